"""Fences and garden walls of generated scans, cast as streets have them where the networks have drawn something like
one.

What is drawn of a fence is neither flat nor has bars: of what lasers meet between these is nothing to see. So where the
classes say fence, lines are looked for, seen from above; along each one stand pieces of one of the streets' own fences
or walls, as high and as dense as what was drawn, their rays are cast and read as streets' are, and the others go on to
what is behind. Measured in docs/generation.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.streets.objects import FENCES, fence, garden_wall
from lidarsynth.streets.sensor_model import range_noise
from lidarsynth.streets.shapes import Mesh, join, moved
from lidarsynth.systems.cascade.canvas import FEW, GROUND, Canvas, mirrored, tint_of
from lidarsynth.systems.cascade.images import STRAYING

FENCE, TERRAIN = CLASS_NUMBER["fence"], CLASS_NUMBER["terrain"]
# Lines of a thing at most, and pairs of returns that are tried for each; metres from a line within which returns are of
# it, and within which no other is looked for; the share of a thing's returns that a line has at least.
LINES, TRIES, NEAR, TAKEN, PART = 4, 80, 0.2, 1.0, 0.25
# Metres: how long a fence is at least, how far away at most, how near its line may pass the sensor, how high it may be.
SHORTEST, FARTHEST, NEAREST, HEIGHTS = 1.2, 45.0, 0.5, (0.35, 2.9)
PIECE, AT_ONCE = 2.0, 3  # metres of a piece; pieces that are cast at once
GATE, POST = 1.5, 0.4  # metres along a fence without a return that leave it open; of a stretch between gates at least
# The share of a piece's rays that must end on it; from which one on, of all of a fence, it is a wall; how much a fence
# of bars may differ from what was drawn by chance. All chosen by street-2 (docs/generation.md).
COVERED, SOLID, ANYHOW = 0.25, 0.5, 0.15
MARGIN, HIDDEN = 0.5, 0.3  # metres off a fence of what was drawn of it, and before it of what hides it
FOOT, HEAD = 0.1, 0.92  # metres above the ground, and the share of the height, between which a fence is looked at
ABOVE, BEYOND = 4, 0.4  # beams above a fence where what is behind is looked for, and metres behind it


class Line(NamedTuple):
    """Seen from above: a point of it and its direction, (2,) each, metres."""

    middle: np.ndarray
    way: np.ndarray

    def along(self, points: np.ndarray) -> np.ndarray:
        """(n,) metres of points (n, 2 or 3) along the line."""
        return (points[:, :2] - self.middle) @ self.way

    def off(self, points: np.ndarray) -> np.ndarray:
        """(n,) metres of points (n, 2 or 3) to the left of the line."""
        return (points[:, :2] - self.middle) @ self.across

    @property
    def across(self) -> np.ndarray:
        return np.array([-self.way[1], self.way[0]])

    def reached(self, rays: np.ndarray) -> np.ndarray:
        """(n,) lengths of rays (n, 3) from the origin to what stands on the line; infinite for those that go away."""
        towards, away = rays[:, :2] @ self.across, float(self.middle @ self.across)
        length = away / np.where(np.abs(towards) > 1e-6, towards, 1e-6)
        return np.where(length > 0, length, np.inf)


class Run(NamedTuple):
    """What was drawn of a fence: its line, from where to where along it its stretches between gates go, (k, 2), its
    ground and its height, metres, the share of its rays that end on it, and their places in the flattened image."""

    line: Line
    stretches: np.ndarray
    level: float
    height: float
    solid: float
    at: np.ndarray


def cast_fences(canvas: Canvas, rng: np.random.Generator) -> None:
    """Casts all that the canvas's labels say is a fence and that stands in a line; what does not stays as it is."""
    for thing in canvas.things(FENCE):
        at = thing[canvas.label.flat[thing] == FENCE]
        for chosen, line in _lines(canvas.points_at(at)[:, :2].astype(float), rng):
            run = _run(canvas, at[chosen], line)
            if run is not None and len(run.stretches):
                _stand(canvas, run, rng)


def _lines(points: np.ndarray, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, Line]]:
    """Lines of points (n, 2), the one of most first, and which points are of each (RANSAC, Fischler & Bolles 1981)."""
    left = np.arange(len(points))
    for _ in range(LINES):
        if len(left) < FEW:
            return
        rest = points[left]
        a, b = rest[rng.integers(len(left), size=(2, TRIES))]
        length = np.hypot(*(b - a).T)
        a, way = a[length > NEAR], ((b - a) / np.maximum(length, NEAR)[:, None])[length > NEAR]
        if not len(a):
            return
        off = (rest[None] - a[:, None]) @ np.stack([-way[:, 1], way[:, 0]], 1)[..., None]
        inside = np.abs(off[..., 0])[(np.abs(off[..., 0]) < NEAR).sum(1).argmax()] < NEAR
        for _ in range(2):
            line = _through(rest[inside])
            inside = np.abs(line.off(rest)) < NEAR
            if inside.sum() < max(FEW, PART * len(points)):
                return
        yield left[inside], line
        along = line.along(rest)
        low, high = along[inside].min() - TAKEN, along[inside].max() + TAKEN
        left = left[~((np.abs(line.off(rest)) < TAKEN) & (along > low) & (along < high))]


def _through(points: np.ndarray) -> Line:
    """The line of least squares through points (n, 2)."""
    middle = points.mean(0)
    return Line(middle, np.linalg.eigh(np.cov((points - middle).T))[1][:, 1])


def _run(canvas: Canvas, at: np.ndarray, line: Line) -> Run | None:
    """The fence along a line that the pixels `at` (n,) are of; None for what is none."""
    points = canvas.points_at(at)
    along, away = line.along(points), np.hypot(points[:, 0], points[:, 1])
    if np.ptp(along) < SHORTEST or np.median(away) > FARTHEST or abs(line.middle @ line.across) < NEAREST:
        return None
    first, level = float(along.min()), canvas.level(np.median(points, 0))
    drawn = np.flatnonzero(canvas.label == FENCE)
    there = line.along(canvas.points_at(drawn)) - first
    near = (np.abs(line.off(canvas.points_at(drawn))) < MARGIN) & (there > -MARGIN) & (there < np.ptp(along) + MARGIN)
    drawn, there = drawn[near], there[near]
    piece = ((along - first) / PIECE).astype(int)
    pieces, height, solid = np.unique(piece), float(np.quantile(points[:, 2], 0.95)) - level, 0.0
    for _ in range(2):  # without pieces of which little is there, it may be lower
        if not len(pieces) or not HEIGHTS[0] < height < HEIGHTS[1]:
            return None
        rays, of = _rays_to(canvas, at, line, first, level, height, away)
        of = np.where(np.isin(of, pieces), of, -1)
        own, metres = np.isin(rays, drawn), canvas.metres.flat[rays]
        hidden = ~own & (metres > 0) & (metres < line.reached(canvas.rays_at(rays)) - HIDDEN)
        all_of, own_of = (np.bincount(of[k & (of >= 0)], minlength=pieces.max() + 1) for k in (~hidden, own))
        pieces = pieces[own_of[pieces] >= np.maximum(COVERED * all_of[pieces], 1)]
        if not len(pieces) or np.isin(piece, pieces).sum() < FEW:
            return None
        height = float(np.quantile(points[np.isin(piece, pieces), 2], 0.95)) - level
        solid = own_of[pieces].sum() / max(all_of[pieces].sum(), 1)
    if not HEIGHTS[0] < height < HEIGHTS[1]:
        return None
    stretches = _stretches(along[np.isin(piece, pieces)])
    return Run(line, stretches, level, height, float(solid), drawn[np.isin(np.floor(there / PIECE), pieces)])


def _stretches(along: np.ndarray) -> np.ndarray:
    """(k, 2) from where to where of metres along a line (n,) there is no gate."""
    along = np.sort(along)
    gates = np.flatnonzero(np.diff(along) > GATE)
    ends = np.stack([along[np.r_[0, gates + 1]], along[np.r_[gates, len(along) - 1]]], 1)
    return ends[ends[:, 1] - ends[:, 0] > POST]


def _rays_to(
    canvas: Canvas, at: np.ndarray, line: Line, first: float, level: float, height: float, away: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Places (n,) of the rays to a fence that the pixels `at` are of, `away` (n,) metres, and each one's piece."""
    low, high = level + FOOT, level + HEAD * height
    near, far = float(away.min()), float(away.max())
    elevations = np.arctan2(low, near if low < 0 else far), np.arctan2(high, far if high < 0 else near)
    ahead, *azimuths = canvas.seen(at, np.median(canvas.points_at(at), 0))
    rays = canvas.window(ahead, (azimuths[0], azimuths[1]), elevations)
    ways = canvas.rays_at(rays)
    length = line.reached(ways)
    length = np.where(np.isfinite(length), length, 0)
    spots = ways * length[:, None]
    met = (length > 0) & (spots[:, 2] > low) & (spots[:, 2] < high)
    return rays[met], np.floor((line.along(spots[met]) - first) / PIECE).astype(int)


@lru_cache(maxsize=1)
def _open_fences() -> list[tuple[float, float, Mesh]]:
    """The streets' fences of bars: height in metres, the share of rays that meet them, and two metres of each."""
    shapes = []
    for height, bars, thick, posts_only in FENCES:
        shares = bars * thick / PIECE, 0.12 / height, 0.07 / PIECE  # bars, two rails, a post
        shapes.append((height, float(1 - np.prod(1 - np.array(shares))), fence(height, bars, thick, posts_only)))
    return shapes


def _shape(run: Run, rng: np.random.Generator) -> tuple[Mesh, str, float]:
    """A piece of a fence like what was drawn, its material, and how far behind the line it stands, metres."""
    if run.solid >= SOLID:
        return garden_wall(run.height), "wall", 0.12
    kinds = _open_fences()
    unlike = [abs(np.log(height / run.height)) + abs(share - run.solid) for height, share, _ in kinds]
    height, _, mesh = kinds[int(np.argmin(np.array(unlike) + ANYHOW * rng.standard_normal(len(kinds))))]
    scale = np.array([1, 1, run.height / (height + 0.05)], np.float32)
    return replace(mesh, corners=mesh.corners * scale), "fence", 0.0


def _stand(canvas: Canvas, run: Run, rng: np.random.Generator) -> None:
    """The fence in the scan, where nothing nearer hides it; what else was drawn of it is as what is behind it."""
    mesh, material, behind = _shape(run, rng)
    line = run.line
    tint = tint_of(material, float(np.median(canvas.reflectance.flat[run.at])), rng)
    yaw, back = float(np.arctan2(line.way[1], line.way[0])), behind * np.sign(line.middle @ line.across) * line.across
    all_found = []
    for some in _parts(mesh, run.stretches):
        middles = line.middle + back + np.outer([x for _, x in some], line.way)
        each = (moved(piece, x, y, run.level, yaw=yaw) for (piece, _), (x, y) in zip(some, middles, strict=True))
        found, at = canvas.cast(join(*each), tint, rng)
        there = np.where(canvas.metres.flat[at] > 0, canvas.metres.flat[at], np.inf)
        seen = np.isfinite(found.surface) & (np.isin(at, run.at) | (there >= found.surface - HIDDEN))
        all_found.append((at, found, seen))
    met = np.concatenate([at[seen] for at, _, seen in all_found])
    _open(canvas, run.at[~np.isin(run.at, met)], np.concatenate([met, run.at]), run, rng)
    for at, found, seen in all_found:
        canvas.put_returns(at, found, seen)


def _parts(mesh: Mesh, stretches: np.ndarray) -> list[list[tuple[Mesh, float]]]:
    """Pieces of two metres, longer or shorter, that fill stretches (k, 2), and where along the line their middles are,
    AT_ONCE at a time: few rays come near few."""
    pieces = []
    for start, end in stretches:
        count = max(1, round((end - start) / PIECE))
        length = (end - start) / count
        one = replace(mesh, corners=mesh.corners * np.array([length / PIECE, 1, 1], np.float32))
        pieces += [(one, start + length * (k + 0.5)) for k in range(count)]
    return [pieces[k : k + AT_ONCE] for k in range(0, len(pieces), AT_ONCE)]


def _open(canvas: Canvas, left: np.ndarray, taken: np.ndarray, run: Run, rng: np.random.Generator) -> None:
    """Pixels `left` (n,) as what is seen above the fence in their column goes on down behind it, or the ground before
    that, as bright as what is seen of either; `taken` tell nothing."""
    if not len(left):
        return
    width, rays = canvas.sensor.width, canvas.rays_at(left)
    rows, columns = np.divmod(left, width)
    level = np.hypot(rays[:, 0], rays[:, 1])
    free = canvas.metres > 0
    free.flat[taken] = False
    behind, source = np.full(len(left), np.inf), np.full(len(left), -1)
    top = np.full(width, len(free))
    np.minimum.at(top, columns, rows)
    for above in range(1, ABOVE + 1):
        row = (top[columns] - above).clip(0)
        at = row * width + columns
        away = np.hypot(*canvas.points_at(at)[:, :2].T)
        good = (source < 0) & (top[columns] >= above) & free.flat[at] & ~GROUND[canvas.label.flat[at]]
        good &= away > run.line.reached(rays) * level + BEYOND
        behind, source = np.where(good, away, behind), np.where(good, at, source)
    ground = canvas.to_ground(left, run.level)
    metres, on_ground = np.minimum(behind / level, ground), ground < behind / level
    source = np.where(on_ground, _ground_beside(canvas, free, rows, columns), source)
    there = (metres <= canvas.sensor.max_range) & (source >= 0)
    label = canvas.label.flat[source]
    rough = sum((label == CLASS_NUMBER[name]) * STRAYING[name][0][1] for name in ("vegetation", "terrain"))
    unit = rng.standard_normal((2, len(left)))
    metres = np.where(there, metres, 0)
    metres = np.where(there, metres + range_noise(metres) * unit[0] + rough * unit[1], 0)
    canvas.put(left, metres, canvas.reflectance.flat[source], label)


def _ground_beside(canvas: Canvas, free: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """For pixels (n,) places of returns of the ground in the same beam, of terrain where there is enough, as behind
    fences; -1 for none. free (H, W) bool: what may be looked at."""
    source, width = np.full(len(rows), -1), free.shape[1]
    for row in np.unique(rows):
        ground = np.flatnonzero(free[row] & GROUND[canvas.label[row]])
        terrain = ground[canvas.label[row, ground] == TERRAIN]
        left = terrain if len(terrain) >= FEW else ground
        if len(left):
            here = rows == row
            source[here] = row * width + mirrored(columns[here], left, width)
    return source
