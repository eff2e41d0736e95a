"""Statistics gathered by two processes are, in both, those of one that saw everything."""

from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist
from forked import Forked

from lidarsynth.evaluation.processes import over_processes
from lidarsynth.evaluation.protocols import BEV_1
from lidarsynth.evaluation.statistics import Statistics
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.metrics.distributions import Moments, moments


def gather(words: list[str]) -> None:
    """What each of the two does."""
    folder, rank = Path(words[0]), int(words[1])
    dist.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=2)
    x = np.load(folder / "x.npy")
    own = Moments(x.shape[1])
    own.update(x[:7] if rank == 0 else x[7:])
    torch.save(over_processes(own).state(), folder / f"{rank}.pt")
    sensor = SENSORS["vlp-16"].resized(width=64)
    near = np.full((16, 64), 5.0 + rank, np.float32)
    statistics = Statistics(BEV_1, sensor, "samples")
    statistics.update([RangeImage(near, 0 * near, near > 0, sensor)], [True], [True])
    statistics.networks["any"] = torch.nn.Linear(1, 1)
    both = over_processes(statistics)
    assert both.bev is not None
    assert both.count == both.bev.count == 2 and len(both.bev.scans) == 2, both.count
    assert not both.networks and statistics.networks and statistics.count == 1
    dist.destroy_process_group()


def test_two_processes_gather_what_one_would(tmp_path: Path):
    x = np.random.default_rng(0).normal(size=(20, 5))
    np.save(tmp_path / "x.npy", x)
    both = [Forked(tmp_path, rank, run=gather) for rank in (0, 1)]
    said = [process.communicate(timeout=200) for process in both]
    assert [process.wait() for process in both] == [0, 0], said
    expected = moments(x)
    for rank in (0, 1):
        found = Moments.from_state(torch.load(tmp_path / f"{rank}.pt", weights_only=True))
        assert found.count == 20
        torch.testing.assert_close(found.covariance(), expected.covariance(), rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(found.mean, expected.mean, rtol=1e-10, atol=1e-12)


def test_one_process_keeps_its_own():
    own = moments(np.ones((3, 2)))
    assert over_processes(own) is own
