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
    LEVELS,
    SECTORS,
    SHADES,
    Grid,
    beside,
    far_as_planned,
    guesses,
    nearness,
    openness,
    ranges_expected,
    relative,
    shades_expected,
    steepening,
    told,
    told_of,
    values,
)
from lidarsynth.networks.pixel_mixture import CODES, TONES, PixelDrawer, picked
from lidarsynth.networks.wall_lines import WallMemory

SHARP, HEAT = 0.85, 1.0  # of draws: chosen by street-2 (docs/training-default.md)


class ColumnTransformer(PixelDrawer):
    """`forward(grid, rays (B, 8, 16, 128)) -> negative log-likelihoods (B, 4)`: of returning, range and reflectance, in
    nats a pixel that is not blocked, and of the plan, a tenth of the nats a sector.

    First comes a plan: how far each of 16 sectors is open, one after the other. Then come the columns, and in a column
    the beams from the lowest to the highest. A transformer, told the plan and the columns before, says what stands
    around; a small network then draws each pixel: does it return; its range, a mixture of hypotheses (flat ground; the
    wall, the plane or the slope that its neighbours to the left and below are of) and of free choice among 64 bins; its
    reflectance likewise. So surfaces come out flat and their edges sharp, which
    diffusion learns only after many more samples (docs/training-default.md). cf. van den Oord et al. 2016 (PixelCNN),
    Salimans et al. 2017 (mixtures of logistics).
    """

    def __init__(self, width: int = 256, layers: int = 5, pixel: int = 192, blocks: int = 3):
        super().__init__(FEATURES, HYPOTHESES, SHADES, pixel, blocks)
        self.place = nn.Parameter(0.02 * torch.randn(COLUMNS, width))
        self.enter = nn.Linear((3 + RAY_CHANNELS) * ROWS, width)
        self.layers = nn.ModuleList(Block(width) for _ in range(layers))
        self.leave = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, pixel))
        self.planned = nn.Linear((SECTORS + 1) * LEVELS, width, bias=False)
        self.planner = nn.Sequential(
            nn.Linear(SECTORS * (LEVELS + 1) + RAY_CHANNELS * ROWS, width),
            nn.SiLU(),
            nn.Linear(width, width),
            nn.SiLU(),
            nn.Linear(width, LEVELS),
        )
        nn.init.zeros_(self.planned.weight)

    def forward(self, grid: Grid, rays: Tensor, columns: Tensor | None = None, seen: Grid | None = None) -> Tensor:
        """columns  (n,) indices of those that are judged, for less work; None = all
        seen     what is told of pixels drawn before, None = what they are: see `spoilt`
        """
        here, seen = slice(None) if columns is None else columns, seen or grid
        plan = openness(grid)
        around = self.context(seen, rays, plan)[:, None, here]  # (B, 1, 128, D)
        hypotheses, valid, wall = ranges_expected(seen, rays)
        features = told(seen, rays, hypotheses, valid, wall, plan)[:, :, here]  # (B, 16, 128, F)
        expected = (hypotheses, valid, *shades_expected(seen))
        hypotheses, valid, copies, copied = (part[:, :, here] for part in expected)
        grid, free = Grid(*(part[:, :, here] for part in grid)), rays[:, 6, :, here] < 0.5
        drawn = self.pixel(features, around, hypotheses, valid)
        mean = self.unlikelihood(drawn, grid, hypotheses, copies, copied, free)
        entropy = F.cross_entropy(self.levels(plan, rays).transpose(1, 2), plan, reduction="none")
        return torch.cat([mean, 0.1 * entropy.mean(1, keepdim=True)], 1)

    def levels(self, plan: Tensor, rays: Tensor) -> Tensor:
        """(B, 16, 24) logits of each sector's level, by the levels (B, 16) of those before it."""
        chosen = F.one_hot(plan, LEVELS).flatten(1)[:, None]
        sector = torch.arange(SECTORS, device=rays.device)
        before = (sector.repeat_interleave(LEVELS) < sector[:, None]) * chosen
        middle = rays[..., COLUMNS // SECTORS // 2 :: COLUMNS // SECTORS].flatten(1, 2).transpose(1, 2)
        number = torch.eye(SECTORS, device=rays.device).expand(len(rays), -1, -1)
        return self.planner(torch.cat([before, number, middle], -1))

    def plans(self, plan: Tensor) -> Tensor:
        """(B, 128, D): what columns are told of the plan (B, 16), the whole and their own sector's part."""
        chosen = F.one_hot(plan, LEVELS).float()
        own = chosen.repeat_interleave(COLUMNS // SECTORS, 1)
        return self.planned(torch.cat([chosen.flatten(1)[:, None].expand(-1, COLUMNS, -1), own], -1))

    def context(self, grid: Grid, rays: Tensor, plan: Tensor) -> Tensor:
        """(B, 128, D) of each column, by those before it, and by the plan (B, 16)."""
        before = F.pad(values(grid), (1, 0))[..., :-1]
        x = self.enter(torch.cat([before, rays], 1).flatten(1, 2).transpose(1, 2)) + self.place + self.plans(plan)
        for layer in self.layers:
            x = layer(x)
        return self.leave(x)


class Block(nn.Module):
    """A layer of a causal transformer (B, N, D) -> (B, N, D); with `kept`, keys and values of the columns before."""

    def __init__(self, width: int, heads: int = 4):
        super().__init__()
        self.heads = heads
        self.first, self.second = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attend, self.join = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, x: Tensor, kept: list[Tensor] | None = None) -> Tensor:
        parts = self.attend(self.first(x)).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        q, k, v = parts
        if kept is None:
            y = F.scaled_dot_product_attention(q, k, v, is_causal=True)
        else:
            if kept:
                k, v = torch.cat([kept[0], k], 2), torch.cat([kept[1], v], 2)
            kept[:] = k, v
            y = F.scaled_dot_product_attention(q, k, v)
        x = x + self.join(y.transpose(1, 2).flatten(2))
        return x + self.mlp(self.second(x))


@torch.inference_mode()
def draw(
    network: ColumnTransformer,
    rays: Tensor,
    rng: Sequence[torch.Generator],
    on_column: Callable[[], None] = lambda: None,
    sharp: float = SHARP,
    heat: float = HEAT,
) -> Grid:
    """Grids of rays (B, 8, 16, 128), each by a generator of its own.

    sharp  the scale of what strays from its hypothesis, of that of recorded scans, whose noise is in it
    heat   of choices: below 1, the likeliest are chosen more often
    """
    count, device = len(rays), rays.device
    chance = torch.stack([torch.rand(5, ROWS, COLUMNS, generator=one) for one in rng]).to(device).clamp(0.001, 0.999)
    plan = drawn_plan(network, rays, torch.stack([torch.rand(SECTORS, generator=one) for one in rng]))
    plans, planned = network.plans(plan), [part.unbind(1) for part in far_as_planned(plan)]
    shape, kinds = (count, ROWS, COLUMNS), (torch.float32, torch.float32, torch.bool)
    grid = Grid(*(torch.zeros(shape, dtype=kind, device=device) for kind in kinds))
    kept: list[list[Tensor]] = [[] for _ in network.layers]
    steeper, rows = steepening(rays), torch.eye(ROWS, device=device).expand(count, ROWS, ROWS).unbind(1)
    none, nothing, memory = rays.new_zeros(count), rays.new_zeros(count, 3 * (ROWS - 1)), WallMemory(rays)
    left = left2 = [none] * (ROWS + 2)  # nearness of columns to the left, from the row above the first to that below
    for j in range(COLUMNS):
        before = values(Grid(*(part[:, :, j - 1 : j] for part in grid))) if j else rays.new_zeros(count, 3, ROWS, 1)
        x = network.enter(torch.cat([before, rays[..., j : j + 1]], 1).flatten(1)[:, None])
        x = x + network.place[j] + plans[:, j : j + 1]
        for layer, one in zip(network.layers, kept, strict=True):
            x = layer(x, one)
        around, since = network.leave(x)[:, 0], max(j - LEFT, 0)
        window = relative(Grid(*(part[:, :, since : j + 1] for part in grid)), rays[..., since : j + 1])
        of_rows = zip(beside(window)[:, :, -1].unbind(1), rays[..., j].unbind(2), chance[..., j].unbind(2),
                      steeper[..., j].unbind(1), rows, strict=True)  # fmt: skip
        shades = _shades_left(grid, j)
        standing, character = (part.unbind(1) for part in memory.next())
        near, beneath, column, lower = [none, none], nothing, [], none
        for i, (beyond, ray, u, ratio, row) in reversed(list(enumerate(of_rows))):
            a, b = left[i + 1], left2[i + 1]
            expected = guesses(a, b, left[i], left[i + 2], near[0], near[1], ratio, ray, standing[i])
            features = told_of(beyond, beneath, ray, *expected, character[i], row, *(part[j] for part in planned))
            drawn = network.pixel(features, around, *expected)
            code = picked(drawn.choice, drawn.centre, drawn.scale, u[:, 1:3], sharp, heat, CODES)
            copied = torch.stack([a, b, near[0]], -1) > 0
            copies = torch.stack([shades[0][i], shades[1][i], lower], -1)
            of_shade = network.shades(drawn, code, expected[0], copies, copied)
            lower = picked(*of_shade, u[:, 3:5], 1, heat, TONES)
            back = ((u[:, 0] < (drawn.returns / heat).sigmoid()) & (ray[:, 6] < 0.5)).float()
            pixel = Grid(code * back, lower * back, back)
            lower = pixel.shade
            near, beneath = (
                [nearness(pixel.code, back, ray), *near],
                torch.cat([relative(pixel, ray), beneath[:, :-3]], 1),
            )
            column.append(pixel)
        for part, new in zip(grid, zip(*column, strict=True), strict=True):
            part[..., j] = torch.stack(new[::-1], 1)
        left2, left = left, [none, *near[:ROWS], none]
        memory.see(torch.stack(near[:ROWS], 1))
        on_column()
    return grid


def _shades_left(grid: Grid, column: int) -> list[tuple[Tensor, ...]]:
    """Reflectances (B,) of each row of the next and the second column to the left, 0 beyond the first."""
    zero = torch.zeros_like(grid.shade[..., 0])
    return [(grid.shade[..., column - k] if column >= k else zero).unbind(1) for k in (1, 2)]


def drawn_plan(network: ColumnTransformer, rays: Tensor, u: Tensor) -> Tensor:
    """(B, 16) int64: how far each sector is to be open, by chances u (B, 16)."""
    plan = torch.zeros(u.shape, dtype=torch.int64, device=rays.device)
    for k, one in enumerate(u.to(rays.device).unbind(1)):
        shares = network.levels(plan, rays)[:, k].softmax(-1).cumsum(-1)
        plan[:, k] = (shares < one[:, None]).sum(-1).clamp(max=LEVELS - 1)
    return plan
