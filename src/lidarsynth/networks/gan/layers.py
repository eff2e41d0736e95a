"""Layers that the three GANs share: equalised learning rate, FIR resampling on a ring, batch statistics.

Images are (B,C,H,W); the width is a ring, beyond the height rows are mirrored or repeated.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

BINOMIAL_3 = (1, 2, 1)
BINOMIAL_4 = (1, 3, 3, 1)
HEIGHT, WIDTH = 2, 3  # dimensions of (B,C,H,W)
GROUP = 4  # images whose deviation a discriminator is told


class Pad(nn.Module):
    """Adds `size` columns and rows on every side: circular along the width, `vertical` along the height."""

    def __init__(self, size: int = 1, vertical: str = "replicate"):
        super().__init__()
        if vertical not in ("replicate", "reflect"):
            raise ValueError(f'vertical padding must be "replicate" or "reflect", got {vertical!r}')
        self.size, self.vertical = size, vertical

    def forward(self, x: Tensor) -> Tensor:
        x = F.pad(x, (self.size, self.size, 0, 0), mode="circular")
        return F.pad(x, (0, 0, self.size, self.size), mode=self.vertical)


class EqualLR(nn.Module):
    """A layer whose weight is scaled at run time: module(x / sqrt n) * gain * lr_mul, n = elements of weight[0].

    weight ~ N(0, 1/lr_mul^2), bias 0. n is the fan-in of Linear and Conv2d, and out*kh*kw of ConvTranspose2d, as in
    the official code. Progressive GAN section 4.1.
    """

    def __init__(self, module: nn.Linear | nn.Conv2d | nn.ConvTranspose2d, gain: float = 1.0, lr_mul: float = 1.0):
        super().__init__()
        self.module = module
        self.scale = 1 / math.sqrt(module.weight[0].numel())
        self.gain = gain * lr_mul
        nn.init.normal_(module.weight, std=1 / lr_mul)
        if module.bias is not None:
            nn.init.zeros_(module.bias)

    def forward(self, x: Tensor) -> Tensor:
        y = self.module(x * self.scale)
        return y if self.gain == 1 else y * self.gain


class FusedLeakyReLU(nn.Module):
    """sqrt(2) * leaky_relu(x + bias, 0.2), one bias per channel: (B,C) or (B,C,H,W), same shape. StyleGAN2."""

    def __init__(self, channels: int):
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Tensor) -> Tensor:
        bias = self.bias.view(-1, *[1] * (x.ndim - 2))
        return F.leaky_relu(x + bias, 0.2) * math.sqrt(2)


class Resample(nn.Module):
    """FIR filter with zero insertion before it (`up`) or decimation after it (`down`), along the dimensions `dims`.

    (B,C,H,W) -> (B,C,H*up/down,W*up/down). The width is circular; beyond the height rows follow `vertical`. The buffer
    `kernel` holds the taps with their sum `up`, so that a constant stays one along each axis. The taps are symmetric.
    """

    kernel: Tensor

    def __init__(
        self,
        taps: Sequence[int],
        up: int = 1,
        down: int = 1,
        dims: Sequence[int] = (WIDTH, HEIGHT),
        vertical: str = "replicate",
    ):
        super().__init__()
        self.up, self.down, self.dims, self.vertical = up, down, dims, vertical
        kernel = torch.tensor(taps, dtype=torch.float32)
        self.register_buffer("kernel", kernel / kernel.sum() * up)
        n = len(taps)
        if up > 1:
            self.before, self.after = (n - up + 1) // 2 + up - 1, (n - up) // 2
        else:
            self.before, self.after = (n - down + 1) // 2, (n - down) // 2

    def forward(self, x: Tensor) -> Tensor:
        for dim in self.dims:
            x = self._grow(x, dim) if self.up > 1 else self._shrink(x, dim)
        return x

    def _pad(self, x: Tensor, dim: int, before: int, after: int) -> Tensor:
        if dim == WIDTH:
            return F.pad(x, (before, after, 0, 0), mode="circular")
        return F.pad(x, (0, 0, before, after), mode=self.vertical)

    def _taps(self, x: Tensor, dim: int) -> Tensor:
        taps = self.kernel.to(x.dtype).expand(x.shape[1], 1, -1)
        return taps.unsqueeze(HEIGHT if dim == WIDTH else WIDTH)

    def _shrink(self, x: Tensor, dim: int) -> Tensor:
        stride = (1, self.down) if dim == WIDTH else (self.down, 1)
        x = self._pad(x, dim, self.before, self.after)
        return F.conv2d(x, self._taps(x, dim), stride=stride, groups=x.shape[1])

    def _grow(self, x: Tensor, dim: int) -> Tensor:
        """Zero insertion and filter in one transposed convolution, of which the middle is kept."""
        size, margin = x.shape[dim], -(-max(self.before, self.after) // self.up)
        stride = (1, self.up) if dim == WIDTH else (self.up, 1)
        x = self._pad(x, dim, margin, margin)
        x = F.conv_transpose2d(x, self._taps(x, dim), stride=stride, groups=x.shape[1])
        return x.narrow(dim, margin * self.up - self.before + len(self.kernel) - 1, size * self.up)


class BlurVH(nn.Module):
    """The image smoothed along the height, then the image smoothed along the width: (B,C,H,W) -> (B,2C,H,W)."""

    def __init__(self, vertical: str = "replicate"):
        super().__init__()
        self.blur_v = Resample(BINOMIAL_3, dims=(HEIGHT,), vertical=vertical)
        self.blur_h = Resample(BINOMIAL_3, dims=(WIDTH,), vertical=vertical)

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([self.blur_v(x), self.blur_h(x)], dim=1)


class PixelNorm(nn.Module):
    """Divides by the root mean square over channels (dimension 1); any shape (B,C,...). Progressive GAN 4.2."""

    def forward(self, x: Tensor) -> Tensor:
        return x / torch.sqrt(x.square().mean(1, keepdim=True) + 1e-8)


class MinibatchStdDev(nn.Module):
    """Appends the mean standard deviation within groups of the batch as a channel: (B,C,H,W) -> (B,C+1,H,W).

    A group is every (B/group)-th image, at most `group` of them; batches smaller than it are one group.
    Raises ValueError if the group does not divide the batch. Progressive GAN section 3.
    """

    def __init__(self, group: int = GROUP):
        super().__init__()
        self.group = group

    def forward(self, x: Tensor) -> Tensor:
        batch, _, height, width = x.shape
        group = min(batch, self.group)
        if batch % group:
            raise ValueError(f"batch must be a multiple of {group} for the statistics of its groups, got {batch}")
        spread = x.unflatten(0, (group, -1)).var(0, correction=0).add(1e-8).sqrt().mean((1, 2, 3))
        return torch.cat([x, spread.repeat(group).view(-1, 1, 1, 1).expand(-1, 1, height, width)], dim=1)
