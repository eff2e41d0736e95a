"""Shapes of people and two-wheelers beside those that every street has: of all ages, in coats, with bags and helmets,
on scooters, two on one motorcycle; metres, x forward, 0 on the ground."""

from __future__ import annotations

import numpy as np

from lidarsynth.streets.shapes import Mesh, box, frustum, join, moved


def scaled(shape: Mesh, length: float, width: float, height: float) -> Mesh:
    """Longer, wider and higher by these factors."""
    return Mesh(shape.corners * np.array([length, width, height], np.float32), shape.material, shape.label)


def walkers(rng: np.random.Generator, walking: list[Mesh]) -> list[Mesh]:
    """People made of those `walking`: children, broad ones, in coats and skirts, with rucksacks and bags."""
    found = []
    for k, body in enumerate(walking):
        parts = [body]
        if k % 2:
            parts.append(frustum((rng.uniform(0.2, 0.34), 0.18), (rng.uniform(0.35, 0.6), 1.05), 8, "cloth", "person"))
        if k % 3 == 0:
            deep, low = rng.uniform(0.12, 0.28), rng.uniform(0.95, 1.1)
            parts.append(box((-0.12 - deep, -0.1), (-0.17, 0.17), (low, low + 0.48), "cloth", "person"))
        if k % 3 == 1:
            side, tall = rng.choice([-1, 1]), rng.uniform(0.3, 0.5)
            edge = sorted((side * 0.27, side * 0.37))
            parts.append(box((-0.2, 0.22), (edge[0], edge[1]), (0.75 - tall, 0.75), "canvas", "person"))
        wide, tall = rng.uniform(0.92, 1.2), rng.uniform(0.9, 1.06) if k % 4 else rng.uniform(0.55, 0.8)
        found.append(scaled(join(*parts), tall * wide, tall * wide, tall))
    return found


def seated(rng: np.random.Generator, label: str, lean: float, thick: float, helmet: bool) -> Mesh:
    """Someone on a saddle 0.95 m up, who leans forward by `lean` radians, arms at the handlebars."""
    rings = (((0.16, 0.21), (0.0, 0.42)), ((0.21, 0.08), (0.42, 0.6)))
    trunk = [frustum((a * thick, b * thick), z, 8, "cloth", label) for (a, b), z in rings]
    head = (0.13, 0.14, 0.06) if helmet else (0.09, 0.11, 0.04)
    of = "paint" if helmet else "skin"
    trunk += [frustum((head[0], head[1]), (0.56, 0.72), 7, of, label),
              frustum((head[1], head[2]), (0.72, 0.9), 7, of, label)]  # fmt: skip
    if rng.random() < 0.4:  # a rucksack
        trunk.append(box((-0.42, -0.16), (-0.17, 0.17), (0.05, 0.5), "cloth", label))
    reach = 0.85 + 0.4 * lean
    arms = [moved(frustum((0.06, 0.05), (0.0, 0.62), 5, "cloth", label), 0.12, 0.22 * side, 0.42, tilt=np.pi - reach)
            for side in (-1, 1)]  # fmt: skip
    legs = []
    for side, turn in ((0.12, rng.uniform(0.9, 1.3)), (-0.12, rng.uniform(0.6, 1.0))):
        thigh = moved(frustum((0.09, 0.11), (-0.42, 0.0), 6, "cloth", label), 0, side, 0, tilt=-turn)
        knee = 0.42 * np.array([np.sin(turn), -np.cos(turn)])
        shin = moved(frustum((0.06, 0.09), (-0.45, 0.0), 6, "cloth", label), knee[0], side, knee[1], tilt=0.25)
        legs += [thigh, shin]
    return moved(join(*legs, moved(join(*trunk, *arms), tilt=lean)), z=0.95)


def scooter(label: str) -> Mesh:
    """A motor scooter: small wheels, a shield before the legs, a box of a body under the saddle."""
    parts = []
    for x in (-0.6, 0.6):
        rim = frustum((0.24, 0.24), (-0.06, 0.06), 12, "tyre", label)
        parts.append(moved(Mesh(rim.corners[..., [0, 2, 1]], rim.material, rim.label), x, 0, 0.24))
    shield = moved(box((-0.03, 0.03), (-0.22, 0.22), (0.0, 0.75), "paint", label), 0.42, 0, 0.3, tilt=-0.25)
    return join(*parts, shield, box((-0.2, 0.4), (-0.17, 0.17), (0.2, 0.32), "paint", label),
                box((-0.75, -0.15), (-0.2, 0.2), (0.35, 0.85), "paint", label),
                box((0.2, 0.3), (-0.32, 0.32), (1.0, 1.08), "fence", label))  # fmt: skip


def luggage(rng: np.random.Generator, label: str) -> list[Mesh]:
    """What two-wheelers carry: a basket, panniers, a case, a child's seat, or nothing."""
    low = rng.uniform(0.3, 0.5)
    panniers = box((-0.75, -0.35), (-0.3, 0.3), (low, low + 0.35), "canvas", label)
    return [
        [box((0.4, 0.75), (-0.2, 0.2), (0.75, 1.0), "fence", label)],
        [panniers],
        [box((-0.85, -0.4), (-0.22, 0.22), (0.9, 1.25), "paint", label)],
        [box((-0.7, -0.4), (-0.17, 0.17), (0.85, 1.4), "cloth", label), panniers],
        [],
    ][int(rng.integers(5))]


def cyclists(rng: np.random.Generator, bicycle: Mesh, count: int = 9) -> list[Mesh]:
    """Riders of a `bicycle` of their class: upright and stretched, grown and small, with what they carry."""
    found = []
    for k in range(count):
        body = seated(rng, "bicyclist", rng.uniform(0.1, 0.9), rng.uniform(0.85, 1.15), bool(k % 2))
        whole = join(bicycle, moved(body, -0.18, 0, rng.uniform(-0.02, 0.08)), *luggage(rng, "bicyclist"))
        size = rng.uniform(0.9, 1.06) if k % 4 else rng.uniform(0.65, 0.8)
        found.append(scaled(whole, size, size, size))
    return found


def motorcyclists(rng: np.random.Generator, motorcycle: Mesh, count: int = 9) -> list[Mesh]:
    """Riders of a `motorcycle` of their class, or of a scooter: one or two of them, behind a screen or not."""
    found = []
    for k in range(count):
        under = scooter("motorcyclist") if k % 3 == 0 else scaled(motorcycle, rng.uniform(1.15, 1.35), 1.2, 1.05)
        lean = rng.uniform(0.0, 0.25) if k % 3 == 0 else rng.uniform(0.15, 0.8)
        parts = [under, moved(seated(rng, "motorcyclist", lean, rng.uniform(1.05, 1.3), True), -0.2, 0, -0.08)]
        if k % 4 == 1:
            parts.append(moved(seated(rng, "motorcyclist", 0.1, rng.uniform(1.0, 1.2), True), -0.6, 0, 0.0))
        if k % 2:
            screen = box((-0.01, 0.01), (-0.2, 0.2), (0.0, 0.45), "glass", "motorcyclist")
            fairing = box((0.35, 0.75), (-0.22, 0.22), (0.55, 1.0), "paint", "motorcyclist")
            parts += [moved(screen, 0.5, 0, 1.0, tilt=-0.5), fairing]
        found.append(join(*parts, *luggage(rng, "motorcyclist")))
    return found


def two_wheelers(rng: np.random.Generator, plain: Mesh, label: str) -> list[Mesh]:
    """More that stand: larger and smaller, with what they carry, and scooters among motorcycles."""
    found = [join(scaled(plain, size, wide, size), *luggage(rng, label))
             for size, wide in ((0.85, 1.0), (1.0, 1.2), (1.08, 1.1), (1.15, 1.3))]  # fmt: skip
    return [*found, scooter(label)] if label == "motorcycle" else found
