"""Networks in the place of trained ones."""

import torch

from lidarsynth.experiment.record import Data, Experiment, Model
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.table import build_network


def trained(experiment: Experiment, seed: int = 0) -> torch.nn.Module:
    """A network with no zero-initialised layer left, in the place of a trained one."""
    network = build_network(experiment)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.08)
    return network


def tiny_cascade(sensor: Sensor) -> CascadeModel:
    """A small cascade that has learned nothing, classes neither."""
    shape = Model(network="cascade", base_channels=16, channel_multipliers=(1, 1, 1, 1),
                  num_residual_blocks=(1, 1, 1, 1), classes=20)  # fmt: skip
    data = Data(sensor=sensor.to_dict(), height=sensor.height, width=sensor.width)
    experiment = Experiment("tiny", data, shape)
    return CascadeModel(trained(experiment), sensor, experiment)  # type: ignore[arg-type]
