"""A sensor learned from its own scans: beams, their origins, columns, limits, mount, tilt, and what is blocked."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from lidarsynth.lidar.cones import Ring, fit_ring
from lidarsynth.lidar.frame import rings_of
from lidarsynth.lidar.ground import plane
from lidarsynth.lidar.motion import straighten
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import Sensor

NEAR, FEWEST = 3.0, 200  # metres; points of a ring that a fit needs
SAMPLE = 1500  # points of a ring and scan are enough
HALVED = 0.5  # of the residual: heights that explain less are bent rings of a moving car
CERTAIN = 0.01  # metres: a ring's height is believed where its error is smaller
BLOCKED_SCANS = 5  # what never returned in fewer scans may have looked at the sky
BLOCKED_RUN = 0.008  # of a turn: shorter runs are chance
BLOCKED_ROW = 0.5  # a row must return at least this often elsewhere


@dataclass(frozen=True)
class LearnedSensor:
    """A sensor and how well it is known.

    sensor    what to write to a file
    rings     the fit of each row
    returned  (H, W) share of the scans in which a pixel returned
    scans     how many scans it was learned from; `left` says why others were not used, in words
    missing   how many rings have too few points, and are no rows
    """

    sensor: Sensor
    rings: tuple[Ring, ...]
    returned: np.ndarray
    scans: int
    left: tuple[str, ...]
    missing: int = 0


def learn_sensor(scans: Iterable[Scan], name: str) -> LearnedSensor:
    """The sensor that took the scans: points with a ring field, or ring after ring in the file.

    Beams are fitted over all scans, z = tan(e) rho + h, with h = 0 unless heights halve the residual; a row's height is
    the neighbours' where its own points cannot tell it. Columns come from the azimuths' steps, mount and tilt from the
    ground (medians over the scans), blocked rays from what never returned in five scans or more. Raises ValueError
    without rings, or with too few points.
    """
    kept, left = _alike(scans)
    count = int(kept[0][1].max()) + 1
    points: list[list[np.ndarray]] = [[] for _ in range(count)]
    steps, depths, grounds = [], [], []
    for number, (scan, ring) in enumerate(kept):
        rng = np.random.default_rng(number)
        for row, xyz in _rows(straighten(scan.xyz, ring, scan.time), ring, count):
            points[row].append(rng.permutation(xyz)[:SAMPLE])
        steps.append(_step(scan.xyz, ring))
        depth = np.linalg.norm(scan.xyz, axis=1)
        depths.append((np.quantile(depth, 0.001), depth.max()))
        grounds += [found] if (found := plane(scan.xyz)) is not None else []
    rings, rows = _fit_rows(points)
    width = max(round(2 * np.pi / float(np.median(steps))), 4)
    returned = _returned(kept, width, rows)
    order = np.argsort([-ring.elevation for ring in rings])
    rings, returned = [rings[i] for i in order], returned[order]
    heights = tuple(round(ring.height, 3) for ring in rings)
    ground = np.median(grounds, axis=0) if grounds else np.array([1.73, 0.0, 0.0])
    sensor = Sensor(
        name=name,
        elevations=_falling([round(ring.elevation, 3) for ring in rings]),
        width=width,
        min_range=round(max(float(np.floor(min(d[0] for d in depths) * 10) / 10), 0.0), 1),
        max_range=float(np.ceil(max(d[1] for d in depths) / 5) * 5),
        offsets=heights if any(abs(height) > 0.005 for height in heights) else (),
        mount=round(float(ground[0]), 2),
        tilt=(round(float(ground[1]), 2), round(float(ground[2]), 2)),
        blocked=blocked_runs(returned, len(kept)),
    )
    return LearnedSensor(sensor, tuple(rings), returned, len(kept), tuple(left), count - len(rows))


def _alike(scans: Iterable[Scan]) -> tuple[list[tuple[Scan, np.ndarray]], list[str]]:
    """(scan, ring of each point) of the scans with the usual number of rings, and in words what was left out."""
    found: list[tuple[Scan, np.ndarray]] = []
    without = 0
    for scan in scans:
        ring = rings_of(scan)
        if ring is None:
            without += 1
        else:
            found.append((scan, ring))
    if not found:
        raise ValueError(
            "expected scans with a ring field, one ring after the other, or beams that elevations show, "
            f"found none in {without}"
        )
    counts = np.array([int(ring.max()) + 1 for _, ring in found])
    usual = int(np.bincount(counts).argmax())
    kept = [pair for pair, count in zip(found, counts, strict=True) if count == usual]
    left = [f"{without} without rings"] if without else []
    left += [f"{len(found) - len(kept)} with other than {usual} rings"] if len(kept) < len(found) else []
    return kept, left


def _rows(xyz: np.ndarray, ring: np.ndarray, count: int) -> Iterator[tuple[int, np.ndarray]]:
    """(row, its points beyond NEAR)."""
    far = np.hypot(xyz[:, 0], xyz[:, 1]) > NEAR
    order = np.argsort(ring[far], kind="stable")
    parts = np.split(xyz[far][order], np.cumsum(np.bincount(ring[far], minlength=count))[:-1])
    return enumerate(parts)


def _fit_rows(points: list[list[np.ndarray]]) -> tuple[list[Ring], list[int]]:
    """The fit of each row with points enough, and which rows those are."""
    pooled = [np.concatenate(parts) if parts else np.zeros((0, 3), np.float32) for parts in points]
    rows = [row for row, xyz in enumerate(pooled) if len(xyz) >= FEWEST]
    if len(rows) < 2:
        raise ValueError(f"expected rings of at least {FEWEST} points beyond {NEAR:g} m, found {len(rows)}")
    free, flat = ([fit_ring(pooled[row], height) for row in rows] for height in (None, 0.0))
    gain = np.median([fit.residual for fit in free]) / np.median([fit.residual for fit in flat])
    sure = np.array([fit.height_error < CERTAIN for fit in free])
    if gain > HALVED or not sure.any():
        return flat, rows
    heights = np.interp(
        np.arange(len(rows)), np.flatnonzero(sure), [f.height for f, s in zip(free, sure, strict=True) if s]
    )
    return [
        fit if known else fit_ring(pooled[row], float(height))
        for row, fit, known, height in zip(rows, free, sure, heights, strict=True)
    ], rows


def _falling(elevations: list[float]) -> tuple[float, ...]:
    """Elevations as they are, apart by at least a thousandth of a degree."""
    for row in range(1, len(elevations)):
        elevations[row] = round(min(elevations[row], elevations[row - 1] - 0.001), 3)
    return tuple(elevations)


def _step(xyz: np.ndarray, ring: np.ndarray) -> float:
    """Radians between neighbouring columns: the median step along the rings, steps over lost points left out."""
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    order = np.lexsort((azimuth, ring))
    step = np.diff(azimuth[order])[np.diff(ring[order]) == 0]
    usual = np.median(step[step > 1e-5])
    return float(np.mean(step[(step > 0.25 * usual) & (step < 1.5 * usual)]))


def _returned(kept: list[tuple[Scan, np.ndarray]], width: int, rows: list[int]) -> np.ndarray:
    """(rows, width) share of the scans in which a ray returned."""
    place = np.full(max(rows) + 1, -1)
    place[rows] = np.arange(len(rows))
    total = np.zeros((len(rows), width), np.int32)
    for scan, ring in kept:
        inside = (ring <= max(rows)) & (place[np.minimum(ring, max(rows))] >= 0)
        turn = (1 - np.arctan2(scan.xyz[inside, 1], scan.xyz[inside, 0]) / np.pi) / 2
        seen = np.zeros_like(total, bool)
        seen[place[ring[inside]], (turn * width).astype(int).clip(0, width - 1)] = True
        total += seen
    return total / len(kept)


def blocked_runs(returned: np.ndarray, scans: int) -> tuple[tuple[int, int, int], ...]:
    """(row, first column, last column) of rays that never returned, in rows that return elsewhere; a run may wrap.

    None where there are too few scans to tell.
    """
    if scans < BLOCKED_SCANS:
        return ()
    width = returned.shape[1]
    runs = []
    for row in np.flatnonzero((returned > 0).mean(axis=1) > BLOCKED_ROW):
        empty = returned[row] == 0
        if empty.all():
            continue
        start = int(np.flatnonzero(~empty)[0])
        turned = np.concatenate([[False], np.roll(empty, -start), [False]]).astype(int)
        first, last = np.flatnonzero(np.diff(turned) == 1), np.flatnonzero(np.diff(turned) == -1) - 1
        for a, b in zip(first, last, strict=True):
            if b - a + 1 >= BLOCKED_RUN * width:
                runs.append((int(row), int((a + start) % width), int((b + start) % width)))
    return tuple(runs)
