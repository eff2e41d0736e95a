"""A world of one thing, to be cast into scans that are there already."""

from __future__ import annotations

import numpy as np

from lidarsynth.streets.ground import Ground
from lidarsynth.streets.shapes import Mesh
from lidarsynth.streets.world import THING, THINGS, World


def alone(mesh: Mesh, tint: float) -> World:
    """A world of one thing, `tint` in spreads of its materials."""
    count = len(mesh)
    kinds, tints = np.full(count, THING, np.uint8), np.full(count, tint, np.float32)
    none, thing = np.full(count, -1, np.int16), np.zeros(count, np.int32)
    nowhere, one = np.zeros((0, 12), np.float32), np.zeros(1, THINGS)
    told = mesh.corners, kinds, mesh.material, mesh.label, tints, none, nowhere
    return World(*told, ground=Ground(()), poses=np.zeros((1, 6)), thing=thing, things=one)
