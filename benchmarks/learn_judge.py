"""The judge of a cascade: it learns to tell the grids that the cascade draws from those of streets, and chooses among
several drawn ones from then on.

python benchmarks/learn_judge.py MODEL OUT [--grids 3328] [--steps 1300] [--width 40] [--sensors 160] [--seed 66001]

Draws the grids, of the same virtual sensors as the streets, holds a thirteenth of them out, and writes the folder OUT,
the model with its judge. Prints the area under the ROC curve of the held-out ones, and of them as chosen among three:
0.5 if it cannot tell them any more. Range and reflectance get noise, so that what counts is how streets run.

Then draws twelve grids for each of some sensors, and finds what the odds owe to how open a scene is: slopes over six
numbers of a grid, within sensors, by least squares. Choosing leaves them out.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from told_apart import area, both, taken
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.diffusion.samplers import generators
from lidarsynth.experiment.record import with_fields
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.column_neighbours import Grid
from lidarsynth.networks.column_transformer import draw
from lidarsynth.networks.grid_judge import GridJudge, openness
from lidarsynth.streets.virtual import VirtualStreets
from lidarsynth.systems.cascade.examples import grid
from lidarsynth.systems.cascade.layout import CHOICE, draft
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.weights.load import load

BATCH, RATE, DECAY, AVERAGE = 16, 2e-3, 0.05, 0.99
CODE, SHADE = 0.02, 0.06  # standard deviations of the noise: 5 to 6 % of the range
EACH, EVERY = 12, 16  # grids of a sensor, and images of a virtual street, which are of one sensor


def noisy(grid: Grid) -> Grid:
    """The grid with noise on its range codes and reflectances."""
    code = grid.code + CODE * torch.randn_like(grid.code)
    return Grid(code, grid.shade + SHADE * torch.randn_like(grid.shade), grid.returned)


def learned(true: Grid, drawn: Grid, rays: Tensor, steps: int, width: int) -> GridJudge:
    """A judge of these grids (B, 16, 128): the running mean of its weights after so many steps of BATCH of each."""
    judge, rng = GridJudge(width), torch.Generator().manual_seed(0)
    mean = GridJudge(width)
    mean.load_state_dict(judge.state_dict())
    optimizer = torch.optim.AdamW(judge.parameters(), RATE, weight_decay=DECAY)
    for step in range(steps):
        first, second = (torch.randint(len(rays), (BATCH,), generator=rng) for _ in range(2))
        pairs = zip(taken(true, first), taken(drawn, second), strict=True)
        odds = judge(noisy(Grid(*map(torch.cat, pairs))), torch.cat([rays[first], rays[second]]))
        truth = torch.cat([torch.ones(BATCH), torch.zeros(BATCH)])
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1, (step + 1) / 100) * (0.5 + 0.5 * math.cos(math.pi * step / steps))
        descend(F.binary_cross_entropy_with_logits(odds, truth), optimizer, judge, mean, step, AVERAGE)
    return mean.eval()


def descend(
    loss: Tensor, optimizer: torch.optim.Optimizer, network: nn.Module, mean: nn.Module, step: int, average: float
) -> None:
    """One step down the gradient of a loss (), cut to a norm of 1, of a network's weights and their running mean."""
    optimizer.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
    optimizer.step()
    follow(mean, network, step, average)


@torch.no_grad()
def follow(mean: nn.Module, network: nn.Module, step: int, average: float) -> None:
    """The running mean of a network's weights after one more step; `average` of it stays, less at first."""
    share = 1 - min(average, (1 + step) / (10 + step))
    for slow, fast in zip(mean.parameters(), network.parameters(), strict=True):
        slow.lerp_(fast, share)


@torch.inference_mode()
def areas(judge: GridJudge, true: Grid, drawn: Grid, rays: Tensor) -> tuple[float, float]:
    """Under the ROC curve: of all drawn grids, and of the best of each CHOICE of them."""
    truth, odds = judge(true, rays), judge(drawn, rays)
    best = odds[: len(odds) // CHOICE * CHOICE].view(-1, CHOICE).amax(1)
    return area(truth, odds), area(truth, best)


@torch.inference_mode()
def owed(cascade: Cascade, judge: GridJudge, sensors: int, seed: int) -> tuple[tuple[float, ...], float]:
    """Slopes of the odds over `openness`, and the share of their variance that these explain, of EACH drawn grids of
    each of so many virtual sensors, less each sensor's mean."""
    assert cascade.columns is not None
    streets, rng = VirtualStreets(seed, 1 << 40), np.random.default_rng(seed)
    parts: tuple[list[Tensor], list[Tensor]] = [], []
    for k in range(sensors):
        rays, standing = (part.expand(EACH, *part.shape) for part in grid(streets.image(EVERY * k), rng)[2:])
        rngs = generators(EACH * k, EACH)
        drawn = draw(cascade.columns, rays, draft(cascade, rays, standing, rngs), rngs)
        for kind, values in zip(parts, (openness(drawn, rays), judge.of_all(drawn, rays)[:, None]), strict=True):
            kind.append(values - values.mean(0))
    numbers, odds = map(torch.cat, parts)
    slopes = torch.linalg.lstsq(numbers, odds).solution
    explained = 1 - (odds - numbers @ slopes).square().sum() / odds.square().sum()
    return tuple(round(slope, 3) for slope in slopes[:, 0].tolist()), explained.item()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("out", type=Path)
    parser.add_argument("--grids", type=int, default=3328)
    parser.add_argument("--steps", type=int, default=1300)
    parser.add_argument("--width", type=int, default=40)
    parser.add_argument("--sensors", type=int, default=160)
    parser.add_argument("--seed", type=int, default=66001, help="of the streets")
    args = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    model = load(args.model)
    if not isinstance(model, CascadeModel) or model.network.columns is None:
        parser.error(f"expected a cascade that draws columns, found {args.model}")
    true, drawn, rays = both(model.network, args.grids, args.seed)
    held = max(args.grids // 13, CHOICE)
    rest = slice(held, None)
    judge = learned(taken(true, rest), taken(drawn, rest), rays[rest], args.steps, args.width)
    of_all, of_best = areas(judge, taken(true, slice(held)), taken(drawn, slice(held)), rays[:held])
    judge.slopes, explained = owed(model.network, judge, args.sensors, args.seed + 1)
    model.network.judge = judge
    fields = {"model.judge_channels": args.width, "model.judge_openness": judge.slopes}
    fields |= {"card.results": ()}  # those of other weights
    replace(model, experiment=with_fields(model.experiment, fields)).save(args.out)
    print(f"{args.out}: {args.grids} grids, {args.steps} steps: area {of_all:.3f}, best of {CHOICE} {of_best:.3f}; "
          f"openness explains {100 * explained:.0f} % of the odds")  # fmt: skip


if __name__ == "__main__":
    main()
