"""A drive along one street: where the carrier and everyone else are at any time. Worlds of drives are as long as asked.

Vehicles keep their lanes and follow each other by `traffic.py`, the carrier among them; pedestrians walk along their
sidewalk or stand.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidarsynth.streets.actors import Actors, actors_of
from lidarsynth.streets.areas import TODAY, Area, Density
from lidarsynth.streets.builder import WorldBuilder, assemble
from lidarsynth.streets.ground import Ground, Road
from lidarsynth.streets.layout import draw_area, fill
from lidarsynth.streets.traffic import STEP, follow
from lidarsynth.streets.world import REACH, TRAFFIC, WALK, World, draw_ground

MARGIN = 120.0  # m of street behind the start and beyond the end
LONGEST = 4000.0  # m of street in one world
SLOWEST, FASTEST = 5.0, 16.0  # m/s that a street has its traffic drive
OWN_LENGTH = 4.3  # m, of the carrier
APART = 2.3  # m between the middles of vehicles that pass each other
RAMP = 1.5  # m in which a kerb falls to the carriageway for those who ride
STANDING = 0.3  # share of pedestrians who do not walk


@dataclass(frozen=True)
class Moment:
    """The A actors at one time: place (A, 3) m and velocity (A, 3) m/s in the world, yaw (A,) rad, spin (A,) rad/s.

    present (A,) bool: not yet, or no more, where False.
    """

    place: np.ndarray
    yaw: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray
    present: np.ndarray

    def later(self, after: np.ndarray) -> Moment:
        """Everyone moved on by a time of their own, (A,) s, short enough that velocity and spin stay what they are."""
        return replace(self, place=self.place + after[:, None] * self.velocity, yaw=self.yaw + after * self.spin)


@dataclass(frozen=True)
class Drive:
    """One world and how everything in it moves.

    along   (steps, A) m along its road of each actor, every traffic.STEP seconds; constant for those that stand
    aside   (A,) m to the left of its road; number (A,) of its road in the ground, -1 for those that stand
    ahead   (A,) +1 or -1: whether it faces along its road or against
    turned  (steps, A) rad by which each looks elsewhere than ahead, counter-clockwise
    reach   (R, 2) m along each road of the ground, from where to where nothing stands across it: who moves is there
            between these alone
    own     (steps,) m of the carrier along the main road; lane, its m to the left of the centre line
    weave   (3, 3): amplitude, frequency in rad/s, phase of what the carrier's offset, pitch and roll sway by
    """

    world: World
    actors: Actors
    along: np.ndarray
    aside: np.ndarray
    number: np.ndarray
    ahead: np.ndarray
    turned: np.ndarray
    reach: np.ndarray
    own: np.ndarray
    lane: float
    weave: np.ndarray

    def poses(self, times: np.ndarray) -> np.ndarray:
        """(N, 6) x, y, z, yaw, pitch, roll of the carrier at times (N,), seconds from 0 to the end."""
        sway, rate = _swaying(self.weave, times), _swaying(self.weave, times, derivative=True)
        s, speed = _at(self.own[:, None], times)[:, 0], np.gradient(self.own, STEP)
        x, y, yaw = self.world.ground.roads[0].at(s, self.lane + sway[0])
        pace = np.maximum(np.interp(times, STEP * np.arange(len(speed)), speed), 1.0)
        yaw = yaw + np.arctan(rate[0] / pace)
        pitch, roll = _slopes(self.world.ground, x, y, yaw)
        return np.column_stack([x, y, self.world.ground.height(x, y), yaw, pitch + sway[1], roll + sway[2]])

    def moment(self, time: float) -> Moment:
        """Where everyone is at `time`, seconds from the start."""
        place, yaw = self._placed(time)
        early, late = max(time - STEP / 2, 0.0), time + STEP / 2  # of more than 20 turns a second the first has no more
        before, after = self._placed(early), self._placed(late)
        velocity = (after[0] - before[0]) / (late - early)
        spin = (np.mod(after[1] - before[1] + np.pi, 2 * np.pi) - np.pi) / (late - early)
        s = _at(self.along, np.array([time]))[0]
        half, ends = self.actors.size[:, 0] / 2, self.reach[self.number]
        present = (self.number < 0) | ((s - half > ends[:, 0]) & (s + half < ends[:, 1]))
        return Moment(place, yaw, velocity, spin, present & (self.ahead != 0))

    def _placed(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        place, yaw = self.actors.place.copy(), self.actors.yaw.copy()
        s, turned = (_at(track, np.array([time]))[0] for track in (self.along, self.turned))
        x, y = np.zeros((2, len(place)))
        for number, road in enumerate(self.world.ground.roads):
            mine = np.flatnonzero(self.number == number)
            if len(mine):
                x[mine], y[mine], heading = road.at(s[mine], self.aside[mine])
                yaw[mine] = heading + np.where(self.ahead[mine] > 0, 0, np.pi) + turned[mine]
        moved = np.flatnonzero(self.number >= 0)  # on all roads at once: long drives have many
        x, y = x[moved], y[moved]
        place[moved] = np.column_stack([x, y, self.world.ground.height(x, y) + self._up(moved, x, y)])
        return place, yaw

    def _up(self, moved: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Metres above the carriageway of the actors `moved`: where another road meets theirs, people step off the
        kerb, cyclists roll down and up again."""
        ground, number = self.world.ground, self.number[moved]
        paved = np.array([road.walk > 0 for road in ground.roads])[number]
        walks = np.flatnonzero((self.actors.pace[moved] == WALK) & paved)
        rolls = walks[self.actors.kind[moved[walks]] == "bicyclist"]
        up = np.zeros(len(moved))
        up[walks] = ground.kerb * (ground.carriageway(x[walks], y[walks]) > 0)
        for own in np.unique(number[rolls]):
            mine = rolls[number[rolls] == own]
            up[mine] *= np.clip(ground.carriageway(x[mine], y[mine], skip=own) / RAMP, 0, 1)
        return up


def draw_drive(seed: int, number: int, seconds: float, density: Density = TODAY, speed: float | None = None) -> Drive:
    """Drive `number` of a seed, at least `seconds` long.

    speed  m/s the carrier would like, None = as the street has it
    Raises ValueError for a drive longer than LONGEST.
    """
    rng = np.random.default_rng((seed, number, 4))
    area, usual = _street(rng, density)
    wished = speed or usual
    ground = draw_ground(rng, area, _length(wished, seconds))
    road = ground.roads[0]
    lane, start = _lane(road), road.start + MARGIN
    world = _furnished(rng, ground, area, lane, start)
    return _set_off(np.random.default_rng((seed, number, 5)), world, lane, start, seconds, usual, wished)


def check_drives(seed: int, count: int, seconds: float, density: Density = TODAY, speed: float | None = None) -> None:
    """Raises ValueError where one of the drives 0 .. count - 1 would be longer than LONGEST, as `draw_drive` does."""
    if (speed or FASTEST) * seconds + 2 * MARGIN <= LONGEST:
        return
    for number in range(count if speed is None else 1):
        _length(speed or _street(np.random.default_rng((seed, number, 4)), density)[1], seconds)


def _street(rng: np.random.Generator, density: Density) -> tuple[Area, float]:
    """What kind of street it is, and at how many m/s its traffic drives."""
    area = density.of(draw_area(rng))
    return area, float(np.clip(5.5 + 1.3 * area.half[0] + rng.normal(0, 1), SLOWEST, FASTEST))


def _length(wished: float, seconds: float) -> float:
    """m of street."""
    length = max(2 * REACH[0], wished * seconds + 2 * MARGIN)
    if length > LONGEST:
        raise ValueError(f"expected a drive of at most {LONGEST - 2 * MARGIN:.0f} m, found {seconds:.0f} s at "
                         f"{wished:.1f} m/s; choose fewer frames, or drive slower")  # fmt: skip
    return length


def _lane(road: Road) -> float:
    """The carrier's m to the left of the centre line: the right lane, or the middle where there is but one."""
    right, left = -(road.half - road.parking[0]) / 2, (road.half - road.parking[1]) / 2
    return right if road.half - max(road.parking) > 2.6 else right + left


def _furnished(rng: np.random.Generator, ground: Ground, area: Area, lane: float, start: float) -> World:
    road, builder = ground.roads[0], WorldBuilder(rng, ground, area)
    s = np.arange(start - 10, road.stop, 2.0)
    path = np.column_stack([s, np.full(s.shape, lane)])
    fill(builder, path[5:6], path)
    x, y, yaw = road.at(path[::5, 0], path[::5, 1])
    zero = np.zeros(len(x))
    return assemble(builder, np.column_stack([x, y, ground.height(x, y), yaw, zero, zero]))


def _set_off(
    rng: np.random.Generator, world: World, lane: float, start: float, seconds: float, usual: float, wished: float
) -> Drive:
    """Gives everyone a road, a direction and a speed, and lets them go."""
    actors, roads = actors_of(world), world.ground.roads
    count, steps = len(actors), int(np.ceil((seconds + 1) / STEP)) + 1
    draw = rng.random((3, count))
    x, y = actors.place[:, 0], actors.place[:, 1]
    s, d = np.array([road.coordinates(x, y) for road in roads]).transpose(1, 0, 2)
    number = np.argmin(np.abs(d) - np.array([[road.half] for road in roads]), axis=0)
    number[actors.pace == TRAFFIC] = 0
    on_some = np.isfinite(d).any(axis=0)  # beyond the ends of all roads one stands
    walks = (actors.pace == WALK) & (draw[0] > STANDING) & on_some
    number[~walks & (actors.pace != TRAFFIC)] = -1
    along, aside = s[number, np.arange(count)], d[number, np.arange(count)]
    ahead = np.where(actors.pace == TRAFFIC, np.where(aside < 0, 1, -1), np.where(draw[1] < 0.5, 1, -1))
    slow = actors.kind == "bicyclist"
    rides = walks & slow  # beside the road, with the traffic of that side
    ahead = np.where(rides, np.where(aside < 0, 1, -1), ahead)
    ahead = np.where(_in_the_way(actors, aside, number, roads, lane, ahead), 0, ahead)
    pace = np.where(slow, 4 + 2 * draw[2], usual * (0.8 + 0.3 * draw[2]))
    pace = np.where(walks & ~rides, 0.9 + 0.7 * draw[2], pace)
    track = along + ahead * pace * STEP * np.arange(steps)[:, None] * walks
    mine = None
    for way in (1, -1):
        lane_of = np.flatnonzero((actors.pace == TRAFFIC) & (ahead == way))
        place, length, speeds = way * along[lane_of], actors.size[lane_of, 0], pace[lane_of]
        if way > 0:
            place, length, speeds = (
                np.append(a, b) for a, b in ((place, start), (length, OWN_LENGTH), (speeds, wished))
            )
        moved = follow(place, length, speeds, (steps - 1) * STEP)[:steps]
        track[:, lane_of] = way * moved[:, : len(lane_of)]
        mine = moved[:, -1] if way > 0 else mine
    assert mine is not None
    weave = np.array([(0.12, 0.35, 0), (0.003, 5.0, 0), (0.004, 3.5, 0)]) * [[1, rng.uniform(0.8, 1.2), 0]]
    weave[:, 2] = rng.uniform(0, 2 * np.pi, 3)
    still = number < 0
    whole, turned = np.where(still, 0.0, track), np.zeros(track.shape, np.float32)
    reach = np.array([(road.start, road.stop) for road in roads])
    return Drive(world, actors, whole, np.where(still, 0.0, aside), number, ahead, turned, reach, mine, lane, weave)


def _in_the_way(actors: Actors, aside: np.ndarray, number: np.ndarray, roads: tuple[Road, ...], lane: float, ahead):
    """(A,) bool: pedestrians on a carriageway, and oncoming vehicles on a street too narrow to pass them."""
    half = np.array([road.half for road in roads])[number]
    on_road = (actors.pace == WALK) & (np.abs(aside) < half) & (number >= 0)
    return on_road | ((actors.pace == TRAFFIC) & (ahead < 0) & (np.abs(aside - lane) < APART))


def parked_world(drive: Drive) -> World:
    """The drive's world without those that move or have no place in it: shrunk to a point far below."""
    movers = drive.actors.thing[(drive.number >= 0) | (drive.ahead == 0)]
    gone = np.isin(drive.world.thing, movers)
    return replace(drive.world, corners=np.where(gone[:, None, None], np.float32(-1000), drive.world.corners))


def _at(track: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(N, A) values of a track (steps, A) at times (N,), linear between its steps."""
    place = np.clip(np.asarray(times) / STEP, 0, len(track) - 1)
    low = np.minimum(place.astype(int), len(track) - 2)
    part = (place - low)[:, None]
    return track[low] * (1 - part) + track[low + 1] * part


def _swaying(weave: np.ndarray, times: np.ndarray, derivative: bool = False) -> np.ndarray:
    """(3, N) offset in m and pitch and roll in rad at times (N,), or how fast they change."""
    size, rate, phase = weave.T[..., None]
    angle = rate * np.asarray(times) + phase
    return size * rate * np.cos(angle) if derivative else size * np.sin(angle)


def _slopes(ground: Ground, x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pitch and roll (N,) of a vehicle on the ground's slope."""
    ahead, left, c, s = 1.3, 0.8, np.cos(yaw), np.sin(yaw)
    rise = ground.height(x + ahead * c, y + ahead * s) - ground.height(x - ahead * c, y - ahead * s)
    bank = ground.height(x - left * s, y + left * c) - ground.height(x + left * s, y - left * c)
    return np.arctan(rise / (2 * ahead)), np.arctan(bank / (2 * left))
