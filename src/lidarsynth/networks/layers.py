"""Layers for equirectangular images: the width is a ring, the height has ends (R2DM section III-B)."""

import math
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F


def pad_width(x: Tensor, ring: bool = True) -> Tensor:
    """Adds a column on either side of (B,C,H,W): the one of the other side on a ring, else zeros."""
    if not ring:
        return F.pad(x, (1, 1))
    if x.shape[-1] == 1:
        return x.expand(-1, -1, -1, 3)
    # split once, because the gradient of overlapping slices costs four passes over the image
    first, middle, last = x.split([1, x.shape[-1] - 2, 1], dim=-1)
    return torch.cat([last, first, middle, last, first], dim=-1)


class ColumnLinear(nn.Linear):
    """`nn.Linear`, (..., I) -> (..., O), whose weights (O, I) lie column by column: of 8 to 24 rows at a time, as where
    pixels are drawn one after the other, its product takes about two thirds of the time."""

    def __init__(self, in_features: int, out_features: int, bias: bool = True):
        super().__init__(in_features, out_features, bias)
        self.weight = nn.Parameter(self.weight.detach().t().contiguous().t())


class Conv3x3(nn.Conv2d):
    """3x3 convolution that keeps the size: circular in width (zeros if not `ring`), zeros beyond the height."""

    def __init__(self, in_channels: int, out_channels: int, ring: bool = True):
        super().__init__(in_channels, out_channels, kernel_size=3, padding=(1, 0))
        self.ring = ring

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(pad_width(x, self.ring))


class Downsample(nn.Module):
    """Halves H and W with the FIR filter [1,3,3,1]/8 on either axis: (B,C,H,W) -> (B,C,H/2,W/2)."""

    kernel: Tensor

    def __init__(self, ring: bool = True):
        super().__init__()
        self.ring = ring
        self.register_buffer("kernel", torch.tensor([1.0, 3.0, 3.0, 1.0]) / 8)

    def forward(self, x: Tensor) -> Tensor:
        channels = x.shape[1]
        across, along = (self.kernel.expand(channels, 1, -1).unsqueeze(dim) for dim in (2, 3))
        x = F.conv2d(pad_width(x, self.ring), across, stride=(1, 2), groups=channels)
        return F.conv2d(x, along, stride=(2, 1), padding=(1, 0), groups=channels)


class Upsample(nn.Module):
    """Doubles H and W with the FIR filter [1,3,3,1]/4 on either axis: (B,C,H,W) -> (B,C,2H,2W)."""

    kernel: Tensor

    def __init__(self, ring: bool = True):
        super().__init__()
        self.ring = ring
        self.register_buffer("kernel", torch.tensor([1.0, 3.0, 3.0, 1.0]) / 4)

    def forward(self, x: Tensor) -> Tensor:
        channels = x.shape[1]
        taps = torch.outer(self.kernel, self.kernel).flip(0, 1).expand(channels, 1, -1, -1)
        return F.conv_transpose2d(pad_width(x, self.ring), taps, stride=2, padding=(1, 3), groups=channels)


class LogSNREmbedding(nn.Module):
    """Sines, then cosines, of the log-SNR at n = channels/2 frequencies from 1 to 1/10000: (B,) -> (B, channels)."""

    def __init__(self, channels: int):
        super().__init__()
        if channels < 4 or channels % 2:
            raise ValueError(f"base_channels must be even and at least 4, got {channels}")
        self.channels = channels

    def forward(self, log_snr: Tensor) -> Tensor:
        n = self.channels // 2
        freqs = torch.exp(torch.arange(n, device=log_snr.device) * (-math.log(10_000) / (n - 1)))
        arguments = log_snr.float()[:, None] * freqs
        return torch.cat([arguments.sin(), arguments.cos()], dim=1)


class TimeEmbedding(nn.Sequential):
    """(B,) -> (B, width) of the log-SNR, of any type; the activation that follows is part of `AdaGroupNorm`."""

    def __init__(self, channels: int, width: int):
        super().__init__(LogSNREmbedding(channels), nn.Linear(channels, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, log_snr: Tensor) -> Tensor:
        embedding, first, activation, last = self
        return last(activation(first(embedding(log_snr).to(first.weight.dtype))))


class AdaGroupNorm(nn.Module):
    """Group normalisation whose scale and shift come from the time embedding: GN(x) * (1 + scale) + shift."""

    def __init__(self, embedding: int, channels: int, groups: int, eps: float):
        super().__init__()
        self.groups, self.eps = groups, eps
        self.proj = nn.Sequential(nn.SiLU(), nn.Linear(embedding, 2 * channels))

    def forward(self, x: Tensor, embedding: Tensor) -> Tensor:
        scale, shift = self.proj(embedding)[:, :, None, None].chunk(2, dim=1)
        return torch.addcmul(shift, F.group_norm(x, self.groups, eps=self.eps), 1 + scale)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions under group normalisation, told the time: (B,in,H,W), (B,T) -> (B,out,H,W)."""

    scale: Tensor

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        embedding: int,  # width T of the time embedding
        groups: int = 8,
        eps: float = 1e-6,
        dropout: float = 0.0,
        ring: bool = True,
    ):
        super().__init__()
        self.norm1 = nn.GroupNorm(groups, in_channels, eps)
        self.conv1 = Conv3x3(in_channels, out_channels, ring)
        self.norm2 = AdaGroupNorm(embedding, out_channels, groups, eps)
        self.dropout = nn.Dropout(dropout)
        self.conv2 = zero_init(Conv3x3(out_channels, out_channels, ring))
        self.skip = nn.Conv2d(in_channels, out_channels, 1) if in_channels != out_channels else nn.Identity()
        self.register_buffer("scale", torch.tensor(1 / math.sqrt(2)))

    def forward(self, x: Tensor, embedding: Tensor) -> Tensor:
        h = self.conv1(F.silu(self.norm1(x)))
        h = self.conv2(self.dropout(F.silu(self.norm2(h, embedding))))
        return (self.skip(x) + h) * self.scale


class MultiheadAttention(nn.Module):
    """Self-attention of (B,N,C) tokens; parameter names and initial values of torch.nn.MultiheadAttention."""

    def __init__(self, channels: int, heads: int):
        super().__init__()
        if channels % heads:
            raise ValueError(f"attn_num_heads must divide {channels} channels, got {heads}")
        self.heads = heads
        self.in_proj_weight = nn.Parameter(nn.init.xavier_uniform_(torch.empty(3 * channels, channels)))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * channels))
        self.out_proj = zero_init(nn.Linear(channels, channels))

    def forward(self, x: Tensor) -> Tensor:
        qkv = F.linear(x, self.in_proj_weight, self.in_proj_bias)
        q, k, v = qkv.unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)  # (B, heads, N, C/heads) each
        return self.out_proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))


class SelfAttentionBlock(nn.Module):
    """Every pixel attends to every other: (B,C,H,W) -> (B,C,H,W)."""

    scale: Tensor

    def __init__(self, channels: int, heads: int = 8, groups: int = 8, eps: float = 1e-6):
        super().__init__()
        self.norm = nn.GroupNorm(groups, channels, eps)
        self.attn = MultiheadAttention(channels, heads)
        self.register_buffer("scale", torch.tensor(1 / math.sqrt(2)))

    def forward(self, x: Tensor) -> Tensor:
        h = self.attn(self.norm(x).flatten(2).transpose(1, 2))
        return (x + h.transpose(1, 2).reshape(x.shape)) * self.scale


Layer = TypeVar("Layer", bound=nn.Module)


def zero_init(layer: Layer) -> Layer:
    """Sets all parameters of `layer` to zero, so that its branch is silent at the start of training; returns it."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer
