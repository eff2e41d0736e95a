"""A sensor learned from its own scans: beams, their origins, columns, limits, mount, tilt, and what is blocked."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from lidarsynth.lidar.blocked import blocked_runs
from lidarsynth.lidar.columns import step_and_whether
from lidarsynth.lidar.cones import Ring, fit_ring
from lidarsynth.lidar.ground import LOWEST, is_above, lowest_plane, share_below
from lidarsynth.lidar.motion import straighten
from lidarsynth.lidar.origin import FEWEST_RINGS, rings_of
from lidarsynth.lidar.projection import columns_one_by_one
from lidarsynth.lidar.recognition import (
    EVERYWHERE,
    ONE_RING,
    elevations_of,
    layers,
    on_one_ring,
    recognise,
    rings_in_order,
)
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.lidar.turns import several_turns

NEAR, FEWEST = 3.0, 200  # metres; points of a ring that a fit needs
THIN, SEEN = 5, 0.5  # points of a ring that is a row all the same; metres, where so few are beyond NEAR
SAME, CLOSEST = 0.1, 0.02  # of the usual spacing: rings of one beam; degrees: no sensor's beams are closer
SMEARED = 0.1  # degrees: known sensors' points lie within 0.03 of their beams where nothing has moved them
SAMPLE = 1500  # points of a ring and scan are enough
HALVED = 0.5  # of the residual: heights that explain less are bent rings of a moving car
CERTAIN = 0.01  # metres: a ring's height is believed where its error is smaller
OTHER = 0.5  # degrees: rings of two scans of one sensor are closer, as `recognition.UNIT`
SPLIT = 0.2  # of the scans: so many that have other rings than the others are no chance
ASTRAY = 1.5  # of the step to the next beam
UNDER = 0.015  # of what the lowest beams met, below the ground: then its height is another
ALIKE = 0.2  # metres: half of the scans must see the ground as near to the usual height, for that to be the mount


@dataclass(frozen=True)
class LearnedSensor:
    """A sensor and how well it is known.

    sensor    what to write to a file
    rings     the fit of each row
    returned  (H, W) share of the scans in which a pixel returned
    scans     how many scans it was learned from; `left` says why others were not used, in words
    missing   how many rings have hardly any points, and are no rows
    thin      how many have too few points for a fit: these tell their beams roughly
    merged    how many rings were of another's beam, and are one row with it
    turns     what is to be said of a scan of more than one turn, or None
    afloat    why mount and tilt are not learned but a sensor's default, in words, or None
    split     what is to be said of scans of several sensors, or of beams that many of them lack, or None
    uneven    whether points of half of the scans or more are no whole columns apart: thinned at random, or noisy
    beyond    share of points above or below all beams, where nothing but elevations tells these
    unused    how many of the missing have no point at all, such as ring 0 where rings count from 1
    """

    sensor: Sensor
    rings: tuple[Ring, ...]
    returned: np.ndarray
    scans: int
    left: tuple[str, ...]
    missing: int = 0
    thin: int = 0
    merged: int = 0
    turns: str | None = None
    afloat: str | None = None
    split: str | None = None
    uneven: bool = False
    unused: int = 0
    beyond: float = 0.0


def learn_sensor(scans: Iterable[Scan], name: str) -> LearnedSensor:
    """The sensor that took the scans: points with a ring field, or ring after ring in the file.

    Beams are fitted over all scans, z = tan(e) rho + h, with h = 0 unless heights halve the residual; a row's height is
    the neighbours' where its own points cannot tell it. Rings of one beam are one row. Scans half of whose rings are
    OTHER degrees or more off are another sensor's, and left out. Columns come from the azimuths' steps, mount and tilt
    from the ground (medians over the scans, if half of them are ALIKE), blocked rays from what hardly returned in five
    scans or more, of several places. Raises ValueError without rings, with too few points, or where most beams are
    wider than SMEARED, or where most of what elevations crowd into are none.
    """
    kept, left, split = _alike(scans)
    guessed = _guessed(kept[0][0])
    points, rings, row_of = _fitted(kept, guessed)
    on = [_on(rings, row_of, *pair) for pair in kept]
    if any(on) and (others := on.count(False)):
        split = split or (f"expected scans of one sensor, found {others} of {len(kept)} with rings {OTHER} degrees or "
                          "more off those of most, which are left out")  # fmt: skip
        left.append(f"{others} of other beams")
        kept = [pair for pair, is_on in zip(kept, on, strict=True) if is_on]
        points, rings, row_of = _fitted(kept, guessed)
    steps, depths, grounds, below, above = [], [], [], [], 0
    for scan, ring in kept:
        inner = _inner(ring) if guessed else slice(None)
        steps.append(step_and_whether(scan.xyz[inner], ring[inner]))
        depth = np.linalg.norm(scan.xyz, axis=1)
        depths.append((depth.min(), depth.max()))
        if (found := lowest_plane(scan.xyz)) is not None:
            grounds.append(found)
            below.append(share_below(scan.xyz, *found))
        above += is_above(scan.xyz)
    thin, missing = sum(ring.points < FEWEST for ring in rings), int((row_of < 0).sum())
    merged, used = points - missing - len(rings), set().union(*(np.unique(ring).tolist() for _, ring in kept))
    _check_sharp(rings, merged, kept[0][0], guessed)
    if guessed:
        _check_guessed(rings, merged, missing)
    kept = [(scan, row_of[ring]) for scan, ring in kept]
    width = max(round(2 * np.pi / float(np.median([step for step, _ in steps]))), 4)
    seen = _seen(kept, width, len(rings))
    order = np.argsort([-ring.elevation for ring in rings])
    rings, seen = [rings[i] for i in order], seen[:, order]
    heights = tuple(round(ring.height, 3) for ring in rings)
    mount, tilt, afloat = _standing(grounds, above, len(kept), float(np.median(below or [0.0])))
    elevations = _falling([round(ring.elevation, 3) for ring in rings])
    sensor = Sensor(
        name=name,
        elevations=elevations,
        width=width,
        min_range=min(round(max(float(np.floor(min(d[0] for d in depths) * 10) / 10), 0.0), 1), Sensor.min_range),
        max_range=float(np.ceil(max(d[1] for d in depths) / 5) * 5),
        offsets=heights if any(abs(height) > 0.005 for height in heights) else (),
        mount=mount,
        tilt=tilt,
        blocked=blocked_runs(seen, np.array(elevations), tilt),
    )
    turns = next((text for scan, _ in kept if (text := several_turns(scan)) is not None), None)
    told = seen.mean(axis=0), len(kept), tuple(left), missing, thin, merged
    uneven = 2 * sum(not steady for _, steady in steps) >= len(steps)
    return LearnedSensor(sensor, tuple(rings), *told, turns, afloat, split, uneven, points - len(used),
                         _beyond([scan for scan, _ in kept], sensor.elevations) if guessed else 0.0)  # fmt: skip


def _standing(
    grounds: list[tuple[float, float, float]], above: int, scans: int, below: float = 0.0
) -> tuple[float, tuple[float, float], str | None]:
    """Mount and tilt from (height, pitch, roll) of those scans that show the ground, or a sensor's default and why.
    `above`: how many show it only when they are turned over; `below`: the usual `share_below` of the others."""
    if 2 * above >= scans:
        why = f"expected z up, found the ground above in {above} of {scans} scans, as of a sensor that hangs upside " \
              "down (--transform 0:0:0:180:0:0 turns them)"  # fmt: skip
        return Sensor.mount, Sensor.tilt, why
    if 2 * len(grounds) < scans:
        why = f"expected scans that show the ground around, found {len(grounds)} of {scans}"
        return Sensor.mount, Sensor.tilt, why
    height, pitch, roll = np.median(grounds, axis=0).tolist()
    heights = np.array(grounds)[:, 0]
    if np.median(np.abs(heights - height)) > ALIKE:
        low, high = np.quantile(heights, [0.1, 0.9])
        why = f"expected the ground as far below in most scans, found it {low:.2f} to {high:.2f} m below"
        return Sensor.mount, Sensor.tilt, why
    if 0 <= height < LOWEST:
        why = f"expected the ground {LOWEST} m below or more, found it {height:.2f} m below, as of few beams that do " \
              "not meet it"  # fmt: skip
        return Sensor.mount, Sensor.tilt, why
    if height < 0:
        why = f"expected the sensor above the ground, found it {-height:.2f} m below, as of points in another frame"
        return Sensor.mount, Sensor.tilt, why
    if below > UNDER:
        why = f"expected nothing below the ground, found {below:.0%} of what the lowest beams met below what looks " \
              "like it, as of beams that meet it too far off"  # fmt: skip
        return Sensor.mount, Sensor.tilt, why
    return round(height, 2), (round(pitch, 2), round(roll, 2)), None


def _guessed(scan: Scan) -> bool:
    """Whether nothing but elevations tells the scan's rings."""
    return scan.ring is None and rings_in_order(scan.xyz) is None


def _inner(ring: np.ndarray) -> np.ndarray | slice:
    """The points on rings (N,) other than the first and last, to which guessed ones have whatever lies beyond: steps
    from one beam's points to another's are no columns. All, where most lie on those two."""
    inner = (ring > 0) & (ring < ring.max())
    return inner if 2 * inner.sum() > len(ring) else slice(None)


def _beyond(scans: list[Scan], elevations: tuple[float, ...]) -> float:
    """The share of the points that lie ASTRAY steps or more beyond the first or last beam: beams of which nothing is
    far enough to crowd."""
    above, below = (abs(elevations[a] - elevations[b]) * ASTRAY for a, b in ((0, 1), (-1, -2)))
    seen = np.concatenate([elevations_of(scan.xyz) for scan in scans])
    return float(((seen > elevations[0] + above) | (seen < elevations[-1] - below)).mean())


def _named(known: str) -> str:
    return f"it is a scan of {known}: --sensor {known}"


def _check_guessed(rings: list[Ring], merged: int, missing: int) -> None:
    """Raises ValueError where most of what elevations crowd into are no beams: wide, in pieces, of too few points."""
    wide, count = sum(ring.residual > SMEARED for ring in rings), len(rings) + merged + missing
    if 2 * (wide + merged + missing) <= count:
        return
    raise ValueError(f"expected elevations that show beams, found {count} crowds, {wide} wider than {SMEARED} degrees, "
                     f"{merged} in pieces and {missing} of fewer than {FEWEST} points, as of a sensor that does not "
                     "spin (Livox), which no model here knows, or in another frame: give scans with rings, as the "
                     "sensor sent them")  # fmt: skip


def _check_sharp(rings: list[Ring], merged: int, scan: Scan, guessed: bool) -> None:
    """Raises ValueError where most beams are wide, and where those of a known sensor were guessed and some are, or are
    in pieces."""
    fits = [ring for ring in rings if ring.points >= FEWEST]
    wide = sum(ring.residual > SMEARED for ring in fits)
    most = 2 * wide > len(fits)
    if not most and not (guessed and (merged or wide)):
        return
    if (known := recognise(scan)[0]) is None and not most:
        return
    way = _named(known) if known else "give scans with rings, in the sensor's frame (lidarsynth info SCAN tells it)"
    pieces = f" and {merged} in pieces" if guessed and merged else ""
    raise ValueError(f"expected points within {SMEARED} degrees of their beams, found {wide} of {len(fits)} beams "
                     f"wider{pieces}: {way}")  # fmt: skip


def _alike(scans: Iterable[Scan]) -> tuple[list[tuple[Scan, np.ndarray]], list[str], str | None]:
    """(scan, ring of each point) of the scans with the usual number of rings, in words what was left out, and what is
    to be said where that is much."""
    found: list[tuple[Scan, np.ndarray]] = []
    without: list[Scan] = []
    for scan in scans:
        ring = None if scan.ring is not None and not layers(scan.xyz, scan.ring) else rings_of(scan)
        if ring is None:
            without.append(scan)
        else:
            found.append((scan, ring))
    if not found:
        if without and all(on_one_ring(scan.xyz) for scan in without):
            raise ValueError(f"expected scans of several beams, found {ONE_RING}")
        known = "" if not without or (name := recognise(without[0])[0]) is None else f": {_named(name)}"
        if without and (ring := without[0].ring) is not None:
            if layers(without[0].xyz, ring) and (count := len(np.unique(ring))) < FEWEST_RINGS:
                raise ValueError(f"expected {FEWEST_RINGS} rings or more to learn from, found {count} in the ring "
                                 "field: leave out one that tells nothing; of a sensor of so few beams write elevations"
                                 " and width into a .toml")  # fmt: skip
            raise ValueError(f"expected rings that are beams, found {EVERYWHERE}")
        raise ValueError(
            "expected scans with a ring field, one ring after the other, or beams that elevations show, "
            f"found none in {len(without)}{known}"
        )
    counts = np.array([int(ring.max()) + 1 for _, ring in found])
    usual = int(np.bincount(counts).argmax())
    kept = [pair for pair, count in zip(found, counts, strict=True) if count == usual]
    left = [f"{len(without)} without rings"] if without else []
    left += [f"{len(found) - len(kept)} with other than {usual} rings"] if len(kept) < len(found) else []
    if len(found) - len(kept) < SPLIT * len(found):
        return kept, left, None
    others = ", ".join(map(str, np.unique(counts[counts != usual]).tolist()[:6]))
    told = f"found {usual} in {len(kept)} of {len(found)}, and {others} in the others, which are left out"
    split = f"expected as many rings in every scan, {told}: are they of two sensors, or do beams see only the sky in " \
            "some? give scans of one sensor that show all of its beams"  # fmt: skip
    return kept, left, split


def _fitted(kept: list[tuple[Scan, np.ndarray]], guessed: bool) -> tuple[int, list[Ring], np.ndarray]:
    """How many rings the scans have, the fits of their rows, and the row of each."""
    points = _pooled(kept)
    return len(points), *_fit_rows(points, FEWEST if guessed else THIN)


def _on(rings: list[Ring], row_of: np.ndarray, scan: Scan, ring: np.ndarray) -> bool:
    """Whether half of a scan's rings lie less than OTHER degrees off their rows, as those of the same sensor do."""
    off = []
    for number, xyz in _rows(scan.xyz, ring, len(row_of)):
        if len(xyz) >= THIN and row_of[number] >= 0:
            fit, rho = rings[row_of[number]], np.hypot(xyz[:, 0], xyz[:, 1])
            seen = np.degrees(np.arctan2(xyz[:, 2] - fit.height, rho))
            off.append(abs(float(np.median(seen)) - fit.elevation))
    return not off or float(np.median(off)) < OTHER


def _pooled(kept: list[tuple[Scan, np.ndarray]]) -> list[np.ndarray]:
    """(N, 3) points of each ring, of all scans, at most SAMPLE of each."""
    count = int(kept[0][1].max()) + 1
    points: list[list[np.ndarray]] = [[] for _ in range(count)]
    for number, (scan, ring) in enumerate(kept):
        rng = np.random.default_rng(number)
        for row, xyz in _rows(straighten(scan.xyz, ring, scan.time), ring, count):
            points[row].append(rng.permutation(xyz)[:SAMPLE])
    return [np.concatenate(parts) for parts in points]


def _rows(xyz: np.ndarray, ring: np.ndarray, count: int) -> Iterator[tuple[int, np.ndarray]]:
    """(row, its points beyond NEAR, or beyond SEEN where those are fewer than THIN)."""
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    lacking = np.bincount(ring[rho > NEAR], minlength=count) < THIN
    far = rho > np.where(lacking[ring], SEEN, NEAR)
    order = np.argsort(ring[far], kind="stable")
    parts = np.split(xyz[far][order], np.cumsum(np.bincount(ring[far], minlength=count))[:-1])
    return enumerate(parts)


def _fit_rows(points: list[np.ndarray], least: int = THIN) -> tuple[list[Ring], np.ndarray]:
    """The fit of each row, and the row of each ring: -1 of those of fewer than `least` points, one of several on one
    beam."""
    size = np.array([len(xyz) for xyz in points])
    rows = np.flatnonzero(size >= FEWEST)
    if len(rows) < 2:
        raise ValueError(f"expected rings of at least {FEWEST} points beyond {NEAR:g} m, found {len(rows)}")
    fits = _fits([points[row] for row in rows])
    group = _of_one_beam(fits)
    if group.max() + 1 < len(rows):  # some rings are of one beam
        fits = _fits([np.concatenate([points[row] for row in rows[group == own]]) for own in range(group.max() + 1)])
    row_of = np.full(len(points), -1)
    row_of[rows] = group
    few = np.flatnonzero((size >= least) & (size < FEWEST))
    row_of[few] = len(fits) + np.arange(len(few))
    return fits + _roughly([points[row] for row in few], few, rows, [fits[own] for own in group]), row_of


def _roughly(points: list[np.ndarray], few: np.ndarray, rows: np.ndarray, fits: list[Ring]) -> list[Ring]:
    """The beams of rings `few` of few points, at the heights of their neighbours `rows`, and between these."""
    elevations, heights = ([getattr(fit, key) for fit in fits] for key in ("elevation", "height"))
    falling = (np.diff(elevations) < 0).all()
    found = []
    for row, xyz in zip(few, points, strict=True):
        fit, after = fit_ring(xyz, float(np.interp(row, rows, heights))), int(np.searchsorted(rows, row))
        inside = falling and 0 < after < len(rows)
        if inside and not elevations[after] < fit.elevation < elevations[after - 1]:  # stray points
            fit = replace(fit, elevation=float(np.interp(row, rows, elevations)))
        found.append(fit)
    return found


def _of_one_beam(fits: list[Ring]) -> np.ndarray:
    """(R,) int: rings of one beam are of one number, as those of two turns in one file; numbers rise with the rings."""
    elevations = np.array([fit.elevation for fit in fits])
    order = np.argsort(-elevations, kind="stable")
    gaps = -np.diff(elevations[order])
    apart = gaps[gaps > CLOSEST]
    usual = float(np.median(apart)) if len(apart) else CLOSEST
    group = np.zeros(len(fits), int)
    group[order[1:]] = np.cumsum(gaps > SAME * usual)
    _, first, same = np.unique(group, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[same]


def _fits(points: list[np.ndarray]) -> list[Ring]:
    """The fit of each row's points."""
    free, flat = ([fit_ring(xyz, height) for xyz in points] for height in (None, 0.0))
    gain = np.median([fit.residual for fit in free]) / np.median([fit.residual for fit in flat])
    sure = np.array([fit.height_error < CERTAIN for fit in free])
    if gain > HALVED or not sure.any():
        return flat
    heights = np.interp(
        np.arange(len(points)), np.flatnonzero(sure), [f.height for f, s in zip(free, sure, strict=True) if s]
    )
    return [
        fit if known else fit_ring(xyz, float(height))
        for xyz, fit, known, height in zip(points, free, sure, heights, strict=True)
    ]


def _falling(elevations: list[float]) -> tuple[float, ...]:
    """Elevations as they are, apart by at least a thousandth of a degree."""
    for row in range(1, len(elevations)):
        elevations[row] = round(min(elevations[row], elevations[row - 1] - 0.001), 3)
    return tuple(elevations)


def _seen(kept: list[tuple[Scan, np.ndarray]], width: int, rows: int) -> np.ndarray:
    """(scans, rows, width) bool: which rays returned in each scan; points of row -1 are of none."""
    seen = np.zeros((len(kept), rows, width), bool)
    for one, (scan, row) in zip(seen, kept, strict=True):
        inside = row >= 0
        one[row[inside], columns_one_by_one(scan.xyz[inside], row[inside], width)] = True
    return seen
