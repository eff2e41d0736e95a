"""First hits of many rays on a triangle soup, by Embree (Wald et al., 2014), or of some without it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from ctypes import PyDLL
from typing import Protocol

import numpy as np

from lidarsynth.streets.embree import PacketScene, library

BLOCK = 256  # rays that are looked at together: what lies in the processor's cache
Hits = tuple[np.ndarray, np.ndarray, np.ndarray]


class AnyCaster(Protocol):
    """Whatever answers where rays first meet something; `Caster.cast` says how."""

    def cast(self, origins: np.ndarray, rays: np.ndarray, times: np.ndarray | None = None) -> Hits:
        """The triangle's number, the distance and |cos| of incidence of each ray."""
        ...


def embree() -> PyDLL | None:
    """As `library`, which whoever will cast rays asks for before it begins anything. Raises ImportError that names the
    extra to install."""
    try:
        return library()
    except ImportError as error:
        raise ImportError("synthetic streets need embreex: pip install 'lidarsynth[synthetic]'") from error


class Caster:
    """A scene of T triangles, corners (T, 3, 3) float32 metres. Raises ImportError that names the extra to install."""

    def __init__(self, corners: np.ndarray):
        packets = embree()
        corners = np.ascontiguousarray(corners, np.float32)
        self._faces = PacketScene(corners).faces if packets else one_by_one(corners)
        self._axes, self.level = _planes(corners)

    def faces(self, origins: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """(N,) int32: the number of the triangle that each ray first meets, -1 for none; rays as in `cast`."""
        return self._faces(origins, rays)

    def cast(self, origins: np.ndarray, rays: np.ndarray, times: np.ndarray | None = None) -> Hits:
        """Where each ray first meets the scene.

        origins, rays (N, 3) float32, rays of length 1. Returns, each (N,): the triangle's number, int32, -1 for none;
        the distance, float32 metres, infinite for none; and |cos| of the angle between ray and normal, float32.
        times (N,) seconds: not used, nothing moves here.
        """
        face = self.faces(origins, rays)
        triangle = face.astype(np.intp)
        normal = [axis.take(triangle, mode="wrap") for axis in self._axes]  # as without, and twice as fast
        towards = _dot(normal, tuple(rays.T))
        gap = self.level.take(triangle, mode="wrap") - _dot(normal, tuple(origins.T))
        missed = np.flatnonzero((face < 0) | (towards == 0))
        towards[missed] = 1
        distance = gap / towards
        distance[missed] = np.inf
        return face, distance, np.abs(towards)


class FewTriangles:
    """As `Caster`, of some hundred triangles, corners (T, 3, 3) float32 metres, and without Embree."""

    def __init__(self, corners: np.ndarray):
        corners = np.ascontiguousarray(corners, np.float32)
        self._axes, self.level = _planes(corners)
        self._first = corners[:, 0]
        self._sides = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        self._middle = corners.mean(1)
        self._reach = np.square(corners - self._middle[:, None]).sum(2).max(1) + np.float32(0.01)

    def cast(self, origins: np.ndarray, rays: np.ndarray, times: np.ndarray | None = None) -> Hits:
        """As `Caster.cast`."""
        ray, face = self._pairs(origins, rays)
        towards = np.stack([axis[face] for axis in self._axes], 1)
        way, start = rays[ray], origins[ray]
        slope = np.einsum("ij,ij->i", towards, way)
        with np.errstate(divide="ignore", invalid="ignore"):  # rays along a triangle's plane do not meet it
            away = (self.level[face] - np.einsum("ij,ij->i", towards, start)) / slope
            met = np.isfinite(away) & (away > 0)
            met[met] = self._inside(face[met], start[met] + way[met] * away[met, None])
        ray, face, away, slope = (part[met] for part in (ray, face, away, slope))
        order = np.lexsort((away, ray))
        at, first = np.unique(ray[order], return_index=True)
        hits = np.full(len(rays), -1, np.int32), np.full(len(rays), np.inf, np.float32), np.ones(len(rays), np.float32)
        for whole, values in zip(hits, (face, away, np.abs(slope)), strict=True):
            whole[at] = values[order[first]]
        return hits

    def _pairs(self, origins: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers (P,) of rays and of triangles that they come near."""
        middle, size = self._middle.T, np.square(self._middle).sum(1) - self._reach
        numbers, faces = [np.zeros(0, int)], [np.zeros(0, int)]
        for first in range(0, len(rays), BLOCK):
            start, way = origins[first : first + BLOCK], rays[first : first + BLOCK]
            along = way @ middle - np.einsum("ij,ij->i", way, start)[:, None]
            gap = size - 2 * (start @ middle) + np.square(start).sum(1)[:, None]
            np.multiply(along, np.abs(along), out=along)  # those behind are near only where the ray starts
            ray, face = np.nonzero(gap < along)
            numbers.append(ray + first)
            faces.append(face)
        return np.concatenate(numbers), np.concatenate(faces)

    def _inside(self, face: np.ndarray, spots: np.ndarray) -> np.ndarray:
        """(P,) bool: whether spots (P, 3) of the triangles' planes are of the triangles (P,)."""
        (a, b), c = (side[face] for side in self._sides), spots - self._first[face]
        aa, ab, bb, ac, bc = (np.einsum("ij,ij->i", *two) for two in ((a, a), (a, b), (b, b), (a, c), (b, c)))
        size = aa * bb - ab * ab
        u, v = bb * ac - ab * bc, aa * bc - ab * ac
        return (u >= 0) & (v >= 0) & (u + v <= size) & (size > 0)


def _planes(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (3, T) float32 of triangles (T, 3, 3) float32, and how far along its normal each lies, (T,)."""
    first = corners[:, 0].T.copy()
    (ax, ay, az), (bx, by, bz) = (corners[:, k].T - first for k in (1, 2))
    normal = np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
    normal /= np.maximum(np.sqrt(_dot(tuple(normal), tuple(normal))), 1e-12)
    return normal, _dot(tuple(normal), tuple(first))


def _dot(a: Sequence[np.ndarray], b: Sequence[np.ndarray]) -> np.ndarray:
    """(N,) of three (N,) and three (N,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def one_by_one(corners: np.ndarray) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """As `PacketScene(corners).faces`, by embreex's own means: for wheels that keep Embree elsewhere."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, corners)
    whole = np.ascontiguousarray
    return lambda origins, rays: scene.run(whole(origins), whole(rays), query="INTERSECT")
