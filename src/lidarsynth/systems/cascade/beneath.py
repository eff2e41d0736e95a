"""Holes that reach the lowest beam: rays below all that is known of their columns.

Recorded scans lack returns in such places, where a carrier stands that nobody has described, and so the fill has
learned to leave them empty. But who tells which rays found nothing has hidden those that are not told. Chosen on
training scans and synthetic streets (docs/completion.md).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from lidarsynth.networks.fill_unet import Filled, Known, ring

# Shares: of a beam's rays that are known, of these that returned, and of all known ones that found nothing; and columns
# on either side without a known ray.
KNOWN, RETURNED, NOTHING, REACH = 0.5, 0.5, 0.002, 2


def certain(filled: Filled, known: Known, blocked: Tensor | np.ndarray | None) -> Filled:
    """What the network made of known pixels (B, 1, H', W'), with those that return whatever it says: of a scan without
    reflectance, which gets one, what was measured; and with `blocked` rays (H, W) bool what is `beneath`."""
    there = known.told & known.returned & ~known.lit
    if blocked is not None:
        blocked = torch.from_numpy(blocked.copy()) if isinstance(blocked, np.ndarray) else blocked
        (height, width), size = blocked.shape[-2:], there.shape
        below = beneath(known.told[..., :height, :width], known.returned[..., :height, :width], blocked)
        there = there | F.pad(below, (0, size[3] - width, 0, size[2] - height))
    return filled._replace(logit=torch.where(there.to(filled.logit.device), torch.inf, filled.logit))


def beneath(told: Tensor, returned: Tensor, closed: Tensor) -> Tensor:
    """(B, 1, H, W) bool: rays of a hole from a known return down to the lowest beam, where most known ones of their
    beam returned; none of an image of which no known ray found nothing, as where returns are all that is known.

    told, returned, closed  (B, 1, H, W) bool, the last maybe (H, W): rays of which something is known, those of them
                            that returned, and those that are known to be blocked
    """
    free, closed = told & ~closed, closed.expand(told.shape)
    count, back = (part.sum(3, keepdim=True) for part in (free, free & returned))
    most = (count >= KNOWN * (~closed).sum(3, keepdim=True)) & (back >= RETURNED * count)
    without = (free & ~returned).sum((2, 3), keepdim=True) > NOTHING * free.sum((2, 3), keepdim=True)
    below = (free.flip(2).cumsum(2).flip(2) == 0) & ((free & returned).cumsum(2) > 0) & ~told & ~closed
    return below & _wide(told) & most & without


def _wide(told: Tensor) -> Tensor:
    """(B, 1, H, W) bool: pixels in, or beside the middle of, five columns of a row of which nothing is told."""
    return _beside(~_beside(told))


def _beside(part: Tensor) -> Tensor:
    """(B, 1, H, W) bool: whether any pixel within REACH columns is of the part, (B, 1, H, W) bool."""
    around, width = ring(part, REACH), part.shape[3]
    found = part
    for first in range(2 * REACH + 1):
        found = found | around[..., first : first + width]
    return found
