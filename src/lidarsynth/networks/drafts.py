"""A draft of a grid: how far diffusion has come when the layout is decided and the details are not."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.networks.coarse_unet import BOUND, RAY_CHANNELS, CoarseUNet
from lidarsynth.networks.fill_unet import ring

LEARNED = (0.25, 0.75)  # times of drafts that who draws learns to read
DRAFT_CHANNELS, READ = 7, 48  # of a draft, and of what is read in it
REACHES = (1, 2, 4)  # columns to either side, of the layers that read it


def drafted(coarse: CoarseUNet, x_t: Tensor, t: Tensor, rays: Tensor, standing: Tensor) -> Tensor:
    """(B, 7, 16, 128) what is told of x_t (B, 3, 16, 128) at times t (B,), by the coarse stage.

    Of range and returning, not of reflectance, which columns draw better alone (docs/generation.md): x_t; its
    x_0_hat, the mean of all grids that it may become; what this says of the range code, from flat ground's on, and how
    far codes of such rays spread; log_snr. rays (B, 8, 16, 128), standing (B, 16, 128) radians.
    """
    denoiser = Denoiser(coarse, coarse.schedule, "velocity", clip=False, condition=(rays,))
    x_0_hat = denoiser(x_t, t)
    log_snr, *_ = denoiser.schedule.at(t, x_t)
    mean, spread = (part[:, :1] for part in coarse.standards(standing))
    away = (4 * (x_0_hat[:, :1] * spread + mean - rays[:, 1:2] / 2)).clamp(-4, 4)
    parts = (x_t[:, ::2], x_0_hat[:, ::2].clamp(-4, 4), away, 4 * spread, log_snr.expand_as(away) / BOUND)
    return torch.cat(parts, 1)


class DraftReader(nn.Module):
    """`forward(draft (B, 7, 16, 128), rays (B, 8, 16, 128)) -> (B, 16, 128, 48)`: what stands around each pixel of it,
    eight columns to either side."""

    def __init__(self, width: int = READ):
        super().__init__()
        self.enter = nn.Conv2d(DRAFT_CHANNELS + RAY_CHANNELS, width, 3, padding=(1, 0))
        self.layers = nn.ModuleList(
            nn.Conv2d(width, width, 3, padding=(1, 0), dilation=(1, reach)) for reach in REACHES
        )

    def forward(self, draft: Tensor, rays: Tensor) -> Tensor:
        x = F.silu(self.enter(ring(torch.cat([draft, rays], 1), 1)))
        for layer, reach in zip(self.layers, REACHES, strict=True):
            x = x + F.silu(layer(ring(x, reach)))
        return x.permute(0, 2, 3, 1)
