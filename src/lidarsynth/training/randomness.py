"""Randomness of one sample of a training batch: a function of (seed, step, its position in the global batch)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def sample_rng(seed: int, step: int, position: int, *purpose: int) -> torch.Generator:
    """The generator of one sample, and of one `purpose`; neighbouring keys give unrelated streams."""
    return torch.Generator().manual_seed(sample_seed(seed, step, position, *purpose))


def sample_seed(*key: int) -> int:
    """32 bits of a key: torch's CPU generator uses no more of its seed, so the key is hashed, not added up."""
    return int(np.random.SeedSequence(key).generate_state(1)[0])


def augment(x_0: Tensor, rng: torch.Generator, roll: bool, mirror: bool) -> Tensor:
    """x_0 (2, H, W) turned by any number of columns and mirrored left-right half of the time."""
    shift = int(torch.randint(x_0.shape[-1], (), generator=rng))
    flip = bool(torch.rand((), generator=rng) < 0.5)
    if roll:
        x_0 = torch.roll(x_0, shift, dims=-1)
    return x_0.flip(-1) if mirror and flip else x_0
