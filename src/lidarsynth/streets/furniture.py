"""What stands and hangs in buildings, each a mesh on z = 0 around its own middle; sizes in metres."""

from __future__ import annotations

import numpy as np

from lidarsynth.streets.shapes import Mesh, box, frustum, join, moved

WOOD = ("door", "door", "wall", "plaster", "dark", "pole")  # what furniture is made of, as lasers see it
GOODS = ("canvas", "canvas", "door", "plaster", "cloth", "wall", "dark", "sign back")
LABEL = "unlabeled"


def _stuff(rng: np.random.Generator, of: tuple[str, ...] = WOOD) -> str:
    return str(rng.choice(of))


def _block(size: tuple[float, float, float], low: float, material: str, x: float = 0.0, y: float = 0.0) -> Mesh:
    """A box of that length, width and height whose bottom is at `low`."""
    length, width, height = size
    return box((x - length / 2, x + length / 2), (y - width / 2, y + width / 2), (low, low + height), material, LABEL)


def _corners(x: float, y: float) -> list[tuple[float, float]]:
    return [(sx * x, sy * y) for sx in (-1, 1) for sy in (-1, 1)]


def table(rng: np.random.Generator) -> Mesh:
    """A top on four legs or two boards, often with things on it."""
    length, width, tall = rng.uniform(0.6, 2.2), rng.uniform(0.5, 1.0), rng.uniform(0.45, 1.05)
    stuff, thick = _stuff(rng), rng.uniform(0.02, 0.05)
    parts = [_block((length, width, thick), tall - thick, stuff)]
    foot = rng.uniform(0.03, 0.08)
    places = _corners(length / 2 - foot, width / 2 - foot)
    if rng.random() < 0.3:
        parts += [_block((foot, width * 0.9, tall - thick), 0.0, stuff, sx * (length / 2 - foot)) for sx in (-1, 1)]
    else:
        parts += [_block((foot, foot, tall - thick), 0.0, stuff, x, y) for x, y in places]
    for _ in range(int(rng.integers(0, 4))):  # a screen, a box, a pile
        size = (rng.uniform(0.05, 0.5), rng.uniform(0.1, 0.5), rng.uniform(0.03, 0.45))
        x, y = rng.uniform(-0.4, 0.4) * length, rng.uniform(-0.3, 0.3) * width
        parts.append(_block(size, tall, _stuff(rng, GOODS), x, y))
    return join(*parts)


def chair(rng: np.random.Generator) -> Mesh:
    """A seat on four legs or one, with a back; some without."""
    side, seat, stuff = rng.uniform(0.38, 0.55), rng.uniform(0.4, 0.5), _stuff(rng, (*WOOD, "cloth", "cloth"))
    parts = [_block((side, side, 0.06), seat - 0.06, stuff)]
    if rng.random() < 0.5:
        parts += [_block((0.04, 0.04, seat), 0.0, stuff, x, y) for x, y in _corners(0.45 * side, 0.45 * side)]
    else:
        parts += [frustum((0.05, 0.05), (0.1, seat), 6, "dark", LABEL), _block((0.6, 0.08, 0.06), 0.04, "dark"),
                  _block((0.08, 0.6, 0.06), 0.04, "dark")]  # fmt: skip
    if rng.random() < 0.85:
        parts.append(_block((0.05, side, rng.uniform(0.3, 0.6)), seat, stuff, -side / 2))
    return join(*parts)


def cabinet(rng: np.random.Generator) -> Mesh:
    """A closed box: cupboard, locker, machine, washing machine, counter."""
    tall = float(rng.choice([0.75, 0.9, 1.1, 1.8, 2.0])) * rng.uniform(0.9, 1.1)
    return _block((rng.uniform(0.4, 1.8), rng.uniform(0.3, 0.7), tall), 0.0, _stuff(rng))


def shelf(rng: np.random.Generator) -> Mesh:
    """Two sides, a back, boards, and what lies on them."""
    length, deep, tall = rng.uniform(0.7, 2.4), rng.uniform(0.25, 0.5), rng.uniform(1.0, 2.2)
    stuff, boards = _stuff(rng), int(rng.integers(3, 7))
    parts = [_block((0.03, deep, tall), 0.0, stuff, sx * length / 2) for sx in (-1, 1)]
    if rng.random() < 0.6:
        parts.append(_block((length, 0.02, tall), 0.0, stuff, 0.0, -deep / 2))
    for low in np.linspace(0.05, tall - 0.03, boards):
        parts.append(_block((length, deep, 0.03), float(low), stuff))
        place = -length / 2 + rng.uniform(0, 0.3)
        while place < length / 2 - 0.1 and low < tall - 0.2:
            size = rng.uniform(0.05, 0.5)
            if rng.random() < 0.7 and place + size < length / 2:
                goods = (size, deep * rng.uniform(0.4, 0.95), rng.uniform(0.08, 0.85) * tall / boards)
                parts.append(_block(goods, float(low) + 0.03, _stuff(rng, GOODS), place + size / 2))
            place += size + rng.uniform(0.0, 0.15)
    return join(*parts)


def sofa(rng: np.random.Generator) -> Mesh:
    """A seat, a back, two arms; a bed where the back is low."""
    length, deep, seat = rng.uniform(0.8, 2.4), rng.uniform(0.75, 1.0), rng.uniform(0.35, 0.48)
    if rng.random() < 0.3:
        wide = rng.uniform(0.9, 1.8)
        return join(
            _block((2.0, wide, rng.uniform(0.4, 0.6)), 0.0, "cloth"), _block((0.06, wide, 0.95), 0.0, "door", -1.0)
        )
    back = _block((length, 0.2, rng.uniform(0.7, 0.95)), 0.0, "cloth", 0.0, -deep / 2 + 0.1)
    arms = [_block((0.18, deep, seat + 0.18), 0.0, "cloth", sx * length / 2) for sx in (-1, 1)]
    return join(_block((length, deep, seat), 0.0, "cloth"), back, *arms)


def goods(rng: np.random.Generator) -> Mesh:
    """Boxes on a pallet, a drum, a cage, or cartons anyhow."""
    kind = rng.random()
    if kind < 0.2:
        return frustum((0.29, 0.29), (0.0, 0.88), 12, "paint", LABEL)
    if kind < 0.55:
        load = _block((rng.uniform(0.9, 1.2), rng.uniform(0.6, 0.8), rng.uniform(0.3, 1.8)), 0.14, _stuff(rng, GOODS))
        return join(_block((1.2, 0.8, 0.14), 0.0, "door"), load)
    parts, low = [], 0.0
    for _ in range(int(rng.integers(1, 5))):
        size = (rng.uniform(0.25, 0.7), rng.uniform(0.25, 0.6), rng.uniform(0.2, 0.5))
        x, y, yaw = rng.normal(0, (0.05, 0.05, 0.2))
        parts.append(moved(_block(size, low, _stuff(rng, GOODS)), x, y, yaw=yaw))
        low += size[2]
    return join(*parts)


def rack(rng: np.random.Generator, bays: int, tall: float) -> Mesh:
    """A pallet rack of that many bays of 2.7 m, filled here and there."""
    levels, parts, half = max(1, int(tall / rng.uniform(1.3, 2.0))), [], 1.35 * bays
    for post in range(bays + 1):
        parts += [_block((0.09, 0.09, tall), 0.0, "pole", 2.7 * post - half, sy * 0.5) for sy in (-1, 1)]
    for level in range(levels + 1):
        low = level * (tall - 0.4) / max(levels, 1)
        if level:
            parts += [_block((2.7 * bays, 0.06, 0.12), low - 0.12, "sign back", 0.0, sy * 0.5) for sy in (-1, 1)]
        for place in np.arange(0.55 - half, half - 0.4, 0.9):
            if rng.random() < 0.65:
                size = (rng.uniform(0.6, 0.85), rng.uniform(0.7, 1.1), rng.uniform(0.3, 1.2))
                parts.append(_block(size, low, _stuff(rng, GOODS), float(place), rng.normal(0, 0.05)))
    return join(*parts)


def stairs(rng: np.random.Generator) -> Mesh:
    """Stairs that lead up, or a step or three."""
    steps, rise, run, wide = int(rng.integers(3, 16)), 0.18, rng.uniform(0.22, 0.3), rng.uniform(0.5, 2.0)
    return join(*(_block((run, wide, rise * (k + 1)), 0.0, "sidewalk", (k - steps / 2) * run) for k in range(steps)))


KINDS = {
    "table": table,
    "chair": chair,
    "cabinet": cabinet,
    "shelf": shelf,
    "sofa": sofa,
    "goods": goods,
    "stairs": stairs,
}
