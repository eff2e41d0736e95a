"""Mixed pixels: ranges between a surface and nothing, which a network puts where it cannot decide between the two."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from lidarsynth.lidar.scan import RangeImage

WINDOW = (5, 7)  # rows, columns
NEARER = 0.75  # of the middle range around it: what is nearer, beside an empty pixel, is mixed


def without_mixed_pixels(image: RangeImage) -> RangeImage:
    """The image with every mixed pixel put onto the surface beside it, at its window's median range.

    A pixel is mixed when the 5 x 7 window around it holds an empty pixel and its range is under three quarters of the
    window's median range. Columns are circular, rows end. Measured on held-out synthetic streets, every fourth beam
    known: range MAE 1.29 m; 1.35 m with mixed pixels left as they are, 1.41 m with them emptied.
    """
    ranges = _framed(np.where(image.mask, image.range, np.float32(np.nan)), np.nan)
    filled = _framed(image.mask, True)
    beside_empty = ~sliding_window_view(filled, WINDOW).all(axis=(2, 3))
    place = np.nonzero(image.mask & beside_empty)
    if not len(place[0]):
        return image
    middle = np.nanmedian(sliding_window_view(ranges, WINDOW)[place].reshape(len(place[0]), -1), axis=1)
    mended = image.range.copy()
    mended[place] = np.where(image.range[place] < NEARER * middle, middle, image.range[place])
    return replace(image, range=mended)


def _framed(values: np.ndarray, outside: float) -> np.ndarray:
    """(H, W) with half a window more on each side: `outside` above and below, the turn's other end left and right."""
    rows, columns = WINDOW[0] // 2, WINDOW[1] // 2
    border = np.full((rows, values.shape[1]), outside, values.dtype)
    tall = np.vstack([border, values, border])
    return np.hstack([tall[:, -columns:], tall, tall[:, :columns]])
