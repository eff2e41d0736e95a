"""The word of a network -> how it is trained."""

from __future__ import annotations

from lidarsynth.experiment import Experiment
from lidarsynth.training.steps import DIFFUSION
from lidarsynth.training.task import Task

TASKS: dict[str, Task] = {
    "efficient-unet": DIFFUSION,
    "conditional-unet": DIFFUSION,
}


def task_of(experiment: Experiment) -> Task:
    """How the experiment's network is trained. Raises ValueError for a word that is not in TASKS."""
    if experiment.model.network not in TASKS:
        raise ValueError(f"model.network: expected one of {', '.join(TASKS)}, found {experiment.model.network!r}")
    return TASKS[experiment.model.network]
