"""Weights of one GAN as the start of another."""

from __future__ import annotations

from torch import nn

from lidarsynth.experiment.record import Experiment
from lidarsynth.networks.tensors import load_weights


def transfer(network: nn.Module, experiment: Experiment, weights: nn.Module, source: Experiment, name: str) -> None:
    """A generator of the same kind and widths, into the angles of `experiment`; the discriminator begins anew."""
    ours, theirs = (e.model.network for e in (experiment, source))
    if ours != theirs or experiment.data.codec != source.data.codec:
        found, expected = (f"{e.model.network} of {e.data.codec} range" for e in (source, experiment))
        raise ValueError(f"{name}: expected weights of {expected}, found {found}")
    own = {key: value for key, value in network.state_dict().items() if key == "angles"}
    load_weights(network, {**weights.state_dict(), **own}, name)
