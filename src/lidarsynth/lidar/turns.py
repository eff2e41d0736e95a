"""Whether a scan holds more than one turn of its sensor."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.recognition import beams_of, median_elevations, rings_in_order
from lidarsynth.lidar.scan import Scan

ONE = 1.3  # turns: begin and end of a single one overlap by up to a tenth
RINGS, POINTS = 8, 100  # are looked at, and a ring of fewer points tells nothing
MANY = 1024  # rings; others count no beams
ENOUGH = 30_000  # points of a scan tell its order
STEADY = 0.8  # of all its steps a ring goes at least this much one way; a random order goes nowhere
AGAIN = 0.4  # of the points of a turn: second returns, behind all first ones, are fewer
PARTS, TOGETHER = 512, 0.9  # of a scan without rings, and how much the directions of one agree
SAME, MOST = 0.05, 8  # of the view that a ring may seem to lie elsewhere a turn later; turns that are looked for


def several_turns(scan: Scan) -> str | None:
    """In one line that a scan holds more than one turn, or None.

    Rings with a field go round more than once in the order of their times, or of the file; in a file of ring after ring
    each elevation comes again; in one without rings the whole goes round. Points that are there twice, as of two equal
    returns, count once. Two sensors in one scan have rings of their own, and are no two turns.
    """
    turns = _turns(scan)
    if turns > ONE:
        whole = np.ascontiguousarray(scan.xyz).view(np.dtype((np.void, 3 * scan.xyz.itemsize)))[:, 0]
        turns = _turns(scan[np.sort(np.unique(whole, return_index=True)[1])])
    if turns <= ONE:
        return None
    return (
        f"expected one turn, found about {turns:.1f} in one scan: what moved meanwhile stands there twice; give each "
        "turn as a scan of its own"
    )


def _turns(scan: Scan) -> float:
    if len(scan) < POINTS:
        return 1.0
    if scan.ring is not None:
        return _of_rings(scan, scan.ring)
    xyz = scan.xyz[:: max(len(scan) // ENOUGH, 1)]
    ring = rings_in_order(xyz)
    return _in_order(scan) if ring is None else _stacked(xyz, ring)


def _of_rings(scan: Scan, ring: np.ndarray) -> float:
    """The median over the fullest rings of the turns that each goes round."""
    if ring.min() < 0 or ring.max() >= MANY:
        return 1.0
    count = np.bincount(ring)
    fullest = np.argsort(-count, kind="stable")[:RINGS]
    found = []
    for number in fullest[count[fullest] >= POINTS]:
        at = np.flatnonzero(ring == number)
        at = at if scan.time is None else at[np.argsort(scan.time[at], kind="stable")]
        found.append(_round(np.arctan2(scan.xyz[at, 1], scan.xyz[at, 0])))
    return float(np.median(found)) if found else 1.0


def _round(azimuth: np.ndarray) -> float:
    """How many turns azimuths (N,) in radians go round one way; 1 of those that go no way, or return thinly."""
    step = np.mod(np.diff(azimuth) + np.pi, 2 * np.pi) - np.pi
    way = np.abs(np.cumsum(step))
    turns = float(way[-1] / (2 * np.pi))
    if turns <= ONE or way[-1] < STEADY * np.abs(step).sum():
        return 1.0
    first = np.count_nonzero(way < 2 * np.pi)
    return turns if len(way) - first >= AGAIN * first * (turns - 1) else 1.0


def _stacked(xyz: np.ndarray, ring: np.ndarray) -> float:
    """How often the elevations of rings, one after the other in the file, come again with enough points."""
    used, beams = beams_of(xyz, ring)
    elevation, count = median_elevations(beams), np.bincount(ring)[used]
    for turns in range(MOST, 1, -1):
        size = len(used) // turns
        if size < 4:
            continue
        first = np.resize(elevation[:size], size * (turns - 1))
        again = count[size : turns * size].reshape(turns - 1, size).sum(axis=1) >= AGAIN * count[:size].sum()
        if again.all() and np.abs(elevation[size : turns * size] - first).mean() < SAME * np.ptp(elevation):
            return float(turns)
    return 1.0


def _in_order(scan: Scan) -> float:
    """Of points without rings, by times or in the order of the file, where each part looks one way up and down."""
    order = slice(None) if scan.time is None else np.argsort(scan.time, kind="stable")
    x, y, z = scan.xyz[order].T
    rho = np.maximum(np.hypot(x, y), 1e-6)
    edges = np.linspace(0, len(rho), min(PARTS, len(rho) // 8) + 1).astype(int)[:-1]
    size = np.diff(np.append(edges, len(rho)))
    east, north, up, up2 = (np.add.reduceat(v, edges) / size for v in (x / rho, y / rho, z / rho, (z / rho) ** 2))
    spread = float(np.median(np.sqrt(np.maximum(up2 - up**2, 0))))
    if np.median(np.hypot(east, north)) < TOGETHER or spread < 0.5 * float(np.std(z / rho)):
        return 1.0  # ring after ring, or at random
    return _round(np.arctan2(north, east))
