"""A turn has as many columns as the sensor fired in it, whatever its table says; images of scans of others stay."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.cli.main import main
from lidarsynth.files.formats import read, write
from lidarsynth.lidar.columns import azimuth_step, columns_of_turn, full_turn, own_columns
from lidarsynth.lidar.projection import occupied, pixel_of_points, project
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import FULL_TURNS, SENSORS, Sensor, get_sensor
from lidarsynth.lidar.unseen import caution
from lidarsynth.systems.any_sensor import AnySensorModel
from lidarsynth.systems.known_pixels import sensor_that_made


def turn(sensor: Sensor, width: int, jitter: float = 0.1, keep: float = 0.8) -> Scan:
    """Points as fired, in a round room on flat ground, without rings; azimuths off by `jitter` of a step."""
    rng, sensor = np.random.default_rng(0), sensor.resized(width=width)
    rays = sensor.directions()
    with np.errstate(divide="ignore"):
        distance = np.clip(np.where(rays[..., 2] < 0, 1.7 / -rays[..., 2], 30), 3.5, 30)
    xyz = sensor.points(distance.astype(np.float32)).swapaxes(0, 1)  # firing after firing
    angle = (rng.normal(0, jitter, (width, 1)) + rng.uniform(-0.5, 0.5)) * 2 * np.pi / width
    x, y, z = np.moveaxis(xyz, -1, 0)
    xyz = np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y, z], axis=-1)
    xyz = xyz[rng.random(xyz.shape[:2]) < keep].astype(np.float32)
    return Scan(xyz, np.full(len(xyz), 0.3, np.float32))


@pytest.mark.parametrize("name", ["hdl-64e-kitti", "hdl-32e", "vlp-16", "vlp-32c", "os1-64", "os1-128", "pandar64"])
def test_a_turn_at_its_usual_rate_has_the_images_that_it_had_and_others_their_own(name: str):
    sensor = SENSORS[name]
    usual = full_turn(sensor)
    assert own_columns(turn(sensor, usual), sensor) is sensor
    for rate in (5, 20):
        width = round(usual * 10 / rate)
        scan = turn(sensor, width)
        found = columns_of_turn(scan, sensor)
        assert found is not None and abs(found - width) <= 1, rate
        expected = 2 * sensor.width if rate == 5 else min(sensor.width, width)
        assert abs(own_columns(scan, sensor).width - expected) <= 1, rate


def test_fewer_columns_leave_none_empty_and_lose_no_point():
    scan, sensor = turn(SENSORS["os1-64"], 512, jitter=0.02, keep=1.0), SENSORS["os1-64"]
    own = own_columns(scan, sensor)
    assert own == sensor.resized(width=512)
    assert project(scan, sensor).mask.any(axis=0).mean() < 0.6
    assert occupied(scan, own, pixel_of_points(scan, own)).sum() > 0.98 * len(scan)


def read_coarsely(firings: int, count: float, beams: int = 24, gone: float = 0.0) -> tuple[Scan, Sensor]:
    """A round room as a sensor fires into it whose azimuths are cut to whole counts of an encoder, and that sensor."""
    elevation = np.linspace(5, -20, beams)
    azimuth = np.floor(np.arange(firings) * 360 / firings / count) * count - 180 + count / 3
    ring, turn = np.repeat(np.arange(beams), firings), np.radians(np.tile(azimuth, beams))
    up = np.radians(elevation[ring])
    xyz = 10 * np.stack([np.cos(turn) * np.cos(up), np.sin(turn) * np.cos(up), np.sin(up)], 1)
    keep = np.random.default_rng(3).random(len(xyz)) >= gone
    scan = Scan(xyz.astype(np.float32), np.full(len(xyz), 0.5, np.float32), ring=ring)[keep]
    return scan, Sensor("nobodys", tuple(elevation.tolist()), firings)


@pytest.mark.parametrize("gone", [0.0, 0.1])
def test_azimuths_that_are_read_coarsely_tell_how_often_a_sensor_fires(gone: float):
    scan, _ = read_coarsely(2149, 0.09, gone=gone)
    assert scan.ring is not None
    assert 2 * np.pi / azimuth_step(scan.xyz, scan.ring) == pytest.approx(2149, abs=8)


def test_each_firing_of_a_sensor_of_ones_own_has_a_column_though_azimuths_are_read_coarsely():
    scan, sensor = read_coarsely(2149, 0.09)
    known = replace(sensor, name="hdl-64e")  # whose images stay as published
    assert project(scan, known).mask.mean() < 0.95
    row, column = pixel_of_points(scan, sensor)
    assert project(scan, sensor).mask.mean() > 0.99
    own = (1 - np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0]) / np.pi) / 2 * sensor.width
    assert np.abs(column + 0.5 - own).max() < 2
    np.testing.assert_array_equal(row, scan.ring)


@pytest.mark.parametrize("columns", [1024, 2140])
def test_more_firings_than_columns_push_none_around_the_turn(columns: int):
    scan, sensor = read_coarsely(2149, 0.001)
    column = pixel_of_points(scan, replace(sensor, width=columns))[1]
    np.testing.assert_array_equal(column, pixel_of_points(scan, replace(sensor, width=columns, name="hdl-64e"))[1])


@pytest.mark.parametrize(("firings", "returns"), [(2149, 1), (2170, 1), (2170, 2)])
def test_of_somewhat_more_firings_than_columns_as_of_a_car_that_turns_few_share_one(firings: int, returns: int):
    scan, sensor = read_coarsely(firings, 0.09)
    scan, sensor = scan[np.repeat(np.arange(len(scan)), returns)], replace(sensor, width=2149)
    row, column = pixel_of_points(scan, sensor)
    even = pixel_of_points(scan, replace(sensor, name="hdl-64e"))[1]
    assert set(column - even) == {0, 1}
    assert len(np.unique(row * 2149 + column)) > 0.98 * len(scan) / returns > len(np.unique(row * 2149 + even))


def test_a_scan_and_what_was_filled_in_are_drawn_as_the_image_that_was_filled_in():
    scan, sensor = read_coarsely(2170, 0.09, gone=0.05)
    image = project(scan, replace(sensor, width=2149))
    new = ~image.mask & (np.random.default_rng(4).random(image.shape) < 0.7)
    filled = replace(image, range=np.where(new, np.float32(10), 0), mask=new, xyz=None).to_scan()
    assert new.sum() > 1000
    assert scan.ring is not None and filled.ring is not None
    ring = np.concatenate([scan.ring, filled.ring])
    both = Scan(np.concatenate([scan.xyz, filled.xyz]), np.full(len(ring), 0.5, np.float32), ring=ring)
    np.testing.assert_array_equal(project(both, image.sensor).mask, image.mask | new)


def test_points_that_tell_no_columns_leave_the_table_as_it_is():
    sensor, rng = SENSORS["os1-64"], np.random.default_rng(1)
    scan = turn(sensor, 2048)
    assert own_columns(scan, sensor).width == 2048
    for share in (0.5, 0.2, 0.05):
        assert own_columns(scan[rng.random(len(scan)) < share], sensor) is sensor, share
    assert own_columns(turn(sensor, 1024, jitter=1.0), sensor) is sensor
    assert own_columns(turn(sensor, 128), sensor) is sensor, "so fast does none turn"
    assert own_columns(scan[:0], sensor) is sensor and own_columns(scan[:500], sensor) is sensor
    grid = SENSORS["hdl-64e"]
    assert own_columns(turn(SENSORS["hdl-64e-kitti"], 4166), grid) is grid, "R2DM's"


def test_two_returns_of_a_firing_are_no_more_columns():
    sensor = SENSORS["vlp-16"]
    scan = turn(sensor, 1800, jitter=0.02)
    again = scan[np.arange(len(scan)) % 3 == 0]
    both = Scan(np.concatenate([scan.xyz, again.xyz * np.float32(1.1)]), np.zeros(len(scan) + len(again), np.float32))
    assert own_columns(both, sensor) is sensor


def test_rings_of_any_numbers_tell_columns():
    sensor = SENSORS["vlp-16"]
    scan = turn(sensor, 900)
    ring = pixel_of_points(scan, sensor, "spherical")[0]
    for numbers in (ring, 15 - ring, ring + 1, ring - 5, ring * 5000):
        told = Scan(scan.xyz, scan.reflectance, ring=numbers)
        assert own_columns(told, sensor).width == 900
    assert 2 * np.pi / azimuth_step(scan.xyz, ring) == pytest.approx(900, rel=0.03)


def test_names_of_full_turns_are_those_of_sensors():
    assert FULL_TURNS.keys() <= SENSORS.keys()
    assert all(SENSORS[name].width < count for name, count in FULL_TURNS.items())
    assert full_turn(get_sensor("vlp-32c-inverted")) == FULL_TURNS["vlp-32c"]


def test_a_model_takes_the_columns_of_the_scan_and_those_that_are_asked_for_where_a_sensor_is_named():
    model = ls.load("nearest")
    scan = turn(SENSORS["vlp-16"], 900)
    assert model.complete(scan).sensor.width == 900
    assert model.into("vlp-16").complete(scan).sensor.width == 1024
    assert model.complete(turn(SENSORS["vlp-16"], 1800)).sensor.width == 1024
    slow = turn(SENSORS["vlp-16"], 3600)
    assert model.complete(slow).sensor.width == 2048
    assert sensor_that_made(slow, None).width == 2048, "of which upsample makes more beams"
    assert isinstance(model, AnySensorModel)
    assert model.labelling(scan).sensor.width == 900
    assert model.labelling(slow).sensor.width == 1024, "more tell no more of classes"
    assert model.into(SENSORS["vlp-16"].resized(width=2048)).labelling(slow).sensor.width == 2048, "as it was asked for"


def test_a_named_sensor_of_too_many_columns_is_warned_of():
    few = turn(SENSORS["os1-64"], 512)
    assert "expected 1024 columns, as os1-64 has, found 512" in (caution(few, SENSORS["os1-64"]) or "")
    assert "columns" not in (caution(few) or "")
    assert "columns" not in (caution(turn(SENSORS["os1-64"], 1024), SENSORS["os1-64"]) or "")
    assert "columns" not in (caution(turn(SENSORS["os1-64"], 2048), SENSORS["os1-64"]) or ""), "nothing is put between"


def test_the_verbs_say_it_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture):
    path = tmp_path / "own.pcd"
    write(path, turn(SENSORS["os1-64"], 512, jitter=0.02))
    said = "os1-64 in 512 columns, by the scan's own steps; where it is named, in 1024"
    for words in (["info"], ["project", "--out", tmp_path / "a.npz"],
                  ["complete", "--model", "nearest", "--out", tmp_path / "a.ply"]):  # fmt: skip
        main([words[0], str(path), *map(str, words[1:])])
        assert capsys.readouterr().out.count(said) == 1, words
    main(["project", str(path), "--width", "1024", "--out", str(tmp_path / "a.npz")])
    assert "columns" not in capsys.readouterr().out


def test_real_scans_of_usual_rates_keep_their_images(shared: Path):
    paths = sorted((shared / "scans" / "test").glob("*.bin"))
    assert len(paths) > 3
    for path in paths:
        assert own_columns(read(path), SENSORS["hdl-64e-kitti"]) is SENSORS["hdl-64e-kitti"], path.name
    others = {
        "fast_gicp_251370668.pcd": "hdl-32e",
        "nuscenes_hdl32e.pcd.bin": "hdl-32e",
        "pandaset_pandar64_0001.pcd": "pandar64",
        "sensorscalibration_top.pcd": "pandar64",
    }
    for name, sensor in others.items():
        assert own_columns(read(shared / "scans" / "other" / name), SENSORS[sensor]) is SENSORS[sensor], name


def test_every_second_firing_of_a_real_scan_is_a_turn_of_half_as_many_columns(shared: Path):
    scan, sensor = read(shared / "scans" / "other" / "sensorscalibration_top.pcd"), SENSORS["pandar64"]
    column = project(scan, sensor).sensor.width - 1 - pixel_of_points(scan, sensor)[1]
    assert own_columns(scan[column % 2 == 0], sensor).width == 900
