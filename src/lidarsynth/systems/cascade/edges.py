"""Edges between the columns of a drawn grid: which surface a ray between two drawn ones meets, and where.

Where both are of the same chance, the fill takes what is to the left, as far as it is: every edge then stood on the
same side of a drawn column, and what ended there ended level. Measured in docs/generation.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.networks.coarse_unet import COLUMNS

# Shares of the range: within which two are the same, two columns of a grid are of one surface whatever is beside it,
# and what is to one side of an edge goes on as it does from the next column to its own.
SAME, ONE, STRAIGHT = 1e-6, 0.03, 0.06


def with_edges(images: list[RangeImage], columns: np.ndarray, rng: list[torch.Generator]) -> list[RangeImage]:
    """`with_edges_at`, drawn with a generator for each image; as they are, where nothing was drawn between the columns
    of a layout."""
    if len(columns) <= COLUMNS:
        return images
    return [
        with_edges_at(image, columns, torch.rand(len(columns), generator=one).numpy())
        for image, one in zip(images, rng, strict=True)
    ]


def with_edges_at(image: RangeImage, columns: np.ndarray, places: np.ndarray) -> RangeImage:
    """An image (H, W) in metres, of which `columns` (C,), rising, were drawn, each pixel between these that is as far
    as one of the two next ones put on a surface.

    That is the plane of both where they are of one; else that of the one to the left up to an edge, which is at
    `places` (C,), as parts of the way from each column to the next around the turn, and that of the right one beyond.
    """
    width = image.shape[1]
    others = np.setdiff1d(np.arange(width), columns)
    if not len(others):
        return image
    after = np.searchsorted(columns, others)
    left, right = columns[after - 1], columns[after % len(columns)]
    before, behind = columns[after - 2], columns[(after + 1) % len(columns)]
    share = ((others - left) % width) / ((right - left) % width)
    metres = image.range * image.mask
    here, a, b = (metres[:, at] for at in (others, left, right))
    on_left = _going_on(a, metres[:, before], (others - left) % width / ((left - before) % width))
    on_right = _going_on(b, metres[:, behind], (right - others) % width / ((behind - right) % width))
    both = (a > 0) & (b > 0)
    plane = both & (np.abs(np.log(np.where(both, a, 1) / np.where(both, b, 1))) < ONE)
    beyond = np.where(both, share >= places[after - 1], b > 0)
    found = np.where(beyond, on_right, on_left)
    found = np.where(plane, 1 / ((1 - share) / np.maximum(a, 0.1) + share / np.maximum(b, 0.1)), found)
    copied = (here > 0) & (np.minimum(np.abs(here - a), np.abs(here - b)) <= SAME * here)
    within = (found >= image.sensor.min_range) & (found <= image.sensor.max_range)
    from_one = copied & within & ~plane
    source = np.tile(np.arange(width), (len(metres), 1))
    source[:, others] = np.where(from_one, np.where(beyond, right, left), others)
    metres[:, others] = np.where(copied & within, found, here)
    reflectance, label = (
        None if part is None else np.take_along_axis(part, source, 1) for part in (image.reflectance, image.label)
    )
    return replace(image, range=metres, reflectance=reflectance, label=label)


def _going_on(one: np.ndarray, next_one: np.ndarray, further: np.ndarray) -> np.ndarray:
    """Metres so much further on the line from what is next (H, N) to `one` (H, N), straight in 1 / range; as far as
    `one` where both are not of one surface."""
    both = (one > 0) & (next_one > 0)
    near, beside = (np.where(both, part, 1) for part in (one, next_one))
    line = 1 / np.maximum(1 / near + (1 / near - 1 / beside) * further, 1e-4)
    return np.where(both & (np.abs(np.log(near / beside)) < STRAIGHT), line, one)
