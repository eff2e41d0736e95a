"""How far fills are off: absolute errors, and energy scores of two draws."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from lidarsynth.networks.fill_unet import Filled, Known
from lidarsynth.networks.rays import Rays, decode_range, encode_range

DARK = -0.15  # what the fill learns where a return reads 0
SEAM = 16  # columns at the ends of a crop that are not judged: beyond them its turn would go on


def absolute_errors(filled: Filled, known: Known, rays: Rays, metres: Tensor, reflectance: Tensor) -> Tensor:
    """(b,): of hidden returns, in code and metres, and of their reflectance; and the cross-entropy of returning.

    The absolute error has the median as its optimum, in metres and in any code alike.
    """
    inside, returned = rays.inside > 0, metres > 0
    hidden = ~known.told & inside
    sought = hidden & returned & ~known.returned
    code = mean_of((filled.code - encode_range(metres)).abs(), sought)
    far = mean_of((decode_range(filled.code) - metres).abs(), sought)
    shade = mean_of((filled.reflectance - _dark(reflectance, returned)).abs(), ~known.lit & inside & returned)
    drop = mean_of(F.binary_cross_entropy_with_logits(filled.logit, returned.float(), reduction="none"), hidden)
    return 2 * code + 0.1 * far + 6 * shade + 0.5 * drop


def expected_errors(filled: Filled, known: Known, rays: Rays, metres: Tensor, reflectance: Tensor) -> Tensor:
    """(b,): errors of hidden pixels as they are judged, where an empty one counts as 0 m and reflects nothing, by the
    chance of returning; with those of `absolute_errors`, less of each.

    So what may as well be empty is nearer, and is empty where that errs less.
    """
    inside, returned = rays.inside > 0, metres > 0
    hidden = ~known.told & ~known.returned & inside
    chance, far = torch.sigmoid(2 * filled.logit), decode_range(filled.code)
    off = torch.where(returned, chance * (far - metres).abs() + (1 - chance) * metres, chance * far)
    dark = (filled.reflectance - reflectance).abs()
    shade = torch.where(returned, chance * dark + (1 - chance) * reflectance, chance * filled.reflectance.abs())
    code = mean_of((filled.code - encode_range(metres)).abs(), hidden & returned)
    lit = mean_of(dark, ~known.lit & inside & returned)
    drop = mean_of(F.binary_cross_entropy_with_logits(filled.logit, returned.float(), reduction="none"), hidden)
    return 1.5 * code + 0.25 * mean_of(off, hidden) + 4 * mean_of(shade, hidden) + 3 * lit + 0.35 * drop


def _dark(reflectance: Tensor, returned: Tensor) -> Tensor:
    """Reflectance with DARK in the place of 0, so that draws of it, which are cut at 0, are often 0."""
    return torch.where(returned & (reflectance <= 0), DARK, reflectance)


def misnamed(filled: Filled, rays: Rays, classes: Tensor) -> Tensor:
    """(b,): cross-entropy of the classes (b, 1, H, W) of all pixels of which somebody has said one."""
    assert filled.classes is not None
    entropy = F.cross_entropy(filled.classes, classes[:, 0], reduction="none")[:, None]
    return mean_of(entropy, (classes > 0) & (rays.inside > 0))


def lovasz(logits: Tensor, label: Tensor) -> Tensor:
    """The Lovasz-softmax (Berman et al. 2018) of logits (N, C) and classes (N,), mean over the classes there: as good
    as 1 - IoU, so that rare classes count as much as others. 0 for no pixel."""
    chances, losses = logits.softmax(1), [logits.sum() * 0]
    for k in label.unique().tolist():
        own = (label == k).float()
        errors, order = (own - chances[:, k]).abs().sort(descending=True)
        own = own[order]
        jaccard = 1 - (own.sum() - own.cumsum(0)) / (own.sum() + (1 - own).cumsum(0))
        losses.append((errors * torch.cat([jaccard[:1], jaccard.diff()])).sum())
    return torch.stack(losses).sum() / max(len(losses) - 1, 1)


def mean_of(values: Tensor, mask: Tensor) -> Tensor:
    """(b,) means over `mask`, but for the crop's ends."""
    values, mask = values[..., SEAM:-SEAM], mask[..., SEAM:-SEAM]
    return (values * mask).sum((1, 2, 3)) / mask.sum((1, 2, 3)).clamp_min(1)


def joined(filled: Filled, known: Known, rays: Rays) -> Tensor:
    """What energy scores compare, (b, 3, H, W): returns, range and reflectance, with known pixels as they are."""
    share = torch.where(known.told, known.returned.float(), filled.logit.sigmoid())
    code = torch.where(known.returned, encode_range(known.metres), filled.code)
    shade = torch.where(known.lit, _dark(known.reflectance, known.lit), filled.reflectance)
    return _comparable(share, code, shade, rays)


def truth(metres: Tensor, reflectance: Tensor, rays: Rays) -> Tensor:
    """`joined` of what was measured."""
    returned = metres > 0
    return _comparable(returned.float(), encode_range(metres), _dark(reflectance, returned), rays)


def _comparable(share: Tensor, code: Tensor, shade: Tensor, rays: Rays) -> Tensor:
    x = torch.cat([2 * share - 1, 3 * share * (code - encode_range(rays.ground)), 3 * share * shade], 1)
    return (x * (rays.inside > 0))[..., SEAM:-SEAM]


def energy_score(first: Tensor, second: Tensor, truth: Tensor) -> Tensor:
    """(b,): E|X - y| - E|X - X'| / 2 of two draws, lowest when draws are distributed as the truth (Gneiting & Raftery
    2007), summed over pixels and patches of values, and of differences to the next pixel along a ring and below, for
    texture."""
    total = truth.new_zeros(len(truth))
    for size, weight in (((1, 1), 1.0), ((2, 4), 1.0), ((8, 16), 0.5)):
        total = total + weight * _score(first, second, truth, size)
    for a, b, y in zip(*map(_differences, (first, second, truth)), strict=True):
        for size in ((1, 1), (2, 8)):
            total = total + 0.5 * _score(a, b, y, size)
    return total


def _score(first: Tensor, second: Tensor, truth: Tensor, size: tuple[int, int]) -> Tensor:
    to_truth = (_distance(first, truth, size) + _distance(second, truth, size)) / 2
    return to_truth - _distance(first, second, size) / 2


def _distance(a: Tensor, b: Tensor, size: tuple[int, int]) -> Tensor:
    """(b,): Euclidean distances of patches, on average."""
    squares = (a - b).square().sum(1, keepdim=True)
    if size != (1, 1):
        squares = F.avg_pool2d(squares, size)
    return (squares + 1e-6).sqrt().mean((1, 2, 3))


def _differences(x: Tensor) -> tuple[Tensor, Tensor]:
    """Steps along a ring and to the beam below, of range (small ones stretched) and reflectance."""
    steps = x[:, 1:, :, 1:] - x[:, 1:, :, :-1], x[:, 1:, 1:] - x[:, 1:, :-1]
    along, down = (torch.cat([torch.asinh(12 * d[:, :1]) / 2, d[:, 1:]], 1) for d in steps)
    return along, down
