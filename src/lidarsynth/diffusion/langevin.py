"""Annealed Langevin dynamics, LiDARGen's sampler, for any denoiser (Song & Ermon 2019, 2020; Zyrianov et al. 2022).

In print a step is x <- x + a score + sqrt(2a) z with a = step_lr (sigma / sigma_last)^2. As score = (alpha x_0_hat - x)
/ sigma^2, and with rate = step_lr / sigma_last^2, it carries x by a share `rate` of the way to the denoiser's estimate:
x <- x + rate (alpha x_0_hat - x) + sqrt(2 rate) sigma z. So it needs no more than a denoiser, does not depend on the
scale of the images, and samples R2DM's network as well: x / alpha is the x of the schedule `ve` with sigma / alpha.

LiDARGen as published: kind "score", schedule `ve` and clip False, images in [0, 1]. For images in [-1, 1] it is the
same with `ve(0.02, 100)`, because the noise grows with the images.
"""

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.repaint import check
from lidarsynth.diffusion.samplers import Grid, Rng, State, even_times, noise_like, times_for

RATE = 0.062  # LiDARGen's step_lr 6.2e-6 over sigma_last^2 = 0.01^2
LEVELS, STEPS = 232, 5


@torch.no_grad()
def langevin(
    denoiser: Denoiser,
    x_1: Tensor,  # (B, C, H, W), see starting_uniform
    rng: Rng,
    levels: int = LEVELS,  # noise levels, from t = 1 to t = 0
    steps: int = STEPS,  # steps at each level
    rate: float = RATE,  # share of the way to alpha x_0_hat, in (0, 1]
    grid: Grid = even_times,  # one of GRIDS; "time" is geometric for `ve`
) -> Iterator[State]:
    """Annealed Langevin dynamics with a final denoising, which is the last state; its x_s is the sample.

    Yields levels * steps + 1 states with a network call each: 1161 as LiDARGen. Between the steps of a level s = t.
    The sample is not clamped. Raises ValueError when a number is out of range.

    Example:
        >>> denoiser = Denoiser(network, ve(), "score", clip=False)
        >>> x_1 = starting_uniform(torch.zeros(4, 2, 64, 1024), rng)
        >>> *_, last = langevin(denoiser, x_1, rng)
        >>> images = last.x_s.clamp(0, 1)
    """
    for state in _anneal(denoiser, x_1, rng, levels, steps, rate, grid, x_1, torch.zeros_like(x_1)):
        yield state
    yield _denoise(denoiser, state, 0)


@torch.no_grad()
def langevin_posterior(
    denoiser: Denoiser,
    x_1: Tensor,  # (B, C, H, W), see starting_uniform
    known: Tensor,  # (B, C, H, W); unknown pixels may hold anything finite
    mask: Tensor,  # (B, C, H, W) or (B, 1, H, W), bool or 0 / 1; 1 = known
    rng: Rng,
    weight: float = 1.0,  # lambda, the pull of the known pixels in every step
    levels: int = LEVELS,
    steps: int = STEPS,
    rate: float = RATE,
    grid: Grid = even_times,
) -> Iterator[State]:
    """Complete known pixels, LiDARGen's densification: every step adds lambda mask (alpha known - x), taken before it.

    Yields the states of `langevin`, whose final denoising repeats the pull of the last step as published, and one more
    after a last pull without a network call: with lambda = 1, known pixels end as given.
    Raises ValueError when shapes do not fit, the mask is not 0 / 1 or a number is out of range.
    """
    check(x_1, known, mask, 1, 1, 1)
    pull = weight * mask.to(x_1.dtype)
    for state in _anneal(denoiser, x_1, rng, levels, steps, rate, grid, known, pull):
        yield state
    _, alpha, _ = denoiser.schedule.at(state.t, x_1)
    last = _denoise(denoiser, state, pull * (alpha * known - state.x_t))
    yield last
    x_0 = last.x_s + pull * (known - last.x_s)
    yield State(last.index + 1, last.s, last.s, last.x_s, x_0, last.x_0_hat)


def starting_uniform(x: Tensor, rng: Rng, low: float = 0.0, high: float = 1.0) -> Tensor:
    """Uniform noise like x (B, C, H, W) between low and high, where LiDARGen starts; drawn as noise_like draws."""
    return low + (high - low) * torch.special.ndtr(noise_like(x, rng))


def evaluations(levels: int = LEVELS, steps: int = STEPS) -> int:
    """Number of network calls, the final denoising included: 1161 for LiDARGen's 232 x 5."""
    return levels * steps + 1


def levels_within(calls: int, steps: int = STEPS) -> int:
    """The most noise levels that `calls` network calls are enough for. Raises ValueError for fewer than two levels."""
    least = evaluations(2, steps)
    if calls < least:
        raise ValueError(
            f"expected at least {least} network calls for langevin, 2 levels of {steps} and 1, found {calls}"
        )
    return (calls - 1) // steps


def _anneal(
    denoiser: Denoiser,
    x: Tensor,
    rng: Rng,
    levels: int,
    steps: int,
    rate: float,
    grid: Grid,
    known: Tensor,
    pull: Tensor,  # lambda * mask; 0 everywhere without known pixels
) -> Iterator[State]:
    _check_numbers(levels, steps, rate)
    times = times_for(grid(denoiser.schedule, levels - 1), x)
    for level, t in enumerate(times):
        _, alpha, sigma = denoiser.schedule.at(t, x)
        for step in range(steps):
            x_0_hat = denoiser(x, t)
            drift = rate * (alpha * x_0_hat - x) + pull * (alpha * known - x)
            x_s, s = x + drift + math.sqrt(2 * rate) * sigma * noise_like(x, rng), t
            if step == steps - 1 and level < levels - 1:
                s = times[level + 1]
                x_s = denoiser.schedule.at(s, x)[1] / alpha * x_s  # 1 for `ve`: x / alpha goes on
            yield State(level * steps + step, t, s, x, x_s, x_0_hat)
            x = x_s


def _denoise(denoiser: Denoiser, last: State, pull: Tensor | float) -> State:
    """Tweedie's formula at the last level: x_0_hat, plus what is pulled."""
    x_0_hat = denoiser(last.x_s, last.s)
    return State(last.index + 1, last.s, last.s, last.x_s, x_0_hat + pull, x_0_hat)


def _check_numbers(levels: int, steps: int, rate: float) -> None:
    if levels < 2 or steps < 1:
        raise ValueError(f"levels must be at least 2 and steps at least 1, got {levels} and {steps}")
    if not 0 < rate <= 1:
        raise ValueError(f"rate must be in (0, 1], got {rate}")
