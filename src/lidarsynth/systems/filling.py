"""What is asked of a model that fills a scan: one record, validated once, by the system that gets it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from operator import index

OnStep = Callable[[], object] | None  # called after every network step, for progress bars


def whole(name: str, number: int) -> int:
    """The number as Python's own. Raises ValueError for one that is not whole."""
    try:
        return index(number)
    except TypeError:
        raise ValueError(f"expected {name} that is a whole number, found {number!r}") from None


def check_counts(n: int, steps: int, batch_size: int, first: int) -> None:
    """Raises ValueError for numbers of scans and steps that are not whole, or too small."""
    for name, number in (("n", n), ("batch_size", batch_size), ("first", first)):
        whole(name, number)
    if min(n, steps, batch_size) < 1:
        raise ValueError(f"expected n, steps and batch_size of at least 1, found {n}, {steps}, {batch_size}")
    if first < 0:
        raise ValueError(f"expected first of at least 0, found {first}")


@dataclass(frozen=True)
class Filling:
    """How the hidden pixels of a scan are to be filled. What is None is the system's own choice.

    method     a word of the system, or `auto`
    steps      of the network
    resamples  passes over each step of repaint
    sampler    a word of the system
    seed       of all randomness
    precision  auto, fp32 or bf16, as `ScanModel.at_precision` says; None = what the model is at
    removed    classes that are taken away first, as `lidar.removal.removable` gives them; None = all stays

    A system's `resolved` says what becomes of it, and raises ValueError for what the system would have to ignore.
    """

    method: str = "auto"
    steps: int | None = None
    resamples: int | None = None
    sampler: str | None = None
    seed: int = 0
    precision: str | None = None
    removed: tuple[str, ...] | None = None

    def at_least_one(self) -> Filling:
        """The same. Raises ValueError for counts below 1."""
        for name in ("steps", "resamples"):
            if (number := getattr(self, name)) is not None and whole(name, number) < 1:
                raise ValueError(f"expected {name} of at least 1, found {number}")
        return self

    def without(self, *names: str, reason: str) -> Filling:
        """The same. Raises ValueError, giving the reason, where one of these fields is not None."""
        for name in names:
            if (value := getattr(self, name)) is not None:
                raise ValueError(f"expected no {name}, {reason}, found {value!r}")
        return self
