"""How many columns a turn has in a scan: a recognised sensor may have turned slower or faster than its table says."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.own_beams import own_beams
from lidarsynth.lidar.projection import row_of_points
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import FULL_TURNS, WORDS, Sensor

FINEST = 2 * np.pi / 8192  # radians: closer points are of one firing, of which some sensors report two returns
# Times as many columns as the fullest ring has points where it has any, LEAST degrees of the turn or more; more columns
# are steps from one beam's points to another's.
DENSER, LEAST = 2.0, 30
POINTS, MANY = 12_000, 1024  # of a scan are enough, in whole rings; rings: others count no beams
ENOUGH = 1000  # steps that tell columns
ALIKE, COARSE = 0.2, 0.08  # of the median step; of so many steps, as many half as long are no chance
# So many of the steps of up to three columns are within a quarter of one, two or three. Of 129 HDL-64E scans 0.75 and
# more are, of half of them 0.85; of four other recordings 0.91; of points kept at random at most 0.71.
MULTIPLES, OFF, STEADY = 3, 0.25, 0.75
USUAL, NEAR = (0.5, 2 / 3, 1.0, 2.0), 0.08  # of the usual columns, as at 20, 15, 10 and 5 turns a second; of itself
FEWEST, MOST, WIDEST = 0.46, 4.3, 4096  # of the usual columns: what sensors turn at; columns of an image
PADDED = 16  # columns: images of networks have multiples of it


def azimuth_step(xyz: np.ndarray, ring: np.ndarray) -> float:
    """Radians between neighbouring columns: the mean step along the rings, steps over lost points left out, and such
    that the fullest ring, had it returned as often all around, is at least half full.

    Steps are those about as long as the median one, and half as long where many are: of azimuths that are read
    coarsely, as KITTI's in 0.09 degrees, two to a firing or, of each seventh, one. Others are of near points, of noise.

    xyz (N, 3), ring (N,) int from 0
    """
    return step_and_whether(xyz, ring)[0]


def step_and_whether(xyz: np.ndarray, ring: np.ndarray) -> tuple[float, bool]:
    """`azimuth_step`, and whether steps are of whole columns: not those of points at random, or of noise."""
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    step = _steps(azimuth, ring)
    mean = _mean_step(step, azimuth, ring)
    return _step_of(step, mean), _steady(step, mean)


def columns_by_steps(xyz: np.ndarray, ring: np.ndarray) -> int | None:
    """Columns of a whole turn by `azimuth_step`, though part of it or of its points be lost; None where none follow."""
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    step = _steps(azimuth, ring)
    return round(2 * np.pi / _step_of(step, _mean_step(step, azimuth, ring))) if len(step) else None


def _steps(azimuth: np.ndarray, ring: np.ndarray) -> np.ndarray:
    """Steps in radians along the rings, but those of one firing."""
    turn = np.sort(azimuth.astype(np.float64) + 10.0 * ring)  # a turn is less than 10
    step = np.diff(turn)
    return step[(step > FINEST) & (step < 3)]


def _steady(step: np.ndarray, mean: float) -> bool:
    times = step / mean
    near = times[times < MULTIPLES + 0.5]
    return bool((np.abs(near - np.maximum(near.round(), 1)) < OFF).mean() >= STEADY)


def _step_of(step: np.ndarray, mean: float) -> float:
    """The step from firing to firing, where the mean of steps up to half as long again is `mean`."""
    near = step[(step > 0.5 * mean) & (step < 1.5 * mean)]
    times = step / (np.median(near) if len(near) else mean)
    whole, half = np.abs(times - 1) < ALIKE, np.abs(times - 0.5) < ALIKE / 4
    if half.sum() > COARSE * whole.sum():
        whole |= half
    return float(np.mean(step[whole])) if whole.any() else mean


def _mean_step(step: np.ndarray, azimuth: np.ndarray, ring: np.ndarray) -> float:
    usual = np.median(step)
    degree = np.floor(np.degrees(azimuth)).astype(int) % 360
    count = np.bincount(ring.astype(int) * 360 + degree, minlength=360 * (int(ring.max()) + 1)).reshape(-1, 360)
    seen = (count > 0).sum(axis=1)
    most = float((360 * count.sum(axis=1) / np.maximum(seen, 1)).max(initial=0, where=seen >= LEAST))
    found = float(np.mean(step[(step > 0.25 * usual) & (step < 1.5 * usual)]))
    return found if most == 0 else max(found, 2 * np.pi / (DENSER * most))


def columns_of_turn(scan: Scan, sensor: Sensor) -> int | None:
    """Columns that a scan of the sensor has, where it has other than usual: what it takes at 10 turns a second.

    None where azimuths do not tell, and of more or fewer than sensors turn at, as of a scan that was thinned.
    """
    told = scan.ring is not None and len(scan) and scan.ring.min() >= 0 and scan.ring.max() < MANY
    ring = scan.ring if told else row_of_points(scan, sensor, "spherical")
    assert ring is not None
    every = max(1, round(len(scan) / POINTS))
    part = (ring >= 0) & (ring % every == every // 2)
    xyz, ring = scan.xyz[part], ring[part]
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    step = _steps(azimuth, ring)
    if len(step) < ENOUGH:
        return None
    mean = _mean_step(step, azimuth, ring)
    if not _steady(step, mean):
        return None
    usual = full_turn(sensor)
    share = 2 * np.pi / _step_of(step, mean) / usual
    likely = min(USUAL, key=lambda rate: abs(np.log(share / rate)))
    if abs(np.log(share / likely)) < NEAR:
        return None if likely == 1 else round(usual * likely)
    return PADDED * round(usual * share / PADDED) if FEWEST < share < MOST else None


def columns_sent(scan: Scan, sensor: Sensor, row: np.ndarray) -> int | None:
    """Columns of a turn in which a scan of the sensor has points, thinned ones too, of which every so many are left;
    row (N,) of each point, -1 for none. None where steps are of no columns, as of points that were kept at random."""
    if (found := columns_of_turn(scan, sensor)) is not None:
        return found
    usual, every = full_turn(sensor), max(1, round(len(scan) / POINTS))
    rows = np.flatnonzero(np.bincount(row[row >= 0]))
    part = np.isin(row, rows[min(every // 2, len(rows) - 1) :: every])
    azimuth, ring = np.arctan2(scan.xyz[part, 1], scan.xyz[part, 0]), row[part]
    if not len(rows) or not len(step := _steps(azimuth, ring)):
        return usual
    mean = _mean_step(step, azimuth, ring)
    share = 2 * np.pi / _step_of(step, mean) / usual
    if not _steady(step, mean):
        return None
    return usual if FEWEST < share < MOST else max(1, round(usual * share))


def full_turn(sensor: Sensor) -> int:
    """Columns of a turn of the sensor at its usual 10 turns a second, of which its images may have fewer."""
    return max(FULL_TURNS.get(sensor.name.removesuffix("-inverted"), sensor.width), sensor.width)


def own_columns(scan: Scan, sensor: Sensor) -> Sensor:
    """The sensor with the columns of the scan where these are fewer than its images have, and with as many times more
    as the scan has more than usual; R2DM's grid as it is."""
    if sensor.edges or (found := columns_of_turn(scan, sensor)) is None:
        return sensor
    usual = full_turn(sensor)
    width = min(sensor.width, found) if found < usual else min(round(sensor.width * found / usual), WIDEST)
    return sensor if width == sensor.width else sensor.resized(width=width)


def as_scanned(scan: Scan, sensor: Sensor) -> Sensor:
    """A sensor that was recognised in a scan, with its beams and columns as the scan has them."""
    return own_columns(scan, own_beams(scan, sensor))


def usual_at_most(sensor: Sensor) -> Sensor:
    """The recognised sensor in no more columns than its table says: classes are no better for more."""
    usual = WORDS[sensor.name].width if sensor.name in WORDS else sensor.width
    return sensor.resized(width=min(usual, sensor.width))


def columns_note(sensor: Sensor, usual: int | None = None) -> str:
    """In words that a recognised sensor has other columns than its table says, or nothing.

    usual  columns that it would have had, where naming the sensor does not hold them: of `realise`
    """
    held = usual is None
    if usual is None:
        usual = WORDS[sensor.name].width if sensor.name in WORDS else sensor.width
    if usual == sensor.width:
        return ""
    note = f"{sensor.name} in {sensor.width} columns, by the scan's own steps"
    return f"{note}; where it is named, in {usual}" if held else note
