"""Adaptive augmentation: given matrices, the controller of its probability, and what its draws may be."""

import math

import pytest
import torch
from oracle import assert_close
from test_gan import check_structure

from lidarsynth.networks.gan.adaptive_augmentation import (
    SYM2,
    SYM6,
    AdaptiveAugmentation,
    Dice,
    octave_filters,
    random_affine,
    random_colour,
    roll_dice,
    transform_colour,
    transform_geometry,
)
from lidarsynth.networks.gan.dusty2 import Discriminator
from lidarsynth.networks.gan.grid_sampling import sample_bilinear
from lidarsynth.networks.gan.losses import r1_penalty


def rolled(count: int, seed: int) -> Dice:
    return roll_dice(count, torch.Generator().manual_seed(seed))


def test_given_matrices_transform_as_the_reference(fixture_tensors):
    expected = fixture_tensors("gan_ada")
    moved = transform_geometry(expected["input"], expected["affine_G"])
    assert_close(transform_colour(moved, expected["color_C"]), expected["output"], atol=1e-5, rtol=0)
    still = transform_geometry(expected["input"][:1], torch.eye(3)[None])
    assert_close(still, expected["output_identity"], atol=1e-5, rtol=0)


def test_probability_moves_as_the_reference(fixture_tensors):
    expected = fixture_tensors("gan_ada")
    augmentation = AdaptiveAugmentation(p=0.2)
    for _ in range(8):
        augmentation.observe(expected["p_update.y_real"])
    assert_close(augmentation.adapt(), expected["p_update.rt"])
    assert_close(augmentation.p[None], expected["p_update.p_after"], atol=1e-7, rtol=0)
    with pytest.raises(ValueError, match="got none"):
        augmentation.adapt()
    augmentation.observe(torch.full((10_000_000, 1), 2.0))
    augmentation.adapt()
    assert augmentation.p.item() == pytest.approx(0.9)


def test_buffers_are_the_official_ones(reference):
    check_structure(reference, "dusty_v2", {"A": AdaptiveAugmentation()}, {"A": 0})


def test_wavelets_are_orthonormal_and_bands_add_up():
    for taps in (SYM2, SYM6):
        wavelet = torch.tensor(taps, dtype=torch.float64)
        assert wavelet.sum().item() == pytest.approx(math.sqrt(2))
        overlaps = [float(wavelet[k:] @ wavelet[: len(wavelet) - k]) for k in range(0, len(wavelet), 2)]
        assert overlaps == pytest.approx([1] + [0] * (len(overlaps) - 1), abs=1e-9)
    identity = torch.zeros(43)
    identity[21] = 1
    assert_close(octave_filters().sum(0), identity, atol=1e-6, rtol=0)


def test_nothing_changes_at_probability_zero_and_an_image_s_dice_decide_above():
    images = torch.randn(4, 1, 32, 64)
    zero, dice = torch.tensor(0.0), rolled(4, 1)
    assert torch.equal(random_affine(images, zero, dice), torch.eye(3).expand(4, 3, 3))
    assert torch.equal(random_colour(images, zero, dice), torch.eye(4).expand(4, 4, 4))
    augmentation = AdaptiveAugmentation(p=0.8)
    first, second = (augmentation(images, rolled(4, seed)) for seed in (1, 1))
    assert torch.equal(first, second)
    assert not torch.equal(first, augmentation(images, rolled(4, 2)))
    halves = [augmentation(images[i : i + 2], Dice(*(part[i : i + 2] for part in dice))) for i in (0, 2)]
    assert_close(torch.cat(halves), first, atol=1e-4, rtol=0)  # other padding, other rounding


def test_shifts_run_around_the_ring_and_flips_mirror():
    images = torch.randn(1, 1, 32, 64)
    shift = torch.eye(3)[None].clone()
    shift[0, 0, 2] = 5
    assert_close(transform_geometry(images, shift), images.roll(5, 3), atol=5e-4, rtol=0)
    flip = torch.diag(torch.tensor([-1.0, 1.0, 1.0]))[None]
    smooth = torch.sin(torch.arange(64) * math.pi / 16).expand(1, 1, 32, 64)
    assert_close(transform_geometry(smooth, flip), smooth.flip(3), atol=0.02, rtol=0)  # the wavelet is not symmetric


def test_draws_follow_their_distributions():
    images = torch.zeros(20_000, 1, 32, 64)
    affine = random_affine(images, torch.tensor(1.0), rolled(20_000, 0))
    assert_close(affine[:, 0, 0].mean(), torch.tensor(0.0), atol=0.03, rtol=0)  # flips in half of the cases
    assert bool((affine[:, 0, 0].abs() == 1).all()), "scaling is vertical only"
    assert_close(affine[:, 1, 1].abs().log2().std(), torch.tensor(0.2), atol=0.01, rtol=0)
    assert_close(affine[:, 0, 2].std(), torch.tensor(64 * math.sqrt(0.125**2 + 0.125**2 / 3)), atol=0.2, rtol=0)
    colour = random_colour(images, torch.tensor(1.0), rolled(20_000, 0))[:, :3].mean(1)
    contrast, offset = colour[:, :3].sum(1), colour[:, 3]
    assert_close(contrast.abs().log2().std(), torch.tensor(0.5), atol=0.02, rtol=0)
    assert_close((contrast > 0).float().mean(), torch.tensor(0.5), atol=0.02, rtol=0)
    assert_close((offset / contrast).std(), torch.tensor(0.2), atol=0.01, rtol=0)


def test_sampling_has_the_second_derivative_that_r1_needs():
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(2, 1, 4, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    grid = torch.rand(2, 3, 4, 2, generator=generator, dtype=torch.float64) * 2.4 - 1.2
    square = lambda x: sample_bilinear(x, grid).square()  # noqa: E731
    assert torch.autograd.gradcheck(square, x)
    assert torch.autograd.gradgradcheck(square, x)


def test_r1_through_the_augmentation_reaches_the_weights():
    net = Discriminator((32, 64), 2, 4)
    images = torch.randn(4, 1, 32, 64, requires_grad=True)
    augmented = AdaptiveAugmentation(p=0.9)(images, rolled(4, 0))
    penalty = r1_penalty(net(augmented), images)
    penalty.backward()
    assert penalty > 0
    weights = {name: value for name, value in net.named_parameters() if name.endswith("weight")}
    assert all(value.grad is not None and bool(value.grad.abs().sum() > 0) for value in weights.values())
