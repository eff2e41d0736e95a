"""What the cascade learns from: crops of streets seen by any sensor with pixels hidden, and grids of whole turns."""

from __future__ import annotations

import math
from collections.abc import Sized
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidarsynth.data.dataset import CachedImages, SeveralCaches
from lidarsynth.experiment.record import Experiment
from lidarsynth.lidar.corruption import every_beam
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.networks.between_beams import with_between
from lidarsynth.networks.coarse_unet import COLUMNS, RAY_CHANNELS, ROWS, grid_columns, grid_rays, grid_rows
from lidarsynth.networks.column_neighbours import known_grid
from lidarsynth.networks.fill_unet import Known
from lidarsynth.networks.rays import Rays, rays_of, stacked
from lidarsynth.streets.hdl64e import hidden, is_kittis, unevenness
from lidarsynth.streets.kittis_car import outline_of, outlined
from lidarsynth.systems.cascade.lessons import AS_FAR, FARTHEST, HEIGHT, WIDTH, Lessons, lessons, to_height
from lidarsynth.systems.cascade.losing import losing
from lidarsynth.systems.cascade.patterns import every_column, pattern
from lidarsynth.systems.cascade.surfaces import evened
from lidarsynth.systems.diffusion.training import generation_count
from lidarsynth.training.randomness import sample_seed
from lidarsynth.training.task import Images

TALL, WIDE = 2 * ROWS - 1, 160  # of a part of a taller grid
FIRST = 0.35  # of samples are drawn in 16 beams, of which columns are known: the first pass of generation
EVERY = 4  # steps from one of the observer to the next: it learns sooner
LOSING = 0.7  # of what learns the most likely image lack some of their returns
EVEN = SENSORS["hdl-64e"]
COUNTED = 64  # images of caches that tell whether there are labels
SCALE = 0.15  # worlds are up to so much larger or smaller, in the logarithm


class Crops(NamedTuple):
    """b crops of which pixels are hidden; the first `samples` learn to be drawn, the others the most likely image."""

    known: Known
    rays: Rays
    metres: Tensor  # (b, 1, H, W), 0 where nothing returned
    reflectance: Tensor  # (b, 1, H, W)
    classes: Tensor  # (b, 1, H, W) int64, 0 where nobody has said
    seeds: tuple[int, ...]
    samples: int


class Grids(NamedTuple):
    """Turns at the coarse stage, of R beams, 16 where nothing else is said, and C columns."""

    metres: Tensor  # (b, R, C)
    reflectance: Tensor
    rays: Tensor  # (b, 8, R, C)
    standing: Tensor  # (b, R, C) radians


class Seen(NamedTuple):
    """b crops as a sensor reports them, of which nothing is hidden, (b, 1, H, W)."""

    rays: Rays
    metres: Tensor  # 0 where nothing returned
    reflectance: Tensor
    surface: Tensor  # metres of what rays meet, of streets cast perfectly; 0 everywhere of other crops


class CascadeBatch(NamedTuple):
    """One process's share of one pass."""

    crops: Crops
    grids: Grids  # of 128 columns
    finer: Grids  # of 256 or, every second step, 512, where the sensors have so many
    taller: Grids  # of 31 beams and 160 columns, see `taller`
    lessons: Lessons  # in what returns are of
    seen: Seen | None = None  # for an observer


def draw(experiment: Experiment, images: Images, indices: list[int], step: int, positions: list[int]) -> CascadeBatch:
    """The samples at `positions` of step `step`'s global batch: functions of (seed, step, position).

    Raises ValueError where the classes of the images are to be learned, and these have none.
    """
    if experiment.model.own_classes:
        check_labelled(images)
    taken, seed = images.take(indices), experiment.training.seed
    samples = generation_count(experiment.training, step)
    seeds = tuple(sample_seed(seed, step, position) for position in positions)
    rngs = [np.random.default_rng(number) for number in seeds]
    crops = []
    for image, rng, position in zip(taken, rngs, positions, strict=True):
        if position >= samples:
            image = evenly(_worse(mixed(image, images, experiment.data.mix, rng), rng), experiment.data.even, rng)
        crops.append(crop(image, rng, position < samples, experiment.training.upsampling_share))
    grids = [grid(image, rng) for image, rng in zip(taken, rngs, strict=True)]
    wide = 4 * COLUMNS if step % 2 and min(image.shape[1] for image in taken) >= 4 * COLUMNS else 2 * COLUMNS
    finer = [grid(image, np.random.default_rng((n, wide)), wide) for image, n in zip(taken, seeds, strict=True)]
    tall = [
        taller(image, np.random.default_rng((n, TALL)), step % 2 == 1) for image, n in zip(taken, seeds, strict=True)
    ]
    known, truth = ([torch.cat(part) for part in zip(*(c[i] for c in crops), strict=True)] for i in (0, 2))
    rays = stacked([c[1] for c in crops])
    count = sum(position < samples for position in positions)
    parts = (Grids(*(torch.stack(part) for part in zip(*each, strict=True))) for each in (grids, finer, tall))
    observed = experiment.model.observer_channels and step % EVERY == 0
    return CascadeBatch(
        Crops(Known(*known), rays, truth[0], truth[1], truth[2], seeds, count),
        *parts,
        lessons=lessons(_all_mixed(experiment, images, taken, seeds), seeds),
        seen=_all_seen(experiment, images, taken, seeds) if observed else None,
    )


@lru_cache(maxsize=2)
def check_labelled(images: Images) -> None:
    """Raises ValueError where none of the images of caches, of at most `COUNTED` from everywhere, says a class."""
    if isinstance(images, CachedImages | SeveralCaches):
        labels = (images.take([i])[0].label for i in images.spread(COUNTED))
        if not any(label is not None and (label > 0).any() for label in labels):
            raise ValueError("expected images with labels, as model.own_classes learns from them, found none; "
                             "`lidarsynth label` names scans")  # fmt: skip


def _worse(image: RangeImage, rng: np.random.Generator) -> RangeImage:
    """Most streets with fewer returns than they have; a recorded scan, which lacks its own, as it is."""
    return image if image.surface is None or rng.random() >= LOSING else losing(image, rng)


def _all_mixed(
    experiment: Experiment, images: Images, taken: list[RangeImage], seeds: tuple[int, ...]
) -> list[RangeImage]:
    rngs = [np.random.default_rng((number, 6)) for number in seeds]
    return [mixed(image, images, experiment.data.mix, rng) for image, rng in zip(taken, rngs, strict=True)]


def _all_seen(experiment: Experiment, images: Images, taken: list[RangeImage], seeds: tuple[int, ...]) -> Seen:
    rngs = [np.random.default_rng((number, 4)) for number in seeds]
    each = [seen(mixed(a, images, experiment.data.mix, rng), rng) for a, rng in zip(taken, rngs, strict=True)]
    arrays = (torch.cat(part) for part in zip(*(part for _, *part in each), strict=True))
    return Seen(stacked([rays for rays, *_ in each]), *arrays)


def mixed(image: RangeImage, images: Images, share: float, rng: np.random.Generator) -> RangeImage:
    """The image; with the chance `share`, an arc of it is that of another one of the same sensor (PolarMix, Xiao et al.
    2022), anywhere in the turn. Streets, which have no number, are not mixed."""
    if not share or not isinstance(images, Sized) or rng.random() >= share:
        return image
    other = images.take([int(rng.integers(len(images)))])[0]
    if other.sensor != image.sensor:
        return image
    width = image.shape[1]
    arc = (int(rng.integers(width)) + np.arange(int(rng.integers(1, width // 2 + 1)))) % width
    taken = np.isin(np.arange(width), arc)
    return RangeImage(
        np.where(taken, other.range, image.range),
        np.where(taken, other.reflectance, image.reflectance),
        np.where(taken, other.mask, image.mask),
        image.sensor,
        np.where(taken, *(np.zeros(a.shape, int) if a.label is None else a.label for a in (other, image))),
    )


def evenly(image: RangeImage, share: float, rng: np.random.Generator) -> RangeImage:
    """The image; of KITTI's sensor, with the chance `share`, its points as R2DM and others draw them: by elevation in
    the even grid `hdl-64e`, some of whose rows no laser hits. Not with the surfaces that rays meet, nor instances."""
    if not share or not is_kittis(image.sensor) or rng.random() >= share:
        return image
    return project(image.to_scan(), EVEN, "spherical", image.sensor.width)


def crop(
    image: RangeImage, rng: np.random.Generator, sampled: bool, upsampling: float = 0.0
) -> tuple[Known, Rays, tuple[Tensor, ...]]:
    """Known pixels, rays, and the truth (metres, reflectance, class), each (1, 1, 64, 256), of a part of an image.

    A world somewhat larger or smaller, seen in a mirror half of the time, with reflectances of another response; the
    carrier is unknown at times, and the tilt and the beams' dimness, since users do not know theirs either. At times
    all surfaces are known but not which of them return, as in a simulator's scan; or everything is, for the classes.
    A share `upsampling` of what is not `sampled` knows every fourth beam instead.
    """
    first = sampled and rng.random() < FIRST
    sensor, rows = _window(image.sensor, rng, first)
    columns = (int(rng.integers(sensor.width)) + np.arange(WIDTH)) % sensor.width
    scale = math.exp(rng.uniform(-SCALE, SCALE)) if rng.random() < 0.7 else 1.0
    blocked = outlined(image.sensor, outline_of(image.sensor, image, image.mask))[rows]
    told_sensor = sensor if rng.random() < 0.7 else replace(sensor, tilt=(0.0, 0.0))
    told_sensor = replace(told_sensor, mount=told_sensor.mount * scale)
    unaware = rng.random() < 0.3
    metres = image.range[rows][:, columns] * np.float32(scale)
    reflectance, dim = _responding(image.reflectance[rows][:, columns], unevenness(image.sensor)[rows], rng)
    reflectance = reflectance if sampled or rng.random() < 0.3 else _uneven(reflectance, rng)
    dim = tuple(dim) if rng.random() < 0.6 else ()
    rays = rays_of(told_sensor, np.zeros_like(blocked) if unaware else blocked, columns, dim)
    hole = blocked[:, columns]
    metres = np.where(metres < FARTHEST, metres, np.float32(0))
    told = every_column(metres.shape, sensor.width, rng) if first else pattern(metres.shape, sensor.width, rng, sampled)
    surface, kind = image.surface, rng.random()
    perfect = surface is not None and not first and kind < (0.2 if sampled else 0.1)
    told[:] = ~np.bool_(perfect) & (told | (not sampled and kind > 0.94))
    if upsampling and not sampled and rng.random() < upsampling:
        told, perfect = every_beam(metres.shape, 4, int(rng.integers(4))), False
    if rng.random() < 0.4 and kind <= 0.94:
        told &= metres > 0
    told = told & ~hole if unaware else told | hole
    lit = told & (metres > 0) & (rng.random() >= 0.1)
    near, returned = metres, told & (metres > 0)
    if perfect:
        assert surface is not None
        near = surface[rows][:, columns] * np.float32(scale)
        near = np.where(near < FARTHEST, near, np.float32(0))
        returned = near > 0
        metres = np.where((metres > 0) & (np.abs(metres - near) < AS_FAR[0] + AS_FAR[1] * near), near, np.float32(0))
    label = np.zeros(metres.shape) if image.label is None else image.label[rows][:, columns]
    arrays = [metres, reflectance * (metres > 0), told, returned, lit & (metres > 0), near, label]
    below = HEIGHT - len(metres)
    full = [np.pad(a, ((0, below), (0, 0)), constant_values=a is told) for a in arrays]
    if rng.random() < 0.5:
        full = [a[:, ::-1] for a in full]
        rays = Rays(*(part.flip(3) for part in rays))
    r, f, told, returned, lit, near, label = (
        torch.from_numpy(np.ascontiguousarray(a, a.dtype if a.dtype == bool else np.float32))[None, None] for a in full
    )
    rays = Rays(*map(to_height, rays))
    return Known(near * returned, f * lit, told, returned, lit), rays, (r, f, label.long())


def seen(image: RangeImage, rng: np.random.Generator) -> tuple[Rays, Tensor, Tensor, Tensor]:
    """`Seen` of a part of an image, as its sensor reports it: somewhat larger or smaller, mirrored half of the time."""
    sensor, rows = _window(image.sensor, rng)
    columns = (int(rng.integers(sensor.width)) + np.arange(WIDTH)) % sensor.width
    scale = np.float32(math.exp(rng.uniform(-SCALE, SCALE))) if rng.random() < 0.5 else np.float32(1)
    dim, blocked = unevenness(image.sensor)[rows][:, 0], hidden(image.sensor)[rows]
    rays = rays_of(sensor, blocked, columns, tuple(dim))
    surface = np.zeros(image.shape, np.float32) if image.surface is None else image.surface
    arrays = [part[rows][:, columns] for part in (image.range * scale, image.reflectance * image.mask, surface * scale)]
    below = HEIGHT - len(rows)
    arrays = [np.pad(np.where(blocked[:, columns], 0, part), ((0, below), (0, 0))) for part in arrays]
    if rng.random() < 0.5:
        arrays, rays = [part[:, ::-1] for part in arrays], Rays(*(part.flip(3) for part in rays))
    metres, reflectance, surface = (torch.from_numpy(np.ascontiguousarray(a, np.float32))[None, None] for a in arrays)
    return Rays(*map(to_height, rays)), metres, reflectance, surface


def _responding(reflectance: np.ndarray, dim: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Reflectance (R, C), at times of a sensor of another response, and how dim its beams then are, (R,)."""
    if rng.random() >= 0.3:
        return reflectance, dim[:, 0]
    seen, even = reflectance > 0, np.maximum(reflectance + dim, 0)  # what reads 0 reads 0 to others, too
    power, scale = math.exp(rng.normal(0, 0.25)), np.float32(rng.uniform(0.6, 1.2))
    return np.clip(scale * (even**power - dim), 0, 1) * seen, scale * dim[:, 0]


def _uneven(reflectance: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Reflectance (R, C) of beams that answer each in its own way, which nobody has measured, and half of the time of
    more speckle: that of KITTI's sensor differs from beam to beam by half as much again as dimness says."""
    beams = (len(reflectance), 1)
    gain = np.exp(rng.normal(0, 1, beams) * rng.uniform(0, 0.22))
    offset = rng.normal(0, 1, beams) * rng.uniform(0, 0.035)
    speckle = np.exp(rng.normal(0, 1, reflectance.shape) * rng.uniform(0, 0.15) * (rng.random() < 0.5))
    changed = np.clip(reflectance * speckle * gain + offset, 0, 1)
    return np.where(reflectance > 0, changed, 0).astype(np.float32)


def _window(sensor: Sensor, rng: np.random.Generator, first: bool = False) -> tuple[Sensor, np.ndarray]:
    """At most 64 beams: all, every second, or a run of 64; `first`, the 16 that generation fills first; their rows."""
    if first:
        rows = grid_rows(sensor.height, rng.random())
        return sensor.rows(rows.tolist()), rows
    if sensor.height <= HEIGHT:
        return sensor, np.arange(sensor.height)
    if sensor.height >= 2 * HEIGHT and rng.random() < 0.3:
        rows = np.arange(int(rng.integers(2)), sensor.height, 2)[:HEIGHT]
    else:
        rows = int(rng.integers(sensor.height - HEIGHT + 1)) + np.arange(HEIGHT)
    return sensor.rows(rows.tolist()), rows


def grid(image: RangeImage, rng: np.random.Generator, count: int = COLUMNS) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Metres, reflectance, rays and standing elevations of an image in 16 beams and `count` columns, any phase, maybe
    mirrored.

    Reflectance as beams that are all alike would read it.
    """
    rows, columns = grid_rows(image.shape[0], rng.random()), grid_columns(image.shape[1], rng.random(), count)
    return _grid(image, rows, columns, grid_rays(image.sensor, hidden(image.sensor), rows, columns), rng)


def taller(image: RangeImage, rng: np.random.Generator, fine: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`grid` of 31 beams, of which every second one is half-way between two others, and 160 of 512 columns in a row.

    The beams of the grid and those between, or `fine`, of those and what is between them again. Reflectances are
    evened, since speckle is not drawn. A sensor that has no 31 such beams or 512 columns gives a grid of blocked rays,
    which teaches nothing.
    """
    (height, width), first = image.shape, rng.random()
    rows = grid_rows(height, first) if height >= ROWS else np.zeros(ROWS, int)
    for _ in range(1 + fine):
        rows = with_between(rows) if np.diff(rows).min() > 1 else rows
    if len(rows) < TALL or width < 4 * COLUMNS:
        none, rays = torch.zeros(TALL, WIDE), torch.zeros(RAY_CHANNELS, TALL, WIDE)
        rays[6] = 1
        return none, none, rays, none
    start, turn = 2 * int(rng.integers((len(rows) - TALL) // 2 + 1)), int(rng.integers(4 * COLUMNS))
    rows = rows[start : start + TALL]
    columns = grid_columns(width, rng.random(), 4 * COLUMNS)[(turn + np.arange(WIDE)) % (4 * COLUMNS)]
    each = [grid_rays(image.sensor, hidden(image.sensor), rows[k::2], columns) for k in (0, 1)]
    order = np.argsort(np.r_[0:TALL:2, 1:TALL:2])  # their places in one after the other
    told = torch.cat([each[0][0], each[1][0]], -2)[..., order, :], torch.cat([each[0][1], each[1][1]], -2)[order]
    metres, reflectance, rays, standing = _grid(image, rows, columns, told, rng)
    calm = evened(known_grid(metres[None], reflectance[None]), rays[None])[0]
    return metres, calm, rays, standing


def _grid(
    image: RangeImage, rows: np.ndarray, columns: np.ndarray, told: tuple[Tensor, Tensor], rng: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`grid` of these rows and columns, with what is told of their rays."""
    (rays, standing), (metres, reflectance) = told, read_at(image, rows, columns)
    if rng.random() < 0.5:
        metres, reflectance, rays, standing = (part.flip(-1) for part in (metres, reflectance, rays, standing))
        rays[4] *= -1  # the sine of the azimuth
    return metres, reflectance, rays, standing


def read_at(image: RangeImage, rows: np.ndarray, columns: np.ndarray) -> tuple[Tensor, Tensor]:
    """Metres (R, C), 0 for no return, and reflectance of these rows and columns, as even beams would read it."""
    at = np.ix_(rows, columns)
    metres = torch.from_numpy(np.where(image.range[at] < FARTHEST, image.range[at], 0).astype(np.float32))
    even = (image.reflectance[at] + unevenness(image.sensor)[rows]) * (image.range[at] > 0)
    return metres, torch.from_numpy(even.astype(np.float32))
