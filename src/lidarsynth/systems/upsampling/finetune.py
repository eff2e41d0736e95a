"""Weights of one network that puts beams between known ones as the start of another."""

from __future__ import annotations

from torch import nn

from lidarsynth.experiment.record import Experiment
from lidarsynth.networks.tensors import load_weights


def transfer(network: nn.Module, experiment: Experiment, weights: nn.Module, source: Experiment, name: str) -> None:
    """Weights of the same kind and widths, of any sensor; which rows are known, and how far 1 is, may differ."""
    groups = [(e.model.network, e.upsampling) for e in (experiment, source)]
    ours, theirs = ((word, *((g.factor, g.keras, g.ensemble) if g else ())) for word, g in groups)
    if ours != theirs:
        raise ValueError(f"{name}: expected weights of {', '.join(map(str, ours))} (network, factor, keras, ensemble), "
                         f"found {', '.join(map(str, theirs))}")  # fmt: skip
    load_weights(network, weights.state_dict(), name)
