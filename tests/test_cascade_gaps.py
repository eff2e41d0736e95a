"""Surfaces in gaps are put straight, and nothing else is."""

import time
from dataclasses import replace

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.systems.cascade.gaps import straight_in_gaps


def ground(sensor: ls.Sensor, tilt: float = 0.03) -> RangeImage:
    """A slightly tilted plane 1.7 m below the sensor."""
    elevation, azimuth = (np.broadcast_to(part, (sensor.height, sensor.width)) for part in sensor.ray_angles())
    down = tilt * np.cos(elevation) * np.cos(azimuth) - np.sin(elevation)
    away = 1.7 / np.maximum(down, 1e-6)
    mask = (down > 0.01) & (away < sensor.max_range)
    metres = np.where(mask, away, 0).astype(np.float32)
    return RangeImage(metres, 0.3 * mask.astype(np.float32), mask, sensor)


def jumpy(image: RangeImage, gap: np.ndarray, share: float = 0.03) -> RangeImage:
    """Ranges in the gap go from one hypothesis to another every few pixels."""
    rows, columns = np.indices(image.shape)
    sign = np.where((columns // 6 + rows // 3) % 2, 1, -1)
    return replace(image, range=np.where(gap, image.range * (1 + share * sign), image.range).astype(np.float32))


@pytest.mark.parametrize("name", ["hdl-64e-kitti", "vlp-16", "os1-128"])
@pytest.mark.parametrize("pattern", ["sector:40", "region:3:12:-4:4", "points:0.02"])
def test_a_road_is_put_straight(name, pattern):
    truth = ground(ls.get_sensor(name))
    told = corrupt(truth, pattern, seed=3)
    filled, lost = jumpy(truth, ~told), truth.mask & ~told
    straight = straight_in_gaps(filled, told)
    before, after = (np.abs(image.range[lost] / truth.range[lost] - 1).mean() for image in (filled, straight))
    assert after < 0.8 * before
    assert np.array_equal(straight.range[told], filled.range[told])
    assert np.array_equal(straight.mask, filled.mask)
    assert straight.range.dtype == np.float32


def test_a_wide_gap_is_put_straight_by_one_thread():
    """Others' share of so short a work is waiting, long where cores are busy."""
    truth = ground(ls.get_sensor("hdl-64e-kitti"))
    told = corrupt(truth, "sector:180", seed=3)
    assert (truth.mask & ~told).sum() > 20_000, "numbers that a matrix product gives to threads"
    filled = jumpy(truth, ~told)
    of_all, of_this = time.process_time(), time.thread_time()
    straight_in_gaps(filled, told)
    of_all, of_this = time.process_time() - of_all, time.thread_time() - of_this
    assert of_all < 1.3 * of_this


def test_a_wall_that_stands_on_the_road_keeps_its_edges():
    truth = ground(ls.get_sensor("hdl-64e-kitti"), 0.0)
    columns = np.abs(np.arange(truth.shape[1]) - truth.shape[1] // 2) < 20
    pole = truth.mask & columns & (truth.range > 8)
    truth = replace(truth, range=np.where(pole, 8, truth.range).astype(np.float32))
    told = corrupt(truth, "sector:60")
    straight = straight_in_gaps(truth, told)
    off = np.abs(straight.range / np.where(truth.mask, truth.range, 1) - 1)[truth.mask]
    assert np.mean(off > 0.01) < 0.01


def test_what_is_between_beams_that_are_known_is_left_alone():
    truth = ground(ls.get_sensor("hdl-64e-kitti"))
    told = corrupt(truth, "beams:4")
    filled = jumpy(truth, ~told)
    assert straight_in_gaps(filled, told) is filled


@pytest.mark.parametrize("beams", [1, 2, 3])
def test_few_beams_and_nothing_known(beams):
    sensor = ls.Sensor(name="few", elevations=tuple(np.linspace(-5, -12, beams)), width=64, max_range=100.0)
    truth = ground(sensor)
    straight = straight_in_gaps(jumpy(truth, ~np.zeros(truth.shape, bool)), np.zeros(truth.shape, bool))
    assert np.isfinite(straight.range).all()
    assert np.array_equal(straight.mask, truth.mask)


def test_completed_roads_are_smooth():
    """`complete` uses it: of a road with a hole, rings within are as straight as a hand's width."""
    model = ls.load("default")
    truth = ground(ls.get_sensor("hdl-64e-kitti"), 0.0)
    told = corrupt(truth, "region:5:15:-4:4")
    filled = model.complete(truth.keep(told), known=told)
    gap = ~told & truth.mask
    inner = gap & np.roll(gap, 1, 1) & np.roll(gap, -1, 1) & filled.mask
    step = np.abs(filled.range - np.roll(filled.range, 1, 1))[inner & np.roll(filled.mask, 1, 1)]
    assert np.median(step) < 0.02
    assert np.mean(step > 0.3) < 0.02
