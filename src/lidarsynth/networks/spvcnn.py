"""SPVCNN (Tang et al. 2020) as 2DPASS and LiDAR-Diffusion build it: the features of the FPVD.

The voxel branch of MinkowskiNet beside a branch of points, which are the voxels themselves with float coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lidarsynth.networks.minkowski_unet import Stage, Stem, Up, checked_levels
from lidarsynth.networks.sparse_convolution import Level, with_norm
from lidarsynth.networks.voxel_points import corners, devoxelise, voxel_of_points, voxelise

VOXEL = 0.05  # metres


def points_of(coordinates: Tensor) -> Tensor:
    """(N, 4) float32 of voxels (N, 4): (v * 0.05) / 0.05 in float32, for some v larger by up to 1.2e-4; batch as is."""
    xyz = coordinates[:, :3].float() * VOXEL / VOXEL
    return torch.cat([xyz, coordinates[:, 3:].float()], 1)


class SPVCNN(nn.Module):
    """Features of points; `widths` as in `MinkowskiUNet`, 21,778,100 parameters at cr 1, 5,449,316 at 0.5."""

    def __init__(self, widths: Sequence[int], classes: int = 20):
        super().__init__()
        w = widths
        self.stem = Stem(w[0])
        self.stage1, self.stage2, self.stage3, self.stage4 = (Stage(w[k], w[k + 1]) for k in range(4))
        self.up1, self.up2, self.up3, self.up4 = (Up(w[4 + k], w[3 - k], w[5 + k]) for k in range(4))
        self.classifier = nn.Sequential(nn.Linear(w[8], classes))
        self.point_transforms = nn.ModuleList(
            nn.Sequential(nn.Linear(a, b), nn.BatchNorm1d(b), nn.ReLU())
            for a, b in ((w[0], w[4]), (w[4], w[6]), (w[6], w[8]))
        )

    @torch.no_grad()
    def forward(self, features: Tensor, coordinates: Tensor) -> tuple[Tensor, Tensor]:
        """(N, widths[8]) features before the classifier, and (N, 4) float32 where: x, y, z in voxels, batch.

        Arguments and errors as in `MinkowskiUNet.forward`.
        """
        levels = checked_levels(self, features, coordinates)
        points = points_of(coordinates)
        finest = _Meeting(points, levels[0])
        stem = self.stem(features, levels[0])
        z0 = finest.to_points(stem)
        x1 = self.stage1(finest.to_voxels(z0), levels[0], levels[1])
        x2 = self.stage2(x1, levels[1], levels[2])
        x3 = self.stage3(x2, levels[2], levels[3])
        x4 = self.stage4(x3, levels[3], levels[4])
        coarse = _Meeting(points, levels[4])
        z1 = coarse.to_points(x4) + self._transformed(z0, 0)
        y2 = self.up2(self.up1(coarse.to_voxels(z1), x3, levels[3]), x2, levels[2])
        middle = _Meeting(points, levels[2])
        z2 = middle.to_points(y2) + self._transformed(z1, 1)
        # the last skip is the stem's own output, not what came back from the points
        y4 = self.up4(self.up3(middle.to_voxels(z2), x1, levels[1]), stem, levels[0])
        return finest.to_points(y4) + self._transformed(z2, 2), points

    def _transformed(self, z: Tensor, number: int) -> Tensor:
        """(P, C') of point features (P, C): a linear layer, batch normalisation and ReLU at once."""
        chain = self.point_transforms[number]
        assert isinstance(chain, nn.Sequential)
        linear, norm = chain[0], chain[1]
        assert isinstance(linear, nn.Linear) and isinstance(norm, nn.BatchNorm1d)
        kernel, bias = with_norm(linear.weight.T, norm, linear.bias)
        return torch.addmm(bias, z, kernel).relu_()


class _Meeting:
    """Where the two branches exchange features: points and the voxels of one level."""

    def __init__(self, points: Tensor, level: Level):
        self.count, self.rows = len(level), voxel_of_points(points, level)
        self.corners = corners(points, level, self.rows)

    def to_points(self, features: Tensor) -> Tensor:
        return devoxelise(features, *self.corners)

    def to_voxels(self, features: Tensor) -> Tensor:
        return voxelise(features, self.rows, self.count)
