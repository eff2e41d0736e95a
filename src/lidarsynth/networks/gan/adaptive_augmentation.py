"""Adaptive discriminator augmentation of one-channel images on a ring (StyleGAN2-ADA, Karras et al. 2020).

Every transform is a 3x3 matrix on pixel coordinates, x right and y down from the image centre, and a 4x4 matrix on
colours; all of them are differentiable in the image.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.networks.gan.grid_sampling import sample_bilinear

# Daubechies' least asymmetric wavelets with 2 and 6 vanishing moments; either sums to sqrt(2).
SYM2 = (-0.12940952255092145, 0.22414386804185735, 0.836516303737469, 0.48296291314469025)
SYM6 = (
    *(0.015404109327027373, 0.0034907120842174702, -0.11799011114819057, -0.048311742585633),
    *(0.4910559419267466, 0.787641141030194, 0.3379294217276218, -0.07263752278646252),
    *(-0.021060292512300564, 0.04472490177066578, 0.0017677118642428036, -0.007800708325034148),
)
_MARGIN = len(SYM6) // 4  # pixels that the filters reach beyond the image


class Dice(NamedTuple):
    """The random numbers that an image's transforms are made from, of B images; rolled by `roll_dice`."""

    gate: Tensor  # (B,8) in [0,1): a transform is applied where its number is below the probability
    uniform: Tensor  # (B,5) in [0,1): flip along x, flip along y, whole-pixel shift x and y, inversion
    normal: Tensor  # (B,5) ~ N(0,1): vertical scale, shift x and y, brightness, contrast


def roll_dice(count: int, generator: torch.Generator) -> Dice:
    """Dice of `count` images, on the device of the generator."""
    device = generator.device
    return Dice(
        torch.rand(count, 8, generator=generator, device=device),
        torch.rand(count, 5, generator=generator, device=device),
        torch.randn(count, 5, generator=generator, device=device),
    )


class AdaptiveAugmentation(nn.Module):
    """Augments images with a probability `p` that follows how sure the discriminator is of real images.

    Call `observe` with the logits of every real batch and `adapt` now and then; `p` moves towards the value where
    the mean sign of the logits is `target`, at most by 1 in `images_to_one` images, within [0, p_max].
    """

    p: Tensor
    sign_cum: Tensor
    n_pred_cum: Tensor

    def __init__(self, p: float = 0.0, target: float = 0.6, images_to_one: int = 500_000, p_max: float = 0.9):
        super().__init__()
        self.target, self.images_to_one, self.p_max = target, images_to_one, p_max
        self.register_buffer("p", torch.tensor(float(p)))
        self.register_buffer("sign_cum", torch.zeros(1))
        self.register_buffer("n_pred_cum", torch.zeros(1))
        self.register_buffer("Hz_fbank", octave_filters())  # official checkpoints hold it; the runs filter nothing

    def forward(self, images: Tensor, dice: Dice) -> Tensor:
        """Images (B,1,H,W) -> augmented images, same shape; an image's own dice decide on it."""
        affine = random_affine(images, self.p, dice)
        return transform_colour(transform_geometry(images, affine), random_colour(images, self.p, dice))

    @torch.no_grad()
    def observe(self, logits_real: Tensor) -> None:
        """Adds up the signs of logits of real images, any shape."""
        self.sign_cum += logits_real.sign().sum()
        self.n_pred_cum += logits_real.numel()

    @torch.no_grad()
    def adapt(self) -> Tensor:
        """Moves `p` by what was observed since the last call, forgets it, and returns the mean sign r_t, (1,).

        Raises ValueError if nothing was observed.
        """
        if not self.n_pred_cum.item():
            raise ValueError("adapt needs logits observed since its last call, got none")
        mean_sign = self.sign_cum / self.n_pred_cum
        step = torch.sign(mean_sign - self.target) * self.n_pred_cum / self.images_to_one
        self.p.copy_((self.p + step[0]).clamp(0, self.p_max))
        self.sign_cum.zero_()
        self.n_pred_cum.zero_()
        return mean_sign


def octave_filters() -> Tensor:
    """Four band-pass filters of 43 taps, low to high, that add up to the identity: (4,43). StyleGAN2-ADA appendix B."""
    low = torch.tensor(SYM2, dtype=torch.float64)
    high = low * torch.tensor([1.0, -1.0, 1.0, -1.0], dtype=torch.float64)
    low2, high2 = (_convolve(taps[None], taps.flip(0))[0] / 2 for taps in (low, high))
    bands = torch.zeros(4, 1, dtype=torch.float64)
    bands[0] = 1
    for i in range(1, 4):
        spread = torch.stack([bands, torch.zeros_like(bands)], dim=2).flatten(1)[:, :-1]
        bands = _convolve(spread, low2)
        start = (bands.shape[1] - len(high2)) // 2
        bands[i, start : start + len(high2)] += high2
    return bands.float()


def _convolve(rows: Tensor, taps: Tensor) -> Tensor:
    return F.conv1d(rows[:, None], taps.flip(0)[None, None], padding=len(taps) - 1)[:, 0]


def transform_geometry(images: Tensor, affine: Tensor) -> Tensor:
    """Moves image content by `affine` (B,3,3), on pixels from the centre: (B,C,H,W) -> (B,C,H,W), little aliasing.

    Circular along the width, mirrored beyond the height. Doubled with a wavelet, sampled, halved with it again.
    """
    height, width = images.shape[2:]
    inverse = torch.linalg.inv(affine)
    x0, y0, x1, y1 = _margins(inverse, height, width)
    images = F.pad(images, (x0, x1, 0, 0), mode="circular")
    images = F.pad(images, (0, 0, y0, y1), mode="reflect")
    inverse = _translation((x0 - x1) / 2, (y0 - y1) / 2, inverse) @ inverse
    images = _double(images)
    inverse = _scaling(2, 2, inverse) @ inverse @ _scaling(1 / 2, 1 / 2, inverse)
    # the wavelet is half a fine pixel off centre
    inverse = _translation(-0.5, -0.5, inverse) @ inverse @ _translation(0.5, 0.5, inverse)
    size = [*images.shape[:2], 2 * (height + 2 * _MARGIN), 2 * (width + 2 * _MARGIN)]
    to_grid = _scaling(2 / images.shape[3], 2 / images.shape[2], inverse)
    grid = F.affine_grid((to_grid @ inverse @ _scaling(size[3] / 2, size[2] / 2, inverse))[:, :2], size, False)
    return _halve(sample_bilinear(images, grid))


def _margins(inverse: Tensor, height: int, width: int) -> list[int]:
    """Pixels to add left, above, right, below so that all transformed corners lie inside with the filter's reach."""
    cx, cy = (width - 1) / 2, (height - 1) / 2
    corners = inverse.new_tensor([[-cx, -cy, 1], [cx, -cy, 1], [cx, cy, 1], [-cx, cy, 1]])
    reach = (inverse @ corners.T)[:, :2].transpose(0, 1).flatten(1)  # (x and y, B*4)
    reach = torch.cat([-reach, reach]).amax(1) + inverse.new_tensor([2 * _MARGIN - cx, 2 * _MARGIN - cy]).repeat(2)
    limit = inverse.new_tensor([width - 1, height - 1]).repeat(2)
    return [int(value) for value in torch.minimum(reach.clamp(min=0), limit).ceil().tolist()]


def _double(x: Tensor) -> Tensor:
    """Zero insertion, zeros beyond the ends, convolution: (B,C,H,W) -> (B,C,2H,2W), a constant c becomes c/2."""
    taps = x.new_tensor(SYM6)
    for dim in (3, 2):
        stride = (1, 2) if dim == 3 else (2, 1)
        full = F.conv_transpose2d(x, _depthwise(taps, x, dim), stride=stride, groups=x.shape[1])
        x = full.narrow(dim, len(SYM6) // 2 - 1, 2 * x.shape[dim])
    return x


def _halve(x: Tensor) -> Tensor:
    """Correlation and decimation; drops the margin: (B,C,2(H+6),2(W+6)) -> (B,C,H,W), a constant c becomes 2c."""
    taps = x.new_tensor(SYM6)
    x = x[:, :, 1:-1, 1:-1]
    for dim in (3, 2):
        stride = (1, 2) if dim == 3 else (2, 1)
        x = F.conv2d(x, _depthwise(taps, x, dim), stride=stride, groups=x.shape[1])
    return x


def _depthwise(taps: Tensor, x: Tensor, dim: int) -> Tensor:
    return taps.expand(x.shape[1], 1, -1).unsqueeze(2 if dim == 3 else 3)


def _translation(x: float, y: float, like: Tensor) -> Tensor:
    return like.new_tensor([[1, 0, x], [0, 1, y], [0, 0, 1]])


def _scaling(x: float, y: float, like: Tensor) -> Tensor:
    return like.new_tensor([[x, 0, 0], [0, y, 0], [0, 0, 1]])


def transform_colour(images: Tensor, colour: Tensor) -> Tensor:
    """Images (B,1,H,W) taken as grey, times colour matrices (B,4,4), back to grey.

    That is x * sum(c[:3]) + c[3], c the mean of the first three rows. Raises ValueError for more than one channel.
    """
    if images.shape[1] != 1:
        raise ValueError(f"images must be (B, 1, H, W), got {tuple(images.shape)}")
    row = colour[:, :3].mean(1)
    return images * row[:, :3].sum(1).view(-1, 1, 1, 1) + row[:, 3].view(-1, 1, 1, 1)


def random_affine(images: Tensor, p: Tensor, dice: Dice) -> Tensor:
    """Flips, whole-pixel shift, vertical scaling, shift, each with probability p, for images (B,1,H,W): (B,3,3)."""
    batch, _, height, width = images.shape
    size = images.new_tensor([width, height])
    gate, uniform, normal = (part.to(images).split(1, dim=1) for part in dice)
    flip_x, flip_y = (1 - 2 * torch.where(gate[i] < p, (uniform[i] < 0.5).to(images), 0.0) for i in (0, 1))
    whole = torch.where(gate[2] < p, ((torch.cat(uniform[2:4], 1) * 2 - 1) * 0.125 * size).round(), 0.0)
    scale = torch.where(gate[3] < p, torch.exp2(normal[0] * 0.2), 1.0)
    shift = torch.where(gate[4] < p, torch.cat(normal[1:3], 1) * 0.125 * size, 0.0)
    one = torch.ones_like(scale)
    flips = torch.cat([flip_x, flip_y], 1)
    scales = torch.cat([one, scale], 1)
    # shift after scale after whole shift after flips, each multiplied from the left
    affine = torch.eye(3, dtype=images.dtype, device=images.device).repeat(batch, 1, 1)
    affine[:, :2, :2] = torch.diag_embed(scales * flips)
    affine[:, :2, 2] = scales * whole + shift
    return affine


def random_colour(images: Tensor, p: Tensor, dice: Dice) -> Tensor:
    """Brightness, contrast and inversion, each with probability p: (B,4,4). Hue and saturation leave grey as it is."""
    gate, uniform, normal = (part.to(images).split(1, dim=1) for part in dice)
    brightness = torch.where(gate[5] < p, normal[3] * 0.2, 0.0)
    contrast = torch.where(gate[6] < p, torch.exp2(normal[4] * 0.5), 1.0)
    flip = torch.where(gate[7] < p, (uniform[4] < 0.5).to(images), 0.0)
    grey = images.new_tensor([1.0, 1.0, 1.0, 0.0]) / math.sqrt(3)
    mirror = torch.eye(4, dtype=images.dtype, device=images.device) - 2 * torch.outer(grey, grey) * flip[:, :, None]
    colour = torch.diag_embed(torch.cat([contrast.expand(-1, 3), torch.ones_like(contrast)], 1))
    colour[:, :3, 3] = contrast * brightness
    return mirror @ colour
