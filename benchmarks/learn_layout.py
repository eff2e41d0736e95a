"""The coarse stage or the columns of a cascade go on with streets as plain sensors see them, of known beams or not.

python benchmarks/learn_layout.py MODEL OUT --part columns|coarse [--scans 5760] [--steps 4000] [--noisiest 10]

A virtual sensor sees better or worse than others, and reports reflectance in its own way. Who asks for scans of an
OS1-64 means one sensor, that of `streets`: of the scans a third are of KITTI's, two fifths of the other known ones, the
rest of beams that nobody has built, all mounted and seeing as in `streets`. A sixteenth is held out. Writes the folder
OUT, the model with what has learned; prints how held-out grids are judged before and after: by the columns, negative
log-likelihoods of returning, range and reflectance, in nats a pixel; by the coarse stage, squared errors of the
velocity at log_snr from -0.23 to -10. Two scans are of each street: by more of them, the coarse stage learns
by heart how open the streets of a sensor are. A step takes 0.6 (coarse, 32 grids) to 0.8 s (columns, 16) of a core in
bfloat16.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from learn_judge import descend
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.schedule import flow
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import get_sensor
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.coarse_unet import BOUND, COLUMNS, ROWS, CoarseUNet
from lidarsynth.networks.column_neighbours import known_grid, spoilt
from lidarsynth.streets.virtual import KNOWN, VirtualSensor, VirtualStreets, draw_sensor
from lidarsynth.streets.world import POSES
from lidarsynth.systems.cascade.examples import grid
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.cascade.training import CoarseObjective
from lidarsynth.weights.load import load

AVERAGE, OFTEN, WARM = 0.998, 100, 100
# A little below the time to which drafts are led; the share of times above it; times at which it is judged.
FROM, OF_DRAFTS, LOG_SNRS = 0.5, 0.8, (-0.23, -2.0, -4.0, -6.0, -8.0, -10.0)
# Patches of which the mean error counts, too, by as much: what a scene is like as a whole is little of a pixel's error.
SCALES = (((2, 8), 1.0), ((4, 32), 1.0), ((ROWS, COLUMNS), 3.0))
Grids: TypeAlias = "list[Tensor]"  # as of `grids_of`
KITTI, OTHERS = "hdl-64e-kitti", tuple(sorted({*KNOWN} - {"hdl-64e-kitti"}))


def plain_sensor(rng: np.random.Generator) -> VirtualSensor:
    """KITTI's, another known one, or one that nobody has built: as well as they see in `streets`."""
    kind = rng.random()
    if kind < 0.75:
        return VirtualSensor(get_sensor(KITTI if kind < 0.35 else str(rng.choice(OTHERS))))
    sensor = draw_sensor(rng, known_share=0.0).sensor
    return VirtualSensor(replace(sensor, dimness=(), max_range=float(rng.uniform(60, 200))))


def of_columns(cascade: Cascade, columns: nn.Module, grids: Grids, rng: torch.Generator, learns: bool) -> Tensor:
    """(3,) negative log-likelihoods of grids after drafts, of half of their columns."""
    metres, reflectance, rays, standing = grids
    whole = known_grid(metres, reflectance)
    x_0 = cascade.coarse.encode(metres, reflectance, standing)
    eps = torch.randn(x_0.shape, generator=rng)
    draft = CoarseObjective(cascade.coarse).draft(x_0, eps, rays, standing, rng)
    judged = torch.randperm(COLUMNS, generator=rng)[: COLUMNS // 2]
    with torch.autocast("cpu", torch.bfloat16):
        return columns(whole, rays, draft, judged, spoilt(whole, rng) if learns else whole).mean(0)


def of_coarse(cascade: Cascade, coarse: CoarseUNet, grids: Grids, rng: torch.Generator, learns: bool) -> Tensor:
    """(1,) squared errors of the velocity, of its pixels and of means of SCALES, four fifths of them at times of
    drafts; (6,) of its pixels at LOG_SNRS.

    As drafts are: evenly in log_snr, by which more than half of these times are above 0.9, where it is decided how open
    a street is.
    """
    metres, reflectance, rays, standing = grids
    x_0, count = cascade.coarse.encode(metres, reflectance, standing), len(metres)
    denoiser = Denoiser(coarse, coarse.schedule, "velocity", clip=False, condition=(rays,))

    def errors(t: Tensor) -> Tensor:
        eps = torch.randn(x_0.shape, generator=rng)
        log_snr, alpha, sigma = coarse.schedule.at(t, x_0)
        with torch.autocast("cpu", torch.bfloat16):
            return denoiser.predict(alpha * x_0 + sigma * eps, log_snr.flatten()) - (eps - x_0)

    if not learns:
        times = coarse.schedule.t(torch.tensor(LOG_SNRS)).clamp(max=1)
        return torch.stack([errors(t.expand(count)).square().mean() for t in times])
    late, u = torch.rand(count, generator=rng) < OF_DRAFTS, torch.rand(count, generator=rng)
    of_drafts = coarse.schedule.along(1, FROM, u).float().clamp(max=1)
    off = errors(torch.where(late, of_drafts, FROM * u))
    means = [weight * F.avg_pool2d(off, patch).square().mean() for patch, weight in SCALES]
    return torch.stack([off.square().mean(), *means]).sum()[None]


# Network, its loss, grids a step, rate.
PARTS = {"columns": (of_columns, 16, 3e-4), "coarse": (of_coarse, 32, 2e-4)}


def grids_of(images: list[RangeImage], rng: np.random.Generator) -> Grids:
    """Metres and reflectance (B, 16, 128), rays (B, 8, 16, 128) and standing elevations (B, 16, 128) in radians of B
    images, each in any phase."""
    return [torch.stack(part) for part in zip(*(grid(image, rng) for image in images), strict=True)]


def learned(
    cascade: Cascade, part: str, images: list[RangeImage], steps: int, report: Callable[[str], None]
) -> nn.Module:
    """The part, gone on for so many steps: the running mean of its weights."""
    loss_of, batch, rate = PARTS[part]
    network, mean = (deepcopy(getattr(cascade, part)) for _ in range(2))
    network.train().requires_grad_(True)
    rng, random = np.random.default_rng(0), torch.Generator().manual_seed(0)
    optimizer = torch.optim.Adam(network.parameters(), rate, betas=(0.9, 0.99))
    for step in range(steps):
        chosen = [images[int(i)] for i in rng.integers(len(images), size=batch)]
        loss = loss_of(cascade, network, grids_of(chosen, rng), random, True).sum()
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1, (step + 1) / WARM) * (0.02 + 0.98 * math.cos(math.pi * step / steps / 2) ** 2)
        descend(loss, optimizer, network, mean, step, AVERAGE)
        if (step + 1) % OFTEN == 0:
            report(f"step {step + 1} of {steps}: {loss.item():.3f}")
    return mean.eval()


@torch.inference_mode()
def judged(cascade: Cascade, part: str, images: list[RangeImage]) -> str:
    (loss_of, batch, _), rng, random = PARTS[part], np.random.default_rng(1), torch.Generator().manual_seed(1)
    parts = [loss_of(cascade, getattr(cascade, part), grids_of(images[i : i + batch], rng), random, False)
             for i in range(0, len(images) - batch + 1, batch)]  # fmt: skip
    return ", ".join(f"{value:.3f}" for value in torch.stack(parts).mean(0).tolist())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("out", type=Path)
    parser.add_argument("--part", choices=tuple(PARTS), required=True)
    parser.add_argument("--scans", type=int, default=5760)
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=9711, help="of the streets")
    parser.add_argument("--noisiest", type=float, default=10, help="-log_snr of the coarse stage's noise")
    args = parser.parse_args()
    torch.set_num_threads(1)
    model = load(args.model)
    if not isinstance(model, CascadeModel) or model.network.columns is None:
        parser.error(f"expected a cascade that draws columns, found {args.model}")
    batch = PARTS[args.part][1]
    held = max(args.scans // 16, batch)
    if args.scans < held + batch:
        parser.error(f"expected {held + batch} scans or more, of which {held} are held out, found {args.scans}")
    apart = POSES // 2
    streets, images = VirtualStreets(args.seed, apart * args.scans, drawn=plain_sensor), []
    for i in range(args.scans):
        images.append(replace(streets.image(apart * i), surface=None, label=None, xyz=None))
        print(f"{i + 1} of {args.scans} cast", end="\r", flush=True)
    if args.part == "coarse":
        model.network.coarse.schedule = flow(BOUND, args.noisiest)
        trained = replace(model.experiment.model, noisiest=args.noisiest)
        model = replace(model, experiment=replace(model.experiment, model=trained))
    network = model.network.requires_grad_(False)
    before = judged(network, args.part, images[:held])
    after = learned(network, args.part, images[held:], args.steps, lambda line: print(line, flush=True))
    setattr(network, args.part, after.requires_grad_(False))
    card = replace(model.experiment.card, results=())  # those of other weights
    replace(model, experiment=replace(model.experiment, card=card)).save(args.out)
    now = judged(network, args.part, images[:held])
    print(f"{args.out}: {args.scans} scans, {args.steps} steps: {before} -> {now}")


if __name__ == "__main__":
    main()
