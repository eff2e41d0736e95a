"""Which samples lie near which: coverage, 1-NN accuracy and matching distance of small sets; precision and recall.

Small sets of point clouds are judged by the matrix of all distances between them, whatever the distance (Chamfer, EMD);
large sets of features by the balls around each feature that reach its k-th neighbour.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lidarsynth.metrics.distributions import Array, as_numpy, as_tensor, check_least


def distance_matrix(a: Sequence | np.ndarray, b: Sequence | np.ndarray, distance: Callable[..., float]) -> np.ndarray:
    """(len(a), len(b)) float64: `distance` of every item of `a` to every item of `b`, such as `chamfer_distance`.

    It must be symmetric and 0 of an item to itself: of one set with itself, `a is b`, each pair is computed once.
    """
    if a is b:
        matrix = np.zeros((len(a), len(a)))
        for i in range(len(a)):
            matrix[i, :i] = [distance(a[i], a[j]) for j in range(i)]
        return matrix + matrix.T
    return np.array([[distance(one, other) for other in b] for one in a], np.float64).reshape(len(a), len(b))


def minimum_matching_distance(between: Array) -> float:
    """Mean over real ones of the distance to the nearest generated one; `between` (G, R) (Achlioptas et al. 2018).

    MMD-CD where the distance is `chamfer_distance`, MMD-EMD where it is `earth_movers_distance`.
    """
    return float(_matrix(between).min(axis=0).mean())


def coverage(between: Array) -> float:
    """Share of the real ones that are the nearest of some generated one; `between` (G, R), in [1 / R, 1].

    Achlioptas et al. 2018; 1 for two identical sets of different items. Raises ValueError for an empty matrix or NaN.
    """
    return len(np.unique(_matrix(between).argmin(axis=1))) / between.shape[1]


def nearest_neighbour_accuracy(generated: Array, between: Array, real: Array) -> float:
    """1-NNA: share of all items whose nearest other item is of their own set; 0.5 is best, 1 tells the sets apart.

    generated (G, G), between (G, R) and real (R, R) distances (Lopez-Paz & Oquab 2017, Yang et al. 2019). An item as
    near to both sets counts as told apart. Raises ValueError for shapes that do not fit or NaN.
    """
    among, between, within = (_matrix(distances) for distances in (generated, between, real))
    g, r = between.shape
    if among.shape != (g, g) or within.shape != (r, r):
        raise ValueError(f"expected distances {(g, g)}, {(g, r)}, {(r, r)}, "
                         f"found {among.shape}, {between.shape}, {within.shape}")  # fmt: skip
    alone = [np.where(np.eye(len(own), dtype=bool), np.inf, own).min(axis=1) for own in (among, within)]
    told_apart = (alone[0] <= between.min(axis=1)).sum() + (alone[1] <= between.min(axis=0)).sum()
    return float(told_apart / (g + r))


def _matrix(distances: Array) -> np.ndarray:
    matrix = as_numpy(distances)
    if matrix.ndim != 2 or not matrix.size or np.isnan(matrix).any():
        raise ValueError(f"expected a matrix of distances without NaN, found {matrix.shape}")
    return matrix


@dataclass(frozen=True)
class Fidelity:
    """How real the generated features are, and how much of the real ones they reach.

    Of equal sets each is 1 where no distances are equal. Balls are open: that of a feature with k duplicates or more
    holds nothing, not even itself, so that equal sets of duplicates score less, down to 0.
    """

    precision: float  # share of generated features inside the real balls (Kynkaanniemi et al. 2019)
    recall: float  # share of real features inside the generated balls
    density: float  # real balls around a generated feature, over k (Naeem et al. 2020); may exceed 1
    coverage: float  # share of real balls with a generated feature inside


def fidelity(generated: Array, real: Array, k: int = 5, block: int = 1024) -> Fidelity:
    """Precision, recall, density and coverage of features (N, D) and (M, D), with balls to the k-th neighbour.

    `block` rows of the matrix of distances exist at a time. Raises ValueError for other shapes, sets of at most k
    features, NaN or infinity, a k or block below 1.
    """
    check_least("a k", k, 1)
    check_least("a block", block, 1)
    fake, true = as_tensor(generated).double(), as_tensor(real).double()
    if fake.ndim != 2 or true.ndim != 2 or fake.shape[1] != true.shape[1] or min(len(fake), len(true)) <= k:
        raise ValueError(f"expected features (N, D) and (M, D) of more than k = {k}, "
                         f"found {tuple(fake.shape)} and {tuple(true.shape)}")  # fmt: skip
    true = true.to(fake.device)
    middle = true.mean(0)  # far from 0 matrix products lose digits
    fake, true = fake - middle, true - middle
    true_radius, fake_radius = _radii(true, k, block), _radii(fake, k, block)
    inside = precise = 0
    recalled = torch.zeros(len(true), dtype=torch.bool, device=fake.device)
    covered = recalled.clone()
    for rows, radius in zip(fake.split(block), fake_radius.split(block), strict=True):
        distance = _distances(rows, true)
        hit = distance < true_radius
        inside += int(hit.sum())
        precise += int(hit.any(1).sum())
        covered |= hit.any(0)
        recalled |= (distance < radius[:, None]).any(0)
    share = [float(found.double().mean()) for found in (recalled, covered)]
    return Fidelity(precise / len(fake), share[0], inside / (k * len(fake)), share[1])


def _radii(features: Tensor, k: int, block: int) -> Tensor:
    """(N,) distance of each feature to its k-th neighbour among the others, less what one pair differs by when it is
    computed twice: open balls leave that neighbour out."""
    # the nearest of k + 1 is the feature itself
    return torch.cat([_distances(rows, features).kthvalue(k + 1).values for rows in features.split(block)]) * (1 - 1e-9)


def _distances(rows: Tensor, features: Tensor) -> Tensor:
    """(B, N) distances; 0 where no more is left than a matrix product leaves of equal features."""
    distance = torch.cdist(rows, features)
    least = 1e-7 * (rows.norm(dim=1)[:, None] + features.norm(dim=1))
    return torch.where(distance < least, 0.0, distance)
