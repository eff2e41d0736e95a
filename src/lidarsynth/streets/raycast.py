"""First hits of many rays on a triangle soup, by Embree (Wald et al., 2014)."""

from __future__ import annotations

from collections.abc import Callable
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
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        self.normal = normal.astype(np.float32)
        self.level = np.einsum("ij,ij->i", self.normal, corners[:, 0])
        self._axes = np.ascontiguousarray(self.normal.T)

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
        nx, ny, nz = (axis.take(triangle) for axis in self._axes)
        (x, y, z), (dx, dy, dz) = origins.T, rays.T
        towards = nx * dx + ny * dy + nz * dz
        gap = self.level.take(triangle) - (nx * x + ny * y + nz * z)
        hit = (face >= 0) & (towards != 0)
        distance = np.divide(gap, towards, out=np.full(len(rays), np.inf, np.float32), where=hit)
        return face, distance, np.abs(towards)


def one_by_one(corners: np.ndarray) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """As `PacketScene(corners).faces`, by embreex's own means: for wheels that keep Embree elsewhere."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, corners)
    whole = np.ascontiguousarray
    return lambda origins, rays: scene.run(whole(origins), whole(rays), query="INTERSECT")
