"""Whether a device of torch is here and computes, asked before the work and not in it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from threading import Lock
from typing import TypeVar

import torch

T = TypeVar("T")


# Kinds of devices for which a program may have asked for half precision.
KINDS = ("cpu", "cuda", "mps", "xpu")
_LOCK = Lock()
_THEIRS: list[torch.dtype] = []  # the program's default type, once for each `usual_torch` that is open


@contextmanager
def usual_torch() -> Iterator[None]:
    """While it is open, torch makes tensors as this package expects them, float32 on the CPU where nothing else is
    said, computes in float32 and can learn, whatever the program around it has set: default type and device, autocast,
    inference mode. All these are as they were afterwards.

    All threads of a program have one default type: it is the program's again when the last of them is done.
    """
    with _LOCK:
        _THEIRS.append(_THEIRS[0] if _THEIRS else torch.get_default_dtype())
        _set_default(torch.float32)
    try:
        with ExitStack() as stack:
            if torch.is_inference_mode_enabled():
                stack.enter_context(torch.inference_mode(False))
            if torch.empty(0).device.type != "cpu":  # torch 2.6 names no device of a `with`
                stack.enter_context(torch.device("cpu"))
            for kind in filter(torch.is_autocast_enabled, KINDS):
                stack.enter_context(torch.autocast(kind, enabled=False))
            yield
    finally:
        with _LOCK:
            theirs = _THEIRS.pop()
            if not _THEIRS:
                _set_default(theirs)


def _set_default(dtype: torch.dtype) -> None:
    if torch.get_default_dtype() != dtype:
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
