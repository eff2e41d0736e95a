"""From where points without rings lie on beams: seen from the sensor's origin, about its axis, elevations crowd."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from lidarsynth.lidar.cones import onto_z
from lidarsynth.lidar.ground import leaning, lowest_plane, normal, plane

FAR = 12.0  # metres, or half the points where fewer are as far: nearer ones show the carrier's motion in a turn most
POINTS, FEW = 8_000, 3_000  # of a scan are enough; to look for a tilt
REACH, STEP = 3.0, 0.05  # metres above and below the origin, in which steps
BIN, AROUND = 0.05, 41  # degrees; bins around each that say how many points there were without beams
AT_ONCE = 32  # axes: their elevations stay in a processor's cache
BEAMS = 8  # at least, in different places: one wall or level is none
VIEW = (-35.0, 25.0)  # degrees that spinning sensors look
NEAR = 0.45  # metres: beams of an HDL-64E leave 0.2 m above its origin
ORIGINS = (0.0, 0.2)  # metres above the origin that a tilt is looked for from
LEVEL = 0.3  # metres
LOW, HIGH, LIFTS = 0.8, 3.5, (0.1, 0.05, 0.025)  # metres above the road from which both are looked for, and steps
OFF, SWAY = 0.4, 1.6  # metres from the road that are off it; degrees of the axis from the road's normal, for both
TIP, TIPS = 4.0, (0.2, 0.1, 0.05)  # degrees that the road may lie off the sensor's axis, and steps of looking for it
# The contrast of beams, and how many times that of the frame itself. Of train scans and streets of seven sensors, at
# rest or with a carrier's 10 m/s taken out, it is 1.75 and more from where the sensor stood; of their points moved off
# the beams at most 1.42, and of a bare plane 1.71.
CROWDED, CLEARLY = 1.8, 1.3


def stand_of_beams(xyz: np.ndarray, seed: int = 0) -> tuple[np.ndarray, float] | None:
    """The sensor's axis (3,), a unit vector, and its height in metres, in the frame of points (N, 3): z and 0.0 where
    they crowd in the frame itself. None where the points crowd nowhere.

    The contrast of elevations is the sum of squares of their histogram by that of the same histogram smoothed. It is
    sought along z at heights within 3 m; then `off_the_road`; and where no road is seen, or nothing off it crowds, at
    the origin about axes within 4 degrees of the ground's normal.
    """
    points = _far(xyz)
    points = points[np.random.default_rng(seed).permutation(len(points))[:POINTS]].astype(np.float32)
    heights, up = np.arange(-REACH, REACH + STEP / 2, STEP), np.array([0.0, 0.0, 1.0])
    contrast = _contrasts(points, np.tile(up, (len(heights), 1)), heights)
    here, best = contrast[np.abs(heights) < NEAR].max(), int(contrast.argmax())
    if here >= CROWDED and contrast[best] < CLEARLY * here:
        return up, 0.0
    road = normal(xyz)
    if (both := off_the_road(xyz, road, seed)) and both.contrast >= max(CROWDED, CLEARLY * both.here):
        return both.axis, both.height
    axis, crowding = _leaning(points, road)
    if max(crowding, contrast[best]) < max(CROWDED, CLEARLY * here):
        return None
    if crowding > contrast[best]:
        return axis, 0.0
    under = (found := lowest_plane(xyz)) is not None and heights[best] < LOW - found[0]
    return None if under else (up, float(heights[best]))  # flat ground crowds, seen from near its level


@dataclass(frozen=True)
class Stand:
    """Where points off the road crowd most: about which axis, from how many metres along it, and their contrast.

    here  that of the frame itself
    """

    axis: np.ndarray
    height: float
    contrast: float
    here: float


def off_the_road(xyz: np.ndarray, road: np.ndarray, seed: int = 0) -> Stand | None:
    """Height and tilt at once, by what stands beside the road: rings on it would crowd from any height above it.

    road  the ground's normal; None where no plane of it is seen, or fewer than POINTS / 8 far points stand off it
    """
    level = (xyz @ onto_z(road).T).astype(np.float32)
    if (found := plane(level)) is None:
        return None
    points = _far(xyz[np.abs(level[:, 2] + found[0]) > OFF])
    if len(points) < POINTS / 8:
        return None
    points = points[np.random.default_rng(seed).permutation(len(points))[:POINTS]].astype(np.float32)
    slopes, side = np.degrees(np.arctan(road[:2] / road[2])), np.arange(-SWAY, SWAY + TIPS[0] / 2, TIPS[0])
    lifts = np.arange(LOW - found[0], HIGH - found[0], LIFTS[0])
    tips = [(lift, slopes[0] + a, slopes[1] + b) for lift, a, b in product(lifts, side, side)]
    contrast, (lift, x, y) = _most_crowded(points[:FEW], tips)
    for step, rise in zip(TIPS[1:], LIFTS[1:], strict=True):
        around = product(range(-2, 3), repeat=3)
        tips = [(lift + k * rise, x + i * step, y + j * step) for k, i, j in around]
        contrast, (lift, x, y) = _most_crowded(points, tips)
    here = _contrasts(points, np.tile([0.0, 0.0, 1.0], (len(ORIGINS), 1)), np.array(ORIGINS)).max()
    return Stand(leaning(x, y), float(lift), contrast, float(here))


def _far(xyz: np.ndarray) -> np.ndarray:
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    return xyz[rho > min(FAR, float(np.median(rho)))] if len(xyz) else xyz


def _leaning(points: np.ndarray, road: np.ndarray) -> tuple[np.ndarray, float]:
    """The axis about which far points crowd most, near the ground's normal `road`, and their contrast about it."""
    slopes = np.degrees(np.arctan(road[:2] / road[2]))
    side = np.arange(-TIP, TIP + TIPS[0] / 2, TIPS[0])
    tips = [(lift, slopes[0] + a, slopes[1] + b) for lift, a, b in product(ORIGINS, side, side)]
    _, (lift, x, y) = _most_crowded(points[:FEW], tips)
    crowding = 0.0
    for step in TIPS[1:]:
        tips = [(lift, x + i * step, y + j * step) for i, j in product(range(-2, 3), repeat=2)]
        crowding, (_, x, y) = _most_crowded(points, tips)
    return leaning(x, y), crowding


def _most_crowded(points: np.ndarray, tips: Sequence[tuple[float, float, float]]) -> tuple[float, tuple[float, ...]]:
    """The greatest contrast about axes that lean by x and y degrees, from `lift` metres along them, and its tip."""
    contrast = _contrasts(points, np.array([leaning(x, y) for _, x, y in tips]), np.array([tip[0] for tip in tips]))
    best = int(contrast.argmax())
    return float(contrast[best]), tips[best]


def _contrasts(points: np.ndarray, axes: np.ndarray, lifts: np.ndarray) -> np.ndarray:
    """(A,) contrasts of points (N, 3) about axes (A, 3) through the origin, from `lifts` (A,) metres along them."""
    square = np.einsum("ni,ni->n", points, points)
    return np.concatenate([_of_counts(_counts(points, square, axes[i : i + AT_ONCE], lifts[i : i + AT_ONCE]))
                           for i in range(0, len(axes), AT_ONCE)])  # fmt: skip


def _counts(points: np.ndarray, square: np.ndarray, axes: np.ndarray, lifts: np.ndarray) -> np.ndarray:
    """(A, bins) how many points have the elevations about each axis, and last, how many have none that counts.

    |p - l a|^2 = |p|^2 - 2 l p.a + l^2, and the sine of the elevation is (p.a - l) by its root. `square` (N,) is |p|^2.
    """
    lift = lifts.astype(np.float32)[:, None]
    level = axes.astype(np.float32) @ points.T  # (A, N)
    sine = (level - lift) / np.sqrt(np.maximum(square - lift * (2 * level - lift), 1e-6))
    bins = round((VIEW[1] - VIEW[0]) / BIN)
    at = np.arcsin(np.clip(sine, -1, 1)) * np.float32(np.degrees(1) / BIN) - np.float32(VIEW[0] / BIN)
    # Seen from its own level, flat ground crowds too.
    at = np.where((np.abs(level - lift) > LEVEL) & (at >= 0) & (at < bins), at, bins).astype(np.intp)
    at += np.arange(len(axes))[:, None] * (bins + 1)
    return np.bincount(at.ravel(), minlength=len(axes) * (bins + 1)).reshape(len(axes), bins + 1)


def _of_counts(counts: np.ndarray) -> np.ndarray:
    """(A,) contrasts of histograms (A, bins and what is in none)."""
    count = counts[:, :-1].astype(np.float64)
    total = np.pad(count, ((0, 0), (AROUND // 2 + 1, AROUND // 2))).cumsum(axis=1)
    smooth = (total[:, AROUND:] - total[:, :-AROUND]) / AROUND
    crowded = (count > 1.5 * smooth) & (count >= 10)
    beams = np.count_nonzero(crowded[:, 1:] & ~crowded[:, :-1], axis=1)
    contrast = (count**2).sum(axis=1) / np.maximum((smooth**2).sum(axis=1), 1e-9)
    enough = count.sum(axis=1) >= np.maximum(counts.sum(axis=1) / 3, 1)
    return np.where(enough & (beams >= BEAMS), contrast, 0.0)
