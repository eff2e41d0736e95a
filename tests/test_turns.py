"""Scans of more than one turn are told, and what is learned from such, and from rings of few points or of guesses."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from test_recognise import turn

from lidarsynth.cli.main import main
from lidarsynth.files.formats import read, write
from lidarsynth.lidar.columns import azimuth_step
from lidarsynth.lidar.learning import learn_sensor
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import SENSORS, Sensor, get_sensor
from lidarsynth.lidar.turns import _in_order, several_turns
from lidarsynth.lidar.view import misfit_of
from lidarsynth.verbs.learned_sensor import doubts, sensor_toml

FAN = Sensor("fan", tuple(np.linspace(20, -20, 40)))  # nobody's


def joined(*scans: Scan) -> Scan:
    """The scans behind one another, with the rings and times that they have."""
    parts = [[getattr(scan, name) for scan in scans] for name in ("xyz", "reflectance", "ring", "time")]
    return Scan(*(None if part[0] is None else np.concatenate(part) for part in parts))  # type: ignore[arg-type]


def later(scan: Scan, metres: float = 0.5) -> Scan:
    """The scan a turn later: its sensor has gone on, and each distance is measured again."""
    again = np.random.default_rng(3).normal(1, 0.001, (len(scan), 1)) * scan.xyz
    return replace(scan, xyz=(again * (1 + metres / 100)).astype(np.float32))


def timed(scan: Scan, begin: float = 0.0) -> Scan:
    azimuth = np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0])
    return replace(scan, time=(begin + (np.pi - azimuth) / (2 * np.pi) * 0.1).astype(np.float64))


def by_columns(scan: Scan) -> Scan:
    return scan[np.argsort(-np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0]), kind="stable")]


def mixed(scan: Scan) -> Scan:
    return scan[np.random.default_rng(0).permutation(len(scan))]


@pytest.mark.parametrize("name", ["hdl-64e-kitti", "hdl-32e", "vlp-16"])
def test_two_turns_are_told(name: str):
    one, bare = turn(SENSORS[name]), turn(SENSORS[name], rings=False)
    columns, bare_columns = by_columns(one), by_columns(bare)
    two = [joined(scan, later(scan)) for scan in (one, bare, columns, bare_columns)]
    two.append(mixed(joined(timed(one), timed(later(one), 0.1))))  # times tell it in any order
    two.append(joined(timed(bare_columns), timed(later(bare_columns), 0.1)))
    two.append(mixed(two[-1]))
    for scan in two:
        assert "found about 2.0 in one scan" in str(several_turns(scan)) and "\n" not in str(several_turns(scan))
    assert "about 3.0" in str(several_turns(joined(bare, later(bare), later(bare, 1.0))))


@pytest.mark.parametrize("name", ["hdl-64e-kitti", "hdl-32e", "vlp-16"])
def test_one_turn_is_one(name: str):
    one, bare = turn(SENSORS[name]), turn(SENSORS[name], rings=False)
    columns, bare_columns = by_columns(one), by_columns(bare)
    begin = columns[: len(one) // 10]  # what the next turn begins with
    ones = [one, bare, columns, bare_columns, mixed(one), mixed(bare), timed(one), mixed(timed(one)), one[:50]]
    ones += [joined(columns, later(begin)), joined(timed(columns), timed(later(begin), 0.1))]
    ones += [one[one.xyz[:, 0] > 0], bare[bare.xyz[:, 0] > 0], bare[bare.xyz[:, 1] > 0]]
    assert [several_turns(scan) for scan in ones] == [None] * len(ones)
    assert _in_order(bare) == 1.0, "ring after ring, whose parts look one way, too"


def test_second_returns_are_no_second_turn():
    one, bare = by_columns(turn(SENSORS["hdl-32e"])), turn(SENSORS["hdl-32e"], rings=False)
    for scan in (one, bare):
        far = np.random.default_rng(1).random(len(scan)) < 0.2
        behind = replace(scan, xyz=np.where(far[:, None], 1.1 * scan.xyz, scan.xyz).astype(np.float32))
        beside = joined(scan, behind)[np.arange(2 * len(scan)).reshape(2, -1).T.ravel()]
        for twice in (joined(scan, behind), joined(scan, behind[far]), beside, joined(scan, scan)):
            assert several_turns(twice) is None


def test_two_sensors_in_one_scan_are_no_two_turns():
    one = turn(SENSORS["vlp-32c"])
    assert one.ring is not None
    other = replace(one, xyz=one.xyz + np.array([0, 0, -0.3], np.float32), ring=one.ring + 32)
    assert several_turns(joined(one, other)) is None
    turned = replace(other, xyz=other.xyz * np.array([-1, -1, 1], np.float32))
    assert several_turns(mixed(joined(timed(one), replace(turned, time=timed(one).time)))) is None


def test_real_scans_are_one_turn(shared: Path):
    names = ("nuscenes_hdl32e.pcd.bin", "fast_gicp_251370668.pcd", "pandaset_pandar64_0001.pcd",
             "sensorscalibration_top.pcd")  # fmt: skip
    scans = [read(shared / "scans" / "other" / name) for name in names]
    kitti = [read(path) for path in sorted((shared / "scans" / "test").glob("*.bin"))]
    assert len(kitti) == 6
    for scan in (*scans, *kitti):
        assert several_turns(scan) is None
    for one, other in pairwise(kitti):
        assert "about 2.0" in str(several_turns(joined(one, other)))


def test_rings_of_one_beam_are_one_row():
    bare = turn(SENSORS["hdl-64e-kitti"], rings=False)
    learned = learn_sensor([joined(bare, later(bare, 0.0))], "own")
    np.testing.assert_allclose(learned.sensor.elevations, SENSORS["hdl-64e-kitti"].elevations, atol=0.005)
    assert learned.sensor.width == 512 and learned.merged == 64
    (line,) = doubts(learned)
    assert "found about 2.0 in one scan" in line and "64 rings are taken as one beam with another" in line
    twice = learn_sensor([joined(bare, bare)], "own")
    assert twice.sensor.height == 64
    (line,) = doubts(twice)
    assert "64 rings are taken as one beam with another" in line


def test_columns_of_two_turns_are_doubted():
    one = turn(SENSORS["vlp-16"])
    (line,) = doubts(learn_sensor([joined(one, later(one))], "own"))
    assert "about 2.0" in line and "columns" in line


def thinned(scan: Scan, *rings: tuple[int, int]) -> Scan:
    """Of some rings, (which, how many) points alone."""
    kept = np.ones(len(scan), bool)
    for ring, points in rings:
        at = np.flatnonzero(scan.ring == ring)
        kept[at[:: -(-len(at) // points)]] = False
        kept[at] = ~kept[at]
    return scan[kept]


def test_a_sensor_fits_the_scan_that_it_was_learned_from(tmp_path: Path):
    """Rings of few points are its rows, too; hardly any points are no ring."""
    scan = thinned(turn(FAN), (3, 60), (20, 8), (30, 2))
    learned = learn_sensor([scan], "own")
    (tmp_path / "own.toml").write_text(sensor_toml(learned.sensor))
    assert (learned.sensor.height, learned.thin, learned.missing) == (39, 2, 1)
    rows = [row for row in range(40) if row != 30]
    np.testing.assert_allclose(learned.sensor.elevations, np.array(FAN.elevations)[rows], atol=0.02)
    (line,) = doubts(learned)
    assert "found fewer in 3, which are left out of the fit, 2 with their few points as rows" in line
    sensor = get_sensor(str(tmp_path / "own.toml"))
    assert misfit_of(scan, sensor) is None
    assert misfit_of(thinned(turn(FAN), (30, 12)), sensor) is None, "a ring that it has not, and hardly the scan"
    assert "on 40 rings, more than its 39 beams" in str(misfit_of(turn(FAN), sensor))


def test_stray_points_of_a_ring_move_no_beam():
    scan = thinned(turn(FAN), (20, 8))
    assert scan.ring is not None
    lifted = scan.xyz + np.where(scan.ring == 20, np.float32(10), np.float32(0))[:, None] * np.array(
        [0, 0, 1], np.float32
    )
    found = learn_sensor([replace(scan, xyz=lifted)], "own").sensor
    np.testing.assert_allclose(found.elevations, FAN.elevations, atol=0.02)


def near_walls(sensor: Sensor) -> Scan:
    """A turn between walls at 4 to 30 m, so that each beam's points are of many elevations, if it leaves off the
    origin."""
    sensor = sensor.resized(width=512)
    rays, azimuth = sensor.directions(), sensor.ray_angles()[1, 0]
    with np.errstate(divide="ignore"):
        ground = np.where(rays[..., 2] < 0, 1.7 / -rays[..., 2], 60)
    noise = np.random.default_rng(0).uniform(0.98, 1.02, ground.shape)
    xyz = sensor.points((noise * np.minimum(ground, 4 + 26 * np.sin(azimuth) ** 2)).astype(np.float32)).reshape(-1, 3)
    return Scan(xyz, np.zeros(len(xyz), np.float32))


def test_smeared_beams_are_refused_by_the_name_of_their_sensor(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A known sensor's points at random, whose beams' heights make elevations no beams, and a leaning unknown one."""
    for beams, found in ((64, "of 40 beams wider"), (32, "none in 1"), (16, "of 16 beams wider")):
        sensor = SENSORS["hdl-64e-kitti"].resized(beams)
        with pytest.raises(ValueError, match=f"{found}: it is a scan of hdl-64e-kitti: --sensor hdl-64e-kitti"):
            learn_sensor([mixed(near_walls(sensor))], "own")
    angle = np.radians(3.0)
    lean = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]], np.float32)
    scan = turn(FAN)
    write(tmp_path / "lean.pcd", replace(scan, xyz=scan.xyz @ lean.T))
    with pytest.raises(SystemExit) as refused:
        main(["sensor", str(tmp_path / "lean.pcd"), "--out", str(tmp_path / "own.toml")])
    assert refused.value.code == 2 and not (tmp_path / "own.toml").exists()
    error = capsys.readouterr().err
    assert "expected points within 0.1 degrees of their beams, found" in error
    assert error.strip().count("\n") == 0 and "beams wider: give scans with rings, in the sensor's frame" in error


def test_columns_are_no_more_than_the_points_allow():
    """Beams that look a little aside, taken for one ring, have steps from one's points to another's: no columns."""
    scan = turn(FAN)
    assert scan.ring is not None
    twist = np.radians(360 / 512 * 0.03 * scan.ring)
    x, y, z = scan.xyz.T
    turned = np.stack([x * np.cos(twist) - y * np.sin(twist), x * np.sin(twist) + y * np.cos(twist), z], axis=1)
    assert 2 * np.pi / azimuth_step(turned, scan.ring) == pytest.approx(512, rel=0.01)
    assert 2 * np.pi / azimuth_step(turned, scan.ring // 8) <= 2 * 8 * 512
