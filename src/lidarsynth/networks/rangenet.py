"""RangeNet-21 and -53 (Milioto et al. 2019): the class of every pixel of a range image, and the features of the FRD.

Parameters have the published names, so that official archives load as they are (`rangenet_archive`). Label 0 is
unlabeled; names and colours of the 20 classes are in `pictures/colours.py`.
"""

from __future__ import annotations

import random
from collections import OrderedDict
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lidarsynth.lidar.semantic_kitti import CLASSES

BLOCKS: dict[int, tuple[int, ...]] = {21: (1, 1, 2, 2, 1), 53: (1, 2, 8, 8, 4)}  # layers -> residual units per stage
MEANS = (12.12, 10.88, 0.23, -1.04, 0.21)  # range, x, y, z in metres, remission: of SemanticKITTI's pixels
STDS = (12.32, 11.47, 6.91, 0.86, 0.16)


class RangeNet(nn.Module):
    """An encoder of 21 or 53 layers that shrinks the width 32 times, and a decoder that leads back to every pixel.

    layers   21 or 53
    width    channels of the first stage, 32 in the published networks; smaller ones are for training from scratch
    classes  number of classes, 0 included
    dropout  share of channels dropped in training, after every stage
    means, stds  of the input channels, for `network_input`: five, or four of a network without remission (LiDM)

    The image is normalised, (B, 5, H, W) with W a multiple of 32; padding is zeros, also at the seam.
    """

    means: Tensor
    stds: Tensor

    def __init__(
        self,
        layers: int = 53,
        width: int = 32,
        classes: int = len(CLASSES),
        dropout: float = 0.01,
        means: Sequence[float] = MEANS,
        stds: Sequence[float] = STDS,
    ):
        super().__init__()
        if layers not in BLOCKS:
            raise ValueError(f"expected RangeNet with {' or '.join(map(str, BLOCKS))} layers, found {layers}")
        if len(means) not in (4, 5) or len(stds) != len(means) or min(stds) <= 0:
            raise ValueError(f"expected 5 means and 5 positive stds, found {list(means)} and {list(stds)}")
        self.layers, self.width, self.channels = layers, width, len(means)
        self.backbone = _Backbone(self.channels, BLOCKS[layers], width, dropout)
        self.decoder = _Decoder(width, dropout)
        # the published head is a sequence whose second member is the convolution: keys 1.weight and 1.bias
        self.head = nn.Sequential(nn.Dropout2d(dropout), nn.Conv2d(width, classes, 3, padding=1))
        self.register_buffer("means", torch.tensor(means).view(1, -1, 1, 1), persistent=False)
        self.register_buffer("stds", torch.tensor(stds).view(1, -1, 1, 1), persistent=False)

    def network_input(self, image: Tensor, mask: Tensor) -> Tensor:
        """(B, 5, H, W) normalised image, 0 where not measured; image: range, x, y, z in metres, reflectance in [0, 1].

        mask  (B, 1, H, W) or (B, H, W), True or 1 where measured
        """
        if image.ndim != 4 or image.shape[1] != self.channels or mask.numel() * self.channels != image.numel():
            raise ValueError(f"expected an image (B, {self.channels}, H, W) and a mask (B, 1, H, W), "
                             f"got {tuple(image.shape)} and {tuple(mask.shape)}")  # fmt: skip
        measured = mask.view(len(image), 1, *image.shape[2:]).bool()
        return torch.where(measured, (image - self.means) / self.stds, 0)

    def features(self, x: Tensor) -> Tensor:
        """(B, width, H, W): the decoder's output for the normalised image, which the FRD samples."""
        if x.ndim != 4 or x.shape[1] != self.channels or x.shape[3] % 32:
            raise ValueError(f"x must be (B, {self.channels}, H, W) with W a multiple of 32, got {tuple(x.shape)}")
        return self.decoder(*self.backbone(x))

    def forward(self, x: Tensor) -> Tensor:
        """(B, classes, H, W) logits for the normalised image; their argmax is the label image."""
        return self.head(self.features(x))


class _Residual(nn.Module):
    """x + two units, 1x1 to `middle` channels and 3x3 back; no activation after the sum."""

    def __init__(self, channels: int, middle: int):
        super().__init__()
        self.conv1 = nn.Conv2d(channels, middle, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(middle, momentum=0.01)
        self.conv2 = nn.Conv2d(middle, channels, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels, momentum=0.01)

    def forward(self, x: Tensor) -> Tensor:
        y = nn.functional.leaky_relu(self.bn1(self.conv1(x)), 0.1)
        return x + nn.functional.leaky_relu(self.bn2(self.conv2(y)), 0.1)


class _Backbone(nn.Module):
    """(B, channels, H, W) -> (B, 32 width, H, W / 32), and the inputs of the five stages, widest first."""

    def __init__(self, channels: int, blocks: tuple[int, ...], width: int, dropout: float):
        super().__init__()
        self.conv1 = nn.Conv2d(channels, width, 3, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(width, momentum=0.01)
        self.enc1, self.enc2, self.enc3, self.enc4, self.enc5 = (
            _stage(
                {"conv": nn.Conv2d(width << k, width << (k + 1), 3, stride=(1, 2), padding=1, bias=False)},
                width << (k + 1),
                {f"residual_{i}": _Residual(width << (k + 1), width << k) for i in range(count)},
            )
            for k, count in enumerate(blocks)
        )
        self.dropout = nn.Dropout2d(dropout)

    def forward(self, x: Tensor) -> tuple[Tensor, list[Tensor]]:
        # a bfloat16 has 8 bits: of 24 m it would drop what is less than 0.1 m, so the first layer sees all of float32
        with torch.autocast(x.device.type, enabled=False):
            x = nn.functional.leaky_relu(self.bn1(self.conv1(x.float())), 0.1)
        skips = []
        for stage in (self.enc1, self.enc2, self.enc3, self.enc4, self.enc5):
            skips.append(x.detach())
            x = self.dropout(stage(x))
        return x, skips


class _Decoder(nn.Module):
    """(B, 32 width, H, W / 32) and the encoder's skips -> (B, width, H, W)."""

    def __init__(self, width: int, dropout: float):
        super().__init__()
        # in the published order, which is that of the keys
        self.dec5, self.dec4, self.dec3, self.dec2, self.dec1 = (
            _stage(
                {"upconv": nn.ConvTranspose2d(width << (k + 1), width << k, (1, 4), stride=(1, 2), padding=(0, 1))},
                width << k,
                {"residual": _Residual(width << k, width << (k + 1))},
            )
            for k in (4, 3, 2, 1, 0)
        )
        self.dropout = nn.Dropout2d(dropout)

    def forward(self, x: Tensor, skips: list[Tensor]) -> Tensor:
        stages = (self.dec5, self.dec4, self.dec3, self.dec2, self.dec1)
        for stage, skip in zip(stages, reversed(skips), strict=True):
            x = stage(x) + skip
        return self.dropout(x)


def _stage(convolution: dict[str, nn.Module], channels: int, residuals: dict[str, nn.Module]) -> nn.Sequential:
    unit = {"bn": nn.BatchNorm2d(channels, momentum=0.01), "relu": nn.LeakyReLU(0.1)}
    return nn.Sequential(OrderedDict({**convolution, **unit, **residuals}))


def frechet_positions(height: int, width: int, channels: int = 32, count: int = 4096) -> Tensor:
    """(count,) int64 positions in a flattened (channels, height, width) feature map, as LiDARGen and R2DM draw them.

    Python's Mersenne twister with seed 0, so the same on every machine; 64 x 1024 starts 1615835, 1764005, 169803.
    """
    return torch.tensor(random.Random(0).sample(range(channels * height * width), count))


@torch.no_grad()
def frechet_features(network: RangeNet, image: Tensor, mask: Tensor, count: int = 4096) -> Tensor:
    """(B, count) float32 features of the FRD: fixed positions of the decoder's output (LiDARGen section 10).

    image (B, 5, H, W) and mask as in `RangeNet.network_input`; the network in evaluation mode, else a ValueError.
    """
    if network.training:
        raise ValueError("expected the network in evaluation mode, found it in training mode")
    maps = network.features(network.network_input(image, mask))
    channels, height, width = maps.shape[1:]
    return maps.flatten(1)[:, frechet_positions(height, width, channels, count).to(maps.device)]


@torch.no_grad()
def band_features(network: RangeNet, x: Tensor, rows: int = 4) -> Tensor:
    """(B, 32 H / rows) float32 features of LiDM's FRID: means of the decoder's output over bands of whole rows.

    x  (B, 4, H, W) as the protocol feeds it: LiDM raw metres with -1 where empty, R2Flow normalised. Index =
    channel * bands + band. Raises ValueError for a network in training mode.
    """
    if network.training:
        raise ValueError("expected the network in evaluation mode, found it in training mode")
    maps = network.features(x)
    return maps.unflatten(2, (-1, rows)).mean((3, 4)).flatten(1)
