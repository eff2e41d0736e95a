"""What the verbs `complete` and `upsample` do with one scan: hide, fill, compare with interpolation, draw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from lidarsynth.data.recognise import recognise
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.lidar.figure import compare
from lidarsynth.lidar.projection import project, row_of_points
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import get_sensor
from lidarsynth.metrics.reconstruction import Errors, reconstruction_errors
from lidarsynth.model import LidarModel, OnStep
from lidarsynth.models.interpolation import interpolate

BASELINES = ("nearest", "bilinear", "bicubic")


@dataclass(frozen=True)
class Completed:
    """A filled scan, the pictures around it by caption, and the errors by method where the truth is known."""

    image: RangeImage
    shown: Mapping[str, RangeImage]
    errors: Mapping[str, Errors]

    def figure(self) -> np.ndarray:
        """(H', W', 3) uint8: before, after and, where known, the truth."""
        return compare(self.shown)


@dataclass(frozen=True)
class Upsampled:
    """A dense image of a sparse scan, and its points with those outside the model's view as they were measured."""

    image: RangeImage
    points: Scan
    sensor: str  # that made the sparse scan
    before: RangeImage

    def figure(self) -> np.ndarray:
        """(H', W', 3) uint8: before and after."""
        return compare({f"measured ({self.sensor})": self.before, "upsampled": self.image})


def interpolated(image: RangeImage, known: np.ndarray, method: str) -> RangeImage:
    """The baseline: range in metres and reflectance interpolated from the known pixels, empty ones as 0.

    known (H, W) bool; method `nearest`, `bilinear` or `bicubic`. Negative overshoots become empty.
    """
    pixels = torch.from_numpy(np.stack([image.range, image.reflectance]))[None].float()
    mask = torch.from_numpy(known).expand(pixels.shape)
    distance, reflectance = interpolate(pixels, mask, method)[0].clamp(min=0).numpy()
    filled = distance > 0
    return RangeImage(distance, reflectance.clip(0, 1), filled, image.sensor)


def complete_file(
    model: LidarModel,
    scan: Scan,
    recipe: str | None = None,
    method: str = "auto",
    steps: int | None = None,
    resamples: int = 10,
    seed: int = 0,
    on_step: OnStep = None,
) -> Completed:
    """Fill a scan; with a corruption `recipe` hide part of it first and judge the hidden pixels against it."""
    truth = model.image_of(scan)
    if recipe is None:
        filled = model.complete(truth, None, method, steps, resamples, seed=seed, on_step=on_step)
        return Completed(filled, {"measured": truth, "completed": filled}, {})
    known = corrupt(truth, recipe, seed)
    before = truth.keep(known)
    filled = model.complete(before, known, method, steps, resamples, seed=seed, on_step=on_step)
    errors = {"lidarsynth": reconstruction_errors(filled, truth, ~known)}
    for baseline in BASELINES:
        errors[baseline] = reconstruction_errors(interpolated(before, known, baseline), truth, ~known)
    return Completed(filled, {f"input, {recipe}": before, "completed": filled, "truth": truth}, errors)


def upsample_file(
    model: LidarModel,
    scan: Scan,
    sensor_in: str | None = None,
    method: str = "auto",
    steps: int | None = None,
    seed: int = 0,
    on_step: OnStep = None,
) -> Upsampled:
    """Make a sparse scan dense. Raises ValueError when its sensor is neither named nor recognised."""
    if sensor_in is None:
        sensor_in, reason = recognise(scan)
        if sensor_in is None:
            raise ValueError(reason.replace("--sensor", "--from"))
    sensor = get_sensor(sensor_in)
    filled = model.upsample(scan, sensor, method, steps, seed=seed, on_step=on_step)
    outside = outside_view(scan, model)
    added = filled.to_scan()
    points = Scan(
        np.concatenate([added.xyz, scan.xyz[outside]]),
        np.concatenate([added.reflectance, scan.reflectance[outside]]),
    )
    return Upsampled(filled, points, sensor.name, project(replace(scan, ring=None), model.sensor, "spherical"))


def outside_view(scan: Scan, model: LidarModel) -> np.ndarray:
    """(N,) bool: points above or below the beams of the model's sensor, or beyond its range limits."""
    depth = np.linalg.norm(scan.xyz, axis=1)
    far = (depth < model.sensor.min_range) | (depth > model.sensor.max_range)
    return far | (row_of_points(scan, model.sensor, "spherical") < 0)
