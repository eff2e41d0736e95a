"""Bird's-eye-view histograms: the published counts, numpy's, and the JSD and MMD made of them."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from lidarsynth.metrics.bev import BevCounts, bev_histograms
from lidarsynth.metrics.distributions import gaussian_mmd, jensen_shannon_distance


def clouds(scans: int, points: int = 400, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 30, (scans, points, 3)).astype(np.float32)


def test_histograms_equal_the_reference_exactly(fixture_tensors):
    tensors = fixture_tensors("metrics/inputs")
    edge = tensors["edge_points"][None]
    pairs = {
        "hist_real": bev_histograms(tensors["clouds_real"]),
        "hist_gen": bev_histograms(tensors["clouds_gen"].numpy()),
        "hist_bins20_field80": bev_histograms(tensors["clouds_real"][:2], bins=20, extent=40),
        "edge_hist_default": bev_histograms(edge)[0],
        "edge_hist_gate_1_200": bev_histograms(edge, near=1, far=200)[0],
    }
    for name, actual in pairs.items():
        torch.testing.assert_close(
            actual, tensors[name].int(), rtol=0, atol=0, msg=lambda text, name=name: f"{name}: {text}"
        )


def test_jsd_and_mmd_equal_the_reference(fixture_tensors, reference: Path):
    tensors = fixture_tensors("metrics/inputs")
    values = json.loads((reference / "fixtures/metrics/values.json").read_text())
    generated, real = (bev_histograms(tensors[name]) for name in ("clouds_gen", "clouds_real"))
    assert jensen_shannon_distance(generated.sum(0), real.sum(0)) == pytest.approx(values["bev_jsd"], rel=1e-5)
    assert gaussian_mmd(generated, real) == pytest.approx(values["bev_mmd"], rel=1e-3)
    assert gaussian_mmd(generated, real) == pytest.approx(values["bev_mmd_float64"], rel=1e-5)


@pytest.mark.parametrize(("bins", "extent"), [(100, 80.0), (7, 30.0), (64, 50.0)])
def test_histograms_equal_numpy(bins, extent):
    xyz = clouds(3)
    distance = np.linalg.norm(xyz, axis=-1)
    keep = (distance > 3) & (distance < 70)
    for counts, points, kept in zip(bev_histograms(xyz, bins, extent), xyz, keep, strict=True):
        x, y, _ = points[kept].astype(np.float64).T
        expected, _, _ = np.histogram2d(x, y, bins, [[-extent, extent]] * 2)
        np.testing.assert_array_equal(counts.numpy(), expected)


def test_the_gate_is_strict_and_the_right_edge_belongs_to_the_last_cell():
    points = np.array([[3, 0, 0], [70, 0, 0], [0, 0, 0], [10, 10, 0], [20, -20, 5], [20.001, 0, 0]], np.float32)
    counts = bev_histograms(points[None], bins=4, extent=20)[0]
    assert counts.nonzero().tolist() == [[3, 0], [3, 3]]
    assert counts.sum() == 2


def gathered(batches: list[np.ndarray], keep: int | None = 10_000) -> BevCounts:
    counts = BevCounts(keep=keep)
    for batch in batches:
        counts.update(batch)
    return counts


def test_counts_depend_neither_on_batches_nor_on_who_gathered_them():
    xyz = clouds(9)
    whole = bev_histograms(xyz)
    for counts in (gathered([xyz]), gathered([xyz[:1], xyz[1:6], xyz[6:]])):
        assert counts.count == 9
        assert torch.equal(counts.pooled, whole.sum(0))
        assert torch.equal(counts.scans, whole)
    first, second = gathered([xyz[:4]], keep=6), gathered([xyz[4:]], keep=6)
    first.merge(second)
    assert first.count == 9
    assert torch.equal(first.pooled, whole.sum(0))
    assert torch.equal(first.scans, whole[:6]), "memory is bounded: only the first are kept"
    assert second.count == 5


def test_an_empty_batch_changes_nothing():
    counts = gathered([clouds(3)])
    counts.update(np.zeros((0, 10, 3)))
    assert counts.count == 3 and torch.equal(counts.pooled, bev_histograms(clouds(3)).sum(0))
    assert bev_histograms(np.zeros((0, 10, 3)), bins=7).shape == (0, 7, 7)


def test_errors_say_both_sides():
    with pytest.raises(ValueError, match=r"must be \(B, N, 3\), got \(4, 3\)"):
        bev_histograms(np.ones((4, 3)))
    with pytest.raises(ValueError, match="NaN or infinity"):
        bev_histograms(np.full((1, 4, 3), np.inf))
    with pytest.raises(ValueError, match="a number of bins of at least 1, found 0"):
        bev_histograms(clouds(1), bins=0)
    with pytest.raises(ValueError, match="an extent above 0, found 0"):
        bev_histograms(clouds(1), extent=0)
    with pytest.raises(ValueError, match=r"\(100, 80.0, 3.0, 70.0\), found \(50, 80.0, 3.0, 70.0\)"):
        BevCounts().merge(BevCounts(bins=50))
