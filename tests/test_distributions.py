"""Distances of feature sets: parity with the published programs and scipy, closed forms, batches in any order."""

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from scipy.linalg import sqrtm
from scipy.spatial.distance import jensenshannon
from torch import Tensor

from lidarsynth.metrics.distributions import (
    Moments,
    frechet_distance,
    gaussian_mmd,
    jensen_shannon_distance,
    kernel_distance,
    moments,
)


@pytest.fixture
def features(fixture_tensors) -> tuple[Tensor, Tensor]:
    tensors = fixture_tensors("metrics/inputs")
    return tensors["features_gen"], tensors["features_real"]


@pytest.fixture
def values(reference: Path) -> dict:
    return json.loads((reference / "fixtures/metrics/values.json").read_text())


def draw(count: int, size: int, seed: int = 0, shift: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(count, size)) @ rng.normal(size=(size, size)) + shift).astype(np.float32)


def test_frechet_distance_equals_the_reference(features, values):
    generated, real = features
    for kind in (lambda v: v, lambda v: v.numpy(), lambda v: v.double()):
        distance = frechet_distance(moments(kind(generated)), moments(kind(real)))
        assert distance == pytest.approx(values["frechet_distance"], rel=1e-6)
    assert frechet_distance(moments(real), moments(generated)) == pytest.approx(distance, rel=1e-9)


def test_frechet_distance_of_few_samples_equals_the_reference(features, values):
    generated, real = features
    expected = values["frechet_distance_rank_deficient_first_k_samples"]
    few = [moments(v[: expected["k"]]) for v in (generated, real)]
    assert frechet_distance(*few) == pytest.approx(expected["value"], rel=1e-6)
    assert frechet_distance(*few[::-1]) == pytest.approx(expected["value"], rel=1e-6)


def test_frechet_distance_of_gaussians_in_closed_form():
    """Covariances that commute: sum over axes of (difference of means)^2 + (difference of deviations)^2."""
    mean, deviation = np.array([[0.0, 1, -2], [3, 1, 0]]), np.array([[1.0, 2, 0], [2, 0.5, 0]])
    signs = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) * math.sqrt(7 / 8)
    distance = frechet_distance(*(moments(m + d * signs) for m, d in zip(mean, deviation, strict=True)))
    assert distance == pytest.approx(((mean[0] - mean[1]) ** 2 + (deviation[0] - deviation[1]) ** 2).sum())


@pytest.mark.parametrize("count", [200, 20], ids=["full rank", "rank deficient"])
def test_frechet_distance_equals_scipy_and_is_zero_for_equal_sets(count):
    x, y = (draw(count, 40, seed, shift=0.1 * seed).astype(np.float64) for seed in (1, 2))
    cov = [np.cov(v, rowvar=False) for v in (x, y)]
    product = cov[0] @ cov[1] + (0 if count > 40 else 1e-12) * np.eye(40)
    expected = ((x.mean(0) - y.mean(0)) ** 2).sum() + np.trace(cov[0] + cov[1] - 2 * sqrtm(product).real)
    assert frechet_distance(moments(x), moments(y)) == pytest.approx(expected, rel=1e-5)
    assert frechet_distance(moments(x), moments(x[::-1])) == pytest.approx(0, abs=1e-5 * np.trace(cov[0]))


def test_frechet_distance_of_equal_sets_is_no_less_than_zero():
    for seed in range(20):
        features = np.random.default_rng(seed).normal(0, 50, (24, 12))
        assert 0 <= frechet_distance(moments(features), moments(features)) < 1e-6


def test_frechet_distance_of_few_against_many_equals_scipy_from_either_side():
    few, many = draw(12, 30, 1).astype(np.float64), draw(200, 30, 2, shift=0.2).astype(np.float64)
    few[6:] = few[:6]  # rank 5
    cov = [np.cov(v, rowvar=False) for v in (few, many)]
    root = sqrtm(cov[1])
    trace = np.sqrt(np.linalg.eigvalsh(root @ cov[0] @ root).clip(0)).sum()
    expected = ((few.mean(0) - many.mean(0)) ** 2).sum() + np.trace(cov[0] + cov[1]) - 2 * trace
    for pair in ((few, many), (many, few)):
        assert frechet_distance(*map(moments, pair)) == pytest.approx(expected, rel=1e-6)


def split(values: np.ndarray, sizes: list[int]) -> list[np.ndarray]:
    return np.split(values, np.cumsum(sizes)[:-1])


def gathered(batches: list[np.ndarray]) -> Moments:
    result = Moments(batches[0].shape[1])
    for batch in batches:
        result.update(batch)
    return result


def assert_same(a: Moments, b: Moments) -> None:
    assert a.count == b.count
    torch.testing.assert_close(a.mean, b.mean, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(a.covariance(), b.covariance(), rtol=1e-9, atol=1e-9)


def test_moments_depend_neither_on_batches_nor_on_order_nor_on_who_gathered_them():
    x = draw(101, 7, shift=1000.0)
    whole = moments(x)
    torch.testing.assert_close(
        whole.covariance().numpy(), np.cov(x.astype(np.float64), rowvar=False), rtol=1e-9, atol=0
    )
    assert_same(gathered(split(x, [1] * 101)), whole)
    assert_same(gathered([x[80:], x[:0], x[:3], x[3:80]]), whole)
    halves = [moments(x[:30]), moments(x[30:])]
    for order in (halves, halves[::-1]):
        merged = Moments(7)
        for half in (*order, Moments(7)):
            merged.merge(half)
        assert_same(merged, whole)


def test_moments_survive_a_file(tmp_path):
    x = draw(30, 4)
    save_file(moments(x[:10]).state(), tmp_path / "half.safetensors")
    half = Moments.from_state(load_file(tmp_path / "half.safetensors"))
    half.update(x[10:])
    assert_same(half, moments(x))


@pytest.mark.parametrize(("seed", "options"), [(0, {}), (123, {}), (7, {"subsets": 5, "size": 64})])
def test_kernel_distance_equals_the_reference(features, values, seed, options):
    name = f"squared_mmd_np_seed{seed}" + ("_subsets5_size64" if options else "")
    for kind in (lambda v: v, lambda v: v.numpy()):
        distance = kernel_distance(*map(kind, features), np.random.RandomState(seed), **options)
        assert distance == pytest.approx(values[name], rel=1e-5)


def test_kernel_distance_of_whole_sets_equals_the_reference_in_any_order(features, values):
    expected = values["squared_mmd_equal_sizes_no_subsampling"]
    sets = [v[: expected["first_n"]] for v in features]
    for pair, seed in ((sets, 0), (sets[::-1], 1)):
        distance = kernel_distance(*pair, np.random.default_rng(seed), subsets=1)
        assert distance == pytest.approx(expected["value"], rel=1e-5)


def test_kernel_distance_equals_its_definition():
    """Unbiased: no pair of a feature with itself (Binkowski et al. 2018, eq. 4; torch-fidelity, k-diffusion)."""
    x, y = draw(9, 6, 1).astype(np.float64), draw(9, 6, 2, shift=0.3).astype(np.float64)

    def kernel(a: np.ndarray, b: np.ndarray) -> float:
        return (sum(p * q for p, q in zip(a, b, strict=True)) / 6 + 1) ** 3

    within = sum(kernel(v[i], v[j]) for v in (x, y) for i in range(9) for j in range(9) if i != j) / (9 * 8)
    between = sum(kernel(p, q) for p in x for q in y) / 81
    distance = kernel_distance(x, y, np.random.default_rng(0), subsets=2)
    assert distance == pytest.approx(within - 2 * between, rel=1e-10)
    assert kernel_distance(x, x, np.random.default_rng(0), subsets=1) < 0, "unbiased, so it may be negative"


def test_kernel_distance_reads_memory_maps(tmp_path):
    x, y = draw(50, 8, 1), draw(60, 8, 2)
    np.save(tmp_path / "x.npy", x)
    mapped = np.load(tmp_path / "x.npy", mmap_mode="r")
    distances = [kernel_distance(v, y, np.random.default_rng(0), 3, 20) for v in (x, mapped)]
    assert distances[0] == distances[1]


def counts(scans: int, seed: int = 0, top: int = 9) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, top, (scans, 5, 6)) * (np.arange(6) != 2)


def test_gaussian_mmd_equals_its_definition_for_any_block():
    x, y = counts(23), counts(31, seed=1, top=3)
    p, q = (v.reshape(len(v), -1) / v.sum((1, 2), keepdims=False)[:, None] for v in (x, y))

    def kernel(a: np.ndarray, b: np.ndarray) -> float:
        return np.exp(-((a[:, None] - b[None]) ** 2).sum(-1) / (2 * 0.5**2)).mean()

    expected = kernel(p, p) + kernel(q, q) - 2 * kernel(p, q)
    for block in (1, 7, 23, 1000):
        assert gaussian_mmd(x, y, block=block) == pytest.approx(expected, rel=1e-4)
    assert gaussian_mmd(torch.from_numpy(y)[torch.randperm(31)], torch.from_numpy(x)) == pytest.approx(
        expected, rel=1e-4
    )
    assert gaussian_mmd(x, x[::-1]) == pytest.approx(0, abs=1e-7)


def test_jensen_shannon_distance_equals_scipy():
    p, q = counts(1)[0], counts(1, seed=4)[0]
    distance = jensen_shannon_distance(p, torch.from_numpy(q))
    assert distance == pytest.approx(jensenshannon(p.ravel(), q.ravel()), rel=1e-12)
    assert jensen_shannon_distance(q, p) == pytest.approx(distance, rel=1e-12)
    assert jensen_shannon_distance(p, 3 * p) == pytest.approx(0, abs=1e-7)
    assert jensen_shannon_distance(np.array([1, 0]), np.array([0, 5])) == pytest.approx(math.sqrt(math.log(2)))


SQUARES = np.ones((3, 3)), np.eye(3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: moments(np.ones(3)), r"must be \(N, D\)"),
        (lambda: moments(np.array([[1.0, np.nan]])), "NaN or infinity"),
        (lambda: Moments(3).update(np.ones((2, 4))), r"must be \(B, 3\), got \(2, 4\)"),
        (lambda: Moments(3).merge(Moments(4)), "of 3 dimensions, found 4"),
        (lambda: moments(np.ones((1, 3))).covariance(), "at least 2 features.*found 1"),
        (lambda: Moments.from_state({"mean": torch.ones(2)}), "count .*found"),
        (lambda: frechet_distance(moments(np.ones((3, 2))), moments(np.ones((3, 3)))), "2 dimensions, found 3"),
        (lambda: kernel_distance(np.ones((3, 2)), np.ones((3, 3)), np.random.default_rng(0)), r"\(3, 2\) and \(3, 3\)"),
        (lambda: kernel_distance(np.ones((1, 2)), np.ones((3, 2)), np.random.default_rng(0)), "found 1 and 3"),
        (
            lambda: kernel_distance(*SQUARES, np.random.default_rng(0), subsets=0),
            "a number of subsets of at least 1, found 0",
        ),
        (lambda: kernel_distance(*SQUARES, np.random.default_rng(0), size=1), "a size of at least 2, found 1"),
        (lambda: gaussian_mmd(*SQUARES, width=0), "a width above 0, found 0"),
        (lambda: gaussian_mmd(*SQUARES, width=math.nan), "a width above 0, found nan"),
        (lambda: gaussian_mmd(*SQUARES, block=0), "a block of at least 1, found 0"),
        (lambda: gaussian_mmd(np.ones((2, 3)), np.ones((2, 4))), r"\(2, 3\) and \(2, 4\)"),
        (lambda: gaussian_mmd(np.ones((2, 3)), np.zeros((2, 3))), "found one without"),
        (lambda: gaussian_mmd(np.ones((2, 4)), np.ones((2, 2, 2))), r"\(2, 4\) and \(2, 2, 2\)"),
        (lambda: gaussian_mmd(np.array([[3.0, -1.0]]), np.ones((2, 2))), "counts of at least 0, found -1"),
        (lambda: jensen_shannon_distance(np.ones(3), np.zeros(3)), "counts of one shape"),
        (lambda: jensen_shannon_distance(np.ones(3), np.array([1, 1, np.inf])), "counts of one shape.*inf"),
        (lambda: jensen_shannon_distance(np.ones(3), np.ones(4)), "counts of one shape"),
    ],
)
def test_errors_say_both_sides(call: Callable, message: str):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("kind", ["u1", "u2", "u4", "u8", ">u2", ">i4", ">f4", ">f8", "i8", "f4"])
def test_counts_of_any_type_are_counts(kind: str):
    rng = np.random.default_rng(0)
    x, y = (rng.integers(1, 200, (6, 5, 5)) for _ in range(2))
    expected = gaussian_mmd(x.astype("f8"), y.astype("f8"))
    assert gaussian_mmd(x.astype(kind), y.astype(kind)) == pytest.approx(expected, rel=1e-5)
    frozen = x.astype(kind)
    frozen.setflags(write=False)
    assert gaussian_mmd(frozen, frozen) == pytest.approx(0, abs=1e-7)
    features = moments(x.reshape(6, -1).astype(kind))
    assert torch.allclose(features.mean, moments(x.reshape(6, -1).astype("f4")).mean)
