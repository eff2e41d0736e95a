"""Which pixels a fill is told of the crops that it learns from."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.corruption import every_beam, without_columns, without_rectangle
from lidarsynth.networks.coarse_unet import grid_rows

JOINED = 0.25  # of sparse patterns have holes besides
# Of what learns the most likely image: know some columns alone; of these, some beams alone, too; have two patterns,
# each in a part of its own.
ALONG, CROSSED, PARTED = 0.12, 0.35, 0.08


def every_column(shape: tuple[int, int], turn: int, rng: np.random.Generator) -> np.ndarray:
    """(H, W) bool, True = known: 128 columns of a turn of `turn`, or 256, as the coarse stage gives them."""
    step = max(1, round(turn / (128 if rng.random() < 0.85 else 256)))
    known = np.zeros(shape, bool)
    known[:, rng.integers(step) :: step] = True
    return known


def pattern(shape: tuple[int, int], turn: int, rng: np.random.Generator, sampled: bool) -> np.ndarray:
    """(H, W) bool, True = known, of a crop of a turn of `turn` columns.

    16 of the beams (what is `sampled`, most of the time), the coarse stage's grids, every k-th beam, any beams, points,
    `_holed`; at times two of these at once, since sparse scans have holes, too. What is not sampled, at times also some
    columns, and a pattern in one part and another elsewhere.
    """
    if not sampled and rng.random() < PARTED:
        return np.where(_part(shape, rng), *(pattern(shape, turn, rng, sampled) for _ in range(2)))
    height, kind = shape[0], rng.random()
    known = np.zeros(shape, bool)
    if not sampled and rng.random() < ALONG:
        known = _some_columns(shape, rng) & (every_k_th(shape, rng) if rng.random() < CROSSED else True)
    elif sampled and kind < 0.45:
        known[grid_rows(height, rng.random())] = True
    elif kind < (0.6 if sampled else 0.12):
        known = _gridded(shape, turn, rng)
    elif kind < 0.72:
        known = every_k_th(shape, rng)
    elif kind < 0.79:
        known[rng.random(height) < rng.uniform(1 / 8, 1 / 2)] = True
    elif kind < 0.9:
        known[:] = rng.random(shape) < 0.02 * 30 ** rng.random()
    else:
        known = _holed(shape, rng)
    if kind < 0.9 and rng.random() < JOINED:
        around = _holed(shape, rng)
        inside = sampled and rng.random() < 0.5  # as `repaint` draws it
        known = known & around | (_gridded(shape, turn, rng) & ~around & inside)
    if rng.random() < 0.08:
        known &= rng.random(shape) < rng.uniform(0.3, 1)
    return known


def every_k_th(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """(H, W) bool, True = known: every second to eighth beam."""
    step = int(rng.choice((2, 2, 3, 4, 4, 4, 6, 8)))
    return every_beam(shape, step, int(rng.integers(step)))


def _some_columns(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """(H, W) bool, True = known: every k-th column, as of a turn twice as fast; any columns; or all but some runs, as
    where packets are lost."""
    width, kind = shape[1], rng.random()
    known = np.ones(width, bool)
    if kind < 0.55:
        step = int(rng.choice((2, 2, 2, 3, 4, 4, 8)))
        known = (np.arange(width) + rng.integers(step)) % step == 0
    elif kind < 0.75:
        known = rng.random(width) < rng.uniform(0.2, 0.9)
    else:
        for _ in range(int(rng.integers(1, 13))):
            known[(int(rng.integers(width)) + np.arange(int(rng.integers(2, 25)))) % width] = False
    return np.tile(known, (shape[0], 1))


def _part(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """(H, W) bool: what is above some beam, or a sector."""
    height, width = shape
    if rng.random() < 0.5:
        return np.tile(np.arange(height)[:, None] < int(rng.integers(1, height)), (1, width))
    along = (np.arange(width) - rng.integers(width)) % width < int(rng.integers(1, width))
    return np.tile(along, (height, 1))


def _gridded(shape: tuple[int, int], turn: int, rng: np.random.Generator) -> np.ndarray:
    """(H, W) bool, True = known: 16 beams, at times 8, of 128 columns of a turn, at times 256."""
    height, width = shape
    count, step = (16 if rng.random() < 0.75 else 8), max(1, round(turn / (128 if rng.random() < 0.8 else 256)))
    rows, known = ((np.arange(count) + rng.random()) * height / count).astype(int), np.zeros(shape, bool)
    known[np.ix_(np.unique(rows), np.arange(rng.integers(step), width, step))] = True
    return known


def _holed(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """(H, W) bool, True = known: all but a sector, or up to three regions."""
    height, width = shape
    if rng.random() < 0.5:
        lost, shift = int(rng.integers(8, 3 * width // 4)), int(rng.integers(width))
        return without_columns(shape, range(shift, shift + lost))
    known = np.ones(shape, bool)
    for _ in range(int(rng.integers(1, 4))):
        tall, wide = int(rng.integers(2, height)), int(rng.integers(4, width // 3))
        top, left = int(rng.integers(height - tall + 1)), int(rng.integers(width - wide))
        known &= without_rectangle(shape, range(top, top + tall), range(left, left + wide))
    return known
