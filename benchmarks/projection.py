"""Scans per second of one core: reading a KITTI `.bin`, and drawing it as a range image by both projections.

python benchmarks/projection.py                 a synthetic scan of KITTI's size, made here
python benchmarks/projection.py 000008.bin      a scan of your own
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from lidarsynth.files.formats import read, write
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import SENSORS


def kitti_like(path: Path) -> Path:
    """A round room: 64 rings of 1,900 points one after the other, anticlockwise from ahead, as in KITTI."""
    sensor = SENSORS["hdl-64e-kitti"].resized(width=1900)
    sine = np.sin(sensor.ray_angles()[0])
    distance = np.minimum(np.where(sine < 0, -1.73 / np.minimum(sine, -1e-3), 40), 40).astype(np.float32)
    xyz = np.roll(sensor.points(distance)[:, ::-1], -950, axis=1).reshape(-1, 3)
    write(path, Scan(xyz, np.full(len(xyz), 0.3, np.float32)))
    return path


def seconds(work: Callable[[], object], repeats: int) -> float:
    """Shortest wall time of `work`, after one call that warms up."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)  # other work on the machine only adds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", nargs="?", type=Path)
    parser.add_argument("--repeats", type=int, default=20)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = args.scan or kitti_like(Path(folder) / "scan.bin")
        scan = read(path)
        works: dict[str, Callable[[], object]] = {"reading alone": lambda: read(path)}
        for method, sensor in (
            ("spherical", "hdl-64e"),
            ("spherical", "hdl-64e-kitti"),
            ("unfolding", "hdl-64e-kitti"),
        ):
            works[f"{method}, {sensor}"] = lambda m=method, s=sensor: project(scan, s, m)
            works[f"read + {method}, {sensor}"] = lambda m=method, s=sensor: project(read(path), s, m)
        times = {name: seconds(work, args.repeats) for name, work in works.items()}
    print(f"{len(scan):,} points to 64 x 1024\n\n| work | ms | scans/s | times reading |\n|---|---|---|---|")
    for name, took in times.items():
        print(f"| {name} | {1000 * took:.1f} | {1 / took:.0f} | {took / times['reading alone']:.1f} |")


if __name__ == "__main__":
    main()
