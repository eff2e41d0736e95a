"""What the verb `realise` does with one simulated scan: leave out what no sensor would report, and light the rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lidarsynth.files.fields import PLACE, Fields, find
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.verbs.completion import Filled
from lidarsynth.verbs.inputs import Loaded

if TYPE_CHECKING:
    from lidarsynth.systems.scan_model import ScanModel


def realise_scan(model: ScanModel, scan: Scan, sensor: Sensor, seed: int = 0) -> Filled:
    """A perfect scan as `sensor` would have reported it.

    Raises ValueError as `ScanModel.realise` does, and where nothing returns.
    """
    real = model.realised(scan, sensor, seed)
    if not len(real.to_scan()):
        raise ValueError(f"expected points of which some return, found that none of {len(scan)} does")
    return Filled(real, lambda: {"simulated": project(scan, real.sensor), f"as {sensor.name} sees it": real}, {})


def realised_fields(real: Scan, loaded: Loaded) -> Fields:
    """A realised scan as the columns that its message had, bit by bit but for the intensity, in the message's scale."""
    given = loaded.given
    fields = {name: column[real.extra[PLACE] - 1] for name, column in given.items()}
    name = find(given, "reflectance")
    if name is None:
        return fields | {"intensity": real.reflectance}
    fields[name] = (real.reflectance * loaded.scale).astype(given[name].dtype)
    return fields
