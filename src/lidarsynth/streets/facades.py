"""Doors, windows and plinths of house fronts, worked out where a beam meets the plain wall."""

from __future__ import annotations

import numpy as np

from lidarsynth.streets.materials import NUMBER

# Columns of a facade row: corner x, y; direction ux, uy of the wall; ground z; period, window share, sill, head,
# recess (m); seed of its doors; tint.
STOREY = 2.9  # metres
PANES = np.array([NUMBER[k] for k in (*("window",) * 4, *("room",) * 3, "void")], np.uint8)  # what windows are


def shade(points: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a wall is made of at the points that beams met, and how far it lies behind the wall's plane.

    points (N, 3) world metres; rows (N, 12) the facade of each. Returns material (N,) uint8 and depth (N,) metres.
    """
    x, y, ux, uy, base, period, share, sill, head, recess, seed, _ = rows.T
    along = (points[:, 0] - x) * ux + (points[:, 1] - y) * uy
    up = points[:, 2] - base
    cell = np.floor(along / period)
    u = along / period - cell
    chance = _fraction((cell * 0.618034 + seed * 0.414214) * 1.7320508)
    storey = _fraction(up / STOREY) * STOREY
    framed = np.abs(u - 0.5) < share / 2
    window = framed & (storey > sill) & (storey < head) & (chance > 0.12)
    door = (np.abs(u - 0.5) * period < 0.6 + 0.9 * (chance > 0.78)) & (up < 2.3) & (chance > 0.62)
    plinth = up < _fraction(seed / 7) * 1.05
    material = np.where(plinth, np.uint8(NUMBER["stone"]), np.uint8(NUMBER["plaster"]))
    glazed = np.flatnonzero(window)
    material[glazed] = PANES.take(np.floor(_fraction(chance.take(glazed) * 37.7) * len(PANES)).astype(int))
    frame = window & ((np.abs(np.abs(u - 0.5) - share / 2) * period < 0.07) | (np.abs(u - 0.5) * period < 0.04))
    material[frame] = NUMBER["door"]
    material[door] = NUMBER["door"]
    depth = _relief(along, up, u * period, plinth, seed)
    depth = np.where(window | door, recess * np.where(frame, 0.7, 1.0), depth)
    room = window & ~frame & (material == NUMBER["room"])
    return material, np.where(room, depth + 0.4 + 2.5 * _fraction(chance * 11.3), depth).astype(np.float32)


def _fraction(values: np.ndarray) -> np.ndarray:
    """What is left above the next lower whole number; several times faster than np.mod."""
    return values - np.floor(values)


def _relief(
    along: np.ndarray, up: np.ndarray, from_edge: np.ndarray, plinth: np.ndarray, seed: np.ndarray
) -> np.ndarray:
    """Metres behind the plane of plain wall: uneven plaster, bossed stone, pilasters, a plinth that stands out."""
    rough = 0.004 + 0.03 * _fraction(seed * 0.173) ** 3
    uneven = rough * (np.sin(along * 3.1 + seed) + np.sin(up * 7.3 + along * 1.7) + np.sin(along * 11.0 - up * 5.0))
    behind = uneven.astype(np.float64)
    bossed = np.flatnonzero(_fraction(seed / 5) < 0.1)
    behind[bossed] += 0.03 * (_fraction(up.take(bossed) / 0.45) < 0.13)
    behind[(_fraction(seed / 4) < 0.1) & (np.abs(from_edge) < 0.35)] -= 0.12  # pilasters
    return behind - 0.06 * plinth
