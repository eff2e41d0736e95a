"""What the verbs `complete` and `upsample` do with one scan: hide, fill, compare with interpolation, draw."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lidarsynth.lidar.columns import as_scanned
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.lidar.marks import were_new
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.recognition import lies_on, recognise
from lidarsynth.lidar.removal import in_words, own_classes
from lidarsynth.lidar.scan import RangeImage, Scan, check_seen
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import Sensor, get_sensor
from lidarsynth.pictures.portrait import before_and_after, portrait
from lidarsynth.systems.filling import Filling

if TYPE_CHECKING:
    from lidarsynth.metrics.reconstruction import Errors
    from lidarsynth.systems.scan_model import OnStep, ScanModel

DEFAULT = Filling()  # whatever the model does best


@dataclass(frozen=True)
class Filled:
    """A scan made dense.

    image   in the model's sensor, measured pixels exactly as they were
    drawn   gives the images of the picture by caption: before, after and, where known, the truth
    errors  of the hidden pixels by method, where the truth is known
    given   the scan, where its points are to be drawn and counted for the first image, which holds one a pixel
    """

    image: RangeImage
    drawn: Callable[[], Mapping[str, RangeImage]]
    errors: Mapping[str, Errors]
    given: Scan | None = None

    @property
    def shown(self) -> Mapping[str, RangeImage]:
        """The images of the picture by caption, made anew."""
        return self.drawn()

    @property
    def points(self) -> Scan:
        """Every measured point, bit by bit, and the new ones; where a corruption hid some, the image's points."""
        return self.image.to_scan()

    def figure(self) -> np.ndarray:
        """(H', W', 3) uint8: strips, 3-D and bird's eye views of before, after and, where known, the truth; of an image
        alone, its portrait."""
        shown = self.shown
        if len(shown) == 1:
            return portrait(self.image)
        after = next(name for name, image in shown.items() if image is self.image)
        before = {} if self.given is None else {next(iter(shown)): self.given}
        return before_and_after(shown, before | {after: self.points})


def complete_scan(
    model: ScanModel,
    scan: Scan,
    recipe: str | None = None,
    how: Filling = DEFAULT,
    on_step: OnStep = None,
    sensor: Sensor | None = None,
    least: float | None = None,
) -> Filled:
    """Fill a scan; with a corruption `recipe` hide part of it first and judge the hidden pixels against it: of beams
    that returned anything, for others, as of a thinned scan, say nothing of the truth.

    sensor  that made the scan, for a model of any sensor; None = as recognised
    least   confidence of new points that stay; None = all

    Raises ValueError when no point is in view, the recipe hides no point or all of them, or `least` meets a model
    without confidences.
    """
    model = model.suited_to(scan, sensor)
    if recipe is None:
        filled = _sure(model.filled(scan, how, on_step=on_step), least)
        done = f"completed without {in_words(how.removed)}" if how.removed else "completed"
        return Filled(filled, lambda: {"measured": _measured(model, scan, filled, how), done: filled}, {}, scan)
    truth = check_seen(model.image_of(scan), len(scan))
    known, judge = hidden_part(truth, recipe, how.seed)
    before = truth.keep(known)
    whole = model.filled(before, how, known, on_step)
    filled = _sure(whole, least)
    shown = {f"input, {recipe}": before, "completed": filled, "truth": truth}
    errors = judged(whole, before, known, truth, judge)  # of the whole: what is left out would count as 0 m
    if not truth.reflectance.any():  # nobody knows what it was
        errors = {name: _of_range(error) for name, error in errors.items()}
    elif not model.experiment.data.reflectance:
        errors["lidarsynth"] = _of_range(errors["lidarsynth"])
    return Filled(filled, lambda: shown, errors)


def hidden_part(truth: RangeImage, recipe: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels (H, W) bool stay known, and which hidden ones can be judged, both of beams that returned anything.

    Raises ValueError for a recipe that hides no measured pixel, or all of them.
    """
    rows = np.flatnonzero(truth.mask.any(1))
    beams = RangeImage(truth.range[rows], truth.reflectance[rows], truth.mask[rows], truth.sensor.rows(rows.tolist()))
    known, judge = np.zeros(truth.shape, bool), np.zeros(truth.shape, bool)
    known[rows] = corrupt(beams, recipe, seed)
    judge[rows] = ~known[rows]
    hides, leaves = (truth.mask & judge).any(), (truth.mask & known).any()
    if not (hides and leaves):
        found = "every" if hides else "none"
        raise ValueError(f"expected a corruption that hides some of the measured pixels, found {recipe!r}, which hides "
                         f"{found}")  # fmt: skip
    return known, judge


def taken_away(scan: Scan, filled: RangeImage, how: Filling, model: str) -> str:
    """How many points of a scan were taken away, of which classes, and who said so, in words; '' where nothing was to
    be."""
    if how.removed is None:
        return ""
    left, label = filled.to_scan(), own_classes(scan)
    earlier, now = (part.xyz[were_new(part) > 0] for part in (scan, left))  # no number tells these from what was filled
    gone = len(scan) - len(earlier) - (len(left) - len(now))
    if label is None:
        there = {point.tobytes() for point in now}
        gone += sum(point.tobytes() not in there for point in earlier)
    else:
        words = [CLASS_NUMBER[word] for word in how.removed]
        gone += int(np.isin(label[were_new(scan) > 0], words).sum())
    who = f"{model} names" if label is None else "its labels name"
    return f"took away {gone} of {len(scan)} points, {in_words(how.removed)} as {who} them"


def check_confident(model: ScanModel, how: Filling, least: float | None) -> None:
    """Raises ValueError where new points are to have a `least` confidence that the model cannot give."""
    name = model.experiment.name
    if least is None:
        return
    if not 0 <= least <= 1:
        raise ValueError(f"expected --min-confidence of 0 to 1, found {least:g}")
    if model.experiment.confidence is None:
        raise ValueError(f"{name}: expected a model with confidences, such as default, for --min-confidence, found one "
                         "without")  # fmt: skip
    if how.method not in ("auto", "conditional"):
        raise ValueError(f"{name}: expected --method conditional for --min-confidence, found {how.method}")


def _of_range(errors: Errors) -> Errors:
    return replace(errors, reflectance_mae=math.nan, reflectance_rmse=math.nan)


def _sure(filled: RangeImage, least: float | None) -> RangeImage:
    return filled if least is None else filled.surer_than(least)


def _measured(model: ScanModel, scan: Scan, filled: RangeImage, how: Filling) -> RangeImage:
    """The scan's own image: the pixels of a filled one that hold measured points, where it has all and says which. A
    reflectance that the model gave them was not measured."""
    if filled.xyz is None or how.removed is not None:
        return model.image_of(scan)
    x, y, z = np.moveaxis(filled.xyz, -1, 0)
    image = filled.keep((x != 0) | (y != 0) | (z != 0))
    return image if scan.reflectance.any() else replace(image, reflectance=np.zeros_like(image.reflectance))


def judged(
    filled: RangeImage, before: RangeImage, known: np.ndarray, truth: RangeImage, judge: np.ndarray
) -> dict[str, Errors]:
    """Errors of the pixels to `judge`: of the model, of each interpolation of `known`, and of leaving them empty."""
    from lidarsynth.metrics.reconstruction import reconstruction_errors
    from lidarsynth.networks.interpolation import METHODS
    from lidarsynth.systems.interpolation.model import interpolated

    results = {"lidarsynth": filled}
    results |= {name: interpolated(before, known, name) for name in METHODS}
    return {name: reconstruction_errors(r, truth, judge) for name, r in {**results, "left empty": before}.items()}


def upsample_scan(
    model: ScanModel,
    scan: Scan,
    sensor_in: Sensor,
    how: Filling = DEFAULT,
    on_step: OnStep = None,
    times: int | None = None,
    least: float | None = None,
) -> Filled:
    """Make a scan of `sensor_in`, which may have other beams than the model's, dense.

    least  as in `complete_scan`

    Raises ValueError when no point is in the model's view, or `least` meets a model without confidences.
    """
    filled = _sure(model.upsampled(scan, how, sensor_in, on_step, times), least)

    def drawn() -> dict[str, RangeImage]:
        measured = project(replace(scan, ring=None), filled.sensor, "spherical")
        return {f"measured, {sensor_in.name}": measured, "upsampled": filled}

    return Filled(filled, drawn, {}, scan)


def named_sensor(scan: Scan, path: Path, flag: str, given: Sensor | str | None, own: Sensor | None = None) -> Sensor:
    """The sensor of a scan file: the given one, else as recognised, else a model's `own` where the points lie on its
    beams. Raises ValueError that asks for the flag."""
    if given is None:
        given, reason = recognise(scan, path)
        if given is None and own is not None and lies_on(scan, own):
            return own
        if given is None:
            raise ValueError(reason.replace("--sensor", flag))
        return as_scanned(scan, get_sensor(given))
    return get_sensor(given)
