"""Speckle taken off what is known, before the most likely reflectance is asked for between it."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.networks.fill_unet import ring

# Columns to either side, the natural logarithm of ranges that differ as on one surface, and how far of the way to the
# median, for a sensor whose beams are measured and for others: chosen on streets of other sensors and real training
# scans. More errs less, but classes are read worse from it (docs/completion.md).
REACH, ALIKE, SHARE, ELSEWHERE = 4, 0.2, 0.35, 0.7


def calm(reflectance: np.ndarray, image: RangeImage, known: np.ndarray, share: float = SHARE) -> np.ndarray:
    """`calmed` reflectances (H, W) of an image's known returns, known (H, W) bool; others are 0."""
    lit = known & image.mask
    rows = lit.any(1)
    parts = (torch.from_numpy(part[rows])[None, None] for part in (reflectance, image.range, lit))
    calmer = np.zeros_like(reflectance)
    calmer[rows] = calmed(*parts, share=share)[0, 0].numpy()
    return calmer


def calmed(reflectance: Tensor, metres: Tensor, lit: Tensor, share: float = SHARE) -> Tensor:
    """(B, 1, H, W) reflectances of returns `lit`, each nearer to the median of those around it on its ring that are
    about as far, so that its own speckle does not go on to the beams between; others are 0."""
    width = reflectance.shape[-1]
    reach = min(REACH, (width - 1) // 2)
    far = torch.where(lit, metres.clamp_min(0.1).log(), math.inf)
    around = zip(*(_moved(ring(part, reach), width) for part in (reflectance, far)), strict=True)
    # what is not lit is infinitely far, and alike to nothing: infinity less infinity is nan
    there, values = zip(*(((away - far).abs() < ALIKE, value) for value, away in around), strict=True)
    ranked = _lowest([torch.where(near, value, math.inf) for near, value in zip(there, values, strict=True)], reach + 1)
    middle = ((torch.stack(there).sum(0) - 1) // 2).clamp_min(0)
    median = ranked.gather(0, middle[None])[0]
    return torch.where(lit, torch.lerp(reflectance, torch.where(lit, median, 0.0), share), 0.0)


def _moved(wide: Tensor, width: int) -> list[Tensor]:
    return [wide[..., k : k + width] for k in range(wide.shape[-1] - width + 1)]


def _lowest(rest: list[Tensor], count: int) -> Tensor:
    """(count, ...) the lowest of the values, in their order: of nine, a quarter of the time of a sort."""
    for place in range(count):
        for k in range(len(rest) - 1, place, -1):
            rest[k - 1], rest[k] = torch.minimum(rest[k - 1], rest[k]), torch.maximum(rest[k - 1], rest[k])
    return torch.stack(rest[:count])
