"""Large holes, where nothing is known around: drawn as generated scans are, around what is known."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidarsynth.diffusion import repaint
from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.samplers import State, even_log_snr, noise_like
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.column_neighbours import known_grid
from lidarsynth.networks.column_transformer import draw
from lidarsynth.networks.drafts import drafted
from lidarsynth.systems.cascade.known import band_of, best_known, widened
from lidarsynth.systems.cascade.layout import RaysOf, detailed, one_thread, to_draft, velocity
from lidarsynth.systems.cascade.surfaces import straightened
from lidarsynth.systems.filling import Filling
from lidarsynth.systems.scan_model import OnStep

SMOOTH, APART = 0.15, 4  # natural logarithm of 1 / metres of two pixels of a plane; lines from one to the next


class Told(NamedTuple):
    """What is known of an image (H, W): metres, 0 where nothing returned, reflectance, and which pixels."""

    metres: np.ndarray
    reflectance: np.ndarray
    known: np.ndarray


def repainted(
    denoiser: Denoiser,
    known: Tensor,
    here: Tensor,
    rng: list[torch.Generator],
    how: Filling,
    on_step: OnStep,
    to_the_end: bool = True,
) -> State:
    """The state of x_0, or of a draft, that agrees with `known` (B, 3, 16, 128) `here` (B, 1, 16, 128) bool, after a
    resolved request's steps."""
    assert how.steps is not None and how.resamples is not None
    times = even_log_snr if to_the_end else to_draft
    states = repaint.repaint(
        denoiser, noise_like(known, rng), known, here, rng, steps=how.steps, resamples=how.resamples, grid=times
    )
    *_, last = map(partial(_told, on_step or (lambda: None)), states)
    return last


def _told(on_step: Callable[[], object], state: State) -> State:
    on_step()
    return state


def with_holes_drawn(
    network: Cascade,
    told: Told,
    sensor: Sensor,
    unevenness: np.ndarray,
    rays_of: RaysOf,
    rng: list[torch.Generator],
    how: Filling,
    on_step: OnStep,
) -> Told:
    """What is told, with a grid of new pixels where nothing is known around.

    unevenness  (H, 1) how much less than the mean beam each reads, in reflectance
    rays_of     rows, columns -> rays (1, 8, R, C) and standing elevations (1, R, C)

    A draft of the whole turn, which agrees with what is known, by RePaint; then the columns, of which known pixels stay
    as they are, and what is between. Without columns, RePaint to the end.
    """
    rows, columns, cell = best_known(told.known)
    rays, standing = rays_of(rows, columns)
    metres, shade, known = (part[np.ix_(rows, columns)][None] for part in told)
    values = torch.from_numpy(metres.astype(np.float32)).to(rays), torch.from_numpy(shade.astype(np.float32)).to(rays)
    here, dim = torch.from_numpy(known).to(rays.device), torch.from_numpy(unevenness[rows]).to(rays)
    code = network.coarse.encode(*values, standing, dim)
    # What is known guides; a sector lost erred 6.1 m for 4.3 with both.
    denoiser = velocity(network, rays, guided=False)
    state = repainted(denoiser, code, here[:, None], rng, how, on_step, network.columns is None)
    if network.columns is None:
        drawn, light = network.coarse.decode(state.x_s, standing, dim)
        parts = straightened(drawn, rows, sensor), light, rows, columns
    else:
        after = drafted(network.coarse, state.x_s, state.s, rays, standing)
        with one_thread():
            grid = draw(network.columns, rays, after, rng, known=(known_grid(values[0], values[1] + dim), here))
        parts = detailed(network, grid, (rows, columns), rays_of, sensor, unevenness, rng)
    new = parts[0][0].cpu().numpy(), parts[1][0].cpu().numpy()
    return _placed(told, ~widened(cell), *new, parts[2], parts[3], sensor.max_range)


def _placed(
    told: Told,
    hole: np.ndarray,
    metres: np.ndarray,
    reflectance: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    farthest: float,
) -> Told:
    """What is told, with pixels (R, C) of these rows and columns where a cell (16, 128) is a `hole`."""
    whole, grid = Told(*(part.copy() for part in told)), np.ix_(rows, columns)
    height, width = told.known.shape
    inside = hole[np.ix_(band_of(rows, height, hole.shape[0]), band_of(columns, width, hole.shape[1]))]
    for part, new in zip(whole, (np.where(metres > farthest, 0, metres), reflectance, True), strict=True):
        part[grid] = np.where(inside, new, part[grid])
    return whole


def with_planes(told: Told, known: np.ndarray, slopes: np.ndarray) -> Told:
    """What is told, with what lies between the columns and beams that were drawn in a hole, where the two next ones are
    of one plane or nothing. Where all beams were drawn, it is left to the fill; told every second beam and column of a
    hole alone, that made rings that stray by a part of their distance.

    known   (H, W) bool, what was told before anything was drawn
    slopes  (H,) tangents of the beams' elevations
    """
    drawn = told.known & ~known
    rows, columns = np.flatnonzero(drawn.any(1)), np.flatnonzero(drawn.any(0))
    if len(rows) < 2 or len(columns) < 2 or np.median(np.diff(rows)) == 1:
        return told
    level = np.hypot(1, slopes)[:, None].astype(np.float32)  # metres along a beam for each along the ground
    whole = Told(*(part.copy() for part in told))
    whole.metres[:] = level * _inverse(told.metres)
    _bridge(Told(*(part.T for part in whole)), columns, np.arange(told.known.shape[1]))
    _bridge(whole, rows, slopes)
    whole.metres[:] = np.where(whole.known & ~told.known, level * _inverse(whole.metres), told.metres)
    return whole


def _bridge(told: Told, lines: np.ndarray, places: np.ndarray) -> None:
    """Fill in lines (H, W) between each two of those at `lines`, where both are told: in 1 / metres, by the places."""
    for first, last in pairwise(lines):
        if last - first > APART:
            continue
        both = told.known[first] & told.known[last]
        near, far = told.metres[first], told.metres[last]
        none = both & (near == 0) & (far == 0)
        plane = (near > 0) & (far > 0) & (np.abs(np.log(np.maximum(near, 1e-6) / np.maximum(far, 1e-6))) < SMOOTH)
        for line in range(first + 1, last):
            share = np.float32((places[line] - places[first]) / (places[last] - places[first]))
            new = ~told.known[line] & (none | both & plane)
            for part in (told.metres, told.reflectance):
                part[line] = np.where(new, (1 - share) * part[first] + share * part[last], part[line])
            told.known[line] |= new


def _inverse(values: np.ndarray) -> np.ndarray:
    """1 / values of any shape, 0 of what is none."""
    return np.where(values > 0, 1 / np.maximum(values, 1e-6), 0)
