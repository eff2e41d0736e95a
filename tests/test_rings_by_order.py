"""Rows of files without rings, one ring after the other, wherever in the turn they begin and end."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.lidar.frame import check_frame
from lidarsynth.lidar.learning import learn_sensor
from lidarsynth.lidar.own_beams import own_beams
from lidarsynth.lidar.projection import pixel_of_points, ring_of_points
from lidarsynth.lidar.recognition import first_row, rings_in_order
from lidarsynth.streets.reader import SyntheticStreets


def by_rings(sensor: ls.Sensor, start: float, way: int, noise: float = 0.0) -> tuple[ls.Scan, np.ndarray]:
    """Ground and a wall, ring by ring from azimuth `start` on, counter-clockwise or, -1, clockwise; and true rings."""
    turn = start + way * np.linspace(0, 2 * np.pi, 957, endpoint=False)
    turn = turn + np.random.default_rng(1).normal(0, noise, turn.shape)
    points = []
    for elevation, lift in zip(np.radians(sensor.elevations), sensor.offsets or [0.0] * sensor.height, strict=True):
        away = np.minimum(15 + 5 * np.sin(3 * turn), 1.73 / max(-np.sin(elevation), 1e-3))
        ray = np.stack([np.cos(elevation) * np.cos(turn), np.cos(elevation) * np.sin(turn)], 1)
        points.append(np.column_stack([away[:, None] * ray, away * np.sin(elevation) + lift]))
    xyz = np.concatenate(points).astype(np.float32)
    return ls.Scan(xyz, np.full(len(xyz), 0.3, np.float32)), np.repeat(np.arange(sensor.height), len(turn))


@pytest.mark.parametrize("start", [-np.pi, 0.0, np.pi / 2, 2.2])
@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("name", ["vlp-16", "hdl-32e", "hdl-64e-kitti"])
def test_a_ring_is_its_beam_wherever_the_turn_begins(name: str, start: float, way: int):
    sensor = ls.get_sensor(name)
    scan, ring = by_rings(sensor, start, way)
    row, _ = pixel_of_points(scan, sensor)
    assert np.mean(row != ring) < 0.002


def test_a_last_point_of_the_next_turn_shifts_no_ring():
    sensor = ls.get_sensor("vlp-16")
    scan, ring = by_rings(sensor, 0.0, 1)
    azimuth = np.float32(0.002)
    far = np.hypot(*scan.xyz[-1, :2])
    scan.xyz[-1, :2] = far * np.cos(azimuth), far * np.sin(azimuth)  # one point of noise over the seam
    counted, count = ring_of_points(scan)
    assert count == 16 and np.mean(counted + 1 == ring) > 0.99, (
        "as published: off by one, and as many as there should be"
    )
    row, _ = pixel_of_points(scan, sensor)
    assert np.array_equal(row, ring)
    own = rings_in_order(scan.xyz)
    assert own is not None and own.max() == 15


def test_unfolding_by_name_stays_as_published():
    sensor = ls.get_sensor("vlp-16")
    scan, ring = by_rings(sensor, -np.pi, 1)
    row, _ = pixel_of_points(scan, sensor, "unfolding")
    assert np.mean(row != ring) > 0.2


def test_rings_of_scans_put_straight_for_motion_stay_those_of_the_file(shared: Path):
    """Their points lie on no beams any more: the order of the file is all there is."""
    sensor = ls.get_sensor("hdl-64e-kitti")
    scans = [ls.read(path) for path in sorted((shared / "scans" / "test").glob("odometry*.bin"))]
    assert scans
    for scan in scans:
        ring, count = ring_of_points(scan)
        row, _ = pixel_of_points(scan, sensor)
        beam, _ = pixel_of_points(scan, sensor, "spherical")
        assert count == 64 and np.mean(row != beam) > 0.1
        assert np.array_equal(row, ring)


@pytest.mark.parametrize("nod", [0.0, 1.5])
@pytest.mark.parametrize("name", ["vlp-16", "hdl-32e", "hdl-64e-kitti"])
def test_rings_may_come_from_the_lowest_upwards(name: str, nod: float):
    """As drivers number them; of a scan that lies on no beams any more the image was upside down."""
    sensor = ls.get_sensor(name)
    scan, ring = by_rings(sensor, 0.0, 1)
    upwards, s, c = np.argsort(-ring, kind="stable"), np.sin(np.radians(nod)), np.cos(np.radians(nod))
    turned = scan.xyz @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]], np.float32)
    row, _ = pixel_of_points(ls.Scan(turned[upwards], scan.reflectance), sensor)
    assert np.mean(row == ring[upwards]) > 0.998
    row, _ = pixel_of_points(ls.Scan(turned, scan.reflectance), sensor)
    assert np.mean(row == ring) > 0.998


@pytest.mark.parametrize("name", ["vlp-16", "hdl-32e", "hdl-64e-kitti"])
@pytest.mark.parametrize(
    ("kept", "first"), [(slice(None), 1), (slice(None), 100), (slice(None, -1), 0), (slice(1, None), -1),
                        (slice(None, -1), 1), (slice(1, None), 0), (slice(1, None, 2), 3)],
)  # fmt: skip
def test_numbers_of_rings_may_begin_anywhere_and_the_first_and_last_beam_may_be_empty(
    name: str, kept: slice, first: int
):
    """Drivers count from 1, too, and thinned scans keep their numbers: rows are those of the beams."""
    sensor = ls.get_sensor(name)
    scan, ring = by_rings(sensor, 0.0, 1, noise=0.001)
    there = np.isin(ring, np.arange(sensor.height)[kept])
    numbered = replace(scan[there], ring=(ring[there] + first).astype(np.int32))
    assert first_row(numbered.ring, numbered.xyz, sensor) == -first
    row, _ = pixel_of_points(numbered, sensor)
    assert np.array_equal(row, ring[there])


def test_rings_of_other_beams_go_where_their_points_are():
    sensor, other = ls.get_sensor("hdl-32e"), ls.Sensor("other", tuple(np.linspace(10, -30, 24).tolist()), 512)
    scan, ring = by_rings(other, 0.0, 1)
    scan = replace(scan, ring=ring.astype(np.int32))
    assert first_row(scan.ring, scan.xyz, sensor) is None
    assert np.array_equal(pixel_of_points(scan, sensor)[0], pixel_of_points(scan, sensor, "spherical")[0])
    assert first_row(scan.ring[:0], scan.xyz[:0], sensor) is None


def test_a_stray_ring_is_found_whatever_its_number():
    """A beam three degrees off its data sheet's: the scan says so, of rings from 1 on too."""
    sheet = ls.get_sensor("vlp-16")
    unit = replace(sheet, elevations=(*sheet.elevations[:-1], sheet.elevations[-1] - 3.0))
    scan, ring = by_rings(unit, 0.0, 1)
    for first in (0, 1):
        found = own_beams(replace(scan, ring=(ring + first).astype(np.int32)), sheet)
        assert found.elevations[-1] == pytest.approx(unit.elevations[-1], abs=0.05)
        assert found.elevations[:-1] == sheet.elevations[:-1]


def to_each_side(index: int, sensor: ls.Sensor) -> ls.Scan:
    """A street, ring after ring from behind on, in which beams look 4.2 degrees to either side, as of a VLP-32C."""
    scan, sides = SyntheticStreets(5, 16, sensor)[index], np.radians([1.4, -4.2, 4.2, -1.4])
    x, y, z = scan.xyz.T
    far, side = np.hypot(x, y), sides[scan.ring % 4]
    azimuth = np.arctan2(y, x)
    order = np.lexsort((-azimuth, scan.ring))
    xyz = np.stack([far * np.cos(azimuth + side), far * np.sin(azimuth + side), z], 1).astype(np.float32)
    return replace(scan, xyz=xyz, ring=None, label=None)[order]


def test_beams_that_look_to_either_side_are_in_their_own_frame_and_tell_their_sensor():
    """An order that mixed two beams in each ring had the sensor stand a metre aside, and taught beams between beams."""
    sensor = ls.get_sensor("vlp-32c")
    for index in (2, 8):
        scan = to_each_side(index, sensor)
        assert check_frame(scan).warning() is None
        learned = np.array(learn_sensor([scan], "own").sensor.elevations)
        assert np.abs(learned[:, None] - sensor.elevations).min(axis=1).max() < 0.05 and len(learned) >= 28


def test_a_turn_that_begins_aside_teaches_no_more_beams_than_there_are():
    sensor = ls.Sensor("own", tuple(np.linspace(12, -22, 20).tolist()))
    scan, _ = by_rings(sensor, np.pi / 2, 1)
    learned = learn_sensor([scan], "own")
    assert learned.merged == 0 and np.allclose(learned.sensor.elevations, sensor.elevations, atol=0.01)


def test_points_of_beams_that_are_not_guessed_are_no_columns():
    """Four beams that see nothing far fall to the last one that is guessed: 2,120 columns were learned of 2,083."""
    sensor = ls.Sensor("own", tuple(np.linspace(8, -22, 20).tolist()), 900, 0.5, 80.0, mount=0.9)
    streets = SyntheticStreets(seed=5, length=200, sensor=sensor)
    scans = [replace(streets[i], ring=None, time=None) for i in (0, 20, 40)]
    mixed = [scan[np.random.default_rng(0).permutation(len(scan))] for scan in scans]
    learned = learn_sensor(mixed, "own")
    assert learned.sensor.height < 20 and abs(learned.sensor.width - 2083) < 2
