"""Official checkpoints of LiDAR-SR, ILN and LIIF: those of ILN's repository, and LiDAR-SR's own Keras weights.

ILN's repository saves dict(epoch, model=dict(name, args, state_dict), ..., lidar_in=dict(channels, ...)).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lidarsynth.experiment.record import Card, Data, Experiment, Upsampling
from lidarsynth.experiment.upsampling_presets import iln, lidar_sr, lidar_sr_keras, liif
from lidarsynth.networks.iln import ILN
from lidarsynth.networks.iln import from_official as iln_from_official
from lidarsynth.networks.lidar_sr import from_keras, official_arguments
from lidarsynth.networks.lidar_sr import from_official as lidar_sr_from_official

NAMES = {"lsr": lidar_sr, "iln": iln, "liif_lidar": liif}  # of models there -> our preset
SCALES = {2: (4, 1), 3: (8, 2), 4: (16, 4)}  # published LiDAR-SR by how often it doubles the rows (4h_1w, ...)
ROWS = 64  # of the images that ILN and LIIF are asked for; `into` gives any other
CARD = Card("not known", "streets of CARLA")
# Fields of lidar_in that a sensor needs: angles in radians, ranges in metres.
FIELDS = ("channels", "points_per_ring", "min_v", "max_v", "min_r", "max_r", "norm_r")


def belongs(checkpoint: object) -> bool:
    """Whether this is a dict whose `model` is named; no other system saves that."""
    model = checkpoint.get("model") if isinstance(checkpoint, dict) else None
    return isinstance(model, dict) and "name" in model and "state_dict" in model


def read(checkpoint: Any, name: str, ema: bool = True) -> tuple[Experiment, nn.Module]:
    """The experiment, called `name`, and the network of a checkpoint of ILN's repository; there is one set of weights.

    Its images have the beams of the checkpoint's sensor and, evenly between them, as many as LiDAR-SR makes, or as make
    64; a checkpoint that tells no sensor gets the HDL-64E. LiDAR-SR learned from images of 16 and of 64 beams over the
    same view, so that the known beams are 63 / 15 of its rows apart: field `spread`.
    Raises ValueError for another model or width, tensors that are missing, or arguments that contradict them.
    """
    model = checkpoint["model"]
    if model["name"] not in NAMES:
        raise ValueError(f"expected a model of {', '.join(NAMES)} from ILN's repository, found {model['name']!r:.60}")
    start, sensor = NAMES[model["name"]](), checkpoint.get("lidar_in")
    group = start.upsampling or Upsampling()
    if model["name"] == "lsr":
        group = replace(group, factor=_scale(model["state_dict"], official_arguments(checkpoint)), spread=True)
        network: nn.Module = lidar_sr_from_official(checkpoint, group.factor)
        start = replace(start, model=replace(start.model, dropout=network.dropout))
        width = network.width
    else:
        network = iln_from_official(checkpoint, model["name"])
        if isinstance(network, ILN):
            group = replace(group, depth=len(network.attention.transformer.layers))
            start = replace(start, model=replace(start.model, attn_num_heads=network.heads))
        else:
            group = replace(group, unfold=network.unfold, ensemble=network.ensemble)
        width = start.model.base_channels
    if sensor is not None:
        start, group = _with_sensor(start, group, sensor, name)
    history = (f"official checkpoint of ILN's repository, {checkpoint.get('epoch')} epochs",)
    experiment = replace(start, name=name, model=replace(start.model, base_channels=width), upsampling=group)
    return replace(experiment, card=replace(CARD, history=history)), network


def _scale(weights: object, told: Mapping[str, float]) -> tuple[int, int]:
    """Factors of rows and columns of the published network that doubles as often as this one; of columns, which leave
    no trace in the tensors, what its arguments tell."""
    keys = weights if isinstance(weights, Mapping) else {}
    doublings = sum(str(key).startswith("up_scale.") and str(key).endswith(".up_block.0.weight") for key in keys)
    if doublings not in SCALES:
        raise ValueError(f"expected LiDAR-SR with {', '.join(map(str, SCALES))} up-scaling layers, found {doublings}")
    rows, columns = SCALES[doublings]
    return rows, int(told.get("scale_w", columns))


def _with_sensor(experiment: Experiment, group: Upsampling, told: object, name: str) -> tuple[Experiment, Upsampling]:
    """The experiment on the checkpoint's `lidar_in`, its beams as many times denser as the factor says."""
    if not isinstance(told, Mapping) or not all(isinstance(told.get(f), (int, float)) for f in FIELDS):
        raise ValueError(f"expected lidar_in with the numbers {', '.join(FIELDS)}, found {told!r:.80}")
    channels, columns = int(told["channels"]), int(told["points_per_ring"])
    limits = {"norm": float(told["norm_r"]), "max_range": float(told["max_r"]), "min_range": float(told["min_r"])}
    rows, group = group.factor[0], replace(group, **limits)
    if experiment.model.network != "lidar-sr":
        rows = max(1, ROWS // channels)
        group = replace(group, factor=(rows, 1))
    top, bottom = np.degrees([told["max_v"], told["min_v"]])
    step = (top - bottom) / max(channels - 1, 1) / rows
    sensor = {
        "name": name,
        "elevations": (top - step * np.arange(channels * rows)).round(6).tolist(),
        "width": columns * group.factor[1],
        "min_range": 0.0,  # nearer returns are seen, as 0: `group.min_range`
        "max_range": float(told["max_r"]),
    }
    height, width = channels * rows, columns * group.factor[1]
    data = Data(sensor, "spherical", height, width, codec="metric", reflectance=False)
    return replace(experiment, data=data), group


def is_keras(path: Path) -> bool:
    """Whether the file is HDF5, as Keras saves weights."""
    try:
        with path.open("rb") as file:
            return file.read(8) == b"\x89HDF\r\n\x1a\n"
    except OSError:
        return False


def read_keras(path: Path) -> tuple[Experiment, nn.Module]:
    """The experiment and the network of LiDAR-SR's own weights, such as `weights.h5`; no code in it is run.

    The low rows it learned from are the lowest of each four. Raises ValueError when the file is damaged or of another
    network; ImportError without h5py, naming the extra that brings it.
    """
    try:
        import h5py  # type: ignore[import-not-found]
    except ImportError:
        raise ImportError("weights of Keras need h5py: pip install 'lidarsynth[data]'") from None
    try:
        with h5py.File(path) as file:
            network = from_keras([*_in_order(file.get("model_weights", file), h5py)])
    except (OSError, KeyError, RuntimeError) as error:
        raise ValueError(f"expected LiDAR-SR's Keras weights, found a damaged file ({error!s:.80})") from None
    start = lidar_sr_keras()
    data = replace(start.data, sensor="os1-64", projection="spherical")
    history = ("official Keras weights of LiDAR-SR",)
    experiment = replace(start, name=path.stem, data=data, card=replace(CARD, history=history))
    return replace(experiment, model=replace(start.model, base_channels=network.width)), network


def _in_order(group: Any, h5py: Any) -> Iterator[Tensor]:
    """The tensors of Keras' file as of `get_weights()`. Raises ValueError for another layout."""
    if "layer_names" not in group.attrs:
        raise ValueError(f"expected weights by layer, as Keras 2 saves them, found {list(group)[:4]}")
    for layer in group.attrs["layer_names"]:
        part = group[layer]
        for name in part.attrs["weight_names"]:
            found = part[name]
            if not isinstance(found, h5py.Dataset) or found.dtype.kind != "f":
                raise ValueError(f"expected numbers as {name!r:.60}, found {found!r:.60}")
            yield torch.from_numpy(np.asarray(found[()], np.float32))
