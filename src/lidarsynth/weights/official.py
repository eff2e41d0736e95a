"""Official checkpoint files: which system they are of, and how they are read, with `weights_only=True`."""

from __future__ import annotations

import warnings
import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from lidarsynth.experiment.record import Experiment
from lidarsynth.lidar.small_file import LARGEST_WEIGHTS, check_regular
from lidarsynth.networks.tensors import Undrawn, load_weights, plain
from lidarsynth.systems.diffusion.official_r2dm import experiment_of
from lidarsynth.systems.table import build_network, official_readers
from lidarsynth.systems.upsampling.official import is_keras, read_keras


def read_official(path: str | Path, ema: bool = True) -> tuple[Experiment, nn.Module]:
    """The experiment and the network of an official checkpoint, of R2DM or of SYSTEMS; `ema` False takes raw weights.

    Of R2DM, the ray angles that the network learned with come from the checkpoint, and the experiment's sensor has
    them. Raises ValueError when the file is no such checkpoint, is damaged or cannot be built.
    """
    path = Path(path)
    try:
        check_regular(path, LARGEST_WEIGHTS)
    except ValueError as error:
        raise ValueError(f"{path}: {EXPECTED}, {str(error).rpartition(', ')[2]}") from None
    except OSError as error:
        raise ValueError(f"{path}: {EXPECTED}, found {error.strerror or error}") from None
    if is_keras(path):
        return _read_keras(path)
    checkpoint = _unpickled(path)
    reader = next((reader for reader in official_readers().values() if reader.belongs(checkpoint)), None)
    name = "ema_weights" if ema else "weights"
    try:
        if reader is not None:
            return reader.read(checkpoint, path.stem, ema)
        _check(checkpoint)
        weights = {key.removeprefix("model."): v for key, v in checkpoint[name].items() if key != "_dummy"}
        experiment = experiment_of(checkpoint, weights.get("coords"), path.stem)
        with Undrawn():
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


EXPECTED = f"expected an official R2DM checkpoint, or one of {', '.join(official_readers())}"


def _unpickled(path: Path) -> Any:
    """What the file holds. Raises ValueError for a file that is damaged or is none."""
    expected = f"{path}: {EXPECTED}"
    try:
        zipped = _is_zip(path)
        with path.open("rb") as file:
            start = file.read(4)
    except OSError as error:
        raise ValueError(f"{expected}, found {error.strerror or error}") from None
    stand_ins = [pair for reader in official_readers().values() for pair in reader.stand_ins]
    try:
        # Mapped, so that the optimiser's two thirds of the file are not read.
        with torch.serialization.safe_globals(stand_ins), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of torch, about old formats and sparse tensors
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=zipped)
    except Exception as error:  # a damaged pickle raises whatever it likes
        raise ValueError(f"{expected}, found {_damage(start, zipped, error)}") from None
    return plain(content, str(path))


def _is_zip(path: Path) -> bool:
    try:
        return zipfile.is_zipfile(path)
    except zipfile.BadZipFile:  # of several disks, says a damaged one
        return False


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
