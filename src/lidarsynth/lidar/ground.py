"""The ground around a sensor: at which height it lies, how it is tilted, and where the road runs."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from lidarsynth.lidar.cones import onto_z, robust_weight

SECTORS, RINGS = 24, 6  # cells around the sensor
NEAR, FAR = 3.0, 20.0  # metres of the cells
REACH, STEP = 4.0, 0.25  # heights that are tried, and their step
LEAN, LEANS = 8, 2  # degrees that the ground may lean, in which steps
POINTS = 8_000  # of a scan are enough


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
    known = np.stack([np.ones(len(x)), x, y], axis=1)
    share = np.hypot(x, y)  # near rings are dense: points count by the area they stand for
    weight, fitted = share, np.zeros(3)
    for _ in range(15):
        fitted = np.linalg.solve((known * weight[:, None]).T @ known, (known * weight[:, None]).T @ z)
        residual = z - known @ fitted
        weight = share * robust_weight(residual, max(1.4826 * float(np.median(np.abs(residual))), 0.005))
    pitch, roll = -np.degrees(np.arctan(fitted[1:]))
    return float(-fitted[0]), float(pitch), float(roll)


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
    a third of them have any.
    """
    below, _ = levels(xyz)
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    ground = (np.abs(xyz[:, 2] - below.height) < 0.35 + 0.02 * rho) & (rho > 5)
    sector = ((np.arctan2(xyz[ground, 1], xyz[ground, 0]) / np.pi + 1) * 36).astype(int) % 72
    far = np.zeros(72)
    np.maximum.at(far, sector, np.minimum(rho[ground], 50))
    angle = (np.arange(72) + 0.5) / 36 * np.pi - np.pi
    return float((far * np.cos(2 * angle)).sum() / far.sum()) if np.count_nonzero(far) >= 24 else 0.0
