"""LiDARGen's network: the NCSNv2 RefineNet with coordinate channels (Zyrianov et al. 2022; Song & Ermon 2020).

Unlike R2DM's own port of it, which has as many parameters but other operations, this is the function that LiDARGen's
checkpoints were trained with. Convolutions inside blocks wrap around in height too, as published.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.networks.tensors import load_weights, tensors_of


class InstanceNormPlus(nn.Module):
    """Instance normalisation that keeps the channel means, themselves normalised (Song & Ermon 2019, appendix A)."""

    def __init__(self, channels: int):
        super().__init__()
        self.alpha = nn.Parameter(1 + 0.02 * torch.randn(channels))
        self.gamma = nn.Parameter(1 + 0.02 * torch.randn(channels))
        self.beta = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Tensor) -> Tensor:
        means = x.mean((2, 3))
        means = (means - means.mean(1, keepdim=True)) / (means.var(1, keepdim=True) + 1e-5).sqrt()
        h = F.instance_norm(x) + (self.alpha * means)[:, :, None, None]
        return self.gamma[:, None, None] * h + self.beta[:, None, None]


def conv3x3(in_channels: int, out_channels: int, dilation: int = 1, bias: bool = True) -> nn.Conv2d:
    """3x3 convolution that keeps the size (B,C,H,W), circular in width and, as published, in height."""
    return nn.Conv2d(
        in_channels, out_channels, 3, padding=dilation, dilation=dilation, bias=bias, padding_mode="circular"
    )


class ConvMeanPool(nn.Module):
    """Zero-padded convolution, then the mean of each 2x2 cell: (B,in,H,W) -> (B,out,H/2,W/2)."""

    def __init__(self, in_channels: int, out_channels: int, kernel: int = 3):
        super().__init__()
        self.conv = nn.Conv2d(in_channels, out_channels, kernel, padding=kernel // 2)

    def forward(self, x: Tensor) -> Tensor:
        return F.avg_pool2d(self.conv(x), 2)


class ResidualBlock(nn.Module):
    """Twice normalise, ELU, convolve, plus a shortcut; `down` halves H and W, or with a dilation only keeps them."""

    def __init__(self, in_channels: int, out_channels: int, down: bool = False, dilation: int = 1):
        super().__init__()
        halve = down and dilation == 1
        middle = in_channels if down else out_channels
        # modules in the official order, which is the order of the tensors in the official optimizer state
        self.conv1 = conv3x3(in_channels, middle, dilation)
        self.normalize2 = InstanceNormPlus(middle)
        self.conv2 = ConvMeanPool(middle, out_channels) if halve else conv3x3(middle, out_channels, dilation)
        self.shortcut = _shortcut(in_channels, out_channels, down, dilation)
        self.normalize1 = InstanceNormPlus(in_channels)

    def forward(self, x: Tensor) -> Tensor:
        h = self.conv1(F.elu(self.normalize1(x)))
        h = self.conv2(F.elu(self.normalize2(h)))
        return self.shortcut(x) + h


def _shortcut(in_channels: int, out_channels: int, down: bool, dilation: int) -> nn.Module:
    if down and dilation == 1:
        return ConvMeanPool(in_channels, out_channels, kernel=1)
    if down or (dilation > 1 and in_channels != out_channels):
        return conv3x3(in_channels, out_channels, dilation)
    return nn.Identity() if in_channels == out_channels else nn.Conv2d(in_channels, out_channels, 1)


class ResidualConvUnits(nn.ModuleDict):
    """RCU of RefineNet (Lin et al. 2017): `blocks` times x + [ELU, convolve] x `stages`; keeps (B,C,H,W)."""

    def __init__(self, channels: int, blocks: int, stages: int = 2):
        names = [[f"{block + 1}_{stage + 1}_conv" for stage in range(stages)] for block in range(blocks)]
        super().__init__({name: conv3x3(channels, channels, bias=False) for block in names for name in block})
        self.names = names

    def forward(self, x: Tensor) -> Tensor:
        for block in self.names:
            h = x
            for name in block:
                h = self[name](F.elu(h))
            x = x + h
        return x


class MultiResolutionFusion(nn.Module):
    """MSF: the sum of convolved inputs (B,C_i,H_i,W_i), all resized to the first one's size -> (B,out,H_0,W_0)."""

    def __init__(self, in_channels: tuple[int, ...], out_channels: int):
        super().__init__()
        self.convs = nn.ModuleList(conv3x3(channels, out_channels) for channels in in_channels)

    def forward(self, inputs: list[Tensor]) -> Tensor:
        size = inputs[0].shape[2:]
        maps = [conv(x) for conv, x in zip(self.convs, inputs, strict=True)]
        return torch.stack([F.interpolate(h, size, mode="bilinear", align_corners=True) for h in maps]).sum(0)


class ChainedPooling(nn.Module):
    """CRP: x plus a chain of 5x5 maximum, convolution, each added; keeps (B,C,H,W)."""

    def __init__(self, channels: int, stages: int = 2):
        super().__init__()
        self.convs = nn.ModuleList(conv3x3(channels, channels, bias=False) for _ in range(stages))

    def forward(self, x: Tensor) -> Tensor:
        x = path = F.elu(x)
        for conv in self.convs:
            path = conv(F.max_pool2d(path, 5, stride=1, padding=2))
            x = x + path
        return x


class RefineBlock(nn.Module):
    """One stage of the decoder: RCU per input, fusion of several inputs, CRP, RCU. The size is the first input's."""

    def __init__(self, in_channels: tuple[int, ...], out_channels: int, last: bool = False):
        super().__init__()
        self.adapt_convs = nn.ModuleList(ResidualConvUnits(channels, blocks=2) for channels in in_channels)
        self.output_convs = ResidualConvUnits(out_channels, blocks=3 if last else 1)
        self.msf = MultiResolutionFusion(in_channels, out_channels) if len(in_channels) > 1 else None
        self.crp = ChainedPooling(out_channels)

    def forward(self, *inputs: Tensor) -> Tensor:
        adapted = [units(x) for units, x in zip(self.adapt_convs, inputs, strict=True)]
        return self.output_convs(self.crp(adapted[0] if self.msf is None else self.msf(adapted)))


class RefineNet(nn.Module):
    """LiDARGen's score network; parameter names and their order are those of the official checkpoints.

    `forward(x_t (B,C,H,W), log_snr (B,)) -> (B,C,H,W)`: the score, which is the network's answer divided by
    sigma = exp(-log_snr / 2); the noise level enters nowhere else. H and W even, at least 8.
    29,694,082 parameters with the defaults, as R2DM's paper counts them. Raises ValueError for another size or shape.

    With `unit_range`, images lie in [0,1] and sigma in [0.01, 50], as published. Without, images lie in [-1,1], and the
    same weights are the same model when every sigma is twice as large: score(2x - 1; 2 sigma) = score(x; sigma) / 2.
    """

    sigmas: Tensor

    def __init__(
        self,
        channels: int = 2,  # of an image: range, reflectance
        base_channels: int = 128,  # n; the inner stages have 2n
        levels: int = 232,  # noise levels of the stored table `sigmas`, which the network itself does not read
        unit_range: bool = True,  # images in [0,1] (LiDARGen); False = in [-1,1] (ours)
        divide: bool = True,  # divide by sigma: a score; False = the bare answer, to train as a noise predictor
    ):
        super().__init__()
        n = base_channels
        self.channels, self.unit_range, self.divide = channels, unit_range, divide
        self.register_buffer("sigmas", geometric_sigmas(levels))
        self.begin_conv = nn.Conv2d(channels + 2, n, 3, padding=1)
        self.normalizer = InstanceNormPlus(n)
        self.end_conv = nn.Conv2d(n, channels, 3, padding=1)
        self.res1 = nn.Sequential(ResidualBlock(n, n), ResidualBlock(n, n))
        self.res2 = nn.Sequential(ResidualBlock(n, 2 * n, down=True), ResidualBlock(2 * n, 2 * n))
        self.res3 = _dilated_stage(2 * n, dilation=2)
        self.res4 = _dilated_stage(2 * n, dilation=4)
        self.refine1 = RefineBlock((2 * n,), 2 * n)
        self.refine2 = RefineBlock((2 * n, 2 * n), 2 * n)
        self.refine3 = RefineBlock((2 * n, 2 * n), n)
        self.refine4 = RefineBlock((n, n), n, last=True)

    def forward(self, x_t: Tensor, log_snr: Tensor) -> Tensor:
        self._check(x_t)
        x = 2 * x_t - 1 if self.unit_range else x_t
        x1 = self.res1(self.begin_conv(torch.cat([x, _ramps(x)], dim=1)))
        x2 = self.res2(x1)
        x3 = self.res3(x2)
        x4 = self.res4(x3)
        h = self.refine1(x4)
        h = self.refine2(x3, h)
        h = self.refine3(x2, h)
        h = self.refine4(x1, h)
        h = self.end_conv(F.elu(self.normalizer(h)))
        return h * (log_snr / 2).exp().view(-1, 1, 1, 1) if self.divide else h

    def _check(self, x_t: Tensor) -> None:
        if x_t.ndim != 4 or x_t.shape[1] != self.channels:
            raise ValueError(f"x_t must be (B, {self.channels}, H, W), got {tuple(x_t.shape)}")
        height, width = x_t.shape[2:]
        if height % 2 or width % 2 or min(height, width) < 8:
            raise ValueError(f"height and width must be even and at least 8, got {height} x {width}")


def _dilated_stage(channels: int, dilation: int) -> nn.Sequential:
    """LiDARGen's stages that see further instead of becoming smaller."""
    first = ResidualBlock(channels, channels, down=True, dilation=dilation)
    return nn.Sequential(first, ResidualBlock(channels, channels, dilation=dilation))


def _ramps(x: Tensor) -> Tensor:
    """(B,2,H,W): the column, then the row of each pixel of x (B,C,H,W), from 0 to 1."""
    batch, _, height, width = x.shape
    column = torch.linspace(0, 1, width, device=x.device, dtype=x.dtype).expand(height, width)
    row = torch.linspace(0, 1, height, device=x.device, dtype=x.dtype)[:, None].expand(height, width)
    return torch.stack([column, row]).expand(batch, 2, height, width)


def geometric_sigmas(levels: int = 232, first: float = 50.0, last: float = 0.01) -> Tensor:
    """LiDARGen's noise levels (levels,), float32, falling geometrically; images are in [0,1]."""
    return torch.linspace(math.log(first), math.log(last), levels, dtype=torch.float64).exp().float()


def from_official(checkpoint: object, ema: bool = True, unit_range: bool = True) -> RefineNet:
    """The network, in evaluation mode, of a LiDARGen checkpoint as torch.load(..., weights_only=True) returns it.

    checkpoint  the list [model with names "module.*", optimizer, epoch, step, moving average of the parameters]
    ema         take the moving average where there is one (True), or the raw weights
    unit_range  as in RefineNet

    The width and the number of levels are read from the tensors.
    Raises ValueError that says what was expected and what was found.
    """
    expected = "expected LiDARGen's list [model, optimizer, epoch, step, ema]"
    if not isinstance(checkpoint, list) or not 4 <= len(checkpoint) <= 5:
        length = f" of {len(checkpoint)}" if isinstance(checkpoint, list | tuple | dict) else ""
        raise ValueError(f"{expected}, found a {type(checkpoint).__name__}{length}")
    weights = tensors_of(checkpoint[0], expected, "module.")
    if ema and len(checkpoint) == 5:
        weights |= tensors_of(checkpoint[4], expected)
    begin, sigmas = weights.get("begin_conv.weight"), weights.get("sigmas")
    if begin is None or begin.ndim != 4 or sigmas is None or sigmas.ndim != 1:
        raise ValueError(f"expected LiDARGen's begin_conv.weight and sigmas, found {list(weights)[:4]}")
    network = RefineNet(begin.shape[1] - 2, len(begin), len(sigmas), unit_range)
    load_weights(network, weights)
    return network.eval()
