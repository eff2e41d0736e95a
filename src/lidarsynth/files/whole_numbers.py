"""Whole numbers of 64 bits in text, such as times in nanoseconds, of which float64 does not tell neighbours apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

EXACT = 2**53  # up to which float64 tells whole numbers apart


def exact(column: np.ndarray, words: Sequence[bytes] | Sequence[str]) -> np.ndarray:
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
