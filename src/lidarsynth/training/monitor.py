"""Looks at a run from time to time: judges the averaged weights on fixed images and draws pictures of them."""

from __future__ import annotations

from pathlib import Path

from torch import nn

from lidarsynth.data.dataset import SeveralCaches
from lidarsynth.experiment.record import Experiment
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.training.examples import CASCADE, Streets, folders_of, open_images, words_of
from lidarsynth.training.journal import Journal
from lidarsynth.training.task import Task

VALIDATION_SEED = 1_000_003  # of streets that are never trained on
IMAGES = 16
FEWEST = 8  # of the beams, one in so many is the least that a completion is judged from


class Monitor:
    """Looks at images that are not trained on where there are such.

    data        what is trained on: a cache, or `synthetic`, for which streets of another seed are held out
    validation  cache of images that are not trained on; without one, a cache's curves are called `training_images`
    """

    def __init__(self, experiment: Experiment, task: Task, data: str | Path, validation: str | Path | None = None):
        self._experiment = experiment
        self._task = task
        self._source = validation or data
        held_out = validation is not None or bool(words_of(data))
        self._name = "validation" if held_out else "training_images"
        self._images: list[RangeImage] = []
        if validation is not None:  # now, and not in 5,000 steps
            images = open_images(validation, experiment, VALIDATION_SEED)
            found, expected = ((s.height, s.width) for s in (images.sensor, build_sensor(experiment)))
            if not words_of(data) and not words_of(validation):
                SeveralCaches([*folders_of(data), *folders_of(validation)])  # refuses another sensor's
            elif experiment.model.network != CASCADE and found != expected:
                raise ValueError(f"{validation}: expected images of {expected[0]} x {expected[1]}, "
                                 f"found {found[0]} x {found[1]}")  # fmt: skip
            try:
                task.suits(experiment, images, False)
            except ValueError as error:
                raise ValueError(f"{validation}: {error}") from None

    def look(self, network: nn.Module, step: int, journal: Journal) -> dict[str, float]:
        """The task's numbers and pictures of the averaged weights, into the journal; and the numbers."""
        self._images = self._images or _spread(self._experiment, self._source)
        values = self._task.judge(self._experiment, network, self._images)
        values = {f"{self._name}/{name}": float(value) for name, value in values.items()}
        journal.pictures(step, "sample", self._task.pictures(self._experiment, network, self._images))
        journal.judged(step, values)  # last: it tells a run that goes on that this look was a whole one
        return values


def _spread(experiment: Experiment, source: str | Path) -> list[RangeImage]:
    """At most IMAGES images from everywhere in a cache, or as many streets; none of which a few beams show nothing."""
    images = open_images(source, experiment, VALIDATION_SEED)
    if isinstance(images, Streets):
        return images.take(images.indices(0, IMAGES))
    chosen = images.take(images.spread(IMAGES))
    return [image for image in chosen if image.mask[::FEWEST].any()] or chosen
