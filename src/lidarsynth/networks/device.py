"""Whether a device of torch is here and computes, asked before the work and not in it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import torch

T = TypeVar("T")


@contextmanager
def usual_torch() -> Iterator[None]:
    """While it is open, torch makes tensors as this package expects them, float32 on the CPU where nothing else is
    said, whatever defaults the program around it has set; these are not touched where they are the same."""
    dtype, device = torch.get_default_dtype(), torch.get_default_device()
    if dtype == torch.float32 and device.type == "cpu":
        yield
        return
    torch.set_default_dtype(torch.float32)
    try:
        with torch.device("cpu"):
            yield
    finally:
        torch.set_default_dtype(dtype)


def each_usually(items: Iterable[T]) -> Iterator[T]:
    """The items of an iterator that computes them, each within `usual_torch`, and the program between them without."""
    iterator, end = iter(items), object()
    while True:
        with usual_torch():
            item = next(iterator, end)
        if item is end:
            return
        yield item  # type: ignore[misc]


def check_device(device: str | torch.device) -> None:
    """Raises ValueError, of one line, for what is no device of torch, is not here, or holds no numbers."""
    try:
        kind = torch.device(device).type
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError, ImportError, TypeError) as error:  # which of them is the device's own choice
        reason = f"{error}".strip().partition("\n")[0].partition(". ")[0]  # what follows is for those who build torch
        raise ValueError(f"expected a device of torch, such as cpu or cuda, found {str(device)!r}: {reason}") from None
    if kind == "meta":
        raise ValueError(f"expected a device that computes, such as cpu or cuda, found {str(device)!r}")
