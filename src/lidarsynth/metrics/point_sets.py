"""Scans as small sets of points: the farthest ones, the earth mover's distance, occupancy of a sphere.

DUSty (Nakashima et al. 2023) judges 2,048 points of every scan so, with the measures of Achlioptas et al. 2018.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from lidarsynth.metrics.distributions import Array, as_tensor, check_least


def farthest_points(xyz: Array, count: int, clear: float = 1e-3) -> np.ndarray:
    """(count,) int64: numbers of points (N, 3), each the farthest from all before it, the first being number 0.

    Points with |xyz|^2 <= clear are never chosen but as the first (as DUSty's program does: removed points stand at the
    origin). Where fewer are left, points repeat. Raises ValueError for another shape, none, NaN or infinity.
    """
    points = as_tensor(xyz).cpu().numpy().astype(np.float32)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise ValueError(f"xyz must be (N, 3), at least one, got {points.shape}")
    numbers = np.flatnonzero(np.square(points).sum(1) > clear)
    chosen = np.zeros(count, np.int64)
    if not len(numbers):
        return chosen
    x, y, z = np.ascontiguousarray(points[numbers].T)
    nearest, last = np.full(len(numbers), np.inf, np.float32), points[0]
    for i in range(1, count):
        squared = np.square(x - last[0])
        squared += np.square(y - last[1])
        squared += np.square(z - last[2])
        np.minimum(nearest, squared, out=nearest)
        k = nearest.argmax()
        chosen[i], last = numbers[k], (x[k], y[k], z[k])
    return chosen


def earth_movers_distance(a: Array, b: Array) -> float:
    """Mean distance between the points of `a` (N, 3) and those of `b` (N, 3), matched one to one so that it is least.

    Exact, by assignment (Jonker & Volgenant 1987), in the points' unit. Two sets of 256 take 10 ms, of 2,048 two to ten
    seconds. Raises ValueError for sets of other shapes, NaN or infinity; ImportError without scipy.
    """
    try:
        from scipy.optimize import linear_sum_assignment
        from scipy.spatial.distance import cdist
    except ImportError as error:
        raise ImportError(MISSING) from error
    first, second = (as_tensor(points).double().cpu().numpy() for points in (a, b))
    if first.shape != second.shape or first.ndim != 2 or first.shape[1] != 3 or not len(first):
        raise ValueError(f"expected two sets of as many points (N, 3), found {first.shape} and {second.shape}")
    cost = cdist(first, second)
    return float(cost[linear_sum_assignment(cost)].mean())


def sphere_counts(points: Array, bins: int = 28) -> np.ndarray:
    """(cells,) int64: how many of `points` (..., 3) lie nearest to each point of a grid within a sphere.

    The grid has `bins` points a side over [-0.5, 0.5]^3, without those farther than 0.5 from the origin (Achlioptas et
    al. 2018); points outside count at its rim. Raises ValueError for another shape or NaN, or fewer than two bins;
    ImportError without scipy.
    """
    check_least("a number of bins", bins, 2)
    flat = as_tensor(points).cpu().numpy()
    if flat.shape[-1] != 3:
        raise ValueError(f"points must be (..., 3), got {flat.shape}")
    tree = _grid(bins)
    return np.bincount(tree.query(flat.reshape(-1, 3))[1], minlength=tree.n)


MISSING = "distances of points need scipy: pip install 'lidarsynth[metrics]'"


@lru_cache(maxsize=2)
def _grid(bins: int) -> Any:
    try:
        from scipy.spatial import KDTree
    except ImportError as error:
        raise ImportError(MISSING) from error
    axis = np.arange(bins) / (bins - 1) - 0.5
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return KDTree(grid[np.linalg.norm(grid, axis=1) <= 0.5])


def spread(count: int, wanted: int) -> np.ndarray:
    """(min(count, wanted),) int64: numbers evenly spaced from the first to the last of `count` (DUSty's choice)."""
    return np.linspace(0, max(count - 1, 0), min(count, wanted)).astype(np.int64)
