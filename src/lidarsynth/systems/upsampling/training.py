"""How LiDAR-SR, ILN and LIIF learn: every k-th beam of an image is shown, the image itself is wanted; L1 on ranges.

All randomness of what a sample shows is a function of (seed, step, position). Dropout draws from torch's global
generator, which is seeded per step and process. LiDAR-SR normalises over the samples that a process sees at once, and
two processes each keep a mask of ILN's dropout: with those the curve depends on how a batch is shared, with LIIF and
iln-0d it does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from lidarsynth.experiment.record import Experiment, Upsampling
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.metrics.reconstruction import mean_errors, reconstruction_errors
from lidarsynth.networks.iln import ILN, LIIF
from lidarsynth.networks.lidar_sr import LidarSR
from lidarsynth.pictures.figure import panel
from lidarsynth.pictures.render import range_strip
from lidarsynth.systems.interpolation.model import interpolated
from lidarsynth.systems.upsampling.model import UpsamplingModel, places, queries_at, scaled
from lidarsynth.training.randomness import augment, sample_rng
from lidarsynth.training.task import Images, Phase, Task


class PairBatch(NamedTuple):
    """What a step of LiDAR-SR sees: ranges in [0, 1], the lowest beam first."""

    low: Tensor  # (b, 1, h, w)
    high: Tensor  # (b, 1, H, W)


class QueryBatch(NamedTuple):
    """What a step of ILN or LIIF sees: ranges in [-1, 1], the lowest beam first."""

    low: Tensor  # (b, 1, h, w)
    queries: Tensor  # (b, Q, 2)
    ranges: Tensor  # (b, Q)


def draw_pairs(
    experiment: Experiment, images: Images, indices: list[int], step: int, positions: list[int]
) -> PairBatch:
    """Images at full height, and every `factor`-th row of them."""
    pairs = [_pair(experiment, image, rng) for image, rng in _drawn(experiment, images, indices, step, positions)]
    low, high = zip(*pairs, strict=True)
    return PairBatch(torch.stack(low), torch.stack(high))


def draw_queries(
    experiment: Experiment, images: Images, indices: list[int], step: int, positions: list[int]
) -> QueryBatch:
    """Every `factor`-th row of images, and `queries` of their pixels, none twice."""
    group, sensor = _group(experiment), build_sensor(experiment)
    beams = np.asarray(sensor.elevations)[group.first :: group.factor[0]]
    column = np.arange(sensor.width) / group.factor[1]
    size = len(beams), sensor.width // group.factor[1]
    queries = queries_at(places(sensor.elevations, beams), column, size)
    count, drawn = min(group.queries, len(queries)), []
    for image, rng in _drawn(experiment, images, indices, step, positions):
        low, high = _pair(experiment, image, rng)
        chosen = torch.randperm(len(queries), generator=rng)[:count]
        drawn.append((2 * low - 1, queries[chosen], 2 * high.flip(1).flatten()[chosen] - 1))
    return QueryBatch(*map(torch.stack, zip(*drawn, strict=True)))


def _drawn(
    experiment: Experiment, images: Images, indices: list[int], step: int, positions: list[int]
) -> list[tuple[RangeImage, torch.Generator]]:
    rngs = [sample_rng(experiment.training.seed, step, position) for position in positions]
    return list(zip(images.take(indices), rngs, strict=True))


def _pair(experiment: Experiment, image: RangeImage, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    """Ranges in [0, 1] of the known rows (1, h, w) and of all (1, H, W), augmented, the lowest beam first."""
    group, data = _group(experiment), experiment.data
    distance = augment(torch.from_numpy(image.range)[None], rng, data.roll, data.mirror)
    if group.noise:
        noise = group.noise * torch.randn(distance.shape, generator=rng)
        distance = torch.where(distance > 0, distance + noise, distance)
    high = scaled(distance, group)
    return high[:, group.first :: group.factor[0], :: group.factor[1]].flip(1), high.flip(1)


class PairObjective(nn.Module):
    """`objective(batch)` -> mean absolute error (b,) of all pixels, in [-1, 1] (ILN's repository) or [0, 1] (Keras)."""

    def __init__(self, experiment: Experiment, network: LidarSR):
        super().__init__()
        self.network = network
        self.range = 1 if _group(experiment).keras else 2

    def forward(self, batch: PairBatch) -> dict[str, Tensor]:
        error = (self.network(batch.low).float() - batch.high).abs()
        return {"range": self.range * error.mean(dim=(1, 2, 3))}


class QueryObjective(nn.Module):
    """`objective(batch)` -> mean absolute error (b,) of the queried pixels, in [-1, 1]."""

    def __init__(self, network: ILN | LIIF):
        super().__init__()
        self.network = network

    def forward(self, batch: QueryBatch) -> dict[str, Tensor]:
        return {"range": (self.network(batch.low, batch.queries).float() - batch.ranges).abs().mean(dim=1)}


def judge(experiment: Experiment, network: nn.Module, images: Sequence[RangeImage]) -> dict[str, float]:
    """MAE in metres of the pixels between the known ones, of one pass of the network and of bilinear interpolation."""
    known = _known(experiment)
    methods = {"range_mae": [], "range_mae_bilinear": []}
    for image in images:
        methods["range_mae"].append(_filled(experiment, network, image))
        methods["range_mae_bilinear"].append(interpolated(image.keep(known), known, "bilinear"))
    return {
        name: mean_errors([reconstruction_errors(r, i, ~known) for r, i in zip(results, images, strict=True)]).range_mae
        for name, results in methods.items()
    }


def pictures(
    experiment: Experiment, network: nn.Module, images: Sequence[RangeImage], count: int = 2
) -> list[np.ndarray]:
    """Pictures (H', W', 3) uint8 of the first images: strips of the known rows, of the result and of the truth."""
    rows = np.flatnonzero(_known(experiment).any(axis=1))
    drawn = []
    for image in images[:count]:
        low = RangeImage(image.range[rows], image.reflectance[rows], image.mask[rows], image.sensor.rows(rows.tolist()))
        shown = {"low": low, "result": _filled(experiment, network, image), "truth": image}
        end = image.sensor.max_range
        drawn.append(panel([[(n, range_strip(i, end, 3 * image.shape[0] // i.shape[0]))] for n, i in shown.items()]))
    return drawn


def _filled(experiment: Experiment, network: nn.Module, image: RangeImage) -> RangeImage:
    assert isinstance(network, LidarSR | ILN | LIIF)
    model = UpsamplingModel(network.eval(), build_sensor(experiment), experiment)
    return model.complete(image, _known(experiment), "network")


def _known(experiment: Experiment) -> np.ndarray:
    """(H, W) bool: the pixels that the network is shown."""
    group, known = _group(experiment), np.zeros((experiment.data.height, experiment.data.width), bool)
    known[group.first :: group.factor[0], :: group.factor[1]] = True
    return known


def suits(experiment: Experiment, images: Images, learned: bool) -> None:
    """Raises ValueError for a factor that leaves fewer than two known rows, none between them, or columns that are not
    equally far apart all around."""
    known, across = _known(experiment), _group(experiment).factor[1]
    rows, (height, width) = int(known.any(axis=1).sum()), known.shape
    if not 2 <= rows < height:
        raise ValueError(f"upsampling.factor: expected two known beams at least, and others between them, found {rows} "
                         f"known of {height}")  # fmt: skip
    if width % across:
        raise ValueError(f"upsampling.factor: expected a divisor of {width} columns, found {across}")


def _group(experiment: Experiment) -> Upsampling:
    return experiment.upsampling or Upsampling()


def _phases(experiment: Experiment, network: nn.Module) -> tuple[Phase]:
    if isinstance(network, LidarSR):
        return (Phase(PairObjective(experiment, network)),)
    assert isinstance(network, ILN | LIIF)
    return (Phase(QueryObjective(network)),)


LIDAR_SR = Task(("range",), draw_pairs, _phases, judge, pictures, suits=suits)
QUERIES = Task(("range",), draw_queries, _phases, judge, pictures, suits=suits)
