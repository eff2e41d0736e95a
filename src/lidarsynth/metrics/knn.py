"""Post-processing of RangeNet: labels of points, or cleaner label images, by a vote of the k nearest pixels.

None of the published generation or completion scores uses it; it is for segmenting real scans.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from lidarsynth.lidar.semantic_kitti import CLASSES

SIGMA, CUTOFF = 1.0, 1.0  # pixels, of the window's Gaussian; metres, weighted by one minus it: as published


def knn_labels(
    image_range: np.ndarray | Tensor,
    image_label: np.ndarray | Tensor,
    row: np.ndarray | Tensor,
    column: np.ndarray | Tensor,
    distance: np.ndarray | Tensor,
    k: int = 5,
    search: int = 5,
) -> Tensor:
    """(N,) int64 class 1 to 19 of every point of a scan, by its k nearest pixels (RangeNet++ section III-E).

    image_range   (H, W) metres, negative where empty
    image_label   (H, W) classes as predicted
    row, column   (N,) pixel of each point
    distance      (N,) metres, range of each point
    search        odd side of the window; of its pixels, those farther than CUTOFF have no vote

    Raises ValueError when k exceeds the window, the window has no middle, or a point lies outside the image.
    """
    ranges, labels, rows, columns, own = map(torch.as_tensor, (image_range, image_label, row, column, distance))
    _check_window(k, search)
    _check_pixels(rows, columns, tuple(ranges.shape))
    pixel = rows.long() * ranges.shape[1] + columns.long()
    near = _windows(ranges, search)[:, pixel]
    near = torch.where(near < 0, torch.inf, near)
    near[search**2 // 2] = own.float()
    weighted = (near - own.float()).abs() * _inverse_gaussian(search).view(-1, 1).to(near)
    return _vote(weighted, _windows(labels, search)[:, pixel], k, 1)


def smooth_labels(
    image_range: np.ndarray | Tensor,
    image_label: np.ndarray | Tensor,
    k: int = 3,
    search: int = 3,
) -> Tensor:
    """(H, W) int64 classes by the k nearest pixels, R2DM's version of `knn_labels` for images; 0 may win.

    It convolves the difference to each neighbour with one minus a Gaussian, instead of weighting neighbours by where
    they are; kept as published. Arguments and errors as in `knn_labels`.
    """
    ranges, labels = torch.as_tensor(image_range).float(), torch.as_tensor(image_label)
    _check_window(k, search)
    height, width = ranges.shape
    near = _windows(ranges, search)
    near = torch.where(near < 0, torch.inf, near)
    difference = (near - ranges.view(1, -1)).abs().view(-1, 1, height, width)
    kernel = _inverse_gaussian(search)[None, None].to(near)
    weighted = nn.functional.conv2d(difference, kernel, padding=(search - 1) // 2).view(-1, height * width)
    return _vote(weighted, _windows(labels, search), k, 0).view(height, width)


def _check_window(k: int, search: int) -> None:
    if search % 2 != 1 or not 1 <= k <= search**2:
        raise ValueError(f"expected an odd window and k within its pixels, found search {search} and k {k}")


def _check_pixels(row: Tensor, column: Tensor, shape: tuple[int, ...]) -> None:
    outside = (row < 0) | (row >= shape[0]) | (column < 0) | (column >= shape[1])
    if outside.any():
        found = f"row {int(row[outside][0])}, column {int(column[outside][0])}"
        raise ValueError(f"expected pixels of an image of {shape[0]} x {shape[1]}, found {found}")


def _inverse_gaussian(size: int) -> Tensor:
    """(size, size) one minus the Gaussian window of sum 1."""
    axis = torch.arange(size, dtype=torch.float32) - (size - 1) / 2
    window = torch.exp(-(axis[:, None] ** 2 + axis**2) / (2 * SIGMA**2))
    return 1 - window / window.sum()


def _windows(image: Tensor, size: int) -> Tensor:
    """(size^2, H * W) the zero-padded window around every pixel of (H, W)."""
    return nn.functional.unfold(image[None, None].float(), size, padding=(size - 1) // 2)[0]


def _vote(distance: Tensor, labels: Tensor, k: int, first: int) -> Tensor:
    """(P,) the label most frequent among the k nearest candidates (S, P) within CUTOFF, from class `first` on."""
    classes = len(CLASSES)
    nearest, index = distance.topk(k, dim=0, largest=False)
    near = labels.long().gather(0, index)
    near = torch.where(nearest > CUTOFF, classes, near)  # one class more, which has no vote
    votes = nn.functional.one_hot(near, classes + 1).sum(0)
    return votes[:, first:classes].argmax(1) + first
