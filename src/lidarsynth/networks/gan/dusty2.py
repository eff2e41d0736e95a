"""DUSty v2: a generator that renders any ray angles, with modulated 1x1 layers, and a residual discriminator.

Parameter names are those of the official checkpoints. Range only: images are inverse depth.
"""

import math
from itertools import pairwise
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.networks.gan.dcgan import styles
from lidarsynth.networks.gan.grid_sampling import sample_bilinear
from lidarsynth.networks.gan.layers import (
    BINOMIAL_4,
    BlurVH,
    EqualLR,
    FusedLeakyReLU,
    MinibatchStdDev,
    Pad,
    PixelNorm,
    Resample,
)
from lidarsynth.networks.gan.modulated import SynthesisBlock
from lidarsynth.networks.gan.raydrop import GeneratedImages, RayDrop, measured

_LEVELS = 4  # the image is 2^4 times as large as the generator's coarsest map
_COARSEST = 4  # pixels along the shorter side of the discriminator's coarsest map
_OUTPUT_SCALE = 0.25
_ACTIVATIONS = {"image": torch.tanh, "raydrop_logit": lambda x: x}


class SynthesisNetwork(nn.Module):
    """Styles (B,num_styles,D) and angles (1 or B,2,H,W) -> maps `image` in (-1,1) and `raydrop_logit`, (B,1,H,W)."""

    def __init__(self, style_channels: int, base_channels: int, max_channels: int, resolution: tuple[int, int]):
        super().__init__()
        widths = [min(base_channels << i, max_channels) for i in reversed(range(_LEVELS + 1))]
        sizes = [(resolution[0] >> i, resolution[1] >> i) for i in reversed(range(_LEVELS + 1))]
        names = tuple(_ACTIVATIONS)
        self.layers = nn.ModuleList(
            SynthesisBlock(before, after, style_channels, size, names)
            for before, after, size in zip([0, *widths[:-1]], widths, sizes, strict=True)
        )
        self.num_styles = 2 * len(self.layers)

    def forward(self, w: Tensor, angles: Tensor, shift: Tensor | None = None) -> dict[str, Tensor]:
        h, maps = None, {}
        for i, (block, level) in enumerate(zip(self.layers, self.pyramid(angles), strict=True)):
            # a head shares its style with the first convolution of the next block
            own = w[:, max(2 * i - 1, 0) : 2 * i + 2].unbind(1)
            h, maps = block(h, maps, level, own, shift)
        if shift is not None:
            maps = {name: unshift(value, shift) for name, value in maps.items()}
        return {name: _ACTIVATIONS[name](value * _OUTPUT_SCALE) for name, value in maps.items()}

    def pyramid(self, angles: Tensor) -> list[Tensor]:
        """The angle map of every block, coarsest first: (B,2,H/16,W/16), ..., (B,2,H,W), radians."""
        levels = [angles]
        for block in list(self.layers)[:0:-1]:
            levels.append(cast(SynthesisBlock, block).coarser(levels[-1]))
        return levels[::-1]


def unshift(x: Tensor, shift: Tensor) -> Tensor:
    """Turns maps (B,C,H,W) by `shift` (B,) of a turn towards smaller columns, bilinear; DUSty v2 in training."""
    width = x.shape[3]
    theta = torch.eye(2, 3, device=x.device).repeat(len(x), 1, 1)
    theta[:, 0, 2] = shift
    doubled = torch.cat([x, x], dim=3).float()
    with torch.autocast(x.device.type, enabled=False):  # half precision cannot tell neighbouring columns
        grid = F.affine_grid(theta, list(doubled.shape), align_corners=False)
        return sample_bilinear(doubled, grid)[..., :width]


def _mapping_layer(in_channels: int, out_channels: int) -> nn.Sequential:
    return nn.Sequential(
        EqualLR(nn.Linear(in_channels, out_channels), gain=math.sqrt(2), lr_mul=0.01), nn.LeakyReLU(0.2)
    )


class Generator(nn.Module):
    """Latents (B,Z) ~ N(0,I) and ray angles (1 or B,2,H,W) -> inverse depth images (B,1,H,W) with ray-drop.

    `resolution` sets the bands of new Fourier features; any angle map whose sides are multiples of 16 is rendered. In
    training mode a forward pass updates `w_avg` and the layers' `ema_var`.
    """

    w_avg: Tensor

    def __init__(
        self,
        resolution: tuple[int, int] = (64, 512),
        latent_channels: int = 512,
        style_channels: int = 512,
        base_channels: int = 32,
        max_channels: int = 512,
        temperature: float = 1.0,  # of the ray-drop
    ):
        super().__init__()
        _check_multiple(resolution)
        self.mapping_network = nn.Sequential(
            PixelNorm(), _mapping_layer(latent_channels, style_channels), _mapping_layer(style_channels, style_channels)
        )
        self.synthesis_network = SynthesisNetwork(style_channels, base_channels, max_channels, resolution)
        self.measurement_model = RayDrop(temperature=temperature)
        self.register_buffer("w_avg", torch.zeros(1, style_channels))

    def forward(
        self,
        z: Tensor,  # (B,Z)
        angles: Tensor,  # (1 or B,2,H,W) radians, elevation first
        uniform: Tensor,  # noise in [0,1) of the ray-drop, broadcasts to (B,1,H,W)
        psi: float = 1.0,  # truncation, below 1 pulls styles to their mean; eval mode only
        shift: Tensor | None = None,  # coordinate augmentation of training: (B,) in [0,1) turns, undone in the output
    ) -> GeneratedImages:
        w = styles(self.mapping_network(z), self.w_avg, psi, self.training)
        return self.synthesize(w, angles, uniform, shift)

    def synthesize(self, w: Tensor, angles: Tensor, uniform: Tensor, shift: Tensor | None = None) -> GeneratedImages:
        """As `forward`, from styles: one for all layers (B,D), or W+, one per layer (B,num_styles,D)."""
        _check_multiple(tuple(angles.shape[2:]))
        each = w[:, None].expand(-1, self.synthesis_network.num_styles, -1) if w.ndim == 2 else w
        if each.shape[1] != self.synthesis_network.num_styles:
            raise ValueError(f"w must hold {self.synthesis_network.num_styles} styles, got {tuple(w.shape)}")
        return measured(self.measurement_model, self.synthesis_network(each, angles, shift), uniform, w)


def _check_multiple(resolution: tuple[int, ...]) -> None:
    if len(resolution) != 2 or any(size % 2**_LEVELS for size in resolution) or min(resolution) < 2 ** (_LEVELS + 1):
        raise ValueError(f"resolution must be two multiples of {2**_LEVELS}, at least twice that, got {resolution}")


def _conv3x3(in_channels: int, out_channels: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(Pad(1), EqualLR(nn.Conv2d(in_channels, out_channels, 3, stride=stride, bias=False)))


class ResidualBlock(nn.Module):
    """Halves an image: (B,in,H,W) -> (B,out,H/2,W/2); StyleGAN2's residual discriminator on a ring."""

    def __init__(self, in_channels: int, out_channels: int):
        super().__init__()
        self.conv1 = _conv3x3(in_channels, in_channels)
        self.bias_act1 = FusedLeakyReLU(in_channels)
        self.resample = Resample(BINOMIAL_4)
        self.conv2 = _conv3x3(in_channels, out_channels, stride=2)
        self.bias_act2 = FusedLeakyReLU(out_channels)
        self.skip = nn.Sequential(EqualLR(nn.Conv2d(in_channels, out_channels, 1, stride=2, bias=False)))

    def forward(self, x: Tensor) -> Tensor:
        h = self.resample(self.bias_act1(self.conv1(x)))
        h = self.bias_act2(self.conv2(h))
        return (h + self.skip(self.resample(x))) / math.sqrt(2)


def _halvings(resolution: tuple[int, int]) -> int:
    """How many blocks the discriminator has: log2(min(H,W)/4), rounded down, 4 for 64 rows."""
    return (min(resolution) // _COARSEST).bit_length() - 1


class Discriminator(nn.Module):
    """Images (B,1,H,W) -> logits (B,1), large = real. B must be below 4 or a multiple of 4 (statistics of groups).

    It halves an image until its shorter side is 4 pixels (up to 7, of sizes that are no power of 2); then come layers
    as wide as after 4 halvings, however many there were, as the published program has it written down.
    """

    def __init__(self, resolution: tuple[int, int] = (64, 512), base_channels: int = 32, max_channels: int = 512):
        super().__init__()
        _check_multiple(resolution)
        count = _halvings(resolution)
        widths = [min(base_channels << i, max_channels) for i in range(count + 1)]
        first = nn.Sequential(EqualLR(nn.Conv2d(2, widths[0], 1, bias=False)))
        blocks = [ResidualBlock(before, after) for before, after in pairwise(widths)]
        self.layers = nn.Sequential(BlurVH(), first, FusedLeakyReLU(widths[0]), *blocks)
        top = min(base_channels << _LEVELS, max_channels)
        pixels = math.prod(math.ceil(size / 2**count) for size in resolution)
        self.epilogue = nn.Sequential(
            MinibatchStdDev(),
            _conv3x3(widths[-1] + 1, top),
            FusedLeakyReLU(top),
            nn.Flatten(),
            EqualLR(nn.Linear(top * pixels, top, bias=False)),
            FusedLeakyReLU(top),
            EqualLR(nn.Linear(top, 1)),
        )

    def forward(self, image: Tensor) -> Tensor:
        return self.epilogue(self.layers(image))
