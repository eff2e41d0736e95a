"""What is particular to the lasers of KITTI's own HDL-64E, beside how dim each is: how a scan shows it.

Each of its lasers reads a little brighter or darker than the others, by how far away it looks (`hdl64e.misread`). The
streets have no such lasers, and so no network has learned them; nor has another unit of the same sensor.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.streets import hdl64e

ALIKE = 0.15  # natural logarithm of ranges that differ as on one surface
MOST = 0.15  # reflectance by which a laser reads otherwise than its neighbours; more is of what they meet
ENOUGH, PER_LASER = 500, 50  # pixels that tell; returns of a laser that counts
UNTOLD = 0.5  # share where nothing tells: streets lose little by it


class Unit(NamedTuple):
    """share, 0 to 1, of what each laser of KITTI's unit reads otherwise."""

    share: float = 0.0

    def even(self, image: RangeImage) -> RangeImage:
        """The image as the streets' lasers would read it; what reads 0 stays."""
        if not self.share:
            return image
        shade = image.reflectance - self._off(image)
        return replace(image, reflectance=np.where(image.reflectance > 0, shade.clip(0, 1), 0).astype(np.float32))

    def read(self, reflectance: np.ndarray, image: RangeImage) -> np.ndarray:
        """Reflectance (H, W) of the image's returns as this unit reads them."""
        return reflectance if not self.share else (reflectance + self._off(image)).clip(0, 1).astype(np.float32)

    def _off(self, image: RangeImage) -> np.ndarray:
        return np.float32(self.share) * hdl64e.misread(image.range)


def as_streets(image: RangeImage, known: np.ndarray, tuned: bool = False) -> tuple[RangeImage, Unit]:
    """The image as the streets' lasers would read it, and the unit that read it; as it is for a model that was `tuned`
    to scans of the sensor."""
    unit = Unit() if tuned else unit_of(image, known)
    return unit.even(image), unit


def unit_of(image: RangeImage, known: np.ndarray) -> Unit:
    """By the known returns of an image, known (H, W) bool; none of any other sensor than `hdl-64e-kitti`.

    Where a laser and its known neighbours above and below meet one surface, it differs from their mean as they say, or
    does not: the share is that of least squares.
    """
    if image.sensor.name != hdl64e.NAME or not image.reflectance.any():
        return Unit()
    lit = known & image.mask & (image.reflectance > 0)
    rows = np.flatnonzero(lit.sum(1) >= PER_LASER)
    if len(rows) < 3:
        return Unit(UNTOLD)
    seen, far = lit[rows], np.log(np.maximum(image.range[rows], 0.1))
    near = np.abs(np.diff(far, axis=0)) < ALIKE
    alike = seen[:-2] & seen[1:-1] & seen[2:] & near[:-1] & near[1:]
    if np.count_nonzero(alike) < ENOUGH:
        return Unit(UNTOLD)
    said = hdl64e.misread(image.range)[rows]
    shade = image.reflectance[rows] + hdl64e.unevenness(image.sensor)[rows]
    differs, should = (_off_neighbours(part)[alike].astype(np.float64) for part in (shade, said))
    share = (should * differs.clip(-MOST, MOST)).sum() / max((should**2).sum(), 1e-9)
    return Unit(float(np.clip(share, 0, 1)))


def _off_neighbours(part: np.ndarray) -> np.ndarray:
    """(R - 2, W) of (R, W): how much more each row has than the one above and below on average."""
    return part[1:-1] - (part[:-2] + part[2:]) / 2
