"""Speed and memory of the metrics on this CPU: feature networks, JSD and MMD of many scans, a large Frechet distance.

python benchmarks/metrics.py                    all of it, each in a process of its own
python benchmarks/metrics.py --scans 1000       fewer scans for JSD and MMD; --only jsd-mmd for one row

Weights are random: they do not change the speed. The BEV histograms that JSD and MMD compare are made beforehand, from
300 drawn scans (150 a side) with counting noise; what drawing one takes is a row of its own.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import torch

from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.metrics.bev import bev_histograms
from lidarsynth.metrics.distributions import Moments, frechet_distance, gaussian_mmd, jensen_shannon_distance
from lidarsynth.networks.pointnet import PointNet, point_features
from lidarsynth.networks.rangenet import RangeNet, frechet_features

SENSOR = SENSORS["hdl-64e"]  # 64 x 1024
T = TypeVar("T")


def streets(count: int, seed: int) -> np.ndarray:
    """(count, H * W, 3) float32, metres: roads between two walls at various distances, with ray-drop at the origin."""
    rng = np.random.default_rng(seed)
    rays = SENSOR.directions().reshape(-1, 3)
    with np.errstate(divide="ignore"):
        road = np.where(rays[:, 2] < 0, -1.73 / rays[:, 2], np.inf)
        walls = rng.uniform(4, 25, (count, 2))
        wall = np.where(rays[:, 1] > 0, walls[:, :1], walls[:, 1:]) / np.abs(rays[:, 1])
    distance = np.minimum(road, wall) * rng.normal(1, 0.01, (count, len(rays)))
    distance = np.where((distance < 70) & (rng.random(distance.shape) < 0.85), distance, 0)
    return (rays * distance[..., None]).astype(np.float32)


def seconds(work: Callable[[], object], repeats: int = 3) -> float:
    """Shortest wall time of `work`, after one call that warms up."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)  # other work on the machine only adds


def timed(work: Callable[[], T]) -> tuple[T, str]:
    """What `work` gives, and its wall and processor time in words; the two differ where others use the machine too."""
    wall, processor = time.perf_counter(), time.process_time()
    result = work()
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    return result, f"{wall:.1f} s, {processor:.1f} s of processor"


def rangenet(layers: int) -> str:
    network, points = RangeNet(layers).eval(), streets(1, 0)[0]
    xyz = points.T.reshape(3, SENSOR.height, SENSOR.width)
    image = np.stack([np.linalg.norm(xyz, axis=0), *xyz, np.full(xyz.shape[1:], 0.3)]).astype(np.float32)
    pixels = torch.from_numpy(image)[None]
    took = seconds(lambda: frechet_features(network, pixels, pixels[:, 0] > 0))
    return f"{1 / took:.2f} images/s"


def pointnet() -> str:
    network, points = PointNet().eval(), streets(1, 0)
    return f"{1 / seconds(lambda: point_features(network, points)):.2f} images/s"


def drawing() -> str:
    points = streets(8, 0)
    return f"{8 / seconds(lambda: bev_histograms(points)):.0f} scans/s"


def histograms(count: int, seed: int) -> torch.Tensor:
    """(count, 100, 100) int16: drawn scans, each with Poisson noise on its counts."""
    rng = np.random.default_rng(seed)
    drawn = torch.cat([bev_histograms(streets(10, 100 * seed + i)) for i in range(15)]).numpy()
    made = np.empty((count, *drawn.shape[1:]), np.int16)
    for i in range(count):
        made[i] = rng.poisson(drawn[i % len(drawn)])
    return torch.from_numpy(made)


def jsd_mmd(scans: int) -> str:
    real, fake = histograms(scans, 1), histograms(scans, 2)
    (jsd, mmd), took = timed(lambda: (jensen_shannon_distance(fake.sum(0), real.sum(0)), gaussian_mmd(fake, real)))
    return f"{took} (JSD {jsd:.4f}, MMD {mmd:.2e}; {scans:,} against {scans:,})"


def frechet(size: int = 4096, count: int = 5000) -> str:
    both, rng = [], np.random.default_rng(0)
    for _ in range(2):
        moments = Moments(size)
        moments.update(rng.normal(size=(count, size)).astype(np.float32) * rng.uniform(0.1, 3, size).astype(np.float32))
        both.append(moments)
    distance, took = timed(lambda: frechet_distance(*both))
    return f"{took} (distance {distance:.1f}; {count:,} against {count:,} features)"


def rows(scans: int) -> dict[str, tuple[str, Callable[..., str], tuple]]:
    """Word -> (title, what measures it, its arguments)."""
    return {
        "rangenet-53": ("RangeNet-53 features, 64 x 1024", rangenet, (53,)),
        "rangenet-21": ("RangeNet-21 features, 64 x 1024", rangenet, (21,)),
        "pointnet": ("PointNet features, 65,536 points", pointnet, ()),
        "drawing": ("BEV histograms, 65,536 points", drawing, ()),
        "jsd-mmd": ("JSD + MMD of BEV histograms", jsd_mmd, (scans,)),
        "frechet": ("Frechet distance, 4,096 dimensions", frechet, ()),
    }


def alone(word: str, scans: int, threads: int) -> tuple[str, float]:
    """A row's result, and the peak memory of this process in GiB."""
    torch.set_num_threads(threads)
    _, work, arguments = rows(scans)[word]
    return work(*arguments), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=10_000)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--only", choices=list(rows(1)))
    args = parser.parse_args()
    print(f"{args.threads} threads\n\n| work | speed | peak memory |\n|---|---|---|")
    fresh = multiprocessing.get_context("spawn")  # forked ones would begin with this one's memory
    for word, (title, _, _) in rows(args.scans).items():
        if args.only in (None, word):
            with fresh.Pool(1) as pool:
                result, peak = pool.apply(alone, (word, args.scans, args.threads))
            print(f"| {title} | {result} | {peak:.2f} GiB |", flush=True)


if __name__ == "__main__":
    main()
