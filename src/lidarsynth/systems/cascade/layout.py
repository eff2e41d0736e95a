"""Grids of the coarse stage from noise: the layout of a street that generation fills in."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.samplers import STEPS, even_log_snr, noise_like, sample
from lidarsynth.diffusion.schedule import flow
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.coarse_unet import COLUMNS, ROWS
from lidarsynth.networks.column_transformer import draw
from lidarsynth.networks.rays import decode_range

BOUND = 8.0  # of log_snr: beyond it the coarse network has hardly been trained
STEPS_DEFAULT = 16
BY_COLUMNS = "columns"  # the sampler that is no diffusion


def sampling(network: Cascade, steps: int | None, sampler: str | None) -> tuple[str, int]:
    """The sampler and its steps: column by column, where the network can; `dpmpp-2m` where not, or steps are asked for.

    Raises ValueError for an unknown word, and for steps of `columns`, which has one a column.
    """
    words = (BY_COLUMNS, *STEPS) if network.columns is not None else tuple(STEPS)
    if sampler is not None and sampler not in words:
        raise ValueError(f"expected a sampler of {', '.join(words)}, found {sampler!r}")
    if sampler is None:
        sampler = BY_COLUMNS if steps is None and network.columns is not None else "dpmpp-2m"
    if sampler != BY_COLUMNS:
        return sampler, STEPS_DEFAULT if steps is None else steps
    if steps is not None:
        raise ValueError(f"expected no steps with the sampler {sampler}, which draws {COLUMNS} columns, found {steps}")
    return sampler, COLUMNS


def block(how: tuple[str, int]) -> int:
    """How many grids to draw at once: half the time of one by one, of columns a tenth."""
    return 16 if how[0] == BY_COLUMNS else 8


def velocity(network: Cascade, rays: Tensor, guided: bool) -> Denoiser:
    """The coarse network of rays (B, 8, 16, 128) as a denoiser, or the one led away from its guide."""
    answers = network.velocity if guided else network.coarse
    return Denoiser(answers, flow(BOUND), "velocity", clip=False, condition=(rays,))


def times(count: int, tell: Callable[[], object]) -> Callable[[], None]:
    """A call that calls `tell` so many times."""

    def all_of_them() -> None:
        for _ in range(count):
            tell()

    return all_of_them


def grids(
    network: Cascade,
    rays: Tensor,
    standing: Tensor,
    dim: Tensor,
    rng: list[torch.Generator],
    how: tuple[str, int],
    on_step: Callable[[], None],
) -> tuple[Tensor, Tensor]:
    """Metres, 0 for no return, and reflectance, each (B, 16, 128), of rays (B, 8, 16, 128) and standing elevations.

    dim  (16, 1), how much less than the mean beam each one reads; how  as `sampling` says; on_step  called after each
    """
    sampler, steps = how
    if sampler == BY_COLUMNS:
        assert network.columns is not None
        grid = draw(network.columns, rays, rng, on_step)
        return decode_range(grid.code) * grid.returned, (grid.shade - dim).clamp(0, 1) * grid.returned
    x_0 = x_1 = noise_like(torch.zeros(len(rays), 3, ROWS, COLUMNS, device=rays.device), rng)
    for state in sample(velocity(network, rays, guided=True), x_1, STEPS[sampler], steps, rng, even_log_snr):
        x_0 = state.x_s
        on_step()
    return network.coarse.decode(network.settled(x_0, rays), standing, dim)
