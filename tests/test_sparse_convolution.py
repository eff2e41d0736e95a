"""Sparse convolution: parity with torchsparse, equality with dense convolution, and what does not matter to it."""

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import conv3d, conv_transpose3d

from lidarsynth.networks.sparse_convolution import (
    OFFSETS_2,
    OFFSETS_3,
    Level,
    convolve,
    grow,
    levels_of,
    shrink,
    with_norm,
)


def assert_equal_to_five_digits(actual: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(actual, expected, atol=1e-5 * expected.abs().max().item(), rtol=0)


def test_the_chain_of_operators_is_torchsparses(oracle_tensors):
    o = oracle_tensors("lidm_operators")
    levels = levels_of(o["coords"], 3)
    assert levels[1].coordinates.tolist() == o["down1_k2s2.coords"].tolist()
    assert levels[2].coordinates.tolist() == o["down2_k2s2.coords"].tolist()
    x, kept = o["feats"], torch.zeros(0)
    for name, operator, level in (
        ("conv_k3s1", convolve, levels[0]),
        ("down1_k2s2", shrink, levels[0]),
        ("conv_k3s1_at2", convolve, levels[1]),
        ("down2_k2s2", shrink, levels[1]),
        ("conv_k3s1_at4", convolve, levels[2]),
        ("up2_k2s2", grow, levels[1]),
    ):
        x = operator(x, level, o[f"{name}.kernel"])
        assert_equal_to_five_digits(x, o[f"{name}.out"])
        kept = x if name == "conv_k3s1_at2" else kept
    x = convolve(torch.cat([x, kept], 1), levels[1], o["conv_k1_at2.kernel"])
    assert_equal_to_five_digits(x, o["conv_k1_at2.out"])
    assert_equal_to_five_digits(grow(x, levels[0], o["up1_k2s2.kernel"]), o["up1_k2s2.out"])


def test_offsets_and_normalisation_are_torchsparses(oracle_tensors):
    o = oracle_tensors("lidm_operators")
    assert torch.tensor(OFFSETS_3).tolist() == o["offsets_k3"].tolist()
    assert torch.tensor(OFFSETS_2).tolist() == o["offsets_k2"].tolist()
    norm = nn.BatchNorm1d(5).eval()
    norm.load_state_dict({k[3:]: v for k, v in o.items() if k.startswith("bn.") and k != "bn.out"}, strict=False)
    with torch.no_grad():
        kernel, bias = with_norm(torch.eye(5), norm)
        assert_equal_to_five_digits(o["feats"] @ kernel + bias, o["bn.out"])


def scattered(seed: int = 0, batches: int = 2, size: int = 8, channels: int = 3) -> tuple[Tensor, Tensor, Tensor]:
    """A dense grid (B, C, size, size, size) with free cells of 0, the voxels of the others, and their features."""
    generator = torch.Generator().manual_seed(seed)
    occupied = torch.rand(batches, size, size, size, generator=generator) < 0.3
    dense = torch.randn(batches, channels, size, size, size, generator=generator) * occupied[:, None]
    voxels = occupied.nonzero().roll(-1, 1)
    return dense, voxels, dense.movedim(1, -1)[occupied]


def at(dense: Tensor, voxels: Tensor, stride: int = 1) -> Tensor:
    x, y, z, batch = (voxels // torch.tensor([stride] * 3 + [1])).unbind(1)
    return dense.movedim(1, -1)[batch, x, y, z]


def test_it_is_dense_convolution_looked_at_in_occupied_voxels():
    dense, voxels, features = scattered()
    generator = torch.Generator().manual_seed(1)
    kernel = torch.randn(27, 3, 5, generator=generator)
    # x is the fastest axis of the offsets and the first of the grid
    weight = kernel.view(3, 3, 3, 3, 5).permute(4, 3, 2, 1, 0)
    expected = at(conv3d(dense, weight, padding=1), voxels)
    torch.testing.assert_close(convolve(features, Level(voxels), kernel), expected, atol=1e-4, rtol=1e-4)


def test_down_and_up_are_dense_strided_convolutions():
    dense, voxels, features = scattered(seed=2)
    level = Level(voxels)
    generator = torch.Generator().manual_seed(3)
    kernel = torch.randn(8, 3, 4, generator=generator)
    weight = kernel.view(2, 2, 2, 3, 4).permute(4, 3, 0, 1, 2)
    coarse = level.parents[0]
    shrunk = shrink(features, level, kernel)
    torch.testing.assert_close(shrunk, at(conv3d(dense, weight, stride=2), coarse.coordinates, 2), atol=1e-4, rtol=1e-4)
    back = torch.randn(8, 4, 3, generator=generator)
    blocks = torch.zeros(2, 4, 4, 4, 4)
    x, y, z, batch = (coarse.coordinates // torch.tensor([2, 2, 2, 1])).unbind(1)
    blocks.movedim(1, -1)[batch, x, y, z] = shrunk
    expected = at(conv_transpose3d(blocks, back.view(2, 2, 2, 4, 3).permute(3, 4, 0, 1, 2), stride=2), voxels)
    torch.testing.assert_close(grow(shrunk, level, back), expected, atol=1e-4, rtol=1e-4)


def test_neither_the_order_of_voxels_nor_other_scans_nor_where_the_scan_stands_matter():
    _, voxels, features = scattered(seed=4)
    kernel = torch.randn(27, 3, 3, generator=torch.Generator().manual_seed(5))
    expected = convolve(features, Level(voxels), kernel)
    order = torch.randperm(len(voxels), generator=torch.Generator().manual_seed(6))
    torch.testing.assert_close(convolve(features[order], Level(voxels[order]), kernel), expected[order])
    alone = voxels[:, 3] == 1
    torch.testing.assert_close(convolve(features[alone], Level(voxels[alone]), kernel), expected[alone])
    moved = voxels + torch.tensor([-1000, 70, -3, 0])
    torch.testing.assert_close(convolve(features, Level(moved), kernel), expected)


def test_a_level_finds_its_voxels_and_only_those():
    _, voxels, _ = scattered(seed=7)
    level = Level(voxels[torch.randperm(len(voxels), generator=torch.Generator().manual_seed(8))])
    assert torch.equal(level.find(level.coordinates), torch.arange(len(level)))
    everywhere = torch.cartesian_prod(*[torch.arange(-2, 11)] * 3, torch.arange(-1, 4))
    found = {tuple(v) for v, row in zip(everywhere.tolist(), level.find(everywhere).tolist(), strict=True) if row >= 0}
    assert found == {tuple(v) for v in voxels.tolist()}
    coarse = level.parents[0]
    assert (coarse.find(coarse.coordinates + torch.tensor([1, 0, 0, 0])) == -1).all(), "no multiple of the stride"


@pytest.mark.parametrize(
    ("voxels", "found"),
    [
        (torch.zeros(0, 4), "got (0, 4)"),
        (torch.zeros(5, 3), "got (5, 3)"),
        (torch.zeros(2, 4), "found one twice"),
        (torch.tensor([[0, 0, 0, 0], [2**40, 2**40, 0, 0]]), "2^62 cells"),
    ],
)
def test_other_voxels_are_refused(voxels: Tensor, found: str):
    with pytest.raises(ValueError, match="expected") as error:
        Level(voxels)
    assert found in str(error.value)
