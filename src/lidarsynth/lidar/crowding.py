"""From where points without rings lie on beams: seen from the sensor's origin, about its axis, elevations crowd."""

from __future__ import annotations

from itertools import product

import numpy as np

from lidarsynth.lidar.cones import onto_z
from lidarsynth.lidar.ground import leaning, normal
from lidarsynth.lidar.recognition import elevations_of

FAR = 12.0  # metres, or half the points where fewer are as far: nearer ones show the carrier's motion in a turn most
POINTS, FEW = 8_000, 3_000  # of a scan are enough; to look for a tilt
REACH, STEP = 3.0, 0.05  # metres above and below the origin, in which steps
BIN, AROUND = 0.05, 41  # degrees; bins around each that say how many points there were without beams
BEAMS = 8  # at least, in different places: one wall or level is none
VIEW = (-35.0, 25.0)  # degrees that spinning sensors look
NEAR = 0.45  # metres: beams of an HDL-64E leave 0.2 m above its origin
ORIGINS = (0.0, 0.2)  # metres above the origin that a tilt is looked for from
LEVEL = 0.3  # metres
TIP, TIPS = 4.0, (0.2, 0.1, 0.05)  # degrees that the road may lie off the sensor's axis, and steps of looking for it
# The contrast of beams, and how many times that of the frame itself. Of train scans and streets of seven sensors, at
# rest or with a carrier's 10 m/s taken out, it is 1.75 and more from where the sensor stood; of their points moved off
# the beams at most 1.42, and of a bare plane 1.71.
CROWDED, CLEARLY = 1.8, 1.3


def stand_of_beams(xyz: np.ndarray, seed: int = 0) -> tuple[np.ndarray, float] | None:
    """The sensor's axis (3,), a unit vector, and its height in metres, in the frame of points (N, 3): z and 0.0 where
    they crowd in the frame itself. None where the points crowd nowhere.

    The contrast of elevations is the sum of squares of their histogram by that of the same histogram smoothed. It is
    sought along z at heights within 3 m, and at the origin about axes within 4 degrees of the ground's normal.
    """
    points = _far(xyz)
    points = points[np.random.default_rng(seed).permutation(len(points))[:POINTS]].astype(np.float64)
    heights, up = np.arange(-REACH, REACH + STEP / 2, STEP), np.array([0.0, 0.0, 1.0])
    contrast = np.array([_contrast(points - [0, 0, height]) for height in heights])
    here, best = contrast[np.abs(heights) < NEAR].max(), int(contrast.argmax())
    if here >= CROWDED and contrast[best] < CLEARLY * here:
        return up, 0.0
    axis, crowding = _leaning(points, normal(xyz))
    if max(crowding, contrast[best]) < max(CROWDED, CLEARLY * here):
        return None
    return (axis, 0.0) if crowding > contrast[best] else (up, float(heights[best]))


def _far(xyz: np.ndarray) -> np.ndarray:
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    return xyz[rho > min(FAR, float(np.median(rho)))] if len(xyz) else xyz


def _leaning(points: np.ndarray, road: np.ndarray) -> tuple[np.ndarray, float]:
    """The axis about which far points crowd most, near the ground's normal `road`, and their contrast about it."""
    slopes = np.degrees(np.arctan(road[:2] / road[2]))
    side = np.arange(-TIP, TIP + TIPS[0] / 2, TIPS[0])
    few = [(_about(points[:FEW], slopes[0] + a, slopes[1] + b, lift), lift, slopes[0] + a, slopes[1] + b)
           for lift, a, b in product(ORIGINS, side, side)]  # fmt: skip
    crowding, lift, x, y = max(few)
    for step in TIPS[1:]:
        around = [(x + i * step, y + j * step) for i, j in product(range(-2, 3), repeat=2)]
        crowding, x, y = max((_about(points, a, b, lift), a, b) for a, b in around)
    return leaning(x, y), crowding


def _about(points: np.ndarray, x: float, y: float, lift: float) -> float:
    return _contrast(points @ onto_z(leaning(x, y)).T - [0, 0, lift])


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
