"""Crowns that let rays through: a fill draws what grows as a wall, with whole edges; lasers meet a leaf, or what is
behind it, and both stand beside each other in an image. Measured in docs/generation.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.systems.cascade.images import texture, textured

# Share of the rays in and beside crowns that meet what a ray beside them meets, how far beside at most: degrees on the
# ring, and beams, and in how many degrees of elevation all rays of a column go the same way, as twigs and gaps have a
# size. Chosen by street-2, of streets told their own layouts and of drawn ones (docs/generation.md).
PIERCED, ASIDE, BEAMS, TALL = 0.2, 1.8, 1, 1.2
LEAFY = CLASS_NUMBER["vegetation"]
STANDING = [CLASS_NUMBER[name] for name in ("vegetation", "building", "fence", "trunk", "pole", "traffic-sign")]


def grown(
    drawn: list[RangeImage], even: np.ndarray, blocked: np.ndarray, rng: list[torch.Generator]
) -> list[RangeImage]:
    """Images as recorded, `textured`, with `through_foliage`: reflectances `even` (B, H, W) on average."""
    parts = [through_foliage(*both, blocked, one) for both, one in zip(zip(drawn, even, strict=True), rng, strict=True)]
    return textured([image for image, _ in parts], np.stack([shade for _, shade in parts]), rng)


def through_foliage(
    image: RangeImage, even: np.ndarray, blocked: np.ndarray, rng: torch.Generator
) -> tuple[RangeImage, np.ndarray]:
    """A sample in the making (H, W), metres, and its reflectances on average `even` (H, W) in [0, 1], in which some
    rays in and beside what grows meet, or miss, what a ray beside them does; as they are without labels.

    Nothing is drawn onto the ground, vehicles or people, nor on blocked rays (H, W).
    """
    if image.label is None:
        return image, even
    height, width = image.shape
    chance, up, aside = _together(torch.rand(3, height, width, generator=rng).numpy(), image.sensor.elevations, rng)
    reach = max(1, round(ASIDE / 360 * width))
    rows = (np.arange(height)[:, None] + _step(up, BEAMS)).clip(0, height - 1)
    columns = (np.arange(width) + _step(aside, reach)) % width
    label = texture(image.label)
    leafy = (label == LEAFY) & image.mask
    open_to = (np.isin(label, STANDING) | ~image.mask) & ~blocked
    moved = (leafy | leafy[rows, columns]) & open_to & open_to[rows, columns] & (chance < PIERCED)

    def taken(part: np.ndarray) -> np.ndarray:
        return np.where(moved, part[rows, columns], part)

    parts = {name: taken(getattr(image, name)) for name in ("range", "reflectance", "mask", "label")}
    return replace(image, **parts), taken(even)


def _together(chances: np.ndarray, elevations: Sequence[float], rng: torch.Generator) -> np.ndarray:
    """Chances (N, H, W), alike in rays of a column that are within the same TALL degrees, from any of them on."""
    columns = np.arange(chances.shape[2])
    piece = np.floor(np.asarray(elevations)[:, None] / TALL + torch.rand(len(columns), generator=rng).numpy())
    return chances[:, np.cumsum(np.diff(piece, axis=0, prepend=piece[:1]) != 0, 0), columns]


def _step(chance: np.ndarray, most: int) -> np.ndarray:
    """Whole steps from -most to most, all as likely, of chances in [0, 1)."""
    return np.floor(chance * (2 * most + 1)).astype(int) - most
