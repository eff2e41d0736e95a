"""What a pixel's neighbours say of its surface, whatever the sensor's height, tilt and response."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.ground import plane
from lidarsynth.lidar.scan import RangeImage

CHANNELS = 10
COLUMNS = 1024  # of a turn whose neighbours are one column away
CELL, CELLS, AROUND = 1.5, 81, 5  # metres, and how many of them each way, of the map of the lowest ground; its window
POINTS = 5_000  # that the plane of the ground is fitted to
HIGH = 100  # metres above and below the road that are told apart


def surroundings(image: RangeImage) -> np.ndarray:
    """(10, H, W) float32 of an image, of about unit size, 0 where nothing returned.

    ln of the range; how bent the ring is within 1 and 4 columns of 1024; the step to the beam below, and its slope;
    height above the plane of the near ground; above the lowest ground around, coarse and fine; how bent the ring's
    height is; reflectance between the scan's own quantiles. A small network learns these only slowly from metres: a
    kerb is 5 cm high, where ranges differ by tens of metres.
    """
    there, distance = image.mask, image.range
    if not there.any():
        return np.zeros((CHANNELS, *image.shape), np.float32)
    xyz = image.points()
    x, y, z = np.moveaxis(xyz, -1, 0)
    far, one = np.maximum(distance, 0.5), max(1, round(image.sensor.width / COLUMNS))
    below = there & np.concatenate([there[1:], np.zeros_like(there[:1])])
    step, rise, forth, aside = (v - np.roll(v, -1, axis=0) for v in (distance, z, x, y))
    above = _above_plane(image, xyz)
    over = _above_lowest(x, y, above, there)
    low, middle, high = np.quantile(image.reflectance[there], (0.15, 0.5, 0.85))
    channels = (
        np.log(np.maximum(distance, 1) / 10),
        _logarithm(_bend(distance, there, one) / far, 0.001, 1.5),
        _logarithm(_bend(distance, there, 4 * one) / far, 0.003, 1.5),
        np.where(below, _logarithm(np.abs(step) / far, 0.02, 1.5), 0),
        np.where(below, 1.5 * np.arctan2(rise, np.hypot(forth, aside)), 0),
        np.clip(above / 0.5, -2, 3),
        np.clip(over, 0, 4) - 0.5,
        np.clip(over / 0.1, 0, 4) - 1,
        _logarithm(_bend(z, there, 2 * one), 0.01, 1),
        np.clip((image.reflectance - middle) / (high - low + 0.02), -4, 4),
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


def _above_plane(image: RangeImage, xyz: np.ndarray) -> np.ndarray:
    """(H, W) metres above the plane of the near ground, or, where none is seen, above the road under the sensor."""
    seen = np.flatnonzero(image.mask)
    found = plane(xyz.reshape(-1, 3)[seen[:: max(1, len(seen) // POINTS)]])
    height, pitch, roll = (image.sensor.mount, *image.sensor.tilt) if found is None else found
    forth, aside = np.tan(np.radians([pitch, roll])).tolist()
    return xyz[..., 2] + height + forth * xyz[..., 0] + aside * xyz[..., 1]


def _above_lowest(x: np.ndarray, y: np.ndarray, z: np.ndarray, there: np.ndarray) -> np.ndarray:
    """(H, W) metres above the lowest of the 25 cells around, a cell's height being its 10 % quantile; -1 to 6."""
    row, column = (np.clip((v * (1 / CELL) + CELLS / 2).astype(np.int32), 0, CELLS - 1) for v in (x, y))
    cell = row * CELLS + column
    millimetres = np.clip(1000 * (z[there] + HIGH), 0, 2000 * HIGH - 1).astype(np.int64)
    key = np.sort(cell[there] * np.int64(2000 * HIGH) + millimetres)  # by cell, then by height
    of, height = np.divmod(key, 2000 * HIGH)
    first = np.flatnonzero(np.r_[True, of[1:] != of[:-1]])
    count = np.diff(np.r_[first, len(of)])
    lowest = np.full(CELLS * CELLS, 1e3, np.float32)
    lowest[of[first]] = height[first + (0.1 * count).astype(int)] / 1000 - HIGH
    wide = np.pad(lowest.reshape(CELLS, CELLS), AROUND // 2, constant_values=1e3)
    wide = np.lib.stride_tricks.sliding_window_view(wide, AROUND, 0).min(-1)
    around = np.lib.stride_tricks.sliding_window_view(wide, AROUND, 1).min(-1)
    return np.clip(z - around.ravel()[cell], -1, 6)
