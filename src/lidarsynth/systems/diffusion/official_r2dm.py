"""Official checkpoints of R2DM: dict(cfg, weights, ema_weights, optimizer, lr_scheduler, global_step)."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from lidarsynth.experiment.record import Card, Data, Experiment, with_fields
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.sensor import get_sensor

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


def experiment_of(checkpoint: dict[str, Any], coords: Tensor | None, name: str) -> Experiment:
    """Our record of an official cfg. Raises ValueError by the name of the official field."""
    cfg, changes = checkpoint["cfg"], {}
    for field in dict.fromkeys([*FIELDS, *VALUES]):
        group, _, key = field.partition(".")
        if group == "training" and not (isinstance(told := cfg.get(group), dict) and key in told):
            continue  # makes no difference to what the network says
        value = _read(cfg, field)
        if field in VALUES:
            if isinstance(value, Tensor) or value not in list(VALUES[field]):
                raise ValueError(f"expected cfg.{field} to be one of {list(VALUES[field])}, found {value!r:.60}")
            value = VALUES[field][value]
        if field in FIELDS:
            changes[FIELDS[field]] = value
    resolution = _read(cfg, "data.resolution")
    found = None if coords is None else tuple(coords.shape)
    if coords is None or found != (1, 2, *np.atleast_1d(resolution)):
        raise ValueError(f"expected model.coords (1, 2, H, W) with cfg.data.resolution {resolution}, found {found}")
    dataset = cfg["data"].get("dataset")
    known = isinstance(dataset, str) and dataset in LICENCES
    learned_from, licence = LICENCES[dataset] if known else ("not known", "not known")
    card = Card(licence, learned_from, (f"official R2DM checkpoint, {checkpoint.get('global_step')} steps",))
    drawn, width = int(_read(cfg, "data.projection").rpartition("-")[2]), coords.shape[3]
    data = Data(
        sensor=_sensor(coords, name), height=coords.shape[2], width=width, columns=drawn if drawn > width else None
    )
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
    evenly spaced columns, an eighth of a pixel (64 x 512) or a quarter (64 x 1024) from those of the checkpoint; those
    of KITTI raw have a word.
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
    raw = get_sensor("hdl-64e-r2dm")
    if len(rows) == raw.height and shift >= 0.25 and np.allclose(rows, raw.elevations, rtol=0, atol=1e-4):
        return raw.name
    limits = {"min_range": grid.min_range, "max_range": grid.max_range, "mount": grid.mount}
    return {"name": name, "elevations": rows.tolist(), "width": width, "edges": bool(shift < 0.25), **limits}
