"""A scan as some beams of a denser sensor: which it holds, and which come between."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.streets.kittis_car import outline_of, seen_written_out

TIMES = 4  # as many beams
ANSWERS = 0.02  # of the rays of a beam
FEW = 3  # beams that may be apart by chance


def spread(sparse: RangeImage, sensor: Sensor, times: int) -> tuple[RangeImage, np.ndarray]:
    """A scan's own image as every `times`-th row of a denser sensor's, and which pixels were looked at: those rows."""

    def rows(values: np.ndarray) -> np.ndarray:
        whole = np.zeros((sensor.height, *values.shape[1:]), values.dtype)
        whole[::times] = values
        return whole

    known = np.zeros((sensor.height, sensor.width), bool)
    known[::times] = (sparse.mask.mean(1) > ANSWERS)[:, None]  # a beam that hardly answers may not be there
    more = sparse.label, sparse.xyz, sparse.confidence, sparse.new
    label, xyz, sure, new = (None if part is None else rows(part) for part in more)
    kept = rows(sparse.range), rows(sparse.reflectance), rows(sparse.mask)
    return RangeImage(*kept, sensor, label, xyz, confidence=sure, new=new), known


def beam_step(sparse: RangeImage) -> tuple[int, int]:
    """(k, first): the scan holds every k-th beam of its sensor from the first on; 1 where it has beams side by side."""
    beams = np.flatnonzero(sparse.mask.mean(1) > ANSWERS)
    step = int(np.gcd.reduce(np.diff(beams))) if len(beams) > FEW else 1
    return step, int(beams[0]) % step if len(beams) else 0


def denser(sensor: Sensor, sparse: RangeImage, times: int) -> tuple[Sensor, Sensor, int]:
    """(of, dense, every): `times` as many beams as a scan of the sensor holds, whose image is `sparse`; beam i of the
    sensor `of`, in which the scan's image is to be, is beam `every` * i of `dense`.

    Raises ValueError for `times` below 2.
    """
    step, first = beam_step(sparse)
    told = seen_written_out(sensor, outline_of(sensor, sparse, sparse.mask))
    if times > 1 and times % step == 0:
        times //= step
        return sensor, told.denser(times) if times > 1 else sensor, times
    some = told.rows(range(first, sensor.height, step)) if step > 1 else sensor
    return some, (some if step > 1 else told).denser(times), times
