"""What the columns of a file mean: intensity scales, ring order, times, labels, lost points."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from full_scan import N, full_scan, same

from lidarsynth.files.fields import MAX_METRES, NAMES, FileError, reflectance_from, rings_from_top, seconds_from
from lidarsynth.files.formats import read, read_with_report, write
from lidarsynth.files.labels import read_labels
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.semantic_kitti import CLASS_OF_RAW, RAW
from lidarsynth.lidar.sensor import SENSORS


@pytest.fixture
def scan() -> Scan:
    return full_scan()


@pytest.mark.parametrize(
    ("values", "scale"),
    [
        (np.array([0, 0.5, 1.0], np.float32), 1),
        (np.array([0, 3, 255.0], np.float32), 255),
        (np.array([0, 3, 256.0], np.float64), 65535),
        (np.array([0, 1], np.uint8), 255),
        (np.array([0, 1], np.uint16), 255),
        (np.array([0, 200], np.int32), 255),
        (np.array([0, 300], np.uint16), 65535),
    ],
)
def test_intensity_scales_are_recognised(values: np.ndarray, scale: float):
    np.testing.assert_allclose(reflectance_from(values), values / np.float64(scale), rtol=1e-6)


@pytest.mark.parametrize("light", ["reflectivity", "Reflectance", "Intensity", "remission", "i"])
@pytest.mark.parametrize("beam", ["ring", "Channel", "laser_id"])
@pytest.mark.parametrize("when", ["Time", "t", "GPS_Time"])
def test_cloudcompares_word_before_a_field_changes_nothing(light: str, beam: str, when: str, tmp_path: Path):
    """It writes the further fields of any file that it has read as scalar_NAME, into .ply and above text."""
    rows = "1 2 3 51 0 5.0\n-2 1 -3 204 1 5.1\n"
    (tmp_path / "p.xyz").write_text(f"//X Y Z Scalar_{light} Scalar_{beam} Scalar_{when}\n{rows}")
    found = read(tmp_path / "p.xyz")
    np.testing.assert_allclose(found.reflectance, [0.2, 0.8], rtol=1e-6)
    assert found.ring is not None and found.ring.tolist() == [0, 1]
    assert found.time is not None and found.time.tolist() == [5.0, 5.1] and not found.extra
    (tmp_path / "p.xyz").write_text(f"x y z scalar_{light} intensity scalar_ring\n1 2 3 51 102 7\n")
    own = read(tmp_path / "p.xyz")
    assert own.reflectance[0] == np.float32(0.4) and list(own.extra) == [f"scalar_{light}"], (
        "the plain name comes first"
    )


def test_intensity_scales_can_be_forced():
    values = np.array([0, 0.5, 1.0])
    np.testing.assert_allclose(reflectance_from(values, "byte"), values / 255, rtol=1e-6)
    np.testing.assert_allclose(reflectance_from(values, "uint16"), values / 65535, rtol=1e-6)
    np.testing.assert_array_equal(reflectance_from(np.array([0, 1], np.uint8), "unit"), [0, 1])


def test_points_without_return_are_dropped_and_counted(scan: Scan, tmp_path: Path):
    table = np.column_stack([scan.xyz, scan.reflectance])
    table[3, 0], table[5, 2], table[7, 3] = np.nan, np.inf, np.nan
    table[9, :3] = 0
    table.astype(np.float32).tofile(tmp_path / "scan.bin")
    found, dropped = read_with_report(tmp_path / "scan.bin")
    assert dropped == 3
    dark = replace(scan, reflectance=np.where(np.arange(N) == 7, np.float32(0), scan.reflectance))
    same(found, dark[np.setdiff1d(np.arange(N), [3, 5, 9])], ("xyz", "reflectance"))


def test_single_intensities_above_a_scale_do_not_change_it():
    values = np.random.default_rng(0).random(5000).astype(np.float32)
    for high in (1.5, 2.0, 300.0):
        bright = np.append(values, np.float32(high))
        np.testing.assert_array_equal(reflectance_from(bright), np.append(values, np.float32(1)))
    assert reflectance_from(values * np.float32(1.5))[:100].mean() > 0.5
    whole = np.round(values * 255)
    np.testing.assert_array_equal(reflectance_from(whole), (whole / np.float64(255)).astype(np.float32))
    assert reflectance_from(np.append(whole, np.float32(300)))[:-1].mean() > 0.4
    np.testing.assert_allclose(reflectance_from(np.append(whole, whole * 200)).max(), whole.max() * 200 / 65535)
    with pytest.raises(FileError, match="expected an intensity of 0-1"):
        reflectance_from(np.append(values, np.float32(2)), "unit")
    with pytest.raises(FileError, match="found -30 to 0; --intensity none takes it for 0"):
        reflectance_from(np.linspace(-30, 0, 9, dtype=np.float32))
    with pytest.raises(FileError, match="found 0 to 800000; --intensity none takes it for 0"):
        reflectance_from(np.arange(9, dtype=np.uint32) * 100_000)


def test_nuscenes_files_that_someone_scaled_stay_so(tmp_path: Path):
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.normal(0, 10, (500, 3)), rng.random(500), np.zeros(500)]).astype("<f4")
    table.tofile(tmp_path / "a.pcd.bin")
    np.testing.assert_array_equal(read(tmp_path / "a.pcd.bin").reflectance, table[:, 3])
    table[:, 3] = np.round(table[:, 3] * 3)  # dark, but whole numbers
    table.tofile(tmp_path / "b.pcd.bin")
    np.testing.assert_allclose(read(tmp_path / "b.pcd.bin").reflectance, table[:, 3] / 255, rtol=1e-6)


def test_nuscenes_intensities_are_scaled_once(tmp_path: Path):
    rng = np.random.default_rng(0)
    light = rng.integers(0, 256, 500).astype("<f4")
    for name, values in (("bright", light), ("dark", light % 2)):  # of which a scan alone would not tell the scale
        path = tmp_path / f"{name}.pcd.bin"
        np.column_stack([rng.normal(0, 10, (500, 3)), values, np.zeros(500)]).astype("<f4").tofile(path)
        for word, scale in (("auto", 255), ("byte", 255), ("uint16", 65535)):
            found = read(path, intensity=word)
            np.testing.assert_array_equal(found.reflectance, (values / np.float64(scale)).astype(np.float32))
            assert not found.extra
    np.testing.assert_array_equal(read(path, intensity="unit").reflectance, light % 2)
    with pytest.raises(FileError, match=r"bright.pcd.bin: expected an intensity of 0-1 \(unit\), found 0 to 255"):
        read(tmp_path / "bright.pcd.bin", intensity="unit")
    np.testing.assert_array_equal(read(path, rings=(0, 3)).reflectance, (light % 2 / np.float64(255)).astype("f4"))


def test_rings_of_one_sensor_are_read_by_the_numbers_of_the_file(scan: Scan, tmp_path: Path):
    """Two sensors, whose lasers are numbered as they fire: together their rings would be those of neither."""
    firing = np.array([0, 5, 1, 6, 2, 7, 3, 8, 4, 9], np.int32)
    lower = replace(scan, xyz=scan.xyz * np.float32([1, 1, 1.1]), ring=firing[scan.ring] + 10)
    both = Scan(*(np.concatenate([getattr(replace(scan, ring=firing[scan.ring]), name), getattr(lower, name)])
                  for name in ("xyz", "reflectance", "ring")))  # fmt: skip
    write(tmp_path / "both.pcd", both)
    found, dropped = read_with_report(tmp_path / "both.pcd", rings=(10, 19))
    assert dropped == 0
    same(found, replace(lower, ring=scan.ring), ("xyz", "reflectance", "ring"))
    same(read(tmp_path / "both.pcd", rings=(0, 9)), scan, ("xyz", "ring"))
    assert read(tmp_path / "both.pcd").ring.max() == 19
    with pytest.raises(FileError, match=r"both.pcd: expected rings 20-30, found rings 0-19"):
        read(tmp_path / "both.pcd", rings=(20, 30))
    write(tmp_path / "plain.bin", scan)
    with pytest.raises(FileError, match="expected rings 0-9, found points without a ring field: only x, y, z, "):
        read(tmp_path / "plain.bin", rings=(0, 9))


def test_rings_count_from_the_top(scan: Scan):
    np.testing.assert_array_equal(rings_from_top(scan.ring, scan.xyz), scan.ring)
    np.testing.assert_array_equal(rings_from_top(9.0 - scan.ring, scan.xyz), scan.ring)
    firing = np.array([0, 5, 1, 6, 2, 7, 3, 8, 4, 9])  # laser ids in the order they fire
    np.testing.assert_array_equal(rings_from_top(firing[scan.ring], scan.xyz), scan.ring)


def test_rings_of_empty_beams_at_the_top_are_not_lost():
    """30 of 32 rings, from the bottom, are the lower 30 of an HDL-32E."""
    grid = SENSORS["hdl-32e"].points(np.full((32, 1024), 10, np.float32))
    ring = np.repeat(np.arange(2, 32), 1024)
    np.testing.assert_array_equal(rings_from_top(31 - ring, grid[2:].reshape(-1, 3)), ring)


@pytest.mark.parametrize("unit", [1e-3, 1e-6, 1e-9])
def test_whole_times_find_their_unit(unit: float):
    seconds = np.linspace(0, 0.1, 101)
    found = seconds_from(np.round((1.6e9 + seconds) / unit).astype(np.int64))
    np.testing.assert_allclose(found, seconds, atol=2 * unit + 1e-6)


def test_semantic_kitti_labels(scan: Scan, tmp_path: Path):
    write(tmp_path / "scan.bin", scan)
    raws = np.array([0, 10, 11, 15, 18, 20, 30, 31, 32, 40, 44, 48, 49, 50, 51, 70, 71, 72, 80, 81])
    np.testing.assert_array_equal(CLASS_OF_RAW[raws], np.arange(20))  # the published inverse map
    assert (CLASS_OF_RAW >= 0).sum() == 34
    words = raws[scan.label].astype("<u4") | np.uint32(77 << 16)  # the high half is the instance
    words.tofile(tmp_path / "scan.label")
    np.testing.assert_array_equal(read_labels(tmp_path / "scan.label", N), scan.label)
    np.testing.assert_array_equal(read(tmp_path / "scan.bin", labels=tmp_path / "scan.label").label, scan.label)


def test_labels_stay_with_their_points_when_some_are_dropped(scan: Scan, tmp_path: Path):
    xyz = scan.xyz.copy()
    xyz[::5] = 0
    write(tmp_path / "scan.bin", Scan(xyz, scan.reflectance))
    raw = np.where(np.arange(N) % 5 == 1, 50, 40).astype("<u4")
    raw.tofile(tmp_path / "scan.label")
    found = read(tmp_path / "scan.bin", labels=tmp_path / "scan.label")
    np.testing.assert_array_equal(found.label, np.where(np.arange(N) % 5 == 1, 13, 9)[np.arange(N) % 5 != 0])


def test_labels_of_another_data_set_are_left_out(scan: Scan, tmp_path: Path):
    write(tmp_path / "scan.pcd", replace(scan, label=scan.label + 100))
    assert read(tmp_path / "scan.pcd").label is None


def test_times_of_which_some_are_unknown_are_kept_once(scan: Scan, tmp_path: Path):
    time = np.where(np.arange(N) % 7 == 0, np.nan, scan.time)
    write(tmp_path / "scan.ply", replace(scan, time=time))
    again = read(tmp_path / "scan.ply")
    np.testing.assert_array_equal(again.time, time)
    assert not again.extra


def test_float32_holds_what_a_turn_may_hold_and_maps_are_told(tmp_path: Path):
    """UTM and the like would be off by centimetres in float32; they are refused, whatever type they are of."""
    edge = np.nextafter(np.float32(MAX_METRES), np.float32(0))
    assert np.spacing(edge) / 2 < 1e-3
    table = np.ones((9, 4)) * [100, 5, 1, 0.5] + [[500_000, 5_400_000, 0, 0]]
    for kind in (np.float64, np.float32):
        np.save(tmp_path / "utm.npy", table.astype(kind))
        with pytest.raises(FileError, match=r"at most 10000, found a coordinate of 5.4e\+06, as of a map: subtract"):
            read(tmp_path / "utm.npy")
    table[:, :3] = np.random.default_rng(0).normal(0, 20_000, (9, 3))
    np.save(tmp_path / "mm.npy", table)
    with pytest.raises(
        FileError, match=r"at most 10000, found a coordinate of .*: are they centimetres or millimetres\?$"
    ):
        read(tmp_path / "mm.npy")


def test_arrays_of_more_dimensions_are_no_columns(tmp_path: Path):
    np.savez(tmp_path / "grid.npz", **{axis: np.ones((4, 5)) for axis in "xyz"})
    with pytest.raises(FileError, match=r"points of one turn, found an array \(4, 5\)$"):
        read(tmp_path / "grid.npz", intensity="none")


def test_every_usual_name_is_lower_case_and_unique():
    names = [usual for usuals in NAMES.values() for usual in usuals]
    assert len(names) == len(set(names)) and all(name == name.lower() for name in names)


@pytest.mark.parametrize("form", ["pcd", "ply", "csv"])
@pytest.mark.parametrize("first", [1_689_000_000_123_456_789, 2**64 - 8, -(2**62) - 1])
def test_whole_numbers_of_64_bits_in_text_keep_every_digit(form: str, first: int, tmp_path: Path):
    """A float64 does not tell nanoseconds since 1970 apart."""
    stamps = [first + i for i in range(5)]
    lines = [f"{i + 1} 0 0 0.5 {stamp}" for i, stamp in enumerate(stamps)]
    kind = "int64" if first < 0 else "uint64"
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    heads = {
        "pcd": "FIELDS x y z intensity stamp\nSIZE 4 4 4 4 8\nTYPE F F F F "
        f"{'I' if first < 0 else 'U'}\nWIDTH 5\nHEIGHT 1\nPOINTS 5\nDATA ascii\n",
        "ply": f"ply\nformat ascii 1.0\nelement vertex 5\n{properties}property {kind} stamp\nend_header\n",
        "csv": "x y z intensity stamp\n",
    }
    path = tmp_path / f"a.{form}"
    path.write_text(heads[form] + "\n".join(lines) + "\n", "ascii")
    assert [int(stamp) for stamp in read(path).extra["stamp"]] == stamps


def test_a_column_of_fractions_beyond_53_bits_stays_as_it_is(tmp_path: Path):
    path = tmp_path / "a.csv"
    path.write_text("x,y,z,intensity,stamp\n1,0,0,0.5,1e17\n2,0,0,0.5,1.5\n", "ascii")
    np.testing.assert_array_equal(read(path).extra["stamp"], [1e17, 1.5])


def test_classes_are_written_as_semantic_kitti_has_them():
    """The published table from training classes back to raw ids."""
    published = [0, 10, 11, 15, 18, 20, 30, 31, 32, 40, 44, 48, 49, 50, 51, 70, 71, 72, 80, 81]
    np.testing.assert_array_equal(RAW, published)
    np.testing.assert_array_equal(CLASS_OF_RAW[RAW], np.arange(20))
