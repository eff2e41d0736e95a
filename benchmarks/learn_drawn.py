"""What names scans in the making, of a cascade: it learns from streets, drawn as generation draws them after their own
layouts, whose surfaces are smoother than any recorded one's, and begins as what it was, or, in a model without one, as
the network that names recorded scans.

python benchmarks/learn_drawn.py MODEL OUT [--scans 1200] [--steps 8000] [--seed 9321]

Of the scans a third are of KITTI's sensor, the others of known and virtual ones, four of each; a sixteenth, 16 at
least, is held out. Writes the folder OUT, the model with this network. Prints, of the pixels that are drawn within a
tenth of where the street's are, how many of a hundred are named rightly, and the mIoU, of the network that it began as,
and then. A scan takes about a second to draw, a step of 4 crops of 64 x 256 about 0.25 seconds of a core in bfloat16.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import torch
from learn_judge import descend
from torch import Tensor

from lidarsynth.experiment.record import with_fields
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor, get_sensor
from lidarsynth.networks.class_unet import ClassUNet
from lidarsynth.networks.rays import Rays
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.streets.virtual import KNOWN, draw_sensor
from lidarsynth.systems.cascade.known import rays_told
from lidarsynth.systems.cascade.lessons import HEIGHT, WIDTH, Lessons
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.cascade.naming import NamingObjective, class_inputs_of
from lidarsynth.systems.cascade.response import AS_STREETS
from lidarsynth.weights.load import load

TOGETHER, RATE, AVERAGE, NEAR, OFTEN = 4, 1.5e-3, 0.998, 0.1, 100
POSES = 16  # of one world: scans are of worlds of their own


class Sketches(NamedTuple):
    """Of four scans of one sensor: what the network is told, (4, C, H', W') float16, and classes (4, H', W') uint8, 0
    where the street's range is another."""

    inputs: Tensor
    classes: Tensor


def drawn_sensor(rng: np.random.Generator) -> Sensor:
    """KITTI's, a known one or a virtual one."""
    kind = rng.random()
    if kind < 2 / 3:
        return get_sensor("hdl-64e-kitti" if kind < 1 / 3 else str(rng.choice(KNOWN)))
    return draw_sensor(rng).sensor


def sketches(model: CascadeModel, seed: int, first: int) -> Sketches:
    """Of four streets from number `first` on, seen by a sensor that both numbers tell."""
    sensor = drawn_sensor(np.random.default_rng([seed, first]))
    streets = SyntheticStreets(seed, (first + TOGETHER) * POSES, sensor)
    images = [streets.image(POSES * k) for k in range(first, first + TOGETHER)]
    drawn, rays = model.into(sensor).sketched(images, seed + first), AS_STREETS.told(rays_told(sensor))
    inputs = torch.cat([told(image, rays) for image in drawn])
    classes = torch.zeros(TOGETHER, *inputs.shape[2:], dtype=torch.uint8)
    classes[:, : sensor.height, : sensor.width] = torch.stack(
        [agreeing(*two) for two in zip(drawn, images, strict=True)]
    )
    return Sketches(inputs.half(), classes)


def told(image: RangeImage, rays: Rays) -> Tensor:
    """(1, C, H', W') of a scan in the making."""
    return class_inputs_of(image, AS_STREETS.even(image.reflectance), rays, torch.device("cpu"))


def agreeing(drawn: RangeImage, street: RangeImage) -> Tensor:
    """(H, W) uint8 classes of a street, 0 where what is drawn is nearer or farther."""
    both = drawn.mask & street.mask
    off = np.abs(np.log(np.where(both, drawn.range, 1) / np.where(both, street.range, 1)))
    return torch.from_numpy(np.where(both & (off < NEAR), street.label, 0).astype(np.uint8))


def crops(some: Sketches, rng: np.random.Generator, seed: int) -> SimpleNamespace:
    """A batch of a part of each: inputs (4, C, 64, 256), or as high as the sensor, and classes (4, 64, 256)."""
    height, width = some.classes.shape[1:]
    inputs, classes = [], []
    for told_of_one, classes_of_one in zip(*some, strict=True):
        columns = (rng.integers(width) + np.arange(WIDTH)) % width
        top = 2 * int(rng.integers(max(height - HEIGHT, 0) // 2 + 1))
        inputs.append(told_of_one[:, top : top + HEIGHT][..., columns].float())
        classes.append(classes_of_one[top : top + HEIGHT][..., columns].long())
    return SimpleNamespace(lessons=Lessons(torch.stack(inputs), torch.stack(classes), (seed,)))


def learned(start: ClassUNet, scans: list[Sketches], steps: int, report: Callable[[str], None]) -> ClassUNet:
    """The network, gone on for so many steps of four crops: the running mean of its weights."""
    network, rng = deepcopy(start).train(), np.random.default_rng(0)
    mean, objective = deepcopy(start), NamingObjective(network)
    optimizer = torch.optim.Adam(network.parameters(), RATE, betas=(0.9, 0.99))
    for step in range(steps):
        batch = crops(scans[int(rng.integers(len(scans)))], rng, step)
        with torch.autocast("cpu", torch.bfloat16):
            loss = objective(batch)["named"].mean()
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1, (step + 1) / 100) * max(0.02, 1 - step / steps) ** 0.7
        descend(loss, optimizer, network, mean, step, AVERAGE)
        if (step + 1) % OFTEN == 0:
            report(f"step {step + 1} of {steps}: {loss.item():.3f}")
    return mean.eval()


@torch.inference_mode()
def right(network: ClassUNet, scans: list[Sketches]) -> str:
    """Pixels named rightly, and mIoU of the classes that are there."""
    count = np.zeros((20, 20))
    for inputs, classes in scans:
        for one, truth in zip(inputs, classes, strict=True):
            logits = network(one[None].float())[0]
            logits[0] = -math.inf
            there = truth > 0
            pairs = truth[there].long() * 20 + logits.argmax(0)[there]
            count += np.bincount(pairs.numpy(), minlength=400).reshape(20, 20)
    hits, there = np.diag(count), count.sum(1) > 0
    union = np.maximum(count.sum(0) + count.sum(1) - hits, 1)
    return f"{100 * hits.sum() / count.sum():.1f} %, {(hits / union)[there].mean():.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("out", type=Path)
    parser.add_argument("--scans", type=int, default=1200)
    parser.add_argument("--steps", type=int, default=8000)
    parser.add_argument("--seed", type=int, default=9321, help="of the streets")
    args = parser.parse_args()
    torch.set_num_threads(1)
    model = load(args.model)
    if not isinstance(model, CascadeModel) or model.network.classes is None or model.network.columns is None:
        parser.error(f"expected a cascade that draws columns and names classes, found {args.model}")
    held = max(args.scans // 16, 16) // TOGETHER
    if args.scans <= held * TOGETHER:
        parser.error(f"expected more than {held * TOGETHER} scans, which are held out, found {args.scans}")
    scans = []
    for first in range(0, args.scans, TOGETHER):
        scans.append(sketches(model, args.seed, first))
        print(f"{first + TOGETHER} of {args.scans} drawn", end="\r", flush=True)
    start = model.network.classes if model.network.drawn is None else model.network.drawn
    before = right(start, scans[:held])
    model.network.drawn = learned(start, scans[held:], args.steps, lambda line: print(line, flush=True))
    channels = model.experiment.model.class_channels  # and no results, which are of other weights
    record = with_fields(model.experiment, {"model.drawn_channels": channels, "card.results": ()})
    replace(model, experiment=record).save(args.out)
    print(f"{args.out}: {args.scans} scans, {args.steps} steps: {before} -> {right(model.network.drawn, scans[:held])}")


if __name__ == "__main__":
    main()
