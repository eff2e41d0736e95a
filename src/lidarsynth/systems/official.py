"""Official checkpoints of the systems that the paper compares with: which one a file is of, and how it is read.

R2DM's own checkpoints are read by `weights`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from torch import nn

from lidarsynth.experiment.record import Experiment
from lidarsynth.systems.diffusion import official_lidargen
from lidarsynth.systems.gan import official as official_gan
from lidarsynth.systems.upsampling import official as official_upsampling


class System(NamedTuple):
    """How the checkpoints of a system, as torch.load(..., weights_only=True) returns them, are recognised and read.

    belongs  whether a checkpoint has this system's structure, whatever is in it
    read     (checkpoint, name of the experiment, moving average or raw weights) -> experiment and network in evaluation
             mode. Raises ValueError, without the file's name, for another width or what is missing
    """

    belongs: Callable[[object], bool]
    read: Callable[[Any, str, bool], tuple[Experiment, nn.Module]]


STAND_INS = official_gan.STAND_INS  # harmless classes in the place of those that official files pickle

SYSTEMS: dict[str, System] = {
    "vanilla-gan/dusty-v1/dusty-v2": System(official_gan.belongs, official_gan.read),
    "lidargen": System(official_lidargen.belongs, official_lidargen.read),
    "lidar-sr/iln/liif": System(official_upsampling.belongs, official_upsampling.read),
}


def system_of(checkpoint: object) -> System | None:
    """The system that the checkpoint is of, or None."""
    return next((system for system in SYSTEMS.values() if system.belongs(checkpoint)), None)
