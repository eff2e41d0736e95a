"""Tells grids of streets from those that a cascade draws: of several drawn ones, the likelier street is kept."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.networks.coarse_unet import ROWS
from lidarsynth.networks.column_neighbours import Grid, nearness
from lidarsynth.networks.fill_unet import ring
from lidarsynth.networks.rays import decode_range

INPUTS, GROUPS, REACHES = 14, 8, (1, 2, 4, 8, 16, 32)  # columns to either side, doubled as far as a turn
NEAR, STANDS = (3, 6, 10, 25), 0.85  # of `openness`: metres, and the share of the way to flat ground


class GridJudge(nn.Module):
    """`judge(grid (B, 16, 128), rays (B, 8, 16, 128)) -> log odds (B,)` that the grid is a street's, not a drawn one.

    Convolutions around the turn, then one vector per column, which looks ever farther along the turn, then their mean.
    The odds weigh draws as importance weights would (Azadi et al. 2019, discriminator rejection sampling). It learns
    with noise on ranges and reflectances, so that what counts is how streets run, not what later stages put right.

    slopes  of the odds over `openness`, which are taken away, or () for none: hard scenes are easier to tell, and a
            choice by such odds would keep the open ones
    """

    def __init__(self, width: int = 40, slopes: Sequence[float] = ()):
        super().__init__()
        self.slopes = tuple(slopes)
        column = width * 14 // 5 // GROUPS * GROUPS
        self.stem = nn.Conv2d(INPUTS, width, 3, padding=(1, 0))
        self.blocks = nn.ModuleList(
            nn.Sequential(
                nn.GroupNorm(GROUPS, width),
                nn.SiLU(),
                nn.Conv2d(width, width, 3, padding=(1, 0)),
                nn.SiLU(),
                nn.Conv2d(width, width, 1),
            )
            for _ in range(2)
        )
        self.column = nn.Linear(ROWS * width, column)
        self.along = nn.ModuleList(Along(column, reach) for reach in REACHES)
        self.out = nn.Sequential(nn.GroupNorm(GROUPS, column), nn.SiLU(), nn.Conv1d(column, 1, 1))

    def forward(self, grid: Grid, rays: Tensor) -> Tensor:
        odds = self.of_all(grid, rays)
        return odds - openness(grid, rays) @ odds.new_tensor(self.slopes) if self.slopes else odds

    def of_all(self, grid: Grid, rays: Tensor) -> Tensor:
        """(B,) the odds as they were learned, with what they owe to openness."""
        h = self.stem(ring(seen(grid, rays), 1))
        for block in self.blocks:
            h = h + block(ring(h, 1))
        h = self.column(h.flatten(1, 2).transpose(1, 2)).transpose(1, 2)
        for along in self.along:
            h = along(h)
        return self.out(h)[:, 0].mean(1)


class Along(nn.Module):
    """(B, C, 128) columns, each told those `reach` to its left and right."""

    def __init__(self, channels: int, reach: int):
        super().__init__()
        self.reach = reach
        self.norm = nn.GroupNorm(GROUPS, channels)
        self.look = nn.Conv1d(channels, channels, 3, dilation=reach)
        self.out = nn.Conv1d(channels, channels, 1)
        nn.init.zeros_(self.out.weight)

    def forward(self, h: Tensor) -> Tensor:
        around = F.pad(F.silu(self.norm(h)), (self.reach, self.reach), mode="circular")
        return h + self.out(F.silu(self.look(around)))


def seen(grid: Grid, rays: Tensor) -> Tensor:
    """(B, 14, 16, 128), each of about unit size, of a grid (B, 16, 128) and its rays (B, 8, 16, 128): ranges and
    reflectances, how they go on along and down, and where each ray goes."""
    back, code = grid.returned.float(), grid.code
    left, below = code.roll(1, -1), F.pad(code, (0, 0, 0, 1))[:, 1:]
    beside, beneath = back * back.roll(1, -1), back * F.pad(back, (0, 0, 0, 1))[:, 1:]
    values = [
        2 * code * back,
        (4 * (code - rays[:, 1] / 2)).clamp(-4, 4) * back,
        2 * grid.shade * back,
        2 * back - 1,
        (20 * (code - left)).clamp(-3, 3) * beside,
        (20 * (code - below)).clamp(-3, 3) * beneath,
        (4 * nearness(code, back, rays)).clamp(0, 3),
        torch.linspace(-1, 1, ROWS, device=code.device)[:, None].expand(code.shape),
    ]
    return torch.cat([torch.stack(values, 1), rays[:, :4], rays[:, 6:8]], 1)


def openness(grid: Grid, rays: Tensor) -> Tensor:
    """(B, 6) how open scenes are, of grids (B, 16, 128) and their rays (B, 8, 16, 128): square roots of the shares of
    rays that meet what stands nearer than NEAR, the share that returns, and the mean ln range of returns."""
    metres, back = decode_range(grid.code).clamp_min(0.1), grid.returned.bool()
    stands = back & ((metres < STANDS * decode_range(rays[:, 1] / 2)) | (rays[:, 0] >= 0))
    shares = [(stands & (metres < near)).float().mean((1, 2)).sqrt() for near in NEAR]
    mean = (metres.log() * back).sum((1, 2)) / back.sum((1, 2)).clamp_min(1)
    return torch.stack([*shares, back.float().mean((1, 2)), mean], 1)
