"""A diffusion model as one module, for its own images: completion in one step, or one denoising step."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lidarsynth.diffusion.samplers import ddim
from lidarsynth.lidar.depth import decode, encode
from lidarsynth.systems.diffusion.model import LidarModel
from lidarsynth.systems.graph import Graph

SAYS = {
    "range": "metres, 0 where nothing returned or nothing is known",
    "reflectance": "0 to 1; 0 everywhere where there is none, and then filled in too",
    "known": "1 where the pixel is known, also to be empty; else 0",
    "noise": "unit Gaussian numbers; another draw, another scan",
    "x_t": "noisy images of range code and reflectance in [-1, 1]",
    "log_snr": "logarithm of the signal-to-noise ratio of x_t",
}


class CompletionGraph(nn.Module):
    """(range, reflectance, known (1, 1, H, W), noise (1, 2, H, W)) -> range, reflectance, filled.

    Mixed pixels stay as the network leaves them.
    """

    def __init__(self, model: LidarModel):
        super().__init__()
        self.model, self.network = model, model.network

    def forward(self, range: Tensor, reflectance: Tensor, known: Tensor, noise: Tensor) -> tuple[Tensor, ...]:
        sensor, codec = self.model.sensor, self.model.experiment.data.codec
        told = known > 0.5
        lit = (torch.where(told, reflectance, 0.0) > 0).flatten(1).any(1)[:, None, None, None]
        x_0 = 2 * torch.cat([encode(range, sensor, codec), reflectance], 1) - 1
        mask = torch.cat([told, told & lit], 1)
        times = torch.ones(1), torch.zeros(1)
        x_s, _ = ddim(self.model.denoiser.given(x_0, mask), noise, *times, torch.zeros_like)
        unit = (x_s.clamp(-1, 1) + 1) / 2
        metres = decode(unit[:, :1], sensor, codec)
        returns = (told & (range > 0)) | (~told & (metres > 0))
        full = torch.where(returns, torch.where(told, range, metres), 0.0)
        light = torch.where(returns, torch.where(told & lit, reflectance, unit[:, 1:]), 0.0)
        return full, light


def completion_graph(model: LidarModel, open_columns: bool) -> Graph:
    """Completion in one step. Raises ValueError where columns must be open."""
    _refuse_open(model, open_columns)
    shape = (1, 1, model.sensor.height, model.sensor.width)
    example = {name: torch.zeros(shape) for name in ("range", "reflectance", "known")}
    example["known"][:, :, ::4] = 1
    example["noise"] = torch.randn((1, 2, *shape[2:]), generator=torch.Generator().manual_seed(0))
    outputs = ("filled_range", "filled_reflectance")
    return Graph("completion in one step", CompletionGraph(model).eval(), example, outputs, SAYS)


class StepGraph(nn.Module):
    """(x_t (1, 2, H, W), log_snr (1,)) -> the network's raw prediction (1, 2, H, W)."""

    def __init__(self, model: LidarModel):
        super().__init__()
        self.network = model.network

    def forward(self, x_t: Tensor, log_snr: Tensor) -> tuple[Tensor]:
        return (self.network(x_t, log_snr),)


def step_graph(model: LidarModel, open_columns: bool) -> Graph:
    """One denoising step: the raw prediction. Raises ValueError where columns must be open."""
    _refuse_open(model, open_columns)
    rng, shape = torch.Generator().manual_seed(0), (1, 2, model.sensor.height, model.sensor.width)
    says = SAYS | {"prediction": f"the network's {model.denoiser.kind}"}
    example = {"x_t": torch.randn(shape, generator=rng), "log_snr": torch.zeros(1)}
    return Graph("one denoising step", StepGraph(model).eval(), example, ("prediction",), says)


def _refuse_open(model: LidarModel, open_columns: bool) -> None:
    if open_columns:
        raise ValueError(f"{model.experiment.name}: expected a cascade, such as default, for any number of columns, "
                         "found a network of fixed images; leave --any-columns out")  # fmt: skip
