"""Statistics gathered by two processes are, in both, those of one that saw everything."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch

from lidarsynth.evaluation.processes import over_processes
from lidarsynth.metrics.distributions import Moments, moments

GATHER = """
import sys
import numpy as np, torch, torch.distributed as dist
from lidarsynth.metrics.bev import BevCounts
from lidarsynth.metrics.distributions import Moments
from lidarsynth.evaluation.processes import over_processes
from lidarsynth.evaluation.protocols import BEV_1
from lidarsynth.evaluation.statistics import Statistics
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.lidar.scan import RangeImage
folder, rank = sys.argv[1], int(sys.argv[2])
dist.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=2)
x = np.load(f"{folder}/x.npy")
own = Moments(x.shape[1])
own.update(x[:7] if rank == 0 else x[7:])
torch.save(over_processes(own).state(), f"{folder}/{rank}.pt")
sensor = SENSORS["vlp-16"].resized(width=64)
near = np.full((16, 64), 5.0 + rank, np.float32)
statistics = Statistics(BEV_1, sensor, "samples")
statistics.update([RangeImage(near, 0 * near, near > 0, sensor)], [True], [True])
statistics.networks["any"] = torch.nn.Linear(1, 1)
both = over_processes(statistics)
assert both.count == both.bev.count == 2 and len(both.bev.scans) == 2, both.count
assert not both.networks and statistics.networks and statistics.count == 1
dist.destroy_process_group()
"""


def test_two_processes_gather_what_one_would(tmp_path: Path):
    x = np.random.default_rng(0).normal(size=(20, 5))
    np.save(tmp_path / "x.npy", x)
    command = [sys.executable, "-c", GATHER, str(tmp_path)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    both = [subprocess.Popen([*command, str(rank)], env=environment, stderr=subprocess.PIPE) for rank in (0, 1)]
    errors = [process.communicate(timeout=200)[1].decode() for process in both]
    assert [process.returncode for process in both] == [0, 0], "\n".join(errors)[-3000:]
    expected = moments(x)
    for rank in (0, 1):
        found = Moments.from_state(torch.load(tmp_path / f"{rank}.pt", weights_only=True))
        assert found.count == 20
        torch.testing.assert_close(found.covariance(), expected.covariance(), rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(found.mean, expected.mean, rtol=1e-10, atol=1e-12)


def test_one_process_keeps_its_own():
    own = moments(np.ones((3, 2)))
    assert over_processes(own) is own
