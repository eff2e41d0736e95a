"""`load`: trained weights as a model, of the class that its network needs."""

from __future__ import annotations

from collections.abc import Callable

from torch import nn

from lidarsynth.experiment.record import Experiment
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.gan.scan_generator import ScanGenerator
from lidarsynth.networks.iln import ILN, LIIF
from lidarsynth.networks.interpolation import METHODS, Interpolation
from lidarsynth.networks.lidar_sr import LidarSR
from lidarsynth.systems.build import GANS, build_denoiser
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.diffusion.model import LidarModel
from lidarsynth.systems.gan.model import GanModel
from lidarsynth.systems.interpolation.model import InterpolationModel
from lidarsynth.systems.scan_model import ScanModel
from lidarsynth.systems.upsampling.model import UpsamplingModel


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


def _cascade(experiment: Experiment, network: nn.Module) -> CascadeModel:
    assert isinstance(network, Cascade)
    return CascadeModel(network, build_sensor(experiment), experiment)


MODELS: dict[str, Callable[[Experiment, nn.Module], ScanModel]] = {  # word of a network -> its model
    "cascade": _cascade,
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
