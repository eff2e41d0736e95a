"""Depth codecs: metres <-> a word of CODECS in [0, 1], and RangeImage <-> x_0 in [-1, 1]."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lidarsynth.lidar.scan import RangeImage, laid_out
from lidarsynth.lidar.sensor import Sensor, get_sensor

OVERSHOOT = 0.05  # what comes out of a network may pass its limits by so much, and is clipped; other codes by far more


@dataclass(frozen=True)
class DepthCodec:
    """A pair of inverse functions of (tensor, sensor): metres -> [0, 1] and back, before masking and clamping."""

    forward: Callable[[Tensor, Sensor], Tensor]
    inverse: Callable[[Tensor, Sensor], Tensor]


def _log_scale(sensor: Sensor) -> float:
    return math.log2(sensor.max_range + 1)


# R2DM table II, rows C (log), D (metric) and E (inverse); LiDARGen's; and that of DUSty's first release.
CODECS: dict[str, DepthCodec] = {
    "log": DepthCodec(
        lambda d, sensor: torch.log2(d + 1) / _log_scale(sensor),
        lambda u, sensor: torch.exp2(u * _log_scale(sensor)) - 1,
    ),
    "inverse": DepthCodec(
        lambda d, sensor: sensor.min_range / (d + 1e-8),
        lambda u, sensor: sensor.min_range / (u + 1e-8),
    ),
    "metric": DepthCodec(
        lambda d, sensor: d / sensor.max_range,
        lambda u, sensor: u * sensor.max_range,
    ),
    # Whatever the sensor, and all that is farther becomes 63 m; without the 0.1 mm that LiDARGen adds before.
    "log-63m": DepthCodec(
        lambda d, sensor: torch.log2(d + 1) / 6,
        lambda u, sensor: torch.exp2(u * 6) - 1,
    ),
    # 1 / d from the farthest, 0, to the nearest, 1; the code 0 stays no return.
    "inverse-minmax": DepthCodec(
        lambda d, sensor: (1 / d - 1 / sensor.max_range) / (1 / sensor.min_range - 1 / sensor.max_range),
        lambda u, sensor: (u > 0) / (u * (1 / sensor.min_range - 1 / sensor.max_range) + 1 / sensor.max_range),
    ),
}


def _codec(name: str) -> DepthCodec:
    if name not in CODECS:
        raise ValueError(f"expected a depth codec of {', '.join(CODECS)}, found {name!r}")
    return CODECS[name]


def valid(distance: Tensor, sensor: Sensor) -> Tensor:
    """Bool, where metres lie strictly between the sensor's range limits."""
    return (distance > sensor.min_range) & (distance < sensor.max_range)


def encode(distance: Tensor, sensor: Sensor, codec: str = "log") -> Tensor:
    """Metres -> [0, 1], any shape; 0 where the range is not strictly inside the sensor's limits."""
    return _codec(codec).forward(distance, sensor).clamp(0, 1) * valid(distance, sensor)


def decode(code: Tensor, sensor: Sensor, codec: str = "log") -> Tensor:
    """[0, 1] -> metres, any shape; 0 where the result is not strictly inside the sensor's limits."""
    distance = _codec(codec).inverse(code, sensor)
    return torch.where(valid(distance, sensor), distance, 0.0)


def to_x_0(image: RangeImage, codec: str = "log") -> Tensor:
    """RangeImage -> x_0 (2, H, W) float32 in [-1, 1]: range code, reflectance; -1 in both where nothing returned."""
    parts = (laid_out(part, np.float32) for part in (image.range, image.reflectance))
    distance, reflectance = map(torch.from_numpy, parts)
    return 2 * torch.stack([encode(distance, image.sensor, codec), reflectance]) - 1


def from_x_0(x_0: Tensor | np.ndarray, sensor: Sensor | str, codec: str = "log") -> RangeImage:
    """x_0 (2, H, W) in [-1, 1], range code and reflectance, or (1, H, W), the code alone -> RangeImage of the sensor.

    codec  how the ranges are coded, a word of CODECS. Pixels outside the sensor's limits are empty

    Raises ValueError for another shape, NaN, and values that are not so coded: outside -1 to 1 by more than 0.05 (less
    is clipped; a sampler that passes by more is clamped first), or all of them in 0 to 1.
    """
    if isinstance(x_0, np.ndarray):  # a view, of a mapped file, of the other byte order: torch takes none of them
        x_0 = np.array(x_0, x_0.dtype.newbyteorder("="))
    sensor, x_0 = get_sensor(sensor), torch.as_tensor(x_0).detach().float().cpu()
    if x_0.ndim != 3 or x_0.shape[0] not in (1, 2):
        raise ValueError(f"x_0 must be (2, H, W), or (1, H, W) without reflectance, got {tuple(x_0.shape)}")
    least, greatest = x_0.aminmax()
    if not (least >= -1 - OVERSHOOT and greatest <= 1 + OVERSHOOT):  # NaN is not
        raise ValueError(f"expected x_0 of -1 to 1, found {least:.4g} to {greatest:.4g}: metres, another scale, or of "
                         "a network that has to be clamped first")  # fmt: skip
    if least >= 0 and greatest > least:
        raise ValueError(f"expected x_0 of -1 to 1, where -1 is no return, found {least:.4g} to {greatest:.4g}: a code "
                         "of 0 to 1 becomes 2 * code - 1")  # fmt: skip
    unit = (x_0.clamp(-1, 1) + 1) / 2
    distance = decode(unit[0], sensor, codec)
    mask = distance > 0
    reflectance = unit[1] * mask if len(unit) == 2 else torch.zeros_like(distance)
    return RangeImage(distance.numpy(), reflectance.numpy(), mask.numpy(), sensor)
