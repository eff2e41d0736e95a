"""Draws the grid of the coarse stage column by column, from the ground up: an autoregressive transformer."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.networks.coarse_unet import COLUMNS, RAY_CHANNELS, ROWS
from lidarsynth.networks.column_neighbours import (
    FEATURES,
    HYPOTHESES,
    LEFT,
    SHADES,
    Grid,
    beside,
    guesses,
    nearness,
    ranges_expected,
    relative,
    shades_expected,
    steepening,
    told,
    told_of,
    values,
)
from lidarsynth.networks.drafts import READ, DraftReader
from lidarsynth.networks.layers import ColumnLinear
from lidarsynth.networks.pixel_mixture import CODES, TONES, PixelDrawer, picked
from lidarsynth.networks.wall_lines import WallMemory

SHARP, HEAT = 0.85, 0.87  # of draws: so that steps are as in streets (docs/generation.md)


class ColumnTransformer(PixelDrawer):
    """`forward(grid, rays (B, 8, 16, 128), draft (B, 7, 16, 128)) -> negative log-likelihoods (B, 3)`: of returning,
    range and reflectance, in nats a pixel that is not blocked.

    First comes a draft of the whole turn, by diffusion (`drafts.py`): where streets run, how wide they are. Then come
    the columns, and in a column the beams from the lowest to the highest. A transformer, told the draft and the columns
    before, says what stands around; a small network then draws each pixel: does it return; its range, a mixture of
    hypotheses (flat ground; the wall, the plane or the slope that its neighbours to the left and below are of) and of
    free choice among 64 bins; its reflectance likewise. So surfaces come out flat and their edges sharp, which
    diffusion learns only after many more samples, while it is diffusion that agrees with itself all around the turn
    (docs/generation.md). cf. van den Oord et al. 2016 (PixelCNN), Salimans et al. 2017 (mixtures of logistics).
    """

    def __init__(self, width: int = 256, layers: int = 5, pixel: int = 192, blocks: int = 3):
        super().__init__(FEATURES, HYPOTHESES, SHADES, pixel, blocks)
        self.place = nn.Parameter(torch.empty(COLUMNS, width))
        nn.init.normal_(self.place, std=0.02)
        self.enter = ColumnLinear((3 + RAY_CHANNELS) * ROWS, width)
        self.layers = nn.ModuleList(Block(width) for _ in range(layers))
        self.leave = nn.Sequential(nn.LayerNorm(width), ColumnLinear(width, pixel))
        self.reader = DraftReader()
        self.read = ColumnLinear(READ * ROWS, width, bias=False)
        nn.init.zeros_(self.read.weight)

    def forward(
        self, grid: Grid, rays: Tensor, draft: Tensor, columns: Tensor | None = None, seen: Grid | None = None
    ) -> Tensor:
        """columns  (n,) indices of those that are judged, for less work; None = all
        seen     what is told of pixels drawn before, None = what they are: see `spoilt`
        """
        here, seen = slice(None) if columns is None else columns, seen or grid
        read = self.reader(draft, rays)
        around = self.context(seen, rays, read)[:, None, here]  # (B, 1, 128, D)
        hypotheses, valid, wall = ranges_expected(seen, rays)
        features = told(seen, rays, hypotheses, valid, wall, read)[:, :, here]  # (B, 16, 128, F)
        expected = (hypotheses, valid, *shades_expected(seen))
        hypotheses, valid, copies, copied = (part[:, :, here] for part in expected)
        grid, free = Grid(*(part[:, :, here] for part in grid)), rays[:, 6, :, here] < 0.5
        drawn = self.pixel(features, around, hypotheses, valid)
        return self.unlikelihood(drawn, grid, hypotheses, copies, copied, free)

    def context(self, grid: Grid, rays: Tensor, read: Tensor) -> Tensor:
        """(B, 128, D) of each column, by those before it, and by what was read of the draft (B, 16, 128, 48)."""
        before = F.pad(values(grid), (1, 0))[..., :-1]
        x = self.enter(torch.cat([before, rays], 1).flatten(1, 2).transpose(1, 2)) + self.place + self.reads(read)
        for layer in self.layers:
            x = layer(x)
        return self.leave(x)

    def reads(self, read: Tensor) -> Tensor:
        """(B, C, D): what columns are told of the draft, of which (B, 16, C, 48) was read."""
        return self.read(read.transpose(1, 2).flatten(2))


class Kept:
    """Keys and values (B, heads, N, D / heads) of the columns that a layer has seen, in room for a turn of them: to
    copy all for each column more takes three times as long as to attend to them."""

    def __init__(self):
        self.count, self.room = 0, torch.empty(0)

    def with_next(self, *new: Tensor) -> tuple[Tensor, Tensor]:
        """Keys and values with those of one column more, (B, heads, 1, D / heads)."""
        if not self.count:
            batch, heads, _, width = new[0].shape
            self.room = new[0].new_empty(2, batch, heads, COLUMNS, width)
        self.room[:, :, :, self.count] = torch.stack(new)[..., 0, :]
        self.count += 1
        keys, values = self.room[..., : self.count, :]
        return keys, values


class Block(nn.Module):
    """A layer of a causal transformer (B, N, D) -> (B, N, D); with `kept`, of one column more."""

    def __init__(self, width: int, heads: int = 4):
        super().__init__()
        self.heads = heads
        self.first, self.second = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attend, self.join = ColumnLinear(width, 3 * width), ColumnLinear(width, width)
        self.mlp = nn.Sequential(ColumnLinear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, x: Tensor, kept: Kept | None = None) -> Tensor:
        parts = self.attend(self.first(x)).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        q, k, v = parts
        if kept is None:
            y = F.scaled_dot_product_attention(q, k, v, is_causal=True)
        else:
            y = F.scaled_dot_product_attention(q, *kept.with_next(k, v))
        x = x + self.join(y.transpose(1, 2).flatten(2))
        return x + self.mlp(self.second(x))


@torch.inference_mode()
def draw(
    network: ColumnTransformer,
    rays: Tensor,
    draft: Tensor,
    rng: Sequence[torch.Generator],
    on_column: Callable[[], None] = lambda: None,
    sharp: float = SHARP,
    heat: float = HEAT,
    known: tuple[Grid, Tensor] | None = None,
) -> Grid:
    """Grids of rays (B, 8, 16, 128) after drafts (B, 7, 16, 128), each by a generator of its own.

    known  grids, and which of their pixels (B, 16, 128) bool stay as they are; None = all are drawn
    sharp  the scale of what strays from its hypothesis, of that of recorded scans, whose noise is in it
    heat   of ranges: below 1, the likeliest are chosen more often
    """
    count, device = len(rays), rays.device
    chance = torch.stack([torch.rand(5, ROWS, COLUMNS, generator=one) for one in rng]).to(device).clamp(0.001, 0.999)
    read = network.reader(draft, rays)
    shape, kinds = (count, ROWS, COLUMNS), (torch.float32, torch.float32, torch.bool)
    grid = Grid(*(torch.zeros(shape, dtype=kind, device=device) for kind in kinds))
    kept = [Kept() for _ in network.layers]
    steeper, rows = steepening(rays), torch.eye(ROWS, device=device).expand(count, ROWS, ROWS).unbind(1)
    none, nothing, memory = rays.new_zeros(count), rays.new_zeros(count, 3 * (ROWS - 1)), WallMemory(rays)
    left = left2 = [none] * (ROWS + 2)  # nearness of columns to the left, from the row above the first to that below
    for j in range(COLUMNS):
        before = values(Grid(*(part[:, :, j - 1 : j] for part in grid))) if j else rays.new_zeros(count, 3, ROWS, 1)
        x = network.enter(torch.cat([before, rays[..., j : j + 1]], 1).flatten(1)[:, None])
        x = x + network.place[j] + network.reads(read[:, :, j : j + 1])
        for layer, one in zip(network.layers, kept, strict=True):
            x = layer(x, one)
        around, since = network.leave(x)[:, 0], max(j - LEFT, 0)
        window = relative(Grid(*(part[:, :, since : j + 1] for part in grid)), rays[..., since : j + 1])
        of_rows = zip(beside(window)[:, :, -1].unbind(1), rays[..., j].unbind(2), chance[..., j].unbind(2),
                      steeper[..., j].unbind(1), rows, read[:, :, j].unbind(1), strict=True)  # fmt: skip
        shades = _shades_left(grid, j)
        standing, character = (part.unbind(1) for part in memory.next())
        near, beneath, column, lower = [none, none], nothing, [], none
        for i, (beyond, ray, u, ratio, row, aim) in reversed(list(enumerate(of_rows))):
            a, b = left[i + 1], left2[i + 1]
            expected = guesses(a, b, left[i], left[i + 2], near[0], near[1], ratio, ray, standing[i])
            features = told_of(beyond, beneath, ray, *expected, character[i], row, aim)
            drawn = network.pixel(features, around, *expected)
            code = picked(drawn.choice, drawn.centre, drawn.scale, u[:, 1:3], sharp, heat, CODES)
            copied = torch.stack([a, b, near[0]], -1) > 0
            copies = torch.stack([shades[0][i], shades[1][i], lower], -1)
            of_shade = network.shades(drawn, code, expected[0], copies, copied)
            lower = picked(*of_shade, u[:, 3:5], 1, 1, TONES)
            back = ((u[:, 0] < drawn.returns.sigmoid()) & (ray[:, 6] < 0.5)).float()
            pixel = _as_known(Grid(code * back, lower * back, back), known, i, j)
            lower, near = pixel.shade, [nearness(pixel.code, pixel.returned, ray), *near]
            beneath = torch.cat([relative(pixel, ray), beneath[:, :-3]], 1)
            column.append(pixel)
        for part, new in zip(grid, zip(*column, strict=True), strict=True):
            part[..., j] = torch.stack(new[::-1], 1)
        left2, left = left, [none, *near[:ROWS], none]
        memory.see(torch.stack(near[:ROWS], 1))
        on_column()
    return grid


def _as_known(pixel: Grid, known: tuple[Grid, Tensor] | None, row: int, column: int) -> Grid:
    """Pixels (B,) as they are known, where they are."""
    if known is None:
        return pixel
    of, here = (Grid(*(part[:, row, column] for part in known[0])), known[1][:, row, column])
    return Grid(*(torch.where(here, k, p) for k, p in zip(of, pixel, strict=True)))


def _shades_left(grid: Grid, column: int) -> list[tuple[Tensor, ...]]:
    """Reflectances (B,) of each row of the next and the second column to the left, 0 beyond the first."""
    zero = torch.zeros_like(grid.shade[..., 0])
    return [(grid.shade[..., column - k] if column >= k else zero).unbind(1) for k in (1, 2)]
