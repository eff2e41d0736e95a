"""First hits of many rays on a triangle soup, by Embree (Wald et al., 2014)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from lidarsynth.streets.embree import PacketScene, library

Hits = tuple[np.ndarray, np.ndarray, np.ndarray]


class AnyCaster(Protocol):
    """Whatever answers where rays first meet something; `Caster.cast` says how."""

    def cast(self, origins: np.ndarray, rays: np.ndarray, times: np.ndarray | None = None) -> Hits:
        """The triangle's number, the distance and |cos| of incidence of each ray."""
        ...


class Caster:
    """A scene of T triangles, corners (T, 3, 3) float32 metres. Raises ImportError that names the extra to install."""

    def __init__(self, corners: np.ndarray):
        try:
            packets = library()
        except ImportError as error:
            raise ImportError("synthetic streets need embreex: pip install 'lidarsynth[synthetic]'") from error
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
