"""Training of GANs as in the DUSty v2 program, the same for Vanilla GAN, DUSty v1 and DUSty v2 (WACV 2023).

A step is the generator's phase, the discriminator's, and from time to time its R1 penalty; then the average follows
and, every few steps, the probability of the augmentation. Several processes see the losses of one, but for rounding,
where no forward pass averages over the batch: with Vanilla GAN and DUSty v1. Of DUSty v2, the groups of the minibatch
deviation are the same in a process that has a multiple of 4 samples, since positions are taken in turn; but the mean
squares that its modulated layers follow are, within a step, those of each process.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from lidarsynth.experiment.record import Adversarial, Experiment, Training
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.metrics.bev import BevCounts
from lidarsynth.metrics.distributions import jensen_shannon_distance
from lidarsynth.networks.gan.adaptive_augmentation import AdaptiveAugmentation
from lidarsynth.networks.gan.layers import GROUP
from lidarsynth.networks.gan.losses import (
    discriminator_loss,
    generator_loss,
    path_length_penalty,
    path_lengths,
    r1_penalty,
)
from lidarsynth.networks.gan.scan_generator import ScanGenerator
from lidarsynth.pictures.figure import panel
from lidarsynth.pictures.render import range_strip
from lidarsynth.systems.gan.batch import AdversarialBatch, View, draw, group_of
from lidarsynth.systems.gan.build import build_discriminator
from lidarsynth.systems.gan.model import GanModel
from lidarsynth.training.machine import fixed_randomness
from lidarsynth.training.task import Phase, Task

if TYPE_CHECKING:
    from accelerate import Accelerator

JUDGED = 64  # samples that are compared with the held-out images
RAMP = 0.05  # the average's half-life is at most this share of the images seen


class AdversarialNetworks(nn.Module):
    """What is trained: generator, discriminator, and what follows their running means."""

    path_length: Tensor

    def __init__(self, generator: ScanGenerator, discriminator: nn.Module, augmentation: AdaptiveAugmentation):
        super().__init__()
        self.generator = generator
        self.discriminator = discriminator
        self.augmentation = augmentation
        self.register_buffer("path_length", torch.zeros(()))


def around(experiment: Experiment, network: nn.Module) -> AdversarialNetworks:
    """The generator and its opponent with fresh weights."""
    assert isinstance(network, ScanGenerator)
    group = group_of(experiment)
    augmentation = AdaptiveAugmentation(0.0, group.augmentation_target or 0.0, group.augmentation_images)
    with fixed_randomness(experiment.training.seed, 1):  # other weights than the generator's
        return AdversarialNetworks(network, build_discriminator(experiment), augmentation)


def shown(networks: AdversarialNetworks, group: Adversarial, images: Tensor, view: View) -> Tensor:
    """Images (b, 1, H, W) as the discriminator sees them: with pixels dropped in the warm-up, and augmented."""
    images = torch.where(view.keep, images.float(), -1.0)
    if group.augmentation_target is None:
        return images
    with torch.autocast(images.device.type, enabled=False):  # coordinates of pixels are beyond half precision
        return networks.augmentation(images, view.dice)


@contextmanager
def _frozen(network: nn.Module) -> Iterator[None]:
    """No gradients of these weights inside: spares their computation in the other network's phase."""
    network.requires_grad_(False)
    try:
        yield
    finally:
        network.requires_grad_(True)


class GeneratorLoss(nn.Module):
    """`objective(batch)` -> non-saturating loss of the generator, (1,): every share of a batch has the same size."""

    def __init__(self, experiment: Experiment, networks: AdversarialNetworks):
        super().__init__()
        self.generator = networks.generator
        self._group = group_of(experiment)
        self._networks = (networks,)  # in a tuple, so that its parameters are not this module's

    def forward(self, batch: AdversarialBatch) -> dict[str, Tensor]:
        (networks,) = self._networks
        with _frozen(networks.discriminator):
            fake = self.generator(batch.latents.z, batch.latents.uniform, shift=batch.latents.shift).image
            logits = networks.discriminator(shown(networks, self._group, fake, batch.view))
        return {"generator": generator_loss(logits.float())[None]}


class DiscriminatorLoss(nn.Module):
    """`objective(batch)` -> the loss of the discriminator on fresh images and real ones, (1,)."""

    def __init__(self, experiment: Experiment, networks: AdversarialNetworks):
        super().__init__()
        self.discriminator = networks.discriminator
        self._group = group_of(experiment)
        self._networks = (networks,)

    def forward(self, batch: AdversarialBatch) -> dict[str, Tensor]:
        (networks,) = self._networks
        with torch.no_grad():
            fake = networks.generator(
                batch.fake_latents.z, batch.fake_latents.uniform, shift=batch.fake_latents.shift
            ).image
        logits_fake = self.discriminator(shown(networks, self._group, fake, batch.fake_view))
        logits_real = self.discriminator(shown(networks, self._group, batch.real, batch.real_view))
        networks.augmentation.observe(logits_real)
        return {"discriminator": discriminator_loss(logits_real.float(), logits_fake.float())[None]}


class R1Penalty(nn.Module):
    """`objective(batch)` -> R1 of real images before they are augmented, times its interval, (1,)."""

    def __init__(self, experiment: Experiment, networks: AdversarialNetworks):
        super().__init__()
        self.discriminator = networks.discriminator
        self._group = group_of(experiment)
        self._networks = (networks,)

    def forward(self, batch: AdversarialBatch) -> dict[str, Tensor]:
        (networks,), group = self._networks, self._group
        with torch.autocast(batch.real.device.type, enabled=False):  # squares of gradients are beyond half precision
            real = batch.real.detach().requires_grad_()
            logits = self.discriminator(shown(networks, group, real, batch.penalty_view))
            penalty = r1_penalty(logits, real) * (group.r1_weight / 2 * group.r1_every)
        # the last bias has no part in the penalty, and a distributed wrapper waits for its gradient
        return {"r1": (penalty + 0 * logits.sum())[None]}


class PathLengthPenalty(nn.Module):
    """`objective(batch)` -> path length penalty of half of the batch, times its interval, (1,). Off as published."""

    def __init__(self, experiment: Experiment, networks: AdversarialNetworks):
        super().__init__()
        self.generator = networks.generator
        self._group = group_of(experiment)
        self._networks = (networks,)

    def forward(self, batch: AdversarialBatch) -> dict[str, Tensor]:
        (networks,), group, half = self._networks, self._group, max(1, len(batch.real) // 2)
        z, uniform, shift = (part[:half] for part in batch.fake_latents)
        with torch.autocast(batch.real.device.type, enabled=False):
            w = self.generator.styles_of_layers(z)
            if not w.requires_grad:
                w = w.detach().requires_grad_()  # styles that are latents
            image = self.generator.synthesize(w, uniform, shift).image
            lengths = path_lengths(image, w, batch.path[:half])
            penalty, mean = path_length_penalty(lengths, networks.path_length)
        networks.path_length.copy_(mean)
        return {"path_length": (penalty * group.path_length_weight * group.path_length_every + 0 * image.sum())[None]}


def phases(experiment: Experiment, networks: nn.Module) -> tuple[Phase, ...]:
    """The phases of a step."""
    assert isinstance(networks, AdversarialNetworks)
    group = group_of(experiment)
    parts = [Phase(GeneratorLoss(experiment, networks), "generator")]
    if group.path_length_weight:
        parts.append(Phase(PathLengthPenalty(experiment, networks), "generator", group.path_length_every))
    parts.append(Phase(DiscriminatorLoss(experiment, networks), "discriminator"))
    if group.r1_weight:
        parts.append(Phase(R1Penalty(experiment, networks), "discriminator", group.r1_every))
    return tuple(parts)


def optimizers(experiment: Experiment, networks: nn.Module) -> dict[str, torch.optim.Optimizer]:
    """Adam for each network; rate and betas of one with a lazy penalty as if every step had it (StyleGAN2)."""
    assert isinstance(networks, AdversarialNetworks)
    group = group_of(experiment)
    every = {"generator": group.path_length_every if group.path_length_weight else 0,
             "discriminator": group.r1_every if group.r1_weight else 0}  # fmt: skip
    made = {}
    for name, network in (("generator", networks.generator), ("discriminator", networks.discriminator)):
        factor = every[name] / (every[name] + 1) if every[name] else 1.0
        first, second = (beta**factor for beta in experiment.training.betas)
        settings = {"params": list(network.parameters()), "factor": factor}
        made[name] = torch.optim.Adam([settings], experiment.training.learning_rate * factor, (first, second))
    return made


def share(experiment: Experiment, samples: int) -> None:
    """Raises ValueError for samples that DUSty v2's discriminator cannot compare in groups of four."""
    if experiment.model.network == "dusty-v2" and samples > GROUP and samples % GROUP:
        raise ValueError(f"training.batch_size: expected a multiple of {GROUP}, or fewer, in a process's pass, as "
                         f"dusty-v2 compares groups of {GROUP}, found {samples}")  # fmt: skip


def average(training: Training, step: int) -> float:
    """Share of the old average that stays: half of it after `ema_half_life` images, sooner in the beginning."""
    half_life = min(training.ema_half_life, RAMP * step * training.batch_size)
    return 0.5 ** (training.batch_size / max(half_life, 1e-8))


@torch.no_grad()
def after(experiment: Experiment, networks: nn.Module, step: int, accelerator: Accelerator) -> None:
    """The running means of all processes become their mean, and the augmentation's probability follows its signs."""
    assert isinstance(networks, AdversarialNetworks)
    group = group_of(experiment)
    if accelerator.num_processes > 1:
        means = {name: value for name, value in networks.named_buffers()
                 if name.rpartition(".")[2] in ("ema_var", "w_avg", "path_length")}  # fmt: skip
        reduced = accelerator.reduce(torch.cat([value.flatten() for value in means.values()]), reduction="mean")
        parts = reduced.split([value.numel() for value in means.values()])  # type: ignore[union-attr]
        for value, part in zip(means.values(), parts, strict=True):
            value.copy_(part.view_as(value))
    if group.augmentation_target is not None and step % group.augmentation_every == 0:
        augmentation = networks.augmentation
        for count in (augmentation.sign_cum, augmentation.n_pred_cum):
            count.copy_(accelerator.reduce(count, reduction="sum"))  # type: ignore[arg-type]
        augmentation.adapt()


def judge(experiment: Experiment, network: nn.Module, images: Sequence[RangeImage]) -> dict[str, float]:
    """Distance of fixed samples to the images: bird's-eye-view JSD, and how much more of the pixels return.

    Of samples without any return the first is that of disjoint histograms, sqrt(ln 2).
    """
    samples = _model(experiment, network).generate(JUDGED, seed=0)
    counts = [_counted(side) for side in (samples, images)]
    returns = [float(np.mean([image.mask.mean() for image in side])) for side in (samples, images)]
    apart = float(np.sqrt(np.log(2)))
    distance = jensen_shannon_distance(*counts) if all(bool(c.any()) for c in counts) else apart
    return {"bev_jsd": distance, "returns": returns[0] - returns[1]}


def _counted(images: Sequence[RangeImage]) -> Tensor:
    counts = BevCounts(keep=0)
    for image in images:
        counts.update(image.points().reshape(1, -1, 3))
    return counts.pooled


def picture(
    experiment: Experiment, network: nn.Module, images: Sequence[RangeImage], count: int = 4
) -> list[np.ndarray]:
    """Pictures (H', W', 3) uint8 of the scans of seeds 0, 1, ...; `images` are not looked at."""
    samples = _model(experiment, network).generate(count, seed=0)
    return [panel([[("range", range_strip(sample))]]) for sample in samples]


def _model(experiment: Experiment, network: nn.Module) -> GanModel:
    assert isinstance(network, ScanGenerator)
    return GanModel(network, build_sensor(experiment), experiment)


ADVERSARIAL = Task(
    parts=("generator", "path_length", "discriminator", "r1"),
    draw=draw,
    phases=phases,
    judge=judge,
    pictures=picture,
    around=around,
    optimizers=optimizers,
    average=average,
    buffers=False,
    after=after,
    share=share,
)
