"""The texts that verbs print: what a model, a preset, a sensor or a scan file is, and tables of errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from lidarsynth.experiment.folder import RECORD
from lidarsynth.experiment.presets import PRESETS
from lidarsynth.experiment.record import Adversarial, Experiment, Segmentation, Upsampling
from lidarsynth.experiment.upsampling_presets import WITHOUT_WEIGHTS
from lidarsynth.files.formats import READERS, read_with_report
from lidarsynth.lidar.recognition import recognise
from lidarsynth.lidar.sensor import SENSORS, Sensor, get_sensor
from lidarsynth.metrics.reconstruction import Errors, mean_errors
from lidarsynth.systems.build import GANS, UPSAMPLERS, build_discriminator, build_network
from lidarsynth.weights.load import load_parts, shipped


def describe(what: str) -> str:
    """Lines about a scan file, a sensor, a preset, or weights as `load` takes them. Raises ValueError for others."""
    path = Path(what)
    if path.name.lower().endswith(tuple(READERS)) and not (path.is_dir() and (path / RECORD).exists()):
        return describe_scan(path)
    if what in SENSORS or (path.suffix in (".toml", ".json") and path.name != RECORD):
        return describe_sensor(get_sensor(what))
    if what in PRESETS and what not in shipped() and not path.is_dir():
        experiment = PRESETS[what]()
        return describe_model(experiment, build_network(experiment), "preset, no weights")
    return describe_model(*load_parts(what), source=what)


def describe_scan(path: Path) -> str:
    """Points, range, reflectance, rings and sensor of a scan file."""
    scan, dropped = read_with_report(path)
    name, reason = recognise(scan)
    depth, light = np.linalg.norm(scan.xyz, axis=1), scan.reflectance
    lines = {
        "points": f"{len(scan)}" + (f" ({dropped} without a return dropped)" if dropped else ""),
        "range": f"{depth.min():.2f} to {depth.max():.2f} m, median {np.median(depth):.2f} m",
        "reflectance": f"{light.min():.2f} to {light.max():.2f}, mean {light.mean():.3f}",
        "fields": "x y z reflectance"
        + "".join(f" {f}" for f in ("ring", "time", "label") if getattr(scan, f) is not None),
        "sensor": f"{name} ({reason})" if name else reason,
    }
    return _table(str(path), lines)


def describe_sensor(sensor: Sensor) -> str:
    """Beams, columns and limits of a sensor."""
    steps = -np.diff(sensor.elevations)
    spacing = f", {steps.min():.2f} to {steps.max():.2f} degrees apart" if len(steps) else ""
    lines = {
        "beams": f"{sensor.height} from {sensor.elevations[0]:+.2f} to {sensor.elevations[-1]:+.2f} degrees{spacing}",
        "columns": f"{sensor.width}, {360 / sensor.width:.3f} degrees apart",
        "range": f"{sensor.min_range:g} to {sensor.max_range:g} m",
        "mount": f"{sensor.mount:g} m above the road",
    }
    return _table(sensor.name, lines)


def describe_model(experiment: Experiment, network, source: str) -> str:
    """Network, sensor, diffusion, training, licence, history and results of a model."""
    data, training = experiment.data, experiment.training
    if experiment.model.network in WITHOUT_WEIGHTS:
        return _table(experiment.name, _interpolation(experiment))
    sensor = data.sensor if isinstance(data.sensor, str) else data.sensor.get("name", "own")
    count = sum(parameter.numel() for parameter in network.parameters())
    lines = {
        "from": source,
        "parameters": f"{count:,}",
        "network": FAMILIES.get(experiment.model.network, _other)(experiment),
        "images": f"{data.height} x {data.width}, {sensor}, {data.projection} projection, {data.codec} range",
        **_diffusion(experiment),
        "training": f"{training.steps:,} steps of {training.batch_size}, learning rate {training.learning_rate:g}",
    }
    card = experiment.card
    lines |= {k: v for k, v in {"learned from": card.data, "licence": card.licence}.items() if v}
    lines |= {f"history {i}": line for i, line in enumerate(card.history, 1)}
    lines |= {f"result {i}": line for i, line in enumerate(card.results, 1)}
    return _table(experiment.name, lines)


def _unet(experiment: Experiment) -> str:
    model = experiment.model
    shape = f"base {model.base_channels} x {model.channel_multipliers}, blocks {model.num_residual_blocks}"
    return f"{model.network}, {shape}, stem {model.stem[0]}x{model.stem[1]}, {model.coords_encoding}"


def _refinenet(experiment: Experiment) -> str:
    return f"refinenet of LiDARGen, base {experiment.model.base_channels}, column and row as coordinates"


def _rangenet(experiment: Experiment) -> str:
    layers = (experiment.segmentation or Segmentation()).layers
    return f"RangeNet-{layers}, width {experiment.model.base_channels}: a class for every pixel, makes no scans"


def _other(experiment: Experiment) -> str:
    return experiment.model.network


def _gan(experiment: Experiment) -> str:
    group, model = experiment.adversarial or Adversarial(), experiment.model
    made = f"latents of {group.latent_channels}, base {model.base_channels}, at most {group.max_channels} channels"
    return f"generator of {model.network}, {made}; range only"


def _upsampling(experiment: Experiment) -> str:
    model, group = experiment.model, experiment.upsampling or Upsampling()
    if model.network == "lidar-sr":
        program = "Keras" if group.keras else "PyTorch"
        return f"lidar-sr ({program}), base {model.base_channels}, dropout {model.dropout:g}; range only"
    size = f"{sum(model.num_residual_blocks)} blocks of {model.base_channels} channels"
    layers = f", {group.depth} layers of {model.attn_num_heads} heads" if model.network == "iln" else ""
    return f"{model.network}, {size}{layers}; range only"


def _shown(experiment: Experiment) -> dict[str, str]:
    """What a network that puts beams between known ones is shown, and how it answers."""
    group, height = experiment.upsampling or Upsampling(), experiment.data.height
    rows = f"{height // group.factor[0]} to {height} rows (beams:{group.factor[0]}:{group.first})"
    range_ = f"1 is {group.norm:g} m, up to {group.max_range:g} m, no return is {0 if group.keras else 1}"
    if experiment.model.network != "lidar-sr":
        return {"upsampling": f"{rows}, and any other known beams and rays; {range_}"}
    answer = f"mean of {group.passes} passes under dropout, empty where they vary by more than {group.threshold:.0%}"
    return {"upsampling": f"{rows}; {range_}; {answer}"}


def _interpolation(experiment: Experiment) -> dict[str, str]:
    """An interpolation has nothing but its settings."""
    word = experiment.model.network
    rows = {
        "nearest": "the value of the nearest known row",
        "bilinear": "linear between the known rows above and below",
        "bicubic": "cubic convolution (a = -0.75) of four known rows",
    }
    cross = "nearest known pixels up, down, left and right, by 1 / distance"
    return {
        "parameters": "0, nothing to train",
        "values": "range in metres and reflectance, an empty pixel is 0; measured pixels stay, the azimuth is a ring",
        "whole beams": f"{rows[word]}; measured rows stay where they are, beyond the outermost their values repeat",
        "other masks": "nearest known pixel" if word == "nearest" else cross,
        "images": "those of any sensor, default hdl-64e-kitti",
    }


FAMILIES: dict[str, Callable[[Experiment], str]] = {  # word of a network -> what it is made of
    "efficient-unet": _unet,
    "conditional-unet": _unet,
    "rangenet": _rangenet,
    "refinenet": _refinenet,
    **dict.fromkeys(GANS, _gan),
    **dict.fromkeys(UPSAMPLERS, _upsampling),
}


def _diffusion(experiment: Experiment) -> dict[str, str]:
    diffusion, score = experiment.diffusion, experiment.score
    if experiment.model.network == "rangenet":
        return {}
    if experiment.model.network in GANS:
        return _discriminator(experiment)
    if experiment.model.network in UPSAMPLERS:
        return _shown(experiment)
    if score is None:
        return {"diffusion": f"{diffusion.schedule} schedule, predicts {diffusion.kind}, {diffusion.loss} loss"}
    return {
        "score matching": f"{score.levels} noise levels, sigma {score.sigma_max:g} to {score.sigma_min:g} of data in "
        f"[0, 1]; sampled in {score.steps} Langevin steps at each",
    }


def _discriminator(experiment: Experiment) -> dict[str, str]:
    with torch.device("meta"):  # counted without memory
        count = sum(parameter.numel() for parameter in build_discriminator(experiment).parameters())
    group = experiment.adversarial or Adversarial()
    r1 = f"R1 of weight {group.r1_weight:g} every {group.r1_every} steps" if group.r1_weight else "no R1"
    return {"discriminator": f"{count:,} parameters, in training only; {r1}"}


def errors_table(title: str, errors: Mapping[str, Errors]) -> str:
    """Range and reflectance MAE by method, over the hidden pixels, empty ones as 0 m and reflectance 0."""
    pixels = next(iter(errors.values())).pixels
    lines = [f"{title}: errors of the {pixels:,} hidden pixels, an empty pixel counts as 0 m"]
    lines.append(f"  {'method':<12}{'range MAE':>11}{'reflectance MAE':>18}")
    lines += [f"  {name:<12}{e.range_mae:>9.3f} m{e.reflectance_mae:>18.4f}" for name, e in errors.items()]
    return "\n".join(lines)


def mean_table(tables: Sequence[Mapping[str, Errors]]) -> str:
    """`errors_table` of the mean over scans."""
    means = {name: mean_errors([table[name] for table in tables]) for name in tables[0]}
    return errors_table(f"mean of {len(tables)} scans", means)


def _table(title: str, lines: dict[str, str]) -> str:
    width = max(map(len, lines)) + 2
    return "\n".join([title, *(f"  {key:<{width}}{value}" for key, value in lines.items())])
