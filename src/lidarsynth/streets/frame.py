"""Labelled streets as a reader: scans of many places, or drives frame by frame, with all that is known of each."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from lidarsynth.lidar.boxes import Box
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.semantic_kitti import RAW
from lidarsynth.lidar.sensor import SENSORS, Sensor, get_sensor
from lidarsynth.streets.actors import KINDS, actors_of, numbers_of
from lidarsynth.streets.apart import stand_apart
from lidarsynth.streets.areas import TODAY, Density
from lidarsynth.streets.boxes import boxes_of
from lidarsynth.streets.drive import Drive, Moment, check_drives, draw_drive, parked_world
from lidarsynth.streets.hdl64e import NAME
from lidarsynth.streets.interiors import buildings
from lidarsynth.streets.layout import build
from lidarsynth.streets.moving import Bodies, MovingCaster
from lidarsynth.streets.passing import set_apart
from lidarsynth.streets.raycast import Caster
from lidarsynth.streets.reader import FULL_TURN, Worlds, whole
from lidarsynth.streets.sensor_model import OPTICS, Optics
from lidarsynth.streets.turn import Turn, attitudes, perfect, sensor_pose, shoot
from lidarsynth.streets.weather import CLEAR, Weather
from lidarsynth.streets.world import POSES, World, visible

OUTLIER = np.uint32(1)  # returns of rain and fog
FURNITURE = np.uint32(99)  # SemanticKITTI's other-object


@dataclass(frozen=True)
class Options:
    """What is asked of the streets. The defaults give the scans that `SyntheticStreets` gives.

    frames    0 = scans of places where everything stands still; else frames of each drive
    rate      turns per second
    speed     m/s the carrier would like to drive, None = as the street has it
    deskewed  the carrier's own motion within a turn is taken out of the points, as odometry data sets have it, and
              boxes stand where the beams met them, as annotators put them around the points; of what moves and is met
              by both ends of the turn, directly behind, one part is brought to the other
    perfect   as a simulator casts: every beam reports exactly what it meets first, with a reflectance of 0
    inside    places in buildings, not in streets: rooms, halls, garages, the sensor `mount` above the floor
    overlap   scans of places with the usual density stay what they always were, where some stand in others and in
              walls; False = nobody does, as with any other density and in drives
    """

    frames: int = 0
    rate: float = 10.0
    speed: float | None = None
    deskewed: bool = False
    perfect: bool = False
    density: Density = TODAY
    weather: Weather = CLEAR
    optics: Optics = field(default=OPTICS)
    inside: bool = False
    overlap: bool = True

    def __post_init__(self):
        object.__setattr__(self, "frames", whole("frames", self.frames, 0))
        if not 0.1 <= self.rate <= 100:
            raise ValueError(f"expected a rate of 0.1 to 100 turns per second, found {self.rate}")
        if self.perfect and self.weather != CLEAR:
            raise ValueError("expected clear weather of a perfect sensor, found rain or fog")
        of_streets = {"frames of a drive": self.frames, "a density": self.density != TODAY,
                      "rain or fog": self.weather != CLEAR, "no overlap": not self.overlap}  # fmt: skip
        if self.inside and (found := [word for word, given in of_streets.items() if given]):
            raise ValueError(
                f"expected places of buildings, where nothing drives or rains, found {' and '.join(found)}"
            )
        if self.frames == 0 and (self.speed is not None or self.deskewed):
            raise ValueError("expected the frames of a drive with a speed or deskewed points, found none: scans of "
                             "places stand still")  # fmt: skip
        if self.speed is not None and not 0.1 <= self.speed <= 60:
            raise ValueError(f"expected a speed of 0.1 to 60 m/s (0.36 to 216 km/h), found {self.speed:g} m/s "
                             f"({3.6 * self.speed:g} km/h)")  # fmt: skip


@dataclass(frozen=True)
class Frame:
    """One labelled scan.

    scan      points in the sensor frame, ring by ring; label = training class, time = s after the turn began
    raw       (N,) uint32, SemanticKITTI's raw class of each point, its instance number in the upper half
    boxes     of all road users within range, at `stamp`, or of deskewed frames when the beams met them (`Box.late`)
    to_world  (4, 4) float64, sensor frame at `stamp` -> world
    stamp     s on the clock of its world, the middle of the turn; 0 for scans of places
    world, number   which world or drive, and which scan of it; unique together
    """

    scan: Scan
    raw: np.ndarray
    boxes: list[Box]
    to_world: np.ndarray
    stamp: float
    world: int
    number: int

    def record(self) -> dict[str, Any]:
        """What the JSON file of a scan holds."""
        return {
            "world": self.world,
            "frame": self.number,
            "stamp": round(self.stamp, 6),
            "points": len(self.scan),
            "pose": [[round(v, 9) for v in row] for row in self.to_world.tolist()],  # rotations that readers check
            "boxes": [box.record() for box in self.boxes],
        }


class LabelledStreets:
    """`len`, and `[i] -> Frame`; frame i of a seed and its options depends on nothing else.

    count   how many scans, or drives where `options.frames` is given; `len` is the number of frames
    sensor  or its word; its own columns; for KITTI's, 2083, as it turns
    Raises IndexError beyond the length, ImportError naming the extra, ValueError for options that make no sense.
    """

    def __init__(
        self,
        seed: int = 0,
        count: int = 1000,
        sensor: Sensor | str = SENSORS["hdl-64e-kitti"],
        options: Options = Options(),
    ):
        seed, count, sensor = whole("seed", seed, 0), whole("count", count, 1), get_sensor(sensor)
        if (frames := count * max(options.frames, 1)) >= 2**62:
            raise ValueError(f"expected at most 2^62 - 1 scans, found {frames}")
        full = sensor.name == NAME and sensor.width < FULL_TURN
        self.sensor = sensor.resized(width=FULL_TURN) if full else sensor
        self.seed, self.count, self.options = seed, count, options
        self._worlds = self._places()
        self._held: tuple[int, Any] | None = None

    def __len__(self) -> int:
        return self.count * max(self.options.frames, 1)

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < len(self):
            raise IndexError(f"expected a frame number in 0..{len(self) - 1}, got {index}")
        return self._driven(*divmod(index, self.options.frames)) if self.options.frames else self._still(index)

    def place(self, index: int) -> tuple[int, int]:
        """(world, frame of it) of frame `index`."""
        world, number = divmod(index, self.options.frames or POSES)
        return world, number

    def drive(self, number: int) -> Drive:
        """Drive `number`, which lasts one turn longer than its frames, and in which nobody goes through anybody."""
        return set_apart(draw_drive(self.seed, number, self._seconds, self.options.density, self.options.speed))

    def check_drives(self) -> None:
        """Raises ValueError where a drive is longer than a street may be: before any is drawn."""
        if self.options.frames:
            check_drives(self.seed, self.count, self._seconds, self.options.density, self.options.speed)

    @property
    def _seconds(self) -> float:
        return (self.options.frames + 1) / self.options.rate

    def _places(self) -> Worlds:
        """Worlds of scans of places. Streets as they are stay what they always were, those of other densities have
        everyone apart."""
        if self.options.inside:
            return buildings(self.seed, self.sensor)
        density = self.options.density
        built = None if density == TODAY and self.options.overlap else partial(_apart, self.seed, self.sensor, density)
        return Worlds(self.seed, self.sensor, built=built)

    def _still(self, index: int) -> Frame:
        number, pose = divmod(index, POSES)
        world, caster = self._worlds[number]
        bodies = self._hold(number, lambda: Bodies(world, actors_of(world)))
        rng = np.random.default_rng((self.seed, index, 1))
        poses = world.poses[pose][None]
        turn = shoot(world, caster, self.sensor, self.options.optics, rng, poses)
        turn = self._weathered(turn, (self.seed, index, 7))
        moment = _standing(bodies)
        return self._frame(world, bodies, moment, turn, poses, None, 0.0, number, pose)

    def _driven(self, number: int, k: int) -> Frame:
        drive, caster, bodies, movers = self._hold(number, lambda: self._begun(number))
        period = 1 / self.options.rate
        times = period * (k + (np.arange(self.sensor.width) + 0.5) / self.sensor.width)
        stamp = period * (k + 0.5)
        moment, poses = drive.moment(stamp), drive.poses(times)
        rng = np.random.default_rng((self.seed, number, k, 6))
        there = movers[moment.present[movers]]
        gone = np.linalg.norm(poses[-1, :3] - poses[0, :3]) + period * np.linalg.norm(moment.velocity[there], axis=1)
        near = np.linalg.norm(moment.place[there] - poses[0, :3], axis=1) < self.sensor.max_range + 10 + gone
        scene = MovingCaster(caster, bodies, there[near], moment, stamp)
        turn = shoot(drive.world, scene, self.sensor, self.options.optics, rng, poses, times)
        turn = self._weathered(turn, (self.seed, number, k, 7))
        return self._frame(drive.world, bodies, moment, turn, poses, times, stamp, number, k)

    def _weathered(self, turn: Turn, seed: tuple[int, ...]) -> Turn:
        if self.options.perfect:
            return perfect(turn, self.sensor)
        return self.options.weather.on(turn, self.sensor, np.random.default_rng(seed))

    def _begun(self, number: int) -> tuple[Drive, Caster, Bodies, np.ndarray]:
        drive = self.drive(number)
        movers = np.flatnonzero((drive.number >= 0) & (drive.ahead != 0))
        return drive, Caster(parked_world(drive).corners), Bodies(drive.world, drive.actors), movers

    def _hold(self, number: int, make: Any) -> Any:
        """What `make` makes for this world, made once while frames of it are asked for."""
        if self._held is None or self._held[0] != number:
            self._held = None  # frees the former one first
            self._held = (number, make())
        return self._held[1]

    def _frame(
        self,
        world: World,
        bodies: Bodies,
        moment: Moment,
        turn: Turn,
        poses: np.ndarray,
        times: np.ndarray | None,
        stamp: float,
        number: int,
        k: int,
    ) -> Frame:
        sensor, period = self.sensor, 1 / self.options.rate
        numbers = numbers_of(world, bodies.actors)[np.where(turn.face >= 0, world.thing[turn.face], -1)]
        numbers = np.where((turn.distance > 0) & (turn.label > 0), numbers, 0)
        pose = poses[0] if times is None else poses[len(poses) // 2]
        to_world = sensor_pose(sensor, pose)
        late = None if times is None else times - stamp
        deskewed = self.options.deskewed and times is not None
        boxes = boxes_of(world, bodies, moment, sensor, turn, numbers, poses, late, to_world, as_seen=deskewed)
        points = turn.points
        if deskewed and late is not None:
            points = _deskewed(sensor, turn, poses, to_world)
            _bring_together(points, numbers, boxes, late, period)
        order = np.roll(np.arange(sensor.width)[::-1], sensor.width // 2)
        hit = (turn.distance > 0)[:, order]
        ring, column = np.nonzero(hit)
        scan = Scan(
            points[:, order][hit],
            turn.reflectance[:, order][hit],
            ring=ring.astype(np.int64),
            time=((order[column] + 0.5) / sensor.width * period).astype(np.float32),
            label=turn.label[:, order][hit].astype(np.int64),
        )
        raw = _raw(scan, numbers[:, order][hit], bodies, moment)
        raw = np.where((scan.label == 0) & (turn.face[:, order][hit] < 0), OUTLIER, raw)
        raw = np.where((raw == 0) & self.options.inside, FURNITURE, raw)
        return Frame(scan, raw, boxes, to_world, stamp, number, k)


def _apart(seed: int, sensor: Sensor, density: Density, number: int) -> World:
    """The street of that number, with everyone apart, as far as the sensor sees it."""
    return visible(stand_apart(build(np.random.default_rng((seed, number)), density))[0], sensor)


def _standing(bodies: Bodies) -> Moment:
    """Everyone where the world has put them."""
    actors = bodies.actors
    zero = np.zeros((len(actors), 3))
    return Moment(actors.place, actors.yaw, zero, zero[:, 0], np.ones(len(actors), bool))


def _raw(scan: Scan, numbers: np.ndarray, bodies: Bodies, moment: Moment) -> np.ndarray:
    """(N,) uint32 SemanticKITTI labels: raw class, and the instance in the upper half."""
    assert scan.label is not None
    raw = RAW[scan.label]
    fast = np.linalg.norm(moment.velocity, axis=1) > 0.2
    kinds = [KINDS[str(kind)] for kind in bodies.actors.kind]
    of_actor = np.array([0, *(k.moving if quick else k.raw for k, quick in zip(kinds, fast, strict=True))], np.uint32)
    return np.where(numbers > 0, of_actor[numbers], raw) | (numbers.astype(np.uint32) << np.uint32(16))


def _bring_together(points: np.ndarray, numbers: np.ndarray, boxes: list[Box], late: np.ndarray, period: float) -> None:
    """Move the points (H, W, 3) of what was met more than half a turn from when its box stands there: by its motion
    since. numbers (H, W) as in `boxes_of`, late (W,) s after the stamp."""
    for box in boxes:
        if not (box.moves and box.points and box.late is not None):
            continue
        after = box.late - late
        part = np.nonzero((numbers == box.instance) & (np.abs(after) > period / 2))
        points[part] += (after[part[1], None] * box.velocity).astype(np.float32)


def _deskewed(sensor: Sensor, turn: Turn, poses: np.ndarray, to_world: np.ndarray) -> np.ndarray:
    """(H, W, 3) float32 points in the sensor frame of the stamp, the carrier's own motion taken out."""
    turns, places = attitudes(sensor, poses)
    origins = places.astype(np.float64) + turns[:, :, 2].astype(np.float64) * sensor.mount
    world = np.einsum("hwj,wij->hwi", turn.points.astype(np.float64), turns.astype(np.float64)) + origins
    return np.where(turn.distance[..., None] > 0, (world - to_world[:3, 3]) @ to_world[:3, :3], 0).astype(np.float32)
