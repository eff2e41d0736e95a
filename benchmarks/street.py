"""The protocol street-1: its floor, whether worse scans get worse scores, and how well its network knows classes.

python benchmarks/street.py                                          floor and sensitivity, 256 against 256 scans
python benchmarks/street.py --counts 64 128 256 512 1024             the floor at these counts
python benchmarks/street.py --classes synthetic                      IoU of each class on 171 held-out streets
python benchmarks/street.py --classes FOLDER                         or on a folder of KITTI .bin with .label beside,
                                                                     and .npz images with xyz and label
Scans are of a seed that the network has not seen; one of each world, so that they are independent of each other.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from lidarsynth.evaluation.accumulation import Loaded, load_networks
from lidarsynth.evaluation.protocols import EvaluationProtocol, get_protocol
from lidarsynth.evaluation.report import Result, results_of
from lidarsynth.evaluation.statistics import Statistics
from lidarsynth.files.formats import read
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASSES
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.metrics.reconstruction import accuracy, class_iou
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.segmentation.training import confusion
from lidarsynth.weights.load import load_parts

WORD = "street-1"  # of the protocol and of its shipped network
SENSOR = SENSORS["hdl-64e-kitti"]
SEED = 12  # of the scans here; the network learned from seed 11
HELD_OUT = 1024  # world from which on scans are judged; before it they are the reference
Corrupt = Callable[[RangeImage, np.random.Generator], RangeImage]


def streets(first: int, count: int, without: tuple[str, ...] = ()) -> Iterator[RangeImage]:
    """Scans first .. first + count - 1, each from a world of its own; of classes `without` nothing is there."""
    reader = SyntheticStreets(SEED, 1 << 40, SENSOR, without, apart=True)
    return (reader.image(i) for i in range(first, first + count))


def blurred(sigma: float) -> Corrupt:
    """Range and reflectance smoothed by a Gaussian of `sigma` pixels over the measured pixels; the mask stays."""
    from scipy.ndimage import gaussian_filter

    def smooth(values: np.ndarray) -> np.ndarray:
        modes: Any = ("nearest", "wrap")  # one for each axis, which scipy's stubs do not know
        return gaussian_filter(values.astype(np.float64), sigma, mode=modes)

    def corrupt(image: RangeImage, rng: np.random.Generator) -> RangeImage:
        share = np.maximum(smooth(image.mask), 1e-9)
        both = (smooth(values * image.mask) / share * image.mask for values in (image.range, image.reflectance))
        distance, reflectance = (values.astype(np.float32) for values in both)
        return replace(image, range=distance, reflectance=reflectance, xyz=None)

    return corrupt


def shuffled(group: int) -> Corrupt:
    """Rows in random order within groups of so many."""

    def corrupt(image: RangeImage, rng: np.random.Generator) -> RangeImage:
        rows = np.concatenate([first + rng.permutation(group) for first in range(0, image.shape[0], group)])
        return rearranged(image, rows)

    return corrupt


def rearranged(image: RangeImage, rows: np.ndarray) -> RangeImage:
    """The image with other rows in its rows' places; their points lie on the new rows' rays."""
    label = None if image.label is None else image.label[rows]
    return RangeImage(image.range[rows], image.reflectance[rows], image.mask[rows], image.sensor, label)


def beams_lost(every: int) -> Corrupt:
    """Every so many-th beam returns nothing."""
    return lambda image, rng: image.keep(np.arange(image.shape[0])[:, None] % every + np.zeros(image.shape[1]) > 0)


def points_lost(share: float) -> Corrupt:
    """Single points return nothing."""
    return lambda image, rng: image.keep(rng.random(image.shape) >= share)


def noisy(metres: float) -> Corrupt:
    """Gaussian noise on the ranges."""

    def corrupt(image: RangeImage, rng: np.random.Generator) -> RangeImage:
        near, far = image.sensor.min_range, image.sensor.max_range
        distance = np.clip(image.range + metres * rng.standard_normal(image.shape), near, far) * image.mask
        return replace(image, range=distance.astype(np.float32), xyz=None)

    return corrupt


def faded(share: float) -> Corrupt:
    """Reflectance drawn towards 0.25 by this share."""
    return lambda image, rng: replace(
        image,
        reflectance=((1 - share) * image.reflectance + share * 0.25 * image.mask).astype(np.float32),
    )


def noise_image(image: RangeImage, rng: np.random.Generator) -> RangeImage:
    """What has nothing of a scan: logarithm of range, and reflectance, uniform in every pixel."""
    low, high = np.log([image.sensor.min_range, image.sensor.max_range])
    distance = np.exp(rng.uniform(low, high, image.shape)).astype(np.float32)
    return RangeImage(distance, rng.random(image.shape).astype(np.float32), distance > 0, image.sensor)


# Kinds of corruption, each from weak to strong: the scores must rise within a kind.
CORRUPTIONS: dict[str, dict[str, Corrupt]] = {
    "blur": {f"{s:g} pixels": blurred(s) for s in (0.5, 1.0, 2.0)},
    "rows shuffled": {f"within {n}": shuffled(n) for n in (2, 8, 64)},
    "beams without return": {f"1 of {n}": beams_lost(n) for n in (16, 8, 4, 2)},
    "points without return": {f"{s:.0%}": points_lost(s) for s in (0.02, 0.1, 0.4)},
    "range noise": {f"{m:g} m": noisy(m) for m in (0.05, 0.2, 1.0)},
    "reflectance faded": {f"{s:.0%}": faded(s) for s in (0.1, 0.3, 1.0)},
    "noise images": {"": noise_image},
}


@dataclass(frozen=True)
class Judge:
    """The protocol, with its network."""

    protocol: EvaluationProtocol
    loaded: Loaded

    def gather(self, images: Iterable[RangeImage], role: Literal["samples", "real"] = "samples") -> Statistics:
        """Statistics of a set of images."""
        statistics = Statistics(self.protocol, SENSOR, role, self.loaded.networks, self.loaded.weights)
        for image in images:
            statistics.update([image], [True], [True])
        return statistics

    def scores(self, samples: Statistics, real: Statistics) -> list[Result]:
        """The rows of the protocol's table."""
        return list(results_of(samples, real, self.loaded.missing))


def table(title: str, rows: Iterable[tuple[str, list[Result]]]) -> Iterator[str]:
    """Lines of a Markdown table, as they are computed."""
    for k, (name, results) in enumerate(rows):
        if not k:
            yield f"| {title} | {' | '.join(f'{r.name} ({r.unit})' if r.unit else r.name for r in results)} |"
            yield "|---|" + "---:|" * len(results)
        yield f"| {name} | {' | '.join('N/A' if r.value is None else f'{r.value:.{r.digits}f}' for r in results)} |"


def floor(judge: Judge, counts: Sequence[int]) -> Iterator[tuple[str, list[Result]]]:
    """Real against real: two sets of other worlds, of so many scans each."""
    for count in counts:
        samples, real = judge.gather(streets(HELD_OUT, count)), judge.gather(streets(0, count), "real")
        yield f"{count} against {count}", judge.scores(samples, real)


def sensitivity(judge: Judge, count: int) -> Iterator[tuple[str, list[Result]]]:
    """The same held-out scans as they are, then worse and worse."""
    real = judge.gather(streets(0, count), "real")
    held_out = list(streets(HELD_OUT, count))
    yield "as they are (floor)", judge.scores(judge.gather(held_out), real)
    empty = list(streets(HELD_OUT, count, ("car",)))
    for share in (0.5, 1.0):
        images = [b if k < share * count else a for k, (a, b) in enumerate(zip(held_out, empty, strict=True))]
        yield f"no cars, {share:.0%} of scans", judge.scores(judge.gather(images), real)
    for kind, strengths in CORRUPTIONS.items():
        for strength, corrupt in strengths.items():
            images = (corrupt(image, np.random.default_rng(k)) for k, image in enumerate(held_out))
            yield f"{kind}, {strength}" if strength else kind, judge.scores(judge.gather(images), real)


def labelled(folder: Path) -> list[RangeImage]:
    """SemanticKITTI scans, projected by their rings, and images (64, 1024) with range, xyz, reflectance and label."""
    scans = [read(path, labels=path.with_suffix(".label")) for path in sorted(folder.glob("*.bin"))
             if path.with_suffix(".label").is_file()]  # fmt: skip
    images = [project(scan, SENSOR, "unfolding") for scan in scans]
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as file:
            values = {name: file[name] for name in ("range", "reflectance", "label", "xyz")}
        values["label"] = values["label"].astype(np.int64)
        images.append(RangeImage(**values, mask=values["range"] > 0, sensor=SENSOR))
    return images


def class_table(images: Sequence[RangeImage]) -> Iterator[str]:
    """Lines of a Markdown table: each class's share of the pixels and IoU."""
    network = load_parts(WORD)[1]
    assert isinstance(network, RangeNet)
    counts = confusion(network, images)
    shares, iou = counts.sum(1) / max(counts[1:].sum(), 1), class_iou(counts, (0,))
    occurs = np.flatnonzero(counts.sum(1))
    occurs = occurs[occurs > 0]
    yield f"{len(images)} images: mIoU {iou[occurs].mean():.3f} of the {len(occurs)} classes there, "
    yield f"{iou[1:].mean():.3f} of all 19; {accuracy(counts):.1%} of the pixels right"
    yield from ("| class | share of pixels | IoU |", "|---|---:|---:|")
    for k in occurs:
        yield f"| {CLASSES[k][0]} | {shares[k]:.2%} | {iou[k]:.3f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=256, help="how many against how many")
    parser.add_argument("--counts", type=int, nargs="+", default=[], help="draw the floor at these counts instead")
    parser.add_argument("--classes", type=Path, help="`synthetic`, or a folder of labelled scans")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.classes:
        every_sixth = (image for first in range(HELD_OUT, 2 * HELD_OUT, 6) for image in streets(first, 1))
        lines = class_table(list(every_sixth) if str(args.classes) == "synthetic" else labelled(args.classes))
    else:
        protocol = get_protocol(WORD)
        judge = Judge(protocol, load_networks(protocol, SENSOR.width))
        rows = floor(judge, args.counts) if args.counts else sensitivity(judge, args.scans)
        lines = table("scans" if args.counts else f"{args.scans} scans", rows)
    for line in lines:
        print(line, flush=True)


if __name__ == "__main__":
    main()
