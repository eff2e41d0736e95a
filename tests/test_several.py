"""Fields of several numbers a point stay, each number as a field, through files and bags."""

from pathlib import Path

import numpy as np
import pytest
from test_bags import message
from test_file_layouts import N, pcd_bytes

from lidarsynth.cli.main import main
from lidarsynth.data.bag_records import POINTS, typestore
from lidarsynth.data.bags import open_bag
from lidarsynth.files.formats import read
from lidarsynth.files.several import listed, numbered, several_left_out
from lidarsynth.lidar.sensor import get_sensor
from lidarsynth.streets.reader import SyntheticStreets


def street() -> dict[str, np.ndarray]:
    scan = SyntheticStreets(5, 1, get_sensor("vlp-16")).image(0).to_scan()[:N]
    columns = {axis: scan.xyz[:, i] for i, axis in enumerate("xyz")}
    return columns | {"intensity": scan.reflectance, "ring": scan.ring.astype(np.uint16)}


def signs(columns: int, kind: str = "f4") -> np.ndarray:
    return (np.random.default_rng(columns).random((N, columns)) * 200).astype(kind)


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_each_number_of_a_pcd_is_a_field(encoding: str, tmp_path: Path):
    more = {"normal": signs(3), "_": signs(5, "u1"), "fpfh": signs(33), "sets": signs(2, "u2")}
    (tmp_path / "a.pcd").write_bytes(pcd_bytes({**more, **street()}, encoding))
    scan = read(tmp_path / "a.pcd")
    assert list(scan.extra) == [f"{n}_{i}" for n in ("normal", "fpfh", "sets") for i in range(more[n].shape[1])]
    for name in ("normal", "fpfh", "sets"):
        for i, column in enumerate(more[name].T):
            np.testing.assert_array_equal(scan.extra[f"{name}_{i}"], column)
    assert scan.extra["sets_1"].dtype == np.uint16


@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
def test_they_come_through_the_verbs(suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    scan, normal = street(), signs(3)
    (tmp_path / "a.pcd").write_bytes(pcd_bytes({**scan, "normal": normal, "fpfh": signs(33)}, "binary"))
    assert main(["info", str(tmp_path / "a.pcd")]) in (None, 0)
    assert " normal_0 normal_1 normal_2 fpfh_0 ... fpfh_32\n" in capsys.readouterr().out
    out = tmp_path / f"b{suffix}"
    main(["complete", str(tmp_path / "a.pcd"), "--out", str(out), "--model", "nearest", "--no-picture"])
    whole = read(out)
    old = whole.extra["new"] == 0
    assert len(whole) > N and not whole.extra["normal_2"][~old].any()
    places = {bytes(point): row for point, row in zip(read(tmp_path / "a.pcd").xyz, normal, strict=True)}
    found = np.stack([whole.extra[f"normal_{i}"][old] for i in range(3)], 1)
    np.testing.assert_array_equal(found, [places[bytes(point)] for point in whole.xyz[old]])


def test_they_come_through_bags(tmp_path: Path):
    pytest.importorskip("mcap", reason="mcap comes with the extra `ros`")
    from rosbags.rosbag1 import Writer

    scan, normal, store = street(), signs(3), typestore("ros1")
    points = np.zeros(N, [(name, column.dtype) for name, column in scan.items()] + [("n", "f4", 3), ("pad", "u1", 18)])
    for name, column in {**scan, "n": normal}.items():
        points[name] = column
    told = message(store, points[list(scan)], 0, False, True)
    told.fields.append(store.types["sensor_msgs/msg/PointField"]("normal", points.dtype.fields["n"][1], 7, 3))
    assert points.dtype.itemsize == told.point_step == 48
    with Writer(tmp_path / "a.bag") as writer:
        topic = writer.add_connection("/points", POINTS, typestore=store)
        writer.write(topic, 10**9, store.serialize_ros1(told, POINTS))
    main(["complete", str(tmp_path / "a.bag"), "--out", str(tmp_path / "b.mcap"), "--model", "nearest"])
    with open_bag(tmp_path / "b.mcap") as bag:
        fields = next(bag.clouds("/points")).fields
    old = fields["new"] == 0
    found = np.stack([fields[f"normal_{i}"] for i in range(3)], 1)
    points = zip(*(scan[axis].tolist() for axis in "xyz"), strict=True)
    places = dict(zip(points, normal, strict=True))
    xyz = zip(*(fields[axis][old].tolist() for axis in "xyz"), strict=True)
    np.testing.assert_array_equal(found[old], [places[point] for point in xyz])
    assert not found[~old].any() and (~old).any()


def test_too_many_are_left_out_and_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "a.pcd").write_bytes(pcd_bytes({**street(), "shot": signs(352), "more": signs(1344)}, "binary"))
    said = "found more of 1344: left out"
    with pytest.warns(UserWarning, match=said):
        scan = read(tmp_path / "a.pcd")
    assert len(scan.extra) == 352 and "more_0" not in scan.extra
    main(["complete", str(tmp_path / "a.pcd"), "--out", str(tmp_path / "b.ply"), "--model", "nearest", "--no-picture"])
    assert said in capsys.readouterr().err and "shot_351" in read(tmp_path / "b.ply").extra
    main(["info", str(tmp_path / "a.pcd")])
    assert "left out" in (out := capsys.readouterr().out) and "shot_0 ... shot_351" in out


def test_names_are_no_others():
    assert numbered(["a", "a", "_", "a_1", "b"], [2, 2, 9, 1, 1]) == \
        [["a_0", "a_1_2"], ["a_0_2", "a_1_3"], [], ["a_1"], ["b"]]  # fmt: skip
    assert several_left_out(["a", "_"], [385, 4096]) is not None and several_left_out(["_", "b"], [4096, 1]) is None
    assert listed(["a_0", "a_1", "b_7", "b_8", "b_9", "b_10", "b_11", "c", "b_13"]) == \
        ["a_0", "a_1", "b_7", "...", "b_11", "c", "b_13"]  # fmt: skip
