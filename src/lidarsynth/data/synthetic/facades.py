"""Doors, windows and plinths of house fronts, worked out where a beam meets the plain wall."""

from __future__ import annotations

import numpy as np

from lidarsynth.data.synthetic.materials import NUMBER

# Columns of a facade row: corner x, y; direction ux, uy of the wall; ground z; period, window share, sill, head,
# recess (m); seed of its doors; tint.
STOREY = 2.9  # metres


def shade(points: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a wall is made of at the points that beams met, and how far it lies behind the wall's plane.

    points (N, 3) world metres; rows (N, 12) the facade of each. Returns material (N,) uint8 and depth (N,) metres.
    """
    x, y, ux, uy, base, period, share, sill, head, recess, seed, _ = rows.T
    along = (points[:, 0] - x) * ux + (points[:, 1] - y) * uy
    up = points[:, 2] - base
    cell = np.floor(along / period)
    u = along / period - cell
    chance = np.mod((cell * 0.618034 + seed * 0.414214) * 1.7320508, 1.0)
    storey = np.mod(up, STOREY)
    framed = np.abs(u - 0.5) < share / 2
    window = framed & (storey > sill) & (storey < head) & (chance > 0.12)
    door = (np.abs(u - 0.5) * period < 0.6 + 0.9 * (chance > 0.78)) & (up < 2.3) & (chance > 0.62)
    material = np.full(len(points), NUMBER["plaster"], np.uint8)
    material[up < np.mod(seed, 7) * 0.15] = NUMBER["stone"]
    material[window] = NUMBER["window"]
    frame = window & ((np.abs(np.abs(u - 0.5) - share / 2) * period < 0.07) | (np.abs(u - 0.5) * period < 0.04))
    material[frame] = NUMBER["door"]
    material[door] = NUMBER["door"]
    return material, np.where(window | door, recess * np.where(frame, 0.7, 1.0), 0).astype(np.float32)
