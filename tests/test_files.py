"""Scan files: what is written comes back exactly, and real scans read as what they are."""

import io
import json
import os
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from full_scan import full_scan, same

from lidarsynth.data.folder import folder
from lidarsynth.files.formats import READERS, WRITERS, left_out, read, read_image, read_with_report, write
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import SENSORS


@pytest.fixture
def scan() -> Scan:
    return full_scan()


@pytest.fixture
def image() -> RangeImage:
    rng = np.random.default_rng(1)
    sensor = SENSORS["hdl-64e-kitti"].resized(height=16, width=32)
    mask = rng.random(sensor.ray_angles()[0].shape) < 0.7
    distance = np.where(mask, rng.uniform(2, 60, mask.shape), 0).astype(np.float32)
    reflectance = np.where(mask, rng.random(mask.shape), 0).astype(np.float32)
    return RangeImage(distance, reflectance, mask, sensor, label=np.where(mask, 9, 0))


@pytest.mark.parametrize("suffix", [".npz", ".pcd", ".ply"])
def test_round_trip_keeps_every_field(suffix: str, scan: Scan, tmp_path: Path):
    write(tmp_path / f"scan{suffix}", scan)
    same(read(tmp_path / f"scan{suffix}"), scan)


@pytest.mark.parametrize("suffix", list(WRITERS))
def test_round_trip_of_points_and_reflectance_alone(suffix: str, scan: Scan, tmp_path: Path):
    write(tmp_path / f"scan{suffix.upper()}", scan)
    same(read(tmp_path / f"scan{suffix.upper()}"), scan, ("xyz", "reflectance"))
    bare = Scan(scan.xyz, scan.reflectance)
    write(tmp_path / f"bare{suffix}", bare)
    found = read(tmp_path / f"bare{suffix}")
    same(found, bare)
    assert found.ring is None and found.time is None and found.label is None


def test_a_range_image_comes_back_with_its_sensor(image: RangeImage, tmp_path: Path):
    write(tmp_path / "image.npz", image)
    found = read_image(tmp_path / "image.npz")
    assert found.sensor == image.sensor and found.xyz is None
    for name in ("range", "reflectance", "mask", "label"):
        np.testing.assert_array_equal(getattr(found, name), getattr(image, name))
    measured = replace(image, label=None, xyz=image.points())
    write(tmp_path / "image.npz", measured)
    assert read_image(tmp_path / "image.npz").label is None
    np.testing.assert_array_equal(read_image(tmp_path / "image.npz").xyz, measured.xyz)


@pytest.mark.parametrize("suffix", list(WRITERS))
def test_a_range_image_is_read_as_its_points(suffix: str, image: RangeImage, tmp_path: Path):
    write(tmp_path / f"image{suffix}", image)
    scan = read(tmp_path / f"image{suffix}")
    fields = ("xyz", "reflectance") if suffix in (".bin", ".npy") else ("xyz", "reflectance", "ring", "label")
    same(scan, image.to_scan(), fields)


def test_writing_is_the_same_every_time(scan: Scan, image: RangeImage, tmp_path: Path):
    for suffix in WRITERS:
        for name, what in (("scan", scan), ("image", image)):
            write(tmp_path / f"a{suffix}", what)
            write(tmp_path / f"b{suffix}", what)
            assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes(), (name, suffix)


def test_a_written_file_has_the_usual_permissions(scan: Scan, tmp_path: Path):
    (tmp_path / "other").write_bytes(b"")
    write(tmp_path / "scan.ply", scan)
    assert os.stat(tmp_path / "scan.ply").st_mode == os.stat(tmp_path / "other").st_mode


@pytest.mark.parametrize(
    ("name", "points", "dropped", "rings"),
    [  # the points with a return, counted once with plain numpy
        ("nuscenes_hdl32e.pcd.bin", 34688, 0, (0, 31)),
        ("fast_gicp_251370668.pcd", 64056, 5032, None),
        ("pandaset_pandar64_0001.pcd", 77295, 41489, (1, 63)),
        ("sensorscalibration_top.pcd", 80748, 0, (3, 63)),
        ("argoverse2_2xvlp32c.feather", 99229, 0, (0, 63)),
    ],
)
def test_real_scans_of_other_sensors(name: str, points: int, dropped: int, rings: tuple[int, int] | None, shared: Path):
    start = time.perf_counter()
    scan, lost = read_with_report(shared / "scans" / "other" / name)
    assert time.perf_counter() - start < 3  # 0.1 s here; LZF in pure Python is the slowest
    assert (len(scan), lost) == (points, dropped)
    assert (None if scan.ring is None else (scan.ring.min(), scan.ring.max())) == rings
    assert scan.reflectance.min() >= 0 and 0.3 < scan.reflectance.max() <= 1


def test_real_kitti_scans(shared: Path):
    folder = shared / "scans" / "test"
    path = folder / "odometry_000000.bin"
    scan = read(path, labels=path.with_suffix(".label"))
    expected = np.fromfile(path, "<f4").reshape(-1, 4)
    np.testing.assert_array_equal(scan.xyz, expected[:, :3])
    np.testing.assert_array_equal(scan.reflectance, expected[:, 3])
    share = np.bincount(scan.label, minlength=20) / len(scan)
    assert share[[9, 11, 13, 15]].sum() > 0.5  # a street: road, sidewalk, buildings, vegetation


def test_projected_semantic_scans_read_as_points(shared: Path):
    path = shared / "scans" / "semantic" / "seq00_0.npz"
    scan = read(path)
    with np.load(path) as arrays:
        known = np.isfinite(arrays["xyz"]).all(-1) & (arrays["xyz"] != 0).any(-1)
        np.testing.assert_array_equal(scan.xyz, arrays["xyz"][known])
        np.testing.assert_array_equal(scan.label, arrays["label"][known])
        np.testing.assert_array_equal(scan.ring, np.nonzero(known)[0])


def test_a_kitti_scan_reads_in_ten_milliseconds(tmp_path: Path):
    rng = np.random.default_rng(0)
    rng.uniform(0.1, 1, (125_000, 4)).astype(np.float32).tofile(tmp_path / "scan.bin")

    def seconds() -> float:
        start = time.perf_counter()
        read(tmp_path / "scan.bin")
        return time.perf_counter() - start

    assert min(seconds() for _ in range(20)) < 0.05  # 4 ms on a free core; five times that on a crowded one


def test_every_reader_has_a_suffix_and_every_writer_a_reader():
    assert all(suffix.startswith(".") and suffix == suffix.lower() for suffix in READERS)
    assert WRITERS.keys() <= READERS.keys()


def test_our_npz_is_plain_numpy(scan: Scan, image: RangeImage, tmp_path: Path):
    """Another program opens it with numpy.load and needs no pickle."""
    write(tmp_path / "scan.npz", scan)
    write(tmp_path / "image.npz", image)
    with np.load(tmp_path / "scan.npz", allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["xyz"], scan.xyz)
    with np.load(tmp_path / "image.npz", allow_pickle=False) as arrays:
        assert json.loads(str(arrays["sensor"]))["width"] == 32
    assert zipfile.is_zipfile(io.BytesIO((tmp_path / "scan.npz").read_bytes()))


CARLA = """ply
format ascii 1.0
element vertex 2
property float32 x
property float32 y
property float32 z
property float32 CosAngle
property uint32 ObjIdx
property uint8 ObjTag
property short high
end_header
9.5 0 -1.25 0.9731 4000000000 7 32767
9.5 1 -1.25 0.5 12 255 32768
"""


def properties(path: Path) -> list[list[str]]:
    header = path.read_bytes().split(b"end_header")[0].decode()
    return [line.split()[1:] for line in header.splitlines() if line.startswith("property")]


def test_fields_of_an_ascii_ply_keep_the_types_it_declares(tmp_path: Path):
    (tmp_path / "carla.ply").write_text(CARLA)
    found = read(tmp_path / "carla.ply", intensity="none")
    kinds = {name: column.dtype.str[1:] for name, column in found.extra.items()}
    assert kinds == {"CosAngle": "f4", "ObjIdx": "u4", "ObjTag": "u1", "high": "f8"}, "32768 is no short"
    write(tmp_path / "again.ply", found)
    written = properties(tmp_path / "again.ply")
    assert written[4:7] == [["float", "CosAngle"], ["uint", "ObjIdx"], ["uchar", "ObjTag"]]
    (tmp_path / "late.ply").write_text(CARLA.replace("CosAngle", "t").replace("0.9731", "0.5000000001"))
    np.testing.assert_allclose(read(tmp_path / "late.ply", intensity="none").time - 0.5, [1e-10, 0], atol=1e-14)


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        (np.array([-5, 7]), "int"),
        (np.array([0, 2**32 - 1]), "uint"),
        (np.array([0, 2**31], np.uint64), "uint"),
        (np.array([-1, 2**32]), "double"),
        (np.array([0, 3 * 2**61], np.uint64), "double"),
    ],
)
def test_whole_numbers_of_64_bits_are_written_in_types_that_ply_has(values: np.ndarray, kind: str, tmp_path: Path):
    write(tmp_path / "a.ply", Scan(np.ones((2, 3), np.float32), extra={"of": values}))
    assert properties(tmp_path / "a.ply")[-1] == [kind, "of"]
    assert read(tmp_path / "a.ply").extra["of"].tolist() == values.tolist()


@pytest.mark.parametrize("value", [2**53 + 1, -(2**53) - 1, 2**63 - 1])
def test_what_no_type_of_ply_holds_stays_of_64_bits(value: int, tmp_path: Path):
    """Times in nanoseconds: some readers do not know the type, ours gives them back as they were."""
    scan = Scan(np.ones((2, 3), np.float32), extra={"of": np.array([0, value])})
    write(tmp_path / "a.ply", scan)
    assert properties(tmp_path / "a.ply")[-1] == ["int64", "of"]
    np.testing.assert_array_equal(read(tmp_path / "a.ply", intensity="none").extra["of"], scan.extra["of"])


def test_a_file_whose_companions_names_would_be_too_long_is_read(tmp_path: Path):
    path = tmp_path / ("x" * 250 + ".bin")
    np.ones((3, 4), np.float32).tofile(path)
    scan, dropped = read_with_report(path)
    assert (len(scan), dropped, left_out(path, scan, dropped)) == (3, 0, [])
    assert [frame.labels for frame in folder(tmp_path).frames] == [None]
