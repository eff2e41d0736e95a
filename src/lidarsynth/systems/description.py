"""What is said of a model: by `info`, and by the card of a repository."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lidarsynth.experiment.record import Experiment
from lidarsynth.lidar.sensor import Sensor

if TYPE_CHECKING:  # `info` of a scan needs no torch
    from torch import nn


@dataclass(frozen=True)
class About:
    """What a model card says of a model beyond its experiment.

    sentence  what it is, in one sentence, with the paper
    usage     lines of Python behind `import lidarsynth as ls`, {repo_id} where it is loaded from
    tags      the hub's words
    """

    sentence: str
    usage: tuple[str, ...]
    tags: tuple[str, ...]


@dataclass(frozen=True)
class Description:
    """How a family of networks is described.

    network  experiment -> what it is made of, in a line
    details  experiment -> more such lines by their titles
    about    experiment -> what a model card says
    """

    network: Callable[[Experiment], str]
    details: Callable[[Experiment], dict[str, str]]
    about: Callable[[Experiment], About]


def training_line(experiment: Experiment) -> str:
    """How long it was trained, or until where, and how."""
    training, done = experiment.training, experiment.card.steps
    stopped = f"stopped at {done:,} of " if 0 < done < training.steps else ""
    return f"{stopped}{training.steps:,} steps of {training.batch_size}, learning rate {training.learning_rate:g}"


def described(kind: str, experiment: Experiment, sensor: Sensor, network: nn.Module) -> str:
    """Three lines: what a model of that class is, its sensor, its network and where that is."""
    parameters = list(network.parameters())
    place = parameters[0].device if parameters else "cpu"
    s, card = sensor, experiment.card
    count = sum(p.numel() for p in parameters)
    learned = f", learned from {card.data}" if card.data else ""
    return (
        f"{kind} {experiment.name}{learned}\n"
        f"  sensor   {s.name}: {s.height} beams x {s.width} columns, {s.min_range:g} to {s.max_range:g} m\n"
        f"  network  {experiment.model.network}, {count:,} parameters, on {place}"
    )
