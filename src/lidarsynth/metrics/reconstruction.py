"""How far a completed scan is from the measured one: pixel by pixel, point by point, class by class."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.metrics.distributions import Array, as_numpy, check_above_0, check_least


@dataclass(frozen=True)
class Errors:
    """Errors over the judged pixels, empty ones included as 0 m and reflectance 0 (as LiDARGen and R2DM judge)."""

    range_mae: float  # metres
    reflectance_mae: float  # in [0, 1]; NaN of what knows no reflectance
    range_rmse: float  # metres
    reflectance_rmse: float
    pixels: int


def reconstruction_errors(result: RangeImage, truth: RangeImage, where: np.ndarray | None = None) -> Errors:
    """Errors of `result` over the pixels `where` (H, W) bool, or all. Raises ValueError for other shapes, no pixel."""
    where = np.ones(truth.shape, bool) if where is None else where
    if result.shape != truth.shape or where.shape != truth.shape:
        raise ValueError(f"expected images and pixels of {truth.shape}, found {result.shape} and {where.shape}")
    if not where.any():
        raise ValueError("expected at least one pixel to judge, found none")
    distance = (result.range.astype(np.float64) - truth.range)[where]
    reflectance = (result.reflectance.astype(np.float64) - truth.reflectance)[where]
    return Errors(
        float(np.abs(distance).mean()),
        float(np.abs(reflectance).mean()),
        float(np.sqrt((distance**2).mean())),
        float(np.sqrt((reflectance**2).mean())),
        int(where.sum()),
    )


def mean_errors(errors: list[Errors]) -> Errors:
    """The mean over scans of each error; pixels add up. RMSE is averaged per scan. Raises ValueError for none."""
    if not errors:
        raise ValueError("expected the errors of at least one scan, found none")
    names = ("range_mae", "reflectance_mae", "range_rmse", "reflectance_rmse")
    means = [float(np.mean([getattr(e, name) for e in errors])) for name in names]
    return Errors(*means, pixels=sum(e.pixels for e in errors))


def nearest_distances(points: Array, others: Array) -> np.ndarray:
    """(N,) float64, metres: from each of `points` (N, 3) to the nearest of `others` (M, 3).

    Raises ValueError for other shapes, no points or NaN; ImportError without scipy, naming the extra that brings it.
    """
    try:
        from scipy.spatial import KDTree
    except ImportError as error:
        raise ImportError("distances of points need scipy: pip install 'lidarsynth[metrics]'") from error
    sets = [_points(values) for values in (points, others)]
    return KDTree(sets[1]).query(sets[0])[0]


def _points(values: Array) -> np.ndarray:
    points = as_numpy(np.asarray(values) if isinstance(values, list | tuple) else values).astype(np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
        raise ValueError(f"expected finite points (N, 3), at least one, found {points.shape}")
    return points


@dataclass(frozen=True)
class PointErrors:
    """Distances between a result's points and the true ones; each is the same, or swaps, when the sets are swapped."""

    chamfer: float  # metres: mean distance to the truth plus mean distance from the truth
    chamfer_squared: float  # metres^2: the same of squared distances, as most learned completion papers say it
    hausdorff: float  # metres: the farthest any point of either set is from the other set
    precision: float  # share of the result's points within the threshold of a true one
    recall: float  # share of the true points within the threshold of one of the result
    f_score: float  # harmonic mean of the two, 0 where both are 0


def point_errors(result: Array, truth: Array, threshold: float = 0.2) -> PointErrors:
    """Chamfer and Hausdorff distance, and F-score at `threshold` metres, of points (N, 3) and (M, 3).

    F-score: Knapitsch et al. 2017. Raises ValueError for other shapes, no points or NaN, a threshold below 0.
    """
    check_least("a threshold", threshold, 0)
    there, back = nearest_distances(result, truth), nearest_distances(truth, result)
    precision, recall = float((there <= threshold).mean()), float((back <= threshold).mean())
    return PointErrors(
        float(there.mean() + back.mean()),
        float((there**2).mean() + (back**2).mean()),
        float(max(there.max(), back.max())),
        precision,
        recall,
        _harmonic(precision, recall),
    )


def chamfer_distance(a: Array, b: Array) -> float:
    """Mean distance from `a` (N, 3) to `b` (M, 3) plus that from `b` to `a`, metres."""
    return float(nearest_distances(a, b).mean() + nearest_distances(b, a).mean())


def _harmonic(precision: float, recall: float) -> float:
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


@dataclass(frozen=True)
class VoxelErrors:
    """Overlap of the voxels that a result and the truth occupy, each in [0, 1]."""

    iou: float
    precision: float
    recall: float
    f1: float


def voxel_errors(result: Array, truth: Array, size: float = 0.1) -> VoxelErrors:
    """Overlap of the voxels floor(x / size) that points (N, 3) and (M, 3) in metres occupy; one scan (ILN, TULIP).

    Means over scans are taken of these. Raises ValueError for other shapes, no points or NaN, a size that is not above
    0.
    """
    check_above_0("a size", size)
    first, second = (np.unique(np.floor(_points(p) / size).astype(np.int64), axis=0) for p in (result, truth))
    both = len(first) + len(second) - len(np.unique(np.concatenate([first, second]), axis=0))
    precision, recall = both / len(first), both / len(second)
    iou = both / (len(first) + len(second) - both)
    return VoxelErrors(iou, precision, recall, _harmonic(precision, recall))


def confusion_matrix(truth: Array, predicted: Array, classes: int = 20) -> np.ndarray:
    """(classes, classes) int64 pixels, truth by row, predicted by column; those of several scans simply add up.

    Labels of one shape, whole numbers 0 to classes - 1. Raises ValueError for other shapes or labels.
    """
    rows, columns = (as_numpy(np.asarray(v) if isinstance(v, list | tuple) else v) for v in (truth, predicted))
    both = np.concatenate([rows.ravel(), columns.ravel()])
    if rows.shape != columns.shape or not rows.size:
        raise ValueError(f"expected two images of one shape, found {rows.shape} and {columns.shape}")
    if (other := ~((both >= 0) & (both < classes))).any():
        raise ValueError(f"expected labels 0-{classes - 1}, found {both[other][0]:g}")
    if both.dtype.kind == "f" and (both % 1).any():
        raise ValueError(f"expected labels of whole numbers, found {both[both % 1 != 0][0]:g}")
    both = both.astype(np.int64)
    pairs = both[: rows.size] * classes + both[rows.size :]
    return np.bincount(pairs, minlength=classes**2).reshape(classes, classes)


def _square(confusion: np.ndarray) -> np.ndarray:
    """The table (C, C). Raises ValueError for another shape, such as labels, or what is no array of numbers."""
    counts = as_numpy(confusion)
    if counts.ndim != 2 or counts.shape[0] != counts.shape[1] or not counts.size:
        raise ValueError(f"expected a confusion matrix (C, C), found {counts.shape}; confusion_matrix makes it")
    return counts


def _check_classes(without: tuple[int, ...], classes: int) -> None:
    """Raises ValueError for a class that is none: -1, by which others mark pixels to ignore, would be the last one."""
    if other := [number for number in without if not 0 <= number < classes]:
        raise ValueError(f"expected classes 0-{classes - 1} to leave out, found {other[0]}")


def class_iou(confusion: np.ndarray, without: tuple[int, ...] = ()) -> np.ndarray:
    """(C,) float64 intersection over union of each class, 0 for classes that do not occur.

    without  classes whose pixels do not count, in the truth or as predicted, as in the RangeNet repository's (0,)
    Raises ValueError for what is no confusion matrix, and for classes that it does not have.
    """
    counts = _square(confusion).astype(np.float64)
    _check_classes(without, len(counts))
    counts[list(without)] = 0
    counts[:, list(without)] = 0
    hit = counts.diagonal()
    return hit / np.maximum(counts.sum(0) + counts.sum(1) - hit, 1)


def mean_iou(confusion: np.ndarray, without: tuple[int, ...] = (0,)) -> float:
    """Mean of `class_iou` over the classes not in `without`, absent ones as 0 (RangeNet repository).

    Raises ValueError as `class_iou`, and where no class is left.
    """
    left = np.delete(class_iou(confusion, without), list(without))
    if not len(left):
        raise ValueError(f"expected at least one class to judge, found all {len(confusion)} left out")
    return float(left.mean())


def weighted_iou(confusion: np.ndarray) -> float:
    """Mean of `class_iou` of all classes, weighted by their true pixels (LiDARGen: jaccard_score, `weighted`).

    Raises ValueError for a confusion of no pixels.
    """
    if not _square(confusion).any():
        raise ValueError("expected a confusion of at least one pixel, found none")
    return float(np.average(class_iou(confusion), weights=confusion.sum(1)))


def accuracy(confusion: np.ndarray, without: tuple[int, ...] = (0,)) -> float:
    """Share of the pixels predicted right, pixels of the classes `without` left out on both sides.

    Raises ValueError as `class_iou`.
    """
    counts = _square(confusion)
    _check_classes(without, len(counts))
    left = np.delete(np.delete(counts, list(without), 0), list(without), 1)
    return float(left.trace() / max(left.sum(), 1))
