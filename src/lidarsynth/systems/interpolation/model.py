"""`InterpolationModel`: nearest, bilinear and bicubic interpolation as models without weights; the baselines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from lidarsynth.experiment.record import Experiment
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.interpolation import RESIZED, Interpolation, interpolate, resize_rows
from lidarsynth.systems.any_sensor import AnySensorModel
from lidarsynth.systems.description import Description
from lidarsynth.systems.filling import Filling
from lidarsynth.systems.interpolation.description import DESCRIPTION
from lidarsynth.systems.known_pixels import with_known
from lidarsynth.systems.scan_model import OnStep


def interpolated(image: RangeImage, known: np.ndarray, method: str) -> RangeImage:
    """The baseline: range in metres and reflectance interpolated from the known pixels, empty ones as 0.

    known (H, W) bool; method `nearest`, `bilinear` or `bicubic`, of which known pixels stay; or one of `RESIZED`, of
    which they do not, and which are of every k-th beam from the first one alone. Negative overshoots become empty.
    Raises ValueError for other known pixels with these.
    """
    pixels = torch.from_numpy(np.stack([image.range, image.reflectance]))[None].float()
    if method in RESIZED:
        step = _step(known, method)
        filled = resize_rows(pixels[:, :, ::step], len(known), method.removeprefix("resized-"))
    else:
        filled = interpolate(pixels, torch.from_numpy(known).expand(pixels.shape), method)
    distance, reflectance = filled[0].clamp(min=0).numpy()
    return RangeImage(distance, reflectance.clip(0, 1), distance > 0, image.sensor)


def _step(known: np.ndarray, method: str) -> int:
    """k, of known pixels (H, W) bool in every k-th row. Raises ValueError for others."""
    rows = np.flatnonzero(known.any(axis=1))
    step = int(rows[1]) if len(rows) > 1 else len(known)
    if len(known) % step or not np.array_equal(rows, np.arange(0, len(known), step)) or not known[rows].all():
        raise ValueError(f"{method}: expected every k-th beam from the first one, such as beams:4 leaves, found others")
    return step


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
