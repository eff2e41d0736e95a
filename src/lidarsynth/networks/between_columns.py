"""Draws the columns between those of a grid: outlines, and what is narrower than a cell, such as poles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.networks.coarse_unet import COLUMNS, RAY_CHANNELS, ROWS
from lidarsynth.networks.column_neighbours import (
    FARTHEST,
    NEAREST,
    Grid,
    beneath_of,
    levelled,
    moved_up,
    nearness,
    relative,
    steepening,
)
from lidarsynth.networks.pixel_mixture import CODES, TONES, Drawn, PixelDrawer, picked
from lidarsynth.networks.rays import encode_range

SIDES, AROUND = (0, -1, 1, -2), 2  # known columns: left, right, and the next to them; rows up and down in them
HYPOTHESES, SHADES = 10, 4  # of range, of reflectance
FEATURES = 3 * (len(SIDES) * (2 * AROUND + 1) + ROWS - 1) + RAY_CHANNELS + 3 * HYPOTHESES + ROWS + 1
SHARP, HEAT = 0.55, 1.0  # of draws, as in `column_transformer.draw`: by street-2 (docs/generation.md)


class BetweenColumns(PixelDrawer):
    """`forward(known, rays, hidden, between) -> negative log-likelihoods (B, 3)`: of returning, range, reflectance, in
    nats a new pixel that is not blocked.

    known, rays      a grid of C columns around the turn (B, 16, C), 128 or 256, and what is told of its rays
    hidden, between  the C columns half-way from each to the next, and their rays (B, 8, 16, C)

    All new columns are drawn at once, each from the ground up, told the two columns on either side: a small convolution
    says what stands around, then each pixel is drawn as by a `ColumnTransformer`. cf. Reed et al. 2017 (parallel
    multiscale autoregressive density estimation).
    """

    def __init__(self, width: int = 64, layers: int = 3, blocks: int = 2):
        pixel = width * 9 // 4
        super().__init__(FEATURES, HYPOTHESES, SHADES, pixel, blocks)
        self.enter = nn.Conv2d(3 + RAY_CHANNELS + 1, width, 3)
        self.layers = nn.ModuleList(nn.Conv2d(width, width, 3) for _ in range(layers))
        self.leave = nn.Linear(2 * width, pixel)

    def forward(self, known: Grid, rays: Tensor, hidden: Grid, between: Tensor) -> Tensor:
        drawn, hypotheses, copies, copied = self.said(known, rays, hidden, between)
        return self.unlikelihood(drawn, hidden, hypotheses, copies, copied, between[:, 6] < 0.5)

    def said(self, known: Grid, rays: Tensor, hidden: Grid, between: Tensor) -> tuple[Drawn, Tensor, Tensor, Tensor]:
        """Of each new pixel, by those known and the hidden ones below it: what is drawn, the hypotheses (B, 16, C, 10)
        of its range, and those (B, 16, C, 4) of its reflectance, with whether they returned."""
        near, own = nearness(known.code, known.returned, rays), nearness(hidden.code, hidden.returned, between)
        below = moved_up(own, 1), moved_up(own, 2)
        expected = guesses(_sides(near), _sides(moved_up(near, 1)), *below, steepening(between), between)
        beneath = beneath_of(relative(hidden, between))
        features = _told(_beside(relative(known, rays)), beneath, between.permute(0, 2, 3, 1), *expected,
                         torch.eye(ROWS, device=rays.device)[:, None])  # fmt: skip
        copies = _copies(known, moved_up(hidden.shade * hidden.returned, 1), moved_up(hidden.returned, 1))
        return self.pixel(features, self.context(known, rays), *expected), expected[0], *copies

    def context(self, known: Grid, rays: Tensor) -> Tensor:
        """(B, 16, C, D) of each new pixel, by the known ones around."""
        back = known.returned.float()
        far = (known.code - rays[:, 1] / 2) * back
        values = torch.stack([3 * far, 2 * known.shade * back, 2 * back - 1], 1)
        x = torch.cat([values, rays, torch.full_like(values[:, :1], _step(values.shape[-1]))], 1)
        x = F.silu(self.enter(padded(x)))
        for layer in self.layers:
            x = x + F.silu(layer(padded(x)))
        x = x.permute(0, 2, 3, 1)
        return self.leave(torch.cat([x, x.roll(-1, 2)], -1))


@torch.inference_mode()
def draw_between(
    network: BetweenColumns,
    known: Grid,
    rays: Tensor,
    between: Tensor,
    rng: Sequence[torch.Generator],
    sharp: float = SHARP,
    heat: float = HEAT,
) -> Grid:
    """The columns between those of grids (B, 16, C) and their rays (B, 8, 16, C), each by a generator of its own."""
    count, height, columns = known.code.shape
    around, beside = network.context(known, rays), _beside(relative(known, rays))
    chance = torch.stack([torch.rand(5, height, columns, generator=one) for one in rng]).to(rays.device)
    chance = chance.clamp(0.001, 0.999).permute(2, 0, 3, 1)  # (16, B, C, 5)
    near = nearness(known.code, known.returned, rays)
    sides, under, steeper = _sides(near), _sides(moved_up(near, 1)), steepening(between)
    below = below2 = lower = rays.new_zeros(count, columns)
    beneath, row = rays.new_zeros(count, columns, 3 * (height - 1)), torch.eye(height, device=rays.device)
    drawn_rows: list[Grid] = []
    for i in reversed(range(height)):
        ray, u = between[:, :, i], chance[i]
        expected = guesses(sides[:, :, i], under[:, :, i], below, below2, steeper[:, i], ray)
        features = _told(beside[:, i], beneath, ray.transpose(1, 2), *expected, row[i])
        drawn = network.pixel(features, around[:, i], *expected)
        code = one_of((drawn.choice, drawn.centre, drawn.scale), u[..., 1:3], sharp, heat, CODES)
        copies = _copies(Grid(*(part[:, i] for part in known)), lower, below > 0)
        shade = one_of(network.shades(drawn, code, expected[0], *copies), u[..., 3:5], 1, 1, TONES)
        returned = (u[..., 0] < (drawn.returns / heat).sigmoid()) & (ray[:, 6] < 0.5)
        pixel = Grid(code * returned, shade * returned, returned)
        below2, below, lower = below, nearness(pixel.code, returned, ray), pixel.shade
        beneath = torch.cat([relative(pixel, ray), beneath[..., :-3]], -1)
        drawn_rows.append(pixel)
    return Grid(*(torch.stack(part[::-1], 1) for part in zip(*drawn_rows, strict=True)))


def joined(known: Grid, hidden: Grid) -> Grid:
    """Grids (B, 16, 2 C), column by column of the known ones and those between."""
    return Grid(*(torch.stack(parts, -1).flatten(-2) for parts in zip(known, hidden, strict=True)))


def guesses(
    beside: Tensor, under: Tensor, below: Tensor, below2: Tensor, steeper: Tensor, rays: Tensor
) -> tuple[Tensor, Tensor]:
    """Range codes (B, ..., 10) and whether they say anything, of pixels (B, ...) whose neighbours are so near.

    Flat ground; as far as left, as right; the plane between both; the planes of the two to the left, to the right;
    upright above the one below; the slope of the two below; as much nearer than the one below as left and right are;
    as much as the left is.

    beside, under  (4, B, ...) of the columns of SIDES, and the row below in them
    """
    left, right, left2, right2 = beside
    under_left, under_right = under[0], under[1]
    near = torch.stack([
        left, right, (left + right) / 2, 1.5 * left - 0.5 * left2, 1.5 * right - 0.5 * right2, below,
        below + (below - below2) * steeper, below + (left + right - under_left - under_right) / 2,
        below + left - under_left,
    ], -1)  # fmt: skip
    a, b, a2, b2 = beside > 0
    o, o2, ua, ub = below > 0, below2 > 0, under_left > 0, under_right > 0
    there = torch.stack([a, b, a & b, a & a2, b & b2, o, o & o2, a & b & ua & ub & o, a & ua & o], -1)
    metres = 1 / (near.clamp_min(1e-4) * levelled(rays)[..., None])
    valid = there & (metres < FARTHEST) & (metres > NEAREST)
    ground = rays[:, 1, ..., None] / 2
    codes = torch.where(valid, encode_range(metres.clamp(NEAREST, FARTHEST)), ground)
    return torch.cat([ground, codes], -1), torch.cat([torch.ones_like(valid[..., :1]), valid], -1)


def _step(columns: int) -> float:
    """How far known columns are apart: 0 where 128 make the turn, 1 where 256 do."""
    return math.log2(columns / COLUMNS)


def padded(x: Tensor) -> Tensor:
    """(B, C, H, W) with a column of the other end on either side, and rows of zeros."""
    return F.pad(torch.cat([x[..., -1:], x, x[..., :1]], -1), (0, 0, 1, 1))


def _sides(x: Tensor) -> Tensor:
    """(4, B, H, C): of the columns of SIDES."""
    return torch.stack([x.roll(k, 2) for k in SIDES])


def _beside(around: Tensor) -> Tensor:
    """(B, H, C, 60): what each new pixel is told of the known columns, around (B, H, C, 3)."""
    height = around.shape[1]
    wide = F.pad(around, (0, 0, 0, 0, AROUND, AROUND))
    parts = [wide[:, AROUND + r : AROUND + r + height].roll(k, 2) for k in SIDES for r in range(-AROUND, AROUND + 1)]
    return torch.cat(parts, -1)


def _copies(known: Grid, below: Tensor, returned: Tensor) -> tuple[Tensor, Tensor]:
    """Reflectances (B, ..., 4) of left, right, their mean, and the one below, and whether they returned."""
    left, a = known.shade * known.returned, known.returned
    right, b = left.roll(-1, -1), a.roll(-1, -1)
    return torch.stack([left, right, (left + right) / 2, below], -1), torch.stack([a, b, a & b, returned], -1)


def _told(beside: Tensor, beneath: Tensor, rays: Tensor, hypotheses: Tensor, valid: Tensor, row: Tensor) -> Tensor:
    """(B, ..., C, F): what new pixels are told, of the parts that are theirs, rays (B, ..., C, 8)."""
    own = (4 * (hypotheses - hypotheses[..., :1])).clamp(-4, 4)
    fine = torch.asinh(200 * (hypotheses - hypotheses[..., 3:4])) / 4
    step = torch.full_like(own[..., :1], _step(own.shape[-2]))
    rows = row.expand(*own.shape[:-1], row.shape[-1])
    return torch.cat([beside, beneath, rays, own, fine, valid.float(), rows, step], -1)


def one_of(
    parts: tuple[Tensor, Tensor, Tensor], u: Tensor, sharp: float, heat: float, span: tuple[float, float, int]
) -> Tensor:
    """(...): `picked` of mixtures of pixels (..., N), by chances u (..., 2)."""
    choice, centre, scale = (part.flatten(0, -2) for part in parts)
    return picked(choice, centre, scale, u.flatten(0, -2), sharp, heat, span).view(u.shape[:-1])
