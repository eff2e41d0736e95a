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
SHOWN = 0.78  # of what is put onto streets, whole and in every second and fourth beam, so much is found
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


def as_streets(image: RangeImage, known: np.ndarray, own: bool = True) -> tuple[RangeImage, Unit]:
    """The image as the streets' lasers would read it, and the unit that read it; as it is if not `own`, where the
    sensor reports otherwise, or the model has learned from its scans."""
    unit = unit_of(image, known) if own else Unit()
    return unit.even(image), unit


def unit_of(image: RangeImage, known: np.ndarray) -> Unit:
    """By the known returns of an image, known (H, W) bool; none of any other sensor than `hdl-64e-kitti`.

    Where a laser and its known neighbours above and below meet one surface, it differs from their mean as it would on
    KITTI's unit, or does not: the share is that of least squares, beside what its dimness and its near dip do.
    """
    if image.sensor.name != hdl64e.NAME or image.shape[0] != len(hdl64e.RING_OFFSET) or not image.reflectance.any():
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
    dim = np.broadcast_to(hdl64e.unevenness(image.sensor), image.shape)
    parts = hdl64e.misread(image.range), dim, hdl64e.dip(image.range)
    should = np.stack([_off_neighbours(part[rows])[alike] for part in parts], 1).astype(np.float64)
    differs = _off_neighbours((image.reflectance + dim)[rows])[alike].clip(-MOST, MOST)
    share = np.linalg.solve(should.T @ should + 1e-3 * np.eye(3), should.T @ differs)[0] / SHOWN
    return Unit(float(np.clip(share, 0, 1)))


def _off_neighbours(part: np.ndarray) -> np.ndarray:
    """(R - 2, W) of (R, W): how much more each row has than the one above and below on average."""
    return part[1:-1] - (part[:-2] + part[2:]) / 2
