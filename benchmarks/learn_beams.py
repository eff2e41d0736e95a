"""What fills in beams between whole ones, of a cascade: it goes on from the fill of least error, which learns points,
sectors and all else besides.

python benchmarks/learn_beams.py MODEL OUT [--scans 9600] [--steps 29000] [--seed 9850]

Of the scans 46 of a hundred are streets of many kinds (`--data varied`), 21 those of virtual sensors, 13 insides of
buildings, and 20 streets in two to four times the beams of sparse sensors, half of them a VLP-16; a sixteenth, 16 at
least, is held out. Writes the folder OUT, the model with this network. Prints the loss of the held-out ones before and
then. 25 to 40 scans a second are cast, each takes 0.7 MB; a step of 4 crops of 64 x 256 takes 0.2 seconds of a core
that multiplies bfloat16 itself.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import torch
from learn_judge import follow
from torch import Tensor

from lidarsynth.experiment.record import with_fields
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import get_sensor
from lidarsynth.networks.fill_unet import FillUNet, Known
from lidarsynth.networks.rays import stacked
from lidarsynth.streets.interiors import interiors
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.streets.varied import VariedStreets
from lidarsynth.streets.virtual import VirtualStreets, draw_sensor
from lidarsynth.systems.cascade.examples import Crops, crop
from lidarsynth.systems.cascade.losing import losing
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.cascade.training import LikeliestObjective
from lidarsynth.weights.load import load

TOGETHER, RATE, AVERAGE, WARM, OFTEN = 4, 3e-4, 0.999, 200, 100
LOSING = 0.7  # of the crops lack some of their returns
SHARES = {"varied": 0.46, "virtual": 0.21, "insides": 0.13, "denser": 0.20}
STEPS = (2, 2, 2, 3, 4, 4, 4, 4, 6, 8)  # from one known beam to the next, of what is no denser sensor's
SPARSE, ALIKE = 32, 8  # beams at most of a sensor that is made denser; scans by one such
APART = 4  # poses of a world from scan to scan, of 16


class Seen(NamedTuple):
    """A street, and every how manieth of its beams is a sparse sensor's: 0 where that may be any."""

    image: RangeImage
    step: int


def scans(kind: str, seed: int, count: int) -> Iterator[Seen]:
    """As many scans of a kind of `SHARES`, with the surfaces that their rays meet."""
    if kind == "denser":
        yield from denser(seed, count)
        return
    readers = {"varied": VariedStreets, "virtual": VirtualStreets, "insides": interiors}
    streets = readers[kind](seed, APART * count)
    yield from (Seen(streets.image(APART * k + k % APART), 0) for k in range(count))


def denser(seed: int, count: int) -> Iterator[Seen]:
    """Streets in two to four times the beams of a VLP-16, or of a virtual sensor of 32 beams or fewer."""
    for first in range(0, count, ALIKE):
        rng = np.random.default_rng((seed, first))
        sparse, optics = get_sensor("vlp-16"), {}
        if rng.random() < 0.5:
            seen = draw_sensor(rng, 0.3)
            while seen.sensor.height > SPARSE:
                seen = draw_sensor(rng, 0.3)
            sparse, optics = seen.sensor, {"optics": seen.optics}
        step = int(rng.choice((4, 4, 4, 2, 3))) if 2 * sparse.height <= SPARSE else 2
        sensor = sparse.denser(step)
        if optics:  # its beams are others now
            optics = {"optics": replace(optics["optics"], loss=sensor.dimness, dip=(), shift=())}
        else:
            sensor = replace(sensor, mount=float(rng.uniform(1.4, 2.3)), tilt=tuple(rng.normal(0, 1, 2).tolist()))
        streets = SyntheticStreets(seed + first, 2 * ALIKE, sensor, **optics)
        pairs = (streets.pair(2 * k) for k in range(min(ALIKE, count - first)))
        yield from (Seen(replace(image, surface=perfect.range), step) for perfect, image in pairs)


def batch(some: list[Seen], rng: np.random.Generator) -> SimpleNamespace:
    """A crop (1, 1, 64, 256) of each, of which whole beams are known."""
    crops = []
    for image, step in some:
        k = step or int(rng.choice(STEPS))
        shown = losing(image, rng) if rng.random() < LOSING else image
        crops.append(crop(shown, rng, False, 1.0, (k, 0 if step else int(rng.integers(k)))))
    known, (metres, reflectance, classes) = (
        [torch.cat(p) for p in zip(*(c[i] for c in crops), strict=True)] for i in (0, 2)
    )
    rays = stacked([c[1] for c in crops])
    return SimpleNamespace(crops=Crops(Known(*known), rays, metres, reflectance, classes, (), 0))


def learned(start: FillUNet, seen: list[Seen], steps: int, report: Callable[[str], None]) -> FillUNet:
    """The network, gone on for so many steps of four crops: the running mean of its weights."""
    network, rng = deepcopy(start).train(), np.random.default_rng(0)
    mean, objective = deepcopy(start), LikeliestObjective(network)
    optimizer = torch.optim.AdamW(network.parameters(), RATE, betas=(0.9, 0.99), weight_decay=0.01)
    for step in range(steps):
        loss = losses(objective, batch([seen[k] for k in rng.integers(len(seen), size=TOGETHER)], rng)).mean()
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1, (step + 1) / WARM) * (0.51 + 0.49 * math.cos(math.pi * step / steps))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        follow(mean, network, step, AVERAGE)
        if (step + 1) % OFTEN == 0:
            report(f"step {step + 1} of {steps}: {loss.item():.3f}")
    return mean.eval()


def losses(objective: LikeliestObjective, crops: SimpleNamespace) -> Tensor:
    """(n,) of the crops, its matrix products in bfloat16."""
    with torch.autocast("cpu", torch.bfloat16):
        return objective(crops)["likeliest"].float()


@torch.no_grad()
def judged(network: FillUNet, held: list[Seen]) -> float:
    """The mean loss of the same crops of held-out scans each time."""
    rng, objective = np.random.default_rng(1), LikeliestObjective(network)
    return float(np.mean([losses(objective, batch([one], rng)).item() for one in held]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("out", type=Path)
    parser.add_argument("--scans", type=int, default=9600)
    parser.add_argument("--steps", type=int, default=29_000)
    parser.add_argument("--seed", type=int, default=9850, help="of the streets")
    args = parser.parse_args()
    torch.set_num_threads(1)
    model = load(args.model)
    if not isinstance(model, CascadeModel) or model.network.likeliest is None:
        parser.error(f"expected a cascade with a fill of least error, found {args.model}")
    held = max(args.scans // 16, 16)
    if args.scans <= held:
        parser.error(f"expected more than {held} scans, which are held out, found {args.scans}")
    seen: list[Seen] = []
    for number, (kind, share) in enumerate(SHARES.items()):
        for one in scans(kind, args.seed + number, max(1, round(share * args.scans))):
            seen.append(one)
            print(f"{len(seen)} of {args.scans} cast", end="\r", flush=True)
    order = np.random.default_rng(args.seed).permutation(len(seen))
    rest, first = ([seen[k] for k in part] for part in (order[held:], order[:held]))
    before = judged(model.network.likeliest, first)
    model.network.by_beams = learned(model.network.likeliest, rest, args.steps, lambda line: print(line, flush=True))
    record = with_fields(model.experiment, {"model.by_beams": True})
    replace(model, experiment=record).save(args.out)
    now = judged(model.network.by_beams, first)
    print(f"{args.out}: {args.scans} scans, {args.steps} steps: {before:.4f} -> {now:.4f}")


if __name__ == "__main__":
    main()
