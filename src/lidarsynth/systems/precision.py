"""In which numbers a network multiplies: bf16 where the processor has instructions for it, else fp32."""

from __future__ import annotations

import torch

PRECISIONS = ("auto", "fp32", "bf16")
TILES, VECTORS = "amx_bf16", "avx512_bf16"  # flags of processors


def resolved_precision(word: str, device: torch.device) -> str:
    """`fp32` or `bf16` for one of PRECISIONS. Raises ValueError for another word."""
    if word not in PRECISIONS:
        raise ValueError(f"expected a precision of {', '.join(PRECISIONS)}, found {word!r}")
    return word if word != "auto" else "bf16" if multiplies_bf16(device) else "fp32"


def multiplies_bf16(device: torch.device) -> bool:
    """Whether bf16 is faster than fp32 there: a GPU with it, or a processor with AMX or AVX-512 instructions for it.

    Of Intel's it is AMX alone: without it completion takes a quarter longer than in fp32 (docs/scaling.md).
    """
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    flags = getattr(torch.cpu, "get_capabilities", dict)() if device.type == "cpu" else {}  # of torch 2.7 on
    return flags.get(TILES, False) or (flags.get(VECTORS, False) and "Intel" not in flags.get("cpu_name", ""))
