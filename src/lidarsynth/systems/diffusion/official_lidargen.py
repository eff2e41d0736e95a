"""LiDARGen's official checkpoints: the list [model, optimizer, epoch, step, moving average] (Zyrianov et al. 2022)."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor, nn

from lidarsynth.experiment.presets import lidargen
from lidarsynth.experiment.record import Card, Experiment
from lidarsynth.networks.refinenet import from_official, geometric_sigmas

STEP_LR = 6.2e-6  # of the published program: a Langevin step is so much times (sigma / sigma_last)^2


def belongs(checkpoint: object) -> bool:
    """Whether this is a list of four or five parts; no other system saves lists."""
    return isinstance(checkpoint, list) and len(checkpoint) in (4, 5)


def read(checkpoint: Any, name: str, ema: bool = True) -> tuple[Experiment, nn.Module]:
    """The experiment, called `name`, and the network of a checkpoint; width and noise levels are those of its tensors.

    ema  the moving average, where the list has one (True), or the raw weights

    Raises ValueError for tensors that are not of LiDARGen's network, or noise levels that do not fall geometrically.
    """
    network = from_official(checkpoint, ema, unit_range=False)
    if network.channels != 2:
        raise ValueError(f"expected LiDARGen's begin_conv.weight for range, reflectance and two coordinates, "
                         f"found {tuple(network.begin_conv.weight.shape)}")  # fmt: skip
    preset = lidargen()
    assert preset.score is not None
    score = dataclasses.replace(preset.score, **_levels(network.sigmas))
    model = dataclasses.replace(preset.model, base_channels=network.begin_conv.out_channels)
    card = Card(
        "CC BY-NC-SA 3.0, that of KITTI-360", "KITTI-360", (f"official LiDARGen checkpoint, {checkpoint[3]} steps",)
    )
    return dataclasses.replace(preset, name=name, model=model, score=score, card=card), network


def _levels(sigmas: Tensor) -> dict[str, Any]:
    """The fields of Score that give these noise levels (L,)."""
    first, last = (float(f"{float(sigma):.6g}") for sigma in (sigmas[0], sigmas[-1]))  # float32 to the number in print
    expected = "expected noise levels `sigmas` that fall geometrically"
    if len(sigmas) < 2 or not 0 < last < first:
        raise ValueError(f"{expected}, found {len(sigmas)} from {first:g} to {last:g}")
    if not torch.allclose(sigmas, geometric_sigmas(len(sigmas), first, last), rtol=1e-4, atol=0):
        raise ValueError(f"{expected}, found {sigmas[:3].tolist()}")
    return {"levels": len(sigmas), "sigma_max": first, "sigma_min": last, "rate": float(f"{STEP_LR / last**2:.6g}")}
