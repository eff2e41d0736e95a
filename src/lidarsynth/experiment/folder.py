"""What a model's folder on disk holds: `model.safetensors` and `experiment.json`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from safetensors.torch import save as serialized
from torch import Tensor, nn

from lidarsynth.experiment.eight_bits import packed
from lidarsynth.experiment.record import RECORD, WEIGHTS, Experiment, from_dict
from lidarsynth.lidar.small_file import read_json
from lidarsynth.lidar.whole_file import whole_file

OWN = ("likeliest.", "observer.")  # how the weights begin that a model with a base does not share with it
CLASSES = "classes."  # and those that it may have of its own
OWN_PARTS = ("likeliest", "likeliest_blocks", "observer_channels", "own_classes")  # what a record says of them


def save(
    folder: str | Path, experiment: Experiment, network: nn.Module, half: bool = False, bytewise: tuple[str, ...] = ()
) -> Path:
    """Write `model.safetensors` (float16 if `half`) and `experiment.json`; each is moved into place when complete.

    Of an experiment with a `base`, the weights that are not the base's.
    bytewise  how the names begin of matrices that are stored in eight bits (`eight_bits.packed`)
    Raises ValueError, before anything is written, where a file has the folder's name, and for weights that are too
    large for float16, of which nothing could be loaded.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder to write to, found a file")
    dtype = torch.float16 if half else torch.float32
    # Angles and frequencies stay exact: half precision would turn the highest Fourier features into noise.
    exact = {name for name, _ in network.named_buffers()}
    own = {k: v for k, v in network.state_dict().items() if not experiment.base or k.startswith(owned(experiment))}
    weights = {k: (v if k in exact else v.to(dtype)).contiguous().cpu() for k, v in own.items()}
    if half:
        _check_half(str(folder), weights, own)
    folder.mkdir(parents=True, exist_ok=True)
    weights |= packed({k: v.cpu() for k, v in own.items() if k not in exact}, bytewise)
    with whole_file(folder / RECORD) as record, whole_file(folder / WEIGHTS) as file:
        record.write_text(json.dumps(experiment.to_dict(), indent=1) + "\n", encoding="utf-8")
        file.write_bytes(serialized(weights))  # save_file would hide it from other users
    return folder


def _check_half(folder: str, weights: Mapping[str, Tensor], own: Mapping[str, Tensor]) -> None:
    lost = (name for name, value in weights.items() if value.isinf().any() and own[name].isfinite().all())
    if name := next(lost, None):
        raise ValueError(f"{folder}: expected weights of at most 65504 for half of the size, found "
                         f"{own[name].abs().max():g} in {name}; save them whole")  # fmt: skip


def owned(experiment: Experiment) -> tuple[str, ...]:
    """How the weights begin that a model with a base has of its own."""
    return (*OWN, CLASSES) if experiment.model.own_classes else OWN


def on_base(experiment: Experiment, base: Experiment) -> Experiment:
    """The record of a model with a base, of the networks that its base has now: those that it shares may have changed
    since it was saved."""
    kept = (*OWN_PARTS, "class_channels") if experiment.model.own_classes else OWN_PARTS
    own = {name: getattr(experiment.model, name) for name in kept}
    return replace(experiment, model=replace(base.model, **own))


def read_experiment(folder: str | Path) -> Experiment:
    """The record of a saved model. Raises ValueError when the folder is not one."""
    path = Path(folder) / RECORD
    try:
        return from_dict(read_json(path), str(path))
    except FileNotFoundError:
        raise ValueError(f"{folder}: expected a model folder with {WEIGHTS} and {RECORD}, found no {RECORD}") from None
    except OSError as error:
        raise ValueError(f"{path}: expected a readable record, found {error.strerror}") from None
