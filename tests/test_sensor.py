"""Sensors: their rays, their own files, and one clear line for each thing that can be wrong in such a file."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidarsynth.lidar.sensor import INVERTED, SENSORS, Sensor, UnlikelySensorWarning, from_dict, get_sensor, read_sensor


def test_the_grid_of_r2dm_equals_the_reference(fixture_tensors):
    coords, utility = fixture_tensors("r2dm/coords"), fixture_tensors("r2dm/lidar_utility")
    tight = {"rtol": 0, "atol": 1e-6}
    grid = get_sensor("hdl-64e").resized(16, 64)
    torch.testing.assert_close(torch.from_numpy(grid.ray_angles())[None], coords["16x64.ray_angles"], **tight)
    torch.testing.assert_close(torch.from_numpy(grid.ray_angles())[None], utility["ray_angles"], **tight)
    odd = Sensor("odd", tuple(3 - 28 * i / 24 for i in range(24)), 32, edges=True)
    torch.testing.assert_close(torch.from_numpy(odd.ray_angles())[None], coords["24x32.ray_angles"], **tight)


def test_points_along_the_grid_equal_the_reference(fixture_tensors):
    expected = fixture_tensors("r2dm/lidar_utility")
    grid = get_sensor("hdl-64e").resized(16, 64)
    for metric, mask, xyz in zip(expected["metric"], expected["mask"], expected["xyz"], strict=True):
        points = grid.points((metric * mask)[0].numpy())
        np.testing.assert_allclose(points, xyz.permute(1, 2, 0).numpy(), rtol=0, atol=1e-5 * 80)


def test_hdl_64e_is_the_grid_of_kitti_360():
    sensor = get_sensor("hdl-64e")
    elevation, azimuth = np.degrees(sensor.ray_angles().astype(np.float64))
    np.testing.assert_allclose(elevation[:, 0], 3 - 28 * np.arange(64) / 64, atol=1e-5)
    np.testing.assert_allclose(azimuth[0], 180 - 360 * np.arange(1024) / 1024, atol=2e-5)
    assert (sensor.min_range, sensor.max_range) == (1.45, 80.0)


def test_real_beams_have_their_azimuth_in_the_middle_of_the_pixel():
    azimuth = np.degrees(get_sensor("vlp-16").ray_angles()[1, 0])
    np.testing.assert_allclose(azimuth, 180 - 360 * (np.arange(1024) + 0.5) / 1024, atol=2e-5)
    assert (np.diff(azimuth) < 0).all()


@pytest.mark.parametrize("name", SENSORS)
def test_every_sensor_points_along_its_angles(name):
    sensor = get_sensor(name)
    assert sensor.name == name and sensor.height == len(sensor.elevations)
    directions = sensor.directions()
    assert directions.shape == (sensor.height, sensor.width, 3) and directions.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-6)
    elevation, azimuth = sensor.ray_angles()
    np.testing.assert_allclose(np.arcsin(directions[..., 2]), elevation, atol=1e-5)
    turn = np.arctan2(directions[..., 1], directions[..., 0]) - azimuth
    np.testing.assert_allclose(np.abs(np.exp(1j * turn) - 1), 0, atol=1e-5)


@pytest.mark.parametrize("name", SENSORS)
def test_points_lie_at_the_asked_range_on_the_line_of_their_beam(name):
    sensor = get_sensor(name)
    rng = np.random.default_rng(0)
    distance = rng.uniform(2, sensor.max_range, (sensor.height, sensor.width)).astype(np.float32)
    distance[rng.random(distance.shape) < 0.1] = 0
    points = sensor.points(distance)
    np.testing.assert_allclose(np.linalg.norm(points, axis=-1), distance, rtol=2e-6, atol=1e-6)
    assert not points[distance == 0].any()
    assert points.dtype == np.float32
    height = np.asarray(sensor.offsets or [0.0] * sensor.height)[:, None]
    origin = np.stack(np.broadcast_arrays(0.0, 0.0, height), axis=-1)
    way = (points - origin)[distance > 0]
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    np.testing.assert_allclose(way, sensor.directions()[distance > 0], atol=1e-5)


def test_resized_sensors_keep_evenly_spaced_beams_of_their_own():
    sensor = get_sensor("hdl-64e-kitti")
    quarter = sensor.resized(16, 256)
    assert quarter.elevations == sensor.elevations[::4] and quarter.offsets == sensor.offsets[::4]
    assert (quarter.name, quarter.width, quarter.max_range) == ("hdl-64e-kitti/16", 256, 80.0)
    assert sensor.resized() == sensor
    assert sensor.resized(width=2048).elevations == sensor.elevations
    around = Sensor("mine", sensor.elevations, 1024, blocked=((63, 1000, 0), (62, 1023, 1), (61, 2, 2)))
    halved = around.resized(width=512)
    assert halved.blocked == ((63, 500, 511), (62, 511, 0))
    assert halved.blocked_rays().sum(1)[-3:].tolist() == [0, 2, 12]
    assert sensor.rows([5, 9]).elevations == (sensor.elevations[5], sensor.elevations[9])
    with pytest.raises(ValueError, match="sensor hdl-64e-kitti: height must divide its 64 beams, got 24"):
        sensor.resized(24)


@pytest.mark.parametrize("name", [name for name in SENSORS if not SENSORS[name].edges])
def test_a_sensor_that_hangs_upside_down_sees_its_own_rays_turned_over(name):
    sensor = replace(SENSORS[name], blocked=((2, 3, 5),), dimness=tuple(range(SENSORS[name].height)))
    over = sensor.inverted()
    metres = np.random.default_rng(0).uniform(5, 9, (sensor.height, sensor.width)).astype(np.float32)
    turned = sensor.points(metres)[::-1, ::-1] * np.float32([1, -1, -1])
    np.testing.assert_allclose(over.points(metres[::-1, ::-1]), turned, atol=2e-5)
    assert (over.blocked_rays() == sensor.blocked_rays()[::-1, ::-1]).all() and over.dimness == sensor.dimness[::-1]
    assert over.mount == sensor.mount and over.name == f"{name}-inverted"


def test_rows_between_edges_are_between_the_same_edges_turned_over():
    sensor = SENSORS["hdl-64e"]
    over = sensor.inverted().elevations
    assert over[-1] == pytest.approx(-sensor.elevations[1]) and over[0] == pytest.approx(25), "its last row ends there"


def test_words_of_sensors_that_hang_upside_down_are_known():
    for name, sensor in INVERTED.items():
        assert get_sensor(name) is sensor and sensor.elevations != get_sensor(name.removesuffix("-inverted")).elevations


@pytest.mark.parametrize("name", SENSORS)
def test_tables_and_sensors_are_inverses(name):
    sensor = get_sensor(name)
    assert from_dict(sensor.to_dict()) == sensor
    assert from_dict(json.loads(json.dumps(sensor.to_dict()))) == sensor


@pytest.mark.parametrize("name", ["hdl-64e-kitti", "hdl-32e", "vlp-16", "os1-128"])
def test_elevations_in_radians_are_warned_of(name, tmp_path):
    elevations = SENSORS[name].elevations
    assert Sensor("mine", elevations).elevations == elevations
    with pytest.warns(
        UnlikelySensorWarning, match=r"sensor mine: expected elevations in degrees, found .*: are they radians\?"
    ):
        Sensor("mine", tuple(np.radians(elevations)))
    path = tmp_path / "mine.toml"
    path.write_text(f"elevations = {np.radians(elevations).tolist()}\n")
    with pytest.warns(UserWarning, match="radians"):
        get_sensor(path)


def test_narrow_sensors_of_few_beams_and_parts_of_others_are_no_radians():
    for beams in ((0.3, 0.0, -0.3), tuple(np.linspace(1, -1, 16)), tuple(np.linspace(0.5, -0.5, 11))):
        assert Sensor("ahead", beams).height == len(beams)  # warnings are errors here
    for sensor in SENSORS.values():
        sensor.rows([row for row, beam in enumerate(sensor.elevations) if abs(beam) <= 1] or [0])


def test_the_command_line_says_so_too_where_a_sensor_is_made_of_another(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("beams = 32\ntop = 0.26\nbottom = -0.44\nmax_range = 100.0\n")
    words = [sys.executable, "-m", "lidarsynth", "streets", "-n", "1", "--sensor", path, "--out", tmp_path / "set"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0
    lines = [line.rsplit("\r", 1)[-1] for line in done.stderr.split("\n") if "radians" in line]
    assert len(lines) == 1 and lines[0].startswith("lidarsynth: sensor")
    assert "UserWarning" not in done.stderr and "dataclasses.py" not in done.stderr


def test_the_command_line_says_a_warning_as_its_own_line(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("beams = 32\ntop = 0.26\nbottom = -0.44\n")
    words = [sys.executable, "-m", "lidarsynth", "info", path]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0
    assert done.stderr.endswith("elevations in degrees, found 32 of 0.26 to -0.44: are they radians?\n")
    assert done.stderr.startswith("lidarsynth: sensor mine: expected") and done.stderr.count("\n") == 1


def test_files_of_the_user_make_sensors(tmp_path):
    (tmp_path / "mine.toml").write_text("beams = 16\ntop = 15\nbottom = -15\nwidth = 1800\nmax_range = 100\n")
    sensor = get_sensor(str(tmp_path / "mine.toml"))
    assert sensor.name == "mine" and sensor.width == 1800 and sensor.max_range == 100
    np.testing.assert_allclose(sensor.elevations, np.linspace(15, -15, 16))
    (tmp_path / "rising.json").write_text(
        json.dumps({"name": "up", "elevations": [-2, 0, 3], "offsets": [0.1, 0, 0.2]})
    )
    sensor = read_sensor(tmp_path / "rising.json")
    assert sensor.name == "up" and sensor.elevations == (3.0, 0.0, -2.0)
    assert sensor.offsets == (0.2, 0.0, 0.1), "each height stays with its beam"


def test_a_file_is_read_again_after_it_changed(tmp_path):
    path = tmp_path / "mine.toml"
    for beams in (16, 32):
        path.write_text(f"beams = {beams}\ntop = 15\nbottom = -15\n")
        assert get_sensor(str(path)).height == beams


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", r"expected elevations, or beams with top and bottom, found \[\]"),
        ("width = 100", r"expected elevations, or beams with top and bottom, found \['width'\]"),
        ("elevation = [1, 2]", r"expected the fields \['blocked', .*\] or .*, found \['elevation'\]"),
        ("beams = 4\ntop = 1", r"expected the fields .* found \['beams', 'top'\]"),
        ("beams = 0\ntop = 1\nbottom = 0", r"expected beams of 1 to 1024, found 0"),
        ("beams = 2.5\ntop = 1\nbottom = 0", r"expected beams of 1 to 1024, found 2.5"),
        (
            "elevations = [2, 1]\nbeams = 2\ntop = 1\nbottom = 0",
            "expected elevations, or beams with top and bottom, found elevations and beams, bottom, top",
        ),
        ("elevations = [2, 1]\nbeams = 4", "expected elevations, or beams with top and bottom, found .* and beams"),
        (
            "elevations = [1]\nmount = 'high'",
            "mine.toml: expected numbers in the sensor's fields, found 'high' as mount",
        ),
        ("beams = 2\ntop = 1\nbottom = 1", r"elevations must fall from top to bottom within \+-90 degrees"),
        ("beams = 2\ntop = 'a'\nbottom = 1", r"mine.toml: expected numbers in the sensor's fields, found"),
        ("elevations = ['a']", r"mine.toml: expected numbers in the sensor's fields, found"),
        ("elevations = 3", r"mine.toml: expected numbers in the sensor's fields, found"),
        ("elevations = []", r"sensor mine: elevations must fall .* got \[\]"),
        ("elevations = [1, 1]", r"elevations must fall .* got \[1.0, 1.0\]"),
        ("elevations = [91, 1]", r"elevations must fall .* got \[91.0, 1.0\]"),
        ("elevations = [nan, 1]", r"elevations must fall .* got \[nan, 1.0\]"),
        ("elevations = [1]\nwidth = 3", r"sensor mine: width must be at least 4 columns, got 3"),
        ("elevations = [1]\nwidth = 1024.5", r"mine.toml: expected a whole number of columns as width, found 1024.5"),
        ("elevations = [1]\nwidth = '9'", r"mine.toml: expected a whole number of columns as width, found '9'"),
        ("elevations = [1]\nmax_range = 'far'", r"mine.toml: expected numbers in the sensor's fields, found"),
        ("elevations = [1]\nmin_range = 5\nmax_range = 5", r"expected 0 <= min_range < max_range, got 5 and 5"),
        ("elevations = [1]\nmin_range = -1", r"expected 0 <= min_range < max_range, got -1 and 100.0"),
        ("elevations = [1]\nmax_range = nan", r"expected 0 <= min_range < max_range, got 1.0 and nan"),
        ("elevations = [2, 1]\noffsets = [1]", r"offsets must have one height per beam \(2\), got 1"),
        (
            "elevations = [1]\nmax_range = inf",
            r"expected finite metres, of a mount 0 or more, found inf as max_r",
        ),
        ("elevations = [1]\nmount = -3", r"expected finite metres, of a mount 0 or more, found -3 as mount"),
        ("elevations = [1", r"mine.toml: expected TOML, found"),
        ("elevations = '9531'", r"mine.toml: expected numbers in the sensor's fields, found '9531'"),
        ("elevations = [true, false]", r"mine.toml: expected numbers in the sensor's fields, found \[True, False\]"),
        ("beams = 4\ntop = 1\nbottom = '-9'", r"mine.toml: expected numbers in the sensor's fields, found \[1, '-9'\]"),
        ("beams = true\ntop = 1\nbottom = 0", r"expected beams of 1 to 1024, found True"),
        ("elevations = [1]\ntilt = '12'", r"mine.toml: expected numbers in the sensor's fields, found '12'"),
        ("elevations = [1]\ntilt = 5", r"expected .* found 5 as tilt, where a list belongs: \[pitch, roll\]"),
        ("elevations = [1]\noffsets = 2.5", r"mine.toml: expected .* found 2.5 as offsets, where a list belongs$"),
        ("beams = 4\ntop = 1\nbottom = [2]", r"mine.toml: expected .* found \[1, \[2\]\] as top and bottom$"),
        ("elevations = [1]\nmount = true", r"expected numbers in the sensor's fields, found True as mount"),
        ("elevations = [1]\nwidth = true", r"mine.toml: expected a whole number of columns as width, found True"),
        ("elevations = [1]\nedges = 'false'", r"mine.toml: expected true or false as edges, found 'false'"),
        ("elevations = [1]\nname = 3", r"mine.toml: expected a word as name, found 3"),
        ("elevations = [1]\nname = ' '", r"mine.toml: expected a word as name, found ' '"),
        ("elevations = [1]\nviews = [-60, 60]", r"expected the fields .*'view'.* found \['views'\]"),
        ("elevations = [1]\nview = [-60, true]", r"mine.toml: expected a view of two azimuths .* found \[-60, True\]"),
        ("elevations = [1]\nwidth = 0\nview = [-60, 60]", r"sensor mine: width must be at least 4 columns, got 0"),
    ],
)
def test_files_that_make_no_sensor_get_one_line(tmp_path, content, message):
    (tmp_path / "mine.toml").write_text(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_sensor(tmp_path / "mine.toml")
    assert "\n" not in str(caught.value)


def test_files_of_another_kind_get_one_line(tmp_path):
    (tmp_path / "list.json").write_text("[1, 2]")
    (tmp_path / "bad.json").write_text("{")
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "folder.toml").mkdir()
    for name, message in {
        "list.json": r"list.json: expected .*, found \[1, 2\]",
        "bad.json": "bad.json: expected JSON, found",
        "binary.json": "binary.json: expected text in UTF-8, found invalid start byte",
        "folder.toml": "folder.toml: expected a file, found a folder",
        "absent.toml": "absent.toml: expected a readable sensor file, found No such file",
        "sensor.yaml": "sensor.yaml: expected a .toml or .json sensor file, found .yaml",
        "sensor": "sensor: expected a .toml or .json sensor file, found no suffix",
    }.items():
        with pytest.raises(ValueError, match=message):
            read_sensor(tmp_path / name)


def test_all_words_are_listed():
    with pytest.raises(ValueError, match=r"hdl-64e, .*pandar64, .*vlp-32c-inverted, .*hdl-64e-dusty.* found 'vlp32'"):
        get_sensor("vlp32")


def test_unknown_words_list_the_known_ones():
    with pytest.raises(ValueError, match=r"expected a sensor of hdl-64e, hdl-64e-kitti, .*, found 'hdl64'"):
        get_sensor("hdl64")


def test_a_mount_that_is_no_number_gets_one_line():
    for wrong in ("high", None, [1.0]):
        with pytest.raises(ValueError, match=r"sensor mine: expected numbers, .* as mount") as refused:
            Sensor("mine", (1.0, 0.0), mount=wrong)  # type: ignore[arg-type]
        assert "\n" not in str(refused.value)


def test_one_number_for_a_list_is_told_from_python_too():
    with pytest.raises(ValueError, match=r"sensor mine: expected numbers.* 4.0 as offsets, where a list belongs$"):
        Sensor("mine", (1.0, 0.0), offsets=4.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"sensor mine: expected numbers.* 4.0 as tilt, .* belongs: \[pitch, roll\]$"):
        Sensor("mine", (1.0, 0.0), tilt=4.0)  # type: ignore[arg-type]
