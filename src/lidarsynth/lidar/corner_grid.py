"""LiDAR-Diffusion's way from points to an image and back (CVPR 2024): a pixel's ray runs through its upper left corner.

The grid is that of our `hdl-64e`, but points out of view pile up on the border rows, and what was written last, the
nearest, stays. Arithmetic is float32 where the published one is: points drawn twice lie exactly on corners, so that
rounding decides which pixel takes them.
"""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.sensor import Sensor

TOP, BOTTOM = 3.0, -25.0  # degrees, of KITTI's sensor
HEIGHT, WIDTH = 64, 1024
CODE = 5.84  # binary logarithms of metres: the range code is log2(r + 1.0001) / CODE


def on_corner_grid(sensor: Sensor) -> bool:
    """Whether a sensor's pixels are those of this grid, as of our `hdl-64e`."""
    rows = tuple(TOP - (TOP - BOTTOM) * i / HEIGHT for i in range(HEIGHT))
    return sensor.edges and sensor.width == WIDTH and sensor.elevations == rows


def corner_image(points: np.ndarray, near: float = 1.0, far: float = 56.0) -> np.ndarray:
    """(64, 1024) float32 metres, -1 where empty, of points (n, 3) in metres with near < |p| < far, strict."""
    xyz = np.asarray(points, np.float32)
    distance = np.linalg.norm(xyz, axis=1)
    inside = (distance > near) & (distance < far)
    xyz, distance = xyz[inside], distance[inside]
    azimuth = -np.arctan2(xyz[:, 1], xyz[:, 0])
    elevation = np.arcsin(xyz[:, 2] / distance)
    column = np.floor(np.float32(0.5) * (azimuth / np.float32(np.pi) + 1) * WIDTH)
    row = np.floor((1 - (elevation + np.float32(np.radians(-BOTTOM))) / np.float32(np.radians(TOP - BOTTOM))) * HEIGHT)
    column = np.clip(column, 0, WIDTH - 1).astype(np.int64)
    row = np.clip(row, 0, HEIGHT - 1).astype(np.int64)
    image = np.full((HEIGHT, WIDTH), -1, np.float32)
    order = np.argsort(-distance, kind="stable")
    image[row[order], column[order]] = distance[order]
    return image


def corner_points(distance: np.ndarray) -> np.ndarray:
    """(64, 1024, 3) float64 metres: the ray through each pixel's corner, `distance` (64, 1024) metres long."""
    yaw = np.pi * (2 * np.arange(WIDTH) / WIDTH - 1)[None, :]
    pitch = np.radians((1 - np.arange(HEIGHT) / HEIGHT) * (TOP - BOTTOM) + BOTTOM)[:, None]
    x = np.cos(yaw) * np.cos(pitch) * distance
    y = -np.sin(yaw) * np.cos(pitch) * distance
    return np.stack(np.broadcast_arrays(x, y, np.sin(pitch) * distance), -1)


def corner_channels(distance: np.ndarray) -> np.ndarray:
    """(4, 64, 1024) float32: range and x, y, z on the pixels' rays, all -1 where the image (64, 1024) is empty."""
    xyz = np.moveaxis(corner_points(distance), -1, 0)
    return np.where(distance > 0, np.concatenate([distance[None], xyz]), -1).astype(np.float32)


def drawn_and_coded(points: np.ndarray, near: float = 1.0, far: float = 56.0) -> np.ndarray:
    """(n, 3) float32 metres, row by row: a scan as LiDAR-Diffusion's reference has it, through image and range code.

    Scan -> image -> code in [-1, 1] -> metres (1e-4 too long) -> the rays with near < r < far.
    """
    return decoded(corner_image(points, near, far), near, far)


def decoded(image: np.ndarray, near: float = 1.0, far: float = 56.0) -> np.ndarray:
    """(n, 3) float32 metres of an image (64, 1024) in metres, empty ones 0 or less, as `drawn_and_coded`."""
    code = np.log2(np.where(image > 0, image, 0) + np.float32(1e-4) + np.float32(1)) / np.float32(CODE)
    code = np.clip(code * 2 - 1, -1, 1)
    distance = np.exp2((code * np.float32(0.5) + np.float32(0.5)) * np.float32(CODE)) - 1
    return corner_points(distance)[(distance > near) & (distance < far)].astype(np.float32)
