"""Grids of a plane, on which what a surface's neighbours say of it is known exactly."""

import numpy as np
import torch

from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.column_neighbours import Grid, known_grid


def plane_grid(sensor: Sensor, blocked: np.ndarray, normal: tuple[float, float, float], level: float) -> Grid:
    """Two alike (2, H, W) of the plane normal . p = level, nothing beyond 60 m or where `blocked` (H, W) bool."""
    nearer = (sensor.directions() @ np.array(normal)) / level
    metres = np.where(nearer > 1 / 60, 1 / np.maximum(nearer, 1 / 60), 0) * ~blocked
    return known_grid(torch.from_numpy(metres).float().expand(2, -1, -1), torch.full((2, *metres.shape), 0.3))
