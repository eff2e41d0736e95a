"""What the cascade brings: one model for any sensor."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from lidarsynth.experiment.record import Experiment, Model
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.semantic_kitti import CLASSES
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.between_beams import BetweenBeams
from lidarsynth.networks.between_columns import BetweenColumns
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.class_unet import ClassUNet
from lidarsynth.networks.coarse_unet import CoarseUNet
from lidarsynth.networks.column_transformer import ColumnTransformer
from lidarsynth.networks.fill_unet import FillUNet
from lidarsynth.networks.grid_judge import GridJudge
from lidarsynth.networks.tensors import load_weights
from lidarsynth.systems.cascade.description import DESCRIPTION
from lidarsynth.systems.cascade.graph import fill_graph
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.cascade.training import CASCADE as TASK
from lidarsynth.systems.sizes import check_multiples, check_unet
from lidarsynth.systems.system import System


def build(experiment: Experiment, sensor: Sensor) -> Cascade:
    """All networks; none knows a sensor.

    Raises ValueError for other numbers of blocks from level to level of the coarse stage, for other than four of the
    likeliest fill, and for slopes of openness other than six.
    """
    model, width = experiment.model, experiment.model.base_channels
    _check(model)
    if len(set(model.num_residual_blocks)) > 1:
        raise ValueError(f"model.num_residual_blocks: expected as many at each level of a cascade, found "
                         f"{model.num_residual_blocks}")  # fmt: skip
    if len(model.likeliest_blocks) != 4:
        raise ValueError(f"model.likeliest_blocks: expected four numbers, found {model.likeliest_blocks}")
    if len(model.judge_openness) not in (0, 6):
        raise ValueError(f"model.judge_openness: expected six numbers or none, found {model.judge_openness}")
    shape = model.channel_multipliers, model.num_residual_blocks[0], model.noisiest
    coarse, guide = (CoarseUNet(channels, *shape) if channels else None for channels in (width, model.guide_channels))
    assert coarse is not None
    widths = _widths(width)
    fill = FillUNet(widths, classes=model.classes)
    likeliest = FillUNet(widths, model.likeliest_blocks) if model.likeliest else None
    observer = FillUNet(_sixteens(_widths(model.observer_channels))) if model.observer_channels else None
    columns = ColumnTransformer(model.column_channels) if model.column_channels else None
    between = BetweenColumns(model.between_channels) if model.between_channels else None
    beams = BetweenBeams(model.beam_channels) if model.beam_channels else None
    classes = ClassUNet(model.class_channels, classes=model.classes) if model.classes else None
    judge = GridJudge(model.judge_channels, model.judge_openness) if model.judge_channels else None
    inside = ClassUNet(model.inside_channels) if model.classes and model.inside_channels else None
    drawn = ClassUNet(model.drawn_channels, classes=model.classes) if model.classes and model.drawn_channels else None
    indoors = ClassUNet(model.indoors_channels) if inside is not None and model.indoors_channels else None
    named = classes, judge, inside, drawn, indoors
    return Cascade(coarse, fill, guide, columns, between, beams, likeliest, observer, *named)


def _check(model: Model) -> None:
    """Raises ValueError by the field for numbers that the networks cannot be built of, or learn by."""
    check_multiples({
        "model.base_channels": (model.base_channels, 16),  # a fill's widths are half as much again
        "model.guide_channels": (model.guide_channels, 8),
        "model.column_channels": (model.column_channels, 4),  # heads of attention
        "model.judge_channels": (model.judge_channels, 8),
    })  # fmt: skip
    check_unet(replace(model, gn_num_groups=8, attn_num_heads=8))  # the coarse stage has its own
    if model.classes not in (0, len(CLASSES)):
        raise ValueError(f"model.classes: expected 0 or {len(CLASSES)}, found {model.classes}")


def _widths(first: int) -> tuple[int, int, int, int]:
    return first, first * 3 // 2, first * 2, first * 5 // 2


def _sixteens(widths: tuple[int, ...]) -> tuple[int, ...]:
    """The next smaller multiples of 16, at least that."""
    return tuple(max(width // 16 * 16, 16) for width in widths)


def model(experiment: Experiment, network: nn.Module) -> CascadeModel:
    """The cascade with the sensor of its images."""
    assert isinstance(network, Cascade)
    return CascadeModel(network, build_sensor(experiment), experiment)


def transfer(network: nn.Module, experiment: Experiment, weights: nn.Module, source: Experiment, name: str) -> None:
    """All weights, of equally wide networks; the sensor may differ, and what not all have starts fresh.

    A fill for the least error, where the weights have none of its own, starts as their only one; so does an observer
    that is as wide. What names insides, where it has to say by itself which scans are of such, starts as what says so.
    Raises ValueError where their fill for the least error has other blocks: what it learned would be lost.
    """
    assert isinstance(network, Cascade) and isinstance(weights, Cascade)
    for part in ("coarse", "fill", "guide", "columns", "between", "beams", "classes", "judge", "inside", "drawn",
                 "indoors"):  # fmt: skip
        start = getattr(weights, part)
        if part == "inside" and network.indoors is None and weights.indoors is not None:
            start = weights.indoors  # the other has seen no streets
        if getattr(network, part) is not None and start is not None:
            load_weights(getattr(network, part), start.state_dict(), name)
    own, known = experiment.model.likeliest_blocks, source.model.likeliest_blocks
    if network.likeliest is not None and weights.likeliest is not None and own != known:
        raise ValueError(f"{name}: expected a fill for the least error of model.likeliest_blocks {list(own)}, found "
                         f"{list(known)}: --set 'model.likeliest_blocks={list(known)}' goes on with it")  # fmt: skip
    _start(network.likeliest, (weights.surest,), name)
    _start(network.observer, (weights.observer, weights.fill), name)


def _start(own: FillUNet | None, sources: tuple[FillUNet | None, ...], name: str) -> None:
    """With the weights of the first that is as wide."""
    alike = (fill for fill in sources if fill is not None and own is not None and _shapes(fill) == _shapes(own))
    if own is not None and (source := next(alike, None)) is not None:
        load_weights(own, _learned(source), name)


def _learned(fill: FillUNet) -> dict[str, Tensor]:
    """All weights but those of classes."""
    return {name: value for name, value in fill.state_dict().items() if not name.startswith("classes")}


def _shapes(fill: FillUNet) -> dict[str, torch.Size]:
    return {name: value.shape for name, value in _learned(fill).items()}


CASCADE = System("cascade", build, DESCRIPTION, model, lambda experiment: TASK, transfer, graph=fill_graph)
