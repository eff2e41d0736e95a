"""Inverse depth as the GANs see it: min_depth / depth, 0 = no return, and the points it stands for.

The published runs have limits 1.45 and 80 metres, both inclusive. Networks work on twice
this minus 1.
"""

import torch
from torch import Tensor

_TINY = 1e-11


def to_inverse_depth(depth: Tensor, min_depth: float, max_depth: float) -> Tensor:
    """Metres -> min_depth / depth in [min_depth / max_depth, 1], any shape; 0 outside the limits."""
    valid = (depth >= min_depth) & (depth <= max_depth)
    return min_depth / (depth + _TINY) * valid


def to_depth(inverse: Tensor, min_depth: float, max_depth: float) -> Tensor:
    """min_depth / depth, nominally in [0,1] -> metres, any shape; 0 where the depth is outside the limits."""
    rate = inverse / min_depth
    valid = (inverse > _TINY) & (rate >= 1 / max_depth) & (rate <= 1 / min_depth)
    return valid / (rate + _TINY)


def to_points(depth: Tensor, angles: Tensor) -> Tensor:
    """Metres (B,1,H,W) along ray angles (1 or B,2,H,W) in radians, elevation first -> x, y, z (B,3,H,W) in metres."""
    elevation, azimuth = angles[:, :1], angles[:, 1:]
    flat = depth * elevation.cos()
    return torch.cat([flat * azimuth.cos(), flat * azimuth.sin(), depth * elevation.sin()], dim=1)
