"""Synthetic streets as a reader: scan i of seed s, the same on every machine, for any sensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from operator import index as index_of

import numpy as np

from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import FULL_TURNS, SENSORS, Sensor, get_sensor
from lidarsynth.streets.areas import TODAY, Density
from lidarsynth.streets.layout import build
from lidarsynth.streets.raycast import Caster, embree
from lidarsynth.streets.sensor_model import OPTICS, Optics
from lidarsynth.streets.turn import Turn, perfect, shoot
from lidarsynth.streets.world import POSES, THING, World, visible

FULL_TURN = FULL_TURNS["hdl-64e-kitti"]


def whole(name: str, number: int, least: int) -> int:
    """The number as Python's own. Raises ValueError for one that is not whole, or below `least`."""
    try:
        number = index_of(number)
    except TypeError:
        raise ValueError(f"expected a whole number as {name}, found {number!r:.60}") from None
    if number < least:
        raise ValueError(f"expected {name} of at least {least}, found {number}")
    return number


class Worlds:
    """Worlds of a seed by number, without what `sensor` cannot see; the last two are kept.

    built  makes the world of a number, whole; None = a street's

    Raises ValueError for a sensor that cannot stand on a road, ImportError naming the extra when embreex is missing.
    """

    def __init__(
        self,
        seed: int,
        sensor: Sensor,
        without: tuple[str, ...] = (),
        density: Density = TODAY,
        built: Callable[[int], World] | None = None,
    ):
        if not 0 < sensor.mount < sensor.max_range:
            raise ValueError(f"sensor {sensor.name}: expected a mount above the road and within its range of it, 0 to "
                             f"{sensor.max_range:g} m, found {sensor.mount:g}")  # fmt: skip
        embree()
        self.seed, self.sensor, self.without, self.density = seed, sensor, without, density
        self._built = built or self._street
        self._kept: dict[int, tuple[World, Caster]] = {}

    def __getitem__(self, number: int) -> tuple[World, Caster]:
        if number not in self._kept:
            world = self._built(number)
            world = _emptied(world, [CLASS_NUMBER[word] for word in self.without])
            if len(self._kept) >= 2:
                self._kept.pop(next(iter(self._kept)))
            self._kept[number] = (world, Caster(world.corners))
        return self._kept[number]

    def _street(self, number: int) -> World:
        return visible(build(np.random.default_rng((self.seed, number)), self.density), self.sensor)


class SyntheticStreets:
    """A reader over procedural streets: `len`, `[i] -> Scan`, and `image(i) -> RangeImage` of the same place.

    seed    any integer >= 0; streets of different seeds are unrelated
    length  number of scans; scan i does not depend on it
    sensor  beams, offsets, range limits, columns and mounting height, or its word
    without words of SemanticKITTI classes, such as `car`: things of these are taken away, all else stays where it is
    optics  how well the sensor sees
    worlds  of this seed, to share with other sensors
    apart   every scan has a world of its own, as statistics of independent scans want it

    Else sixteen consecutive scans are sixteen places in one world, and reading in order builds each world once.
    Raises IndexError beyond the length, ImportError naming the extra when embreex is missing, ValueError for others.
    """

    def __init__(
        self,
        seed: int = 0,
        length: int = 1000,
        sensor: Sensor | str = SENSORS["hdl-64e-kitti"],
        without: tuple[str, ...] = (),
        apart: bool = False,
        optics: Optics = OPTICS,
        worlds: Worlds | None = None,
    ):
        seed, length, sensor = whole("seed", seed, 0), whole("length", length, 1), get_sensor(sensor)
        if unknown := [word for word in without if word not in CLASS_NUMBER]:
            raise ValueError(f"expected classes of {', '.join(CLASS_NUMBER)}, found {unknown[0]!r}")
        self.without = without
        self.apart = apart
        self.optics = optics
        self.seed = seed
        self.length = length
        self.sensor = sensor
        self._worlds = worlds or Worlds(seed, sensor, without)

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> Scan:
        """The full turn of 2083 azimuth steps (or the sensor's own columns if more), ring by ring from the top.

        Points of one ring run counter-clockwise from straight ahead, as in KITTI's files; `ring`, `label` filled.
        """
        width = max(FULL_TURN, self.sensor.width)
        sensor = self.sensor.resized(width=width)
        turn = self._shoot(index, sensor)
        rows = np.broadcast_to(np.arange(sensor.height)[:, None], (sensor.height, width))
        order = np.roll(np.arange(width)[::-1], width // 2)
        hit = (turn.distance > 0)[:, order]
        label = turn.label[:, order][hit].astype(np.int64)
        points, reflectance = turn.points[:, order][hit], turn.reflectance[:, order][hit]
        return Scan(points, reflectance, ring=rows[hit].astype(np.int64), label=label)

    def image(self, index: int) -> RangeImage:
        """(H, W) image of scan `index` with one ray per pixel, row = beam; no `xyz`, pixels hold the rays' ranges."""
        return _image(self._shoot(index, self.sensor), self.sensor)

    def pair(self, index: int) -> tuple[RangeImage, RangeImage]:
        """`(perfect, seen)`, (H, W) images of the same rays: as a simulator casts them, and `image(index)`.

        perfect  the exact range and class of what each ray meets first within the sensor's limits, panes included,
                 reflectance 0; what the carrier itself blocks is empty, as in `seen`
        seen     may lack it, look through a pane, and errs by the sensor's noise
        """
        turn = self._shoot(index, self.sensor)
        return _image(perfect(turn, self.sensor), self.sensor), _image(turn, self.sensor)

    def _shoot(self, index: int, sensor: Sensor) -> Turn:
        """Returns of all H * W rays."""
        if not 0 <= index < self.length:
            raise IndexError(f"expected a scan number in 0..{self.length - 1}, got {index}")
        if self.apart:
            index = POSES * index + index % POSES
        world, caster = self._worlds[index // POSES]
        rng = np.random.default_rng((self.seed, index, 1))
        pose = world.poses[index % POSES]
        return shoot(world, caster, sensor, self.optics, rng, pose[None])


def _image(turn: Turn, sensor: Sensor) -> RangeImage:
    x, y, z = np.moveaxis(turn.points, -1, 0)
    distance = np.sqrt(x * x + y * y + z * z)
    return RangeImage(distance, turn.reflectance, turn.distance > 0, sensor, turn.label.astype(np.int64))


def _emptied(world: World, labels: list[int]) -> World:
    """The world with the things of these labels shrunk to a point below it; triangles keep their numbers."""
    gone = (world.kind == THING) & np.isin(world.label, labels)
    below = np.array([0, 0, -1000], np.float32)
    return replace(world, corners=np.where(gone[:, None, None], below, world.corners)) if gone.any() else world
