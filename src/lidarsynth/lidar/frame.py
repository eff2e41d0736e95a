"""Whether a scan's points are in their sensor's frame (x forward, y left, z up, the sensor at the origin), or in which.

Rings tell: they are cones about the axis that the sensor turns about, through its origin (`cones.fit_cones`), so a scan
that was shifted, raised, tilted or written in other axes shows it, whatever the road does. The ground tells up from
down.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidarsynth.lidar.cones import onto_z
from lidarsynth.lidar.crowding import ORIGINS
from lidarsynth.lidar.ground import GROUND, UPSIDE, is_above, levels, road_axis
from lidarsynth.lidar.origin import BESIDE, TILTED, Turned, place_of, rings_of, to_undo, turned
from lidarsynth.lidar.recognition import on_one_ring, recognise
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import INVERTED, SENSORS

CLEAR = 0.7  # degrees: cones that fit better leave no doubt of the axis
CLEARLY = 0.5  # of the residual about z: cones about another axis that fit better are the scan's
TURN = 64  # parts of a turn, whose directions tell which way it goes
ACROSS = -0.2  # `road_axis` of a road that runs along y; of 133 real scans the lowest is -0.11
TOLD = 0.05  # metres: shifts that are said

# Which axis of the file is up -> rotation into x forward, y left, z up, and the words for it.
AXES: dict[str, tuple[tuple[tuple[int, int, int], ...], str]] = {
    "+z": (((1, 0, 0), (0, 1, 0), (0, 0, 1)), ""),
    "-z": (((1, 0, 0), (0, -1, 0), (0, 0, -1)), "upside down"),
    "-y": (((0, 0, 1), (-1, 0, 0), (0, -1, 0)), "in camera axes (x right, y down, z forward)"),
    "+y": (((0, 0, -1), (-1, 0, 0), (0, 1, 0)), "with y up instead of z"),
    "+x": (((0, 0, -1), (0, 1, 0), (1, 0, 0)), "with x up instead of z"),
    "-x": (((0, 0, 1), (0, 1, 0), (-1, 0, 0)), "with x down instead of z up"),
}


@dataclass(frozen=True)
class Frame:
    """What was found of a scan's frame.

    faults     what is not as it should be, in words; none for a scan in its sensor's frame
    hints      what only seems so, in words: never a reason to refuse
    transform  (4, 4) that brings the file's points into the sensor's frame
    """

    faults: tuple[str, ...]
    hints: tuple[str, ...]
    transform: np.ndarray

    @property
    def lifted(self) -> bool:
        """Whether all that is wrong is how high the origin is: of a sensor that was learned so, it is right."""
        level = self.transform.copy()
        level[2, 3] = 0
        return bool(self.faults) and np.array_equal(level, np.eye(4))

    def warning(self) -> str | None:
        """One line that says what the points are and what to do, or None."""
        found = [*self.faults, *self.hints]
        if not found:
            return None
        way = ":".join(f"{round(v, 3) + 0.0:.4g}" for v in pose_of(self.transform))
        return f"expected points in the sensor's frame (x forward, z up), found them {', '.join(found)}: " \
               f"try --transform {way}"  # fmt: skip


def check_frame(scan: Scan) -> Frame:
    """In which frame a scan's points are.

    Without a ring field, and in an order that does not tell rings, axes are tested by the ground, and height and tilt
    by where elevations crowd. One ring tells nothing.
    """
    if on_one_ring(scan.xyz):
        return Frame((), (), np.eye(4))
    up, points = _upright(scan)
    rotation, words, xyz = np.array(AXES[up][0], np.float64), AXES[up][1], points.xyz
    place = place_of(scan, points)
    faults, hints = [words] if words else [], []
    if place.tilt > TILTED:
        faults.append(f"tilted by {place.tilt:.1f} degrees")
        tip = onto_z(place.axis)
        rotation, xyz = tip @ rotation, (xyz @ tip.T).astype(np.float32)
        place = replace(place, axis=tip @ place.axis, origin=tip @ place.origin)
    if (origin := to_undo(scan, xyz, place)).any():
        faults.append(f"with the sensor {_away(origin)} the origin")
    if not faults and _hangs(scan):
        hints.append("with the ground above, as of a sensor that hangs upside down")
        rotation = np.array(AXES["-z"][0], np.float64)
    elif not faults and road_axis(scan.xyz) < ACROSS:
        hints.append("with the road along y, as if turned by 90 degrees")
        rotation = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -origin
    return Frame(tuple(faults), tuple(hints), matrix)


def _away(origin: np.ndarray) -> str:
    """Where (3,) metres are, as words before "the origin"."""
    ways = (("ahead of", "behind"), ("left of", "right of"), ("above", "below"))
    told = [f"{abs(v):.2f} m {way[int(v < 0)]}" for v, way in zip(origin, ways, strict=True) if abs(v) > TOLD]
    return " and ".join([", ".join(told[:-1]), told[-1]]) if told[1:] else told[0]


def _upright(scan: Scan) -> tuple[str, Turned]:
    """Which of AXES points up, and the points turned so. Nothing found: z."""
    about: dict[str, Turned] = {}
    best, residual = "", np.inf
    for axis in "zyx":
        points = turned(scan, np.array(AXES["+" + axis][0]), BESIDE if axis == "z" else (0.0,))
        about[axis] = points
        if points.cones is None or not (points.told or _sees_ground(scan, axis)):
            continue
        if points.cones.residual < CLEARLY * residual:
            best, residual = axis, points.cones.residual
            if residual < CLEAR:
                break
    if best:
        side = _side(scan, best, about[best])
        return side, about[best] if side[0] == "+" else turned(scan, np.array(AXES[side][0]))
    shares = {axis: _shares(scan, axis) for axis in AXES}
    level = max(shares, key=lambda axis: shares[axis])
    clear = shares[level] > max(0.6, UPSIDE * shares["+z"]) and shares["+z"] < 1 / 3
    return (level, turned(scan, np.array(AXES[level][0]))) if clear else ("+z", about["z"])


def _sees_ground(scan: Scan, axis: str) -> bool:
    """Whether as much ground lies along an axis as along z: about any other one the elevations of points that lie on no
    beams, as of a sensor that looks ahead and does not spin, crowd into rings by chance."""
    along, upright = (max(_shares(scan, sign + one) for sign in "+-") for one in (axis, "z"))
    return along >= upright


def _side(scan: Scan, axis: str, points: Turned) -> str:
    """+axis or -axis: where the ground is below the sensor, wherever the origin, however tilted; where both sides look
    alike, where the beams are a known sensor's, unless one of that kind hangs at times: then where there is more of the
    ground; and of beams that are so either way, as an OS1's, from where they turn to the right.

    points  of the scan, turned so that +axis is up
    """
    rotation, seen = np.array(AXES["+" + axis][0]), scan
    if points.told and points.cones is not None:
        level = onto_z(points.cones.axis) if points.cones.tilt > TILTED else np.eye(3)
        upright = (points.xyz - points.cones.origin) @ level.T
        seen = replace(scan, xyz=(upright @ rotation).astype(np.float32))
    upper, lower = _shares(seen, "+" + axis), _shares(seen, "-" + axis)
    if upper > GROUND and upper > UPSIDE * lower:
        return "+" + axis
    up, down = (_known(seen, sign + axis) for sign in "+-")
    if down and not up and f"{down}-inverted" in INVERTED:  # its own beams, or those of one that hangs
        return ("+" if upper > lower else "-") + axis
    if bool(up) != bool(down):
        return ("+" if up else "-") + axis
    if lower > UPSIDE * upper and lower > 1 / 3:
        return "-" + axis
    return ("-" if up and turns_left(seen.xyz @ rotation.T.astype(np.float32), scan.time) else "+") + axis


def turns_left(xyz: np.ndarray, time: np.ndarray | None) -> bool:
    """Whether a sensor saw the points (N, 3) counter-clockwise about z, by their times (N,).

    Ouster's, Hesai's and Velodyne's turn clockwise, seen from above. False where times do not tell: a tenth of their
    steps goes the other way, or they are of less than half a turn.
    """
    if time is None or len(time) < 10 * TURN:
        return False
    order = np.argsort(time, kind="stable")
    way = np.exp(1j * np.arctan2(xyz[order, 1], xyz[order, 0]))
    middle = np.array([part.mean() for part in np.array_split(way, TURN)])
    step = np.angle(middle[1:] / middle[:-1])
    return bool((step > 0).mean() > 0.9 and step.sum() > np.pi)


def _known(scan: Scan, up: str) -> str:
    """The known sensor whose beams these are, were `up` the upper side, at one of its origins; "" = none."""
    xyz = scan.xyz @ np.array(AXES[up][0], np.float32).T
    for lift in ORIGINS:
        raised = xyz + np.array([0, 0, lift], np.float32)
        name, _ = recognise(Scan(raised, scan.reflectance, ring=rings_of(scan, raised)), among=SENSORS)
        if name is not None:
            return name
    return ""


def _hangs(scan: Scan) -> bool:
    """Whether the ground is above: of a known sensor whose beams tell that its own frame is the file's, or as it is
    only seen where the scan is turned over."""
    below, above = levels(scan.xyz)
    if above.share > GROUND and above.share > UPSIDE * below.share:
        name = recognise(scan, among=SENSORS)[0]
        if name is not None and f"{name}-inverted" in INVERTED:
            return True
    return is_above(scan.xyz)


def _shares(scan: Scan, up: str) -> float:
    """The share of the cells around the sensor that have points of one level below, were `up` the upper side."""
    return levels(scan.xyz @ np.array(AXES[up][0], np.float32).T)[0].share


WAYS = {"f": (1, 0, 0), "b": (-1, 0, 0), "l": (0, 1, 0), "r": (0, -1, 0), "u": (0, 0, 1), "d": (0, 0, -1)}


def parse_axes(text: str) -> np.ndarray:
    """(4, 4) from where a file's x, y and z point, as `flu` for forward, left, up: a turn, or a mirror for left-handed
    ones such as `fru`. Raises ValueError for anything but one letter each of f b, l r and u d.
    """
    if len(text) != 3 or [len(set(text.lower()) & set(pair)) for pair in ("fb", "lr", "ud")] != [1, 1, 1]:
        raise ValueError(
            f"expected axes of three letters, one each of f b, l r and u d, such as flu or fru, found {text!r}"
        )
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([WAYS[letter] for letter in text.lower()]).T
    return matrix


def parse_transform(text: str) -> np.ndarray:
    """(4, 4) from x:y:z:roll:pitch:yaw (metres, degrees: roll about x, then pitch about y, then yaw about z).

    Raises ValueError for anything but six finite numbers.
    """
    try:
        x, y, z, *angles = numbers = [float(word) for word in text.split(":")]
        roll, pitch, yaw = np.radians(angles)
    except ValueError:
        raise ValueError(
            f"expected a transform x:y:z:roll:pitch:yaw, or a file of 4 x 4 numbers, found {text!r}"
        ) from None
    if not np.isfinite(numbers).all():
        raise ValueError(f"expected a transform x:y:z:roll:pitch:yaw of finite numbers, found {text!r}")
    (a, b), (c, d), (e, f) = ((np.cos(angle), np.sin(angle)) for angle in (roll, pitch, yaw))
    about_x = np.array([[1, 0, 0], [0, a, -b], [0, b, a]])
    about_y = np.array([[c, 0, d], [0, 1, 0], [-d, 0, c]])
    about_z = np.array([[e, -f, 0], [f, e, 0], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = about_z @ about_y @ about_x, (x, y, z)
    return matrix


def pose_of(matrix: np.ndarray) -> tuple[float, ...]:
    """x y z roll pitch yaw of a (4, 4) rigid transform, the inverse of `parse_transform`."""
    r = matrix[:3, :3]
    pitch = -np.arcsin(np.clip(r[2, 0], -1, 1))
    if abs(r[2, 0]) > 1 - 1e-9:  # nose straight up or down: roll and yaw are one
        roll, yaw = np.arctan2(-r[1, 2], r[1, 1]), 0.0
    else:
        roll, yaw = np.arctan2(r[2, 1], r[2, 2]), np.arctan2(r[1, 0], r[0, 0])
    angles = np.degrees([roll, pitch, yaw])
    return tuple(float(round(v, 6)) + 0.0 for v in (*matrix[:3, 3], *angles))


def transformed(xyz: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """(N, 3) float32 points through a (4, 4) rigid transform or mirror."""
    return (xyz.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
