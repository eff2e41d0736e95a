"""Interpolation of unknown pixels of an equirectangular image: width circular, height with ends."""

import torch
from torch import Tensor
from torch.nn import functional as F


@torch.no_grad()
def fill_in(known: Tensor, mask: Tensor) -> Tensor:
    """Fills unknown pixels from the nearest known pixel up, down, left and right, weighted by inverse distance.

    `known` (B,C,H,W) holds values where `mask` (B,C,H,W) is not 0; the rest of it is ignored. Known pixels stay. Where
    whole rows are known this is linear interpolation between them, constant beyond the outer ones. Pixels that see no
    known pixel take part in a second pass over the filled image, so one known pixel fills a channel; a channel with
    none is 0. Distances are in pixels. Raises ValueError if the shapes differ.
    """
    _check(known, mask)
    mask = mask != 0
    known = torch.where(mask, known, 0)
    filled, seen = _fill_cross(known, mask)
    if bool((seen | ~mask.any(3, keepdim=True).any(2, keepdim=True)).all()):
        return filled
    return _fill_cross(filled, seen)[0]


def _fill_cross(known: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """One pass: the filled image and which of its pixels are now known."""
    weight_sum = torch.zeros_like(known)
    value_sum = torch.zeros_like(known)
    for dim, ring in ((2, False), (3, True)):
        for reverse in (False, True):
            value, weight = _nearest_before(known, mask, dim, ring, reverse)
            weight_sum += weight
            value_sum.addcmul_(value, weight)
    seen = weight_sum > 0
    filled = torch.where(seen, value_sum / weight_sum, 0)
    return torch.where(mask, known, filled), seen | mask


def _nearest_before(known: Tensor, mask: Tensor, dim: int, ring: bool, reverse: bool) -> tuple[Tensor, Tensor]:
    """Value of the nearest known pixel at or before each along `dim`, and 1/distance, or 0 where there is none."""
    if reverse:
        value, weight = _nearest_before(known.flip(dim), mask.flip(dim), dim, ring, reverse=False)
        return value.flip(dim), weight.flip(dim)
    size = known.shape[dim]
    position = torch.arange(size, device=known.device, dtype=torch.int32)  # int32: cummax is 8 times faster than int64
    position = position.view(-1, *[1] * (3 - dim))
    last = torch.where(mask, position, -1).cummax(dim).values
    found = last >= 0
    if ring:  # nothing yet in this row: its last known pixel, one turn away
        around = last.narrow(dim, size - 1, 1)
        last = torch.where(found, last, around - size)
        found = around >= 0
    value = known.gather(dim, torch.remainder(last, size).long())
    distance = (position - last).clamp_min(1).to(known.dtype)
    return value, torch.where(found, 1 / distance, 0)


def _check(known: Tensor, mask: Tensor) -> None:
    if known.ndim != 4 or known.shape != mask.shape:
        raise ValueError(f"known and mask must both be (B, C, H, W), got {tuple(known.shape)} and {tuple(mask.shape)}")
