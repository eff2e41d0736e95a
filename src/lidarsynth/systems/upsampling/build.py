"""An experiment's LiDAR-SR, ILN or LIIF."""

from __future__ import annotations

from lidarsynth.experiment.record import Experiment, Upsampling
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.iln import ILN, LIIF
from lidarsynth.networks.lidar_sr import LidarSR
from lidarsynth.systems.sizes import check_divisor, check_lidar_sr


def lidar_sr(experiment: Experiment, sensor: Sensor) -> LidarSR:
    """LiDAR-SR, as wide as the experiment says."""
    model, group = experiment.model, experiment.upsampling or Upsampling()
    check_lidar_sr(group, sensor)
    return LidarSR(group.factor, model.base_channels, model.dropout, group.keras)


def iln(experiment: Experiment, sensor: Sensor) -> ILN:
    """ILN of the experiment's layers and heads."""
    model, group = experiment.model, experiment.upsampling or Upsampling()
    blocks = sum(model.num_residual_blocks)
    check_divisor("model.attn_num_heads", model.attn_num_heads, [model.base_channels])
    return ILN(group.depth, model.attn_num_heads, model.base_channels, blocks, model.dropout)


def liif(experiment: Experiment, sensor: Sensor) -> LIIF:
    """LIIF, its perceptron four times as wide as its features."""
    model, group = experiment.model, experiment.upsampling or Upsampling()
    channels, blocks = model.base_channels, sum(model.num_residual_blocks)
    return LIIF(channels, 4 * channels, blocks, group.unfold, group.ensemble)
