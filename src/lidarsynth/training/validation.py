"""How good the averaged weights are: losses at fixed noise levels on fixed noise, and pictures of fixed seeds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from lidarsynth.build import build_denoiser, build_sensor
from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.experiment import Experiment
from lidarsynth.lidar.figure import panel
from lidarsynth.lidar.render import range_strip, reflectance_strip
from lidarsynth.model import LidarModel
from lidarsynth.training.examples import SYNTHETIC, Images, Streets, open_images
from lidarsynth.training.journal import Journal

VALIDATION_SEED = 1_000_003  # of streets that are never trained on
IMAGES = 16
TIMES = (0.1, 0.3, 0.5, 0.7, 0.9)  # noise levels
EVERY = 4  # completion is judged on every fourth beam, from pure noise


class Watch:
    """Looks at a run from time to time: at images that are not trained on where there are such, and at samples.

    data        what is trained on: a cache, or `synthetic`, for which streets of another seed are held out
    validation  cache of images that are not trained on; without one, a cache's curves are called `training_images`
    """

    def __init__(self, experiment: Experiment, data: str | Path, validation: str | Path | None = None):
        self._experiment = experiment
        self._source = validation or data
        held_out = validation is not None or str(data) == SYNTHETIC
        self._name = "validation" if held_out else "training_images"
        self._x_0: Tensor | None = None

    def look(self, network: nn.Module, step: int, journal: Journal) -> None:
        """Losses per noise level and sample pictures of the averaged weights, into the journal."""
        if self._x_0 is None:
            self._x_0 = _spread(self._experiment, open_images(self._source, self._experiment, VALIDATION_SEED))
        losses = fixed_losses(self._experiment, network, self._x_0)
        journal.curves(step, {f"{self._name}/{level}": loss for level, loss in losses.items()})
        journal.pictures(step, "sample", sample_pictures(self._experiment, network))


def _spread(experiment: Experiment, images: Images) -> Tensor:
    """x_0 (n, 2, H, W) of at most IMAGES images from everywhere in a cache, or of as many streets."""
    if isinstance(images, Streets):
        indices = images.indices(0, IMAGES)
    else:
        count = min(IMAGES, len(images))
        indices = [i * len(images) // count for i in range(count)]
    return images.x_0(indices, experiment.data.codec)


@torch.no_grad()
def fixed_losses(experiment: Experiment, network: nn.Module, x_0: Tensor, batch_size: int = 4) -> dict[str, float]:
    """Unweighted loss per noise level of x_0 (n, 2, H, W), by name; the noise is the same in every call.

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
    losses = {}
    for time in TIMES:
        t = x_0.new_full((len(x_0),), time)
        losses[f"t_{time}"] = denoiser.loss(x_0, t, eps, loss=experiment.diffusion.loss, gamma=None)
    if experiment.model.network == "conditional-unet":
        known = torch.zeros_like(x_0)
        known[:, :, ::EVERY] = 1
        given, t = denoiser.given(x_0, known), x_0.new_ones(len(x_0))
        losses["completion"] = given.loss(x_0, t, eps, mask=1 - known, loss="l1", gamma=None)
    return losses


def sample_pictures(experiment: Experiment, network: nn.Module, count: int = 2, steps: int = 16) -> list[np.ndarray]:
    """Pictures (H', W', 3) uint8 of scans that the network makes from seeds 0, 1, ...: range above reflectance."""
    sensor = build_sensor(experiment)
    model = LidarModel(network, build_denoiser(experiment, network), sensor, experiment)
    images = model.generate(count, steps=steps, seed=0)
    return [panel([[("range", range_strip(image))], [("reflectance", reflectance_strip(image))]]) for image in images]
