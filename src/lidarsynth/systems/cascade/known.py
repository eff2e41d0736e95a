"""What a cascade is told of an image, and where a scan's own pixels stand in it."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from lidarsynth.lidar.ground import LEANING, SOME, stance
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.coarse_unet import COLUMNS, ROWS
from lidarsynth.networks.fill_unet import Known
from lidarsynth.networks.rays import Rays, rays_of
from lidarsynth.streets.hdl64e import dimness
from lidarsynth.streets.kittis_car import Outline, outlined

ANOTHER, STEP, LOWEST = 0.2, 0.05, 0.2  # share of a mount by which another is told; metres


def known_of(metres: np.ndarray, reflectance: np.ndarray, told: np.ndarray, lit: bool, size: tuple[int, int]) -> Known:
    """(B, H, W) arrays as padded tensors (B, 1, H', W'): rows below are known to be empty, columns go around."""
    extra, columns = size[0] - told.shape[1], np.arange(size[1]) % told.shape[2]

    def part(values: np.ndarray, below: float) -> Tensor:
        if size != told.shape[1:]:
            values = np.pad(values[:, :, columns], ((0, 0), (0, extra), (0, 0)), constant_values=below)
        return torch.from_numpy(np.ascontiguousarray(values))[:, None]

    returned = told & (metres > 0)
    ranges = part(np.where(returned, metres, 0).astype(np.float32), 0)
    shades = part(np.where(returned & lit, reflectance, 0).astype(np.float32), 0)
    return Known(ranges, shades, part(told, True), part(returned, False), part(returned & lit, False))


def standing(sensor: Sensor, image: RangeImage, known: np.ndarray) -> Sensor:
    """The sensor as high above the road, and as tilted, as the returns of an image, known (H, W) bool, tell it is, to 5
    cm and a degree; what they do not tell, or what is within a fifth and three and a half degrees, stays."""
    places = np.flatnonzero(known & image.mask)
    told = sensor.mount, *sensor.tilt
    found = stance(sensor.points(image.range, places[:: max(1, -(-len(places) // SOME))]), told)
    if found is None:
        return sensor
    height, tilt = max(found[0], LOWEST), np.array(found[1:])
    if abs(np.log(height / max(sensor.mount, LOWEST))) > np.log(1 + ANOTHER):
        sensor = replace(sensor, mount=round(height / STEP) * STEP)
    if np.abs(tilt - sensor.tilt).max() > LEANING:
        sensor = replace(sensor, tilt=tuple(tilt.round().tolist()))
    return sensor


@lru_cache(maxsize=2)  # every scan of a folder asks for the same
def rays_told(sensor: Sensor, car: Outline | None = None) -> Rays:
    """The rays of a sensor's padded image, with those that its carrier blocks, of KITTI's car as a scan shows it, and
    what is known of its beams."""
    return rays_of(sensor, outlined(sensor, car), dimness=dimness(sensor))


def unanswered(image: RangeImage, size: tuple[int, int]) -> Known:
    """(1, 1, H', W') what is known of a perfect image, padded to `size`: where surfaces are, and nothing else."""
    below, columns = size[0] - image.shape[0], np.arange(size[1]) % image.shape[1]
    metres = _tensor(np.pad(image.range[:, columns], ((0, below), (0, 0))))
    there = _tensor(np.pad(image.mask[:, columns], ((0, below), (0, 0))))
    nothing = torch.zeros_like(there)
    return Known(metres, torch.zeros_like(metres), nothing, there, nothing)


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values))[None, None]


def best_known(told: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each of 16 x 128 bands the row and the column with most known pixels, and which cells hold any: (16, 128).

    Of bands of the same height the same row of each, so that there is one between each two wherever there can be.
    """
    rows, columns = (
        np.linspace(0, size, count + 1).astype(int) for size, count in zip(told.shape, (ROWS, COLUMNS), strict=True)
    )
    row = np.array([a + told[a:b].sum(1).argmax() for a, b in pairwise(rows)])
    if len(told) % ROWS == 0:
        row = rows[:-1] + told.sum(1).reshape(ROWS, -1).sum(0).argmax()
    column = np.array([a + told[:, a:b].sum(0).argmax() for a, b in pairwise(columns)])
    cell = np.add.reduceat(np.add.reduceat(told.astype(int), rows[:-1], 0), columns[:-1], 1) > 0
    return row, column, cell


def band_of(places: np.ndarray, size: int, count: int) -> np.ndarray:
    """Which of `count` bands of rows or columns 0 .. size - 1, as `best_known` has them, each of the places is in."""
    return np.searchsorted(np.linspace(0, size, count + 1).astype(int), places, side="right") - 1


def widened(cell: np.ndarray) -> np.ndarray:
    """(16, 128) bool: cells and their eight neighbours, around the turn."""
    tall = np.pad(cell, ((1, 1), (0, 0)))
    tall = tall[:-2] | tall[1:-1] | tall[2:]
    return tall | np.roll(tall, 1, 1) | np.roll(tall, -1, 1)
