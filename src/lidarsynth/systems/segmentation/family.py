"""What RangeNet brings: classes of pixels, and features for metrics; it makes no scans."""

from __future__ import annotations

from torch import nn

from lidarsynth.experiment.record import Experiment, Segmentation
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.networks.tensors import load_weights
from lidarsynth.systems.segmentation.description import DESCRIPTION
from lidarsynth.systems.segmentation.training import SEGMENTATION
from lidarsynth.systems.system import System


def build(experiment: Experiment, sensor: Sensor) -> RangeNet:
    """RangeNet of the experiment's layers."""
    layers = (experiment.segmentation or Segmentation()).layers
    return RangeNet(layers, experiment.model.base_channels, dropout=experiment.model.dropout)


def transfer(network: nn.Module, experiment: Experiment, weights: nn.Module, source: Experiment, name: str) -> None:
    """All weights, of an equally wide network."""
    load_weights(network, weights.state_dict(), name)


RANGENET = System("segmentation", build, DESCRIPTION, task=lambda experiment: SEGMENTATION, transfer=transfer)
