"""How far two sets of features lie apart: Frechet distance, polynomial MMD (KID), Gaussian MMD, Jensen-Shannon.

Features are (N, D) and come from any network, as numpy arrays or torch tensors on any device. `Moments` gathers what
the Frechet distance needs batch by batch, and two of them merge, so that two machines can share a set.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from lidarsynth.lidar.scan import ODD, laid_out

Array: TypeAlias = np.ndarray | Tensor
Random: TypeAlias = np.random.Generator | np.random.RandomState


def as_tensor(values: Array) -> Tensor:
    """The values as a tensor on their own device without gradients, as float32 unless they are float64.

    Read-only arrays (memory maps) are copied. Raises ValueError for NaN or infinity, and as `check_numbers`.
    """
    tensor = as_numbers(values)
    tensor = tensor if tensor.dtype == torch.float64 else tensor.float()
    if not torch.isfinite(tensor.sum(dtype=torch.float64)):  # a fifth of the time of looking at each
        raise ValueError(f"expected finite values, found NaN or infinity among {tuple(tensor.shape)}")
    return tensor


def check_numbers(values: object) -> None:
    """Raises ValueError for what is no array or tensor of plain numbers: lists, masked, complex and sparse ones."""
    if isinstance(values, Tensor):
        odd = values.is_meta or values.is_quantized or values.is_nested or values.is_complex()
        plain = values.layout == torch.strided and not odd
        found = f"a tensor of {values.layout}, {values.dtype} on {values.device}"
    elif isinstance(values, np.ndarray):
        plain = values.dtype.kind in "fiub" and not isinstance(values, ODD)
        found = f"a {type(values).__name__} of {values.dtype}"
    else:
        plain, found = False, f"a {type(values).__name__}"
    if not plain:
        raise ValueError(f"expected an array or tensor of plain numbers, found {found}")


def as_numbers(values: Array) -> Tensor:
    """The values where they are, without gradients, and of types that torch knows and can sum: not unsigned of many
    bytes, longer than float64 or of another byte order. Raises ValueError as `check_numbers`."""
    check_numbers(values)
    if isinstance(values, Tensor):
        return values.detach()
    if values.dtype.kind == "u" and values.dtype.itemsize > 1:
        values = values.astype(np.int32 if values.dtype.itemsize == 2 else np.int64)
    if values.dtype.kind == "f" and values.dtype.itemsize > 8:
        values = values.astype(np.float64)
    return torch.from_numpy(laid_out(values, values.dtype.newbyteorder("=")))


def as_numpy(values: Array) -> np.ndarray:
    """The values as `as_numbers` has them, as an array; bfloat16, which numpy has not, as float32."""
    tensor = as_numbers(values).cpu()
    return (tensor.float() if tensor.dtype == torch.bfloat16 else tensor).numpy()


def check_least(name: str, number: float, least: float) -> None:
    """Raises ValueError by name, with its article, for a number below `least`, or NaN."""
    if not number >= least:
        raise ValueError(f"expected {name} of at least {least:g}, found {number}")


def check_above_0(name: str, number: float) -> None:
    """Raises ValueError by name, with its article, for a number that is not above 0."""
    if not number > 0:
        raise ValueError(f"expected {name} above 0, found {number}")


class Moments:
    """Count, mean and covariance of features that arrive in batches; float64 sums of bounded size.

    count    number of features so far
    mean     (D,) float64
    scatter  (D, D) float64, sum of the outer products of the deviations from the mean

    Batches may come in any size and order, and `merge` adds what another process gathered (Chan et al. 1979).
    """

    def __init__(self, dimensions: int, device: torch.device | str = "cpu"):
        self.count = 0
        self.mean = torch.zeros(dimensions, dtype=torch.float64, device=device)
        self.scatter = torch.zeros(dimensions, dimensions, dtype=torch.float64, device=device)

    def update(self, features: Array) -> None:
        """Take in a batch (B, D). Raises ValueError for another shape, NaN or infinity."""
        batch = as_tensor(features).to(self.mean)
        if batch.ndim != 2 or batch.shape[1] != len(self.mean):
            raise ValueError(f"features must be (B, {len(self.mean)}), got {tuple(batch.shape)}")
        if len(batch):
            mean = batch.mean(0)
            self._join(len(batch), mean, batch - mean)

    def merge(self, other: Moments) -> None:
        """Take in all that `other` has seen; it stays as it is. Raises ValueError for another number of dimensions."""
        if len(other.mean) != len(self.mean):
            raise ValueError(f"expected moments of {len(self.mean)} dimensions, found {len(other.mean)}")
        if other.count:
            self.scatter += other.scatter.to(self.mean)
            mean = other.mean.to(self.mean)
            self._join(other.count, mean, mean.new_zeros(0, len(mean)))

    def _join(self, count: int, mean: Tensor, deviations: Tensor) -> None:
        total = self.count + count
        shift = mean - self.mean
        between = shift * math.sqrt(self.count * count / total)
        # one pass over the large matrix: the distance of the two means is one more deviation
        rows = torch.cat([deviations, between[None]])
        self.scatter.addmm_(rows.T, rows)
        self.mean += shift * (count / total)
        self.count = total

    def covariance(self) -> Tensor:
        """(D, D) float64, divided by count - 1. Raises ValueError for fewer than two features."""
        if self.count < 2:
            raise ValueError(f"expected at least 2 features for a covariance, found {self.count}")
        return self.scatter / (self.count - 1)

    def state(self) -> dict[str, Tensor]:
        """Tensors by name, for a file or another process; the inverse of `from_state`."""
        return {"count": torch.tensor(self.count), "mean": self.mean, "scatter": self.scatter}

    @classmethod
    def from_state(cls, state: dict[str, Tensor]) -> Moments:
        """Moments as `state` gave them. Raises ValueError when names or shapes do not fit."""
        found = {key: tuple(value.shape) for key, value in state.items()}
        size = state["mean"].numel() if "mean" in state else 0
        expected = {"count": (), "mean": (size,), "scatter": (size, size)}
        if found != expected:
            raise ValueError(f"expected count (), mean (D,) and scatter (D, D), found {found}")
        moments = cls(size, state["mean"].device)
        moments.count = int(state["count"])
        moments.mean += state["mean"]
        moments.scatter += state["scatter"]
        return moments


def moments(features: Array) -> Moments:
    """Moments of one array (N, D), on its device. Raises ValueError for another shape, NaN or infinity."""
    check_numbers(features)
    if features.ndim != 2:
        raise ValueError(f"features must be (N, D), got {tuple(features.shape)}")
    result = Moments(features.shape[1], features.device if isinstance(features, Tensor) else "cpu")
    result.update(features)
    return result


def frechet_distance(a: Moments, b: Moments) -> float:
    """|mu_a - mu_b|^2 + tr(S_a + S_b - 2 (S_a S_b)^(1/2)); symmetric, 0 for equal moments (Heusel et al. 2017).

    FRD, FPD and FID by the features. With no more samples than dimensions the covariances are singular; the value is
    then exact for these samples, but larger than that of many. Raises ValueError for different dimensions, and for
    features, of which `moments` makes what is expected.
    """
    for given in (a, b):
        if not isinstance(given, Moments):
            raise ValueError(f"expected Moments, found a {type(given).__name__}; moments(features) makes them")
    if len(a.mean) != len(b.mean):
        raise ValueError(f"expected moments of {len(a.mean)} dimensions, found {len(b.mean)}")
    first, second = a.covariance(), b.covariance().to(a.mean)
    # S_a S_b = L (L^T S_b) has the eigenvalues of the symmetric L^T S_b L, whose roots add up to the trace
    fewer = a.count <= b.count
    root = _factor(*((first, a.count) if fewer else (second, b.count)))
    eigenvalues = torch.linalg.eigvalsh(root.T @ (second if fewer else first) @ root).clamp(min=0)
    distance = (a.mean - b.mean.to(a.mean)).square().sum() + first.trace() + second.trace()
    return max(float(distance - 2 * eigenvalues.sqrt().sum()), 0.0)  # of equal ones rounding leaves either sign


def _factor(covariance: Tensor, count: int) -> Tensor:
    """L (D, R) with covariance = L L^T, of `count` samples: Cholesky, or eigenvectors where it is singular."""
    size = len(covariance)
    if count <= size:
        # Its rank is below `count`, so `count` random directions reach all of its range (Halko et al. 2011).
        probe = torch.randn(size, count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        basis = torch.linalg.qr(covariance @ probe.to(covariance)).Q
        return basis @ _eigen_root(basis.T @ covariance @ basis)
    lower, failed = torch.linalg.cholesky_ex(covariance)
    return _eigen_root(covariance) if failed else lower


def _eigen_root(covariance: Tensor) -> Tensor:
    values, vectors = torch.linalg.eigh(covariance)
    solid = values > values[-1] * len(values) * torch.finfo(values.dtype).eps
    return vectors[:, solid] * values[solid].sqrt()


def kernel_distance(generated: Array, real: Array, rng: Random, subsets: int = 100, size: int = 1000) -> float:
    """Unbiased squared MMD of features (N, D) and (M, D) under k(x, y) = (x.y / D + 1)^3 (KID, Binkowski et al. 2018).

    The mean over `subsets` pairs of subsets of min(N, M, size) features without replacement; `rng` draws the generated
    ones first. Features may be memory maps: only the drawn ones are read. Raises ValueError for fewer than two, other
    shapes, NaN or infinity, no subset, a seed in place of `rng`.
    """
    if not isinstance(rng, Random) and rng is not np.random:
        raise ValueError(f"expected a generator such as numpy.random.default_rng(0), found a {type(rng).__name__}")
    check_numbers(generated)
    check_numbers(real)
    check_least("a number of subsets", subsets, 1)
    check_least("a size", size, 2)
    if generated.ndim != 2 or real.ndim != 2 or generated.shape[1] != real.shape[1]:
        raise ValueError(f"features must be (N, D) and (M, D), got {tuple(generated.shape)} and {tuple(real.shape)}")
    count = min(len(generated), len(real), size)
    if count < 2:
        raise ValueError(f"expected at least 2 features of either set, found {len(generated)} and {len(real)}")
    total = 0.0
    for _ in range(subsets):
        x = as_tensor(generated[rng.choice(len(generated), count, replace=False)])
        y = as_tensor(real[rng.choice(len(real), count, replace=False)]).to(x)
        within = _cubic(x, x).fill_diagonal_(0).sum() + _cubic(y, y).fill_diagonal_(0).sum()
        total += float(within / (count * (count - 1)) - 2 * _cubic(x, y).mean())
    return total / subsets


def _cubic(x: Tensor, y: Tensor) -> Tensor:
    return ((x @ y.T).double() / x.shape[1] + 1) ** 3


def gaussian_mmd(x: Array, y: Array, width: float = 0.5, block: int = 1024) -> float:
    """Biased squared MMD under k(p, q) = exp(-|p - q|^2 / (2 width^2)) (Gretton et al. 2012), diagonals included.

    x (N, ...) and y (M, ...) are histograms of one shape, each divided by its sum here. `block` of them at a time
    become float32, so 10,000 histograms of 100x100 counts need little more memory than themselves. Zero, to 1e-8, for
    equal sets. Raises ValueError for other shapes, negative counts, a histogram without any, or a width of 0.
    """
    check_above_0("a width", width)
    check_least("a block", block, 1)
    first, second = _rows(x), _rows(y)
    if not len(first) or not len(second) or tuple(x.shape[1:]) != tuple(y.shape[1:]):
        raise ValueError(f"expected two sets of histograms of one shape, found {tuple(x.shape)} and {tuple(y.shape)}")
    used = ((first != 0).any(0) | (second != 0).any(0).to(first.device)).nonzero()[:, 0]
    p, q = (_Blocks(rows, used, block) for rows in (first, second))
    scale = -0.5 / width**2
    # k - 1 keeps the digits that k loses where all histograms are close; the ones cancel in the sum of the means
    return _mean_kernel(p, p, scale) + _mean_kernel(q, q, scale) - 2 * _mean_kernel(p, q, scale)


def _rows(values: Array) -> Tensor:
    numbers = as_numbers(values)
    if numbers.ndim < 2:
        raise ValueError(f"expected histograms (N, ...), found {tuple(numbers.shape)}")
    return numbers.flatten(1)


class _Blocks:
    """Histograms (N, D) of which `block` at a time become float32 rows of sum 1, with the columns `used` only."""

    def __init__(self, rows: Tensor, used: Tensor, block: int):
        self.rows, self.used, self.block = rows, used.to(rows.device), block
        self.total = rows.sum(1, keepdim=True, dtype=torch.float64)
        if not (self.total > 0).all() or not torch.isfinite(self.total).all():
            raise ValueError("expected counts in every histogram, found one without")
        if (least := float(rows.amin())) < 0:
            raise ValueError(f"expected counts of at least 0, found {least:g}")

    def __len__(self) -> int:
        return -(-len(self.rows) // self.block)

    def __getitem__(self, index: int) -> Tensor:
        part = slice(index * self.block, (index + 1) * self.block)
        return self.rows[part].index_select(1, self.used).float() / self.total[part].float()


def _mean_kernel(x: _Blocks, y: _Blocks, scale: float) -> float:
    """Mean of exp(scale |p - q|^2) - 1 over all pairs; of one set with itself, over its upper triangle twice."""
    total, same = 0.0, x is y
    for i in range(len(x)):
        p = x[i]
        for j in range(i if same else 0, len(y)):
            q = p if same and i == j else y[j].to(p)
            squared = p.square().sum(1)[:, None] + q.square().sum(1) - 2 * (p @ q.T)
            if q is p:
                squared.fill_diagonal_(0)
            part = float(torch.expm1(scale * squared.clamp(min=0)).sum(dtype=torch.float64))
            total += part * (2 if same and q is not p else 1)
    return total / (len(x.rows) * len(y.rows))


def jensen_shannon_distance(p: Array, q: Array) -> float:
    """Square root of the Jensen-Shannon divergence, natural logarithm: 0 for equal, sqrt(ln 2) for disjoint ones.

    p, q are counts of one shape, pooled over all scans; each is divided by its sum. Square the value for the divergence
    (nats). Raises ValueError for other shapes, negative or infinite counts, or none.
    """
    counts = [as_numbers(values).flatten().double().cpu() for values in (p, q)]
    if p.shape != q.shape or any(not 0 < c.sum() < math.inf or c.min() < 0 for c in counts):
        found = [(tuple(v.shape), float(c.sum())) for v, c in zip((p, q), counts, strict=True)]
        raise ValueError(f"expected counts of one shape, found shapes and sums {found}")
    some = (counts[0] > 0) | (counts[1] > 0)  # most cells of a map are empty on both sides
    left, right = (c[some] / c.sum() for c in counts)
    middle = (left + right) / 2
    divergence = sum(torch.special.xlogy(c, c / middle).sum() for c in (left, right)) / 2
    return math.sqrt(max(float(divergence), 0.0))
