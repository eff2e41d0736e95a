"""Cars and people of generated scans, cast as streets have them where the networks have drawn something like one; then
fences (`fences.py`).

What is drawn of a car is often a heap and hardly ever has the outline of one: the columns of a layout are 2.8 degrees
apart. So where the classes say car or person, one of the streets' own shapes is put where it explains most
(`placing.py`), its rays are cast and read as streets' are, and what else was drawn of it becomes what is beside it, as
does all of it where no place is good enough, but for walls. Measured in docs/generation.md.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.streets.actors import MARGIN
from lidarsynth.streets.apart import footprints, meet
from lidarsynth.streets.hdl64e import hidden
from lidarsynth.streets.objects import cars_and_people
from lidarsynth.streets.sensor_model import Returns, range_noise
from lidarsynth.streets.shapes import Mesh, moved
from lidarsynth.systems.cascade.canvas import (
    FEW,
    GROUND,
    OCCLUDED,
    SIZE,
    Canvas,
    axis_of,
    box_around,
    canvas_of,
    mirrored,
    numbered,
    pieces,
    tint_of,
)
from lidarsynth.systems.cascade.fences import cast_fences
from lidarsynth.systems.cascade.hanging import beside, one_surface
from lidarsynth.systems.cascade.placing import LONG, Place, Shape, View, best_place, length, parts_of, two_boxes, within


class Kind(NamedTuple):
    """Things of a class that are cast anew: what they are like; their material; the directions tried in half a turn;
    where returns of at least `area` square metres within `reach` metres suggest one; the `most` that its place may
    cost, and the `least` share of its own rays that must end about there; what else of it within `margin` metres is
    taken away."""

    name: str
    shapes: tuple[Shape, ...]
    material: str
    turns: int
    area: float
    reach: float
    most: float
    least: float
    margin: float


# Chosen on 96 generated scans (docs/generation.md).
KINDS = (
    Kind("car", (two_boxes("car", 4.3, 1.74, 0.9, 1.46, (-1.93, 0.95, 0.15)),
                 two_boxes("van", 4.9, 1.94, 0.95, 2.0, (-2.45, 1.76, 0.05), 1.6)),
         "paint", 24, 0.3, 40.0, 1.5, 0.2, 1.6),
    Kind("person", (two_boxes("person", 0.5, 0.55, 0.8, 1.75, (-0.2, 0.2, 0.12)),),
         "cloth", 1, 0.12, 25.0, 1.8, 0.2, 0.5),
)  # fmt: skip
ROAD = CLASS_NUMBER["road"]
LOW = 0.2  # metres above the ground around a thing that are ground
WIDER, TALLER = 2.5, 2.2  # metres beside and above a thing that are looked at
OWN, OTHERS, MOST = 220, 340, 2.5  # rays that are looked at, of a thing's and of the others; how many times as many
TIGHT = 0.4  # metres beside one of several things that are in a row, within which returns are of it
SURE = (0.9, 0.4)  # the most that a place costs, and the least share of its rays, that is good enough for a wall, too
WALL = (0.4, 1.7)  # metres, standard deviations across and along, of returns that are of a wall
BESIDE = 3  # columns beside a heap's that are as lost as its own
# Metres beside a thing, and above its ground, where it may have swallowed rays; beams and columns that hang together.
DARK, DARK_TALL, DARK_STEPS = 1.5, 1.5, ((0, 1), (0, 2), *((1, side) for side in range(-2, 3)))


def all_recast(images: list[RangeImage], rng: list[torch.Generator]) -> list[RangeImage]:
    """`recast` of images, each by a generator of its own."""
    seeds = [int(torch.randint(1 << 62, (), generator=one)) for one in rng]
    return [recast(image, np.random.default_rng(seed)) for image, seed in zip(images, seeds, strict=True)]


def as_cast(named: list[RangeImage], cast: list[RangeImage]) -> list[RangeImage]:
    """The images with the classes of those that were cast anew, where these have one; without classes as they are."""
    things = [CLASS_NUMBER[kind.name] for kind in KINDS]
    return [
        a
        if a.label is None or b.label is None
        else numbered(
            replace(a, label=np.where(np.isin(b.label, things), b.label, a.label), instance=b.instance, boxes=b.boxes)
        )
        for a, b in zip(named, cast, strict=True)
    ]


def unnamed(image: RangeImage) -> RangeImage:
    """The image without classes, instances and boxes."""
    return replace(image, label=None, instance=None, boxes=())


def recast(image: RangeImage, rng: np.random.Generator) -> RangeImage:
    """The image (H, W), metres and reflectance in [0, 1], with labels (H, W), whose cars, people and fences have the
    shapes of streets'; as it is, where nothing suggests any."""
    canvas = canvas_of(image)
    axis = axis_of(canvas)
    for kind in KINDS:
        todo = _suggestions(canvas, kind)
        while todo:
            rest = _thing(canvas, kind, todo.pop(0), axis, rng)
            todo += [rest] if rest is not None else []
    cast_fences(canvas, rng)
    return numbered(canvas.on(image))


def _suggestions(canvas: Canvas, kind: Kind) -> list[np.ndarray]:
    """Places of the returns of each thing of a kind, the nearest first."""
    things = canvas.things(CLASS_NUMBER[kind.name])
    return sorted(things, key=lambda each: float(np.median(canvas.metres.flat[each])))


def _thing(
    canvas: Canvas, kind: Kind, at: np.ndarray, axis: float | None, rng: np.random.Generator
) -> np.ndarray | None:
    """Casts what the pixels `at` (n,) suggest; which of them may be of another one, None for none or too few."""
    points = canvas.points_at(at)
    metres, sensor = canvas.metres.flat[at], canvas.sensor
    step = np.abs(np.gradient(np.radians(sensor.elevations)))[at // sensor.width] * (2 * np.pi / sensor.width)
    middle = np.median(points, 0)
    if (step * metres**2).sum() < kind.area or np.hypot(*middle[:2]) > kind.reach:
        return None
    level = canvas.level(middle)
    long = length(points) / LONG if kind.turns > 1 else 0
    parts = parts_of(points, FEW) if long >= 1 else [points]
    view = _view(canvas, at, middle, level, long if len(parts) > 1 else 1)
    top = np.quantile(points[:, 2], 0.97) - level
    shapes = [shape for shape in kind.shapes if top >= shape.tall]
    places = [best_place(shape, kind.turns, parts, view, level, axis if kind.turns > 1 else None) for shape in shapes]
    place, shape = min(zip(places, shapes, strict=True), key=lambda both: both[0].total)
    if (place.cost > SURE[0] or place.share < SURE[1]) and _a_wall(points):
        return None
    found = None if place.cost > kind.most or place.share < kind.least else _mesh(canvas, kind, shape, place, rng)
    if found is None:
        gone = _with_lost(canvas, at)
        _fill(canvas, gone, gone, level, rng)
        return None
    there = np.array([[place.x, place.y, place.yaw]])
    mine = at[within(points, there, shape, kind.margin if len(parts) == 1 else TIGHT)[0]]
    shade = float(np.median(canvas.reflectance.flat[mine if len(mine) else at]))
    mesh, yaw, stands = found
    there = moved(mesh, place.x, place.y, level, yaw=yaw)
    returns, rays = canvas.cast(there, tint_of(kind.material, shade, rng), rng)
    shown = _put(canvas, returns, rays, mine, level, rng)
    up, number = mesh.corners[..., 2], 1 + len(canvas.boxes)
    stood = (place.x, place.y), (level + float(up.min()), level + float(up.max())), yaw
    canvas.boxes.append(box_around(mesh, *stood, sensor, shape.words, number, occlusion=1 - shown))
    canvas.taken.append(stands)
    rest = at[~np.isin(at, mine)]
    return rest if len(rest) >= FEW and len(mine) else None


def _a_wall(points: np.ndarray) -> bool:
    """Whether points (n, 3), metres, stand in a line that is longer than a thing."""
    thin, long = np.sqrt(np.linalg.eigvalsh(np.cov(points[:, :2].T)).clip(0))
    return bool(thin < WALL[0] and long > WALL[1])


def _with_lost(canvas: Canvas, at: np.ndarray) -> np.ndarray:
    """Pixels `at` (n,), and those that these enclose, along their rings and from beam to beam, and that did not return:
    of a heap they would have been."""
    width = canvas.sensor.width
    middle = np.angle(np.exp(2j * np.pi * (at % width) / width).sum()) * width / (2 * np.pi)
    heap = np.zeros(canvas.metres.shape, bool)
    heap.flat[at] = True
    heap = np.roll(heap, width // 2 - round(middle), 1)
    wider = np.logical_or.reduce([np.roll(heap, step, 1) for step in range(-BESIDE, BESIDE + 1)])
    within = _between(wider, 0) & _between(heap, 1)
    lost = np.roll(within, round(middle) - width // 2, 1) & (canvas.metres == 0) & ~hidden(canvas.sensor)
    return np.concatenate([at, np.flatnonzero(lost)])


def _between(there: np.ndarray, axis: int) -> np.ndarray:
    """Pixels (H, W) with some that are `there` before and behind, or that are themselves."""
    before, behind = (np.logical_or.accumulate(one, axis) for one in (there, np.flip(there, axis)))
    return before & np.flip(behind, axis)


def _view(canvas: Canvas, at: np.ndarray, middle: np.ndarray, level: float, longer: float) -> View:
    """Some of the rays around what the pixels `at` suggest, up to MOST times as many where that is `longer`."""
    away, (ahead, low, high) = float(np.hypot(*middle[:2])), canvas.seen(at, middle)
    wider, seen = np.arctan2(WIDER, max(away, WIDER)), canvas.elevation.flat[at]
    top = max(np.arctan2(level + TALLER, max(away - 2, 1)), seen.max())
    bottom = min(np.arctan2(level, max(away - 3, 1)), seen.min())
    window = canvas.window(ahead, (low - wider, high + wider), (bottom, top))
    own = np.isin(window, at)
    more = min(longer, MOST)
    groups = [(window[which], int(more * most)) for which, most in ((own, OWN), (~own, OTHERS))]
    chosen = [group[np.linspace(0, len(group) - 1, min(len(group), most)).astype(int)] for group, most in groups]
    weight = np.concatenate([
        np.full(len(some), len(group) / max(len(some), 1), np.float32)
        for some, (group, _) in zip(chosen, groups, strict=True)
    ])  # fmt: skip
    of = np.concatenate(chosen)
    metres = np.where(canvas.metres.flat[of] > 0, canvas.metres.flat[of], np.inf).astype(np.float32)
    lost = np.isin(of, _swallowed(canvas, at, middle, level))
    ground = GROUND[canvas.label.flat[of]] | (canvas.points_at(of)[:, 2] < level + LOW)
    own = np.arange(len(of)) < len(chosen[0])
    return View(canvas.rays_at(of), metres, own, ground, lost, weight, np.array(canvas.taken).reshape(-1, 5))


def _swallowed(canvas: Canvas, at: np.ndarray, middle: np.ndarray, level: float) -> np.ndarray:
    """Pixels (m,) about as high as a thing that did not return and hang together with those that suggest it, `at` (n,):
    its panes and its dark paint would not have returned. middle (3,), level: of the thing and its ground, metres."""
    away, width = float(np.hypot(*middle[:2])), canvas.sensor.width
    ahead, low, high = canvas.seen(at, middle)
    wider = np.arctan2(DARK, max(away, DARK))
    heights = np.arctan2(level, max(away - 1, 1)), np.arctan2(level + DARK_TALL, max(away, 1))
    window = canvas.window(ahead, (low - wider, high + wider), heights)
    both = np.concatenate([at, window[canvas.metres.flat[window] == 0]])
    column = (both % width - at[0] % width + width // 2) % width
    piece = pieces(2 * width * (both // width) + column, [2 * width * down + side for down, side in DARK_STEPS])
    return both[len(at) :][np.isin(piece[len(at) :], piece[: len(at)])]


def _mesh(
    canvas: Canvas, kind: Kind, shape: Shape, place: Place, rng: np.random.Generator
) -> tuple[Mesh, float, np.ndarray] | None:
    """One of the streets' own, in its own frame, the direction of its front, radians: ahead or behind, and its
    footprint (5,) at that place; None where all would stand in others."""
    meshes = cars_and_people()[shape.words]
    first = int(rng.integers(len(meshes)))
    yaw = float(place.yaw + np.pi * rng.integers(2) if kind.turns > 1 else rng.uniform(0, 2 * np.pi))
    larger = np.float32(rng.uniform(*SIZE))
    for mesh in (*meshes[first:], *meshes[:first]):
        mesh = replace(mesh, corners=mesh.corners * larger)
        low, high = (each(mesh.corners.reshape(-1, 3)[:, :2], 0) for each in (np.min, np.max))
        stands = footprints(np.array([place.x, place.y]), np.array(yaw), (low + high) / 2, (high - low) / 2 + MARGIN)
        if not len(canvas.taken) or not meet(stands, np.stack(canvas.taken)).any():
            return mesh, yaw, stands
    return None


def _put(
    canvas: Canvas, found: Returns, at: np.ndarray, mine: np.ndarray, level: float, rng: np.random.Generator
) -> float:
    """The thing in the scan as its next box, where nothing nearer hides it and rays do not go through it; what else was
    drawn of it, pixels `mine`, is as it is beside it. Returns which share of the rays that meet it nothing hides."""
    own = np.isin(at, mine)
    there = canvas.metres.flat[at]
    there = np.where(there > 0, there, np.inf)
    ground = GROUND[canvas.label.flat[at]]
    hidden_there = ~own & ~ground & (there < found.surface - OCCLUDED)
    through = ~own & (found.face < 0) & (there > found.surface + OCCLUDED)
    put = np.isfinite(found.surface) & ~hidden_there & ~through
    left = mine[~np.isin(mine, at[put])]
    _fill(canvas, left, np.concatenate([at[put], mine]), level, rng)
    canvas.put_returns(at, found, put, 1 + len(canvas.boxes))
    return float(put.sum() / max((put | np.isfinite(found.surface) & hidden_there).sum(), 1))


def _fill(canvas: Canvas, left: np.ndarray, taken: np.ndarray, level: float, rng: np.random.Generator) -> None:
    """Pixels `left` (n,) as the farther of the next ones of their row is that are not `taken`, or the ground before it,
    as bright as the ground beside it."""
    width, free = canvas.sensor.width, ~hidden(canvas.sensor)
    free.flat[taken] = False
    for row in np.unique(left // width):
        gone, others = left[left // width == row] % width, np.flatnonzero(free[row])
        if not len(others):
            continue
        before, after, share = beside(gone, others, width)
        ends = canvas.metres[row, before], canvas.metres[row, after]
        both, plane = one_surface(*ends, share)
        ends = [np.where(end > 0, end, np.inf) for end in ends]
        farther = np.where(ends[0] >= ends[1], before, after)
        behind = np.where(both, plane, np.maximum(*ends))
        ground = canvas.to_ground(row * width + gone, level)
        metres = np.minimum(behind, ground)
        there = metres <= canvas.sensor.max_range
        noise = range_noise(np.where(there, metres, 0)) * rng.standard_normal(len(gone))
        flat = others[GROUND[canvas.label[row, others]] & (canvas.metres[row, others] > 0)]
        as_bright = np.where(ground < behind, mirrored(gone, flat, width), farther) if len(flat) else farther
        label = np.where(ground < behind, ROAD, canvas.label[row, farther])
        canvas.put(row * width + gone, np.where(there, metres + noise, 0), canvas.reflectance[row, as_bright], label)
