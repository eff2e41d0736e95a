"""The IROS 2021 release of vanilla GAN, DUSty-I and DUSty-II: its weights, through our networks."""

import pytest
import torch
from oracle import assert_close

from lidarsynth.networks.gan.dcgan import Discriminator, Generator
from lidarsynth.networks.gan.iros21 import discriminator_weights, generator_weights, masks, uniform_noise
from lidarsynth.networks.gan.losses import r1_penalty

TOLERANCE = {"atol": 1e-5, "rtol": 1e-5}


def weights(tensors, prefix: str) -> dict[str, torch.Tensor]:
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}


@pytest.mark.parametrize(("name", "raydrop"), [("gan_iros21_vanilla", False), ("gan_iros21_dusty1", True)])
def test_generator_equals_the_reference(fixture_tensors, name, raydrop):
    expected = fixture_tensors(name)
    net = Generator((64, 128), 16, 4, 16, raydrop, bounded=True).eval()
    net.load_state_dict(generator_weights(weights(expected, "G_ema.")), strict=True)
    uniform = uniform_noise(expected["uniform0.u1"], expected["uniform0.u2"]) if raydrop else None
    z = expected["z"].requires_grad_()
    out = net(z, uniform)
    assert_close(out.image.detach(), expected["eval.depth"], **TOLERANCE)
    if raydrop:
        assert_close(out.image_orig.detach(), expected["eval.depth_orig"], **TOLERANCE)
        assert_close(out.raydrop_logit.detach(), expected["eval.confidence"], **TOLERANCE)
        assert_close(out.raydrop_mask.detach(), expected["eval.mask"], **TOLERANCE)
    (grad,) = torch.autograd.grad((out.image * expected["cotangent"]).sum(), z)
    assert (grad - expected["grad_z"]).abs().max() < 1e-5 * expected["grad_z"].abs().max()


@pytest.mark.parametrize("name", ["gan_iros21_vanilla", "gan_iros21_dusty1", "gan_iros21_dusty2"])
def test_discriminator_equals_the_reference(fixture_tensors, name):
    expected = fixture_tensors(name)
    net = Discriminator((64, 128), 4, 16, vertical="reflect").eval()
    net.load_state_dict(discriminator_weights(weights(expected, "D.")), strict=True)
    images = expected["d_input"].requires_grad_()
    logits = net(images)
    assert_close(logits.detach(), expected["d_output"], **TOLERANCE)
    (grad,) = torch.autograd.grad(logits.sum(), images, retain_graph=True)
    assert_close(grad[:1], expected["r1_input_grad"], **TOLERANCE)
    assert_close(r1_penalty(logits, images).detach(), expected["r1_penalty"], atol=0, rtol=1e-4)


def dusty2(tensors) -> tuple[Generator, torch.Tensor]:
    """DUSty-II of the fixture, in training mode, and the noise of its pixels and, all over the second map, images."""
    net = Generator((64, 128), 16, 4, 16, raydrop=True, bounded=True, image_mask=True)
    net.load_state_dict(generator_weights(weights(tensors, "G_ema.")), strict=True)
    noise = [uniform_noise(tensors[f"uniform{i}.u1"], tensors[f"uniform{i}.u2"]) for i in (0, 1)]
    return net, torch.cat([noise[0], noise[1].expand_as(noise[0])], dim=1)


@torch.no_grad()
def test_dusty2_drops_by_two_masks_as_the_reference(fixture_tensors):
    expected = fixture_tensors("gan_iros21_dusty2")
    net, noise = dusty2(expected)
    for part, uniform in (("train", noise), ("eval", noise[:, :1]), ("eval", noise)):
        out = net.train(part == "train")(expected["z"], uniform)
        assert_close(out.image, expected[f"{part}.depth"], **TOLERANCE)
        assert_close(out.image_orig, expected["eval.depth_orig"], **TOLERANCE)
        assert_close(out.raydrop_logit, expected[f"{part}.confidence"], **TOLERANCE)
        assert_close(out.raydrop_mask, expected[f"{part}.mask"], **TOLERANCE)
        assert 0 < out.raydrop_mask[:, 1].mean() < 1, "the second mask drops something, and not all"
    assert (expected["train.mask"] != expected["eval.mask"])[:, 1].any(), "only training draws the second"


def test_dusty2_s_gradient_equals_the_reference(fixture_tensors):
    expected = fixture_tensors("gan_iros21_dusty2")
    net, noise = dusty2(expected)
    z = expected["z"].requires_grad_()
    (grad,) = torch.autograd.grad((net(z, noise).image * expected["cotangent"]).sum(), z)
    assert (grad - expected["grad_z"]).abs().max() < 1e-5 * expected["grad_z"].abs().max()
    with pytest.raises(ValueError, match=r"\(B, 2, H, W\), to train DUSty-II, got \(2, 1, 64, 128\)"):
        net(z, noise[:, :1])


def test_masks_are_counted_and_other_networks_named(fixture_tensors):
    for name, count in (("vanilla", 0), ("dusty1", 1), ("dusty2", 2)):
        assert masks(generator_weights(weights(fixture_tensors(f"gan_iros21_{name}"), "G_ema."))) == count
    with pytest.raises(ValueError, match=r"1 ray-drop logit per pixel \(DUSty-I\) or 2 \(DUSty-II\), found \(3,\)"):
        masks({"synthesis_network.4.heads.raydrop_logit.1.module.bias": torch.zeros(3)})
    with pytest.raises(ValueError, match="expected a key of the IROS 2021 generator, found 'w_avg'"):
        generator_weights({"w_avg": torch.zeros(1)})
    with pytest.raises(ValueError, match="image_mask must be off without raydrop, got True"):
        Generator((64, 128), 16, 4, 16, image_mask=True)
