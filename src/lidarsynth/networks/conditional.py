"""A U-Net that is told the known pixels: one network that generates, completes and upsamples."""

import torch
from torch import Tensor, nn

from lidarsynth.networks.efficient_unet import EfficientUNet
from lidarsynth.networks.interpolation import fill_in, nearest_along_axes, nearest_around

CANDIDATES = 6  # interpolation, left, right, above, below, nothing returned
RADIUS = 8  # pixels, of a seventh: the nearest in any direction, where points are scattered


class ConditionalUNet(nn.Module):
    """Feeds `[x_t, known, mask, fill_in(known, mask)]` to a U-Net, whose output corrects what is known of the pixel.

    `unet` takes four times as many channels as it gives, C. It corrects the interpolation of the known pixels. If it
    gives C + 6 C channels, the other 6 C choose, by a softmax per channel and pixel, what is corrected: the
    interpolation, one of the nearest known values (left, right, above, below), or -1, nothing returned; so that an edge
    is where one candidate gives way to another, and not a slope between them. With C + 7 C channels it chooses the
    nearest known value in any direction too, within 8 pixels.

    Its last layer starts at zero, so an untrained network returns (nearly, with candidates) the interpolation of the
    known pixels; where nothing is known it predicts all of x_0.

    Example:
        >>> unet = EfficientUNet(in_channels=8, resolution=(64, 1024), base_channels=48, stem=(2, 4))
        >>> prediction = ConditionalUNet(unet)(x_t, log_snr, known, mask)  # (B,2,64,1024), to be read as x_0
    """

    def __init__(self, unet: EfficientUNet):
        super().__init__()
        channels = unet.in_channels // 4
        possible = [channels * count for count in (1, 1 + CANDIDATES, 2 + CANDIDATES)]
        if unet.in_channels % 4 or unet.out_channels not in possible:
            raise ValueError(
                f"unet must have in_channels = 4 C and out_channels = C, {1 + CANDIDATES} C or {2 + CANDIDATES} C, "
                f"got {unet.in_channels} and {unet.out_channels}"
            )
        self.unet = unet

    def forward(self, x_t: Tensor, log_snr: Tensor, known: Tensor | None = None, mask: Tensor | None = None) -> Tensor:
        """Prediction (B,C,H,W) for noisy `x_t` (B,C,H,W) at `log_snr` (B,) or 0-d.

        `known` (B,C,H,W) holds clean values in [-1,1] where `mask` (B,C,H,W) is 1 and anything where it is 0, the mask
        per channel; samples with and without known pixels can share a batch. Without both: pure generation.
        Raises ValueError for other shapes, or if only one of the two is given.
        """
        if known is None and mask is None:
            known = mask = fill = torch.zeros_like(x_t)
        else:
            known, mask = _check(x_t, known, mask)
            fill = fill_in(known, mask)
        output = self.unet(torch.cat([x_t, known, mask, fill], dim=1), log_snr)
        if self.unet.out_channels == x_t.shape[1]:
            return output + fill
        correction, scores = output.float().split([x_t.shape[1], output.shape[1] - x_t.shape[1]], dim=1)
        return correction + _chosen(scores.unflatten(1, (-1, x_t.shape[1])), known, mask, fill)


def _chosen(scores: Tensor, known: Tensor, mask: Tensor, fill: Tensor) -> Tensor:
    """Mean (B,C,H,W) of the candidates by `scores` (B,6 or 7,C,H,W); 0 where a channel has no known pixel."""
    values, found = nearest_along_axes(known, mask)
    some = mask.flatten(2).any(2)[:, :, None, None].expand(known.shape)
    candidates = [fill, *values, torch.full_like(fill, -1)]
    possible = [torch.ones_like(some), *found, some]
    if scores.shape[1] > CANDIDATES:
        around, near = nearest_around(known, mask, RADIUS)
        candidates.append(around)
        possible.append(near)
    prior = scores.new_tensor([3.0] + [0.0] * (scores.shape[1] - 1))[:, None, None, None]
    weights = (scores + prior).masked_fill(~torch.stack(possible, dim=1), -torch.inf).softmax(dim=1)
    return (weights * torch.stack(candidates, dim=1)).sum(dim=1)


def _check(x_t: Tensor, known: Tensor | None, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Both in the type of x_t, unknown pixels 0 whatever they were (NaN too)."""
    for name, tensor in (("known", known), ("mask", mask)):
        if tensor is None or tensor.shape != x_t.shape:
            found = None if tensor is None else tuple(tensor.shape)
            raise ValueError(f"{name} must have the shape of x_t, {tuple(x_t.shape)}, got {found}")
    assert known is not None and mask is not None
    mask = mask != 0
    return torch.where(mask, known, 0).to(x_t.dtype), mask.to(x_t.dtype)
