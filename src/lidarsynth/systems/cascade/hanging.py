"""What hangs in the air of a generated grid, of which there is too much, taken away."""

from __future__ import annotations

import numpy as np
import torch

from lidarsynth.lidar.pieces import connected
from lidarsynth.networks.column_neighbours import Grid
from lidarsynth.networks.rays import decode_range, encode_range

# Natural logarithm of ranges of one thing, along a ring and from beam to beam, and of what is farther below one that
# hangs; cells of things that may be taken away, and how many of them are: streets have 21 a scan, drawn grids 30.
TOGETHER, CLEAR = (0.08, 0.12), 0.15
SIZES, TAKEN = (3, 128), 0.3


def landed(grid: Grid, rng: list[torch.Generator]) -> Grid:
    """A grid (B, R, C) around the turn, without three tenths of the things that hang before what is farther below them,
    each image's chosen by a generator of its own; in their place goes on what is to the left and right, or the farther.
    """
    images = []
    for code, shade, returned, one in zip(*grid, rng, strict=True):
        metres = (decode_range(code) * returned).cpu().numpy()
        there = _hanging(metres)
        things = np.unique(there[there > 0])
        taken = things[torch.rand(len(things), generator=one).numpy() < TAKEN]
        images.append(_without(np.isin(there, taken), metres, shade.cpu().numpy()))
    metres, shade = (torch.from_numpy(np.stack(part)).to(grid.code) for part in zip(*images, strict=True))
    return Grid(torch.where(metres > 0, encode_range(metres.clamp_min(0.1)), 0), shade, metres > 0)


def _hanging(metres: np.ndarray) -> np.ndarray:
    """(R, C) int: a number for each thing that hangs, 0 elsewhere; metres (R, C), 0 for no return."""
    returned, log = metres > 0, np.log(np.maximum(metres, 1e-3))
    cells = np.arange(metres.size).reshape(metres.shape)
    along = returned & np.roll(returned, -1, 1) & (np.abs(np.roll(log, -1, 1) - log) < TOGETHER[0])
    down = returned[:-1] & returned[1:] & (np.abs(log[1:] - log[:-1]) < TOGETHER[1])
    one = np.concatenate([cells[along], cells[:-1][down]])
    other = np.concatenate([np.roll(cells, -1, 1)[along], cells[1:][down]])
    thing = connected(one, other, metres.size)
    size = np.bincount(thing, minlength=metres.size)
    row = np.repeat(np.arange(len(metres)), metres.shape[1])
    lowest = np.zeros(metres.size, int)
    np.maximum.at(lowest, thing, row)
    clear = np.zeros_like(returned)
    clear[:-1] = returned[1:] & (log[1:] - log[:-1] > CLEAR)
    hangs = np.zeros(metres.size, bool)
    hangs[thing[returned.ravel() & clear.ravel() & (row == lowest[thing])]] = True
    hangs &= (size >= SIZES[0]) & (size <= SIZES[1])
    return np.where(returned & hangs[thing].reshape(metres.shape), 1 + thing.reshape(metres.shape), 0)


def _without(taken: np.ndarray, metres: np.ndarray, shade: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Metres and reflectance (R, C) where what is taken away (R, C) bool is as its neighbours on the ring are."""
    metres, shade, width = metres.copy(), shade.copy(), metres.shape[1]
    for row in np.flatnonzero(taken.any(1)):
        gone, left = np.flatnonzero(taken[row]), np.flatnonzero(~taken[row])
        if not len(left):
            continue
        a, b, share = beside(gone, left, width)
        near, far = metres[row, a], metres[row, b]
        both, plane = one_surface(near, far, share)
        metres[row, gone] = np.where(both, plane, np.maximum(near, far))
        shade[row, gone] = np.where(near > far, shade[row, a], shade[row, b])
    return metres, shade


def beside(gone: np.ndarray, left: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The next columns before and after those that are gone (N,) of all that are left, rising, around a turn of `width`
    columns, and how far each one is from the first to the second, 0 to 1."""
    after = np.searchsorted(left, gone)
    a, b = left[after - 1], left[after % len(left)]
    return a, b, ((gone - a) % width) / np.maximum((b - a) % width, 1)


def one_surface(near: np.ndarray, far: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether ranges (N,) on either side, 0 for none, are of one surface, and its range at `share` of the way."""
    both = (near > 0) & (far > 0) & (np.abs(np.log(np.maximum(far, 1e-3) / np.maximum(near, 1e-3))) < CLEAR)
    return both, 1 / ((1 - share) / np.maximum(near, 0.1) + share / np.maximum(far, 0.1))
