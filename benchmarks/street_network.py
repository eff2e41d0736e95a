"""The RangeNet of street-1, and one that is told what a pixel's neighbours say of its surface."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from street import WORD
from street_geometry import CHANNELS, geometry
from torch import Tensor, nn

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASSES
from lidarsynth.metrics.reconstruction import confusion_matrix
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.systems.segmentation.training import pixels
from lidarsynth.weights.load import load_parts

HIDDEN = 32


class Reader(nn.Module):
    """`reader(x) -> logits` (B, 20, H, W) of x (B, 5 or 15, H, W): RangeNet's input, and the channels of `geometry`.

    Begins as street-1's RangeNet: what is added, to the first convolution and to the logits, begins at 0. Or, with a
    width, as one of 21 layers that has learned nothing.
    """

    def __init__(self, told: bool, width: int | None = None):
        super().__init__()
        network = RangeNet(21, width) if width else load_parts(WORD)[1]
        assert isinstance(network, RangeNet)
        self.rangenet, self.told, width, fresh = network, told, network.width, width is not None
        if told:
            self.stem = nn.Conv2d(CHANNELS, width, 3, padding=1, bias=False)
            self.pixel = nn.Conv2d(5 + CHANNELS, HIDDEN, 1)
            self.mixed = nn.Conv2d(HIDDEN + width, HIDDEN, 1)
            self.classes = nn.Conv2d(HIDDEN, len(CLASSES), 1)
            for weights in () if fresh else (self.stem.weight, self.classes.weight, self.classes.bias):
                assert weights is not None
                nn.init.zeros_(weights)

    def forward(self, x: Tensor) -> Tensor:
        x = x.contiguous(memory_format=torch.channels_last)
        if not self.told:
            return self.rangenet(x)
        backbone, act = self.rangenet.backbone, nn.functional.leaky_relu
        y, skips = act(backbone.bn1(backbone.conv1(x[:, :5]) + self.stem(x[:, 5:])), 0.1), []
        for stage in (backbone.enc1, backbone.enc2, backbone.enc3, backbone.enc4, backbone.enc5):
            skips.append(y)
            y = backbone.dropout(stage(y))
        decoded = self.rangenet.decoder(y, skips)
        mixed = act(self.mixed(torch.cat([act(self.pixel(x), 0.1), decoded], 1)), 0.1)
        return self.rangenet.head(decoded) + self.classes(mixed)

    def prepared(self, values: np.ndarray) -> Tensor:
        """(B, 5 or 15, H, W) of (B, 5, H, W) range, x, y, z in metres and reflectance."""
        image = torch.from_numpy(values)
        x = self.rangenet.network_input(image, image[:, :1] > 0)
        return torch.cat([x, torch.from_numpy(np.stack([geometry(v) for v in values]))], 1) if self.told else x

    def inputs(self, images: Sequence[RangeImage], together: int = 4) -> Iterator[Tensor]:
        """Batches of whole images."""
        for first in range(0, len(images), together):
            yield self.prepared(np.stack([pixels(image) for image in images[first : first + together]]))


@torch.no_grad()
def counted(reader: Reader, images: Sequence[RangeImage]) -> np.ndarray:
    """(20, 20) pixels, truth by row; 0 where nothing was measured, and never said elsewhere."""
    counts = np.zeros((len(CLASSES), len(CLASSES)), np.int64)
    for image, x in zip(images, reader.inputs(images, 1), strict=True):
        assert image.label is not None
        said = np.where(image.mask, reader(x)[0, 1:].argmax(0).numpy() + 1, 0)
        counts += confusion_matrix(np.where(image.mask, image.label, 0), said)
    return counts
