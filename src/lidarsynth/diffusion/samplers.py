"""Samplers: one loop that yields its state, and steps that carry x_t from time t to an earlier time s.

A step has the signature `step(denoiser, x_t, t, s, rng, previous) -> (x_s, x_0_hat)`: x (B, C, H, W), times t > s (B,),
`previous` the state before this one (None at the start), of use to multistep methods only.

| name | method | network calls | order |
|---|---|---|---|
| ddpm | ancestral sampling (Ho et al. 2020; R2DM) | 1 | - |
| ddim | DDIM (Song et al. 2021); Euler's step when the schedule is `flow` | 1 | 1 |
| dpmpp-2m | DPM-Solver++(2M) (Lu et al. 2022) | 1 | 2 |
| sde-dpmpp-2m | SDE-DPM-Solver++(2M) (Lu et al. 2022): `ddpm` with the estimate of the line before | 1 | 2 |
| heun | Heun's method, exponential form (Hochbruck & Ostermann 2010) | 2 | 2 |
"""

import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.schedule import Schedule

Rng = torch.Generator | Sequence[torch.Generator] | Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class State:
    """What a sampler knows after a step; all images (B, C, H, W), times (B,). The last state's x_s is the sample."""

    index: int  # number of the step, from 0
    t: Tensor  # the time before the step
    s: Tensor  # the time after it, s < t
    x_t: Tensor  # the noisy images before the step
    x_s: Tensor  # the images after it
    x_0_hat: Tensor  # the clean images as estimated from x_t


Step = Callable[[Denoiser, Tensor, Tensor, Tensor, Rng, State | None], tuple[Tensor, Tensor]]
Grid = Callable[[Schedule, int], Tensor]


def generators(seed: int, count: int, offset: int = 0) -> list[torch.Generator]:
    """One CPU generator per sample: sample i of a run draws from seed + i, here for i = offset .. offset + count - 1.

    With seed 0 these are the generators of R2DM's evaluation (seed = sample index). Draws do not depend on the batch
    size or the device. Seeds beyond 32 bits are mixed down to them, which are all that torch's generator takes.

    Raises ValueError for a seed that is no whole number, or negative.
    """
    seed = checked_seed(seed)
    return [_seeded(seed + offset + index) for index in range(count)]


def checked_seed(seed: int) -> int:
    """The seed as Python's own number. Raises ValueError for one that is no whole number, or negative."""
    try:
        number = operator.index(seed)
    except TypeError:
        raise ValueError(f"expected a seed that is a whole number, found {seed!r}") from None
    if number < 0:
        raise ValueError(f"expected a seed of at least 0, found {number}")
    return number


def _seeded(seed: int) -> torch.Generator:
    if seed >= 1 << 32:
        seed = int(np.random.SeedSequence(seed).generate_state(1)[0])
    return torch.Generator().manual_seed(seed)


def noise_like(x: Tensor, rng: Rng) -> Tensor:
    """Unit Gaussian noise of the shape, dtype and device of x (B, C, H, W).

    rng: one generator for the batch; or B generators, each drawing (C, H, W) in turn, so that a sample does not depend
    on its batch; or any function of x. Generators draw float32 on their own device. Raises ValueError when the number
    of generators is not B.
    """
    if isinstance(rng, torch.Generator):
        return torch.randn(x.shape, generator=rng, device=rng.device).to(x)
    if callable(rng):
        return rng(x)
    if len(rng) != len(x):
        raise ValueError(f"rng must be one generator or {len(x)}, one per sample, got {len(rng)}")
    return torch.stack([torch.randn(x.shape[1:], generator=one, device=one.device) for one in rng]).to(x)


def starting_noise(denoiser: Denoiser, x: Tensor, rng: Rng) -> Tensor:
    """x_1, where sampling begins, like x (B, C, H, W): unit Gaussian noise, times sigma_1 for the schedule `ve`.

    Elsewhere sigma_1 is 1 to three digits or more, and is taken as 1 as in R2DM's program.
    """
    _, _, sigma = denoiser.schedule.at(torch.ones(len(x), device=x.device), x)
    return sigma.clamp(min=1) * noise_like(x, rng)


def even_times(schedule: Schedule, steps: int) -> Tensor:
    """steps + 1 times from 1 to 0, equally far apart (R2DM)."""
    return torch.linspace(1, 0, steps + 1, dtype=torch.float64)


def even_log_snr(schedule: Schedule, steps: int) -> Tensor:
    """steps + 1 times from 1 to 0, equally far apart in log_snr (DPM-Solver, Lu et al. 2022)."""
    times = schedule.along(1, 0, torch.linspace(0, 1, steps + 1, dtype=torch.float64))
    times[0], times[-1] = 1, 0  # the inverse is exact to rounding only
    return times


@torch.no_grad()
def sample(
    denoiser: Denoiser,
    x_1: Tensor,  # (B, C, H, W) noise, see starting_noise
    step: Step,  # one of STEPS
    steps: int,
    rng: Rng,
    grid: Grid = even_times,  # or even_log_snr
) -> Iterator[State]:
    """Carry x_1 to x_0 in `steps` steps and yield the state after each; `functools.partial` sets a step's options.

    The result lies in about [-1, 1], and is not clamped: some steps leave noise of sigma_0 behind.

    Example:
        >>> rng = generators(seed=0, count=4)
        >>> x_1 = starting_noise(denoiser, torch.zeros(4, 2, 64, 1024), rng)
        >>> *_, last = sample(denoiser, x_1, ddpm, 256, rng)
        >>> x_0 = last.x_s.clamp(-1, 1)
    """
    if steps < 1:
        raise ValueError(f"steps must be at least 1, got {steps}")
    times = times_for(grid(denoiser.schedule, steps), x_1)
    x_t, state = x_1, None
    for index in range(steps):
        t, s = times[index], times[index + 1]
        x_s, x_0_hat = step(denoiser, x_t, t, s, rng, state)
        state = State(index, t, s, x_t, x_s, x_0_hat)
        yield state
        x_t = x_s


def times_for(times: Tensor, x: Tensor) -> Tensor:
    """Times (T,) repeated for the samples of x: (T, B) on its device, in float32, or float64 if x is float64.

    Raises ValueError unless each time is below the one before, which very many steps can break in float32.
    """
    times = times.to(torch.promote_types(x.dtype, torch.float32))
    if not bool((times.diff() < 0).all()):
        raise ValueError(f"times must fall at every step, got equal or rising ones among {len(times)} in {times.dtype}")
    return times.to(x.device)[:, None].repeat(1, len(x))


def ddpm(
    denoiser: Denoiser, x_t: Tensor, t: Tensor, s: Tensor, rng: Rng, previous: State | None = None
) -> tuple[Tensor, Tensor]:
    """Ancestral sampling: a draw from q(x_s | x_t, x_0 = x_0_hat) (Ho et al. 2020; R2DM).

    It is DDIM with eta = 1 in other words, and other roundings: these are R2DM's. Noise comes with the last step too.
    """
    x_0_hat = denoiser(x_t, t)
    return _drawn(denoiser.schedule, x_t, x_0_hat, t, s, rng), x_0_hat


def _drawn(schedule: Schedule, x_t: Tensor, x_0_hat: Tensor, t: Tensor, s: Tensor, rng: Rng) -> Tensor:
    """A draw from q(x_s | x_t, x_0 = x_0_hat)."""
    log_snr_t, alpha_t, _ = schedule.at(t, x_t)
    log_snr_s, alpha_s, sigma_s = schedule.at(s, x_t)
    c = -torch.expm1(log_snr_t - log_snr_s)  # 1 - snr_t / snr_s
    mean = alpha_s * (x_t * (1 - c) / alpha_t + c * x_0_hat)
    return mean + sigma_s * c.sqrt() * noise_like(x_t, rng)


def ddim(
    denoiser: Denoiser,
    x_t: Tensor,
    t: Tensor,
    s: Tensor,
    rng: Rng,
    previous: State | None = None,
    eta: float = 0.0,  # share of fresh noise: 0 = deterministic, 1 = ancestral sampling
) -> tuple[Tensor, Tensor]:
    """DDIM (Song et al. 2021, eq. 12); on the schedule `flow` with eta = 0, Euler's step of rectified flow.

    Noise is drawn whatever eta is, as in R2DM's program, so that one seed names one sequence of noise.
    """
    x_0_hat = denoiser(x_t, t)
    log_snr_t, alpha_t, sigma_t = denoiser.schedule.at(t, x_t)
    log_snr_s, alpha_s, sigma_s = denoiser.schedule.at(s, x_t)
    eps_hat = (x_t - alpha_t * x_0_hat) / sigma_t
    fresh = eta * sigma_s * torch.sqrt(-torch.expm1(log_snr_t - log_snr_s))
    kept = (denoiser.schedule.variance(alpha_s, sigma_s) - fresh**2).clamp(min=0).sqrt()  # below 0 by rounding only
    return alpha_s * x_0_hat + fresh * noise_like(x_t, rng) + kept * eps_hat, x_0_hat


def dpmpp_2m(
    denoiser: Denoiser, x_t: Tensor, t: Tensor, s: Tensor, rng: Rng, previous: State | None = None
) -> tuple[Tensor, Tensor]:
    """DPM-Solver++(2M) (Lu et al. 2022, algorithm 2), on a line through this and the previous x_0_hat over log_snr.

    The first step has no previous estimate, and the last must not extrapolate over its huge range of log_snr: both
    are of first order, which leaves the method of second order.
    """
    x_0_hat = denoiser(x_t, t)
    log_snr_t, _, sigma_t = denoiser.schedule.at(t, x_t)
    log_snr_s, alpha_s, sigma_s = denoiser.schedule.at(s, x_t)
    estimate = _ahead(denoiser.schedule, x_t, x_0_hat, t, s, previous)
    return sigma_s / sigma_t * x_t - alpha_s * torch.expm1((log_snr_t - log_snr_s) / 2) * estimate, x_0_hat


def sde_dpmpp_2m(
    denoiser: Denoiser,
    x_t: Tensor,
    t: Tensor,
    s: Tensor,
    rng: Rng,
    previous: State | None = None,
    eta: float = 1.0,  # share of fresh noise: 0 = `dpmpp_2m`, 1 = as in the reverse diffusion
    s_noise: float = 1.0,  # by which it is larger, where a network takes off too much (Karras et al. 2022, appendix D)
) -> tuple[Tensor, Tensor]:
    """SDE-DPM-Solver++(2M) (Lu et al. 2022, algorithm 4): `ddpm`, on the line of `dpmpp_2m`.

    Fresh noise at each step takes off what the network's errors have made of those before, which a deterministic step
    keeps; but each step's is also smoothed by what the network does not know.
    """
    x_0_hat = denoiser(x_t, t)
    log_snr_t, _, sigma_t = denoiser.schedule.at(t, x_t)
    log_snr_s, alpha_s, sigma_s = denoiser.schedule.at(s, x_t)
    estimate, h = _ahead(denoiser.schedule, x_t, x_0_hat, t, s, previous), (log_snr_s - log_snr_t) / 2
    mean = sigma_s / sigma_t * torch.exp(-eta * h) * x_t - alpha_s * torch.expm1(-(1 + eta) * h) * estimate
    fresh = s_noise * sigma_s * torch.sqrt(-torch.expm1(-2 * eta * h))
    return mean + fresh * noise_like(x_t, rng), x_0_hat


def _ahead(schedule: Schedule, x_t: Tensor, x_0_hat: Tensor, t: Tensor, s: Tensor, previous: State | None) -> Tensor:
    """x_0 half a step ahead, on the line through this and the previous estimate over log_snr."""
    if previous is None:
        return x_0_hat
    log_snr, before, after = (schedule.at(time, x_t)[0] for time in (t, previous.t, s))
    weight = torch.where(s.view_as(log_snr) > 0, (after - log_snr) / (2 * (log_snr - before)), 0)
    return x_0_hat + weight * (x_0_hat - previous.x_0_hat)


def heun(
    denoiser: Denoiser, x_t: Tensor, t: Tensor, s: Tensor, rng: Rng, previous: State | None = None
) -> tuple[Tensor, Tensor]:
    """Heun's method in exponential form (Hochbruck & Ostermann 2010): predict with DDIM, then correct.

    x_0_hat is taken as linear in lambda = log_snr / 2 between t and s, and the rest of the probability flow is solved
    exactly. Heun's plain form (Karras et al. 2022, algorithm 1) multiplies errors by e^h, 50 and more at the ends of
    the cosine schedule.
    """
    x_0_hat = denoiser(x_t, t)
    log_snr_t, _, sigma_t = denoiser.schedule.at(t, x_t)
    log_snr_s, alpha_s, sigma_s = denoiser.schedule.at(s, x_t)
    h = (log_snr_s - log_snr_t) / 2
    decay = -torch.expm1(-h)
    predicted = sigma_s / sigma_t * x_t + alpha_s * decay * x_0_hat
    change = denoiser(predicted, s) - x_0_hat
    return predicted + alpha_s * (1 - decay / h) * change, x_0_hat


STEPS: dict[str, Step] = {
    "ddpm": ddpm,
    "ddim": ddim,
    "dpmpp-2m": dpmpp_2m,
    "sde-dpmpp-2m": sde_dpmpp_2m,
    "heun": heun,
}
