"""Generation: every method's set of new scans is compared with one set of measured ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidarsynth.benchmark.config import Generation, GenerationMethod, protocols_of
from lidarsynth.benchmark.evaluation_counts import generation_evaluations
from lidarsynth.benchmark.published import published
from lidarsynth.benchmark.rows import Declined, Row, fill_store, timed
from lidarsynth.benchmark.setup import OnDone, Setup
from lidarsynth.benchmark.sources import located
from lidarsynth.benchmark.store import Seconds, Store
from lidarsynth.evaluation.evaluate import evaluate
from lidarsynth.evaluation.image_sets import ImageSet, image_set, sensor_of
from lidarsynth.evaluation.protocols import get_protocol
from lidarsynth.evaluation.statistics import GATHERED, definition
from lidarsynth.lidar.depth import from_x_0
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor, get_sensor
from lidarsynth.systems.scan_model import ScanModel

Draw = Callable[[int, int], list[RangeImage]]  # seed of the first scan, how many -> scans
DECIDING = ("noise", "steps", "sampler")  # keys of a method that decide its scans


def drawer(
    method: GenerationMethod, model: ScanModel | None, sensor: Sensor, on_step: Callable[..., None] | None = None
) -> Draw:
    """What makes new scans: a model with the method's settings, or noise as `sensor` would see it.

    on_step  called after every network step with how many scans it was for
    """
    if model is None:
        return lambda seed, count: [noise(sensor, seed + i) for i in range(count)]
    given: dict[str, Any] = {key: vars(method)[key] for key in ("steps", "sampler") if vars(method)[key] is not None}

    def draw(seed: int, count: int) -> list[RangeImage]:
        tell = None if on_step is None else partial(on_step, model.at_once(count))
        images = model.generate(count, seed=seed, batch_size=count, on_step=tell, **given)
        if model.experiment.data.reflectance:
            return images
        return [replace(image, reflectance=np.zeros_like(image.reflectance)) for image in images]

    return draw


def noise(sensor: Sensor, seed: int) -> RangeImage:
    """x_1 ~ N(0, I), clamped to [-1, 1], as a scan: what sampling starts from, and the worst a table can show."""
    generator = torch.Generator().manual_seed(seed)
    return from_x_0(torch.randn(2, sensor.height, sensor.width, generator=generator).clamp(-1, 1), sensor)


def generation_row(
    setup: Setup, config: Generation, group: str, method: GenerationMethod, reference: ImageSet, sensor: Sensor
) -> Row:
    """Make the scans and judge them; of a method that cannot, a row with the reason."""
    model, word = setup.model(method.model), method.samples or method.held_out
    deciding = setup.settings(method, DECIDING) | {"seed": config.seed}
    if model is not None and model.any_sensor and model.sensor != sensor:
        model, deciding = model.into(sensor), deciding | {"sensor": sensor.to_dict()}
    if word:
        deciding = {"scans": word, "held out": method.held_out is not None}
    if method.noise:
        deciding |= {"sensor": sensor.to_dict()}
    row = Row(method.name, group, deciding, floor=method.noise or method.held_out is not None)
    store = setup.store(word or method.model or "noise", deciding)
    count, evaluations = method.count or config.count, None
    image = store.image
    if word:
        samples = located(word, setup.folder, config.sensor, setup.on_images)
        made = image_set(samples)
        own = sensor_of(made.item(0), sensor)
        count, image = len(made), lambda i: made.image(i, own, "auto")
    else:
        try:
            evaluations, _ = timed(lambda: generation_evaluations(model, method) if model else None)
            batch = setup.batch_size if setup.device != "cpu" else model.together if model else 1
            calls = model.generation_steps(method.steps_asked, method.sampler) if model else 1
            on_done, on_step = setup.stepwise(method.name, count, calls)
            _make(drawer(method, model, sensor, on_step), store, count, config.seed, batch, on_done)
        except Declined as reason:
            return replace(row, reason=str(reason))
        samples = store.folder
    kept = samples if word or store.count() == count else [store.image(i) for i in range(count)]
    return replace(
        row,
        count=count,
        reports={name: _judged(setup, config, name, kept, reference, sensor, store) for name in protocols_of(config)},
        seconds=() if word or method.noise else store.seconds(count),
        evaluations=evaluations,
        published={name: published(name, method.published, reference.names, "") for name in protocols_of(config)},
        image=image,
    )


def _make(draw: Draw, store: Store, count: int, seed: int, batch: int, on_done: OnDone) -> None:
    """Scans of any number depend on seed + number only, so that more of them go on where fewer ended."""

    def make(numbers: range) -> tuple[list[RangeImage], Seconds]:
        return timed(lambda: draw(seed + numbers.start, len(numbers)))

    fill_store(store, dict.fromkeys(range(count), ""), make, batch, on_done)


def _judged(
    setup: Setup,
    config: Generation,
    name: str,
    samples: Path | Sequence[RangeImage],
    reference: ImageSet,
    sensor: Sensor,
    store: Store,
) -> dict[str, Any]:
    """A protocol's report; one that lacks a network is made again, since it may be there the next time.

    sensor  of samples that are points, where the file names none
    """
    protocol = get_protocol(name)

    def judge() -> dict[str, Any]:
        try:
            report = evaluate(samples, reference.source, name, config.sensor, config.seed,
                              device=setup.device, on_images=setup.on_images)  # fmt: skip
        except ValueError as error:
            return {"reason": str(error)}
        return report.to_dict()

    if not isinstance(samples, Path):
        return judge()

    def final(report: dict[str, Any]) -> bool:
        return "values" in report and all(report["values"][r.name]["value"] is not None for r in protocol.rows)

    images, named = image_set(samples), get_sensor(config.sensor) if config.sensor else None
    try:
        width = images.sensor(named or sensor).width
        if protocol.clouds:  # drawn for its networks as its own sensor sees them
            width = named.width if named else protocol.width
        weights = setup.weights(name, width)
    except ValueError as error:
        return {"reason": str(error)}
    told = named and named.to_dict()  # what its file says now, not only how it is called
    key = [definition(protocol), images.stamp, reference.stamp, config.seed, told, weights, GATHERED]
    return store.report(key, judge, final)
