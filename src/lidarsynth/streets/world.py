"""Where everything stands: one world of 300 m of street with its side roads, and the poses the scans are taken from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidarsynth.lidar.sensor import Sensor
from lidarsynth.streets.areas import Area
from lidarsynth.streets.ground import Ground, Road

GROUND, SLAB, THING, FRONT = 0, 1, 2, 3  # what a triangle belongs to
REACH = (150.0, 90.0)  # half size of the world in metres, x and y
POSES = 16  # scans taken in one world
LONG = 30.0  # m, as far as which a sensor may see a part of a wall whose corner is out of its sight
STILL, TRAFFIC, WALK = 0, 1, 2  # how a thing moves once time passes
THINGS = np.dtype([("kind", "U16"), ("variant", "i2"), ("row", "f8", 8), ("pace", "u1")])  # row as `builder.ROW`


@dataclass(frozen=True)
class World:
    """T triangles and what they are.

    corners (T, 3, 3) float32 m; kind (T,) uint8 of GROUND, SLAB, THING, FRONT; material, label (T,) uint8;
    tint (T,) float32, the object's brightness in spreads of its material; front (T,) int16, row of `fronts` or -1;
    fronts (F, 12) float32, see `facades.py`; ground; poses (16, 6) float64: x, y, z, yaw, pitch, roll of the vehicle;
    thing (T,) int32, row of `things` or -1; things (K,) of THINGS, what stands where.
    """

    corners: np.ndarray
    kind: np.ndarray
    material: np.ndarray
    label: np.ndarray
    tint: np.ndarray
    front: np.ndarray
    fronts: np.ndarray
    ground: Ground
    poses: np.ndarray
    thing: np.ndarray
    things: np.ndarray


def draw_ground(rng: np.random.Generator, area: Area, length: float = 2 * REACH[0]) -> Ground:
    """Roads and terrain of one world, whose main road is `length` metres long."""
    half_length = length / 2
    lane = rng.uniform(*area.half)
    parking = (2.1 * (rng.random() < area.parking[0]), 2.1 * (rng.random() < area.parking[1]))
    half = lane + max(parking)
    parking = (parking[0], parking[1])
    wave = (rng.uniform(*area.bend) * (rng.random() < 0.7), rng.uniform(130, 300), rng.uniform(0, 6.28))
    draw = rng.random()
    lanes = "dashed" if draw < area.lanes[0] else "solid" if draw < sum(area.lanes) else "none"
    rails = bool(rng.random() < area.rails) and lane > 3.5
    walk = rng.uniform(*area.walk)
    roads = [Road(0, 0, 0, half, walk, parking, wave, -half_length, half_length, lanes, rails)]
    places = rng.permutation(np.arange(50 - half_length, half_length - 49, 40.0))
    crossings = rng.integers(area.crossings[0], area.crossings[1] + 1)
    for k in range(round(crossings * half_length / REACH[0])):
        place = places[k] + rng.uniform(-14, 14)
        x, y, yaw = roads[0].at(np.asarray(place), np.asarray(0.0))
        one_sided = rng.choice(np.array([(-90, 90), (-90, 0), (0, 90)]))
        side = Road(float(x), float(y), float(yaw) + np.pi / 2 + rng.normal(0, 0.12), rng.uniform(2.2, max(3.0, lane)),
                    walk * rng.uniform(0.5, 1), start=float(one_sided[0]), stop=float(one_sided[1]))  # fmt: skip
        roads.append(side)
    slope = rng.normal(0, area.slope, 2)
    hills = np.column_stack([rng.uniform(0, 0.35, 3) * area.slope / 0.02, rng.uniform(-0.04, 0.04, (3, 2)),
                             rng.uniform(0, 6.28, 3)])  # fmt: skip
    banks = rng.normal(0, area.bank, 2) if area.bank else np.zeros(2)
    patches = np.column_stack([rng.normal(0, 0.6, (4, 2)), rng.uniform(0, 6.28, 4)]).astype(np.float32)
    return Ground(tuple(roads), (slope[0], slope[1]), hills, (banks[0], banks[1]), str(rng.choice(area.verge)), patches,
                  float(rng.uniform(0, 9)), area.kerb)  # fmt: skip


def draw_poses(rng: np.random.Generator, ground: Ground) -> tuple[np.ndarray, np.ndarray]:
    """Vehicle poses (16, 6) and their places (16, 2), (s, d) along the main road, far away for those on side roads."""
    road = ground.roads[0]
    lanes = np.array([-(road.half - road.parking[0]) / 2, (road.half - road.parking[1]) / 2])
    two_way = road.half - max(road.parking) > 2.6
    back = (rng.random(POSES) < 0.4) & two_way
    s = np.linspace(-66, 66, POSES) + rng.uniform(-3, 3, POSES)
    d = np.where(back, lanes[1], lanes[0] if two_way else lanes.sum()) + rng.normal(0, 0.25, POSES)
    x, y, yaw = road.at(s, d)
    yaw = yaw + np.where(back, np.pi, 0) + rng.normal(0, 0.03, POSES)
    for k in range(POSES):
        draw, swing = rng.random(2), rng.normal(0, 1, 2)
        near = [r for r in ground.roads[1:] if np.hypot(r.x - x[k], r.y - y[k]) < 10]
        if near and draw[0] < 0.6:  # turning
            x[k], y[k] = near[0].x + swing[0], near[0].y + swing[1]
            yaw[k] += 2.4 * draw[1] - 1.2
        elif len(ground.roads) > 1 and draw[0] > 0.85:  # on a side road
            side = ground.roads[1 + k % (len(ground.roads) - 1)]
            place = np.clip(side.start + (side.stop - side.start) * draw[1], -60, 60)
            x[k], y[k], yaw[k] = side.at(np.asarray(place), np.asarray(-side.half / 2))
            s[k] = 1e6
    return _settled(rng, ground, x, y, yaw), np.column_stack([s, d])


def _settled(rng: np.random.Generator, ground: Ground, x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """(N, 6) poses of vehicles that stand on the ground: its slope under the wheels, and half a degree of sway."""
    ahead, left = 1.3, 0.8
    c, s = np.cos(yaw), np.sin(yaw)
    rise = ground.height(x + ahead * c, y + ahead * s) - ground.height(x - ahead * c, y - ahead * s)
    bank = ground.height(x - left * s, y + left * c) - ground.height(x + left * s, y - left * c)
    sway = rng.normal(0, 0.008, (2, len(x)))
    pitch, roll = np.arctan(rise / (2 * ahead)) + sway[0], np.arctan(bank / (2 * left)) + sway[1]
    return np.column_stack([x, y, ground.height(x, y), yaw, pitch, roll])


def visible(world: World, sensor: Sensor) -> World:
    """The world without triangles that no pose can see: too far, or wholly above the highest beam. Faster to cast."""
    poses = world.poses.astype(np.float32)
    spot = np.vstack([world.corners[:, 0].T, np.full(len(world.corners), sensor.max_range + 5, np.float32)])
    if sensor.max_range < LONG:  # a long wall comes nearer than its corner, and lower
        spot[2] = world.corners[:, :, 2].min(axis=1)
        spot[3] += np.hypot(*(world.corners[:, 1:, :2] - world.corners[:, :1, :2]).T).max(axis=0)
    high = np.flatnonzero((world.kind == THING) & (spot[2] > poses[:, 2].min() + sensor.mount + 0.8))
    top = np.radians(sensor.elevations[0] + np.hypot(*sensor.tilt)) + 0.06  # rad: pitch, roll and slope of the poses
    steep = np.float32(np.tan(min(top, 1.57)))  # what looks straight up sees everything
    seen = np.ones(len(world.corners), bool)
    seen[high] = False
    open_ = spot.take(high, axis=1)  # those that no pose so far has seen
    for x, y, z, *_ in poses[np.argsort(np.arange(len(poses)) % 4, kind="stable")]:  # far apart first
        away = np.hypot(open_[0] - x, open_[1] - y)
        shown = (away < open_[3]) & (open_[2] - z - sensor.mount - 0.8 < steep * away)
        seen[high.compress(shown)] = True
        if 8 * np.count_nonzero(shown) > len(high):
            high, open_ = high.compress(~shown), open_.compress(~shown, axis=1)
    left, keys = np.flatnonzero(seen), ("corners", "kind", "material", "label", "tint", "front", "thing")
    return replace(world, **{key: getattr(world, key).take(left, axis=0) for key in keys})
