"""What a street has more of when it is asked for: people in groups, parked motorcycles, road works, cyclists, heavy
vehicles, fences and walls, crash barriers, panels, riders, people and bicycles of more shapes.

All of it is drawn after everything else, so that the rest of a world is the same with and without.
"""

from __future__ import annotations

import numpy as np

from lidarsynth.streets.builder import WorldBuilder
from lidarsynth.streets.ground import Road
from lidarsynth.streets.world import TRAFFIC, WALK

FENCES = ("board fence", "board fence", "mesh fence", "railed wall", "high wall", "overgrown fence")
VEHICLES = ("car", "van", "truck", "bus", "lorry", "coach", "trailer")
ON_ROAD = (*VEHICLES, "bicyclist", "motorcyclist")
ROOM = {"lorry": 10.5, "coach": 10.0, "trailer": 6.0}  # metres from one's middle to that of any other vehicle


def more(builder: WorldBuilder, places: np.ndarray) -> None:
    """Draws what the area asks for, per 100 m and side; an area that asks for nothing draws nothing.

    places (P, 2): (s, d) of the poses on the main road, where nobody rides
    """
    for road in builder.ground.roads:
        for side in (-1, 1):
            for per_100, put in ((builder.area.groups, _group), (builder.area.motorcycles, _motorcycles),
                                 (builder.area.works, _works), (builder.area.cyclists, _cyclists),
                                 (builder.area.heavy, _heavy), (builder.area.walls, _walls),
                                 (builder.area.barriers, _barriers), (builder.area.panels, _panels)):  # fmt: skip
                if per_100 > 0:
                    count = int(builder.rng.poisson(per_100 * (road.stop - road.start) / 100))
                    for s in builder.rng.uniform(road.start, road.stop, count):
                        put(builder, road, side, float(s))
    for number, road in enumerate(builder.ground.roads):
        for side in (-1, 1):
            if number == 0:
                _riders(builder, road, side, places)
            _walkers(builder, road, side)
            _racks(builder, road, side)


def _drawn(builder: WorldBuilder, road: Road, per_100: float) -> np.ndarray:
    """(N,) metres along the road."""
    if per_100 <= 0:
        return np.zeros(0)
    return builder.rng.uniform(road.start, road.stop, builder.rng.poisson(per_100 * (road.stop - road.start) / 100))


def _riders(builder: WorldBuilder, road: Road, side: int, places: np.ndarray) -> None:
    """On the main road, with the traffic of their side, cyclists nearer to its edge; where no vehicle is."""
    rng, edge = builder.rng, road.half - road.parking[0 if side < 0 else 1]
    for s in _drawn(builder, road, builder.area.riders):
        kind = str(rng.choice(["bicyclist", "motorcyclist"]))
        out = edge - rng.uniform(0.5, 1.2) if kind == "bicyclist" else edge * rng.uniform(0.35, 0.7)
        at, turn = np.array([s]), (np.pi if side > 0 else 0.0) + rng.normal(0, 0.04)
        x, y, along = road.at(at, np.array([side * out]))
        near = [group.rows[:, :2] for group in builder.groups if group.kind in ON_ROAD]
        near.append(np.stack([x, y], 1) + 1e3)
        gap = np.abs(road.coordinates(*np.concatenate(near).T) - np.array([[s], [side * out]]))
        free = not ((gap[0] < 5.0) & (gap[1] < 1.9)).any()
        free &= not ((np.abs(places[:, 0] - s) < 6.0) & (np.abs(places[:, 1] - side * out) < 2.3)).any()
        if free and all(np.hypot(x[0] - other.x, y[0] - other.y) > 7 for other in builder.ground.roads[1:]):
            builder.put(kind, x, y, along + turn, clear=None, size=(0.95, 1.06), pace=TRAFFIC, all_shapes=True)


def _walkers(builder: WorldBuilder, road: Road, side: int) -> None:
    """On the sidewalk, most of them along it."""
    s, rng = _drawn(builder, road, builder.area.walkers), builder.rng
    if len(s):
        out = road.half + rng.uniform(0.3, max(road.walk, 1.5), len(s))
        x, y, along = road.at(s, side * out)
        yaw = along + np.where(rng.random(len(s)) < 0.5, 0, np.pi) + rng.normal(0, 0.5, len(s))
        up = builder.ground.kerb if road.walk > 0 else 0.0
        builder.put("person", x, y, yaw, up=up, clear=0.0, pace=WALK, all_shapes=True)


def _racks(builder: WorldBuilder, road: Road, side: int) -> None:
    """One to six that lean against what stands behind the sidewalk, or stand across it in a rack."""
    rng = builder.rng
    for s in _drawn(builder, road, builder.area.racks):
        rack, count = rng.random() < 0.5, int(rng.integers(1, 7))
        place = s + (0.6 if rack else 1.9) * np.arange(count)
        x, y, along = road.at(place, np.full(count, side * (road.half + max(road.walk, 1.5) - 0.4)))
        yaw = along + (np.pi / 2 if rack else 0.0) + rng.normal(0, 0.08, count)
        up = builder.ground.kerb if road.walk > 0 else 0.0
        builder.put("bicycle", x, y, yaw, up=up, clear=0.0, all_shapes=True)


def _group(builder: WorldBuilder, road: Road, side: int, s: float) -> None:
    """Two to five people on the sidewalk who face one another."""
    rng = builder.rng
    count = int(rng.integers(2, 6))
    around = rng.uniform(0, 6.28) + np.arange(count) * 2 * np.pi / count + rng.normal(0, 0.2, count)
    far = rng.uniform(0.4, 0.6) * max(1.0, count / 3)
    middle = road.half + max(road.walk, 1.5) * rng.uniform(0.4, 0.8)
    x, y, _ = road.at(s + far * np.cos(around), side * middle + far * np.sin(around))
    cx, cy, _ = road.at(np.array([s]), np.array([side * middle]))
    yaw = np.arctan2(cy - y, cx - x) + rng.normal(0, 0.3, count)
    builder.put("person", x, y, yaw, up=builder.ground.kerb if road.walk > 0 else 0.0, clear=0.0)


def _motorcycles(builder: WorldBuilder, road: Road, side: int, s: float) -> None:
    """One to four, side by side, across the edge of the sidewalk."""
    rng = builder.rng
    count = int(rng.integers(1, 5))
    place = s + 0.95 * np.arange(count)
    x, y, along = road.at(place, np.full(count, side * (road.half + 1.1)))
    yaw = along + rng.choice([0.5, np.pi / 2]) + rng.normal(0, 0.08, count)
    builder.put("motorcycle", x, y, yaw, up=builder.ground.kerb if road.walk > 0 else 0.0, clear=0.0)


def _cyclists(builder: WorldBuilder, road: Road, side: int, s: float) -> None:
    """One, or two in a row, along the sidewalk's edge, with the traffic of their side; none without a sidewalk."""
    rng = builder.rng
    place = s - 4.0 * np.arange(1 + int(rng.random() < 0.25))
    aside, sway = road.half + 0.7 + rng.normal(0, 0.1), rng.normal(0, 0.05)
    if road.walk < 1.3:
        return
    x, y, along = road.at(place, np.full(len(place), side * aside))
    yaw = along + sway + (np.pi if side > 0 else 0.0)
    builder.put("bicyclist", x, y, yaw, up=builder.ground.kerb, clear=0.0, size=(0.96, 1.04), pace=WALK)


def _heavy(builder: WorldBuilder, road: Road, side: int, s: float) -> None:
    """A lorry, coach or trailer in the parking lane, or else beyond the sidewalk, where no vehicle or house stands: the
    first such place of ten."""
    rng = builder.rng
    kind = str(rng.choice(["lorry", "lorry", "coach", "trailer"]))
    lane = road.parking[0 if side < 0 else 1] and rng.random() < 0.7
    out = road.half - 1.2 if lane else road.half + road.walk + rng.uniform(1.6, 8.0)
    turn = rng.choice([0.0, 0.0, 0.0, np.pi]) + (np.pi if side > 0 else 0.0) + rng.normal(0, 0.02)
    taken = [group.rows for group in builder.groups if group.kind in VEHICLES]
    axle = np.linspace(-0.8, 0.8, 9) * ROOM[kind]
    for place in (s, *rng.uniform(road.start, road.stop, 9)):
        x, y, along = road.at(np.array([place]), np.array([side * out]))
        gap = min((np.hypot(rows[:, 0] - x, rows[:, 1] - y).min() for rows in taken if len(rows)), default=np.inf)
        free = gap > ROOM[kind] and builder.ground.carriageway(x, y)[0] > (-1.5 if lane else 1.4)
        if free and not _indoors(builder, x + axle * np.cos(along), y + axle * np.sin(along)):
            builder.put(kind, x, y, along + turn, clear=None, size=(0.94, 1.06))
            return


def _indoors(builder: WorldBuilder, x: np.ndarray, y: np.ndarray) -> bool:
    """Whether any of the places (N,) is in a house, or nearer than 1.5 m to it."""
    for houses in builder.houses:
        along_x, along_y = (np.roll(corners, -1, 1) - corners for corners in (houses.x, houses.y))
        aside = along_x[..., None] * (y - houses.y[..., None]) - along_y[..., None] * (x - houses.x[..., None])
        aside = aside / np.maximum(np.hypot(along_x, along_y), 1e-6)[..., None]  # (H, 4, N) metres beside each wall
        if ((aside > -1.5).all(1) | (aside < 1.5).all(1)).any():
            return True
    return False


def _walls(builder: WorldBuilder, road: Road, side: int, s: float) -> None:
    """6 to 40 m of a fence or wall along the sidewalk, here and there with gaps."""
    rng = builder.rng
    kind, pieces = str(rng.choice(FENCES)), int(rng.integers(3, 21))
    out = road.half + road.walk + rng.choice([0.3, rng.uniform(0.3, 5.0)])
    place = s + 1 + 2.0 * np.arange(pieces)
    place = place[(rng.random(pieces) > 0.05) & (place < road.stop)]
    x, y, along = road.at(place, np.full(len(place), side * out))
    builder.put_row(kind, x, y, along, (int(rng.integers(0, 64)), rng.uniform(0.85, 1.15), rng.normal()))


def _barriers(builder: WorldBuilder, road: Road, side: int, s: float) -> None:
    """30 to 120 m of crash barrier beside the carriageway."""
    rng = builder.rng
    kind = str(rng.choice(["guard rail", "guard rail", "concrete barrier"]))
    place = np.arange(s, min(s + rng.uniform(30, 120), road.stop), 2.0)
    x, y, along = road.at(place, np.full(len(place), side * (road.half + rng.uniform(0.45, 1.0))))
    turn = 0.0 if side > 0 else np.pi
    builder.put_row(kind, x, y, along + turn, (int(rng.integers(0, 64)), rng.uniform(0.9, 1.1), rng.normal()))


def _panels(builder: WorldBuilder, road: Road, side: int, s: float) -> None:
    """One that looks at the traffic of its side."""
    rng = builder.rng
    out = road.half + rng.uniform(0.9, max(road.walk, 1.5) + 1.5)
    x, y, along = road.at(np.array([s]), np.array([side * out]))
    builder.put("panel", x, y, along + (np.pi if side < 0 else 0.0) + rng.normal(0, 0.25), clear=0.3)


def _works(builder: WorldBuilder, road: Road, side: int, s: float) -> None:
    """A fenced piece of sidewalk and gutter with a heap and a box, and cones that lead the traffic past it."""
    rng = builder.rng
    boards, deep = int(rng.integers(4, 10)), max(road.walk * 0.8, 1.6)
    length, near = 2.0 * boards, road.half - 0.3
    front = [(s + 1 + 2.0 * k, near, 0.0) for k in range(boards)]
    ends = [(s + end, near + 1 + 2.0 * k, np.pi / 2) for end in (0, length) for k in range(max(1, round(deep / 2)))]
    place, out, turn = np.array(front + ends).T
    x, y, along = road.at(place, side * out)
    builder.put("barrier board", x, y, along + turn, clear=None, size=(1.0, 1.0))
    towards = -1 if side < 0 else 1  # the traffic of the right side comes from behind
    cones = np.arange(5)
    x, y, _ = road.at(s + (length if towards > 0 else 0) + towards * (1 + 1.8 * cones), side * (near + 0.1 * cones))
    builder.put("cone", x, y, rng.uniform(0, 6.28, 5), clear=None)
    inside = s + length * rng.uniform(0.25, 0.75, 2)
    for kind, at in zip(("heap", "site box"), inside, strict=True):
        x, y, along = road.at(np.array([at]), np.array([side * (road.half + deep / 2)]))
        builder.put(kind, x, y, along, clear=None, size=(0.7, 1.2))
