"""The texts that verbs print: what a model, a preset, a sensor or a scan file is, and tables of errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lidarsynth.experiment.presets import PRESETS
from lidarsynth.experiment.record import RECORD, Experiment
from lidarsynth.experiment.upsampling_presets import WITHOUT_WEIGHTS
from lidarsynth.lidar.plural import plural
from lidarsynth.lidar.sensor import WORDS, Sensor, get_sensor
from lidarsynth.systems.description import training_line
from lidarsynth.verbs.file_kinds import file_lines
from lidarsynth.verbs.inputs import Reading

if TYPE_CHECKING:
    from lidarsynth.metrics.reconstruction import Errors


def describe(what: str, reading: Reading | None = None) -> str:
    """Lines about a scan file, a sensor, a preset, or weights as `load` takes them. Raises ValueError for others.

    reading  how scans are read; where it moves points or takes rings of them, what holds no scan is refused
    """
    path, reading = Path(what), reading or Reading()
    if lines := file_lines(path, reading):
        return _table(str(path), lines)
    if reading.moves:
        raise ValueError(f"{what}: expected a scan to move or take rings of, found a word, a sensor or a model")
    if what in WORDS or (path.suffix in (".toml", ".json") and path.name != RECORD):
        return describe_sensor(get_sensor(what))
    from lidarsynth.systems.table import build_network  # torch takes seconds, which no file above needs
    from lidarsynth.weights.load import RELEASES, load_parts, shipped

    if what in PRESETS and what not in shipped() and not path.is_dir():
        experiment = PRESETS[what]()
        return describe_model(experiment, build_network(experiment), "preset, no weights")
    try:
        parts = load_parts(what)
    except ValueError as error:
        near = get_close_matches(what.lower(), {*WORDS, *PRESETS, *shipped(), *RELEASES}, n=1)
        if not near or near[0] == what.removesuffix("-300k") or path.exists():  # as `load` takes the word
            raise
        raise ValueError(f"{error}; was {near[0]} meant?") from None
    return describe_model(*parts, source=what)


def describe_sensor(sensor: Sensor) -> str:
    """Beams, columns and limits of a sensor."""
    steps = -np.diff(sensor.elevations)
    spacing = f", {steps.min():.2f} to {steps.max():.2f} degrees apart" if len(steps) else ""
    lines = {
        "kind": "sensor",
        "beams": f"{sensor.height} from {sensor.elevations[0]:+.2f} to {sensor.elevations[-1]:+.2f} degrees{spacing}",
        "columns": f"{sensor.width}, {360 / sensor.width:.3f} degrees apart",
        "range": f"{sensor.min_range:g} to {sensor.max_range:g} m",
        "mount": f"{sensor.mount:g} m above the road",
    }
    if any(sensor.tilt):
        lines["tilt"] = f"nose {sensor.tilt[0]:+g} and left side {sensor.tilt[1]:+g} degrees up"
    if sensor.blocked:
        lines["blocked"] = f"{sensor.blocked_rays().mean():.1%} of the rays, by its carrier or out of its view"
    return _table(sensor.name, lines)


def describe_model(experiment: Experiment, network, source: str) -> str:
    """Network, sensor, diffusion, training, licence, history and results of a model."""
    from lidarsynth.systems.table import system_of

    data, system = experiment.data, system_of(experiment)
    if experiment.model.network in WITHOUT_WEIGHTS:
        return _table(experiment.name, system.description.details(experiment))
    sensor = data.sensor if isinstance(data.sensor, str) else data.sensor.get("name", "own")
    count = sum(parameter.numel() for parameter in network.parameters())
    lines = {
        "from": source,
        "parameters": f"{count:,}",
        "network": system.description.network(experiment),
        "images": f"{data.height} x {data.width}, {sensor}, {data.projection} projection, {data.codec} range",
        **system.description.details(experiment),
        "training": training_line(experiment),
    }
    card = experiment.card
    lines |= {k: v for k, v in {"learned from": card.data, "licence": card.licence}.items() if v}
    lines |= {f"history {i}": line for i, line in enumerate(card.history, 1)}
    lines |= {f"result {i}": line for i, line in enumerate(card.results, 1)}
    return _table(experiment.name, lines)


def errors_table(title: str, errors: Mapping[str, Errors]) -> str:
    """Range and reflectance MAE by method, over the hidden pixels, empty ones as 0 m and reflectance 0."""
    pixels = next(iter(errors.values())).pixels
    lines = [f"{title}: errors of the {pixels:,} hidden pixels, an empty pixel counts as 0 m"]
    lines.append(f"  {'method':<12}{'range MAE':>11}{'reflectance MAE':>18}")
    shades = ("none" if math.isnan(e.reflectance_mae) else f"{e.reflectance_mae:.4f}" for e in errors.values())
    lines += [
        f"  {n:<12}{e.range_mae:>9.3f} m{shade:>18}" for (n, e), shade in zip(errors.items(), shades, strict=True)
    ]
    return "\n".join(lines)


def mean_table(tables: Sequence[Mapping[str, Errors]]) -> str:
    """`errors_table` of the mean over scans."""
    from lidarsynth.metrics.reconstruction import mean_errors

    means = {name: mean_errors([table[name] for table in tables]) for name in tables[0]}
    return errors_table(f"mean of {plural(len(tables), 'scan')}", means)


def _table(title: str, lines: dict[str, str]) -> str:
    width = max(map(len, lines)) + 2
    return "\n".join([title, *(f"  {key:<{width}}{value}" for key, value in lines.items())])
