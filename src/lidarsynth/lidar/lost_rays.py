"""Rays of a scan that brought nothing back: where its rings have gaps, and of beams above all that it met."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsynth.lidar.columns import columns_sent
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import Sensor

GAP = 1.5  # columns, from which on a ray between two points is lost
UNSEEN = 360  # parts of a turn: those in which no ring has a point were not looked at, or not kept
MANY = 8  # points of a ring, without which it tells nothing of where rays were sent


class LostRays(NamedTuple):
    """M rays: row (M,) and azimuth (M,) radians; before, after (M,): the points of the scan to the right and left of
    them, in their ring, or, of beams of which none returned, in the highest that has any; share (M,) of the way from
    the former to the latter."""

    row: np.ndarray
    azimuth: np.ndarray
    before: np.ndarray
    after: np.ndarray
    share: np.ndarray


def lost_rays(scan: Scan, sensor: Sensor, row: np.ndarray) -> LostRays:
    """The rays that a scan of the sensor must have sent besides its points', by the steps of its turn; row (N,) of each
    point, -1 for none.

    None where no ring has a point within a degree, in rings of less than 8 points, of beams between others that have
    none, as in thinned scans, and of points that were kept at random.
    """
    azimuth = np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0]).astype(np.float64)
    count = np.bincount(row[row >= 0], minlength=sensor.height)
    at = np.flatnonzero((row >= 0) & (count[row] >= MANY))
    columns = columns_sent(scan, sensor, row) if len(at) else None
    if columns is None:
        none = np.zeros(0, np.int64)
        return LostRays(none, np.zeros(0), none, none, np.zeros(0))
    order = at[np.lexsort((azimuth[at], row[at]))]
    both = [_between(row[order], azimuth[order], columns), _above(row[order], azimuth[order], columns, count)]
    ring, along, before, after, share = (np.concatenate(parts) for parts in zip(*both, strict=True))
    seen = np.zeros(UNSEEN, bool)
    seen[_part(azimuth)] = True
    kept = seen[_part(along)]
    return LostRays(*(part[kept] for part in (ring, along, order[before], order[after], share)))


def _between(ring: np.ndarray, along: np.ndarray, columns: int) -> tuple[np.ndarray, ...]:
    """Rays between points of rings (N,) at azimuths (N,), ring by ring and counted to the left: as `LostRays`."""
    first = np.flatnonzero(np.diff(ring, prepend=-1))
    after = np.arange(1, len(ring) + 1)
    after[np.append(first[1:], len(ring)) - 1] = first
    gap, step = (along[after] - along) % (2 * np.pi), 2 * np.pi / columns
    missing = np.where(gap > GAP * step, np.round(gap / step).astype(int) - 1, 0)
    of = np.repeat(np.arange(len(ring)), missing)
    which = np.arange(len(of)) - np.repeat(np.cumsum(missing) - missing, missing)
    share = (which + 1) / (missing[of] + 1)
    return ring[of], _wrapped(along[of] + share * gap[of]), of, after[of], share


def _above(ring: np.ndarray, along: np.ndarray, columns: int, count: np.ndarray) -> tuple[np.ndarray, ...]:
    """Rays of the beams above the first of all rings, if the others between follow each other: as `LostRays`."""
    top = int(ring[0]) if (count[ring[0] : ring[-1] + 1] > 0).all() else 0
    there = _wrapped((np.arange(columns) + 0.5) * 2 * np.pi / columns)
    own = along[ring == ring[0]]
    after = np.searchsorted(own, there) % len(own)
    before = after - 1  # -1 is the last
    share = (there - own[before]) % (2 * np.pi) / np.maximum((own[after] - own[before]) % (2 * np.pi), 1e-9)
    parts = there, before % len(own), after, share.clip(0, 1)
    return np.repeat(np.arange(top), columns), *(np.tile(part, top) for part in parts)


def _wrapped(azimuth: np.ndarray) -> np.ndarray:
    return (azimuth + np.pi) % (2 * np.pi) - np.pi


def _part(azimuth: np.ndarray) -> np.ndarray:
    """(N,) which part of a turn azimuths (N,) are in."""
    return ((azimuth / np.pi + 1) * (UNSEEN / 2)).astype(int) % UNSEEN
