"""Whether a network fits into this machine, before it is built."""

from __future__ import annotations

import os
from collections.abc import Callable

import torch
from torch import nn

from lidarsynth.experiment.record import Experiment


def check_memory(experiment: Experiment, build: Callable[[], nn.Module]) -> None:
    """Raises ValueError for a network with more weights than this machine has memory.

    build  makes it; called only for one of unusual width or depth, and then without numbers
    """
    model, group = experiment.model, experiment.adversarial
    widest = max(model.base_channels * max(model.channel_multipliers, default=1), group.max_channels if group else 0)
    told = getattr(os, "sysconf_names", ())  # Windows has none
    if (widest <= 2048 and sum(model.num_residual_blocks) <= 64) or "SC_PHYS_PAGES" not in told:
        return
    with torch.device("meta"):  # shapes without numbers
        network = build()
    needed = sum(parameter.numel() * 4 for parameter in network.parameters())
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > there:
        raise ValueError(f"{experiment.name}: expected a network that fits into {there / 2**30:,.0f} GiB of memory, "
                         f"found weights of {needed / 2**30:,.0f} GiB")  # fmt: skip
