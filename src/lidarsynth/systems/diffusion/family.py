"""What R2DM's U-Net, the one that is told the known pixels, and LiDARGen's RefineNet bring."""

from __future__ import annotations

from dataclasses import replace

from torch import nn

from lidarsynth.experiment.record import Experiment
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.systems.diffusion import official_lidargen
from lidarsynth.systems.diffusion.build import build_denoiser, conditional_unet, efficient_unet, refinenet
from lidarsynth.systems.diffusion.description import DESCRIPTION
from lidarsynth.systems.diffusion.finetune import transfer
from lidarsynth.systems.diffusion.graph import completion_graph, step_graph
from lidarsynth.systems.diffusion.model import LidarModel
from lidarsynth.systems.diffusion.score_matching import SCORE
from lidarsynth.systems.diffusion.training import DIFFUSION
from lidarsynth.systems.system import Official, System
from lidarsynth.training.task import Task


def model(experiment: Experiment, network: nn.Module) -> LidarModel:
    """The denoiser with its sensor."""
    return LidarModel(network, build_denoiser(experiment, network), build_sensor(experiment), experiment)


def task(experiment: Experiment) -> Task:
    """Denoising score matching with a score group, else R2DM's training."""
    return DIFFUSION if experiment.score is None else SCORE


EFFICIENT_UNET = System("diffusion", efficient_unet, DESCRIPTION, model, task, transfer, graph=step_graph)
CONDITIONAL_UNET = replace(EFFICIENT_UNET, build=conditional_unet, graph=completion_graph)
LIDARGEN = Official("lidargen", official_lidargen.belongs, official_lidargen.read)
REFINENET = replace(EFFICIENT_UNET, build=refinenet, official=LIDARGEN)
