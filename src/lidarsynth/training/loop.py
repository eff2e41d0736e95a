"""The training loop: a generator that yields its state; saving, logging and progress belong to the caller."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn

from lidarsynth.experiment.record import Experiment, Training
from lidarsynth.networks.conditional import ConditionalUNet
from lidarsynth.training.examples import Examples, Streets, TrainingImages, load_batches
from lidarsynth.training.machine import accelerator_of, fixed_randomness, workers_of
from lidarsynth.training.options import Options
from lidarsynth.training.task import Phase, Task

if TYPE_CHECKING:
    from accelerate import Accelerator


@dataclass
class Run:
    """Everything that training changes; `state_dict` of it restores the run exactly.

    network     what is trained: of a GAN also the discriminator
    product     the network that the model needs, a part of `network` or all of it
    ema         its moving average
    optimizers  by the names that the task's phases use
    task        how this kind of network is trained
    """

    network: nn.Module
    product: nn.Module
    ema: nn.Module
    optimizers: dict[str, torch.optim.Optimizer]
    task: Task
    step: int = 0
    scaler: torch.amp.GradScaler | None = None  # of fp16

    def state_dict(self) -> dict:
        """Weights, their average, optimisers, loss scale and the step, from which randomness and data order follow."""
        return {
            "network": self.network.state_dict(),
            "ema": self.ema.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()},
            "step": self.step,
            "scaler": self.scaler.state_dict() if self.scaler else {},
        }

    def load_state_dict(self, state: dict) -> None:
        """The inverse of `state_dict`."""
        self.network.load_state_dict(state["network"])
        self.ema.load_state_dict(state["ema"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        self.step = state["step"]
        if self.scaler and state.get("scaler"):
            self.scaler.load_state_dict(state["scaler"])


@dataclass(frozen=True)
class Progress:
    """What one step of training yields: how many steps are done, and what the last one was like."""

    step: int
    losses: dict[str, float]  # `loss` and its parts, means over the global batch
    grad_norm: float  # of a GAN, the largest of its phases
    learning_rate: float
    seconds: float = 0.0  # that the step took
    waited: float = 0.0  # seconds of these spent waiting for data
    note: str = ""  # what the user should know, such as a damaged checkpoint that was passed over
    judged: dict[str, float] = field(default_factory=dict)  # after a look at the averaged weights: what it found


def start(experiment: Experiment, network: nn.Module, task: Task, scaler: torch.amp.GradScaler | None = None) -> Run:
    """A fresh run from the network's present weights; `scaler` is accelerate's, for fp16."""
    with fixed_randomness(experiment.training.seed):
        trained = task.around(experiment, network)
    ema = copy.deepcopy(network).requires_grad_(False)
    return Run(trained, network, ema, task.optimizers(experiment, trained), task, scaler=scaler)


def learning_rate(training: Training, step: int) -> float:
    """Linear warm-up from 0, then `training.decay`; `step` counts from 0. Raises ValueError for another word."""
    if training.decay not in DECAYS:
        raise ValueError(f"training.decay: expected one of {', '.join(DECAYS)}, found {training.decay!r}")
    if step < training.warmup:
        return training.learning_rate * step / max(1, training.warmup)
    done = step - training.warmup
    progress = done / max(1, training.steps - training.warmup)
    return training.learning_rate * DECAYS[training.decay](min(1.0, progress), done)


# Factor of the rate behind the warm-up: after a share of the steps there, and after that many steps.
DECAYS: dict[str, Callable[[float, int], float]] = {
    "cosine": lambda progress, done: 0.5 * (1 + math.cos(math.pi * progress)),  # R2DM's schedule
    "constant": lambda progress, done: 1.0,
    "inverse": lambda progress, done: 1 / (1 + done / 100_000),  # Keras' decay of 1e-5, of any length (LiDAR-SR)
    "halving": lambda progress, done: 0.5 ** min(4, int(5 * progress)),  # after each fifth of the steps (ILN)
}


@torch.no_grad()
def update_ema(ema: nn.Module, network: nn.Module, decay: float, buffers: bool = True) -> None:
    """ema <- decay * ema + (1 - decay) * network, for parameters and, if `buffers`, floating buffers, else copied."""
    source, learned = network.state_dict(), dict(ema.named_parameters())
    for name, average in ema.state_dict().items():
        averaged = average.is_floating_point() and (buffers or name in learned)
        average.lerp_(source[name], 1 - decay) if averaged else average.copy_(source[name])


def train(
    experiment: Experiment,
    run: Run,
    images: TrainingImages,
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
    training, task = experiment.training, run.task
    batches, examples = _batches(experiment, images, run, options, accelerator)
    run.ema.to(accelerator.device)
    run.network.to(accelerator.device).train()
    if options.compile:
        # the U-Net only: interpolation of the known pixels has loops that depend on the data
        (run.product.unet if isinstance(run.product, ConditionalUNet) else run.product).compile()
    phases = _prepare(accelerator, task.phases(experiment, run.network), run.optimizers)
    with closing(batches):
        while run.step < training.steps:
            began = time.perf_counter()
            passes, waited = _fetch(accelerator, batches)
            rate = learning_rate(training, run.step)
            losses, norm = _step(run.step, phases, passes, rate, training, accelerator, examples)
            run.step += 1
            task.after(experiment, run.network, run.step, accelerator)
            if (decay := task.average(training, run.step)) is not None:
                update_ema(run.ema, run.product, decay, task.buffers)
            yield Progress(run.step, losses, norm, rate, time.perf_counter() - began, waited)


def _batches(
    experiment: Experiment, images: TrainingImages, run: Run, options: Options, accelerator: Accelerator
) -> tuple[Generator[Any, None, None], Examples]:
    """This process's batches from the run's step on, one per pass, and what makes them."""
    parts = accelerator.num_processes * accelerator.gradient_accumulation_steps
    examples = Examples(experiment, images, parts, run.task.draw)
    own = range(accelerator.process_index, parts, accelerator.num_processes)
    pinned = accelerator.device.type == "cuda"
    workers = workers_of(options, pinned or isinstance(images, Streets))
    return load_batches(examples, run.step, own, workers, pinned), examples


class _PreparedPhase(NamedTuple):
    """A phase, with what accelerate made of its objective and optimiser."""

    objective: nn.Module
    optimizer: torch.optim.Optimizer
    every: int
    count: Callable[[Any], int] | None


def _prepare(
    accelerator: Accelerator, phases: Sequence[Phase], optimizers: dict[str, torch.optim.Optimizer]
) -> list[_PreparedPhase]:
    prepared = accelerator.prepare(*(phase.objective for phase in phases), *optimizers.values())
    wrapped = dict(zip(optimizers, prepared[len(phases) :], strict=True))
    return [
        _PreparedPhase(objective, wrapped[phase.optimizer], phase.every, phase.count)
        for phase, objective in zip(phases, prepared[: len(phases)], strict=True)
    ]


def _fetch(accelerator: Accelerator, batches: Iterator[Any]) -> tuple[list[Any], float]:
    """The batches of one step's passes, on the device, and the seconds spent waiting for them."""
    from accelerate.utils import send_to_device

    began = time.perf_counter()
    passes = [next(batches) for _ in range(accelerator.gradient_accumulation_steps)]
    waited = time.perf_counter() - began
    return [send_to_device(batch, accelerator.device, non_blocking=True) for batch in passes], waited


def _step(
    step: int,
    phases: list[_PreparedPhase],
    passes: list[Any],
    rate: float,
    training: Training,
    accelerator: Accelerator,
    examples: Examples,
) -> tuple[dict[str, float], float]:
    """All phases that are due, each with its optimiser's step; the sum and the parts of their losses, largest norm."""
    losses, norms = {"loss": 0.0}, []
    with fixed_randomness(training.seed, step, accelerator.process_index):  # of dropout and augmentations
        for phase in phases:
            if step % phase.every == 0:
                found, norm = _gradients(accelerator, phase, passes, rate, training.clip_norm)
                _check(step, found["loss"], norm, accelerator, examples)
                phase.optimizer.step()
                losses = {**losses, **found, "loss": losses["loss"] + found["loss"]}
                norms.append(norm)
    return losses, max(norms)


def _gradients(
    accelerator: Accelerator, phase: _PreparedPhase, passes: list[Any], rate: float, clip_norm: float | None
) -> tuple[dict[str, float], float]:
    """Clipped gradients of one phase for one step's global batch; the mean of each part of its loss, and their norm."""
    sums: dict[str, Tensor] = {}
    for group in phase.optimizer.param_groups:
        group["lr"] = rate * group.get("factor", 1.0)
    phase.optimizer.zero_grad()
    for batch, weight in zip(passes, _weights(accelerator, phase, passes), strict=True):
        with accelerator.accumulate(phase.objective):
            losses = phase.objective(batch)
            accelerator.backward(weight * torch.cat([*losses.values()]).mean())
        for name, values in losses.items():
            part = torch.stack([values.detach().sum(), values.new_tensor(float(len(values)))])
            sums[name] = sums.get(name, 0) + part
    total = accelerator.reduce(torch.stack([*sums.values()]), reduction="sum")
    assert isinstance(total, Tensor)
    parameters = [p for group in phase.optimizer.param_groups for p in group["params"]]
    limit = math.inf if clip_norm is None else clip_norm
    norm = float(accelerator.clip_grad_norm_(parameters, limit))  # type: ignore[arg-type]
    parts = {name: (float(part[0]), float(part[1])) for name, part in zip(sums, total, strict=True)}
    mean = sum(value for value, _ in parts.values()) / max(1, sum(count for _, count in parts.values()))
    return {"loss": mean, **{name: value / count for name, (value, count) in parts.items() if count}}, norm


def _weights(accelerator: Accelerator, phase: _PreparedPhase, passes: list[Any]) -> list[float]:
    """What the mean of each pass counts for, so that the mean of all shares' is that of the global batch's losses."""
    if phase.count is None:
        return [1.0] * len(passes)
    counts = [phase.count(batch) for batch in passes]
    total = accelerator.reduce(torch.tensor(float(sum(counts)), device=accelerator.device), reduction="sum")
    assert isinstance(total, Tensor)
    shares = len(passes) * accelerator.num_processes
    return [count * shares / max(1.0, float(total)) for count in counts]


def _check(step: int, loss: float, norm: float, accelerator: Accelerator, examples: Examples) -> None:
    """Raises FloatingPointError unless loss and gradient are finite; an infinite gradient of fp16 is skipped later."""
    if not (math.isfinite(loss) and (math.isfinite(norm) or accelerator.scaler is not None)):
        raise FloatingPointError(
            f"step {step + 1}: expected a finite loss and gradient, found {loss} and {norm}; "
            f"scans {examples.names(step)}"
        )
