"""lidm-2024, r2flow-2025 and r3dpa-2026 killed, shared by two machines, and over a folder that is still written."""

import os
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from forked import Forked
from voxel_weights import cached

from lidarsynth.evaluation import accumulation, evaluate
from lidarsynth.evaluation.protocols import get_protocol
from lidarsynth.evaluation.statistics import load_statistics
from lidarsynth.files.formats import read
from lidarsynth.lidar.scan import Scan

PROTOCOLS = ("lidm-2024", "r2flow-2025", "r3dpa-2026")


def killed_at_the_second(words: list[str]) -> None:
    """Gather a folder's samples for a protocol, and be killed by -9 in the second; the first is in the cache folder."""
    folder, protocol = words
    accumulation.SAVE_EVERY = 0.0

    def kill(what: str, done: int, total: int) -> None:
        if done == 2:
            os.kill(os.getpid(), signal.SIGKILL)

    evaluate.gather_part(folder, "1/1", "out.safetensors", protocol, batch_size=1, on_images=kill)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch, fixture_tensors) -> Path:
    return cached(tmp_path / "cache", fixture_tensors("lidm/spvcnn_weights"), monkeypatch)


def scans(folder: Path, numbers: Iterator[int] | range, seed: int) -> Path:
    folder.mkdir(exist_ok=True)
    for i in numbers:
        rng = np.random.default_rng([seed, i])
        angle, distance = rng.uniform(-np.pi, np.pi, 100), rng.uniform(2, 54, 100)
        xyz = np.stack([distance * np.cos(angle), distance * np.sin(angle), rng.uniform(-1.7, 0.5, 100)], 1)
        np.column_stack([xyz, np.zeros(100)]).astype(np.float32).tofile(folder / f"{i:06}.bin")
    return folder


def test_killed_and_continued_what_is_gathered_is_the_same_bit_by_bit(tmp_path: Path, cache: Path):
    samples, out = scans(tmp_path / "samples", range(3), 0), tmp_path / "out.safetensors"
    for protocol in PROTOCOLS:
        killed = Forked(samples, protocol, run=killed_at_the_second)
        assert killed.wait() == -signal.SIGKILL, killed.communicate()
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


def test_an_image_without_a_point_is_named(tmp_path: Path, cache: Path):
    folder = scans(tmp_path / "scans", range(2), 0)
    samples = [read(folder / "000000.bin"), Scan(np.full((3, 3), 90.0, np.float32), np.zeros(3, np.float32))]
    with pytest.raises(ValueError, match=r"^image 1: expected points between 0.5 and 63 m, found none of"):
        evaluate.evaluate(samples, folder, "r2flow-2025")


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
