"""One network for any sensor: told known pixels and the geometry of the rays, it fills in the others in one step."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.networks.candidates import BEND, RANGE_CANDIDATES, REFLECTANCE_CANDIDATES, Candidates, candidates
from lidarsynth.networks.rays import Rays, decode_range, encode_range, steps_told

STEM = (4, 2)  # rows, columns of the patches that become channels
NOISES = 3  # per pixel, along a ring, in patches
INPUTS = 34
OUTPUTS = (RANGE_CANDIDATES + 2) + (REFLECTANCE_CANDIDATES + 1 + NOISES) + (1 + NOISES)
COHERENT = (2.0, 1.0)  # columns and rows over which the noise of returning is alike, standard deviation
PRIOR = 2.0  # score of the first guess before any training
# Of the code: from so near a hypothesis is taken as it is, 3 % of the range; from anywhere, in samples.
SNAP, ANYHOW = 0.01, 2.0


class Known(NamedTuple):
    """What is known of B images, (B, 1, H, W) each: metres, reflectance in [0, 1], and three masks.

    told: the pixel is known; returned: it is known and a return; lit: its reflectance is known too. Returned but not
    told: the ray meets a surface at that range, and whether it returns is to be found out, as in a simulator's scan.
    """

    metres: Tensor
    reflectance: Tensor
    told: Tensor
    returned: Tensor
    lit: Tensor


class Filled(NamedTuple):
    """code: range if the ray returns, in [-1, 1]; reflectance; logit: of returning. (B, 1, H, W) each.

    classes: logits of what the ray meets, (B, classes, H, W), where asked for.
    spread: how far the candidates lie from the chosen range, in metres, each by its share in the choice (B, 1, H, W);
    and `near` of the candidates (B, 4, H, W), where asked for. plain: the mean reflectance of what is known around.
    """

    code: Tensor
    reflectance: Tensor
    logit: Tensor
    classes: Tensor | None = None
    spread: Tensor | None = None
    near: Tensor | None = None
    plain: Tensor | None = None


class Block(nn.Module):
    """Normalise, silu, convolve twice, add: (B, C, H, W) -> (B, D, H, W); the width is a ring, the height has ends."""

    def __init__(self, channels: int, out: int, groups: int = 8):
        super().__init__()
        self.norm = nn.GroupNorm(groups, channels)
        self.first = nn.Conv2d(channels, out, 3, padding=(1, 0))
        self.second = nn.Conv2d(out, out, 3, padding=(1, 0))
        self.skip = Pointwise(channels, out) if channels != out else nn.Identity()
        nn.init.normal_(self.second.weight, std=0.1 / math.sqrt(9 * out))

    def forward(self, x: Tensor) -> Tensor:
        h = ring(_silu(self.norm(x)), 2)
        return self.skip(x) + self.second(_silu(self.first(h)))


def _silu(fresh: Tensor) -> Tensor:
    """`F.silu` of a tensor that nobody else has, in its own memory where no gradient asks for it."""
    return F.silu(fresh, inplace=not torch.is_grad_enabled())


class Pointwise(nn.Linear):
    """A 1 x 1 convolution of (B, C, H, W) in channels-last memory, as one matrix product."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class Halve(nn.Module):
    """(B, C, H, W) -> (B, D, H/2, W/2): patches of 2 x 2 through one matrix."""

    def __init__(self, channels: int, out: int):
        super().__init__()
        self.mix = nn.Linear(4 * channels, out)

    def forward(self, x: Tensor) -> Tensor:
        b, c, h, w = x.shape
        x = x.permute(0, 2, 3, 1).reshape(b, h // 2, 2, w // 2, 2 * c).transpose(2, 3).reshape(b, h // 2, w // 2, 4 * c)
        return self.mix(x).permute(0, 3, 1, 2)


def ring(x: Tensor, columns: int) -> Tensor:
    """(B, C, H, W) with `columns` of the other end on either side."""
    return torch.cat([x[..., -columns:], x, x[..., :columns]], -1)


class FillUNet(nn.Module):
    """`forward(known, rays, noise) -> Filled`, for any number of beams in multiples of 32 and columns of 16.

    noise (B, NOISES, H, W): zeros for the most likely image, which errs least; `draw_noise` for a sample, which has
    the grain of a recorded scan; lost: the noise of returning, where it is another;
    bend: of `candidates`. For each pixel the network chooses
    among `candidates` by a softmax, corrects the choice, and says whether the ray returns at all; and, if it has
    learned `classes`, of which class the surface is.
    In use, not in training, a choice closer than `reach` (of the code) to a candidate is that candidate, and ranges
    have no grain. Reflectances are compared as even beams would read them: what a beam loses (`dimness`) is added
    before, and taken off after.
    """

    def __init__(
        self,
        widths: tuple[int, ...] = (64, 96, 128, 160),
        blocks: tuple[int, ...] = (1, 1, 2, 2),
        classes: int = 0,
    ):
        super().__init__()
        patch = STEM[0] * STEM[1]
        self.stem = Pointwise(INPUTS * patch, widths[0])
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        for i, (width, count) in enumerate(zip(widths, blocks, strict=True)):
            self.down.append(nn.ModuleList(Block(width, width) for _ in range(count)))
            if i + 1 < len(widths):
                self.down.append(Halve(width, widths[i + 1]))
        for i in range(len(widths) - 2, -1, -1):
            self.up.append(Pointwise(widths[i + 1], widths[i]))
            joined = [2 * widths[i]] + [widths[i]] * (blocks[i] - 1)
            self.up.append(nn.ModuleList(Block(width, widths[i]) for width in joined))
        self.head = Pointwise(2 * widths[0], 2 * widths[0])
        self.out = Pointwise(2 * widths[0], OUTPUTS * patch)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)
        self.classes = Pointwise(2 * widths[0], classes * patch) if classes else None

    def forward(
        self,
        known: Known,
        rays: Rays,
        noise: Tensor,
        classify: bool = False,
        doubt: bool = False,
        reach: float = SNAP,
        lost: Tensor | None = None,
        bend: float = BEND,
    ) -> Filled:
        with torch.no_grad():
            even = (known.reflectance + rays.dimness) * known.lit
            guesses = candidates(known.metres, even, known.returned, known.lit, rays, bend)
            x = inputs(known, rays, guesses, noise)
        top = h = _of_patches(self.stem, x)
        kept = []
        for stage in self.down:
            if isinstance(stage, Halve):
                kept.append(h)
                h = stage(h)
            else:
                h = _through(stage, h)
        for join, stage in zip(self.up[::2], self.up[1::2], strict=True):
            h = F.interpolate(join(h), scale_factor=2, mode="nearest")
            h = _through(stage, torch.cat([h, kept.pop()], 1))
        h = F.silu(self.head(torch.cat([h, top], 1)))
        out = _to_pixels(self.out, h)
        filled, shares = _assemble(out, guesses, noise, noise if lost is None else lost, rays.dimness, self.training)
        if not self.training:
            filled = filled._replace(code=_snapped(filled.code, guesses, reach))
        if doubt:
            filled = filled._replace(spread=_spread(shares, filled.code, guesses), near=guesses.near)
        if not classify:
            return filled
        if self.classes is None:
            raise ValueError("expected a network that has learned classes, found one without")
        return filled._replace(classes=_to_pixels(self.classes, h))


def _through(blocks: nn.Module, h: Tensor) -> Tensor:
    assert isinstance(blocks, nn.ModuleList)
    for block in blocks:
        h = block(h)
    return h


def _assemble(
    out: Tensor, guesses: Candidates, noise: Tensor, lost: Tensor, dimness: Tensor, training: bool
) -> tuple[Filled, Tensor]:
    """The image, and the shares of the candidates in its ranges, (B, 10, H, W)."""
    scores, shift, grain, f_scores, f_shift, f_gain, logit, gain = out.split(
        [RANGE_CANDIDATES, 1, 1, REFLECTANCE_CANDIDATES, 1, NOISES, 1, NOISES], 1
    )
    shares = _shares(scores)
    code = (shares * guesses.code).sum(1, keepdim=True) + 0.1 * shift
    if training:  # the learned grain of ranges; in use a sensor's own noise is added in the end, which planes need
        code = code + 0.02 * grain * noise[:, :1]
    reflectance = (f_scores.softmax(1) * guesses.reflectance).sum(1, keepdim=True) + 0.2 * f_shift
    reflectance = reflectance + 0.2 * (f_gain * noise).sum(1, keepdim=True) - dimness
    logit = 2 * logit + 2 * (gain * lost).sum(1, keepdim=True) + 1.0
    return Filled(code, reflectance, logit, plain=guesses.reflectance[:, :1] - dimness), shares


def _snapped(code: Tensor, guesses: Candidates, reach: float) -> Tensor:
    """The nearest hypothesis where one is near, so that what is flat comes out flat: mixtures of several are rough."""
    away, which = (guesses.code - code).abs().min(1, keepdim=True)
    return torch.where(away < reach, guesses.code.gather(1, which), code)


def _shares(scores: Tensor) -> Tensor:
    prior = scores.new_zeros(RANGE_CANDIDATES, 1, 1)
    prior[1:3] = PRIOR
    return (scores + prior).softmax(1)


def _spread(shares: Tensor, code: Tensor, guesses: Candidates) -> Tensor:
    away = (decode_range(guesses.code) - decode_range(code)).abs()
    return (shares * away).sum(1, keepdim=True)


def inputs(known: Known, rays: Rays, guesses: Candidates, noise: Tensor) -> Tensor:
    """(B, INPUTS, H, W): what the network sees, each of about unit size."""
    told, returned, lit = (mask.float() for mask in (known.told, known.returned, known.lit))
    base = guesses.code[:, 2:3]
    ground = encode_range(rays.ground)
    others = 8 * (guesses.code[:, [0, 3, 4, 5, 6, 7, 8, 9]] - base)
    full = torch.ones_like(told)
    return torch.cat(
        [
            noise,
            told,
            returned,
            lit,
            2 * base,
            (8 * (base - ground)).clamp(-3, 3),
            others.clamp(-4, 4),
            2 * guesses.reflectance[:, :1] - 0.5,
            guesses.reflectance[:, 5:6] * 2 - 0.5,
            guesses.near,
            3 * rays.elevation.expand_as(told),
            ground.expand_as(told) * 2,
            *steps_told(rays, told),
            rays.blocked.expand_as(told),
            rays.inside.expand_as(told),
            10 * rays.dimness * full,
            4 * (guesses.reflectance[:, 1:5] - guesses.reflectance[:, :1]),
        ],
        1,
    )


def draw_noise(shape: tuple[int, int, int], rng: torch.Generator | None = None) -> Tensor:
    """(B, NOISES, H, W) unit Gaussians: independent, constant over 6 columns of a ring, over patches of 4 x 8."""
    batch, height, width = shape
    pixel = torch.randn(batch, 1, height, width, generator=rng)
    along = torch.randn(batch, 1, height, -(-width // 6), generator=rng).repeat_interleave(6, 3)[..., :width]
    patch = torch.randn(batch, 1, -(-height // 4), -(-width // 8), generator=rng)
    patch = patch.repeat_interleave(4, 2).repeat_interleave(8, 3)[:, :, :height, :width]
    return torch.cat([pixel, along, patch], 1)


def draw_coherent(shape: tuple[int, int, int], rng: torch.Generator | None = None) -> Tensor:
    """`draw_noise` whose pixels are alike around: what a ray meets, its neighbours meet too, or the sky."""
    noise = draw_noise(shape, rng)
    steps = torch.arange(-6.0, 7.0)
    along, down = (torch.exp(-0.5 * (steps / spread) ** 2) for spread in COHERENT)
    kernel = (down[:, None] * along) / (down.square().sum() * along.square().sum()).sqrt()
    pixel = F.pad(ring(noise[:, :1], 6), (0, 0, 6, 6), mode="reflect")
    return torch.cat([F.conv2d(pixel, kernel[None, None]), noise[:, 1:]], 1)


def _of_patches(matrix: Pointwise, x: Tensor) -> Tensor:
    """(B, C, H, W) -> (B, D, H / 4, W / 2): patches of `STEM` through one matrix (D, 8 C), of which each row has the
    pixels of a patch one after the other."""
    kernel = matrix.weight.view(len(matrix.weight), *STEM, x.shape[1]).permute(0, 3, 1, 2)
    return F.conv2d(x, kernel, matrix.bias, STEM)


def _to_pixels(matrix: Pointwise, x: Tensor) -> Tensor:
    """(B, D, H, W) -> (B, C, 4 H, 2 W), the inverse: a matrix (8 C, D), then patches as pixels, channel by channel."""
    (b, d, h, w), patch = x.shape, STEM[0] * STEM[1]
    by_channel = matrix.weight.view(patch, -1, d).transpose(0, 1).reshape(-1, d)
    bias = matrix.bias.view(patch, -1).t().reshape(-1, 1)
    runs = torch.addmm(bias, by_channel, x.permute(0, 2, 3, 1).reshape(-1, d).t())
    pixels = runs.view(-1, *STEM, b, h, w).permute(3, 0, 4, 1, 5, 2)
    return pixels.reshape(b, -1, h * STEM[0], w * STEM[1])
