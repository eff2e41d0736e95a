"""Points and voxels of SPVCNN: parity with its published program, and interpolation's own laws."""

import pytest
import torch

from lidarsynth.networks.sparse_convolution import Level
from lidarsynth.networks.voxel_points import corners, devoxelise, voxel_of_points, voxelise


def test_the_first_voxelisation_is_the_published_one(oracle_tensors):
    o = oracle_tensors("lidm_points")
    level = Level(o["voxels.coords"].long())
    means = voxelise(o["feats"], voxel_of_points(o["points"], level), len(level))
    torch.testing.assert_close(means, o["voxels.feats"], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("stride", [1, 4])
def test_corners_weights_and_both_ways_are_the_published_ones(stride, oracle_tensors):
    o = oracle_tensors("lidm_points")
    level = Level(o[f"stride{stride}.coords"], stride)
    rows, weights = corners(o["points"], level)
    assert torch.equal(rows, o[f"stride{stride}.corner_index"])
    torch.testing.assert_close(weights, o[f"stride{stride}.corner_weight"], atol=1e-6, rtol=1e-5)
    back = devoxelise(o[f"stride{stride}.feats"], rows, weights)
    torch.testing.assert_close(back, o[f"stride{stride}.to_points"], atol=1e-5, rtol=1e-5)
    means = voxelise(o["feats"], voxel_of_points(o["points"], level), len(level))
    torch.testing.assert_close(means, o[f"stride{stride}.from_points"], atol=1e-5, rtol=1e-5)


def test_interpolation_keeps_linear_functions_where_all_corners_are_and_constants_everywhere():
    generator = torch.Generator().manual_seed(0)
    full = torch.cartesian_prod(*[torch.arange(0, 16, 2)] * 3, torch.zeros(1, dtype=torch.long))
    points = torch.cat([torch.rand(200, 3, generator=generator) * 13.9, torch.zeros(200, 1)], 1)
    plane = torch.tensor([[1.0, 0.5], [-2.0, 0.0], [3.0, 1.0]])
    level = Level(full, 2)
    found = devoxelise(full[:, :3].float() @ plane, *corners(points, level))
    torch.testing.assert_close(found, points[:, :3] @ plane, atol=1e-4, rtol=1e-4)
    holes = Level(full[torch.rand(len(full), generator=generator) < 0.7], 2)
    rows, weights = corners(points, holes)
    some = (rows >= 0).any(1)
    torch.testing.assert_close(
        devoxelise(torch.ones(len(holes), 1), rows, weights)[some], torch.ones(int(some.sum()), 1)
    )


def test_points_without_a_voxel_take_no_part():
    level = Level(torch.tensor([[0, 0, 0, 0], [4, 0, 0, 0]]), 4)
    points = torch.tensor([[1.0, 1, 1, 0], [3, 3, 3, 0], [9, 0, 0, 0], [1, 1, 1, 1]])
    rows = voxel_of_points(points, level)
    assert rows.tolist() == [0, 0, -1, -1]
    means = voxelise(torch.tensor([[2.0], [4.0], [100.0], [100.0]]), rows, 2)
    assert means.tolist() == [[3.0], [0.0]]
