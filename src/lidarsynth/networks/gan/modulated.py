"""Modulated layers on Fourier features of the ray angles: the blocks of DUSty v2 (WACV 2023)."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.networks.gan.layers import BINOMIAL_4, EqualLR, FusedLeakyReLU, Resample

EMA_VAR_DECAY = 0.9989


class RandomFourierFeatures(nn.Module):
    """Sines, then cosines, of random linear forms of the angles: (B,2,H,W) radians -> (B,2*count,H,W).

    Azimuth frequencies are integers, 0 or +-2^i, so that the features close on the ring; elevation frequencies are
    uniform. `resolution` is that of the block. Not trained: a checkpoint holds them.
    """

    freqs: Tensor
    phase: Tensor

    def __init__(self, resolution: tuple[int, int], count: int = 256):
        super().__init__()
        octaves_h = math.ceil(math.log2(resolution[0])) + 3
        octaves_w = math.ceil(math.log2(resolution[1])) - 1
        powers = 2.0 ** torch.arange(octaves_w)
        choices = torch.cat([-powers, torch.zeros(1), powers])
        elevation = (2 * torch.rand(count) - 1) * 2 ** (octaves_h - 1)
        azimuth = choices[torch.randint(len(choices), (count,))]
        self.register_buffer("freqs", torch.stack([elevation, azimuth], 1)[:, :, None, None])
        self.register_buffer("phase", torch.rand(count) * 2 * math.pi)

    def forward(self, angles: Tensor) -> Tensor:
        # in full precision even under autocast: phases of hundreds of radians have no half precision
        angles = angles.float()
        elevation, azimuth = self.freqs.float().unbind(1)
        arguments = elevation * angles[:, :1] + azimuth * angles[:, 1:] + self.phase.float()[:, None, None]
        return torch.cat([arguments.sin(), arguments.cos()], dim=1)

    def turned(self, weight: Tensor, shift: Tensor) -> Tensor:
        """Weights (B,out,2*count) that do with the features of some angles what `weight` does `shift` (B,) turns on.

        sin(a + d) and cos(a + d) are sums of sin a and cos a, so all samples can share the features of one angle map.
        """
        delta = 2 * math.pi * shift[:, None, None] * self.freqs.float()[:, 1, 0, 0]
        sine, cosine = delta.sin(), delta.cos()
        of_sine, of_cosine = weight.chunk(2, dim=2)
        return torch.cat([of_sine * cosine - of_cosine * sine, of_sine * sine + of_cosine * cosine], dim=2)


class ModulatedConv1x1(nn.Module):
    """1x1 convolution whose input channels are scaled by a style: (B,in,H,W), (B,D) -> (B,out,H,W).

    StyleGAN3's order: normalise weight and style, modulate by 1 + style, demodulate, divide by the running root mean
    square `ema_var` of the input, which a forward pass in training mode updates first.

    Features that all samples share, channels behind those of x, come as `shared` (1,C,H,W), with `rotate` to change
    their weights (B,out,C): one product for the whole batch, and no copy for each sample.
    """

    ema_var: Tensor

    def __init__(
        self, in_channels: int, out_channels: int, style_channels: int, demodulate: bool = True, bias: bool = False
    ):
        super().__init__()
        self.demodulate = demodulate
        self.weight = nn.Parameter(torch.randn(1, out_channels, in_channels, 1, 1))
        self.bias = nn.Parameter(torch.zeros(1, 1, 1, 1)) if bias else None
        self.mod = EqualLR(nn.Linear(style_channels, in_channels))
        self.register_buffer("ema_var", torch.tensor(1.0))

    def forward(
        self,
        x: Tensor | None,
        style: Tensor,
        shared: Tensor | None = None,
        rotate: Callable[[Tensor], Tensor] | None = None,
    ) -> Tensor:
        parts = [part for part in (x, shared) if part is not None]
        channels = self.weight.shape[2]
        if self.training:
            with torch.no_grad():
                squares = sum(part.float().square().mean() * (part.shape[1] / channels) for part in parts)
                self.ema_var.lerp_(torch.as_tensor(squares), 1 - EMA_VAR_DECAY)
        weight = self.modulated(style)
        own = channels if shared is None else channels - shared.shape[1]
        y = weight.new_zeros(())
        if x is not None:
            y = weight[..., :own].to(x.dtype) @ x.flatten(2)
        if shared is not None:
            common = weight[..., own:] if rotate is None else rotate(weight[..., own:])
            y = y + (common.flatten(0, 1).to(shared.dtype) @ shared[0].flatten(1)).unflatten(0, common.shape[:2])
        y = y.unflatten(2, parts[0].shape[2:])
        return y if self.bias is None else y + self.bias

    def modulated(self, style: Tensor) -> Tensor:
        """The weight of each sample: (B,D) -> (B,out,in)."""
        s = self.mod(style)
        weight = self.weight[..., 0, 0] / math.sqrt(self.weight.shape[2])
        if self.demodulate:
            weight = weight / weight.abs().amax((1, 2), keepdim=True)
            s = s / s.abs().amax(1, keepdim=True)
        weight = weight * (s + 1)[:, None]
        if self.demodulate:
            weight = weight * torch.rsqrt(weight.square().sum(2, keepdim=True) + 1e-8)
        return weight / (self.ema_var.sqrt() + 1e-8)


class _Heads(nn.Module):
    """One modulated 1x1 convolution per output map: (B,C,H,W), (B,D) -> {name: (B,1,H,W)}."""

    def __init__(self, channels: int, style_channels: int, names: Sequence[str]):
        super().__init__()
        self.heads = nn.ModuleDict(
            {name: ModulatedConv1x1(channels, 1, style_channels, demodulate=False, bias=True) for name in names}
        )

    def forward(self, x: Tensor, style: Tensor) -> dict[str, Tensor]:
        return {name: head(x, style) for name, head in self.heads.items()}


class SynthesisBlock(nn.Module):
    """One resolution: features and output maps of the block below, angles, styles -> features, summed output maps.

    The first block takes no features, uses two styles (convolution, heads) and does not double; the others use three.
    """

    def __init__(
        self,
        in_channels: int,  # 0 = the first block
        out_channels: int,
        style_channels: int,
        resolution: tuple[int, int],
        names: Sequence[str],  # of the output maps
    ):
        super().__init__()
        self.first = in_channels == 0
        if not self.first:
            self.resample = Resample(BINOMIAL_4, up=2)
            self.downsample = Resample(BINOMIAL_4, down=2)
        self.pe = RandomFourierFeatures(resolution)
        self.conv1 = ModulatedConv1x1(in_channels + 2 * len(self.pe.phase), out_channels, style_channels)
        self.bias_act1 = FusedLeakyReLU(out_channels)
        if not self.first:
            self.conv2 = ModulatedConv1x1(out_channels, out_channels, style_channels)
            self.bias_act2 = FusedLeakyReLU(out_channels)
        self.head = _Heads(out_channels, style_channels, names)

    def forward(
        self,
        h: Tensor | None,
        maps: Mapping[str, Tensor],
        angles: Tensor,  # (1 or B,2,H,W)
        styles: Sequence[Tensor],
        shift: Tensor | None = None,  # (B,) turns added to the azimuths
    ) -> tuple[Tensor, dict[str, Tensor]]:
        x = None if h is None else self.resample(h)
        if len(angles) == 1:
            rotate = None if shift is None else partial(self.pe.turned, shift=shift)
            x = self.conv1(x, styles[0], self.pe(angles), rotate)
        else:
            features = self.pe(angles if shift is None else turned(angles, shift))
            x = self.conv1(features if x is None else torch.cat([x, features.to(x.dtype)], dim=1), styles[0])
        x = self.bias_act1(x)
        if not self.first:
            x = self.bias_act2(self.conv2(x, styles[1]))
        new = self.head(x, styles[-1])
        return x, {name: value + self.resample(maps[name]) if name in maps else value for name, value in new.items()}

    def coarser(self, angles: Tensor) -> Tensor:
        """Angles at half the resolution, averaged on the circle: (B,2,H,W) -> (B,2,H/2,W/2), radians."""
        smooth = self.downsample(circle(angles))
        return torch.atan2(smooth[:, ::2], smooth[:, 1::2])


def turned(angles: Tensor, shift: Tensor) -> Tensor:
    """Azimuths (1 or B,2,H,W), elevation first, `shift` (B,) turns on: (B,2,H,W) radians."""
    azimuth = angles[:, 1] + 2 * math.pi * shift[:, None, None]
    return torch.stack([angles[:, 0].expand_as(azimuth), azimuth], dim=1)


def circle(angles: Tensor) -> Tensor:
    """Sine and cosine of either angle: (B,2,H,W) radians -> (B,4,H,W): sin el, cos el, sin az, cos az."""
    return torch.stack([angles.sin(), angles.cos()], dim=2).flatten(1, 2)


def resize_angles(angles: Tensor, resolution: tuple[int, int]) -> Tensor:
    """Angles at another resolution, bilinear on the circle and on the ring: (B,2,h,w) -> (B,2,H,W), radians."""
    height, width = resolution
    wide = F.interpolate(circle(angles).repeat(1, 1, 1, 3), size=(height, 3 * width), mode="bilinear")
    middle = wide[..., width : 2 * width]
    return torch.atan2(middle[:, ::2], middle[:, 1::2])
