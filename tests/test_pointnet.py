"""PointNet: parity with the published program, and what makes it a function of sets of points."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from lidarsynth.networks.pointnet import PointNet, point_features, read_pointnet


@pytest.fixture(scope="module")
def network(official_file) -> PointNet:
    return read_pointnet(official_file("pointnet/cls_model_39.pth"))


def test_features_equal_the_reference(network, fixture_tensors):
    tensors = fixture_tensors("pointnet/io")
    points = tensors["points_metric"]
    features = point_features(network, points.transpose(1, 2))
    assert features.shape == (3, 1808)
    expected = tensors["feature"]
    torch.testing.assert_close(features, expected, atol=1e-4 * expected.abs().max().item(), rtol=0)
    stn = network.feat.stn(points / 80).detach()
    torch.testing.assert_close(stn, tensors["stn_transform"], atol=1e-4, rtol=0)


def test_names_shapes_and_count_are_the_published_ones(reference: Path):
    expected = json.loads((reference / "fixtures/pointnet/keys.json").read_text())
    network = PointNet()
    assert {key: list(value.shape) for key, value in network.state_dict().items()} == expected
    assert sum(p.numel() for p in network.parameters()) == 1_607_961


def test_features_depend_neither_on_the_batch_nor_on_the_order_of_points(network):
    rng = np.random.default_rng(0)
    xyz = rng.normal(0, 20, (4, 500, 3)).astype(np.float32)
    together = point_features(network, xyz)
    for i in range(4):
        shuffled = torch.from_numpy(xyz[i : i + 1, rng.permutation(500)])
        torch.testing.assert_close(point_features(network, shuffled), together[i : i + 1], atol=1e-5, rtol=1e-5)


def test_errors_say_both_sides(network, tmp_path: Path):
    with pytest.raises(ValueError, match=r"xyz must be \(B, N, 3\), got \(1, 3, 9\)"):
        point_features(network, np.ones((1, 3, 9)))
    with pytest.raises(ValueError, match="NaN or infinity"):
        point_features(network, np.full((1, 9, 3), np.nan))
    with pytest.raises(ValueError, match="evaluation mode"):
        point_features(PointNet(), np.ones((1, 9, 3)))
    with pytest.raises(ValueError, match=r"must be \(B, 3, N\), got \(2, 9, 3\)"):
        network(torch.ones(2, 9, 3))
    torch.save({"fc1.weight": torch.ones(2, 2)}, tmp_path / "other.pth")
    with pytest.raises(ValueError, match=r"other.pth: expected .*fc1.weight|other.pth: expected feat"):
        read_pointnet(tmp_path / "other.pth")
    with pytest.raises(ValueError, match=r"none.pth: expected weights, found No such file"):
        read_pointnet(tmp_path / "none.pth")
