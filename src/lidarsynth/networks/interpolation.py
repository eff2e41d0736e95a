"""Interpolation of unknown pixels, alone the baseline of R2DM's table IV and the start of the conditional network.

Images are equirectangular: the width is circular, the height has ends. None of this is differentiable in the mask.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.networks.exporting import is_exporting
from lidarsynth.networks.running import last_known

METHODS = ("nearest", "bilinear", "bicubic")
RESIZED = tuple(f"resized-{method}" for method in METHODS)  # as images are enlarged: see `resize_rows`


@torch.no_grad()
def fill_in(known: Tensor, mask: Tensor) -> Tensor:
    """Fills unknown pixels from the nearest known pixel up, down, left and right, weighted by inverse distance.

    `known` (B,C,H,W) holds values where `mask` (B,C,H,W) is not 0; the rest of it is ignored. Known pixels stay. Where
    whole rows are known this is linear interpolation between them, constant beyond the outer ones. Pixels that see no
    known pixel take part in a second pass over the filled image, so one known pixel fills a channel; a channel with
    none is 0. Distances are in pixels. Raises ValueError if the shapes differ.
    """
    known, mask = _check(known, mask)
    filled, seen = _fill_cross(known, mask)
    if not is_exporting() and bool((seen | ~mask.flatten(2).any(2)[:, :, None, None]).all()):
        return filled
    return _fill_cross(filled, seen)[0]


@torch.no_grad()
def interpolate(known: Tensor, mask: Tensor, method: str = "bilinear") -> Tensor:
    """Baselines "nearest", "bilinear" and "bicubic" for any mask; known pixels stay, a channel without any is 0.

    `known` (B,C,H,W), `mask` (B,C,H,W) as in `fill_in`. If every row is either known or unknown, rows are interpolated
    between the true places of the known rows, whatever their spacing; beyond the outer ones their values repeat.
    Bicubic has a = -0.75 like torch and OpenCV and can overshoot [-1,1]; clamp if that matters.
    For other masks "nearest" is the nearest known pixel, and "bilinear" and "bicubic" both are `fill_in`.
    Raises ValueError for another method or if the shapes differ.
    """
    known, mask = _check(known, mask)
    _check_method(method)
    rows = mask.all(3)
    if torch.equal(rows, mask.any(3)):
        return torch.where(mask, known, _interpolate_rows(known, rows, method))
    return _nearest(known, mask, known.shape[3])[0] if method == "nearest" else fill_in(known, mask)


class Interpolation(nn.Module):
    """`interpolate` by one method as a module: without parameters, there is nothing to learn."""

    def __init__(self, method: str):
        super().__init__()
        _check_method(method)
        self.method = method

    def forward(self, known: Tensor, mask: Tensor) -> Tensor:
        return interpolate(known, mask, self.method)


def resize_rows(x: Tensor, height: int, method: str = "bilinear") -> Tensor:
    """Enlarges (B,C,h,W) to (B,C,height,W) as OpenCV and torch resize images: LiDARGen's baselines.

    Pixel centres stay where they are in the whole, so the rows come back moved: row i of h by (height/h - 1) / 2.
    Raises ValueError for another method.
    """
    _check_method(method)
    corners = None if method == "nearest" else False
    return F.interpolate(x, size=(height, x.shape[3]), mode=method, align_corners=corners)


def sample_queries(x: Tensor, queries: Tensor, method: str = "bilinear") -> Tensor:
    """Values (B,C,Q) of the image (B,C,H,W) at `queries` (Q,2), (vertical, horizontal) in [-1,1] (ILN's baselines).

    -1 and 1 are the outer edges of the border pixels; borders repeat, the width is not circular.
    Raises ValueError for another method.
    """
    _check_method(method)
    grid = queries.flip(-1).expand(len(x), 1, -1, -1)
    return F.grid_sample(x, grid, mode=method, padding_mode="border", align_corners=False)[:, :, 0]


@torch.no_grad()
def nearest_along_axes(known: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest known pixel to the left, to the right, above and below each pixel, itself where it is known.

    `known` and `mask` (B,C,H,W) as in `fill_in`. Returns values (4,B,C,H,W), 0 where there is none, and whether there
    is one, bool of that shape. Left and right go around the ring. Raises ValueError if the shapes differ.
    """
    known, mask = _check(known, mask)
    upright = [tensor.transpose(2, 3).contiguous() for tensor in (known, mask)]
    left, right = _nearest_sides(known, mask, ring=True)
    above, below = ((v.transpose(2, 3), f.transpose(2, 3)) for v, f in _nearest_sides(*upright, ring=False))
    values, found = zip(left, right, above, below, strict=True)
    return torch.stack(values), torch.stack(found)


@torch.no_grad()
def nearest_around(known: Tensor, mask: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """The known pixel nearest to each pixel in any direction, itself where it is known, if within `radius` pixels.

    `known` and `mask` (B,C,H,W) as in `fill_in`. Returns values (B,C,H,W), 0 where there is none, and whether there is
    one, bool of that shape. Distances are Euclidean and go around the ring. Raises ValueError if the shapes differ.
    """
    known, mask = _check(known, mask)
    value, distance = _nearest(known, mask, radius)
    found = distance <= radius**2
    return value * found, found


def _nearest_sides(known: Tensor, mask: Tensor, ring: bool) -> list[tuple[Tensor, Tensor]]:
    """Values and whether there is one, of the nearest known pixel before and after along the last axis."""
    size = known.shape[-1]
    _, before, after = _sides(mask)
    if ring:
        before = torch.where(before < 0, before[..., -1:], before)
        after = torch.where(after >= size, after[..., :1], after)
    sides = []
    for place in (before, after):
        found = (place >= 0) & (place < size)
        sides.append((known.gather(-1, place.clamp(0, size - 1).long()) * found, found))
    return sides


def _fill_cross(known: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """One pass: the filled image and which of its pixels are now known."""
    values, weights = _neighbours(known, mask, ring=True)
    # rows last in memory: scans along the last axis are several times faster
    up_down = (tensor.transpose(2, 3).contiguous() for tensor in (known, mask))
    values_up_down, weights_up_down = _neighbours(*up_down, ring=False)
    values += values_up_down.transpose(2, 3)
    weights += weights_up_down.transpose(2, 3)
    filled = torch.where(mask, known, values / weights.clamp_min(1e-12))
    return filled, mask | (weights > 0)


def _neighbours(known: Tensor, mask: Tensor, ring: bool) -> tuple[Tensor, Tensor]:
    """Sums of value/distance and of 1/distance over the nearest known pixel on either side along the last axis."""
    size = known.shape[-1]
    position, before, after = _sides(mask)
    values, weights = torch.zeros_like(known), torch.zeros_like(known)
    for nearest, missing, turn in ((before, before < 0, -size), (after, after >= size, size)):
        index = nearest
        if ring:  # nothing left until the border: the pixel at the other end, one turn away
            other_end = before[..., -1:] if turn < 0 else after[..., :1]
            index = torch.where(missing, other_end, nearest)
            nearest = torch.where(missing, other_end + turn, nearest)
            missing = (other_end < 0) | (other_end >= size)
        weight = 1 / (position - nearest).abs().clamp_min(1).to(known.dtype)
        weight = weight.masked_fill(missing, 0)
        values.addcmul_(known.gather(-1, index.clamp(0, size - 1).long()), weight)
        weights += weight
    return values, weights


def _sides(mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Along the last axis: every position, the last known one up to it (or -1), the first known from it (or size)."""
    size = mask.shape[-1]
    position = torch.arange(size, device=mask.device, dtype=torch.int32)
    before = last_known(torch.where(mask, position, -1), -1)
    after = size - 1 - last_known(torch.where(mask.flip(-1), position, -1), -1).flip(-1)
    return position, before, after


def _interpolate_rows(known: Tensor, rows: Tensor, method: str) -> Tensor:
    """Interpolates between the known `rows` (B,C,H); all weights are per row, so the width plays no part."""
    count = rows.sum(2, keepdim=True)
    order = torch.argsort((~rows).byte(), dim=2, stable=True)  # the known rows first, from top to bottom
    position = torch.arange(rows.shape[2], device=rows.device)
    previous = torch.minimum(rows.cumsum(2) - 1, count - 2).clamp_min(0)
    following = torch.minimum(previous + 1, (count - 1).clamp_min(0))
    start, end = order.gather(2, previous), order.gather(2, following)
    # fractional index among the known rows, beyond the outer ones in the spacing of their neighbours
    place = previous + (position - start) / (end - start).clamp_min(1)
    result = torch.zeros_like(known)
    for index, weight in _taps(place, method):
        index = torch.minimum(index.long(), count - 1).clamp_min(0)
        source = order.gather(2, index)[..., None].expand_as(known)
        result += weight[..., None] * known.gather(2, source)
    return result * (count > 0)[..., None]


def _taps(place: Tensor, method: str) -> list[tuple[Tensor, Tensor]]:
    """Indices to read for a fractional index, and their weights; the caller repeats the border."""
    if method == "nearest":
        return [(torch.ceil(place - 0.5), torch.ones_like(place))]
    floor = place.floor()
    fraction = place - floor
    if method == "bilinear":
        return [(floor, 1 - fraction), (floor + 1, fraction)]
    return [(floor + offset, _cubic((fraction - offset).abs())) for offset in (-1, 0, 1, 2)]


def _cubic(distance: Tensor, a: float = -0.75) -> Tensor:
    """Cubic convolution kernel (Keys 1981)."""
    near = ((a + 2) * distance - (a + 3)) * distance**2 + 1
    far = ((a * distance - 5 * a) * distance + 8 * a) * distance - 4 * a
    return torch.where(distance <= 1, near, far)


def _nearest(known: Tensor, mask: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """Value of the nearest known pixel and its squared distance, exact up to `radius`; 0 in a channel without any.

    Euclidean distance transform, columns first, then around the ring.
    """
    position, before, after = _sides(mask.transpose(2, 3).contiguous())
    height, width = known.shape[2:]
    take_after = (after < height) & ((before < 0) | (after - position < position - before))
    source = torch.where(take_after, after, before)
    distance = (source - position).float().square().masked_fill((source < 0), torch.inf).transpose(2, 3)
    value = known.gather(2, source.clamp(0, height - 1).long().transpose(2, 3))
    best, best_value = distance, value
    empty = ~mask.flatten(2).any(2)[:, :, None, None]
    for shift in range(1, min(radius, width // 2) + 1):
        if not is_exporting() and not bool(((best > shift**2) & ~empty).any()):
            break  # an exported network cannot ask; further shifts change nothing
        for signed in (shift, -shift):
            candidate = distance.roll(signed, 3) + shift**2
            closer = candidate < best
            best = torch.where(closer, candidate, best)
            best_value = torch.where(closer, value.roll(signed, 3), best_value)
    return best_value.masked_fill(empty, 0), best


def _check(known: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Zero where unknown, and a boolean mask."""
    if known.ndim != 4 or known.shape != mask.shape:
        raise ValueError(f"known and mask must both be (B, C, H, W), got {tuple(known.shape)} and {tuple(mask.shape)}")
    mask = mask != 0
    return torch.where(mask, known, 0), mask


def _check_method(method: str) -> None:
    if method not in METHODS:
        raise ValueError(f"method must be one of {METHODS}, got {method!r}")
