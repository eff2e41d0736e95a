"""Grids of the coarse stage from noise: the layout of a street that generation fills in."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np
import torch
from torch import Tensor

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.samplers import STEPS, even_log_snr, noise_like, sample, sde_dpmpp_2m
from lidarsynth.diffusion.schedule import Schedule
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.between_beams import draw_beams, interleaved, with_between
from lidarsynth.networks.between_columns import draw_between, joined
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.coarse_unet import COLUMNS, ROWS
from lidarsynth.networks.column_neighbours import Grid, known_grid, levelled, nearness
from lidarsynth.networks.column_transformer import draw
from lidarsynth.networks.drafts import drafted
from lidarsynth.networks.rays import decode_range, encode_range
from lidarsynth.streets.hdl64e import unevenness
from lidarsynth.systems.cascade.examples import read_at
from lidarsynth.systems.cascade.facades import with_facades
from lidarsynth.systems.cascade.hanging import landed
from lidarsynth.systems.cascade.surfaces import across_rings, along_rings, evened, straightened

STEPS_DEFAULT = 16
# Time of a draft, at which columns go on: later, diffusion's own errors show, earlier, its layout is lost; steps to it.
DRAFT, DRAFT_STEPS = 0.53, 8
# Its sampler: a deterministic one keeps what is wrong at first, one of fresh noise alone smooths what is small.
DRAFTING = partial(sde_dpmpp_2m, eta=0.5, s_noise=1.02)
SMOOTH = 0.3  # natural logarithm of ranges of beams that go on as a plane
LEVEL = 0.15  # natural logarithm of the range of flat ground by which a return on the ground may be nearer or farther
FINEST, TALLEST = 4 * COLUMNS, 4 * ROWS - 3  # columns, and beams, with what is between
BY_COLUMNS = "columns"  # the sampler that is no diffusion
CHOICE = 3  # grids of which one is kept, where the network has a judge: docs/generation.md
# Rows, columns -> what is told of their rays (B, 8, R, C), and their standing elevations (B, R, C).
RaysOf = Callable[[np.ndarray, np.ndarray], tuple[Tensor, Tensor]]


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


def block(how: tuple[str, int], choice: int = 1) -> int:
    """How many scans to draw at once, each `choice` times: half the time of one by one, of columns a tenth."""
    return 8 if choice > 1 or how[0] != BY_COLUMNS else 16


def velocity(network: Cascade, rays: Tensor, guided: bool) -> Denoiser:
    """The coarse network of rays (B, 8, 16, 128) as a denoiser, or the one led away from its guide."""
    answers = network.velocity if guided else network.coarse
    return Denoiser(answers, network.coarse.schedule, "velocity", clip=False, condition=(rays,))


def to_draft(schedule: Schedule, steps: int, t: float = DRAFT) -> Tensor:
    """steps + 1 times from 1 to t, equally far apart in log_snr."""
    return schedule.along(1, t, torch.linspace(0, 1, steps + 1, dtype=torch.float64)).clamp(max=1)


def draft(
    network: Cascade,
    rays: Tensor,
    standing: Tensor,
    rng: list[torch.Generator],
    t: float = DRAFT,
    precision: str = "fp32",
) -> Tensor:
    """(B, 7, 16, 128) what `drafted` says of noise that was led to time t, for rays (B, 8, 16, 128) of standing
    elevations (B, 16, 128) in radians, each by a generator of its own; the coarse network's products in `precision`."""
    x_1 = noise_like(torch.zeros(len(rays), 3, ROWS, COLUMNS, device=rays.device), rng)
    with torch.autocast(rays.device.type, torch.bfloat16, enabled=precision == "bf16"):
        *_, last = sample(velocity(network, rays, guided=True), x_1, DRAFTING, DRAFT_STEPS, rng, partial(to_draft, t=t))
        return drafted(network.coarse, last.x_s, last.s, rays, standing)


def times(count: int, tell: Callable[[], object]) -> Callable[[], None]:
    """A call that calls `tell` so many times."""

    def all_of_them() -> None:
        for _ in range(count):
            tell()

    return all_of_them


@contextmanager
def one_thread() -> Iterator[None]:
    """While it is open, torch computes in one thread: of very many small steps two save a fifth of the time where
    cores are idle, and cost a hundred times as much where one is not, as each waits for the other."""
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)


def grids(
    network: Cascade,
    sensor: Sensor,
    rows: np.ndarray,
    columns: np.ndarray,
    rays_of: RaysOf,
    rng: list[torch.Generator],
    how: tuple[str, int],
    on_step: Callable[[], None],
    choice: int = 1,
    precision: str = "fp32",
) -> tuple[Tensor, Tensor, np.ndarray, np.ndarray]:
    """Metres, 0 for no return, and reflectance, each (B, R, C), and the rows (R,) and columns (C,) that were drawn:
    those given, and what is between them where the network draws them.

    how     as `sampling` says; on_step  called after each
    choice  of so many drawn column by column one is kept, by the odds of the network's judge that it is a street's
    precision  of the coarse network's products: fp32 | bf16
    """
    (told, standing), (sampler, steps) = rays_of(rows, columns), how
    if sampler == BY_COLUMNS:
        assert network.columns is not None
        with one_thread():
            some = choice if network.judge is not None else 1
            grid = _chosen(network, told, standing, rng, on_step, some, precision)
            return detailed(network, grid, (rows, columns), rays_of, sensor, unevenness(sensor), rng)
    dim = torch.from_numpy(unevenness(sensor)[rows]).to(told.device)
    x_0 = x_1 = noise_like(torch.zeros(len(told), 3, ROWS, COLUMNS, device=told.device), rng)
    with torch.autocast(told.device.type, torch.bfloat16, enabled=precision == "bf16"):
        for state in sample(velocity(network, told, guided=True), x_1, STEPS[sampler], steps, rng, even_log_snr):
            x_0 = state.x_s
            on_step()
    metres, shade = network.coarse.decode(network.settled(x_0, told), standing, dim)
    return straightened(metres, rows, sensor), shade, rows, columns


def _chosen(
    network: Cascade,
    told: Tensor,
    standing: Tensor,
    rng: list[torch.Generator],
    on_step: Callable[[], None],
    choice: int,
    precision: str = "fp32",
) -> Grid:
    """Grids (B, 16, 128) drawn after drafts, each one of `choice`, by the odds that the judge gives it as a street's.

    That is importance resampling (Rubin 1987), which nears streets in all respects as far as the judge is right; the
    best of them would be too much alike.
    """
    assert network.columns is not None
    one_by_one = rng if choice == 1 else [each for one in rng for each in _offspring(one, choice)]
    told, standing = (part.repeat_interleave(choice, 0) for part in (told, standing))
    after = draft(network, told, standing, one_by_one, DRAFT, precision)
    grid = draw(network.columns, told, after, one_by_one, on_step)
    if choice == 1:
        return grid
    assert network.judge is not None
    first = torch.arange(len(rng), device=told.device) * choice
    odds = network.judge(grid, told).view(-1, choice).softmax(1)
    kept = first + torch.cat([torch.multinomial(of, 1, generator=one) for of, one in zip(odds, rng, strict=True)])
    return Grid(*(part[kept] for part in grid))


def _offspring(rng: torch.Generator, count: int) -> list[torch.Generator]:
    """Generators of their own for each of the draws among which a scan's is chosen."""
    return [torch.Generator().manual_seed(int(torch.randint(1 << 31, (), generator=rng))) for _ in range(count)]


def told_of(images: Sequence[RangeImage], rows: np.ndarray, columns: np.ndarray) -> Grid:
    """Grids (B, 16, 128) of images (H, W), in metres, at these rows (16,) and columns (128,), as if they were drawn."""
    metres, reflectance = map(torch.stack, zip(*(read_at(image, rows, columns) for image in images), strict=True))
    return known_grid(metres, reflectance.clamp(-0.1, 1.1))


def detailed(
    network: Cascade,
    grid: Grid,
    places: tuple[np.ndarray, np.ndarray],
    rays_of: RaysOf,
    sensor: Sensor,
    dimness: np.ndarray,
    rng: list[torch.Generator],
) -> tuple[Tensor, Tensor, np.ndarray, np.ndarray]:
    """As `grids`, of a grid (B, 16, 128) of drawn columns: put straight, with what is between them and their beams.

    places   its rows (16,) and columns (128,) of the sensor
    dimness  (H, 1) how much less than the mean beam each of the sensor's reads, in reflectance
    """
    rows, columns = places
    grid = _straight(grid, rows, sensor)
    grid, columns = _finer(network, grid, rows, columns, rays_of, sensor.width, rng)
    grid, rows = _taller(network, grid, rows, columns, rays_of, rng)
    if len(rows) > ROWS:
        grid = _in_line(grid, rows, sensor)
        grid, rows = _whole(grid, rows, columns, rays_of, sensor.height)
    grid = landed(grid, rng)
    shade, order = evened(grid, rays_of(rows, columns)[0]), np.argsort(columns)
    dim = torch.from_numpy(dimness[rows]).to(shade.device)
    parts = (_metres(grid), (shade - dim).clamp(0, 1) * grid.returned)
    return parts[0][..., order], parts[1][..., order], rows, columns[order]


def _finer(
    network: Cascade,
    grid: Grid,
    rows: np.ndarray,
    columns: np.ndarray,
    rays_of: RaysOf,
    width: int,
    rng: list[torch.Generator],
) -> tuple[Grid, np.ndarray]:
    """The grid with twice and four times the columns, as far as a sensor of so many has them, in their order."""
    if network.between is None or 2 * len(columns) > width:
        return grid, columns
    while 2 * len(columns) <= min(FINEST, width):
        half = (columns + (np.roll(columns, -1) - columns) % width // 2) % width
        told, between = rays_of(rows, columns)[0], rays_of(rows, half)[0]
        grid = joined(grid, draw_between(network.between, grid, told, between, rng))
        columns = np.stack([columns, half], 1).ravel()
    return known_grid(along_rings(_metres(grid)), grid.shade), columns


def _taller(
    network: Cascade,
    grid: Grid,
    rows: np.ndarray,
    columns: np.ndarray,
    rays_of: RaysOf,
    rng: list[torch.Generator],
) -> tuple[Grid, np.ndarray]:
    """The grid with the beams between its own, twice over, as far as the sensor has one between each two.

    They are drawn without speckle, which the grid's own have lost before: it would go on for what a surface looks like.
    """
    if network.beams is not None:
        grid = grid._replace(shade=evened(grid, rays_of(rows, columns)[0]) * grid.returned)
    while network.beams is not None and len(columns) == FINEST and len(rows) < TALLEST and np.diff(rows).min() > 1:
        told, rows = rays_of(rows, columns)[0], with_between(rows)
        grid = interleaved(grid, draw_beams(network.beams, grid, told, rays_of(rows[1::2], columns)[0], rng))
    return grid, rows


def _in_line(grid: Grid, rows: np.ndarray, sensor: Sensor) -> Grid:
    """The grid with its beams straight with those above and below."""
    return known_grid(across_rings(_metres(grid), rows, sensor), grid.shade)


def _whole(grid: Grid, rows: np.ndarray, columns: np.ndarray, rays_of: RaysOf, height: int) -> tuple[Grid, np.ndarray]:
    """The grid with the few beams above its first and below its last, which go on with the planes of the next two."""
    ends = np.arange(rows[0]), np.arange(rows[-1] + 1, height)
    ends_of = [beyond(grid, rays_of(rows, columns)[0], rays_of(end, columns)[0], side)
              for end, side in zip(ends, ((0, 1), (-1, -2)), strict=True)]  # fmt: skip
    parts = zip(ends_of[0], grid, ends_of[1], strict=True)
    return Grid(*(torch.cat(part, 1) for part in parts)), np.concatenate([ends[0], rows, ends[1]])


def beyond(grid: Grid, rays: Tensor, new: Tensor, side: tuple[int, int]) -> Grid:
    """Beams of rays (B, 8, E, C) beyond those at `side` of a grid and its rays, the next one and the one behind it.

    Where the next one is of the ground, as high as that, or as the ground is that it meets as far to the side, for
    kerbs run along the street; else on the plane of both where they are of one, or upright on the next one, down to
    flat ground. What returns there, returns.
    """
    told = nearness(grid.code, grid.returned, rays), (rays[:, 0] / 3).tan()
    (near, near2), (slope, slope2) = ([part[:, i, None] for i in side] for part in told)
    steep, flat, level = (new[:, 0] / 3).tan(), _of_flat_ground(new), _of_flat_ground(rays)[:, side[0], None]
    far = near + (near - near2) * (steep - slope) / (slope - slope2)
    plane = (near2 > 0) & ((near / near2.clamp_min(1e-6)).log().abs() < SMOOTH) & (far > 0.3 * near)
    far = torch.where(plane, far, near)
    far = torch.where(steep < 0, torch.maximum(far, flat), far)
    ground = (near > 0) & ((near / level).clamp_min(1e-6).log().abs() < LEVEL) & (slope < 0)
    aside, lower = _as_far_aside(level / flat, rays[:, 4:6, side[0]]), near / level
    shade = grid.shade[:, side[0], None].expand_as(far)
    on, there, reads = (part.expand_as(far).gather(2, aside) for part in (ground, lower, shade))
    far = torch.where(ground & (steep < 0), flat * torch.where(on, there, lower), far)
    shade = torch.where(ground & (steep < 0) & on, reads, shade)
    metres = 1 / (far.clamp_min(1e-4) * levelled(new))
    back = grid.returned[:, side[0], None] & (new[:, 6] < 0.5)
    code = torch.where(back, encode_range(metres), 0)
    return Grid(code, shade * back, back)


def _of_flat_ground(rays: Tensor) -> Tensor:
    """(B, R, C) 1 / metres along the ground to where rays (B, 8, R, C) meet it, were it flat."""
    return 1 / (decode_range(rays[:, 1] / 2) * levelled(rays))


def _as_far_aside(nearer: Tensor, azimuth: Tensor) -> Tensor:
    """(B, E, C) columns in which a ring meets the ground as far to the side, and as much ahead or behind, as each of
    these (B, 2, C), sine and cosine of the azimuth, does on a ring `nearer` (B, E, C) times as near."""
    sine, cosine = (part[:, None] for part in azimuth.unbind(1))
    sine = (nearer * sine).clamp(-1, 1)
    ahead = (1 - sine**2).sqrt().copysign(cosine)
    return (sine[..., None] * azimuth[:, 0, None, None] + ahead[..., None] * azimuth[:, 1, None, None]).argmax(-1)


def _straight(grid: Grid, rows: np.ndarray, sensor: Sensor) -> Grid:
    metres = straightened(_metres(grid), rows, sensor, edges=True)
    return known_grid(with_facades(metres, rows, sensor), grid.shade)


def _metres(grid: Grid) -> Tensor:
    return decode_range(grid.code) * grid.returned
