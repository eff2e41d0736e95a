"""Ranges as caches store them: whole steps of a few millimetres."""

from __future__ import annotations

import math

import numpy as np

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor

RANGE_STEP = 0.002  # metres per unit of the uint16 that caches store, 0 = nothing returned; see `range_step`


def range_step(sensor: Sensor) -> float:
    """Metres per stored unit for this sensor: 2 mm, or as many whole millimetres as its furthest range needs."""
    return max(RANGE_STEP, math.ceil(sensor.max_range / 65.535) / 1000)


def as_stored(image: RangeImage) -> np.ndarray:
    """(H, W) float32 ranges of the image as a cache of its sensor keeps them: what measured is never 0."""
    step = range_step(image.sensor)
    return np.where(image.mask, np.maximum(np.round(image.range / step), 1) * step, 0).astype(np.float32)
