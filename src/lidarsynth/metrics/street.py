"""Features of the protocol street-1: maps of our own small RangeNet, pooled so that few scans tell their covariance.

A protocol's numbers hold for one definition of its features: what is here is frozen with street-1's version.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lidarsynth.metrics.rangenet import RangeNet

BANDS = 8  # of beams, from the top
FEATURES = 128


class StreetFeatures(nn.Module):
    """Mean and standard deviation of each channel of a RangeNet's decoder output, in eight bands of beams.

    Turning a scan about the vertical hardly changes them, moving what it shows up or down does.
    """

    def __init__(self, network: RangeNet):
        super().__init__()
        self.network = network

    @torch.no_grad()
    def forward(self, image: Tensor, mask: Tensor) -> Tensor:
        """(B, 128) float32; image (B, 5, H, W) and mask as in `RangeNet.network_input`, H a multiple of 8.

        Raises ValueError for another height, or a network in training mode.
        """
        if self.network.training or image.shape[2] % BANDS:
            raise ValueError(f"expected a network in evaluation mode and rows that are a multiple of {BANDS}, found "
                             f"training {self.network.training} and {image.shape[2]} rows")  # fmt: skip
        maps = self.network.features(self.network.network_input(image, mask))
        bands = maps.float().reshape(*maps.shape[:2], BANDS, -1)
        return torch.cat([bands.mean(-1), bands.std(-1)], 1).flatten(1)
