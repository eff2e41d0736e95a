"""Vanilla GAN and DUSty v1: DCGAN-like networks on a ring, without and with ray-drop.

Both as re-trained by the DUSty v2 authors at 64x512 (WACV 2023), which is what R2DM compares with; parameter names are
those of the official checkpoints. Range only: images are inverse depth.
"""

from collections.abc import Mapping
from itertools import pairwise

import torch
from torch import Tensor, nn

from lidarsynth.networks.gan.layers import BlurVH, EqualLR, FusedLeakyReLU, Pad
from lidarsynth.networks.gan.raydrop import GeneratedImages, RayDrop, measured

W_AVG_DECAY = 0.995
LEVELS = 4  # the image is 2^4 times as large as the coarsest map


class _Heads(nn.Module):
    """One transposed convolution per output map: (B,C,H,W) -> {name: (B,maps,2H,2W)}, `maps` by name."""

    def __init__(self, channels: int, maps: Mapping[str, int], bounded: bool):
        super().__init__()
        self.bounded = bounded
        self.heads = nn.ModuleDict(
            {name: nn.Sequential(Pad(1, "reflect"), _double(channels, count, True)) for name, count in maps.items()}
        )

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        maps = {name: head(x) for name, head in self.heads.items()}
        if self.bounded:
            maps["image"] = maps["image"].tanh()
        return maps


def _double(in_channels: int, out_channels: int, bias: bool) -> EqualLR:
    """Doubles the size of an image padded by one pixel."""
    return EqualLR(nn.ConvTranspose2d(in_channels, out_channels, 4, stride=2, padding=3, bias=bias))


def _coarsest(resolution: tuple[int, int]) -> tuple[int, int]:
    height, width = resolution
    if height % 2**LEVELS or width % 2**LEVELS or min(resolution) < 2 ** (LEVELS + 1):
        raise ValueError(f"resolution must be multiples of {2**LEVELS}, at least twice that, got {resolution}")
    return height >> LEVELS, width >> LEVELS


class Generator(nn.Module):
    """Latents (B,Z) ~ N(0,I) -> inverse depth images (B,1,H,W); Vanilla GAN, or DUSty v1 with `raydrop`.

    In training mode a forward pass updates `w_avg`, the running mean of latents that truncation leans on.
    Raises ValueError for a resolution that is not a multiple of 16, and for `image_mask` alone.
    """

    w_avg: Tensor

    def __init__(
        self,
        resolution: tuple[int, int] = (64, 512),
        latent_channels: int = 512,
        base_channels: int = 64,
        max_channels: int = 512,
        raydrop: bool = False,
        bounded: bool = False,  # tanh on the image: the IROS 2021 release
        temperature: float = 1.0,  # of the ray-drop
        image_mask: bool = False,  # a second mask, of whole images: DUSty-II of the IROS 2021 release
    ):
        super().__init__()
        if image_mask and not raydrop:
            raise ValueError("image_mask must be off without raydrop, got True")
        kernel = _coarsest(resolution)
        widths = [min(base_channels << i, max_channels) for i in reversed(range(LEVELS))]
        first = EqualLR(nn.ConvTranspose2d(latent_channels, widths[0], kernel, bias=False))
        blocks = [nn.Sequential(nn.Identity(), first, FusedLeakyReLU(widths[0]))]
        for before, after in pairwise(widths):
            blocks.append(nn.Sequential(Pad(1, "reflect"), _double(before, after, False), FusedLeakyReLU(after)))
        heads = {"image": 1, **({"raydrop_logit": 2 if image_mask else 1} if raydrop else {})}
        self.synthesis_network = nn.Sequential(*blocks, _Heads(widths[-1], heads, bounded))
        self.measurement_model = RayDrop(temperature=temperature) if raydrop else None
        self.register_buffer("w_avg", torch.zeros(1, latent_channels))

    def forward(self, z: Tensor, uniform: Tensor | None = None, psi: float = 1.0) -> GeneratedImages:
        """`uniform` in [0,1), broadcast to (B,1,H,W), decides which rays drop; `psi` < 1 truncates (eval mode only).

        In training with `image_mask` it is (B,2,H,W): of each pixel, and, all over the second map, of each image.
        """
        return self.synthesize(styles(z, self.w_avg, psi, self.training), uniform)

    def synthesize(self, w: Tensor, uniform: Tensor | None = None) -> GeneratedImages:
        """As `forward`, from styles (B,Z) that are neither truncated nor averaged: for inversion."""
        return measured(self.measurement_model, self.synthesis_network(w[:, :, None, None]), uniform, w)


def styles(w: Tensor, w_avg: Tensor, psi: float, training: bool) -> Tensor:
    """Styles (B,D): in training they update `w_avg` (1,D) in place; else they are pulled to it, lerp(w_avg, w, psi)."""
    if training:
        with torch.no_grad():
            w_avg.lerp_(w.mean(0, keepdim=True).to(w_avg.dtype), 1 - W_AVG_DECAY)
        return w
    return w if psi == 1 else torch.lerp(w_avg.to(w.dtype), w, psi)


class Discriminator(nn.Sequential):
    """Images (B,1,H,W) -> logits (B,1,1,1), large = real; of Vanilla GAN and DUSty v1 alike."""

    def __init__(
        self,
        resolution: tuple[int, int] = (64, 512),
        base_channels: int = 64,
        max_channels: int = 512,
        vertical: str = "replicate",  # padding of the first blur, "reflect": the IROS 2021 release
    ):
        kernel = _coarsest(resolution)
        widths = [2, *(min(base_channels << i, max_channels) for i in range(LEVELS))]
        blocks = [
            nn.Sequential(
                Pad(1, "reflect"),
                EqualLR(nn.Conv2d(before, after, 4, stride=2, bias=False)),
                FusedLeakyReLU(after),
            )
            for before, after in pairwise(widths)
        ]
        super().__init__(BlurVH(vertical), *blocks, EqualLR(nn.Conv2d(widths[-1], 1, kernel)))
