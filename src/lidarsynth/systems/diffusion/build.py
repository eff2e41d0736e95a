"""An experiment's U-Net, RefineNet or conditional U-Net, and the denoiser around it."""

from __future__ import annotations

import torch
from torch import nn

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.schedule import SCHEDULES, Schedule, ve
from lidarsynth.experiment.record import Experiment, Score
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.conditional import CANDIDATES, ConditionalUNet
from lidarsynth.networks.efficient_unet import EfficientUNet
from lidarsynth.networks.refinenet import RefineNet, geometric_sigmas
from lidarsynth.systems.sizes import check_refinenet, check_stem, check_unet


def efficient_unet(
    experiment: Experiment, sensor: Sensor, in_channels: int = 2, out_channels: int = 2
) -> EfficientUNet:
    """R2DM's U-Net with the sensor's ray angles."""
    model = experiment.model
    check_unet(model)
    check_stem(model, sensor)
    unet = EfficientUNet(
        in_channels=in_channels,
        out_channels=out_channels,
        resolution=(sensor.height, sensor.width),
        base_channels=model.base_channels,
        temb_channels=model.temb_channels,
        channel_multipliers=model.channel_multipliers,
        num_residual_blocks=model.num_residual_blocks,
        gn_num_groups=model.gn_num_groups,
        gn_eps=model.gn_eps,
        attn_num_heads=model.attn_num_heads,
        coords_encoding=model.coords_encoding,
        ring=model.ring,
        stem=model.stem,
        dropout=model.dropout,
    )
    unet.coords.copy_(torch.from_numpy(sensor.ray_angles())[None])
    return unet


def refinenet(experiment: Experiment, sensor: Sensor) -> RefineNet:
    """For images in [-1, 1]: with a score group the published score network, else a noise predictor."""
    score, width = experiment.score or Score(), experiment.model.base_channels
    _check_score(score)
    if width < 2:  # channels are normalised by how their means differ
        raise ValueError(f"model.base_channels: expected at least 2 for refinenet, found {width}")
    check_refinenet(experiment.model.network, sensor)
    divide = experiment.diffusion.kind == "score"
    network = RefineNet(2, width, score.levels, unit_range=False, divide=divide)
    network.sigmas.copy_(geometric_sigmas(score.levels, score.sigma_max, score.sigma_min))
    return network


def _check_score(score: Score) -> None:
    if not 0 < score.sigma_min < 0.5 <= score.sigma_max:  # of data in [0, 1], which the noise has to cover
        raise ValueError("score.sigma_min, score.sigma_max: expected 0 < sigma_min < 0.5 <= sigma_max, found "
                         f"{score.sigma_min:g} and {score.sigma_max:g}")  # fmt: skip


def conditional_unet(experiment: Experiment, sensor: Sensor) -> ConditionalUNet:
    """The same network, told the known pixels."""
    model = experiment.model
    return ConditionalUNet(
        efficient_unet(experiment, sensor, 8, 2 * (1 + CANDIDATES + model.around) if model.candidates else 2)
    )


def build_denoiser(experiment: Experiment, network: nn.Module) -> Denoiser:
    """The network with the experiment's schedule and kind."""
    diffusion = experiment.diffusion
    if diffusion.schedule not in SCHEDULES:
        raise ValueError(f"diffusion.schedule: expected one of {', '.join(SCHEDULES)}, found {diffusion.schedule!r}")
    return Denoiser(network, _schedule(experiment), diffusion.kind, diffusion.clip)


def _schedule(experiment: Experiment) -> Schedule:
    """Images here lie in [-1, 1], twice as wide as those of the score group, and so are its noise levels."""
    if experiment.score is None:
        return SCHEDULES[experiment.diffusion.schedule]()
    if experiment.diffusion.schedule != "ve":
        raise ValueError(f"diffusion.schedule: expected ve beside a score group, found {experiment.diffusion.schedule}")
    _check_score(experiment.score)
    return ve(2 * experiment.score.sigma_min, 2 * experiment.score.sigma_max)
