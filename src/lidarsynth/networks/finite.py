"""A network whose output is not finite says so, by name, instead of an empty scan."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn


def refuse_not_finite(network: nn.Module, name: str) -> None:
    """From now on, NaN or infinity in what the network returns is a FloatingPointError that names it.

    Neither tracing nor compiling sees the check.
    """
    network.register_forward_hook(partial(_check, name))


def _check(name: str, module: nn.Module, arguments: Any, output: Any) -> None:
    if torch.compiler.is_compiling() or torch.jit.is_tracing():  # pyright: ignore[reportPrivateImportUsage]
        return
    for tensor in _tensors(output):
        if tensor.is_floating_point() and not torch.isfinite(tensor.detach().sum(dtype=torch.float64)):
            raise FloatingPointError(
                f"{name}: expected finite values of its network, found NaN or infinity; its weights are damaged, or "
                "its precision is too low"
            )


def _tensors(output: Any) -> Iterable[Tensor]:
    if isinstance(output, Tensor):
        yield output
    elif isinstance(output, dict | list | tuple):
        for part in output.values() if isinstance(output, dict) else output:
            yield from _tensors(part)


def not_finite(weights: dict[str, Tensor]) -> str:
    """The name of the first tensor that holds NaN or infinity, or ""."""
    for name, tensor in weights.items():
        if tensor.is_floating_point() and not torch.isfinite(tensor.sum(dtype=torch.float64)):
            return name
    return ""
