"""Reference values: tensors that are too large for the repository are a sample there, NaN where nothing was kept."""

import json
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor


def load(path: Path) -> dict[str, Tensor]:
    """The tensors of a file by key. Its metadata say of which only every n-th value was kept, and which are noise.

    {"sampled": {key: [shape, n]}, "drawn": {key: [shape (T, B, ...), seeds of B generators]}}
    """
    with safe_open(path, "pt") as file:
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118, no mapping
        said = file.metadata() or {}
    for key, (shape, every) in json.loads(said.get("sampled", "{}")).items():
        whole = torch.full(shape, torch.nan)
        whole.view(-1)[::every] = tensors[key]
        tensors[key] = whole
    for key, (shape, seeds) in json.loads(said.get("drawn", "{}")).items():
        rng = [torch.Generator().manual_seed(seed) for seed in seeds]
        draws = [torch.stack([torch.randn(shape[2:], generator=one) for one in rng]) for _ in range(shape[0])]
        tensors[key] = torch.stack(draws)
    return tensors


def assert_close(actual: Tensor, expected: Tensor, **tolerance: float) -> None:
    """torch.testing's, of the values that were kept; at least one was."""
    assert actual.shape == expected.shape, f"expected {tuple(expected.shape)}, found {tuple(actual.shape)}"
    kept = ~expected.isnan()
    assert bool(kept.any())
    torch.testing.assert_close(actual[kept], expected[kept], **tolerance)


def largest(expected: Tensor) -> float:
    """The largest absolute value that was kept."""
    return expected.nan_to_num().abs().max().item()
