"""`load`: trained weights as a model, of the class that its network needs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import nn

from lidarsynth.build import GANS, build_denoiser, build_sensor
from lidarsynth.experiment import Experiment
from lidarsynth.gan_model import GanModel
from lidarsynth.interpolation_model import InterpolationModel
from lidarsynth.model import LidarModel
from lidarsynth.models.iln import ILN, LIIF
from lidarsynth.models.interpolation import METHODS, Interpolation
from lidarsynth.models.lidar_sr import LidarSR
from lidarsynth.models.scan_generator import ScanGenerator
from lidarsynth.scan_model import ScanModel
from lidarsynth.upsampling_model import UpsamplingModel
from lidarsynth.weights import load_parts


def _diffusion(experiment: Experiment, network: nn.Module) -> LidarModel:
    return LidarModel(network, build_denoiser(experiment, network), build_sensor(experiment), experiment)


def _upsampling(experiment: Experiment, network: nn.Module) -> UpsamplingModel:
    assert isinstance(network, LidarSR | ILN | LIIF)
    return UpsamplingModel(network, build_sensor(experiment), experiment)


def _interpolation(experiment: Experiment, network: nn.Module) -> InterpolationModel:
    assert isinstance(network, Interpolation)
    return InterpolationModel(network, build_sensor(experiment), experiment)


def _gan(experiment: Experiment, network: nn.Module) -> GanModel:
    assert isinstance(network, ScanGenerator)
    return GanModel(network, build_sensor(experiment), experiment)


MODELS: dict[str, Callable[[Experiment, nn.Module], ScanModel]] = {  # word of a network -> its model
    "efficient-unet": _diffusion,
    "conditional-unet": _diffusion,
    "refinenet": _diffusion,
    "lidar-sr": _upsampling,
    "iln": _upsampling,
    "liif": _upsampling,
    **dict.fromkeys(METHODS, _interpolation),
    **dict.fromkeys(GANS, _gan),
}


def assemble(experiment: Experiment, network: nn.Module) -> ScanModel:
    """The model of an experiment and its trained network. Raises ValueError for a network that makes no scans."""
    word = experiment.model.network
    if word not in MODELS:
        raise ValueError(
            f"{experiment.name}: expected a network of {', '.join(MODELS)}, which make scans, found {word}"
        )
    return MODELS[word](experiment, network.eval())


def load(source: str | Path = "default", ema: bool = True, device: str | torch.device = "cpu") -> ScanModel:
    """A trained model.

    source  `default`: the shipped weights; the name of an official release; one of our folders; an official `.pth`;
            `owner/name` of the Hugging Face hub
    ema     official files hold two sets of weights: their moving average (True), or the raw ones

    Raises ValueError, or OSError, with one line that says what was expected and what was found.
    """
    return assemble(*load_parts(source, ema)).to(device)
