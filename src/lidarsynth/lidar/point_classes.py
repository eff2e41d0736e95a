"""From the classes of an image's pixels to those of a scan's points."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.scan import RangeImage


def class_of_points(xyz: np.ndarray, image: RangeImage, pixels: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """(N,) int64 class of each point (N, 3) of pixels (row, column): of the one, of the nine around, that is nearest in
    range, as a pixel holds but one of its points; 0 for points of no row, out of the sensor's limits, or around which
    nothing returned."""
    assert image.label is not None
    (row, column), (height, width) = pixels, image.shape
    depth = np.linalg.norm(xyz, axis=1)
    nearest, found = np.full(len(xyz), np.inf), np.zeros(len(xyz), np.int64)
    for down in (0, -1, 1):
        for across in (0, -1, 1):
            at = np.clip(row + down, 0, height - 1), (column + across) % width
            off = np.where(image.mask[at], np.abs(image.range[at] - depth), np.inf)
            closer = off < nearest
            nearest, found = np.where(closer, off, nearest), np.where(closer, image.label[at], found)
    seen = (row >= 0) & (depth >= image.sensor.min_range) & (depth <= image.sensor.max_range)
    return np.where(seen, found, 0)
