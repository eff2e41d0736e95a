"""Points -> voxels of a sparse network, and its features -> one vector of a scan: FSVD and FPVD (Ran et al. 2024)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

VOXEL = 0.05  # metres
# Edges of the 16 shells around the voxels' centroid, metres; nothing is left out near it.
SHELLS = (0.0, *np.linspace(4, 56, 17)[1:].tolist())


def quantise(points: np.ndarray, near: float = 1.0, far: float = 56.0) -> tuple[np.ndarray, np.ndarray]:
    """Voxels (V, 3) int64 and features (V, 4) float32 of points (n, 3) in metres with near < |p| < far, strict.

    Voxel = round(p / 0.05), half to even, from the corner of the scan, ordered by x, y, z. Features: the first of its
    points in metres, and -1 in place of remission. Raises ValueError for another shape, no point within, NaN.
    """
    xyz = np.asarray(points, np.float32)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise ValueError(f"points must be (n, 3), got {xyz.shape}")
    if not np.isfinite(xyz).all():
        raise ValueError(f"expected finite points, found {np.sum(~np.isfinite(xyz).all(1))} with NaN or infinity")
    distance = np.linalg.norm(xyz, axis=1)
    xyz = xyz[(distance > near) & (distance < far)]
    if not len(xyz):
        raise ValueError(f"expected points between {near:g} and {far:g} m, found none")
    cells = np.round(xyz / np.float32(VOXEL)).astype(np.int64)
    cells -= cells.min(0)
    sizes = cells.max(0) + 1
    _, first = np.unique((cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2], return_index=True)
    return cells[first], np.column_stack([xyz[first], np.full(len(first), -1, np.float32)])


def collate(scans: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[Tensor, Tensor]:
    """Features (N, 4) float32 and coordinates (N, 4) int64 x, y, z, batch of the quantised scans of a batch."""
    numbered = [np.column_stack([cells, np.full(len(cells), i)]) for i, (cells, _) in enumerate(scans)]
    features = np.concatenate([values for _, values in scans])
    return torch.from_numpy(features), torch.from_numpy(np.concatenate(numbered))


def shell_means(features: Tensor, where: Tensor, count: int, edges: Sequence[float] = SHELLS) -> Tensor:
    """(count, shells * C): mean of the features (N, C) in each shell around the centroid of a scan's voxels.

    where  (N, 4) float32: x, y, z in voxels, batch 0 to count - 1
    An empty shell is 0, what lies beyond the last edge is left out; index = shell * C + channel.
    """
    shells, channels = len(edges) - 1, features.shape[1]
    limits = torch.tensor(edges, dtype=torch.float64, device=where.device).float()
    vectors = features.new_zeros(count, shells, channels)
    for scan in range(count):
        own = where[:, 3] == scan
        offset = where[own, :3] - where[own, :3].mean(0)
        shell = torch.bucketize(offset.norm(dim=1) * VOXEL, limits, right=True) - 1
        inside = shell < shells
        shell, values = shell[inside], features[own][inside]
        number = torch.bincount(shell, minlength=shells).clamp(min=1)
        vectors[scan].index_add_(0, shell, values)
        vectors[scan] /= number[:, None]
    return vectors.flatten(1)
