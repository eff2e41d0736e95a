"""The largest value so far along an axis; an exported network has no operator for it, and takes slices and maxima."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

LONGEST = 4096  # columns of an exported network whose number of columns is open


def running_max(x: Tensor, dim: int, size: int, least: int) -> Tensor:
    """`x.cummax(dim).values` of an integer tensor; in an export by doubling.

    size   the axis' length, or LONGEST where it is not known yet
    least  a value below all others
    """
    if not torch.compiler.is_exporting():
        return x.cummax(dim).values
    return doubled_max(x, dim, size, least)


def doubled_max(x: Tensor, dim: int, size: int, least: int) -> Tensor:
    """`running_max` by doubling: maxima with what lies 1, 2, 4, ... before."""
    before = 2 * (x.ndim - 1 - dim % x.ndim)  # places of `pad` that belong to later axes
    step = 1
    while step < size:
        shifted = F.pad(x, (*[0] * before, step, 0), value=least).narrow(dim, 0, x.shape[dim])
        x = torch.maximum(x, shifted)
        step *= 2
    return x


def size_of(x: Tensor, dim: int) -> int:
    """The axis' length; LONGEST in an export that leaves it open."""
    return x.shape[dim] if isinstance(x.shape[dim], int) else LONGEST
