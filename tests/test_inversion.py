"""GAN inversion: its losses and steps equal the reference, and it finds the latent of an image; depth conversions."""

import copy
import math

import pytest
import torch
from oracle import assert_close

from lidarsynth.networks.gan.dcgan import Generator
from lidarsynth.networks.gan.inverse_depth import to_depth, to_inverse_depth, to_points
from lidarsynth.networks.gan.inversion import (
    geocross,
    invert,
    learning_rate_factor,
    multiscale_loss,
    squared_distance,
    tune,
    unit_rms,
)

LIMITS = (1.45, 80.0)
TOLERANCE = {"atol": 1e-5, "rtol": 0.0}


def test_losses_equal_the_reference(fixture_tensors):
    expected = fixture_tensors("gan_inversion")
    generated, reference, mask = (expected[key] for key in ("gen", "ref", "mask"))
    for levels in (1, 2, 3):
        loss = multiscale_loss(generated, reference, mask, levels)
        assert_close(loss, expected[f"loss_level{levels}_relative"], **TOLERANCE)
    squared = multiscale_loss(generated, reference, mask, 2, squared_distance)
    assert_close(squared, expected["loss_level2_mse_nonrel"], **TOLERANCE)
    assert_close(geocross(expected["latents"]), expected["geocross"], **TOLERANCE)
    generated.requires_grad_()
    (grad,) = torch.autograd.grad(multiscale_loss(generated, reference, mask).sum(), generated)
    assert_close(grad, expected["loss_level2_relative.grad"], atol=1e-8, rtol=1e-5)
    with pytest.raises(ValueError, match="must have one shape"):
        multiscale_loss(generated, reference, mask[:1])


def test_latent_steps_and_learning_rates_equal_the_reference(fixture_tensors):
    expected = fixture_tensors("gan_inversion")
    factors = torch.tensor([learning_rate_factor(step / 500) for step in range(501)])
    assert_close(factors, expected["lr_schedule_500"], **TOLERANCE)
    latents = expected["sph.param0"].requires_grad_()
    optimizer = torch.optim.Adam([latents], lr=0.05)
    for grad, after in zip(expected["sph.grads"], expected["sph.params"], strict=True):
        latents.grad = grad
        optimizer.step()
        with torch.no_grad():
            latents.copy_(unit_rms(latents))
        assert_close(latents.detach(), after, **TOLERANCE)


def test_inversion_and_tuning_reach_an_image_of_the_generator():
    generator = torch.Generator().manual_seed(0)
    net = Generator((32, 64), 8, 4, 16).eval()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
        net.synthesis_network[-1].heads["image"][1].module.weight.mul_(0.3)
        target = unit_rms(torch.randn(2, 8, generator=generator))
        reference = ((net(target).image + 1) / 2).clamp(0.05, 0.95)
    mask = (torch.rand(reference.shape, generator=generator) < 0.5).float()
    start = unit_rms(torch.randn(2, 8, generator=generator))
    render = lambda z: net.synthesize(z).image_orig  # noqa: E731
    fits = list(invert(render, start, reference, mask, LIMITS, steps=60, learning_rate=0.1, project=unit_rms))
    assert [fit.step for fit in fits] == list(range(61))
    assert torch.equal(fits[0].latents, start)
    assert bool((fits[-1].loss < 0.5 * fits[0].loss).all())
    assert_close(fits[-1].latents.square().mean(1), torch.ones(2))
    tuned = copy.deepcopy(net)
    render = lambda z: tuned.synthesize(z).image_orig  # noqa: E731
    tunes = list(tune(tuned, render, start, reference, mask, LIMITS, steps=30, learning_rate=0.005))
    assert_close(tunes[0].loss, fits[0].loss)
    assert torch.equal(tunes[-1].latents, start)
    assert tunes[-1].loss.sum() < 0.8 * tunes[0].loss.sum()


def test_an_inversion_follows_the_schedule_of_learning_rates(monkeypatch: pytest.MonkeyPatch):
    rates = []

    class Recorded(torch.optim.Adam):
        def step(self, *arguments):
            rates.append(self.param_groups[0]["lr"])
            return super().step(*arguments)

    monkeypatch.setattr(torch.optim, "Adam", Recorded)
    reference, mask = torch.full((2, 1, 8, 16), 0.5), torch.ones(2, 1, 8, 16)
    list(invert(lambda z: z.expand(2, 1, 8, 16), torch.zeros(2, 1, 1, 1), reference, mask, LIMITS, 10, 0.1))
    assert rates == pytest.approx([0.1 * learning_rate_factor(step / 10) for step in range(10)])
    assert rates[0] < max(rates) == pytest.approx(0.1) and rates[-1] < 0.1


def test_depth_conversions_equal_the_reference(fixture_tensors):
    expected = fixture_tensors("gan_coords")
    inverse = to_inverse_depth(expected["depth"], *LIMITS)
    assert_close(inverse, expected["depth_to_inv_depth_norm"], **TOLERANCE)
    assert_close(inverse / LIMITS[0], expected["depth_to_inv_depth"], **TOLERANCE)
    depth = to_depth(expected["inv_depth_norm"], *LIMITS)
    assert_close(depth, expected["inv_depth_norm_to_depth"], atol=0, rtol=1e-5)
    angles = expected["angle_64x512"]
    assert_close(to_points(expected["depth"], angles)[:, :, ::8], expected["depth_to_point_map"], atol=1e-4, rtol=0)
    points = to_points(depth, angles).flatten(2).transpose(1, 2)[:, ::8]
    assert_close(points, expected["inv_depth_norm_to_point_set"], atol=1e-4, rtol=0)


def test_depth_and_its_inverse_undo_each_other_inside_the_limits():
    depth = torch.tensor([0.0, 1.4, 1.46, 10.0, 79.9, 80.1, 200.0])
    assert_close(to_depth(to_inverse_depth(depth, *LIMITS), *LIMITS), depth * torch.tensor([0, 0, 1, 1, 1, 0, 0]))
    ahead = to_points(torch.full((1, 1, 1, 1), 2.0), torch.tensor([math.pi / 6, math.pi / 2]).view(1, 2, 1, 1))
    assert_close(ahead.flatten(), torch.tensor([0, math.sqrt(3), 1.0]), atol=1e-6, rtol=0)
