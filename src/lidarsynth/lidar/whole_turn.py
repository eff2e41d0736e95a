"""Scans of a sensor that sees a sector of the turn alone, from whole turns."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sector import runs_of
from lidarsynth.lidar.sensor import Sensor


def whole_turn(sensor: Sensor) -> Sensor:
    """The sensor, where it sees a sector alone, if it saw all around: columns of which no ray returns are open. Layouts
    of streets are of whole turns."""
    rays = sensor.blocked_rays()
    shut = rays.all(axis=0)
    return replace(sensor, blocked=runs_of(rays & ~shut)) if shut.any() and not shut.all() else sensor


def within(images: Iterable[RangeImage], sensor: Sensor) -> Iterator[RangeImage]:
    """Images (H, W) of the `whole_turn` of a sensor as the sensor sees them, with the boxes of which it sees a part."""
    rays = ~sensor.blocked_rays()
    for image in images:
        if image.sensor != sensor:
            seen = image.keep(rays)
            image = replace(seen, sensor=sensor, boxes=tuple(box for box in seen.boxes if box.points))
        yield image
