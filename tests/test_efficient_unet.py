"""R2DM's U-Net: official weights, official sizes, and the ring."""

import json
from pathlib import Path

import pytest
import torch
from oracle import assert_close

from lidarsynth.networks.efficient_unet import EfficientUNet

SMALL = {
    "resolution": (16, 64),
    "base_channels": 8,
    "channel_multipliers": (1, 1, 2, 2),
    "num_residual_blocks": [1] * 4,
}


def randomised(net: EfficientUNet, seed: int = 0) -> EfficientUNet:
    """No zero-initialised layer is left, so that every path counts."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=generator) * 0.1)
    return net.eval()


def official(path: Path, weights: str) -> EfficientUNet:
    checkpoint = torch.load(path, weights_only=True)
    cfg = checkpoint["cfg"]["model"]
    net = EfficientUNet(
        resolution=tuple(checkpoint["cfg"]["data"]["resolution"]),
        base_channels=cfg["base_channels"],
        temb_channels=cfg["temb_channels"],
        channel_multipliers=cfg["channel_multiplier"],
        num_residual_blocks=cfg["num_residual_blocks"],
        gn_num_groups=cfg["gn_num_groups"],
        gn_eps=cfg["gn_eps"],
        attn_num_heads=cfg["attn_num_heads"],
        coords_encoding=cfg["coords_encoding"],
        dropout=cfg["dropout"],
    )
    state = {key.removeprefix("model."): value for key, value in checkpoint[weights].items() if key != "_dummy"}
    net.load_state_dict(state, strict=True)
    return net.eval().requires_grad_(False)


@pytest.mark.parametrize("name", ["config_A", "config_F", "config_G", "config_H", "tiny_H"])
def test_outputs_equal_the_reference(official_file, fixture_tensors, name):
    expected = fixture_tensors(f"r2dm/{name}_io")
    net = official(official_file(f"r2dm/{name}.pth"), "ema_weights")
    torch.testing.assert_close(net.coords, expected["coords"], atol=0, rtol=0)
    inner = {key.removeprefix("inter."): value for key, value in expected.items() if key.startswith("inter.")}
    inner["time_embedding.0"] = inner.pop("time_sinusoid")
    inner |= {"coords_encoding": expected["coords_encoding"]} if "coords_encoding" in expected else {}
    seen = {}
    for path in inner:
        net.get_submodule(path).register_forward_hook(lambda _, __, output, path=path: seen.update({path: output}))
    output = net(expected["input"], expected["log_snr"])
    assert_close(output, expected["output"], atol=1e-4, rtol=0)
    for path, value in inner.items():  # large maps are stored for sample 0 only
        assert_close(seen[path][: len(value)], value, atol=1e-4, rtol=0)


def test_online_weights_give_another_output(shared, fixture_tensors):
    expected = fixture_tensors("r2dm/config_H_io")
    output = official(shared / "fixtures/r2dm/config_H.pth", "weights")(expected["input"], expected["log_snr"])
    torch.testing.assert_close(output, expected["output_online_weights"], atol=1e-4, rtol=0)
    assert (output - expected["output"]).abs().max() > 1e-2


@pytest.mark.parametrize(
    ("encoding", "width", "count"),
    [
        ("polar_coordinates", 1024, 31_082_370),
        (None, 1024, 31_081_218),
        ("spherical_harmonics", 1024, 31_095_618),
        ("fourier_features", 1024, 31_099_650),
        ("fourier_features", 512, 31_098_498),
    ],
)
def test_parameter_counts_are_the_official_ones(encoding, width, count):
    with torch.device("meta"):
        net = EfficientUNet(resolution=(64, width), coords_encoding=encoding)
    assert sum(parameter.numel() for parameter in net.parameters()) == count


def test_keys_and_shapes_are_the_official_ones(reference):
    with torch.device("meta"):
        net = EfficientUNet()
    official_shapes = json.loads((reference / "facts" / "r2dm_H_state_dict.json").read_text())
    official_shapes.pop("_dummy")
    assert {f"model.{key}": list(value.shape) for key, value in net.state_dict().items()} == official_shapes


@pytest.mark.parametrize("stem", [(1, 1), (2, 2)])
@pytest.mark.parametrize("encoding", ["fourier_features", None])
@torch.no_grad()
def test_turning_input_and_coordinates_turns_the_output(stem, encoding):
    """Exact for multiples of 8 (three halvings) times the stem's width; other shifts change the sampling phase."""
    net = randomised(EfficientUNet(**SMALL, stem=stem, coords_encoding=encoding))
    x_t, log_snr = torch.randn(2, 2, 16, 64), torch.tensor([3.0, -4.0])
    expected = net(x_t, log_snr)
    shift = 8 * stem[1]
    net.coords = net.coords.roll(shift, 3)
    torch.testing.assert_close(net(x_t.roll(shift, 3), log_snr), expected.roll(shift, 3), atol=1e-4, rtol=0)
    net.coords = net.coords.roll(1 - shift, 3)
    assert (net(x_t.roll(1, 3), log_snr) - expected.roll(1, 3)).abs().max() > 1e-3


@torch.no_grad()
def test_coordinates_matter_and_without_a_ring_the_seam_shows():
    x_t, log_snr = torch.randn(1, 2, 16, 64), torch.tensor(0.0)
    net = randomised(EfficientUNet(**SMALL))
    assert (net(x_t.roll(8, 3), log_snr) - net(x_t, log_snr).roll(8, 3)).abs().max() > 1e-3
    cut = randomised(EfficientUNet(**SMALL, ring=False, coords_encoding=None))
    assert (cut(x_t.roll(8, 3), log_snr) - cut(x_t, log_snr).roll(8, 3)).abs().max() > 1e-3


@torch.no_grad()
def test_one_log_snr_serves_the_whole_batch_and_samples_are_independent():
    net = randomised(EfficientUNet(**SMALL))
    x_t = torch.randn(3, 2, 16, 64)
    together = net(x_t, torch.tensor(1.5))
    torch.testing.assert_close(together, net(x_t, torch.full((3,), 1.5)))
    torch.testing.assert_close(together[1:2], net(x_t[1:2], torch.tensor([1.5])), atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_a_network_of_doubles_says_the_same():
    net, x_t = randomised(EfficientUNet(**SMALL)), torch.randn(2, 2, 16, 64)
    single, log_snr = net(x_t, torch.tensor([1.5, -3.0])), torch.tensor([1.5, -3.0], dtype=torch.float64)
    torch.testing.assert_close(net(x_t, log_snr), single)  # times of samplers are double
    torch.testing.assert_close(net.double()(x_t.double(), log_snr).float(), single, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("stem", [(1, 1), (2, 4)])
def test_a_new_network_returns_zero_and_all_of_it_learns(stem):
    net = EfficientUNet(resolution=(16, 64), base_channels=8, num_residual_blocks=[1] * 4, stem=stem, out_channels=3)
    output = net(torch.randn(2, 2, 16, 64), torch.zeros(2))
    torch.testing.assert_close(output, torch.zeros(2, 3, 16, 64))
    randomised(net)(torch.randn(2, 2, 16, 64), torch.zeros(2)).square().sum().backward()
    assert all(parameter.grad.abs().max() > 0 for parameter in net.parameters())


def test_the_stem_reduces_the_fourier_frequencies():
    with torch.device("meta"):
        assert EfficientUNet(stem=(2, 4)).coords_encoding.channels == 2 * (5 + 8)


@pytest.mark.parametrize("resolution", [(40, 200), (8, 8), (16, 16)])
@torch.no_grad()
def test_any_size_divisible_by_8_works(resolution):
    net = randomised(EfficientUNet(**{**SMALL, "resolution": resolution}))
    assert net(torch.randn(1, 2, *resolution), torch.tensor(0.0)).shape == (1, 2, *resolution)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"resolution": (60, 1024)}, r"height must be divisible by 8 \(8 x stem 1\), got 60"),
        ({"resolution": (64, 1000), "stem": (2, 4)}, r"width must be divisible by 32 \(8 x stem 4\), got 1000"),
        ({"base_channels": 12}, r"gn_num_groups must divide all level widths .* got 8"),
        ({"attn_num_heads": 7}, "attn_num_heads must divide .* got 7"),
        ({"num_residual_blocks": (1, 1)}, r"num_residual_blocks must be 4 positive integers, got \(1, 1\)"),
        ({"channel_multipliers": (1, 2, 0, 4)}, "channel_multipliers must be 4 positive integers"),
        ({"coords_encoding": "fourier"}, "coords_encoding must be one of"),
    ],
)
def test_impossible_structures_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        EfficientUNet(**{**SMALL, **change})


def test_impossible_inputs_are_refused():
    net = EfficientUNet(**SMALL)
    with pytest.raises(ValueError, match=r"x_t must be \(B, 2, 16, 64\), got \(1, 3, 16, 64\)"):
        net(torch.zeros(1, 3, 16, 64), torch.tensor(0.0))
    with pytest.raises(ValueError, match=r"log_snr must be \(\) or \(2,\), got \(3,\)"):
        net(torch.zeros(2, 2, 16, 64), torch.zeros(3))
