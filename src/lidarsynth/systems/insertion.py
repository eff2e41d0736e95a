"""Recorded scans with road users more: the streets' own shapes, met by the very rays of the scan, which hide what is
behind them and are hidden by what is before."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from lidarsynth.files.labels import MOST_INSTANCES
from lidarsynth.lidar.boxes import Box
from lidarsynth.lidar.columns import usual_at_most
from lidarsynth.lidar.lost_rays import LostRays, lost_rays
from lidarsynth.lidar.marks import confidences, marks_of, were_new
from lidarsynth.lidar.projection import pixel_of_points, project
from lidarsynth.lidar.removal import own_classes
from lidarsynth.lidar.scan import RangeImage, Scan, check_seen
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.streets.actors import KINDS
from lidarsynth.streets.hdl64e import Lasers, hidden, lasers
from lidarsynth.streets.kittis_car import outline_of, outlined
from lidarsynth.streets.lone import alone
from lidarsynth.streets.objects import library
from lidarsynth.streets.raycast import FewTriangles
from lidarsynth.streets.sensor_model import Returns, sense
from lidarsynth.streets.shapes import Mesh
from lidarsynth.streets.wanted import Wanted
from lidarsynth.systems.cascade.canvas import (
    OCCLUDED,
    SIZE,
    TINT,
    axis_of,
    box_around,
    canvas_of,
    levelled,
    span,
    to_sensor,
)
from lidarsynth.systems.cascade.response import Response, response_of
from lidarsynth.systems.free_places import NEAR, Spot, Surroundings

SHOWN, LEAST = 0.4, 8  # of the rays that would meet a thing where there is room, that nothing hides; its returns, and
# those that it leaves of others that were put
INSIDE = 5  # measured points that may be in a thing for which somebody names a place: noise
INSTANCE = "instance"  # field of the numbers of boxes
SAME = 2e-4  # radians between two returns of a ray, at most
BESIDE = np.radians(10)  # from one point of a ring to the next, if any of these is to tell how the sensor turns
RINGS = ("ring", "file_ring")  # further fields that tell of a ray, whatever it meets


class Inserted(NamedTuple):
    """The scan, and the boxes of what was inserted, in the sensor frame, whose `instance` its points have."""

    scan: Scan
    boxes: tuple[Box, ...]


class Names(Protocol):
    """What is asked of a model here; see `ScanModel`."""

    sensor: Sensor

    def named(self, scan: Scan, sensor: Sensor | str | None = None, least: float = 0.0) -> RangeImage: ...


@dataclass
class Rays:
    """All rays of a scan, its N points' first, then those that are lost: starts and directions (R, 3) of a frame that
    stands upright; azimuth, elevation (R,) radians; row (R,); where each ends (R,), metres, infinite for nowhere; and
    of what was put there: owner (R,), its number or -1, metres, 0 for no return, reflectance, label."""

    starts: np.ndarray
    directions: np.ndarray
    azimuth: np.ndarray
    elevation: np.ndarray
    row: np.ndarray
    ends: np.ndarray
    owner: np.ndarray
    metres: np.ndarray
    reflectance: np.ndarray
    label: np.ndarray

    def towards(self, mesh: Mesh) -> np.ndarray:
        """(n,) which rays may meet a mesh."""
        x, y, z = mesh.corners.reshape(-1, 3).T
        ahead = float(np.arctan2(y.mean(), x.mean()))
        low, high = span(np.arctan2(y, x) - ahead)
        heights = np.arctan2(z, np.hypot(x, y))
        around = (self.azimuth - ahead + np.pi) % (2 * np.pi) - np.pi
        at = (around > low - 0.02) & (around < high + 0.02)
        return np.flatnonzero(at & (self.elevation > heights.min() - 0.05) & (self.elevation < heights.max() + 0.05))


class Thing(NamedTuple):
    """What is put: a word of KINDS, its shape in its own frame, its place, and the rays (m,) that would meet it."""

    kind: str
    mesh: Mesh
    spot: Spot
    met: np.ndarray


class Placed(NamedTuple):
    """All rays of a scan of a sensor, after what was put; which of them are lost ones; how the scan reports."""

    rays: Rays
    lost: LostRays
    put: list[Thing]
    sensor: Sensor
    response: Response


def inserted(model: Names, scan: Scan, things: Sequence[Wanted], rng: np.random.Generator) -> Inserted:
    """`ScanModel.insert` of a model with images of the scan's own sensor."""
    return with_points(scan, placed(model, scan, things, rng))


def placed(model: Names, scan: Scan, things: Sequence[Wanted], rng: np.random.Generator) -> Placed:
    """Where all that finds room stands. Raises ValueError as `ScanModel.insert` does."""
    raw = scan.extra.get("raw_label")
    own, sensor = own_classes(scan), usual_at_most(model.sensor)
    if own is None and raw is not None:
        raise ValueError("expected labels of SemanticKITTI's raw ids, beside which those of what is inserted stand, "
                         "found others")  # fmt: skip
    if own is not None and (stray := own[(own < 0) | (own >= len(CLASS_NUMBER))]).size:
        raise ValueError(f"expected labels of 0-{len(CLASS_NUMBER) - 1}, SemanticKITTI's training classes, found "
                         f'{stray[0]}; extra["raw_label"] takes its raw ids')  # fmt: skip
    if own is None or not own[were_new(scan) == 0].any():  # or as of a scan without labels that has been inserted into
        named = model.named(scan, sensor).completed
        assert named is not None and named.label is not None
        own = named.label if own is None else np.where(own > 0, own, named.label)
    image = check_seen(project(replace(scan, label=own.astype(np.int64)), sensor), len(scan))
    row, _ = pixel_of_points(scan, model.sensor, "auto")
    blocked = outlined(model.sensor, outline_of(sensor, image, image.mask))
    rays, lost = _rays(scan, model.sensor, row, lost_rays(scan, model.sensor, row), blocked)
    around = Surroundings(levelled(sensor, scan.xyz), own, axis_of(canvas_of(image)))
    put: list[Thing] = []
    for thing in things:
        if (found := _put(rays, around, thing, model.sensor, len(put), rng)) is not None:
            put.append(found)
    if not put:
        kinds = ", ".join(dict.fromkeys(thing.kind for thing in things))
        raise ValueError(f"expected a scan that shows free ground for {kinds}, found none where it has room")
    return Placed(rays, lost, put, model.sensor, response_of(image, image.mask))


def _rays(scan: Scan, sensor: Sensor, row: np.ndarray, lost: LostRays, blocked: np.ndarray) -> tuple[Rays, LostRays]:
    """The rays of a scan, row (N,) of each point, and the lost ones that nothing on the carrier blocks, (H, W) bool."""
    column = ((np.pi - lost.azimuth) / (2 * np.pi) * sensor.width).astype(int) % sensor.width
    free = ~blocked[lost.row, column]
    lost = LostRays(*(part[free] for part in lost))
    row = np.concatenate([row, lost.row])
    offset = np.asarray(sensor.offsets or [0.0] * sensor.height, np.float32)
    starts = np.zeros((len(row), 3), np.float32)
    starts[:, 2] = np.where(row < 0, 0, offset[row])
    up = np.radians(np.asarray(sensor.elevations))[lost.row]
    flat = np.cos(up)
    sent = np.stack([flat * np.cos(lost.azimuth), flat * np.sin(lost.azimuth), np.sin(up)], 1).astype(np.float32)
    ways = np.concatenate([scan.xyz - starts[: len(scan)], sent])
    far = np.linalg.norm(ways, axis=1)
    ways /= np.maximum(far, 1e-6)[:, None]
    ends = np.where(np.arange(len(row)) < len(scan), far, np.inf).astype(np.float32)
    starts, ways = levelled(sensor, starts), levelled(sensor, ways)
    angles = np.arctan2(ways[:, 1], ways[:, 0]), np.arcsin(ways[:, 2].clip(-1, 1))
    none = np.zeros(len(row), np.float32)
    owner = np.full(len(row), -1)
    return Rays(starts, ways, *angles, row, ends, owner, none, none.copy(), np.zeros(len(row), np.int64)), lost


def _put(
    rays: Rays, around: Surroundings, thing: Wanted, sensor: Sensor, number: int, rng: np.random.Generator
) -> Thing | None:
    """What is put as thing `number`; None where there is no room. Raises ValueError where a place that somebody names
    is not free, or not seen."""
    meshes = library()[thing.kind]
    mesh = meshes[int(rng.integers(len(meshes)))]
    mesh = replace(mesh, corners=mesh.corners * np.float32(rng.uniform(*SIZE)))
    tint = float(np.clip(rng.normal(), *TINT))
    spots = around.free(thing.kind, mesh, rng) if thing.place is None else _named(around, thing, mesh, rng)
    for spot in spots:
        there = spot.on_ground(mesh)
        at = rays.towards(there)
        found = sense(
            alone(there, tint), FewTriangles(there.corners), rays.starts[at], rays.directions[at],
            _lasers(sensor, rays.row[at]), rng, sensor.max_range,
        )  # fmt: skip
        met = np.isfinite(found.surface) & (found.face >= 0)
        seen = met & (rays.ends[at] >= found.surface - OCCLUDED)
        returned = np.where(found.distance >= sensor.min_range, found.distance, 0) * seen
        returned[np.flatnonzero(seen)[_again(rays, at[seen])]] = 0
        left = _left(rays, at[seen], number)
        if thing.place is None and (
            seen.sum() < SHOWN * met.sum() or np.count_nonzero(returned) < LEAST or (left < LEAST).any()
        ):
            continue
        if not returned.any():
            break
        if not left.all():
            raise ValueError(f"expected a place for {thing.kind} that leaves the others in sight, found that it hides "
                             f"one {_where(thing.place)}")  # fmt: skip
        _set(rays, at[seen], found, returned[seen], seen, number)
        around.taken.append(around.footprint(spot, mesh))
        return Thing(thing.kind, mesh, spot, at[met])
    if thing.place is not None:
        raise ValueError(f"expected a place for {thing.kind} that the scan's rays reach, found "
                         f"{_where(thing.place)}, of which none returns")  # fmt: skip
    return None


def _again(rays: Rays, at: np.ndarray) -> np.ndarray:
    """(n,) bool: which of rays `at` (n,) look where another of their row does, as those of a second return do."""
    azimuth, elevation, row = rays.azimuth[at], rays.elevation[at], rays.row[at]
    order, again = np.lexsort((azimuth, row)), np.zeros(len(at), bool)
    steps = (np.abs(np.diff(part[order])) for part in (azimuth, elevation, row))
    again[order[1:]] = np.logical_and.reduce([step < SAME for step in steps])
    return again


def _left(rays: Rays, at: np.ndarray, number: int) -> np.ndarray:
    """How many points are left of each thing before `number` of which rays `at` (n,) bring back any, without these."""
    owner, returns = rays.owner[at], rays.metres[at] > 0
    gone = np.bincount(owner[(owner >= 0) & returns], minlength=number)
    if not gone.any():
        return gone[:0]
    points = np.bincount(rays.owner[(rays.owner >= 0) & (rays.metres > 0)], minlength=number)
    return (points - gone)[gone > 0]


def _where(place: tuple[float, float] | None) -> str:
    return "" if place is None else f"{place[0]:g} m ahead, {place[1]:g} m to the left"


def _set(rays: Rays, at: np.ndarray, found: Returns, returned: np.ndarray, seen: np.ndarray, number: int) -> None:
    rays.owner[at], rays.ends[at] = number, found.surface[seen]
    rays.metres[at], rays.reflectance[at], rays.label[at] = returned, found.reflectance[seen], found.label[seen]


def _named(around: Surroundings, thing: Wanted, mesh: Mesh, rng: np.random.Generator) -> Iterator[Spot]:
    """The place that somebody names. Raises ValueError where nothing can be put there."""
    assert thing.place is not None
    x, y = thing.place
    yaw = float(rng.uniform(-np.pi, np.pi)) if thing.yaw is None else thing.yaw
    where = _where(thing.place)
    if (spot := around.spot(x, y, yaw)) is None:
        raise ValueError(f"expected a place for {thing.kind} on ground that the scan shows, found none {where}")
    if around.crowded(spot, mesh):
        raise ValueError(f"expected a free place for {thing.kind}, {NEAR:g} m and more away, found the sensor or "
                         f"another thing {where}")  # fmt: skip
    if (inside := int(around.in_it(spot, mesh).sum())) > INSIDE:
        raise ValueError(f"expected a free place for {thing.kind}, found {inside} measured points in it {where}")
    yield spot


def _lasers(sensor: Sensor, row: np.ndarray) -> Lasers:
    """What is known of the lasers of rays of these rows (n,), -1 for none."""
    free = ~hidden(sensor)
    whole, first = lasers(sensor), np.cumsum(free) - 1
    of_row = first[np.arange(sensor.height) * sensor.width + free.argmax(1)]
    loss, dip, shift = (part[of_row][row] * (row >= 0) for part in whole[:3])
    return Lasers(loss, dip, shift, np.maximum(row, 0).astype(np.uint32))


def with_points(scan: Scan, there: Placed) -> Inserted:
    """The scan with what was put: points that it hides are gone, and its own stand where their rays stood in order."""
    rays, lost = there.rays, there.lost
    old, new = np.flatnonzero(rays.owner[: len(scan)] < 0), np.flatnonzero(rays.metres > 0)
    new = new[rays.owner[new] >= 0]
    number = _numbers(scan)
    first = 1 + int(number.max(initial=0))
    mine = _points(scan, there, new, first)
    fields = {
        name: np.concatenate([values[old], mine.extra.get(name, np.zeros(len(new), values.dtype))])
        for name, values in _fields(scan, number).items()
    }
    ring, time, label = (
        None if part is None or more is None else np.concatenate([part[old], more])
        for part, more in ((scan.ring, mine.ring), (scan.time, mine.time), (_labels(scan), mine.label))
    )
    xyz, light = np.concatenate([scan.xyz[old], mine.xyz]), np.concatenate([scan.reflectance[old], mine.reflectance])
    both = Scan(xyz, light, ring, time, label, fields)
    both = both[np.argsort(np.concatenate([old, _order(scan, rays, lost)[new]]), kind="stable")]
    if scan.time is not None and both.time is not None and (np.diff(scan.time) >= 0).all():
        both = both[np.argsort(both.time, kind="stable")]
    return Inserted(both, _boxes(there, first))


def _points(scan: Scan, there: Placed, new: np.ndarray, first: int) -> Scan:
    """The points (n,) of the rays `new`: what tells of a ray is the ray's, or of a lost one that of its neighbour; of
    what tells of what it met, the place, reflectance, class and number are the thing's, all else is 0."""
    (rays, lost, put, sensor, response), count = there, len(scan)
    source = np.concatenate([np.arange(count), lost.before])[new]
    xyz = to_sensor(sensor, rays.starts[new] + rays.directions[new] * rays.metres[new, None]).astype(np.float32)
    dim = np.asarray(response.dimness or [0.0] * sensor.height, np.float32)[rays.row[new]]
    light = response.reported((rays.reflectance[new] - dim).clip(0, 1))
    light = response.faded(light, rays.metres[new]) * bool(scan.reflectance.any())
    owner = rays.owner[new].astype(np.int32)
    extra = {name: np.zeros(len(new), values.dtype) for name, values in scan.extra.items()}
    extra |= {name: _rings(scan.extra[name], rays, new, source) for name in RINGS if name in scan.extra}
    extra |= {INSTANCE: first + owner, "new": np.ones(len(new), np.uint8), "confidence": np.ones(len(new), np.float32)}
    if "raw_label" in scan.extra:
        if first + len(put) - 1 > MOST_INSTANCES:
            raise ValueError(f"expected instances of {MOST_INSTANCES - len(put)} at most in labels, beside which there "
                             f"are numbers for {len(put)} things, found {first - 1}")  # fmt: skip
        word = np.array([KINDS[thing.kind].raw for thing in put])[owner] | (first + owner) << 16
        extra["raw_label"] = word.astype(scan.extra["raw_label"].dtype)
    time = None if scan.time is None else _times(scan.time, scan.xyz, rays.row, lost, new)
    ring = None if scan.ring is None else _rings(scan.ring, rays, new, source)
    return Scan(xyz, light.astype(np.float32), ring, time, rays.label[new], extra)


def _times(time: np.ndarray, xyz: np.ndarray, row: np.ndarray, lost: LostRays, new: np.ndarray) -> np.ndarray:
    """(n,) when the rays `new` were sent: a lost one between its neighbours, though the turn begins between these."""
    count, azimuth = len(time), np.arctan2(xyz[:, 1], xyz[:, 0]).astype(np.float64)
    of, late = new[new >= count] - count, (time - time.min()).astype(np.float64)
    before, after, turn = lost.before[of], lost.after[of], _turn(late, azimuth, row[:count])
    step = late[after] - late[before]
    if turn:  # its sign is the way in which the sensor turns
        gap = (azimuth[after] - azimuth[before]) % (2 * np.pi) / (2 * np.pi)
        step += turn * np.round((turn * gap - step) / turn)
    moment = late[before] + lost.share[of] * step
    moment -= abs(turn) * ((moment > late.max()).astype(int) - (moment < 0))
    sent = moment.clip(0, late.max()).astype(time.dtype) + time.min()
    return np.concatenate([time[new[new < count]], sent])


def _turn(time: np.ndarray, azimuth: np.ndarray, row: np.ndarray) -> float:
    """Seconds of a turn to the left by the steps (N,) of the rows' points, negative of one to the right; 0 where these
    do not tell."""
    order = np.lexsort((azimuth, row))
    on = np.diff(azimuth[order])
    near = (np.diff(row[order]) == 0) & (on > 1e-4) & (on < BESIDE)
    return 2 * np.pi * float(np.median(np.diff(time[order])[near] / on[near])) if near.any() else 0.0


def _fields(scan: Scan, number: np.ndarray) -> dict[str, np.ndarray]:
    """Further fields of the scan, with its numbers (N,) of instances, `new` and confidences, without which a completion
    would hold what was inserted for unsure; what it calls so and is something else under another name."""
    marks = marks_of(scan)
    theirs = {"new", "confidence"} - marks.keys() | ({INSTANCE} if _own_numbers(scan) is None else set())
    kept = {f"file_{name}" if name in theirs else name: values for name, values in scan.extra.items()}
    return kept | {INSTANCE: number, "new": were_new(scan), "confidence": confidences(scan)}


def _numbers(scan: Scan) -> np.ndarray:
    """(N,) int32 instance of each point that the scan tells of, 0 for none."""
    if (number := _own_numbers(scan)) is not None:
        return number.astype(np.int32)
    raw = scan.extra.get("raw_label")
    return np.zeros(len(scan), np.int32) if raw is None else (raw.astype(np.int64) >> 16).astype(np.int32)


def _own_numbers(scan: Scan) -> np.ndarray | None:
    """Instances as whole numbers, if a scan has a field of them."""
    number = scan.extra.get(INSTANCE)
    return number if number is not None and number.dtype.kind in "iu" and abs(number).max(initial=0) < 1 << 31 else None


def _labels(scan: Scan) -> np.ndarray | None:
    """(N,) classes of the scan's points: 0 where nobody has said any; None where its raw labels do."""
    if scan.label is not None or "raw_label" in scan.extra:
        return scan.label
    return np.zeros(len(scan), np.int64)


def _order(scan: Scan, rays: Rays, lost: LostRays) -> np.ndarray:
    """(R,) where each ray stands among the scan's points: a lost one next to the neighbour that comes first; of scans
    ring by ring, those of beams of which none returned before all others, in the order of the scan's own."""
    onward = bool(np.median(lost.after - lost.before) > 0) if len(lost.row) else True
    place, row = lost.before + lost.share if onward else lost.after + 1 - lost.share, rays.row[: len(scan)]
    above = np.flatnonzero(lost.row != row[lost.before])
    if len(above) and np.mean(np.diff(row) == 0) > 0.5:
        start = np.arctan2(*scan.xyz[0, [1, 0]])
        around = (lost.azimuth[above] - start) * (1 if onward else -1) % (2 * np.pi) / (2 * np.pi)
        place[above] = lost.row[above] - row[lost.before[above]] - 1 + around
    return np.concatenate([np.arange(len(scan)), place])


def _rings(ring: np.ndarray, rays: Rays, new: np.ndarray, source: np.ndarray) -> np.ndarray:
    """(n,) rings of the rays `new`, numbered as a scan's points are, `ring` (N,): those of the neighbours `source`, or
    as many rows off."""
    row = rays.row[: len(ring)]
    inside, number = row >= 0, ring.astype(np.int64)
    ways = [way for way in (1, -1) if len(np.unique((number - way * row)[inside])) == 1]
    return (number[source] + (ways[0] if ways else 0) * (rays.row[new] - rays.row[source])).astype(ring.dtype)


def _boxes(there: Placed, first: int) -> tuple[Box, ...]:
    """Boxes of all things that any point is of, numbered from the first on."""
    rays, boxes = there.rays, []
    points = np.bincount(rays.owner[(rays.owner >= 0) & (rays.metres > 0)], minlength=len(there.put)).tolist()
    for number, (kind, mesh, spot, met) in enumerate(there.put):
        up = spot.on_ground(mesh).corners[..., 2]
        stood = (spot.x, spot.y), (float(up.min()), float(up.max())), spot.yaw
        told = there.sensor, kind, first + number, points[number], float(np.mean(rays.owner[met] != number))
        boxes += [box_around(mesh, *stood, *told)] if points[number] else []
    return tuple(boxes)
