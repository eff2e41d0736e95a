"""What a step of a GAN's training sees: real images, latents, and how the discriminator is shown images.

All randomness of a sample is a function of (seed, step, its position in the global batch).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lidarsynth.experiment.record import Adversarial, Experiment
from lidarsynth.networks.gan.adaptive_augmentation import Dice, roll_dice
from lidarsynth.training.randomness import augment, sample_rng
from lidarsynth.training.task import Images


class Latents(NamedTuple):
    """What b images are generated from."""

    z: Tensor  # (b, Z) unit Gaussian
    uniform: Tensor  # (b, 1, H, W) in [0, 1), of the ray-drop; of DUSty-II (b, 2, H, W), the second all alike
    shift: Tensor  # (b,) in [0, 1), share of a turn by which DUSty v2's angles are rotated


class View(NamedTuple):
    """How b images are shown to the discriminator."""

    keep: Tensor  # (b, 1, H, W) bool, False where the warm-up drops a pixel; (b, 1, 1, 1) after it
    dice: Dice  # of the augmentation


class AdversarialBatch(NamedTuple):
    """One process's share of one pass: b samples. What a step does not need is there all the same, for order's sake."""

    real: Tensor  # (b, 1, H, W) in [-1, 1]
    latents: Latents  # of the generator's phase
    view: View
    fake_latents: Latents  # of the discriminator's phase
    fake_view: View
    real_view: View
    penalty_view: View  # of R1
    path: Tensor  # (b, 1, H, W) unit Gaussian noise of the path length; (b, 1, 1, 1) where it is off


def group_of(experiment: Experiment) -> Adversarial:
    """The experiment's settings of the game, or those that are published."""
    return experiment.adversarial or Adversarial()


def draw(
    experiment: Experiment, images: Images, indices: list[int], step: int, positions: list[int]
) -> AdversarialBatch:
    """The batch of images `indices` that stand at rising `positions` of step `step`'s global batch."""
    x_0, data, group = images.x_0(indices, experiment.data.codec)[:, :1], experiment.data, group_of(experiment)
    drop = warmup_drop(group, step * experiment.training.batch_size)
    samples = []
    for image, position in zip(x_0, positions, strict=True):
        rng = sample_rng(experiment.training.seed, step, position)
        real = augment(image, rng, data.roll, data.mirror)
        first, second = (_latents(experiment, real.shape, rng) for _ in range(2))
        shows = [_view(real.shape, drop, rng) for _ in range(4)]
        noise = torch.randn(real.shape if group.path_length_weight else (1, 1, 1), generator=rng)
        samples.append(AdversarialBatch(real, first, shows[0], second, shows[1], shows[2], shows[3], noise))
    return _stack(samples)


def warmup_drop(group: Adversarial, images: int) -> float:
    """Probability that the warm-up drops a pixel after `images` images: from a half falling to 0."""
    return 0.5 * max(0.0, 1 - images / group.warmup_images) if group.warmup_images else 0.0


def _latents(experiment: Experiment, shape: torch.Size, rng: torch.Generator) -> Latents:
    """Of one sample, whose image is (1, H, W)."""
    z = torch.randn(group_of(experiment).latent_channels, generator=rng)
    uniform = torch.rand(shape if experiment.model.network != "vanilla-gan" else (1, 1, 1), generator=rng)
    if group_of(experiment).image_mask:
        uniform = torch.cat([uniform, torch.rand(1, 1, 1, generator=rng).expand(shape)])
    return Latents(z, uniform, torch.rand((), generator=rng))


def _view(shape: torch.Size, drop: float, rng: torch.Generator) -> View:
    """Of one sample, whose image is (1, H, W)."""
    keep = torch.rand(shape, generator=rng) >= drop if drop else torch.ones(1, 1, 1, dtype=torch.bool)
    return View(keep, Dice(*(part[0] for part in roll_dice(1, rng))))


def _stack(samples: Sequence[Any]) -> Any:
    """Named tuples of tensors, nested, as one whose tensors have the samples along their first dimension."""
    if isinstance(samples[0], Tensor):
        return torch.stack(list(samples))
    return type(samples[0])(*(_stack(parts) for parts in zip(*samples, strict=True)))
