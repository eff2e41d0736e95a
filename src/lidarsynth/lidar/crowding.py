"""From which height points without rings lie on beams: seen from the sensor's origin, their elevations crowd."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.recognition import FAR, elevations_of

REACH, STEP = 3.0, 0.05  # metres above and below the origin, in which steps
BIN, AROUND = 0.05, 41  # degrees; bins around each that say how many points there were without beams
BEAMS = 8  # at least, in different places: one wall or level is none
VIEW = (-35.0, 25.0)  # degrees that spinning sensors look
POINTS = 8_000  # of a scan are enough
NEAR = 0.45  # metres: beams of an HDL-64E leave 0.2 m above its origin
LEVEL = 0.3  # metres
CROWDED, CLEARLY = 1.6, 1.3  # the contrast of beams, and how many times that of the origin. Real scans: 1.7 and more,
# but 1.4 of two motion-compensated ones, whose height stays untested; raised, they have a height 1.4 to 16 times better


def height_of_beams(xyz: np.ndarray, seed: int = 0) -> float | None:
    """Metres of the sensor above the origin of points (N, 3): 0.0 where they crowd there; None where they nowhere do.

    The contrast of elevations is the sum of squares of their histogram by that of the same histogram smoothed.
    """
    far = np.flatnonzero(np.hypot(xyz[:, 0], xyz[:, 1]) > FAR)
    points = xyz[np.random.default_rng(seed).permutation(far)[:POINTS]].astype(np.float64)
    heights = np.arange(-REACH, REACH + STEP / 2, STEP)
    contrast = np.array([_contrast(points - [0, 0, height]) for height in heights])
    here, best = contrast[np.abs(heights) < NEAR].max(), int(contrast.argmax())
    if contrast[best] < CROWDED:
        return None
    return 0.0 if contrast[best] < CLEARLY * here else float(heights[best])


def _contrast(points: np.ndarray) -> float:
    above = points[np.abs(points[:, 2]) > LEVEL]  # seen from its own level, flat ground crowds too
    count = np.histogram(elevations_of(above), np.arange(VIEW[0], VIEW[1] + BIN / 2, BIN))[0].astype(np.float64)
    if count.sum() < max(len(points) / 3, 1):
        return 0.0
    smooth = np.convolve(count, np.full(AROUND, 1 / AROUND), "same")
    crowded = (count > 1.5 * smooth) & (count >= 10)
    if np.count_nonzero(crowded[1:] & ~crowded[:-1]) < BEAMS:
        return 0.0
    return float((count @ count) / (smooth @ smooth))
