"""What the verb `label` does with one scan: say what each of its points is of."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lidarsynth.files.fields import PLACE, Fields
from lidarsynth.lidar.plural import plural
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER, CLASSES
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.verbs.completion import Filled
from lidarsynth.verbs.inputs import Loaded

if TYPE_CHECKING:
    from lidarsynth.systems.scan_model import ScanModel

MOST = 4  # classes that are told


def label_scan(
    model: ScanModel, scan: Scan, sensor: Sensor, precision: str | None = None, least: float | None = None
) -> Filled:
    """A scan of `sensor` with a class for every point, or for those whose class has a `least` confidence. Raises
    ValueError as `ScanModel.label` does."""
    named = (model if precision is None else model.at_precision(precision)).named(scan, sensor, least or 0.0)
    return Filled(named, lambda: {"classes": named}, {})


def found(points: Scan, sensor: Sensor) -> str:
    """How much of the points is of the commonest classes, in words."""
    assert points.label is not None
    count = np.bincount(points.label, minlength=len(CLASSES))
    most = [k for k in np.argsort(-count) if k and count[k]][:MOST]
    named = "".join(f"{CLASSES[k][0]} {count[k] / len(points):.0%}, " for k in most)
    inside = ", as furniture is inside a building" if count[CLASS_NUMBER["other-ground"]] else ""  # a floor
    return f"{plural(len(points), 'point')} of {sensor.name}: {named}{count[0]} without a class{inside}"


def labelled_fields(named: Scan, loaded: Loaded) -> Fields:
    """A labelled scan as the columns that its message had, bit by bit, and `label`."""
    assert named.label is not None
    fields = {name: column[named.extra[PLACE] - 1] for name, column in loaded.given.items()}
    return fields | {"label": named.label.astype(np.uint8)}
