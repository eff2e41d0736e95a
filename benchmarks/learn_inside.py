"""What names the insides of buildings, of a cascade, or what says which scans are of such, goes on learning.

python benchmarks/learn_inside.py MODEL OUT [--part inside] [--scans 2800] [--steps 12000] [--seed 610101]

part  inside   what is there: six lessons of ten are of buildings with odd things in them (odd_things.py), the others of
               `streets.interiors`
      indoors  which scans are of such: 45 lessons of a hundred are of these, the others of streets that robots and
               virtual sensors see

Begins as the model's network of that part, or, for `indoors` in a model without, as what names insides. Writes the
folder OUT, the model with this network. Prints before and after, of 64 other scans of each kind, how many returns get
their class, and how many scans are taken for the inside of a building: buildings, buildings with odd things that it has
never learned from, streets that robots see, streets. A step of 8 cuts of 64 x 256 takes about 0.3 seconds of a core in
bfloat16, a scan 0.15.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from learn_judge import descend
from odd_things import HELD_OUT, LEARNED, odd

from lidarsynth.experiment.record import with_fields
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.networks.class_unet import ClassUNet
from lidarsynth.streets.interiors import draw_robot, interiors
from lidarsynth.streets.virtual import VirtualStreets
from lidarsynth.streets.world import POSES
from lidarsynth.systems.cascade.lessons import Lessons, lesson
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.cascade.naming import NamingObjective, named
from lidarsynth.systems.cascade.response import response_of
from lidarsynth.weights.load import load

TOGETHER, RATE, AVERAGE, OFTEN, JUDGED = 4, 1.2e-3, 0.9995, 200, 64
SHARES = {"inside": {"odd": 0.6, "plain": 0.4}, "indoors": {"odd": 0.2, "plain": 0.25, "robots": 0.33, "streets": 0.22}}
FLOOR = CLASS_NUMBER["other-ground"]


def scans(kind: str, seed: int, count: int, each: int = 4) -> Iterator[RangeImage]:
    """So many scans of a kind of SHARES, or `unseen`, buildings with things that nothing is learned from; `each` of one
    world."""
    length = -(-count // each) * POSES
    if kind in ("robots", "streets"):
        source = VirtualStreets(seed, length, drawn=draw_robot if kind == "robots" else None)
    else:
        source = interiors(seed, length)
    things = {"odd": LEARNED, "unseen": HELD_OUT}.get(kind)
    for number in range(count):
        with odd(things) if things else nullcontext():
            yield source.image(number // each * POSES + number % each * (POSES // each))


def batch(of: Sequence[RangeImage], rng: np.random.Generator, step: int) -> SimpleNamespace:
    """Two cuts of each."""
    cuts = [lesson(image, np.random.default_rng(int(rng.integers(1 << 60)))) for image in of]
    inputs, classes = (torch.cat(part) for part in zip(*cuts, strict=True))
    return SimpleNamespace(lessons=Lessons(inputs, classes, (step,) * len(of)))


def learned(
    start: ClassUNet, part: str, of: dict[str, list[RangeImage]], steps: int, report: Callable[[str], None]
) -> ClassUNet:
    """The network, gone on for so many steps of eight cuts: the running mean of its weights."""
    network, rng = deepcopy(start).train(), np.random.default_rng(0)
    mean, objective = deepcopy(start), NamingObjective(network, inside=True)
    optimizer = torch.optim.AdamW(network.parameters(), RATE, betas=(0.9, 0.99), weight_decay=0.01)
    for step in range(steps):
        kinds = rng.choice(list(SHARES[part]), TOGETHER, p=list(SHARES[part].values()))
        images = [of[kind][int(rng.integers(len(of[kind])))] for kind in kinds]
        with torch.autocast("cpu", torch.bfloat16):
            loss = objective(batch(images, rng, step))["inside"].mean()
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1, (step + 1) / 200) * max(0.02, (1 + math.cos(math.pi * step / steps)) / 2)
        descend(loss, optimizer, network, mean, step, AVERAGE)
        if (step + 1) % OFTEN == 0:
            report(f"step {step + 1} of {steps}: {loss.item():.3f}")
    return mean.eval()


def judged(model: CascadeModel, of: dict[str, list[RangeImage]]) -> Iterator[str]:
    """A line of each kind."""
    network = model.network
    assert network.classes is not None
    for kind, images in of.items():
        right, taken = [], 0
        for image in images:
            told = network.classes, [image], response_of(image, image.mask), image.sensor
            (answer,) = named(*told, inside=network.inside, indoors=network.indoors)
            assert answer.label is not None and image.label is not None
            taken += bool((answer.label == FLOOR).any())
            right.append((answer.label == image.label)[image.mask].mean())
        yield f"{len(images)} {kind}: {100 * np.mean(right):.1f} % of the returns right, {taken} taken for insides"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("out", type=Path)
    parser.add_argument("--part", choices=list(SHARES), default="inside")
    parser.add_argument("--scans", type=int, default=2800)
    parser.add_argument("--steps", type=int, default=12_000)
    parser.add_argument("--seed", type=int, default=610_101, help="of the buildings and streets")
    args = parser.parse_args()
    torch.set_num_threads(1)
    model = load(args.model)
    if not isinstance(model, CascadeModel) or model.network.inside is None:
        parser.error(f"expected a cascade that names the insides of buildings, found {args.model}")
    if args.part == "inside" and model.network.indoors is None:
        parser.error(f"expected a model in which another network tells insides from streets, found {args.model}, whose "
                     "one would forget streets: begin with --part indoors")  # fmt: skip
    kinds = ("plain", "unseen", "robots", "streets")
    held_out = {kind: list(scans(kind, args.seed + 100 + i, JUDGED, 1)) for i, kind in enumerate(kinds)}
    print(*judged(model, held_out), sep="\n", flush=True)
    shares = SHARES[args.part]
    of = {kind: list(scans(kind, args.seed + i, math.ceil(shares[kind] * args.scans))) for i, kind in enumerate(shares)}
    network, own = model.network, args.part == "indoors" and model.network.indoors is not None
    start = network.indoors if own else network.inside
    assert start is not None
    setattr(network, args.part, learned(start, args.part, of, args.steps, lambda line: print(line, flush=True)))
    record = with_fields(model.experiment, {"card.results": ()})  # those of other weights
    if args.part == "indoors":
        record = with_fields(record, {"model.indoors_channels": record.model.inside_channels})
    replace(model, experiment=record).save(args.out)
    print(*judged(model, held_out), sep="\n")


if __name__ == "__main__":
    main()
