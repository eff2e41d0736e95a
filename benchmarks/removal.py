"""How near streets that traffic was taken out of come to the same streets without it.

python benchmarks/removal.py [--sensor WORD ...] [--models MODEL ...] [--streets N] [--real FOLDER ...]

Rays that end on traffic, in streets that nothing was trained on: mean error in metres, no return being 0, and how many
of them still return from the traffic. By the streets' own labels, and by the model's.
Of labelled real scans, read as `benchmarks/street.py --classes` reads them: how many returns from traffic go, and how
many others, as the model names them.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from street import SENSOR, labelled

import lidarsynth as ls
from lidarsynth.cli.terminal import answer
from lidarsynth.lidar.removal import TRAFFIC
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.streets.world import POSES
from lidarsynth.systems.interpolation.model import interpolated
from lidarsynth.systems.scan_model import ScanModel

HELD_OUT = 777_117  # a seed that nothing was trained on
THINGS = [CLASS_NUMBER[word] for word in TRAFFIC]
FEW = 100  # rays on traffic, of a street that says little
NEAR = 30.0  # metres
THERE, APART = 0.3, 1.0  # metres from what was taken away; and of it from the truth


def pairs(sensor: str, count: int) -> Iterator[tuple[RangeImage, RangeImage]]:
    """Places in streets of their own with traffic, and the same without it."""
    seen, bare = (SyntheticStreets(HELD_OUT, 1 << 20, sensor, words) for words in ((), TRAFFIC))
    for number in range(3, POSES * count, POSES):
        image = seen.image(number)
        if np.isin(image.label, THINGS).sum() >= FEW:
            yield image, bare.image(number)


def ways(seen: RangeImage, models: list[str]) -> Iterator[tuple[str, RangeImage]]:
    """What is put in place of a street's traffic, by name."""
    away = np.isin(seen.label, THINGS)
    yield "left as it is", seen
    yield "left empty", seen.keep(~away)
    for word in ("nearest", "bilinear"):
        yield word, interpolated(seen.keep(~away), ~away, word)
    for word in models:
        model = ls.load(word).into(seen.sensor)
        yield f"{word}, its own labels", model.complete(seen, without="traffic")
        yield f"{word}, named by it", model.complete(replace(seen, label=None), without="traffic")


def errors(filled: RangeImage, seen: RangeImage, truth: RangeImage) -> tuple[float, float]:
    """Metres of error of rays on traffic, and the share of them that still return from it."""
    away = np.isin(seen.label, THINGS)
    new, real = filled.range * filled.mask, truth.range * truth.mask
    still = (np.abs(new - seen.range) < THERE) & (np.abs(real - seen.range) > APART)
    return float(np.abs(new - real)[away].mean()), float(still[away].mean())


def taken(model: ScanModel, images: list[RangeImage]) -> tuple[float, float, float]:
    """Shares of labelled returns that go where the model names classes: from traffic, from that within NEAR, others."""
    counts = np.zeros((3, 2))
    for image in images:
        assert image.label is not None
        left = model.complete(replace(image, label=None), without="traffic")
        assert left.new is not None
        gone, things = left.new | ~left.mask, np.isin(image.label, THINGS) & image.mask
        for row, of in enumerate((things, things & (image.range < NEAR), image.mask & (image.label > 0) & ~things)):
            counts[row] += (gone & of).sum(), of.sum()
    return tuple((counts[:, 0] / counts[:, 1]).tolist())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", nargs="+", default=["hdl-64e-kitti", "os1-64", "hdl-32e", "vlp-16"])
    parser.add_argument("--models", nargs="+", default=["default"])
    parser.add_argument("--streets", type=int, default=24)
    parser.add_argument("--real", type=Path, nargs="+", default=[], help="folders of labelled scans")
    args = parser.parse_args()
    images = [image for folder in args.real for image in labelled(folder)]
    for word in args.models if images else ():
        found = taken(ls.load(word).into(SENSOR), images)
        print(f"{len(images)} real scans, {word}: of traffic {found[0]:.1%} go, within {NEAR:g} m {found[1]:.1%}; "
              f"of all else {found[2]:.2%}", flush=True)  # fmt: skip
    for sensor in args.sensor:
        results: dict[str, list[tuple[float, float]]] = {}
        for seen, truth in pairs(sensor, args.streets):
            for name, filled in ways(seen, args.models):
                results.setdefault(name, []).append(errors(filled, seen, truth))
        print(f"{sensor}: {len(next(iter(results.values())))} streets")
        for name, values in results.items():
            metres, still = np.mean(values, axis=0)
            print(f"  {name:28} {metres:6.2f} m   still there {still:6.1%}", flush=True)


if __name__ == "__main__":
    answer(main)
