"""Goes on with a cascade's columns against what they draw themselves: python examples/contest.py OUT [--from MODEL].

The last stage of the weights `default` (docs/training-default.md), on virtual streets, one core. Stopped at any moment,
the same command goes on; in the end OUT is a model folder.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import torch

from lidarsynth.experiment.folder import save
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.networks.cascade import Cascade
from lidarsynth.systems.cascade.contest import contested
from lidarsynth.training.examples import VIRTUAL, Streets
from lidarsynth.weights.load import load_parts

EVERY = 25  # steps from one saved state to the next


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--from", dest="model", default="default")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(1)
    experiment, network = load_parts(args.model)
    if not isinstance(network, Cascade) or network.columns is None:
        parser.error(f"expected a cascade that draws columns, found {args.model}")
    args.out.mkdir(parents=True, exist_ok=True)
    kept = args.out / "contest.pt"
    before = torch.load(kept, weights_only=True) if kept.exists() else None
    columns = network.columns.requires_grad_(True)
    images = Streets(args.seed, build_sensor(experiment), VIRTUAL)
    total = torch.zeros(3)
    for state, losses in contested(columns, images, args.steps, args.seed, before):
        total += losses
        if state["step"] % EVERY == 0 or state["step"] == args.steps:
            print(state["step"], "missed {:.3f}, fooled {:.3f}, nats a pixel {:.3f}".format(*total / EVERY), flush=True)
            total.zero_()
            torch.save(state, kept.with_suffix(".new"))
            os.replace(kept.with_suffix(".new"), kept)
    print(save(args.out, experiment, network, half=True))


if __name__ == "__main__":
    main()
