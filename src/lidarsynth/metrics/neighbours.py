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

from lidarsynth.metrics.distributions import Array, as_tensor


def distance_matrix(a: Sequence, b: Sequence, distance: Callable[..., float]) -> np.ndarray:
    """(len(a), len(b)) float64: `distance` of every item of `a` to every item of `b`, such as `chamfer_distance`."""
    return np.array([[distance(one, other) for other in b] for one in a], np.float64).reshape(len(a), len(b))


def minimum_matching_distance(between: np.ndarray) -> float:
    """Mean over real ones of the distance to the nearest generated one; `between` (G, R) (Achlioptas et al. 2018)."""
    return float(_matrix(between).min(axis=0).mean())


def coverage(between: np.ndarray) -> float:
    """Share of the real ones that are the nearest of some generated one; `between` (G, R), in [1 / R, 1].

    Achlioptas et al. 2018; 1 for two identical sets of different items. Raises ValueError for an empty matrix or NaN.
    """
    return len(np.unique(_matrix(between).argmin(axis=1))) / between.shape[1]


def nearest_neighbour_accuracy(generated: np.ndarray, between: np.ndarray, real: np.ndarray) -> float:
    """1-NNA: share of all items whose nearest other item is of their own set; 0.5 is best, 1 tells the sets apart.

    generated (G, G), between (G, R) and real (R, R) distances (Lopez-Paz & Oquab 2017, Yang et al. 2019). An item as
    near to both sets counts as told apart. Raises ValueError for shapes that do not fit or NaN.
    """
    between = _matrix(between)
    g, r = between.shape
    if generated.shape != (g, g) or real.shape != (r, r):
        raise ValueError(f"expected distances {(g, g)}, {(g, r)}, {(r, r)}, "
                         f"found {generated.shape}, {between.shape}, {real.shape}")  # fmt: skip
    alone = [np.where(np.eye(len(own), dtype=bool), np.inf, _matrix(own)).min(axis=1) for own in (generated, real)]
    told_apart = (alone[0] <= between.min(axis=1)).sum() + (alone[1] <= between.min(axis=0)).sum()
    return float(told_apart / (g + r))


def _matrix(distances: np.ndarray) -> np.ndarray:
    if distances.ndim != 2 or not distances.size or np.isnan(distances).any():
        raise ValueError(f"expected a matrix of distances without NaN, found {distances.shape}")
    return distances


@dataclass(frozen=True)
class Fidelity:
    """How real the generated features are, and how much of the real ones they reach; each is 1 for equal sets."""

    precision: float  # share of generated features inside the real balls (Kynkaanniemi et al. 2019)
    recall: float  # share of real features inside the generated balls
    density: float  # real balls around a generated feature, over k (Naeem et al. 2020); may exceed 1
    coverage: float  # share of real balls with a generated feature inside


def fidelity(generated: Array, real: Array, k: int = 5, block: int = 1024) -> Fidelity:
    """Precision, recall, density and coverage of features (N, D) and (M, D), with balls to the k-th neighbour.

    `block` rows of the matrix of distances exist at a time. Raises ValueError for other shapes, sets of at most k
    features, NaN or infinity.
    """
    fake, true = as_tensor(generated).double(), as_tensor(real).double()
    if fake.ndim != 2 or true.ndim != 2 or fake.shape[1] != true.shape[1] or min(len(fake), len(true)) <= k:
        raise ValueError(f"expected features (N, D) and (M, D) of more than k = {k}, "
                         f"found {tuple(fake.shape)} and {tuple(true.shape)}")  # fmt: skip
    true = true.to(fake.device)
    true_radius, fake_radius = _radii(true, k, block), _radii(fake, k, block)
    inside = precise = 0
    recalled = torch.zeros(len(true), dtype=torch.bool, device=fake.device)
    covered = recalled.clone()
    for rows, radius in zip(fake.split(block), fake_radius.split(block), strict=True):
        distance = torch.cdist(rows, true)
        hit = distance < true_radius
        inside += int(hit.sum())
        precise += int(hit.any(1).sum())
        covered |= hit.any(0)
        recalled |= (distance < radius[:, None]).any(0)
    share = [float(found.double().mean()) for found in (recalled, covered)]
    return Fidelity(precise / len(fake), share[0], inside / (k * len(fake)), share[1])


def _radii(features: Tensor, k: int, block: int) -> Tensor:
    """(N,) distance of each feature to its k-th neighbour among the others."""
    # the nearest of k + 1 is the feature itself
    return torch.cat([torch.cdist(rows, features).kthvalue(k + 1).values for rows in features.split(block)])
