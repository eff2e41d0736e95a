"""GAN inversion: the latent whose image agrees with the measured pixels, and with it completion (auto-decoding).

Losses, latent steps and learning rates of the DUSty v2 demonstration (facts/gans.md, "Inversion").
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F

from lidarsynth.models.gan_layers import BINOMIAL_3, Pad

_TINY = 1e-9


def relative_distance(generated: Tensor, reference: Tensor) -> Tensor:
    """|reference - generated| / reference, any shape."""
    return (reference - generated).abs() / (reference + 1e-11)


def squared_distance(generated: Tensor, reference: Tensor) -> Tensor:
    """(reference - generated)^2, any shape."""
    return (reference - generated).square()


def multiscale_loss(
    generated: Tensor,
    reference: Tensor,
    mask: Tensor,
    levels: int = 2,
    distance: Callable[[Tensor, Tensor], Tensor] = relative_distance,
) -> Tensor:
    """Mean distance of the valid pixels summed over `levels` resolutions, each half the one before: (B,1,H,W) -> (B,).

    `mask` (B,1,H,W) is 1 where the reference is valid, hence positive, else 0. Raises ValueError if the shapes differ.
    """
    if not generated.shape == reference.shape == mask.shape:
        shapes = [tuple(x.shape) for x in (generated, reference, mask)]
        raise ValueError(f"generated, reference and mask must have one shape (B, 1, H, W), got {shapes}")
    total = _masked_mean(distance(generated, reference), mask)
    for _ in range(levels - 1):
        generated, reference, mask = *(masked_halve(x, mask) for x in (generated, reference)), window(mask).gt(0).to(mask)
        total = total + _masked_mean(distance(generated, reference), mask)
    return total


def _masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    return (mask * values).flatten(1).sum(1) / (mask.flatten(1).sum(1) + 1e-8)


def masked_halve(x: Tensor, mask: Tensor) -> Tensor:
    """Blurs and halves the valid pixels of (B,1,H,W) -> (B,1,H/2,W/2), weighted up where few of 3x3 are valid."""
    taps = torch.tensor(BINOMIAL_3, dtype=x.dtype, device=x.device) / sum(BINOMIAL_3)
    blurred = F.conv2d(Pad(1)(x * mask), torch.outer(taps, taps)[None, None], stride=2)
    count = window(mask)
    return blurred * torch.where(count > 0, 9 / count.clamp(min=1), 0)


def window(mask: Tensor) -> Tensor:
    """How many of the 3x3 pixels around every second pixel are valid: (B,1,H,W) -> (B,1,H/2,W/2)."""
    return F.conv2d(Pad(1)(mask), mask.new_ones(1, 1, 3, 3), stride=2)


def geocross(w: Tensor) -> Tensor:
    """How far the styles of W+ (B,num_styles,D) lie apart on the sphere: (B,).

    Mean of D^3/8 over all ordered pairs, a style with itself included, D their angle. PULSE, equation 5.
    """
    x, y = w[:, :, None], w[:, None]
    angle = 2 * torch.atan2(_length(x - y), _length(x + y))
    return (angle.square() * angle / 8).mean((1, 2))


def _length(x: Tensor) -> Tensor:
    return (x.square().sum(-1) + _TINY).sqrt()


def unit_rms(latents: Tensor) -> Tensor:
    """Latents (...,D) scaled to root mean square 1 over their last dimension, where N(0,I) concentrates."""
    return latents * torch.rsqrt(latents.square().mean(-1, keepdim=True) + _TINY)


def learning_rate_factor(t: float, ramp_up: float = 0.05, ramp_down: float = 0.25) -> float:
    """Factor of the learning rate at t in [0,1]: linear from 0, then 1, then half a cosine down to 0. StyleGAN2."""
    down = 0.5 - 0.5 * math.cos(math.pi * min(1.0, (1 - t) / ramp_down))
    return down * min(1.0, t / ramp_up)
