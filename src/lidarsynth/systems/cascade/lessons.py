"""Lessons in what returns are of: cuts of labelled streets, as recorded, as drawn, and as other sensors answer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASSES
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.lidar.surroundings import surroundings
from lidarsynth.networks.class_unet import class_inputs
from lidarsynth.networks.rays import Rays, rays_of
from lidarsynth.streets.hdl64e import unevenness

HEIGHT, WIDTH = 64, 256  # of a crop: higher sensors show a window of beams, lower ones are padded
FARTHEST = 250.0  # metres
AS_FAR = (0.3, 0.03)  # metres, and share of the range, by which what was measured is of a surface and not behind it
ACROSS = (-2, -1, 1, 2)  # columns of a ring whose speckle is averaged
APART = (0.05, 0.25)  # standard deviation of the natural logarithm of how bright each class is where others drive
ALIKE, FLAT = 0.05, 0.1  # share of the range by which neighbours of one surface differ; and the ground from flat ground


class Lessons(NamedTuple):
    """n cuts of at most 64 beams and of 256 columns."""

    inputs: Tensor  # (n, C, 64, 256) of `class_inputs`
    classes: Tensor  # (n, 64, 256) int64, 0 where nothing returned or nobody has said
    seeds: tuple[int, ...]


class Pixels(NamedTuple):
    """What is seen of an image (H, W)."""

    metres: np.ndarray  # 0 where nothing returned
    shade: np.ndarray
    label: np.ndarray


def lessons(images: Sequence[RangeImage], seeds: Sequence[int]) -> Lessons:
    """Two cuts of every second image, each image's by a seed of its own."""
    pairs = zip(images[::2], seeds[::2], strict=True)
    cuts = [lesson(image, np.random.default_rng((seed, 5))) for image, seed in pairs]
    inputs, classes = (torch.cat(part) for part in zip(*cuts, strict=True))
    return Lessons(inputs, classes, tuple(seeds))


def lesson(image: RangeImage, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Inputs (2, C, 64, 256) and classes (2, 64, 256) of two opposite parts of an image, as it may be given.

    Half of the time as scans are drawn or completed, less rough than recorded, with every second column, or all but
    every second to fourth beam, as their neighbours have it; somewhat larger or smaller, in a mirror, thinned;
    answering otherwise, without speckle, or nothing but ranges; of a sensor whose tilt, height and beams are not known
    well; at times of every second beam alone.
    """
    sensor, dim = _as_told(image.sensor, rng), unevenness(image.sensor)
    label = np.zeros(image.shape, np.int64) if image.label is None else image.label
    drawn = rng.random() < 0.5
    seen = Pixels(image.range * image.mask, _otherwise(image, dim, label, 0.75 if drawn else 0.15, rng), label)
    if drawn:
        seen = _filled_in(_less_rough(seen, image.surface, rng), image.sensor, rng)
    scale = math.exp(rng.uniform(-0.1, 0.1)) if rng.random() < 0.5 else 1.0
    metres, sensor = seen.metres * np.float32(scale), replace(sensor, mount=sensor.mount * scale)
    gone = (rng.random(metres.shape) < 0.1 * rng.random()) | (rng.random((len(metres), 1)) < 0.15 * rng.random())
    mask = ~gone & (metres > 0) & (metres < FARTHEST)
    dim = dim if rng.random() < 0.6 else np.zeros_like(dim)
    rows = np.arange(len(metres))
    if len(rows) >= HEIGHT and rng.random() < 0.15:
        rows = rows[int(rng.integers(2)) :: 2]
    shade = (seen.shade * mask).astype(np.float32)
    image = RangeImage((metres * mask)[rows].astype(np.float32), shade[rows], mask[rows], sensor.rows(rows.tolist()))
    parts = image.range, (shade + dim * mask)[rows], *surroundings(image), (seen.label * mask)[rows]
    top = 2 * int(rng.integers(max(len(rows) - HEIGHT, 0) // 2 + 1))
    cuts, first, whole = [], int(rng.integers(sensor.width)), np.stack(parts).astype(np.float32)
    for start in (first, first + sensor.width // 2):
        columns = (start + np.arange(WIDTH)) % sensor.width
        cuts.append(_cut(whole[:, :, columns], image.sensor, columns, top))
    inputs, classes = (torch.cat(part) for part in zip(*cuts, strict=True))
    return (inputs.flip(-1), classes.flip(-1)) if rng.random() < 0.5 else (inputs, classes)


def _cut(parts: np.ndarray, sensor: Sensor, columns: np.ndarray, top: int) -> tuple[Tensor, Tensor]:
    """Inputs (1, C, 64, N) and classes (1, 64, N) of 64 beams from `top` on, of parts (2 + 10 + 1, H, N)."""
    parts = parts[:, top : top + HEIGHT]
    below = HEIGHT - parts.shape[1]
    seen = torch.from_numpy(np.pad(parts, ((0, 0), (0, below), (0, 0))))[None]
    rays = rays_of(sensor, np.zeros((sensor.height, sensor.width), bool), columns)
    rays = Rays(*(part if part.shape[2] == 1 else to_height(part[:, :, top : top + HEIGHT]) for part in rays))
    return class_inputs(seen[:, :1], seen[:, 1:2], seen[:, 2:-1], rays), seen[:, -1].long()


def to_height(part: Tensor) -> Tensor:
    """Rays (1, 1, H, ...) of fewer than 64 rows with copies of the last below; those of 64, or of one for all, as they
    are."""
    if part.shape[2] in (1, HEIGHT):
        return part
    return torch.cat([part, part[:, :, -1:].expand(-1, -1, HEIGHT - part.shape[2], -1)], 2)


def _as_told(sensor: Sensor, rng: np.random.Generator) -> Sensor:
    """The sensor as its user knows it."""
    tilt = (0.0, 0.0) if rng.random() < 0.3 else sensor.tilt
    mount = sensor.mount * math.exp(rng.normal(0, 0.1)) if rng.random() < 0.15 else sensor.mount
    return replace(sensor, tilt=tilt, mount=float(np.clip(mount, 0.2, 4)))


def _less_rough(seen: Pixels, surface: np.ndarray | None, rng: np.random.Generator) -> Pixels:
    """Nearer to the surfaces that the rays met, where these are known; half of the time much nearer."""
    kind, share = rng.random(), rng.random()
    if surface is None or kind < 0.2:
        return seen
    rough = np.float32(share if kind < 0.5 else 0.35 * share)
    near = (surface > 0) & (np.abs(seen.metres - surface) < AS_FAR[0] + AS_FAR[1] * surface)
    return seen._replace(metres=np.where(near, surface + rough * (seen.metres - surface), seen.metres))


def _filled_in(seen: Pixels, sensor: Sensor, rng: np.random.Generator) -> Pixels:
    """At times every second column as its neighbours have it, and all but every second to fourth beam."""
    height, width = seen.metres.shape
    columns, beams, step = rng.random() < 0.4, rng.random() < 0.5, int(rng.choice((2, 3, 4, 4)))
    if columns:
        between = np.arange(int(rng.integers(2)), width - width % 2, 2)
        pair = _Pair(seen, (slice(None), between - 1), (slice(None), (between + 1) % width), np.float32(0.5))
        seen = pair.put(seen, (slice(None), between), rng)
    if beams and height > 2 * step:
        known = np.arange(int(rng.integers(step)), height, step)
        between = np.setdiff1d(np.arange(known[0], known[-1]), known)
        above = known[np.searchsorted(known, between) - 1]
        share = ((between - above) / step).astype(np.float32)[:, None]
        seen = _Pair(seen, above, above + step, share, _flat(seen.metres, sensor)).put(seen, between, rng)
    return seen


def _flat(metres: np.ndarray, sensor: Sensor) -> np.ndarray:
    """(H, W) bool: what lies about where flat ground would be."""
    height = sensor.mount + metres * np.sin(np.radians(np.asarray(sensor.elevations)))[:, None]
    return (np.abs(height) < FLAT * metres) & (metres > 0)


class _Pair:
    """Neighbours on either side of pixels, and how far those lie from the first to the second."""

    def __init__(self, seen: Pixels, first: Any, second: Any, share: Any, flat: np.ndarray | None = None):
        self.one, self.other = (Pixels(*(part[at] for part in seen)) for at in (first, second))
        self.share, self.flat = share, False if flat is None else flat[first] & flat[second]

    def put(self, seen: Pixels, at: Any, rng: np.random.Generator) -> Pixels:
        """The image with pixels that are of one surface with both, or as one of them; empty ones stay empty, and what
        still has the range that was measured keeps its class."""
        (a, shade_a, label_a), (b, shade_b, label_b) = self.one, self.other
        both = (a > 0) & (b > 0)
        plane = np.divide(1, (1 - self.share) / np.maximum(a, 0.1) + self.share / np.maximum(b, 0.1))
        alike = both & ((np.abs(a - b) < ALIKE * np.minimum(a, b)) | self.flat)
        second = ((rng.random(a.shape) < self.share) & (b > 0)) | (a == 0)
        metres = np.where(alike, plane, np.where(second, b, a)) * (seen.metres[at] > 0)
        shade = np.where(alike, (1 - self.share) * shade_a + self.share * shade_b, np.where(second, shade_b, shade_a))
        true = np.abs(metres - seen.metres[at]) < AS_FAR[0] + AS_FAR[1] * metres
        parts = metres, shade, np.where(true, seen.label[at], np.where(second, label_b, label_a))
        whole = Pixels(*(part.copy() for part in seen))
        for part, new in zip(whole, parts, strict=True):
            part[at] = new
        return whole


def _otherwise(
    image: RangeImage, dim: np.ndarray, label: np.ndarray, calm: float, rng: np.random.Generator
) -> np.ndarray:
    """Reflectance (H, W) of another response, each class's a little of its own; with a chance `calm` without speckle;
    at times none."""
    power, scale, apart = rng.uniform(0.75, 1.3), rng.uniform(0.75, 1.25), rng.uniform(*APART)
    each = np.exp(rng.normal(0, apart, len(CLASSES)))
    told = dim if rng.random() < 0.7 else 0
    shade = np.maximum(image.reflectance + dim, 0) ** power * scale * each[label]
    shade = np.clip(shade - told, 0, 1) * (image.reflectance > 0)
    if rng.random() < calm:
        shade = _without_speckle(shade, label)
    return shade * (rng.random() >= 0.06)


def _without_speckle(shade: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Each reflectance (H, W) as the mean of those of its class within two columns."""
    total, count = shade.copy(), np.ones_like(shade)
    for step in ACROSS:
        same = (np.roll(label, step, 1) == label) & (label > 0)
        total, count = total + np.roll(shade, step, 1) * same, count + same
    return total / count
