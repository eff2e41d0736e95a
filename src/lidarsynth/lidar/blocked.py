"""Which rays of a sensor end on its carrier, or are none of its own: those that never return, wherever it goes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

SCANS = 5  # what never returned in fewer scans may have looked at the sky
RUN = 0.008  # of a turn: shorter runs are chance
ROW = 0.5  # of a row must have returned, within the view of the sensor around
CHANCE = 1e-3  # that what is not blocked never returned in so many places
# Degrees: rays that look higher may meet nothing wherever a street leads; of these only runs whose edges stand still
# are believed, where in this share of a turn beside them returns are at least half of what is usual for the row.
LEVEL, BESIDE, USUAL = -5.0, 0.002, 0.5
# Of rays that look lower: those are blocked that return in fewer scans than one in ten, and those beside them, within
# this share of a turn, that return half as often as is usual for the row at most, if others do within it.
RARELY, EDGE = 0.1, 0.006
SECTOR = 1 / 12  # of a turn: where no beam at all returned in as much, and some are blocked, the sensor does not look


def blocked_runs(
    seen: np.ndarray, elevations: np.ndarray, tilt: tuple[float, float] = (0.0, 0.0)
) -> tuple[tuple[int, int, int], ...]:
    """(row, first column, last column) of rays that never return, in rows that return elsewhere; a run may wrap.

    seen        (scans, H, W) bool, which rays returned in each scan
    elevations  (H,) degrees of the rows
    tilt        degrees of the sensor against the ground, which may raise a row by as much

    None where there are too few scans to tell, or all are of nearly one place. Of rays that look down those that hardly
    return are such, too, as where scans were moved to one moment. Rays that look up need the more of them,
    and sharp edges: above the end of a street there is always sky. A wide sector without any return, of which some rows
    are blocked, is none of the view of the others, either.
    """
    if len(seen) < SCANS:
        return ()
    returned, width = seen.mean(axis=0), seen.shape[2]
    view = np.asarray(seen.any(axis=(0, 1)))  # of a sensor that looks ahead only, columns behind it never return
    many, raised = places(seen[:, :, view]), float(np.hypot(*tilt))
    near = np.arange(1, max(round(BESIDE * width), 3) + 1)
    runs = []
    for row in np.flatnonzero((returned[:, view] > 0).mean(axis=1) > ROW):
        share = returned[row]
        usual = float(share[share > 0].mean())
        high = elevations[row] > LEVEL - raised
        if (1 - usual) ** many > CHANCE or (high and many < SCANS):
            continue
        empty = share == 0
        if not high and _chance(usual, many) < CHANCE:
            empty = _with_edges(share < RARELY, share < USUAL * usual, RUN * width, max(round(EDGE * width), 1))
        for first, last in _empty_runs(empty):
            beside = [share[(edge + steps) % width].mean() for edge, steps in ((first, -near), (last, near))]
            if (last - first) % width + 1 >= RUN * width and (not high or min(beside) >= USUAL * usual):
                runs.append((int(row), first, last))
    return tuple(sorted({*runs, *_unseen_sectors(view, len(elevations), runs)}))


def _chance(usual: float, many: float) -> float:
    """At most, that of `many` rays which usually return so often fewer than `RARELY` do, by Chernoff's bound."""
    usual = min(max(usual, RARELY), 1 - 1e-6)
    return float(np.exp(-many * (RARELY * np.log(RARELY / usual) + (1 - RARELY) * np.log((1 - RARELY) / (1 - usual)))))


def _with_edges(rare: np.ndarray, seldom: np.ndarray, least: float, reach: int) -> np.ndarray:
    """(W,) bool: runs of at least so many `rare` columns, with gaps of up to two `seldom` ones, and the seldom ones
    beside them where these are no more than `reach` on a side: a wider margin is none of an edge that stands still."""
    width, found = len(rare), np.zeros(len(rare), bool)
    beside = [np.roll(rare, step) for step in (1, 2, -1, -2)]
    closed = rare | seldom & (beside[0] & (beside[2] | beside[3]) | beside[1] & beside[2])
    runs = [run for run in _empty_runs(closed) if (run[1] - run[0]) % width + 1 >= least]
    for first, last in runs:
        left, right = (_until(~seldom, edge, way, reach) for edge, way in ((first, -1), (last, 1)))
        found[np.arange(first - left, first + (last - first) % width + 1 + right) % width] = True
    return found


def _until(usual: np.ndarray, edge: int, way: int, reach: int) -> int:
    """Columns beyond an edge, to the left (-1) or right (1), before the first that is `usual` (W,); 0 where that is
    farther than `reach`."""
    return int(usual[(edge + way * np.arange(1, reach + 2)) % len(usual)].argmax())  # 0 of none, too


def _unseen_sectors(view: np.ndarray, rows: int, runs: list[tuple[int, int, int]]) -> Iterator[tuple[int, int, int]]:
    """As `blocked_runs`, of the other rows, of which nothing is said there: sectors without any return, view (W,)."""
    width = len(view)
    for first, last in _empty_runs(~view):
        if (size := (last - first) % width + 1) < SECTOR * width:
            continue
        known = {row for row, start, end in runs if (first - start) % width + size <= (end - start) % width + 1}
        yield from ((row, first, last) for row in range(rows) if known and row not in known)


def _empty_runs(empty: np.ndarray) -> list[tuple[int, int]]:
    """First and last column of the runs of a row (W,) bool around a turn that is empty in parts."""
    if empty.all() or not empty.any():
        return []
    width, start = len(empty), int(np.flatnonzero(~empty)[0])
    edges = np.diff(np.concatenate([[0], np.roll(empty, -start).astype(int), [0]]))
    ends = zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1, strict=True)
    return [(int(first + start) % width, int(last + start) % width) for first, last in ends]


def places(seen: np.ndarray) -> float:
    """Of how many places scans tell, `seen` as in `blocked_runs`: about 1 of a sensor that stands, nearly as many as
    there are of one that was elsewhere each time. Each counts by what its lost rays do not share with those of the scan
    before, by their correlation within rows."""
    total, before = 1.0, None
    for mask in seen:
        now = mask - mask.mean(axis=1, keepdims=True, dtype=np.float32)
        if before is not None:
            alike = float((now * before).sum() / np.sqrt(max(float((now**2).sum() * (before**2).sum()), 1e-12)))
            total += min(1 - alike, 1.0)
        before = now
    return total
