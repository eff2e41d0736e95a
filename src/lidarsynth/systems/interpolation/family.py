"""What nearest, bilinear and bicubic interpolation bring."""

from __future__ import annotations

from torch import nn

from lidarsynth.experiment.record import Experiment
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.interpolation import Interpolation
from lidarsynth.systems.interpolation.description import DESCRIPTION
from lidarsynth.systems.interpolation.model import InterpolationModel
from lidarsynth.systems.system import System


def build(experiment: Experiment, sensor: Sensor) -> Interpolation:
    """The interpolation of that name."""
    return Interpolation(experiment.model.network)


def model(experiment: Experiment, network: nn.Module) -> InterpolationModel:
    """The interpolation with the sensor of its images."""
    assert isinstance(network, Interpolation)
    return InterpolationModel(network, build_sensor(experiment), experiment)


INTERPOLATION = System("interpolation", build, DESCRIPTION, model)
