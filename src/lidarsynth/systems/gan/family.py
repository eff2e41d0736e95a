"""What Vanilla GAN, DUSty v1 and DUSty v2 bring."""

from __future__ import annotations

from torch import nn

from lidarsynth.experiment.record import Experiment
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.networks.gan.scan_generator import ScanGenerator
from lidarsynth.systems.gan import official
from lidarsynth.systems.gan.build import generator
from lidarsynth.systems.gan.description import DESCRIPTION
from lidarsynth.systems.gan.finetune import transfer
from lidarsynth.systems.gan.model import GanModel
from lidarsynth.systems.gan.training import ADVERSARIAL
from lidarsynth.systems.system import Official, System


def model(experiment: Experiment, network: nn.Module) -> GanModel:
    """The generator with its sensor."""
    assert isinstance(network, ScanGenerator)
    return GanModel(network, build_sensor(experiment), experiment)


OFFICIAL = Official("vanilla-gan/dusty-v1/dusty-v2", official.belongs, official.read, tuple(official.STAND_INS))
GAN = System("gan", generator, DESCRIPTION, model, lambda experiment: ADVERSARIAL, transfer, OFFICIAL)
