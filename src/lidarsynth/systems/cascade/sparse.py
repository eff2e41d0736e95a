"""Scans of which returns are missing here and there, as thinned ones and every k-th beam are: what is asked for before
their returns are named, since the networks of classes go by surfaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.streets.hdl64e import hidden
from lidarsynth.systems.filling import Filling
from lidarsynth.systems.scan_model import ScanModel

# Of the rays beside returns, the least share that return, too, of a scan that lacks none, and how far about a return
# rays are asked for: a share of the turn (docs/classes.md).
BESIDE, ABOUT = 0.8, 0.01


def filled_in(model: ScanModel, image: RangeImage) -> RangeImage:
    """The image with what is `missing` filled in by the model, as reflecting nothing where nothing does."""
    asked = missing(image, hidden(image.sensor))
    if not asked.any():
        return image
    whole = model.fill(replace(image, label=None), ~asked, model.resolved(Filling()))
    return whole if image.reflectance.any() else replace(whole, reflectance=np.zeros_like(whole.reflectance))


def named_as(image: RangeImage, answer: RangeImage) -> RangeImage:
    """The image with the classes of its own returns, of those of an answer."""
    assert answer.label is not None
    return replace(image, label=answer.label * image.mask)


def missing(image: RangeImage, blocked: np.ndarray) -> np.ndarray:
    """(H, W) bool: the rays that are to be filled in before an image is named; none of one of which few are missing.

    blocked  (H, W) bool: rays that never return
    """
    if not image.mask.any() or share_beside(image.mask, blocked) >= BESIDE:
        return np.zeros(image.shape, bool)
    return ~image.mask & ~blocked & _seen(np.asarray(image.mask.any(0)))


def share_beside(mask: np.ndarray, blocked: np.ndarray) -> float:
    """Of the rays above, below, left and right of returns, how many return; mask and blocked (H, W) bool."""
    met = count = 0
    for axis in (0, 1):
        for step in (1, -1):
            near, free = np.roll(mask, step, axis), ~np.roll(blocked, step, axis)
            here = mask & free
            if axis == 0:
                here[0 if step == 1 else -1] = False  # nothing is above the first row or below the last
            met, count = met + int((here & near).sum()), count + int(here.sum())
    return met / max(count, 1)


def _seen(columns: np.ndarray) -> np.ndarray:
    """(W,) bool: columns within ABOUT of some of these, around the turn."""
    reach = max(1, round(ABOUT * len(columns)))
    return np.any([np.roll(columns, step) for step in range(-reach, reach + 1)], axis=0)
