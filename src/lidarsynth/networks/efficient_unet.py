"""R2DM's network: an efficient U-Net on the equirectangular image (R2DM section III-B, figure 3)."""

from collections.abc import Sequence
from functools import partial

import torch
from einops import rearrange
from torch import Tensor, nn

from lidarsynth.networks.coordinates import coordinate_encoding, default_angles, patch_angles
from lidarsynth.networks.layers import (
    Conv3x3,
    Downsample,
    ResidualBlock,
    SelfAttentionBlock,
    TimeEmbedding,
    Upsample,
    zero_init,
)


class Level(nn.Module):
    """One level of the U-Net: [conv, halve]; residual blocks; [attention]; [double, conv]."""

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        num_blocks: int,
        embedding: int,  # width of the time embedding
        groups: int,
        eps: float,
        dropout: float,
        ring: bool,
        heads: int | None = None,  # None = no attention
        down: bool = False,
        up: bool = False,
    ):
        super().__init__()
        self.downsample = nn.Sequential(Conv3x3(in_channels, out_channels, ring), Downsample(ring)) if down else None
        first = out_channels if down else in_channels
        self.residual_blocks = nn.ModuleList(
            ResidualBlock(first if i == 0 else out_channels, out_channels, embedding, groups, eps, dropout, ring)
            for i in range(num_blocks)
        )
        self.self_attn_block = None if heads is None else SelfAttentionBlock(out_channels, heads, groups, eps)
        self.upsample = nn.Sequential(Upsample(ring), Conv3x3(out_channels, out_channels, ring)) if up else None

    def forward(self, x: Tensor, embedding: Tensor) -> Tensor:
        if self.downsample is not None:
            x = self.downsample(x)
        for block in self.residual_blocks:
            x = block(x, embedding)
        if self.self_attn_block is not None:
            x = self.self_attn_block(x)
        return x if self.upsample is None else self.upsample(x)


class EfficientUNet(nn.Module):
    """R2DM's U-Net; parameter names are those of the official checkpoints without their `model.` prefix.

    `forward(x_t (B,C,H,W), log_snr (B,) or 0-d) -> (B,out,H,W)`, the raw prediction. The buffer `coords` (1,2,H,W)
    holds the ray angles in radians, elevation first; assign to it, or load a checkpoint, to change the sensor.
    With `stem=(sh, sw)`, patches of sh x sw pixels become channels and the network runs at (H/sh, W/sw); (1, 1) is the
    official network, 31,099,650 parameters with the defaults. On a ring, rolling `x_t` and `coords` by a multiple of
    8*sw columns rolls the output.

    Raises ValueError if H, W is not divisible by 8 times the stem, or channels by the groups or heads.
    """

    coords: Tensor

    def __init__(
        self,
        in_channels: int = 2,
        out_channels: int = 2,
        resolution: tuple[int, int] = (64, 1024),  # H, W
        base_channels: int = 64,
        temb_channels: int | None = None,  # width of the time embedding; None = 4 * base_channels
        channel_multipliers: Sequence[int] = (1, 2, 4, 8),
        num_residual_blocks: Sequence[int] = (3, 3, 3, 3),
        gn_num_groups: int = 8,
        gn_eps: float = 1e-6,
        attn_num_heads: int = 8,
        coords_encoding: str | None = "fourier_features",  # a key of coordinates.ENCODINGS
        ring: bool = True,  # the width is circular
        stem: tuple[int, int] = (1, 1),
        dropout: float = 0.0,
    ):
        super().__init__()
        reduced = _reduced_resolution(resolution, stem)
        c0, c1, c2, c3, c4 = _level_widths(base_channels, channel_multipliers, gn_num_groups)
        n1, n2, n3, n4 = _four("num_residual_blocks", num_residual_blocks)
        embedding, patch = temb_channels or 4 * base_channels, stem[0] * stem[1]
        level = partial(Level, embedding=embedding, groups=gn_num_groups, eps=gn_eps, dropout=dropout, ring=ring)

        self.in_channels, self.out_channels = in_channels, out_channels
        self.resolution, self.stem = (resolution[0], resolution[1]), (stem[0], stem[1])
        self.register_buffer("coords", default_angles(resolution))
        self.coords_encoding = coordinate_encoding(coords_encoding, reduced)
        self.time_embedding = TimeEmbedding(base_channels, embedding)
        self.in_conv = Conv3x3(in_channels * patch + self.coords_encoding.channels, c0, ring)
        self.d_block1 = level(c0, c1, n1)
        self.d_block2 = level(c1, c2, n2, down=True)
        self.d_block3 = level(c2, c3, n3, down=True)
        self.d_block4 = level(c3, c4, n4, down=True, heads=attn_num_heads)
        self.u_block4 = level(c4, c3, n4, up=True, heads=attn_num_heads)
        self.u_block3 = level(2 * c3, c2, n3, up=True)
        self.u_block2 = level(2 * c2, c1, n2, up=True)
        self.u_block1 = level(2 * c1, c0, n1)
        self.out_conv = zero_init(Conv3x3(c0, out_channels * patch, ring))

    def forward(self, x_t: Tensor, log_snr: Tensor) -> Tensor:
        self._check_input(x_t, log_snr)
        sh, sw = self.stem
        embedding = self.time_embedding(log_snr.expand(len(x_t)))
        h = rearrange(x_t, "b c (h sh) (w sw) -> b (c sh sw) h w", sh=sh, sw=sw)
        h = self.in_conv(self._with_coords(h))
        d1 = self.d_block1(h, embedding)
        d2 = self.d_block2(d1, embedding)
        d3 = self.d_block3(d2, embedding)
        h = self.d_block4(d3, embedding)
        h = self.u_block4(h, embedding)
        h = self.u_block3(torch.cat([h, d3], dim=1), embedding)
        h = self.u_block2(torch.cat([h, d2], dim=1), embedding)
        h = self.u_block1(torch.cat([h, d1], dim=1), embedding)
        return rearrange(self.out_conv(h), "b (c sh sw) h w -> b c (h sh) (w sw)", sh=sh, sw=sw)

    def _with_coords(self, x: Tensor) -> Tensor:
        encoding = self.coords_encoding(patch_angles(self.coords, self.stem))
        return torch.cat([x, encoding.to(x.dtype).expand(len(x), -1, -1, -1)], dim=1)

    def _check_input(self, x_t: Tensor, log_snr: Tensor) -> None:
        expected = (self.in_channels, *self.resolution)
        if x_t.ndim != 4 or tuple(x_t.shape[1:]) != expected:
            raise ValueError(f"x_t must be (B, {', '.join(map(str, expected))}), got {tuple(x_t.shape)}")
        if log_snr.ndim > 1 or (log_snr.ndim == 1 and len(log_snr) != len(x_t)):
            raise ValueError(f"log_snr must be () or ({len(x_t)},), got {tuple(log_snr.shape)}")


def _reduced_resolution(resolution: tuple[int, int], stem: tuple[int, int]) -> tuple[int, int]:
    for name, size, step in zip(("height", "width"), resolution, stem, strict=True):
        if step < 1 or size < 1 or size % (8 * step):
            raise ValueError(f"{name} must be divisible by {8 * step} (8 x stem {step}), got {size}")
    return resolution[0] // stem[0], resolution[1] // stem[1]


def _level_widths(base_channels: int, multipliers: Sequence[int], groups: int) -> list[int]:
    widths = [base_channels, *(base_channels * factor for factor in _four("channel_multipliers", multipliers))]
    if any(width % groups for width in widths):
        raise ValueError(f"gn_num_groups must divide all level widths {widths}, got {groups}")
    return widths


def _four(name: str, values: Sequence[int]) -> Sequence[int]:
    if len(values) != 4 or min(values) < 1:
        raise ValueError(f"{name} must be 4 positive integers, got {values}")
    return values
