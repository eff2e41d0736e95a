"""Large holes, where nothing is known around: a coarse grid of them by RePaint."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lidarsynth.diffusion import repaint
from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.samplers import even_log_snr, noise_like
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.systems.filling import Filling
from lidarsynth.systems.scan_model import OnStep


def repainted(
    denoiser: Denoiser, known: Tensor, here: Tensor, rng: list[torch.Generator], how: Filling, on_step: OnStep
) -> Tensor:
    """x_0 (B, 3, 16, 128) that agrees with `known` `here` (B, 1, 16, 128) bool, after a resolved request's steps."""
    assert how.steps is not None and how.resamples is not None
    x_1 = x_0 = noise_like(known, rng)
    for state in repaint.repaint(
        denoiser, x_1, known, here, rng, steps=how.steps, resamples=how.resamples, grid=even_log_snr
    ):
        x_0 = state.x_s
        if on_step is not None:
            on_step()
    return x_0


def with_grid(
    told: tuple[np.ndarray, np.ndarray, np.ndarray],
    grid: tuple[np.ndarray, ...],
    hole: np.ndarray,
    metres: np.ndarray,
    reflectance: np.ndarray,
    sensor: Sensor,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Metres, reflectance and known pixels (H, W), with those of the `grid` (16, 128) where there is a `hole`."""
    whole = tuple(part.copy() for part in told)
    metres = np.where(metres > sensor.max_range, 0, metres)
    for part, new in zip(whole, (metres, reflectance, True), strict=True):
        part[grid] = np.where(hole, new, part[grid])
    return whole  # type: ignore[return-value]
