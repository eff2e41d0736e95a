"""How a run uses the machine and what it writes; none of it is part of the model. Pure Python, no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lidarsynth.data.workers import MOST


@dataclass(frozen=True)
class Options:
    """Settings that may change from one continuation of a run to the next. Raises ValueError for absurd counts."""

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

    def __post_init__(self):
        least = {"accumulate": 1, "log_every": 1, "save_every": 1, "keep": 1, "sample_every": 0, "threads": 0}
        for name, smallest in least.items():
            value = getattr(self, name)
            if value < smallest:
                raise ValueError(f"expected {name} of at least {smallest}, found {value}")
        if self.workers is not None and self.workers < 0:
            raise ValueError(f"expected workers of at least 0, found {self.workers}")
        for name in ("threads", "workers"):
            if (value := getattr(self, name) or 0) > MOST:
                raise ValueError(f"expected {name} of at most {MOST:,}, found {value:,}")
