"""Training: samples per second, the loader alone, memory, and the share of time spent waiting for data.

python benchmarks/training.py                                    preset tiny, seconds
python benchmarks/training.py default --steps 20                 the shipped model
accelerate launch --num_processes 8 benchmarks/training.py r2dm-h --data CACHE --precision fp16 --compile --workers 8
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from itertools import islice
from pathlib import Path

import numpy as np
import torch

from lidarsynth.data.dataset import CachedImages, write_cache
from lidarsynth.experiment.record import Experiment, with_fields
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.systems.table import build_network, task_of
from lidarsynth.training.examples import Examples, Streets, TrainingImages, load_batches, open_images
from lidarsynth.training.loop import start, train
from lidarsynth.training.machine import accelerator_of, workers_of
from lidarsynth.training.options import Options
from lidarsynth.verbs.training import resolve

WARM_UP = 5  # steps that are not timed


def noise_cache(folder: Path, experiment: Experiment, count: int = 64) -> CachedImages:
    """A cache of random images of the experiment's size: as slow to read as any."""
    sensor, rng = build_sensor(experiment), np.random.default_rng(0)
    shape = (sensor.height, sensor.width)

    def image(i: int) -> RangeImage:
        return RangeImage(rng.uniform(2, 60, shape).astype(np.float32), rng.random(shape), np.ones(shape, bool), sensor)

    list(write_cache(folder, image, count, sensor, {"name": "noise"}))
    return CachedImages(folder)


def loader_speed(experiment: Experiment, images: TrainingImages, workers: int, steps: int) -> float:
    """Samples per second of one process's loader when nobody trains."""
    batches = load_batches(Examples(experiment, images, 1, task_of(experiment).draw), 0, range(1), workers)
    next(batches)
    began = time.perf_counter()
    count = sum(len(batch.x_0) for batch in islice(batches, steps))
    return count / (time.perf_counter() - began)


def gigabytes() -> str:
    """The peak memory of this process, and of its GPU."""
    host = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    gpu = torch.cuda.max_memory_allocated() / 2**30 if torch.cuda.is_available() else 0.0
    return f"{host:.2f} GiB" + (f", GPU {gpu:.2f} GiB" if gpu else "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("preset", nargs="?", default="tiny")
    parser.add_argument("--data", help="cache, or synthetic; default: a cache of noise")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--set", nargs="*", default=[], help="such as training.batch_size=64")
    parser.add_argument("--precision", choices=["fp32", "bf16", "fp16"])
    parser.add_argument("--compile", action="store_true")
    parser.add_argument("--workers", type=int)
    args = parser.parse_args()
    options = Options(precision=args.precision, compile=args.compile, workers=args.workers)
    experiment = resolve(args.preset, tuple(args.set), data=args.data)
    experiment = with_fields(experiment, {"training.steps": args.steps + WARM_UP})
    with tempfile.TemporaryDirectory() as folder:
        images = open_images(args.data, experiment) if args.data else noise_cache(Path(folder), experiment)
        measure(experiment, images, options, args.steps)


def measure(experiment: Experiment, images: TrainingImages, options: Options, steps: int) -> None:
    """Train for a while and print the table."""
    accelerator = accelerator_of(options)
    on_gpu = accelerator.device.type == "cuda"
    workers = workers_of(options, on_gpu or isinstance(images, Streets))
    loader = loader_speed(experiment, images, workers, steps)
    run = start(experiment, build_network(experiment), task_of(experiment), accelerator.scaler)
    timed = list(train(experiment, run, images, options, accelerator))[WARM_UP:]
    if not accelerator.is_main_process:
        return
    seconds, waited = sum(p.seconds for p in timed), sum(p.waited for p in timed)
    device = torch.cuda.get_device_name() if on_gpu else f"CPU, {torch.get_num_threads()} threads"
    print(f"{experiment.name}  {accelerator.num_processes} x {device}  batch {experiment.training.batch_size}  "
          f"{accelerator.mixed_precision.replace('no', 'fp32')}{'  compiled' if options.compile else ''}")  # fmt: skip
    print(f"training            {len(timed) * experiment.training.batch_size / seconds:10.1f} samples/s")
    print(f"loader, {workers:2d} workers  {loader:10.1f} samples/s per process")
    print(f"waiting for data    {100 * waited / seconds:10.1f} %")
    print(f"memory              {gigabytes():>10}")


if __name__ == "__main__":
    main()
