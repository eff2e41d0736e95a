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
from lidarsynth.systems.cascade.response import AS_STREETS, Response

ALIKE = 0.15  # natural logarithm of ranges that differ as on one surface
MOST = 0.15  # reflectance by which a laser reads otherwise than its neighbours; more is of what they meet
CELL = 4  # columns of a laser whose known returns are taken together, where they are of one surface
ENOUGH = 150  # cells that tell
SHOWN = 0.78  # of what is put onto streets, of all beams, every second and fourth, one point in ten, so much is found
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


def as_streets(
    image: RangeImage, known: np.ndarray, response: Response = AS_STREETS, tuned: bool = False
) -> tuple[RangeImage, Unit]:
    """The image (H, W), known (H, W) bool, as the streets' lasers would read it, and the unit that read it; as it is
    where the sensor reports otherwise, by its response, or the model was `tuned` to its scans."""
    unit = unit_of(image, known) if response == AS_STREETS and not tuned else Unit()
    return unit.even(image), unit


def unit_of(image: RangeImage, known: np.ndarray) -> Unit:
    """By the known returns of an image, known (H, W) bool; none of any other sensor than `hdl-64e-kitti`.

    Where a laser and its known neighbours above and below meet one surface, it differs from their mean as it would on
    KITTI's unit, or does not: the share is that of least squares, beside what its dimness and its near dip do.
    """
    if not hdl64e.is_kittis(image.sensor) or not image.reflectance.any():
        return Unit()
    lit = known & image.mask & (image.reflectance > 0)
    rows = np.flatnonzero(lit.any(1))
    lit = lit[rows]
    count = _cells(lit)
    logs, shade = np.log(np.maximum(image.range[rows], 0.1)), image.reflectance[rows]
    far, squares, shade = (_cells(part * lit) / np.maximum(count, 1) for part in (logs, logs**2, shade))
    sound, near = (count > 0) & (squares - far**2 < ALIKE**2), np.abs(np.diff(far, axis=0)) < ALIKE
    alike = sound[:-2] & sound[1:-1] & sound[2:] & near[:-1] & near[1:]
    if np.count_nonzero(alike) < ENOUGH:
        return Unit(UNTOLD)
    metres, dim = np.exp(far), np.broadcast_to(hdl64e.unevenness(image.sensor)[rows], far.shape)
    parts = hdl64e.misread(metres, rows), dim, hdl64e.dip(metres, rows)
    one, two, three = (1 / count[k : len(count) - 2 + k][alike] for k in range(3))
    surer = 1 / np.sqrt(two + (one + three) / 4)  # of cells of more returns
    should = np.stack([_off_neighbours(part)[alike] * surer for part in parts], 1).astype(np.float64)
    differs = _off_neighbours(shade + dim)[alike].clip(-MOST, MOST) * surer
    share = np.linalg.solve(should.T @ should + 1e-3 * np.eye(3), should.T @ differs)[0] / SHOWN
    return Unit(float(np.clip(share, 0, 1)))


def _cells(part: np.ndarray) -> np.ndarray:
    """(R, W // CELL) sums of (R, W) over the columns of each cell; what is left of a turn is left out."""
    width = part.shape[1] // CELL * CELL
    return part[:, :width].reshape(len(part), -1, CELL).sum(2, dtype=np.float32)


def _off_neighbours(part: np.ndarray) -> np.ndarray:
    """(R - 2, W) of (R, W): how much more each row has than the one above and below on average."""
    return part[1:-1] - (part[:-2] + part[2:]) / 2
