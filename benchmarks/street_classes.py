"""Why a network of synthetic streets misreads real scans, and what helps: streets that vary, statistics, geometry.

python benchmarks/street_classes.py --why FOLDER          real scans with one thing made as the streets have it
python benchmarks/street_classes.py --confusion FOLDER    what each class is taken for
python benchmarks/street_classes.py --scans 2400 --minutes 65 --geometry --judge FOLDER... --unlabelled FOLDER

The third goes on training the network of street-1 on streets as recorded on many days (`streets/recordings.py`), with
`--geometry` told what a pixel's neighbours say of its surface (`street_geometry.py`). `--keep FILE` writes the weights,
and goes on from them where the file is there, best with another `--seed` of streets. No real label is learned from;
`--unlabelled` gives the batch normalisations the statistics of real scans without labels (AdaBN). `--scans 0` trains
nothing. Folders are read as `benchmarks/street.py --classes` reads them.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from street import SENSOR, WORD, labelled
from street_geometry import geometry
from street_network import Reader, counted
from torch import Tensor, nn

from lidarsynth.files.formats import read
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASSES
from lidarsynth.metrics.reconstruction import class_iou
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.streets.recordings import RecordedStreets
from lidarsynth.streets.world import POSES
from lidarsynth.systems.segmentation.adaptation import adapted
from lidarsynth.systems.segmentation.training import class_weights, confusion, pixels
from lidarsynth.weights.load import load_parts

PER_WORLD, IMAGES, COLUMNS = 4, 3, 256
RATE, KEPT = 2e-3, 0.97  # learning rate; share of the former average that a step keeps
Sample = tuple[np.ndarray, np.ndarray]  # (5, H, W) as `pixels`, (H, W) classes


def varied(seed: int, count: int) -> Iterator[RangeImage]:
    """Four places of each world, each recorded on another day."""
    streets = RecordedStreets(seed, 1 << 40)
    return (streets.image(POSES * (k // PER_WORLD) + 4 * (k % PER_WORLD)) for k in range(count))


def cuts(image: RangeImage, rng: np.random.Generator) -> Sample:
    """The scan turned, mirrored, thinned and answering otherwise, as (5, H, W) and (H, W)."""
    assert image.label is not None
    values, label = pixels(image), np.where(image.mask, image.label, 0)
    gamma, scale, each = rng.uniform(0.8, 1.25), rng.uniform(0.85, 1.15), np.exp(rng.normal(0, 0.12, len(CLASSES)))
    values[4] = np.clip(values[4] ** gamma * scale * each[label], 0, 0.99)
    turn = rng.uniform(0, 2 * np.pi) if rng.random() < 0.5 else rng.normal(0, 0.15)
    if rng.random() < 0.5:
        c, s = np.cos(turn), np.sin(turn)
        values[1], values[2] = c * values[1] - s * values[2], s * values[1] + c * values[2]
    gone = (rng.random(label.shape) < 0.1 * rng.random()) | (rng.random((len(label), 1)) < 0.15 * rng.random())
    values[:, gone], label[gone] = 0, 0
    if rng.random() < 0.5:
        values, label = values[:, :, ::-1].copy(), label[:, ::-1].copy()
        values[2] *= -1
    return values, label


def batches(reader: Reader, images: Sequence[RangeImage], seed: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Endless batches of two cuts, opposite to each other, of each of IMAGES scans."""
    rng = np.random.default_rng(seed)
    while True:
        inputs, labels = [], []
        for image in (images[k] for k in rng.integers(len(images), size=IMAGES)):
            values, label = cuts(image, rng)
            for x, classes in opposite(reader.prepared(values[None]), label, rng):
                inputs.append(x)
                labels.append(classes)
        yield torch.cat(inputs), torch.stack(labels)


def opposite(x: Tensor, label: np.ndarray, rng: np.random.Generator) -> Iterator[tuple[Tensor, Tensor]]:
    """Two cuts (1, C, H, 256) and (H, 256), opposite to each other, of a scan (1, C, H, W) and its classes (H, W)."""
    first, width = rng.integers(label.shape[1]), label.shape[1]
    for start in (first, first + width // 2):
        columns = (start + np.arange(COLUMNS)) % width
        yield x[..., columns], torch.from_numpy(label[:, columns].astype(np.int64))


def balance(images: Sequence[RangeImage]) -> Tensor:
    """(20,) weights of the classes, by how many of the images' pixels are of each."""
    labels = [np.where(i.mask, i.label, 0)[::2, ::4].ravel() for i in images if i.label is not None]
    counts = np.bincount(np.concatenate(labels), minlength=len(CLASSES)).astype(float)
    counts[0] = 0
    weights = class_weights(counts / counts.sum())
    weights[0] = 0
    return weights


@torch.no_grad()
def average_in(average: nn.Module, new: nn.Module, kept: float) -> None:
    """The average of weights of so far, of which `kept` stays, with the new ones."""
    for mine, other in zip(average.state_dict().values(), new.state_dict().values(), strict=True):
        mine.lerp_(other, 1 - kept) if mine.is_floating_point() else mine.copy_(other)


def trained(reader: Reader, images: Sequence[RangeImage], minutes: float) -> Reader:
    """The average of the weights over the last steps, after that many minutes."""
    weights = balance(images[::7])
    optimizer = torch.optim.AdamW(reader.parameters(), RATE, weight_decay=1e-3)
    average, start = copy.deepcopy(reader), time.monotonic()
    reader.train()
    for step, (x, label) in enumerate(batches(reader, images, 1)):
        part = (time.monotonic() - start) / (60 * minutes)
        if part >= 1:
            print(f"{step} steps", flush=True)
            break
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1, (step + 1) / 20) * (0.5 + 0.5 * np.cos(np.pi * part))
        losses = nn.functional.cross_entropy(reader(x), label, weights, ignore_index=0, reduction="none")
        optimizer.zero_grad()
        (losses.sum() / (label > 0).sum()).backward()
        nn.utils.clip_grad_norm_(reader.parameters(), 2.0)
        optimizer.step()
        average_in(average, reader, KEPT)
    return average.eval()


def unlabelled(folder: Path, every: int = 3) -> list[RangeImage]:
    """Every third scan of a folder of KITTI's .bin files."""
    return [project(read(path), SENSOR, "unfolding") for path in sorted(folder.glob("*.bin"))[::every]]


def judged(reader: Reader, folders: Sequence[Path]) -> str:
    """mIoU of the classes there, IoU of road, sidewalk, building and vegetation, and pixels right of each folder."""
    return "; ".join(f"{folder.name}: {cells(counted(reader, labelled(folder)))}" for folder in folders)


def scores(network: RangeNet, images: Sequence[RangeImage]) -> str:
    """Cells of a table row."""
    return cells(confusion(network, images))


def cells(counts: np.ndarray) -> str:
    iou, there = class_iou(counts, (0,)), counts.sum(1)[1:] > 0
    right = np.trace(counts[1:, 1:]) / counts[1:].sum()
    return f"{iou[1:][there].mean():.3f} | {iou[9]:.3f} | {iou[11]:.3f} | {iou[13]:.3f} | {iou[15]:.3f} | {right:.3f}"


def taken_for(network: RangeNet, folder: Path) -> Iterator[str]:
    """Rows: what each class of the real scans is read as, and how it looks there and in the streets.

    share; median reflectance; median height above the lowest ground around, cm; median bend of the ring, mm per metre.
    """
    real = labelled(folder)
    counts = confusion(network, real)
    there, streets = looks(real), looks(held_out())
    yield "| class | share, % | reflectance | above ground, cm | bend, mm/m | read as |"
    yield "|---|---|---|---|---|---|"
    for k in np.flatnonzero(counts[:, 1:].sum(1) * (np.arange(len(CLASSES)) > 0)):
        most = np.argsort(-counts[k])[:4]
        read_as = ", ".join(f"{CLASSES[m][0]} {counts[k, m] / counts[k].sum():.0%}" for m in most)
        pairs = zip(there[k], streets[k], (".1f", ".2f", ".0f", ".1f"), strict=True)
        yield f"| {CLASSES[k][0]} | {' | '.join(f'{a:{f}}, {b:{f}}' for a, b, f in pairs)} | {read_as} |"


def looks(images: Sequence[RangeImage]) -> np.ndarray:
    """(20, 4) share in percent, median reflectance, height in cm and bend in mm/m of each class; NaN for none."""
    rows = np.full((len(CLASSES), 4), np.nan)
    told = [geometry(pixels(image)) for image in images]
    label = np.concatenate([np.where(image.mask, image.label, 0).ravel() for image in images])
    columns = [
        np.concatenate([image.reflectance.ravel() for image in images]),
        np.concatenate([100 * (part[6].ravel() + 0.5) for part in told]),
        np.concatenate([np.expm1(part[1].ravel() + 1.5) for part in told]),
    ]
    for k in np.unique(label[label > 0]):
        rows[k] = [100 * (label == k).sum() / (label > 0).sum(), *(np.median(v[label == k]) for v in columns)]
    return rows


def held_out() -> list[RangeImage]:
    """Streets as they are without any variation, which street-1's network has not seen."""
    return [SyntheticStreets(12, 1 << 40, SENSOR, apart=True).image(k) for k in range(1024, 1032)]


def why(network: RangeNet, folder: Path) -> Iterator[str]:
    """Rows: the real scans as they are, then with one thing made as the streets have it."""
    real = labelled(folder)
    streets = held_out()
    classes = np.arange(20)
    medians = [np.array([_median(images, k) for k in classes]) for images in (real, streets)]
    yield "| real scans | mIoU | road | sidewalk | building | vegetation | pixels right |"
    yield "|---|---|---|---|---|---|---|"
    yield f"| as they are | {scores(network, real)} |"
    for shift in (-0.2, -0.1, 0.1):
        yield f"| {shift:+.1f} m higher | {scores(network, [_raised(image, shift) for image in real])} |"
    every = [np.quantile(np.concatenate([i.reflectance[i.mask] for i in of]), np.linspace(0, 1, 101))
             for of in (real, streets)]  # fmt: skip
    spaced = every[0] + 1e-6 * np.arange(101)
    alike = [_answering(image, np.interp(image.reflectance, spaced, every[1])) for image in real]
    yield f"| reflectance with the streets' quantiles | {scores(network, alike)} |"
    both = [_raised(image, -0.1) for image in alike]
    yield f"| that, and -0.1 m | {scores(network, both)} |"
    ratio = np.where((medians[0] > 0.02) & (medians[1] > 0.02), medians[1] / np.maximum(medians[0], 0.02), 1)
    fitted = [_answering(image, image.reflectance * ratio[image.label]) for image in real]
    yield f"| reflectance with the streets' median of each class | {scores(network, fitted)} |"


def _median(images: Sequence[RangeImage], label: int) -> float:
    values = np.concatenate([image.reflectance[image.mask & (image.label == label)] for image in images])
    return float(np.median(values)) if len(values) else 0.0


def _raised(image: RangeImage, height: float) -> RangeImage:
    return replace(image, xyz=(image.points() + np.array([0, 0, height])).astype(np.float32))


def _answering(image: RangeImage, reflectance: np.ndarray) -> RangeImage:
    return replace(image, reflectance=np.where(image.mask, np.clip(reflectance, 0, 1), 0).astype(np.float32))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=0, help="of streets to learn from")
    parser.add_argument("--minutes", type=float, default=15)
    parser.add_argument("--seed", type=int, default=31, help="of these streets")
    parser.add_argument("--geometry", action="store_true")
    parser.add_argument("--keep", type=Path, help="weights to go on from, and to write")
    parser.add_argument("--why", type=Path, help="folder of labelled scans")
    parser.add_argument("--confusion", type=Path, help="folder of labelled scans")
    parser.add_argument("--judge", type=Path, nargs="+", default=[])
    parser.add_argument("--unlabelled", type=Path, help="folder of KITTI's .bin files")
    args = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    network = load_parts(WORD)[1]
    assert isinstance(network, RangeNet)
    for row in [*(why(network, args.why) if args.why else ()),
                *(taken_for(network, args.confusion) if args.confusion else ())]:  # fmt: skip
        print(row, flush=True)
    reader = Reader(args.geometry).eval()
    if args.keep and args.keep.exists():
        reader.load_state_dict(torch.load(args.keep, weights_only=True))
    if args.scans:
        reader = trained(reader, list(varied(args.seed, args.scans)), args.minutes)
    if args.keep:
        torch.save(reader.state_dict(), args.keep)
    print(judged(reader, args.judge), flush=True)
    if args.unlabelled:
        reader = adapted(reader, reader.inputs(unlabelled(args.unlabelled)))
        print("with the statistics of the unlabelled scans:", judged(reader, args.judge), flush=True)


if __name__ == "__main__":
    main()
