"""Where KITTI's own car stands in a scan, as its returns tell; and what learned carriers hide at their edges."""

from dataclasses import replace

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.lidar.blocked import blocked_runs
from lidarsynth.lidar.projection import pixel_of_points, project
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.streets.hdl64e import hidden
from lidarsynth.streets.kittis_car import Outline, outline_of, outlined
from lidarsynth.streets.reader import SyntheticStreets

KITTI, SPEED, TURN = SENSORS["hdl-64e-kitti"], 10.0, 0.1  # metres a second, seconds
PARTS = outlined(KITTI, Outline())


def ground(open_to: np.ndarray) -> RangeImage:
    """Flat ground within 60 m, and a wall behind it, wherever `open_to` (H, W)."""
    down = np.sin(np.radians(np.maximum(-np.asarray(KITTI.elevations), 1e-3)))
    metres = np.minimum(KITTI.mount / down, 60.0)[:, None] * np.ones(KITTI.width)
    metres = np.where(open_to, metres, 0).astype(np.float32)
    return RangeImage(metres, 0.3 * (metres > 0), metres > 0, KITTI)


def moved(image: RangeImage, speed: float, ahead: float = 0.0) -> RangeImage:
    """The points where they were as the sensor of the car, which went on while it turned to the right, looked at an
    azimuth, in radians."""
    xyz = KITTI.points(image.range)[image.mask].astype(np.float64)
    xyz[:, 0] += speed * TURN * (ahead - np.arctan2(xyz[:, 1], xyz[:, 0])) / (2 * np.pi)
    ring = np.nonzero(image.mask)[0]
    return project(Scan(xyz.astype(np.float32), np.full(len(xyz), 0.3, np.float32), ring=ring), KITTI, "unfolding")


def known(image: RangeImage, part: str) -> np.ndarray:
    return image.mask if part == "whole" else ls.corrupt(image, part)


@pytest.mark.parametrize("part", ["whole", "beams:2", "beams:4", "points:0.1"])
def test_a_scan_tells_whether_its_points_were_moved(part: str):
    still = ground(~PARTS)
    assert outline_of(KITTI, still, known(still, part)) == Outline()
    for speed in (6.0, SPEED, 18.0):
        image = moved(still, speed)
        found = outline_of(KITTI, image, known(image, part))
        assert found is not None and not found.gone and not found.cast
        assert found.moved == pytest.approx(speed * TURN / (2 * np.pi), abs=0.03)
    for ahead in (np.pi, -np.pi):
        image = moved(still, SPEED, ahead)
        found = outline_of(KITTI, image, known(image, part))
        assert found is not None and found.ahead == ahead
        assert found.moved == pytest.approx(SPEED * TURN / (2 * np.pi), abs=0.03)
    image = moved(still, SPEED)
    shown = outlined(KITTI, outline_of(KITTI, image, known(image, part)))
    assert (shown & image.mask).sum() < 0.3 * (PARTS & image.mask).sum(), "nearly all of it is where nothing returned"


@pytest.mark.parametrize("part", ["whole", "beams:4", "points:0.1"])
def test_a_street_has_the_car_as_streets_have_it(part: str):
    image = SyntheticStreets(98_013, 16).image(0)
    found = outline_of(image.sensor, image, known(image, part))
    assert found == Outline(cast=True)
    np.testing.assert_array_equal(outlined(image.sensor, found), hidden(image.sensor))


def test_what_returns_is_no_part_of_the_car():
    alone = PARTS & (np.arange(KITTI.width) > 640) & (np.arange(KITTI.width) < 780)  # stands by itself, on the right
    for part in ("whole", "beams:4"):
        image = ground(~PARTS | alone)
        found = outline_of(KITTI, image, known(image, part))
        assert found is not None and len(found.gone) == 1 and found.moved == 0
        np.testing.assert_array_equal(outlined(KITTI, found), PARTS & ~alone)
    empty = ground(np.ones(PARTS.shape, bool))
    shown = outlined(KITTI, outline_of(KITTI, empty, empty.mask))
    assert not shown.any(), "as of a simulator, which has no car"


def test_other_sensors_have_no_such_car():
    image = ground(~PARTS)
    stranger = replace(KITTI, elevations=tuple(np.linspace(15, -25, 64).tolist()))
    for sensor in (stranger, replace(KITTI, name="mine"), SENSORS["os1-64"]):
        assert outline_of(sensor, image, image.mask) is None
        np.testing.assert_array_equal(outlined(sensor, Outline()), hidden(sensor))
    half = KITTI.resized(width=512)
    assert outlined(half, Outline()).mean() == pytest.approx(PARTS.mean(), rel=0.05)


@pytest.mark.parametrize("speed", [0.0, SPEED])
def test_completion_leaves_the_car_empty_where_it_stands_and_fills_what_is_beside_it(speed: float):
    image = moved(ground(~PARTS), speed) if speed else ground(~PARTS)
    asked = ls.corrupt(image, "beams:4")
    filled = ls.load("default").complete(image.keep(asked), known=asked)
    shown = outlined(KITTI, outline_of(KITTI, image, asked))
    assert not (filled.mask & shown & ~asked).any()
    beside = hidden(KITTI) & ~shown & ~asked & image.mask
    assert beside.sum() > 100 and filled.mask[beside].mean() > 0.8, "all of which streets' outline would leave empty"
    wrong = (filled.mask != image.mask) & ~asked
    as_streets = hidden(KITTI) & image.mask | ~hidden(KITTI) & ~image.mask
    assert wrong.sum() < 0.6 * (as_streets & ~asked).sum()


def test_denser_beams_know_the_car_as_the_scan_shows_it():
    image = moved(ground(~PARTS), SPEED)
    dense = ls.load("default").upsample(image.to_scan(), sensor_in="hdl-64e-kitti", times=2)
    own = dense.sensor.blocked_rays()[::2]
    np.testing.assert_array_equal(own, outlined(KITTI, outline_of(KITTI, image, image.mask)))


@pytest.mark.parametrize("place", ["-4.2/1.9", "-3.6/1.4", "-4.2/-1.9"])
def test_what_is_inserted_has_no_return_where_the_scan_shows_the_car(place: str):
    scan = ground(~PARTS).to_scan()
    road = replace(scan, label=np.full(len(scan), CLASS_NUMBER["road"]))
    found = ls.load("default").insert(road, f"person@{place}/0", seed=1).scan
    new = found[found.extra["new"] == 1]
    row, column = pixel_of_points(new, KITTI, "auto")
    assert len(new) > 600 and not PARTS[row, column].any()


def carrier(rng: np.random.Generator, scans: int) -> np.ndarray:
    """(scans, 2, 1000): a carrier in columns 100 to 149, whose edges lie up to two columns aside from scan to scan, and
    through which a ray in thirty returns."""
    seen = rng.random((scans, 2, 1000)) < 0.9
    for one in seen:
        first, last = 100 + rng.integers(-2, 3), 149 + rng.integers(-2, 3)
        one[:, first : last + 1] &= rng.random((2, last + 1 - first)) < 1 / 30
    return seen


def test_a_learned_carrier_has_its_edges_where_half_of_the_scans_have_them():
    for seed in range(3):
        seen = carrier(np.random.default_rng(seed), 40)
        runs = blocked_runs(seen, np.array([-12.0, -14.0]))
        assert [row for row, _, _ in runs] == [0, 1]
        assert all(abs(first - 100) <= 1 and abs(last - 149) <= 1 for _, first, last in runs)
        assert blocked_runs(seen, np.array([12.0, 14.0])) == (), "of rays that look up it would have to be surer"


def test_rays_that_seldom_return_are_blocked_where_chance_hardly_brings_that():
    rng = np.random.default_rng(5)
    often = rng.random((20, 2, 1000)) < np.where(np.arange(1000) < 500, 0.3, 0.35)
    often[:, :, 40:60] &= rng.random((20, 2, 20)) < 0.1
    assert blocked_runs(often, np.array([-12.0, -14.0])) == ()
