"""Facades of a drawn grid: what stands is put on the fewest straight walls, seen from above, that are near enough."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lidarsynth.lidar.sensor import Sensor
from lidarsynth.systems.cascade.surfaces import GROUND, NEAR, upright

# Columns of a wall at most. A return that strays from its wall by the share STRAY of its nearness costs 1, one more
# wall costs WALL. Returns of a wall at least, and the share by which any of them may stray.
LONGEST, STRAY, WALL, LEAST, MOST = 40, 0.035, 16.0, 4, 0.12  # by docs/generation.md


def with_facades(metres: Tensor, rows: np.ndarray, sensor: Sensor) -> Tensor:
    """(B, R, C) metres of these rows around the turn, 0 for no return, with straight walls, upright as before."""
    elevation = metres.new_tensor(np.radians(np.asarray(sensor.elevations)[rows]))[None, :, None]
    cosine, height = elevation.cos().clamp_min(1e-3), elevation.tan()
    away = metres * cosine
    stands = _standing(away, height)
    near = torch.where(stands, 1 / away.clamp_min(0.05), 0).cpu().numpy().astype(np.float64)
    straight = torch.from_numpy(on_fewest_lines(near.reshape(-1, near.shape[-1])).reshape(near.shape)).to(metres)
    away = torch.where(stands, 1 / straight.clamp_min(1e-4), away)
    return upright(away, height) / cosine


def _standing(away: Tensor, height: Tensor) -> Tensor:
    """Of horizontal distances (B, R, C), 0 for no return: which are above or below one that is about as far."""
    ground = (height[:, 1:] / height[:, :-1]).clamp_min(1e-6).log().abs()  # between beams that both look down
    near = torch.where(height[:, :-1] < 0, (GROUND * ground).clamp(1e-6, NEAR), NEAR)
    log = away.clamp_min(1e-6).log()
    pair = (away[:, 1:] > 0) & (away[:, :-1] > 0) & ((log[:, 1:] - log[:, :-1]).abs() < 2 * near)
    none = torch.zeros_like(pair[:, :1])
    return torch.cat([pair, none], 1) | torch.cat([none, pair], 1)


def on_fewest_lines(near: np.ndarray) -> np.ndarray:
    """(N, C) nearness, 1 / horizontal distance, of N rings, 0 where nothing stands, on straight walls.

    Segmented least squares (Bellman 1961): of all ways to cut a ring into runs, that in which the squares by which
    returns stray from their run's line, and so much for each run, are least in sum. Runs of fewer than LEAST returns,
    or of which one strays too far, stay as they are; what stands where the turn's ends meet is of two runs.
    """
    count, width = near.shape
    cumulative, design = _sums(near)
    rings = np.arange(count)
    best, lengths = np.zeros((width + 1, count)), np.zeros((width + 1, count), int)
    for end in range(1, width + 1):
        run = np.arange(1, min(LONGEST, end) + 1)
        stray, _, there = _line(cumulative[:, :, end, None] - cumulative[:, :, end - run])
        cost = best[end - run].T + stray / STRAY**2 + WALL * (there > 0)
        chosen = cost.argmin(1)
        best[end], lengths[end] = cost[rings, chosen], run[chosen]
    straight, ends = near.copy(), np.full(count, width)
    while len(rings):
        first = ends - lengths[ends, rings]
        _, lines, there = _line(cumulative[:, rings, ends] - cumulative[:, rings, first])
        for k in np.flatnonzero(there >= LEAST):
            run = slice(first[k], ends[k])
            own, line = near[rings[k], run], lines[:, k] @ design[:, run]
            if (np.abs(line - own) <= MOST * own)[own > 0].all():
                straight[rings[k], run] = np.where(own > 0, line, 0)
        rings, ends = rings[first > 0], first[first > 0]
    return straight


def _sums(near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums (6, N, C + 1), up to each column, of what least squares of relative errors needs; cosine and sine (2, C)."""
    angle = 2 * np.pi / near.shape[1] * np.arange(near.shape[1])
    c, s = np.cos(angle), np.sin(angle)
    away = np.divide(1, near, out=np.zeros_like(near), where=near > 0)
    parts = np.stack([(c * away) ** 2, c * s * away**2, (s * away) ** 2, c * away, s * away, (near > 0).astype(float)])
    return np.concatenate([np.zeros((6, len(near), 1)), parts.cumsum(-1)], -1), np.stack([c, s])


def _line(sums: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of runs (6, ...): squares of the relative errors (...), the line (2, ...), how many returns there are (...)."""
    cc, cs, ss, c, s, there = sums
    size = cc * ss - cs**2
    known = (there > 2) & (size > 1e-9 * (cc + ss) ** 2)  # two returns are always on a line
    scale = np.divide(1, size, out=np.zeros_like(size), where=known)
    line = np.stack([(ss * c - cs * s) * scale, (cc * s - cs * c) * scale])
    stray = np.where(known, np.maximum(there - line[0] * c - line[1] * s, 0), 0)
    return stray, line, there
