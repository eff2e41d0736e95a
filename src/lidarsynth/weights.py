"""Where trained weights come from: shipped ones, our folders, official R2DM releases, official `.pth` files.

R2DM's format is dict(cfg, weights, ema_weights, optimizer, lr_scheduler, global_step), read with
`weights_only=True`. Releases are downloaded once into the user's cache and continue where they were interrupted.
"""

from __future__ import annotations

import http.client
import os
import re
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable, Iterator
from http import HTTPStatus
from importlib.resources import files
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor, nn

from lidarsynth.build import RECORD, WEIGHTS, build_network, build_sensor, load, load_weights
from lidarsynth.experiment import Card, Data, Experiment, with_fields
from lidarsynth.hub import fetch, is_repository
from lidarsynth.official import STAND_INS, SYSTEMS, system_of
from lidarsynth.official_upsampling import is_keras, read_keras
from lidarsynth.presets import PRESETS, preset
from lidarsynth.upsampling_presets import WITHOUT_WEIGHTS

BASE_URL = "https://github.com/kazuto1011/r2dm/releases/download/weights"

# Files of the official repository's release "weights" without their `-300k.pth`: table II's rows, and KITTI-Raw.
RELEASES = (*(f"r2dm-{row}-kitti360" for row in "abcdefgh"), "r2dm-h-kittiraw")

# Field of an official cfg -> field of our Experiment. What is not here (workers, saving, ...) does not matter.
FIELDS: dict[str, str] = {
    "data.depth_format": "data.codec",
    "data.projection": "data.projection",
    "model.architecture": "model.network",
    "model.base_channels": "model.base_channels",
    "model.temb_channels": "model.temb_channels",
    "model.channel_multiplier": "model.channel_multipliers",
    "model.num_residual_blocks": "model.num_residual_blocks",
    "model.gn_num_groups": "model.gn_num_groups",
    "model.gn_eps": "model.gn_eps",
    "model.attn_num_heads": "model.attn_num_heads",
    "model.coords_encoding": "model.coords_encoding",
    "model.dropout": "model.dropout",
    "diffusion.noise_schedule": "diffusion.schedule",
    "diffusion.prediction_type": "diffusion.kind",
    "diffusion.loss_type": "diffusion.loss",
    "training.num_steps": "training.steps",
    "training.batch_size_train": "training.batch_size",
    "training.lr": "training.learning_rate",
    "training.lr_warmup_steps": "training.warmup",
    "training.ema_decay": "training.ema_decay",
    "training.ema_update_every": "training.ema_every",
    "training.seed": "training.seed",
}

# Official words -> ours, for the fields where only these can be built.
VALUES: dict[str, dict[Any, Any]] = {
    "data.depth_format": {"log_depth": "log", "inverse_depth": "inverse", "depth": "metric"},
    "data.projection": {f"{p}-{width}": p for p in ("spherical", "unfolding") for width in (1024, 2048)},
    "data.train_depth": {True: True},
    "data.train_reflectance": {True: True},
    "model.architecture": {"efficient_unet": "efficient-unet"},
    "diffusion.noise_schedule": {"cosine": "cosine", "linear": "linear"},
    "diffusion.prediction_type": {"eps": "eps", "x_0": "x_0", "v": "v"},
    "diffusion.loss_type": {"l1": "l1", "l2": "l2", "huber": "huber"},
    "diffusion.timestep_type": {"continuous": "continuous"},
}

LICENCES: dict[str, tuple[str, str]] = {  # dataset of an official cfg -> what was learned from, and its licence
    "kitti_360": ("KITTI-360", "CC BY-NC-SA 3.0, that of KITTI-360"),
    "kitti_raw": ("KITTI raw", "CC BY-NC-SA 3.0, that of KITTI"),
}

OnBytes = Callable[[int, "int | None"], object]  # called with (bytes so far, bytes in all or None if not known)


def load_parts(source: str | Path, ema: bool = True, on_bytes: OnBytes | None = None) -> tuple[Experiment, nn.Module]:
    """The experiment and the network, in evaluation mode, of trained weights.

    source    in this order: a shipped word (`default`); an interpolation (`bilinear`), which has none; the name of an
              official release (`r2dm-h-kitti360`), which is downloaded once; a folder that `build.save` wrote; an
              official `.pth`, or `.h5` of Keras; a repository `owner/name` of the Hugging Face hub, or
              `owner/name@revision` for one of its versions. `./default` is always a path
    ema       of an official file, the moving average (True) or the raw weights
    on_bytes  called while a release downloads

    Raises ValueError in one line that says what was expected and what was found.
    """
    word = source.removesuffix("-300k") if isinstance(source, str) else None
    if word in (own := shipped()):
        return load(own[word])
    if word in WITHOUT_WEIGHTS:
        return preset(word), build_network(preset(word))
    if word in RELEASES:
        return _load_release(word, ema, on_bytes)
    path = Path(source)
    if path.name in (WEIGHTS, RECORD):
        path = path.parent
    if path.is_dir():
        return load(path)
    if path.is_file():
        return read_official(path, ema)
    if isinstance(source, str) and is_repository(source):
        return load(fetch(source))
    raise ValueError(_unknown(str(source)))


def _load_release(word: str, ema: bool, on_bytes: OnBytes | None) -> tuple[Experiment, nn.Module]:
    path = cache_folder() / f"{word}-300k.pth"
    for done, total in download(f"{BASE_URL}/{path.name}", path):
        if on_bytes is not None:
            on_bytes(done, total)
    try:
        return read_official(path, ema)
    except ValueError as error:
        raise ValueError(f"{error}; delete the file to download it again") from None


def shipped() -> dict[str, Path]:
    """Word -> folder of the weights inside the package."""
    folder = Path(str(files("lidarsynth") / "shipped"))
    return {path.parent.name: path.parent for path in sorted(folder.glob(f"*/{RECORD}"))}


def cache_folder() -> Path:
    """Where releases are kept: LIDARSYNTH_CACHE, or ~/.cache/lidarsynth."""
    return Path(os.environ.get("LIDARSYNTH_CACHE") or Path.home() / ".cache" / "lidarsynth")


def _unknown(source: str) -> str:
    expected = f"expected shipped weights ({', '.join(shipped()) or 'none here'}), a release ({', '.join(RELEASES)})"
    found = "a preset, which has no trained weights" if source in PRESETS else "no file or folder of that name"
    expected += f", an interpolation ({', '.join(WITHOUT_WEIGHTS)})"
    return f"{source}: {expected}, a model folder, an official .pth file or owner/name of a hub, found {found}"


def read_official(path: str | Path, ema: bool = True) -> tuple[Experiment, nn.Module]:
    """The experiment and the network of an official checkpoint, of R2DM or of SYSTEMS; `ema` False takes raw weights.

    Of R2DM, the ray angles that the network learned with come from the checkpoint, and the experiment's sensor has
    them. Raises ValueError when the file is no such checkpoint, is damaged or cannot be built.
    """
    path = Path(path)
    if is_keras(path):
        return _read_keras(path)
    checkpoint = _unpickled(path)
    system = system_of(checkpoint)
    name = "ema_weights" if ema else "weights"
    try:
        if system is not None:
            return system.read(checkpoint, path.stem, ema)
        _check(checkpoint)
        weights = {key.removeprefix("model."): v for key, v in checkpoint[name].items() if key != "_dummy"}
        experiment = _experiment(checkpoint, weights.get("coords"), path.stem)
        network = build_network(experiment)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    load_weights(network, weights, f"{path}: {name}")
    return experiment, network


def _read_keras(path: Path) -> tuple[Experiment, nn.Module]:
    try:
        return read_keras(path)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


EXPECTED = f"expected an official R2DM checkpoint, or one of {', '.join(SYSTEMS)}"


def _unpickled(path: Path) -> Any:
    """What the file holds. Raises ValueError for a file that is damaged or is none."""
    expected = f"{path}: {EXPECTED}"
    try:
        zipped = zipfile.is_zipfile(path)
        with path.open("rb") as file:
            start = file.read(4)
    except OSError as error:
        raise ValueError(f"{expected}, found {error.strerror or error}") from None
    try:
        # Mapped, so that the optimiser's two thirds of the file are not read.
        with torch.serialization.safe_globals(STAND_INS):
            return torch.load(path, map_location="cpu", weights_only=True, mmap=zipped)
    except Exception as error:  # a damaged pickle raises whatever it likes
        raise ValueError(f"{expected}, found {_damage(start, zipped, error)}") from None


def _check(checkpoint: Any) -> None:
    """Raises ValueError, saying what there is instead, unless this is R2DM's dict."""
    if not isinstance(checkpoint, dict):
        raise ValueError(f"{EXPECTED}, found a {type(checkpoint).__name__}")
    if not all(isinstance(checkpoint.get(key), dict) for key in ("cfg", "weights", "ema_weights")):
        keys = [str(key) for key in checkpoint]
        raise ValueError(f"{EXPECTED}, and R2DM's with cfg, weights and ema_weights, found {len(keys)} keys {keys[:4]}")
    for key, value in [*checkpoint["weights"].items(), *checkpoint["ema_weights"].items()]:
        if not isinstance(key, str) or not isinstance(value, Tensor):
            raise ValueError(f"{EXPECTED} with tensors by name, found {key!r:.60} {type(value).__name__}")


def _damage(start: bytes, zipped: bool, error: Exception) -> str:
    if not start:
        return "an empty file"
    if start.startswith(b"PK") and not zipped:
        return "a truncated file"
    if not zipped and not start.startswith(b"\x80"):
        return f"another kind of file, which starts with {start!r}"
    # torch's own text advises to load it without weights_only; the reason stands in its middle.
    reason = str(error).rpartition("WeightsUnpickler error:")[2].strip().partition(". Please")[0].partition("\n")[0]
    return f"a damaged or unsafe file ({reason:.120})"


def _experiment(checkpoint: dict[str, Any], coords: Tensor | None, name: str) -> Experiment:
    """Our record of an official cfg. Raises ValueError by the name of the official field."""
    cfg, changes = checkpoint["cfg"], {}
    for field in dict.fromkeys([*FIELDS, *VALUES]):
        group, _, key = field.partition(".")
        if group == "training" and key not in cfg.get(group, ()):
            continue  # makes no difference to what the network says
        value = _read(cfg, field)
        if field in VALUES:
            if value not in list(VALUES[field]):
                raise ValueError(f"expected cfg.{field} to be one of {list(VALUES[field])}, found {value!r:.60}")
            value = VALUES[field][value]
        if field in FIELDS:
            changes[FIELDS[field]] = value
    resolution = _read(cfg, "data.resolution")
    found = None if coords is None else tuple(coords.shape)
    if coords is None or found != (1, 2, *np.atleast_1d(resolution)):
        raise ValueError(f"expected model.coords (1, 2, H, W) with cfg.data.resolution {resolution}, found {found}")
    learned_from, licence = LICENCES.get(cfg["data"].get("dataset"), ("not known", "not known"))
    card = Card(licence, learned_from, (f"official R2DM checkpoint, {checkpoint.get('global_step')} steps",))
    data = Data(sensor=_sensor(coords, name), height=coords.shape[2], width=coords.shape[3])
    return with_fields(Experiment(name, data=data, card=card), changes)


def _read(cfg: dict[str, Any], field: str) -> Any:
    group, _, key = field.partition(".")
    part = cfg.get(group)
    if not isinstance(part, dict) or key not in part:
        raise ValueError(f"expected cfg.{field}, found the fields {list(part if isinstance(part, dict) else cfg)}")
    return part[key]


def _sensor(coords: Tensor, name: str) -> str | dict:
    """The sensor whose ray angles are the checkpoint's `coords` (1, 2, H, W): a word, or a table for another grid.

    R2DM's own grid is exact at any height. Measured angles (scan unfolding) become beams at their exact elevations with
    evenly spaced columns, an eighth of a pixel (64 x 512) or a quarter (64 x 1024) from those of the checkpoint.
    """
    height, width = coords.shape[2:]
    elevation, azimuth = np.degrees(coords[0].double().numpy())
    grid = build_sensor(Experiment("grid", data=Data(width=width)))
    step = (grid.elevations[0] - grid.elevations[1]) * grid.height / height
    rows = grid.elevations[0] - step * np.arange(height)
    shift = np.median((180 - azimuth) / 360 * width - np.arange(width))  # pixels: 0 = left edge, 0.5 = centre
    if not np.allclose(elevation, rows[:, None], rtol=0, atol=1e-4):
        rows = elevation.mean(axis=1).clip(-90, 90).round(6)
    elif grid.height % height == 0 and abs(shift) < 0.01:
        return grid.name
    if not np.all(np.diff(rows) < 0):
        raise ValueError(f"expected model.coords with elevations that fall from row to row, found {rows[:4]} degrees")
    limits = {"min_range": grid.min_range, "max_range": grid.max_range, "mount": grid.mount}
    return {"name": name, "elevations": rows.tolist(), "width": width, "edges": bool(shift < 0.25), **limits}


def download(url: str, path: str | Path) -> Iterator[tuple[int, int | None]]:
    """Fetch `url` into `path`, yielding (bytes so far, bytes in all or None if not told); nothing if it is there.

    The bytes gather in `<path>.part`, which moves into place when it is complete; after an interruption, the next call
    continues there. Raises ValueError that says where to put the file by hand.
    """
    path = Path(path)
    part = path.with_name(path.name + ".part")
    if path.is_file():
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.touch()
        # Written in place, not appended: two processes that fetch the same file write the same bytes.
        with part.open("r+b") as file:
            yield from _receive(url, file)
        os.replace(part, path)
    except (OSError, http.client.HTTPException) as error:
        if path.is_file():  # another process was faster
            return
        place = f"without a network, put the file at {path}"
        raise ValueError(f"{url}: expected a download, found {_reason(error)}; {place}") from None


def _receive(url: str, file: BinaryIO) -> Iterator[tuple[int, int | None]]:
    """Continue `file` to the end of `url`; from the start where the server cannot continue."""
    # The last byte is asked for again, so that a complete file is answered like any other.
    start = max(file.seek(0, os.SEEK_END) - 1, 0)
    with _reply(url, start) as reply:
        done, total = _extent(reply)
        file.seek(done)
        yield done, total
        while chunk := reply.read(1 << 20):
            file.write(chunk)
            done += len(chunk)
            yield done, total
    if total is not None and done != total:
        raise ConnectionError(f"only {done} of {total} bytes")
    file.truncate(done)  # the rest, if any, is of an older and longer file


def _reply(url: str, start: int) -> http.client.HTTPResponse:
    try:
        return urllib.request.urlopen(urllib.request.Request(url, headers={"Range": f"bytes={start}-"}), timeout=30)
    except urllib.error.HTTPError as error:
        if error.code != HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
            raise
        error.close()
        return urllib.request.urlopen(url, timeout=30)


def _extent(reply: http.client.HTTPResponse) -> tuple[int, int | None]:
    """First byte of a reply, and bytes of the whole file or None if not told."""
    length = reply.headers["Content-Length"]
    if reply.status != HTTPStatus.PARTIAL_CONTENT:
        return 0, None if length is None else int(length)
    told = reply.headers["Content-Range"] or ""  # bytes FIRST-LAST/TOTAL
    match = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", told)
    if match is None:
        raise ConnectionError(f"an answer with Content-Range {told!r}")
    return int(match[1]), None if match[2] == "*" else int(match[2])


def _reason(error: Exception) -> str:
    if isinstance(error, urllib.error.HTTPError):
        error.close()
    elif isinstance(error, urllib.error.URLError):
        return str(error.reason)
    return str(error)
