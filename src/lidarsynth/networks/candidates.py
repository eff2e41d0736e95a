"""What an unknown pixel may hold, by the known ones around it: the hypotheses among which a network chooses."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from lidarsynth.networks.rays import Rays, encode_range
from lidarsynth.networks.running import running_max, size_of

# The mean of the four sides by nearness; between the beams above and below, linear in code or in 1 / range; the surface
# above or below as a wall; the one to the left or right; the ground above or below as a plane; the nearest at all.
RANGE_CANDIDATES = 10
REFLECTANCE_CANDIDATES = 6  # mean of the sides, above, below, left, right, nearest
LOW, AT_LEAST = 0.01, 0.004  # radians below the horizon from which on a plane may be the ground, and least sine


class Candidates(NamedTuple):
    """Range codes (B, 10, H, W) and reflectances (B, 6, H, W); and how near the known pixels are (B, 4, H, W).

    `near`: 1 / (1 + distance) in pixels to the known return above, below, left and right, 0 for none.
    """

    code: Tensor
    reflectance: Tensor
    near: Tensor


@torch.no_grad()
def candidates(metres: Tensor, reflectance: Tensor, returned: Tensor, lit: Tensor, rays: Rays) -> Candidates:
    """Hypotheses from the known returns.

    metres, reflectance (B, 1, H, W), looked at where `returned` and `lit` (B, 1, H, W) bool: a known return, and one
    of known reflectance. A pixel without any hypothesis gets the ground's range, or a reflectance of 0.25.
    """
    found, distance, source = _sides(returned)  # (B, 4, H, W): above, below, left, right
    r = _take(metres, source)
    elevation = rays.elevation.expand_as(metres)
    e = _take(elevation, source)
    wall = r * (e.cos() / elevation.cos())
    wall[:, 2:] = r[:, 2:]
    low = elevation.sin().clamp(max=-AT_LEAST)
    ground = r[:, :2] * e[:, :2].sin().clamp(max=-AT_LEAST) / low
    usable = found[:, :2] & (e[:, :2] < -LOW) & (elevation < -0.8 * LOW)
    weight = found / distance.clamp_min(1)
    code = encode_range(r)
    total = weight.sum(1, keepdim=True)
    cross = (weight * code).sum(1, keepdim=True) / total.clamp_min(1e-9)
    cross = torch.where(total > 0, cross, encode_range(rays.ground))
    # by angle between the beams above and below: linear in code, and in 1/r, which is exact on any plane
    span = (e[:, :1] - e[:, 1:2]).clamp_min(1e-6)
    share = ((e[:, :1] - elevation) / span).clamp(0, 1)
    both = found[:, :1] & found[:, 1:2]
    one = torch.where(found[:, :1], code[:, :1], torch.where(found[:, 1:2], code[:, 1:2], cross))
    column = torch.where(both, code[:, :1] * (1 - share) + code[:, 1:2] * share, one)
    inverse = (1 - share) / r[:, :1].clamp_min(0.1) + share / r[:, 1:2].clamp_min(0.1)
    plane = torch.where(both, encode_range(1 / inverse), column)
    sides = torch.where(found, encode_range(wall), cross)
    grounds = torch.where(usable, encode_range(ground.clamp(0.1, 250.0)), plane)
    around = _around(code[:, 2:], distance[:, 2:], found[:, 2:], sides[:, 2:3], elevation)
    known = encode_range(metres)
    codes = torch.cat([cross, column, plane, sides, grounds, around], 1)
    codes = torch.where(returned, known, codes)
    near = found / (1 + distance)
    return Candidates(codes, _reflectances(reflectance, lit, returned, (found, distance, source)), near)


def _reflectances(reflectance: Tensor, lit: Tensor, returned: Tensor, sides: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    found, distance, source = sides if _same(lit, returned) else _sides(lit)
    f = _take(reflectance, source)
    weight = found / distance.clamp_min(1)
    total = weight.sum(1, keepdim=True)
    cross = torch.where(total > 0, (weight * f).sum(1, keepdim=True) / total.clamp_min(1e-9), 0.25)
    around = _around(f[:, 2:], distance[:, 2:], found[:, 2:], cross, None)
    values = torch.cat([cross, torch.where(found, f, cross), around], 1)
    return torch.where(lit, reflectance, values)


def _same(lit: Tensor, returned: Tensor) -> bool:
    """Whether all known returns are lit; an exported network cannot ask."""
    return lit is returned or (not torch.compiler.is_exporting() and torch.equal(lit, returned))


def _sides(known: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of the nearest known pixel above, below, left and right: whether there is one, its distance, its flat index."""
    height, width = known.shape[2:]
    rows = torch.arange(height, dtype=torch.int32)[:, None].expand(height, width)
    columns = torch.arange(width, dtype=torch.int32)[None].expand(height, width)
    k = known[:, 0]
    above = _last(torch.where(k, rows, -1), 1)
    below = height - 1 - _last(torch.where(k, rows, height).flip(1).sub(height - 1).neg(), 1).flip(1)
    before = _last(torch.where(k, columns, -1), 2)
    after = width - 1 - _last(torch.where(k, columns, width).flip(2).sub(width - 1).neg(), 2).flip(2)
    before = torch.where(before < 0, before[..., -1:] - width, before)
    after = torch.where(after >= width, after[..., :1] + width, after)
    found = torch.stack([above >= 0, below < height, before >= -width, after < 2 * width], 1)
    distance = torch.stack([rows - above, below - rows, columns - before, after - columns], 1).float()
    row = torch.stack([above.clamp(0), below.clamp(max=height - 1), rows.expand_as(k), rows.expand_as(k)], 1)
    column = torch.stack([columns.expand_as(k)] * 2 + [before % width, after % width], 1)
    return found, distance, (row * width + column).long()


def _last(place: Tensor, dim: int) -> Tensor:
    """The last known place up to each, -1 for none."""
    return running_max(place, dim, size_of(place, dim), -1)


def _take(values: Tensor, source: Tensor) -> Tensor:
    """(B, 1, H, W) at flat indices (B, 4, H, W)."""
    return values.flatten(2).expand(-1, 4, -1).gather(2, source.flatten(2)).view(source.shape)


def _around(values: Tensor, distance: Tensor, found: Tensor, other: Tensor, elevation: Tensor | None) -> Tensor:
    """(B, 1, H, W): the nearest known value within two rows, by those to the left and right in each; else `other`."""
    far = torch.where(found, distance.square(), torch.inf)
    best, best_value = torch.full_like(other, torch.inf), other
    tall, taller = F.pad(values, (0, 0, 2, 2)), F.pad(far, (0, 0, 2, 2), value=torch.inf)
    height = values.shape[2]
    for shift in (0, -1, 1, -2, 2):
        here = slice(2 + shift, 2 + shift + height)
        for side in (0, 1):
            away = taller[:, side : side + 1, here] + shift**2
            closer = away < best
            best_value = torch.where(closer, tall[:, side : side + 1, here], best_value)
            best = torch.minimum(best, away)
    return best_value
