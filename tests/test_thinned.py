"""Scans that hold every k-th beam of a sensor: `times` counts the beams that they hold."""

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.lidar.scan import Scan
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.denser import beam_step

HDL = ls.get_sensor("hdl-64e-kitti")


@pytest.fixture(scope="module")
def street() -> ls.RangeImage:
    return SyntheticStreets(4321, 1, HDL).image(0)


def thinned(street: ls.RangeImage, every: int, first: int = 0) -> Scan:
    known = ls.corrupt(street, f"beams:{every}:{first}")
    return street.keep(known).to_scan()


@pytest.mark.parametrize(("every", "first"), [(1, 0), (2, 1), (4, 0), (4, 3), (8, 5)])
def test_how_many_beams_a_scan_leaves_out_is_seen(street: ls.RangeImage, every: int, first: int):
    assert beam_step(street.keep(ls.corrupt(street, f"beams:{every}:{first}"))) == (every, first)


def test_few_beams_and_none_leave_out_nothing(street: ls.RangeImage):
    rows = np.zeros(street.shape, bool)
    assert beam_step(street.keep(rows))[0] == 1
    rows[[8, 40]] = True
    assert beam_step(street.keep(rows))[0] == 1


@pytest.mark.parametrize(("times", "height", "beams"), [(4, 64, HDL.elevations), (8, 127, None), (3, 46, None)])
def test_times_counts_the_beams_that_it_holds(street: ls.RangeImage, times: int, height: int, beams: tuple | None):
    scan = thinned(street, 4)
    dense = ls.load("default").upsample(scan, "hdl-64e-kitti", times=times)
    assert dense.sensor.height == height
    assert beams is None or dense.sensor.elevations == beams
    rows = np.flatnonzero(dense.mask.any(1))
    assert np.diff(rows).max() == 1 and len(rows) > 0.9 * height
    every = dense.to_scan().xyz
    assert {point.tobytes() for point in scan.xyz} <= {point.tobytes() for point in every}


def test_the_sensors_own_beams_are_filled_in_as_complete_does(street: ls.RangeImage):
    model, scan = ls.load("default"), thinned(street, 4)
    dense, whole = model.upsample(scan, "hdl-64e-kitti", times=4), model.complete(scan)
    both = dense.mask & whole.mask
    assert both.mean() > 0.9 * whole.mask.mean()
    assert np.median(np.abs(dense.range - whole.range)[both]) < 0.05


def test_interpolations_put_beams_between_those_of_the_scans_own_sensor():
    """Row i of the scan is row 4 i, and those between are on the straight line; `nearest` repeats its rows."""
    sensor = ls.get_sensor("vlp-16")
    scan = SyntheticStreets(4321, 1, sensor)[0]
    own = ls.project(scan, sensor)
    straight = ls.load("bilinear").upsample(scan, sensor, times=4)
    assert straight.sensor.elevations[::4] == pytest.approx(sensor.elevations) and straight.shape[0] == 61
    answered = (own.mask.mean(1) > 0.02).nonzero()[0]
    np.testing.assert_array_equal(straight.range[4 * answered], own.range[answered])
    first = answered[np.flatnonzero(np.diff(answered) == 1)[0]]
    expected = 0.75 * own.range[first] + 0.25 * own.range[first + 1]
    np.testing.assert_allclose(straight.range[4 * first + 1], expected, rtol=1e-5)
    near = ls.load("nearest").upsample(scan, sensor)
    np.testing.assert_array_equal(near.range[4 * first + 1], own.range[first])
    every = {point.tobytes() for point in straight.to_scan().xyz}
    assert {point.tobytes() for point in scan.xyz} <= every
