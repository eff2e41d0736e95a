"""What KITTI's own car hides of its HDL-64E, as recorded scans show it: a piece of a column off what streets have there
(`hdl64e.own_car`), moved in scans whose points were moved to one moment, and in parts another on KITTI-360's car.

Fitted to 111 real KITTI scans of 2011_09_26 and the object benchmark: where fewer than half of them have a return.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sector import runs_of
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.streets.hdl64e import NAME, hidden, is_kittis, written_out

WIDTH = 1024  # columns of what follows
TOP = 42  # the highest row of them
# Metres per radian, up to 27 m/s, and radians to the left, as in `Outline`.
MOTIONS = ((0.0, 0.0), *((round(0.02 * step, 2), ahead) for ahead in (0.0, np.pi, -np.pi) for step in range(1, 23)))
STEEP = 5.0  # degrees below the horizon at least, by which the ground that a beam meets is told
SURE = (1.1, 8)  # returns where none can be, of what is usual: more than so many times those of another, and some more
BESIDE = 8  # columns
GONE = 0.5  # of the returns that are beside a part, on as many rays, found on it: it is not there

# fmt: off
# What stands on the car's roof, and the car: for each part its runs, (row, first column, last column).
_PARTS = (
    ((52, -38, 30), (53, -59, 65), (54, -70, 57), (55, -63, 65), (56, -72, 61), (57, -69, 73), (58, -79, 70),
     (59, -74, 79), (60, -86, 73), (61, -81, 83), (62, -91, 78), (63, -91, 100)),
    ((42, 41, 63), (43, 48, 71), (44, 40, 66), (45, 48, 72), (46, 43, 63), (47, 53, 70), (48, 41, 57), (49, 47, 63),
     (50, 42, 54), (51, 49, 60), (52, 43, 55)),
    ((42, 948, 971), (43, 955, 979), (44, 947, 973), (45, 956, 980), (46, 951, 970), (47, 961, 975), (48, 955, 970),
     (49, 963, 978), (50, 959, 972), (51, 968, 979), (52, 961, 972)),
    ((55, 142, 149), (56, 126, 142), (57, 133, 155), (58, 123, 147), (59, 132, 158), (60, 118, 146), (61, 113, 122),
     (61, 130, 155), (62, 98, 114), (62, 120, 141), (63, 107, 156)),
    ((46, 685, 691), (47, 697, 723), (48, 673, 726), (49, 688, 741), (50, 673, 731), (51, 687, 750), (52, 674, 735),
     (53, 688, 750), (54, 667, 733), (55, 684, 744), (56, 671, 732), (57, 688, 744), (58, 674, 732), (59, 696, 748),
     (59, 757, 758), (60, 688, 729), (60, 737, 741), (61, 711, 741), (61, 756, 761), (62, 704, 727), (62, 744, 749),
     (63, 728, 744), (63, 760, 767)),
    ((55, 875, 881), (56, 864, 879), (57, 872, 894), (58, 862, 886), (59, 871, 896), (60, 858, 884), (61, 869, 893),
     (61, 906, 912), (62, 860, 861), (62, 867, 884), (62, 894, 905), (63, 871, 899), (63, 904, 922)),
    ((57, 483, 543), (58, 469, 550), (59, 467, 556), (60, 461, 557), (61, 459, 563), (62, 454, 564), (63, 454, 568)),
    ((59, 599, 600), (60, 582, 593), (60, 605, 614), (61, 591, 603), (61, 610, 623), (62, 584, 596), (62, 601, 616),
     (63, 593, 624)),
    ((60, 421, 425), (61, 406, 415), (61, 428, 438), (62, 398, 411), (62, 419, 430), (63, 406, 421), (63, 428, 439)),
)
# fmt: on


class Outline(NamedTuple):
    """How a scan shows the car.

    moved  metres per radian of azimuth by which its points were moved on, so that all are where they were at one
           moment: the speed, of a turn of 0.1 s by 62.8 radians a second; 0 as recorded
    ahead  radians to the left at which the sensor looked at that moment: 0, or pi and -pi as a turn began and ended
    gone   numbers of the parts that are not there
    cast   whether it is as streets have it
    """

    moved: float = 0.0
    ahead: float = 0.0
    gone: tuple[int, ...] = ()
    cast: bool = False


@lru_cache(maxsize=64)
def outlined(sensor: Sensor, outline: Outline | None) -> np.ndarray:
    """(H, W) bool: rays that end on the carrier, of KITTI's car as a scan shows it. Read only."""
    if outline is None or outline.cast or not is_kittis(sensor):
        return hidden(sensor)
    parts = _parts(sensor, outline.moved, outline.ahead)
    rays = (parts > 0) & ~np.isin(parts, outline.gone) | sensor.blocked_rays()
    rays.flags.writeable = False
    return rays


def seen_written_out(sensor: Sensor, outline: Outline | None) -> Sensor:
    """`hdl64e.written_out` with the car as a scan shows it."""
    told = written_out(sensor)
    return told if outline is None else replace(told, blocked=runs_of(outlined(sensor, outline)))


def outline_of(sensor: Sensor, image: RangeImage, known: np.ndarray) -> Outline | None:
    """How an image, known (H, W) bool, shows KITTI's own car: as it has fewest returns on it. None of other sensors."""
    if not is_kittis(sensor):
        return None
    returned = np.asarray(known & image.mask)[TOP:]
    found = [int(returned[_parts(sensor, *motion)[TOP:] > 0].sum()) for motion in MOTIONS]
    best, cast = int(np.argmin(found)), int(returned[hidden(sensor)[TOP:]].sum())
    best = best if _more(found[0], found[best]) else 0
    if _more(found[best], cast):
        return Outline(cast=True)
    parts = _parts(sensor, *MOTIONS[best])[TOP:]
    count, beside = len(_PARTS) + 1, _beside(parts)
    size, there = np.bincount(parts.ravel(), minlength=count), np.bincount(parts[returned], minlength=count)
    free, near = np.bincount(beside.ravel(), minlength=count), np.bincount(beside[returned], minlength=count)
    usual = size * near / np.maximum(free, 1)
    gone = np.flatnonzero((there > GONE * usual) & (usual >= SURE[1]))
    return Outline(*MOTIONS[best], tuple(gone[gone > 0].tolist()))


def _more(found: int, other: int) -> bool:
    return found > SURE[0] * other + SURE[1]


@lru_cache(maxsize=4)
def _recorded(height: int, width: int) -> np.ndarray:
    """(H, W) int8: the number of the part that each ray ends on, 0 = none."""
    columns, scale, parts = np.arange(width), width / WIDTH, np.zeros((height, width), np.int8)
    for number, runs in enumerate(_PARTS, 1):
        for row, first, last in runs:
            parts[row, np.mod(columns - first * scale, width) <= (last - first + 1) * scale - 1] = number
    return parts


@lru_cache(maxsize=256)
def _parts(sensor: Sensor, moved: float, ahead: float) -> np.ndarray:
    """The same of points that are moved by as many metres per radian, to where the sensor looked `ahead`."""
    columns, width = np.arange(sensor.width), sensor.width
    azimuth = np.pi - (columns + 0.5) * (2 * np.pi / width)
    away = SENSORS[NAME].mount / np.tan(np.radians(np.maximum(-np.asarray(sensor.elevations), STEEP)))
    left = moved * (azimuth - ahead) * np.sin(azimuth) / away[:, None] * (width / (2 * np.pi))
    return np.take_along_axis(_recorded(sensor.height, width), (columns + np.rint(left).astype(int)) % width, 1)


def _beside(parts: np.ndarray) -> np.ndarray:
    """(R, W): of rays on no part, the number of one that is within a few columns, 0 = none."""
    near = np.zeros_like(parts)
    for step in range(1, round(BESIDE * parts.shape[1] / WIDTH) + 1):
        near = np.maximum(near, np.maximum(np.roll(parts, step, 1), np.roll(parts, -step, 1)))
    return np.where(parts > 0, 0, near)
