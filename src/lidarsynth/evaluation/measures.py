"""What computes the rows of a protocol's table: statistics of both sides -> a number. A word of MEASURES each."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from torch import Tensor

from lidarsynth.evaluation.protocol import Row, Sets
from lidarsynth.evaluation.statistics import Statistics
from lidarsynth.metrics.distributions import frechet_distance, gaussian_mmd, jensen_shannon_distance, kernel_distance
from lidarsynth.metrics.neighbours import (
    coverage,
    distance_matrix,
    minimum_matching_distance,
    nearest_neighbour_accuracy,
)
from lidarsynth.metrics.occupancy import Occupancy, cells_along, minimum_matching, total_variation
from lidarsynth.metrics.point_sets import earth_movers_distance, sphere_counts
from lidarsynth.metrics.sensor_report import BeamCounts, compare_beams, drop_rate_error
from lidarsynth.metrics.sharpness import KINDS

LARGEST_SEED = 2**32 - 1  # of the generator that `_kernel` draws from
SHARP = {  # kind of returns of which rows of sharpness are, in words
    "along": "neighbours along a ring",
    "down": "neighbours from beam to beam",
    "ground": "on the ground, within 1 m of both beside them on the ring",
    "walls": "on walls, within 1 m of both beside them on the ring",
}
OnPair = Callable[[int, int], object] | None  # (done, in all), for progress bars
SetDistances = tuple[np.ndarray, np.ndarray, np.ndarray]


def _frechet(row: Row, samples: Statistics, real: Statistics, seed: int) -> float:
    assert row.network
    return frechet_distance(samples.moments[row.network], real.moments[row.network])


def _kernel(row: Row, samples: Statistics, real: Statistics, seed: int) -> float:
    assert row.network
    protocol, rng = samples.protocol, np.random.RandomState(seed)  # the official programs draw from this generator
    both = samples.features(row.network), real.features(row.network)
    return kernel_distance(*both, rng, protocol.subsets, protocol.subset_size)


def _bev_mmd(row: Row, samples: Statistics, real: Statistics, seed: int) -> float:
    assert samples.protocol.bev
    _check_gate(samples, real)
    return gaussian_mmd(filled_scans(samples), filled_scans(real), samples.protocol.bev.width)


def _bev_jsd(row: Row, samples: Statistics, real: Statistics, seed: int) -> float:
    assert samples.bev and real.bev
    _check_gate(samples, real)
    return jensen_shannon_distance(samples.bev.pooled, real.bev.pooled)


def _check_gate(samples: Statistics, real: Statistics) -> None:
    """Raises ValueError where a side has no point to count from above."""
    for side, name in ((samples, "samples"), (real, "reference")):
        if not side.bev or not side.bev.pooled.any():
            raise ValueError(f"no point of the {name} lies within the bird's eye gate")


def filled_scans(statistics: Statistics) -> Tensor:
    """(n, bins, bins) int32: the kept histograms of the scans that have any point in the gate."""
    assert statistics.bev
    scans = statistics.bev.scans
    filled = scans.flatten(1).any(1)
    return scans if filled.all() else scans[filled]


def _drop_rate(row: Row, samples: Statistics, real: Statistics, seed: int) -> float:
    return drop_rate_error(*_beams(samples, real))


def _beam_range(row: Row, samples: Statistics, real: Statistics, seed: int) -> float:
    return compare_beams(*_beams(samples, real)).range_error


def _beams(samples: Statistics, real: Statistics) -> tuple[BeamCounts, BeamCounts]:
    """Of both sides. Raises ValueError where rows are no one's beams."""
    if not samples.beams or not real.beams:
        raise ValueError(f"{samples.protocol.title} does not count beams")
    for side, name in ((samples, "samples"), (real, "reference")):
        if side.others:
            raise ValueError(f"images of the {name} are of several sensors, so that rows are no one's beams")
    return samples.beams, real.beams


def _sharpness(row: Row, samples: Statistics, real: Statistics, seed: int) -> float:
    assert samples.sharpness and real.sharpness
    kind = row.measure.removeprefix("sharp-")
    counts = samples.sharpness.counts[kind], real.sharpness.counts[kind]
    return jensen_shannon_distance(*counts) ** 2 if all(c.any() for c in counts) else math.nan


def lacking_returns(row: Row, samples: Statistics, real: Statistics) -> str:
    """Why a row is not a number: which side has no returns, or none that it is of."""
    kind = row.measure.removeprefix("sharp-")
    for side, name in ((samples, "samples"), (real, "reference")):
        if kind in SHARP and side.sharpness and not side.sharpness.counts[kind].any():
            return f"no returns of the {name} are {SHARP[kind]}"
    return "no returns to compare"


def _sets_jsd(row: Row, samples: Statistics, real: Statistics, seed: int) -> float:
    counts = [sphere_counts(side.sets() / 2, _sets(side).bins) for side in (samples, real)]
    return jensen_shannon_distance(*counts) ** 2 / math.log(2)


def _sets_coverage(row: Row, samples: Statistics, real: Statistics, seed: int) -> float:
    return coverage(set_distances(samples, real)[1])


def _sets_mmd(row: Row, samples: Statistics, real: Statistics, seed: int) -> float:
    return minimum_matching_distance(set_distances(samples, real)[1])


def _sets_1nna(row: Row, samples: Statistics, real: Statistics, seed: int) -> float:
    return nearest_neighbour_accuracy(*set_distances(samples, real))


def _sets(statistics: Statistics) -> Sets:
    assert statistics.protocol.sets
    return statistics.protocol.sets


def set_distances(samples: Statistics, real: Statistics, on_pair: OnPair = None) -> SetDistances:
    """Earth mover's distances among the samples, between samples and real ones, and among the real ones.

    on_pair  called with (distances done, in all) after each, which may take seconds
    """
    if not (kept := kept_distances(samples, real)):
        kept.append(_set_distances(samples, real, on_pair))
    return kept[0]


@lru_cache(maxsize=1)  # `cache_clear()` lets go of the statistics
def kept_distances(samples: Statistics, real: Statistics) -> list[SetDistances]:
    """What `set_distances` found of these, which three rows need."""
    return []


def _set_distances(samples: Statistics, real: Statistics, on_pair: OnPair) -> SetDistances:
    record, fake, true = _sets(samples), samples.sets(), real.sets()
    g, r = len(fake), len(true)
    pairs = g * r + g * (g - 1) // 2 + r * (r - 1) // 2
    if pairs > record.pairs:
        raise ValueError(f"needs {pairs:,} earth mover's distances between sets of {record.points:,} points, at most "
                         f"{record.pairs:,} are computed here; dusty-2023-small takes fewer points")  # fmt: skip
    done = 0

    def told(a: np.ndarray, b: np.ndarray) -> float:
        nonlocal done
        distance, done = earth_movers_distance(a, b), done + 1
        if on_pair:
            on_pair(done, pairs)
        return distance

    return distance_matrix(fake, fake, told), distance_matrix(fake, true, told), distance_matrix(true, true, told)


def _cloud_jsd(row: Row, samples: Statistics, real: Statistics, seed: int) -> float:
    _check_square(samples, real)
    return jensen_shannon_distance(*(_occupancy(side).pooled for side in (samples, real)))


def _cloud_tv(row: Row, samples: Statistics, real: Statistics, seed: int) -> float:
    _check_square(samples, real)
    return total_variation(*(_occupancy(side).pooled for side in (samples, real)))


def _cloud_mmd(row: Row, samples: Statistics, real: Statistics, seed: int) -> float:
    _check_square(samples, real)
    counts = _occupancy(real)
    reference, fake = ([scan for scan in _occupancy(side).scans if len(scan)] for side in (real, samples))
    return minimum_matching(reference, fake, cells_along(counts.matching, counts.extent))


def _check_square(samples: Statistics, real: Statistics) -> None:
    """Raises ValueError where a side has no point in the square of the cells."""
    for side, name in ((samples, "samples"), (real, "reference")):
        if not _occupancy(side).pooled.any():
            raise ValueError(f"no point of the {name} lies within +-{_occupancy(side).extent:g} m")


def _occupancy(statistics: Statistics) -> Occupancy:
    assert statistics.occupancy
    return statistics.occupancy


MEASURES: dict[str, Callable[[Row, Statistics, Statistics, int], float]] = {
    "frechet": _frechet,
    "kernel": _kernel,
    "bev-mmd": _bev_mmd,
    "bev-jsd": _bev_jsd,
    "drop-rate": _drop_rate,
    "beam-range": _beam_range,
    "cloud-jsd": _cloud_jsd,
    "cloud-mmd": _cloud_mmd,
    "cloud-tv": _cloud_tv,
    "sets-jsd": _sets_jsd,
    "sets-coverage": _sets_coverage,
    "sets-mmd": _sets_mmd,
    "sets-1nna": _sets_1nna,
    **{f"sharp-{kind}": _sharpness for kind in KINDS},
}
# What rows share and takes long, computed before the first of them, with progress.
SHARED: dict[str, Callable[[Statistics, Statistics, OnPair], object]] = {
    "sets-coverage": set_distances,
    "sets-mmd": set_distances,
    "sets-1nna": set_distances,
}
