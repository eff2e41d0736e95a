"""Points that were moved to one instant of a turn: where the sensor was meanwhile, told by its rings alone."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.cones import robust_weight

NEAR = 3.0  # metres
SEAMS = 8  # directions in which a turn may begin, where no times say it
POINTS, COARSE = 8000, 3000
BENT = 0.05  # degrees off the cones; rings that fit better were not moved
BETTER = 0.5  # of the residual; less gain is no motion


def straighten(xyz: np.ndarray, ring: np.ndarray, time: np.ndarray | None = None, seed: int = 0) -> np.ndarray:
    """(N, 3) float32 points as the sensor saw them, where a motion makes bent rings cones; else as they are.

    The sensor's origin at the fraction tau of the turn is p + tau u; p and u are fitted to the rings (N,), six numbers
    linear in z / rho = t_ring - (p + tau u) . grad. tau comes from `time` (N,), or from the azimuth with the seam that
    fits best. A constant height is left in the points: it belongs to the beams.
    """
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]) / (2 * np.pi)
    far = np.flatnonzero(np.hypot(xyz[:, 0], xyz[:, 1]) > NEAR)
    chosen = np.random.default_rng(seed).permutation(far)
    _, ring = np.unique(ring, return_inverse=True)
    few, many = chosen[:COARSE], chosen[:POINTS]
    if len(many) < 500:
        return xyz
    taus = [np.mod(azimuth + k / SEAMS, 1) - 0.5 for k in range(SEAMS)]
    if time is not None and np.ptp(time) > 0:
        taus.append((time - time.min()) / np.ptp(time) - 0.5)
    before = _at_rest(xyz[many], ring[many])
    if np.degrees(before) < BENT:
        return xyz
    best = min(taus, key=lambda tau: _fit(xyz[few], ring[few], tau[few])[1])
    path, after = _fit(xyz[many], ring[many], best[many])
    if after > BETTER * before:
        return xyz
    return (xyz - path[0] * [1, 1, 0] - best[:, None] * path[1]).astype(np.float32)


def _at_rest(xyz: np.ndarray, ring: np.ndarray) -> float:
    """Robust residual of z / rho about cones of one height above the origin."""
    rho = np.hypot(xyz[:, 0], xyz[:, 1]).astype(np.float64)
    return _within_rings(1 / rho[:, None], xyz[:, 2] / rho, ring)[1]


def _fit(xyz: np.ndarray, ring: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, float]:
    """((2, 3) p and u in metres, robust residual of z / rho): five Gauss-Newton steps of robust least squares."""
    path, scale = np.zeros((2, 3)), 1.0
    for _ in range(5):
        x, y, z = (xyz.astype(np.float64) - path[0] - tau[:, None] * path[1]).T
        rho = np.hypot(x, y)
        value = z / rho
        slope = np.stack([-value * x / rho**2, -value * y / rho**2, 1 / rho], axis=1)
        step, scale = _within_rings(np.concatenate([slope, slope * tau[:, None]], axis=1), value, ring)
        path = path + step.reshape(2, 3)
    return path, scale


def _within_rings(known: np.ndarray, value: np.ndarray, ring: np.ndarray) -> tuple[np.ndarray, float]:
    """(k,) coefficients of known (N, k), and the deviation of what they and the rings' own means leave."""
    weight, found, scale = np.ones(len(value)), np.zeros(known.shape[1]), 1.0
    for _ in range(8):
        total = np.maximum(np.bincount(ring, weight), 1e-9)
        left = known - (np.stack([np.bincount(ring, weight * k) for k in known.T], axis=1) / total[:, None])[ring]
        right = value - (np.bincount(ring, weight * value) / total)[ring]
        normal = (left * weight[:, None]).T @ left + 1e-6 * np.eye(known.shape[1])
        found = np.linalg.solve(normal, (left * weight[:, None]).T @ right)
        residual = right - left @ found
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-6)
        weight = robust_weight(residual, scale)
    return found, scale
