"""The columns of a cascade go on with streets as sensors see them of which nothing is known but their beams.

python benchmarks/learn_columns.py MODEL OUT [--scans 5760] [--steps 4000] [--rate 3e-4] [--seed 9711]

A virtual sensor sees better or worse than others, and reports reflectance in its own way. Who asks for scans of an
OS1-64 means one sensor, that of `streets`: of the scans a third are of KITTI's, two fifths of the other known ones, the
rest of beams that nobody has built, all mounted and seeing as in `streets`. A sixteenth is held out. Writes the folder
OUT, the model with these columns; prints their negative log-likelihoods of held-out grids, of returning, range and
reflectance, in nats a pixel, before and after. A step of 16 grids takes about 0.8 s of a core in bfloat16.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from learn_judge import follow
from torch import Tensor

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import get_sensor
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.coarse_unet import COLUMNS
from lidarsynth.networks.column_neighbours import known_grid, spoilt
from lidarsynth.networks.column_transformer import ColumnTransformer
from lidarsynth.streets.virtual import KNOWN, VirtualSensor, VirtualStreets, draw_sensor
from lidarsynth.systems.cascade.examples import grid
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.cascade.training import CoarseObjective
from lidarsynth.weights.load import load

BATCH, AVERAGE, OFTEN, WARM = 16, 0.998, 100, 100
KITTI, OTHERS = "hdl-64e-kitti", tuple(sorted({*KNOWN} - {"hdl-64e-kitti"}))


def plain_sensor(rng: np.random.Generator) -> VirtualSensor:
    """KITTI's, another known one, or one that nobody has built: as well as they see in `streets`."""
    kind = rng.random()
    if kind < 0.75:
        return VirtualSensor(get_sensor(KITTI if kind < 0.35 else str(rng.choice(OTHERS))))
    sensor = draw_sensor(rng, known_share=0.0).sensor
    return VirtualSensor(replace(sensor, dimness=(), max_range=float(rng.uniform(60, 200))))


def unlikelihood(
    cascade: Cascade, columns: ColumnTransformer, images: list[RangeImage], rng: np.random.Generator, learns: bool
) -> Tensor:
    """(3,) means of as many grids, each in any phase and after a draft, half of their columns judged."""
    metres, reflectance, rays, standing = (
        torch.stack(part) for part in zip(*(grid(i, rng) for i in images), strict=True)
    )
    random = torch.Generator().manual_seed(int(rng.integers(1 << 31)))
    whole = known_grid(metres, reflectance)
    x_0 = cascade.coarse.encode(metres, reflectance, standing)
    eps = torch.randn(x_0.shape, generator=random)
    draft = CoarseObjective(cascade.coarse).draft(x_0, eps, rays, standing, random)
    judged = torch.randperm(COLUMNS, generator=random)[: COLUMNS // 2]
    with torch.autocast("cpu", torch.bfloat16):
        return columns(whole, rays, draft, judged, spoilt(whole, random) if learns else whole).mean(0)


def learned(
    cascade: Cascade, images: list[RangeImage], steps: int, rate: float, report: Callable[[str], None]
) -> ColumnTransformer:
    """The columns, gone on for so many steps: the running mean of their weights."""
    assert cascade.columns is not None
    columns, mean, rng = deepcopy(cascade.columns).train(), deepcopy(cascade.columns), np.random.default_rng(0)
    optimizer = torch.optim.Adam(columns.parameters(), rate, betas=(0.9, 0.99))
    for step in range(steps):
        chosen = [images[int(i)] for i in rng.integers(len(images), size=BATCH)]
        loss = unlikelihood(cascade, columns, chosen, rng, learns=True).sum()
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1, (step + 1) / WARM) * (0.02 + 0.98 * math.cos(math.pi * step / steps / 2) ** 2)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(columns.parameters(), 1.0)
        optimizer.step()
        with torch.no_grad():
            follow(mean, columns, step, AVERAGE)
        if (step + 1) % OFTEN == 0:
            report(f"step {step + 1} of {steps}: {loss.item():.3f}")
    return mean.eval()


@torch.inference_mode()
def judged(cascade: Cascade, columns: ColumnTransformer, images: list[RangeImage]) -> str:
    rng = np.random.default_rng(1)
    parts = [unlikelihood(cascade, columns, images[i : i + BATCH], rng, learns=False)
             for i in range(0, len(images) - BATCH + 1, BATCH)]  # fmt: skip
    return ", ".join(f"{value:.3f}" for value in torch.stack(parts).mean(0).tolist())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("out", type=Path)
    parser.add_argument("--scans", type=int, default=5760)
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--rate", type=float, default=3e-4)
    parser.add_argument("--seed", type=int, default=9711, help="of the streets")
    args = parser.parse_args()
    torch.set_num_threads(1)
    model = load(args.model)
    if not isinstance(model, CascadeModel) or model.network.columns is None:
        parser.error(f"expected a cascade that draws columns, found {args.model}")
    held = max(args.scans // 16, BATCH)
    if args.scans < held + BATCH:
        parser.error(f"expected {held + BATCH} scans or more, of which {held} are held out, found {args.scans}")
    streets, images = VirtualStreets(args.seed, args.scans, drawn=plain_sensor), []
    for i in range(args.scans):
        images.append(replace(streets.image(i), surface=None, label=None, xyz=None))
        print(f"{i + 1} of {args.scans} cast", end="\r", flush=True)
    network = model.network.requires_grad_(False)
    assert network.columns is not None
    before = judged(network, network.columns, images[:held])
    start = deepcopy(network)
    assert start.columns is not None
    start.columns.requires_grad_(True)
    network.columns = learned(start, images[held:], args.steps, args.rate, lambda line: print(line, flush=True))
    model.save(args.out)
    print(f"{args.out}: {args.scans} scans, {args.steps} steps: {before} -> "
          f"{judged(network, network.columns, images[:held])}")  # fmt: skip


if __name__ == "__main__":
    main()
