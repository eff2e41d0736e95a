"""The word of a network -> how it is trained."""

from __future__ import annotations

from lidarsynth.build import GANS
from lidarsynth.experiment import Experiment
from lidarsynth.training.adversarial import ADVERSARIAL
from lidarsynth.training.score import SCORE
from lidarsynth.training.segmentation import SEGMENTATION
from lidarsynth.training.steps import DIFFUSION
from lidarsynth.training.task import Task
from lidarsynth.training.upsampling import LIDAR_SR, QUERIES

TASKS: dict[str, Task] = {
    "efficient-unet": DIFFUSION,
    "conditional-unet": DIFFUSION,
    "rangenet": SEGMENTATION,
    **dict.fromkeys(GANS, ADVERSARIAL),
    "refinenet": DIFFUSION,  # as a noise predictor; with a score group it is SCORE
    "lidar-sr": LIDAR_SR,
    "iln": QUERIES,
    "liif": QUERIES,
}


def task_of(experiment: Experiment) -> Task:
    """How the experiment's network is trained. Raises ValueError for a word that is not in TASKS."""
    if experiment.model.network not in TASKS:
        raise ValueError(f"model.network: expected one of {', '.join(TASKS)}, found {experiment.model.network!r}")
    return TASKS[experiment.model.network] if experiment.score is None else SCORE
