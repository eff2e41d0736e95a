"""Noise schedules in continuous time: x_t = alpha_t x_0 + sigma_t eps, t in [0, 1], 0 = data, 1 = noise.

A schedule is known by its log signal-to-noise ratio, log_snr = log(alpha^2 / sigma^2), which falls with t, and by the
way alpha and sigma follow from it. Every schedule is finite at t = 0 and t = 1, so no sampler needs a special case.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import softplus


@dataclass(frozen=True)
class Schedule:
    """A noise schedule as three functions; each keeps the shape, dtype and device of its argument, and can be pickled.

    Example:
        >>> schedule = cosine()
        >>> log_snr = schedule.log_snr(torch.tensor([0.0, 0.5, 1.0]))  # 15, 0, -15
        >>> alpha, sigma = schedule.alpha_sigma(log_snr)
    """

    log_snr: Callable[[Tensor], Tensor]  # t in [0, 1] -> log(alpha^2 / sigma^2), falling
    t: Callable[[Tensor], Tensor]  # the inverse: log_snr -> t
    alpha_sigma: Callable[[Tensor], tuple[Tensor, Tensor]]  # log_snr -> (alpha, sigma), both >= 0

    def at(self, t: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """log_snr, alpha and sigma at times t (B,), each (B, 1, ...) so that it multiplies x (B, ...)."""
        if t.shape != x.shape[:1]:
            raise ValueError(f"t must be ({x.shape[0]},), one time per sample, got {tuple(t.shape)}")
        log_snr = self.log_snr(t).view(-1, *[1] * (x.ndim - 1))
        return log_snr, *self.alpha_sigma(log_snr)

    def along(self, first: float, last: float, share: Tensor) -> Tensor:
        """Times (n,) in float64 at shares (n,) in [0, 1] of the way from one time to another, even in log_snr."""
        start, end = self.log_snr(torch.tensor([first, last], dtype=torch.float64)).tolist()
        return self.t(start + (end - start) * share.double())

    def variance(self, alpha: Tensor, sigma: Tensor) -> Tensor:
        """sigma^2, for variance-preserving schedules as 1 - alpha^2.

        In float32 the two differ by a fifth at t = 0, where sigma^2 = 3e-7; R2DM's program has the second in DDIM.
        """
        return 1 - alpha**2 if self.alpha_sigma is variance_preserving else sigma**2


def variance_preserving(log_snr: Tensor) -> tuple[Tensor, Tensor]:
    """alpha and sigma with alpha^2 + sigma^2 = 1 (R2DM; Kingma et al. 2021)."""
    return log_snr.sigmoid().sqrt(), (-log_snr).sigmoid().sqrt()


def straight(log_snr: Tensor) -> tuple[Tensor, Tensor]:
    """alpha and sigma with alpha + sigma = 1: the straight paths of rectified flow (Liu et al. 2022)."""
    return (log_snr / 2).sigmoid(), (-log_snr / 2).sigmoid()


def variance_exploding(log_snr: Tensor) -> tuple[Tensor, Tensor]:
    """alpha = 1 and sigma = exp(-log_snr / 2), the schedule of NCSN (Song & Ermon 2019)."""
    return torch.ones_like(log_snr), (-log_snr / 2).exp()


def cosine(bound: float = 15.0) -> Schedule:
    """Cosine schedule with log_snr in [-bound, bound] (Nichol & Dhariwal 2021, truncated as in R2DM's program)."""
    return cosine_shifted(64, 64, bound)


def cosine_shifted(resolution: float = 256, reference: float = 64, bound: float = 15.0) -> Schedule:
    """Cosine schedule, noisier by the ratio of image sides (simple diffusion, Hoogeboom et al. 2023).

    resolution: side of the image in pixels, sqrt(H W) for a range image (256 for 64 x 1024).
    reference: side of the images for which the plain cosine schedule is meant.
    """
    shift = _shift(reference, resolution)
    return Schedule(
        partial(_shifted_log_snr, bound, shift),
        partial(_shifted_t, bound, shift),
        variance_preserving,
    )


def cosine_interpolated(resolution: float = 256, low: float = 32, high: float = 256, bound: float = 15.0) -> Schedule:
    """Between two shifts: that of `low` at t = 1, that of `high` at t = 0 (Hoogeboom et al. 2023).

    resolution, low, high: image sides in pixels. Its inverse has no closed form and is found by bisection.
    """
    log_snr = partial(_interpolated_log_snr, bound, _shift(low, resolution), _shift(high, resolution))
    return Schedule(log_snr, partial(bisect, log_snr), variance_preserving)


def linear() -> Schedule:
    """The continuous form of DDPM's linear betas, log_snr in [-10.0, 9.2] (Ho et al. 2020; Kingma et al. 2021)."""
    return Schedule(_linear_log_snr, _linear_t, variance_preserving)


def flow(bound: float = 30.0, noisiest: float | None = None) -> Schedule:
    """Rectified flow: alpha = 1 - t, sigma = t (Liu et al. 2022), with log_snr in [-noisiest, bound].

    The bounds keep log_snr finite for the network; at the ends they move alpha and sigma by exp(-bound / 2) = 3e-7.
    noisiest  as `bound`, where noise is strongest: None = the same
    """
    first, last = (1 / (1 + math.exp(end / 2)) for end in (bound, bound if noisiest is None else noisiest))
    width = 1 - (first + last)
    return Schedule(partial(_flow_log_snr, first, last, width), partial(_flow_t, first, width), straight)


def ve(sigma_min: float = 0.01, sigma_max: float = 50.0) -> Schedule:
    """Variance exploding: alpha = 1, sigma geometric between the two (NCSN; the defaults are LiDARGen's)."""
    if not 0 < sigma_min < 1 <= sigma_max:  # the noise has to cover data in [-1, 1]
        raise ValueError(f"sigma_min and sigma_max must satisfy 0 < min < 1 <= max, got {sigma_min} and {sigma_max}")
    start, ratio = math.log(sigma_min), math.log(sigma_max / sigma_min)
    return Schedule(partial(_ve_log_snr, start, ratio), partial(_ve_t, start, ratio), variance_exploding)


def renoise(schedule: Schedule, x_s: Tensor, s: Tensor, t: Tensor, eps: Tensor) -> Tensor:
    """A draw from q(x_t | x_s): x_s (B, ...) at times s (B,) with more noise, at times t >= s; eps is unit Gaussian.

    x_t = alpha_ts x_s + sigma_ts eps, alpha_ts = alpha_t / alpha_s, sigma_ts^2 = sigma_t^2 - alpha_ts^2 sigma_s^2.
    R2DM's paper prints sigma_ts^2 = sigma_t - alpha_ts sigma_s; only with the squares do two jumps make one longer jump
    (Kingma et al. 2021), and R2DM's program has them.
    """
    log_snr_s, alpha_s, _ = schedule.at(s, x_s)
    log_snr_t, alpha_t, sigma_t = schedule.at(t, x_s)
    sigma_ts = sigma_t * torch.sqrt(-torch.expm1(log_snr_t - log_snr_s))  # the formula above without cancellation
    return alpha_t / alpha_s * x_s + sigma_ts * eps


def cosine_log_snr(t: Tensor, bound: float) -> Tensor:
    """-2 log tan(a + t (b - a)) with a, b such that the ends are +-bound (R2DM's program).

    tan is steep at t = 1: float32 loses up to 1e-4 of log_snr there. It is kept so on purpose, because 1 / alpha = 1800
    carries each digit of it into x_0_hat, and only the same arithmetic gives the samples of the released program.
    """
    start, end = math.atan(math.exp(-bound / 2)), math.atan(math.exp(bound / 2))
    return -2 * torch.log(torch.tan(start + t * (end - start)))


def cosine_t(log_snr: Tensor, bound: float) -> Tensor:
    """The inverse of cosine_log_snr."""
    start = math.atan(math.exp(-bound / 2))
    return (torch.atan(torch.exp(-log_snr / 2)) - start) / (math.pi / 2 - 2 * start)


def _shifted_log_snr(bound: float, shift: float, t: Tensor) -> Tensor:
    return cosine_log_snr(t, bound) + shift


def _shifted_t(bound: float, shift: float, log_snr: Tensor) -> Tensor:
    return cosine_t(log_snr - shift, bound)


def _interpolated_log_snr(bound: float, low: float, high: float, t: Tensor) -> Tensor:
    return cosine_log_snr(t, bound) + t * low + (1 - t) * high


def _linear_log_snr(t: Tensor) -> Tensor:
    return -torch.log(torch.expm1(1e-4 + 10 * t**2))


def _linear_t(log_snr: Tensor) -> Tensor:
    return ((softplus(-log_snr) - 1e-4).clamp(min=0) / 10).sqrt()


def _flow_log_snr(first: float, last: float, width: float, t: Tensor) -> Tensor:
    return 2 * torch.log((last + (1 - t) * width) / (first + t * width))


def _flow_t(first: float, width: float, log_snr: Tensor) -> Tensor:
    return ((-log_snr / 2).sigmoid() - first) / width


def _ve_log_snr(start: float, ratio: float, t: Tensor) -> Tensor:
    return -2 * (start + t * ratio)


def _ve_t(start: float, ratio: float, log_snr: Tensor) -> Tensor:
    return (-log_snr / 2 - start) / ratio


def bisect(falling: Callable[[Tensor], Tensor], value: Tensor, iterations: int = 40) -> Tensor:
    """t in [0, 1] with falling(t) = value, elementwise, for a function that falls with t."""
    low, high = torch.zeros_like(value), torch.ones_like(value)
    for _ in range(iterations):
        middle = (low + high) / 2
        above = falling(middle) > value
        low, high = torch.where(above, middle, low), torch.where(above, high, middle)
    return (low + high) / 2


def _shift(reference: float, resolution: float) -> float:
    if reference <= 0 or resolution <= 0:
        raise ValueError(f"image sides must be positive numbers of pixels, got {reference} and {resolution}")
    return 2 * math.log(reference / resolution)


SCHEDULES: dict[str, Callable[[], Schedule]] = {
    "cosine": cosine,
    "cosine-shifted": cosine_shifted,
    "cosine-interpolated": cosine_interpolated,
    "linear": linear,
    "flow": flow,
    "ve": ve,
}
