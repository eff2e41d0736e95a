"""What a pixel's neighbours say of its surface, of arrays as the networks of `benchmarks/` take them."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.lidar.surroundings import CHANNELS, surroundings

__all__ = ["CHANNELS", "geometry"]
SENSOR = SENSORS["hdl-64e-kitti"]


def geometry(pixels: np.ndarray) -> np.ndarray:
    """(10, H, W) float32 `surroundings` of (5, H, W) range, x, y, z, reflectance; 0 where nothing was measured."""
    distance, x, y, z, reflectance = pixels
    sensor = SENSOR.resized(width=distance.shape[1])
    return surroundings(RangeImage(distance, reflectance, distance > 0, sensor, xyz=np.stack([x, y, z], -1)))
