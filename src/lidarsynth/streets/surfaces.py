"""What beams met: the triangles' own material, or the ground's and the fronts', worked out at the point."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsynth.streets import facades
from lidarsynth.streets.materials import NUMBER, TABLE
from lidarsynth.streets.world import FRONT, GROUND, SLAB, World

SPREAD = np.ascontiguousarray(TABLE[:, 1])


class Met(NamedTuple):
    """Where N beams that start at origins (N, 3) m along rays (N, 3) first met something, as casters say it."""

    origins: np.ndarray
    rays: np.ndarray
    face: np.ndarray
    distance: np.ndarray
    cosine: np.ndarray


class Surface(NamedTuple):
    """material (N,) uint8, label (N,) uint8, tint (N,) float32 in spreads of the material, depth (N,) float32 m behind
    the triangle."""

    material: np.ndarray
    label: np.ndarray
    tint: np.ndarray
    depth: np.ndarray


def surfaces(world: World, near: Met, far: Met) -> tuple[Surface, Surface]:
    """What the beams met near and far, both at once as it costs the same; misses get the last triangle's."""
    face = np.concatenate([near.face, far.face])
    hit, triangle = face >= 0, face.astype(np.intp)
    columns = (world.kind, world.material, world.label, world.tint)
    kind, material, label, tint = (column.take(triangle, mode="wrap") for column in columns)
    depth = np.zeros(len(face), np.float32)
    low = np.flatnonzero(hit & ((kind == GROUND) | (kind == SLAB)) & (material != NUMBER["kerb"]))
    x, y = _spots(near, far, low, axes=2)
    stuff, words, wear, depth[low] = world.ground.surface(x, y, kind.take(low) == SLAB)
    material[low], label[low] = stuff, words
    tint[low] = wear / SPREAD.take(stuff.astype(np.intp), mode="wrap")
    wall = np.flatnonzero(hit & (kind == FRONT))
    rows = world.fronts.T.take(world.front.take(triangle.take(wall)), axis=1, mode="wrap")
    material[wall], depth[wall] = facades.shade(np.stack(_spots(near, far, wall)).T, rows.T)
    found, count = (material, label, tint, depth), len(near.face)
    return Surface(*(values[:count] for values in found)), Surface(*(values[count:] for values in found))


def _spots(near: Met, far: Met, chosen: np.ndarray, axes: int = 3) -> list[np.ndarray]:
    """World x, y and z, each (n,), at which the chosen beams end; numbers rise, and go on from near to far."""
    count = len(near.face)
    cut = int(np.searchsorted(chosen, count))
    parts = [_ends(near, chosen[:cut], axes), _ends(far, chosen[cut:] - count, axes)]
    return [np.concatenate(axis) for axis in zip(*parts, strict=True)]


def _ends(met: Met, chosen: np.ndarray, axes: int) -> list[np.ndarray]:
    distance = met.distance.take(chosen, mode="wrap")
    return [
        start.take(chosen, mode="wrap") + way.take(chosen, mode="wrap") * distance
        for start, way in zip(met.origins.T[:axes], met.rays.T[:axes], strict=True)
    ]
