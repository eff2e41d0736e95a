"""Networks in the place of trained ones."""

import torch

from lidarsynth.experiment.record import Experiment
from lidarsynth.systems.table import build_network


def trained(experiment: Experiment, seed: int = 0) -> torch.nn.Module:
    """A network with no zero-initialised layer left, in the place of a trained one."""
    network = build_network(experiment)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.08)
    return network
