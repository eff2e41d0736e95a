"""Triangle soups: boxes, extrusions, cylinders, leaf clouds; each triangle knows its material and its class."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.streets.materials import NUMBER


@dataclass(frozen=True)
class Mesh:
    """T triangles: corners (T, 3, 3) float32 metres; material (T,) uint8 into MATERIALS; label (T,) uint8, 0-19."""

    corners: np.ndarray
    material: np.ndarray
    label: np.ndarray

    def __len__(self) -> int:
        return len(self.corners)


def mesh(corners: np.ndarray, material: str, label: str) -> Mesh:
    """All of one material and class. corners (T, 3, 3) or anything that reshapes to it."""
    corners = np.asarray(corners, np.float32).reshape(-1, 3, 3)
    count = len(corners)
    return Mesh(corners, np.full(count, NUMBER[material], np.uint8), np.full(count, CLASS_NUMBER[label], np.uint8))


def join(*parts: Mesh) -> Mesh:
    """One soup of many."""
    return Mesh(*(np.concatenate([getattr(p, key) for p in parts]) for key in ("corners", "material", "label")))


def moved(shape: Mesh, x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0, tilt: float = 0.0) -> Mesh:
    """Turned by `tilt` about y, then by `yaw` about z (radians), then shifted (metres)."""
    c, s, ct, st = np.cos(yaw), np.sin(yaw), np.cos(tilt), np.sin(tilt)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[ct, 0, st], [0, 1, 0], [-st, 0, ct]])
    corners = shape.corners @ turn.T.astype(np.float32) + np.array([x, y, z], np.float32)
    return Mesh(corners, shape.material, shape.label)


def quads(corners: np.ndarray) -> np.ndarray:
    """(Q, 4, 3) corners in order around each quad -> (2Q, 3, 3) triangles."""
    corners = np.asarray(corners, np.float32).reshape(-1, 4, 3)
    return corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)


_FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], material: str, label: str) -> Mesh:
    """An axis-aligned box between the given bounds."""
    corner = np.array([[a, b, c] for a in x for b in y for c in z], np.float32)
    return mesh(quads(corner[_FACES]), material, label)


def frustum(radii: tuple[float, float], z: tuple[float, float], sides: int, material: str, label: str) -> Mesh:
    """A standing, open cylinder or cone with the radii of its bottom and top."""
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    low = np.concatenate([ring * radii[0], np.full((sides + 1, 1), z[0])], axis=1)
    high = np.concatenate([ring * radii[1], np.full((sides + 1, 1), z[1])], axis=1)
    return mesh(quads(np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)), material, label)


def wheel(radius: float, width: float, material: str, label: str, sides: int = 12) -> Mesh:
    """A closed disk of that width about the y axis, centred on the origin."""
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack([radius * np.cos(angle), np.zeros(sides + 1), radius * np.sin(angle)], axis=-1)
    out = np.array([0, width / 2, 0])
    left, right = ring + out, ring - out
    tread = quads(np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1))
    faces = [np.stack([np.broadcast_to([0, y, 0], (sides, 3)), e[:-1], e[1:]], axis=1)
             for y, e in ((width / 2, left), (-width / 2, right))]  # fmt: skip
    return mesh(np.concatenate([tread, *faces]), material, label)


def extrusion(profile: list[tuple[float, float]], half: list[float], material: str, label: str) -> Mesh:
    """A side view (x, z) swept across y, with its own half width at each corner; both sides closed by a fan."""
    flat = np.array(profile)
    side = np.array(half)
    left = np.stack([flat[:, 0], side, flat[:, 1]], axis=-1)
    right = left * [1, -1, 1]
    a, b = left, np.roll(left, -1, axis=0)
    skin = quads(np.stack([a, b, np.roll(right, -1, axis=0), right], axis=1))
    fans = []
    for face in (left, right):
        centre = np.broadcast_to(face.mean(axis=0), face.shape)
        fans.append(np.stack([centre, face, np.roll(face, -1, axis=0)], axis=1))
    return mesh(np.concatenate([skin, *fans]), material, label)


def leaves(
    rng: np.random.Generator,
    count: int,
    centre: tuple[float, float, float],
    radii: tuple[float, float, float],
    size: float,
    shell: float = 0.5,
    material: str = "leaves",
    label: str = "vegetation",
) -> Mesh:
    """A crown: `count` triangles of about `size` metres, turned at random, in an ellipsoid.

    `shell` in [0, 1]: 0 fills it evenly, 1 puts everything on the hull. Beams pass between them as in real foliage.
    """
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    depth = rng.uniform(shell**3, 1, (count, 1)) ** (1 / 3)
    middle = np.asarray(centre) + direction * depth * np.asarray(radii)
    spokes = rng.normal(size=(count, 3, 3)) * size * rng.uniform(0.5, 1.5, (count, 1, 1))
    return mesh(middle[:, None] + spokes, material, label)


def hedge_leaves(rng: np.random.Generator, count: int, half: tuple[float, float, float], size: float) -> Mesh:
    """Leaves on the faces of a box of half sizes `half` that stands on z = 0."""
    place = rng.uniform(-1, 1, (count, 3))
    face = rng.integers(0, 3, count)
    place[np.arange(count), face] = np.sign(place[np.arange(count), face])
    place *= np.asarray(half) * rng.uniform(0.85, 1.08, (count, 1))
    place[:, 2] = np.abs(place[:, 2] + half[2])
    return mesh(place[:, None] + rng.normal(size=(count, 3, 3)) * size, "leaves", "vegetation")
