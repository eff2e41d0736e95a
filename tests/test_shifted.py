"""Where the sensor stood in a scan's frame is found in all three directions, and the offered transform helps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_frame import moved, street

from lidarsynth.cli.main import main
from lidarsynth.files.formats import read, write
from lidarsynth.lidar.cones import fit_cones
from lidarsynth.lidar.frame import check_frame, parse_transform
from lidarsynth.lidar.recognition import recognise
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.verbs.description import describe
from lidarsynth.verbs.inputs import Reading

SHIFTS = ("1:0:0", "0:1:0", "-2:0.7:0", "1.35:0:1.6", "3:0:0")


def turned_back(scan: Scan, shift: str) -> tuple[np.ndarray, tuple[str, ...], str | None]:
    """(3,) metres by which the offered transform misses the shift, what is said, and the sensor that is seen then."""
    there = moved(scan, parse_transform(f"{shift}:0:0:0"))
    frame = check_frame(there)
    back = moved(there, frame.transform)
    np.testing.assert_allclose(frame.transform[:3, :3], np.eye(3))
    return (back.xyz - scan.xyz).mean(axis=0), frame.faults, recognise(back)[0]


@pytest.mark.parametrize("name", SENSORS)
def test_a_shift_is_found_and_undone_with_the_height_in_one_transform(name: str):
    scan = street(name)
    assert check_frame(scan).warning() is None
    for shift in SHIFTS:
        off, faults, sensor = turned_back(scan, shift)
        assert len(faults) == 1 and "the origin" in faults[0], shift
        assert np.abs(off).max() < 0.06, shift
        assert sensor == name, shift


def test_a_shift_is_said_by_its_directions():
    scan = street("hdl-32e")
    for shift, words in (("1:0:0", "1.00 m ahead of"), ("-1.2:0:0", "1.20 m behind"), ("0:1:0", "1.00 m left of"),
                         ("1:-2:-1.5", "1.00 m ahead of, 2.00 m right of and 1.50 m below")):  # fmt: skip
        assert turned_back(scan, shift)[1] == (f"with the sensor {words} the origin",)


@pytest.mark.parametrize("shift", ["1:0:0", "0:-1:0", "0:1.4:0", "1.35:0:1.6"])
def test_rings_told_by_the_order_of_points_show_a_shift_and_no_other_axis(shift: str):
    off, faults, sensor = turned_back(street("hdl-64e-kitti", rings=False), shift)
    assert len(faults) == 1 and "the origin" in faults[0]
    assert np.abs(off).max() < 0.06 and sensor == "hdl-64e-kitti"


def test_a_tilted_and_shifted_scan_comes_back():
    scan, matrix = street("pandar64"), parse_transform("1.35:-0.5:1.6:2:4:0")
    frame = check_frame(moved(scan, matrix))
    left = frame.transform @ matrix
    assert len(frame.faults) == 2
    np.testing.assert_allclose(left[:3, 2], [0, 0, 1], atol=2e-3)
    np.testing.assert_allclose(left[:3, 3], 0, atol=0.03)


@pytest.mark.parametrize("to", [-0.5, 0.0, 0.5])
def test_points_moved_to_one_instant_of_a_turn_are_not_shifted(to: float):
    """At 20 m/s the sensor is 1 m from where it was in the middle of a turn."""
    scan = street("hdl-32e")
    tau = np.mod(np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0]) / (2 * np.pi), 1) - 0.5
    bent = replace(scan, xyz=(scan.xyz + (tau - to)[:, None] * [2, 0.2, 0]).astype(np.float32))
    assert check_frame(bent).warning() is None
    off = check_frame(moved(bent, parse_transform("0:3:0:0:0:0"))).transform[:3, 3]
    assert off[1] == pytest.approx(-3, abs=0.3)


@pytest.mark.parametrize("lift", [0.3, -0.3, 0.45])
def test_a_small_lift_that_hides_the_sensor_is_said(lift: float):
    scan = street("hdl-64e-kitti")
    there = moved(scan, parse_transform(f"0:0:{lift}:0:0:0"))
    assert recognise(there)[0] is None
    off, faults, sensor = turned_back(scan, f"0:0:{lift}")
    assert faults == (f"with the sensor {abs(lift):.2f} m {'above' if lift > 0 else 'below'} the origin",)
    assert np.abs(off).max() < 0.03 and sensor == "hdl-64e-kitti"
    assert check_frame(there).lifted and not check_frame(moved(scan, parse_transform("1:0:1:0:0:0"))).lifted


def test_beams_of_nobody_a_little_off_are_left_as_they_are():
    sensor = replace(SENSORS["pandar64"], name="own", elevations=tuple(np.linspace(9, -31, 64)))
    rays = sensor.resized(width=512).directions()
    with np.errstate(divide="ignore"):
        distance = np.where(rays[..., 2] < 0, -1.7 / rays[..., 2], 20).clip(2, 50) + np.arange(512) % 7
    ring = np.repeat(np.arange(64), 512)
    scan = Scan((rays * distance[..., None]).reshape(-1, 3).astype(np.float32), ring=ring)
    assert recognise(scan)[0] is None
    assert check_frame(moved(scan, parse_transform("0:0:0.3:0:0:0"))).warning() is None


@pytest.mark.parametrize("name", ["hdl-64e", "hdl-32e"])
def test_far_off_cones_are_fitted_in_strides(name: str):
    """Whole Gauss-Newton steps from the frame's origin run off these scans' cones."""
    scan = street(name)
    assert scan.ring is not None
    cones = fit_cones((scan.xyz + np.array([1.35, 0, 2.5], np.float32)).astype(np.float32), scan.ring)
    np.testing.assert_allclose(cones.origin, [1.35, 0, 2.5], atol=0.01)


def test_few_far_points_among_many_near_ones_are_no_fault():
    """Of the points that are taken to tell a motion hardly any lie beyond the carrier's own."""
    scan = street("hdl-32e")
    assert scan.ring is not None
    near = np.random.default_rng(0).normal(0, 0.5, (200_000, 3)).astype(np.float32)
    far = moved(scan[::20], parse_transform("2:0:0:0:0:0"))
    both = Scan(np.concatenate([near, far.xyz]), ring=np.concatenate([np.arange(200_000) % 32, scan.ring[::20]]))
    assert "ahead of the origin" in str(check_frame(both).warning())


def test_info_tries_a_transform_and_rings_as_complete_takes_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    scan = street("hdl-32e")
    write(tmp_path / "ahead.ply", moved(scan, parse_transform("1:0:1.6:0:0:0")))
    asked = "info", str(tmp_path / "ahead.ply")
    main([*asked])
    assert "try --transform -1:" in capsys.readouterr().out
    for words in (("--transform=-1:0:-1.6:0:0:0",), ("--transform=-1:0:0:0:0:0", "--mount", "1.6")):
        main([*asked, *words])
        said = capsys.readouterr().out
        assert "sensor       hdl-32e" in said and "frame" not in said
    main([*asked, "--rings", "0-15"])
    assert scan.ring is not None
    assert f"points       {np.count_nonzero(scan.ring < 16)}\n" in capsys.readouterr().out
    left_handed = replace(scan, xyz=scan.xyz * np.array([1, -1, 1], np.float32))
    write(tmp_path / "carla.ply", left_handed)
    main(["info", str(tmp_path / "carla.ply"), "--axes", "fru"])
    assert "hdl-32e" in capsys.readouterr().out
    with pytest.raises(ValueError, match="vlp-16: expected a scan to move"):
        describe("vlp-16", Reading(rings=(0, 3)))
    (tmp_path / "own.json").write_text("{}")
    with pytest.raises(ValueError, match=r"own.json: expected a scan to move"):
        describe(str(tmp_path / "own.json"), Reading(transform=np.eye(4)))


@pytest.mark.parametrize("name", ["other/nuscenes_hdl32e.pcd.bin", "other/pandaset_pandar64_0001.pcd",
                                  "other/sensorscalibration_top.pcd", "test/semantickitti_x.bin"])  # fmt: skip
def test_a_shifted_real_scan_comes_back(name: str, shared: Path):
    scan = read(shared / "scans" / name)
    for shift in ("1.35:0:1.6", "2:0:0", "0:1:0"):
        off, faults, sensor = turned_back(scan, shift)
        assert faults and np.abs(off).max() < 0.3, "0.25 m of nuScenes' are its motion"
        assert sensor == recognise(scan)[0] is not None


def test_raised_points_of_kitti_are_recognised_by_the_offered_transform(shared: Path):
    scan = read(shared / "scans" / "test" / "semantickitti_x.bin")
    off, _, sensor = turned_back(scan, "0:0:1.73")
    assert np.abs(off).max() < 0.06 and sensor == "hdl-64e-kitti"
