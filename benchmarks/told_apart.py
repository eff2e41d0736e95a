"""How well a small network learns to tell the grids that a cascade draws from those of streets (a classifier two-sample
test, Lopez-Paz & Oquab 2017).

python benchmarks/told_apart.py [--model default] [--grids 1024] [--steps 300] [--seed 4242]

Both of the same virtual sensors; an eighth is held out. Prints, of the held-out ones, the area under the ROC curve by
single columns, told eleven around, and by whole grids: 0.5 if nobody can tell, 1 if anybody can. Range and reflectance
get noise (1.7 % and 0.03), so that what counts is the layout. The area grows with grids and steps: compare models at
the same ones.
"""

from __future__ import annotations

import argparse
import math

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.diffusion.samplers import generators
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.coarse_unet import ROWS
from lidarsynth.networks.column_neighbours import Grid, known_grid
from lidarsynth.networks.column_transformer import draw
from lidarsynth.networks.fill_unet import ring
from lidarsynth.networks.grid_judge import INPUTS, seen
from lidarsynth.streets.virtual import VirtualStreets
from lidarsynth.systems.cascade.examples import grid
from lidarsynth.systems.cascade.layout import draft
from lidarsynth.weights.load import load_parts

SEED, TOGETHER, BATCH, RATE, WIDTH, BLOCKS = 4242, 64, 12, 2e-3, 48, 4
CODE, SHADE = 0.006, 0.03  # standard deviations of the noise


class Judge(nn.Module):
    """`judge(grid (B, 16, 128), rays (B, 8, 16, 128)) -> logits (B, 128)` of each column: positive for a true one."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Conv2d(INPUTS, WIDTH, 3, padding=(1, 0))
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.GroupNorm(8, WIDTH), nn.SiLU(), nn.Conv2d(WIDTH, WIDTH, 3, padding=(1, 0)), nn.SiLU(),
                          nn.Conv2d(WIDTH, WIDTH, 1)) for _ in range(BLOCKS))  # fmt: skip
        self.column = nn.Sequential(nn.Linear(ROWS * WIDTH, 96), nn.SiLU(), nn.Linear(96, 1))

    def forward(self, grid: Grid, rays: Tensor) -> Tensor:
        code = grid.code + CODE * torch.randn_like(grid.code)
        h = self.stem(ring(seen(Grid(code, grid.shade + SHADE * torch.randn_like(code), grid.returned), rays), 1))
        for block in self.blocks:
            h = h + block(ring(h, 1))
        return self.column(h.flatten(1, 2).transpose(1, 2))[..., 0]


def both(cascade: Cascade, count: int, seed: int) -> tuple[Grid, Grid, Tensor]:
    """`count` true grids (B, 16, 128), as many drawn ones, and their rays (B, 8, 16, 128)."""
    assert cascade.columns is not None
    streets, rng, drawn = VirtualStreets(seed, 1 << 40), np.random.default_rng(seed), []
    metres, reflectance, rays, standing = map(
        torch.stack, zip(*(grid(streets.image(k), rng) for k in range(count)), strict=True)
    )
    for first in range(0, count, TOGETHER):
        told = rays[first : first + TOGETHER], standing[first : first + TOGETHER]
        rngs = generators(first, len(told[0]))
        drawn.append(draw(cascade.columns, told[0], draft(cascade, *told, rngs), rngs))
    true = known_grid(metres, reflectance.clamp(-0.1, 1.1))
    return true, Grid(*(torch.cat(part).clone() for part in zip(*drawn, strict=True))), rays


def taken(whole: Grid, chosen: Tensor | slice) -> Grid:
    """Some of the grids."""
    return Grid(*(part[chosen] for part in whole))


def learned(true: Grid, drawn: Grid, rays: Tensor, steps: int) -> Judge:
    """A judge of these grids (B, 16, 128), after so many steps of BATCH of either kind."""
    judge, rng = Judge(), torch.Generator().manual_seed(0)
    optimizer = torch.optim.AdamW(judge.parameters(), RATE, weight_decay=0.01)
    for step in range(steps):
        first, second = (torch.randint(len(rays), (BATCH,), generator=rng) for _ in range(2))
        grids = Grid(*(torch.cat(pair) for pair in zip(taken(true, first), taken(drawn, second), strict=True)))
        logits = judge(grids, torch.cat([rays[first], rays[second]]))
        truth = torch.cat([torch.ones_like(logits[:BATCH]), torch.zeros_like(logits[BATCH:])])
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1, (step + 1) / 50) * (0.5 + 0.5 * math.cos(math.pi * step / steps))
        optimizer.zero_grad()
        F.binary_cross_entropy_with_logits(logits, truth).backward()
        optimizer.step()
    return judge.eval()


def area(true: Tensor, drawn: Tensor) -> float:
    """Under the ROC curve: how often a true one has the higher logit."""
    place = torch.cat([true, drawn]).argsort().argsort().double()
    count = len(true)
    return float((place[:count].sum() - count * (count - 1) / 2) / (count * len(drawn)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="default")
    parser.add_argument("--grids", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seed", type=int, default=SEED, help="of the streets")
    args = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    network = load_parts(args.model)[1]
    if not isinstance(network, Cascade) or network.columns is None:
        parser.error(f"expected a cascade that draws columns, found {args.model}")
    true, drawn, rays = both(network, args.grids, args.seed)
    held = len(rays) // 8
    judge = learned(taken(true, slice(held, None)), taken(drawn, slice(held, None)), rays[held:], args.steps)
    with torch.inference_mode():
        logits = [judge(taken(one, slice(held)), rays[:held]) for one in (true, drawn)]
    columns, grids = area(*(x.flatten() for x in logits)), area(*(x.mean(1) for x in logits))
    print(f"{args.model}: {args.grids} grids, {args.steps} steps: area {columns:.3f} by column, {grids:.3f} by grid")


if __name__ == "__main__":
    main()
