"""What may be asked of a cascade, with what it answers where nothing is said, and whose scans it draws less well."""

from __future__ import annotations

import warnings
from dataclasses import replace

from lidarsynth.diffusion import repaint
from lidarsynth.lidar.sensor import Sensor, UnlikelySensorWarning
from lidarsynth.systems.cascade.layout import STEPS_DEFAULT
from lidarsynth.systems.filling import Filling

METHODS = ("auto", "conditional", "sample", "repaint")
RESAMPLES_DEFAULT = 10
HIGHEST = 5.0  # metres; layouts have learned from 1.2 to 2.5: seen from 4 half of the returns are ground, as in streets


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


def warn_of_height(sensor: Sensor) -> None:
    """Warns where a sensor stands higher than what layouts have learned of allows: its scans have too little ground."""
    if sensor.mount > HIGHEST:
        warnings.warn(f"expected a sensor up to {HIGHEST:g} m above the road to generate, found {sensor.name} at "
                      f"{sensor.mount:g} m: scans have far too little ground and too much of walls; `streets` casts "
                      "such scans", UnlikelySensorWarning, stacklevel=3)  # fmt: skip
