"""Silent beams: a few of which nothing is known, as of a laser that is dead, among beams of which nearly all is.

Recorded scans lack returns where nothing came back, and the fill has learned that what lacks among known pixels came
not back. A beam that is silent all around the turn says no such thing: told fewer of the others, as of a sparse scan,
the fill knows. Chosen on training scans and synthetic streets (docs/completion.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from lidarsynth.lidar.scan import RangeImage

# Known beams for each silent one, at least; silent ones side by side, at most; share of the rays of the beams beside
# them that returned, at least; and of the others each so many-th is told, from the one beside them on.
FEW, BESIDE, RETURNED, EVERY = 3, 3, 0.1, 3


def silent_rows(told: np.ndarray, returned: np.ndarray, closed: np.ndarray) -> np.ndarray:
    """(H,) bool: silent beams of an image; none where they are more than a few.

    told, returned, closed  (H, W) bool: rays of which something is known, those that returned, and those that are
                            blocked
    """
    free = told & ~closed
    back, open_rays = (free & returned).sum(1), (~closed).sum(1)
    enough, silent = back >= np.maximum(RETURNED * open_rays, 1), np.zeros(len(told), bool)
    known = np.flatnonzero(free.any(1))
    for above, below in pairwise(known):
        if below - above <= BESIDE + 1 and enough[above] and enough[below]:
            silent[above + 1 : below] = open_rays[above + 1 : below] > 0
    return silent if FEW * silent.sum() <= len(known) else np.zeros_like(silent)


def told_of_silent(silent: np.ndarray) -> np.ndarray:
    """(H,) bool: which beams tell of the silent ones (H,) bool: those beside them, and from there on each third."""
    rows = np.arange(len(silent))
    away = np.abs(rows[:, None] - np.flatnonzero(silent)).min(1)
    return away % EVERY == 1


def with_silent(
    fill: Callable[[np.ndarray], list[RangeImage]], told: np.ndarray, returned: np.ndarray, closed: np.ndarray
) -> list[RangeImage]:
    """What `fill` makes of images of which `told` (B, H, W) bool is known, in all the same beams, its silent beams as
    it makes them of fewer; returned (B, H, W), closed (H, W) as `silent_rows` has them, in the first image."""
    images, silent = fill(told), silent_rows(told[0], returned[0], closed)
    if not silent.any():
        return images
    return [_with_rows(*both, silent[:, None])
            for both in zip(images, fill(told & (told_of_silent(silent)[:, None] | closed)), strict=True)]  # fmt: skip


def _with_rows(image: RangeImage, other: RangeImage, rows: np.ndarray) -> RangeImage:
    """The image (H, W) with what the other has in `rows` (H, 1) bool."""
    parts = {}
    for name in ("range", "reflectance", "mask", "label", "confidence"):
        one, two = getattr(image, name), getattr(other, name)
        parts[name] = None if one is None or two is None else np.where(rows, two, one)
    return replace(image, **parts)
