"""lidm-2024, r2flow-2025 and r3dpa-2026 killed, shared by two machines, and over a folder that is still written."""

import os
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from lidarsynth.evaluation import accumulation, evaluate
from lidarsynth.evaluation.protocols import get_protocol
from lidarsynth.evaluation.statistics import load_statistics

PROTOCOLS = ("lidm-2024", "r2flow-2025", "r3dpa-2026")
# Each protocol in a child of its own, killed by -9 in the second sample; the first is in the cache folder.
KILLED = """
import os, signal, sys
from lidarsynth.evaluation import accumulation, evaluate
accumulation.SAVE_EVERY = 0.0
def kill(what, done, total):
    if done == 2:
        os.kill(os.getpid(), signal.SIGKILL)
for protocol in sys.argv[2:]:
    if (child := os.fork()) == 0:
        evaluate.gather_part(sys.argv[1], "1/1", "out.safetensors", protocol, batch_size=1, on_images=kill)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL, protocol
"""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch, oracle_tensors) -> Path:
    """A cache folder with seeded weights under the published names; no network is asked."""
    weights = oracle_tensors("lidm_spvcnn_weights")
    branch = {name: value for name, value in weights.items() if not name.startswith("point_transforms")}
    for name, tensors in (("spvcnn", weights), ("minkowskinet", branch)):
        (tmp_path / f"cache/{name}_lidm").mkdir(parents=True)
        torch.save({"state_dict": tensors}, tmp_path / f"cache/{name}_lidm/model.ckpt")
    monkeypatch.setenv("LIDARSYNTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(accumulation, "URLS", dict.fromkeys(accumulation.URLS, "http://127.0.0.1:9"))
    return tmp_path / "cache"


def scans(folder: Path, numbers: Iterator[int] | range, seed: int) -> Path:
    folder.mkdir(exist_ok=True)
    for i in numbers:
        rng = np.random.default_rng([seed, i])
        angle, distance = rng.uniform(-np.pi, np.pi, 300), rng.uniform(2, 54, 300)
        xyz = np.stack([distance * np.cos(angle), distance * np.sin(angle), rng.uniform(-1.7, 0.5, 300)], 1)
        np.column_stack([xyz, np.zeros(300)]).astype(np.float32).tofile(folder / f"{i:06}.bin")
    return folder


def test_killed_and_continued_what_is_gathered_is_the_same_bit_by_bit(tmp_path: Path, cache: Path):
    samples, out = scans(tmp_path / "samples", range(3), 0), tmp_path / "out.safetensors"
    command = [sys.executable, "-c", KILLED, str(samples), *PROTOCOLS]
    environment = {**os.environ, "OMP_NUM_THREADS": str(torch.get_num_threads())}
    done = subprocess.run(command, env=environment, capture_output=True, timeout=300)
    assert done.returncode == 0, done.stderr.decode()[-2000:]
    for protocol in PROTOCOLS:
        seen: list[int] = []
        note = partial(lambda seen, what, done, total: seen.append(done), seen)
        continued = evaluate.gather_part(samples, "1/1", out, protocol, batch_size=1, on_images=note)
        assert seen == [2, 3], "the first sample was kept"
        assert not list((cache / "statistics").glob(f"*{protocol}*"))
        assert continued == evaluate.gather_part(samples, "1/1", out, protocol, batch_size=1), "the hash of all of it"


@pytest.mark.parametrize(
    ("protocol", "side"), [("lidm-2024", "samples"), ("r2flow-2025", "reference"), ("r3dpa-2026", "reference")]
)
def test_two_machines_gather_what_one_does(protocol: str, side, tmp_path: Path, cache: Path):
    folder = scans(tmp_path / "scans", range(2), 0)
    files = [tmp_path / f"{part[0]}.safetensors" for part in ("1/2", "2/2", "all")]
    for part, file in zip(("1/2", "2/2", "1/1"), files, strict=True):
        evaluate.gather_part(folder, part, file, protocol, side=side)
    (merged, notes), (whole, _) = (evaluate.merged(parts, get_protocol(protocol)) for parts in (files[:2], files[2:]))
    assert not notes and merged.count == whole.count == 2 and merged.digest == whole.digest
    found, expected = merged.tensors(), whole.tensors()
    assert found.keys() == expected.keys() and {"minkowskinet.features", "spvcnn.features"} <= found.keys()
    for name, tensor in expected.items():  # counts and cells are integers; sums of floats are in another order
        torch.testing.assert_close(found[name], tensor, rtol=1e-6, atol=1e-6 if tensor.is_floating_point() else 0)


def test_a_folder_that_grows_is_judged_whole_and_a_file_half_written_is_named(tmp_path: Path, cache: Path, monkeypatch):
    monkeypatch.setattr(accumulation, "SAVE_EVERY", 0.0)
    samples = scans(tmp_path / "samples", range(3), 0)

    def stop(what: str, done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    out = tmp_path / "out.safetensors"
    with pytest.raises(KeyboardInterrupt):
        evaluate.gather_part(samples, "1/1", out, "lidm-2024", batch_size=1, on_images=stop)
    scans(samples, range(3, 4), 0)
    whole = (samples / "000003.bin").read_bytes()
    (samples / "000003.bin").write_bytes(whole[:1001])
    with pytest.raises(ValueError, match=r"000003\.bin: expected .*, found"):
        evaluate.gather_part(samples, "1/1", out, "lidm-2024", batch_size=1)
    assert not out.exists()
    (samples / "000003.bin").write_bytes(whole)
    (samples / ".000005.bin.part").write_bytes(whole[:100])
    grown, again = tmp_path / "grown.safetensors", tmp_path / "again.safetensors"
    for folder, out in ((samples, grown), (scans(tmp_path / "again", range(4), 0), again)):
        evaluate.gather_part(folder, "1/1", out, "lidm-2024", batch_size=1)
    both = [load_statistics(out)[0] for out in (grown, again)]
    assert both[0].count == 4 and both[0].digest == both[1].digest
    for name, tensor in both[0].tensors().items():
        assert torch.equal(tensor, both[1].tensors()[name]), name
