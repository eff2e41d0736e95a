"""The text of `lidarsynth info`: what a model, a preset or a scan file is."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidarsynth.build import build_network
from lidarsynth.data.files import READERS, read_with_report
from lidarsynth.data.recognise import recognise
from lidarsynth.experiment import Experiment
from lidarsynth.presets import PRESETS
from lidarsynth.weights import load_parts


def describe(what: str) -> str:
    """Lines about a scan file, a preset, or weights in any form that `load` takes. Raises ValueError for others."""
    path = Path(what)
    if any(path.name.lower().endswith(suffix) for suffix in READERS):
        return describe_scan(path)
    if what in PRESETS and what != "default":
        experiment = PRESETS[what]()
        return describe_model(experiment, build_network(experiment), "preset, no weights")
    return describe_model(*load_parts(what), source=what)


def describe_scan(path: Path) -> str:
    """Points, range, reflectance, rings and sensor of a scan file."""
    scan, dropped = read_with_report(path)
    name, reason = recognise(scan)
    depth = np.linalg.norm(scan.xyz, axis=1)
    lines = {
        "points": f"{len(scan)}" + (f" ({dropped} without a return dropped)" if dropped else ""),
        "range": f"{depth.min():.2f} to {depth.max():.2f} m, median {np.median(depth):.2f} m",
        "reflectance": f"{scan.reflectance.min():.2f} to {scan.reflectance.max():.2f}, mean {scan.reflectance.mean():.3f}",
        "fields": "x y z reflectance" + "".join(f" {f}" for f in ("ring", "time", "label") if getattr(scan, f) is not None),
        "sensor": f"{name} ({reason})" if name else reason,
    }
    return _table(str(path), lines)


def describe_model(experiment: Experiment, network, source: str) -> str:
    """Network, sensor, diffusion, training, licence, history and results of a model."""
    data, model, diffusion, training = experiment.data, experiment.model, experiment.diffusion, experiment.training
    sensor = data.sensor if isinstance(data.sensor, str) else data.sensor.get("name", "own")
    count = sum(parameter.numel() for parameter in network.parameters())
    lines = {
        "from": source,
        "parameters": f"{count:,}",
        "network": f"{model.network}, base {model.base_channels} x {model.channel_multipliers}, "
        f"blocks {model.num_residual_blocks}, stem {model.stem[0]}x{model.stem[1]}, {model.coords_encoding}",
        "images": f"{data.height} x {data.width}, {sensor}, {data.projection} projection, {data.codec} range",
        "diffusion": f"{diffusion.schedule} schedule, predicts {diffusion.kind}, {diffusion.loss} loss",
        "training": f"{training.steps:,} steps of {training.batch_size}, learning rate {training.learning_rate:g}",
    }
    card = experiment.card
    lines |= {k: v for k, v in {"learned from": card.data, "licence": card.licence}.items() if v}
    lines |= {f"history {i}": line for i, line in enumerate(card.history, 1)}
    lines |= {f"result {i}": line for i, line in enumerate(card.results, 1)}
    return _table(experiment.name, lines)


def _table(title: str, lines: dict[str, str]) -> str:
    width = max(map(len, lines)) + 2
    return "\n".join([title, *(f"  {key:<{width}}{value}" for key, value in lines.items())])
