"""How sharp scans are, which neither FRD nor bird's eye views see: steps between neighbours, thickness of surfaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.stored import as_stored

BINS = 40
# Bins of log10: what is finer than a sensor's own noise falls into the first one.
STEPS = np.linspace(-3, 1, BINS + 1)  # of |ln r - ln r'|
THICKNESS = np.linspace(-2.3, 1, BINS + 1)  # of metres: 5 mm to 10 m
TOGETHER = 1.0  # metres between a point and its neighbours on the ring at most: one surface
ABOVE = 0.5  # metres above the flat ground under the sensor from where on a point counts as of a wall
KINDS = ("along", "down", "ground", "walls")


class Sharpness:
    """Histograms (40,) of range images that arrive in any number; `merge` adds what another process gathered.

    along, down    |ln r - ln r'| of neighbours that both returned, along a ring and from beam to beam
    ground, walls  metres from a point to the line through its two neighbours on the ring, both within 1 m of it, of
                   points below and above 0.5 m over the flat ground under the sensor
    """

    def __init__(self) -> None:
        self.counts = {kind: np.zeros(BINS, np.int64) for kind in KINDS}

    def update(self, image: RangeImage, mask: np.ndarray | None = None) -> None:
        """Take in an image (H, W); `mask` (H, W) bool leaves out pixels, None = all that returned.

        Ranges count as caches keep them: of a sensor that sees 200 m in steps of 4 mm, which make smooth ground as
        rough as that, on whichever side they are.
        """
        mask, image = image.mask if mask is None else mask, replace(image, range=as_stored(image))
        log = np.log(np.maximum(image.range, 1e-3))
        self.counts["along"] += _histogram((log[:, 1:] - log[:, :-1])[mask[:, 1:] & mask[:, :-1]], STEPS)
        self.counts["down"] += _histogram((log[1:] - log[:-1])[mask[1:] & mask[:-1]], STEPS)
        xyz = image.points().astype(np.float64)
        before, after = np.roll(xyz, 1, 1), np.roll(xyz, -1, 1)
        near = [np.linalg.norm(other - xyz, axis=-1) < TOGETHER for other in (before, after)]
        together = mask & np.roll(mask, 1, 1) & np.roll(mask, -1, 1) & near[0] & near[1]
        off = _off_line(xyz[together], before[together], after[together])
        low = xyz[together][:, 2] < ABOVE - image.sensor.mount
        for kind, chosen in (("ground", off[low]), ("walls", off[~low])):
            self.counts[kind] += _histogram(chosen, THICKNESS)

    def merge(self, other: Sharpness) -> None:
        """Take in all that `other` has seen; it stays as it is."""
        for kind, counts in other.counts.items():
            self.counts[kind] += counts


def _histogram(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(40,) counts of values (N,) by their size; what lies beyond the ends counts in the last bins."""
    low, high = 10 ** edges[0], 10 ** edges[-1]
    return np.histogram(np.log10(np.clip(np.abs(values), low * 1.001, high * 0.999)), bins=edges)[0]


def _off_line(xyz: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """(N,) metres from points (N, 3) to the lines through two others each."""
    along = after - before
    return np.linalg.norm(np.cross(along, xyz - before), axis=1) / np.maximum(np.linalg.norm(along, axis=1), 1e-6)
