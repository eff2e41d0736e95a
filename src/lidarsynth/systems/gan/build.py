"""An experiment's GAN: the generator, and the discriminator it is trained against."""

from __future__ import annotations

import torch
from torch import nn

from lidarsynth.experiment.record import Adversarial, Experiment
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.gan import dcgan as gan
from lidarsynth.networks.gan import dusty2
from lidarsynth.networks.gan.scan_generator import ScanGenerator
from lidarsynth.systems.sizes import check_gan


def generator(experiment: Experiment, sensor: Sensor) -> ScanGenerator:
    """The generator of a GAN of inverse depth. Raises ValueError for another codec, or an image mask of no dusty-v1."""
    model, group, codec = experiment.model, experiment.adversarial or Adversarial(), experiment.data.codec
    if codec not in ("inverse", "inverse-minmax"):
        raise ValueError(f"data.codec: expected inverse or inverse-minmax for {model.network}, found {codec!r}")
    if group.image_mask and model.network != "dusty-v1":
        raise ValueError(f"adversarial.image_mask: expected false for {model.network}, which has none, found true")
    check_gan(model.network, sensor)
    size, widths = (sensor.height, sensor.width), (model.base_channels, group.max_channels)
    if model.network == "dusty-v2":
        latents = (group.latent_channels, group.style_channels)
        angles = torch.from_numpy(sensor.ray_angles())[None]
        return ScanGenerator(dusty2.Generator(size, *latents, *widths, group.temperature), angles)
    how = (model.network == "dusty-v1", group.iros21, group.temperature, group.image_mask)
    return ScanGenerator(gan.Generator(size, group.latent_channels, *widths, *how))


def build_discriminator(experiment: Experiment) -> nn.Module:
    """What a GAN's generator is trained against, with fresh weights: images (B, 1, H, W) -> logits, large = real."""
    model, group, sensor = experiment.model, experiment.adversarial or Adversarial(), build_sensor(experiment)
    size = (sensor.height, sensor.width)
    widths = (group.discriminator_channels or model.base_channels, group.max_channels)
    if model.network == "dusty-v2":
        return dusty2.Discriminator(size, *widths)
    return gan.Discriminator(size, *widths, vertical="reflect" if group.iros21 else "replicate")
