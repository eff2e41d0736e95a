"""Draws the beams between those of a grid: how high cars and people are, and where a wall's foot is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.networks.between_columns import one_of, padded
from lidarsynth.networks.coarse_unet import RAY_CHANNELS
from lidarsynth.networks.column_neighbours import FARTHEST, NEAREST, Grid, levelled, nearness, relative
from lidarsynth.networks.pixel_mixture import CODES, TONES, Drawn, PixelDrawer
from lidarsynth.networks.rays import encode_range

AROUND, STRIDES = 2, (0, 4, 2, 1)  # known columns to either side; those drawn before, of each phase
HYPOTHESES, SHADES = 11, 5  # of range, of reflectance
# Of draws, as in `column_transformer.draw`; the heat of whether rays return: chosen by street-2
# (docs/generation.md).
SHARP, HEAT, LOST = 0.3, 0.85, 0.4
FEATURES = 3 * (4 * (2 * AROUND + 1) + 6) + RAY_CHANNELS + 3 * HYPOTHESES + len(STRIDES)


class BetweenBeams(PixelDrawer):
    """`forward(known, rays, hidden, between) -> negative log-likelihoods (B, 3)`: of returning, range, reflectance, in
    nats a new pixel that is not blocked.

    known, rays      R beams of a grid (B, R, C), C a multiple of 8, and what is told of their rays
    hidden, between  the R - 1 beams between each and the next, and their rays (B, 8, R - 1, C)

    Every eighth column is drawn first, then those half-way between, three times: all beams and columns of a phase at
    once, each told the beams above and below, and those drawn before to its left and right (cf. Reed et al. 2017).
    """

    def __init__(self, width: int = 56, layers: int = 3, blocks: int = 2):
        pixel = width * 16 // 7
        super().__init__(FEATURES, HYPOTHESES, SHADES, pixel, blocks)
        self.enter = nn.Conv2d(3 + RAY_CHANNELS, width, 3)
        self.layers = nn.ModuleList(nn.Conv2d(width, width, 3) for _ in range(layers))
        self.leave = nn.Linear(2 * width, pixel)

    def forward(
        self, known: Grid, rays: Tensor, hidden: Grid, between: Tensor, columns: Tensor | None = None
    ) -> Tensor:
        """columns  (n,) indices of those that are judged, for less work; None = all"""
        chosen = torch.arange(rays.shape[-1], device=rays.device) if columns is None else columns
        drawn, hypotheses, copies, copied = self.said(known, rays, hidden, between, chosen)
        hidden, free = Grid(*(part[..., chosen] for part in hidden)), between[:, 6][..., chosen] < 0.5
        return self.unlikelihood(drawn, hidden, hypotheses, copies, copied, free)

    def said(
        self, known: Grid, rays: Tensor, hidden: Grid, between: Tensor, columns: Tensor
    ) -> tuple[Drawn, Tensor, Tensor, Tensor]:
        """Of the new pixels of these columns, by those known and those of earlier phases: what is drawn, the hypotheses
        (B, R - 1, n, 11) of range, and those (B, R - 1, n, 5) of reflectance, with whether they returned."""
        told = told_of(known, rays, hidden, between, columns)
        around = self.context(known, rays)[..., columns, :]
        return self.pixel(told.features, around, told.ranges, told.valid), told.ranges, told.shades, told.lit

    def context(self, known: Grid, rays: Tensor) -> Tensor:
        """(B, R - 1, C, D) of each new pixel, by the known ones around."""
        back = known.returned.float()
        far = (known.code - rays[:, 1] / 2) * back
        x = torch.cat([torch.stack([3 * far, 2 * known.shade * back, 2 * back - 1], 1), rays], 1)
        x = F.silu(self.enter(padded(x)))
        for layer in self.layers:
            x = x + F.silu(layer(padded(x)))
        x = x.permute(0, 2, 3, 1)
        return self.leave(torch.cat([x[:, :-1], x[:, 1:]], -1))


class Told(NamedTuple):
    """What new pixels (B, R - 1, n) are told: features, hypotheses of range and of reflectance, and whether these say
    anything."""

    features: Tensor
    ranges: Tensor
    valid: Tensor
    shades: Tensor
    lit: Tensor


@torch.inference_mode()
def draw_beams(
    network: BetweenBeams,
    known: Grid,
    rays: Tensor,
    between: Tensor,
    rng: Sequence[torch.Generator],
    sharp: float = SHARP,
    heats: tuple[float, float] = (HEAT, LOST),
) -> Grid:
    """The beams between those of grids (B, R, C) and their rays (B, 8, R - 1, C), each by a generator of its own.

    heats  of range, and of whether rays return
    """
    grids = (Grid(*(part[i : i + 1] for part in known)) for i in range(len(rays)))
    each = zip(grids, rays.split(1), between.split(1), rng, strict=True)  # one by one: all of them take a tenth longer
    drawn = [_drawn(network, *grid, sharp, heats) for grid in each]
    return Grid(*map(torch.cat, zip(*drawn, strict=True)))


def _drawn(
    network: BetweenBeams,
    known: Grid,
    rays: Tensor,
    between: Tensor,
    rng: torch.Generator,
    sharp: float,
    heats: tuple[float, float],
) -> Grid:
    """As `draw_beams`, of one grid (1, R, C)."""
    shape = (1, between.shape[2], rays.shape[-1])
    chance = torch.rand(5, *shape, generator=rng).to(rays.device).clamp(0.001, 0.999).permute(1, 2, 3, 0)
    around = network.context(known, rays)
    hidden = Grid(*(torch.zeros(shape, dtype=part.dtype, device=rays.device) for part in known))
    for columns in (part.to(rays.device) for part in phases(shape[2])):
        told, u, ray = told_of(known, rays, hidden, between, columns), chance[:, :, columns], between[..., columns]
        drawn = network.pixel(told.features, around[:, :, columns], told.ranges, told.valid)
        code = one_of((drawn.choice, drawn.centre, drawn.scale), u[..., 1:3], sharp, heats[0], CODES)
        shade = one_of(network.shades(drawn, code, told.ranges, told.shades, told.lit), u[..., 3:5], 1.0, 1.0, TONES)
        back = (u[..., 0] < (drawn.returns / heats[1]).sigmoid()) & (ray[:, 6] < 0.5)
        for part, new in zip(hidden, (code * back, shade * back, back), strict=True):
            part[..., columns] = new
    return hidden


def with_between(rows: np.ndarray) -> np.ndarray:
    """Numbers of beams (2 R - 1,), with those half-way between each two of (R,)."""
    return np.insert(rows, np.arange(1, len(rows)), (rows[1:] + rows[:-1]) // 2)


def interleaved(known: Grid, hidden: Grid) -> Grid:
    """Grids (B, 2 R - 1, C), beam by beam of the known ones and those between."""
    parts = (torch.stack([above[:, :-1], new], 2).flatten(1, 2) for above, new in zip(known, hidden, strict=True))
    return Grid(*(torch.cat([part, above[:, -1:]], 1) for part, above in zip(parts, known, strict=True)))


def strides(columns: Tensor) -> Tensor:
    """(n,): how many columns from each of these (n,) to those drawn before it on either side, 0 for the first."""
    place = columns % 8
    stride = torch.where(place % 2 == 1, 1, torch.where(place % 4 == 2, 2, 4))
    return torch.where(place == 0, 0, stride)


def phases(count: int) -> list[Tensor]:
    """Indices of the columns, of `count`, that are drawn together: four tensors, one after the other."""
    columns = torch.arange(count)
    return [columns[strides(columns) == stride] for stride in STRIDES]


def told_of(known: Grid, rays: Tensor, hidden: Grid, between: Tensor, columns: Tensor) -> Told:
    """What the new pixels of these columns are told of a grid, and of what is drawn of the hidden one."""
    count, stride = rays.shape[-1], strides(columns)
    left, right, before = (columns - stride) % count, (columns + stride) % count, stride > 0
    near, own = nearness(known.code, known.returned, rays), nearness(hidden.code, hidden.returned, between)
    ray, slope = between[..., columns], (rays[:, 0] / 3).tan()
    high, low, mid = slope[:, :-1, columns], slope[:, 1:, columns], (ray[:, 0] / 3).tan()
    share = ((mid - low) / (high - low).clamp_min(1e-5)).clamp(0, 1)

    def plane(at: Tensor) -> tuple[Tensor, Tensor]:
        a, b = near[:, :-1, at], near[:, 1:, at]
        return share * a + (1 - share) * b, (a > 0) & (b > 0)

    above, below = near[:, :-1, columns], near[:, 1:, columns]
    above2, below2 = F.pad(near, (0, 0, 1, 0))[:, :-2, columns], F.pad(near, (0, 0, 0, 1))[:, 2:, columns]
    up, down = F.pad(slope, (0, 0, 1, 0))[:, :-2, columns], F.pad(slope, (0, 0, 0, 1))[:, 2:, columns]
    one, other = own[..., left] * before, own[..., right] * before
    (flat, a), (flat_left, c), (flat_right, d) = plane(columns), plane(left), plane(right)
    steeper = (above - above2) * ((mid - high) / (high - up).clamp(max=-1e-4)).clamp(0, 2)
    lower = (below - below2) * ((mid - low) / (low - down).clamp_min(1e-4)).clamp(0, 2)
    guesses = torch.stack([
        above, below, flat, above + steeper, below + lower, one, other, (one + other) / 2,
        flat + (one - flat_left + other - flat_right) / 2, flat + one - flat_left,
    ], -1)  # fmt: skip
    u, v, e, f = above > 0, below > 0, one > 0, other > 0
    there = torch.stack([u, v, a, u & (above2 > 0), v & (below2 > 0), e, f, e & f, a & c & d & e & f, a & c & e], -1)
    metres = 1 / (guesses.clamp_min(1e-4) * levelled(ray)[..., None])
    valid = there & (metres < FARTHEST) & (metres > NEAREST)
    ground = ray[:, 1, ..., None] / 2
    codes = torch.where(valid, encode_range(metres.clamp(NEAREST, FARTHEST)), ground)
    ranges, valid = torch.cat([ground, codes], -1), torch.cat([torch.ones_like(valid[..., :1]), valid], -1)

    around, drawn = relative(known, rays), relative(hidden, between)
    wide = F.pad(around, (0, 0, 0, 0, 1, 1))
    rows = [wide[:, r : r + between.shape[2]] for r in range(4)]
    beside = [row[:, :, (columns + k) % count] for row in rows for k in range(-AROUND, AROUND + 1)]
    sides = [part[:, :, at] * before[:, None] for at in (left, right) for part in (drawn, rows[1], rows[2])]
    phase = F.one_hot(stride, STRIDES[1] + 1)[:, STRIDES].float().expand(*ray[:, 0].shape, -1)
    relation = (4 * (ranges - ranges[..., :1])).clamp(-4, 4)
    fine = torch.asinh(200 * (ranges - ranges[..., 3:4])) / 4
    features = torch.cat([*beside, *sides, ray.permute(0, 2, 3, 1), relation, fine, valid.float(), phase], -1)
    return Told(features, ranges, valid, *_copies(known, hidden, columns, left, right, before))


def _copies(
    known: Grid, hidden: Grid, columns: Tensor, left: Tensor, right: Tensor, before: Tensor
) -> tuple[Tensor, Tensor]:
    """Reflectances (B, R - 1, n, 5) above, below, their mean, left and right, and whether they returned."""
    shade, drawn, seen = known.shade * known.returned, hidden.shade * hidden.returned, hidden.returned
    above, below = (part[:, rows] for part in (shade[..., columns],) for rows in (slice(None, -1), slice(1, None)))
    a, b = known.returned[:, :-1, columns], known.returned[:, 1:, columns]
    one, other = drawn[..., left] * before, drawn[..., right] * before
    shades = torch.stack([above, below, (above + below) / 2, one, other], -1)
    return shades, torch.stack([a, b, a & b, seen[..., left] & before, seen[..., right] & before], -1)
