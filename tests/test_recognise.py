"""The sensor is found from the points alone, on real scans and on ideal ones; what is not known is asked for."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidarsynth.files.formats import read
from lidarsynth.lidar.learning import learn_sensor
from lidarsynth.lidar.own_beams import own_beams, stray_rings
from lidarsynth.lidar.recognition import elevations_of, layers, recognise, rings_in_order, same_kind
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import GRIDS, INVERTED, SENSORS, Sensor, get_sensor
from lidarsynth.lidar.unseen import caution


def turn(sensor: Sensor, rings: bool = True, keep: float = 0.8, rows: slice = slice(None)) -> Scan:
    """A turn of an ideal sensor in a round room on flat ground, some points lost."""
    rng = np.random.default_rng(0)
    sensor = sensor.resized(width=512)
    rays = sensor.directions()
    with np.errstate(divide="ignore"):
        ground = np.where(rays[..., 2] < 0, 1.7 / -rays[..., 2], 60)
    distance = np.clip(np.minimum(ground, 60), 3.5, 60) * rng.uniform(0.98, 1.02, ground.shape)
    xyz = sensor.points(distance.astype(np.float32))[rows]
    ring = np.broadcast_to(np.arange(len(xyz))[:, None], xyz.shape[:2])
    kept = rng.random(ring.shape) < keep
    return Scan(xyz[kept], np.zeros(kept.sum(), np.float32), ring=ring[kept] if rings else None)


@pytest.mark.parametrize("name", SENSORS)
def test_every_sensor_is_recognised_by_its_rings(name: str):
    assert recognise(turn(SENSORS[name]))[0] == name


@pytest.mark.parametrize("name", SENSORS)
def test_every_sensor_is_recognised_by_the_order_of_its_points(name: str):
    assert recognise(turn(SENSORS[name], rings=False))[0] == name


@pytest.mark.parametrize("name", ["hdl-64e-kitti", "hdl-32e", "vlp-16", "vlp-32c", "os1-64", "os1-128", "pandar64"])
def test_a_sensor_without_rings_is_recognised_by_its_points(name: str):
    scan = turn(SENSORS[name], rings=False)
    shuffled = scan[np.random.default_rng(1).permutation(len(scan))]
    assert rings_in_order(shuffled.xyz) is None
    assert recognise(shuffled)[0] == name


@pytest.mark.parametrize("name", INVERTED)
def test_a_sensor_that_hangs_upside_down_is_recognised_where_the_ground_is_below(name: str):
    for rings in (True, False):
        scan = turn(get_sensor(name), rings=rings)
        assert recognise(scan)[0] == name
        over = Scan(scan.xyz * np.float32([1, -1, -1]), scan.reflectance, ring=scan.ring)
        assert recognise(over)[0] == name.removesuffix("-inverted"), "in its own frame"
    upright = turn(SENSORS[name.removesuffix("-inverted")])
    assert recognise(Scan(upright.xyz * np.float32([1, -1, -1]), ring=upright.ring))[0] is None, "the ground is above"


def shuffled_turn(elevations: np.ndarray) -> Scan:
    scan = turn(Sensor("unit", tuple(elevations)), rings=False)
    return scan[np.random.default_rng(1).permutation(len(scan))]


def test_a_unit_off_the_table_is_recognised_without_rings_and_one_that_shares_its_beams_is_not():
    off = np.random.default_rng(2).uniform(-0.2, 0.2, 64)
    assert recognise(shuffled_turn(np.array(SENSORS["os1-64"].elevations) + off))[0] == "os1-64"
    assert recognise(shuffled_turn(np.arange(16.0, -16, -1)))[0] is None, "every second beam is a VLP-16's"


@pytest.mark.parametrize("first", range(4))
def test_every_fourth_ring_of_a_64_beam_sensor_is_no_vlp_16(first: int):
    name, reason = recognise(turn(SENSORS["hdl-64e-kitti"], rows=slice(first, None, 4)))
    assert name == "hdl-64e-kitti"
    assert "16 of the 64 beams" in reason


def test_a_sensor_close_to_the_ground_keeps_its_lowest_beams():
    scan = turn(SENSORS["vlp-16"])
    low = Scan(scan.xyz * np.float32(0.3), scan.reflectance, ring=scan.ring)
    assert recognise(low)[0] == "vlp-16"


@pytest.mark.parametrize("beams", [(3, 1, -1, -3), (2, -3, -8), (5.1, 0.9, -0.7, -2.6, -9.8)])
def test_a_few_beams_that_lie_near_those_of_a_sensor_by_chance_are_not_its(beams):
    assert recognise(turn(Sensor("own", tuple(map(float, beams)))))[0] is None


@pytest.mark.parametrize("name", ["hdl-32e", "os1-64", "os1-128", "pandar64", "hdl-64e-kitti"])
@pytest.mark.parametrize("count", [2, 3, 5])
def test_a_few_beams_of_a_sensor_are_its(name: str, count: int):
    rows = slice(10, 10 + 5 * count, 5)
    assert recognise(turn(SENSORS[name], rows=rows))[0] == name


def test_empty_beams_towards_the_sky_do_no_harm():
    assert recognise(turn(SENSORS["pandar64"], rows=slice(3, None)))[0] == "pandar64"


def test_an_unknown_sensor_is_asked_for_in_one_line():
    other = Sensor("fan", tuple(np.linspace(40, -30, 40)))
    for scan in (turn(other), turn(other, rings=False)):
        name, reason = recognise(scan, Path("scan.pcd"))
        assert name is None
        assert reason.startswith("scan.pcd: expected the beams of hdl-64e") and "--sensor" in reason
        assert "\n" not in reason and "+40.0 to -30.0" in reason
        assert reason.endswith("or learn it: lidarsynth sensor SCANS --out my.toml")


def test_the_lines_of_a_sensor_that_does_not_spin_are_no_rings():
    """As a Livox numbers its lasers, each of which looks everywhere."""
    scan = turn(SENSORS["os1-64"], rings=False)
    rng = np.random.default_rng(0)
    petals = scan[rng.permutation(len(scan))]
    for lines in (4, 6):
        line = Scan(petals.xyz, petals.reflectance, ring=np.arange(len(petals)) % lines)
        name, reason = recognise(line)
        assert name is None and "look everywhere, as of a sensor that does not spin (Livox)" in reason
        assert "learn it" not in reason
        with pytest.raises(ValueError, match="rings that are beams, found rings that each look everywhere"):
            learn_sensor([line], "own")
    assert all(layers(turn(sensor).xyz[:, axes], turn(sensor).ring)
               for sensor in SENSORS.values() for axes in ([0, 1, 2], [2, 0, 1], [1, 2, 0]))  # fmt: skip


def test_points_of_no_spinning_sensor_are_asked_for():
    xyz = np.random.default_rng(0).normal(0, 10, (5000, 3)).astype(np.float32)
    assert recognise(Scan(xyz, np.zeros(5000, np.float32)))[0] is None
    name, reason = recognise(Scan(xyz[:50], np.zeros(50, np.float32)))
    assert name is None and "at least 100 points" in reason and "found 50" in reason
    near = Scan(xyz * np.float32(0.01), np.zeros(5000, np.float32))
    assert recognise(near)[0] is None
    above = Scan(xyz + np.float32([0, 0, 1e9]), near.reflectance)  # straight above, all of them
    name, reason = recognise(above)
    assert name is None and "from +90.0 to +90.0 degrees" in reason


def moved(name: str, *beams: tuple[int, float]) -> Sensor:
    """A unit of a known sensor with some beams elsewhere: (row, degrees)."""
    elevations = list(SENSORS[name].elevations)
    for row, degrees in beams:
        elevations[row] = degrees
    return replace(SENSORS[name], elevations=tuple(elevations))


@pytest.mark.parametrize("rings", [True, False])
def test_rings_off_their_beams_are_told_and_their_beams_taken_as_they_are(rings: bool):
    unit, table = moved("pandar64", (62, -14.7), (63, -19.5)), SENSORS["pandar64"]
    scan = turn(unit, rings)
    assert recognise(scan)[0] == "pandar64", "most rings are where they should be"
    text = str(stray_rings(scan, table))
    assert "found 2 of 64 up to 5.4 degrees off (62, 63)" in text and "\n" not in text
    found = own_beams(scan, table)
    np.testing.assert_allclose(found.elevations, unit.elevations, atol=0.01)
    assert found.name == table.name and found.elevations[:62] == table.elevations[:62]


def test_beams_are_only_moved_as_far_as_they_stay_in_order():
    table = SENSORS["vlp-16"]
    scan = turn(moved("vlp-16", (15, -18.0)))
    assert scan.ring is not None
    crossed = replace(scan, ring=np.where(scan.ring == 12, 3, scan.ring))[scan.ring != 3]  # one where another is
    assert "found 2 of 16 up to 18.0 degrees off (3, 15)" in str(stray_rings(crossed, table))
    np.testing.assert_allclose(own_beams(crossed, table).elevations, [*table.elevations[:15], -18.0], atol=0.01)


@pytest.mark.parametrize("name", SENSORS)
def test_no_ring_of_a_known_sensor_strays(name: str):
    """Nor of a few points, of some beams only, of a unit a little off the table, or of a sensor that leans."""
    table = SENSORS[name]
    off = np.random.default_rng(2).uniform(-0.05, 0.05, table.height)
    unit = replace(table, elevations=tuple(np.array(table.elevations) + off))
    angle = np.radians(2.0)
    lean = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]], np.float32)
    whole = turn(table)
    tilted = Scan(whole.xyz @ lean.T, whole.reflectance, ring=whole.ring)
    some = turn(table, rows=slice(1, None, 4))
    for scan in (whole, turn(table, rings=False), turn(table, keep=0.05), turn(unit), tilted, some):
        assert stray_rings(scan, table) is None
        assert own_beams(scan, table) is table


@pytest.mark.parametrize(
    ("name", "sensor"),
    [
        ("nuscenes_hdl32e.pcd.bin", "hdl-32e"),
        ("fast_gicp_251370668.pcd", "hdl-32e"),  # not named by its source: 32 beams from 10.67 to -30.67 degrees
        ("pandaset_pandar64_0001.pcd", "pandar64"),
        ("sensorscalibration_top.pcd", "pandar64"),  # not named by its source: its rings are the Pandar64's
    ],
)
def test_real_scans_of_other_sensors(name: str, sensor: str, shared: Path):
    found, reason = recognise(read(shared / "scans" / "other" / name))
    assert found == sensor, reason


def test_only_the_real_scan_whose_rings_stray_is_told_so(shared: Path, kitti: list[Scan]):
    other = [read(shared / "scans" / "other" / name) for name in
             ("nuscenes_hdl32e.pcd.bin", "fast_gicp_251370668.pcd", "sensorscalibration_top.pcd")]  # fmt: skip
    for scan in (*other, *kitti):
        assert stray_rings(scan, SENSORS[str(recognise(scan)[0])]) is None
    panda = read(shared / "scans" / "other" / "pandaset_pandar64_0001.pcd")
    assert "found 2 of 64 up to 5.4 degrees off (62, 63)" in str(stray_rings(panda, SENSORS["pandar64"]))
    np.testing.assert_allclose(own_beams(panda, SENSORS["pandar64"]).elevations[62:], (-14.7, -19.5), atol=0.2)
    assert "found 2 of 64" in str(caution(panda, SENSORS["pandar64"])), "named by hand, its data sheet's are taken"
    assert caution(panda) is None


def test_two_stacked_sensors_are_asked_for(shared: Path):
    """An Argoverse 2 sweep is two VLP-32C in the vehicle's frame: no single sensor's rings."""
    pytest.importorskip("pyarrow", reason="pyarrow comes with the extra `data`")
    name, reason = recognise(read(shared / "scans" / "other" / "argoverse2_2xvlp32c.feather"))
    assert name is None and "64 rings" in reason


@pytest.fixture(scope="module")
def kitti(shared: Path) -> list[Scan]:
    return [read(path) for path in sorted((shared / "scans" / "test").glob("*.bin"))]


def test_real_kitti_scans_are_hdl_64e(kitti: list[Scan]):
    assert len(kitti) == 6
    for scan in kitti:
        ring = rings_in_order(scan.xyz)
        assert ring is not None and ring.max() == 63
        name, reason = recognise(scan)
        assert name == "hdl-64e-kitti", reason


@pytest.mark.parametrize("step", [2, 4])
def test_rings_taken_out_of_a_real_scan_are_still_hdl_64e(step: int, kitti: list[Scan]):
    for scan in kitti[:3]:
        ring = rings_in_order(scan.xyz)
        assert ring is not None
        for first in range(0, step, step - 1):
            name, reason = recognise(scan[ring % step == first])
            assert name == "hdl-64e-kitti" and f"{64 // step} of the 64" in reason


@pytest.mark.parametrize(
    ("file", "sensor", "tolerance"),
    [("nuscenes_hdl32e.pcd.bin", "hdl-32e", 0.05), ("sensorscalibration_top.pcd", "pandar64", 0.002)],
)
def test_tables_are_what_real_sensors_do(file: str, sensor: str, tolerance: float, shared: Path):
    """Median elevation of each ring beyond 10 m against the table; nuScenes is compensated for motion."""
    scan = read(shared / "scans" / "other" / file)
    assert scan.ring is not None
    far = np.hypot(scan.xyz[:, 0], scan.xyz[:, 1]) > (10 if sensor == "hdl-32e" else 3)
    elevation = elevations_of(scan.xyz)
    rows = [row for row in range(SENSORS[sensor].height) if (far & (scan.ring == row)).sum() > 100]
    assert len(rows) >= 16
    for row in rows:
        here = np.median(elevation[far & (scan.ring == row)])
        assert abs(here - SENSORS[sensor].elevations[row]) < tolerance, row


def test_the_points_of_an_unnamed_scan_lie_on_the_table_of_the_hdl_32e(shared: Path):
    elevation = elevations_of(read(shared / "scans" / "other" / "fast_gicp_251370668.pcd").xyz)
    table = np.array(SENSORS["hdl-32e"].elevations)
    assert np.abs(elevation[:, None] - table).min(axis=1).max() < 0.01


def test_what_published_programs_take_an_image_for_is_no_other_sensor():
    """So no warning that a network of DUSty's knows another sensor, of KITTI's scans; and scans are of units alone."""
    for word in GRIDS:
        assert same_kind(word, "hdl-64e-kitti") and same_kind(f"{word}/32", "hdl-64e") and word not in SENSORS
        assert not same_kind(word, "hdl-32e")
