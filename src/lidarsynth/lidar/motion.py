"""Points that were moved to one instant of a turn: where the sensor was meanwhile, told by its rings alone."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.cones import robust_weight

NEAR = 3.0  # metres
SEAMS = 8  # directions in which a turn may begin, where no times say it
POINTS, COARSE = 8000, 3000
BETTER = 0.5  # of the residual; less gain is no motion


def straighten(xyz: np.ndarray, ring: np.ndarray, time: np.ndarray | None = None, seed: int = 0) -> np.ndarray:
    """(N, 3) the points as the sensor saw them, each from the origin, where a motion makes the rings cones; else as
    they are.

    The sensor's origin at the fraction tau of the turn is p + tau u; p and u are fitted to the rings (N,), six numbers
    linear in z / rho = t_ring - (p + tau u) . grad. tau comes from `time` (N,), or from the azimuth with the seam that
    fits best.
    """
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]) / (2 * np.pi)
    far = np.flatnonzero(np.hypot(xyz[:, 0], xyz[:, 1]) > NEAR)
    chosen = np.random.default_rng(seed).permutation(far)
    _, ring = np.unique(ring, return_inverse=True)
    few, many = chosen[:COARSE], chosen[:POINTS]
    if len(many) < 500:
        return xyz
    turns = [np.mod(azimuth + k / SEAMS, 1) - 0.5 for k in range(SEAMS)]
    if time is not None and np.ptp(time) > 0:
        turns.append((time - time.min()) / np.ptp(time) - 0.5)
    best = min(turns, key=lambda turn: _fit(xyz[few], ring[few], turn[few])[1])
    path, after = _fit(xyz[many], ring[many], best[many])
    _, before = _fit(xyz[many], ring[many], best[many], rounds=0)
    if after > BETTER * before:
        return xyz
    return (xyz - path[0] - best[:, None] * path[1]).astype(np.float32)


def _fit(xyz: np.ndarray, ring: np.ndarray, turn: np.ndarray, rounds: int = 3) -> tuple[np.ndarray, float]:
    """((2, 3) p and u in metres, robust residual of z / rho): Gauss-Newton steps of robust least squares."""
    path, scale = np.zeros((2, 3)), 1.0
    for i in range(max(rounds, 1)):
        x, y, z = (xyz.astype(np.float64) - path[0] - turn[:, None] * path[1]).T
        rho = np.hypot(x, y)
        value = z / rho
        slope = np.stack([-value * x / rho**2, -value * y / rho**2, 1 / rho], axis=1)
        step, scale = _within_rings(np.concatenate([slope, slope * turn[:, None]], axis=1), value, ring, rounds == 0)
        path = path + (step.reshape(2, 3) if i < rounds else 0)
    return path, scale


def _within_rings(known: np.ndarray, value: np.ndarray, ring: np.ndarray, only_rings: bool) -> tuple[np.ndarray, float]:
    """(6,) coefficients, and the deviation of what they and the rings' own means leave."""
    weight, found, scale = np.ones(len(value)), np.zeros(6), 1.0
    for _ in range(8):
        total = np.maximum(np.bincount(ring, weight), 1e-9)
        left = known - (np.stack([np.bincount(ring, weight * k) for k in known.T], axis=1) / total[:, None])[ring]
        right = value - (np.bincount(ring, weight * value) / total)[ring]
        if not only_rings:
            normal = (left * weight[:, None]).T @ left + 1e-6 * np.eye(6)
            found = np.linalg.solve(normal, (left * weight[:, None]).T @ right)
        residual = right - left @ found
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-6)
        weight = robust_weight(residual, scale)
    return found, scale
