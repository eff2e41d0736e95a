"""Road users that stand in nobody and in nothing: each moved a little along its street where it would, or left out.

What is drawn for a street knows little of what was drawn before: people stand in people, poles and cars, bicycles of a
rack in one another. Labelled scans of denser streets, and drives, have none of that.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarsynth.streets.actors import MARGIN, Actors, actors_of, bounds_of
from lidarsynth.streets.ground import Ground, Road
from lidarsynth.streets.world import FRONT, TRAFFIC, World

VEHICLES = ("car", "van", "truck", "bus", "lorry", "coach", "trailer")
LEAVES = ("bush", "thicket")  # people may stand at them
TRUNKS, TRUNK = ("tree", "young tree"), 0.3  # m, half of a trunk
POSTS = (*TRUNKS, "lamp", "sign", "bollard", "bin", "panel")
HARD = ("garden wall", "high wall", "railed wall", "guard rail", "concrete barrier")  # no vehicle stands in these
WALL = 0.1  # m, half of a house's wall
CARRIER = (2.15, 0.95)  # m, half length and half width of what carries the sensor
FAR, ASIDE, STEP = 6.0, 1.5, 0.3  # m, how far one is moved along the street and across it, and in which steps
KERB = 0.3  # m that one who is moved keeps from the carriageway


def footprints(place: np.ndarray, yaw: np.ndarray, middle: np.ndarray, half: np.ndarray) -> np.ndarray:
    """(..., 5) x, y, yaw, half length and half width in m and rad, of places (..., 2 or 3) and their boxes' middles in
    their own frames and half sizes, (..., 2)."""
    c, s = np.cos(yaw), np.sin(yaw)
    x = place[..., 0] + c * middle[..., 0] - s * middle[..., 1]
    y = place[..., 1] + s * middle[..., 0] + c * middle[..., 1]
    return np.stack([x, y, yaw, *np.broadcast_arrays(half[..., 0] + 0 * x, half[..., 1] + 0 * x)], axis=-1)


def meet(these: np.ndarray, those: np.ndarray) -> np.ndarray:
    """Whether footprints (..., 5) overlap, by the separating axes of two rectangles."""
    x, y = those[..., 0] - these[..., 0], those[..., 1] - these[..., 1]
    turn = those[..., 2] - these[..., 2]
    c, s = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    (a, b), (p, q) = ((of[..., 3], of[..., 4]) for of in (these, those))
    found = np.ones(np.broadcast_shapes(x.shape, turn.shape), bool)
    for yaw, long, wide in ((these[..., 2], a + p * c + q * s, b + p * s + q * c),
                            (those[..., 2], p + a * c + b * s, q + a * s + b * c)):  # fmt: skip
        along, aside = np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x
        found &= (np.abs(along) < long) & (np.abs(aside) < wide)
    return found


def boxes_on_ground(actors: Actors, gap: float, yaw: np.ndarray | None = None) -> np.ndarray:
    """(A, 5) footprints of actors' boxes and `gap` m around; yaw (A,) where they look elsewhere than in the world."""
    turn = actors.yaw if yaw is None else yaw
    return footprints(actors.place, turn, actors.middle[:, :2], actors.size[:, :2] / 2 + MARGIN + gap)


def lane(road: Road, start: float, stop: float, right: float, left: float) -> np.ndarray:
    """(N, 5) footprints of a lane from `start` to `stop` m along a road, between two distances aside."""
    count = max(int(np.ceil((stop - start) / 4.0)), 1)
    s = start + (stop - start) * (np.arange(count) + 0.5) / count
    x, y, yaw = road.at(s, np.full(s.shape, (right + left) / 2))
    half = 0.52 * (stop - start) / count  # pieces overlap where the road bends
    return np.column_stack([x, y, yaw, np.full(s.shape, half), np.full(s.shape, (left - right) / 2)])


def stand_apart(
    world: World,
    ways: np.ndarray | None = None,
    makes: np.ndarray | None = None,
    yaw: np.ndarray | None = None,
    there: np.ndarray | None = None,
    gap: float = 0.01,
) -> tuple[World, np.ndarray]:
    """The world with those moved, or left out, who would stand in others; and (A,) bool, who of its actors is left.

    ways   (N, 5) footprints that are kept free by all but those that `makes` (A,) them, by driving or riding there;
           None = where the poses are, and who drives
    yaw    (A,) rad, where the actors look, if elsewhere; there (A,) bool, those that are there at all
    gap    m between boxes
    """
    actors = actors_of(world)
    boxes = boxes_on_ground(actors, gap / 2, yaw)
    there = np.ones(len(actors), bool) if there is None else there
    kept = footprints(world.poses, world.poses[:, 3], np.zeros(2), np.array(CARRIER)) if ways is None else ways
    going = np.equal(actors.pace, TRAFFIC) if makes is None else makes
    fixed, taken = what_stands(world), np.zeros((0, 5))
    hard = bases(world, np.flatnonzero(np.isin(world.things["kind"], POSTS + HARD)))
    solid = np.concatenate([hard, walls(world)])  # vehicles may stand at fences and in hedges
    shift, left = np.zeros((len(actors), 2)), there.copy()
    for one in _order(actors):
        if not there[one]:
            continue
        parked, goes = actors.kind[one] in VEHICLES, bool(going[one])
        others = taken if goes else np.concatenate([taken, kept, solid if parked else fixed])
        move: np.ndarray | None = np.zeros(2)
        if meet(boxes[one], near(boxes[one], others, 0.0)).any():
            move = None if goes else _moved(boxes[one], others, world.ground, parked)
        if move is None:
            left[one] = False
            continue
        shift[one] = move
        boxes[one, :2] += move
        taken = np.concatenate([taken, boxes[one : one + 1]])
    return _with(world, actors, shift, left | ~there), left | ~there


def _order(actors: Actors) -> list[int]:
    """Whose place counts first: what drives, vehicles that stand, large ones first, riders, two-wheelers, people."""
    rank = np.select([actors.pace == TRAFFIC, np.isin(actors.kind, VEHICLES), actors.kind != "person"], [0, 1, 2], 3)
    long = np.where(rank == 1, -actors.size[:, 0], 0)
    rides = ~np.isin(actors.kind, ("bicyclist", "motorcyclist"))
    return np.lexsort((np.arange(len(actors)), long, rides, rank)).tolist()


def near(box: np.ndarray, others: np.ndarray, reach: float) -> np.ndarray:
    """Those of the footprints `others` (N, 5) that may be less than `reach` m away from one, (5,)."""
    away = np.hypot(others[:, 0] - box[0], others[:, 1] - box[1])
    return others[away < reach + np.hypot(box[3], box[4]) + np.hypot(others[:, 3], others[:, 4])]


def _moved(box: np.ndarray, others: np.ndarray, ground: Ground, parked: bool) -> np.ndarray | None:
    """(2,) m, the least move along or across its street by which a thing meets nothing; None where there is none."""
    x, y = box[:1], box[1:2]
    places = [road.coordinates(x, y) for road in ground.roads]
    gaps = [abs(d.item()) - road.half for road, (_, d) in zip(ground.roads, places, strict=True)]
    number = int(np.argmin(gaps))
    road, (s, d), gap = ground.roads[number], places[number], gaps[number]
    if not np.isfinite(gap):
        return None
    along, aside = (np.arange(-reach, reach + STEP / 2, STEP) for reach in (FAR, 0.6 if parked else ASIDE))
    ways = np.stack(np.meshgrid(along, aside, indexing="ij"), axis=-1).reshape(-1, 2)
    ways = ways[np.argsort(np.hypot(*ways.T), kind="stable")]
    to_x, to_y, _ = road.at(s + ways[:, 0], d + ways[:, 1])
    moves = np.column_stack([to_x, to_y]) - np.column_stack(road.at(s, d)[:2])
    edge = ground.carriageway(x + moves[:, 0], y + moves[:, 1])
    if gap > 0 and not parked:
        good = (edge >= min(gap, KERB)) & (edge <= max(gap, road.walk - KERB))
    else:
        good = (edge < 0) == (gap < 0)
    good &= (s + ways[:, 0] > road.start) & (s + ways[:, 0] < road.stop)
    moves = moves[good]
    tried = np.repeat(box[None], len(moves), axis=0)
    tried[:, :2] += moves
    free = np.flatnonzero(~meet(tried[:, None], near(box, others, np.hypot(FAR, ASIDE))[None]).any(axis=1))
    return moves[free[0]] if len(free) else None


def what_stands(world: World) -> np.ndarray:
    """(N, 5) footprints of all that stands and is no road user, first POSTS, last walls; of trees their trunks, leaves
    aside."""
    return np.concatenate([bases(world, things_that_stand(world)), walls(world)])


def things_that_stand(world: World) -> np.ndarray:
    """Rows of `World.things` of all that stands and is no road user, first POSTS, leaves aside."""
    kind, numbers = world.things["kind"], np.arange(len(world.things))
    posts = np.isin(kind, POSTS)
    others = ~posts & ~np.isin(kind, LEAVES) & ~np.isin(numbers, actors_of(world).thing)
    return np.concatenate([numbers[posts], numbers[others]])


def bases(world: World, rows: np.ndarray) -> np.ndarray:
    """(N, 5) footprints of these things; of trees their trunks."""
    found = world.things[rows]
    bounds = np.array([bounds_of(str(one["kind"]), int(one["variant"])) for one in found]).reshape(-1, 2, 3)
    low, high = (bounds[:, k, :2] * found["row"][:, 4:6] for k in (0, 1))
    tree = np.isin(found["kind"], TRUNKS)[:, None]
    middle, half = np.where(tree, 0, (low + high) / 2), np.where(tree, TRUNK, (high - low) / 2)
    return footprints(found["row"], found["row"][:, 3], middle, half)


def walls(world: World) -> np.ndarray:
    """(N, 5) footprints of the houses' walls."""
    start, end = np.moveaxis(world.corners[world.kind == FRONT, :2, :2].astype(float), 1, 0)  # as `walls_of` has them
    x, y = (end - start).T
    half = np.column_stack([np.hypot(x, y) / 2, np.full(len(x), WALL)])
    return footprints((start + end) / 2, np.arctan2(y, x), np.zeros(2), half)[::2]


def _with(world: World, actors: Actors, shift: np.ndarray, left: np.ndarray) -> World:
    """The world whose actors are moved by shift (A, 2) m, over its ground, without those that are not `left` (A,)."""
    old = actors.place[:, :2]
    new = old + shift
    ground, by = world.ground, np.zeros((len(world.things) + 1, 3))
    rise = ground.height(*new.T) - ground.height(*old.T)
    by[actors.thing] = np.column_stack([shift, np.where(shift.any(axis=1), rise, 0)])
    things, stays = world.things.copy(), np.ones(len(world.things), bool)
    things["row"][:, :3] += by[:-1]
    stays[actors.thing] = left
    return only(
        replace(world, things=things, corners=world.corners + by[world.thing].astype(np.float32)[:, None]), stays
    )


def only(world: World, stays: np.ndarray) -> World:
    """The world without the things that do not stay, (T,) bool of `World.things`."""
    number = np.append(np.cumsum(stays) - 1, -1).astype(np.int32)
    kept = np.flatnonzero(np.append(stays, True)[world.thing])
    parts = {
        key: getattr(world, key)[kept] for key in ("corners", "kind", "material", "label", "tint", "front", "thing")
    }
    return replace(world, **(parts | {"thing": number[parts["thing"]]}), things=world.things[stays])
