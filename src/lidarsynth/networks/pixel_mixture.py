"""Pixels drawn by likelihood: whether a ray returns, its range, its reflectance, as mixtures of hypotheses and bins."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.networks.column_neighbours import Grid
from lidarsynth.networks.layers import ColumnLinear

# Lowest, highest, and how many bins between them: of the range code (8 % of the range each) and of reflectance.
CODES, TONES = (-0.9, 1.0, 64), (-0.1, 1.1, 36)
SHARPEST, SHARPEST_SHADE = 0.0005, 0.003  # scales of logistic distributions, of code (2 cm at 10 m) and reflectance


class Drawn(NamedTuple):
    """Of pixels: whether they return, the mixture of their range, and the hidden state (..., D)."""

    returns: Tensor  # (...) logit
    choice: Tensor  # (..., hypotheses + 64) log shares of hypotheses and bins
    centre: Tensor  # (..., hypotheses)
    scale: Tensor  # (..., hypotheses) positive
    hidden: Tensor


class PixelDrawer(nn.Module, ABC):
    """The part of a network that draws single pixels, of what they are told: `pixel`, then `shades`.

    features  how many numbers a pixel is told
    guesses   how many hypotheses of its range; shades: of its reflectance
    """

    def __init__(self, features: int, guesses: int, shades: int, pixel: int, blocks: int):
        super().__init__()
        self.guesses, self.copies = guesses, shades
        self.stem = ColumnLinear(features, pixel)
        self.blocks = nn.ModuleList(Mix(pixel) for _ in range(blocks))
        self.range_head = nn.Sequential(nn.LayerNorm(pixel), ColumnLinear(pixel, 1 + CODES[2] + 3 * guesses))
        self.shade_stem = ColumnLinear(pixel + guesses + 1, pixel // 2)
        self.shade_head = ColumnLinear(pixel // 2, TONES[2] + 3 * shades)

    @abstractmethod
    def forward(self, *args: Tensor) -> Tensor:
        """Negative log-likelihoods (B, 3 or more) of a grid's pixels."""

    def pixel(self, features: Tensor, around: Tensor, hypotheses: Tensor, valid: Tensor) -> Drawn:
        """Of pixels (..., F), told (..., D) of what is around and hypotheses (..., H)."""
        x = self.stem(features) + around
        for block in self.blocks:
            x = block(x)
        count = self.guesses
        returns, choice, shift, scale = self.range_head(x).float().split([1, count + CODES[2], count, count], -1)
        scale = SHARPEST + 0.02 * torch.exp(scale.clamp(-8, 2) - 1)
        return Drawn(returns[..., 0], _among(choice, valid), hypotheses + 0.02 * shift, scale, x)

    def shades(
        self, drawn: Drawn, code: Tensor, hypotheses: Tensor, copies: Tensor, copied: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Log shares (..., S + 36), centres and scales (..., S) of reflectance, told the range code (...)."""
        near = torch.tanh(20 * (code[..., None] - hypotheses))
        x = F.silu(self.shade_stem(torch.cat([drawn.hidden, near, code[..., None]], -1)))
        choice, shift, scale = self.shade_head(x).float().split([self.copies + TONES[2], self.copies, self.copies], -1)
        scale = SHARPEST_SHADE + 0.05 * torch.exp(scale.clamp(-6, 2) - 1)
        return _among(choice, copied), copies + 0.05 * shift, scale

    def unlikelihood(
        self, drawn: Drawn, grid: Grid, hypotheses: Tensor, copies: Tensor, copied: Tensor, free: Tensor
    ) -> Tensor:
        """(B, 3): negative log-likelihoods of returning, range and reflectance, in nats a pixel that is `free`."""
        returned = grid.returned & free
        back = F.binary_cross_entropy_with_logits(drawn.returns, grid.returned.float(), reduction="none")
        far = -mixture(grid.code, drawn.choice, drawn.centre, drawn.scale, CODES)
        shade = grid.shade.clamp(TONES[0] + 1e-4, TONES[1] - 1e-4)
        lit = -mixture(shade, *self.shades(drawn, grid.code, hypotheses, copies, copied), TONES)
        parts = (back * free, torch.where(returned, far, 0), torch.where(returned, lit, 0))
        return torch.stack([part.sum((1, 2)) for part in parts], 1) / free.sum((1, 2)).clamp_min(1)[:, None]


def _among(choice: Tensor, valid: Tensor) -> Tensor:
    """Log shares of scores (..., H + bins), of which the hypotheses that say something (..., H) count."""
    count = valid.shape[-1]
    named = choice[..., :count].masked_fill(~valid, -1e4)
    return torch.cat([named, choice[..., count:]], -1).log_softmax(-1)


class Mix(nn.Module):
    """A residual layer of pixels (..., D)."""

    def __init__(self, width: int):
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.up, self.down = ColumnLinear(width, 2 * width), ColumnLinear(2 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.down(F.silu(self.up(self.norm(x))))


def mixture(x: Tensor, choice: Tensor, centre: Tensor, scale: Tensor, span: tuple[float, float, int]) -> Tensor:
    """Log density of x (...): logistic about the centres, even in each of the bins of a span."""
    low, high, bins = span
    z = (x[..., None] - centre) / scale
    named = choice[..., : centre.shape[-1]] - z - 2 * F.softplus(-z) - scale.log()
    place = ((x - low) / (high - low) * bins).long().clamp(0, bins - 1)
    free = choice[..., centre.shape[-1] :].gather(-1, place[..., None]) + math.log(bins / (high - low))
    return torch.cat([named, free], -1).logsumexp(-1)


def picked(
    choice: Tensor,
    centre: Tensor,
    scale: Tensor,
    u: Tensor,
    sharp: float,
    heat: float,
    span: tuple[float, float, int],
) -> Tensor:
    """One draw (B,) of each `mixture`, by chances u (B, 2); sharp and heat as in `draw`."""
    low, high, bins = span
    shares = (choice / heat).softmax(-1).cumsum(-1)
    chosen = (shares < u[:, :1]).sum(-1, keepdim=True).clamp(max=choice.shape[-1] - 1)
    named = chosen < centre.shape[-1]
    index = chosen.clamp(max=centre.shape[-1] - 1)
    about = centre.gather(-1, index) + sharp * scale.gather(-1, index) * torch.logit(u[:, 1:])
    free = low + (chosen - centre.shape[-1] + u[:, 1:]) * (high - low) / bins
    return torch.where(named, about, free)[:, 0].clamp(low, high)
