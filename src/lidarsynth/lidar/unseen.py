"""What a scan that is to be completed has not measured: points filled in before, and parts of the turn without any."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.measured import were_new
from lidarsynth.lidar.scan import Scan

WIDE = 45  # degrees: confidences were fitted on wider holes, too, but what stands there is anyone's guess


def caution(scan: Scan) -> str | None:
    """What must be said of the completion of a scan, in one line, or None."""
    if before := int(were_new(scan).sum()):
        return f"expected measured points, found {before} of {len(scan)} that were filled in before (new = 1): they " \
               "are taken as they are, and stay marked"  # fmt: skip
    if (wide := widest_gap(scan.xyz)) > WIDE:
        return f"expected points all around, found none in {wide} degrees of the turn: what is put there is a guess"
    return None


def widest_gap(xyz: np.ndarray) -> int:
    """Whole degrees of the widest arc of the turn, seen from above, in which no point (N, 3) stands; 360 of none."""
    seen = np.zeros(360, bool)
    seen[np.floor(np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0]))).astype(int) % 360] = True
    if not seen.any():
        return 360
    at = np.flatnonzero(seen)
    return int(np.diff(at, append=at[0] + 360).max()) - 1
