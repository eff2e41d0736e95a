"""Where trained weights come from: shipped ones, our folders, official R2DM releases, official `.pth` files.

R2DM's format is dict(cfg, weights, ema_weights, optimizer, lr_scheduler, global_step), read with
`weights_only=True`. Releases are downloaded once into the user's cache and continue where they were interrupted.
"""

from __future__ import annotations

import os
from pathlib import Path

import torch
from torch import nn

from lidarsynth.experiment.presets import PRESETS, preset
from lidarsynth.experiment.record import RECORD, WEIGHTS, Experiment
from lidarsynth.experiment.upsampling_presets import WITHOUT_WEIGHTS
from lidarsynth.networks.device import check_device, usual_torch
from lidarsynth.systems.hub import fetch, is_repository
from lidarsynth.systems.scan_model import ScanModel
from lidarsynth.systems.table import SHIPPED, assemble, build_network, load_folder
from lidarsynth.weights.download import OnBytes, cache_folder, download
from lidarsynth.weights.official import read_official

BASE_URL = "https://github.com/kazuto1011/r2dm/releases/download/weights"

# Files of the official repository's release "weights" without their `-300k.pth`: table II's rows, and KITTI-Raw.
RELEASES = (*(f"r2dm-{row}-kitti360" for row in "abcdefgh"), "r2dm-h-kittiraw")


def load_parts(source: str | Path, ema: bool = True, on_bytes: OnBytes | None = None) -> tuple[Experiment, nn.Module]:
    """The experiment and the network, in evaluation mode, of trained weights.

    source    in this order: a shipped word (`default`); an interpolation (`bilinear`), which has none; the name of an
              official release (`r2dm-h-kitti360`), which is downloaded once; a folder of ours; an
              official `.pth`, or `.h5` of Keras; a repository `owner/name` of the Hugging Face hub, or
              `owner/name@revision` for one of its versions. `./default` is always a path
    ema       of an official file, the moving average (True) or the raw weights
    on_bytes  called while a release downloads

    Raises ValueError in one line that says what was expected and what was found.
    """
    if not isinstance(source, str | os.PathLike):
        raise ValueError(f"expected weights by a word or a path, found a {type(source).__name__}")
    word = source.removesuffix("-300k") if isinstance(source, str) else None
    if word in (own := shipped()):
        return load_folder(own[word])
    if word in WITHOUT_WEIGHTS:
        return preset(word), build_network(preset(word))
    if word in RELEASES:
        return _load_release(word, ema, on_bytes)
    path = Path(source)
    if path.name in (WEIGHTS, RECORD):
        path = path.parent
    if os.path.isdir(path) and source != "":  # which is no word for where one happens to be
        return load_folder(path)
    if os.path.isfile(path):
        return read_official(path, ema)
    if isinstance(source, str) and is_repository(source):
        return load_folder(fetch(source))
    raise ValueError(_unknown(source))


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
    return {path.parent.name: path.parent for path in sorted(SHIPPED.glob(f"*/{RECORD}"))}


def _unknown(source: str | Path) -> str:
    expected = f"expected shipped weights ({', '.join(shipped()) or 'none here'}), a release ({', '.join(RELEASES)})"
    found = "a preset, which has no trained weights" if source in PRESETS else "no file or folder of that name"
    found += "; words are given as str" if isinstance(source, Path) else ""
    expected += f", an interpolation ({', '.join(WITHOUT_WEIGHTS)})"
    return f"{source}: {expected}, a model folder, an official .pth file or owner/name of a hub, found {found}"


def load(source: str | Path = "default", ema: bool = True, device: str | torch.device = "cpu") -> ScanModel:
    """A trained model.

    source  `default`: the shipped weights; the name of an official release; one of our folders; an official `.pth`;
            `owner/name` of the Hugging Face hub
    ema     official files hold two sets of weights: their moving average (True), or the raw ones

    Raises ValueError, or OSError, with one line that says what was expected and what was found.
    """
    check_device(device)
    with usual_torch():
        return assemble(*load_parts(source, ema)).to(device)
