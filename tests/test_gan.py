"""Vanilla GAN and DUSty v1: official weights, official sizes, ray-drop and the adversarial losses."""

import json
import math

import pytest
import torch
from oracle import assert_close, largest
from procedural_weights import gan_weights, procedural_uniform

from lidarsynth.networks.gan.dcgan import Discriminator, Generator
from lidarsynth.networks.gan.layers import HEIGHT, WIDTH, BlurVH, MinibatchStdDev, Pad, Resample
from lidarsynth.networks.gan.losses import (
    discriminator_loss,
    generator_loss,
    path_length_penalty,
    path_lengths,
    r1_penalty,
)
from lidarsynth.networks.gan.raydrop import relaxed_bernoulli

SMALL = ["gan_vanilla_small", "gan_dusty_v1_small"]
FULL = ["gan_vanilla_full", "gan_dusty_v1_full"]
TOLERANCE = {"atol": 2e-5, "rtol": 1e-4}


def load(net: torch.nn.Module, letter: str, facts: dict, tensors) -> torch.nn.Module:
    """The weights of G or D, stored in the fixture or computed, into `net`, strictly."""
    if facts["full_size"]:
        recipe = facts["procedural"]
        weights = gan_weights(net.state_dict(), recipe[f"{letter}_seed"], recipe["freq_tables"])
    else:
        prefix = {"G": "G_ema.", "D": "D."}[letter]
        weights = {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
    net.load_state_dict(weights, strict=True, assign=True)
    for parameter in net.parameters():
        parameter.requires_grad_()
    return net.eval()


def generator(reference, name: str, tensors) -> Generator:
    facts = json.loads((reference / "fixtures" / f"{name}.json").read_text())
    config = facts["config"]["generator"]["synthesis_kwargs"]
    resolution, widths = tuple(config["resolution"]), (config["ch_base"], config["ch_max"])
    net = Generator(resolution, config["in_ch"], *widths, raydrop="dusty" in name)
    return load(net, "G", facts, tensors)


def discriminator(reference, name: str, tensors) -> Discriminator:
    facts = json.loads((reference / "fixtures" / f"{name}.json").read_text())
    config = facts["config"]["discriminator"]["layer_kwargs"]
    net = Discriminator(tuple(config["resolution"]), config["ch_base"], config["ch_max"])
    return load(net, "D", facts, tensors)


def test_procedural_weights_are_the_stated_ones():
    expected = torch.tensor([0.3138620853, 0.8930457830, 0.0852542520])
    assert_close(torch.from_numpy(procedural_uniform("outc.conv.1.weight", 2110, 3)), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", SMALL + FULL)
def test_images_and_their_gradient_equal_the_reference(reference, fixture_tensors, name):
    expected = fixture_tensors(name)
    net = generator(reference, name, expected)
    uniform = expected.get("uniform")
    z = expected["z"].requires_grad_()
    out = net(z, uniform)
    for key in ("image", "image_orig", "raydrop_logit", "w"):
        if f"eval.{key}" in expected:
            assert_close(getattr(out, key).detach(), expected[f"eval.{key}"], **TOLERANCE)
    if uniform is None:
        assert out.raydrop_mask is None
    else:
        assert torch.equal(out.raydrop_mask.detach(), expected["eval.raydrop_mask"].float())
    (grad,) = torch.autograd.grad((out.image * expected["cotangent"]).sum(), z)
    assert (grad - expected["grad_z"]).abs().max() < 1e-5 * expected["grad_z"].abs().max()
    with torch.no_grad():
        truncated = net(expected["z"][:1], uniform if uniform is None else uniform[:1], psi=0.7)
    key = "trunc0.7.image" if uniform is None else "trunc0.7.image_orig"
    assert_close(truncated.image_orig, expected[key], **TOLERANCE)


@pytest.mark.parametrize("name", SMALL + FULL)
def test_discriminator_and_losses_equal_the_reference(reference, fixture_tensors, name):
    expected = fixture_tensors(name)
    check_discriminator(discriminator(reference, name, expected), expected)


def check_discriminator(net: torch.nn.Module, expected) -> None:
    images = expected["d_input"].requires_grad_()
    logits = net(images)
    assert_close(logits.detach(), expected["d_output"], **TOLERANCE)
    (grad,) = torch.autograd.grad(logits.sum(), images, retain_graph=True)
    assert_close(grad[:1], expected["r1_input_grad"], **TOLERANCE)
    # on some processors one activation rounds to the other side of a leaky ReLU's kink, which a few pixels feel
    kept = ~expected["r1_input_grad"].isnan()
    error, most = (grad[:1] - expected["r1_input_grad"])[kept].abs(), largest(expected["r1_input_grad"])
    assert error.max() < 5e-3 * most and error.quantile(0.9) < 1e-4 * most
    penalty = r1_penalty(logits, images)
    assert_close(penalty.detach(), expected["r1_penalty"], atol=0, rtol=1e-4)
    for key in (key for key in expected if key.startswith("r1_grad.")):
        (grad,) = torch.autograd.grad(penalty, net.get_parameter(key.removeprefix("r1_grad.")), retain_graph=True)
        assert (grad - expected[key]).abs().max() < 1e-4 * expected[key].abs().max(), key
    real = expected["d_output"]
    assert_close(discriminator_loss(real, 0.5 * real.flip(0)), expected["loss_D"], **TOLERANCE)
    assert_close(generator_loss(real), expected["loss_G"], **TOLERANCE)


@pytest.mark.parametrize("name", SMALL)
def test_a_training_step_averages_the_styles(reference, fixture_tensors, name):
    expected = fixture_tensors(name)
    net = generator(reference, name, expected).train()
    out = net(expected["z"], expected.get("uniform"))
    assert_close(out.image_orig.detach(), expected["train.image_orig"], **TOLERANCE)
    assert_close(net.w_avg, expected["train.w_avg_after"], **TOLERANCE)


@pytest.mark.parametrize(
    ("model", "raydrop", "count"), [("vanilla", False, 36_308_929), ("dusty_v1", True, 36_309_954)]
)
def test_names_shapes_and_counts_are_the_official_ones(reference, model, raydrop, count):
    with torch.device("meta"):
        nets = {"G": Generator(raydrop=raydrop), "D": Discriminator()}
    check_structure(reference, model, nets, {"G": count, "D": 2_821_057})


def check_structure(reference, model: str, nets: dict[str, torch.nn.Module], counts: dict[str, int]) -> None:
    """Names, shapes and parameter counts of G, D and A against the official ones; A is the same for all models."""
    table = json.loads((reference / "facts" / "gans_state_dict_shapes.json").read_text())
    for letter, net in nets.items():
        official = {
            key: tuple(entry["shape"])
            for key, entry in table["wacv23/A" if letter == "A" else f"wacv23/{model}.{letter}"].items()
        }
        assert {key: tuple(value.shape) for key, value in net.state_dict().items()} == official
        assert sum(parameter.numel() for parameter in net.parameters()) == counts[letter]


def test_ray_drop_keeps_pixels_with_the_probability_of_the_logit():
    uniform = torch.rand(1, 1, 200, 200, generator=torch.Generator().manual_seed(0))
    for logit in (-2.0, 0.0, 1.5):
        l = torch.full((1, 1, 200, 200), logit, requires_grad=True)
        mask = relaxed_bernoulli(l, uniform)
        p = 1 / (1 + math.exp(-logit))
        assert set(mask.unique().tolist()) <= {0.0, 1.0}
        assert abs(mask.mean().item() - p) < 4 * math.sqrt(p * (1 - p) / 40_000)
        assert torch.equal(mask > 0.5, l + uniform.logit() > 0)
        (slope,) = torch.autograd.grad(mask.sum(), l)
        soft = torch.sigmoid(logit + uniform.logit())
        assert_close(slope, soft * (1 - soft), atol=1e-5, rtol=1e-4)


def test_dropped_pixels_are_minus_one_and_the_noise_is_required():
    net = Generator((32, 64), 8, 4, 8, raydrop=True).eval()
    z = torch.randn(3, 8)
    out = net(z, torch.rand(1, 1, 32, 64))  # one noise map for all images, as the test script of the paper
    assert out.image.shape == (3, 1, 32, 64)
    assert bool((out.image[out.raydrop_mask == 0] == -1).all())
    assert_close(out.image[out.raydrop_mask == 1], out.image_orig[out.raydrop_mask == 1])
    with pytest.raises(ValueError, match=r"uniform must be .* got None"):
        net(z)
    with pytest.raises(ValueError, match=r"resolution must be multiples of 16, .* got \(60, 512\)"):
        Generator((60, 512))


def test_resampling_keeps_constants_and_turns_with_the_ring():
    x = torch.randn(2, 3, 8, 16)
    for layer, factor in ((Resample((1, 3, 3, 1), up=2), 2), (Resample((1, 3, 3, 1), down=2), 0.5), (BlurVH(), 1)):
        assert_close(layer(torch.ones_like(x)), torch.ones_like(layer(x)))
        turned = layer(x.roll(4, WIDTH))
        assert_close(turned, layer(x).roll(round(4 * factor), WIDTH))
    assert BlurVH()(x)[:, :3].ne(Resample((1, 2, 1), dims=(HEIGHT,))(x)).sum() == 0
    doubled = torch.nn.functional.interpolate(Pad(1)(x), scale_factor=2, mode="bilinear")[..., 2:-2, 2:-2]
    assert_close(Resample((1, 3, 3, 1), up=2)(x), doubled)  # 1-3-3-1 after zero insertion is bilinear
    with pytest.raises(ValueError, match="vertical padding must be"):
        Pad(1, "circular")


def test_minibatch_deviation_is_of_every_second_image_in_a_batch_of_eight():
    x = torch.randn(8, 2, 3, 4)
    out = MinibatchStdDev(4)(x)
    expected = torch.stack([x[i::2].std(0, correction=0).mean() for i in (0, 1)]).repeat(4)
    assert_close(out[:, 2], expected[:, None, None].expand(8, 3, 4))
    with pytest.raises(ValueError, match=r"batch must be a multiple of 4 .* got 6"):
        MinibatchStdDev(4)(torch.randn(6, 2, 3, 4))


def test_path_lengths_of_a_linear_generator_are_those_of_its_noise():
    w = torch.randn(3, 8 * 16, requires_grad=True)
    noise = torch.randn(3, 1, 8, 16)
    lengths = path_lengths(2 * w.view(3, 1, 8, 16), w, noise)
    assert_close(lengths, 2 * noise.flatten(1).norm(dim=1) / math.sqrt(8 * 16))
    penalty, mean = path_length_penalty(lengths, torch.tensor(1.0))
    assert_close(mean, 1 + 0.01 * (lengths.detach().mean() - 1))
    assert_close(penalty, (lengths - mean).square().mean())
