"""Whole numbers: of 64 bits in text, such as times in nanoseconds, where float64 does not tell neighbours apart, of the
types that headers declare, and those that a type does not hold."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

EXACT = 2**53  # up to which float64 tells whole numbers apart


def exact(column: np.ndarray, words: Iterable[bytes] | Iterable[str]) -> np.ndarray:
    """A column (N,) of float64 as int64 or uint64, where it is of whole numbers that float64 does not tell apart, and
    one of these types does; else as it is. `words` are its numbers as the file writes them."""
    if not (np.isfinite(column).all() and np.abs(column).max(initial=0) >= EXACT):
        return column
    try:
        whole = [int(word) for word in words]
    except ValueError:
        return column
    low, high = min(whole), max(whole)
    for kind in (np.int64, np.uint64):
        if np.iinfo(kind).min <= low and high <= np.iinfo(kind).max:
            return np.array(whole, kind)
    return column


def typed(column: np.ndarray, words: Sequence[bytes] | Sequence[str], dtype: np.dtype) -> np.ndarray:
    """A column (N,) of float64 in the whole type that the header declares, from which the scale of intensities is told;
    where it holds fractions, or numbers that this type does not, as `exact` has it, so that none is lost."""
    whole, limits = exact(column, words), np.iinfo(dtype)
    if whole.dtype.kind != "f":
        return whole.astype(dtype) if limits.min <= int(whole.min()) <= int(whole.max()) <= limits.max else whole
    low, high = max(limits.min, -EXACT), min(limits.max, EXACT)
    inside = (low <= column) & (column <= high) & (column == np.floor(column))
    return column.astype(dtype) if inside.all() else column


def stray(values: np.ndarray, most: int) -> np.generic | None:
    """The first of numbers (N,) that is no whole one from 0 to `most`, or None."""
    off = ~((values >= 0) & (values <= most))
    off |= values != np.floor(values) if values.dtype.kind == "f" else False
    return values[off][0] if off.any() else None
