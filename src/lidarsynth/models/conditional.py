"""A U-Net that is told the known pixels: one network that generates, completes and upsamples."""

import torch
from torch import Tensor, nn

from lidarsynth.models.efficient_unet import EfficientUNet
from lidarsynth.models.interpolation import fill_in


class ConditionalUNet(nn.Module):
    """Feeds `[x_t, known, mask, fill_in(known, mask)]` to a U-Net and adds the interpolation to what it returns.

    `unet` takes four times as many channels as it gives. Its last layer starts at zero, so an untrained network returns
    the interpolation of the known pixels; a trained one predicts what interpolation misses, and all of x_0 where
    nothing is known.

    Example:
        >>> unet = EfficientUNet(in_channels=8, resolution=(64, 1024), base_channels=48, stem=(2, 4))
        >>> prediction = ConditionalUNet(unet)(x_t, log_snr, known, mask)  # (B,2,64,1024), to be read as x_0
    """

    def __init__(self, unet: EfficientUNet):
        super().__init__()
        if unet.in_channels != 4 * unet.out_channels:
            raise ValueError(
                f"unet must have in_channels = 4 * out_channels = {4 * unet.out_channels}, got {unet.in_channels}"
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
        return self.unet(torch.cat([x_t, known, mask, fill], dim=1), log_snr) + fill


def _check(x_t: Tensor, known: Tensor | None, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Both in the type of x_t, unknown pixels 0 whatever they were (NaN too)."""
    for name, tensor in (("known", known), ("mask", mask)):
        if tensor is None or tensor.shape != x_t.shape:
            found = None if tensor is None else tuple(tensor.shape)
            raise ValueError(f"{name} must have the shape of x_t, {tuple(x_t.shape)}, got {found}")
    assert known is not None and mask is not None
    mask = mask != 0
    return torch.where(mask, known, 0).to(x_t.dtype), mask.to(x_t.dtype)
