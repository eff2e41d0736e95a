"""Fills a street: fronts and gardens along every road, parked and moving traffic, people, trees, street furniture."""

from __future__ import annotations

import numpy as np

from lidarsynth.streets.areas import AREAS, TODAY, Area, Density
from lidarsynth.streets.builder import Houses, WorldBuilder, assemble
from lidarsynth.streets.ground import Road
from lidarsynth.streets.more import more
from lidarsynth.streets.world import REACH, STILL, TRAFFIC, WALK, World, draw_ground, draw_poses

Array = np.ndarray
NOWHERE = np.inf  # m clear of carriageways: what is drawn with it is left out, and all that is drawn later stays


def draw_area(rng: np.random.Generator) -> Area:
    """One kind of surroundings, as often as its weight says."""
    weights = np.array([a.weight for a in AREAS.values()])
    return list(AREAS.values())[rng.choice(len(AREAS), p=weights / weights.sum())]


def build(rng: np.random.Generator, density: Density = TODAY) -> World:
    """One world. The same generator state gives the same world."""
    area = density.of(draw_area(rng))
    ground = draw_ground(rng, area)
    poses, places = draw_poses(rng, ground)
    builder = WorldBuilder(rng, ground, area)
    fill(builder, places)
    return assemble(builder, poses)


def fill(builder: WorldBuilder, places: Array, lane: Array | None = None) -> None:
    """Everything of one world. places (16, 2): (s, d) of the poses on the main road, kept free.

    lane  (P, 2): (s, d) kept free of parked vehicles, if others
    """
    closings(builder)
    for number, road in enumerate(builder.ground.roads):
        for side in (-1, 1):
            fronts(builder, road, side)
            gardens(builder, road, side)
            kerbside(builder, road, side, main=number == 0)
            backdrop(builder, road, side)
            car_park(builder, road, side)
            if number == 0:
                parked(builder, road, side, places if lane is None else lane)
                moving(builder, road, side, places)
    more(builder, places)
    for road in builder.ground.roads:
        for side in (-1, 1):
            garages(builder, road, side)


def _count(builder: WorldBuilder, per_100: float, road: Road) -> int:
    return int(builder.rng.poisson(max(per_100, 0) * (road.stop - road.start) / 100))


def _along(builder: WorldBuilder, road: Road, count: int) -> Array:
    return builder.rng.uniform(road.start, road.stop, count)


def _edge(road: Road) -> float:
    """Metres from the centre line to the outer edge of the sidewalk."""
    return road.half + road.walk


def fronts(builder: WorldBuilder, road: Road, side: int) -> None:
    """Houses in a row: four walls each, doors and windows by `facades.py`; and what borders their lots."""
    rng, area = builder.rng, builder.area
    count = int((road.stop - road.start) / (area.house[0] + area.gap[0]) + 2)
    length, gap = rng.uniform(*area.house, count), rng.uniform(*area.gap, count)
    start = road.start + np.cumsum(length + gap) - length
    base = rng.uniform(*area.setback)
    setback = np.maximum(base + rng.normal(0, 0.3 + 0.15 * base, count), 0.05)
    depth = rng.uniform(8, 13, count)
    keep = (start + length < road.stop) & (rng.random(count) > area.vacant)
    near = _edge(road) + setback
    _houses(builder, road, side, start[keep], length[keep], near[keep], depth[keep])
    if base > 0.8:
        _borders(builder, road, side, start, length + gap)
    bays = keep & (rng.random(count) < 0.3)
    if bays.any():
        s = start[bays] + length[bays] * rng.uniform(0.1, 0.7, bays.sum())
        out = rng.uniform(0.3, 1.6, bays.sum())
        _houses(builder, road, side, s, rng.uniform(1.2, 3.5, bays.sum()), near[bays] - out, out + 0.5)


def _houses(
    builder: WorldBuilder,
    road: Road,
    side: int,
    s: Array,
    length: Array,
    near: Array,
    depth: Array,
    across: bool = False,
    tall: tuple[float, float] = (5, 14),
) -> None:
    """Boxes from (s, near) to (s + length, near + depth) beside a road, `tall` m high; those on a carriageway are left
    out."""
    rng, count = builder.rng, len(s)
    if not count:
        return
    far = near + depth
    sd = np.stack([np.stack([s, near], 1), np.stack([s + length, near], 1), np.stack([s + length, far], 1),
                   np.stack([s, far], 1)], 1)  # fmt: skip
    middle, heading = s + length / 2, None
    x0, y0, heading = road.at(middle, side * near)
    u, v = sd[..., 0] - middle[:, None], side * (sd[..., 1] - near[:, None])
    c, sn = np.cos(heading)[:, None], np.sin(heading)[:, None]
    x, y = x0[:, None] + c * u - sn * v, y0[:, None] + sn * u + c * v
    high = rng.uniform(*tall, count)
    builder.houses.append(Houses(x, y, high, facade_rows(rng, builder.area.shops, count), across))


def garages(builder: WorldBuilder, road: Road, side: int) -> None:
    """One to six in a row, by the sidewalk or behind it, where the area asks for them."""
    rng = builder.rng
    for s in _along(builder, road, _count(builder, builder.area.garages, road)) if builder.area.garages > 0 else ():
        count, wide = int(rng.integers(1, 7)), rng.uniform(2.8, 3.4)
        start, near = s + wide * np.arange(count), _edge(road) + rng.uniform(0.2, 6.0)
        deep = np.full(count, rng.uniform(5, 7))
        tall = (2.3, 2.5) if rng.random() < 0.7 else (2.6, 3.8)
        _houses(builder, road, side, start, np.full(count, wide), np.full(count, near), deep, tall=tall)


def facade_rows(rng: np.random.Generator, shops: float, count: int) -> Array:
    """(count, 12) facade parameters, columns as in `facades.py`; position columns are filled by the caller."""
    rows = np.zeros((count, 12))
    shop = rng.random(count) < shops
    rows[:, 5] = np.where(shop, rng.uniform(2.5, 5.0, count), rng.uniform(1.8, 4.5, count))  # period
    rows[:, 6] = np.where(shop, rng.uniform(0.55, 0.88, count), rng.uniform(0.2, 0.45, count))  # window share
    rows[:, 7] = np.where(shop, rng.uniform(0.1, 0.7, count), rng.uniform(0.8, 1.9, count))  # sill
    rows[:, 8] = rows[:, 7] + np.where(shop, rng.uniform(1.8, 2.6, count), rng.uniform(0.7, 1.7, count))  # head
    rows[:, 9] = rng.uniform(0.04, 0.3, count)  # recess
    rows[:, 10] = rng.integers(0, 1000, count)  # seed of its doors
    rows[:, 11] = np.clip(rng.normal(size=count), -1.6, 2.2)  # tint
    return rows


def _borders(builder: WorldBuilder, road: Road, side: int, start: Array, length: Array) -> None:
    """Wall, hedge or fence between the sidewalk and each lot, in pieces of two metres, with gates left open."""
    rng = builder.rng
    kind = rng.choice(4, p=np.array(builder.area.borders) / sum(builder.area.borders), size=len(start))
    words, along, out, firsts = [], [], [], []
    for code, name in ((0, "garden wall"), (1, "hedge"), (2, "fence")):
        for s0, far in zip(start[kind == code].tolist(), length[kind == code].tolist(), strict=True):
            s = np.arange(s0, s0 + far - 1, 2.0)
            gate = rng.integers(0, max(len(s), 1), 2)
            left = np.ones(len(s), bool)
            left[gate[: len(s)]] = False
            along.append(s[left] + 1.0)
            out.append(_edge(road) + 0.35 + (0.6 if code == 1 else 0))
            firsts.append((int(rng.integers(0, 64)), rng.uniform(0.9, 1.1), rng.normal()))
            words.append("wild hedge" if code == 1 and rng.random() < 0.45 else name)
    sizes = [len(s) for s in along]
    if words:
        x, y, yaw = road.at(np.concatenate(along), side * np.repeat(out, sizes))
        for word, first, n, end in zip(words, firsts, sizes, np.cumsum(sizes).tolist(), strict=True):
            builder.put_row(word, x[end - n : end], y[end - n : end], yaw[end - n : end], first)


def gardens(builder: WorldBuilder, road: Road, side: int) -> None:
    """Bushes and small trees between sidewalk and fronts, thickets and trees behind."""
    rng, area = builder.rng, builder.area
    depth = max(area.setback[1], 3.0)
    for kind, share in (("bush", 0.65), ("young tree", 0.2), ("tree", 0.15)):
        count = _count(builder, share * rng.uniform(*area.garden), road)
        s = _along(builder, road, count)
        d = side * (_edge(road) + 0.8 + rng.uniform(0, 1, count) * depth)
        x, y, _ = road.at(s, d)
        builder.put(kind, x, y, rng.uniform(0, 6.28, count), clear=1.2, size=(0.6, 1.3))


def backdrop(builder: WorldBuilder, road: Road, side: int) -> None:
    """What closes the view: thickets, trees and far houses."""
    rng, area = builder.rng, builder.area
    for kind, share in (("thicket", 0.7), ("tree", 0.3)):
        count = _count(builder, share * rng.uniform(*area.thicket), road)
        x, y, _ = road.at(
            _along(builder, road, count), side * (_edge(road) + area.setback[0] + 3 + rng.gamma(1.5, 12, count))
        )
        builder.put(kind, x, y, rng.uniform(0, 6.28, count), clear=3.5, size=(0.7, 1.5))
    count = _count(builder, 18.0 * area.closed, road)
    s = _along(builder, road, count)
    near = _edge(road) + area.setback[1] + 8 + rng.uniform(0, 45, count)
    _houses(builder, road, side, s, rng.uniform(10, 35, count), near, rng.uniform(8, 15, count))


def closings(builder: WorldBuilder) -> None:
    """What stands at the far ends of roads: a house where the road ends at another, a wood behind a bend."""
    rng = builder.rng
    for number, road in enumerate(builder.ground.roads):
        for end in (road.start, road.stop):
            if end == 0:
                continue
            place = np.sign(end) * rng.uniform(*((82, 125) if number == 0 else (30, 80)))
            place += np.sign(end) * (abs(end) - REACH[0]) if number == 0 else 0.0
            if rng.random() < builder.area.closed:
                length = rng.uniform(18, 40)
                s = np.array([place if end > 0 else place - 12.0])
                _houses(builder, road, 1, s, np.array([12.0]), np.array([-length / 2]), np.array([length]), across=True)
            elif rng.random() < 0.7:
                count = round(rng.integers(4, 12) * builder.area.woods)
                x, y, _ = road.at(place + rng.normal(0, 6, count), rng.normal(0, 14, count))
                builder.put("thicket", x, y, rng.uniform(0, 6.28, count), clear=None, size=(0.8, 1.5))


def car_park(builder: WorldBuilder, road: Road, side: int) -> None:
    """Cars side by side off the street, and a crash barrier along wide roads."""
    rng, area = builder.rng, builder.area
    if rng.random() < 0.5 * (area.setback[1] > 6) + 0.08:
        first, count = rng.uniform(road.start, road.stop), rng.integers(4, 18)
        s = first + 2.6 * np.arange(count) + rng.normal(0, 0.1, count)
        s = s[(rng.random(count) < 0.75) & (s < road.stop)]
        if len(s):
            d = side * (_edge(road) + rng.choice([3.2, 9.5])) + rng.normal(0, 0.2, len(s))
            turn = np.where(rng.random(len(s)) < 0.7, np.pi / 2, -np.pi / 2)
            clear = builder.ground.carriageway(*road.at(s, d)[:2]) > 2.6
            _vehicles(builder, road, s[clear], d[clear], turn[clear], 0.0, there=area.car_parks)
    if area.bank > 0.02 and road.half > 3 and rng.random() < 0.3:
        start = rng.uniform(road.start, 0)
        s = np.arange(start, rng.uniform(start + 20, max(road.stop, start + 20)), 2.0)
        x, y, yaw = road.at(s, np.full(s.shape, side * (road.half + 0.5)))
        builder.put_row("guard rail", x, y, yaw if side > 0 else yaw + np.pi, (0, 1.0, rng.normal()))


def kerbside(builder: WorldBuilder, road: Road, side: int, main: bool) -> None:
    """Trees, lamps, signs, bollards, bins, bicycles and people on or beside the sidewalk."""
    rng, area = builder.rng, builder.area
    up = builder.ground.kerb if road.walk > 0 else 0.0
    strip = max(road.walk, 1.5)
    spacing = rng.uniform(*area.trees)
    if spacing > 0.5:
        step = 100 / spacing
        s = np.arange(road.start + rng.uniform(0, step), road.stop, step)
        s = s + rng.normal(0, 0.5, len(s))
        x, y, _ = road.at(s, np.full(s.shape, side * (road.half + min(0.8, strip / 2))))
        builder.put("tree", x, y, rng.uniform(0, 6.28, len(s)), up=up, size=(0.7, 1.2))
    for kind, rate, near, far in (
        ("lamp", area.lamps, 0.4, 0.7), ("sign", area.signs, 0.4, 0.9), ("bollard", area.signs * 0.7, 0.3, 0.5),
        ("bin", 1.2, strip * 0.6, strip), ("person", rng.uniform(*area.people), 0.4, strip),
        ("bicycle", rng.uniform(*area.bicycles), strip * 0.6, strip), ("bush", area.kerb_bushes, strip, strip + 1.5),
    ):  # fmt: skip
        count = _count(builder, rate, road)
        x, y, yaw = road.at(_along(builder, road, count), side * (road.half + rng.uniform(near, max(far, near), count)))
        if kind == "sign":  # plates look at the traffic of their side
            yaw = yaw + np.where(side < 0, np.pi, 0) + rng.normal(0, 0.25, count)
        elif kind != "bin":
            yaw = yaw + rng.uniform(0, 6.28, count)
        clear = 0.15 if area.car_parks or kind != "bicycle" else NOWHERE
        builder.put(kind, x, y, yaw, up=up, clear=clear, pace=WALK if kind == "person" else STILL)
    if main:
        count = rng.poisson(area.on_road)
        x, y, yaw = road.at(_along(builder, road, count), rng.uniform(-road.half, road.half, count))
        builder.put("person", x, y, rng.uniform(0, 6.28, count), clear=None, pace=WALK)


def parked(builder: WorldBuilder, road: Road, side: int, places: Array) -> None:
    """Vehicles in the parking lane, bumper to bumper with gaps; sometimes half on the sidewalk where there is none."""
    rng, area = builder.rng, builder.area
    width = road.parking[0 if side < 0 else 1]
    share = rng.uniform(*area.parked)
    up = 0.0
    if width == 0:
        if road.walk < 1.5 or rng.random() > 0.25:
            return
        share, up = share * 0.3, builder.ground.kerb
    s = np.arange(road.start, road.stop, 5.4)
    s = s[rng.random(len(s)) < share] + rng.normal(0, 0.25)
    d = side * (road.half - 1.05 + (1.6 if up else 0)) + rng.normal(0, 0.08, len(s))
    free = np.ones(len(s), bool)
    for place in places:
        free &= (np.abs(s - place[0]) > 4.5) | (np.abs(d - place[1]) > 2.1)
    free &= builder.ground.carriageway(*road.at(s, d)[:2], skip=0) > 2.5
    turn = np.where(rng.random(int(free.sum())) < 0.85, 0, np.pi) + (np.pi if side > 0 else 0)
    _vehicles(builder, road, s[free], d[free], turn, up)


def moving(builder: WorldBuilder, road: Road, side: int, places: Array) -> None:
    """Traffic in the lane of one side, never where a pose is."""
    rng = builder.rng
    count = _count(builder, rng.uniform(*builder.area.traffic), road)
    lane = road.half - road.parking[0 if side < 0 else 1]
    s = np.sort(_along(builder, road, count))
    s = s[np.diff(s, prepend=-1e9) > 8]
    d = side * lane / 2 + rng.normal(0, 0.2, len(s))
    free = np.ones(len(s), bool)
    for place in places:
        free &= (np.abs(s - place[0]) > 7.5) | (np.abs(d - place[1]) > 2.3)
    for road_side in builder.ground.roads[1:]:  # poses turn at crossings
        free &= np.hypot(*(np.array(road.at(s, d)[:2]) - [[road_side.x], [road_side.y]])) > 7
    _vehicles(builder, road, s[free], d[free], np.full(int(free.sum()), np.pi if side > 0 else 0.0), 0.0, 0.12, TRAFFIC)


def _vehicles(
    builder: WorldBuilder,
    road: Road,
    s: Array,
    d: Array,
    heading: Array,
    up: float,
    two_wheels: float = 0.0,
    pace: int = STILL,
    there: bool = True,
) -> None:
    rng, clear = builder.rng, None if there else NOWHERE
    draw = rng.random(len(s))
    x, y, yaw = road.at(s, d)
    yaw = yaw + heading + rng.normal(0, 0.02, len(s))
    limits = {"bicyclist": two_wheels * 0.7, "motorcyclist": two_wheels, "bus": two_wheels * 1.4,
              "truck": two_wheels * 1.55 + 0.012, "van": two_wheels * 1.6 + 0.13, "car": 1.1}  # fmt: skip
    low = -1.0
    for kind, high in limits.items():
        chosen = (draw > low) & (draw <= high)
        if chosen.any():
            builder.put(kind, x[chosen], y[chosen], yaw[chosen], up=up, clear=clear, size=(0.96, 1.04), pace=pace)
        low = high
