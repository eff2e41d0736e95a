"""MinkowskiNet (Choy et al. 2019) as 2DPASS and LiDAR-Diffusion build it: the features of the FSVD.

A U-Net over occupied voxels, four times down and up, in evaluation mode only. Parameters have the published names, so
that checkpoints load as they are (`sparse_weights`).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lidarsynth.networks.sparse_convolution import Kernel, Level, convolve, grow, levels_of, shrink, with_norm

BASE = (32, 32, 64, 128, 256, 256, 128, 96, 96)  # channels after the stem, the four stages and the four ups, at cr 1
INPUTS = 4  # x, y, z in metres, and remission


def widths_of(cr: float) -> tuple[int, ...]:
    """The nine widths at a channel ratio: int(cr * BASE)."""
    return tuple(int(cr * width) for width in BASE)


class Residual(nn.Module):
    """ReLU of two convolutions and the input, which a 1 x 1 x 1 one brings to `outputs` channels where they differ."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        first, second = Kernel(27, inputs, outputs), Kernel(27, outputs, outputs)
        norms = [nn.BatchNorm1d(outputs) for _ in range(2)]
        self.net = nn.Sequential(first, norms[0], nn.ReLU(), second, norms[1])
        self.downsample = nn.Sequential()
        if inputs != outputs:
            self.downsample = nn.Sequential(Kernel(1, inputs, outputs), nn.BatchNorm1d(outputs))

    def forward(self, x: Tensor, level: Level) -> Tensor:
        """(N, outputs) of (N, inputs) at a level's voxels."""
        shortcut = convolve(x, level, *_folded(self.downsample)) if len(self.downsample) else x
        middle = torch.relu_(convolve(x, level, *_folded(self.net)))
        return torch.relu_(convolve(middle, level, *_folded(self.net, 3)).add_(shortcut))


def _folded(chain: nn.Sequential, start: int = 0) -> tuple[Tensor, Tensor]:
    """Kernel and bias of a convolution at `start` of a chain and the batch normalisation after it."""
    kernel, norm = chain[start], chain[start + 1]
    assert isinstance(kernel, Kernel) and isinstance(norm, nn.BatchNorm1d)
    return with_norm(kernel.kernel, norm)


class _Resample(nn.Module):
    """A convolution of size and stride 2, or its transpose, then batch normalisation and ReLU."""

    def __init__(self, inputs: int, outputs: int, up: bool):
        super().__init__()
        self.net = nn.Sequential(Kernel(8, inputs, outputs), nn.BatchNorm1d(outputs), nn.ReLU())
        self.resample = grow if up else shrink

    def forward(self, x: Tensor, fine: Level) -> Tensor:
        return torch.relu_(self.resample(x, fine, *_folded(self.net)))


class Stage(nn.Sequential):
    """To the next level of twice the stride, then two residuals."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__(_Resample(inputs, inputs, up=False), Residual(inputs, outputs), Residual(outputs, outputs))

    def forward(self, x: Tensor, fine: Level, coarse: Level) -> Tensor:
        """(M, outputs) at `coarse` of (N, inputs) at `fine`."""
        return self[2](self[1](self[0](x, fine), coarse), coarse)


class Up(nn.Sequential):
    """Back to the level of half the stride, beside the encoder's features there, then two residuals."""

    def __init__(self, inputs: int, skip: int, outputs: int):
        residuals = nn.Sequential(Residual(outputs + skip, outputs), Residual(outputs, outputs))
        super().__init__(_Resample(inputs, outputs, up=True), residuals)

    def forward(self, x: Tensor, skip: Tensor, fine: Level) -> Tensor:
        """(N, outputs) at `fine`, of x (M, inputs) at twice its stride and the skip (N, skip)."""
        residuals = self[1]
        assert isinstance(residuals, nn.Sequential)
        return residuals[1](residuals[0](torch.cat([self[0](x, fine), skip], 1), fine), fine)


class Stem(nn.Sequential):
    """Two convolutions of the input features, each with batch normalisation and ReLU."""

    def __init__(self, width: int):
        layers = [(Kernel(27, size, width), nn.BatchNorm1d(width), nn.ReLU()) for size in (INPUTS, width)]
        super().__init__(*layers[0], *layers[1])

    def forward(self, x: Tensor, level: Level) -> Tensor:
        """(N, width) of the input features (N, 4) at the finest level."""
        for start in (0, 3):
            x = torch.relu_(convolve(x, level, *_folded(self, start)))
        return x


class MinkowskiUNet(nn.Module):
    """Features of voxels; `widths` are the nine of `widths_of`, 21,723,412 parameters at cr 1, 5,435,284 at 0.5."""

    def __init__(self, widths: Sequence[int], classes: int = 20):
        super().__init__()
        w = widths
        self.stem = Stem(w[0])
        self.stage1, self.stage2, self.stage3, self.stage4 = (Stage(w[k], w[k + 1]) for k in range(4))
        self.up1, self.up2, self.up3, self.up4 = (Up(w[4 + k], w[3 - k], w[5 + k]) for k in range(4))
        self.classifier = nn.Sequential(nn.Linear(w[8], classes))

    @torch.no_grad()
    def forward(self, features: Tensor, coordinates: Tensor) -> tuple[Tensor, Tensor]:
        """(N, widths[8]) features before the classifier, and (N, 4) float32 where: x, y, z in voxels, batch.

        features     (N, 4) float32: x, y, z of a voxel's point in metres, and -1 (`metrics.voxel_features.quantise`)
        coordinates  (N, 4) whole numbers: x, y, z, batch; no voxel twice
        Scans of a batch do not see each other. Raises ValueError for other shapes, or in training mode.
        """
        levels = checked_levels(self, features, coordinates)
        skips = [self.stem(features, levels[0])]
        for k, stage in enumerate((self.stage1, self.stage2, self.stage3, self.stage4)):
            skips.append(stage(skips[-1], levels[k], levels[k + 1]))
        x = skips.pop()
        for k, up in enumerate((self.up1, self.up2, self.up3, self.up4)):
            x = up(x, skips.pop(), levels[3 - k])
        return x, coordinates.float()


def checked_levels(network: nn.Module, features: Tensor, coordinates: Tensor) -> list[Level]:
    """The five levels of the voxels. Raises ValueError for features that do not fit them, or a network in training."""
    if network.training:
        raise ValueError("expected the network in evaluation mode, found it in training mode")
    if tuple(features.shape) != (len(coordinates), INPUTS):
        raise ValueError(f"expected features ({len(coordinates)}, {INPUTS}), one row per voxel, "
                         f"found {tuple(features.shape)}")  # fmt: skip
    return levels_of(coordinates, 5)
