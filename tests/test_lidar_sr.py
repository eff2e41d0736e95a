"""LiDAR-SR: parity with both programs, Monte-Carlo dropout and the removal of uncertain pixels."""

import json

import pytest
import torch
from oracle import assert_close
from procedural_weights import procedural_uniform, upsampling_weights
from torch import Tensor

from lidarsynth.networks.lidar_sr import LidarSR, copy_measured, from_keras, from_official, mc_dropout, remove_uncertain

SMALL = {"lsr_4h1w_small": (4, 1), "lsr_8h2w_small": (8, 2)}
STAGES = ("up_scale", "down1", "down3", "downup", "up1", "up3")
PUBLISHED = {"lsr_4h_1w": (4, 1), "lsr_8h_2w": (8, 2), "lsr_16h_4w": (16, 4)}


def weights_of(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {key.removeprefix("state_dict."): value for key, value in tensors.items() if key.startswith("state_dict.")}


def official(tensors: dict[str, Tensor], name: str = "lsr") -> dict:
    return {"epoch": 1, "model": {"name": name, "args": {}, "state_dict": weights_of(tensors)}}


@torch.no_grad()
def assert_output_and_stages(network: LidarSR, expected: dict[str, Tensor]) -> None:
    stages = {}
    for name in STAGES:
        # forward goes through `downup` part by part: the last one has its output
        module = network.get_submodule("downup.2" if name == "downup" else name)
        module.register_forward_hook(lambda _module, _inputs, output, name=name: stages.update({name: output}))
    assert_close(network(expected["input"]), expected["output"], atol=1e-5, rtol=0)
    for name in STAGES:
        assert_close(stages[name][:1, :4], expected[f"inter.{name}"], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("fixture", "scale"), SMALL.items())
def test_the_small_networks_equal_the_reference(fixture_tensors, fixture, scale):
    expected = fixture_tensors(fixture)
    assert_output_and_stages(from_official(official(expected), scale), expected)


def test_the_published_width_equals_the_reference(fixture_tensors, reference):
    expected = fixture_tensors("lsr_4h1w_full")
    stated = json.loads((reference / "fixtures" / "lsr_4h1w_full.json").read_text())["procedural"]
    with torch.device("meta"):
        network = LidarSR()
    weights = upsampling_weights(network, stated["seed"])
    weights["outc.conv.1.bias"] = torch.tensor([stated["final_bias"]["outc.conv.1.bias"]])
    network.load_state_dict(weights, assign=True)
    assert_output_and_stages(network.eval(), expected)


def test_procedural_weights_are_those_of_the_readme():
    found = procedural_uniform("outc.conv.1.weight", 2110, 3)
    assert found.tolist() == pytest.approx([0.3138620853, 0.8930457830, 0.0852542520], abs=1e-9)


def test_the_keras_program_is_reproduced(fixture_tensors):
    stored = fixture_tensors("lsr_keras_small")
    order = {"kernel": 0, "bias": 1, "gamma": 0, "beta": 1, "moving_mean": 2, "moving_variance": 3}
    names = [key for key in stored if key.startswith("weights.")]
    names.sort(key=lambda key: (key.split(".")[1], order[key.split(".")[3]]))
    network = from_keras([stored[name] for name in names])
    with torch.no_grad():
        found = network(stored["input"].permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
    assert_close(found, stored["output"], atol=1e-5, rtol=0)


@pytest.mark.parametrize(("fixture", "scale"), SMALL.items())
@torch.no_grad()
def test_monte_carlo_passes_equal_the_reference(fixture_tensors, fixture, scale):
    expected = fixture_tensors(fixture)
    network = from_official(official(expected), scale)
    masks = [expected[f"mc.mask{index}"][:, :, None, None] for index in range(8)]
    outputs = network(expected["input"][:1].expand(len(masks[0]), -1, -1, -1), masks)
    assert_close(outputs, expected["mc.outputs"], atol=1e-5, rtol=0)
    torch.testing.assert_close(outputs.mean(0), expected["mc.mean"], atol=1e-5, rtol=0)
    torch.testing.assert_close(outputs.std(0, correction=0), expected["mc.std"], atol=1e-5, rtol=0)


@pytest.mark.parametrize("fixture", SMALL)
def test_the_removal_rule_equals_the_reference(fixture_tensors, fixture):
    expected = fixture_tensors(fixture)
    assert torch.equal(remove_uncertain(expected["filter.mean"], expected["filter.std"]), expected["filter.output"])
    filtered = remove_uncertain(expected["mc.mean"], expected["mc.std"])
    assert torch.equal(filtered, expected["mc.filtered"])
    if "mc.filtered_copied" in expected:
        assert torch.equal(copy_measured(filtered, expected["input"][0]), expected["mc.filtered_copied"])


@pytest.mark.parametrize(("fixture", "scale"), SMALL.items())
def test_training_equals_the_reference(fixture_tensors, fixture, scale):
    expected = fixture_tensors(fixture)
    network = LidarSR(scale, len(expected["state_dict.up_scale.conv.0.up_block.0.bias"]), dropout=0.0).train()
    network.load_state_dict(weights_of(expected))
    output = network(expected["input"])
    loss = ((2 * output - 1) - (2 * expected["train.target"] - 1)).abs().mean()
    loss.backward()
    # Batch statistics amplify rounding: float64 is 1.1e-5 from the stored float32, which puts some ReLUs of the first
    # layers on the other side of their kink, as other processors' float32 does (AVX2 as stored, AVX-512 as float64).
    assert_close(output, expected["train.output"], atol=2e-5, rtol=0)
    torch.testing.assert_close(loss, expected["train.loss"])
    gradients = {key: value for key, value in expected.items() if key.startswith("train.grad.")}
    assert len(gradients) == 2
    for key, gradient in gradients.items():
        found = network.get_parameter(key.removeprefix("train.grad.")).grad
        share = 0.05 if key.startswith("train.grad.up_scale") else 1e-4
        torch.testing.assert_close(found, gradient, atol=share * gradient.abs().max().item(), rtol=0)


@pytest.mark.parametrize(("name", "scale"), PUBLISHED.items())
def test_names_and_shapes_are_the_published_ones(reference, name, scale):
    facts = json.loads((reference / "facts" / "upsampling_state_dict_shapes.json").read_text())[name]
    with torch.device("meta"):
        network = LidarSR(scale)
    found = [(key, list(value.shape)) for key, value in network.state_dict().items()]
    assert found == [(key, entry["shape"]) for key, entry in facts.items()]


@pytest.mark.parametrize("keras", [False, True])
def test_the_count_is_the_published_one_in_both_programs(keras):
    with torch.device("meta"):
        network = LidarSR(keras=keras)
    assert sum(parameter.numel() for parameter in network.parameters()) == 34_600_001


def test_the_keras_layers_are_the_published_ones(reference):
    layers = json.loads((reference / "facts" / "lsr_keras_layers.json").read_text())["layers"]
    expected = [shape for _, _, weights in layers for _, shape in weights]
    with torch.device("meta"):
        state = LidarSR(keras=True).state_dict()
    own = [list(value.shape) for key, value in state.items() if not key.endswith("num_batches_tracked")]
    assert [[s[2], s[3], s[1], s[0]] if len(s) == 4 else s for s in own] == expected


@pytest.mark.parametrize("keras", [False, True])
def test_monte_carlo_dropout_is_random_by_its_generator_only(keras):
    torch.manual_seed(0)
    network, low = LidarSR(width=4, keras=keras).eval(), torch.rand(2, 1, 4, 16)
    mean, std = mc_dropout(network, low, torch.Generator().manual_seed(1), passes=4)
    again = mc_dropout(network, low, torch.Generator().manual_seed(1), passes=4)
    assert mean.shape == std.shape == (2, 1, 16, 16)
    assert torch.equal(mean, again[0]) and torch.equal(std, again[1]) and std.max() > 0
    with torch.no_grad():
        assert torch.equal(network(low), network(low))
    shapes = {tuple(mask.shape[2:]) for mask in network.draw_masks(low, torch.Generator())}
    assert shapes == ({(8, 8), (4, 4), (2, 2), (1, 1)} if keras else {(1, 1)})
    kept = torch.cat([network.draw_masks(low.expand(2, 1, 4, 16), torch.Generator())[4].flatten() for _ in range(40)])
    assert 0.6 < kept.float().mean() < 0.9


def test_without_dropout_no_pixel_is_uncertain():
    network, low = LidarSR(width=2, dropout=0.0).eval(), torch.rand(1, 1, 4, 16)
    mean, std = mc_dropout(network, low, torch.Generator(), passes=3)
    torch.testing.assert_close(std, torch.zeros_like(std), atol=1e-6, rtol=0)
    with torch.no_grad():
        torch.testing.assert_close(mean, network(low))


def test_errors_say_both_sides(fixture_tensors):
    network = LidarSR(width=2)
    with pytest.raises(ValueError, match=r"low must be \(B, 1, h, w\), got \(1, 2, 4, 16\)"):
        network(torch.zeros(1, 2, 4, 16))
    with pytest.raises(ValueError, match="divisible by 16, got 16 x 24"):
        network(torch.zeros(1, 1, 4, 24))
    with pytest.raises(ValueError, match="keep must be 8 masks, one per dropout, got 1"):
        network(torch.zeros(1, 1, 4, 16), [torch.ones(1)])
    with pytest.raises(ValueError, match=r"two powers of 2, the second at most the first, got \(2, 4\)"):
        LidarSR((2, 4))
    with pytest.raises(ValueError, match="evaluation mode and at least 1 pass, got training mode and 50"):
        mc_dropout(network, torch.zeros(1, 1, 4, 16), torch.Generator())
    with pytest.raises(ValueError, match=r"a multiple of 4 rows of 8, got \(6, 8\)"):
        copy_measured(torch.zeros(6, 8), torch.zeros(4, 8))
    stored = fixture_tensors("lsr_4h1w_small")
    with pytest.raises(ValueError, match="checkpoint of 'lsr' in the format of ILN's repository, found one of 'iln'"):
        from_official(official(stored, "iln"))
    with pytest.raises(ValueError, match=r"found a dict with keys \['weights'\]"):
        from_official({"weights": 1})
    with pytest.raises(ValueError, match=r"tensors do not fit LidarSR"):
        from_official(official(stored), (8, 2))
    with pytest.raises(ValueError, match="expected 146 tensors of Keras' LiDAR-SR, found 1"):
        from_keras([torch.zeros(3, 3, 4, 1)])
