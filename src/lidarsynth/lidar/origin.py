"""Where in a scan's points its sensor is: its axis and origin by the cones of its rings, and what of that to undo.

How far off the origin is along the axis, the beams say: those of an HDL-64E leave above its origin. How far across, a
motion says: points that were moved to one instant of a turn look as if the sensor stood elsewhere on its way.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lidarsynth.lidar.cones import Cones, fit_cones, onto_z
from lidarsynth.lidar.crowding import ORIGINS, stand_of_beams
from lidarsynth.lidar.motion import straighten
from lidarsynth.lidar.recognition import mixes_beams, recognise, rings_by_elevation, rings_in_order
from lidarsynth.lidar.scan import Scan

RAISED = 0.6  # metres; beams of an HDL-64E leave up to 0.2 m above its origin
# Metres across; of train scans and standing streets of eight sensors it is at most 0.05, of those that drive, their
# motion taken out, 0.2.
ASIDE = 0.4
SMALL = 0.1  # metres: less hides no sensor
TILTED = 2.0  # degrees; no real scan at hand exceeds 0.3
FIT = 2.0  # degrees: cones that fit worse are none
REACH = 5.0  # metres: cones of points about a wrong axis fit best from far off, if anywhere
SURE = 6.0  # standard errors
ROUNDS = 3
BESIDE = (0.0, -1.0, 1.0)  # metres: seen from near its sensor, each ring of a shifted scan is one turn
POINTS = 4_000  # of a scan are enough to tell a motion
FEWEST_RINGS = 4  # fewer tell no cones
BETTER = 0.8  # of the residual; less gain is no motion


@dataclass(frozen=True)
class Turned:
    """A scan's points, as turned, by the rings that they have then.

    xyz    (N, 3) metres
    ring   (N,), or None where nothing tells
    told   whether the field or the order of the points says it, not where elevations crowd
    cones  of the rings, or None where they are none
    """

    xyz: np.ndarray
    ring: np.ndarray | None
    told: bool
    cones: Cones | None


@dataclass(frozen=True)
class Place:
    """Where the sensor is among points: its axis (3,), a unit vector; its origin (3,), metres; rings (N,), if told."""

    axis: np.ndarray
    origin: np.ndarray
    ring: np.ndarray | None

    @property
    def tilt(self) -> float:
        """Degrees between the axis and z."""
        return float(np.degrees(np.arccos(np.clip(self.axis[2], -1, 1))))


def rings_of(scan: Scan, xyz: np.ndarray | None = None) -> np.ndarray | None:
    """(N,) ring of each point by its field, else by the order of the points (of `xyz`, where turned), else by crowded
    elevations, else None."""
    xyz = scan.xyz if xyz is None else xyz
    ring = scan.ring if scan.ring is not None else rings_in_order(xyz)
    return _several(rings_by_elevation(xyz) if ring is None else ring)


def turned(scan: Scan, rotation: np.ndarray, beside: Sequence[float] = (0.0,)) -> Turned:
    """The scan by what its rings are about the axis that `rotation` (3, 3) makes z; by their order, seen from the
    first place `beside` the origin, metres to the left, that tells them."""
    xyz = (scan.xyz @ rotation.T).astype(np.float32)
    ring = scan.ring if scan.ring is not None else _in_order(xyz, beside)
    told = ring is not None
    ring = _several(ring if told else rings_by_elevation(xyz))
    return Turned(xyz, ring, told, None if ring is None else _cones(xyz, ring))


def _in_order(xyz: np.ndarray, beside: Sequence[float]) -> np.ndarray | None:
    rings = (rings_in_order(xyz - np.array([0, y, 0], np.float32)) for y in beside)
    ring = next((ring for ring in rings if ring is not None), None)
    return None if ring is None or mixes_beams(xyz, ring) else ring


def _several(ring: np.ndarray | None) -> np.ndarray | None:
    return None if ring is None or np.count_nonzero(np.bincount(ring)) < FEWEST_RINGS else ring


def _cones(xyz: np.ndarray, ring: np.ndarray) -> Cones | None:
    try:
        cones = fit_cones(xyz, ring)
    except (ValueError, np.linalg.LinAlgError):
        return None
    return cones if cones.residual < FIT and np.linalg.norm(cones.origin) < REACH else None


def place_of(scan: Scan, points: Turned) -> Place:
    """Where the sensor is in the points as turned; also of a scan whose rings are not said."""
    if points.told:
        return _by_cones(scan, points)
    stand = stand_of_beams(points.xyz) or (np.array([0.0, 0.0, 1.0]), 0.0)
    return Place(stand[0], stand[1] * stand[0], None)


def _by_cones(scan: Scan, points: Turned) -> Place:
    """The fit is linear in a tilt, and the order of points tells rings from nearby best: it is repeated on what it
    straightened."""
    tip, origin, cones, ring = np.eye(3), np.zeros(3), points.cones, points.ring
    for _ in range(ROUNDS):
        if cones is None or not cones.apart(SURE):
            break  # cones about z through the origin fit as well
        origin = origin + tip.T @ cones.origin
        tip = onto_z(cones.axis) @ tip
        if cones.tilt < TILTED / 10 and np.linalg.norm(cones.origin) < RAISED / 2:
            break
        xyz = ((points.xyz - origin) @ tip.T).astype(np.float32)
        ring = rings_of(scan, xyz)
        cones = None if ring is None else _cones(xyz, ring)
    return Place(tip[2], origin, ring)


def to_undo(scan: Scan, xyz: np.ndarray, place: Place) -> np.ndarray:
    """(3,) metres of the sensor's origin in points (N, 3) about its axis, zero where it is right as it is.

    An origin far off is undone. The height is that of which the beams are a known sensor's, if any; and where they are
    one only from a height or place that were near enough, that is undone as well.
    """
    apex, away = place.origin, _off(place.origin)
    if away.any() and place.ring is not None:
        apex, away = _at_rest(scan, xyz, place.ring, apex, away)
    apex = np.round(apex, 3)
    as_said = apex * away
    if place.ring is None and not away.any():
        return as_said
    found = _known_from(scan, xyz, place.ring, _tried(apex, as_said))
    strange = away.any() or min(abs(apex[2] - lift) for lift in ORIGINS) > SMALL
    if found is None and strange and scan.ring is None and place.ring is not None:  # the order may miscount them
        found = _known_from(scan, xyz, None, _tried(apex, as_said))
    if found is None or not (away.any() or recognise(scan)[0] is None):
        return as_said
    return found


def _known_from(
    scan: Scan, xyz: np.ndarray, ring: np.ndarray | None, origins: Iterable[np.ndarray]
) -> np.ndarray | None:
    """The first of the origins (3,) from which points (N, 3) lie on the beams of a known sensor, if any."""
    for origin in origins:
        if recognise(Scan((xyz - origin).astype(np.float32), scan.reflectance, ring=ring))[0] is not None:
            return origin
    return None


def _tried(apex: np.ndarray, as_said: np.ndarray) -> Iterator[np.ndarray]:
    """Origins from which the beams may be a known sensor's, `as_said` first where its height is near enough."""
    heights = [apex[2] - lift for lift in ORIGINS]
    if as_said[2] == 0:
        heights = [0.0, *(height for height in heights if abs(height) > SMALL)]
    for across in (as_said[:2], apex[:2]):
        yield from (np.append(across, height) for height in heights)
        if as_said[:2].any() or np.hypot(*apex[:2]) < SMALL:
            return


def _off(apex: np.ndarray) -> np.ndarray:
    """(3,) bool: which numbers of an origin are far off by themselves."""
    aside = np.hypot(*apex[:2]) > ASIDE
    return np.array([aside, aside, abs(apex[2]) > RAISED])


def _at_rest(
    scan: Scan, xyz: np.ndarray, ring: np.ndarray, apex: np.ndarray, away: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The origin and which of its numbers are off, were the points (N, 3) moved to one instant of the turn: where the
    sensor's way passed by the frame's origin it is not aside, and the height is that of the straightened rings."""
    few = np.random.default_rng(0).permutation(len(xyz))[:POINTS]
    points, rings, time = xyz[few], ring[few], None if scan.time is None else scan.time[few]
    found, bent = [], _cones((points - apex).astype(np.float32), rings)
    for start in (apex, np.zeros(3)):  # a long way is found from where its middle was, a short one from what was fitted
        seen = (points - start).astype(np.float32)
        straight = straighten(seen, rings, time)
        if (way := seen - straight).any():
            cones, passed = _cones(straight, rings), way[:, :2] + start[:2]
            better = cones is not None and (bent is None or cones.residual < BETTER * bent.residual)
            if cones is not None and better and np.abs(passed).max() < REACH:
                found.append((cones.residual, start[2] + cones.origin[2], passed))
    if not found:  # the rings bend too little to tell a short motion from a shift
        aside = np.hypot(*apex[:2]) > RAISED or recognise(scan)[0] is None
        return apex, away & [aside, aside, True]
    _, height, passed = min(found, key=lambda one: one[0])
    apex = np.array([*passed.mean(axis=0), height])
    near = float(np.hypot(*passed.T).min()) <= ASIDE
    return apex, _off(apex) & [not near, not near, True]
