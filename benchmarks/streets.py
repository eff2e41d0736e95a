"""Labelled streets: how fast they are made, who is in them, and what odometry makes of a drive.

python benchmarks/streets.py                          frames per second of processor time, by sensor, boxes included
python benchmarks/streets.py --shares                 shares of pixels, by --pedestrians, --cyclists, --motorcycles
python benchmarks/streets.py --odometry               KISS-ICP (pip install kiss-icp) on drives, against their poses
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.streets.areas import Density
from lidarsynth.streets.frame import Frame, LabelledStreets, Options
from lidarsynth.streets.reader import SyntheticStreets, Worlds
from lidarsynth.streets.turn import sensor_pose
from lidarsynth.streets.world import POSES

SETTLED = 5  # frames until KISS-ICP knows how fast it goes; its first cannot be deskewed


def speed(name: str, frames: int, count: int) -> str:
    """One line: frames per second of processor time; worlds included, the first (which loads things) left out."""
    reader = LabelledStreets(1, count, SENSORS[name], Options(frames=frames))
    LabelledStreets(0, 1, SENSORS[name], Options(frames=frames))[0]
    start = time.process_time()
    points = [len(reader[index].scan) for index in range(len(reader))]
    rate = len(points) / (time.process_time() - start)
    what = f"drive of {frames}" if frames else f"{count} places"
    return f"{name}, {what}: {rate:.1f} frames per second and core, {np.mean(points):.0f} points each"


def shares(density: Density, worlds: int) -> str:
    """One line: per cent of the labelled pixels of one scan in each world, for each class of small road users."""
    sensor = SENSORS["hdl-64e-kitti"]
    reader = SyntheticStreets(0, POSES * worlds, sensor, worlds=Worlds(0, sensor, density=density))
    labels = np.concatenate([reader.image(POSES * world + 4).label.ravel() for world in range(worlds)])
    counts = np.bincount(labels, minlength=len(CLASS_NUMBER))
    words = ("person", "bicyclist", "motorcyclist", "bicycle", "motorcycle", "car")
    cells = [f"{100 * counts[CLASS_NUMBER[word]] / counts[1:].sum():.3f}" for word in words]
    asked = (density.pedestrians, density.cyclists, density.motorcycles)
    return "| " + " | ".join([*(f"{factor:g}" for factor in asked), *cells]) + " |"


def estimated(frames: list[Frame], timed: bool) -> np.ndarray:
    """(N, 4, 4) poses of KISS-ICP with its defaults; timed: it is told when each point was measured."""
    from kiss_icp.config import load_config
    from kiss_icp.kiss_icp import KissICP

    config = load_config(None)
    config.data.deskew, config.registration.max_num_threads = timed, 1
    odometry = KissICP(config)
    poses = []
    for frame in frames:
        assert frame.scan.time is not None
        stamps = frame.scan.time / 0.1 if timed else np.zeros(0)
        odometry.register_frame(frame.scan.xyz.astype(np.float64), stamps.astype(np.float64))
        poses.append(odometry.last_pose.copy())
    return np.stack(poses)


def errors(truth: np.ndarray, found: np.ndarray) -> str:
    """Drift over the whole drive in percent and degrees, root mean square of the position, of aligned first poses."""
    truth, found = np.linalg.inv(truth[0]) @ truth, np.linalg.inv(found[0]) @ found
    gap = np.linalg.norm(truth[:, :3, 3] - found[:, :3, 3], axis=1)
    length = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    turn = truth[-1, :3, :3].T @ found[-1, :3, :3]
    angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    return f"{length:.0f} m | {100 * gap[-1] / length:.2f} | {angle:.2f} | {np.sqrt((gap**2).mean()):.3f}"


def odometry(seeds: int, frames: int, name: str) -> None:
    """A row per drive and way of reading it."""
    print("| drive | points | length | drift, % | turn, degrees | RMSE, m |\n|---|---|---|---|---|---|")
    for seed in range(seeds):
        for deskewed in (False, True):
            reader = LabelledStreets(seed, 1, SENSORS[name], Options(frames=frames, deskewed=deskewed))
            made = [reader[k] for k in range(frames)]
            drive = reader.drive(0)
            for timed in (False,) if deskewed else (True, False):
                # Told the times, KISS-ICP gives the pose at the end of each turn, else that of the middle fits.
                stamps = np.array([frame.stamp for frame in made]) + 0.05 * timed
                truth = np.stack([sensor_pose(reader.sensor, pose) for pose in drive.poses(stamps)])
                what = "deskewed" if deskewed else "as measured, times given" if timed else "as measured, no times"
                found = estimated(made, timed)
                first = SETTLED if timed else 0
                print(f"| {seed} | {what} | {errors(truth[first:], found[first:])} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--odometry", action="store_true")
    parser.add_argument("--shares", type=int, nargs="?", const=120, metavar="WORLDS")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--drives", type=int, default=2)
    parser.add_argument("--sensor", default="hdl-64e-kitti")
    args = parser.parse_args()
    if args.odometry:
        odometry(args.drives, args.frames, args.sensor)
    elif args.shares:
        for asked in ((1, 0, 0), (0.1, 0, 0), (0.08, 0, 0), (0.05, 0, 0), (0.08, 0.1, 0), (0.08, 0.1, 0.08)):
            density = Density(**dict(zip(("pedestrians", "cyclists", "motorcycles"), asked, strict=True)))
            print(shares(density, args.shares), flush=True)
    else:
        for name in ("hdl-64e-kitti", "os1-64", "vlp-16"):
            print(speed(name, 0, 16))
            print(speed(name, 16, 1))


if __name__ == "__main__":
    main()
