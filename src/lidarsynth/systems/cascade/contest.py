"""The last of what the columns learn: to tell true grids from those that they draw, by their own likelihood.

Direct discriminative optimisation (Zheng et al. 2025, arXiv 2503.01103): what a network gives more chance than its
rival, the same network as it was when it drew, it calls true. So the chance of what it draws and streets never have
goes down, which likelihood alone hardly asks for. Rounds follow each other, each against the network as it has become,
for one that is far from its rival moves chance to what neither has. What came of it: docs/training-default.md.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from lidarsynth.networks.coarse_unet import COLUMNS
from lidarsynth.networks.column_neighbours import Grid, known_grid
from lidarsynth.networks.column_transformer import ColumnTransformer, draw
from lidarsynth.systems.cascade.examples import grid
from lidarsynth.training.task import Images

PART = 8  # columns in a row that are called true or drawn, as a whole
SURE = 0.4  # of the logarithm of the two chances' ratio: less of it is surer
KEPT = 20.0  # weight of plain likelihood on true grids, which keeps noise and reflectance as they are
HALF, ROUND, FRESH, TOGETHER = 8, 100, 512, 64  # grids of either kind in a step; steps of a round; its grids; at once
RATE, WARM = 6e-5, 50  # learning rate, and steps until it is reached


def contest(
    network: ColumnTransformer, rival: ColumnTransformer, true: Grid, drawn: Grid, rays: Tensor, columns: Tensor
) -> Tensor:
    """(3,) losses: of true grids taken for drawn ones, of drawn for true ones, and nats a pixel of the true ones.

    true, drawn  (B, 16, 128) each; rays (2 B, 8, 16, 128), of both; columns (n,) that are judged, runs of PART
    """
    count, both = len(true.code), Grid(*(torch.cat(pair) for pair in zip(true, drawn, strict=True)))
    with torch.no_grad():
        _, before = rival.judged(both, rays, columns)
    plain, now = network.judged(both, rays, columns)
    ratio = SURE * (now - before).sum(1).unflatten(1, (-1, PART)).sum(2)
    return torch.stack(
        [F.softplus(-ratio[:count]).mean(), F.softplus(ratio[count:]).mean(), plain[:count].sum(1).mean()]
    )


def contested(
    network: ColumnTransformer, images: Images, steps: int, seed: int = 0, state: dict[str, Any] | None = None
) -> Iterator[tuple[dict[str, Any], Tensor]]:
    """Teaches the network, in place; yields, after each step, what `state` takes and the losses of `contest`.

    images  `image(i)` of any number i, whose sensors have at least 16 beams and 128 columns; FRESH are taken a round
    state   as it was yielded: goes on bit by bit as if never stopped
    """
    rival = copy.deepcopy(network).eval().requires_grad_(False)
    optimizer = torch.optim.AdamW(network.parameters(), RATE, betas=(0.9, 0.95), weight_decay=0)
    parts = {"network": network, "rival": rival, "optimizer": optimizer}
    for word, part in parts.items() if state else ():
        part.load_state_dict(state[word])
    first, met = state["step"] if state else 0, None
    for step in range(first, steps):
        if step % ROUND == 0:
            rival.load_state_dict(network.state_dict())
        if met is None or step % ROUND == 0:
            met = _round(rival, images, seed, step // ROUND)
        rng = np.random.default_rng((seed, step))
        chosen, others = (torch.from_numpy(rng.integers(FRESH, size=HALF)) for _ in range(2))
        runs = PART * rng.permutation(COLUMNS // PART)[: COLUMNS // PART // 2, None] + np.arange(PART)
        grids = Grid(*(part[chosen] for part in met.true)), Grid(*(part[others] for part in met.drawn))
        rays = torch.cat([met.rays[chosen], met.rays[others]])
        losses = contest(network, rival, *grids, rays, torch.from_numpy(runs.ravel()))
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1, (step + 1) / WARM) * (0.525 + 0.475 * math.cos(math.pi * step / steps))
        optimizer.zero_grad()
        (losses * losses.new_tensor([1, 1, KEPT])).sum().backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        yield {"step": step + 1, **{word: part.state_dict() for word, part in parts.items()}}, losses.detach()


class _Round(NamedTuple):
    """Of as many streets: their grids, those that the rival draws for the same rays, and these, (FRESH, 8, 16, 128)."""

    true: Grid
    drawn: Grid
    rays: Tensor


def _round(rival: ColumnTransformer, images: Images, seed: int, number: int) -> _Round:
    rng, drawn = np.random.default_rng((seed, number, 1)), []
    each = [grid(*images.take([number * FRESH + k]), rng)[:3] for k in range(FRESH)]
    metres, reflectance, rays = (torch.stack(part) for part in zip(*each, strict=True))
    for first in range(0, FRESH, TOGETHER):
        part = rays[first : first + TOGETHER]
        chances = [torch.Generator().manual_seed(int(n)) for n in rng.integers(1 << 40, size=len(part))]
        drawn.append(draw(rival, part, chances))
    whole = Grid(*(torch.cat(part) for part in zip(*drawn, strict=True)))
    return _Round(known_grid(metres, reflectance), Grid(*(part.clone() for part in whole)), rays)
