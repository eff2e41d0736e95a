"""Bird's-eye-view histograms: where the points of a scan lie on the ground plane, counted in a grid.

LiDARGen's measure (Zyrianov et al. 2022), taken over by R2DM: the histograms of all scans pooled give the JSD, one per
scan gives the MMD (`distributions.jensen_shannon_distance`, `distributions.gaussian_mmd`).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lidarsynth.metrics.distributions import Array, as_tensor, check_above_0, check_least


def bev_histograms(
    xyz: Array,
    bins: int = 100,
    extent: float = 80.0,
    near: float = 3.0,
    far: float = 70.0,
) -> Tensor:
    """(B, bins, bins) int32 counts of points (B, N, 3) in metres; axis 1 is x, axis 2 is y; on the device of `xyz`.

    Points with near < |xyz| < far (strict) are counted, in cells of 2 * extent / bins metres over +-extent; the last
    cell includes its right edge, as in numpy. Removed points may stand at the origin. Raises ValueError for another
    shape, NaN or infinity, no bin, or an extent of 0.
    """
    check_least("a number of bins", bins, 1)
    check_above_0("an extent", extent)
    points = as_tensor(xyz)
    if points.ndim != 3 or points.shape[-1] != 3:
        raise ValueError(f"xyz must be (B, N, 3), got {tuple(points.shape)}")
    distance = points.norm(dim=-1)
    x, y = points[..., 0], points[..., 1]
    keep = (distance > near) & (distance < far) & (x.abs() <= extent) & (y.abs() <= extent)
    edges = _edges(bins, extent).to(points)
    cell = torch.where(keep, _cell(x, edges) * bins + _cell(y, edges), bins**2)
    counts = [torch.bincount(scan, minlength=bins**2 + 1)[:-1] for scan in cell]
    return (torch.stack(counts) if counts else cell.new_zeros(0)).view(len(points), bins, bins).int()


def _edges(bins: int, extent: float) -> Tensor:
    """(bins + 1,) the float32 edges of torch.histogramdd, with which all published values were made.

    Its step is a float32, counted from either end: the middle edge of 100 bins over +-80 m lies at -1.2e-6, which puts
    points of a ray straight ahead, |y| < 1e-6, left of it. Made here because its rounding depends on the processor.
    """
    step = float(np.float32(2 * extent) / np.float32(bins))
    count = np.arange(bins + 1)
    edges = np.where(count < (bins + 1) // 2, -extent + step * count, extent - step * (bins - count))
    return torch.from_numpy(edges.astype(np.float32))


def _cell(values: Tensor, edges: Tensor) -> Tensor:
    """Cell of each value within the edges: edges[k] <= value < edges[k + 1], the last one closed on the right."""
    bins = len(edges) - 1
    position = (values - edges[0]) * (bins / (edges[-1] - edges[0]))
    cell = position.clamp(0, bins - 0.5).long()
    # a search in the edges is exact but slow, so only values next to one, where rounding matters, are searched
    close = ((position - position.round()).abs() < 1e-3).nonzero(as_tuple=True)
    cell[close] = (torch.bucketize(values[close], edges, right=True) - 1).clamp(0, bins - 1)
    return cell


class BevCounts:
    """Histograms of scans that arrive in batches: all of them pooled, and the first `keep` one by one.

    count   number of scans so far
    pooled  (bins, bins) int64, the sum of all histograms; for the JSD
    scans   (min(count, keep), bins, bins) int16, or int32 where that is too small, for the MMD; 20 kB each at 100 bins

    `merge` adds what another process gathered. Grid and gate as in `bev_histograms`.
    """

    def __init__(
        self, bins: int = 100, extent: float = 80.0, near: float = 3.0, far: float = 70.0, keep: int | None = 10_000
    ):
        self.bins, self.extent, self.near, self.far, self.keep = bins, extent, near, far, keep
        self.count = 0
        self.pooled = torch.zeros(bins, bins, dtype=torch.int64)
        self._kept: list[Tensor] = []

    @property
    def scans(self) -> Tensor:
        """(n, bins, bins) int16 or int32: the kept histograms, in the order they came."""
        if len(self._kept) != 1:  # one copy of them, not two: 10,000 are 200 MB
            self._kept = [torch.cat([torch.zeros(0, self.bins, self.bins, dtype=torch.int16), *self._kept])]
        return self._kept[0]

    def update(self, xyz: Array) -> None:
        """Take in the points of a batch of scans (B, N, 3), metres. Raises ValueError as `bev_histograms` does."""
        scans = bev_histograms(xyz, self.bins, self.extent, self.near, self.far).cpu()
        self._add(len(scans), scans.sum(0), scans)

    def merge(self, other: BevCounts) -> None:
        """Take in all that `other` has seen; it stays as it is. Raises ValueError for another grid or gate."""
        own, its = ((c.bins, c.extent, c.near, c.far) for c in (self, other))
        if own != its:
            raise ValueError(f"expected counts with bins, extent, near, far {own}, found {its}")
        self._add(other.count, other.pooled, other.scans)

    def state(self) -> dict[str, Tensor]:
        """Tensors by name, for a file or another process; the inverse of `load_state`."""
        return {"count": torch.tensor(self.count), "pooled": self.pooled, "scans": self.scans}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Take in, with a grid and gate like its own, what `state` of another gave. Raises ValueError for others."""
        found = {name: tuple(value.shape) for name, value in state.items()}
        kept = len(state["scans"]) if "scans" in state else 0
        expected = {"count": (), "pooled": (self.bins, self.bins), "scans": (kept, self.bins, self.bins)}
        if found != expected:
            raise ValueError(f"expected {expected}, found {found}")
        self._add(int(state["count"]), state["pooled"], state["scans"])

    def _add(self, count: int, pooled: Tensor, scans: Tensor) -> None:
        free = len(scans) if self.keep is None else self.keep - sum(map(len, self._kept))
        if free > 0 and len(scans):
            small = int(scans[:free].amax()) < 1 << 15  # as a number: in int16 the limit itself does not fit
            self._kept.append(scans[:free].to(torch.int16 if small else torch.int32, copy=True))
        self.count += count
        self.pooled += pooled
