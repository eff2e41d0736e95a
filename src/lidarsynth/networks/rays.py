"""What a network is told of a sensor: where pixels look, how far their neighbours are, where flat ground would be."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidarsynth.lidar.sensor import Sensor

HORIZON = 120.0  # metres: flat ground beyond it, and rays that look above it, count as this far
ROWS, COLUMNS = 32, 16  # images are padded to multiples of these
FEWEST = 2  # such multiples of columns: a kernel of three goes around two of the smallest map's
PADDING_STEP = math.radians(0.4)  # between rows of padding, which lie below the lowest beam


class Rays(NamedTuple):
    """The rays of B images of H x W pixels; angles in radians, float32, each (B, 1, H, W) unless said otherwise.

    elevation, azimuth; up, down: elevation steps (B, 1, H, 1) to the next beam above and below, 0 at the ends;
    across: azimuth step (B, 1, 1, 1); ground: metres to flat ground; blocked: 1 where a ray never returns; inside: 1
    for a beam of the sensor, 0 for a row of padding; dimness (B, 1, H, 1): how much less signal a beam reports than the
    mean beam, so that a network knows the stripes of its reflectance; 0 where nobody has measured it.
    """

    elevation: Tensor
    azimuth: Tensor
    up: Tensor
    down: Tensor
    across: Tensor
    ground: Tensor
    blocked: Tensor
    inside: Tensor
    dimness: Tensor


def encode_range(metres: Tensor) -> Tensor:
    """Metres -> [-1, 1]: R2DM's logarithmic code limited at 255 m, so that a code means the same metres everywhere."""
    return torch.log2(metres + 1) / 4 - 1


def decode_range(code: Tensor) -> Tensor:
    """The inverse of `encode_range`, limited to 0 to 255 metres."""
    return torch.exp2((code.clamp(-1, 1) + 1) * 4) - 1


def ground_range(sine: np.ndarray, mount: np.ndarray) -> np.ndarray:
    """Metres to flat ground along rays of sin(elevation) `sine` from `mount` metres up, at most HORIZON."""
    return mount / np.maximum(np.maximum(-sine, 1e-6), mount / HORIZON)


def level_sines(sensor: Sensor, elevation: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """(H, W) sines of the elevations above the road, of a sensor that may be tilted: from radians (H,) and (W,)."""
    pitch, roll = np.radians(sensor.tilt)
    up = (np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll))  # the road's up, seen from it
    flat = np.cos(azimuth) * up[0] + np.sin(azimuth) * up[1]
    return np.cos(elevation)[:, None] * flat + np.sin(elevation)[:, None] * up[2]


def padded(sensor: Sensor) -> tuple[int, int]:
    """Rows and columns of the images in which a network sees the sensor's."""
    return ROWS * math.ceil(sensor.height / ROWS), COLUMNS * max(FEWEST, math.ceil(sensor.width / COLUMNS))


def rays_of(
    sensor: Sensor,
    blocked: np.ndarray,
    columns: Sequence[int] | np.ndarray | None = None,
    dimness: Sequence[float] = (),
) -> Rays:
    """The sensor's rays as one padded image.

    blocked  (H, W) bool: rays that never return
    dimness  per beam, or () where it is not known
    columns  which columns of the turn, in multiples of 16; None = all, and the first ones again up to a multiple
    """
    height, width = padded(sensor)
    chosen = np.asarray(np.arange(width) if columns is None else columns) % sensor.width
    extra = height - sensor.height
    own = np.radians(np.asarray(sensor.elevations))
    elevation = np.concatenate([own, own[-1] - PADDING_STEP * np.arange(1, extra + 1)])
    azimuth = sensor.ray_angles()[1, 0, chosen].astype(np.float64)
    mount = np.concatenate([mounts(sensor), np.full(extra, sensor.mount)])
    step = np.abs(np.diff(own))
    ends = np.zeros(extra + 1)
    dim = np.asarray(dimness or np.zeros(sensor.height))
    parts = (
        np.broadcast_to(elevation[:, None], (height, len(chosen))),
        np.broadcast_to(azimuth[None], (height, len(chosen))),
        np.concatenate([[0], step, ends[1:]])[:, None],
        np.concatenate([step, ends])[:, None],
        np.full((1, 1), 2 * np.pi / sensor.width),
        ground_range(level_sines(sensor, elevation, azimuth), mount[:, None]),
        np.concatenate([blocked[:, chosen], np.zeros((extra, len(chosen)), bool)]),
        np.broadcast_to((np.arange(height) < sensor.height)[:, None], (height, len(chosen))),
        np.concatenate([dim - dim.mean(), np.zeros(extra)])[:, None],
    )
    return Rays(*(torch.from_numpy(np.ascontiguousarray(part, np.float32))[None, None] for part in parts))


def steps_told(rays: Rays, like: Tensor) -> list[Tensor]:
    """Angular steps up, down and across, each (B, 1, H, W) as `like`, in logarithms of about unit size: 0 for 0.36
    degrees."""
    degrees = (step * (180 / math.pi) for step in (rays.up, rays.down, rays.across))
    return [torch.ones_like(like) * torch.log2(step / 0.4 + 0.1) / 2 for step in degrees]


def stacked(rays: Sequence[Rays]) -> Rays:
    """Images of equal size as one batch."""
    return Rays(*(torch.cat(parts) for parts in zip(*rays, strict=True)))


def mounts(sensor: Sensor) -> np.ndarray:
    """(H,) metres from the ground to where each beam begins. Raises ValueError for one that begins below it."""
    found = sensor.mount + np.asarray(sensor.offsets or np.zeros(sensor.height))
    if found.min() <= 0:
        raise ValueError(f"sensor {sensor.name}: expected beams that begin above the ground (mount and offsets), found "
                         f"one at {found.min():.2f} m")  # fmt: skip
    return found
