"""What a family of networks brings: one record per word of a network, listed in `systems.table`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import nn

from lidarsynth.experiment.record import Experiment
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.systems.description import Description
from lidarsynth.systems.graph import Graph
from lidarsynth.systems.scan_model import ScanModel
from lidarsynth.training.task import Task


@dataclass(frozen=True)
class Official:
    """How the checkpoints of a published program, as torch.load(..., weights_only=True) returns them, are read.

    name       of the systems it is of
    belongs    whether a checkpoint has this program's structure, whatever is in it
    read       (checkpoint, name of the experiment, moving average or raw weights) -> experiment and network in
               evaluation mode. Raises ValueError, without the file's name, for another width or what is missing
    stand_ins  harmless classes in the place of those that the files pickle, as torch.serialization takes them
    """

    name: str
    belongs: Callable[[object], bool]
    read: Callable[[Any, str, bool], tuple[Experiment, nn.Module]]
    stand_ins: tuple[Any, ...] = ()


@dataclass(frozen=True)
class System:
    """What a word of `model.network` stands for.

    family       weights of one family are no start for another
    build        (experiment, its sensor) -> the network with fresh weights
    model        (experiment, trained network) -> the model; None for a network that makes no scans
    task         experiment -> how it is trained; None where there is nothing to train
    transfer     (network, experiment, trained weights, their experiment, their name): copy weights into a fresh
                 network. Raises ValueError that says what does not fit; None where there is nothing to copy
    description  what is said of it
    graph        (model, whether the number of columns is open) -> what an exported file holds. Raises ValueError for
                 what cannot be exported; None where nothing of it can
    official     the reader of published checkpoints, if there is one
    """

    family: str
    build: Callable[[Experiment, Sensor], nn.Module]
    description: Description
    model: Callable[[Experiment, nn.Module], ScanModel] | None = None
    task: Callable[[Experiment], Task] | None = None
    transfer: Callable[[nn.Module, Experiment, nn.Module, Experiment, str], None] | None = None
    official: Official | None = None
    graph: Callable[[Any, bool], Graph] | None = None
