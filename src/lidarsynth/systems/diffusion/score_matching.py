"""Denoising score matching over fixed noise levels, as LiDARGen is trained (Song & Ermon 2020; Zyrianov et al. 2022).

A sample's level and noise are a function of (seed, step, its position in the global batch) (`training.randomness`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from lidarsynth.diffusion import langevin
from lidarsynth.experiment.record import Experiment, Score, Training
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.systems.diffusion.build import build_denoiser
from lidarsynth.systems.diffusion.validation import judge_diffusion, picture_samples
from lidarsynth.training.randomness import augment, sample_rng
from lidarsynth.training.task import Images, Phase, Task, ema_due

PICTURED = 20  # noise levels of the pictures drawn during training


class ScoreBatch(NamedTuple):
    """One process's share of one pass: b samples."""

    x_0: Tensor  # (b, 2, H, W) in [-1, 1], augmented
    t: Tensor  # (b,) times of the noise levels
    eps: Tensor  # (b, 2, H, W) unit Gaussian noise


class ScoreMatching(nn.Module):
    """`objective(batch)` -> the loss per sample, 1/2 sigma^2 |score + eps / sigma|^2 summed over the image."""

    def __init__(self, experiment: Experiment, network: nn.Module):
        super().__init__()
        self.network = network
        self.denoiser = build_denoiser(experiment, network)

    def forward(self, batch: ScoreBatch) -> dict[str, Tensor]:
        mean = self.denoiser.loss(batch.x_0, batch.t, batch.eps, gamma=math.inf)  # sigma^2 is this kind's plain weight
        return {"score": 0.5 * batch.x_0[0].numel() * mean}


def draw(experiment: Experiment, x_0: Tensor, step: int, positions: list[int]) -> ScoreBatch:
    """The batch of clean images x_0 (b, 2, H, W) that stand at `positions` of step `step`'s global batch.

    Levels are drawn uniformly from those of the experiment's score group. Raises ValueError where there is none.
    """
    score, data = _score(experiment), experiment.data
    drawn = []
    for x, position in zip(x_0, positions, strict=True):
        rng = sample_rng(experiment.training.seed, step, position)
        level = torch.randint(score.levels, (), generator=rng)  # 0 = the noisiest
        x = augment(x, rng, data.roll, data.mirror)
        drawn.append((x, 1 - level / (score.levels - 1), torch.randn(x.shape, generator=rng)))
    return ScoreBatch(*map(torch.stack, zip(*drawn, strict=True)))


def draw_images(
    experiment: Experiment, images: Images, indices: list[int], step: int, positions: list[int]
) -> ScoreBatch:
    """`draw` of images of a cache or of streets."""
    return draw(experiment, images.x_0(indices, experiment.data.codec), step, positions)


def average(training: Training, step: int) -> float | None:
    """`ema_decay` from the first step after `ema_start` on, without the slow beginning of R2DM's; None = not due."""
    return (training.ema_decay if step > training.ema_start else 0.0) if ema_due(training, step) else None


def picture_chains(experiment: Experiment, network: nn.Module, images: Sequence[RangeImage]) -> list[np.ndarray]:
    """Pictures (H', W', 3) uint8 of two scans, from chains with fewer noise levels; `images` are not looked at."""
    score = _score(experiment)
    calls = langevin.evaluations(min(PICTURED, score.levels), score.steps)
    return picture_samples(experiment, network, images, steps=calls)


def _score(experiment: Experiment) -> Score:
    if experiment.score is None or experiment.score.levels < 2:
        raise ValueError(f"{experiment.name}: expected a score group of at least 2 levels, found {experiment.score}")
    return experiment.score


SCORE = Task(
    parts=("score",),
    draw=draw_images,
    phases=lambda experiment, network: (Phase(ScoreMatching(experiment, network)),),
    judge=judge_diffusion,
    pictures=picture_chains,
    average=average,
    buffers=False,
)
