"""Beams of a recognised sensor that lie elsewhere in a scan than in the table: of another unit, or another frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarsynth.lidar.projection import is_even_grid
from lidarsynth.lidar.recognition import FAR, beams_of, first_row, rings_in_order, spacing
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import Sensor

OFF = 0.5  # degrees, and half the spacing: rings that lie farther off are another beam's
POINTS, FEWEST = 30_000, 20  # of a scan are enough, evenly from all; of a ring, beyond FAR: fewer say nothing of it


def stray_rings(scan: Scan, sensor: Sensor) -> str | None:
    """In one line that rings of a scan lie off the sensor's beams, or None."""
    row, measured = _strays(scan, sensor)
    if not len(row):
        return None
    most = float(np.abs(measured - np.array(sensor.elevations)[row]).max())
    which = ", ".join(map(str, row[:4])) + (", ..." if len(row) > 4 else "")
    return (
        f"expected rings on the beams of {sensor.name}, found {len(row)} of {sensor.height} up to {most:.1f} degrees "
        f"off ({which}): learn the sensor, lidarsynth sensor SCANS --out my.toml"
    )


def own_beams(scan: Scan, sensor: Sensor) -> Sensor:
    """The sensor with the beams of stray rings where the scan has them, as far as elevations stay falling."""
    row, measured = _strays(scan, sensor)
    table = np.array(sensor.elevations)
    own = table.copy()
    own[row] = measured
    while (wrong := np.flatnonzero(np.diff(own) >= 0)).size:  # at the latest the table itself falls
        beside = np.union1d(wrong, wrong + 1)
        own[beside] = table[beside]
    return replace(sensor, elevations=tuple(own.tolist())) if len(row) else sensor


def _strays(scan: Scan, sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the rings that lie off their beams, and their median elevations in degrees.

    Only where `project` takes rows from rings: else elevations find the nearest beam.
    A ring lies off where three quarters of its points do, to one side.
    """
    scan = scan[:: max(len(scan) // POINTS, 1)]
    ring = scan.ring if scan.ring is not None else rings_in_order(scan.xyz)
    far = np.hypot(scan.xyz[:, 0], scan.xyz[:, 1]) > FAR
    first = None
    if ring is not None and far.any() and sensor.height > 1 and not is_even_grid(sensor):
        usual = 0 if ring.max() + 1 == sensor.height else None
        first = usual if scan.ring is None else first_row(ring, scan.xyz, sensor)
    if ring is None or first is None:
        return np.zeros(0, int), np.zeros(0)
    row, beams = beams_of(scan.xyz[far], ring[far] + first, FEWEST)
    inside = (row >= 0) & (row < sensor.height)
    row, beams = row[inside], beams[inside]
    height = np.array(sensor.offsets or (0.0,) * sensor.height)[row]
    level = np.hypot(beams[..., 0], beams[..., 1])
    elevation = np.degrees(np.arctan2(beams[..., 2] - height[:, None], level))
    low, middle, high = np.quantile(elevation, (0.25, 0.5, 0.75), axis=1)
    beam = np.array(sensor.elevations)[row]
    stray = np.maximum(low - beam, beam - high) > np.maximum(OFF, spacing(sensor)[row] / 2)
    return row[stray], middle[stray]
