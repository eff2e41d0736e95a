"""R2DM's table II at small scale: configurations A to H at reduced width and resolution, one budget for all.

python benchmarks/ablation.py                                  a look: half a minute of training per row, then samples
python benchmarks/ablation.py --steps 5000 --out runs/ablation  stopped, the same command goes on
python benchmarks/ablation.py --only fh --steps 50 --samples 8 --images 32 --height 16 --width 64

Data are synthetic streets on R2DM's grid. The validation loss is the mean squared error of eps on held-out streets, the
same noise for all, whatever loss a configuration is trained with; D and E see other range codes, so that theirs can be
compared only roughly. BEV: Jensen-Shannon distance x 100 and MMD x 10,000 between samples and held-out streets, smaller
is better. The paper's trend: F, which does not know where a pixel looks, far worst; H best.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from lidarsynth.data.dataset import CachedImages, write_cache
from lidarsynth.experiment.folder import save
from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import Experiment, with_fields
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.metrics.bev import bev_histograms
from lidarsynth.metrics.distributions import gaussian_mmd, jensen_shannon_distance
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.diffusion.build import build_denoiser
from lidarsynth.systems.diffusion.model import LidarModel
from lidarsynth.systems.diffusion.validation import fixed_losses
from lidarsynth.systems.table import build_network, task_of
from lidarsynth.training.checkpoint import load_run, save_run
from lidarsynth.training.loop import Run, start, train

ROWS = "abcdefgh"
STEPS_AT_MOST = 1_000_000  # where the budget is time


def configuration(row: str, args: argparse.Namespace) -> Experiment:
    """The preset of a row of the table, small."""
    steps = args.steps or STEPS_AT_MOST
    changes = {
        "data.height": args.height,
        "data.width": args.width,
        "model.base_channels": args.channels,
        "model.num_residual_blocks": (1, 1, 1, 1),
        "training.steps": steps,
        "training.batch_size": args.batch_size,
        "training.learning_rate": 5e-4,
        "training.warmup": 100,
        "training.ema_start": 200,
    }
    return with_fields(preset(f"r2dm-{row}"), changes)


def streets(folder: Path, experiment: Experiment, count: int, seed: int) -> CachedImages:
    """A cache of synthetic streets, made when it is not there."""
    sensor = build_sensor(experiment)
    reader = SyntheticStreets(seed, count, sensor)
    list(write_cache(folder, reader.image, count, sensor, {"name": "synthetic", "seed": seed}))
    return CachedImages(folder)


def trained(experiment: Experiment, images: CachedImages, folder: Path, seconds: float) -> tuple[Run, float]:
    """The run after its budget of steps or seconds, and the seconds of this call; continued where it was stopped."""
    torch.manual_seed(0)
    run = start(experiment, build_network(experiment), task_of(experiment))
    state = folder / "state.pt"
    if state.exists():
        load_run(state, run)
        if not experiment.training.steps < STEPS_AT_MOST:
            return run, 0.0  # a budget of time is spent once
    folder.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    for progress in train(experiment, run, images):
        if progress.step % 500 == 0 and experiment.training.steps < STEPS_AT_MOST:
            save_run(state, run)
        if time.monotonic() - began > seconds:
            break
    save_run(state, run)
    save(folder, experiment, run.ema)
    return run, time.monotonic() - began


def validation_loss(experiment: Experiment, run: Run, held_out: CachedImages, count: int = 32) -> float:
    """Mean over noise levels of the squared error of eps."""
    squared = replace(experiment, diffusion=replace(experiment.diffusion, loss="l2"))
    x_0 = held_out.x_0(list(range(0, len(held_out), max(1, len(held_out) // count))), experiment.data.codec)
    return float(np.mean(list(fixed_losses(squared, run.ema, x_0).values())))


def bev_distances(samples: list[RangeImage], reference: list[RangeImage]) -> tuple[float, float]:
    """Jensen-Shannon distance of the pooled BEV histograms, squared MMD of the scans' (R2DM's evaluation)."""
    ours, theirs = (torch.cat([_histogram(image) for image in images]) for images in (samples, reference))
    seen = ours[ours.flatten(1).sum(1) > 0]  # a sample of a bad model may hold no point at all
    mmd = gaussian_mmd(seen, theirs) if len(seen) else float("nan")
    return jensen_shannon_distance(ours.sum(0), theirs.sum(0)) if len(seen) else float("nan"), mmd


def _histogram(image: RangeImage) -> torch.Tensor:
    return bev_histograms(torch.from_numpy(image.points() * image.mask[..., None]).flatten(0, 1)[None])


def describe(experiment: Experiment) -> str:
    """What sets a row apart: range code, loss, position encoding."""
    encoding = {"polar_coordinates": "angles", "spherical_harmonics": "harmonics", "fourier_features": "Fourier"}
    where = encoding.get(experiment.model.coords_encoding or "", "none")
    return f"{experiment.data.codec:8}{experiment.diffusion.loss:7}{where:10}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument("--minutes", type=float, default=0.5, help="of training per configuration")
    budget.add_argument("--steps", type=int, help="of training per configuration")
    parser.add_argument("--out", type=Path, default=Path("runs/ablation"))
    parser.add_argument("--only", default=ROWS, help="letters of the table's rows")
    parser.add_argument("--height", type=int, default=32)
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--channels", type=int, default=16)
    parser.add_argument("--batch-size", type=int, default=8)
    parser.add_argument("--images", type=int, default=960, help="streets to train on")
    parser.add_argument("--samples", type=int, default=64, help="to compare with as many held-out streets")
    parser.add_argument("--sampling-steps", type=int, default=32)
    table(parser.parse_args())


def table(args: argparse.Namespace) -> None:
    """Train, judge and print row by row."""
    first = configuration("h", args)
    home = args.out / f"{args.height}x{args.width}-{args.channels}"
    images = streets(home / f"streets-{args.images}", first, args.images, seed=0)
    held_out = streets(home / f"held-out-{args.samples}", first, args.samples, seed=1)
    reference = [held_out[i] for i in range(len(held_out))]
    budget = f"{args.steps} steps" if args.steps else f"{args.minutes:g} minutes"
    print(f"{args.height} x {args.width}, {args.channels} channels, {budget} each, {args.samples} samples of "
          f"{args.sampling_steps} steps")  # fmt: skip
    names = ("steps", "validation", "BEV JSD", "BEV MMD", "seconds")
    print(f"row {'range':8}{'loss':7}{'position':10}" + "".join(f"{name:>12}" for name in names))
    for row in args.only:
        experiment = configuration(row, args)
        seconds = float("inf") if args.steps else 60 * args.minutes
        run, spent = trained(experiment, images, home / f"{row}-{budget.replace(' ', '-')}", seconds)
        loss = validation_loss(experiment, run, held_out)
        model = LidarModel(run.ema, build_denoiser(experiment, run.ema), build_sensor(experiment), experiment)
        jsd, distance = bev_distances(model.generate(args.samples, steps=args.sampling_steps, batch_size=8), reference)
        print(f"{row.upper():4}{describe(experiment)}{run.step:12d}{loss:12.4f}{100 * jsd:12.2f}{1e4 * distance:12.2f}"
              f"{spent:12.0f}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
