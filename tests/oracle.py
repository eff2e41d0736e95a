"""Reference values: tensors that are too large for the repository are a sample there, NaN where nothing was kept, or
are drawn again from torch's generator, as they were when the published program was run."""

import json
import lzma
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from torch import Tensor


def load(path: Path) -> dict[str, Tensor]:
    """The tensors of a file by key, `.safetensors` or packed as `.safetensors.xz`.

    Its metadata say of which only every n-th value was kept, and which are drawn:
    {"sampled": {key: [shape, n]}, "drawn": {key: [shape (T, B, ...), seeds of B generators]},
    "streams": {key: [kind, seed, offset, mean, scale, shape]}}: mean + scale * torch.randn or torch.rand of the
    generator of that seed after `offset` numbers; of some, `key changed` says where they were replaced, `key values` by
    what.
    """
    return _read(path)[0]


def unpacked(path: Path) -> Any:
    """The checkpoint that a file of tensors stands for: {"$": prefix} in its metadata are the tensors below it."""
    tensors, said = _read(path)

    def built(part: Any) -> Any:
        if isinstance(part, dict) and "$" in part:
            prefixes = part["$"]
            below = {key[len(prefix) :]: value for prefix in prefixes for key, value in tensors.items()
                     if key.startswith(prefix)}  # fmt: skip
            return {part.get("as", "") + key: value for key, value in below.items()}
        if isinstance(part, dict):
            return {key: built(value) for key, value in part.items()}
        return [built(value) for value in part] if isinstance(part, list) else part

    return built(json.loads(said["file"]))


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    content = lzma.decompress(path.read_bytes()) if path.suffix == ".xz" else path.read_bytes()
    tensors = safetensors.torch.load(content)
    said = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")]).get("__metadata__", {})
    for key, (shape, every) in json.loads(said.get("sampled", "{}")).items():
        whole = torch.full(shape, torch.nan)
        whole.view(-1)[::every] = tensors[key]
        tensors[key] = whole
    for key, (shape, seeds) in json.loads(said.get("drawn", "{}")).items():
        rng = [torch.Generator().manual_seed(seed) for seed in seeds]
        draws = [torch.stack([torch.randn(shape[2:], generator=one) for one in rng]) for _ in range(shape[0])]
        tensors[key] = torch.stack(draws)
    for key, value in _streams(json.loads(said.get("streams", "{}"))):
        if (changed := tensors.pop(f"{key} changed", None)) is not None:
            value[changed.bool()] = tensors.pop(f"{key} values")
        tensors[key] = value
    return tensors, said


def _streams(said: dict[str, list]) -> Iterable[tuple[str, Tensor]]:
    """The draws by key, in the order of their places, so that no generator runs twice over what lies between."""
    rng, at = torch.Generator(), (-1, 0)  # seed, numbers taken
    for key, (kind, seed, offset, mean, scale, shape) in sorted(said.items(), key=lambda item: item[1][1:3]):
        if at[0] != seed or at[1] > offset:
            rng.manual_seed(seed)
            at = seed, 0
        torch.rand(offset - at[1], generator=rng)
        drawn = (torch.rand if kind == "uniform" else torch.randn)(shape, generator=rng)
        again = 16 if kind == "normal" and drawn.numel() % 16 else 0  # the last 16 are drawn once more
        at = seed, offset + drawn.numel() + again
        yield key, (mean + scale * drawn.double()).float()


def assert_close(actual: Tensor, expected: Tensor, **tolerance: float) -> None:
    """torch.testing's, of the values that were kept; at least one was."""
    assert actual.shape == expected.shape, f"expected {tuple(expected.shape)}, found {tuple(actual.shape)}"
    kept = ~expected.isnan()
    assert bool(kept.any())
    torch.testing.assert_close(actual[kept], expected[kept], **tolerance)


def largest(expected: Tensor) -> float:
    """The largest absolute value that was kept."""
    return expected.nan_to_num().abs().max().item()


def assert_within(actual: Tensor, expected: Tensor, share: float) -> None:
    """`assert_close` up to a share of the largest value that was kept."""
    assert_close(actual, expected, atol=share * largest(expected), rtol=0)
