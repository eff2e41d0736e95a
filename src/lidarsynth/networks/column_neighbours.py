"""What a pixel of a coarse grid is told of those drawn before it: to its left, and below it in its own column."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from lidarsynth.networks.coarse_unet import COLUMNS, RAY_CHANNELS, ROWS
from lidarsynth.networks.drafts import READ
from lidarsynth.networks.rays import decode_range, encode_range
from lidarsynth.networks.wall_lines import walls

LEFT, AROUND = 3, 2  # columns to the left, and rows up and down in them, that a pixel is told
HYPOTHESES, SHADES = 12, 3  # of range, of reflectance
FEATURES = 3 * (LEFT * (2 * AROUND + 1) + ROWS - 1) + RAY_CHANNELS + 3 * HYPOTHESES + ROWS + 5 + READ
NEAREST, FARTHEST = 0.5, 300.0  # metres of hypotheses


class Grid(NamedTuple):
    """What is known of grids (B, 16, 128): range code, reflectance as of even beams, both 0 where nothing returned, and
    whether it did."""

    code: Tensor
    shade: Tensor
    returned: Tensor


def known_grid(metres: Tensor, reflectance: Tensor) -> Grid:
    """Of metres (B, 16, 128), 0 where nothing returned, and reflectance as of even beams."""
    back = metres > 0
    return Grid(torch.where(back, encode_range(metres), 0), torch.where(back, reflectance, 0), back)


def spoilt(grid: Grid, rng: torch.Generator) -> Grid:
    """Every second grid with one to sixteen runs of as many pixels that are wrong, as draws are at times, so that a
    network learns to go on after them as if they were not there, where it else would go on with them."""
    code, shade, returned = (part.clone() for part in grid)

    def upto(high: int) -> int:
        return int(torch.randint(high, (1,), generator=rng))

    for k in range(len(code)):
        for _ in range(upto(2) * (1 + upto(16))):
            row, first, kind = upto(ROWS), upto(COLUMNS), upto(5)
            run = slice(first, first + 1 + upto(16))
            other = upto(ROWS), upto(COLUMNS)
            if kind < 3:  # as anything else in the grid
                for part in (code, shade, returned):
                    part[k, row, run] = part[k, other[0], other[1]]
            elif kind == 3:
                for part in (code, shade, returned):
                    part[k, row, run] = 0
            else:  # nearer or farther
                away = 0.2 * (float(torch.rand(1, generator=rng)) - 0.5)
                code[k, row, run] += away * returned[k, row, run]
    return Grid(code, shade, returned)


def values(grid: Grid) -> Tensor:
    """(B, 3, H, W) of known pixels, of the size of one."""
    back = grid.returned
    return torch.stack([2 * grid.code * back, 2 * grid.shade * back, 2 * back.float() - 1], 1)


def ranges_expected(grid: Grid, rays: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Range codes (B, H, W, 12) as neighbours to the left and below would have them, whether they say anything, and
    the `character` (B, H, W, 5) of the walls to the left."""
    near = nearness(grid.code, grid.returned, rays)
    left, left2 = (_right(near, k) for k in (1, 2))
    above, under = F.pad(left, (0, 0, 1, 0))[:, :-1], moved_up(left, 1)
    below, seen = (moved_up(near, 1), moved_up(near, 2)), walls(near, rays)
    return *guesses(left, left2, above, under, *below, steepening(rays), rays, seen.nearness), seen.character


def steepening(rays: Tensor) -> Tensor:
    """(B, H, W): the step of the elevation's tangent from the beam below, over that beam's own step."""
    slope = (rays[:, 0] / 3).tan()
    down = slope - moved_up(slope, 1)
    return down / moved_up(down, 1).clamp_min(1e-4)


def nearness(code: Tensor, returned: Tensor, rays: Tensor) -> Tensor:
    """1 / horizontal distance in metres, 0 where nothing returned; rays (B, 8, ...) of pixels (B, ...)."""
    return returned / (decode_range(code).clamp_min(0.1) * levelled(rays))


def guesses(
    left: Tensor,
    left2: Tensor,
    above: Tensor,
    under: Tensor,
    below: Tensor,
    below2: Tensor,
    steeper: Tensor,
    rays: Tensor,
    standing: Tensor,
) -> tuple[Tensor, Tensor]:
    """Range codes (B, ..., 12) and whether they say anything, of pixels (B, ...) whose neighbours are so near.

    Flat ground; as far as the one to the left; the plane of the two to the left; upright above the one below; the slope
    of the two below; the plane of three; as far as the one above to the left; as the second to the left; and the four
    walls of `Walls.nearness`.

    under, above  those to the left of the one below and of the one above; steeper: ratio of the steps of the slope
    standing      (B, ..., 4), 0 where there is none
    """
    near = torch.stack(
        [left, 2 * left - left2, below, below + (below - below2) * steeper, left + below - under, above, left2], -1
    )
    near = torch.cat([near, standing], -1)
    there = torch.stack([left, left2, below, below2, under, above], -1) > 0
    a, a2, b, b2, ab, c = there.unbind(-1)
    level, ground = levelled(rays)[..., None], rays[:, 1, ..., None] / 2
    metres = 1 / (near.clamp_min(1e-4) * level)
    said = torch.cat([torch.stack([a, a & a2, b, b & b2, a & b & ab, c, a2], -1), standing > 0], -1)
    valid = said & (metres < FARTHEST) & (metres > NEAREST)
    codes = torch.where(valid, encode_range(metres.clamp(NEAREST, FARTHEST)), ground)
    return torch.cat([ground, codes], -1), torch.cat([torch.ones_like(valid[..., :1]), valid], -1)


def shades_expected(grid: Grid) -> tuple[Tensor, Tensor]:
    """Reflectances (B, H, W, 3) of the two to the left and of the one below, and whether they returned."""
    shade, back = grid.shade * grid.returned, grid.returned
    return (torch.stack([_right(part, 1), _right(part, 2), moved_up(part, 1)], -1) for part in (shade, back))  # type: ignore[return-value]


def relative(grid: Grid, rays: Tensor) -> Tensor:
    """(B, H, W, 3) of known pixels, ranges relative to flat ground's."""
    far = (4 * (grid.code - rays[:, 1] / 2)).clamp(-4, 4)
    return torch.stack([far * grid.returned, 2 * grid.shade * grid.returned, 2.0 * grid.returned - 1], -1)


def beside(known: Tensor) -> Tensor:
    """(B, H, W, 45): what each pixel is told of the columns to its left, known (B, H, W, 3)."""
    height, width = known.shape[1:3]
    wide = F.pad(known, (0, 0, LEFT, 0, AROUND, AROUND))
    parts = [wide[:, AROUND + r : AROUND + r + height, LEFT - c : LEFT - c + width]
             for c in range(1, LEFT + 1) for r in range(-AROUND, AROUND + 1)]  # fmt: skip
    return torch.cat(parts, -1)


def beneath_of(known: Tensor) -> Tensor:
    """(B, H, W, 45): what each pixel is told of those below in its column, the next one first, known (B, H, W, 3)."""
    height = known.shape[1]
    low = F.pad(known, (0, 0, 0, 0, 0, height - 1))
    return torch.cat([low[:, r : r + height] for r in range(1, height)], -1)


def told(grid: Grid, rays: Tensor, hypotheses: Tensor, valid: Tensor, wall: Tensor, draft: Tensor) -> Tensor:
    """(B, H, W, F): what each pixel is told of those around, of its ray and its row, what it may be, and the draft, of
    which (B, H, W, 48) was read."""
    known = relative(grid, rays)
    height = known.shape[1]
    rows = torch.eye(height, device=known.device)[None, :, None].expand(*known.shape[:3], height)
    around = beside(known), beneath_of(known)
    return told_of(*around, rays.permute(0, 2, 3, 1), hypotheses, valid, wall, rows, draft)


def told_of(
    beside: Tensor,
    beneath: Tensor,
    rays: Tensor,
    hypotheses: Tensor,
    valid: Tensor,
    wall: Tensor,
    row: Tensor,
    draft: Tensor,
) -> Tensor:
    """`told` of pixels (..., F), of the parts that are theirs: beside (..., 45), beneath (..., 45), rays (..., 8),
    hypotheses (..., 12), the `character` of walls (..., 5), row (..., 16), which is one-hot, and draft (..., 48)."""
    own = (4 * (hypotheses - hypotheses[..., :1])).clamp(-4, 4)
    fine = torch.asinh(200 * (hypotheses - hypotheses[..., 3:4])) / 4
    return torch.cat([beside, beneath, rays, own, fine, valid.float(), row, wall, draft], -1)


def levelled(rays: Tensor) -> Tensor:
    """Cosines (B, ...) of the elevations, which may be straight up, of rays (B, 8, ...)."""
    return (rays[:, 0] / 3).cos().clamp_min(0.02)


def moved_up(x: Tensor, rows: int) -> Tensor:
    """(B, H, W) moved up: each pixel has the value of the one so many rows below, or 0."""
    return F.pad(x, (0, 0, 0, rows))[:, rows:]


def _right(x: Tensor, columns: int) -> Tensor:
    """(B, H, W) moved to the right."""
    return F.pad(x, (columns, 0))[..., : x.shape[2]]
