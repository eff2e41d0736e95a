"""Weights of one network that puts beams between known ones as the start of another."""

from __future__ import annotations

from torch import nn

from lidarsynth.experiment.record import Experiment
from lidarsynth.networks.tensors import load_weights


def transfer(network: nn.Module, experiment: Experiment, weights: nn.Module, source: Experiment, name: str) -> None:
    """Weights of the same kind and widths, of any sensor; which rows are known, and how far 1 is, may differ."""
    ours, theirs = (
        (e.model.network, *((g.factor, g.keras) if (g := e.upsampling) else ())) for e in (experiment, source)
    )
    if ours != theirs:
        raise ValueError(f"{name}: expected weights of {', '.join(map(str, ours))} (network, factor, keras), "
                         f"found {', '.join(map(str, theirs))}")  # fmt: skip
    load_weights(network, weights.state_dict(), name)
