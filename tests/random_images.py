"""Random images of a small sensor, for processes that do not import torch."""

import numpy as np

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor

SENSOR = Sensor("eight", tuple(range(4, -4, -1)), width=32, min_range=1.45, max_range=80.0)
WHAT = {"name": "test"}


def image(i: int) -> RangeImage:
    """A random image of seed i; every third has labels."""
    rng = np.random.default_rng(i)
    mask = rng.random((8, 32)) < 0.8
    distance = np.where(mask, rng.uniform(1, 90, mask.shape), 0).astype(np.float32)
    reflectance = np.where(mask, rng.random(mask.shape), 0).astype(np.float32)
    label = np.where(mask, rng.integers(0, 20, mask.shape), 0) if i % 3 == 0 else None
    return RangeImage(distance, reflectance, mask, SENSOR, label)


def name(i: int) -> tuple[str, str, str]:
    return "test", f"drive{i // 100}", f"{i:06d}"
