"""Points that float: what was filled in between two surfaces goes onto one of them.

At an edge the range of least error may lie between what is before and what is behind, where nothing is. Chosen on
training scans and synthetic streets (docs/completion.md).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from lidarsynth.lidar.scan import RangeImage

# As logarithms of ranges: how far a neighbour of the same surface may be, and one onto whose surface a floating point
# goes.
ALIKE, REACH = math.log(1.03), 1.0
# Of the fourteen neighbours, two columns to either side and a beam up and down: how many are as far as what does not
# float, and as what a floating point goes onto; and what each of these is worth, as a logarithm of ranges.
ALONE, SURFACE, WORTH = 2, 4, 0.06
NOWHERE = -1e3  # logarithm of no range
PLACES = [(down, right) for down in range(3) for right in range(5) if (down, right) != (1, 2)]


def settled(filled: RangeImage, known: RangeImage, told: np.ndarray) -> RangeImage:
    """The filled image, told the pixels `told` (H, W) bool of `known`, what floats on the surfaces beside it."""
    metres = np.where(told, known.range * known.mask, filled.range)
    images = torch.from_numpy(metres)[None, None], torch.from_numpy(told)[None, None]
    return replace(filled, range=np.where(told, filled.range, onto_surfaces(*images)[0, 0].numpy()))


def onto_surfaces(metres: Tensor, told: Tensor) -> Tensor:
    """(B, 1, H, W) metres, 0 for no return. Where not `told` (bool, of the same shape), a return as far as fewer than
    two of its neighbours becomes as far as the one that is near in range and of a surface, where there is one."""
    back, (height, width) = metres > 0, metres.shape[2:]
    far = torch.where(back, metres, 1.0).log().masked_fill(~back, NOWHERE)
    wide, alike = _bordered(far, NOWHERE), torch.zeros_like(far)
    for down, right in PLACES:
        alike = alike + ((wide[:, :, down : down + height, right : right + width] - far).abs() < ALIKE)
    image, _, row, column = torch.nonzero(back & ~told & (alike < ALONE), as_tuple=True)
    first = (image * (height + 2) + row) * (width + 4) + column
    around = first[:, None] + torch.tensor([down * (width + 4) + right for down, right in PLACES], device=first.device)
    near, like = (part.flatten()[around] for part in (wide, _bordered(alike, 0.0)))
    off = (near - far[image, 0, row, column, None]).abs()
    best = torch.where((off < REACH) & (like >= 1), off - WORTH * like, -NOWHERE).argmin(1, keepdim=True)
    near, like, off = (part.gather(1, best)[:, 0] for part in (near, like, off))
    moved = torch.where((off < REACH) & (like >= SURFACE), near.exp(), metres[image, 0, row, column])
    return metres.index_put((image, torch.zeros_like(row), row, column), moved)


def _bordered(part: Tensor, beyond: float) -> Tensor:
    """(B, 1, H + 2, W + 4): two more columns on either side, around the turn, and rows of `beyond` above and below."""
    return F.pad(torch.cat([part[..., -2:], part, part[..., :2]], 3), (0, 0, 1, 1), value=beyond)
