"""What a scan that is to be completed has not measured: points filled in before, and parts of the turn without any."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.columns import own_columns
from lidarsynth.lidar.marks import were_new
from lidarsynth.lidar.own_beams import stray_rings
from lidarsynth.lidar.plural import plural
from lidarsynth.lidar.recognition import elevations_of
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.lidar.turns import several_turns

WIDE = 45  # degrees: confidences were fitted on wider holes, too, but what stands there is anyone's guess
SPARSE = 200  # points: of so few of an XT32 less than half of the new ones are right, of 4,000 four fifths
FEW = 0.15  # share of the usual points of a degree that are hardly any
# Elevations that tell hardly anything, tenths of a degree that are one, and the share of points there: of real scans,
# their near and far parts too, at most 0.76 are, of every fourth beam of a VLP-16 0.79.
BEAMS, TENTHS, NEARLY = 3, 10, 0.9
DARK = 1 / 16  # of the most there is, above which any real scan's brightest point is: 12 bits, taken for 16, are not


def caution(
    scan: Scan, sensor: Sensor | None = None, alone: bool = True, image: Sensor | None = None, around: bool = True
) -> str | None:
    """What must be said of the completion of a scan, in one line, or None.

    sensor  that it is said to be of; of one that was recognised, beams are taken where the scan has them
    alone   False = something else is said of its sensor or frame already: only what was filled in, and what lacks
    image   in whose image points are put, None = `sensor`
    around  False = they are put between the beams of the scan alone, so none where a part of the turn has none
    """
    said = [] if (before := filled_before(scan)) is None else [before]
    if 0 < len(scan) < SPARSE:
        said.append(f"expected a turn of a sensor, found {plural(len(scan), 'point')}: most of what is put between is "
                    "a guess; of default's a least confidence of 0.5 leaves most out")  # fmt: skip
    elif around and len(scan) and (wide := widest_gap(scan.xyz)) > WIDE + _never_seen(image or sensor):
        said.append(f"expected points all around, found hardly any in {wide} degrees of the turn: what is put there is "
                    "a guess; of default's a least confidence of 0.8 leaves most out, repaint draws one")  # fmt: skip
    if not alone:
        return "; ".join(said) or None
    if (turns := several_turns(scan)) is not None:
        said.append(turns)
    if sensor is not None and (strays := stray_rings(scan, sensor)) is not None:
        said.append(strays)
    if sensor is not None and (found := own_columns(scan, sensor).width) < sensor.width:
        said.append(f"expected {sensor.width} columns, as {sensor.name} has, found {found}: what lies between them is "
                    "filled in, too; learn the sensor, or leave out a known one's name")  # fmt: skip
    return "; ".join(said) or None


def filled_before(scan: Scan) -> str | None:
    """That a scan holds points that were filled in, and how many, in one line; or None."""
    if not (before := int(were_new(scan).sum())):
        return None
    return (f"expected measured points, found {before} of {len(scan)} that were filled in before (new = 1): they are "
            "taken as they are, and stay marked")  # fmt: skip


def darkness(scan: Scan) -> str | None:
    """That no point of a scan is bright, as where intensities were taken for those of a wider scale than theirs, in one
    line; or None, as of scans without reflectance, and of few points."""
    most = float(scan.reflectance.max(initial=0))
    if len(scan) < SPARSE or not 0 < most < DARK:
        return None
    return (f"expected bright points among others, found no reflectance above {most:.2g}: intensities of another scale "
            "than 0-1, 0-255 and 0-65535, such as 0-4095, are to be divided by it before")  # fmt: skip


def few_beams(xyz: np.ndarray, sensor: Sensor | None = None) -> str | None:
    """That points (N, 3) lie on so few beams that whatever is made of them is a guess, in one line; or None, as of a
    sensor that has no more."""
    if len(xyz) < SPARSE or (sensor is not None and sensor.height <= BEAMS + 1):
        return None  # `caution` tells of fewer
    lift = np.array([0, 0, np.mean(sensor.offsets) if sensor is not None and sensor.offsets else 0], np.float32)
    tenth = (10 * (90 + elevations_of(xyz - lift))).astype(int)
    count, within = np.bincount(tenth, minlength=1801), 0
    for found in range(1, BEAMS + 1):
        windows = np.convolve(count, np.ones(TENTHS, int), "valid")
        at = int(windows.argmax())
        within += int(windows[at])
        count[at : at + TENTHS] = 0
        if within >= NEARLY * len(xyz):
            return (f"expected points on many beams, found nearly all at {plural(found, 'elevation')}: nothing tells "
                    "what is above and below, so that the result is a guess")  # fmt: skip
    return None


def _never_seen(sensor: Sensor | None) -> float:
    """Degrees of the turn in which half of a sensor's rays or more are said to be blocked, as behind one that looks
    ahead: hardly anything is put there."""
    return 0.0 if sensor is None else 360 * float((sensor.blocked_rays().mean(axis=0) >= 0.5).mean())


def widest_gap(xyz: np.ndarray) -> int:
    """Whole degrees of the widest arc of the turn, seen from above, in which hardly a point (N, 3) stands; 360 of none.

    Stray points there do not count: fewer, of any three degrees, than 15 % of the usual number.
    """
    if not len(xyz):
        return 360
    count = np.bincount(np.floor(np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0]))).astype(int) % 360, minlength=360)
    around = count + np.roll(count, 1) + np.roll(count, -1)
    at = np.flatnonzero((count > 0) & (around >= FEW * np.median(around[around > 0])))
    return int(np.diff(at, append=at[0] + 360).max()) - 1
