"""Layers: parity with the reference operators, and what makes them operators on a ring."""

from copy import deepcopy

import pytest
import torch
from torch import nn

from lidarsynth.networks.layers import (
    AdaGroupNorm,
    ColumnLinear,
    Conv3x3,
    Downsample,
    LogSNREmbedding,
    ResidualBlock,
    SelfAttentionBlock,
    Upsample,
)


@pytest.fixture
def ops(fixture_tensors):
    return fixture_tensors("r2dm/ops")


def load(layer: nn.Module, tensors: dict, prefix: str) -> nn.Module:
    """Loads `prefix.*` into a layer; buffers that the reference did not store keep their values."""
    outputs = (f"{prefix}.out", f"{prefix}.emb")
    stored = {key.removeprefix(f"{prefix}."): value for key, value in tensors.items() if key.startswith(f"{prefix}.")}
    stored = {key: value for key, value in stored.items() if f"{prefix}.{key}" not in outputs}
    layer.load_state_dict(stored)
    return layer.requires_grad_(False)


def assert_tight(actual, expected):
    torch.testing.assert_close(actual, expected, atol=1e-5 * expected.abs().max().item(), rtol=0)


@pytest.mark.parametrize("ring", [True, False])
def test_resampling_equals_the_reference(ops, ring):
    for layer, key in ((Downsample(ring), "up1.down2"), (Upsample(ring), "up2.down1")):
        layer.load_state_dict({"kernel": ops[f"resample.{key}.kernel"]})
        assert_tight(layer(ops["x"]), ops[f"resample.{key}.ring{int(ring)}"])


def test_layers_equal_the_reference(ops):
    x, emb = ops["x"], ops["adagn.emb"]
    assert_tight(load(Conv3x3(16, 8), ops, "conv")(x), ops["conv.out"])
    assert_tight(load(AdaGroupNorm(12, 16, 8, 1e-6), ops, "adagn")(x, emb), ops["adagn.out"])
    assert_tight(load(SelfAttentionBlock(16, heads=4), ops, "attn")(x), ops["attn.out"])
    assert_tight(load(ResidualBlock(16, 24, 12), ops, "resblock")(x, emb), ops["resblock.out"])
    assert_tight(LogSNREmbedding(16)(ops["sinusoid.in"]), ops["sinusoid.out"])


@pytest.mark.parametrize("width", [1, 2, 3, 16])
def test_convolution_wraps_in_width_and_pads_zeros_in_height(width):
    layer = Conv3x3(3, 5)
    x = torch.randn(2, 3, 4, width)
    padded = nn.functional.pad(torch.cat([x] * 3, dim=3), (0, 0, 1, 1))[..., width - 1 : 2 * width + 1]
    torch.testing.assert_close(layer(x), nn.functional.conv2d(padded, layer.weight, layer.bias))


def test_without_a_ring_the_width_ends_like_the_height():
    layer = Conv3x3(3, 5, ring=False)
    x = torch.randn(2, 3, 4, 16)
    torch.testing.assert_close(layer(x), nn.functional.conv2d(x, layer.weight, layer.bias, padding=1))


@pytest.mark.parametrize(("layer", "factor"), [(Downsample(), 0.5), (Upsample(), 2)])
def test_resampling_commutes_with_turning_the_ring(layer, factor):
    x = torch.randn(2, 3, 8, 16)
    torch.testing.assert_close(layer(x.roll(4, 3)), layer(x).roll(int(4 * factor), 3))


def test_resampling_keeps_a_constant_away_from_the_ends_of_the_height():
    ones = torch.ones(1, 2, 8, 16)
    torch.testing.assert_close(Downsample()(ones)[:, :, 1:-1], torch.ones(1, 2, 2, 8))
    torch.testing.assert_close(Upsample()(ones)[:, :, 1:-1], torch.ones(1, 2, 14, 32))
    # one of the taps 1, 3, 3, 1 looks beyond the end
    torch.testing.assert_close(Upsample()(ones)[:, :, 0], torch.full((1, 2, 32), 0.75))


def test_new_blocks_are_scaled_identities():
    x, emb = torch.randn(2, 16, 4, 8), torch.randn(2, 12)
    torch.testing.assert_close(ResidualBlock(16, 16, 12)(x, emb), x / 2**0.5)
    torch.testing.assert_close(SelfAttentionBlock(16)(x), x / 2**0.5)


def test_attention_equals_torch():
    """Same names, same initial shapes, same result as torch.nn.MultiheadAttention."""
    block = SelfAttentionBlock(16, heads=4)
    nn.init.normal_(block.attn.out_proj.weight)
    nn.init.normal_(block.attn.in_proj_bias)
    reference = nn.MultiheadAttention(16, 4, batch_first=True)
    reference.load_state_dict(block.attn.state_dict())
    tokens = torch.randn(2, 10, 16)
    torch.testing.assert_close(block.attn(tokens), reference(tokens, tokens, tokens)[0])


def test_attention_refuses_heads_that_do_not_divide():
    with pytest.raises(ValueError, match="attn_num_heads must divide 16 channels, got 5"):
        SelfAttentionBlock(16, heads=5)


def test_the_embedding_refuses_odd_widths():
    with pytest.raises(ValueError, match="even and at least 4, got 9"):
        LogSNREmbedding(9)


def test_weights_that_lie_column_by_column_do_so_once_loaded_copied_and_learned():
    usual, layer = nn.Linear(6, 10), ColumnLinear(6, 10)
    layer.load_state_dict(usual.state_dict())
    optimizer = torch.optim.AdamW(layer.parameters())
    x = torch.randn(24, 6)
    torch.testing.assert_close(layer(x), usual(x))
    for one in (layer, deepcopy(layer), deepcopy(layer).double(), ColumnLinear(6, 10, bias=False)):
        assert one.weight.shape == (10, 6) and one.weight.t().is_contiguous() and not one.weight.is_contiguous()
    layer(x).square().mean().backward()
    optimizer.step()
    assert layer.weight.t().is_contiguous() and not torch.equal(layer.weight, usual.weight)
