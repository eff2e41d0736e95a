"""Scans as small sets of points: farthest points, earth mover's distance and occupancy, by hand and by brute force."""

from itertools import permutations

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from lidarsynth.metrics.point_sets import earth_movers_distance, farthest_points, sphere_counts, spread


def cloud(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 0.3, (count, 3)).astype(np.float32)


def test_each_point_is_the_farthest_from_all_before():
    xyz = cloud(200)
    chosen = farthest_points(xyz, 20, clear=0)
    assert chosen[0] == 0 and len(set(chosen.tolist())) == 20
    for i in range(1, 20):
        nearest = cdist(xyz, xyz[chosen[:i]]).min(1)
        assert nearest[chosen[i]] == pytest.approx(nearest.max(), rel=1e-6)
    assert np.array_equal(farthest_points(torch.from_numpy(xyz), 7, clear=0), chosen[:7]), "the first few are the same"


def test_removed_points_are_chosen_as_the_first_only():
    xyz = np.zeros((50, 3), np.float32)
    xyz[10:20, 0] = np.arange(1, 11)
    chosen = farthest_points(xyz, 15)
    assert chosen[:3].tolist() == [0, 19, 14], "5 m lies 5 from both 0 and 10"
    assert set(chosen[1:].tolist()) == set(range(10, 20)), "then points repeat"
    assert farthest_points(np.zeros((5, 3)), 4).tolist() == [0, 0, 0, 0]


def test_the_distance_is_that_of_the_best_of_all_matchings():
    a, b = cloud(6, 1), cloud(6, 2)
    distance = cdist(a, b)
    best = min(np.mean([distance[i, p[i]] for i in range(6)]) for p in permutations(range(6)))
    assert earth_movers_distance(a, torch.from_numpy(b)) == pytest.approx(best, rel=1e-6)


def test_the_distance_is_a_metric_and_of_a_shift_its_length():
    a, b, c = cloud(64, 1), cloud(64, 2), cloud(64, 3)
    assert earth_movers_distance(a, a[::-1].copy()) == 0
    assert earth_movers_distance(a, b) == pytest.approx(earth_movers_distance(b, a))
    assert earth_movers_distance(a, c) <= earth_movers_distance(a, b) + earth_movers_distance(b, c)
    assert earth_movers_distance(a, a + np.array([3, 4, 0])) == pytest.approx(5, rel=1e-6)


def test_occupancy_counts_the_nearest_grid_point_within_the_sphere():
    axis = np.linspace(-0.5, 0.5, 5)
    grid = np.array([[x, y, z] for x in axis for y in axis for z in axis])
    grid = grid[np.linalg.norm(grid, axis=1) <= 0.5]
    points = cloud(300)  # some outside
    expected = np.bincount(cdist(points, grid).argmin(1), minlength=len(grid))
    assert np.array_equal(np.sort(sphere_counts(points, 5)), np.sort(expected))
    assert np.array_equal(sphere_counts(grid, 5), np.ones(len(grid)))
    assert sphere_counts(points.reshape(3, 100, 3)).sum() == 300


def test_numbers_are_spread_from_the_first_to_the_last():
    assert spread(10, 4).tolist() == [0, 3, 6, 9]
    assert spread(3, 9).tolist() == [0, 1, 2]
    assert spread(0, 9).tolist() == []


def test_errors_say_both_sides():
    with pytest.raises(ValueError, match=r"must be \(N, 3\), at least one, got \(0, 3\)"):
        farthest_points(np.ones((0, 3)), 2)
    with pytest.raises(ValueError, match="NaN"):
        farthest_points(np.full((4, 3), np.nan), 2)
    with pytest.raises(ValueError, match=r"as many points \(N, 3\), found \(4, 3\) and \(5, 3\)"):
        earth_movers_distance(np.ones((4, 3)), np.ones((5, 3)))
    with pytest.raises(ValueError, match=r"\(..., 3\), got \(4, 2\)"):
        sphere_counts(np.ones((4, 2)))
    with pytest.raises(ValueError, match="a number of bins of at least 2, found 1"):
        sphere_counts(np.ones((4, 3)), 1)
