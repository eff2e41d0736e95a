"""Drives in which nobody goes through anybody or anything: the ways of vehicles and riders are kept free and end where
a house stands across them, and everyone who walks has a piece of sidewalk alone, to the ends of which they go and turn.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarsynth.streets.actors import MARGIN, actors_of
from lidarsynth.streets.apart import (
    CARRIER,
    bases,
    boxes_on_ground,
    footprints,
    lane,
    meet,
    near,
    only,
    stand_apart,
    things_that_stand,
    walls,
    what_stands,
)
from lidarsynth.streets.drive import Drive
from lidarsynth.streets.ground import Road
from lidarsynth.streets.traffic import BRAKING, STEP
from lidarsynth.streets.world import TRAFFIC

GAP = 0.1  # m between boxes
SWAY = 0.2  # m that the carrier sways to each side
BEFORE = 0.5  # m that those who come along a side road stay away from the main road's sidewalk
QUEUE = 2.5  # m from one rider who waits there to the next
HOME, CELL = 10.0, 0.25  # m that one walks to each side of where they are at first, at most; in which steps it is tried
ENOUGH = 6.0  # m of way that nobody looks farther for
LEAST = 1.5  # m that are worth walking
STRIP = 0.1  # m, in which steps riders beside a road are moved to where least stands in their way
PAUSE, TURN = 2.0, 1.5  # s at the end of one's way, of which one turns


def set_apart(drive: Drive) -> Drive:
    """The drive in which no two boxes ever meet: those who would stand in others are moved or left out, as
    `stand_apart` has it, and so are those in the way; riders of one side go as fast as the slowest of them."""
    drive = _cleared(_abreast(drive))
    walks, there = _walks(drive), (drive.number < 0) | (drive.ahead != 0)
    ways = _ways(drive, there)
    yaw = drive.moment(0.0).yaw
    world, left = stand_apart(drive.world, ways, _makes(drive), yaw, there & ~walks, GAP)
    drive = replace(
        drive, world=world, actors=actors_of(world), along=drive.along[:, left], aside=drive.aside[left],
        number=drive.number[left], ahead=drive.ahead[left], turned=drive.turned[:, left],
    )  # fmt: skip
    return _with_ways_of_their_own(drive, ways)


def _walks(drive: Drive) -> np.ndarray:
    return (drive.number >= 0) & (drive.ahead != 0) & (drive.actors.kind == "person")


def _makes(drive: Drive) -> np.ndarray:
    """(A,) bool: those that make the ways, who drive or ride."""
    return (drive.actors.pace == TRAFFIC) | ((drive.number >= 0) & (drive.actors.kind == "bicyclist"))


def _limit(drive: Drive, number: int) -> float:
    """m along a side road, to both sides, that are the main road's, and its sidewalks'; 0 of that itself."""
    main = drive.world.ground.roads[0]
    return 0.0 if number == 0 else main.half + main.walk + BEFORE


def _abreast(drive: Drive) -> Drive:
    """Riders on one side of a road as fast as the slowest, so that none meets the one before; they wait at the main
    road. Of vehicles that would meet head-on the later one is left out."""
    along, ahead = drive.along.copy(), drive.ahead.copy()
    rides = (drive.number >= 0) & (ahead != 0) & (drive.actors.kind == "bicyclist") & (drive.actors.pace != TRAFFIC)
    for number in range(len(drive.world.ground.roads)):
        for way in (-1, 1):
            mine = np.flatnonzero(rides & (drive.number == number) & (ahead == way))
            if not len(mine):
                continue
            gone = np.abs(along[:, mine] - along[0, mine]).min(axis=1)
            to, limit = way * along[0, mine], _limit(drive, number)
            order = np.argsort(np.argsort(-np.where(to < -limit, to, -np.inf)))
            track, pace = to + gone[:, None], gone[1] / STEP
            halted = _halted(to, gone, np.maximum(-limit - QUEUE * order, to), pace)
            along[:, mine] = way * np.where((to < -limit) & (number > 0), halted, track)
    drives = np.flatnonzero((drive.actors.pace == TRAFFIC) & (ahead != 0))
    wide = drive.actors.size[:, 1] / 2 + MARGIN + GAP
    for one in drives.tolist():
        other = drives[(drives < one) & (ahead[drives] == -ahead[one])]
        if (np.abs(drive.aside[other] - drive.aside[one]) < wide[other] + wide[one]).any():
            ahead[one] = 0
    return replace(drive, along=along, ahead=ahead)


def _halted(start: np.ndarray, gone: np.ndarray, stop: np.ndarray, pace: float) -> np.ndarray:
    """(steps, N) m along a road of those who ride from `start` (N,) at `pace` m/s and brake so as to stand at `stop`
    (N,): as comfortably as there is room. gone (steps,) m that they ride where they need not stop."""
    brakes = np.minimum(pace**2 / (2 * BRAKING), stop - start)  # m from the brake to the stop: twice that in full ride
    begun = np.clip(start + gone[:, None] - (stop - brakes), 0, 2 * brakes)
    saved = begun**2 / np.maximum(4 * brakes, 1e-9)
    return np.minimum(start + gone[:, None], stop - brakes + begun) - saved


def _cleared(drive: Drive) -> Drive:
    """The drive whose riders beside a road are where least stands in their way, without what stands in the ways still,
    and without riders that would meet a house: they and vehicles go as far as to what closes their road."""
    world, aside = drive.world, drive.aside.copy()
    drive = replace(drive, reach=_reach(drive))
    rows = things_that_stand(world)
    standing, houses = bases(world, rows), walls(world)
    rides = (drive.number >= 0) & (drive.ahead != 0) & _makes(drive) & (drive.actors.pace != TRAFFIC)
    for number, road in enumerate(world.ground.roads):
        for side in (-1, 1):
            mine = np.flatnonzero(rides & (drive.number == number) & (np.sign(aside) == side))
            if len(mine):
                aside[mine] += side * _least(road, *_strip(drive, mine), side, standing, houses)
    drive = replace(drive, aside=aside)
    blocked = [
        one
        for one in np.flatnonzero(rides).tolist()
        if meet(lane(world.ground.roads[drive.number[one]], *_strip(drive, np.array([one])))[:, None], houses).any()
    ]
    ahead = drive.ahead.copy()
    ahead[blocked] = 0
    drive = replace(drive, ahead=ahead)
    met = meet(standing[:, None], _ways(drive, drive.ahead != 0)[None]).any(axis=1)
    stays = np.ones(len(world.things), bool)
    stays[rows[met]] = False
    world = only(world, stays)
    return replace(drive, world=world, actors=actors_of(world))


def _least(
    road: Road, start: float, stop: float, right: float, left: float, side: int, things: np.ndarray, houses: np.ndarray
) -> float:
    """m outward by which a strip of a sidewalk meets no house, if it may, and then the fewest things; the least of
    these. Things and houses are footprints (N, 5), the strip goes from `start` to `stop` m along the road."""
    room = max(road.half + road.walk - max(abs(right), abs(left)), 0.0)
    moves, met = np.arange(0.0, room + STRIP / 2, STRIP), []
    for move in side * moves:
        strip = lane(road, start, stop, right + move, left + move)[:, None]
        met.append((meet(strip, houses).any(), meet(strip, things).any(axis=0).sum()))
    return float(moves[min(range(len(moves)), key=met.__getitem__)])


def _reach(drive: Drive) -> np.ndarray:
    """(R, 2) m along each road to what stands across it beyond the carrier's way, or the main road: a house, a thicket;
    to the road's end where nothing does."""
    world, found = drive.world, drive.reach.copy()
    across = np.concatenate([walls(world), bases(world, np.flatnonzero(world.things["kind"] == "thicket"))])
    main = world.ground.roads[0]
    for number, road in enumerate(world.ground.roads):
        pieces = lane(road, road.start, road.stop, -road.half / 2, road.half / 2)
        ends = np.linspace(road.start, road.stop, len(pieces) + 1)
        closed = meet(pieces[:, None], across[None]).any(axis=1)
        inner = (-main.half - main.walk, main.half + main.walk) if number else (drive.own.min(), drive.own.max())
        found[number, 0] = ends[1:][closed & (ends[1:] < inner[0])].max(initial=road.start)
        found[number, 1] = ends[:-1][closed & (ends[:-1] > inner[1])].min(initial=road.stop)
    return found


def _strip(drive: Drive, mine: np.ndarray) -> tuple[float, float, float, float]:
    """m along a road from where to where these actors of it go, and between which distances aside."""
    half, track = drive.actors.size[mine] / 2 + MARGIN + GAP, drive.along[:, mine]
    low, high = drive.reach[drive.number[mine[0]]]
    start, stop = (track - half[:, 0]).min(), (track + half[:, 0]).max()
    right, left = (drive.aside[mine] - half[:, 1]).min(), (drive.aside[mine] + half[:, 1]).max()
    return max(start, low), min(stop, high), right, left


def _ways(drive: Drive, there: np.ndarray) -> np.ndarray:
    """(N, 5) footprints of what is driven and ridden on: by the carrier, on each side of each road and sidewalk."""
    roads, wide = drive.world.ground.roads, CARRIER[1] + SWAY
    found = [lane(roads[0], drive.own.min() - CARRIER[0], drive.own.max() + CARRIER[0], drive.lane - wide,
                  drive.lane + wide)]  # fmt: skip
    on_road, makes = drive.actors.pace == TRAFFIC, there & _makes(drive)
    for number, road in enumerate(roads):
        for side in (-1, 1):
            for among in (on_road, ~on_road):
                mine = np.flatnonzero(makes & among & (drive.number == number) & (np.sign(drive.aside) == side))
                if not len(mine):
                    continue
                found.append(lane(road, *_strip(drive, mine)))
    return np.concatenate(found)


def _with_ways_of_their_own(drive: Drive, ways: np.ndarray) -> Drive:
    """Everyone who walks to and fro on a piece of sidewalk that is free; those that find none are left out."""
    along, aside, ahead, turned = drive.along.copy(), drive.aside.copy(), drive.ahead.copy(), drive.turned.copy()
    walks, times = _walks(drive), STEP * np.arange(len(along))
    stands = ~walks & (drive.number < 0)
    taken = [what_stands(drive.world), ways, boxes_on_ground(drive.actors, GAP / 2)[stands]]
    others = np.concatenate(taken)
    for one in np.flatnonzero(walks).tolist():
        road = drive.world.ground.roads[drive.number[one]]
        half = drive.actors.size[one, :2] / 2 + np.abs(drive.actors.middle[one, :2]) + MARGIN + GAP / 2
        found = _way(road, _limit(drive, int(drive.number[one])), along[0, one], aside[one], half, others)
        if found is None:
            ahead[one] = 0
            continue
        s, aside[one], low, high = found
        pace = abs(along[1, one] - along[0, one]) / STEP
        along[:, one], facing = _to_and_fro(low, high, s, pace, int(ahead[one]), times)
        turned[:, one] = facing - (0.0 if ahead[one] > 0 else np.pi)
        reach = np.hypot(*half) if np.ptp(turned[:, one]) > 0 else half[1]
        low, high = along[:, one].min() - max(half[0], reach), along[:, one].max() + max(half[0], reach)
        others = np.concatenate([others, lane(road, low, high, aside[one] - reach, aside[one] + reach)])
    return replace(drive, along=along, aside=aside, ahead=ahead, turned=turned)


def _way(
    road: Road, limit: float, s: float, d: float, half: np.ndarray, others: np.ndarray
) -> tuple[float, float, float, float] | None:
    """Where one begins who would at (s, d), and from where to where along the road they may go: beside the same place
    if that is long enough, else the longest of those near. None where there is no room to stand.

    half (2,) m, of their box; limit m around the road's middle that are the main road's
    """
    cells = np.arange(-HOME, HOME + CELL / 2, CELL)
    x, y, _ = road.at(np.array([s]), np.array([d]))
    close = near(np.array([x[0], y[0], 0, HOME, 2.0]), others, 0.0)
    best = None
    out, inner = abs(d) - road.half, np.array([0.0, 0.3, -0.3, 0.6, -0.6, 0.9, -0.9, 1.2, -1.2])
    for move in inner[(out + inner > half[1]) & (out + inner < max(out, road.walk - half[1])) | (inner == 0)].tolist():
        to = d + np.sign(d) * move
        x, y, yaw = road.at(s + cells, np.full(cells.shape, to))
        place = np.column_stack([x, y])
        inside = (s + cells > road.start + 1) & (s + cells < road.stop - 1)
        inside &= (np.abs(s + cells) > limit) & (np.sign(s + cells) == np.sign(s)) if limit else True
        free, wide = (~meet(footprints(place, yaw, np.zeros(2), size)[:, None], close[None]).any(axis=1) & inside
                      for size in (half, np.full(2, np.hypot(*half))))  # fmt: skip
        begin, low, high = _longest(free, wide)
        if begin >= 0 and (best is None or high - low > best[3] - best[2] + LEAST):
            best = (s + cells[begin], to, s + cells[low], s + cells[high])
        if best is not None and best[3] - best[2] >= ENOUGH:
            break
    return best


def _longest(free: np.ndarray, wide: np.ndarray) -> tuple[int, int, int]:
    """The cell to begin in, nearest to the middle one, and the first and last of the free ones around it between cells
    `wide` enough to turn; -1 of all where none is."""
    middle = len(free) // 2
    turns = np.flatnonzero(free & wide)
    if not len(turns):
        return -1, -1, -1
    begin = turns[np.argmin(np.abs(turns - middle))]
    part = np.cumsum(~free)
    mine = turns[part[turns] == part[begin]]
    if free[middle] and part[middle] == part[begin] and mine[0] <= middle <= mine[-1]:
        begin = middle
    return int(begin), int(mine[0]), int(mine[-1])


def _to_and_fro(
    low: float, high: float, s: float, pace: float, ahead: int, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(steps,) m along the road and rad against it of one who goes from s, ahead or back, and turns at both ends."""
    if high - low < LEAST or pace == 0:
        return np.full(times.shape, s), np.full(times.shape, 0.0 if ahead > 0 else np.pi)
    way = (high - low) / pace
    half = way + PAUSE
    start = (s - low) / pace if ahead > 0 else half + (high - s) / pace
    rounds, phase = np.divmod(times + start, half)
    back = rounds % 2 == 1
    gone = np.minimum(phase, way) * pace
    turn = np.pi * np.clip((phase - way - (PAUSE - TURN) / 2) / TURN, 0, 1)
    return np.where(back, high - gone, low + gone), np.pi * rounds + turn
