"""How a run uses the machine and what it writes; none of it is part of the model. Pure Python, no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Options:
    """Settings that may change from one continuation of a run to the next."""

    # of the network; default: as `accelerate config` or `accelerate launch` says, else fp32
    precision: Literal["fp32", "bf16", "fp16"] | None = None
    accumulate: int = 1  # passes whose gradients make one step; the batch size stays the global one
    compile: bool = False  # torch.compile the network
    # processes that read or cast images; default: half of the cores for a GPU or for streets, else none
    workers: int | None = None
    threads: int = 0  # of the processor, per process; 0 = all
    log_every: int = 50  # steps between points of the curves
    save_every: int = 1000  # steps between checkpoints
    keep: int = 3  # how many of the last checkpoints stay
    sample_every: int = 5000  # steps between sample pictures and validation losses; 0 = never
    wandb: str | None = None  # log to this project of Weights & Biases too
