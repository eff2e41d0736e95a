"""Between points and voxels: the mean of a voxel's points, and the value at a point of the eight corners around it.

The point branch of SPVCNN (Tang et al. 2020), equal to its published program on torchsparse. Points are (P, 4) float32:
x, y, z in units of the finest voxel, and the batch.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from lidarsynth.networks.sparse_convolution import OFFSETS_2, Level


def voxel_of_points(points: Tensor, level: Level) -> Tensor:
    """(P,) int64: the row of the voxel floor(p / s) * s around each point, -1 where it is not occupied."""
    return level.find(_corner(points, level.stride).long())


def _corner(points: Tensor, stride: int) -> Tensor:
    """(P, 4) float32: the lower corner of each point's voxel, and the batch."""
    return torch.cat([torch.floor(points[:, :3] / stride) * stride, points[:, 3:]], 1)


def voxelise(features: Tensor, rows: Tensor, count: int) -> Tensor:
    """(count, C): the mean of the point features (P, C) per voxel, 0 where none is; `rows` as of `voxel_of_points`."""
    met = rows >= 0
    if not met.all():
        rows, features = rows[met], features[met]
    total = features.new_zeros(count, features.shape[1]).index_add_(0, rows, features)
    number = torch.bincount(rows, minlength=count).clamp(min=1)
    return total / number[:, None].to(total)


def corners(points: Tensor, level: Level, own: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Rows (P, 8) int64 of the corners around each point, -1 where free or without weight, and weights (P, 8) float32.

    Trilinear weights; those of free corners are 0, and the others are divided by their sum + 1e-8. `own` is what
    `voxel_of_points` gives, where it is known already.
    """
    stride = level.stride
    own = voxel_of_points(points, level) if own is None else own
    lower = _corner(points, stride)
    low = (points - lower)[:, :3]
    high = (lower[:, :3] + stride) - points[:, :3]
    base = lower.long()
    rows, weights = [], []
    for offset in OFFSETS_2:
        x, y, z = (low[:, i] if side else high[:, i] for i, side in enumerate(offset))
        weight = x * y * z / stride**3
        near = (weight > 0).nonzero()[:, 0]  # few, where the points stand on the grid
        row = base.new_full((len(points),), -1)
        row[near] = _rows_beside(base, own, near, base.new_tensor([*offset, 0]) * stride, level)
        rows.append(row)
        weights.append(torch.where(row >= 0, weight, 0))
    weight = torch.stack(weights, 1)
    return torch.stack(rows, 1), weight / (weight.sum(1, keepdim=True) + 1e-8)


def _rows_beside(base: Tensor, own: Tensor, near: Tensor, step: Tensor, level: Level) -> Tensor:
    """Rows of the voxels base[near] + step, as `find`; each is looked for once, since many points share one."""
    own = own[near]
    if (own < 0).any():
        return level.find(base[near] + step)
    needed = torch.zeros(len(level), dtype=torch.bool, device=own.device)
    needed[own] = True
    voxels = needed.nonzero()[:, 0]
    rows = own.new_empty(len(level))
    rows[voxels] = level.find(level.coordinates[voxels] + step)
    return rows[own]


def devoxelise(features: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """(P, C): the voxels' features (N, C) at the points whose `corners` are given."""
    return embedding_bag(rows.clamp(min=0), features, mode="sum", per_sample_weights=weights)
