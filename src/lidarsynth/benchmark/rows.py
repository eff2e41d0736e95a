"""What a benchmark finds: a record per row of the table, and how the scans of a row are made one by one and kept."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from lidarsynth.benchmark.store import Seconds, Store
from lidarsynth.lidar.scan import RangeImage

T = TypeVar("T")
Make = Callable[[range], tuple[Sequence[RangeImage], Seconds]]  # numbers of scans -> the scans, and what they took


@dataclass(frozen=True)
class Row:
    """One row of the table.

    group        the method, of which this may be one number of steps among several
    settings     everything that decides the scans
    count        how many scans were judged
    reports      protocol -> `Report.to_dict()`, or {"reason": why there is none}
    errors       measure -> its value for each scan, what is hidden with `hidden` before it
    seconds      what each scan took, by the clock and of the processor
    evaluations  of the network per scan, or None
    floor        whether the scans are real ones, or noise: a bound, no competitor
    reason       why there is nothing at all
    published    protocol -> row of the report -> value of the paper
    image        number -> a scan, for pictures
    """

    name: str
    group: str
    settings: Mapping[str, Any]
    count: int = 0
    reports: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    errors: Mapping[str, Sequence[float]] = field(default_factory=dict)
    seconds: Sequence[Seconds] = ()
    evaluations: int | None = None
    floor: bool = False
    reason: str = ""
    published: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    image: Callable[[int], RangeImage] | None = None

    def value(self, protocol: str, measure: str) -> float | None:
        """A number of a protocol's report, as its table shows it; None where N/A."""
        return self.reports.get(protocol, {}).get("values", {}).get(measure, {}).get("value")

    def why(self, protocol: str, measure: str) -> str:
        """Why a number is N/A."""
        report = self.reports.get(protocol, {})
        told = report.get("values", {}).get(measure, {}).get("reason", "")
        return self.reason or report.get("reason", "") or told

    def median(self, clock: str) -> float | None:
        """Seconds of a scan by a clock of `Seconds`; the first scans of a process are slower than the rest."""
        return float(np.median([getattr(each, clock) for each in self.seconds])) if self.seconds else None

    def to_dict(self) -> dict[str, Any]:
        """Plain tables for JSON."""
        keys = (
            "name",
            "group",
            "settings",
            "count",
            "evaluations",
            "floor",
            "reason",
            "published",
            "reports",
        )
        timing = {
            clock: {"median": self.median(clock), "each": [getattr(each, clock) for each in self.seconds]}
            for clock in Seconds._fields
        }
        told = {"seconds per scan": timing if self.seconds else None, "errors of each scan": dict(self.errors)}
        return {key: vars(self)[key] for key in keys} | told


class Declined(Exception):
    """A method cannot do what it is asked for; the text says why."""


def timed(call: Callable[[], T]) -> tuple[T, Seconds]:
    """What a method answers, and the seconds it took. Raises Declined where it raises ValueError."""
    start = time.perf_counter(), time.process_time()
    try:
        answer = call()
    except ValueError as error:
        raise Declined(str(error)) from None
    return answer, Seconds(time.perf_counter() - start[0], time.process_time() - start[1])


def fill_store(
    store: Store, stamps: Mapping[int, str], make: Make, batch: int = 1, on_done: Callable[[int], object] | None = None
) -> None:
    """Make the scans that the store lacks, `batch` at a time, and keep each with its share of the seconds.

    stamps   number of a scan -> what it is made of
    on_done  called with how many are there, at first too. Raises Declined as `make` does, and where its scans are no
             numbers.
    """
    todo = store.lacks(stamps)
    there = len(stamps) - len(todo)
    if on_done:
        on_done(there)
    for numbers in _runs(todo, batch):
        images, seconds = make(numbers)
        for i, image in zip(numbers, images, strict=True):
            if not (np.isfinite(image.range).all() and np.isfinite(image.reflectance).all()):
                raise Declined(f"scan {i}: expected finite numbers, found NaN or infinity")
            store.put(i, image, Seconds(*(value / len(numbers) for value in seconds)), stamps[i])
        there += len(numbers)
        if on_done:
            on_done(there)


def _runs(numbers: Iterable[int], size: int) -> list[range]:
    """Numbers as runs of at most `size` in a row."""
    runs: list[range] = []
    for i in numbers:
        if runs and runs[-1].stop == i and len(runs[-1]) < size:
            runs[-1] = range(runs[-1].start, i + 1)
        else:
            runs.append(range(i, i + 1))
    return runs
