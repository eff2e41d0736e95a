"""Who takes part in traffic: vehicles, cyclists and pedestrians of a world, with their instance numbers and boxes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lidarsynth.streets.objects import library
from lidarsynth.streets.world import World

MARGIN = 0.05  # m between a shape and each side of its box: flat sides are seen through the noise, boxes stand upright
# in the sensor's frame, and the sensor tilts


class Kind(NamedTuple):
    """How other data sets call one kind of road user."""

    raw: int  # SemanticKITTI's raw class of one that stands
    moving: int  # and of one that moves
    kitti: str  # KITTI's type, "" where it has none
    nuscenes: str  # category
    nuscenes_index: int  # of nuScenes-lidarseg


# fmt: off
KINDS: dict[str, Kind] = {
    "car":          Kind(10, 252, "Car", "vehicle.car", 17),
    "van":          Kind(10, 252, "Van", "vehicle.car", 17),
    "truck":        Kind(18, 258, "Truck", "vehicle.truck", 23),
    "bus":          Kind(13, 257, "Misc", "vehicle.bus.rigid", 16),
    "lorry":        Kind(18, 258, "Truck", "vehicle.truck", 23),
    "coach":        Kind(13, 257, "Misc", "vehicle.bus.rigid", 16),
    "trailer":      Kind(20, 259, "Misc", "vehicle.trailer", 22),
    "person":       Kind(30, 254, "Pedestrian", "human.pedestrian.adult", 2),
    "bicyclist":    Kind(31, 253, "Cyclist", "vehicle.bicycle", 14),
    "motorcyclist": Kind(32, 255, "Cyclist", "vehicle.motorcycle", 21),
    "bicycle":      Kind(11, 11, "", "vehicle.bicycle", 14),
    "motorcycle":   Kind(15, 15, "", "vehicle.motorcycle", 21),
}
# fmt: on


@dataclass(frozen=True)
class Actors:
    """A road users of one world, where they stand when time is 0.

    kind (A,) words of KINDS; thing (A,) int, rows of `World.things`; place (A, 3) m, on the ground; yaw (A,) rad;
    size (A, 3) m, length, width, height; middle (A, 3) m, of the box, in the actor's own frame; pace (A,)
    The instance number of actor a is a + 1.
    """

    kind: np.ndarray
    thing: np.ndarray
    place: np.ndarray
    yaw: np.ndarray
    size: np.ndarray
    middle: np.ndarray
    pace: np.ndarray

    def __len__(self) -> int:
        return len(self.thing)


def actors_of(world: World) -> Actors:
    """Everyone of KINDS in the world, in the order of `World.things`."""
    thing = np.flatnonzero(np.isin(world.things["kind"], list(KINDS)))
    found = world.things[thing]
    bounds = np.array([bounds_of(str(one["kind"]), int(one["variant"])) for one in found]).reshape(-1, 2, 3)
    low, high = bounds[:, 0] * found["row"][:, 4:7], bounds[:, 1] * found["row"][:, 4:7]
    place, yaw = found["row"][:, :3], found["row"][:, 3]
    return Actors(found["kind"], thing, place, yaw, high - low, (low + high) / 2, found["pace"])


@lru_cache(maxsize=64)
def bounds_of(kind: str, variant: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The least and the greatest x, y and z, m, of a shape of the library."""
    corners = library()[kind][variant].corners.reshape(-1, 3)
    return tuple(corners.min(axis=0).tolist()), tuple(corners.max(axis=0).tolist())


def numbers_of(world: World, actors: Actors) -> np.ndarray:
    """(K + 1,) int32: instance number of each thing, 0 for other things and for -1, the last."""
    table = np.zeros(len(world.things) + 1, np.int32)
    table[actors.thing] = np.arange(1, len(actors) + 1)
    return table
