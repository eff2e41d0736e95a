"""LiDAR-SR (Shan et al. 2020): a U-Net for more beams, with Monte-Carlo dropout that tells where it is unsure.

There are two programs of it. The original is Keras; the one in ILN's repository is PyTorch, and the candidate for
R2DM's table. They have the same layers and differ in arithmetic, so that weights belong to one of them, see `LidarSR`.
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.networks.tensors import iln_tensors, load_weights

DROPOUT = 0.25  # as published, in both programs


class TransposedConv(nn.ConvTranspose2d):
    """3x3 transposed convolution: (B,in,H,W) -> (B,out,sh*H,sw*W) for strides of 1 or 2.

    Along a stride of 2, one row more than twice the input has to go: the first (PyTorch's way) or the last (Keras').
    """

    def __init__(self, in_channels: int, out_channels: int, stride: tuple[int, int], keras: bool):
        kept = (0 if stride[0] == 2 else 1, 0 if stride[1] == 2 else 1)
        padding, extra = (kept, (0, 0)) if keras else ((1, 1), (stride[0] - 1, stride[1] - 1))
        super().__init__(in_channels, out_channels, 3, stride=stride, padding=padding, output_padding=extra)
        self.factors = stride

    def forward(self, x: Tensor, output_size: list[int] | None = None) -> Tensor:
        height, width = x.shape[2] * self.factors[0], x.shape[3] * self.factors[1]
        return super().forward(x)[:, :, :height, :width]


class Dropout(nn.Module):
    """Drops whole channels, or single values if `keras`, while training; or what a mask tells, at any time."""

    def __init__(self, rate: float, keras: bool):
        super().__init__()
        self.rate, self.keras = rate, keras

    def forward(self, x: Tensor, keep: Tensor | None = None) -> Tensor:
        if keep is not None:
            return x * keep.to(x.dtype) / (1 - self.rate)
        drop = F.dropout if self.keras else F.dropout2d
        return drop(x, self.rate, self.training)


def batch_norm(channels: int, keras: bool) -> nn.BatchNorm2d:
    """Batch normalisation with the constants of either program."""
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01) if keras else nn.BatchNorm2d(channels)


class ConvBlock(nn.Module):
    """Twice convolve, normalise, ReLU: (B,in,H,W) -> (B,out,H,W), zeros beyond all borders."""

    def __init__(self, in_channels: int, out_channels: int, keras: bool):
        super().__init__()
        layers: list[nn.Module] = []
        for channels in (in_channels, out_channels):
            layers += [nn.Conv2d(channels, out_channels, 3, padding=1), batch_norm(out_channels, keras), nn.ReLU()]
        self.conv_block = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv_block(x)


class UpBlock(nn.Module):
    """Transposed convolution, normalise, ReLU: (B,in,H,W) -> (B,out,sh*H,sw*W)."""

    def __init__(self, in_channels: int, out_channels: int, keras: bool, stride: tuple[int, int] = (2, 2)):
        super().__init__()
        conv = TransposedConv(in_channels, out_channels, stride, keras)
        self.up_block = nn.Sequential(conv, batch_norm(out_channels, keras), nn.ReLU())

    def forward(self, x: Tensor) -> Tensor:
        return self.up_block(x)


class UpScale(nn.Module):
    """(B,1,h,w) -> (B,C,H,W): doublings, those of the width first, then a block of convolutions."""

    def __init__(self, channels: int, scale: tuple[int, int], keras: bool):
        super().__init__()
        doublings, wide = (int(math.log2(factor)) for factor in scale)
        strides = [(2, 2 if index < wide else 1) for index in range(doublings)]
        widths = [1] + [channels] * doublings
        blocks = [UpBlock(a, channels, keras, stride) for a, stride in zip(widths[:-1], strides, strict=True)]
        self.conv = nn.Sequential(*blocks, ConvBlock(channels, channels, keras))

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(x)


class Down(nn.Module):
    """(B,C,H,W) -> (B,2C,H/2,W/2): mean of 2x2, dropout, convolutions."""

    def __init__(self, channels: int, rate: float, keras: bool):
        super().__init__()
        self.down = nn.Sequential(nn.AvgPool2d(2), Dropout(rate, keras), ConvBlock(channels, 2 * channels, keras))

    def forward(self, x: Tensor, keep: Tensor | None = None) -> Tensor:
        pool, dropout, convs = self.down
        return convs(dropout(pool(x), keep))


class Up(nn.Module):
    """Skip and current features, (B,C,H,W) each -> (B,C/2,2H,2W): convolutions, dropout, transposed convolution."""

    def __init__(self, channels: int, rate: float, keras: bool):
        super().__init__()
        blocks = ConvBlock(2 * channels, channels, keras), UpBlock(channels, channels // 2, keras)
        self.up = nn.Sequential(blocks[0], Dropout(rate, keras), blocks[1])

    def forward(self, skip: Tensor, x: Tensor, keep: Tensor | None = None) -> Tensor:
        convs, dropout, up = self.up
        return up(dropout(convs(torch.cat([skip, x], dim=1)), keep))


class Out(nn.Module):
    """(B,2C,H,W) -> (B,1,H,W): convolutions, then one of 1x1."""

    def __init__(self, channels: int, keras: bool):
        super().__init__()
        self.conv = nn.Sequential(ConvBlock(2 * channels, channels, keras), nn.Conv2d(channels, 1, 1))

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(x)


class LidarSR(nn.Module):
    """LiDAR-SR; parameter names are those of the checkpoints of ILN's repository.

    `forward(low (B,1,h,w), keep) -> (B,1,H,W)`, H, W = h, w times `scale`: ranges over the largest one, in [0,1] where
    measured, at least 0 and not bounded above. The lowest beam is row 0. No return is 1 (PyTorch) or 0 (Keras).
    `keep`, 8 masks as of `draw_masks`, tells what dropout keeps, in training and evaluation; without, evaluation drops
    nothing. Keras' program never ran so: its answers are those of `mc_dropout`.
    34,600,001 parameters with the defaults. Raises ValueError for another scale, shape or number of masks.
    """

    def __init__(
        self,
        scale: tuple[int, int] = (4, 1),  # of rows and columns, powers of 2; the second at most the first
        width: int = 64,
        dropout: float = DROPOUT,
        keras: bool = False,  # arithmetic of the original: end crop, eps 1e-3, dropout of single values
    ):
        super().__init__()
        if any(factor < 1 or factor & (factor - 1) for factor in scale) or scale[1] > scale[0]:
            raise ValueError(f"scale must be two powers of 2, the second at most the first, got {scale}")
        self.scale, self.width, self.dropout, self.keras = scale, width, dropout, keras
        # in the order of execution, which is that of Keras' weights
        self.up_scale = UpScale(width, scale, keras)
        self.down1 = Down(width, dropout, keras)
        self.down2 = Down(2 * width, dropout, keras)
        self.down3 = Down(4 * width, dropout, keras)
        bottom = Down(8 * width, dropout, keras), Dropout(dropout, keras), UpBlock(16 * width, 8 * width, keras)
        self.downup = nn.Sequential(*bottom)
        self.up1 = Up(8 * width, dropout, keras)
        self.up2 = Up(4 * width, dropout, keras)
        self.up3 = Up(2 * width, dropout, keras)
        self.outc = Out(width, keras)
        self.apply(_he_normal)

    def forward(self, low: Tensor, keep: Sequence[Tensor] | None = None) -> Tensor:
        self._check(low, keep)
        k = [None] * 8 if keep is None else keep
        x1 = self.up_scale(low)
        x2 = self.down1(x1, k[0])
        x3 = self.down2(x2, k[1])
        x4 = self.down3(x3, k[2])
        down, dropout, up = self.downup
        y = up(dropout(down(x4, k[3]), k[4]))
        y = self.up1(x4, y, k[5])
        y = self.up2(x3, y, k[6])
        y = self.up3(x2, y, k[7])
        return F.relu(self.outc(torch.cat([x1, y], dim=1)))

    def draw_masks(self, low: Tensor, rng: torch.Generator) -> list[Tensor]:
        """Random masks for forward(low), bool, True = keep: 8 of (B,C,1,1), or of (B,C,H,W) with `keras`."""
        height, width = (size * factor for size, factor in zip(low.shape[2:], self.scale, strict=True))
        shapes = []
        for channels, halvings in zip((1, 2, 4, 8, 16, 8, 4, 2), (1, 2, 3, 4, 4, 3, 2, 1), strict=True):
            size = (height >> halvings, width >> halvings) if self.keras else (1, 1)
            shapes.append((len(low), channels * self.width, *size))
        return [(torch.rand(s, generator=rng, device=rng.device) >= self.dropout).to(low.device) for s in shapes]

    def _check(self, low: Tensor, keep: Sequence[Tensor] | None) -> None:
        if low.ndim != 4 or low.shape[1] != 1:
            raise ValueError(f"low must be (B, 1, h, w), got {tuple(low.shape)}")
        height, width = (size * factor for size, factor in zip(low.shape[2:], self.scale, strict=True))
        if height % 16 or width % 16:
            raise ValueError(f"the output's height and width must be divisible by 16, got {height} x {width}")
        if keep is not None and len(keep) != 8:
            raise ValueError(f"keep must be 8 masks, one per dropout, got {len(keep)}")


def _he_normal(module: nn.Module) -> None:
    if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
        nn.init.kaiming_normal_(module.weight)
        assert module.bias is not None
        nn.init.zeros_(module.bias)


@torch.no_grad()
def mc_dropout(
    network: LidarSR,
    low: Tensor,
    rng: torch.Generator,
    passes: int = 50,
    on_pass: Callable[[], object] | None = None,  # called after each
) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation (over passes, not unbiased), (B,1,H,W) each, of forward(low) under dropout.

    The network must be in evaluation mode, because batch normalisation uses its running statistics (LiDAR-SR III-D).
    Raises ValueError otherwise, and for fewer than one pass.
    """
    if network.training or passes < 1:
        mode = "training" if network.training else "evaluation"
        raise ValueError(f"expected a network in evaluation mode and at least 1 pass, got {mode} mode and {passes}")
    outputs = []
    for _ in range(passes):
        outputs.append(network(low, network.draw_masks(low, rng)))
        if on_pass is not None:
            on_pass()
    found = torch.stack(outputs)
    return found.mean(0), found.std(0, correction=0)


def remove_uncertain(mean: Tensor, std: Tensor, threshold: float = 0.03) -> Tensor:
    """The mean, 0 where the standard deviation exceeds this share of it; both are ranges that start at 0, any unit."""
    return torch.where(std > threshold * mean, 0, mean)


def official_arguments(checkpoint: object) -> dict[str, float]:
    """What `model.args` of a checkpoint of ILN's repository says of scale_h, scale_w, width and dropout_rate.

    Other arguments, and none at all, say nothing. Raises ValueError for what is no number, or no rate.
    """
    model = checkpoint.get("model") if isinstance(checkpoint, dict) else None
    args = (model.get("args") if isinstance(model, dict) else None) or {}
    if not isinstance(args, dict):
        raise ValueError(f"expected model.args by name, found {args!r:.80}")
    found = {key: args[key] for key in ("scale_h", "scale_w", "width", "dropout_rate") if key in args}
    for key, value in found.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError(f"expected a number as {key} of model.args, found {value!r:.80}")
    if not 0 <= found.get("dropout_rate", 0) < 1:
        raise ValueError(f"expected dropout_rate of model.args from 0 to below 1, found {found['dropout_rate']}")
    return found


def from_official(checkpoint: object, scale: tuple[int, int] = (4, 1)) -> LidarSR:
    """The network, in evaluation mode, of a checkpoint of ILN's repository (`lsr_4h_1w_*.pth`: scale (4, 1)).

    The width is read from the tensors; the factor of columns cannot be. Dropout is that of the checkpoint's arguments
    or, where it tells none, as published. Raises ValueError if something does not fit, arguments and tensors included.
    """
    weights, told = iln_tensors(checkpoint, "lsr"), official_arguments(checkpoint)
    last = weights.get("outc.conv.1.weight")
    if last is None or last.ndim != 4:
        raise ValueError(f"expected LiDAR-SR's outc.conv.1.weight, found {list(weights)[:4]}")
    found = {"scale_h": scale[0], "scale_w": scale[1], "width": last.shape[1]}
    for key, value in found.items():
        if told.get(key, value) != value:
            raise ValueError(f"expected tensors of {key} = {told[key]}, as model.args says, found those of {value}")
    network = LidarSR(scale, last.shape[1], told.get("dropout_rate", DROPOUT))
    load_weights(network, weights)
    return network.eval()


def from_keras(weights: Sequence[Tensor], scale: int = 4, dropout: float = DROPOUT) -> LidarSR:
    """The network, in evaluation mode, of the original program's weights in the order of Keras' `get_weights()`.

    That is by layer as created: kernel [kh,kw,in,out] (transposed: [kh,kw,out,in]), bias; or gamma, beta, moving mean
    and variance. Raises ValueError when the number of tensors or a shape does not fit.
    """
    if not weights or weights[0].ndim != 4:
        raise ValueError(f"expected LiDAR-SR's kernels in Keras' order, found {len(weights)} tensors")
    network = LidarSR((scale, 1), weights[0].shape[2], dropout, keras=True)
    names = [name for name in network.state_dict() if not name.endswith("num_batches_tracked")]
    if len(names) != len(weights):
        raise ValueError(f"expected {len(names)} tensors of Keras' LiDAR-SR, found {len(weights)}")
    own = [tensor.permute(3, 2, 0, 1) if tensor.ndim == 4 else tensor for tensor in weights]
    counters = {name: value for name, value in network.state_dict().items() if name not in names}
    load_weights(network, {**dict(zip(names, own, strict=True)), **counters})
    return network.eval()


def copy_measured(high: Tensor, low: Tensor) -> Tensor:
    """The upsampled (...,H,W) with every (H/h)-th row, from row 0, as measured in (...,h,W)."""
    if high.shape[-1] != low.shape[-1] or high.shape[-2] % low.shape[-2]:
        raise ValueError(f"expected a multiple of {low.shape[-2]} rows of {low.shape[-1]}, got {tuple(high.shape)}")
    copied = high.clone()
    copied[..., :: high.shape[-2] // low.shape[-2], :] = low
    return copied
