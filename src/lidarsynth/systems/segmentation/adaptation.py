"""A network of one domain for images of another, without their labels."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
import torch
from torch import nn

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.systems.segmentation.training import pixels

TOGETHER = 4  # images of which each batch's statistics are taken


@torch.no_grad()
def adapted(network: RangeNet, images: Sequence[RangeImage]) -> RangeNet:
    """A copy whose batch normalisations have the means and variances of these images; all weights stay.

    AdaBN (Li et al., arXiv 1603.04779): what a sensor shifts and scales everywhere is taken out in every layer. The
    images need no labels. Raises ValueError for none.
    """
    if not images:
        raise ValueError("expected images of the other domain, found none")
    network = copy.deepcopy(network).eval()
    norms = [module for module in network.modules() if isinstance(module, nn.BatchNorm2d)]
    for norm in norms:
        norm.train()
        norm.reset_running_stats()
        norm.momentum = None  # all batches weigh the same
    for first in range(0, len(images), TOGETHER):
        values = torch.from_numpy(np.stack([pixels(image) for image in images[first : first + TOGETHER]]))
        values = values.to(network.means)
        network(network.network_input(values, values[:, :1] > 0))
    for norm in norms:
        norm.momentum = 0.01
    return network.eval()
