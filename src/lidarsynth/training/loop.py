"""The training loop: a generator that yields its state; saving, logging and progress belong to the caller."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from lidarsynth.experiment import Experiment, Training
from lidarsynth.models.conditional import ConditionalUNet
from lidarsynth.training.examples import Examples, Images, Streets, load_batches
from lidarsynth.training.machine import accelerator_of, fixed_randomness, workers_of
from lidarsynth.training.options import Options
from lidarsynth.training.steps import Batch, Objective, generation_count

if TYPE_CHECKING:
    from accelerate import Accelerator


@dataclass
class Run:
    """Everything that training changes; `state_dict` of it restores the run exactly."""

    network: nn.Module
    ema: nn.Module
    optimizer: torch.optim.Optimizer
    step: int = 0
    scaler: torch.amp.GradScaler | None = None  # of fp16

    def state_dict(self) -> dict:
        """Weights, their average, optimiser, loss scale and the step, from which randomness and data order follow."""
        return {
            "network": self.network.state_dict(),
            "ema": self.ema.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
            "scaler": self.scaler.state_dict() if self.scaler else {},
        }

    def load_state_dict(self, state: dict) -> None:
        """The inverse of `state_dict`."""
        self.network.load_state_dict(state["network"])
        self.ema.load_state_dict(state["ema"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.step = state["step"]
        if self.scaler and state.get("scaler"):
            self.scaler.load_state_dict(state["scaler"])


@dataclass(frozen=True)
class Progress:
    """What one step of training yields: how many steps are done, and what the last one was like."""

    step: int
    losses: dict[str, float]  # `loss` and its parts, means over the global batch
    grad_norm: float
    learning_rate: float
    seconds: float = 0.0  # that the step took
    waited: float = 0.0  # seconds of these spent waiting for data


def start(experiment: Experiment, network: nn.Module, scaler: torch.amp.GradScaler | None = None) -> Run:
    """A fresh run from the network's present weights; `scaler` is accelerate's, for fp16."""
    training = experiment.training
    optimizer = torch.optim.AdamW(network.parameters(), training.learning_rate, training.betas, weight_decay=0.0)
    return Run(network, copy.deepcopy(network).requires_grad_(False), optimizer, scaler=scaler)


def learning_rate(training: Training, step: int) -> float:
    """Linear warm-up from 0, then a half-cosine to 0 at the last step (R2DM's schedule); `step` counts from 0."""
    if step < training.warmup:
        return training.learning_rate * step / max(1, training.warmup)
    progress = (step - training.warmup) / max(1, training.steps - training.warmup)
    return training.learning_rate * 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))


def ema_due(training: Training, step: int) -> bool:
    """Whether the average is updated after step `step`, counted from 1: the first, then every `ema_every`-th."""
    return (step - 1) % training.ema_every == 0


def ema_decay(training: Training, step: int) -> float:
    """Share of the old average that stays after step `step`, counted from 1 (R2DM, i.e. ema-pytorch).

    0 (copy) until `ema_start`, then min(ema_decay, 1 - (1 + k)^(-2/3)) with k steps since.
    """
    k = step - training.ema_start - 1
    return 0.0 if k <= 0 else min(training.ema_decay, 1 - (1 + k) ** (-2 / 3))


@torch.no_grad()
def update_ema(ema: nn.Module, network: nn.Module, decay: float) -> None:
    """ema <- decay * ema + (1 - decay) * network, for parameters and floating buffers."""
    source = network.state_dict()
    for name, average in ema.state_dict().items():
        average.lerp_(source[name], 1 - decay) if average.is_floating_point() else average.copy_(source[name])


def train(
    experiment: Experiment,
    run: Run,
    images: Images,
    options: Options | None = None,
    accelerator: Accelerator | None = None,
) -> Iterator[Progress]:
    """Train from `run.step` to the last step, yielding after each; randomness is a function of (seed, step, sample).

    The batch size is the global one: every process takes an equal share of it, in `options.accumulate` passes.
    Raises ValueError when the shares are not equal; FloatingPointError, naming the step and the images, when the
    loss or the gradient is not finite.
    """
    options = options or Options(workers=0)
    accelerator = accelerator or accelerator_of(options)
    training, passes = experiment.training, accelerator.gradient_accumulation_steps
    examples = Examples(experiment, images, accelerator.num_processes * passes)
    parts = range(accelerator.process_index, examples.parts, accelerator.num_processes)
    pinned = accelerator.device.type == "cuda"
    workers = workers_of(options, pinned or isinstance(images, Streets))
    batches = load_batches(examples, run.step, parts, workers, pinned)
    run.ema.to(accelerator.device)
    run.network.train()
    if options.compile:
        # the U-Net only: interpolation of the known pixels has loops that depend on the data
        (run.network.unet if isinstance(run.network, ConditionalUNet) else run.network).compile()
    objective, optimizer = accelerator.prepare(Objective(experiment, run.network), run.optimizer)
    while run.step < training.steps:
        began = time.perf_counter()
        with _dropout(experiment, run.step, accelerator.process_index):
            losses, waited = _gradients(accelerator, objective, optimizer, batches, training)
        norm = float(accelerator.clip_grad_norm_(run.network.parameters(), training.clip_norm))  # type: ignore[arg-type]
        finite = math.isfinite(losses["loss"]) and (math.isfinite(norm) or accelerator.scaler is not None)
        if not finite:
            raise FloatingPointError(f"step {run.step + 1}: expected a finite loss and gradient, "
                                     f"found {losses['loss']} and {norm}; "
                                     f"scans {examples.names(run.step)}")  # fmt: skip
        rate = _update(run, optimizer, training)
        yield Progress(run.step, losses, norm, rate, time.perf_counter() - began, waited)


def _dropout(experiment: Experiment, step: int, process: int) -> AbstractContextManager:
    """Dropout draws from torch's global generator: fixed for the step, and put back."""
    if experiment.model.dropout == 0:
        return nullcontext()
    return fixed_randomness(experiment.training.seed, step, process)


def _gradients(
    accelerator: Accelerator,
    objective: nn.Module,
    optimizer: torch.optim.Optimizer,
    batches: Iterator[Batch],
    training: Training,
) -> tuple[dict[str, float], float]:
    """Gradients of one step's global batch; its losses, and the seconds spent waiting for data."""
    from accelerate.utils import send_to_device

    waited, sums = 0.0, torch.zeros(2, device=accelerator.device)
    optimizer.zero_grad()
    for _ in range(accelerator.gradient_accumulation_steps):
        began = time.perf_counter()
        batch = next(batches)
        waited += time.perf_counter() - began
        batch: Batch = send_to_device(batch, accelerator.device, non_blocking=True)  # type: ignore[assignment]
        with accelerator.accumulate(objective):
            losses = objective(batch)
            accelerator.backward(losses.mean())
        n = batch.generation
        sums += torch.stack([losses[:n].sum(), losses[n:].sum()]).detach()
    total = accelerator.reduce(sums, reduction="sum")
    assert isinstance(total, Tensor)
    return _means(total.tolist(), training), waited


def _means(sums: list[float], training: Training) -> dict[str, float]:
    count, size = generation_count(training), training.batch_size
    parts = {"generation": (sums[0], count), "completion": (sums[1], size - count)}
    return {"loss": sum(sums) / size, **{name: total / n for name, (total, n) in parts.items() if n}}


def _update(run: Run, optimizer: torch.optim.Optimizer, training: Training) -> float:
    """One optimiser step and, when due, the moving average; returns the learning rate."""
    rate = learning_rate(training, run.step)
    for group in optimizer.param_groups:
        group["lr"] = rate
    optimizer.step()
    run.step += 1
    if ema_due(training, run.step):
        update_ema(run.ema, run.network, ema_decay(training, run.step))
    return rate
