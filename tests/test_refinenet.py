"""LiDARGen's RefineNet: parity of layers, network and checkpoint, and the two scales of its images."""

import json
import math

import pytest
import torch
from oracle import assert_within
from torch import Tensor, nn

from lidarsynth.networks.refinenet import (
    ChainedPooling,
    ConvMeanPool,
    InstanceNormPlus,
    RefineBlock,
    RefineNet,
    ResidualBlock,
    ResidualConvUnits,
    conv3x3,
    from_official,
    geometric_sigmas,
)


def load(layer: nn.Module, tensors: dict[str, Tensor], prefix: str) -> nn.Module:
    stored = {key.removeprefix(f"{prefix}."): value for key, value in tensors.items() if key.startswith(f"{prefix}.")}
    stored.pop("out")
    layer.load_state_dict(stored)
    return layer.requires_grad_(False)


@pytest.fixture(scope="module")
def checkpoint(official_file):
    return torch.load(official_file("lidargen/checkpoint_100.pth"), weights_only=True)


@pytest.fixture
def io(fixture_tensors):
    return fixture_tensors("lidargen/io")


def log_snr_of(io: dict[str, Tensor]) -> Tensor:
    return -2 * io["sigmas"][io["labels"].long()].log()


@pytest.mark.parametrize(
    ("name", "layer"),
    [
        ("instance_norm_plus", lambda: InstanceNormPlus(6)),
        ("conv3x3_circular", lambda: conv3x3(6, 5)),
        ("conv_mean_pool", lambda: ConvMeanPool(6, 5)),
        ("res_same", lambda: ResidualBlock(6, 6)),
        ("res_down", lambda: ResidualBlock(6, 8, down=True)),
        ("res_down_dil2", lambda: ResidualBlock(6, 6, down=True, dilation=2)),
        ("crp", lambda: ChainedPooling(6)),
        ("rcu", lambda: ResidualConvUnits(6, blocks=2)),
    ],
)
def test_layers_equal_the_reference(fixture_tensors, name, layer):
    tensors = fixture_tensors("lidargen/layers")
    assert_within(load(layer(), tensors, name)(tensors["x"]), tensors[f"{name}.out"], 1e-5)


def test_dilation_and_refinement_equal_the_reference(fixture_tensors):
    tensors = fixture_tensors("lidargen/layers")
    dilated = load(conv3x3(6, 5, dilation=4), tensors, "dilated4_circular")
    assert_within(dilated(torch.cat([tensors["x"]] * 2, dim=2)), tensors["dilated4_circular.out"], 1e-5)
    refine = load(RefineBlock((6, 4), 5), tensors, "refine")
    assert_within(refine(tensors["x"], tensors["y"]), tensors["refine.out"], 1e-5)


@torch.no_grad()
def test_the_score_and_every_stage_equal_the_reference(checkpoint, io):
    network, stages = from_official(checkpoint), {}
    for name, module in network.named_children():
        module.register_forward_hook(lambda _module, _inputs, output, name=name: stages.update({name: output[:1]}))
    score = network(io["input"], log_snr_of(io))
    assert_within(score, io["score"], 1e-4)
    sigma = io["sigmas"][io["labels"].long()].view(-1, 1, 1, 1)
    assert_within(score * sigma, io["score_times_sigma"], 1e-4)
    inner = {key.removeprefix("inter."): value for key, value in io.items() if key.startswith("inter.")}
    assert len(inner) == 10
    for name, expected in inner.items():
        assert_within(stages[name], expected, 1e-4)


@torch.no_grad()
def test_the_raw_weights_are_in_the_checkpoint_too(checkpoint, io):
    if "score_online_weights" not in io:
        pytest.skip("tests/oracles has one set of LiDARGen's weights")
    assert_within(from_official(checkpoint, ema=False)(io["input"], log_snr_of(io)), io["score_online_weights"], 1e-4)


@torch.no_grad()
def test_images_between_minus_one_and_one_are_the_same_model_at_twice_the_sigma(checkpoint, io):
    ours = from_official(checkpoint, unit_range=False)
    score = ours(2 * io["input"] - 1, log_snr_of(io) - 2 * math.log(2))
    assert_within(score, io["score"] / 2, 1e-4)


@torch.no_grad()
def test_without_division_the_noise_level_does_not_matter(checkpoint, io):
    network = RefineNet(base_channels=8, divide=False).eval()
    network.load_state_dict(from_official(checkpoint).state_dict())
    assert_within(network(io["input"], torch.zeros(3)), io["score_times_sigma"], 1e-4)


def test_names_shapes_order_and_count_are_the_published_ones(reference):
    facts = json.loads((reference / "facts" / "lidargen_state_dict.json").read_text())
    with torch.device("meta"):
        network = RefineNet()
    assert sum(parameter.numel() for parameter in network.parameters()) == 29_694_082 == facts["n_params"]
    assert [(key, list(value.shape)) for key, value in network.state_dict().items()] == list(facts["model"].items())


def test_the_official_optimizer_state_fits(shared):
    checkpoint = torch.load(shared / "fixtures/lidargen/checkpoint_100.pth", weights_only=True)
    network = from_official(checkpoint, ema=False)
    optimizer = torch.optim.Adam(network.parameters())
    optimizer.load_state_dict(checkpoint[1])
    for parameter, state in optimizer.state.items():
        assert state["exp_avg"].shape == parameter.shape
    assert len(optimizer.state) == len(list(network.parameters()))


def test_noise_levels_equal_the_reference(io, checkpoint):
    assert_within(geometric_sigmas(), io["sigmas"], 1e-7)
    torch.testing.assert_close(from_official(checkpoint).sigmas, io["sigmas"], atol=0, rtol=0)
    ratios = geometric_sigmas()[1:] / geometric_sigmas()[:-1]
    torch.testing.assert_close(ratios, torch.full_like(ratios, 0.963800), atol=1e-6, rtol=0)


def test_the_loss_falls_and_every_parameter_learns():
    torch.manual_seed(0)
    network = RefineNet(base_channels=4, unit_range=False)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    eps = torch.randn(2, 2, 8, 16)
    losses = []
    for _ in range(8):
        loss = (network(0.5 * eps, torch.zeros(2)) + eps).square().mean()
        optimizer.zero_grad()
        loss.backward()
        assert all(parameter.grad is not None for parameter in network.parameters())
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.7 * losses[0]


def test_errors_say_both_sides(checkpoint):
    network = RefineNet(base_channels=4)
    with pytest.raises(ValueError, match=r"x_t must be \(B, 2, H, W\), got \(1, 3, 8, 16\)"):
        network(torch.zeros(1, 3, 8, 16), torch.zeros(1))
    with pytest.raises(ValueError, match="even and at least 8, got 8 x 15"):
        network(torch.zeros(1, 2, 8, 15), torch.zeros(1))
    with pytest.raises(ValueError, match=r"LiDARGen's list \[model, optimizer, epoch, step, ema\], found a dict of 1"):
        from_official({"weights": 1})
    with pytest.raises(ValueError, match="with tensors by name, found a int"):
        from_official([1, 2, 3, 4, 5])
    with pytest.raises(ValueError, match=r"begin_conv.weight and sigmas, found \['conv1.weight'\]"):
        from_official([{"module.conv1.weight": torch.zeros(1)}, {}, 0, 0])
    cut = [{key: value for key, value in checkpoint[0].items() if "refine4" not in key}, {}, 0, 0]
    with pytest.raises(ValueError, match=r"\(8, 8, 3, 3\), found none; 20 tensors do not fit"):
        from_official(cut)
