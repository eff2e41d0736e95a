"""How far a completed range image is from the measured one: MAE and RMSE of range and reflectance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarsynth.lidar.scan import RangeImage


@dataclass(frozen=True)
class Errors:
    """Errors over the judged pixels, empty ones included as 0 m and reflectance 0 (as LiDARGen and R2DM judge)."""

    range_mae: float  # metres
    reflectance_mae: float  # in [0, 1]
    range_rmse: float  # metres
    reflectance_rmse: float
    pixels: int


def reconstruction_errors(result: RangeImage, truth: RangeImage, where: np.ndarray | None = None) -> Errors:
    """Errors of `result` over the pixels `where` (H, W) bool, or all. Raises ValueError for other shapes or no pixel."""
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
