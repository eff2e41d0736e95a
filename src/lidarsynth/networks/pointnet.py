"""PointNet (Qi et al. 2017) as classifier of ShapeNet parts' 16 classes: the features of the FPD (Shu et al. 2019)."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import relu

from lidarsynth.metrics.distributions import Array, as_tensor
from lidarsynth.networks.tensors import load_weights, read_state

SCALE = 80.0  # metres; points are divided by it
WEIGHTS = "cls_model_39.pth"  # the official file, of TreeGAN


class PointNet(nn.Module):
    """Points (B, 3, N), divided by 80 m -> features (B, 1808); 1,607,961 parameters, keys as published.

    Removed points stand at the origin and take part. There is no dropout; batch normalisation wants evaluation mode.
    """

    def __init__(self, classes: int = 16):
        super().__init__()
        self.feat = _PointFeatures()
        self.fc1, self.bn1 = nn.Linear(1024, 512), nn.BatchNorm1d(512)
        self.fc2, self.bn2 = nn.Linear(512, 256), nn.BatchNorm1d(256)
        self.fc3 = nn.Linear(256, classes)

    def forward(self, points: Tensor) -> Tensor:
        """(B, 1024 + 512 + 256 + classes): maximum over points, both hidden layers, logits."""
        if points.ndim != 3 or points.shape[1] != 3 or not points.shape[2]:
            raise ValueError(f"points must be (B, 3, N), got {tuple(points.shape)}")
        x1 = self.feat(points)
        x2 = relu(self.bn1(self.fc1(x1)))
        x3 = relu(self.bn2(self.fc2(x2)))
        return torch.cat([x1, x2, x3, self.fc3(x3)], dim=1)


class _Transform(nn.Module):
    """(B, 3, N) -> (B, 3, 3), a learned matrix that turns the points upright."""

    def __init__(self):
        super().__init__()
        self.conv1, self.bn1 = nn.Conv1d(3, 64, 1), nn.BatchNorm1d(64)
        self.conv2, self.bn2 = nn.Conv1d(64, 128, 1), nn.BatchNorm1d(128)
        self.conv3, self.bn3 = nn.Conv1d(128, 1024, 1), nn.BatchNorm1d(1024)
        self.fc1, self.bn4 = nn.Linear(1024, 512), nn.BatchNorm1d(512)
        self.fc2, self.bn5 = nn.Linear(512, 256), nn.BatchNorm1d(256)
        self.fc3 = nn.Linear(256, 9)

    def forward(self, points: Tensor) -> Tensor:
        x = relu(self.bn1(self.conv1(points)))
        x = relu(self.bn2(self.conv2(x)))
        x = relu(self.bn3(self.conv3(x))).amax(2)
        x = relu(self.bn4(self.fc1(x)))
        x = relu(self.bn5(self.fc2(x)))
        return self.fc3(x).view(-1, 3, 3) + torch.eye(3, device=x.device, dtype=x.dtype)


class _PointFeatures(nn.Module):
    """(B, 3, N) -> (B, 1024), the maximum over the points."""

    def __init__(self):
        super().__init__()
        self.stn = _Transform()
        self.conv1, self.bn1 = nn.Conv1d(3, 64, 1), nn.BatchNorm1d(64)
        self.conv2, self.bn2 = nn.Conv1d(64, 128, 1), nn.BatchNorm1d(128)
        self.conv3, self.bn3 = nn.Conv1d(128, 1024, 1), nn.BatchNorm1d(1024)

    def forward(self, points: Tensor) -> Tensor:
        x = self.stn(points).transpose(1, 2) @ points  # points as rows times the matrix
        x = relu(self.bn1(self.conv1(x)))
        x = relu(self.bn2(self.conv2(x)))
        return self.bn3(self.conv3(x)).amax(2)  # no ReLU here, as published


def read_pointnet(path: str | Path) -> PointNet:
    """The network of the official `cls_model_39.pth`, in evaluation mode. Raises ValueError for any other file."""
    network = PointNet()
    load_weights(network, read_state(path, str(path)), str(path), counters=True)
    return network.eval()


@torch.no_grad()
def point_features(network: PointNet, xyz: Array) -> Tensor:
    """(B, 1808) float32 features of the FPD of points (B, N, 3) in metres, removed ones at the origin.

    Raises ValueError for another shape, NaN or infinity, or a network in training mode.
    """
    if network.training:
        raise ValueError("expected the network in evaluation mode, found it in training mode")
    points = as_tensor(xyz)
    if points.ndim != 3 or points.shape[2] != 3:
        raise ValueError(f"xyz must be (B, N, 3), got {tuple(points.shape)}")
    return network((points / SCALE).transpose(1, 2).to(network.fc3.weight))
