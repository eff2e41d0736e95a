"""One training run in a folder: fresh, from other weights, or continued; what `lidarsynth train` does."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch

from lidarsynth.build import build_network, build_sensor, load_weights, read_experiment, save
from lidarsynth.data.dataset import CachedImages
from lidarsynth.experiment import Experiment, with_fields
from lidarsynth.presets import preset
from lidarsynth.training.loop import Progress, load_run, save_run, start, train
from lidarsynth.weights import load_parts

STATE = "state.pt"


def resolve(name: str, changes: tuple[str, ...] = (), seed: int = 0) -> Experiment:
    """A preset with `group.field=value` changes, values in JSON or bare words. Raises ValueError by the field's name."""
    fields = {"training.seed": seed}
    for change in changes:
        path, equals, text = change.partition("=")
        if not equals:
            raise ValueError(f"expected group.field=value, such as training.steps=1000, found {change!r}")
        try:
            fields[path] = json.loads(text)
        except json.JSONDecodeError:
            fields[path] = text
    return with_fields(preset(name), fields)


def run(
    experiment: Experiment,
    data: str | Path,
    out: str | Path,
    weights: str | None = None,
    threads: int = 0,
    every: int = 50,
    save_every: int = 500,
) -> Iterator[str]:
    """Train on a cache and yield a line of progress `every` steps; state and weights go to `out` `save_every` steps.

    A folder that holds a state of the same experiment is continued exactly. Raises ValueError when the cache has other
    images than the experiment, or the folder another experiment.
    """
    if threads:
        torch.set_num_threads(threads)
    out, images = Path(out), CachedImages(data)
    expected, found = build_sensor(experiment), images.sensor
    if (expected.height, expected.width) != (found.height, found.width):
        raise ValueError(f"{data}: expected images of {expected.height} x {expected.width}, "
                         f"found {found.height} x {found.width}")  # fmt: skip
    torch.manual_seed(experiment.training.seed)
    network = build_network(experiment)
    if weights:
        load_weights(network, load_parts(weights)[1].state_dict(), weights)
    state = start(experiment, network)
    if (out / STATE).exists():
        _same_experiment(out, experiment)
        load_run(out / STATE, state)
    out.mkdir(parents=True, exist_ok=True)
    began, first = time.monotonic(), state.step
    for progress in train(experiment, state, images):
        if progress.step % every == 0 or progress.step == experiment.training.steps:
            yield line(progress, (time.monotonic() - began) / (progress.step - first))
        if progress.step % save_every == 0 or progress.step == experiment.training.steps:
            save_run(out / STATE, state)
            save(out, experiment, state.ema)


def line(progress: Progress, seconds: float) -> str:
    """Step, losses, gradient norm, learning rate and seconds per step, in one line."""
    losses = " ".join(f"{name} {value:.4f}" for name, value in progress.losses.items())
    return (f"step {progress.step} {losses} norm {progress.grad_norm:.2f} "
            f"rate {progress.learning_rate:.1e} {seconds:.2f} s/step")  # fmt: skip


def _same_experiment(out: Path, experiment: Experiment) -> None:
    found = read_experiment(out)
    if replace(found, card=experiment.card) != experiment:
        raise ValueError(f"{out}: expected a run of this experiment, found another one in experiment.json")
