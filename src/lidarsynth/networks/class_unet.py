"""Says of every pixel of a scan what it is of: a U-Net told what its neighbours say of its surface."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.networks.fill_unet import Block, Halve, Pointwise
from lidarsynth.networks.rays import Rays, encode_range, steps_told

PATCH, PIXEL = 2, 32  # rows and columns of the patches that become channels; numbers of each pixel in the end
BLOCKS = (1, 1, 1, 1, 2)  # of each level, which is half as high and wide as the one before
MULTIPLE = PATCH * 2 ** (len(BLOCKS) - 1)  # of which images have rows and columns
RAYS = 9  # channels that say where a pixel looks, and how far it saw


class ClassUNet(nn.Module):
    """`forward(x) -> logits` (B, classes, H, W) of `inputs` (B, RAYS + around, H, W), H and W multiples of MULTIPLE.

    around  channels of `lidar.surroundings`
    """

    def __init__(self, width: int = 32, around: int = 10, classes: int = 20):
        super().__init__()
        widths, told = [width * (i + 1) for i in range(len(BLOCKS))], RAYS + around
        self.stem = nn.Conv2d(told, width, PATCH, PATCH)
        self.down, self.halve = nn.ModuleList(), nn.ModuleList()
        self.join, self.up = nn.ModuleList(), nn.ModuleList()
        for own, count in zip(widths, BLOCKS, strict=True):
            self.down.append(nn.Sequential(*(_block(own, own) for _ in range(count))))
        for own, deeper in pairwise(widths):
            self.halve.append(Halve(own, deeper))
            self.join.append(Pointwise(deeper, own))
            self.up.append(_block(2 * own, own))
        self.pixel, self.spread = Pointwise(told, PIXEL), Pointwise(width, PIXEL * PATCH**2)
        self.mix, self.classes = Pointwise(PIXEL, PIXEL), Pointwise(PIXEL, classes)

    def forward(self, x: Tensor) -> Tensor:
        x = x.contiguous(memory_format=torch.channels_last)
        h, kept = self.down[0](self.stem(x)), []
        for halve, stage in zip(self.halve, self.down[1:], strict=True):
            kept.append(h)
            h = stage(halve(h))
        for join, stage in zip(reversed(self.join), reversed(self.up), strict=True):
            h = F.interpolate(join(h), scale_factor=2, mode="nearest")
            h = stage(torch.cat([h, kept.pop()], 1))
        fine = F.silu(self.pixel(x) + F.pixel_shuffle(self.spread(h), PATCH))
        return self.classes(F.silu(self.mix(fine)))


def _block(channels: int, out: int) -> Block:
    return Block(channels, out, math.gcd(8, channels))


def class_inputs(metres: Tensor, reflectance: Tensor, around: Tensor, rays: Rays) -> Tensor:
    """(B, RAYS + A, H, W): what the network sees of metres (B, 1, H, W), 0 where nothing returned, reflectance, as even
    beams would read it, and surroundings (B, A, H, W)."""
    back = (metres > 0).float()
    code = encode_range(metres)
    return torch.cat(
        [
            back,
            2 * code * back,
            (8 * (code - encode_range(rays.ground))).clamp(-3, 3) * back,
            3 * rays.elevation.expand_as(back),
            2 * encode_range(rays.ground),
            *steps_told(rays, back),
            (3 * (reflectance + rays.dimness) - 0.5) * back,
            around,
        ],
        1,
    )


def around_the_turn(x: Tensor, multiple: int = MULTIPLE) -> Tensor:
    """(B, C, H, W) with the first columns again behind the last, up to a multiple of them."""
    extra = -x.shape[-1] % multiple
    return x if not extra else torch.cat([x, x[..., :extra]], -1)
