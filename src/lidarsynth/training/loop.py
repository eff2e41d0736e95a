"""The training loop: a generator that yields its state; saving, logging and progress belong to the caller."""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from lidarsynth.build import build_denoiser
from lidarsynth.data.dataset import CachedImages
from lidarsynth.experiment import Experiment, Training
from lidarsynth.training.steps import training_loss


@dataclass
class Run:
    """Everything that training changes; `state_dict` of it restores the run exactly."""

    network: nn.Module
    ema: nn.Module
    optimizer: torch.optim.Optimizer
    step: int = 0

    def state_dict(self) -> dict:
        """Weights, their average, optimiser state and the step; randomness follows from the step."""
        return {
            "network": self.network.state_dict(),
            "ema": self.ema.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
        }

    def load_state_dict(self, state: dict) -> None:
        """The inverse of `state_dict`."""
        self.network.load_state_dict(state["network"])
        self.ema.load_state_dict(state["ema"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.step = state["step"]


@dataclass(frozen=True)
class Progress:
    """What one step of training yields: the step's number, from 1, its losses and the gradient's norm."""

    step: int
    losses: dict[str, float]
    grad_norm: float
    learning_rate: float


def start(experiment: Experiment, network: nn.Module) -> Run:
    """A fresh run from the network's present weights."""
    training = experiment.training
    optimizer = torch.optim.AdamW(network.parameters(), training.learning_rate, training.betas, weight_decay=0.0)
    return Run(network, copy.deepcopy(network).requires_grad_(False), optimizer)


def learning_rate(training: Training, step: int) -> float:
    """Linear warm-up from 0, then a half-cosine to 0 at the last step (R2DM's schedule); `step` counts from 0."""
    if step < training.warmup:
        return training.learning_rate * step / max(1, training.warmup)
    progress = (step - training.warmup) / max(1, training.steps - training.warmup)
    return training.learning_rate * 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))


def ema_decay(training: Training, step: int) -> float:
    """0 (copy) until `ema_start`, then min(ema_decay, 1 - (1 + k)^(-2/3)) with k steps since (R2DM)."""
    k = step - training.ema_start - 1
    return 0.0 if k <= 0 else min(training.ema_decay, 1 - (1 + k) ** (-2 / 3))


@torch.no_grad()
def update_ema(ema: nn.Module, network: nn.Module, decay: float) -> None:
    """ema <- decay * ema + (1 - decay) * network, for parameters and floating buffers."""
    source = network.state_dict()
    for name, average in ema.state_dict().items():
        average.lerp_(source[name], 1 - decay) if average.is_floating_point() else average.copy_(source[name])


def epoch_order(seed: int, epoch: int, length: int) -> Tensor:
    """(length,) permutation of the data of one epoch, a function of the seed and the epoch only."""
    return torch.randperm(length, generator=torch.Generator().manual_seed(seed * 1_000_003 + epoch))


def batch_indices(training: Training, step: int, length: int) -> list[int]:
    """Which images step `step` sees: each epoch visits every image once."""
    positions = range(step * training.batch_size, (step + 1) * training.batch_size)
    epochs = {p // length: None for p in positions}
    orders = {epoch: epoch_order(training.seed, epoch, length) for epoch in epochs}
    return [int(orders[p // length][p % length]) for p in positions]


def train(experiment: Experiment, run: Run, images: CachedImages) -> Iterator[Progress]:
    """Train from `run.step` to the last step, yielding after each; all randomness is a function of (seed, step).

    Raises FloatingPointError, naming the step and the images, when the loss is not finite.
    """
    training = experiment.training
    denoiser = build_denoiser(experiment, run.network)
    run.network.train()
    while run.step < training.steps:
        rng = torch.Generator().manual_seed(training.seed * 1_000_003 + run.step)
        indices = batch_indices(training, run.step, len(images))
        losses = training_loss(experiment, denoiser, images.x_0(indices, experiment.data.codec), rng)
        if not torch.isfinite(losses["loss"]):
            raise FloatingPointError(f"step {run.step}: expected a finite loss, found {losses['loss']}; images {indices}")
        rate, norm = _update(run, training, losses["loss"])
        yield Progress(run.step, {name: float(v.detach()) for name, v in losses.items()}, norm, rate)


def _update(run: Run, training: Training, loss: Tensor) -> tuple[float, float]:
    """One optimiser step and, when due, the moving average; returns learning rate and gradient norm."""
    rate = learning_rate(training, run.step + 1)
    for group in run.optimizer.param_groups:
        group["lr"] = rate
    run.optimizer.zero_grad(set_to_none=True)
    loss.backward()
    norm = float(nn.utils.clip_grad_norm_(run.network.parameters(), training.clip_norm))
    run.optimizer.step()
    run.step += 1
    if run.step % training.ema_every == 0:
        update_ema(run.ema, run.network, ema_decay(training, run.step))
    return rate, norm


def save_run(path: str | Path, run: Run) -> None:
    """Write the run's state; the file is moved into place when complete."""
    path = Path(path)
    scratch = path.with_suffix(".tmp")
    torch.save(run.state_dict(), scratch)
    os.replace(scratch, path)


def load_run(path: str | Path, run: Run) -> None:
    """Continue from a file of `save_run`. Raises ValueError when it is none, or of another network."""
    try:
        run.load_state_dict(torch.load(path, weights_only=True, map_location="cpu"))
    except Exception as error:
        raise ValueError(f"{path}: expected a training state of this experiment, found {error!s:.120}") from None
