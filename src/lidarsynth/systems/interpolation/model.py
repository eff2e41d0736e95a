"""`InterpolationModel`: nearest, bilinear and bicubic interpolation as models without weights; the baselines."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch

from lidarsynth.experiment.record import Experiment
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import Sensor, get_sensor
from lidarsynth.networks.interpolation import Interpolation, interpolate
from lidarsynth.systems.scan_model import OnStep, ScanModel, imaged_by, known_pixels, with_known


def interpolated(image: RangeImage, known: np.ndarray, method: str) -> RangeImage:
    """The baseline: range in metres and reflectance interpolated from the known pixels, empty ones as 0.

    known (H, W) bool; method `nearest`, `bilinear` or `bicubic`. Negative overshoots become empty.
    """
    pixels = torch.from_numpy(np.stack([image.range, image.reflectance]))[None].float()
    mask = torch.from_numpy(known).expand(pixels.shape)
    distance, reflectance = interpolate(pixels, mask, method)[0].clamp(min=0).numpy()
    return RangeImage(distance, reflectance.clip(0, 1), distance > 0, image.sensor)


@dataclass(frozen=True)
class InterpolationModel(ScanModel):
    """An interpolation with the sensor of its images.

    Its network has no parameters; the name of its experiment is the method.
    """

    network: Interpolation
    sensor: Sensor
    experiment: Experiment
    kind: ClassVar[str] = "an interpolation"

    def into(self, sensor: Sensor | str) -> InterpolationModel:
        """The same interpolation in images of another sensor."""
        sensor = get_sensor(sensor) if isinstance(sensor, str) else sensor
        return replace(self, sensor=sensor, experiment=imaged_by(self.experiment, sensor))

    def complete(
        self,
        scan: Scan | RangeImage,
        known: np.ndarray | None = None,
        method: str = "auto",
        steps: int | None = None,
        resamples: int = 10,
        sampler: str | None = None,
        seed: int = 0,
        on_step: OnStep = None,
    ) -> RangeImage:
        """Fill what was not measured; pixels of `known` (H, W) bool come back exactly as they were.

        Whole known beams are interpolated between their true rows, any other mask as `interpolate` says. Raises
        ValueError when shapes do not fit, or for a method, a sampler or more than one step.
        """
        image = self.image_of(scan)
        known = known_pixels(image, known)
        self.evaluations(method, steps)
        if sampler is not None:
            raise ValueError(f"{self.experiment.name}: expected no sampler, for nothing is sampled, found {sampler!r}")
        filled = interpolated(image, known, self.network.method)
        if on_step is not None:
            on_step()
        return with_known(filled, image, known, keep_reflectance=True)

    def evaluations(self, method: str = "auto", steps: int | None = None, resamples: int = 10) -> int:
        """1, whatever is filled. Raises ValueError for another method or more steps."""
        if method != "auto" or steps not in (None, 1):
            raise ValueError(f"{self.experiment.name}: expected method auto and 1 step, found {method} and {steps}")
        return 1
