"""Scans without what is of some classes: its points taken away, and what stands behind it filled in."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from lidarsynth.experiment.record import Experiment
from lidarsynth.lidar.columns import usual_at_most
from lidarsynth.lidar.measured import with_measured
from lidarsynth.lidar.point_classes import class_of_points
from lidarsynth.lidar.projection import Pixels, occupied, pixel_of_points
from lidarsynth.lidar.removal import hidden_behind, in_the_way, in_whole_pieces, own_classes
from lidarsynth.lidar.scan import RangeImage, Scan, check_seen
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.systems.filling import Filling, OnStep
from lidarsynth.systems.known_pixels import known_pixels, with_own_classes


class Fills(Protocol):
    """What is asked of a model here; see `ScanModel`."""

    sensor: Sensor
    experiment: Experiment

    def image_of(self, scan: Scan | RangeImage, pixels: Pixels | None = None) -> RangeImage: ...

    def named(self, scan: Scan, sensor: Sensor | str | None = None, least: float = 0.0) -> RangeImage: ...

    def fill(self, image: RangeImage, known: np.ndarray, how: Filling, on_step: OnStep = None) -> RangeImage: ...


def emptied(
    model: Fills, scan: Scan | RangeImage, how: Filling, known: np.ndarray | None = None, on_step: OnStep = None
) -> RangeImage:
    """`complete` where `how` names classes to take away: no other ray is filled, but those not `known` (H, W) bool.

    Of which class a point is, the scan's labels say, else the model, whose classes are taken piece by piece. What is
    filled in nearer than what was taken away cannot be, and is left out. Raises ValueError for a model without classes
    where there are no labels.
    """
    gone = [CLASS_NUMBER[word] for word in how.removed or ()]
    if isinstance(scan, RangeImage):
        image, away = model.image_of(scan), np.zeros(scan.shape, bool)
        away[image.mask] = _going(model, replace(image, completed=None).to_scan(), gone)
        return _image_emptied(model, image, away, known, how, on_step)
    goes = _going(model, scan, gone)
    pixels = pixel_of_points(scan, model.sensor, model.experiment.data.projection)
    image = model.image_of(replace(scan, label=goes.astype(np.int64)), pixels)
    assert image.label is not None
    away = image.label == 1
    if known is not None:
        return _image_emptied(model, image, away, known, how, on_step)
    rest, at = scan[~goes], (pixels[0][~goes], pixels[1][~goes])
    left = model.image_of(rest, at)
    told = ~hidden_behind(image, away) | left.mask | occupied(rest, model.sensor, at)
    filled = _filled(model, left, told, image, away, how, on_step)
    return replace(filled, completed=with_measured(rest, left.mask, filled, at))


def _image_emptied(
    model: Fills, image: RangeImage, away: np.ndarray, known: np.ndarray | None, how: Filling, on_step: OnStep
) -> RangeImage:
    """`emptied` of an image of which the pixels `away` (H, W) bool go."""
    told = np.ones(image.shape, bool) if known is None else known_pixels(image, known)
    return _filled(model, image, told & ~hidden_behind(image, away), image, away, how, on_step)


def _going(model: Fills, scan: Scan, gone: list[int]) -> np.ndarray:
    """(N,) bool: points of the classes `gone`."""
    if (label := own_classes(scan)) is not None:
        return np.isin(label, gone)
    named = model.named(scan, usual_at_most(model.sensor))
    assert named.label is not None
    away = in_whole_pieces(named, np.isin(named.label, gone) & named.mask)
    pixels = pixel_of_points(scan, named.sensor, model.experiment.data.projection)
    return class_of_points(scan.xyz, replace(named, label=away.astype(np.int64)), pixels) == 1


def _filled(
    model: Fills,
    left: RangeImage,
    told: np.ndarray,
    image: RangeImage,
    away: np.ndarray,
    how: Filling,
    on_step: OnStep,
) -> RangeImage:
    """What is left, filled where it is not `told` (H, W) bool; `away` (H, W) bool, pixels of `image` that are gone."""
    count = int(image.mask.sum())
    left = check_seen(left.keep(told), count)
    filled = with_own_classes(model.fill(left, told, how, on_step), left)
    return filled.keep(~in_the_way(filled, image, away & ~told))
