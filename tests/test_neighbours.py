"""Coverage, 1-NN accuracy, precision and recall: closed forms, a second implementation, independence of order."""

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from lidarsynth.metrics.neighbours import (
    Fidelity,
    coverage,
    distance_matrix,
    fidelity,
    minimum_matching_distance,
    nearest_neighbour_accuracy,
)
from lidarsynth.metrics.reconstruction import chamfer_distance


def normal(count: int, seed: int, shift: float = 0.0, size: int = 4) -> np.ndarray:
    return np.random.default_rng(seed).normal(shift, 1, (count, size))


def test_scores_of_a_small_matrix_by_hand():
    between = np.array([[1.0, 2.0, 3.0], [1.5, 4.0, 9.0]])  # two generated, three real: both are nearest to the first
    assert coverage(between) == pytest.approx(1 / 3)
    assert minimum_matching_distance(between) == pytest.approx((1 + 2 + 3) / 3)
    alone = {"generated": np.array([[0, 0.5], [0.5, 0]]), "real": np.full((3, 3), 2.5)}
    # both generated ones are nearer to each other; of the real ones only the third (2.5 < 3) is nearer to its own
    assert nearest_neighbour_accuracy(alone["generated"], between, alone["real"]) == pytest.approx(3 / 5)


def test_sets_of_one_distribution_score_a_half_and_distant_sets_one():
    x, y = normal(400, 1), normal(400, 2)
    near = nearest_neighbour_accuracy(cdist(x, x), cdist(x, y), cdist(y, y))
    assert near == pytest.approx(0.5, abs=0.06)
    assert nearest_neighbour_accuracy(cdist(x, x), cdist(x, y + 50), cdist(y, y)) == 1
    assert coverage(cdist(x, x)) == 1
    assert minimum_matching_distance(cdist(x, x)) == 0
    assert coverage(cdist(x, y + 50)) < 0.1


def test_scores_do_not_depend_on_order():
    x, y = normal(30, 1), normal(20, 2, shift=0.5)
    a, b = np.random.default_rng(0).permutation(30), np.random.default_rng(1).permutation(20)
    first, second = ((cdist(u, u), cdist(u, v), cdist(v, v)) for u, v in ((x, y), (x[a], y[b])))
    assert nearest_neighbour_accuracy(*first) == nearest_neighbour_accuracy(*second)
    assert coverage(first[1]) == coverage(second[1])
    swapped = nearest_neighbour_accuracy(first[2], first[1].T, first[0])
    assert swapped == nearest_neighbour_accuracy(*first)


def test_distance_matrix_of_point_clouds():
    clouds = [normal(50, seed, size=3) for seed in range(3)]
    matrix = distance_matrix(clouds, clouds[:2], chamfer_distance)
    assert matrix.shape == (3, 2)
    assert matrix[0, 0] == matrix[1, 1] == 0
    assert matrix[0, 1] == matrix[1, 0] == chamfer_distance(clouds[0], clouds[1])
    tensors = [torch.from_numpy(matrix) for matrix in (matrix[:2], matrix[:2], matrix[:2])]
    assert coverage(tensors[0]) == coverage(matrix[:2]) and nearest_neighbour_accuracy(*tensors) == 0
    assert minimum_matching_distance(tensors[0]) == minimum_matching_distance(matrix[:2])
    calls: list[int] = []

    def counted(a: np.ndarray, b: np.ndarray) -> float:
        calls.append(1)
        return chamfer_distance(a, b)

    assert np.array_equal(
        distance_matrix(clouds, clouds, counted), distance_matrix(clouds, list(clouds), chamfer_distance)
    )
    assert len(calls) == 3, "of one set with itself each pair is computed once"
    assert distance_matrix([], clouds, chamfer_distance).shape == (0, 3)


def test_fidelity_equals_its_definition_for_any_block():
    fake, real, k = normal(60, 1, shift=0.4), normal(45, 2), 3
    balls = [np.sort(cdist(v, v), axis=1)[:, k] for v in (real, fake)]
    between = cdist(real, fake)
    inside = between < balls[0][:, None]
    expected = (
        inside.any(0).mean(),
        (between < balls[1]).any(1).mean(),
        inside.sum(0).mean() / k,
        (between.min(1) < balls[0]).mean(),
    )
    for block in (1, 17, 1000):
        found = fidelity(fake, torch.from_numpy(real), k, block)
        assert (found.precision, found.recall, found.density, found.coverage) == pytest.approx(expected)


def test_fidelity_of_equal_and_of_distant_sets():
    x = normal(50, 1)
    same, far = fidelity(x, x[::-1].copy()), fidelity(x, x + 100)
    assert (same.precision, same.recall, same.coverage) == (1, 1, 1)
    assert same.density >= 1
    assert (far.precision, far.recall, far.density, far.coverage) == (0, 0, 0, 0)


def test_fidelity_of_equal_sets_of_duplicates_is_not_one():
    """Balls are open: that of a feature with k others at its place is empty, as in the program of Naeem et al."""
    x = np.repeat(normal(10, 1), 4, axis=0)
    assert fidelity(x, x, k=3) == Fidelity(0, 0, 0, 0)
    assert fidelity(x, x, k=4).precision == 1


@pytest.mark.parametrize("shift", [0.0, 3.0, 1000.0])
@pytest.mark.parametrize("k", [1, 5])
def test_each_score_of_equal_sets_is_one_wherever_they_lie(k: int, shift: float):
    """A feature's k-th neighbour lies on the edge of its ball, also where its distance is computed once more."""
    for seed in range(3):
        x = np.random.default_rng(seed).normal(size=(300, 16)) + shift
        assert fidelity(x, x, k=k) == fidelity(x, x, k=k, block=64) == Fidelity(1, 1, 1, 1)
        doubled = np.repeat(x, k + 1, axis=0)
        assert fidelity(doubled, doubled, k=k) == Fidelity(0, 0, 0, 0)


def test_precision_falls_with_noise_and_recall_with_missing_modes():
    real = np.concatenate([normal(60, 1), normal(60, 2, shift=20)])
    noisy = fidelity(real + 5 * normal(120, 3), real)
    half = fidelity(normal(60, 4), real)
    assert noisy.precision < 0.5 < half.precision
    assert half.recall < 0.6
    assert half.coverage < 0.6


def test_errors_say_both_sides():
    square = np.ones((3, 3))
    with pytest.raises(ValueError, match=r"expected distances \(2, 2\), \(2, 3\), \(3, 3\), found \(3, 3\)"):
        nearest_neighbour_accuracy(square, np.ones((2, 3)), square)
    with pytest.raises(ValueError, match="without NaN"):
        coverage(np.full((2, 2), np.nan))
    with pytest.raises(ValueError, match=r"without NaN, found \(0, 3\)"):
        minimum_matching_distance(np.ones((0, 3)))
    with pytest.raises(ValueError, match="more than k = 5"):
        fidelity(np.ones((5, 2)), np.ones((9, 2)))
    for odd, message in (({"k": 0}, "a k of at least 1, found 0"), ({"block": 0}, "a block of at least 1, found 0")):
        with pytest.raises(ValueError, match=message):
            fidelity(normal(9, 1), normal(9, 2), **odd)
