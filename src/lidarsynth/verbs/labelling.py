"""What the verb `label` does with one scan: say what each of its points is of."""

from __future__ import annotations

import numpy as np

from lidarsynth.files.fields import Fields
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.systems.scan_model import ScanModel
from lidarsynth.verbs.completion import Filled


def label_scan(model: ScanModel, scan: Scan, sensor: Sensor) -> Filled:
    """A scan of `sensor` with a class for every point. Raises ValueError as `ScanModel.label` does."""
    named = model.named(scan, sensor)
    return Filled(named, lambda: {"classes": named}, {})


def labelled_fields(named: Scan, given: Fields) -> Fields:
    """A labelled scan as the columns that its message had, bit by bit, and `label`."""
    assert named.label is not None
    fields = {name: column[named.extra["point"]] for name, column in given.items()}
    return fields | {"label": named.label.astype(np.uint8)}
