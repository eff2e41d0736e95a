"""A sensor learned from its scans is the sensor that made them, ideal or real."""

import lzma
import re
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_recognise import turn

from lidarsynth.cli.main import main
from lidarsynth.files.formats import read, write
from lidarsynth.lidar import learning
from lidarsynth.lidar.blocked import blocked_runs
from lidarsynth.lidar.cones import fit_ring
from lidarsynth.lidar.frame import check_frame
from lidarsynth.lidar.learning import _standing, learn_sensor
from lidarsynth.lidar.recognition import rings_by_elevation
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import SENSORS, Sensor, read_sensor
from lidarsynth.lidar.unseen import caution
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.verbs.description import describe_sensor
from lidarsynth.verbs.inputs import Inputs, Loaded
from lidarsynth.verbs.learned_sensor import ENOUGH, doubts, learn, sensor_toml, summary


def unpacked(path: Path) -> Scan:
    """N (int32), x y z as differences of int32 millimetres, planar, then reflectance in hundredths."""
    raw = lzma.decompress(path.read_bytes())
    n = int(np.frombuffer(raw, "<i4", 1)[0])
    steps = np.frombuffer(raw, "<i4", 3 * n, 4).reshape(3, n)
    return Scan((np.cumsum(steps, axis=1, dtype=np.int32) / 1000.0).T.astype(np.float32))


class Turn:
    """A turn of a capture: how many there are is known when the last is read."""

    path = Path("a.pcap")

    def __init__(self, number: int, read: list[int]):
        self.name, self.number, self.asked = f"{number:06d}", number, read

    def read(self) -> Loaded:
        self.asked.append(self.number)
        return Loaded(turn(SENSORS["vlp-16"]), {}, 0)


@pytest.mark.parametrize("count", [None, 450])
def test_of_many_scans_enough_are_read_evenly_whether_their_number_is_known_or_not(count: int | None):
    read: list[int] = []
    learned = learn(Inputs(False, count, lambda: (Turn(i, read) for i in range(450)), True), "own")
    assert ENOUGH / 2 <= learned.scans == len(read) <= ENOUGH
    assert len(set(np.diff(read).tolist())) == 1 and read[0] == 0 and read[-1] > 440


def test_a_ring_is_fitted_by_one_thread():
    """Others' share of so short a work is waiting, long where cores are busy."""
    rng = np.random.default_rng(0)
    angle, rho = rng.uniform(-np.pi, np.pi, 30_000), rng.uniform(3, 60, 30_000)
    xyz = np.stack([rho * np.cos(angle), rho * np.sin(angle), 0.1 * rho + rng.normal(0, 0.01, 30_000)], axis=1)
    of_all, of_this = time.process_time(), time.thread_time()
    fit = fit_ring(xyz)
    of_all, of_this = time.process_time() - of_all, time.thread_time() - of_this
    assert fit.elevation == pytest.approx(np.degrees(np.arctan(0.1)), abs=1e-2)
    assert of_all < 1.3 * of_this


def test_rings_of_a_beam_each_are_fitted_once(monkeypatch: pytest.MonkeyPatch):
    fitted: list[float | None] = []

    def counted(xyz: np.ndarray, height: float | None = None):
        fitted.append(height)
        return fit_ring(xyz, height)

    monkeypatch.setattr(learning, "fit_ring", counted)
    learn_sensor([turn(SENSORS["vlp-16"])], "own")
    assert len(fitted) <= 2 * 16, "with a height of its own, and with none"


@pytest.mark.parametrize("name", ["hdl-64e-kitti", "hdl-32e", "vlp-16"])
def test_an_ideal_sensor_is_learned(name: str):
    known = SENSORS[name]
    found = learn_sensor([turn(known)], "own").sensor
    assert found.height == known.height and found.width == 512
    np.testing.assert_allclose(found.elevations, known.elevations, atol=0.005)
    np.testing.assert_allclose(found.offsets or 0.0, known.offsets or 0.0, atol=0.01)
    assert found.mount == pytest.approx(1.7, abs=0.2)
    assert np.abs(found.tilt).max() < 0.2


def seen(few: Sensor, count: int = 4) -> list[Scan]:
    pytest.importorskip("embreex", reason="lidarsynth[synthetic] is not installed")
    streets = SyntheticStreets(0, 64, few)
    return [streets.image(index).to_scan() for index in range(0, 16 * count, 16)]


@pytest.mark.parametrize(
    ("elevations", "mount", "tilt"),
    [
        (np.linspace(5, -15, 10), 1.5, (0.0, 0.0)),
        (np.linspace(10, -10, 10), 1.5, (0.0, 0.0)),
        (np.linspace(15, -15, 12), 2.2, (12.0, -8.0)),
        (np.linspace(2, -8, 6), 1.8, (0.0, 0.0)),
        (np.linspace(15, -15, 16), 0.4, (0.0, 0.0)),
        (np.array(SENSORS["vlp-32c"].elevations), 1.73, (0.0, 0.0)),
    ],
)
def test_few_beams_tell_how_the_sensor_stands(elevations: np.ndarray, mount: float, tilt: tuple[float, float]):
    """Some stand lower or tilted: of walls and cars the beams just below the horizon see more than of the ground."""
    few = Sensor("few", tuple(elevations.tolist()), 1024, 0.5, mount=mount, tilt=tilt)
    learned = learn_sensor(seen(few), "own")
    assert learned.sensor.mount == pytest.approx(mount, abs=0.15)
    np.testing.assert_allclose(learned.sensor.tilt, tilt, atol=1.0)
    assert learned.afloat is None


def test_scans_that_do_not_tell_the_mount_are_told():
    turns = [turn(SENSORS["vlp-16"], rings=True) for _ in range(4)]
    shifted = [replace(scan, xyz=scan.xyz * np.float32(1 + k)) for k, scan in enumerate(turns)]
    above = [scan[scan.xyz[:, 2] > -0.5] for scan in turns]
    for scans, why in ((shifted, r"as far below in most scans, found it 1\.\d+ to \d\.\d+ m"), (above, "found 0 of 4")):
        learned = learn_sensor(scans, "own")
        assert (learned.sensor.mount, learned.sensor.tilt) == (1.73, (0.0, 0.0))
        assert "how far above the ground is not known" in summary(learned)
        (line,) = (line for line in doubts(learned) if "mount" in line)
        assert re.search(
            rf"own: expected .*{why}.*: mount and tilt are not learned, 1\.73 m and level are written", line
        )


def test_a_sensor_below_the_ground_has_no_mount():
    mount, tilt, why = _standing([(-0.12, 0.1, 0.0)] * 3, 0, 3)
    assert (mount, tilt) == (1.73, (0.0, 0.0)) and why is not None
    assert why.startswith("expected the sensor above the ground, found it 0.12 m below")


def test_beams_that_meet_the_ground_far_off_do_not_tell_how_far_below_it_is():
    narrow = Sensor("narrow", tuple(np.linspace(3.0, -3.0, 24).tolist()), 900, 0.5, 200.0, mount=1.8)
    streets = SyntheticStreets(seed=3, length=200, sensor=narrow)
    learned = learn_sensor([streets[16 * i] for i in range(3)], "own")
    assert (learned.sensor.mount, learned.sensor.tilt) == (1.73, (0.0, 0.0))
    assert "of what the lowest beams met below what looks like it" in str(learned.afloat)


def test_what_lies_as_near_as_no_sensor_is_mounted_is_no_ground():
    few = replace(SENSORS["vlp-16"], name="few", elevations=(0.8, 0.0, -0.8, -1.6))
    for scan in seen(few, 1):
        learned = learn_sensor([scan], "own")
        assert learned.sensor.mount == 1.73 and "found it 0." in str(learned.afloat)


def test_elevations_that_crowd_where_no_beams_are_are_no_sensor():
    scan = turn(SENSORS["hdl-32e"])
    rare = scan[(scan.ring % 16 == 8) | (np.arange(len(scan)) % 5 == 0)]
    mixed = replace(rare, ring=None)[np.random.default_rng(0).permutation(len(rare))]
    with pytest.raises(ValueError, match=r"found 32 crowds, .* and 30 of fewer than 200 points, as of .*\(Livox\)"):
        learn_sensor([mixed], "own")


def test_smeared_and_missing_beams_are_told():
    clean = turn(SENSORS["hdl-32e"])
    far = np.linalg.norm(clean.xyz, axis=1)
    off = np.random.default_rng(0).normal(0, np.radians(0.3), len(clean)) * far * (clean.ring >= 20)
    smeared = replace(clean, xyz=clean.xyz + np.stack([0 * off, 0 * off, off], 1).astype(np.float32))
    rare = clean[(clean.ring != 7) | (np.arange(len(clean)) % 5 == 0)]
    assert doubts(learn_sensor([clean], "own")) == []
    (line,) = doubts(learn_sensor([smeared], "own"))
    assert "found 12 of 32 beams wider" in line
    (line,) = doubts(learn_sensor([rare], "own"))
    assert "in each of 32 rings, found fewer in 1, which are left out" in line


def test_rings_that_count_from_1_or_leave_numbers_out_lack_nothing():
    scan = turn(SENSORS["hdl-32e"])
    for ring, last, none in ((scan.ring + 1, 32, 1), (2 * scan.ring, 62, 31)):
        learned = learn_sensor([replace(scan, ring=ring)], "own")
        (line,) = doubts(learned)
        assert learned.sensor == learn_sensor([scan], "own").sensor
        assert f"rings 0 to {last}, found none in {none}, which are left out: rightly, where rings count from 1" in line


def test_columns_that_steps_do_not_tell_are_a_guess():
    scan = turn(SENSORS["hdl-32e"])
    rng = np.random.default_rng(0)
    some = scan[np.sort(rng.permutation(len(scan))[: len(scan) // 2])]
    noise = np.linalg.norm(scan.xyz, axis=1, keepdims=True) * np.radians(0.4) * np.float32([1, 1, 0])
    noisy = replace(scan, xyz=(scan.xyz + rng.normal(size=(len(scan), 3)) * noise).astype(np.float32))
    for other in (some, noisy):
        assert any("whole columns apart, found other steps" in line for line in doubts(learn_sensor([other], "own")))
    for whole in (scan, scan[scan.xyz[:, 0] > 0], turn(SENSORS["hdl-32e"], keep=1.0)[::2]):
        assert not any("columns" in line for line in doubts(learn_sensor([whole], "own")))


def test_a_point_that_no_sensor_sees_makes_no_range_without_a_word():
    scan = turn(SENSORS["hdl-32e"])
    stray = replace(scan, xyz=np.concatenate([scan.xyz[:-1], scan.xyz[-1:] * 500]))
    learned = learn_sensor([stray], "own")
    (line,) = doubts(learned)
    assert f"expected points within 1000 m, found some to {learned.sensor.max_range:g} m: stray ones" in line


def test_few_rings_are_no_sensor_that_does_not_spin():
    scan = turn(SENSORS["hdl-32e"])
    for ring, count in ((scan.ring // 16, 2), (0 * scan.ring, 1)):
        with pytest.raises(ValueError, match=f"expected 4 rings or more to learn from, found {count} in the ring fie"):
            learn_sensor([replace(scan, ring=ring)], "own")


def test_few_scans_do_not_tell_what_is_blocked():
    scan = turn(SENSORS["vlp-16"])
    assert "what is blocked is not known: 5 scans" in summary(learn_sensor([scan] * 4, "own"))
    assert "nothing seen to be blocked" in summary(learn_sensor([scan] * 5, "own"))


def test_beams_are_found_without_rings():
    scan = turn(SENSORS["hdl-32e"], rings=False)
    mixed = scan[np.random.default_rng(0).permutation(len(scan))]
    ring = rings_by_elevation(mixed.xyz)
    assert ring is not None and ring.max() == 31
    found = learn_sensor([mixed], "own").sensor
    np.testing.assert_allclose(found.elevations, SENSORS["hdl-32e"].elevations, atol=0.02)
    cloud = np.random.default_rng(0).normal(0, 10, (5000, 3)).astype(np.float32)
    with pytest.raises(ValueError, match="none in 1"):
        learn_sensor([Scan(cloud)], "own")


def test_beams_that_see_nothing_far_are_missed_without_rings():
    low = Sensor("low", tuple(np.linspace(15.0, -25.0, 32).tolist()), 600, 0.1, 40.0, mount=0.4)
    scan = SyntheticStreets(seed=5, length=200, sensor=low)[0]
    told = doubts(learn_sensor([scan], "own"))
    assert not any("beyond 3 m: give scans with rings" in line for line in told)
    mixed = replace(scan, ring=None)[np.random.default_rng(0).permutation(len(scan))]
    learned = learn_sensor([mixed], "own")
    assert learned.sensor.height < 32
    assert any("above or below all" in line and "see nothing beyond 3 m" in line for line in doubts(learned))


def looks(scans: int, moves: bool = True) -> np.ndarray:
    """(scans, 4, 1000) of scattered returns: row 0 sees only sky, rows 1 and 2 have a carrier; one that does not move
    loses nearly the same rays each time."""
    rng = np.random.default_rng(0)
    seen = rng.random((scans, 4, 1000)) < 0.8
    seen = seen if moves else seen[:1] ^ (rng.random((scans, 4, 1000)) < 0.01)
    seen[:, 1, 10:30] = seen[:, 2, 990:] = seen[:, 2, :4] = seen[:, 0] = seen[:, 3, 50] = False
    seen[-1, 2, 989] = seen[-1, 2, 4] = True
    return seen


def test_blocked_rays_are_runs_that_may_wrap():
    down = np.array([-8.0, -9.0, -10.0, -11.0])
    assert blocked_runs(looks(9), down) == ((1, 10, 29), (2, 990, 3))
    assert blocked_runs(looks(9), down + 8) == ((1, 10, 29), (2, 990, 3)), "its edges stand still"
    assert blocked_runs(looks(4), down) == (), "too few scans to tell"
    assert blocked_runs(looks(9, moves=False), down) == (), "all of one place"


def test_sky_at_the_end_of_a_street_is_no_carrier():
    seen = looks(9)
    for number, one in enumerate(seen):  # an opening that is never narrower than 20 columns, and mostly wider
        one[3, 500 - 7 * number : 520 + 7 * ((number * 5) % 9)] = False
    assert blocked_runs(seen, np.array([3.0, 2.0, 1.0, 0.0])) == ((1, 10, 29), (2, 990, 3))
    below = blocked_runs(seen, np.array([-8.0, -9.0, -10.0, -11.0]))
    assert below == ((1, 10, 29), (2, 990, 3), (3, 500, 519)), "rays at the ground return"
    assert (3, 500, 519) not in blocked_runs(seen, np.array([-8.0, -9.0, -10.0, -11.0]), (8.0, 0.0)), "not if tilted"


def test_a_sector_without_any_return_is_out_of_the_view_of_all_beams():
    down = np.array([-1.0, -9.0, -10.0, -11.0])
    seen = np.random.default_rng(0).random((5, 4, 1000)) < np.array([0.6, 0.9, 0.9, 0.9])[:, None]
    seen[:, :, 900:] = seen[:, :, :100] = False
    assert blocked_runs(seen, down) == tuple((row, 900, 99) for row in range(4)), "the highest alone would not tell"
    assert blocked_runs(seen[:, [0, 0, 0, 0]], down) == (), "of which none is sure"
    seen[2, 0, 900::40] = seen[2, 0, :100:40] = True
    assert 0 not in {row for row, _, _ in blocked_runs(seen, down)}, "it looks over what hides the others"
    narrow = np.random.default_rng(0).random((5, 4, 1000)) < np.array([0.6, 0.9, 0.9, 0.9])[:, None]
    narrow[:, :, 40:80] = False
    assert 0 not in {row for row, _, _ in blocked_runs(narrow, down)}, "there may be sky over what hides the others"


def test_a_sensor_that_looks_ahead_is_learned_so():
    elevations = tuple(np.linspace(8.0, -16.0, 16).tolist())
    sensor = Sensor("ahead", elevations, 600, 0.3, 100.0, mount=1.1, tilt=(-3.0, 2.0))
    streets = SyntheticStreets(seed=3, length=200, sensor=sensor)
    scans = [streets[16 * i] for i in range(7)]
    ahead = [scan[np.abs(np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0])) < np.pi / 3] for scan in scans]
    learned = learn_sensor(ahead, "ahead")
    found = learned.sensor
    assert learned.afloat is None and found.mount == pytest.approx(1.1, abs=0.1)
    assert found.tilt == pytest.approx((-3.0, 2.0), abs=1.0)
    aside = np.abs(found.ray_angles()[1])
    assert found.blocked_rays()[aside > np.pi / 3 + 0.01].mean() > 0.8
    assert not found.blocked_rays()[aside < np.pi / 3 - 0.01].any()
    assert "hardly any in 2" in str(caution(ahead[0], replace(found, blocked=()))) and caution(ahead[0], found) is None
    assert found.min_range <= 1, "what stands nearer than anything in these scans is seen, too"


def test_a_street_hides_no_ray():
    sensor = Sensor("own", tuple(np.linspace(40.0, -16.0, 29).tolist()), 600, 0.3, 60.0)
    streets = SyntheticStreets(seed=3, length=100, sensor=sensor)
    assert learn_sensor([streets[16 * i] for i in range(6)], "own").sensor.blocked == ()


def test_what_is_blocked_is_described():
    told = describe_sensor(Sensor("own", (1.0, -1.0), 100, blocked=((1, 10, 19),)))
    assert "blocked  5.0% of the rays" in told and "tilt" not in told


def test_the_file_is_read_back_as_the_sensor(tmp_path: Path):
    known = SENSORS["hdl-64e-kitti"].rows(range(0, 64, 2), width=300)
    (tmp_path / "own.toml").write_text(sensor_toml(known, ["two", "comments"]))
    found = read_sensor(tmp_path / "own.toml")
    assert found.to_dict() == known.to_dict()


@pytest.mark.parametrize("name", ["two\nlines", "\x1b[31mred", "del\x7f", 'q"\\', "\u00fc", "bad\udcff"])
def test_a_file_of_any_name_is_read_back(name: str, tmp_path: Path):
    known = replace(SENSORS["vlp-16"], name=name)
    (tmp_path / "own.toml").write_text(sensor_toml(known, [f"{name}: 16 beams"]), encoding="utf-8")
    assert read_sensor(tmp_path / "own.toml") == replace(known, name=name.replace("\udcff", "?"))


def test_the_verb_writes_a_sensor_and_its_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for i in range(2):
        write(tmp_path / f"{i}.pcd", turn(SENSORS["vlp-16"]))
    main(["sensor", str(tmp_path), "--out", str(tmp_path / "own.toml")])
    assert "own: 16 beams from +15.00 to -15.00 degrees, 512 columns" in capsys.readouterr().out
    assert read_sensor(tmp_path / "own.toml").height == 16
    assert (tmp_path / "own.png").stat().st_size > 5000
    own = turn(SENSORS["vlp-16"], rings=True)
    near = np.linalg.norm(own.xyz, axis=1).min()
    assert learn_sensor([own], "own").sensor.min_range <= near, "no measured point is nearer than it sees"
    (tmp_path / "moved").mkdir()
    write(tmp_path / "moved/0.pcd", replace(own, xyz=own.xyz + np.float32([1.5, 0, 1.2])))
    main(["sensor", str(tmp_path / "moved"), "--out", str(tmp_path / "moved.toml"), "--no-picture"])
    assert "moved/0.pcd: expected points in the sensor's frame" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "sensor"),
    [("sensorscalibration_top.pcd", "pandar64"), ("fast_gicp_251370668.pcd", "hdl-32e")],
)
def test_real_sensors_within_a_twentieth_of_a_degree(name: str, sensor: str, shared: Path):
    found = np.array(learn_sensor([read(shared / "scans" / "other" / name)], "own").sensor.elevations)
    known = np.array(SENSORS[sensor].elevations)
    assert len(found) > 0.9 * len(known)
    assert np.abs(found[:, None] - known).min(axis=1).max() < 0.05


def test_kittis_sensor_from_real_scans(shared: Path, tmp_path: Path):
    """Raw scans: beams within 0.05 degrees of the fit to 110 scans, and their origins 0.2 and 0.12 m up."""
    packed = sorted((shared / "scans" / "train").glob("objtest_*.scan.xz"))[:2]
    if not packed:
        pytest.skip("packed scans are not here")
    scans = [unpacked(path) for path in packed]
    found, known = learn_sensor(scans, "own").sensor, SENSORS["hdl-64e-kitti"]
    np.testing.assert_allclose(found.elevations, known.elevations, atol=0.05)
    np.testing.assert_allclose(found.offsets, known.offsets, atol=0.01)
    assert 2050 < found.width < 2250


def own_streets(count: int) -> list[Scan]:
    """Scans of a sensor that is no known one, nose up."""
    beams = (12.0, 9.0, 7.0, 5.0, *np.linspace(3, -9, 25).tolist(), -11.0, -14.0, -18.0)
    sensor = Sensor("own", beams, 512, mount=1.2, tilt=(6.0, -4.0))
    streets = SyntheticStreets(0, count, sensor)
    return [streets[i] for i in range(count)]


def test_a_sensor_that_hangs_has_no_mount_until_it_is_turned(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    flip = np.array([1, -1, -1], np.float32)
    for number, scan in enumerate(own_streets(3)):
        assert check_frame(scan).warning() is None
        hung = replace(scan, xyz=scan.xyz * flip)
        assert "hangs upside down: try --transform 0:0:0:180:0:0" in str(check_frame(hung).warning())
        write(tmp_path / f"{number}.pcd", hung)
    words = ["sensor", str(tmp_path), "--no-picture", "--out"]
    main([*words, str(tmp_path / "hung.toml")])
    told = capsys.readouterr()
    assert "ground above in 3 of 3 scans" in told.err and "how far above the ground is not known" in told.out
    hung = read_sensor(tmp_path / "hung.toml")
    assert (hung.mount, hung.tilt) == (Sensor.mount, Sensor.tilt)
    main([*words, str(tmp_path / "own.toml"), "--transform", "0:0:0:180:0:0"])
    assert capsys.readouterr().err == ""
    own = read_sensor(tmp_path / "own.toml")
    main(["info", str(tmp_path / "own.toml")])
    assert f"nose {own.tilt[0]:+g} and left side {own.tilt[1]:+g} degrees up" in capsys.readouterr().out
    assert own.mount == pytest.approx(1.2, abs=0.15)
    np.testing.assert_allclose(own.tilt, (6, -4), atol=1.5)
    np.testing.assert_allclose(own.elevations, [-e for e in hung.elevations[::-1]], atol=0.002)


def test_scans_of_two_sensors_and_beams_that_only_see_the_sky_are_told():
    one = turn(SENSORS["vlp-16"])
    assert one.ring is not None
    low = one.ring >= 4
    less = replace(one, xyz=one.xyz[low], reflectance=one.reflectance[low], ring=one.ring[low] - 4)
    for others, words in (
        ([turn(SENSORS["hdl-32e"])] * 2, "16 in 3 of 5, and 32 in"),
        ([less], "16 in 3 of 4, and 12 in"),
    ):
        (line,) = doubts(learn_sensor([one] * 3 + others, "own"))
        assert f"expected as many rings in every scan, found {words} the others" in line
    assert doubts(learn_sensor([one] * 9 + [less], "own")) == [], "one odd scan of many is named, and no more"


def test_scans_of_another_sensor_of_as_many_beams_are_left_out_and_told():
    one, other = turn(SENSORS["vlp-16"]), turn(replace(SENSORS["vlp-16"], elevations=tuple(np.linspace(10, -20, 16))))
    alone, mixed = learn_sensor([one] * 3, "own"), learn_sensor([one, other, one, other, one], "own")
    assert mixed.sensor == alone.sensor and (mixed.scans, mixed.left) == (3, ("2 of other beams",))
    (line,) = doubts(mixed)
    assert "expected scans of one sensor, found 2 of 5 with rings 0.5 degrees or more off those of most" in line
    lifted = [replace(scan, xyz=scan.xyz - np.float32([0, 0, 0.3])) for scan in (one, turn(SENSORS["vlp-16"]))]
    assert learn_sensor(lifted, "own").scans == 2, "an origin elsewhere is no other sensor"
