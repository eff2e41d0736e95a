"""Denoisers in closed form, for data whose distribution is known: what a perfectly trained network would say."""

import torch
from torch import Tensor

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.schedule import Schedule


def gaussian_denoiser(schedule: Schedule, mean: float = 0.3, std: float = 0.4) -> Denoiser:
    """The exact E[x_0 | x_t] for independent pixels from N(mean, std^2); it is linear in x_t."""

    def network(x_t: Tensor, log_snr: Tensor) -> Tensor:
        alpha, sigma = schedule.alpha_sigma(log_snr.view(-1, 1, 1, 1))
        return mean + alpha * std**2 / (alpha**2 * std**2 + sigma**2) * (x_t - alpha * mean)

    return Denoiser(network, schedule, kind="x_0", clip=False)


def gaussian_flow(schedule: Schedule, x_t: Tensor, t: Tensor, s: Tensor, mean: float = 0.3, std: float = 0.4) -> Tensor:
    """The exact solution at s of the probability flow through x_t: the standardised value never changes."""
    (_, alpha_t, sigma_t), (_, alpha_s, sigma_s) = schedule.at(t, x_t), schedule.at(s, x_t)
    spread_t, spread_s = (alpha_t**2 * std**2 + sigma_t**2).sqrt(), (alpha_s**2 * std**2 + sigma_s**2).sqrt()
    return alpha_s * mean + (x_t - alpha_t * mean) * spread_s / spread_t


def mixture_denoiser(schedule: Schedule, means: Tensor, weights: Tensor, std: float = 0.05) -> Denoiser:
    """The exact E[x_0 | x_t] for independent pixels from a mixture of Gaussians; means and weights (K,)."""

    def network(x_t: Tensor, log_snr: Tensor) -> Tensor:
        alpha, sigma = schedule.alpha_sigma(log_snr.view(-1, 1, 1, 1, 1))
        variance = alpha**2 * std**2 + sigma**2
        offset = x_t[..., None] - alpha * means
        share = torch.softmax(weights.log() - offset**2 / (2 * variance), dim=-1)
        return (share * (means + alpha * std**2 / variance * offset)).sum(-1)

    return Denoiser(network, schedule, kind="x_0")
