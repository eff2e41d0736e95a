"""Things of no kind in particular, for rooms that a network has to name: what stands in buildings has more shapes than
`streets/furniture.py` has kinds.

Within `odd()` buildings of `streets.interiors` have such things in most rooms and halls, and more people.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from unittest.mock import patch

import numpy as np

from lidarsynth.streets import furniture, interiors
from lidarsynth.streets.floors import Room
from lidarsynth.streets.furniture import GOODS, LABEL, WOOD
from lidarsynth.streets.interiors import Site
from lidarsynth.streets.shapes import Mesh, frustum, join, moved

MATERIALS = (*WOOD, *GOODS, "paint", "glass", "sign", "skin", "cloth", "tyre", "lamp", "stone")
IN_ROOMS, ALONE, IN_HALLS = 0.06, 0.08, 0.012  # of a kind per square metre: beside furniture, in its place, in halls
Kind = Callable[[np.random.Generator], Mesh]


_block, _stuff = furniture._block, partial(furniture._stuff, of=MATERIALS)


def _ellipsoid(half: tuple[float, float], low: float, high: float, material: str, rings: int = 6) -> Mesh:
    """Upright, of that half length and half width."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    radius, z = np.cos(turn), (low + high) / 2 + (high - low) / 2 * np.sin(turn)
    parts = [frustum((radius[k], radius[k + 1]), (z[k], z[k + 1]), 12, material, LABEL) for k in range(rings)]
    shape = join(*parts)
    return replace(shape, corners=(shape.corners * np.array([*half, 1.0])).astype(np.float32))


def lump(rng: np.random.Generator) -> Mesh:
    """One to three round bodies on each other."""
    parts, low = [], 0.0
    for _ in range(int(rng.integers(1, 4))):
        tall = rng.uniform(0.15, 1.1)
        parts.append(_ellipsoid((rng.uniform(0.1, 0.9), rng.uniform(0.1, 0.6)), low, low + tall, _stuff(rng)))
        low += tall * rng.uniform(0.4, 1.0)
    return join(*parts)


def machine(rng: np.random.Generator) -> Mesh:
    """Two to six blocks and drums through each other, up to 4.2 m long."""
    length, width, stuff, parts = rng.uniform(0.5, 4.2), rng.uniform(0.4, 2.0), _stuff(rng), []
    for _ in range(int(rng.integers(2, 7))):
        own = length * rng.uniform(0.2, 1.0), width * rng.uniform(0.2, 1.0), rng.uniform(0.2, 1.9)
        x, y = rng.uniform(-0.5, 0.5) * (length - own[0]), rng.uniform(-0.5, 0.5) * (width - own[1])
        made = stuff if rng.random() < 0.6 else _stuff(rng)
        if rng.random() < 0.7:
            parts.append(_block(own, 0.0 if rng.random() < 0.7 else rng.uniform(0.2, 0.9), made, x, y))
        else:
            radius = min(own[:2]) / 2
            parts.append(moved(frustum((radius, radius * rng.uniform(0.4, 1)), (0, own[2]), 12, made, LABEL), x, y))
    return join(*parts)


def counter(rng: np.random.Generator) -> Mesh:
    """A long block, at times with another on top, or one beside."""
    length, deep, tall, stuff = rng.uniform(1.5, 5.0), rng.uniform(0.5, 1.0), rng.uniform(0.7, 1.3), _stuff(rng)
    parts = [_block((length, deep, tall), 0.0, stuff)]
    if rng.random() < 0.5:
        parts.append(_block((0.95 * length, 0.4 * deep, rng.uniform(0.2, 0.9)), tall, _stuff(rng), 0, -deep / 4))
    if rng.random() < 0.4:
        parts.append(_block((deep, rng.uniform(1.0, 2.5), tall), 0.0, stuff, length / 2, rng.uniform(-0.5, 0.5)))
    return join(*parts)


def screen(rng: np.random.Generator) -> Mesh:
    """A thin board on two feet."""
    length, tall, low = rng.uniform(0.6, 2.5), rng.uniform(1.0, 2.2), rng.uniform(0.0, 0.6)
    parts = [_block((length, 0.04, tall - low), low, _stuff(rng))]
    for side in (-0.4, 0.4):
        parts += [_block((0.05, 0.5, 0.05), 0.0, "pole", side * length)]
        parts += [_block((0.04, 0.04, tall), 0.0, "pole", side * length)]
    return join(*parts)


def round_table(rng: np.random.Generator) -> Mesh:
    """On one leg."""
    radius, tall, stuff = rng.uniform(0.3, 1.0), rng.uniform(0.4, 1.1), _stuff(rng)
    leg, foot = ((0.05, 0.05), (0.0, tall)), ((0.3, 0.2), (0.0, 0.05))
    legs = [frustum(*part, 8, stuff, LABEL) for part in (leg, foot)]
    return join(_ellipsoid((radius, radius), tall - 0.03, tall, stuff, 2), *legs)


def cart(rng: np.random.Generator) -> Mesh:
    """Two or three shelves between four rods, and what lies on them."""
    length, width, tall = rng.uniform(0.5, 1.4), rng.uniform(0.4, 0.8), rng.uniform(0.9, 1.3)
    boards = np.linspace(0.15, rng.uniform(0.7, 1.3), int(rng.integers(2, 4)))
    parts = [_block((length, width, 0.03), float(low), _stuff(rng)) for low in boards]
    parts += [_block((0.03, 0.03, tall), 0.0, "pole", x * length, y * width) for x in (-0.5, 0.5) for y in (-0.5, 0.5)]
    for _ in range(int(rng.integers(0, 4))):
        size = (rng.uniform(0.1, 0.4), rng.uniform(0.1, 0.4), rng.uniform(0.1, 0.4))
        x, y = rng.uniform(-0.3, 0.3) * length, rng.uniform(-0.2, 0.2) * width
        parts.append(_block(size, 0.2 + rng.uniform(0.0, 0.8), _stuff(rng), x, y))
    return join(*parts)


def heap(rng: np.random.Generator) -> Mesh:
    """Three to thirteen boxes and boards anyhow."""
    parts = []
    for _ in range(int(rng.integers(3, 14))):
        size = (rng.uniform(0.1, 1.2), rng.uniform(0.1, 0.6), rng.uniform(0.05, 0.5))
        lying = _block(size, rng.uniform(0.0, 0.7), _stuff(rng))
        parts.append(moved(lying, rng.normal(0, 0.5), rng.normal(0, 0.4), yaw=rng.uniform(0, 6.3)))
    return join(*parts)


def stand(rng: np.random.Generator) -> Mesh:
    """A drum or a post, half of the time with something round on top."""
    tall, radius = rng.uniform(0.8, 2.4), rng.uniform(0.05, 0.45)
    post = frustum((radius, radius * rng.uniform(0.5, 1.2)), (0.0, tall), 12, _stuff(rng), LABEL)
    if rng.random() < 0.5:
        return post
    half = radius * rng.uniform(1.0, 2.5), radius * rng.uniform(1.0, 2.5)
    return join(post, _ellipsoid(half, tall - 0.1, tall + rng.uniform(0.1, 0.5), _stuff(rng)))


def arch(rng: np.random.Generator) -> Mesh:
    """A bow of eight blocks."""
    length, tall, width, stuff = rng.uniform(0.8, 2.5), rng.uniform(0.8, 2.0), rng.uniform(0.3, 1.2), _stuff(rng)
    size = 0.25 * length, width, 0.22 * tall
    turns = (np.arange(8) + 0.5) * np.pi / 8
    return join(*(_block(size, max(0.0, tall * np.sin(t) - 0.2), stuff, length / 2 * np.cos(t)) for t in turns))


def lounge(rng: np.random.Generator) -> Mesh:
    """A seat whose back leans, half of the time around a corner."""
    length, deep, stuff, parts, low = rng.uniform(1.2, 4.0), rng.uniform(0.7, 1.1), _stuff(rng), [], 0.0
    for high, share in ((0.42, 1.0), (0.5, 0.6), (0.62, 0.3), (0.85, 0.2)):
        parts.append(_block((length, deep * share, high - low), low, stuff, 0.0, -deep * (1 - share) / 2))
        low = high
    if rng.random() < 0.5:
        parts.append(_block((deep, 0.7 * length, 0.42), 0.0, stuff, length / 2, 0.3 * length))
    return join(*parts)


def pod(rng: np.random.Generator) -> Mesh:
    """A round body on a block, as large as a small car."""
    half, tall = (rng.uniform(0.5, 1.6), rng.uniform(0.4, 0.9)), rng.uniform(0.8, 1.6)
    foot = _block((1.3 * half[0], 1.2 * half[1], 0.2), 0.02, "dark")
    return join(_ellipsoid(half, 0.15, tall, _stuff(rng), 8), foot)


def tub(rng: np.random.Generator) -> Mesh:
    """Half of the time with a plant."""
    radius, tall, stuff = rng.uniform(0.3, 0.9), rng.uniform(0.4, 1.2), _stuff(rng)
    parts = [frustum((0.8 * radius, radius), (0.0, tall), 14, stuff, LABEL)]
    if rng.random() < 0.5:
        parts.append(_ellipsoid((0.8 * radius, 0.8 * radius), tall / 2, 1.5 * tall, "leaves"))
    return join(*parts)


LEARNED: Mapping[str, Kind] = {"lump": lump, "machine": machine, "counter": counter, "screen": screen,
                               "round table": round_table, "cart": cart, "heap": heap, "stand": stand}  # fmt: skip
HELD_OUT: Mapping[str, Kind] = {"arch": arch, "lounge": lounge, "pod": pod, "tub": tub}


def _more(site: Site, room: Room, kinds: Mapping[str, Kind], per: float) -> None:
    rng = site.rng
    for kind in kinds:
        if rng.random() < 0.6:
            count = min(int(rng.poisson(per * rng.exponential() * room.area)), 30)
            interiors._spots(site, room, count, kind, bool(rng.random() < 0.4))


def _furnished(
    plain: Callable[[Site, Room, float], None], kinds: Mapping[str, Kind], site: Site, room: Room, tall: float
) -> None:
    beside = site.rng.random() < 0.5
    _more(site, room, kinds, IN_ROOMS if beside else ALONE)
    if beside or site.rng.random() < 0.4:
        plain(site, room, tall)
    if site.rng.random() < 0.4:
        interiors._people(site, room, int(site.rng.integers(1, 5)))


def _stocked(
    plain: Callable[[Site, Room, float], None], kinds: Mapping[str, Kind], site: Site, room: Room, tall: float
) -> None:
    _more(site, room, kinds, IN_HALLS)
    plain(site, room, tall)


@contextmanager
def odd(kinds: Mapping[str, Kind] = LEARNED) -> Iterator[None]:
    """Within, buildings that are drawn have such things."""
    furnish, stock = (partial(f, g, kinds) for f, g in ((_furnished, interiors._furnish), (_stocked, interiors._stock)))
    with (
        patch.dict(furniture.KINDS, kinds),
        patch.object(interiors, "_furnish", furnish),
        patch.object(interiors, "_stock", stock),
    ):
        yield
