"""The IROS 2021 release of vanilla GAN and DUSty-I: its weights, through our networks."""

import pytest
import torch
from oracle import assert_close

from lidarsynth.networks.gan.dcgan import Discriminator, Generator
from lidarsynth.networks.gan.iros21 import discriminator_weights, generator_weights, uniform_noise
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


def test_other_networks_are_named(fixture_tensors):
    with pytest.raises(ValueError, match=r"one ray-drop logit per pixel \(DUSty-I\), found 2 \(DUSty-II\)"):
        generator_weights(weights(fixture_tensors("gan_iros21_dusty2"), "G_ema."))
    with pytest.raises(ValueError, match="expected a key of the IROS 2021 generator, found 'w_avg'"):
        generator_weights({"w_avg": torch.zeros(1)})
