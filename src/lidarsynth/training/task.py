"""What the loop has to know of a kind of network to train it: what it sees, minimises, averages and is judged by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from lidarsynth.data.frames import Name
from lidarsynth.experiment.record import Experiment, Training
from lidarsynth.lidar.scan import RangeImage

if TYPE_CHECKING:
    from accelerate import Accelerator


class Images(Protocol):
    """Images to learn from: those of a cache, or endless streets."""

    source: dict[str, Any]  # `name`, and what else a card tells

    def take(self, indices: list[int]) -> list[RangeImage]:
        """Images, with labels where there are any."""
        ...

    def x_0(self, indices: list[int], codec: str = "log") -> Tensor:
        """(B, 2, H, W) in [-1, 1] of images."""
        ...

    def name(self, i: int) -> Name:
        """Source, sequence and frame of image i."""
        ...


@dataclass(frozen=True)
class Phase:
    """One optimiser's part of a step; a GAN's step has one per network, the others have one.

    objective  a module, batch -> the losses per sample (n,) by the name of their part; their mean over the global batch
               is minimised. Its parameters are those that the optimiser changes: other networks it asks are not
               registered in it, so that a distributed wrapper of it is told all of its gradients
    optimizer  the key of the task's optimisers
    every      steps from one to the next, the first at step 0
    count      batch -> how many losses it gives, where equal shares of one batch may give unequal numbers of them
    """

    objective: nn.Module
    optimizer: str = "network"
    every: int = 1
    count: Callable[[Any], int] | None = None


Draw = Callable[[Experiment, Images, list[int], int, list[int]], Any]
"""(experiment, images, which of them, step, their positions in the global batch) -> a NamedTuple of tensors.

All randomness of a sample is a function of (seed, step, position): `randomness.sample_rng`.
"""


def optimizers(experiment: Experiment, network: nn.Module) -> dict[str, torch.optim.Optimizer]:
    """One AdamW without decay of weights, for all parameters, as R2DM trains."""
    training = experiment.training
    rate, betas = training.learning_rate, training.betas
    return {"network": torch.optim.AdamW(network.parameters(), rate, betas, weight_decay=0.0)}


def ema_due(training: Training, step: int) -> bool:
    """Whether the average is updated after step `step`, counted from 1: the first, then every `ema_every`-th."""
    return (step - 1) % training.ema_every == 0


def ema_decay(training: Training, step: int) -> float:
    """Share of the old average that stays after step `step`, counted from 1 (R2DM, i.e. ema-pytorch).

    0 (copy) until `ema_start`, then min(ema_decay, 1 - (1 + k)^(-2/3)) with k steps since.
    """
    k = step - training.ema_start - 1
    return 0.0 if k <= 0 else min(training.ema_decay, 1 - (1 + k) ** (-2 / 3))


def average(training: Training, step: int) -> float | None:
    """`ema_decay` where `ema_due`, else None."""
    return ema_decay(training, step) if ema_due(training, step) else None


def itself(experiment: Experiment, network: nn.Module) -> nn.Module:
    """What is trained is the network alone."""
    return network


def any_share(experiment: Experiment, samples: int) -> None:
    """A network can learn from any number of samples at once."""


def any_images(experiment: Experiment, images: Images, learned: bool) -> None:
    """A network can learn from any images, and be judged on any."""


def nothing(experiment: Experiment, network: nn.Module, step: int, accelerator: Accelerator) -> None:
    """No more to do after a step."""


@dataclass(frozen=True)
class Task:
    """How a kind of network is trained.

    parts       names of the loss's parts, the columns of the journal
    draw        what a step sees
    phases      of the experiment and the trained network: the parts of a step, in their order
    judge       (experiment, averaged network, images that are not trained on) -> numbers by name, on fixed noise
    pictures    (experiment, averaged network, the same images) -> (H', W', 3) uint8
    around      network -> what is trained, e.g. it and its discriminator
    optimizers  of the trained network, by the names that phases use; a parameter group's `factor` scales its rate
    average     after a step, counted from 1: how much of the average stays, or None = left as it is
    buffers     whether floating buffers are averaged like parameters, or copied
    after       what else changes after a step, counted from 1; must be the same in all processes
    share       raises ValueError for a number of samples at once, in a process's pass, that cannot be learned from
    suits       (experiment, images, whether they are learned from, else judged on): raises ValueError for images that
                cannot be
    """

    parts: tuple[str, ...]
    draw: Draw
    phases: Callable[[Experiment, nn.Module], Sequence[Phase]]
    judge: Callable[[Experiment, nn.Module, Sequence[RangeImage]], dict[str, float]]
    pictures: Callable[[Experiment, nn.Module, Sequence[RangeImage]], list[np.ndarray]]
    around: Callable[[Experiment, nn.Module], nn.Module] = itself
    optimizers: Callable[[Experiment, nn.Module], dict[str, torch.optim.Optimizer]] = optimizers
    average: Callable[[Training, int], float | None] = average
    buffers: bool = True
    after: Callable[[Experiment, nn.Module, int, Accelerator], None] = nothing
    share: Callable[[Experiment, int], None] = any_share
    suits: Callable[[Experiment, Images, bool], None] = any_images
