"""Upsampling and completion: every method fills the same hidden pixels of the same scans."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidarsynth.benchmark.config import Upsampling, UpsamplingMethod, protocols_of
from lidarsynth.benchmark.evaluation_counts import completion_evaluations
from lidarsynth.benchmark.published import published
from lidarsynth.benchmark.rows import Declined, Row, fill_store, timed
from lidarsynth.benchmark.setup import Setup
from lidarsynth.benchmark.sources import Corrupted
from lidarsynth.benchmark.store import Seconds, Store
from lidarsynth.evaluation.image_sets import emptied
from lidarsynth.evaluation.pairs import Pairs, classes_of
from lidarsynth.evaluation.protocols import get_protocol
from lidarsynth.evaluation.statistics import GATHERED, definition
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.metrics.reconstruction import reconstruction_errors
from lidarsynth.systems.interpolation.model import interpolated
from lidarsynth.systems.scan_model import OnStep, ScanModel

Fill = Callable[[RangeImage, np.ndarray, int], RangeImage]  # image without the hidden pixels, known (H, W), seed
ERRORS = ("range MAE", "reflectance MAE", "hidden range MAE", "hidden reflectance MAE")  # of each scan
DECIDING = ("interpolation", "method", "steps", "resamples", "sampler")  # keys of a method that decide its scans


def filler(method: UpsamplingMethod, model: ScanModel | None, on_step: OnStep = None) -> Fill:
    """What fills a scan: an interpolation, or a model with the method's settings."""
    if model is None:
        return lambda before, known, seed: interpolated(before, known, method.interpolation or "")
    given: dict[str, Any] = {key: vars(method)[key] for key in DECIDING if vars(method)[key] is not None}
    given["on_step"] = on_step

    def fill(before: RangeImage, known: np.ndarray, seed: int) -> RangeImage:
        filled = replace(model.complete(before, known, seed=seed, **given), sensor=before.sensor)
        return (
            filled
            if model.experiment.data.reflectance
            else replace(filled, reflectance=np.zeros_like(filled.reflectance))
        )

    return fill


@dataclass(frozen=True)
class Problem:
    """What all methods are given.

    stamps  of every scan, see `Corrupted.stamps`
    shown   number of the scan in the figure, which slow methods fill too
    """

    config: Upsampling
    data: Corrupted
    stamps: dict[int, str]
    shown: int


def upsampling_row(setup: Setup, problem: Problem, group: str, method: UpsamplingMethod) -> Row:
    """Fill the scans and judge them; of a method that cannot, a row with the reason."""
    config, data, stamps = problem.config, problem.data, problem.stamps
    model, count = setup.model(method.model), min(method.images or len(data), len(data))
    deciding = setup.settings(method, DECIDING) | {"corruption": config.corruption, "seed": config.seed}
    row = Row(method.name, group, deciding)
    store = setup.store(method.model or method.interpolation or "", deciding)

    def make(numbers: range) -> tuple[list[RangeImage], Seconds]:
        truth, known = data[numbers.start]
        before = truth.keep(known)
        try:
            filled, seconds = timed(lambda: fill(before, known, config.seed + numbers.start))
        except Declined as reason:
            raise Declined(f"{reason} ({data.names[numbers.start]})") from None
        return [filled], seconds

    try:
        evaluations, _ = timed(lambda: completion_evaluations(model, method) if model else 0)
        needed = {i: stamp for i, stamp in stamps.items() if i < count or i == problem.shown}
        on_done, on_step = setup.stepwise(method.name, len(needed), evaluations)
        fill = filler(method, model, on_step)
        fill_store(store, needed, make, on_done=on_done)
    except Declined as reason:
        return replace(row, reason=str(reason))
    word = method.published or method.interpolation
    judged = {name: _judged(setup, name, data, store, list(stamps.values())[:count]) for name in protocols_of(config)}
    return replace(
        row,
        count=count,
        reports={name: found["report"] for name, found in judged.items()},
        errors=next(iter(judged.values()))["errors"],
        seconds=store.seconds(count),
        evaluations=evaluations,
        published={name: published(name, word, data.names, config.corruption) for name in judged},
        image=store.image,
    )


def _judged(setup: Setup, name: str, data: Corrupted, store: Store, stamps: Sequence[str]) -> dict[str, Any]:
    """A protocol's report, or why there is none, and the errors of each scan."""
    protocol, judges = get_protocol(name), setup.judges(name, data.sensor.width)

    def judge() -> dict[str, Any]:
        pairs, errors = Pairs(protocol, classes_of(judges.networks), setup.seen(name, data.sensor.width)), []
        lacking = ""
        for i in range(len(stamps)):
            (truth, known), filled = data[i], emptied(store.image(i))
            try:
                pairs.update([filled], [truth])
            except ValueError as error:  # a scan of which the protocol says nothing, such as of no point
                lacking = lacking or f"{data.names[i]}: {error}"
            both = [reconstruction_errors(filled, truth, where) for where in (None, ~known)]
            errors.append([error for e in both for error in (e.range_mae, e.reflectance_mae)])
            if setup.on_images:
                setup.on_images("judge", i + 1, len(stamps))
        report = {"reason": lacking} if lacking else pairs.report(judges.missing, judges.weights).to_dict()
        columns = dict(zip(ERRORS, map(list, zip(*errors, strict=True)), strict=True))
        return {"report": report, "errors": {k: v for k, v in columns.items() if pairs.lit or "reflectance" not in k}}

    key = [definition(protocol), list(stamps), judges.weights, GATHERED]
    return store.report(key, judge, lambda judged: "values" in judged["report"])
