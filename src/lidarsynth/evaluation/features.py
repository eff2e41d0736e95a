"""Range images -> features: which pixels a protocol takes, and what its networks say of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from lidarsynth.evaluation.protocol import Clouds, EvaluationProtocol, Side
from lidarsynth.lidar.corner_grid import corner_channels, corner_image
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.metrics.voxel_features import collate, quantise, shell_means
from lidarsynth.networks.minkowski_unet import MinkowskiUNet
from lidarsynth.networks.pointnet import PointNet, point_features
from lidarsynth.networks.rangenet import RangeNet, band_features, frechet_features
from lidarsynth.networks.spvcnn import SPVCNN
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
    if isinstance(network, MinkowskiUNet | SPVCNN):  # removed points stand at the origin, and no other does
        return voxel_features(network, [points[mask] for points, mask in zip(xyz, masks, strict=True)], 0, np.inf)
    if not isinstance(network, RangeNet | StreetFeatures):
        raise ValueError(f"expected a feature network, found {type(network).__name__}")
    flat = [np.stack([image.range for image in images]), *np.moveaxis(xyz, -1, 0)]
    flat.append(np.stack([image.reflectance for image in images]))
    pixels = torch.from_numpy(np.stack(flat, axis=1).astype(np.float32)).to(device)
    measured = torch.from_numpy(masks).to(device)
    if isinstance(network, StreetFeatures):
        return network(pixels, measured)
    if network.channels == 4:
        return band_features(network, network.network_input(pixels[:, :4], measured))
    return frechet_features(network, pixels, measured, size)


def cloud_features(network: nn.Module, scans: Sequence[np.ndarray], clouds: Clouds) -> Tensor:
    """(B, D) of LiDM's FRID, FSVD or FPVD, of points (n, 3) in metres each. Raises ValueError for a scan of none."""
    if isinstance(network, MinkowskiUNet | SPVCNN):
        return voxel_features(network, scans, clouds.near, clouds.far)
    if not isinstance(network, RangeNet):
        raise ValueError(f"expected a network of LiDM, found {type(network).__name__}")
    images = np.stack([corner_channels(corner_image(points, clouds.near, clouds.far)) for points in scans])
    return band_features(network, torch.from_numpy(images).to(network.means.device))


def voxel_features(network: MinkowskiUNet | SPVCNN, scans: Sequence[np.ndarray], near: float, far: float) -> Tensor:
    """(B, 16 C): the network's features, averaged in shells, of points (n, 3) with near < |p| < far metres.

    One scan at a time, since a batch costs as much time and more memory. Raises ValueError for a scan of no point.
    """
    device = next(network.parameters()).device
    vectors = []
    for points in scans:
        features, voxels = collate([quantise(points, near, far)])
        values, where = network(features.to(device), voxels.to(device))
        vectors.append(shell_means(values, where, 1))
    return torch.cat(vectors)
