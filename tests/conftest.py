"""What all tests share: the folder of facts, reference tensors and real scans, and one thread per process.

torch is imported by the processes that run tests, not by the one that hands them out.
"""

from __future__ import annotations

import gc
import lzma
import os
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from torch import Tensor

REPO_ROOT = Path(__file__).resolve().parents[1]
ORACLES = Path(__file__).parent / "oracles"
SHARED = Path(os.environ.get("LIDARSYNTH_SHARED", REPO_ROOT.parent / "shared"))


def pytest_collection_finish() -> None:
    """pytest-xdist runs one process per core; what is imported by now is looked through for garbage no more."""
    import torch

    torch.set_num_threads(1)
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 10, 10)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The shared folder (facts/, fixtures/, scans/); skips the test where it is absent."""
    if not (SHARED / "fixtures").is_dir():
        pytest.skip(f"reference values are not here: {SHARED} (set LIDARSYNTH_SHARED)")
    return SHARED


@pytest.fixture(scope="session")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What published programs say of themselves, facts/*.json and fixtures/*.json, and a small network of R2DM's."""
    folder = tmp_path_factory.mktemp("reference")
    with tarfile.open(ORACLES / "reference.tar.xz") as archive:
        for member in archive:  # one by one: Python 3.10 has no filter for all
            if member.isfile():
                path = folder / member.name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(archive.extractfile(member).read())  # type: ignore[union-attr]
    return folder


@pytest.fixture(scope="session")
def fixture_tensors() -> Callable[[str], dict[str, Tensor]]:
    """`fixture_tensors("r2dm/ops")` -> the tensors of r2dm/ops.safetensors by key, from the shared folder's
    fixtures or, of large ones a sample (`oracle.load`), from tests/oracles; skips where neither has them."""

    import oracle

    def load(name: str) -> dict[str, Tensor]:
        return oracle.load(reference_file(f"{name}.safetensors"))

    return load


def reference_file(name: str) -> Path:
    """Of the shared folder's fixtures, or packed in tests/oracles; skips where neither has it."""
    paths = SHARED / "fixtures" / name, ORACLES / f"{name}.xz"
    found = next((path for path in paths if path.is_file()), None)
    if found is None:
        pytest.skip(f"reference values are not here: {paths[0]}")
    return found


@pytest.fixture(scope="session")
def official_file(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """`official_file("r2dm/config_A.pth")` -> a file as the published program writes it, from the shared folder or
    made of the tensors in tests/oracles, where only its averaged weights may be left (both sets are the same then)."""
    import oracle
    import torch

    folder = tmp_path_factory.mktemp("official")

    def make(name: str) -> Path:
        whole, made = SHARED / "fixtures" / name, folder / name
        if whole.is_file() or made.is_file():
            return whole if whole.is_file() else made
        made.parent.mkdir(exist_ok=True)
        torch.save(oracle.unpacked(reference_file(str(Path(name).with_suffix(".safetensors")))), made)
        return made

    return make


@pytest.fixture(scope="session")
def scan64() -> bytes:
    """A synthetic turn of an HDL-64E in the order of its rings, as KITTI's `.bin`: what was projected."""
    return lzma.decompress((ORACLES / "projection" / "scan64.bin.xz").read_bytes())


@pytest.fixture(scope="session")
def oracle_tensors() -> Callable[[str], dict[str, Tensor]]:
    """`oracle_tensors("lidm_points")` -> the tensors of tests/oracles/lidm_points.safetensors.xz, of every checkout."""
    import oracle

    return lambda name: oracle.load(ORACLES / f"{name}.safetensors.xz")
