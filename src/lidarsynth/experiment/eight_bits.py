"""Weights in eight bits: half the size of float16, each row of a matrix with a scale of its own."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

SCALE = ":scale"  # after the name of the matrix whose rows' scales a tensor holds
LEAST = 4096  # numbers of a matrix that is worth it
TINY = 1e-12  # of a row of zeros


def packed(weights: Mapping[str, Tensor], names: tuple[str, ...]) -> dict[str, Tensor]:
    """The matrices and kernels whose names begin so, as int8, and the scales (rows,) of their rows.

    A number is off by at most 1/254 of the largest one in its row.
    """
    stored: dict[str, Tensor] = {}
    for name, value in weights.items():
        if name.startswith(names) and value.is_floating_point() and value.ndim > 1 and value.numel() >= LEAST:
            rows = value.float().flatten(1)
            scale = rows.abs().amax(1).clamp_min(TINY) / 127
            stored[name] = (rows / scale[:, None]).round().to(torch.int8).view(value.shape)
            stored[name + SCALE] = scale
    return stored


def unpacked(stored: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """float32 of what `packed` made of them; all other tensors as they are."""
    weights = dict(stored)
    for name, value in stored.items():
        scale = stored.get(name + SCALE)
        if value.dtype == torch.int8 and scale is not None and scale.shape == value.shape[:1]:
            weights[name] = value * scale.view(-1, *(1,) * (value.ndim - 1))
            del weights[name + SCALE]
    return weights
