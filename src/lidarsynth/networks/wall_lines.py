"""Walls go on straight, turn by right angles and stand parallel: what a ring has seen of them so far, from above.

A wall is upright, so 1 / horizontal distance along a ring is `a cos + b sin` of the azimuth, however far it goes. Two
pixels tell its direction only roughly, and who goes on from the last two walks in a circle; up to twelve tell it well.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from lidarsynth.networks.coarse_unet import COLUMNS
from lidarsynth.networks.rays import decode_range

STEP = 2 * math.pi / COLUMNS  # radians between columns
WINDOWS = (12, 8, 5, 3)  # columns of a line, the longest first that they are on
STRAY = 0.04  # share of its nearness by which a return of a line strays from it, at most
HIDING = 0.08  # by which what hides a line is nearer
REACH = 24  # columns that a line is remembered
LONG, STRAIGHT, AXES = 0.6, 0.015, 2.0  # lines that tell how walls stand; for how many of them the sensor's axes count
LEVEL = 0.12  # share of flat ground's nearness, from which a line is none of the ground
GRAZING = 0.1  # cosine between a ray and a wall's normal, at least


class Line(NamedTuple):
    """Of pixels (...): nearness a, 1 / metres, at the next column, and b, a quarter of a turn before it; whether there
    is a line; through how many columns, as a share of the most; and by which share of its nearness they stray."""

    a: Tensor
    b: Tensor
    there: Tensor
    length: Tensor
    stray: Tensor


class Walls(NamedTuple):
    """What is known of walls at pixels (...) before these are seen."""

    nearness: Tensor  # (..., 4): on the line of the last columns; on that which these hide; on a wall through the last
    # one that stands as most do, and on one at a right angle; 0 where there is none
    character: (
        Tensor  # (..., 5): of the line, how long, straight, askew it is, and as others stand; how much these agree
    )


class WallMemory:
    """What grids' rings have seen of walls, column by column: `walls = memory.next()`, then `memory.see(nearness)`.

    rays  (B, 8, H, 128) of the grids, as `grid_rays` says, whose columns may go around either way
    """

    def __init__(self, rays: Tensor):
        azimuth = torch.atan2(rays[:, 4, 0], rays[:, 5, 0])
        way = torch.sin(azimuth[:, 1] - azimuth[:, 0]).sign()
        self._angles = (way[:, None] * azimuth).unbind(1)  # rise from column to column
        self._last = rays.new_zeros(len(rays), rays.shape[2], WINDOWS[0])  # nearness, the latest first
        self._hidden, self._age = none(self._last[..., 0]), torch.zeros_like(self._last[..., 0])
        self._sums = torch.tensor([AXES, 0.0, AXES]).to(rays).repeat(len(rays), 1)  # cos, sin of 4 angles, and how many
        cosine = (rays[:, 0] / 3).cos().clamp_min(0.02)
        self._ground = (1 / (decode_range(rays[:, 1] / 2).clamp_min(0.1) * cosine)).unbind(2)  # nearness of flat ground
        self._column = 0

    def next(self) -> Walls:
        """What is known of the next column (B, H)."""
        own, angle = through(self._last), self._angles[self._column][:, None]
        if self._column:
            self._hidden, self._age = behind(self._hidden, self._age, self._last[..., 0], own)
        fourfold = 4 * (angle - torch.atan2(own.b, own.a))
        stands = (own.a / self._ground[self._column] - 1).abs() > LEVEL
        tells = (stands & own.there & (own.length > LONG) & (own.stray < STRAIGHT)).to(angle)
        both = torch.stack([fourfold.cos(), fourfold.sin(), torch.ones_like(fourfold)], -1)
        self._sums = self._sums + (tells[..., None] * both).sum(1)
        cosine, sine, count = self._sums.unbind(1)
        most, agreed = (torch.atan2(sine, cosine) / 4)[:, None], (torch.hypot(cosine, sine) / count)[:, None]
        left = self._last[..., :1]
        normal = torch.stack([most, most + math.pi / 2], -1)
        before, here = (angle[..., None] - STEP - normal).cos(), (angle[..., None] - normal).cos()
        ratio = torch.where(before.abs() > GRAZING, here / before, 0).clamp(0, 4)
        near = torch.cat([torch.stack([own.a * own.there, self._hidden.a * self._hidden.there], -1), left * ratio], -1)
        straight = 1 - torch.asinh(300 * own.stray) / 3
        alike = (fourfold - 4 * most).cos() * own.there
        character = [own.length, straight * own.there, torch.tanh(own.b / own.a.clamp_min(1e-4)), alike]
        return Walls(near, torch.stack([*character, agreed.expand_as(alike)], -1))

    def see(self, near: Tensor) -> None:
        """The column's nearness (B, H), 0 where nothing returned."""
        self._last = torch.cat([near[..., None], self._last[..., :-1]], -1)
        self._column += 1


@torch.no_grad()
def walls(near: Tensor, rays: Tensor) -> Walls:
    """What is known of walls at each pixel of grids, nearness (B, H, 128), before it is seen."""
    memory, columns = WallMemory(rays), []
    for column in near.unbind(-1):
        columns.append(memory.next())
        memory.see(column)
    return Walls(*(torch.stack(part, 2) for part in zip(*columns, strict=True)))


def behind(line: Line, age: Tensor, last: Tensor, own: Line) -> tuple[Line, Tensor]:
    """What is remembered after a column whose nearness is `last` (...), 0 where nothing returned: the line of before,
    where the column hides it or nothing returned, else that of its own, `own`; and how long it has been hidden.

    line  of before, at this column
    """
    hidden = (last <= 0) | (last > (1 + HIDING) * line.a)
    on_it = ((last - line.a).abs() <= STRAY * line.a) & ~own.there
    kept = line.there & (hidden | on_it) & (age < REACH)
    c, s = math.cos(STEP), math.sin(STEP)
    onward = line._replace(a=line.a * c - line.b * s, b=line.a * s + line.b * c)
    chosen = Line(*(torch.where(kept, a, b) for a, b in zip(onward, own, strict=True)))
    return chosen, torch.where(kept & hidden, age + 1, 0)


def through(near: Tensor) -> Line:
    """The line through the last of 12 columns (..., 12), the latest first, nearness 0 where nothing returned."""
    best = none(near[..., 0])
    for window in WINDOWS:
        part = near[..., :window]
        fit, line = fitted(part)
        stray = ((line - part).abs() / part.clamp_min(1e-6)).amax(-1)
        good = ~best.there & (part > 0).all(-1) & (stray <= STRAY) & (fit[..., 0] > 0)
        length = torch.full_like(stray, window / WINDOWS[0])
        own = Line(fit[..., 0], fit[..., 1], good, length, stray)
        best = Line(*(torch.where(good, new, old) for new, old in zip(own, best, strict=True)))
    return best


def none(like: Tensor) -> Line:
    """No line, of pixels as `like`."""
    zero = torch.zeros_like(like)
    return Line(zero, zero, zero.bool(), zero, zero)


def fitted(near: Tensor) -> tuple[Tensor, Tensor]:
    """a and b, (..., 2), of the line through n columns (..., n), the latest first, and its nearness there (..., n)."""
    solver, design = _least_squares(near.shape[-1])
    fit = near @ solver.to(near).T
    return fit, fit @ design.to(near).T


@lru_cache(maxsize=16)
def _least_squares(window: int) -> tuple[Tensor, Tensor]:
    """(2, n) of nearness to a and b, and (n, 2) back."""
    k = torch.arange(1, window + 1, dtype=torch.float64) * STEP
    design = torch.stack([k.cos(), k.sin()], 1)
    return torch.linalg.pinv(design).float(), design.float()
