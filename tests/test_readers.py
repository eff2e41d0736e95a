"""Each reader on a miniature tree in its data set's exact layout."""

import json
from pathlib import Path

import numpy as np
import pytest

from lidarsynth.data.folder import folder
from lidarsynth.data.frames import read_velodyne
from lidarsynth.data.kitti import ODOMETRY_TO_RAW, RAW_TRAIN, RAW_VAL, kitti, kitti_odometry, kitti_raw, raw_test_drives
from lidarsynth.data.kitti360 import kitti360
from lidarsynth.data.nuscenes import nuscenes, rows
from lidarsynth.files.fields import FileError
from lidarsynth.files.formats import read, write
from lidarsynth.lidar.scan import Scan


def points(seed: int, columns: int = 4) -> np.ndarray:
    """(200, columns) float32: x y z within 50 m, reflectance in [0, 1]; with 5, intensity 0-255 and a ring."""
    rng = np.random.default_rng(seed)
    table = np.concatenate([rng.uniform(-50, 50, (200, 3)), rng.random((200, 1))], axis=1)
    if columns == 5:
        elevation = np.arctan2(table[:, 2], np.hypot(table[:, 0], table[:, 1]))
        rank = np.argsort(np.argsort(elevation))  # ring 0 is the lowest beam
        table = np.column_stack([table[:, :3], np.floor(table[:, 3] * 255), rank * 32 // 200])
    return table.astype("<f4")


def put(path: Path, table: np.ndarray) -> np.ndarray:
    path.parent.mkdir(parents=True, exist_ok=True)
    table.tofile(path)
    return table


def same(scan: Scan, table: np.ndarray) -> None:
    np.testing.assert_array_equal(scan.xyz, table[:, :3])
    np.testing.assert_array_equal(scan.reflectance, table[:, 3])


def drive(root: Path, name: str, frames: list[int]) -> None:
    for frame in frames:
        put(root / name[:10] / name / "velodyne_points" / "data" / f"{frame:010d}.bin", points(frame))


def test_kitti_raw_takes_the_odometry_frames_for_training_and_the_rest_for_testing(tmp_path: Path):
    drive(tmp_path, "2011_09_30_drive_0016_sync", [0, 1, 270, 271])  # sequence 04 ends at 270
    drive(tmp_path, "2011_09_30_drive_0028_sync", [1099, 1100, 5170, 5171])  # sequence 08 is 1100 to 5170
    drive(tmp_path, "2011_09_26_drive_0015_sync", [3])  # road
    drive(tmp_path, "2011_09_26_drive_0001_sync", [2])  # city
    drive(tmp_path, "2011_09_26_drive_0067_sync", [0])  # sequence 03, in no split
    train = kitti_raw(tmp_path, "train")
    assert [train.name(i) for i in range(len(train))] == [
        ("kitti", "2011_09_30_drive_0016_sync", f"{frame:010d}") for frame in (0, 1, 270)
    ]
    same(train[2], points(270))
    assert len(train.missing) == len(RAW_TRAIN) - 1
    assert [kitti_raw(tmp_path, "val").name(i).frame for i in range(2)] == ["0000001100", "0000005170"]
    test = kitti_raw(tmp_path, "test")
    assert [test.name(i).sequence[11:] for i in range(len(test))] == ["drive_0001_sync", "drive_0015_sync"]
    assert len(kitti_raw(tmp_path, "all")) == 4 + 4 + 3
    assert len(kitti(tmp_path, "train")) == 3, "kitti recognises the raw layout"


def test_kitti_raw_splits_are_those_of_the_published_program(reference: Path):
    facts = json.loads((reference / "facts" / "kitti_raw_splits.json").read_text())
    raw = {
        sequence: tuple(entry[k] for k in ("drive", "first", "last"))
        for sequence, entry in facts["odometry_to_raw"].items()
    }
    assert raw == ODOMETRY_TO_RAW
    assert list(RAW_TRAIN) == facts["train_sequences"]
    assert list(RAW_VAL) == facts["validation_sequences"]
    assert raw_test_drives() == [entry["drive"] for entry in facts["test_drives_in_order"]]
    assert sum(last - first + 1 for _, first, last in (ODOMETRY_TO_RAW[s] for s in RAW_TRAIN)) == 18329


@pytest.mark.parametrize("inner", ["sequences", "dataset/sequences"])
def test_kitti_odometry_has_labels_where_there_are_files(tmp_path: Path, inner: str):
    for sequence, frames in {"00": [0, 1], "08": [7], "11": [0]}.items():
        for frame in frames:
            put(tmp_path / inner / sequence / "velodyne" / f"{frame:06d}.bin", points(frame))
    words = np.tile(np.array([40, 10 | 3 << 16, 252, 0, 70], "<u4"), 40)  # road, car of instance 3, moving car, ...
    put(tmp_path / inner / "00" / "labels" / "000001.label", words)
    train = kitti(tmp_path, "train")
    assert [train.name(i) for i in range(len(train))] == [("kitti", "00", "000000"), ("kitti", "00", "000001")]
    assert train[0].label is None
    np.testing.assert_array_equal(train[1].label, np.tile([9, 1, 1, 0, 15], 40))
    same(train[1], points(1))
    assert kitti_odometry(tmp_path, "val").name(0) == ("kitti", "08", "000007")
    assert kitti_odometry(tmp_path, "test").name(0) == ("kitti", "11", "000000")
    assert len(kitti_odometry(tmp_path, "all")) == 4


def test_kitti360_has_lidargens_split(tmp_path: Path):
    root = tmp_path / "data_3d_raw"
    for sequence in (0, 2, 3, 10):
        for frame in (1, 0):
            name = f"2013_05_28_drive_{sequence:04d}_sync"
            put(root / name / "velodyne_points" / "data" / f"{frame:010d}.bin", points(10 * sequence + frame))
    train = kitti360(tmp_path)
    assert [(train.name(i).sequence[-9:-5], train.name(i).frame) for i in range(len(train))] == [
        ("0003", "0000000000"), ("0003", "0000000001"), ("0010", "0000000000"), ("0010", "0000000001"),
    ]  # fmt: skip
    same(train[3], points(101))
    assert train.missing == ("0004", "0005", "0006", "0007", "0009")
    assert [kitti360(root, "test").name(i).sequence[-9:-5] for i in range(4)] == ["0000", "0000", "0002", "0002"]
    assert len(kitti360(tmp_path, "all")) == 8
    with pytest.raises(ValueError, match="expected a split of train, test, all, found 'val'"):
        kitti360(tmp_path, "val")


def nuscenes_tree(root: Path, version: str = "v1.0-mini", lidarseg: bool = True) -> None:
    """Two scenes of one sample each; each sample has a camera row, a key frame and a sweep of LIDAR_TOP."""
    tables: dict[str, list[dict]] = {name: [] for name in ("scene", "sample", "sample_data", "lidarseg")}
    tables["sensor"] = [
        {"token": f"s{i}", "channel": c, "modality": ""} for i, c in enumerate(["CAM_FRONT", "LIDAR_TOP"])
    ]
    tables["calibrated_sensor"] = [
        {"token": f"c{i}", "sensor_token": f"s{i}", "rotation": [1, 0, 0, 0]} for i in (0, 1)
    ]
    names = {17: "vehicle.car", 0: "noise", 24: "flat.driveable_surface"}
    tables["category"] = [{"token": f"k{index}", "name": name, "index": index} for index, name in names.items()]
    for scene in (1, 0):
        tables["scene"].append({"token": f"scene{scene}", "name": f"scene-{scene:04d}"})
        tables["sample"].append({"token": f"sample{scene}", "scene_token": f"scene{scene}", "timestamp": 5 + scene})
        for kind, folder_, key in (("cam", "samples/CAM_FRONT", True), ("key", "samples/LIDAR_TOP", True),
                                   ("swp", "sweeps/LIDAR_TOP", False)):  # fmt: skip
            name = f"{folder_}/n{scene}.pcd.bin"
            row = {"token": f"{kind}{scene}", "sample_token": f"sample{scene}", "filename": name, "is_key_frame": key}
            row |= {"calibrated_sensor_token": f"c{int(kind != 'cam')}", "timestamp": scene * 10 + (kind == "swp")}
            tables["sample_data"].append(row)
            put(root / name, points(scene * 2 + (kind == "swp"), 5))
    put(root / "lidarseg" / version / "key0_lidarseg.bin", np.tile(np.array([17, 0, 24, 24], np.uint8), 50))
    tables["lidarseg"] = [
        {"token": "key0", "sample_data_token": "key0", "filename": f"lidarseg/{version}/key0_lidarseg.bin"}
    ]
    (root / version).mkdir()
    for name, content in tables.items():
        if lidarseg or name != "lidarseg":
            (root / version / f"{name}.json").write_text(json.dumps(content, indent=0))


def test_nuscenes_is_read_from_its_tables_and_turned_into_our_frame(tmp_path: Path):
    nuscenes_tree(tmp_path)
    reader = nuscenes(tmp_path)
    assert [reader.name(i) for i in range(len(reader))] == [
        ("nuscenes", "scene-0000", "0"),
        ("nuscenes", "scene-0001", "10"),
    ]
    table, scan = points(2, 5), reader[1]
    np.testing.assert_array_equal(scan.xyz[:, 0], table[:, 1])  # nuScenes' y is forward
    np.testing.assert_array_equal(scan.xyz[:, 1], -table[:, 0])  # and its x is right
    np.testing.assert_allclose(scan.reflectance, table[:, 3] / 255, rtol=1e-6)
    np.testing.assert_array_equal(scan.ring, 31 - table[:, 4])
    assert scan.label is None
    np.testing.assert_array_equal(reader[0].label, np.tile([1, 0, 9, 9], 50))
    sweeps = nuscenes(tmp_path, "mini", sweeps=True)
    assert [sweeps.name(i).frame for i in range(len(sweeps))] == ["0", "1", "10", "11"]


def test_nuscenes_says_which_tables_it_wants(tmp_path: Path):
    with pytest.raises(ValueError, match=r"expected one folder v1.0-\*; choose a split, found none"):
        nuscenes(tmp_path)
    nuscenes_tree(tmp_path, lidarseg=False)
    assert nuscenes(tmp_path)[0].label is None
    (tmp_path / "samples" / "LIDAR_TOP" / "n1.pcd.bin").unlink()
    assert nuscenes(tmp_path).missing == ("scene-0001",)
    nuscenes_tree(tmp_path, "v1.0-test")
    with pytest.raises(ValueError, match=r"found v1.0-mini, v1.0-test"):
        nuscenes(tmp_path)
    (tmp_path / "v1.0-test" / "sample.json").unlink()
    with pytest.raises(ValueError, match=r"sample.json.*No such file"):
        nuscenes(tmp_path, "test")


@pytest.mark.parametrize(
    ("table", "change", "told"),
    [
        ("sample_data", {"filename": None}, "expected rows with filename of type str, found None"),
        ("sample_data", {"filename": 5}, "expected rows with filename of type str, found 5"),
        ("sample_data", {"is_key_frame": "no"}, "expected rows with is_key_frame of type bool, found 'no'"),
        ("sample_data", {"timestamp": "soon"}, "expected rows with timestamp of type int, found 'soon'"),
        ("sample_data", {"sample_token": "gone"}, "expected tokens of sample.json, found 'gone', which it lacks"),
        ("sample", {"scene_token": "gone"}, "expected tokens of scene.json, found 'gone', which it lacks"),
        ("calibrated_sensor", {"sensor_token": "gone"}, "expected tokens of sensor.json, found 'gone', which it lacks"),
        ("scene", {"name": []}, r"expected rows with name of type str, found \[\]"),
        ("category", {"index": 300}, "expected an index of 0 to 255, found 300"),
        ("lidarseg", {"sample_data_token": {}}, "expected rows with sample_data_token of type str, found {}"),
    ],
)
def test_tables_of_other_rows_are_refused_in_one_line(table: str, change: dict, told: str, tmp_path: Path):
    """They ended with errors of Python."""
    nuscenes_tree(tmp_path)
    path = tmp_path / "v1.0-mini" / f"{table}.json"
    content = [row | change for row in json.loads(path.read_text())]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=rf"{table}.json: {told}") as error:
        nuscenes(tmp_path)
    assert "\n" not in str(error.value)
    lacking = next(iter(change))
    path.write_text(json.dumps([{key: value for key, value in row.items() if key != lacking} for row in content]))
    with pytest.raises(ValueError, match=rf"{table}.json: expected rows with {lacking} of type \w+, found none"):
        nuscenes(tmp_path)


def test_tables_are_read_piece_by_piece(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    table = [{"token": f"é{i}", "nested": {"a": [1, {"b": "]},{"}]}} for i in range(50)]
    path = tmp_path / "table.json"
    path.write_text(json.dumps(table, indent=1, ensure_ascii=False))
    for chunk in (1, 7, 64, 1 << 20):
        monkeypatch.setattr("lidarsynth.data.nuscenes.CHUNK", chunk)
        assert list(rows(path)) == table
    for text, found in (
        ("{}", r"a JSON list"),
        ('[{"a": 1}, {"b"', "expected JSON, found"),
        ("[1]", "JSON objects, found 1"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=found):
            list(rows(path))


def test_a_folder_may_hold_any_readable_scans(tmp_path: Path):
    put(tmp_path / "b.bin", points(1))
    put(tmp_path / "deep" / "er" / "a.bin", points(2))
    (tmp_path / "deep" / "notes.txt").write_text("not a scan")
    put(tmp_path / "b.label", np.full(200, 40, "<u4"))
    np.save(tmp_path / "c.npy", points(3))
    reader = folder(tmp_path)
    assert [reader.name(i) for i in range(len(reader))] == [
        ("files", ".", "b.bin"), ("files", ".", "c.npy"), ("files", "deep/er", "a.bin"),
    ]  # fmt: skip
    same(reader[1], points(3))
    assert (reader[0].label == 9).all() and reader[2].label is None
    with pytest.raises(ValueError, match="expected a folder of scans, found a file"):
        folder(tmp_path / "b.bin")


@pytest.mark.parametrize("reader", [kitti, kitti_raw, kitti_odometry, kitti360, folder])
def test_an_empty_root_is_refused(tmp_path: Path, reader):
    with pytest.raises(ValueError, match=r"expected .*found n"):
        reader(tmp_path)


def test_the_quick_way_reads_as_the_careful_one(tmp_path: Path):
    path, table = tmp_path / "a.bin", points(4)
    put(path, table)
    same(read_velodyne(path), table)
    table[[3, 4]] = [[0, 0, 0, 0.5], [1, np.nan, 1, 0]]
    put(path, table)
    same(read_velodyne(path), np.delete(table, [3, 4], axis=0))


def test_the_quick_way_refuses_what_the_careful_one_does(tmp_path: Path):
    path = tmp_path / "a.bin"
    for content, found in (
        (b"1.0 2.0 3.0 0.5\n" * 100, "binary float32 a point, found text"),
        ((points(0) * [100, 100, 1, 1]).astype("<f4").tobytes(), "are they centimetres"),
    ):
        path.write_bytes(content)
        for way in (lambda p: read(p, "unit"), read_velodyne):
            with pytest.raises(FileError, match=f"^{path}: expected .*{found}"):
                way(path)
    table = points(0)
    table[3, 0] = 900  # one that is far, and no more
    put(path, table)
    same(read_velodyne(path), table)


def test_the_quick_way_keeps_the_marks_beside(tmp_path: Path):
    scan = Scan(points(0)[:, :3], points(0)[:, 3], extra={"new": (np.arange(200) % 2).astype(np.uint8)})
    write(tmp_path / "a.bin", scan)
    np.testing.assert_array_equal(read_velodyne(tmp_path / "a.bin").extra["new"], scan.extra["new"])


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "found 0"),
        (points(0).tobytes()[:-5], "found 3195 bytes"),
        ((points(0) * [1e6, 1, 1, 1]).astype("<f4").tobytes(), r"at most 10000, found a coordinate of .*e\+07"),
        ((points(0) + 2).tobytes(), r"expected an intensity of 0-1"),
        (np.full((9, 4), np.nan, "<f4").tobytes(), "found none in 9"),
    ],
)
def test_broken_scans_are_named(tmp_path: Path, content: bytes, found: str):
    path = tmp_path / "sequences" / "00" / "velodyne" / "000000.bin"
    path.parent.mkdir(parents=True)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"^{path}: .*{found}"):
        kitti(tmp_path)[0]
