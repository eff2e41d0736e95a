"""A cache folder that holds seeded weights of LiDM's sparse networks under the published names; no network is asked."""

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from lidarsynth.evaluation import accumulation
from lidarsynth.evaluation.protocol import Network

_read = accumulation._read_network
_known: dict[tuple[str, str], nn.Module] = {}


def cached(folder: Path, weights: dict[str, Tensor], patch: pytest.MonkeyPatch) -> Path:
    """The folder, which is LIDARSYNTH_CACHE for the time of the patch; equal files are read once in a process."""
    branch = {name: value for name, value in weights.items() if not name.startswith("point_transforms")}
    for name, tensors in (("spvcnn_lidm", weights), ("minkowskinet_lidm", branch)):
        (folder / name).mkdir(parents=True)
        torch.save({"state_dict": tensors}, folder / name / "model.ckpt")
    patch.setenv("LIDARSYNTH_CACHE", str(folder))
    patch.setattr(accumulation, "URLS", dict.fromkeys(accumulation.URLS, "http://127.0.0.1:9"))
    patch.setattr(accumulation, "_read_network", _read_once)
    return folder


def _read_once(network: Network, path: Path) -> nn.Module:
    key = (network.kind, accumulation._sha256_of(path))
    if key not in _known:
        _known[key] = _read(network, path)
    return _known[key]
