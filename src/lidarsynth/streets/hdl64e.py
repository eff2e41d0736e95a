"""What is particular to KITTI's Velodyne HDL-64E on its car: how bright each laser reads, and what its own car hides.

Fitted to real KITTI scans of 2011_09_26 and the object benchmark, as the elevations in `lidar/sensor.py` are; numbers
of the instrument, not of any scene.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lidarsynth.lidar.sector import runs_of
from lidarsynth.lidar.sensor import SENSORS, Sensor

NAME = "hdl-64e-kitti"
ANOTHER = 1.0  # degrees: a sensor of this name whose beams stand so much otherwise is somebody else's

# fmt: off
# How much less signal each laser reports than the brightest ones, top beam first.
RING_LOSS = (
    0.054, 0.080, 0.113, 0.097, 0.070, 0.062, 0.016, 0.042, 0.003, 0.072, 0.020, 0.014, -0.021,
    0.010, 0.031, 0.018, 0.001, 0.016, -0.019, 0.028, 0.005, 0.085, 0.001, -0.014, 0.042, 0.034,
    0.042, 0.003, 0.017, 0.095, 0.030, 0.038, 0.072, 0.088, 0.074, 0.142, 0.184, 0.080, 0.030,
    0.044, 0.110, 0.084, 0.179, 0.082, 0.089, 0.083, 0.080, 0.107, 0.126, 0.063, 0.030, 0.196,
    0.088, 0.131, 0.131, 0.084, 0.068, 0.025, 0.131, 0.136, 0.143, 0.052, 0.010, 0.035)

# How much less signal it reports from 4 to 6 m, where its optics are too close: dark patches on near walls.
RING_DIP = (
    0.157, 0.160, 0.050, 0.233, 0.123, 0.223, 0.117, 0.209, 0.237, 0.250, 0.317, 0.167, 0.330,
    0.313, 0.233, 0.320, 0.330, 0.229, 0.284, 0.240, 0.157, 0.173, 0.287, 0.153, 0.233, 0.180,
    0.033, 0.244, 0.214, 0.095, 0.150, 0.083, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
    0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
    0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

DIP = (2.2, 4.0, 6.0, 9.5)  # metres over which near returns are read too dark: from, fully, until, no more

# Metres that each laser reads too far; the upper block measured on walls, the lower one within what the ground allows.
RING_SHIFT = (
    0.005, -0.013, 0.031, -0.010, 0.006, -0.056, 0.048, -0.016, -0.022, 0.007, 0.027, -0.012, 0.019,
    0.005, -0.019, -0.020, 0.033, 0.004, 0.071, 0.014, 0.012, -0.009, -0.033, -0.058, -0.041, -0.068,
    -0.018, -0.012, 0.038, 0.012, 0.063, 0.011, 0.003, 0.007, 0.003, -0.010, 0.007, 0.004, -0.004,
    0.005, 0.003, 0.002, 0.0, 0.004, -0.006, -0.001, -0.004, 0.005, 0.0, -0.002, -0.006, -0.002,
    0.0, -0.002, 0.010, 0.008, -0.022, -0.015, -0.001, -0.003, 0.002, 0.002, 0.017, -0.009)

# How much more reflectance each laser reads than others, at 12 m, and how much more still per natural logarithm of
# how many times as far it looks: what a network errs between known beams of 111 scans. Not cast into streets.
RING_OFFSET = (
    0.034, 0.010, 0.029, -0.052, 0.025, -0.020, 0.031, -0.017, 0.020, -0.017, -0.017, 0.021, 0.011,
    -0.001, -0.007, -0.028, -0.022, 0.000, 0.003, -0.027, 0.014, -0.038, -0.009, 0.020, -0.025, -0.004,
    0.019, -0.017, -0.008, -0.018, 0.001, 0.014, -0.015, -0.008, 0.000, -0.034, -0.030, 0.016, 0.016,
    0.038, -0.001, 0.008, -0.014, 0.006, 0.063, 0.040, 0.000, 0.037, 0.052, -0.026, 0.075, -0.083,
    -0.069, 0.039, 0.014, -0.097, 0.134, 0.080, -0.094, 0.061, 0.052, -0.146, -0.113, 0.017)
RING_SLOPE = (
    -0.044, -0.006, -0.042, 0.075, -0.085, 0.034, -0.062, 0.027, -0.043, 0.020, 0.003, -0.023, -0.042,
    -0.006, 0.013, 0.013, 0.005, -0.007, -0.047, 0.039, -0.009, 0.035, -0.019, -0.056, 0.069, 0.002,
    -0.022, 0.010, 0.020, 0.034, 0.030, 0.046, -0.148, -0.075, -0.065, -0.057, -0.020, -0.001, 0.005,
    0.061, -0.016, 0.003, -0.001, -0.019, 0.088, 0.045, -0.021, 0.042, 0.069, -0.060, 0.074, -0.066,
    -0.102, 0.045, 0.019, -0.136, 0.132, 0.062, -0.088, 0.073, 0.058, -0.163, -0.126, 0.007)

# Outlines of what stands on the car's roof and hides the ground: for each part, (row, first column, last column) at
# 1024 columns, row by row; and by how many columns every second laser of the lower block sees it shifted.
_EGO = (
    (0, ((52, -36, 28), (53, -57, 62), (54, -70, 57), (56, -72, 61), (58, -78, 70), (60, -86, 73), (62, -90, 79),
         (63, -90, 100))),
    (7, ((42, 41, 63), (44, 40, 67), (46, 43, 63), (48, 41, 58), (50, 42, 55), (52, 44, 56))),
    (8, ((42, 947, 969), (44, 947, 973), (46, 951, 969), (48, 954, 969), (50, 959, 972), (52, 961, 972))),
    (14, ((46, 685, 690), (47, 681, 706), (48, 677, 722), (50, 673, 730), (52, 674, 735), (54, 668, 732),
          (56, 671, 732), (58, 674, 732), (60, 689, 729), (61, 694, 724), (63, 713, 730))),
    (11, ((55, 132, 139), (56, 126, 142), (58, 123, 147), (60, 118, 146), (61, 116, 145), (62, 99, 141),
          (63, 97, 145))),
    (10, ((55, 867, 871), (56, 864, 878), (58, 862, 885), (60, 858, 884), (61, 860, 886), (62, 861, 906),
          (63, 861, 912))),
    (5, ((57, 481, 537), (58, 470, 549), (60, 461, 557), (61, 456, 560), (62, 454, 563), (63, 452, 564))),
    (10, ((60, 423, 425), (61, 398, 428), (62, 398, 430), (63, 396, 430))),
    (10, ((60, 583, 614), (61, 584, 614), (62, 584, 616), (63, 583, 615))),
)
# fmt: on


@lru_cache(maxsize=4)
def is_kittis(sensor: Sensor) -> bool:
    """Whether it is `hdl-64e-kitti`, on whatever day; not a sensor of other beams that somebody named so."""
    own = SENSORS[NAME].elevations
    if sensor.name != NAME or sensor.height != len(own):
        return False
    return bool(np.median(np.abs(np.subtract(sensor.elevations, own))) < ANOTHER)


@lru_cache(maxsize=4)
def own_car(sensor: Sensor) -> np.ndarray:
    """(H, W) bool: which rays end on the vehicle itself. All False for other sensors than `hdl-64e-kitti`, or rows."""
    width = sensor.width
    hidden = np.zeros((sensor.height, width), bool)
    if not is_kittis(sensor):
        return hidden
    columns = np.arange(width)
    scale = width / 1024
    for shift, outline in _EGO:
        rows, first, last = np.array(outline, float).T
        for row in range(int(rows[0]), int(rows[-1]) + 1):
            move = shift * (row % 2)
            a, b = (np.interp(row, rows, edge) + move for edge in (first, last))
            hidden[row] |= np.mod(columns - a * scale, width) <= (b - a + 1) * scale
    return hidden


Table = tuple[float, ...]
Rows = slice | np.ndarray  # some of the lasers
ALL = slice(None)


class Lasers(NamedTuple):
    """Per ray: signal lost (N,), signal lost at 4 to 6 m (N,), metres read too far (N,), laser number (N,)."""

    loss: np.ndarray
    dip: np.ndarray
    shift: np.ndarray
    number: np.ndarray


@lru_cache(maxsize=4)
def lasers(sensor: Sensor, loss: Table = (), dip: Table = (), shift: Table = ()) -> Lasers:
    """For each ray of the sensor's image that nothing blocks, row by row; zeros for tables that are not given.

    loss, dip, shift  one number per beam; those of `hdl-64e-kitti` where nothing is given for it
    """
    seen = ~hidden(sensor).reshape(-1)
    tables = (RING_LOSS, RING_DIP, RING_SHIFT) if is_kittis(sensor) and not loss else (loss, dip, shift)
    spread = [np.repeat(np.asarray(table or [0.0] * sensor.height, np.float32), sensor.width)[seen] for table in tables]
    return Lasers(*spread, number=np.repeat(np.arange(sensor.height, dtype=np.uint32), sensor.width)[seen])


@lru_cache(maxsize=4)
def hidden(sensor: Sensor) -> np.ndarray:
    """(H, W) bool: rays that end on the carrier: those blocked by name, and those of KITTI's own car. Read only."""
    rays = own_car(sensor) | sensor.blocked_rays()
    rays.flags.writeable = False
    return rays


@lru_cache(maxsize=4)
def written_out(sensor: Sensor) -> Sensor:
    """The sensor with what is known by its name in its own fields, so that its parts and denser ones keep it."""
    if not is_kittis(sensor):
        return sensor
    blocked = runs_of(hidden(sensor))
    return replace(sensor, blocked=blocked, dimness=RING_LOSS)


def shifts(sensor: Sensor) -> np.ndarray:
    """(H, 1) float32 metres that each beam reads too far, 0 where nobody has measured it."""
    return np.asarray(RING_SHIFT if is_kittis(sensor) else [0.0] * sensor.height, np.float32)[:, None]


def misread(metres: np.ndarray, rows: Rows = ALL) -> np.ndarray:
    """(R, W) float32: how much more reflectance lasers of KITTI's own unit, all or some, read at ranges (R, W) in m."""
    far = np.log(np.maximum(metres, np.float32(1)) / np.float32(12))
    offset, slope = np.array([RING_OFFSET, RING_SLOPE], np.float32)[:, rows, None]
    return offset + slope * far


def dip(metres: np.ndarray, rows: Rows = ALL) -> np.ndarray:
    """(R, W) float32: how much less signal lasers of KITTI's unit, all or some, report at ranges (R, W) in metres."""
    return np.array(RING_DIP, np.float32)[rows, None] * dipped(metres)


def dipped(metres: np.ndarray) -> np.ndarray:
    """Share of a laser's dip at ranges of any shape, in metres."""
    near = np.minimum((metres - DIP[0]) / (DIP[1] - DIP[0]), (DIP[3] - metres) / (DIP[3] - DIP[2]))
    return np.clip(near, 0, 1)


def dimness(sensor: Sensor) -> Table:
    """How much less signal each beam reports, () where nobody has measured it."""
    return RING_LOSS if is_kittis(sensor) else sensor.dimness


def unevenness(sensor: Sensor) -> np.ndarray:
    """(H, 1) float32: how much less than the mean beam each one reads, 0 where nobody has measured it."""
    dim = np.asarray(dimness(sensor) or [0.0] * sensor.height, np.float32)
    return (dim - dim.mean())[:, None]
