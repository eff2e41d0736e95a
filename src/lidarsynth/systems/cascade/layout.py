"""Grids of the coarse stage from noise: the layout of a street that generation fills in."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.samplers import STEPS, even_log_snr, noise_like, sample
from lidarsynth.diffusion.schedule import flow
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.between_columns import draw_between, joined
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.coarse_unet import COLUMNS, ROWS
from lidarsynth.networks.column_neighbours import Grid, known_grid
from lidarsynth.networks.column_transformer import draw
from lidarsynth.networks.rays import decode_range
from lidarsynth.streets.hdl64e import unevenness
from lidarsynth.systems.cascade.surfaces import along_rings, evened, straightened

BOUND = 8.0  # of log_snr: beyond it the coarse network has hardly been trained
STEPS_DEFAULT = 16
FINEST = 4 * COLUMNS  # of the columns between
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
    sensor: Sensor,
    rows: np.ndarray,
    columns: np.ndarray,
    rays_of: Callable[[np.ndarray], tuple[Tensor, Tensor]],
    rng: list[torch.Generator],
    how: tuple[str, int],
    on_step: Callable[[], None],
) -> tuple[Tensor, Tensor, np.ndarray]:
    """Metres, 0 for no return, and reflectance, each (B, 16, C), of these rows, and the columns (C,) that were drawn:
    those given, and what is between them where the network draws them.

    rays_of  columns -> what is told of their rays (B, 8, 16, C), and their standing elevations
    how      as `sampling` says; on_step  called after each
    """
    (told, standing), (sampler, steps) = rays_of(columns), how
    dim = torch.from_numpy(unevenness(sensor)[rows]).to(told.device)
    if sampler == BY_COLUMNS:
        assert network.columns is not None
        grid = _straight(draw(network.columns, told, rng, on_step), rows, sensor)
        grid, told, columns = _finer(network, grid, told, columns, rays_of, sensor.width, rng)
        metres, shade = _metres(grid), evened(grid, told)
        metres = metres if len(columns) == COLUMNS else along_rings(metres)
        order = np.argsort(columns)
        return metres[..., order], ((shade - dim).clamp(0, 1) * grid.returned)[..., order], columns[order]
    x_0 = x_1 = noise_like(torch.zeros(len(told), 3, ROWS, COLUMNS, device=told.device), rng)
    for state in sample(velocity(network, told, guided=True), x_1, STEPS[sampler], steps, rng, even_log_snr):
        x_0 = state.x_s
        on_step()
    metres, shade = network.coarse.decode(network.settled(x_0, told), standing, dim)
    return straightened(metres, rows, sensor), shade, columns


def _finer(
    network: Cascade,
    grid: Grid,
    told: Tensor,
    columns: np.ndarray,
    rays_of: Callable[[np.ndarray], tuple[Tensor, Tensor]],
    width: int,
    rng: list[torch.Generator],
) -> tuple[Grid, Tensor, np.ndarray]:
    """The grid with twice and four times the columns, as far as a sensor of so many has them, in their order."""
    while network.between is not None and 2 * len(columns) <= min(FINEST, width):
        half = (columns + (np.roll(columns, -1) - columns) % width // 2) % width
        grid = joined(grid, draw_between(network.between, grid, told, rays_of(half)[0], rng))
        columns = np.stack([columns, half], 1).ravel()
        told = rays_of(columns)[0]
    return grid, told, columns


def _straight(grid: Grid, rows: np.ndarray, sensor: Sensor) -> Grid:
    return known_grid(straightened(_metres(grid), rows, sensor), grid.shade)


def _metres(grid: Grid) -> Tensor:
    return decode_range(grid.code) * grid.returned
