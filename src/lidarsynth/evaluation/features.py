"""Range images -> features: which pixels a protocol takes, and what its networks say of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from lidarsynth.evaluation.protocols import EvaluationProtocol, Side
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.networks.pointnet import PointNet, point_features
from lidarsynth.networks.rangenet import RangeNet, frechet_features
from lidarsynth.networks.street_features import StreetFeatures


def gated(image: RangeImage, protocol: EvaluationProtocol, side: Side) -> np.ndarray:
    """(H, W) bool: measured, and strictly within the protocol's limits where it gates this side."""
    if side not in protocol.gated:
        return image.mask
    return image.mask & (image.range > protocol.near) & (image.range < protocol.far)


def drawn_again(image: RangeImage, mask: np.ndarray) -> RangeImage:
    """The image of its own points, without the first of them (LiDARGen's program takes index 0 for empty)."""
    scan = Scan(image.points()[mask], image.reflectance[mask])
    drawn = project(scan, replace(image.sensor, min_range=0.0, max_range=float("inf")), "spherical")
    if not len(scan) or drawn.xyz is None:
        return drawn
    return drawn.keep(~(drawn.xyz == scan.xyz[0]).all(axis=-1))


def features(network: nn.Module, images: Sequence[RangeImage], xyz: np.ndarray, masks: np.ndarray, size: int) -> Tensor:
    """(B, size) of the FRD, FPD or street-1; xyz (B, H, W, 3) metres with zeros outside the masks (B, H, W)."""
    device = next(network.parameters()).device
    if isinstance(network, PointNet):
        return point_features(network, torch.from_numpy(xyz.reshape(len(xyz), -1, 3)).to(device))
    if not isinstance(network, RangeNet | StreetFeatures):
        raise ValueError(f"expected a RangeNet, PointNet or StreetFeatures, found {type(network).__name__}")
    flat = [np.stack([image.range for image in images]), *np.moveaxis(xyz, -1, 0)]
    flat.append(np.stack([image.reflectance for image in images]))
    pixels = torch.from_numpy(np.stack(flat, axis=1).astype(np.float32)).to(device)
    measured = torch.from_numpy(masks).to(device)
    if isinstance(network, StreetFeatures):
        return network(pixels, measured)
    return frechet_features(network, pixels, measured, size)
