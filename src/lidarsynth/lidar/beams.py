"""Whether two sensors have the same beams."""

from __future__ import annotations

from lidarsynth.lidar.sensor import Sensor

CLOSE = 1e-4  # degrees: float32 rounds a beam by 1e-6, and no two sensors are measured so well


def same_beams(one: Sensor, other: Sensor) -> bool:
    """Whether both have as many beams, each within CLOSE of the other's, whatever their names, columns and limits."""
    pairs = zip(one.elevations, other.elevations, strict=False)
    return one.height == other.height and all(abs(a - b) <= CLOSE for a, b in pairs)
