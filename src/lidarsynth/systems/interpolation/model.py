"""`InterpolationModel`: nearest, bilinear and bicubic interpolation as models without weights; the baselines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from lidarsynth.experiment.record import Experiment
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.interpolation import Interpolation, interpolate
from lidarsynth.systems.any_sensor import AnySensorModel
from lidarsynth.systems.description import Description
from lidarsynth.systems.filling import Filling
from lidarsynth.systems.interpolation.description import DESCRIPTION
from lidarsynth.systems.known_pixels import with_known
from lidarsynth.systems.scan_model import OnStep


def interpolated(image: RangeImage, known: np.ndarray, method: str) -> RangeImage:
    """The baseline: range in metres and reflectance interpolated from the known pixels, empty ones as 0.

    known (H, W) bool; method `nearest`, `bilinear` or `bicubic`. Negative overshoots become empty.
    """
    pixels = torch.from_numpy(np.stack([image.range, image.reflectance]))[None].float()
    mask = torch.from_numpy(known).expand(pixels.shape)
    distance, reflectance = interpolate(pixels, mask, method)[0].clamp(min=0).numpy()
    return RangeImage(distance, reflectance.clip(0, 1), distance > 0, image.sensor)


@dataclass(frozen=True, repr=False)
class InterpolationModel(AnySensorModel):
    """An interpolation with the sensor of its images.

    Its network has no parameters; the name of its experiment is the method.
    """

    network: Interpolation
    sensor: Sensor
    experiment: Experiment
    description: ClassVar[Description] = DESCRIPTION
    kind: ClassVar[str] = "an interpolation"

    def resolved(self, how: Filling) -> Filling:
        """The request itself. Raises ValueError for a method, a sampler or more than one step."""
        name = self.experiment.name
        if how.method != "auto" or how.steps not in (None, 1):
            raise ValueError(f"{name}: expected method auto and 1 step, found {how.method} and {how.steps}")
        if how.sampler is not None:
            raise ValueError(f"{name}: expected no sampler, for nothing is sampled, found {how.sampler!r}")
        return how.without("resamples", reason="which only repaint has")

    def calls(self, how: Filling) -> int:
        """1, whatever is filled."""
        return 1

    def fill(self, image: RangeImage, known: np.ndarray, how: Filling, on_step: OnStep = None) -> RangeImage:
        """The image, filled: whole known beams between their true rows, any other mask as `interpolate` says."""
        filled = interpolated(image, known, self.network.method)
        if on_step is not None:
            on_step()
        return with_known(filled, image, known, keep_reflectance=True)
