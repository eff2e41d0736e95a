"""What a pixel's neighbours say of its surface, the same whatever the sensor's height, tilt and response.

Ten channels that a small network learns only slowly from metres: a kerb is 5 cm high where the normalised range has a
standard deviation of 12 m. `street_classes.py --geometry` gives them to RangeNet.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import minimum_filter

CHANNELS = 10
CELL, CELLS = 1.5, 81  # metres, and how many of them each way, of the map of the lowest ground


def geometry(pixels: np.ndarray) -> np.ndarray:
    """(10, H, W) float32 of (5, H, W) range, x, y, z, reflectance; 0 where nothing was measured.

    log range; how bent the ring is within 1 and 4 columns; the step to the beam below, and its slope; height above the
    plane of the near ground; above the lowest ground around, coarse and fine; how bent the ring's height is;
    reflectance between the scan's own quantiles.
    """
    distance, x, y, z, reflectance = pixels
    there, far = distance > 0, np.maximum(distance, 0.5)
    below = np.roll(there, -1, axis=0)
    below[-1] = False
    below &= there
    step = np.abs(distance - np.roll(distance, -1, axis=0)) / far
    rise = z - np.roll(z, -1, axis=0)
    run = np.hypot(x - np.roll(x, -1, axis=0), y - np.roll(y, -1, axis=0))
    above = above_plane(x, y, z, there, distance)
    over = above_lowest(x, y, above, there)
    low, middle, high = np.quantile(reflectance[there], (0.15, 0.5, 0.85))
    channels = (
        np.log(np.maximum(distance, 1) / 10),
        _logarithm(_bend(distance, there, 1) / far, 0.001, 1.5),
        _logarithm(_bend(distance, there, 4) / far, 0.003, 1.5),
        np.where(below, _logarithm(step, 0.02, 1.5), 0),
        np.where(below, 1.5 * np.arctan2(rise, run), 0),
        np.clip(above / 0.5, -2, 3),
        np.clip(over, 0, 4) - 0.5,
        np.clip(over / 0.1, 0, 4) - 1,
        _logarithm(_bend(z, there, 2), 0.01, 1),
        (reflectance - middle) / (high - low + 0.02),
    )
    return np.where(there, np.stack(channels), 0).astype(np.float32)


def _bend(values: np.ndarray, there: np.ndarray, step: int) -> np.ndarray:
    """(H, W) |second difference| along the ring, NaN where one of the three is missing."""
    before, after = np.roll(values, step, axis=1), np.roll(values, -step, axis=1)
    whole = there & np.roll(there, step, axis=1) & np.roll(there, -step, axis=1)
    return np.where(whole, np.abs(before + after - 2 * values), np.nan)


def _logarithm(values: np.ndarray, unit: float, middle: float) -> np.ndarray:
    """ln(values / unit + 1) - middle; 0 for NaN."""
    return np.where(np.isnan(values), 0, np.log(values / unit + 1) - middle)


def above_plane(x: np.ndarray, y: np.ndarray, z: np.ndarray, there: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """(H, W) metres above the plane of the ground within 25 m, by least squares that let go of what stands on it."""
    near = there & (distance < 25) & (np.abs(z + 1.75) < 0.9)
    if near.sum() < 500:
        return z + 1.75
    places, heights = np.stack([x[near], y[near], np.ones(near.sum())], 1), z[near]
    kept, limit, plane = np.abs(heights - np.quantile(heights, 0.3)) < 0.6, 0.5, np.zeros(3)
    for _ in range(4):
        plane = np.linalg.lstsq(places[kept][::7], heights[kept][::7], rcond=None)[0]
        rest = heights - places @ plane
        kept, limit = np.abs(rest - np.quantile(rest[kept], 0.4)) < limit, max(0.15, 0.6 * limit)
    return z - (plane[0] * x + plane[1] * y + plane[2])


def above_lowest(x: np.ndarray, y: np.ndarray, z: np.ndarray, there: np.ndarray) -> np.ndarray:
    """(H, W) metres above the lowest of the 25 cells around, a cell's height being its 10 % quantile; -1 to 6."""
    row, column = (np.clip((v / CELL + CELLS / 2).astype(int), 0, CELLS - 1) for v in (x, y))
    cell, height = (row * CELLS + column)[there], z[there]
    order = np.lexsort((height, cell))
    cell, height = cell[order], height[order]
    first = np.flatnonzero(np.r_[True, cell[1:] != cell[:-1]])
    count = np.diff(np.r_[first, len(cell)])
    lowest = np.full(CELLS * CELLS, 1e3, np.float32)
    lowest[cell[first]] = height[first + (0.1 * count).astype(int)]
    around = minimum_filter(lowest.reshape(CELLS, CELLS), size=5, mode="nearest")
    return np.clip(z - around[row, column], -1, 6)
