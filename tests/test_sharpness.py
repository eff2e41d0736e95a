"""street-2: what the FRD does not see. Flat ground is thin, noise makes it thick, and files keep the counts."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidarsynth.data.dataset import CachedImages, write_cache
from lidarsynth.evaluation.measures import MEASURES
from lidarsynth.evaluation.protocols import STREET_2
from lidarsynth.evaluation.report import results_of, warnings_of
from lidarsynth.evaluation.statistics import Statistics, load_statistics, save_statistics
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.metrics.sharpness import KINDS, THICKNESS, Sharpness

SENSOR = Sensor("flat", tuple(np.linspace(-3, -20, 32)), width=720, min_range=1.0, max_range=80.0, mount=1.8)
PROTOCOL = replace(STREET_2, networks=(), height=32, width=720)


def street(noise: float = 0.0, seed: int = 0) -> RangeImage:
    """Flat ground 1.8 m below, and behind it a straight wall, 10 m ahead."""
    elevation, azimuth = SENSOR.ray_angles()
    ground = 1.8 / np.sin(-elevation)
    wall = 10 / (np.cos(elevation) * np.maximum(np.cos(azimuth), 1e-3))
    distance = np.minimum(ground, wall) + np.random.default_rng(seed).normal(0, noise, elevation.shape)
    return RangeImage(distance.astype(np.float32), np.full(elevation.shape, 0.3, np.float32), distance < 60, SENSOR)


def counted(*images: RangeImage) -> Sharpness:
    sharpness = Sharpness()
    for image in images:
        sharpness.update(image)
    return sharpness


def median(counts: np.ndarray) -> float:
    """Metres of the bin that half of the counts do not exceed."""
    return float(10 ** THICKNESS[np.searchsorted(counts.cumsum(), counts.sum() / 2) + 1])


def test_noise_makes_ground_and_walls_as_thick_as_it_is():
    clean, noisy = counted(street()), counted(street(0.1))
    assert median(clean.counts["ground"]) < 0.007 and median(clean.counts["walls"]) < 0.007
    # A point errs by the noise, the line by half of its square: sqrt(1.5) * 0.1 m, half of all by 0.67 of that, and
    # not all of it is across the line.
    assert 0.01 < median(noisy.counts["walls"]) < 0.15
    assert all(counts.sum() > 100 for counts in clean.counts.values())


def test_ranges_count_as_caches_keep_them(tmp_path: Path):
    far = replace(SENSOR, max_range=200.0)  # a cache of it has steps of 4 mm
    image = replace(street(0.001), sensor=far)
    list(write_cache(tmp_path / "cache", lambda _: image, 1, far, {"dataset": "street"}))
    kept = CachedImages(tmp_path / "cache")[0]
    first, second = counted(image).counts, counted(kept).counts
    assert (kept.range != image.range).any() and all((first[kind] == second[kind]).all() for kind in KINDS)


def test_two_halves_merge_into_the_whole():
    both, first, second = counted(street(0), street(0.1)), counted(street(0)), counted(street(0.1))
    first.merge(second)
    assert all((first.counts[kind] == both.counts[kind]).all() for kind in KINDS)


def test_rows_rise_with_the_noise_and_a_file_keeps_them(tmp_path: Path):
    rows = [row for row in STREET_2.rows if row.measure.startswith("sharp-")]
    sides = {}
    for noise in (0.0, 0.02, 0.2):
        sides[noise] = Statistics(PROTOCOL, SENSOR, "samples")
        sides[noise].update([street(noise, seed=1)], [True], [True])
    real = Statistics(PROTOCOL, SENSOR, "real")
    real.update([street(0.0, seed=2)], [True], [True])
    for row in rows:
        values = [MEASURES[row.measure](row, sides[noise], real, 0) for noise in sides]
        assert values[0] < values[1] < values[2] <= np.log(2)
    save_statistics(tmp_path / "s.safetensors", sides[0.2])
    again = load_statistics(tmp_path / "s.safetensors", PROTOCOL)[0]
    for row in rows:
        assert MEASURES[row.measure](row, again, real, 0) == MEASURES[row.measure](row, sides[0.2], real, 0)


def test_measured_points_on_one_side_alone_are_told():
    image = street()
    measured = replace(image, xyz=image.points())
    told = []
    for one, other in ((image, image), (measured, image), (measured, measured)):
        sides = [Statistics(PROTOCOL, SENSOR, role) for role in ("samples", "real")]
        for side, given in zip(sides, (one, other), strict=True):
            side.update([given], [True], [True])
        told.append([line for line in warnings_of(*sides) if "measured points" in line])
    assert told[0] == told[2] == [] and "1 of the samples and 0 of the reference hold measured points" in told[1][0]


def test_an_image_without_returns_has_no_number():
    real, none = (Statistics(PROTOCOL, SENSOR, "samples") for _ in range(2))
    real.update([street()], [True], [True])
    row = next(row for row in STREET_2.rows if row.measure == "sharp-walls")
    assert np.isnan(MEASURES[row.measure](row, none, real, 0))


@pytest.mark.parametrize("kind", KINDS)
def test_equal_sides_are_zero_apart(kind: str):
    side = Statistics(PROTOCOL, SENSOR, "samples")
    side.update([street(0.05)], [True], [True])
    row = next(row for row in STREET_2.rows if row.measure == f"sharp-{kind}")
    assert MEASURES[row.measure](row, side, side, 0) == pytest.approx(0, abs=1e-9)


def test_why_a_kind_of_returns_is_not_compared_is_told():
    """It was `no returns to compare`, of scans full of returns."""
    flat, wall = street(), street()
    sides = [Statistics(PROTOCOL, SENSOR, role) for role in ("samples", "real")]
    sides[0].update([flat.keep(flat.points()[..., 2] < -1.7)], [True], [True])
    sides[1].update([wall], [True], [True])
    found = {r.name: (r.value, r.reason) for r in results_of(*sides)}
    told = "no returns of the samples are on walls, within 1 m of both beside them on the ring"
    assert found["thickness of walls x1e3"] == (None, told)
    assert found["thickness of the ground x1e3"][0] is not None and found["steps along a ring x1e3"][0] is not None
