"""A ring of a spinning LiDAR is a cone: its points obey z = tan(e) rho + h. Fits of that to measured rings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarsynth.lidar.inner_product import inner_product

NEAR = 2.0  # metres: nearer points are the carrier's own, and their angle says little of the beam
ROUNDS = 12
POINTS = 4_000  # of a scan are enough
STEPS, WEIGHED = 12, 4  # of Gauss-Newton at most, and how often points are weighed anew in each
STRIDE, CLOSE = 1.5, 0.01  # metres: no step is longer, for far off cones fit too; and a shorter one is the last


@dataclass(frozen=True)
class Cones:
    """How the rings of a scan stand in its frame: z = h + a (x - p) + b (y - q) + t_ring rho, rho from the axis.

    axis      (3,) unit vector that the sensor turns about
    origin    (3,) metres: p, q, h of the cones' common apex
    residual  degrees, a robust standard deviation, of the points from their cones
    upright   degrees, the same of cones about z through the frame's origin
    error     (5,) standard errors of p, q, h (metres) and a, b (radians)
    """

    axis: np.ndarray
    origin: np.ndarray
    residual: float
    upright: float
    error: np.ndarray

    @property
    def tilt(self) -> float:
        """Degrees between the axis and z."""
        return float(np.degrees(np.arccos(np.clip(self.axis[2], -1, 1))))

    def apart(self, deviations: float) -> bool:
        """Whether axis or origin differ from the frame's own by more than so many standard errors."""
        found = np.append(self.origin, self.axis[:2])
        return bool((np.abs(found) > deviations * np.maximum(self.error, 1e-12)).any())


def fit_cones(xyz: np.ndarray, ring: np.ndarray, seed: int = 0) -> Cones:
    """The cones of points (N, 3) metres by their rings (N,): common axis and origin, each ring its own elevation.

    Angles are fitted, v = (z - h - a x - b y) / rho = t_ring with x, y and rho from (p, q), by Gauss-Newton steps of
    least squares that give less weight to points far off (Huber, and none beyond six deviations). Raises ValueError for
    fewer than 100 points beyond 2 m.
    """
    chosen = np.flatnonzero(np.hypot(xyz[:, 0], xyz[:, 1]) > NEAR)
    if len(chosen) < 100:
        raise ValueError(f"expected at least 100 points beyond {NEAR:g} m to fit rings to, found {len(chosen)}")
    if len(chosen) > POINTS:
        chosen = np.random.default_rng(seed).choice(chosen, POINTS, replace=False, shuffle=False)
    points = xyz[chosen].astype(np.float64)
    _, ring = np.unique(ring[chosen], return_inverse=True)
    fitted, weight, scale, error = np.zeros(5), np.ones(len(points)), 1.0, np.zeros(5)
    for _ in range(STEPS):
        x, y, z = (points - fitted[:3]).T
        rho = np.maximum(np.hypot(x, y), NEAR / 4)
        values = (z - fitted[3] * x - fitted[4] * y) / rho
        slopes = np.stack([-values * x / rho**2, -values * y / rho**2, 1 / rho, x / rho, y / rho], axis=1)
        step, error, scale, weight = _stepped(slopes, values, ring, weight)
        length = float(np.linalg.norm(step[:3]))
        fitted += step * min(1.0, STRIDE / max(length, CLOSE))
        if length < CLOSE:
            break
    axis = np.array([-fitted[3], -fitted[4], 1.0])
    values = points[:, 2] / np.hypot(points[:, 0], points[:, 1])
    spread = float(np.degrees(_deviation(values - _medians(values, ring)[ring])))
    return Cones(axis / np.linalg.norm(axis), fitted[:3], float(np.degrees(scale)), spread, error)


def _stepped(
    slopes: np.ndarray, values: np.ndarray, ring: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Coefficients of slopes (N, k) that explain values (N,) but for each ring's mean: (k,), their standard errors
    (k,), the deviation of what is left, and the weights (N,) that go with it."""
    step, scale, normal = np.zeros(slopes.shape[1]), 1.0, np.eye(slopes.shape[1])
    for _ in range(WEIGHED):
        left = np.stack([_without_mean(slope, ring, weight) for slope in slopes.T], axis=1)
        right = _without_mean(values, ring, weight)
        normal = (left * weight[:, None]).T @ left + 1e-9 * np.eye(len(step))
        step = np.linalg.solve(normal, (left * weight[:, None]).T @ right)
        residual = right - left @ step
        scale = _deviation(residual)
        weight = robust_weight(residual, scale)
    return step, np.sqrt(np.diag(np.linalg.inv(normal))) * scale, scale, weight


@dataclass(frozen=True)
class Ring:
    """One ring's cone about z: elevation in degrees, height of its origin in metres, its error, and what it fits.

    residual  degrees, a robust standard deviation of the points from the cone
    """

    elevation: float
    height: float
    height_error: float
    residual: float
    points: int


def fit_ring(xyz: np.ndarray, height: float | None = None) -> Ring:
    """z = tan(e) rho + h of one ring's points (N, 3) metres; with `height` only e is sought."""
    rho = np.hypot(xyz[:, 0], xyz[:, 1]).astype(np.float64)
    values, inverse = xyz[:, 2] / rho, 1 / rho
    slope, lift, error, scale = float(np.median(values)), height or 0.0, np.inf, 1.0
    far = rho > np.median(rho)
    if height is None and far.any():  # starting from a nearly right line: medians of the near and of the far half
        near_value, far_value = float(np.median(values[~far])), float(np.median(values[far]))
        gap = float(np.median(inverse[~far]) - np.median(inverse[far]))
        lift = (near_value - far_value) / gap if gap > 1e-3 else 0.0
    for _ in range(ROUNDS):
        residual = values - slope - lift * inverse
        scale = _deviation(residual)
        weight = robust_weight(residual, scale)
        total = weight.sum()
        mean_value, mean_inverse = inner_product(weight, values) / total, inner_product(weight, inverse) / total
        spread = inner_product(weight, (inverse - mean_inverse) ** 2)
        if height is None and spread > 1e-9:
            lift = float(inner_product(weight, (inverse - mean_inverse) * (values - mean_value)) / spread)
            error = float(scale / np.sqrt(spread))
        slope = float(mean_value - lift * mean_inverse)
    return Ring(float(np.degrees(np.arctan(slope))), lift, error, float(np.degrees(scale)), len(xyz))


def robust_weight(residual: np.ndarray, scale: float) -> np.ndarray:
    """(N,) weights: 1 within 1.5 deviations, falling as 1 / r beyond (Huber 1964), 0 beyond 6."""
    far = np.abs(residual) / scale
    return np.where(far > 6, 0, 1 / np.maximum(far / 1.5, 1))


def _deviation(residual: np.ndarray) -> float:
    """A standard deviation that outliers do not move: 1.4826 medians of the absolute value."""
    return max(1.4826 * float(np.median(np.abs(residual))), 1e-6)


def _without_mean(values: np.ndarray, ring: np.ndarray, weight: np.ndarray) -> np.ndarray:
    total = np.maximum(np.bincount(ring, weight), 1e-12)
    return values - (np.bincount(ring, weight * values) / total)[ring]


def _medians(values: np.ndarray, ring: np.ndarray) -> np.ndarray:
    """(rings,) median of each ring's values; rings are numbered without gaps."""
    order = np.lexsort((values, ring))
    ends = np.cumsum(np.bincount(ring))
    return values[order][(ends + np.concatenate([[0], ends[:-1]])) // 2]


def onto_z(axis: np.ndarray) -> np.ndarray:
    """(3, 3) the shortest rotation that brings a unit vector onto z (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])  # of axis x z, as a matrix
    return np.eye(3) + cross + cross @ cross / (1 + z)
