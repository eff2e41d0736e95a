"""The ground around a sensor: at which height it lies, how it is tilted, and where the road runs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np

from lidarsynth.lidar.cones import onto_z, robust_weight

SECTORS, RINGS = 24, 6  # cells around the sensor
NEAR, FAR = 3.0, 20.0  # metres of the cells
REACH, STEP = 4.0, 0.25  # heights that are tried, and their step
LEAN, LEANS = 8, 2  # degrees that the ground may lean, in which steps
POINTS = 8_000  # of a scan are enough
DIRECTIONS, STEPS = 36, 16  # cells of `lowest_plane`, whose lengths grow with their distance
# Metres from where to where the ground is looked for: roads, beyond the carrier's own roof; then in rooms, whose floor
# goes on beyond any roof in half of the directions, with hardly a point below it.
OUTSIDE, INSIDE, ROOF, UNDER = (NEAR, 25.0), (0.8, 8.0), 2.2, 0.01
TILT, TILTS = 16, 2  # degrees that a sensor may be tilted against the ground, in which steps
LOWEST, RISE = 0.2, 0.1  # metres of the sensor above the ground that are tried
OFF, FARTHER = 0.1, np.array([0.015, 0.01])  # metres off a plane that are on it, and per metre: to find it, to fit it
BELOW = 2.5  # times as far off below, nothing lies of what is the ground
ALL_AROUND, AHEAD = 0.4, 5  # of the directions, in which it must be seen; of a sensor that looks ahead only, so many
TILTED, NEARLY = range(-TILT, TILT + 1, TILTS), (-2, 0, 2)
# Of `stance`: points that are enough, cells on the ground in a direction, the share of the lowest points on the ground
# below which a sensor may be tilted (of level ones it is 0.46 and more, of tilted ones 0.14 and less, of those between
# between), how many times as many must be on another plane, and how much of a turn may have none on the ground.
SOME, DEEP, LEVEL, CLEARLY, LOST = 10_000, 3, 0.6, 1.15, 0.5
FLIP = np.array([1, -1, -1], np.float32)  # half a turn about x
# Times more level ground above than below, and of how many of the cells around: of Argoverse 2's second sensor, which
# hangs upside down and meets the road from 6 m on, it is 0.59.
# Of `share_below`: metres of points that count, of the lowest ray those that do, of points those below that ray, and
# degrees below the horizon beyond which beams meet the ground near enough to tell it.
BEYOND, LOW, STRAY, FLAT = 1.0, 0.75, 0.002, 8.0
UPSIDE, GROUND = 1.5, 0.45
LEANING = 3.5  # degrees of a tilt that is no slope of the road


@dataclass(frozen=True)
class Ground:
    """A level seen all around. `share` of the cells around the sensor have points at `height` metres."""

    share: float
    height: float


def levels(xyz: np.ndarray) -> tuple[Ground, Ground]:
    """The level below the origin and that above it (or none: share 0) which the most cells around have points of.

    Cells are 24 sectors by 6 rings of 3 to 20 m; heights within 4 m are tried in steps of 0.25 m.
    """
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    around = (rho > NEAR) & (rho < FAR) & (np.abs(xyz[:, 2]) < REACH)
    points, rho = xyz[around], rho[around]
    sector = (np.arctan2(points[:, 1], points[:, 0]) / np.pi + 1) * (SECTORS / 2)
    cell = sector.astype(int) % SECTORS * RINGS + ((rho - NEAR) / (FAR - NEAR) * RINGS).astype(int)
    count = round(2 * REACH / STEP)
    seen = np.zeros((SECTORS * RINGS, count), bool)
    seen[cell, ((points[:, 2] + REACH) / STEP).astype(int).clip(0, count - 1)] = True
    wide = seen.copy()  # roads slope: the steps above and below count too
    wide[:, 1:] |= seen[:, :-1]
    wide[:, :-1] |= seen[:, 1:]
    share = wide.mean(axis=0)
    heights = (np.arange(count) + 0.5) * STEP - REACH
    below, above = share * (heights < 0), share * (heights > STEP)
    return (Ground(float(below.max()), float(heights[below.argmax()])),
            Ground(float(above.max()), float(heights[above.argmax()])))  # fmt: skip


def plane(xyz: np.ndarray) -> tuple[float, float, float] | None:
    """(height, pitch, roll): metres of the sensor above the ground, and degrees of its nose and left side up.

    Fitted to the points near the level below, z = -height - tan(pitch) x - tan(roll) y. None where no level is seen
    in a third of the cells.
    """
    below, _ = levels(xyz)
    if below.share < 1 / 3:
        return None
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    x, y, z = xyz[(rho > NEAR) & (rho < FAR) & (np.abs(xyz[:, 2] - below.height) < 0.5)].astype(np.float64).T
    if len(x) < 100:
        return None
    return _told(_fitted(x, y, z))


def _fitted(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(3,) of the robust fit z = a + b x + c y."""
    known = np.stack([np.ones(len(x)), x, y], axis=1)
    share = np.hypot(x, y)  # near rings are dense: points count by the area they stand for
    weight, fitted = share, np.zeros(3)
    for _ in range(15):
        fitted = np.linalg.solve((known * weight[:, None]).T @ known, (known * weight[:, None]).T @ z)
        residual = z - known @ fitted
        weight = share * robust_weight(residual, max(1.4826 * float(np.median(np.abs(residual))), 0.005))
    return fitted


def _told(fitted: np.ndarray) -> tuple[float, float, float]:
    """Height, pitch and roll, as `plane` says them."""
    pitch, roll = -np.degrees(np.arctan(fitted[1:]))
    return float(-fitted[0]), float(pitch), float(roll)


def lowest_plane(xyz: np.ndarray) -> tuple[float, float, float] | None:
    """As `plane`, also of few beams, and of a sensor tilted by up to 16 degrees; ten times as slow.

    The fullest level may be what the beams just below the horizon meet all around. But nothing lies below the ground:
    it is the plane that the most of the cells' lowest points are on, less two for each that is below. None where it is
    not seen in two of five directions that have points, 50 degrees in all. Of eight streets seen 70 to 180 degrees
    wide, by five sensors each, the median is off by 0.06 m and 0.7 degrees at most.
    """
    if (points := _around(xyz)) is None:
        return None
    low, sector = _lowest(points)
    fitted, on = _on_most(low, product(TILTED, TILTED))
    if len(np.unique(sector[on])) < max(ALL_AROUND * len(np.unique(sector)), AHEAD):
        return None
    rho = np.hypot(points[:, 0], points[:, 1])
    for wide in (2, 1, 1, 1):
        near = np.abs(points[:, 2] - fitted[0] - points[:, :2] @ fitted[1:]) < wide * (OFF + FARTHER[1] * rho)
        if np.count_nonzero(near) < 100:
            return None
        fitted = _fitted(*points[near][:: max(1, np.count_nonzero(near) // POINTS)].T)
    return _told(fitted)


def stance(xyz: np.ndarray, told: tuple[float, float, float] | None = None) -> tuple[float, float, float] | None:
    """As `lowest_plane`, coarsely, in 2 ms, or 4 where the sensor is tilted by more than 3 degrees; None where points
    (N, 3) do not tell: less than three cells of a direction on the ground, or none in half a turn; a height at the end
    of those that are tried; not clearly more cells on the ground than on that of the stance `told`.

    Metres, and degrees of pitch and roll. Of 64 streets of sensors 0.5 to 3.2 m up and 19 real scans, whole, in every
    second, fourth and eighth beam, and in one point in ten and in a hundred, it says something of 440 of 498: heights
    are off by 0.03 m (median), and by more than a fifth once. Of 24 streets of sensors that are tilted by 7 to 15
    degrees, 90 of 96: tilts are off by 1 degree (median), at most 2. Where what is 3 m off tells nothing, as in rooms,
    what is nearer may: of 60 buildings in five ways 176 of 300 for 130, none of the 46 more off by a fifth.
    """
    some = xyz[:: max(1, -(-len(xyz) // SOME))]
    seen = _seen(some, OUTSIDE)
    if seen is None and ((seen := _seen(some, INSIDE)) is None or not _is_floor(some, seen)):
        return None
    found, low, on = seen
    return None if told is not None and on.sum() < CLEARLY * _on(low, *told).sum() else found


def share_below(xyz: np.ndarray, height: float, pitch: float, roll: float) -> float:
    """0 to 1: how many of what the lowest beams met lies below the ground that `lowest_plane` tells, as where they meet
    the true one farther off than it looks; 0 where the lowest look down by more than FLAT. Of 36 real scans, whatever
    their beams, 0.007 at most; of 18 streets of beams that end 2 to 5 degrees below the horizon, 1.5 m and more above
    the road, 0.027 and more."""
    rho, above = np.hypot(xyz[:, 0], xyz[:, 1]), _above(xyz, height, pitch, roll)
    down = np.arctan2(above - height, rho)
    far = rho > BEYOND
    lowest = float(np.quantile(down[far], STRAY)) if far.any() else 0.0
    low = far & (down < LOW * lowest)
    if not -np.radians(FLAT) < lowest < 0 or not low.any():
        return 0.0
    return float((above[low] < -(2 * OFF + 2 * FARTHER[0] * rho[low])).mean())


def is_above(xyz: np.ndarray) -> bool:
    """Whether the ground of points (N, 3) is seen only where they are turned over, as of a sensor that hangs upside
    down, and is wide, as ceilings seldom are. Of 65 real scans, 107 of made streets and 240 of insides of buildings
    none is, and so are 57, 98 and 22 turned over; of 240 insides whose floor was cut away 18 are."""
    over = xyz * FLIP
    found = stance(over)
    if found is None or stance(xyz) is not None:
        return False
    height = _above(over, *found) - found[0]
    below, above = levels(np.concatenate([over[:, :2], height[:, None]], 1))
    return below.share > GROUND and below.share > UPSIDE * above.share


def _seen(
    xyz: np.ndarray, reach: tuple[float, float]
) -> tuple[tuple[float, float, float], np.ndarray, np.ndarray] | None:
    """What `stance` says by points that are so far, the lowest of their cells, and which of these are on the ground."""
    if (points := _around(xyz, reach)) is None:
        return None
    low, sector = _lowest(points, reach)
    fitted, on = _on_most(low, product(NEARLY, NEARLY))
    if on.mean() < LEVEL and (other := _tilted(low))[1].sum() > CLEARLY * on.sum():
        fitted, on = other
    seen = np.unique(sector[on])
    if len(seen) < ALL_AROUND * DIRECTIONS or np.count_nonzero(on) < DEEP * len(seen):
        return None
    found = _told(np.append(np.median(low[on, 2] - low[on, :2] @ fitted[1:]), fitted[1:]))
    lost = np.diff(seen, append=seen[0] + DIRECTIONS).max() > LOST * DIRECTIONS
    if lost or not LOWEST + RISE / 2 < found[0] < REACH - 2 * RISE:
        return None
    return found, low, on


def _is_floor(xyz: np.ndarray, seen: tuple[tuple[float, float, float], np.ndarray, np.ndarray]) -> bool:
    """Whether what was seen inside is no roof of a carrier: it goes on, and nothing lies below it."""
    stands, low, on = seen
    points = _around(xyz, (INSIDE[0], OUTSIDE[1]))
    assert points is not None  # there were enough inside
    under = _above(points, *stands) < -BELOW * _near(points)
    farthest = np.zeros(DIRECTIONS)
    np.maximum.at(farthest, _sector(low[on]), np.hypot(low[on, 0], low[on, 1]))
    return bool(under.mean() <= UNDER and np.median(farthest[farthest > 0]) >= ROOF)


def _around(xyz: np.ndarray, reach: tuple[float, float] = OUTSIDE) -> np.ndarray | None:
    """(N, 3) float64: the points among which the ground is looked for; None where they are too few."""
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    points = xyz[(rho > reach[0]) & (rho < reach[1])].astype(np.float64)
    return None if len(points) < 100 else points


def _on(low: np.ndarray, height: float, pitch: float, roll: float) -> np.ndarray:
    """(N,) bool: which of the lowest points are on the ground of a sensor that stands so."""
    return np.abs(_above(low, height, pitch, roll)) < _near(low)


def _above(points: np.ndarray, height: float, pitch: float, roll: float) -> np.ndarray:
    """(N,) metres of points (N, 3) above the ground of a sensor that stands so."""
    return points[:, 2] + points[:, :2] @ np.tan(np.radians([pitch, roll])) + height


def _near(low: np.ndarray) -> np.ndarray:
    """(N,) how far lowest points may be off the ground to be on it."""
    return OFF + FARTHER[0] * np.hypot(low[:, 0], low[:, 1])


def _tilted(low: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`_on_most` of planes that are tilted by more than `NEARLY`: first every fourth degree, then around the best."""
    steps = range(-TILT, TILT + 1, 2 * TILTS)
    fitted, _ = _on_most(low, ((a, b) for a, b in product(steps, steps) if max(abs(a), abs(b)) > TILTS))
    pitch, roll = -np.degrees(np.arctan(fitted[1:])).round()
    return _on_most(low, product((pitch - TILTS, pitch, pitch + TILTS), (roll - TILTS, roll, roll + TILTS)))


def _lowest(points: np.ndarray, reach: tuple[float, float] = OUTSIDE) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) the lowest point of each cell that has any, and (N,) the direction of each."""
    rho = np.hypot(points[:, 0], points[:, 1])
    sector = _sector(points)
    near, far = reach
    cell = sector * STEPS + (np.log(rho / near) / np.log(far / near) * STEPS).astype(int).clip(0, STEPS - 1)
    order = np.lexsort((points[:, 2], cell))
    first = order[np.flatnonzero(np.diff(cell[order], prepend=-1))]
    return points[first], sector[first]


def _sector(points: np.ndarray) -> np.ndarray:
    """(N,) the direction of each of the points (N, 3), of DIRECTIONS."""
    return ((np.arctan2(points[:, 1], points[:, 0]) / np.pi + 1) * (DIRECTIONS / 2)).astype(int) % DIRECTIONS


def _on_most(low: np.ndarray, tilts: Iterable[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """(3,) of the plane z = a + b x + c y that lowest points (N, 3) speak for the most, and (N,) bool: which are on
    it; the least tilted of equals. `tilts` are those that are tried, degrees of pitch and roll."""
    x, y, z = low.T.astype(np.float32)
    near = _near(low).astype(np.float32)
    heights = np.arange(LOWEST, REACH, RISE, dtype=np.float32)[:, None]
    best, found = -np.inf, (np.zeros(3), np.zeros(len(low), bool))
    for a, b in sorted(tilts, key=lambda ab: ab[0] ** 2 + ab[1] ** 2):
        if a**2 + b**2 > TILT**2:
            break
        slope = np.tan(np.radians([a, b]))
        off = (z + np.float32(slope[0]) * x + np.float32(slope[1]) * y) + heights
        score = np.count_nonzero(np.abs(off) < near, axis=1) - 2 * np.count_nonzero(off < -BELOW * near, axis=1)
        height = int(score.argmax())
        if score[height] > best:
            best = score[height]
            found = np.array([-heights[height, 0], *-slope]), np.abs(off[height]) < near
    return found


def normal(xyz: np.ndarray, seed: int = 0) -> np.ndarray:
    """(3,) unit normal of the ground, which may lean by 8 degrees along x and along y; z where no level is seen."""
    few = xyz[np.random.default_rng(seed).permutation(len(xyz))[:POINTS]]
    side = range(-LEAN, LEAN + 1, LEANS)
    axes = [leaning(a, b) for a, b in sorted(product(side, side), key=lambda ab: ab[0] ** 2 + ab[1] ** 2)]
    shares = [levels(few @ onto_z(axis).T.astype(np.float32))[0].share for axis in axes]
    level = onto_z(axes[int(np.argmax(shares))])
    if (found := plane((xyz @ level.T).astype(np.float32))) is None:
        return np.array([0.0, 0.0, 1.0])
    return leaning(*found[1:]) @ level


def leaning(x: float, y: float) -> np.ndarray:
    """(3,) the unit vector that leans from z by degrees along x and along y."""
    axis = np.append(np.tan(np.radians([x, y])), 1.0)
    return axis / np.linalg.norm(axis)


def road_axis(xyz: np.ndarray) -> float:
    """-1 to 1: how much farther the ground is seen along x (road ahead) than along y; about 0 where neither is.

    The mean of cos(2 azimuth) over 72 sectors, each by the farthest ground point in it, up to 50 m; 0 where fewer than
    a third of them have any. Of a sensor that looks to a side, less what the sectors with any point have alike.
    """
    below, _ = levels(xyz)
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    ground = (np.abs(xyz[:, 2] - below.height) < 0.35 + 0.02 * rho) & (rho > 5)
    sector = ((np.arctan2(xyz[:, 1], xyz[:, 0]) / np.pi + 1) * 36).astype(int) % 72
    far, seen = np.zeros(72), np.bincount(sector, minlength=72) > 0
    np.maximum.at(far, sector[ground], np.minimum(rho[ground], 50))
    if np.count_nonzero(far) < 24:
        return 0.0
    ahead = np.cos(2 * ((np.arange(72) + 0.5) / 36 * np.pi - np.pi))
    return float((far * ahead).sum() / far.sum() - min(ahead[seen].mean(), 0))
