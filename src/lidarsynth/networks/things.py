"""Noise that is alike all over a thing, which is mostly of one material, and that changes slowly on the ground."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from lidarsynth.lidar.pieces import connected
from lidarsynth.networks.fill_unet import draw_noise
from lidarsynth.networks.rays import Rays

STEEPEST = math.radians(10)  # of the line between two hits to the farther ray, from which they are of one thing
LOW, LEVEL = 0.8, -0.02  # of the way to flat ground, and radians of elevation, from which a hit is on the ground
NONE = -1
NODES = (8, 32)  # rows and columns from one node of the ground's noise to the next


def things(metres: Tensor, rays: Rays) -> np.ndarray:
    """(B, H, W) which thing each ray of metres (B, 1, H, W) hits, by any number; `NONE` on the ground and in the air.

    After Bogoslavskyi and Stachniss (IROS 2016): neighbours are of one thing if the line between them stands steep
    enough on the farther ray. The width is a ring, which a crop's is not: there two things may be one.
    """
    far = metres[:, 0].cpu().numpy().astype(np.float32)
    count, height, width = far.shape
    elevation, across, ground = (
        np.broadcast_to(part[:, 0].cpu().numpy(), far.shape) for part in (rays.elevation, rays.across, rays.ground)
    )
    hit = (far > 0) & ~((far > LOW * ground) & (elevation < LEVEL))
    place = np.arange(far.size).reshape(far.shape)
    right = hit & np.roll(hit, -1, 2) & _alike(far, np.roll(far, -1, 2), across)
    step = np.maximum(elevation[:, :-1] - elevation[:, 1:], 1e-4)
    below = hit[:, :-1] & hit[:, 1:] & _alike(far[:, :-1], far[:, 1:], step)
    first, second = np.r_[place[right], place[:, :-1][below]], np.r_[np.roll(place, -1, 2)[right], place[:, 1:][below]]
    return np.where(hit, connected(first, second, far.size).reshape(count, height, width), NONE)


def draw_on_things(of: np.ndarray, rng: torch.Generator | None = None, ground: float = 1.0) -> Tensor:
    """(1, NOISES, H, W) as `draw_noise`, whose patches are the things (H, W), and elsewhere smooth, so much of it."""
    noise = draw_noise((1, *of.shape), rng)
    numbers, which = np.unique(of, return_inverse=True)
    each = torch.randn(len(numbers), generator=rng)[torch.from_numpy(which.reshape(of.shape))]
    noise[0, 2] = torch.where(torch.from_numpy(of != NONE), each, ground * _smooth(of.shape[0], of.shape[1], rng))
    return noise


def _smooth(height: int, width: int, rng: torch.Generator | None) -> Tensor:
    """(H, W) unit Gaussians that go from one node to the next, around the turn."""
    tall, wide = NODES
    columns = max(width // wide, 1)
    nodes = torch.randn(height // tall + 2, columns, generator=rng)
    row, column = torch.arange(height) / tall, torch.arange(width) * (columns / width)
    down, along = ((place - place.floor()) * (math.pi / 2) for place in (row, column))
    across = nodes[:, column.long()] * along.cos() + nodes.roll(-1, 1)[:, column.long()] * along.sin()
    return across[row.long()] * down.cos()[:, None] + across[row.long() + 1] * down.sin()[:, None]


def _alike(a: np.ndarray, b: np.ndarray, angle: np.ndarray) -> np.ndarray:
    far, near = np.maximum(a, b), np.minimum(a, b)
    return np.arctan2(near * np.sin(angle), far - near * np.cos(angle)) > STEEPEST
