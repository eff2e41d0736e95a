"""Whether a device of torch is here and computes, asked before the work and not in it."""

from __future__ import annotations

import torch


def check_device(device: str) -> None:
    """Raises ValueError, of one line, for what is no device of torch, is not here, or holds no numbers."""
    try:
        kind = torch.device(device).type
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError, ImportError) as error:  # which of them is the device's own choice
        reason = f"{error}".strip().partition("\n")[0].partition(". ")[0]  # what follows is for those who build torch
        raise ValueError(f"expected a device of torch, such as cpu or cuda, found {device!r}: {reason}") from None
    if kind == "meta":
        raise ValueError(f"expected a device that computes, such as cpu or cuda, found {device!r}")
