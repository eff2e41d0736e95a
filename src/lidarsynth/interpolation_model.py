"""`InterpolationModel`: nearest, bilinear and bicubic interpolation as models without weights; the baselines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from lidarsynth.experiment import Experiment, with_fields
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import Sensor, get_sensor
from lidarsynth.models.interpolation import Interpolation, interpolate
from lidarsynth.scan_model import OnStep, image_in, known_pixels, sensor_that_made, sparse_image, with_known


def interpolated(image: RangeImage, known: np.ndarray, method: str) -> RangeImage:
    """The baseline: range in metres and reflectance interpolated from the known pixels, empty ones as 0.

    known (H, W) bool; method `nearest`, `bilinear` or `bicubic`. Negative overshoots become empty.
    """
    pixels = torch.from_numpy(np.stack([image.range, image.reflectance]))[None].float()
    mask = torch.from_numpy(known).expand(pixels.shape)
    distance, reflectance = interpolate(pixels, mask, method)[0].clamp(min=0).numpy()
    return RangeImage(distance, reflectance.clip(0, 1), distance > 0, image.sensor)


@dataclass(frozen=True)
class InterpolationModel:
    """An interpolation with the sensor of its images.

    network     the bare torch module, without parameters
    sensor      the beams and columns of its images
    experiment  its name is the method
    """

    network: Interpolation
    sensor: Sensor
    experiment: Experiment

    def to(self, device: str | torch.device) -> InterpolationModel:
        """The same model: nothing of it is on a device."""
        self.network.to(device)
        return self

    def into(self, sensor: Sensor | str) -> InterpolationModel:
        """The same interpolation in images of another sensor."""
        sensor = get_sensor(sensor) if isinstance(sensor, str) else sensor
        fields = {"data.sensor": sensor.to_dict(), "data.height": sensor.height, "data.width": sensor.width}
        return replace(self, sensor=sensor, experiment=with_fields(self.experiment, fields))

    def generate(
        self,
        n: int = 1,
        steps: int | None = None,
        seed: int = 0,
        sampler: str | None = None,
        batch_size: int = 4,
        on_step: OnStep = None,
    ) -> list[RangeImage]:
        """Raises ValueError: an interpolation makes nothing from nothing."""
        raise self._generates_nothing()

    def stream(
        self,
        n: int,
        steps: int | None = None,
        seed: int = 0,
        sampler: str | None = None,
        batch_size: int = 4,
        first: int = 0,
        on_step: OnStep = None,
    ) -> Iterator[RangeImage]:
        """Raises ValueError, as `generate`."""
        raise self._generates_nothing()

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

    def upsample(
        self,
        scan: Scan,
        sensor_in: Sensor | str | None = None,
        method: str = "auto",
        steps: int | None = None,
        seed: int = 0,
        on_step: OnStep = None,
    ) -> RangeImage:
        """A sparse scan, of a sensor with fewer beams, as an image of this model's sensor, as `LidarModel.upsample`."""
        image, known = sparse_image(scan, sensor_that_made(scan, sensor_in), self.sensor)
        return self.complete(image, known, method, steps, seed=seed, on_step=on_step)

    def image_of(self, scan: Scan | RangeImage) -> RangeImage:
        """The scan in this model's image. Raises ValueError for an image of another size."""
        return image_in(scan, self.sensor, self.experiment.data.projection)

    def generation_steps(self, steps: int | None = None, sampler: str | None = None) -> int:
        """Raises ValueError, as `generate`."""
        raise self._generates_nothing()

    def evaluations(self, method: str = "auto", steps: int | None = None, resamples: int = 10) -> int:
        """1, whatever is filled. Raises ValueError for another method or more steps."""
        if method != "auto" or steps not in (None, 1):
            raise ValueError(f"{self.experiment.name}: expected method auto and 1 step, found {method} and {steps}")
        return 1

    def _generates_nothing(self) -> ValueError:
        return ValueError(f"{self.experiment.name}: expected a model that makes scans from noise, found an "
                          f"interpolation; use complete or upsample")  # fmt: skip
