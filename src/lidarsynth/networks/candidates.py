"""What an unknown pixel may hold, by the known ones around it: the hypotheses among which a network chooses."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lidarsynth.networks.exporting import is_exporting
from lidarsynth.networks.rays import Rays, encode_range
from lidarsynth.networks.running import last_known

# The mean of the four sides by nearness; between the beams above and below, linear in code or in 1 / range; the surface
# above or below as a wall; the one to the left or right; the ground above or below as a plane; the nearest at all.
RANGE_CANDIDATES = 10
REFLECTANCE_CANDIDATES = 6  # mean of the sides, above, below, left, right, nearest
LOW, AT_LEAST = 0.01, 0.004  # radians below the horizon from which on a plane may be the ground, and least sine
SHIFTS = (0, -1, 1, -2, 2)  # rows in which the nearest value at all is sought, the nearer ones first
NOWHERE = 1 << 30  # eighths of squared pixels
STEEPEST = 1e-3  # cosine of an elevation: a dome's beam may look straight up
# One surface to the left and right: how much 1 / range changes from one to the other at most, and how far from straight
# it goes on to the next known pixel on either side, as a share of that change and of 1 / range. Chosen on streets: an
# edge bends by all of the change, and there the mean errs least; what is drawn is one or the other, by half of BEND.
STEEP, BEND, LEAST = 0.2, 1.0, 0.01


class Candidates(NamedTuple):
    """Range codes (B, 10, H, W) and reflectances (B, 6, H, W); and how near the known pixels are (B, 4, H, W).

    `near`: 1 / (1 + distance) in pixels to the known return above, below, left and right, 0 for none.
    """

    code: Tensor
    reflectance: Tensor
    near: Tensor


@torch.no_grad()
def candidates(
    metres: Tensor, reflectance: Tensor, returned: Tensor, lit: Tensor, rays: Rays, bend: float = BEND
) -> Candidates:
    """Hypotheses from the known returns.

    metres, reflectance (B, 1, H, W), looked at where `returned` and `lit` (B, 1, H, W) bool: a known return, and one
    of known reflectance. A pixel without any hypothesis gets the ground's range, or a reflectance of 0.25. All of a
    known pixel's are what is known: the work is done for the others.
    """
    around = _nearest(returned)
    codes = _laid(_codes(metres, around, rays, bend), encode_range(metres), returned, around.place)
    near = _laid(around.found / (1 + around.distance), torch.ones_like(metres), returned, around.place)
    around = around if _same(lit, returned) else _nearest(lit)
    return Candidates(codes, _laid(_reflectances(reflectance, around), reflectance, lit, around.place), near)


class _Around(NamedTuple):
    """The N pixels that are to be filled, and the known ones around each.

    place (N,) in the flattened batch; found, distance, source (4, N): whether there is a known pixel above, below, left
    and right, how many pixels away, and its flat index; nearest (N,): the flat index of the nearest known one within
    two rows, by those to the left and right in each, where `some` (N,) says that there is one; sides: of all pixels.
    """

    place: Tensor
    found: Tensor
    distance: Tensor
    source: Tensor
    nearest: Tensor
    some: Tensor
    sides: _Sides


def _codes(metres: Tensor, around: _Around, rays: Rays, bend: float) -> Tensor:
    """(10, N) range codes."""
    found, distance, source = around.found, around.distance, around.source
    r, tilt = metres.flatten()[source], rays.elevation.expand_as(metres).flatten()
    e, elevation = tilt[source], tilt[around.place]
    wall = torch.cat([r[:2] * (e[:2].cos() / elevation.cos().clamp_min(STEEPEST)), r[2:]])
    ground = r[:2] * e[:2].sin().clamp(max=-AT_LEAST) / elevation.sin().clamp(max=-AT_LEAST)
    usable = found[:2] & (e[:2] < -LOW) & (elevation < -0.8 * LOW)
    code = encode_range(r)
    cross = _mean(code, found, distance, encode_range(rays.ground.expand_as(metres).flatten()[around.place]))
    # by angle between the beams above and below: linear in code, and in 1/r, which is exact on any plane; without beams
    # above and below, in 1/r between the columns to the left and right
    share = ((e[0] - elevation) / (e[0] - e[1]).clamp_min(1e-6)).clamp(0, 1)
    both = found[0] & found[1]
    one = torch.where(found[0], code[0], torch.where(found[1], code[1], cross))
    column = torch.where(both, code[0] * (1 - share) + code[1] * share, one)
    inverse = (1 - share) / r[0].clamp_min(0.1) + share / r[1].clamp_min(0.1)
    turn = distance[2] / (distance[2] + distance[3]).clamp_min(1)
    beside = encode_range(1 / ((1 - turn) / r[2].clamp_min(0.1) + turn / r[3].clamp_min(0.1)))
    across = torch.where(found[2] & found[3] & ~found[0] & ~found[1], beside, column)
    plane = torch.where(both, encode_range(1 / inverse), across)
    sides = torch.where(found, encode_range(wall), cross)
    grounds = torch.where(usable, encode_range(ground.clamp(0.1, 250.0)), plane)
    nearest = torch.where(around.some, encode_range(metres.flatten()[around.nearest]), sides[2])
    if is_exporting() or bool((found[2] & found[3]).any()):
        flat = _one_surface(metres, around, bend)  # there all that is taken over from the side would make steps
        sides = torch.cat([sides[:2], torch.where(flat, beside, sides[2:])])
        nearest = torch.where(flat, beside, nearest)
    return torch.cat([torch.stack([cross, column, plane]), sides, grounds, nearest[None]])


def _one_surface(metres: Tensor, around: _Around, most: float) -> Tensor:
    """(N,) bool: whether the pixels to the left and right lie on one plane, along which 1 / range is straight.

    most  how far from straight, as a share of the change from left to right
    """
    beyond, apart = _beyond(around)
    left, right, before, after = (1 / metres.flatten()[torch.cat([around.source[2:], beyond])]).clamp(max=10)
    between = (around.distance[2] + around.distance[3]).clamp_min(1)
    step = right - left
    bends = ((left - before) / apart[0] * between - step, (after - right) / apart[1] * between - step)
    bend = torch.minimum(bends[0].abs(), bends[1].abs())
    straight = (step.abs() < STEEP * left) & (bend < most * step.abs() + LEAST * left)
    return around.found[2] & around.found[3] & straight


def _reflectances(reflectance: Tensor, around: _Around) -> Tensor:
    """(6, N) reflectances."""
    f = reflectance.flatten()[around.source]
    cross = _mean(f, around.found, around.distance, f.new_full((), 0.25))
    nearest = torch.where(around.some, reflectance.flatten()[around.nearest], cross)
    return torch.cat([cross[None], torch.where(around.found, f, cross), nearest[None]])


def _mean(values: Tensor, found: Tensor, distance: Tensor, other: Tensor) -> Tensor:
    """(N,) the mean of the four sides by nearness, `other` where there is none."""
    weight = found / distance.clamp_min(1)
    total = weight.sum(0)
    return torch.where(total > 0, (weight * values).sum(0) / total.clamp_min(1e-9), other)


def _laid(values: Tensor, known: Tensor, where: Tensor, place: Tensor) -> Tensor:
    """(B, C, H, W): values (C, N) at their places, and `known` (B, 1, H, W) in all channels `where` it is known."""
    shape = (len(values), len(known), *known.shape[2:])
    if is_exporting():  # there all pixels are places
        return torch.where(where, known, values.view(shape).transpose(0, 1))
    whole = known.transpose(0, 1).expand(shape).flatten(1)
    return whole.index_copy(1, place, values).view(shape).transpose(0, 1)


def _same(lit: Tensor, returned: Tensor) -> bool:
    """Whether all known returns are lit; an exported network cannot ask."""
    return lit is returned or (not is_exporting() and torch.equal(lit, returned))


def _nearest(known: Tensor) -> _Around:
    """The known pixels (B, 1, H, W) around all others; in an exported network, of fixed shapes, around all pixels."""
    height, width = known.shape[2:]
    sides = _sides(known[:, 0])
    every = torch.arange(known.numel(), device=known.device)
    place = every if is_exporting() else every[~known.flatten()]
    row, column, up, down, left, right = (part.flatten()[place] for part in sides)
    found = torch.stack([up >= 0, down < height, left >= -width, right < 2 * width])
    distance = torch.stack([row - up, down - row, column - left, right - column])
    rows = torch.stack([up - row, down - row]) * width
    columns = torch.stack([_turned(left, width), _turned(right, width)]) - column
    source = place + torch.where(found, torch.cat([rows, columns]), 0)
    some, nearest = _nearest_at_all(place, row, sides)
    return _Around(place, found, distance.float(), source, nearest, some, sides)


def _beyond(around: _Around) -> tuple[Tensor, Tensor]:
    """The known pixel to the left of that to the left, and to the right of that to the right, (2, N) flat indices; and
    how many columns lie between."""
    beside, sides = around.source[2:], around.sides
    width = sides.row.shape[2]
    column = sides.column.flatten()[beside]
    start, one = beside - column, torch.tensor([[-1], [1]], device=beside.device)
    before, after = start + _turned(column + one, width)
    there = torch.stack([sides.before.flatten()[before], sides.after.flatten()[after]])
    there = _turned(there, width).clamp(0, width - 1)  # of a row without any it would be outside
    apart = (column - there) * -one
    return start + there, (apart + width * (apart <= 0).int()).float()


def _nearest_at_all(place: Tensor, row: Tensor, sides: _Sides) -> tuple[Tensor, Tensor]:
    """`nearest` and `some` of `_Around`, the latter first; of equally near ones the earlier shift's, left before right.

    In a row the nearest one is that to the left or that to the right, the same for whoever looks from another row.
    """
    height, width = sides.row.shape[1:]
    left, right = sides.column - sides.before, sides.after - sides.column
    step = torch.where(left <= right, _turned(sides.before, width), _turned(sides.after, width)) - sides.column
    away = torch.where(sides.before >= -width, 8 * torch.minimum(left, right).square(), NOWHERE).flatten()
    shift = torch.tensor(SHIFTS, dtype=torch.int32, device=place.device)[:, None]  # (5, 1) against (N,)
    inside = (row + shift >= 0) & (row + shift < height)
    beside = torch.where(inside, place + shift * width, place)
    turn = torch.arange(len(SHIFTS), dtype=torch.int32, device=place.device)[:, None]
    best = torch.where(inside, away[beside] + (8 * shift.square() + turn), NOWHERE).amin(0)
    some = best < NOWHERE
    there = torch.where(some, place + shift[best.remainder(8).clamp(max=len(SHIFTS) - 1).long(), 0] * width, place)
    return some, torch.where(some, there + step.flatten()[there], place)


class _Sides(NamedTuple):
    """Of each pixel, (B, H, W) int32: its row and column; the row of the nearest known one above and below; the column
    of that to the left and right.

    -1 and H where the column has none; columns count on around the turn, and lie a turn beyond it where a row has none.
    """

    row: Tensor
    column: Tensor
    above: Tensor
    below: Tensor
    before: Tensor
    after: Tensor


def _sides(known: Tensor) -> _Sides:
    height, width = known.shape[1:]
    rows = torch.arange(height, dtype=torch.int32, device=known.device)[:, None].expand(known.shape)
    columns = torch.arange(width, dtype=torch.int32, device=known.device).expand(known.shape)
    above = last_known(torch.where(known, rows, -1), 1)
    below = height - 1 - last_known(torch.where(known, height - 1 - rows, -1).flip(1), 1).flip(1)
    before = last_known(torch.where(known, columns, -1), 2)
    after = width - 1 - last_known(torch.where(known, width - 1 - columns, -1).flip(2), 2).flip(2)
    before = torch.where(before < 0, before[..., -1:] - width, before)
    after = torch.where(after >= width, after[..., :1] + width, after)
    return _Sides(rows, columns, above, below, before, after)


def _turned(column: Tensor, width: int) -> Tensor:
    """Columns of -width to 2 width - 1 as those of the turn."""
    return column + width * ((column < 0).int() - (column >= width).int())
