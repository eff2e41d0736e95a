"""Coarse first, then fill: two networks that generate and complete the scans of any sensor."""

from __future__ import annotations

from torch import nn

from lidarsynth.networks.coarse_unet import CoarseUNet
from lidarsynth.networks.fill_unet import FillUNet


class Cascade(nn.Module):
    """Holds `coarse` (noise -> a grid of 16 beams x 128 columns) and `fill` (known pixels -> all pixels)."""

    def __init__(self, coarse: CoarseUNet, fill: FillUNet):
        super().__init__()
        self.coarse, self.fill = coarse, fill
