"""The marks of a completed scan: which of its points were filled in, and how sure those are."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.scan import Scan

MARKS = ("new", "confidence")  # fields that may be ours; other programs mean other things by these words


def marks_of(scan: Scan) -> dict[str, np.ndarray]:
    """`new` (N,) uint8 and `confidence` (N,) of a scan, as far as they are ours: of 0 and 1, and, beside it, of chances
    of 0 to 1. Whatever else a file means by these words are no marks."""
    new, sure = (scan.extra.get(name) for name in MARKS)
    if new is None or new.dtype.kind not in "biuf" or not ((new == 0) | (new == 1)).all():
        return {}
    found = {"new": new.astype(np.uint8)}
    if sure is None or sure.dtype.kind not in "biuf" or not ((sure >= 0) & (sure <= 1)).all():
        return found
    return {**found, "confidence": sure}


def were_new(scan: Scan) -> np.ndarray:
    """(N,) uint8: 1 for points that the scan says were filled in, 0 for measured ones."""
    return marks_of(scan).get("new", np.zeros(len(scan), np.uint8))


def confidences(scan: Scan) -> np.ndarray:
    """(N,) float32 confidences of a scan's own points: 1 of a measured one, of one that was filled in what was said of
    it, or 0 where nothing was."""
    marks = marks_of(scan)
    return np.where(were_new(scan) > 0, marks.get("confidence", 0), 1).astype(np.float32)
