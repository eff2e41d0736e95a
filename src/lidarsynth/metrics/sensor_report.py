"""What a sensor engineer looks at first: how often each beam gets no return, and how far away its returns are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from lidarsynth.lidar.beams import same_beams
from lidarsynth.lidar.sensor import Sensor, get_sensor
from lidarsynth.metrics.distributions import as_numpy, check_above_0


class BeamCounts:
    """Pixels, returns and a histogram of range per beam, of range images that arrive in batches.

    pixels     (H,) int64 rays of each beam so far
    histogram  (H, bins) int64 returns by range; bin k holds k * step <= range < (k + 1) * step, the last one all beyond
    step       metres

    Bounded in size whatever the number of images; `merge` adds what another process gathered.
    """

    def __init__(self, sensor: Sensor, step: float = 0.5):
        check_above_0("a step", step)
        self.sensor, self.step = get_sensor(sensor), step
        self.pixels = np.zeros(self.sensor.height, np.int64)
        self.histogram = np.zeros((self.sensor.height, int(np.ceil(self.sensor.max_range / step))), np.int64)

    def update(self, distance: np.ndarray | Tensor, mask: np.ndarray | Tensor) -> None:
        """Take in images (B, H, W) or (H, W): range in metres and mask, True where measured, of any width.

        Raises ValueError for another shape, what is no array or tensor of numbers, or ranges that are NaN, infinite or
        negative where measured.
        """
        ranges, measured = (as_numpy(v) for v in (distance, mask))
        height, bins = self.histogram.shape
        if ranges.shape != measured.shape or ranges.ndim not in (2, 3) or ranges.shape[-2] != height:
            raise ValueError(f"expected range and mask (B, {height}, W), found {ranges.shape} and {measured.shape}")
        measured = measured.astype(bool)
        values = ranges[measured]
        if not np.isfinite(values).all() or values.min(initial=0) < 0:
            raise ValueError("expected finite ranges from 0 m up, found NaN, infinity or below 0")
        beam = np.broadcast_to(np.arange(height)[:, None], ranges.shape)[measured]
        place = np.minimum((values.astype(np.float64) / self.step).astype(np.int64), bins - 1)
        self.histogram += np.bincount(beam * bins + place, minlength=height * bins).reshape(height, bins)
        self.pixels += ranges.size // height

    def merge(self, other: BeamCounts) -> None:
        """Take in all that `other` has seen; it stays as it is. Raises ValueError for other beams, limits or steps."""
        check_comparable(self, other)
        self.pixels += other.pixels
        self.histogram += other.histogram

    @property
    def drop_rate(self) -> np.ndarray:
        """(H,) share of each beam's rays without a return, NaN before the first image."""
        with np.errstate(invalid="ignore"):
            return 1 - self.histogram.sum(1) / self.pixels

    def quantile(self, share: float) -> np.ndarray:
        """(H,) metres that `share` in [0, 1] of each beam's returns do not exceed, to one step; NaN without returns."""
        total = self.histogram.sum(1)
        reached = self.histogram.cumsum(1) >= np.maximum(share * total, 1)[:, None]
        return np.where(total > 0, (reached.argmax(1) + 0.5) * self.step, np.nan)


def check_comparable(a: BeamCounts, b: BeamCounts, binned: bool = True) -> None:
    """Raises ValueError unless both count the same beams, and where `binned` in the same bins; widths may differ."""
    own, its = ((c.histogram.shape, c.step) for c in (a, b))
    if not same_beams(a.sensor, b.sensor) or (binned and own != its):
        names = (
            f"{c.sensor.name} ({len(c.histogram)} beams, {c.histogram.shape[1]} bins of {c.step} m)" for c in (a, b)
        )
        raise ValueError(f"expected counts of one sensor and step, found {' and '.join(names)}")


@dataclass(frozen=True)
class BeamReport:
    """Two sets of images beam by beam, from the highest beam to the lowest; each array (H,).

    elevation       degrees above the horizon
    drop_rate       share of rays without a return, of the judged images
    drop_rate_real  the same of the reference
    median, median_real  metres
    range_distance  metres: how far the returns would have to move to give the reference's histogram (Wasserstein-1);
                    NaN where one side has no returns, 0 where neither has
    """

    elevation: np.ndarray
    drop_rate: np.ndarray
    drop_rate_real: np.ndarray
    median: np.ndarray
    median_real: np.ndarray
    range_distance: np.ndarray

    @property
    def drop_rate_error(self) -> float:
        """Mean over beams of the absolute difference of the drop rates, in [0, 1]."""
        return float(np.abs(self.drop_rate - self.drop_rate_real).mean())

    @property
    def range_error(self) -> float:
        """Mean over beams of `range_distance`, metres, those that return on one side only left out; NaN where none
        returns on both."""
        if np.isnan(self.median + self.median_real).all():
            return float("nan")
        return float(np.nanmean(self.range_distance))

    @property
    def one_sided(self) -> int:
        """How many beams return on one side only."""
        return int(np.isnan(self.range_distance).sum())

    def __str__(self) -> str:
        """A table with one line per beam, and the two means below."""
        lines = ["beam  elevation   no return (reference)   median range (reference)   returns moved by"]
        columns = zip(self.elevation, self.drop_rate, self.drop_rate_real, self.median, self.median_real,
                      self.range_distance, strict=True)  # fmt: skip
        for beam, (angle, drop, real, median, median_real, moved) in enumerate(columns):
            lines.append(f"{beam:>4}{angle:>+10.2f}°{drop:>12.1%} ({real:>6.1%}){median:>18.2f} m "
                         f"({median_real:>5.2f} m){moved:>17.2f} m")  # fmt: skip
        lines.append(f"mean over beams: no return differs by {self.drop_rate_error:.2%}, "
                     f"returns moved by {self.range_error:.2f} m")  # fmt: skip
        if self.one_sided:
            beams = f"{self.one_sided} of {len(self.elevation)} beams"
            lines[-1] += f"; {beams} return on one side only: no distance counts them"
        return "\n".join(lines)


def drop_rate_error(counts: BeamCounts, real: BeamCounts) -> float:
    """As `BeamReport.drop_rate_error`, also of ranges in other bins, which it does not look at.

    Raises ValueError for other beams, or no images.
    """
    _check_both(counts, real, binned=False)
    return float(np.abs(counts.drop_rate - real.drop_rate).mean())


def _check_both(counts: BeamCounts, real: BeamCounts, binned: bool) -> None:
    """Raises ValueError unless both are comparable, and have images."""
    check_comparable(counts, real, binned)
    if not counts.pixels.all() or not real.pixels.all():
        raise ValueError(
            f"expected images on both sides, found {counts.pixels.max()} and {real.pixels.max()} rays per beam"
        )


def compare_beams(counts: BeamCounts, real: BeamCounts) -> BeamReport:
    """The report of judged images against a reference. Raises ValueError for other beams or steps, or no images."""
    _check_both(counts, real, binned=True)
    with np.errstate(invalid="ignore"):  # a beam without returns has no histogram
        shares = [c.histogram.cumsum(1) / c.histogram.sum(1, keepdims=True) for c in (counts, real)]
    moved = np.abs(shares[0] - shares[1]).sum(1) * counts.step
    silent = ~(counts.histogram.any(1) | real.histogram.any(1))
    return BeamReport(
        np.asarray(counts.sensor.elevations),
        counts.drop_rate,
        real.drop_rate,
        counts.quantile(0.5),
        real.quantile(0.5),
        np.where(silent, 0.0, moved),
    )
