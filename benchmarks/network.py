"""Seconds per network step and per scan, on a CPU, of R2DM-H and of the default model, at 1 and 2 threads.

python benchmarks/network.py                     a table
python benchmarks/network.py --models default    one of them; a scan is 32 steps, its table column 32 times a step
"""

from __future__ import annotations

import argparse
import time

import torch

from lidarsynth.build import build_network
from lidarsynth.presets import PRESETS, preset

STEPS = 32  # of a generated scan, `lidarsynth generate`'s default


@torch.no_grad()
def seconds_per_step(name: str, threads: int, repeats: int) -> float:
    """Shortest time of one network call for one scan, weights at random: they make no difference."""
    torch.set_num_threads(threads)
    experiment = preset(name)
    network = build_network(experiment)
    x_t = torch.randn(1, 2, experiment.data.height, experiment.data.width)
    log_snr = torch.zeros(1)
    network(x_t, log_snr)
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        network(x_t, log_snr)
        times.append(time.perf_counter() - start)
    return min(times)  # other work on the machine only adds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", default=["r2dm-h", "default"], choices=list(PRESETS))
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    print("| model | parameters | threads | s per step | s per scan of 32 steps | times the first line's speed |")
    print("|---|---|---|---|---|---|")
    first = None
    for name in args.models:
        count = sum(p.numel() for p in build_network(preset(name)).parameters())
        for threads in args.threads:
            step = seconds_per_step(name, threads, args.repeats)
            first = first or step
            print(
                f"| {name} | {count:,} | {threads} | {step:.3f} | {STEPS * step:.1f} | {first / step:.1f} |", flush=True
            )


if __name__ == "__main__":
    main()
