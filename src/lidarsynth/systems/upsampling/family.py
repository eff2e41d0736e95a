"""What LiDAR-SR, ILN and LIIF bring."""

from __future__ import annotations

from dataclasses import replace

from torch import nn

from lidarsynth.experiment.record import Experiment
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.networks.iln import ILN, LIIF
from lidarsynth.networks.lidar_sr import LidarSR
from lidarsynth.systems.system import Official, System
from lidarsynth.systems.upsampling import official
from lidarsynth.systems.upsampling.build import iln, lidar_sr, liif
from lidarsynth.systems.upsampling.description import DESCRIPTION
from lidarsynth.systems.upsampling.finetune import transfer
from lidarsynth.systems.upsampling.model import UpsamplingModel
from lidarsynth.systems.upsampling.training import LIDAR_SR as GRIDS
from lidarsynth.systems.upsampling.training import QUERIES


def model(experiment: Experiment, network: nn.Module) -> UpsamplingModel:
    """The network with the sensor of its images."""
    assert isinstance(network, LidarSR | ILN | LIIF)
    return UpsamplingModel(network, build_sensor(experiment), experiment)


OFFICIAL = Official("lidar-sr/iln/liif", official.belongs, official.read)
LIDAR_SR = System("upsampling", lidar_sr, DESCRIPTION, model, lambda experiment: GRIDS, transfer, OFFICIAL)
ILN_SYSTEM = replace(LIDAR_SR, build=iln, task=lambda experiment: QUERIES)
LIIF_SYSTEM = replace(ILN_SYSTEM, build=liif)
