"""One training step's loss: generation (R2DM eq. 2-3) and completion of randomly hidden pixels.

All randomness of a sample is a function of (seed, step, its position in the global batch), so that the loss does not
depend on how many processes, workers or passes share a batch, and a resumed run draws what it would have drawn.
"""

from __future__ import annotations

import math
from collections.abc import Sized
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from lidarsynth.diffusion.denoiser import Denoiser, masked_mean, min_snr_weight
from lidarsynth.experiment.record import Experiment, Training
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.corruption import every_beam, without_columns, without_rectangle
from lidarsynth.lidar.depth import CODECS, decode, encode, valid
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.conditional import ConditionalUNet
from lidarsynth.systems.diffusion.build import build_denoiser
from lidarsynth.systems.diffusion.validation import EVERY, judge_diffusion, picture_samples
from lidarsynth.training.randomness import augment, sample_rng, sample_seed
from lidarsynth.training.task import Images, Phase, Task

MIXING, NOISE = 1, 2  # purposes of `sample_rng` and `sample_seed`


class DiffusionBatch(NamedTuple):
    """One process's share of one pass: b samples, the first `generation` of which learn p(x_0), the rest completion."""

    x_0: Tensor  # (b, 2, H, W) in [-1, 1], augmented
    t: Tensor  # (b,) times in [0, 1]
    seeds: tuple[int, ...]  # of the samples' noise, which is drawn where the batch is used
    known: Tensor  # (b, 2, H, W) bool, False everywhere for the first `generation`
    times: Tensor  # (generation_count,) times of all samples of the global batch that learn p(x_0), for `mean_weight`
    generation: int

    @property
    def eps(self) -> Tensor:
        """(b, 2, H, W) unit Gaussian noise, drawn on the batch's device: what a loader need not make nor copy."""
        device = self.x_0.device
        noise = torch.empty_like(self.x_0)
        for sample, seed in zip(noise, self.seeds, strict=True):
            sample.normal_(generator=torch.Generator(device).manual_seed(seed))
        return noise


class Objective(nn.Module):
    """`objective(batch)` -> the losses per sample of generation and of completion; their mean is minimised.

    The first samples learn p(x_0), the others p(x_0 | known pixels): for a network that is told the known pixels, cf.
    conditional diffusion for LiDAR upsampling (Helgesen et al. 2024, arXiv 2405.04889). A module, so that one wrapper
    (distributed, autocast) holds both calls of the network; noising stays in float32.
    """

    def __init__(self, experiment: Experiment, network: nn.Module):
        super().__init__()
        share, word = experiment.training.generation_share, experiment.model.network
        if share < 1 and not isinstance(network, ConditionalUNet):
            raise ValueError(f"training.generation_share: expected 1 for {word}, which cannot be told the known "
                             f"pixels, found {share:g}")  # fmt: skip
        self.experiment = experiment
        self.network = network
        self.denoiser = build_denoiser(experiment, network)

    def forward(self, batch: DiffusionBatch) -> dict[str, Tensor]:
        n, noise = batch.generation, batch.eps
        losses = {"generation": batch.t[:0], "completion": batch.t[:0]}
        if n:
            x_0, t, eps = (part[:n] for part in (batch.x_0, batch.t, noise))
            losses["generation"] = generation_loss(self.experiment, self.denoiser, x_0, t, eps, batch.times)
        if n < len(batch.x_0):
            x_0, t, eps, known = (part[n:] for part in (batch.x_0, batch.t, noise, batch.known))
            losses["completion"] = completion_loss(self.experiment, self.denoiser, x_0, t, eps, known)
        return losses


def generation_loss(
    experiment: Experiment, denoiser: Denoiser, x_0: Tensor, t: Tensor, eps: Tensor, times: Tensor
) -> Tensor:
    """Weighted loss (b,) of samples that learn p(x_0); `times` are those of all such samples of the global batch.

    With `mean_weight`, R2DM's mean(loss) * mean(weight), the mean weight is that of `times`. R2DM's program takes it
    over each device's samples, so its loss depends on the number of devices; ours is its loss on one, always.
    """
    diffusion = experiment.diffusion
    gamma = None if diffusion.mean_weight else diffusion.gamma
    losses = denoiser.loss(x_0, t, eps, loss=diffusion.loss, gamma=gamma, floor=diffusion.floor)
    if diffusion.gamma is None or not diffusion.mean_weight:
        return losses
    log_snr, alpha, sigma = denoiser.schedule.at(times, times)
    weight = min_snr_weight(denoiser.kind, log_snr, alpha, sigma, diffusion.gamma)
    return losses * weight.clamp(min=diffusion.floor).mean()


def completion_loss(
    experiment: Experiment, denoiser: Denoiser, x_0: Tensor, t: Tensor, eps: Tensor, known: Tensor
) -> Tensor:
    """Mean absolute error (b,) of the pixels that are not `known` (b, 2, H, W), in code and, of range, in metres too.

    The absolute error has the median as its optimum, which is the same in metres and in any depth code; in code the
    near pixels weigh most, in metres, by `training.metres_weight`, the far ones.
    """
    mask = known.to(x_0)
    _, alpha, sigma = denoiser.schedule.at(t, x_0)
    x_0_hat = replace(denoiser, clip=False).given(x_0, mask)(alpha * x_0 + sigma * eps, t)
    error = (x_0_hat - x_0).abs()
    sensor, codec = build_sensor(experiment), experiment.data.codec
    metres = (_metres(x_0_hat[:, :1], sensor, codec) - _metres(x_0[:, :1], sensor, codec)).abs()
    metres = metres * experiment.training.metres_weight
    return masked_mean(error + torch.cat([metres, torch.zeros_like(metres)], dim=1), 1 - mask)


def _metres(code: Tensor, sensor: Sensor, codec: str) -> Tensor:
    """Range code in [-1, 1] -> metres up to the sensor's limit, without the gap below its least range."""
    return CODECS[codec].inverse((code.clamp(-1, 1) + 1) / 2, sensor).clamp(max=sensor.max_range)


def generation_count(training: Training, step: int) -> int:
    """How many samples of a step's global batch, the first ones, learn p(x_0); over many steps exactly their share."""
    wanted = training.generation_share * training.batch_size
    return math.floor(wanted * (step + 1) + 1e-9) - math.floor(wanted * step + 1e-9)


def draw(experiment: Experiment, x_0: Tensor, step: int, positions: list[int]) -> DiffusionBatch:
    """The batch of clean images x_0 (b, 2, H, W) that stand at rising `positions` of step `step`'s global batch."""
    count, seed = generation_count(experiment.training, step), experiment.training.seed
    augmented, t, known = _augmented(experiment), torch.empty(len(x_0)), torch.zeros(x_0.shape, dtype=torch.bool)
    clean = torch.empty_like(x_0) if augmented else x_0
    for i, position in enumerate(positions):
        rng, completes = sample_rng(seed, step, position), position >= count
        t[i] = draw_time(rng, completes)  # first, because it is repeated for the other processes' samples
        if augmented:
            clean[i] = _augment(experiment, x_0[i], rng)
        if completes:
            hide(experiment, clean[i], t[i], known[i], rng)
    times = [
        draw_time(sample_rng(seed, step, p), False) for p in range(count if experiment.diffusion.mean_weight else 0)
    ]
    seeds = tuple(sample_seed(seed, step, position, NOISE) for position in positions)
    return DiffusionBatch(clean, t, seeds, known, torch.tensor(times), sum(p < count for p in positions))


def hide(experiment: Experiment, x_0: Tensor, t: Tensor, known: Tensor, rng: torch.Generator) -> None:
    """Fill in `known` (2, H, W) of a sample that learns completion, and its time t () where that goes with it."""
    known.copy_(random_known(x_0, rng))
    if torch.rand((), generator=rng) < experiment.training.upsampling_share:
        t.fill_(1)
        known.zero_()[:, ::EVERY] = True


def draw_images(
    experiment: Experiment, images: Images, indices: list[int], step: int, positions: list[int]
) -> DiffusionBatch:
    """`draw` of images of a cache or of streets; those that learn completion are mixed by `data.mix`."""
    x_0 = images.x_0(indices, experiment.data.codec)
    if experiment.data.mix:
        count = generation_count(experiment.training, step)
        for sample, position in zip(x_0, positions, strict=True):
            if position >= count:
                mix(experiment, sample, images, sample_rng(experiment.training.seed, step, position, MIXING))
    return draw(experiment, x_0, step, positions)


def mix(experiment: Experiment, x_0: Tensor, images: Images, rng: torch.Generator) -> None:
    """Put, into a share `data.mix` of samples x_0 (2, H, W), a sector of up to half a turn of another image of a cache.

    PolarMix's swap of scenes (Xiao et al., NeurIPS 2022): a network that corrects the interpolation of its neighbours
    cannot learn whole scans by heart. Endless streets are new each time and stay whole.
    """
    if not isinstance(images, Sized) or torch.rand((), generator=rng) >= experiment.data.mix:
        return
    other = images.x_0([int(torch.randint(len(images), (), generator=rng))], experiment.data.codec)[0]
    other = augment(other, rng, experiment.data.roll, experiment.data.mirror)
    first, width = torch.rand(2, generator=rng).mul(x_0.shape[-1]).tolist()
    columns = (int(first) + torch.arange(int(width / 2))) % x_0.shape[-1]
    x_0[..., columns] = other[..., columns]


def _augmented(experiment: Experiment) -> bool:
    data = experiment.data
    return data.roll or data.mirror or data.scale > 0


def _augment(experiment: Experiment, x_0: Tensor, rng: torch.Generator) -> Tensor:
    x_0 = augment(x_0, rng, experiment.data.roll, experiment.data.mirror)
    return scaled(experiment, x_0, rng) if experiment.data.scale else x_0


def draw_time(rng: torch.Generator, completes: bool) -> Tensor:
    """t () ~ U(0, 1); for completion, half of the times are 1, where it begins."""
    t, begins = torch.rand(2, generator=rng)
    return torch.ones(()) if completes and begins < 0.5 else t


def scaled(experiment: Experiment, x_0: Tensor, rng: torch.Generator) -> Tensor:
    """x_0 (2, H, W) of a world up to `data.scale` larger or smaller; what leaves the sensor's limits is gone."""
    sensor, codec = build_sensor(experiment), experiment.data.codec
    factor = 1 + experiment.data.scale * (2 * float(torch.rand((), generator=rng)) - 1)
    distance = decode((x_0[:1] + 1) / 2, sensor, codec) * factor
    code = 2 * encode(distance, sensor, codec) - 1
    return torch.where(valid(distance, sensor), torch.cat([code, x_0[1:]]), -1.0)


def random_known(x_0: Tensor, rng: torch.Generator) -> Tensor:
    """Bool (2, H, W): a random pattern of known pixels: even beams (most), uneven beams, points, without a sector or
    a rectangle; a tenth of all keep points only.

    Half of the samples also hide where the sensor measured nothing (-1 in x_0), as in a scan whose drop-outs are to be
    filled; a tenth hide all reflectance.
    """
    kind, size, width, place, sparse, share, column, _, empty, dark = torch.rand(10, generator=rng).tolist()
    shape = height, columns = x_0.shape[1], x_0.shape[2]
    pattern = np.ones(shape, bool)
    if kind < 0.6:
        every = (2, 3, 4, 4, 4, 6, 8)[int(size * 7)]
        pattern = every_beam(shape, every, 0 if width < 0.5 else int(place * every))
    elif kind < 0.7:  # one beam in eight to one in two
        pattern = pattern & (torch.rand(height, 1, generator=rng) < 1 / 8 + 3 / 8 * size).numpy()
    if 0.7 < kind < 0.82 or sparse < 0.1:  # 2 % to 80 % of the points
        pattern &= (torch.rand(shape, generator=rng) < math.exp(math.log(0.02) + share * math.log(40))).numpy()
    if 0.82 <= kind < 0.91:  # 20 to 180 degrees
        first = int(width * columns)
        pattern &= without_columns(shape, range(first, first + int(columns * (20 + 160 * size) / 360)))
    if kind >= 0.91:
        tall, wide = int(height * (0.1 + 0.9 * size)), int(columns * (0.02 + 0.2 * width))
        top, left = int(place * (height - tall + 1)), int(column * columns)
        pattern &= without_rectangle(shape, range(top, top + tall), range(left, left + wide))
    known = torch.from_numpy(pattern).expand(x_0.shape).clone()
    if empty < 0.5:
        known &= x_0[:1] > -1
    if dark < 0.1:
        known[1] = False
    return known


DIFFUSION = Task(
    parts=("generation", "completion"),
    draw=draw_images,
    phases=lambda experiment, network: (Phase(Objective(experiment, network)),),
    judge=judge_diffusion,
    pictures=picture_samples,
)
