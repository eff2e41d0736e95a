"""The rows of a scan's strip: its sensor's own beams where the scan tells them, else rows by elevation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarsynth.lidar.projection import row_of_points
from lidarsynth.lidar.recognition import elevations_of, recognise, rings_in_order
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import get_sensor

EVEN = 64  # rows of a scan that tells nothing of its beams
WIDTHS = (512, 1024, 2048, 4096)  # columns that a strip may have
FULL = 0.75  # columns, at least, by the points of a full beam: two returns, or points a pixel twice, add none
MOST = 1024  # rows; more are no beams


@dataclass(frozen=True)
class Rows:
    """Where points lie in the strip.

    row     (N,) int32, 0 the highest; -1 for a point in none
    height  rows; width: columns, the first looks backwards and the middle one ahead
    origin  in words, for the strip's caption
    """

    row: np.ndarray
    height: int
    width: int
    origin: str


def rows_of(scan: Scan) -> Rows:
    """By the `ring` field, else the order of the points, else a recognised sensor, else evenly by elevation."""
    ring, origin = scan.ring, "beams by the ring field"
    if ring is None and (ring := rings_in_order(scan.xyz)) is not None:
        origin = "beams by the order of the points"
    if ring is not None and 1 < (height := int(ring.max(initial=0)) + 1) <= MOST:
        return _rows(ring, height, origin)
    name = recognise(scan)[0]
    if name is not None:
        sensor = get_sensor(name)
        return _rows(row_of_points(scan, sensor, "spherical"), sensor.height, f"beams of {name}, recognised")
    return _rows(_even(scan), EVEN, "rows by elevation, as the scan does not tell its beams")


def _rows(row: np.ndarray, height: int, origin: str) -> Rows:
    counts = np.bincount(row[row >= 0], minlength=1)
    full = float(np.percentile(counts[counts > 0], 75)) if counts.any() else 0.0
    width = next((width for width in WIDTHS if width >= FULL * full), WIDTHS[-1])
    return Rows(row.astype(np.int32), height, width, origin)


def _even(scan: Scan) -> np.ndarray:
    elevation = elevations_of(scan.xyz)
    low, high = np.percentile(elevation, [0.5, 99.5]) if len(elevation) else (-1.0, 1.0)
    row = ((high - elevation) / max(high - low, 1e-3) * EVEN).astype(np.int32)
    return np.where((elevation > high) | (elevation < low), -1, np.minimum(row, EVEN - 1))
