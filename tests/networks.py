"""Networks in the place of trained ones."""

import math

import torch
from torch import Tensor

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


def angle_queries(elevation: Tensor, azimuth: Tensor, size: tuple[int, int], min_v: float, max_v: float) -> Tensor:
    """Queries (h w, 2), row by row, for directions given by elevations (h,) and azimuths (w,), in radians.

    size          H, W of the image that is asked
    min_v, max_v  elevations of its first and its last row, radians; its columns begin at azimuth -pi and ascend

    Equal to the published program's to 2.4e-7. That matters nowhere in ILN; LIIF's answer in line with the centres of
    border pixels is a ratio of such roundings, in the published program too.
    """
    height, width = size
    step = (max_v - min_v) / (height - 1)
    v = 2 * (elevation - (min_v - step / 2)) / (max_v - min_v + step) - 1
    turned = azimuth + math.pi / width
    turned = torch.where(turned >= math.pi, turned - 2 * math.pi, turned)
    h = 2 * (turned + math.pi) / (2 * math.pi) - 1
    return torch.stack(torch.meshgrid(v, h, indexing="ij"), dim=-1).flatten(0, 1)
