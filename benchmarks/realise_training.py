"""What a network learns from perfect scans, from realised ones and from streets as the sensor sees them.

python benchmarks/realise_training.py --network pixels|rangenet --judge FOLDER... [--scans 128] [--steps 600]
    [--model default]

The same places three times: as a simulator casts them (no reflectance; the network is judged without it too), made real
by `realise`, and as the streets' sensor model sees them; and the last without reflectance, so that the worth of the
drop-outs and of the reflectance are told apart. Equal networks, steps and seeds, from scratch. `rangenet` is a
RangeNet-21 of width 4 on cuts of 256 columns; `pixels` sees one pixel and the ten channels of `street_geometry.py`,
and learns in seconds. Folders of labelled real scans are read as `benchmarks/street.py --classes` reads them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from street import SENSOR, labelled
from street_classes import cells
from street_geometry import CHANNELS, geometry
from torch import Tensor, nn

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASSES
from lidarsynth.metrics.reconstruction import confusion_matrix
from lidarsynth.networks.rangenet import MEANS, STDS, RangeNet
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.streets.world import POSES
from lidarsynth.systems.segmentation.adaptation import adapted
from lidarsynth.systems.segmentation.training import class_weights, pixels
from lidarsynth.weights.load import load

SEED, CUTS, COLUMNS, PIXELS, RATE = 901, 4, 256, 8192, 4e-3
Prepare = Callable[[RangeImage], np.ndarray]  # -> (C, 64, 1024)


def places(count: int, word: str) -> dict[str, list[RangeImage]]:
    """The kinds of scans by name, four places of each world."""
    streets, model = SyntheticStreets(SEED, 1 << 30, SENSOR), load(word).into(SENSOR)
    perfect, seen = zip(*(streets.pair(POSES * (k // 4) + 4 * (k % 4)) for k in range(count)), strict=True)
    real = [model.realised(p.to_scan(), SENSOR, seed=k) for k, p in enumerate(perfect)]
    real = [replace(image, completed=None, xyz=None) for image in real]
    return {"perfect": list(perfect), "realised": real, "as the sensor sees them": list(seen),
            "the same, without reflectance": [dark(image) for image in seen]}  # fmt: skip


def generated(count: int) -> list[RangeImage]:
    """Scans of the default model with the classes that it sees there, in KITTI's beams."""
    made = load("default").into(SENSOR).generate(count, seed=SEED, labels=True)
    return [replace(image, xyz=None) for image in made]


def dark(image: RangeImage) -> RangeImage:
    return replace(image, reflectance=np.zeros_like(image.reflectance))


def normalised(image: RangeImage) -> np.ndarray:
    """(5, H, W) as RangeNet takes it."""
    values = pixels(image)
    means, stds = (np.array(v, np.float32)[:, None, None] for v in (MEANS, STDS))
    return np.where(values[:1] > 0, (values - means) / stds, 0).astype(np.float32)


def told(image: RangeImage) -> np.ndarray:
    """(15, H, W) with the channels of `geometry`."""
    return np.concatenate([normalised(image), geometry(pixels(image))])


def classes_of(image: RangeImage) -> np.ndarray:
    assert image.label is not None
    return np.where(image.mask, image.label, 0)


def cuts(images: Sequence[RangeImage], prepare: Prepare, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """CUTS cuts of COLUMNS columns, two of a scan, half of them mirrored."""
    inputs, labels = [], []
    for image in (images[k] for k in rng.integers(len(images), size=CUTS // 2)):
        x, label, first = prepare(image), classes_of(image), rng.integers(image.shape[1])
        x = np.where(rng.random(label.shape) < 0.1 * rng.random(), 0, x)
        if rng.random() < 0.5:
            x, label = x[:, :, ::-1].copy(), label[:, ::-1]
            x[2] = np.where(x[2] == 0, 0, -x[2] - 2 * MEANS[2] / STDS[2])
        for start in (first, first + image.shape[1] // 2):
            columns = (start + np.arange(COLUMNS)) % image.shape[1]
            inputs.append(x[..., columns])
            labels.append(label[:, columns])
    return torch.from_numpy(np.stack(inputs)).float(), torch.from_numpy(np.stack(labels))


def batches(images: Sequence[RangeImage], prepare: Prepare, alone: bool, seed: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Endless: cuts, or where pixels stand alone, PIXELS of them as (1, C, 1, N) and (1, 1, N)."""
    rng = np.random.default_rng(seed)
    if not alone:
        while True:
            yield cuts(images, prepare, rng)
    label = np.stack([classes_of(image).ravel() for image in images])
    chosen = [rng.choice(np.flatnonzero(row), PIXELS) for row in label]
    every = [prepare(image).reshape(5 + CHANNELS, -1)[:, some] for image, some in zip(images, chosen, strict=True)]
    values, label = np.concatenate(every, 1), np.concatenate([r[c] for r, c in zip(label, chosen, strict=True)])
    while True:
        some = rng.integers(len(label), size=PIXELS)
        yield torch.from_numpy(values[None, :, None, some]), torch.from_numpy(label[None, None, some])


def trained(
    images: Sequence[RangeImage], weights: Tensor, alone: bool, steps: int, seed: int
) -> tuple[nn.Module, Prepare]:
    """A network after so many steps, and what it wants to be told."""
    torch.manual_seed(seed)
    prepare = told if alone else normalised
    widths = (5 + CHANNELS, 64, 64)
    layers = [part for a, b in pairwise(widths) for part in (nn.Conv2d(a, b, 1), nn.ReLU())]
    network = nn.Sequential(*layers, nn.Conv2d(64, len(CLASSES), 1)) if alone else RangeNet(21, 4)
    optimizer = torch.optim.AdamW(network.parameters(), RATE, weight_decay=1e-3)
    network.train()
    for step, (x, label) in zip(range(steps), batches(images, prepare, alone, seed), strict=False):
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1, (step + 1) / 10) * (0.5 + 0.5 * np.cos(np.pi * step / steps))
        losses = nn.functional.cross_entropy(network(x), label, weights, ignore_index=0, reduction="none")
        optimizer.zero_grad()
        (losses.sum() / (label > 0).sum()).backward()
        nn.utils.clip_grad_norm_(network.parameters(), 2.0)
        optimizer.step()
    if not alone:  # its running statistics are those of a longer training
        network = adapted(network, (torch.from_numpy(prepare(image)[None]) for image in images[::4]))
    return network.eval(), prepare


@torch.no_grad()
def counted(network: nn.Module, prepare: Prepare, images: Sequence[RangeImage]) -> np.ndarray:
    """(20, 20) pixels, truth by row."""
    counts = np.zeros((len(CLASSES), len(CLASSES)), np.int64)
    for image in images:
        said = network(torch.from_numpy(prepare(image)[None]))[0, 1:].argmax(0).numpy() + 1
        counts += confusion_matrix(classes_of(image), np.where(image.mask, said, 0))
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", choices=("pixels", "rangenet"), default="pixels")
    parser.add_argument("--scans", type=int, default=128)
    parser.add_argument("--generated", type=int, default=0, help="learn from so many generated scans instead")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--model", default="default", help="that realises")
    parser.add_argument("--judge", type=Path, nargs="+", default=[])
    args = parser.parse_args()
    torch.set_num_threads(1)
    kinds = {"generated, labelled": generated(args.generated)} if args.generated else places(args.scans, args.model)
    counts = np.bincount(np.concatenate([classes_of(i).ravel() for i in list(kinds.values())[-1]]), minlength=20)
    counts = np.where(np.arange(20) > 0, counts, 0)
    weights = class_weights(counts / counts.sum()) * (torch.arange(20) > 0)
    judges = {folder.name: labelled(folder) for folder in args.judge}
    print("learned from, seed, folder: mIoU | road | sidewalk | building | vegetation | pixels right")
    for name, images in kinds.items():
        without = name in ("perfect", "the same, without reflectance")
        for seed in range(args.seeds):
            made = trained(images, weights, args.network == "pixels", args.steps, seed)
            for folder, real in judges.items():
                seen = [dark(image) for image in real] if without else real
                print(f"{name}, {seed}, {folder}: {cells(counted(*made, seen))}", flush=True)


if __name__ == "__main__":
    main()
