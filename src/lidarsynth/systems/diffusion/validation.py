"""How good a denoiser's averaged weights are: losses at fixed noise levels on fixed noise, and pictures of samples."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.experiment.record import Experiment
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.depth import to_x_0
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.networks.conditional import ConditionalUNet
from lidarsynth.pictures.figure import panel
from lidarsynth.pictures.render import range_strip, reflectance_strip
from lidarsynth.systems.diffusion.build import build_denoiser
from lidarsynth.systems.diffusion.model import LidarModel

TIMES = (0.1, 0.3, 0.5, 0.7, 0.9)  # noise levels
EVERY = 4  # completion is judged on every fourth beam, from pure noise


def judge_diffusion(experiment: Experiment, network: nn.Module, images: Sequence[RangeImage]) -> dict[str, float]:
    """`fixed_losses` of range images."""
    return fixed_losses(experiment, network, torch.stack([to_x_0(i, experiment.data.codec) for i in images]))


@torch.no_grad()
def fixed_losses(experiment: Experiment, network: nn.Module, x_0: Tensor, batch_size: int = 4) -> dict[str, float]:
    """Unweighted loss per noise level of x_0 (n, 2, H, W), by name; the noise is the same in every call.

    The squared error of a score weighs sigma^2, as in its training.

    A network that is told the known pixels is also judged on completing three of four beams (mean absolute error of the
    code in [-1, 1]).
    """
    device = next(network.parameters()).device
    denoiser = build_denoiser(experiment, network)
    eps = torch.randn(x_0.shape, generator=torch.Generator().manual_seed(0))
    sums: dict[str, float] = {}
    for first in range(0, len(x_0), batch_size):
        part = slice(first, first + batch_size)
        losses = _losses(experiment, denoiser, x_0[part].to(device), eps[part].to(device))
        for name, loss in losses.items():
            sums[name] = sums.get(name, 0.0) + float(loss.sum()) / len(x_0)
    return sums


def _losses(experiment: Experiment, denoiser: Denoiser, x_0: Tensor, eps: Tensor) -> dict[str, Tensor]:
    losses, gamma = {}, math.inf if denoiser.kind == "score" else None
    for time in TIMES:
        t = x_0.new_full((len(x_0),), time)
        losses[f"t_{time}"] = denoiser.loss(x_0, t, eps, loss=experiment.diffusion.loss, gamma=gamma)
    if isinstance(denoiser.network, ConditionalUNet):
        known = torch.zeros_like(x_0)
        known[:, :, ::EVERY] = 1
        given, t = denoiser.given(x_0, known), x_0.new_ones(len(x_0))
        losses["completion"] = given.loss(x_0, t, eps, mask=1 - known, loss="l1", gamma=None)
    return losses


def picture_samples(
    experiment: Experiment, network: nn.Module, images: Sequence[RangeImage], count: int = 2, steps: int = 16
) -> list[np.ndarray]:
    """Pictures (H', W', 3) uint8 of scans that the network makes from seeds 0, 1, ...; `images` are not looked at."""
    sensor = build_sensor(experiment)
    model = LidarModel(network, build_denoiser(experiment, network), sensor, experiment)
    return [strips(image) for image in model.generate(count, steps=steps, seed=0)]


def strips(image: RangeImage) -> np.ndarray:
    """(H', W', 3) uint8: range above reflectance."""
    return panel([[("range", range_strip(image))], [("reflectance", reflectance_strip(image))]])
