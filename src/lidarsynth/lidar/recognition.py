"""Which sensor took a scan: the elevations of its rings, or of its points, against the tables of SENSORS."""

from __future__ import annotations

from collections.abc import Mapping
from math import factorial
from pathlib import Path

import numpy as np

from lidarsynth.lidar.ground import levels
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import GRIDS, INVERTED, SENSORS, Sensor

FAR = 3.0  # metres: nearer points show the beam's origin off the sensor's centre more than its elevation
ON_ROW, RINGS = 0.25, 8  # of the beams' spacing: how far numbered rings may lie off their rows; how many tell
UNIT = 0.5  # degrees: one sensor of a kind may differ from its data sheet by this much (HDL-64E units do)
# Metres above the beams' origin that a frame may have its own, by which near rings look degrees off: an Ouster's 0.04.
LIFTS = np.linspace(-0.1, 0.1, 9)
SUBSET = 0.12  # of the beams' spacing: the error when a scan has some beams only; chance gives 0.25
LUCK = 0.003  # chance that so few beams of nobody's lie so near those of one sensor: of 3 the error is at most 0.044
STRAY = 0.02  # of a usual ring: a first or last one of fewer points is none
ENOUGH = 256  # points of a ring, evenly from all of it: their median is the ring's to a few thousandths of a degree
POINTS = 8_000  # of a scan are enough, where each is compared with each beam
SOME = 30_000  # of a scan tell what its rings are
# Degrees off their ring's median, the share of points that are, and how many times that of crowds: of rings by an order
# that begins elsewhere or is of beams that each look to another side it is 0.24 to 0.49, and of crowds at most 0.013.
# Of KITTI's scans and of streets it is that of crowds, or less, or below 0.001.
ASTRAY, MIXED, CLEARER = 0.1, 0.05, 10
# For scans without rings, the least `share_on_beams`. Of train scans and streets of seven sensors it is 0.98 and more,
# with a carrier's 10 m/s taken out mostly above 0.22; for 400 random sensors of nobody at most 0.17.
POINTWISE = 0.25
LAYERED = 0.02  # of the variance of directions, what rings explain: of a Livox 0.001, of spinning sensors 0.8 and more
ONE, ROUND, SPREAD = 0.006, 0.9, 0.05  # of unit vectors: how far off a ring's plane, that plane, how wide a ring is
ONE_RING = "points of one ring, as of a laser that looks along one plane (2-D): nothing tells of beams above and " \
           "below, so that no image of beams can be learned or completed"  # fmt: skip
LEARN = "lidarsynth sensor SCANS --out my.toml"
EVERYWHERE = "rings that each look everywhere, as of a sensor that does not spin (Livox), which no model here knows"


def recognise(
    scan: Scan, path: str | Path | None = None, among: Mapping[str, Sensor] | None = None
) -> tuple[str | None, str]:
    """The word (`get_sensor`) of the sensor that took the scan, or None, and the reason in words, one line.

    among  sensors by their names; None = SENSORS, and those of INVERTED, by their rings, where the ground is below

    Rings come from `scan.ring`, else from the order of the points (KITTI's files hold one ring after the other). A scan
    of at least nine tenths of a sensor's beams matches it beam by beam within half a degree; one of fewer beams must
    meet them ten times better than the spacing, so every fourth ring of an HDL-64E is an HDL-64E and no VLP-16. Without
    rings the points must lie on beams, or crowd on as many. `path` begins the reason. Of three to nine rings, the
    fewer the nearer these must be (`_nearness`).
    """
    where = "" if path is None else f"{path}: "
    if len(scan) < 100:
        return None, f"{where}expected at least 100 points to tell the sensor, found {len(scan)}: name it with --sensor"
    ring = scan.ring if scan.ring is not None else rings_in_order(scan.xyz)
    told, known = ring is not None and ring.min() < ring.max(), SENSORS if among is None else among
    name, reason = _by_rings(scan.xyz, ring, known) if told else _by_points(scan.xyz, known)  # type: ignore[arg-type]
    if name is None and told and scan.ring is None:  # the order may miscount them
        name, other = _by_points(scan.xyz, known)
        reason = reason if name is None else other
    if name is None and told and among is None and _ground_below(scan.xyz):
        name, other = _by_rings(scan.xyz, ring, INVERTED, whole=True)  # type: ignore[arg-type]
        reason = reason if name is None else other
    if name is None and on_one_ring(scan.xyz):
        reason = f"expected the beams of {', '.join(known)}, found {ONE_RING}"
    elif name is None:
        spins = scan.ring is None or layers(scan.xyz, scan.ring)
        beams = ring is not None or rings_by_elevation(scan.xyz) is not None
        way = ": name the sensor with --sensor" + (f", or learn it: {LEARN}" if beams else "")
        reason = f"expected the beams of {', '.join(known)}, found {reason + way if spins else EVERYWHERE}"
    return name, where + reason


def _ground_below(xyz: np.ndarray) -> bool:
    below, above = levels(xyz)
    return below.share > above.share


def lies_on(scan: Scan, sensor: Sensor) -> bool:
    """Whether a scan's points lie on a sensor's beams, as `recognise` would have it of a known one, or its rings on
    some of them, however few the sensor has."""
    if recognise(scan, among={sensor.name: sensor})[0] is not None:
        return True
    ring = scan.ring if scan.ring is not None else rings_in_order(scan.xyz)
    if ring is None or not len(ring):
        return False
    _, beams = beams_of(scan.xyz, ring)
    error = _off_beams(beams, sensor) if 2 < len(beams) <= sensor.height > 1 else None
    return error is not None and error < _nearness(len(beams))


def same_kind(name: str, other: str) -> bool:
    """Whether two names are of one kind of sensor: `hdl-64e-kitti` is an `hdl-64e`, whose beams are where they are, so
    is `hdl-64e-kitti/16`, some of its rows, and so are the words of GRIDS."""
    one, two = (word.partition("/")[0] for word in (name, other))
    return _unit(one) == _unit(two)


def _unit(name: str) -> str:
    return "hdl-64e" if name in GRIDS else name.removesuffix("-kitti")


def first_row(ring: np.ndarray, xyz: np.ndarray, sensor: Sensor) -> int | None:
    """What is to be added to ring numbers (N,) that count from the top, of points (N, 3), for the sensor's rows.

    0 where they go from 0 to its last beam. Else they may begin elsewhere, as some drivers' do at 1, or the first or
    last beams may have no point: so that at least eight rings lie on the beams of their rows. None where they do not.
    """
    if not len(ring):
        return None
    usual = 0 if ring.max() + 1 == sensor.height else None
    if usual == 0 and ring.min() == 0:
        return usual
    number, beams = beams_of(xyz, ring)
    if len(number) < min(RINGS, sensor.height) or np.ptp(number) >= sensor.height:
        return usual
    offsets, table = np.array(sensor.offsets or (0.0,) * sensor.height), np.array(sensor.elevations)
    off = {}
    for first in range(-int(number[0]), sensor.height - int(number[-1])):
        rows = number + first
        off[first] = np.median(np.abs(median_elevations(beams, offsets[rows]) - table[rows]) / spacing(sensor)[rows])
    best = min(off, key=off.__getitem__)
    return best if off[best] < ON_ROW else usual


def off_rows(ring: np.ndarray, xyz: np.ndarray, sensor: Sensor) -> bool:
    """Whether rings (N,) of points (N, 3), enough of them to tell, are neither rows of the sensor in their order nor on
    any of its beams."""
    number, beams = beams_of(xyz, ring)
    if len(number) < min(RINGS, sensor.height) or first_row(ring, xyz, sensor) is not None:
        return False
    whole, error = degrees_off(ring, xyz, sensor), _off_beams(beams, sensor)
    return (whole is None or whole >= UNIT) and (error is None or error > SUBSET)


def degrees_off(ring: np.ndarray, xyz: np.ndarray, sensor: Sensor) -> float | None:
    """By how much the median one of rings (N,) of points (N, 3) lies off its beam of the sensor, or of one of its kind,
    wherever within LIFTS its origin is; None for fewer than nine tenths of its beams, or more than all.

    Of train scans at most 0.2 degrees, of streets and buildings with the origin anywhere there 0.13; of fifteen sensors
    of as many beams that are named wrongly 0.55 and more, where none is recognised as the named one.
    """
    _, beams = beams_of(xyz, ring)
    beams = beams[np.argsort(-median_elevations(beams), kind="stable")]
    units = (other for name, other in SENSORS.items() if same_kind(name, sensor.name) and not other.edges)
    kind = [sensor, *units]  # of R2DM's grid, which is no unit's, KITTI's
    lifted = [beams + np.array([0, 0, lift], beams.dtype) for lift in LIFTS]
    errors = [_whole_error(seen, median_elevations(seen), one) for one in kind for seen in lifted]
    return min((error for error in errors if error is not None), default=None)


def elevations_of(xyz: np.ndarray) -> np.ndarray:
    """(..., 3) metres -> (...) degrees above the horizon."""
    return np.degrees(np.arctan2(xyz[..., 2], np.hypot(xyz[..., 0], xyz[..., 1])))


def layers(xyz: np.ndarray, ring: np.ndarray) -> bool:
    """Whether rings (N,) of points (N, 3), in axes of any kind, look elsewhere than others, as beams do. The lines of a
    sensor that does not spin, such as a Livox, each look everywhere; of a single ring nothing is said."""
    some = np.linspace(0, len(ring) - 1, min(len(ring), SOME)).astype(int)
    xyz, (_, ring, count) = xyz[some], np.unique(ring[some], return_inverse=True, return_counts=True)
    if len(count) < 2:
        return True
    way = xyz / np.maximum(np.linalg.norm(xyz, axis=1, keepdims=True), 1e-6)
    apart = [count @ (np.bincount(ring, v) / count - v.mean()) ** 2 / len(v) for v in way.T.astype(np.float64)]
    return bool((np.array(apart) >= LAYERED * way.var(axis=0, dtype=np.float64)).any())


def on_one_ring(xyz: np.ndarray) -> bool:
    """Whether points (N, 3) lie in one plane through the sensor, or on one cone about any axis: but for one in fifty
    within a third of a degree, as those of a laser of one beam do. Two beams of a sensor lie farther apart, and of
    points that all lie in one direction nothing is said."""
    depth = np.linalg.norm(xyz, axis=1)
    way = (xyz[depth > 0] / depth[depth > 0, None]).astype(np.float64)
    way = way[np.linspace(0, len(way) - 1, min(len(way), POINTS)).astype(int)]
    if len(way) < RINGS:
        return False
    for _ in range(2):  # the second time without those that are off
        middle = way.mean(axis=0)
        spread, axes = np.linalg.eigh(np.cov((way - middle).T, bias=True))
        off = np.abs((way - middle) @ axes[:, 0])
        wide = np.sqrt(spread.clip(0))
        way = way[off <= np.quantile(off, 0.98)]
    return bool(wide[0] < ONE and wide[2] > SPREAD and abs(middle @ axes[:, 0]) < ROUND)


def rings_in_order(xyz: np.ndarray) -> np.ndarray | None:
    """(N,) int ring of each point where the file holds ring after ring, the highest first, else None.

    Each ring is one turn, so the azimuth jumps by a turn once between two rings, always in the same direction. The
    turn may begin ahead (KITTI) or behind (our own images): the seam with fewer jumps is the right one. None, too, of a
    turn that begins elsewhere, or of beams that each look to another side, where elevations crowd and these rings mix
    them.
    """
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    best: np.ndarray | None = None
    for angle in (azimuth, np.where(azimuth < 0, azimuth + azimuth.dtype.type(2 * np.pi), azimuth)):
        step = np.diff(angle)
        up, down = step > np.pi, step < -np.pi
        jumps, others = (up, down) if up.sum() > down.sum() else (down, up)
        if 3 <= jumps.sum() < 256 and others.sum() <= 0.02 * jumps.sum():
            ring = _without_strays(np.concatenate([[0], np.cumsum(jumps)]))
            best = ring if best is None or ring[-1] < best[-1] else best
    return None if best is None or mixes_beams(xyz, best) else best


def mixes_beams(xyz: np.ndarray, ring: np.ndarray) -> bool:
    """Whether points (N, 3) beyond FAR crowd on beams of which rings (N,) each hold points of several."""
    part = slice(None, None, max(1, len(xyz) // POINTS))
    far = np.hypot(xyz[part, 0], xyz[part, 1]) > FAR
    points, ring = xyz[part][far], ring[part][far]
    if (crowd := rings_by_elevation(points)) is None:
        return False
    elevation = elevations_of(points)
    least = max(MIXED, CLEARER * _share_astray(elevation, crowd))
    return least < 1 and _share_astray(elevation, ring) > least


def _share_astray(elevation: np.ndarray, ring: np.ndarray) -> float:
    """The share of points, of degrees (N,), that are ASTRAY from the median of their ring (N,)."""
    order = np.lexsort((elevation, ring))
    _, first, own, count = np.unique(ring[order], return_index=True, return_inverse=True, return_counts=True)
    elevation = elevation[order]
    return float((np.abs(elevation - elevation[first + count // 2][own]) > ASTRAY).mean())


def _without_strays(ring: np.ndarray) -> np.ndarray:
    """Rings (N,) counted upwards, without a first or last one of a point or two that noise put beyond the seam."""
    count = np.bincount(ring)
    few = count < STRAY * np.median(count)
    return np.clip(ring, int(few[0]), len(count) - 1 - int(few[-1])) - int(few[0])


def _by_rings(
    xyz: np.ndarray, ring: np.ndarray, among: Mapping[str, Sensor], whole: bool = False
) -> tuple[str | None, str]:
    """`whole`: of at least nine tenths of the sensor's beams only."""
    _, beams = beams_of(xyz, ring)
    if len(beams) < 2:
        return None, f"{len(beams)} rings of at least 5 points"
    middle = median_elevations(beams)
    order = np.argsort(-middle, kind="stable")
    beams, middle = beams[order], middle[order]
    found = f"{len(beams)} rings from {middle[0]:+.1f} to {middle[-1]:+.1f} degrees"
    errors = {n: e for n, s in among.items() if (e := _whole_error(beams, middle, s)) is not None and e < UNIT}
    if errors:
        name = min(errors, key=lambda n: errors[n])
        return name, f"{found}, {errors[name]:.2f} from the {among[name].height} beams of {name}"
    errors = {} if whole else {name: _subset_error(beams, s) for name, s in among.items()}
    shares = {name: e for name, e in errors.items() if e is not None and e < _nearness(len(beams))}
    if shares:
        name = min(shares, key=lambda n: shares[n])
        return name, f"{found}, on {len(beams)} of the {among[name].height} beams of {name}"
    return None, found


def beams_of(xyz: np.ndarray, ring: np.ndarray, fewest: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (rings,) of the rings of at least `fewest` points, and points (rings, ENOUGH, 3) of each, evenly from
    those beyond FAR, where those are 5 at least."""
    if (ring[1:] < ring[:-1]).any():
        order = np.argsort(ring, kind="stable")
        xyz, ring = xyz[order], ring[order]
    far = np.hypot(xyz[:, 0], xyz[:, 1]) > FAR
    ends = np.append(np.flatnonzero(ring[1:] != ring[:-1]) + 1, len(ring))
    starts = np.append(0, ends[:-1])
    farther = np.append(0, np.cumsum(far))
    enough = (farther[ends] - farther[starts] >= 5)[:, None]  # else all: the lowest beams of a small robot's sensor
    first = np.where(enough, farther[starts][:, None], starts[:, None])
    last = np.where(enough, farther[ends][:, None], ends[:, None]) - 1
    rank = first + np.linspace(0, (last - first)[:, 0], ENOUGH, axis=1).astype(int)
    place = np.where(enough, np.flatnonzero(far)[np.minimum(rank, far.sum() - 1)] if far.any() else rank, rank)
    enough = ends - starts >= fewest
    return ring[starts[enough]], xyz[place[enough]]


def _far(points: np.ndarray) -> np.ndarray:
    """The points beyond FAR, or all where those are too few: the lowest beams of a small robot's sensor."""
    far = points[np.hypot(points[:, 0], points[:, 1]) > FAR]
    return far if len(far) >= 5 else points


def _whole_error(beams: np.ndarray, middle: np.ndarray, sensor: Sensor) -> float | None:
    """Median distance in degrees of the rings from the sensor's beams, taken in order; the sky may hide a few beams.

    middle  (rings,) their elevations from the sensor's origin, for beams that leave there
    """
    spare = sensor.height - len(beams)
    if not 0 <= spare <= 0.1 * sensor.height:
        return None
    offsets, table = np.array(sensor.offsets), np.array(sensor.elevations)
    places = [slice(first, first + len(beams)) for first in range(spare + 1)]
    seen = (median_elevations(beams, offsets[rows]) if sensor.offsets else middle for rows in places)
    return min(float(np.median(np.abs(e - table[rows]))) for e, rows in zip(seen, places, strict=True))


def _subset_error(beams: np.ndarray, sensor: Sensor) -> float | None:
    """Mean distance of the rings from the nearest beams, in units of the spacing there; None if two meet one beam."""
    return None if len(beams) >= 0.9 * sensor.height or sensor.height < 32 else _off_beams(beams, sensor)


def _nearness(rings: int) -> float:
    """The mean distance from beams, in units of their spacing, below which so many rings are a sensor's: SUBSET, or
    where rings that lie anywhere, each 0 to 1/2 off, would be nearer by LUCK, (2 n error)^n / n! (Irwin-Hall). Of two
    it is SUBSET: as near as that would ask for, hardly any sensor's own are."""
    few = min(rings, 10)  # of as many it is SUBSET already
    return SUBSET if rings < 3 else min(SUBSET, (LUCK * factorial(few)) ** (1 / few) / (2 * few))


def _off_beams(beams: np.ndarray, sensor: Sensor) -> float | None:
    """Of (rings, N, 3) points, as `_subset_error`, of any number of rings."""
    table, plain = np.array(sensor.elevations), median_elevations(beams)[:, None]
    near = np.argsort(np.abs(table - plain), axis=1)[:, :16]  # an offset of 0.2 m moves a near ring by a few beams
    seen = median_elevations(beams[:, None], np.array(sensor.offsets)[near]) if sensor.offsets else plain
    distance = np.abs(seen - table[near]) / spacing(sensor)[near]
    rows = near[np.arange(len(near)), distance.argmin(axis=1)]
    return float(np.minimum(distance.min(axis=1), 1.0).mean()) if len(set(rows)) == len(beams) else None


def median_elevations(points: np.ndarray, offset: np.ndarray | float = 0.0) -> np.ndarray:
    """(...) median elevations in degrees of rings (..., N, 3), seen from `offset` metres above the sensor's origin."""
    height = points[..., 2] - np.asarray(offset, points.dtype)[..., None]
    return np.median(np.degrees(np.arctan2(height, np.hypot(points[..., 0], points[..., 1]))), axis=-1)


def spacing(sensor: Sensor) -> np.ndarray:
    """(H,) degrees from each beam to its nearer neighbour."""
    gaps = -np.diff(np.array(sensor.elevations))
    return np.minimum(np.concatenate([gaps[:1], gaps]), np.concatenate([gaps, gaps[-1:]]))


def _by_points(xyz: np.ndarray, among: Mapping[str, Sensor]) -> tuple[str | None, str]:
    far = _far(xyz)
    elevation = elevations_of(far)
    few = far[np.random.default_rng(0).permutation(len(far))[:POINTS]]
    shares = {name: share_on_beams(few, sensor) for name, sensor in among.items()}
    name = max(shares, key=lambda n: shares[n])
    found = f"no rings, and points from {elevation.min():+.1f} to {elevation.max():+.1f} degrees"
    if shares[name] >= POINTWISE:
        return name, f"{found}, {shares[name]:.0%} of them on the beams of {name}"
    ring = rings_by_elevation(xyz)  # of a unit whose beams lie off the table's
    by_rings = None if ring is None else _by_rings(xyz, ring, among, whole=True)
    return by_rings if by_rings is not None and by_rings[0] is not None else (None, found)


def share_on_beams(points: np.ndarray, sensor: Sensor) -> float:
    """Share of points within a tenth of the spacing of a beam, less that of those in the fifth midway between beams,
    times the share of beams that have points: chance gives 0, and so do beams of which every second one is a sensor's.
    """
    offsets, table = np.array(sensor.offsets or (0.0,) * sensor.height), np.array(sensor.elevations)
    flat = np.hypot(points[:, 0], points[:, 1])[:, None]
    away = np.degrees(np.arctan2(points[:, 2:] - offsets, flat)) - table  # (N, H)
    row = np.abs(away).argmin(axis=1)
    off = np.abs(away[np.arange(len(row)), row]) / spacing(sensor)[row]
    used = np.bincount(row[off < 0.1], minlength=sensor.height) > 0
    return float(((off < 0.1).mean() - (off > 0.4).mean()) * used.mean())


def rings_by_elevation(xyz: np.ndarray) -> np.ndarray | None:
    """(N,) int ring of each point, 0 the highest, where elevations crowd around 8 to 256 beams, else None.

    For points in any order without a ring field. Beams are the crowded runs of a histogram of 0.02 degrees, cut where
    it is nearly empty; at least nine tenths of the points beyond FAR must lie in them.
    """
    elevation = elevations_of(xyz)
    far = np.hypot(xyz[:, 0], xyz[:, 1]) > FAR
    edges = np.arange(-90, 90.01, 0.02)
    count = np.histogram(elevation[far], edges)[0]
    if not count.any():  # none is far, or all are straight above or below
        return None
    smooth = np.convolve(count, np.ones(5) / 5, "same")
    crowded = smooth > max(0.15 * float(np.quantile(smooth[smooth > 0], 0.9)), 2)
    starts = np.flatnonzero(np.diff(np.concatenate([[0], crowded.astype(int)])) == 1)
    ends = np.flatnonzero(np.diff(np.concatenate([crowded.astype(int), [0]])) == -1)
    if not 8 <= len(starts) <= 256 or count[crowded].sum() < 0.9 * far.sum():
        return None
    middle = (edges[starts] + edges[ends + 1]) / 2
    border = (middle[1:] + middle[:-1]) / 2
    return len(middle) - 1 - np.searchsorted(border, elevation)
