"""A scan that was moved, tilted or written in other axes is found out; nobody's correct scan is."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidarsynth.files.formats import read
from lidarsynth.lidar.cones import fit_cones, fit_ring
from lidarsynth.lidar.crowding import stand_of_beams
from lidarsynth.lidar.frame import AXES, check_frame, parse_transform, pose_of, transformed, turns_left
from lidarsynth.lidar.ground import plane, road_axis
from lidarsynth.lidar.motion import straighten
from lidarsynth.lidar.recognition import elevations_of, recognise, rings_in_order
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import INVERTED, SENSORS, WORDS, Sensor, get_sensor
from lidarsynth.lidar.view import misfit
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.verbs.placement import read_transform

MOVES = {
    "raised": ("0:0:1.73:0:0:0", "m above the origin"),
    "tilted": ("0:0:0:0:5:0", "tilted by 5."),
    "both": ("0:0:1.73:4:0:0", "tilted by 4."),
    "upside down": ("0:0:0:180:0:0", "upside down"),
}


def street(name: str, rings: bool = True) -> Scan:
    """A road between walls that are not straight, as a sensor sees it without noise."""
    sensor = get_sensor(name).resized(width=512)
    rays = sensor.directions()
    rng = np.random.default_rng(0)
    wall = np.repeat(rng.uniform(5, 25, 64), 8)[None] / np.maximum(np.hypot(rays[..., 0], rays[..., 1]), 1e-6)
    with np.errstate(divide="ignore"):
        distance = np.minimum(np.where(rays[..., 2] < 0, -1.7 / rays[..., 2], np.inf), wall)
    mask = (distance < 60) & (distance > 2) & (rng.random(distance.shape) < 0.9)
    ring = np.broadcast_to(np.arange(sensor.height)[:, None], mask.shape)
    xyz = sensor.points(distance.astype(np.float32))
    return Scan(xyz[mask], ring=ring[mask] if rings else None)


def moved(scan: Scan, matrix: np.ndarray) -> Scan:
    return Scan(transformed(scan.xyz, matrix), scan.reflectance, ring=scan.ring)


@pytest.mark.parametrize("name", ["hdl-64e-kitti", "hdl-32e", "pandar64", "vlp-16"])
def test_a_scan_in_its_frame_has_no_fault(name: str):
    assert check_frame(street(name)).warning() is None
    assert check_frame(street(name, rings=False)).warning() is None


@pytest.mark.parametrize("name", ["hdl-64e-kitti", "pandar64"])
@pytest.mark.parametrize("move", MOVES)
def test_a_moved_scan_is_found_out_and_its_transform_undoes_it(name: str, move: str):
    matrix, (pose, words) = parse_transform(MOVES[move][0]), MOVES[move]
    assert pose_of(matrix) == pytest.approx([float(word) for word in pose.split(":")], abs=1e-5)
    frame = check_frame(moved(street(name), matrix))
    assert words in str(frame.warning())
    left = frame.transform @ matrix
    assert np.degrees(np.arccos(np.clip(left[2, 2], -1, 1))) < 0.4
    assert abs(left[2, 3]) < 0.25
    assert check_frame(moved(street(name), left)).warning() is None


@pytest.mark.parametrize("name", ["hdl-64e-kitti", "hdl-32e"])
def test_height_and_tilt_show_without_rings_and_in_any_order(name: str):
    scan = street(name, rings=False)
    scan = scan[np.random.default_rng(1).permutation(len(scan))]
    assert check_frame(scan).warning() is None
    for lift in (1.73, -1.0):
        frame = check_frame(moved(scan, parse_transform(f"0:0:{lift}:0:0:0")))
        assert frame.faults and frame.transform[2, 3] == pytest.approx(-lift, abs=0.25)
    tilt = parse_transform("0:0:0:-4:5:0")
    frame = check_frame(moved(scan, tilt))
    assert "tilted by 6.4 degrees" in str(frame.warning())
    np.testing.assert_allclose((frame.transform @ tilt)[:3, 2], [0, 0, 1], atol=2e-3)
    both = parse_transform("0:0:1.73:-4:5:0")
    frame = check_frame(moved(scan, both))
    assert len(frame.faults) == 2, "height and tilt at once"
    np.testing.assert_allclose((frame.transform @ both)[:3, 2], [0, 0, 1], atol=5e-3)
    assert (frame.transform @ both)[2, 3] == pytest.approx(0, abs=0.25)


def test_beams_that_look_alike_either_way_up_are_told_by_their_times():
    """An OS1 in a room: as much above as below, and mirrored beams; it turns clockwise, seen from above."""
    sensor = SENSORS["os1-64"].resized(width=256)
    rays = sensor.directions()
    near = np.random.default_rng(0).uniform(1.5, 3, 16).repeat(16) / np.hypot(rays[..., 0], rays[..., 1])
    rows, columns = (index.reshape(-1) for index in np.indices(near.shape))
    scan = Scan(sensor.points(near.astype(np.float32)).reshape(-1, 3), ring=rows, time=columns / 2560)
    assert check_frame(scan).warning() is None
    over = Scan(scan.xyz * np.float32([1, -1, -1]), ring=rows, time=scan.time)
    assert check_frame(over).faults == ("upside down",)
    np.testing.assert_allclose(check_frame(over).transform, np.diag([1, -1, -1, 1]), atol=1e-6)
    assert not turns_left(over.xyz, None) and not turns_left(over.xyz, np.random.default_rng(0).random(len(over)))


@pytest.mark.parametrize("name", INVERTED)
def test_a_sensor_that_hangs_upside_down_has_no_fault_in_a_frame_whose_z_is_up(name: str):
    scan = street(name)
    assert check_frame(scan).warning() is None
    shifted = check_frame(moved(scan, parse_transform("1.4:0:1.5:0:0:0")))
    np.testing.assert_allclose(shifted.transform[:3, :3], np.eye(3))
    assert shifted.faults == ("with the sensor 1.40 m ahead of and 1.50 m above the origin",)


@pytest.mark.parametrize("name", INVERTED)
def test_of_beams_that_hang_at_times_the_ground_tells_the_side(name: str):
    """Streets in which so little ground is seen that the beams used to decide, which are those of an upright sensor."""
    hanging, upright = (SyntheticStreets(4711, 64, get_sensor(n)) for n in (name, name.removesuffix("-inverted")))
    for k in range(0, 64, 16):
        assert check_frame(hanging.image(k).to_scan()).faults == ()
        over = moved(upright.image(k).to_scan(), parse_transform("0:0:0:180:0:0"))
        assert check_frame(over).faults == ("upside down",)


@pytest.mark.parametrize("name", INVERTED)
def test_a_sensor_that_hangs_upside_down_is_hinted_at_in_its_own_frame(name: str):
    over = moved(street(name), parse_transform("0:0:0:180:0:0"))
    frame = check_frame(over)
    assert frame.faults == () and "hangs upside down" in str(frame.warning())
    assert check_frame(moved(over, frame.transform)).warning() is None


def test_points_that_a_named_sensor_could_not_see():
    scan = street("hdl-32e", rings=False)
    assert misfit(scan.xyz, SENSORS["hdl-32e"]) is None
    assert "outside its view of -15.0" in str(misfit(scan.xyz, SENSORS["vlp-16"]))
    raised = transformed(scan.xyz, parse_transform("0:0:1.73:0:0:0"))
    assert "outside its view of -30.7 to +10.7" in str(misfit(raised, SENSORS["hdl-32e"]))
    level = scan.xyz[np.abs(scan.xyz[:, 2]) < 0.1 * np.hypot(scan.xyz[:, 0], scan.xyz[:, 1])]
    assert "lowest beams of 32" in str(misfit(level, SENSORS["hdl-32e"]))
    ring = np.argsort(np.argsort(-elevations_of(scan.xyz))) * 32 // len(scan)
    assert misfit(scan.xyz, SENSORS["hdl-32e"], ring) is None
    ring[:4] = 40  # a few wrong numbers are no other sensor
    assert misfit(scan.xyz, SENSORS["hdl-32e"], ring) is None
    two = np.concatenate([scan.xyz, scan.xyz]), np.concatenate([ring, ring + 64])
    assert "on 64 rings, more than its 32 beams" in str(misfit(two[0], SENSORS["hdl-32e"], two[1]))


def test_rings_between_the_beams_are_no_named_sensors():
    """Of a sensor of fewer beams: in the view of the named one, whose rows they filled without a word."""
    other = Sensor("other", tuple(np.linspace(14, -13, 8).tolist()), 512)
    scan = cylinder(other)
    assert misfit(scan.xyz, other, scan.ring) is None
    assert misfit(scan.xyz, SENSORS["vlp-16"], scan.ring) == "them on 8 rings that are not on its 16 beams"
    own = cylinder(SENSORS["vlp-16"])
    second = own[np.asarray(own.ring) % 2 == 1]
    for ring in (np.asarray(second.ring), np.asarray(second.ring) // 2):
        assert misfit(second.xyz, SENSORS["vlp-16"], ring) is None, "every second beam, numbered as it was, and anew"


@pytest.mark.parametrize("named", ["os1-64", "pandar64"])
def test_as_many_rings_that_are_off_the_beams_are_no_named_sensors(named: str):
    """In the view of the named one, whose rows they filled without a word, numbered or in the file's order."""
    other = Sensor("other", tuple(np.linspace(14, -15, 64).tolist()), 512)
    scan = cylinder(other)
    assert misfit(scan.xyz, other, scan.ring) is None
    for ring in (scan.ring, None):
        assert "on 64 rings, half of which are" in str(misfit(scan.xyz, SENSORS[named], ring))


def test_a_unit_that_is_a_little_off_its_table_or_its_origin_is_no_other_sensor():
    """As a real OS1-64 in its packets' frame, 0.2 degrees off, whose lowest rings were empty and called another's."""
    table = SENSORS["os1-64"]
    unit = replace(table, elevations=tuple((np.array(table.elevations) + 0.2).tolist()))
    scan = cylinder(unit)
    few = np.asarray(scan.ring) < 61
    assert misfit(scan.xyz[few], table, np.asarray(scan.ring)[few]) is None
    near = replace(cylinder(table), xyz=0.2 * cylinder(table).xyz + np.float32([0, 0, 0.04]))  # walls at 4 m
    assert misfit(near.xyz, table, near.ring) is None
    for grid in ("hdl-64e", "hdl-64e-r2dm", "hdl-64e-lidargen"):
        turn = street("hdl-64e-kitti", rings=False).xyz
        assert misfit(turn, WORDS[grid], rings_in_order(turn)) is None


def cylinder(sensor: Sensor) -> Scan:
    """A scan of walls 20 m away all around."""
    distance = np.full((sensor.height, sensor.width), 20, np.float32)
    return RangeImage(distance, 0 * distance, distance > 0, sensor).to_scan()


def test_points_on_no_beams_are_no_named_sensors():
    """Of a map, and of a sensor that does not spin, in whose view they may lie."""
    scan = street("hdl-32e", rings=False)
    rng = np.random.default_rng(0)
    away = rng.uniform(-0.5, 0.5, len(scan)) * 4 / 3  # degrees, the beams' spacing
    rho = np.hypot(scan.xyz[:, 0], scan.xyz[:, 1])
    between = scan.xyz.copy()
    between[:, 2] = rho * np.tan(np.radians(elevations_of(scan.xyz) + away))
    between = between[rng.permutation(len(between))]
    assert "between its beams as often as on them" in str(misfit(between, SENSORS["hdl-32e"]))
    line = np.arange(len(between)) % 6
    assert "look everywhere" in str(misfit(between, SENSORS["hdl-32e"], line))
    shuffled = scan.xyz[rng.permutation(len(scan))]
    assert misfit(shuffled, SENSORS["hdl-32e"]) is None


def test_the_transform_that_is_offered_has_no_digits_of_noise():
    frame = check_frame(moved(street("hdl-32e"), parse_transform("1.2:0.1:1.9:0:3:0")))
    way = str(frame.warning()).partition("--transform ")[2]
    assert "e" not in way and len(way) <= len("-1.200:-0.100:-1.900:0:-3.000:0") and "-3" in way
    turn = street("hdl-64e-kitti", rings=False).xyz  # one ring after the other, which nobody has numbered
    assert "rings, more than its 32 beams" in str(misfit(turn, SENSORS["hdl-32e"]))
    some = [beam for beam in range(64) if beam % 16 != 8]
    assert misfit(turn, SENSORS["hdl-64e-kitti"].rows(some)) is None, "more rings counted than there are"


@pytest.mark.parametrize("other", ["os1-128", "pandar64"])
def test_a_sensor_of_as_many_beams_or_more_that_lie_elsewhere_is_another_one(other: str):
    turn = street("hdl-64e-kitti", rings=False).xyz
    assert misfit(turn, SENSORS[other]) == "them on the beams of hdl-64e-kitti"
    for same in ("hdl-64e-kitti", "hdl-64e"):
        assert misfit(turn, SENSORS[same]) is None
    table = SENSORS["hdl-64e-kitti"]
    own = replace(table, name="mine", elevations=tuple((np.array(table.elevations) + 0.2).tolist()))
    assert misfit(turn, own) is None, "a unit's beams are a little off the table's"


def rosette(wide: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Azimuths and elevations, in degrees, of 24,000 rays of a sensor that does not spin and looks ahead."""
    turn = np.linspace(0, 80 * np.pi, 24_000)
    flower = np.cos(3.63 * turn)
    return wide * flower * np.cos(1.01 * turn), high * flower * np.sin(1.01 * turn) - 4


@pytest.mark.parametrize("seed", [3, 5])
def test_flat_ground_is_no_beams_seen_from_near_its_level(seed: int):
    azimuth, elevation = rosette(60, 12.5)
    walls = np.repeat(np.random.default_rng(seed).uniform(5, 25, 64), 8)[((azimuth / 180 + 1) * 256).astype(int) % 512]
    (a, b), (c, d) = ((np.cos(angle), np.sin(angle)) for angle in np.radians([azimuth, elevation]))
    rays = np.stack([c * a, c * b, d], 1)
    distance = np.minimum(walls / c, np.where(d < 0, -1.9 / np.minimum(d, -1e-9), np.inf))
    assert check_frame(Scan((rays * distance[:, None])[distance < 60].astype(np.float32))).faults == ()


@pytest.mark.parametrize("seed", [3, 11])
def test_what_looks_ahead_and_does_not_spin_is_not_taken_for_turned(seed: int):
    dense = Sensor("dense", tuple(np.linspace(14, -26, 300).tolist()), width=2048, max_range=150.0)
    azimuth, elevation = rosette(35, 35)
    inside = (elevation < 14) & (elevation > -26)
    row, column = ((14 - elevation) / 40 * 299).round().astype(int), ((1 - azimuth / 180) * 1024).astype(int) % 2048
    image = SyntheticStreets(seed, 1, dense).image(0)
    order = row[inside], column[inside]
    assert check_frame(Scan(dense.points(image.range)[order][image.mask[order]])).faults == ()


def test_points_on_no_beams_have_no_stand():
    assert stand_of_beams(np.random.default_rng(0).normal(0, 10, (9000, 3))) is None


@pytest.mark.parametrize("name", ["hdl-64e-kitti", "hdl-64e"])
@pytest.mark.parametrize("pose", ["0:0:0:180:10:0", "0:0:0:175:12:0"])
def test_a_tilted_sensor_that_hangs_is_upside_down_too(name: str, pose: str):
    """The side was judged as the points came: on the tilted ground, by beams that are none of a known sensor's then."""
    streets = SyntheticStreets(4711, 64, get_sensor(name))
    for k in range(0, 64, 16):
        frame = check_frame(moved(streets.image(k).to_scan(), parse_transform(pose)))
        assert frame.faults[0] == "upside down" and "tilted by" in frame.faults[1]
        np.testing.assert_allclose((frame.transform @ parse_transform(pose))[:3, 2], [0, 0, 1], atol=0.01)


def test_a_scan_whose_ground_is_at_zero_is_not_upside_down():
    frame = check_frame(moved(street("hdl-64e-kitti"), parse_transform("0:0:1.9:0:0:0")))
    assert frame.faults == ("with the sensor 1.90 m above the origin",)


@pytest.mark.parametrize("axis", [axis for axis in AXES if axis not in ("+z", "-z")])
def test_other_axes_are_named(axis: str):
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(AXES[axis][0]).T  # ours -> the file's
    frame = check_frame(moved(street("hdl-64e-kitti"), matrix))
    assert AXES[axis][1] in str(frame.warning())
    np.testing.assert_allclose((frame.transform @ matrix)[:3, :3], np.eye(3), atol=1e-2)


def test_a_turn_by_90_degrees_is_only_a_hint():
    rng = np.random.default_rng(0)
    ground = np.stack([rng.uniform(-40, 40, 20000), rng.uniform(-5, 5, 20000), np.full(20000, -1.7)], axis=1)
    assert road_axis(ground) > 0.3 and road_axis(ground[:, [1, 0, 2]]) < -0.3
    frame = check_frame(Scan(ground[:, [1, 0, 2]].astype(np.float32)))
    assert frame.faults == () and "as if turned by 90 degrees" in str(frame.warning())


@pytest.mark.parametrize("view", [(30, 150), (-150, -30), (-135, 135)])
def test_what_looks_to_a_side_of_the_road_is_not_taken_for_turned(view: tuple[int, int]):
    streets = SyntheticStreets(0, 128, SENSORS["os1-64"])
    for number in range(0, 128, 16):
        scan = streets[number]
        azimuth = np.degrees(np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0]))
        assert check_frame(scan[(azimuth > view[0]) & (azimuth < view[1])]).hints == ()


def test_cones_have_their_axis_height_and_elevations():
    sensor = SENSORS["pandar64"]
    scan = street(sensor.name)
    assert scan.ring is not None
    matrix = parse_transform("0:0:0.5:1:2:0")
    cones = fit_cones(transformed(scan.xyz, matrix), scan.ring)
    np.testing.assert_allclose(cones.axis, matrix[:3, 2], atol=2e-3)
    np.testing.assert_allclose(cones.origin, [0, 0, 0.5], atol=0.06)
    assert cones.origin[2] == pytest.approx(0.5, abs=0.01)
    assert cones.residual < 0.1 < cones.upright
    for row in (20, 60):
        ring = fit_ring(scan.xyz[scan.ring == row])
        assert ring.elevation == pytest.approx(sensor.elevations[row], abs=1e-3)
        assert ring.height == pytest.approx(0, abs=1e-3)


def test_the_ground_has_its_height_and_tilt():
    around = np.random.default_rng(0).uniform(-20, 20, (5000, 2))
    ground = np.column_stack([around, np.full(len(around), -1.7)]).astype(np.float32)
    tilted = transformed(ground, parse_transform("0:0:0:2:-3:0"))  # the nose goes up: pitch about y is negative
    height, pitch, roll = plane(tilted) or (0, 0, 0)
    assert height == pytest.approx(1.7, abs=0.02)
    # What rose in the points is the ground ahead, so the sensor looks down: opposite signs.
    assert (pitch, roll) == (pytest.approx(-3, abs=0.1), pytest.approx(-2, abs=0.1))


def test_a_motion_is_taken_out_of_the_rings():
    scan = street("hdl-32e")
    assert scan.ring is not None
    tau = np.mod(np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0]) / (2 * np.pi), 1) - 0.5
    bent = (scan.xyz + tau[:, None] * [0.8, 0.2, 0]).astype(np.float32)
    straight = straighten(bent, scan.ring)
    off, before = (np.abs(xyz - scan.xyz).max(axis=1) for xyz in (straight, bent))
    assert np.quantile(off, 0.99) < 0.02 < 0.3 < np.quantile(before, 0.99), "all but points on the turn's seam"
    np.testing.assert_array_equal(straighten(scan.xyz, scan.ring), scan.xyz)


def test_transforms_from_files(tmp_path: Path):
    matrix = parse_transform("1:2:3:10:20:30")
    np.savetxt(tmp_path / "t.txt", matrix[:3])
    np.testing.assert_allclose(read_transform(str(tmp_path / "t.txt")), matrix)
    np.testing.assert_allclose(read_transform("1:2:3:10:20:30", mount=0.5), parse_transform("1:2:2.5:10:20:30"))
    assert read_transform(None) is None
    np.savetxt(tmp_path / "t.txt", 2 * matrix)
    with pytest.raises(ValueError, match="stretches or mirrors"):
        read_transform(str(tmp_path / "t.txt"))
    with pytest.raises(ValueError, match="found '1:2'"):
        read_transform("1:2")


@pytest.mark.parametrize("number", ["nan", "inf", "-inf", "1e+30"])
def test_shifts_and_turns_are_finite(number: str, tmp_path: Path):
    matrix = np.eye(4)
    matrix[1, 3] = float(number)
    np.savetxt(tmp_path / "t.txt", matrix)
    with pytest.raises(ValueError, match="expected --mount of finite metres, at most .*, found " + re.escape(number)):
        read_transform(None, mount=float(number))
    for text in (f"{number}:0:0:0:0:0", str(tmp_path / "t.txt")):
        with pytest.raises(ValueError, match="expected .*transform .*of finite .*, found '?" + re.escape(text)):
            read_transform(text)
    if "e" not in number:
        with pytest.raises(ValueError, match=f"of finite numbers, found '0:0:0:0:0:{number}'"):
            parse_transform(f"0:0:0:0:0:{number}")
    assert read_transform("1e9:0:0:0:0:0", mount=-1e9) is not None


@pytest.mark.parametrize("name", ["test/kitti360_000000.bin", "test/odometry_000964.bin", "test/odometry08_000000.bin",
                                  "other/nuscenes_hdl32e.pcd.bin", "other/pandaset_pandar64_0001.pcd",
                                  "other/sensorscalibration_top.pcd", "other/fast_gicp_251370668.pcd",
                                  "semantic/seq00_0.npz"])  # fmt: skip
def test_no_correct_real_scan_is_refused(name: str, shared: Path):
    frame = check_frame(read(shared / "scans" / name))
    assert frame.faults == (), frame.warning()


@pytest.mark.parametrize("move", MOVES)
def test_a_moved_real_scan_is_found_out(move: str, shared: Path):
    scan = read(shared / "scans" / "test" / "semantickitti_x.bin")
    assert MOVES[move][1].split(".")[0] in str(check_frame(moved(scan, parse_transform(MOVES[move][0]))).warning())


def test_a_sweep_in_the_vehicles_frame_is_raised_and_ahead(shared: Path):
    pytest.importorskip("pyarrow", reason="pyarrow comes with the extra `data`")
    frame = check_frame(read(shared / "scans" / "other" / "argoverse2_2xvlp32c.feather"))
    assert re.search("1.3. m ahead of and 1.[56]. m above the origin", str(frame.warning()))
    np.testing.assert_allclose(frame.transform[:3, 3], [-1.35, 0, -1.56], atol=0.05)


def test_the_second_sensor_of_a_sweep_hangs_upside_down(shared: Path):
    pytest.importorskip("pyarrow", reason="pyarrow comes with the extra `data`")
    scan = read(shared / "scans" / "other" / "argoverse2_2xvlp32c.feather", rings=(32, 63))
    frame = check_frame(scan)
    assert re.search("1.3. m ahead of and 1.5. m above the origin", str(frame.warning()))
    assert recognise(moved(scan, frame.transform))[0] == "vlp-32c-inverted"
