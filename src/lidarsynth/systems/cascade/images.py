"""Images of a cascade: grids placed in them, what the fill answers, and a sensor's noise on it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER, CLASSES
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.coarse_unet import COLUMNS, ROWS, grid_columns, grid_rows
from lidarsynth.networks.fill_unet import NOISES, Known, draw_coherent, draw_noise
from lidarsynth.networks.rays import Rays
from lidarsynth.networks.things import draw_on_things, things
from lidarsynth.streets.hdl64e import shifts
from lidarsynth.streets.materials import NUMBER, TABLE
from lidarsynth.streets.sensor_model import range_noise, speckled


class Grain(NamedTuple):
    """How much samples take of each kind of noise of training, speckle, stripes and patches; and of `draw_coherent`,
    where whether rays return has noise of its own. ground: patches are things; how much is on the ground."""

    noise: tuple[float, float, float]
    returning: tuple[float, float, float] | None = None
    ground: float | None = None


# Generation's, chosen by street-2 (docs/generation.md); a completed sample's, which errs less by speckle alone;
# `realise`'s; an observer's, less on the ground than it learned, with which streets are read better; that of one which
# learned from scans of the sensor, all of it.
GENERATED, SPECKLE, REALISED = Grain((1.0, 0.5, 0.0), (0.5, 0.4, 0.6)), Grain((1.0, 0.0, 0.0)), Grain((0.4, 0.4, 0.8))
OBSERVED, TUNED = Grain((1.0, 1.0, 1.0), ground=0.6), Grain((1.0, 1.0, 1.0), ground=1.0)
# Metres, standard deviation along the ray of what misses the surface that the fill has drawn, for a leaf, a stalk or an
# arm before or behind it: of shares of the rays. Chosen by street-2 (docs/generation.md); streets have 0.08 for leaves,
# 0.035 for grass and 0.02 for bark, and shapes for the rest.
STRAYING = {"vegetation": ((1.0, 0.08),), "terrain": ((1.0, 0.031),), "trunk": ((0.9, 0.025), (0.1, 0.08)),
            "person": ((0.7, 0.0), (0.3, 0.04))}  # fmt: skip
# The same of buildings, whose windows and sills are edges, which the more rays meet the farther apart these are: the
# least and the greatest share, and how much it rises per metre from so many on, in a turn of TURN columns.
FRAMES, WINDOWS, RISING, NEARBY, TURN = 0.045, (0.02, 0.3), 0.009, 5.0, 1024
UPRIGHT = 3.0  # degrees of elevation in which rays of a column stray alike from a building: frames and sills are edges
ALIKE = 32  # parts of the turn in which classes that the fill is in doubt about are drawn alike: things are whole
# The label of a sample in the making: the likeliest class, and so many times the one that was drawn, whose texture it
# has: so there is as much terrain and fence as in streets, while labels are right more often.
TEXTURE = 64
FAR_ABOVE = 2.0  # degrees from a grid's first row to the sensor's first beam, from which on it is drawn, not gone on to
# What gives a class its speckle, and what gives it to all others.
_MADE_OF = {"road": "road", "parking": "parking", "sidewalk": "sidewalk", "building": "wall", "fence": "fence",
            "vegetation": "leaves", "trunk": "bark", "terrain": "grass", "car": "paint", "truck": "paint",
            "other-vehicle": "paint", "pole": "pole", "traffic-sign": "sign"}  # fmt: skip
SPREAD = np.array([TABLE[NUMBER[_MADE_OF.get(name, "cloth")], 2] for name, _ in CLASSES], np.float32)


def grid_of(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Rows (16,) and columns (128,) of the coarse grid. Raises ValueError for a sensor that has fewer.

    The rows begin half a step below the first beam, or with it where that is far above the next ones: what reaches so
    high has to be drawn, while below the last row there is ground.
    """
    if sensor.height < ROWS or sensor.width < COLUMNS:
        raise ValueError(f"expected a sensor of at least {ROWS} beams and {COLUMNS} columns to generate, found "
                         f"{sensor.name} with {sensor.height} and {sensor.width}")  # fmt: skip
    rows = grid_rows(sensor.height)
    if sensor.elevations[0] - sensor.elevations[rows[0]] > FAR_ABOVE:
        rows = grid_rows(sensor.height, first=0.0)
    return rows, grid_columns(sensor.width)


def parts(first: int, stop: int, size: int) -> list[slice]:
    """Numbers `first` (or 0) to `stop` - 1 of a block of grids, at most `size` at a time: what is filled at once."""
    return [slice(i, min(i + size, stop)) for i in range(max(first, 0), stop, size)]


def placed(
    metres: np.ndarray,
    reflectance: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    sensor: Sensor,
    blocked: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(B, R, C) metres and reflectance of these rows and columns in whole images (B, H, W), and what is told of them.

    Ranges beyond the sensor's limits are no returns; blocked rays (H, W) are known to be empty.
    """
    shape, grid = (len(metres), *blocked.shape), np.ix_(np.arange(len(metres)), rows, columns)
    ranges, shades, told = np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, bool)
    ranges[grid], shades[grid], told[grid] = metres, reflectance, True
    ranges[(ranges < sensor.min_range) | (ranges > sensor.max_range)] = 0
    ranges[:, blocked] = 0
    return ranges, shades * (ranges > 0), told | blocked


def noisy(image: RangeImage, rng: torch.Generator) -> RangeImage:
    """The image with a sensor's range noise and each beam's own error, as streets have them; by its labels, if any,
    also with the roughness of what grows, and then with the likeliest class alone."""
    noise = torch.randn(image.shape, generator=rng).numpy() * range_noise(image.range) + shifts(image.sensor)
    if image.label is not None:
        noise = noise + _straying(texture(image.label), image.range, image.sensor, rng)
    label = None if image.label is None else image.label % TEXTURE
    limits = image.sensor.min_range, image.sensor.max_range
    return replace(image, range=np.clip(image.range + noise, *limits) * image.mask, label=label)


def textured(drawn: list[RangeImage], even: np.ndarray, rng: list[torch.Generator]) -> list[RangeImage]:
    """Images as recorded: their reflectances `even` (B, H, W) on average, with the speckle, the roughness and the noise
    of what they show, by their labels."""
    return [noisy(as_read(image, of, one), one) for image, of, one in zip(drawn, even, rng, strict=True)]


def texture(label: np.ndarray) -> np.ndarray:
    """(H, W) classes whose texture a sample in the making has."""
    return np.where(label < TEXTURE, label, label // TEXTURE)


def _straying(label: np.ndarray, away: np.ndarray, sensor: Sensor, rng: torch.Generator) -> np.ndarray:
    """(H, W) metres: how far each ray strays from what is of a class (H, W), so many metres away (H, W)."""
    unit, chance = torch.randn(label.shape, generator=rng).numpy(), torch.rand(label.shape, generator=rng).numpy()
    metres = np.zeros(label.shape, np.float32)
    for name, some in STRAYING.items():
        before, here = 0.0, label == CLASS_NUMBER[name]
        for share, rough in some:
            strays = here & (before <= chance) & (chance < before + share)
            metres[strays] = rough * unit[strays]
            before += share
    bands = np.unique(np.floor(np.asarray(sensor.elevations) / UPRIGHT), return_index=True, return_inverse=True)
    first = bands[1][bands[2]]  # row of each one's band
    share = np.clip(WINDOWS[0] + RISING * (away - NEARBY) * TURN / sensor.width, *WINDOWS)
    strays = (label == CLASS_NUMBER["building"]) & (chance[first] < share)
    metres[strays] = FRAMES * unit[first][strays]
    return metres


def with_doubts(logits: Tensor | None, rng: list[torch.Generator] | None) -> Tensor | None:
    """Logits of classes (B, C, H, W) whose greatest is one drawn by their softmax, with a generator for each image;
    None without.

    They get Gumbel noise, whose quantiles are those of Gaussians that change slowly around the turn: what stands side
    by side is of one class.
    """
    if logits is None or rng is None:
        return None
    classes, width = logits.shape[1], logits.shape[3]
    place = torch.arange(width) * (ALIKE / width)
    first, turned = place.long(), (place - place.floor()) * (math.pi / 2)
    steps = torch.stack([torch.randn(classes, 1, ALIKE, generator=one) for one in rng])
    smooth = steps[..., first] * turned.cos() + steps.roll(-1, -1)[..., first] * turned.sin()
    return logits - torch.special.ndtr(smooth).clamp(1e-6, 1 - 1e-6).log().neg().log().to(logits.device)


def drawn(grain: Grain, known: Known, rays: Rays, rng: list[torch.Generator] | None) -> tuple[Tensor, Tensor | None]:
    """Noise (B, NOISES, H', W') for the fill, zeros without generators, and that of returning, if it has its own."""
    shape = (known.told.shape[2], known.told.shape[3])
    if rng is None:
        return torch.zeros(len(known.told), NOISES, *shape), None
    if grain.ground is not None:
        each = [draw_on_things(of, one, grain.ground) for of, one in zip(things(known.metres, rays), rng, strict=True)]
        return torch.tensor(grain.noise)[:, None, None] * torch.cat(each), None
    noise = weighted(draw_noise, grain.noise, shape, rng)
    return noise, None if grain.returning is None else weighted(draw_coherent, grain.returning, shape, rng)


def weighted(
    draw: Callable[[tuple[int, int, int], torch.Generator], Tensor],
    amounts: tuple[float, float, float],
    shape: tuple[int, int],
    rng: list[torch.Generator],
) -> Tensor:
    """(B, 3, H, W): so much of each kind of noise, each image's by a generator of its own."""
    return torch.tensor(amounts)[:, None, None] * torch.cat([draw((1, *shape), generator) for generator in rng])


def agreed(
    drawn: list[RangeImage], calm: list[RangeImage], metres: np.ndarray, columns: np.ndarray
) -> list[RangeImage]:
    """Samples whose rays between two known ones of a beam that agree whether they return, do as they do.

    metres   (B, H, C), 0 for no return, of these columns; where they are only 128, too much may be between them
    columns  (C,), rising

    A ray between two that return has the likeliest range, where the sample has none.
    """
    if len(columns) <= COLUMNS:
        return drawn
    left = np.searchsorted(columns, np.arange(drawn[0].sensor.width), side="right") - 1  # -1: the last, around the turn
    right = np.where(np.isin(np.arange(len(left)), columns), left, (left + 1) % len(columns))
    images = []
    for sample, likely, known in zip(drawn, calm, metres > 0, strict=True):
        lost = known[:, left] & known[:, right] & ~sample.mask & likely.mask
        mask = (sample.mask | lost) & (known[:, left] | known[:, right])
        both = zip((sample.range, sample.reflectance), (likely.range, likely.reflectance), strict=True)
        metres, shades = (np.where(lost, b, a) * mask for a, b in both)
        images.append(replace(sample, range=metres, reflectance=shades, mask=mask))
    return images


def shades_of(drawn: list[RangeImage], calm: list[RangeImage]) -> np.ndarray:
    """(B, H, W): the likeliest reflectances of samples; where the likeliest image has no return, the sample's own."""
    return np.stack([np.where(b.mask, b.reflectance, a.reflectance) for a, b in zip(drawn, calm, strict=True)])


def as_read(image: RangeImage, even: np.ndarray, rng: torch.Generator) -> RangeImage:
    """The image with reflectances that are `even` (H, W) on average, and the speckle of what it meets, by its labels if
    any, as streets have it."""
    spread = SPREAD[np.zeros(image.shape, int) if image.label is None else texture(image.label)]
    shades = speckled(even, spread, torch.randn(2, *image.shape, generator=rng).numpy())
    return replace(image, reflectance=shades * image.mask)


def answered(
    sensor: Sensor,
    blocked: np.ndarray,
    distance: np.ndarray,
    reflectance: Tensor,
    logit: Tensor,
    classes: Tensor | None,
    drawn: Tensor | None,
    sure: Tensor | None,
) -> RangeImage:
    """The image of what the fill says: metres (H, W), outputs (1, H, W) and (C, H, W), those `with_doubts`, and chances
    (1, H, W)."""
    mask = (logit[0] > 0).numpy() & (distance <= sensor.max_range) & (distance >= sensor.min_range) & ~blocked
    shade = reflectance[0].clamp(0, 1).numpy()
    likeliest, kind = (None if part is None else part[1:].float().numpy().argmax(0) + 1 for part in (classes, drawn))
    label = likeliest if kind is None else likeliest + TEXTURE * kind  # 0, unlabeled, is no answer
    chance = None if sure is None else sure.reshape(distance.shape).numpy()
    # The label is that of all rays: what is known may return.
    return RangeImage(distance * mask, shade * mask, mask, sensor, label, confidence=chance)
