"""GAN inversion: the latent whose image agrees with the measured pixels, and with it completion (auto-decoding).

Losses, latent steps and learning rates of the DUSty v2 demonstration (Nakashima et al., WACV 2023).
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.networks.gan.inverse_depth import to_depth
from lidarsynth.networks.gan.layers import BINOMIAL_3, Pad

_TINY = 1e-9


@dataclass(frozen=True)
class Fit:
    """One step of an inversion, before the update that its loss leads to."""

    step: int
    latents: Tensor  # (B,...), a copy
    inverse: Tensor  # min_depth / depth in [0,1], (B,1,H,W), before ray-drop
    loss: Tensor  # (B,)


def invert(
    render: Callable[[Tensor], Tensor],  # latents (B,...) -> images before ray-drop in [-1,1], (B,1,H,W)
    latents: Tensor,  # where to start: the mean style of many latents, or latents themselves
    reference: Tensor,  # min_depth / depth in [0,1], (B,1,H,W); 0 where nothing was measured
    mask: Tensor,  # (B,1,H,W), 1 where the reference counts and is positive: the known pixels of a completion
    limits: tuple[float, float],  # min_depth and max_depth, metres
    steps: int = 500,
    learning_rate: float = 0.05,
    project: Callable[[Tensor], Tensor] | None = None,  # after each step, `unit_rms` for latents z
    spread: float = 0.0,  # weight of `geocross`, 5e-3 for latents W+
) -> Iterator[Fit]:
    """Yields `steps` + 1 fits, better and better, of images to measured pixels: stage 1 of DUSty v2's inversion.

    The last fit is rendered from the final latents. The network behind `render` is not changed.
    """
    latents = latents.detach().clone().requires_grad_()
    optimizer = torch.optim.Adam([latents], lr=learning_rate)
    for step in range(steps + 1):
        inverse, loss = reconstruction(render(latents), reference, mask, limits)
        loss = loss + spread * geocross(latents) if spread else loss
        yield Fit(step, latents.detach().clone(), inverse.detach(), loss.detach())
        if step == steps:
            return
        optimizer.param_groups[0]["lr"] = learning_rate * learning_rate_factor(step / steps)
        (latents.grad,) = torch.autograd.grad(loss.sum(), latents)
        optimizer.step()
        if project is not None:
            with torch.no_grad():
                latents.copy_(project(latents))


def tune(
    network: nn.Module,  # changed in place: give a copy
    render: Callable[[Tensor], Tensor],  # through that network, as in `invert`
    latents: Tensor,
    reference: Tensor,
    mask: Tensor,
    limits: tuple[float, float],
    steps: int = 500,
    learning_rate: float = 5e-4,
) -> Iterator[Fit]:
    """Stage 2, pivotal tuning: latents stay, all weights of the network follow the same loss; yields as `invert`."""
    optimizer = torch.optim.Adam(network.parameters(), lr=learning_rate)
    for step in range(steps + 1):
        inverse, loss = reconstruction(render(latents), reference, mask, limits)
        yield Fit(step, latents.detach().clone(), inverse.detach(), loss.detach())
        if step == steps:
            return
        optimizer.zero_grad()
        loss.sum().backward()
        optimizer.step()


def reconstruction(
    image: Tensor, reference: Tensor, mask: Tensor, limits: tuple[float, float]
) -> tuple[Tensor, Tensor]:
    """Images in [-1,1] -> inverse depth in [0,1], (B,1,H,W), and the distance to the reference in both depths, (B,)."""
    inverse = ((image + 1) / 2).clamp(0, 1)
    depth, true_depth = (to_depth(x, *limits) for x in (inverse, reference))
    return inverse, multiscale_loss(depth, true_depth, mask) + multiscale_loss(inverse, reference, mask)


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
        generated, reference, mask = (
            *(masked_halve(x, mask) for x in (generated, reference)),
            window(mask).gt(0).to(mask),
        )
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


def _length(x: Tensor) -> Tensor:
    return (x.square().sum(-1) + _TINY).sqrt()


def geocross(w: Tensor) -> Tensor:
    """How far the styles of W+ (B,num_styles,D) lie apart on the sphere: (B,).

    Mean of D^3/8 over all ordered pairs, a style with itself included, D their angle. PULSE (Menon et al. 2020).
    """
    x, y = w[:, :, None], w[:, None]
    angle = 2 * torch.atan2(_length(x - y), _length(x + y))
    return (angle.square() * angle / 8).mean((1, 2))


def unit_rms(latents: Tensor) -> Tensor:
    """Latents (...,D) scaled to root mean square 1 over their last dimension, where N(0,I) concentrates."""
    return latents * torch.rsqrt(latents.square().mean(-1, keepdim=True) + _TINY)


def learning_rate_factor(t: float, ramp_up: float = 0.05, ramp_down: float = 0.25) -> float:
    """Factor of the learning rate at t in [0,1]: linear from 0, then 1, then half a cosine down to 0. StyleGAN2."""
    down = 0.5 - 0.5 * math.cos(math.pi * min(1.0, (1 - t) / ramp_down))
    return down * min(1.0, t / ramp_up)
