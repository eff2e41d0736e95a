"""What may be asked of a cascade's completion, and with what it answers where nothing is said."""

from __future__ import annotations

from dataclasses import replace

from lidarsynth.diffusion import repaint
from lidarsynth.systems.cascade.layout import STEPS_DEFAULT
from lidarsynth.systems.filling import Filling

METHODS = ("auto", "conditional", "sample", "repaint")
RESAMPLES_DEFAULT = 10


def resolved(how: Filling, name: str) -> Filling:
    """The request with all that was left open, as `CascadeModel.resolved` says. Raises ValueError, with the model's
    name, for other words, and for what the method would ignore."""
    if how.method not in METHODS:
        raise ValueError(f"{name}: expected a method of {', '.join(METHODS)}, found {how.method!r}")
    how.at_least_one().without("sampler", reason="since repaint takes ancestral steps and the fill is one")
    if how.method == "repaint":
        return replace(how, steps=how.steps or STEPS_DEFAULT, resamples=how.resamples or RESAMPLES_DEFAULT)
    how.without("resamples", reason="which only repaint has")
    if how.steps not in (None, 1):
        raise ValueError(f"{name}: expected 1 step, for the fill is one, found {how.steps}")
    return replace(how, method="conditional" if how.method == "auto" else how.method, steps=1)


def calls(how: Filling) -> int:
    """How many network evaluations a resolved request takes."""
    if how.method != "repaint":
        return 1
    assert how.steps is not None and how.resamples is not None
    return 1 + repaint.evaluations(how.steps, how.resamples)
