"""Features of the protocol street-1: how much the maps of our own small RangeNet vary within a scan.

A protocol's numbers hold for one definition of its features: what is here is frozen with street-1's version. Layer and
pooling were chosen on synthetic streets by what blur, swapped rows and missing cars do to the score (docs/street-1.md).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lidarsynth.networks.rangenet import RangeNet

LEAST = 0.01  # added to each deviation, so that a map without any has a logarithm


class StreetFeatures(nn.Module):
    """Logarithms of the standard deviations of a RangeNet's maps at an eighth of the width: encoder, then decoder.

    Of a network of width 8 these are 64 + 64 numbers. A logarithm tells relative changes, so no channel weighs more
    than another because its numbers are larger.
    """

    def __init__(self, network: RangeNet):
        super().__init__()
        self.network = network

    @torch.no_grad()
    def forward(self, image: Tensor, mask: Tensor) -> Tensor:
        """(B, 16 width) float32; image (B, 5, H, W) and mask as in `RangeNet.network_input`.

        Raises ValueError for a network in training mode.
        """
        if self.network.training:
            raise ValueError("expected the network in evaluation mode, found it in training mode")
        x = self.network.network_input(image, mask)
        deepest, skips = self.network.backbone(x.contiguous(memory_format=torch.channels_last))
        decoder, encoded = self.network.decoder, skips[3]
        decoded = decoder.dec4(decoder.dec5(deepest) + skips[4]) + encoded
        deviations = torch.cat([maps.float().std((2, 3)) for maps in (encoded, decoded)], 1)
        return torch.log(deviations + LEAST)
