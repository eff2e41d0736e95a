"""Why a network of synthetic streets misreads real scans, and what helps: the sensor's height, tilt and response vary.

python benchmarks/street_classes.py --why FOLDER          real scans with one thing made as the streets have it
python benchmarks/street_classes.py --scans 360 --minutes 15 --judge FOLDER...

The second goes on training the network of street-1 on streets whose sensor stands a few centimetres higher or lower,
tilts by half a degree, and answers a little brighter or darker, each scan its own; classes differ in brightness from
scan to scan. No real scan is learned from. Folders are read as `benchmarks/street.py --classes` reads them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from street import SENSOR, WORD, labelled

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.metrics.reconstruction import class_iou
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.streets.reader import SyntheticStreets, Worlds
from lidarsynth.streets.sensor_model import Optics
from lidarsynth.systems.segmentation.training import CrossEntropy, SegmentationBatch, confusion
from lidarsynth.weights.load import load_parts

PER_WORLD, BATCH, COLUMNS = 6, 4, 512


def varied(seed: int, count: int) -> Iterator[RangeImage]:
    """Scans of which each has a sensor and materials of its own."""
    worlds = Worlds(seed, replace(SENSOR, mount=2.0, elevations=(4.0, *SENSOR.elevations[1:])))
    rng = np.random.default_rng((seed, 99))
    for k in range(count):
        tilt = (float(rng.normal(0, 0.6)), float(rng.normal(0, 0.5)))
        sensor = replace(SENSOR, mount=float(rng.normal(1.76, 0.07)), tilt=tilt)
        optics = Optics(gamma=float(rng.uniform(0.65, 1.2)), scale=float(rng.uniform(0.8, 1.25)),
                        strength=float(rng.uniform(-0.02, 0.05)))  # fmt: skip
        reader = SyntheticStreets(seed, 1 << 30, sensor, optics=optics, worlds=worlds)
        image = reader.image(16 * (k // PER_WORLD) + int(rng.integers(16)))
        assert image.label is not None
        bright = rng.uniform(0.75, 1.4, 20)[image.label]
        yield replace(image, reflectance=np.clip(image.reflectance * bright, 0, 0.99).astype(np.float32))


def batches(images: list[RangeImage], weights: torch.Tensor, seed: int) -> Iterator[SegmentationBatch]:
    """Endless batches of cuts, mirrored and thinned at random."""
    rng = np.random.default_rng(seed)
    while True:
        pixels, labels = [], []
        for image in (images[k] for k in rng.integers(len(images), size=BATCH)):
            assert image.label is not None
            columns = (rng.integers(image.shape[1]) + np.arange(COLUMNS)) % image.shape[1]
            xyz = image.points()[:, columns]
            parts = [np.linalg.norm(xyz, axis=-1), *np.moveaxis(xyz, -1, 0), image.reflectance[:, columns]]
            stack, label = np.stack(parts).astype(np.float32), image.label[:, columns]
            gone = (rng.random(label.shape) < 0.1 * rng.random()) | (rng.random((64, 1)) < 0.2 * rng.random())
            stack, label = np.where(gone, 0, stack), np.where(gone, 0, label)
            if rng.random() < 0.5:
                stack, label = stack[:, :, ::-1].copy(), label[:, ::-1].copy()
                stack[2] *= -1
            pixels.append(stack)
            labels.append(label)
        yield SegmentationBatch(torch.from_numpy(np.stack(pixels)), torch.from_numpy(np.stack(labels)), weights)


def judged(network: RangeNet, folders: list[Path]) -> str:
    """mIoU of the classes there, IoU of road and vegetation, and pixels right of each folder."""
    return "; ".join(f"{folder.name}: {scores(network, labelled(folder))}" for folder in folders)


def scores(network: RangeNet, images: Sequence[RangeImage]) -> str:
    """Cells of a table row."""
    counts = confusion(network, images)
    iou, there = class_iou(counts, (0,)), counts.sum(1)[1:] > 0
    right = np.trace(counts[1:, 1:]) / counts[1:].sum()
    return f"{iou[1:][there].mean():.3f} | {iou[9]:.3f} | {iou[11]:.3f} | {iou[13]:.3f} | {iou[15]:.3f} | {right:.3f}"


def why(network: RangeNet, folder: Path) -> Iterator[str]:
    """Rows: the real scans as they are, then with one thing made as the streets have it."""
    real = labelled(folder)
    streets = [SyntheticStreets(12, 1 << 40, SENSOR, apart=True).image(k) for k in range(1024, 1032)]
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
    parser.add_argument("--scans", type=int, default=360)
    parser.add_argument("--minutes", type=float, default=15)
    parser.add_argument("--why", type=Path, help="folder of labelled scans")
    parser.add_argument("--judge", type=Path, nargs="+", default=[])
    args = parser.parse_args()
    torch.set_num_threads(1)
    network = load_parts(WORD)[1]
    assert isinstance(network, RangeNet)
    if args.why:
        for row in why(network, args.why):
            print(row, flush=True)
        return
    print("before:", judged(network, args.judge), flush=True)
    images = list(varied(31, args.scans))
    labels = np.stack([image.label for image in images if image.label is not None])
    shares = np.bincount(labels.ravel(), minlength=20)[1:] / max((labels > 0).sum(), 1)
    weights = torch.tensor([0.0, *(1 / np.log(1.02 + shares))], dtype=torch.float32)
    objective, start, step = CrossEntropy(network), time.monotonic(), 0
    optimizer = torch.optim.AdamW(network.parameters(), 1e-3, weight_decay=1e-4)
    for batch in batches(images, weights, 0):
        part = (time.monotonic() - start) / (60 * args.minutes)
        if part >= 1:
            break
        for group in optimizer.param_groups:
            group["lr"] = 1e-3 * min(1, (step + 1) / 20) * (0.5 + 0.5 * np.cos(np.pi * part))
        network.train()
        with torch.autocast("cpu", torch.bfloat16):
            loss = objective(batch)["cross_entropy"].mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        step += 1
        if step % 100 == 0:
            print(step, f"{loss.item():.3f}", flush=True)
    network.eval()
    print(f"after {step} steps:", judged(network, args.judge), flush=True)


if __name__ == "__main__":
    main()
