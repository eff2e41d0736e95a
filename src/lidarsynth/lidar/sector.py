"""Rays of a sensor that never return, as runs of columns; such of one that sees a sector of the turn alone."""

from __future__ import annotations

from typing import Any

import numpy as np

Runs = tuple[tuple[int, int, int], ...]  # (row, first column, last column), around the seam where first > last


def listed_runs(runs: Any, source: str) -> Runs:
    """Runs of a sensor's file. Raises ValueError, which begins with the source, for what is no list of three each."""
    listed = isinstance(runs, list | tuple) and all(isinstance(run, list | tuple) for run in runs)
    if not listed or not all(type(number) is int for run in runs for number in run):
        raise ValueError(
            f"{source}: expected blocked as a list of [row, first column, last column], found {runs!r:.60}"
        )
    return tuple(map(tuple, runs))


def runs_outside(view: Any, rows: int, width: int, source: str) -> Runs:
    """Runs of all rays of an image of rows x width that look outside a view, [right, left] in degrees from straight
    ahead, counted to the left: [-60, 60] looks ahead, [120, 240] behind.

    Raises ValueError, which begins with the source, for what is no such view, and for one between two columns.
    """
    numbers = isinstance(view, list | tuple) and all(type(angle) is not bool for angle in view)
    numbers = numbers and all(isinstance(angle, int | float) for angle in view)
    if not numbers or len(view) != 2 or not 0 < view[1] - view[0] <= 360 or not np.isfinite(view).all():
        raise ValueError(f"{source}: expected a view of two azimuths in degrees to the left, such as [-60, 60], found "
                         f"{view!r:.60}")  # fmt: skip
    azimuth = 180 - (np.arange(width) + 0.5) * (360 / width)
    inside = np.mod(azimuth - view[0], 360) <= view[1] - view[0]
    if not inside.any():
        raise ValueError(f"{source}: expected a view of at least one of {width} columns, found {view!r:.60}")
    if inside.all():
        return ()
    last = int(np.flatnonzero(inside & ~np.roll(inside, -1))[0])  # of the view's columns, from the left to the right
    first = int(np.flatnonzero(inside & ~np.roll(inside, 1))[0])
    return tuple((row, (last + 1) % width, (first - 1) % width) for row in range(rows))


def runs_of(rays: np.ndarray) -> Runs:
    """Runs of rays (H, W) bool, none of which goes around the seam."""
    edges = np.diff(np.pad(rays, ((0, 0), (1, 1))).astype(int), axis=1)
    first, last = np.argwhere(edges > 0), np.argwhere(edges < 0)
    return tuple((int(row), int(a), int(b) - 1) for (row, a), (_, b) in zip(first, last, strict=True))
