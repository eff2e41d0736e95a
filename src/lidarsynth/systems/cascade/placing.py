"""Where a car or a person stands that a scan's returns only suggest: boxes tried in many places."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsynth.streets.apart import meet


class Shape(NamedTuple):
    """What things of one kind are like: two boxes one upon the other, (2, 2, 3) least and greatest x, y, z in metres,
    0 on the ground; `words` of `streets.objects`; tall: how far up returns of a higher one reach at least."""

    words: str
    boxes: np.ndarray
    tall: float = -np.inf

    @property
    def size(self) -> np.ndarray:
        """(2,) length and width, metres."""
        return self.boxes[0, 1, :2] - self.boxes[0, 0, :2]


def two_boxes(
    words: str,
    length: float,
    width: float,
    waist: float,
    height: float,
    upper: tuple[float, float, float],
    tall: float = -np.inf,
) -> Shape:
    """A thing of so many metres; waist: height at which the upper box stands on the lower one.

    upper: from where to where along the thing the upper box goes, and how much narrower it is on either side, metres
    """
    half, foot = width / 2, min(0.2, waist / 4)
    lower = [[-length / 2, -half, foot], [length / 2, half, waist]]
    back, front, less = upper
    return Shape(
        words, np.array([lower, [[back, -half + less, waist], [front, half - less, height]]], np.float32), tall
    )


class View(NamedTuple):
    """N rays, (N, 3), from the origin through some of what a thing may hide; metres (N,), inf for none; own (N,) bool:
    they met what suggests the thing; ground (N,) bool; lost (N,) bool: what the thing may have swallowed; weight (N,):
    how many rays each one stands for; taken (K, 5): where others stand, as `streets.apart.footprints`."""

    rays: np.ndarray
    metres: np.ndarray
    own: np.ndarray
    ground: np.ndarray
    lost: np.ndarray
    weight: np.ndarray
    taken: np.ndarray = np.zeros((0, 5), np.float32)


class Place(NamedTuple):
    """A thing's middle and direction, metres and radians; of `_costs`: what it costs with all that it leaves, which
    tells which is the best, what it costs by itself, and which share of its own rays end about where it is."""

    x: float
    y: float
    yaw: float
    total: float
    cost: float
    share: float


# Of each ray, in what a missed one of the thing's own costs: one that ends so many metres off; one that hides what is
# farther; one that ends inside, or where something else is; one that did not return, and that it misses; then, how far
# off a return may be. Then of all of the thing's own rays, where it stands in another.
OFF, HIDES, INSIDE, ANOTHER, LOST, ABOUT, MEETS = 2.0, 0.35, 0.6, 0.5, 0.15, 1.0, 3.0
GAP, BEHIND = 0.3, 0.15  # metres
ENDS = (0.06, 0.94)  # quantiles of what is seen of a thing
ASKEW = 0.15  # cost of standing at 45 degrees to everything around
BESIDE = 1.0  # metres around a thing within which rays are its own
# Metres: a heap that is longer may be several things; places are looked for around what returns within so many of each
# corner of a grid of that step; at the most of these, by about so many of the points of each; the best places are
# looked at with all rays, after a first look with about so many.
LONG, WITHIN, STEP, PARTS, SEEN, BEST, SOME = 6.0, 2.7, 1.5, 8, 200, 40, 100
STEPS = ((0.25, 0.07), (0.1, 0.028))  # metres and radians, of the best place
NEIGHBOURS = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), -1).reshape(-1, 3).astype(np.float32)


def length(points: np.ndarray) -> float:
    """How long what returns at points (n, 3) is from above, metres, but for the outermost."""
    flat = points[:, :2] - points[:, :2].mean(0)
    ends = np.quantile(flat @ np.linalg.eigh(np.cov(flat.T))[1][:, 1], [0.03, 0.97])
    return float(ends[1] - ends[0])


def parts_of(points: np.ndarray, few: int) -> list[np.ndarray]:
    """What may be single things among the points (n, 3) of a long heap: the fullest first, `few` points at least."""
    corners = np.unique(np.round(points[:, :2] / STEP), axis=0) * STEP
    parts = [points[np.square(points[:, :2] - corner).sum(1) < WITHIN**2] for corner in corners]
    parts = sorted((part for part in parts if len(part) >= few), key=lambda part: -len(part))
    return parts[:PARTS] or [points]


def best_place(
    shape: Shape, turns: int, parts: list[np.ndarray], view: View, level: float, axis: float | None
) -> Place:
    """The place of least total cost of a thing that is suggested by points (n, 3), or by one of several such parts.

    turns  directions that are tried in half a turn; level: height of the ground there, metres
    axis   direction in which most things stand, or at a right angle to it; None = who knows
    """
    yaws = np.arange(turns, dtype=np.float32) * np.float32(np.pi / turns)
    few = [points[:: max(len(points) // SEEN, 1), :2] for points in parts]
    places = np.concatenate([_corners(seen, shape.size, yaws) for seen in few])
    if len(places) > BEST:
        step = max(len(view.rays) // SOME, 1)
        some = view._replace(**{name: part[::step] for name, part in view._asdict().items() if name != "taken"})
        places = places[np.argsort(_costs(places, shape, some, level, axis)[0], kind="stable")[:BEST]]
    costs = _costs(places, shape, view, level, axis)
    for metres, radians in STEPS:
        around = np.array([metres, metres, radians if turns > 1 else 0], np.float32)
        places = places[costs[0].argmin()] + NEIGHBOURS * around
        costs = _costs(places, shape, view, level, axis)
    best = int(costs[0].argmin())
    return Place(*(float(value) for value in places[best]), *(float(cost[best]) for cost in costs))


def _corners(seen: np.ndarray, size: np.ndarray, yaws: np.ndarray) -> np.ndarray:
    """(9 T, 3) places of a box of length and width `size` (2,) in T directions: along each side, what is seen (n, 2) is
    its near end, its far end or its middle."""
    c, s = np.cos(yaws), np.sin(yaws)
    places = []
    for across, half in enumerate(size / 2):
        ends = seen @ (np.stack([-s, c]) if across else np.stack([c, s]))
        low, high = np.quantile(ends, ENDS, axis=0)
        near = np.where(np.median(ends, 0) > 0, 1, -1) * half
        places.append(
            np.stack([np.where(near > 0, low, high) + near, np.where(near > 0, high, low) - near, (low + high) / 2])
        )
    along, side = places[0][:, None], places[1][None]
    grid = np.stack(np.broadcast_arrays(c * along - s * side, s * along + c * side, yaws), -1)
    return grid.reshape(-1, 3).astype(np.float32)


def _costs(
    places: np.ndarray, shape: Shape, view: View, level: float, axis: float | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of things at places (P, 3): (P,) costs with all that they leave, in rays; costs by themselves, in those of their
    own rays that are not farther off than BESIDE; shares of these that end within a metre of the thing."""
    met, left = _through(places, shape.boxes, view.rays, level)
    hit, off = np.isfinite(met), np.abs(np.minimum(met, 1e4) - np.minimum(view.metres, 2e4))
    missed = np.where(hit, np.minimum(off / OFF, 1), 1) * view.own
    hides = hit & ~view.own & ~view.lost & (view.metres > met + GAP)
    inside = hides & (view.metres < left - BEHIND) & ~view.ground
    another = hit & ~view.own & ~view.ground & (off <= GAP)
    wrong = (HIDES * hides + INSIDE * inside + ANOTHER * another) @ view.weight
    ends = view.rays * np.where(np.isfinite(view.metres), view.metres, 0)[:, None]
    near = within(ends, places, shape, BESIDE) & view.own
    own = np.maximum(near @ view.weight, 1)
    cost, share = ((missed * near) @ view.weight + wrong) / own, (hit & near & (off < ABOUT)) @ view.weight / own
    total = missed @ view.weight + wrong + LOST * (~hit & view.lost) @ view.weight
    if len(view.taken):
        stands = np.concatenate([places, np.broadcast_to(shape.size / 2, (len(places), 2))], 1)
        crossing = MEETS * meet(stands[:, None], view.taken).any(1)
        total, cost = total + crossing * own, cost + crossing
    if axis is not None:
        askew = ASKEW * np.abs((places[:, 2] - axis + np.pi / 4) % (np.pi / 2) - np.pi / 4) / (np.pi / 4)
        total, cost = total + askew * own, cost + askew
    return total, cost, share


def within(points: np.ndarray, places: np.ndarray, shape: Shape, margin: float) -> np.ndarray:
    """(P, n) bool: which points (n, 3) are of a thing at places (P, 3), or within so many metres of it, from above."""
    c, s = np.cos(places[:, 2:]), np.sin(places[:, 2:])
    x, y = points[:, 0] - places[:, :1], points[:, 1] - places[:, 1:2]
    length, width = shape.size / 2 + margin
    return (np.abs(c * x + s * y) < length) & (np.abs(c * y - s * x) < width)


def _through(places: np.ndarray, boxes: np.ndarray, rays: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Where rays (N, 3) meet things at places (P, 3), inf for none, and where they leave that box: (P, N) metres."""
    c, s = np.cos(places[:, 2:]), np.sin(places[:, 2:])
    x, y = places[:, :1], places[:, 1:2]
    starts = -(c * x + s * y), s * x - c * y, np.full_like(x, -level)
    with np.errstate(divide="ignore"):  # along a side: never through it
        slopes = [
            1 / way for way in (c * rays[:, 0] + s * rays[:, 1], c * rays[:, 1] - s * rays[:, 0], rays[None, :, 2])
        ]
    met, left = [], []
    for low, high in boxes:
        with np.errstate(invalid="ignore"):  # along a side and in it: no number, which is no less than any
            sides = [((a - o) * w, (b - o) * w) for a, b, o, w in zip(low, high, starts, slopes, strict=True)]
        first = np.maximum.reduce([np.minimum(*pair) for pair in sides])
        last = np.minimum.reduce([np.maximum(*pair) for pair in sides])
        met.append(np.where((first < last) & (last > 0), first, np.float32(np.inf)))
        left.append(last)
    return np.minimum(*met), np.where(met[0] <= met[1], *left)
