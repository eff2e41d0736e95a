"""The word of a network -> how it is trained."""

from __future__ import annotations

from lidarsynth.experiment.record import Experiment
from lidarsynth.systems.build import GANS
from lidarsynth.systems.cascade.training import CASCADE
from lidarsynth.systems.diffusion.score_matching import SCORE
from lidarsynth.systems.diffusion.training import DIFFUSION
from lidarsynth.systems.gan.training import ADVERSARIAL
from lidarsynth.systems.segmentation.training import SEGMENTATION
from lidarsynth.systems.upsampling.training import LIDAR_SR, QUERIES
from lidarsynth.training.task import Task

TASKS: dict[str, Task] = {
    "cascade": CASCADE,
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
