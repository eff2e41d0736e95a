"""Synthetic streets as a reader: scan i of seed s, the same on every machine, for any sensor."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.streets import hdl64e
from lidarsynth.streets.layout import build
from lidarsynth.streets.materials import LABEL
from lidarsynth.streets.raycast import Caster
from lidarsynth.streets.sensor_model import OPTICS, Optics, Returns, sense
from lidarsynth.streets.world import POSES, THING, World, visible

FULL_TURN = 2083  # azimuth steps per turn of KITTI's sensor at 10 Hz


class Worlds:
    """Worlds of a seed by number, without what `sensor` cannot see; the last two are kept."""

    def __init__(self, seed: int, sensor: Sensor, without: tuple[str, ...] = ()):
        self.seed, self.sensor, self.without = seed, sensor, without
        self._kept: dict[int, tuple[World, Caster]] = {}

    def __getitem__(self, number: int) -> tuple[World, Caster]:
        if number not in self._kept:
            world = visible(build(np.random.default_rng((self.seed, number))), self.sensor)
            world = _emptied(world, [LABEL[word] for word in self.without])
            if len(self._kept) >= 2:
                self._kept.pop(next(iter(self._kept)))
            self._kept[number] = (world, Caster(world.corners))
        return self._kept[number]


class SyntheticStreets:
    """A reader over procedural streets: `len`, `[i] -> Scan`, and `image(i) -> RangeImage` of the same place.

    seed    any integer >= 0; streets of different seeds are unrelated
    length  number of scans; scan i does not depend on it
    sensor  beams, offsets, range limits, columns and mounting height
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
        sensor: Sensor = SENSORS["hdl-64e-kitti"],
        without: tuple[str, ...] = (),
        apart: bool = False,
        optics: Optics = OPTICS,
        worlds: Worlds | None = None,
    ):
        if seed < 0 or length < 1:
            raise ValueError(f"expected seed >= 0 and length >= 1, got seed {seed} and length {length}")
        if unknown := [word for word in without if word not in LABEL]:
            raise ValueError(f"expected classes of {', '.join(LABEL)}, found {unknown[0]!r}")
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
        returns, rays = self._shoot(index, sensor)
        rows = np.broadcast_to(np.arange(sensor.height)[:, None], (sensor.height, width))
        order = np.roll(np.arange(width)[::-1], width // 2)
        hit = (returns.distance > 0).reshape(rows.shape)[:, order]
        points = self._local(rays, returns, sensor)[:, order][hit]
        reflectance = returns.reflectance.reshape(rows.shape)[:, order][hit]
        label = returns.label.reshape(rows.shape)[:, order][hit].astype(np.int64)
        return Scan(points, reflectance, ring=rows[hit].astype(np.int64), label=label)

    def image(self, index: int) -> RangeImage:
        """(H, W) image of scan `index` with one ray per pixel, row = beam; no `xyz`, pixels hold the rays' ranges."""
        returns, rays = self._shoot(index, self.sensor)
        shape = (self.sensor.height, self.sensor.width)
        points = self._local(rays, returns, self.sensor)
        distance = np.linalg.norm(points, axis=-1).astype(np.float32)
        mask = returns.distance.reshape(shape) > 0
        label = returns.label.reshape(shape).astype(np.int64)
        return RangeImage(distance, returns.reflectance.reshape(shape), mask, self.sensor, label)

    def _local(self, rays: np.ndarray, returns: Returns, sensor: Sensor) -> np.ndarray:
        """(H, W, 3) float32 points in the sensor frame, zero where nothing returned."""
        distance = returns.distance.reshape(rays.shape[:2])
        points = rays * distance[..., None]
        if sensor.offsets:
            points[..., 2] += np.where(distance > 0, np.asarray(sensor.offsets, np.float32)[:, None], 0)
        return points

    def _shoot(self, index: int, sensor: Sensor) -> tuple[Returns, np.ndarray]:
        """Returns of all H * W rays, and the rays (H, W, 3) in the sensor frame."""
        if not 0 <= index < self.length:
            raise IndexError(f"expected a scan number in 0..{self.length - 1}, got {index}")
        if self.apart:
            index = POSES * index + index % POSES
        world, caster = self._worlds[index // POSES]
        rng = np.random.default_rng((self.seed, index, 1))
        rays = _jittered(sensor, rng)
        turn, place = _pose(world.poses[index % POSES])
        if any(sensor.tilt):
            turn = turn @ _pose(np.array([0, 0, 0, 0, *np.radians(sensor.tilt)]))[0]
        start = np.zeros((sensor.height, 3), np.float32)
        start[:, 2] = sensor.mount
        if sensor.offsets:
            start[:, 2] += np.asarray(sensor.offsets, np.float32)
        visible_rays = ~hdl64e.hidden(sensor)
        seen = visible_rays.reshape(-1)
        origins = np.repeat(start @ turn.T + place, visible_rays.sum(axis=1), axis=0)
        directions = rays.reshape(-1, 3)[seen] @ turn.T
        lasers = hdl64e.lasers(sensor, self.optics.loss, self.optics.dip, self.optics.shift)
        found = sense(world, caster, origins, directions, lasers, rng, sensor.max_range, self.optics)
        kept = found.distance >= sensor.min_range
        whole = []
        for values in (found.distance, found.reflectance, found.label):
            image = np.zeros(len(seen), values.dtype)
            image[seen] = np.where(kept, values, 0)
            whole.append(image)
        return Returns(*whole), rays


def _emptied(world: World, labels: list[int]) -> World:
    """The world with the things of these labels shrunk to a point below it; triangles keep their numbers."""
    gone = (world.kind == THING) & np.isin(world.label, labels)
    below = np.array([0, 0, -1000], np.float32)
    return replace(world, corners=np.where(gone[:, None, None], below, world.corners)) if gone.any() else world


@lru_cache(maxsize=4)
def _directions(sensor: Sensor) -> np.ndarray:
    return sensor.directions()


def _jittered(sensor: Sensor, rng: np.random.Generator) -> np.ndarray:
    """(H, W, 3) float32 rays: the sensor's, turned by a third of a column at most, each ring with its own phase."""
    phase = rng.random((sensor.height, 1), np.float32) / 2 - 0.25
    shake = rng.random((sensor.height, sensor.width), np.float32)
    angle = (phase + 0.16 * shake - 0.08) * np.float32(2 * np.pi / sensor.width)
    rays = _directions(sensor)
    x = rays[..., 0] - angle * rays[..., 1]
    y = rays[..., 1] + angle * rays[..., 0]
    return np.stack([x, y, rays[..., 2]], axis=-1)  # small angles: the length stays 1 within 1e-6


def _pose(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and place (3,) float32 of a vehicle pose x, y, z, yaw, pitch, roll (nose up, left side up)."""
    x, y, z, yaw, pitch, roll = pose
    c, s = np.cos(yaw), np.sin(yaw)
    cp, sp, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, -sp], [0, 1, 0], [sp, 0, cp]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return (about_z @ about_y @ about_x).astype(np.float32), np.array([x, y, z], np.float32)
