"""Whether a scan's points can be of the sensor that is named: in its frame, on its rings and beams, in its view, to
its lowest."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.frame import check_frame
from lidarsynth.lidar.projection import is_even_grid
from lidarsynth.lidar.recognition import (
    EVERYWHERE,
    FAR,
    POINTS,
    UNIT,
    degrees_off,
    elevations_of,
    layers,
    lies_on,
    off_rows,
    recognise,
    rings_in_order,
    same_kind,
    share_on_beams,
)
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import Sensor

MARGIN = 1.0  # degrees
# Of train scans at most 2 % of the points lie farther outside, of the same raised 1.73 m at least 16 %, pitched by 5
# degrees 8 %; and none has a beam below all points.
OUTSIDE, BELOW = 0.04, 0.25
LOWEST = 0.002  # of the points are left out to find the lowest
THIN = 0.1  # of the usual points of a ring; fewer do not make it one more than a sensor's beams
FEW = 5  # points: a ring that has fewer is a wrong number
# Least `share_on_beams` of points that no rings tell of: of maps at most 0.05, of train scans 0.98 and more, with a
# carrier's 25 m/s taken out 0.08.
BETWEEN = 0.06
BESIDE = "them between its beams as often as on them, as of a map, or of a sensor that does not spin"
MISCOUNTED = 1.25  # as many rings may be counted by the points' order alone


def misfit(xyz: np.ndarray, sensor: Sensor, ring: np.ndarray | None = None) -> str | None:
    """What points (N, 3) beyond 3 m, of rings (N,) where these are said, else of those of their order, have that the
    sensor's could not, in words, or None."""
    if found := _more_rings(ring, sensor):
        return found
    if ring is not None and not layers(xyz, ring):
        return EVERYWHERE
    far = _far(xyz)
    if found := out_of_view(xyz, sensor) or _side_by_side(xyz, sensor):
        return found
    if len(far) < 100:
        return None
    turns = rings_in_order(xyz) if ring is None else None
    rings = 0 if turns is None else _count(turns)
    if rings > MISCOUNTED * sensor.height:
        return f"them on {rings} rings, more than its {sensor.height} beams"
    scan = Scan(xyz, ring=ring)
    if other := _of_another(scan, sensor):
        return other
    if ring is not None and off_rows(ring, xyz, sensor):
        return f"them on {_count(ring)} rings that are not on its {sensor.height} beams"
    rows = turns if ring is None else ring
    if rows is not None:
        off = degrees_off(rows, xyz, sensor)
        if off is None or off < UNIT or lies_on(scan, sensor):
            return None
        return f"them on {_count(rows)} rings, half of which are {off:.1f} degrees or more off its beams"
    if is_even_grid(sensor):
        return None
    few = far[np.random.default_rng(0).permutation(len(far))[:POINTS]]
    return BESIDE if share_on_beams(few, sensor) < BETWEEN else None


def placement(scan: Scan, sensor: Sensor | None) -> tuple[str | None, bool]:
    """What is wrong with the frame of a scan, or with the sensor that is named as its, in one line, or None, and
    whether that is certain, and no mere hint."""
    frame = check_frame(scan)
    if frame.lifted and sensor is not None and lies_on(scan, sensor):
        return None, False  # one that was learned in this frame
    alien = None if frame.faults or sensor is None else misfit_of(scan, sensor)
    said = alien or frame.warning()
    if frame.faults and sensor is not None and (more := _more_rings(scan.ring, sensor)):  # in whichever frame
        said = f"{said}; expected points of {sensor.name}, found {more}"
    return said, bool(frame.faults or alien)


def _more_rings(ring: np.ndarray | None, sensor: Sensor) -> str | None:
    if ring is None or (rings := _count(ring)) <= sensor.height:
        return None
    return f"them on {rings} rings, more than its {sensor.height} beams (of two sensors? --rings A-B takes one)"


def misfit_of(scan: Scan, sensor: Sensor) -> str | None:
    """That the points of a scan cannot be of the sensor that was named as theirs, in one line, or None."""
    if scan.ring is not None and len(scan):  # what learning a sensor may leave out is no other sensor's
        _, own, count = np.unique(scan.ring, return_inverse=True, return_counts=True)
        scan = scan[count[own] >= THIN * np.median(count)]
    found = misfit(scan.xyz, sensor, scan.ring)
    return found and f"expected points of {sensor.name}, found {found}: is it another sensor, or another frame " \
                     "(--transform, --mount)?"  # fmt: skip


def out_of_view(xyz: np.ndarray, sensor: Sensor) -> str | None:
    """That points (N, 3) beyond 3 m are above or below the sensor's view, or none on its lowest beams, in words, or
    None; the cheap part of `misfit`."""
    far = _far(xyz)
    if len(far) < 100:
        return None
    elevation = elevations_of(far - _lift(sensor))
    outside = float(_outside(elevation, sensor).mean())
    if outside > OUTSIDE:
        return f"{outside:.0%} of them outside its view of {_view(sensor)}"
    near = np.quantile(elevations_of(xyz - _lift(sensor)), LOWEST)  # steep beams meet the ground within 3 m alone
    lowest = min(np.quantile(elevation, LOWEST), near) - MARGIN
    below = int((np.array(sensor.elevations) < lowest).sum())
    return f"none on its {below} lowest beams of {sensor.height}" if below > BELOW * sensor.height else None


def _side_by_side(xyz: np.ndarray, sensor: Sensor) -> str | None:
    """That points (N, 3) are all on a few beams of the sensor that lie side by side, in words, or None. The sky may
    hide the beams above, and the carrier those below, but not both."""
    if len(xyz) < 100:
        return None
    ends = np.quantile(elevations_of(xyz - _lift(sensor)), [1 - LOWEST, LOWEST])
    first, last = np.abs(np.array(sensor.elevations) - ends[:, None]).argmin(axis=1).tolist()
    few = last - first + 1
    if few > max(BELOW * sensor.height, 1) or few == sensor.height:
        return None
    return f"them on {few} of its {sensor.height} beams" + (", which lie side by side" if few > 1 else "")


def beyond_beams(xyz: np.ndarray, sensor: Sensor) -> str | None:
    """That points (N, 3), whoever measured them, are above or below the view of the sensor in whose image they are
    drawn, and how many, in one line; or None where they are few. Whether they are, those beyond 3 m say, if there are
    100: of a sensor's own view are many nearer ones, as of its carrier's roof."""
    beyond, far = _outside(elevations_of(xyz - _lift(sensor)), sensor), np.hypot(xyz[:, 0], xyz[:, 1]) > FAR
    judged, outside = beyond[far] if far.sum() >= 100 else beyond, int(beyond.sum())
    if judged.sum() <= OUTSIDE * len(judged):
        return None
    return (f"expected points in {sensor.name}'s view of {_view(sensor)}, found {outside} of {len(xyz)} above or below "
            "it: they stay, with the ring of its first or last beam")  # fmt: skip


def _outside(elevation: np.ndarray, sensor: Sensor) -> np.ndarray:
    """(N,) bool: which elevations, in degrees, are above or below the sensor's view."""
    return (elevation > sensor.elevations[0] + MARGIN) | (elevation < sensor.elevations[-1] - MARGIN)


def _view(sensor: Sensor) -> str:
    return f"{sensor.elevations[-1]:+.1f} to {sensor.elevations[0]:+.1f} degrees"


def _far(xyz: np.ndarray) -> np.ndarray:
    """The points (N, 3) beyond 3 m."""
    return xyz[np.hypot(xyz[:, 0], xyz[:, 1]) > FAR]


def _lift(sensor: Sensor) -> np.ndarray:
    """(3,) metres from the sensor's origin to the mean origin of its beams."""
    return np.array([0, 0, np.mean(sensor.offsets) if sensor.offsets else 0.0], np.float32)


def _of_another(scan: Scan, sensor: Sensor) -> str | None:
    """That the points lie on the beams of a known sensor and not on this one's, which may have as many or more."""
    other, _ = recognise(scan)
    if other is None or same_kind(other, sensor.name) or lies_on(scan, sensor):
        return None
    return f"them on the beams of {other}"


def _count(ring: np.ndarray) -> int:
    return int((np.unique(ring, return_counts=True)[1] >= FEW).sum())
