"""A network of one domain for images of another, without their labels."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import TypeVar

import torch
from torch import Tensor, nn

Network = TypeVar("Network", bound=nn.Module)


@torch.no_grad()
def adapted(network: Network, inputs: Iterable[Tensor]) -> Network:
    """A copy whose batch normalisations have the means and variances of these inputs; all weights stay.

    inputs  batches (B, C, H, W) of the other domain, as the network takes them; they need no labels, and all weigh the
            same
    AdaBN (Li et al., arXiv 1603.04779): what a sensor shifts and scales everywhere is taken out in every layer. Raises
    ValueError for no batch.
    """
    network = copy.deepcopy(network).eval()
    norms = [module for module in network.modules() if isinstance(module, nn.BatchNorm2d)]
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.train()
        norm.reset_running_stats()
        norm.momentum = None  # the mean of all batches
    count = 0
    for x in inputs:
        network(x)
        count += 1
    if not count:
        raise ValueError("expected batches of the other domain, found none")
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.momentum = momentum
    return network.eval()
