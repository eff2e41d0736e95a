"""The last known place up to each along an axis; an exported network has no running maximum, and counts instead."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from lidarsynth.networks.exporting import is_exporting

LONGEST = 4096  # columns of an exported network whose number of columns is open


def last_known(place: Tensor, dim: int) -> Tensor:
    """The last known place up to each along an axis, -1 before the first.

    place  integers: where a place is known, its number along `dim`, else -1
    """
    return counted(place, dim) if is_exporting() else place.cummax(dim).values


def counted(place: Tensor, dim: int) -> Tensor:
    """`last_known` by a table: the n-th known place stands at n, and whoever has n known ones up to it looks there."""
    before = (*[0] * (2 * (place.ndim - 1 - dim % place.ndim)), 1, 0)  # `pad` begins with the last axis
    count = (place >= 0).cumsum(dim, dtype=torch.int64)
    table = F.pad(place, before, value=-1).scatter(dim, torch.where(place >= 0, count, 0), place)
    return table.gather(dim, count)
