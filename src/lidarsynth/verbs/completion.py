"""What the verbs `complete` and `upsample` do with one scan: hide, fill, compare with interpolation, draw."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lidarsynth.lidar.corruption import corrupt
from lidarsynth.lidar.projection import project, row_of_points
from lidarsynth.lidar.recognition import recognise
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import Sensor, get_sensor
from lidarsynth.metrics.reconstruction import Errors, reconstruction_errors
from lidarsynth.networks.interpolation import METHODS
from lidarsynth.pictures.portrait import before_and_after
from lidarsynth.systems.gan.model import GanModel
from lidarsynth.systems.interpolation.model import InterpolationModel, interpolated
from lidarsynth.systems.scan_model import OnStep, ScanModel, sparse_image
from lidarsynth.systems.upsampling.model import UpsamplingModel


@dataclass(frozen=True)
class Filled:
    """A scan made dense.

    image   in the model's sensor, measured pixels exactly as they were
    points  every measured point, bit by bit, and the new ones; row by row of the image, points out of view last.
            Where a corruption hid measurements to judge the result, the image's points
    shown   the images of the picture by caption: before, after and, where known, the truth
    errors  of the hidden pixels by method, where the truth is known
    """

    image: RangeImage
    points: Scan
    shown: Mapping[str, RangeImage]
    errors: Mapping[str, Errors]

    def figure(self) -> np.ndarray:
        """(H', W', 3) uint8: strips, 3-D and bird's eye views of before, after and, where known, the truth."""
        after = next(name for name, image in self.shown.items() if image is self.image)
        return before_and_after(self.shown, {after: self.points})


def complete_scan(
    model: ScanModel,
    scan: Scan,
    recipe: str | None = None,
    method: str = "auto",
    steps: int | None = None,
    resamples: int = 10,
    seed: int = 0,
    on_step: OnStep = None,
) -> Filled:
    """Fill a scan; with a corruption `recipe` hide part of it first and judge the hidden pixels against it.

    Without a recipe a ray with any point, also one beyond the range limits, is known: nothing is put before it.
    Raises ValueError when no point is in view, or the recipe hides nothing.
    """
    truth = model.image_of(scan)
    if not truth.mask.any():
        raise ValueError(f"expected points within {model.sensor.name}'s view, found none of {len(scan)} points")
    projection = model.experiment.data.projection
    if recipe is None:
        known = _rays_with_points(scan, model, projection)
        filled = model.complete(truth, known, method, steps, resamples, seed=seed, on_step=on_step)
        points = with_measured(scan, truth.mask, filled, projection)
        return Filled(filled, points, {"measured": truth, "completed": filled}, {})
    known = corrupt(truth, recipe, seed)
    if known.all():
        raise ValueError(f"expected a corruption that hides at least one pixel, found {recipe!r}")
    before = truth.keep(known)
    filled = model.complete(before, known, method, steps, resamples, seed=seed, on_step=on_step)
    shown = {f"input, {recipe}": before, "completed": filled, "truth": truth}
    return Filled(filled, filled.to_scan(), shown, judged(filled, before, known, truth))


def judged(filled: RangeImage, before: RangeImage, known: np.ndarray, truth: RangeImage) -> dict[str, Errors]:
    """Errors of the pixels outside `known`: of the model, of each interpolation, and of leaving them empty."""
    results = {"lidarsynth": filled}
    results |= {name: interpolated(before, known, name) for name in METHODS}
    return {name: reconstruction_errors(r, truth, ~known) for name, r in {**results, "left empty": before}.items()}


def upsample_scan(
    model: ScanModel,
    scan: Scan,
    sensor_in: Sensor,
    method: str = "auto",
    steps: int | None = None,
    resamples: int = 10,
    seed: int = 0,
    on_step: OnStep = None,
) -> Filled:
    """Make a scan of `sensor_in`, which may have other beams than the model's, dense.

    Raises ValueError when no point is in the model's view.
    """
    sparse, known = sparse_image(scan, sensor_in, model.sensor)
    loose = replace(scan, ring=None)  # its rings are not the model's
    known |= _rays_with_points(loose, model, "spherical")
    if isinstance(model, UpsamplingModel):  # it looks at the beams of sensor_in, not at their shadows in its image
        filled = model.upsample(scan, sensor_in, method, steps, seed, on_step)
    else:
        filled = model.complete(sparse, known, method, steps, resamples, seed=seed, on_step=on_step)
    points = with_measured(loose, sparse.mask, filled, "spherical")
    return Filled(filled, points, {f"measured, {sensor_in.name}": sparse, "upsampled": filled}, {})


def into_sensor(model: ScanModel, sensor: str) -> ScanModel:
    """The model with images of another sensor. Raises ValueError for a network that knows the rays of its own only."""
    if isinstance(model, UpsamplingModel | InterpolationModel | GanModel):
        return model.into(sensor)
    raise ValueError(f"{model.experiment.name}: expected a model of any sensor, such as iln, lidar-sr or bilinear, for "
                     f"--to {sensor}, found one of {model.sensor.name} only")  # fmt: skip


def named_sensor(scan: Scan, path: Path, flag: str, given: str | None) -> Sensor:
    """The sensor of a scan file: the given one, else as recognised. Raises ValueError that asks for the flag."""
    if given is None:
        given, reason = recognise(scan, path)
        if given is None:
            raise ValueError(reason.replace("--sensor", flag))
    return get_sensor(given)


def _rays_with_points(scan: Scan, model: ScanModel, projection: str) -> np.ndarray:
    """(H, W) bool: pixels that any point falls into, at whatever range."""
    return project(scan, replace(model.sensor, min_range=0.0, max_range=math.inf), projection).mask


def with_measured(scan: Scan, measured: np.ndarray, filled: RangeImage, projection: str) -> Scan:
    """Every point of the scan bit by bit, and the pixels of `filled` outside `measured` (H, W) bool as new points.

    Points come row by row, each row from behind over the left; those above or below the view come last, and only
    without any there is a `ring`, the row. A scan without reflectance takes that of its pixels.
    """
    new = replace(filled, mask=filled.mask & ~measured).to_scan()
    row = row_of_points(scan, filled.sensor, projection)
    reflectance = scan.reflectance
    if not reflectance.any():
        turn = (1 - np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0]) / np.pi) / 2
        column = (turn * filled.sensor.width).astype(int).clip(0, filled.sensor.width - 1)
        reflectance = np.where(row >= 0, filled.reflectance[row, column], reflectance)
    assert new.ring is not None
    xyz = np.concatenate([scan.xyz, new.xyz])
    ring = np.concatenate([np.where(row < 0, filled.sensor.height, row), new.ring])
    order = np.lexsort((-np.arctan2(xyz[:, 1], xyz[:, 0]), ring))
    both = Scan(xyz, np.concatenate([reflectance, new.reflectance]), ring=None if (row < 0).any() else ring)
    return both[order]
