"""RePaint: completion with an unconditional denoiser (Lugmayr et al. 2022; R2DM eq. 5)."""

from collections.abc import Iterator
from itertools import pairwise

import torch
from torch import Tensor

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.samplers import Grid, Rng, State, Step, ddpm, even_times, noise_like, times_for
from lidarsynth.diffusion.schedule import renoise


@torch.no_grad()
def repaint(
    denoiser: Denoiser,
    x_1: Tensor,  # (B, C, H, W) noise, see samplers.starting_noise
    known: Tensor,  # (B, C, H, W) in [-1, 1]; unknown pixels may hold anything
    mask: Tensor,  # (B, C, H, W) or (B, 1, H, W), bool or 0 / 1; 1 = known
    rng: Rng,
    step: Step = ddpm,
    steps: int = 32,  # T, intervals of time
    resamples: int = 10,  # n, passes over each interval (harmonisation); the last interval has one
    jump: int = 1,  # J, sub-steps of an interval
    grid: Grid = even_times,
) -> Iterator[State]:
    """Complete known pixels: each step joins the noised known pixels with the step's unknown pixels.

    Each interval of time but the last is passed n times, going back by fresh noise in between, so that the new pixels
    come to agree with the known ones. Yields a state per step, evaluations(T, n, J) in all; x_s of the last is the
    result, in which known pixels still carry noise of sigma_0: put the measured values back. Multistep methods take
    every step as a first one here, since the join breaks the path of their earlier estimates.
    Raises ValueError when shapes do not fit, the mask is not 0 / 1, or a count is below 1.

    Example:
        >>> rng = generators(seed=0, count=1)
        >>> x_1 = starting_noise(denoiser, known, rng)
        >>> *_, last = repaint(denoiser, x_1, known, mask, rng)
        >>> x_0 = torch.where(mask, known, last.x_s.clamp(-1, 1))
    """
    check(x_1, known, mask, steps, resamples, jump)
    times = times_for(grid(denoiser.schedule, steps), x_1)
    mask = mask.bool()
    x, index = x_1, 0
    for interval, (start, end) in enumerate(pairwise(times)):
        marks = [torch.lerp(start, end, part / jump) for part in range(jump + 1)]
        for resample in range(resamples if interval < steps - 1 else 1):
            if resample > 0:
                for s, t in pairwise(reversed(marks)):
                    x = renoise(denoiser.schedule, x, s, t, noise_like(x, rng))
            for t, s in pairwise(marks):
                state = joined_step(denoiser, x, known, mask, t, s, rng, step, index)
                yield state
                x, index = state.x_s, index + 1


def joined_step(
    denoiser: Denoiser,
    x_t: Tensor,
    known: Tensor,
    mask: Tensor,  # bool
    t: Tensor,
    s: Tensor,
    rng: Rng,
    step: Step,
    index: int,
) -> State:
    """R2DM eq. 5: x_s = m * known_s + (1 - m) * unknown_s, where known_s ~ q(x_s | known). Draws known noise first."""
    _, alpha_s, sigma_s = denoiser.schedule.at(s, x_t)
    known_s = alpha_s * known + sigma_s * noise_like(x_t, rng)
    unknown_s, x_0_hat = step(denoiser, x_t, t, s, rng, None)
    return State(index, t, s, x_t, torch.where(mask, known_s, unknown_s), x_0_hat)


def evaluations(steps: int = 32, resamples: int = 10, jump: int = 1) -> int:
    """Number of steps that repaint takes: ((T - 1) n + 1) J; 311 for R2DM's 32 x 10."""
    return ((steps - 1) * resamples + 1) * jump


def check(x_1: Tensor, known: Tensor, mask: Tensor, steps: int, resamples: int, jump: int) -> None:
    """Raise ValueError unless the arguments of repaint fit together."""
    shape = tuple(x_1.shape)
    if known.shape != x_1.shape:
        raise ValueError(f"known must have the shape of x_1, {shape}, got {tuple(known.shape)}")
    one_channel = (shape[0], 1, *shape[2:])
    if tuple(mask.shape) not in (shape, one_channel):
        raise ValueError(f"mask must be {shape} or {one_channel}, got {tuple(mask.shape)}")
    if not bool(((mask == 0) | (mask == 1)).all()):
        raise ValueError("mask must hold 0 (unknown) and 1 (known) only, got other values")
    if min(steps, resamples, jump) < 1:
        raise ValueError(f"steps, resamples and jump must be at least 1, got {steps}, {resamples}, {jump}")
