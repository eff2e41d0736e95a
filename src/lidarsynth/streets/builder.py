"""Collects what is placed in a world, then makes one soup of triangles of it.

Only what is drawn at random is worked out at once; heights and distances from carriageways come for all together.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.streets.areas import Area
from lidarsynth.streets.ground import Ground, ground_mesh, slab_mesh
from lidarsynth.streets.materials import NUMBER
from lidarsynth.streets.objects import USUAL, library
from lidarsynth.streets.world import FRONT, GROUND, REACH, SLAB, STILL, THING, THINGS, World

ROW = ("x", "y", "z", "yaw", "length", "width", "height", "tint", "pace")  # metres, radians, scales; of one thing
VARIANTS = 64  # more than any kind has


class Group(NamedTuple):
    """Things of one kind: rows (N, 9) of ROW, z above the ground; variant of each; dropped within `clear` m of a road.

    variants  those that count as placed, so that others follow them, even if none is left; None = those that are left
    """

    kind: str
    rows: np.ndarray
    variant: np.ndarray
    clear: float
    variants: tuple[int, ...] | None = None


class Houses(NamedTuple):
    """N houses: corners x, y (N, 4) m; tall (N,) m; fronts (N, 12), see `facades.py`; across: may stand on a road."""

    x: np.ndarray
    y: np.ndarray
    tall: np.ndarray
    fronts: np.ndarray
    across: bool


@dataclass
class WorldBuilder:
    """What is placed, in order. `rng` draws it, `area` says how much of it, `ground` is what it will stand on."""

    rng: np.random.Generator
    ground: Ground
    area: Area
    groups: list[Group] = field(default_factory=list)
    houses: list[Houses] = field(default_factory=list)

    def put(
        self,
        kind: str,
        x: np.ndarray,
        y: np.ndarray,
        yaw: np.ndarray,
        up: float = 0.0,
        clear: float | None = 0.3,
        size: tuple[float, float] = (0.9, 1.1),
        pace: int = STILL,
        all_shapes: bool = False,
    ) -> None:
        """Things of one kind at (N,) places, variants drawn at random, of `all_shapes` or the usual ones; dropped
        within `clear` m of a carriageway."""
        rows, shapes = np.empty((len(x), len(ROW))), len(library()[kind])
        variant = self.rng.integers(0, shapes if all_shapes else USUAL.get(kind, shapes), len(x))
        rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3] = x, y, up, yaw
        rows[:, 4:7] = self.rng.uniform(*size, (len(x), 3))
        rows[:, 7], rows[:, 8] = np.minimum(np.maximum(self.rng.normal(size=len(x)), -1.5), 2.2), pace
        self.groups.append(Group(kind, rows, variant, -np.inf if clear is None else clear))

    def put_row(
        self, kind: str, x: np.ndarray, y: np.ndarray, yaw: np.ndarray, first: tuple[int, float, float]
    ) -> None:
        """Pieces of one hedge or fence: all of the same variant, height scale and tint, given by `first`."""
        rows = np.empty((len(x), len(ROW)))
        rows[:] = 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, first[1], first[2], STILL
        rows[:, 0], rows[:, 1], rows[:, 3] = x, y, yaw
        variant = first[0] % len(library()[kind])
        self.groups.append(Group(kind, rows, np.full(len(x), variant), 0.4, (variant,)))


def placed(builder: WorldBuilder) -> dict[tuple[str, int], np.ndarray]:
    """Rows (N, 9) of ROW of each kind and variant, of what stands clear of the carriageways, in the order placed."""
    groups, ground = builder.groups, builder.ground
    rows = np.concatenate([group.rows for group in groups])
    sizes = [len(group.rows) for group in groups]
    x, y = rows[:, 0].copy(), rows[:, 1].copy()
    rows[:, 2] = ground.height(x, y) + rows[:, 2]
    keep = ground.carriageway(x, y) > np.repeat([group.clear for group in groups], sizes)
    kinds = {kind: number for number, kind in enumerate(library())}
    code = np.repeat([VARIANTS * kinds[group.kind] for group in groups], sizes)
    code += np.concatenate([group.variant for group in groups])
    rank: dict[tuple[str, int], int] = {}
    for group, end in zip(groups, np.cumsum(sizes).tolist(), strict=True):
        left = group.variant[keep[end - len(group.rows) : end]]
        for variant in sorted(set(left.tolist())) if group.variants is None else group.variants:
            rank.setdefault((group.kind, variant), len(rank))
    place = np.zeros(VARIANTS * len(kinds), int)
    place[[VARIANTS * kinds[kind] + variant for kind, variant in rank]] = np.arange(len(rank))
    order = place[code[keep]]
    ends = np.cumsum(np.bincount(order, minlength=len(rank)))[:-1]
    return dict(zip(rank, np.split(rows[keep][np.argsort(order, kind="stable")], ends), strict=True))


def assemble(builder: WorldBuilder, poses: np.ndarray) -> World:
    """One soup of the ground, the sidewalks, the walls and the things."""
    bare = ground_mesh(builder.ground, (builder.ground.roads[0].stop, REACH[1]), 4.0)
    slab, kerb = slab_mesh(builder.ground)
    walls, fronts = walls_of(builder)
    things = placed(builder)
    count = sum(len(library()[kind][variant]) * len(rows) for (kind, variant), rows in things.items())
    written_later = np.zeros((count, 0, 3))
    parts = ((bare, GROUND, "road", "road"), (slab, SLAB, "sidewalk", "sidewalk"),
             (walls, FRONT, "plaster", "building"), (written_later, THING, "road", "road"))  # fmt: skip
    ends = np.cumsum([len(corners) for corners, *_ in parts]).tolist()
    joined = _soup(ends[-1])
    soups = [{key: of[a:b] for key, of in joined.items()} for a, b in zip([0, *ends], ends, strict=False)]
    for soup, (corners, kind, material, label) in zip(soups, parts, strict=True):
        soup["corners"][:, : corners.shape[1]] = corners
        soup["kind"][:], soup["material"][:], soup["label"][:] = kind, NUMBER[material], CLASS_NUMBER[label]
    soups[1]["material"][kerb] = NUMBER["kerb"]
    if len(fronts):
        per = len(walls) // len(fronts)
        soups[2]["front"][:] = np.repeat(np.arange(len(fronts)), per)
        soups[2]["tint"][:] = np.repeat(fronts[:, 11], per)
    _instances(things, soups[3])
    names = [(kind, variant, row[:8], row[8]) for (kind, variant), rows in things.items() for row in rows]
    return World(**joined, fronts=fronts, ground=builder.ground, poses=poses, things=np.array(names, THINGS))


def walls_of(builder: WorldBuilder) -> tuple[np.ndarray, np.ndarray]:
    """Walls (T, 3, 3) float32 of the houses that stand clear of the carriageways, and their fronts (F, 12) float32."""
    if not builder.houses:
        return np.zeros((0, 3, 3), np.float32), np.zeros((0, 12), np.float32)
    x, y, tall, rows = (np.concatenate([houses[k] for houses in builder.houses]) for k in range(4))
    across = np.repeat([houses.across for houses in builder.houses], [len(houses.x) for houses in builder.houses])
    after_x, after_y = x[:, [1, 2, 3, 0]], y[:, [1, 2, 3, 0]]
    edge_x, edge_y = (np.concatenate([a + (b - a) * k / 5 for k in range(5)], axis=1)
                      for a, b in ((x, after_x), (y, after_y)))  # fmt: skip
    keep = across | (builder.ground.carriageway(edge_x, edge_y) > 0.7).all(axis=1)
    x, y, tall, rows, nx, ny = (values[keep] for values in (x, y, tall, rows, after_x, after_y))
    base = builder.ground.height(x.mean(axis=1), y.mean(axis=1))
    low, high = np.broadcast_to((base - 2.5)[:, None], x.shape), np.broadcast_to((base + tall)[:, None], x.shape)
    quad = np.stack([np.stack([x, y, low], -1), np.stack([nx, ny, low], -1), np.stack([nx, ny, high], -1),
                     np.stack([x, y, high], -1)], axis=2)  # fmt: skip
    size = np.maximum(np.hypot(nx - x, ny - y), 1e-6)
    table = np.repeat(rows[:, None], 4, axis=1)
    table[..., 0], table[..., 1], table[..., 4] = x, y, base[:, None]
    table[..., 2], table[..., 3] = (nx - x) / size, (ny - y) / size
    corners = quad[:, :, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3).astype(np.float32)
    return corners, table.reshape(-1, 12).astype(np.float32)


def _soup(count: int) -> dict[str, np.ndarray]:
    """What `World` says of `count` triangles; corners, kinds, materials and labels are not yet written."""
    return {
        "corners": np.empty((count, 3, 3), np.float32),
        **{key: np.empty(count, np.uint8) for key in ("kind", "material", "label")},
        "tint": np.zeros(count, np.float32),
        "front": np.full(count, -1, np.int16),
        "thing": np.full(count, -1, np.int32),
    }


def _instances(things: dict[tuple[str, int], np.ndarray], soup: dict[str, np.ndarray]) -> None:
    """Copies of library meshes, scaled, turned and shifted by rows (N, 9) of ROW for each kind and variant."""
    rows = np.concatenate([np.zeros((0, len(ROW))), *things.values()]).astype(np.float32)
    c, s, zero = np.cos(rows[:, 3]), np.sin(rows[:, 3]), np.zeros(len(rows), np.float32)
    turns = np.stack([c, s, zero, -s, c, zero, zero, zero, zero + 1], axis=-1).reshape(-1, 3, 3) * rows[:, 4:7, None]
    shapes = [library()[kind][variant] for kind, variant in things]
    first = start = 0
    for shape, mine in zip(shapes, things.values(), strict=True):
        count, last, stop = len(mine), first + len(mine), start + len(mine) * len(shape)
        part = {key: soup[key][start:stop].reshape(count, len(shape)) for key in ("material", "label", "tint", "thing")}
        corners = soup["corners"][start:stop].reshape(count, 3 * len(shape), 3)
        np.matmul(shape.corners.reshape(-1, 3), turns[first:last], out=corners)
        for axis in range(3):  # three long passes, not one over triples
            corners[:, :, axis] += rows[first:last, axis, None]
        part["material"][:], part["label"][:] = shape.material, shape.label
        part["tint"][:], part["thing"][:] = rows[first:last, 7, None], np.arange(first, last)[:, None]
        first, start = last, stop
