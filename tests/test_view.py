"""The viewer without a browser: bytes, rows, what lies beside, scans by number, the server's doors, the file."""

import base64
import gzip
import http.client
import json
import os
import re
import socket
import struct
import subprocess
import sys
import threading
import weakref
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

from lidarsynth.cli.main import main
from lidarsynth.data.bag_records import POINTS, Cloud, cloud_of, typestore
from lidarsynth.data.bag_writer import message_of, write_bag
from lidarsynth.data.bags import open_bag
from lidarsynth.files.formats import read, write
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.semantic_kitti import RAW
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.streets.actors import KINDS
from lidarsynth.verbs.file_kinds import file_lines
from lidarsynth.verbs.inputs import Loaded, Reading, inputs_of
from lidarsynth.verbs.placement import read_transform
from lidarsynth.viewer.beside import read_shown
from lidarsynth.viewer.colouring import colourings
from lidarsynth.viewer.packing import Shown, packed
from lidarsynth.viewer.page import STATIC, page, settings_of
from lidarsynth.viewer.pairs import compared
from lidarsynth.viewer.rows import rows_of
from lidarsynth.viewer.series import Stream, series_of
from lidarsynth.viewer.server import Show, address, serve

BOX = {"kind": "car", "centre": [10.0, -3.0, -1.0], "size": [4.2, 1.8, 1.5], "yaw": 0.3}


def turn(sensor: str = "vlp-16", far: float = 20.0) -> Scan:
    """A full turn of a sensor in a round room, ring by ring, its points told apart by their reflectance."""
    unit = SENSORS[sensor].resized(width=256)
    xyz = unit.points(np.full((unit.height, 256), far, np.float32)).reshape(-1, 3)
    ring = np.repeat(np.arange(unit.height), 256)
    return Scan(xyz, np.linspace(0.01, 1, len(xyz), dtype=np.float32), ring=ring)


def unpacked(data: bytes) -> tuple[dict, dict[str, np.ndarray]]:
    """As decode.js."""
    assert data[:4] == b"LSV1"
    length = struct.unpack("<I", data[4:8])[0]
    header, place, blocks = json.loads(data[8 : 8 + length]), 8 + length, {}
    assert place % 4 == 0
    for block in header["blocks"]:
        blocks[block["name"]] = np.frombuffer(data, "<" + block["type"], block["count"], place)
        place += -(-blocks[block["name"]].nbytes // 4) * 4
    assert place == len(data)
    return header, blocks


@pytest.mark.parametrize(("far", "kind", "step"), [(20.0, "i2", 7e-4), (250.0, "i2", 0.008), (4000.0, "f4", 1.0)])
def test_positions_come_back_within_half_a_step(far: float, kind: str, step: float):
    scan = turn(far=far)
    header, blocks = unpacked(packed(Shown(scan)))
    assert header["points"] == len(scan) and header["blocks"][0]["type"] == kind and header["step"] <= step
    tolerance = header["step"] / 2 * 1.001 if kind == "i2" else 0
    found = blocks["xyz"].reshape(-1, 3) * header["step"]
    np.testing.assert_allclose(found, scan.xyz, rtol=0, atol=tolerance)


def test_fields_come_back_and_absent_ones_do_not():
    scan = turn()
    n = len(scan)
    label, new = np.arange(n) % 20, np.arange(n) % 2
    full = Scan(scan.xyz, scan.reflectance, scan.ring, None, label, {"new": new, "confidence": np.linspace(-1, 2, n)})
    header, blocks = unpacked(packed(Shown(full, (BOX,), ("a note",))))
    assert header["boxes"] == [BOX] and header["notes"] == ["a note"]
    np.testing.assert_array_equal(blocks["label"], label)
    np.testing.assert_array_equal(blocks["new"], new)
    np.testing.assert_allclose(blocks["reflectance"] / 255, scan.reflectance, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(blocks["confidence"] / 255, np.clip(np.linspace(-1, 2, n), 0, 1), atol=0.5 / 255 + 1e-6)
    assert set(unpacked(packed(Shown(Scan(scan.xyz))))[1]) == {"xyz", "row"}


def test_raw_ids_are_shown_as_their_classes_and_labels_that_are_none_are_told(tmp_path: Path):
    """`realise` of a labelled `.bin` writes a `.ply` with `raw_label`; the page had no classes, and no word of why."""
    scan = turn()
    n = len(scan)
    words = RAW[np.arange(n) % 20] | np.uint32(7 << 16)
    write(tmp_path / "raw.ply", Scan(scan.xyz, scan.reflectance, extra={"raw_label": words}))
    header, blocks = unpacked(packed(read_shown(tmp_path / "raw.ply")))
    np.testing.assert_array_equal(blocks["label"], np.arange(n) % 20)
    assert header["notes"] == []
    for extra, told in (
        ({"label": np.full(n, 252, np.uint16)}, "training classes of 0-19 in the field label, found 252"),
        ({"Class": np.full(n, 1.5, np.float32)}, "training classes of 0-19 in the field Class, found 1.5"),
        ({"raw_label": np.full(n, 9, np.uint32)}, "SemanticKITTI's raw ids in the field raw_label, found others"),
    ):
        header, blocks = unpacked(packed(Shown(Scan(scan.xyz, extra=extra))))
        assert header["notes"] == [f"classes left out: expected {told}"] and "label" not in blocks


def test_confidences_none_of_which_is_a_number_are_told(tmp_path: Path):
    lost = {"confidence": np.full(5, np.nan, np.float32)}
    header, blocks = unpacked(packed(Shown(Scan(np.ones((5, 3), np.float32), extra=lost))))
    assert header["notes"] == ["confidence left out: expected numbers from 0 to 1, found none"]
    assert "confidence" not in blocks
    lost["confidence"][2] = 1
    header, blocks = unpacked(packed(Shown(Scan(np.ones((5, 3), np.float32), extra=lost))))
    assert header["notes"] == [] and blocks["confidence"].tolist() == [0, 0, 255, 0, 0]


def test_points_of_which_nobody_says_whether_they_are_new_are_told():
    lost = {"new": np.array([np.nan, 1, 0, 1, 0], np.float32)}
    header, blocks = unpacked(packed(Shown(Scan(np.ones((5, 3), np.float32), extra=lost))))
    assert header["notes"] == ["new is no number at 1 point; shown as measured"]
    assert blocks["new"].tolist() == [0, 1, 0, 1, 0]


def test_several_paths_are_as_many_scans_as_they_hold(tmp_path: Path):
    (tmp_path / "of").mkdir()
    for name in ("of/a", "of/b", "c"):
        write(tmp_path / f"{name}.ply", Scan(np.ones((5, 3), np.float32)))
    assert list(compared([tmp_path / "of", tmp_path / "c.ply"], None, Reading())) == ["3 scans"]
    assert list(compared([tmp_path / "of"], None, Reading())) == ["of"]


def test_a_browser_without_scripts_is_told_so():
    assert "<noscript>" in page(settings_of(Shown(Scan(np.ones((5, 3), np.float32))), "scan"), "nonce")


def test_every_kind_of_box_has_a_colour():
    """Lorries and coaches were of no kind."""
    script = (STATIC / "lines.js").read_text(encoding="utf-8")
    colours = script.split("const BOX_COLOURS = {")[1].split("};")[0]
    assert [kind for kind in KINDS if not re.search(rf"\b{kind}: ", colours)] == []


def test_rows_are_the_beams_however_they_are_told():
    scan = turn("hdl-32e")
    shuffled = np.random.default_rng(0).permutation(len(scan))
    told = {
        "beams by the ring field": scan,
        "beams by the order of the points": Scan(scan.xyz),
        "beams of hdl-32e, recognised": Scan(scan.xyz[shuffled]),
    }
    assert scan.ring is not None
    for origin, of in told.items():
        rows = rows_of(of)
        expected = scan.ring[shuffled] if "recognised" in origin else scan.ring
        np.testing.assert_array_equal(rows.row, expected)
        assert (rows.height, rows.width, rows.origin) == (32, 512, origin)
    cloud = Scan(np.random.default_rng(1).normal(size=(5000, 3)).astype(np.float32))
    even = rows_of(cloud)
    assert even.height == 64 and "does not tell" in even.origin
    elevation = np.arctan2(cloud.xyz[:, 2], np.hypot(*cloud.xyz[:, :2].T))
    inside = even.row >= 0
    assert inside.mean() > 0.98 and (np.diff(even.row[inside][np.argsort(-elevation[inside])]) >= 0).all()


@pytest.mark.parametrize("scan", [Scan(np.zeros((0, 3), np.float32)), Scan(np.ones((1, 3), np.float32))])
def test_a_scan_of_nothing_or_one_point_is_no_fault(scan: Scan):
    assert unpacked(packed(Shown(scan)))[0]["points"] == len(scan)
    assert colourings(scan)["range"]["low"] < colourings(scan)["range"]["high"]


def test_labels_boxes_and_marks_lie_beside(tmp_path: Path):
    scan = turn()
    root = tmp_path / "sequences" / "00"
    for folder in ("velodyne", "labels", "boxes", "rings"):
        (root / folder).mkdir(parents=True)
    path = root / "velodyne" / "000000.bin"
    write(path, scan)
    (root / "rings" / "000000.bin").write_bytes(b"\1\0" * len(scan))
    (root / "labels" / "000000.label").write_bytes(np.full(len(scan), 40, "<u4").tobytes())
    (root / "boxes" / "000000.json").write_text(json.dumps({"boxes": [BOX | {"occlusion": 0.5}]}))
    path.with_suffix(".new").write_bytes(b"\1" * len(scan))
    path.with_suffix(".confidence").write_bytes(scan.reflectance.tobytes())
    (shown,) = [series_of([tmp_path], Reading())[0]]
    assert shown.scan.label is not None and set(shown.scan.label.tolist()) == {9}  # road
    assert list(shown.boxes) == [BOX] and shown.notes == ()
    np.testing.assert_array_equal(shown.scan.extra["new"], np.ones(len(scan)))
    np.testing.assert_array_equal(shown.scan.extra["confidence"], scan.reflectance)
    assert series_of([tmp_path], Reading()).count == 1, "rings/*.bin are no scans"


@pytest.mark.parametrize(("boxes", "told"), [
    ('{"boxes": 3}', "expected a list of boxes, found 3"), ('{"boxes": [{"kind": "car"}]}', "found {'kind': 'car'}"),
    ("not json", "a.json: expected"),
    ('{"boxes": [{"kind": "car", "centre": [0, 0, NaN], "size": [1, 1, 1], "yaw": 0}]}', "expected boxes of a kind,"),
])  # fmt: skip
def test_what_does_not_fit_is_left_out_and_said(boxes: str, told: str, tmp_path: Path):
    """And boxes of the same number in another folder are not taken for those that are broken."""
    (tmp_path / "boxes").mkdir()
    (tmp_path / "boxes" / "a.json").write_text(json.dumps({"boxes": [BOX]}))
    path = tmp_path / "a.bin"
    write(path, turn())
    path.with_suffix(".json").write_text(boxes)
    path.with_suffix(".label").write_bytes(b"\0" * 12)
    path.with_suffix(".new").write_bytes(b"\0" * 12)
    shown = read_shown(path)
    assert shown.boxes == [] and shown.scan.label is None and "new" not in shown.scan.extra
    labels, marks, broken = shown.notes
    assert re.search(r"labels left out: .*expected 16384 bytes.*found 12", labels)
    assert marks == "a.new left out: expected 4096 bytes for 4096 points, found 12 bytes"
    assert broken.startswith(f"boxes left out: {path.with_suffix('.json')}") and told in broken


def test_marks_of_points_without_a_return_go_with_them_unsaid(tmp_path: Path):
    scan, path = turn(), tmp_path / "a.bin"
    write(path, Scan(np.concatenate([np.zeros((2, 3), np.float32), scan.xyz])))
    new = np.arange(len(scan) + 2) % 2
    path.with_suffix(".new").write_bytes(new.astype("u1").tobytes())
    shown = read_shown(path)
    assert shown.notes == ("2 points without a return or not finite were dropped",)
    np.testing.assert_array_equal(shown.scan.extra["new"], new[2:])


@pytest.mark.parametrize("other", ["[]", '{"beams": 16}'])
def test_a_json_without_boxes_is_something_else(other: str, tmp_path: Path):
    write(tmp_path / "a.bin", turn())
    (tmp_path / "a.json").write_text(other)
    (tmp_path / "boxes").mkdir()
    (tmp_path / "boxes" / "a.json").write_text(json.dumps({"boxes": [BOX]}))
    shown = read_shown(tmp_path / "a.bin")
    assert list(shown.boxes) == [BOX] and shown.notes == ()


def test_rings_count_from_the_top_of_the_sensors_frame(tmp_path: Path):
    """Of a file whose z points down, as messages of a bag do: its strip is not upside down, and `info` knows it."""
    scan, reading = turn(), Reading(transform=read_transform(None, axes="frd"))
    write(tmp_path / "up.ply", scan)
    write(tmp_path / "down.ply", replace(scan, xyz=scan.xyz * np.float32([1, -1, -1])))
    shown = series_of([tmp_path / "down.ply"], reading)[0].scan
    np.testing.assert_allclose(shown.xyz, scan.xyz, atol=1e-5)
    np.testing.assert_array_equal(shown.ring, scan.ring)
    (item,) = inputs_of([tmp_path / "down.ply"], reading).stream()
    np.testing.assert_array_equal(shown.ring, item.read().scan.ring)
    np.testing.assert_array_equal(rows_of(shown).row, rows_of(scan).row)
    lines, upright = file_lines(tmp_path / "down.ply", reading), file_lines(tmp_path / "up.ply", Reading())
    assert lines is not None and upright is not None and lines["sensor"] == upright["sensor"]


def bag(path: Path, times: list[int]) -> Path:
    """A bag whose i-th cloud is i + 10 metres away."""
    with write_bag(path) as writer:
        for i, time in enumerate(times):
            scan = turn(far=10.0 + i)
            fields = {axis: scan.xyz[:, k].copy() for k, axis in enumerate("xyz")} | {"intensity": scan.reflectance}
            writer.write_cloud("/points", Cloud(time, "lidar", time, fields))
    return path


def sqlite(path: Path, old: Path) -> Path:
    """The bag as a ROS 2 folder."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    store = typestore("cdr")
    with open_bag(old) as source, Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        points = writer.add_connection("/points", POINTS, typestore=store)
        for message in source.messages():
            data = message_of(cloud_of(message), "cdr")
            writer.write(points, message.time, data)
    return path


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ""])
def test_a_bag_by_number_in_any_order(suffix: str, tmp_path: Path):
    """Asked by as many threads as a server has."""
    pytest.importorskip("rosbags", reason="lidarsynth[ros] is not installed")
    path = bag(tmp_path / f"drive{suffix or '.bag'}", [10**18 + t * 10**8 for t in (0, 1, 2, 2, 3, 4)])
    path = path if suffix else sqlite(tmp_path / "drive", path)
    series = series_of([path], Reading())
    assert series.count == 6
    for number in (0, 3, 1, 2, 5, 4, 0, 3):
        with ThreadPoolExecutor(1) as thread:
            scan = thread.submit(series.__getitem__, number).result().scan
        np.testing.assert_allclose(np.linalg.norm(scan.xyz, axis=1), 10 + number, rtol=1e-4)
    assert list(series.names) == [f"/points {10**9 + t / 10:.3f} s" for t in (0, 1, 2, 2, 3, 4)]
    with pytest.raises(IndexError):
        series[6]


def test_several_bags_are_one_row_and_none_is_held(tmp_path: Path):
    pytest.importorskip("rosbags", reason="lidarsynth[ros] is not installed")
    for name in "ab":
        bag(tmp_path / f"{name}.bag", [10**18, 10**18 + 1])
    series = series_of([tmp_path], Reading())
    assert isinstance(series, Stream) and series.count == 4
    assert [round(float(np.linalg.norm(series[k].scan.xyz[0]))) for k in (3, 0, 2)] == [11, 10, 10]
    assert list(series.names) == ["a/000000", "a/000001", "b/000000", "b/000001"]


def test_going_back_starts_at_the_mark_and_nothing_is_held():
    """Of a stream with times: a jump back reads from that time on, not from the start."""
    read_at: list[int] = []
    alive: list[weakref.ref] = []

    class Item:
        def __init__(self, number: int):
            self.name, self.path = f"item {number}", Path()
            alive.append(weakref.ref(self))

        def read(self) -> Loaded:
            return Loaded(Scan(np.full((1, 3), int(self.name[5:]) + 1, np.float32)), {}, 0)

    def open_at(mark: int, number: int) -> Iterator[tuple[int, Item]]:
        assert mark == 7 * number
        for k in range(number, 100):
            read_at.append(k)
            yield 7 * k, Item(k)

    stream = Stream(open_at, None)
    assert stream[50].scan.xyz[0, 0] == 51 and read_at == list(range(51))
    assert sum(item() is not None for item in alive) <= 1
    read_at.clear()
    assert [stream[k].scan.xyz[0, 0] for k in (51, 20, 21, 49)] == [52, 21, 22, 50]
    assert read_at == [51, 20, 21, 49], "forth to what was seen goes by the mark, too"
    with pytest.raises(IndexError):
        stream[100]
    assert stream.count == 100 == len(stream.names)


def test_frames_play_in_the_order_of_their_numbers(tmp_path: Path):
    """In a folder and by a pattern, and of a data set; files that are named keep the order they were named in."""
    drive, odometry = tmp_path / "drive", tmp_path / "sequences" / "2" / "velodyne"
    for folder in (drive, odometry):
        folder.mkdir(parents=True)
        for k in (8, 9, 10, 11):
            write(folder / f"frame_{k}.npy", turn(far=float(k)))
    frames = [f"frame_{k}" for k in (8, 9, 10, 11)]
    for found in (drive, Path(f"{drive}/frame_*"), tmp_path / "sequences"):
        series = series_of([found], Reading())
        assert list(series.names) == frames
        assert [round(float(np.linalg.norm(series[i].scan.xyz[0]))) for i in range(4)] == [8, 9, 10, 11]
    named = [drive / f"{frames[2]}.npy", drive / f"{frames[0]}.npy"]
    assert list(series_of(named, Reading()).names) == [frames[2], frames[0]]


def test_a_scan_without_intensities_is_shown_without_reflectance(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Alone, in a folder beside others, with its labels; where a scale was named, it is not there to be read."""
    scan, page = turn(), tmp_path / "page.html"
    folder = tmp_path / "scans"
    folder.mkdir()
    np.save(folder / "a.npy", scan.xyz)
    np.full(len(scan), 40, "<u4").tofile(folder / "a.label")
    write(folder / "b.npy", scan)
    bare, whole = series_of([folder], Reading())[0], series_of([folder], Reading())[1]
    assert not bare.scan.reflectance.any() and bare.scan.label is not None and whole.notes == ()
    (note,) = bare.notes
    assert note.startswith(f"reflectance left out: {folder / 'a.npy'}: expected an intensity field")
    assert note.endswith("found only x, y, z")
    main(["view", str(folder), "--out", str(page)])
    assert capsys.readouterr().err == "" and page.read_text().count('id="scan-') == 2
    assert "a.npy: expected an intensity field" in refused(
        capsys, str(folder / "a.npy"), "--out", str(page), "--intensity", "byte"
    )
    (folder / "c.npy").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"c\.npy: expected"):
        read_shown(folder / "c.npy")


def test_a_message_without_intensities_is_shown_without_reflectance(tmp_path: Path):
    pytest.importorskip("rosbags", reason="lidarsynth[ros] is not installed")
    scan = turn()
    with write_bag(tmp_path / "a.mcap") as writer:
        writer.write_cloud(
            "/points", Cloud(1, "lidar", 1, {axis: scan.xyz[:, k].copy() for k, axis in enumerate("xyz")})
        )
    shown = series_of([tmp_path / "a.mcap"], Reading())[0]
    np.testing.assert_array_equal(shown.scan.xyz, scan.xyz)
    assert not shown.scan.reflectance.any() and "expected an intensity field" in shown.notes[0]
    with pytest.raises(ValueError, match="expected an intensity field"):
        series_of([tmp_path / "a.mcap"], Reading("unit"))[0]


def test_partners_are_found_by_name_or_by_number(tmp_path: Path):
    """And where some have one of their name and others none, it is said: by number unlike ones would be compared."""
    for folder, names in (("a", "xyz"), ("b", "zyxw"), ("c", "123"), ("d", "wxy"), ("e", "12")):
        (tmp_path / folder).mkdir()
        for i, name in enumerate(names):
            write(tmp_path / folder / f"{name}.npy", turn(far=10.0 + i))

    def distances(other: str) -> list[float]:
        series = compared([tmp_path / "a"], tmp_path / other, Reading())[other]
        return [float(np.linalg.norm(series[i].scan.xyz[0]).round(2)) for i in range(3)]

    assert distances("b") == [12, 11, 10]
    assert distances("c") == [10, 11, 12]
    with pytest.raises(ValueError, match=r"e: expected 3 scans to compare, or one of each name, found 2"):
        distances("e")
    with pytest.raises(ValueError, match=r"a: expected 4 scans to compare, or one of each name, found 3"):
        compared([tmp_path / "b"], tmp_path / "a", Reading())
    with pytest.raises(ValueError, match=r"d: expected a scan of each name, .* 1 of 3 scans, the first: z"):
        distances("d")


def test_scans_of_one_name_are_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """By their whole paths, and none takes the other's place."""
    monkeypatch.chdir(tmp_path)
    for folder, far in (("X/S", 10.0), ("S", 20.0), ("1 scan", 30.0), ("2 scans", 40.0)):
        Path(folder).mkdir(parents=True)
        write(Path(folder, "a.npy"), turn(far=far))

    def seen(*paths: str) -> dict[str, int]:
        *scans, other = map(Path, paths)
        series = compared(scans, other, Reading())
        return {caption: round(float(np.linalg.norm(scan[0].scan.xyz[0]))) for caption, scan in series.items()}

    assert seen("X/S/a.npy", "S/a.npy") == {"X/S/a.npy": 10, "S/a.npy": 20}
    assert seen("X/S", "S") == {"X/S": 10, "S": 20}
    assert seen("S", "1 scan") == {"S": 20, "1 scan": 30}
    write(Path("X/S/b.npy"), turn())
    write(Path("2 scans/b.npy"), turn())
    assert seen("X/S/a.npy", "X/S/b.npy", "2 scans") == {"2 scans": 10, str(tmp_path / "2 scans"): 40}
    for same in ("./S", "S", str(tmp_path / "S")):
        with pytest.raises(ValueError, match="S: expected another scan to compare, found the same"):
            seen("S", same)


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[str, str, Path]]:
    """(host:port, token, folder) of a server over two scans and a broken one."""
    for i in range(3):
        write(tmp_path / f"{i}.npy", turn(far=10.0 + i))
    (tmp_path / "2.npy").write_bytes(b"\x93NUMPY")
    (tmp_path / "secret.txt").write_text("secret")
    show = Show("scans", compared([tmp_path], None, Reading()))
    with serve(show) as server:
        assert server.server_address[0] == "127.0.0.1"
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        yield urlsplit(address(server, show)).netloc, show.token, tmp_path
        server.shutdown()
        thread.join()


def ask(host: str, path: str, method: str = "GET", **headers: str) -> tuple[int, bytes, http.client.HTTPMessage]:
    connection = http.client.HTTPConnection(host, timeout=30)
    connection.putrequest(method, path, skip_host="Host" in headers, skip_accept_encoding=True)
    for name, value in headers.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, content, answer.headers


def test_the_page_and_the_scans_are_served(served: tuple[str, str, Path]):
    host, token, folder = served
    status, content, headers = ask(host, f"/{token}/")
    assert status == 200 and b"<canvas" in content
    assert not re.search(rb"https?://|src=|@import|url\(", content), "the page needs nothing from elsewhere"
    policy = headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'") and "connect-src 'self'" in policy and "unsafe" not in policy
    assert headers["Cache-Control"] == "no-store" and headers["X-Frame-Options"] == "DENY"
    assert headers["Access-Control-Allow-Origin"] is None
    status, content, headers = ask(host, f"/{token}/scan/1/0", Origin=f"http://{host}", Sec_Fetch_Site="same-origin")
    assert (status, headers["Content-Type"]) == (200, "application/octet-stream")
    assert content == packed(read_shown(folder / "1.npy"))
    assert ask(host, f"/{token}/scan/3/0")[:2] == (204, b"")
    status, content, headers = ask(host, f"/{token}/scan/2/0")
    assert status == 200 and headers["Content-Type"].startswith("text/plain")
    assert re.search(rb"2\.npy: expected .*found", content)


@pytest.mark.parametrize("headers", [
    {"Origin": "http://evil.example"}, {"Origin": "null"}, {"Origin": "https://{host}"}, {"Host": "evil.example"},
    {"Host": "evil.example:{port}"}, {"Host": "127.0.0.1"}, {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "cors"},
    {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "no-cors"}, {"Host": "127.0.0.1:{port}@evil.example"},
])  # fmt: skip
def test_others_are_refused_even_with_the_token(served: tuple[str, str, Path], headers: dict[str, str]):
    host, token, _ = served
    filled = {name: value.format(host=host, port=host.split(":")[1]) for name, value in headers.items()}
    for path in (f"/{token}/", f"/{token}/scan/0/0"):
        status, content, _ = ask(host, path, **filled)
        assert status == 403 and len(content) < 100


@pytest.mark.parametrize("path", [
    "/", "/scan/0/0", "/wrong/", "/{part}/", "/{token}x/scan/0/0", "//{token}/", "/%2e/{token}/", "/?{token}", "*",
    "http://evil.example/{token}/",
])  # fmt: skip
def test_a_wrong_address_is_refused(served: tuple[str, str, Path], path: str):
    host, token, _ = served
    status, content, _ = ask(host, path.format(token=token, part=token[:-1]))
    assert status == 403 or (path.startswith("//") and status == 200), "a doubled first slash is the same address"
    assert token.encode() not in content


@pytest.mark.parametrize("path", [
    "..", "../", "../secret.txt", "secret.txt", "scan/../secret.txt", "scan/0/../../../etc/passwd", "scan/%2e%2e/0",
    "scan/..%2f..%2fetc", "scan/-1/0", "scan/0", "scan/0/0/", "scan/0/0/0", "scan/1e0/0", "scan/٣/0",
    "scan/9999999999/0", "/etc/passwd", "scan//etc/passwd", "scan/0/0%00", "static/app.js", "?a=/etc/passwd",
    "scan/0/0?x=../../secret.txt",
])  # fmt: skip
def test_no_path_leads_anywhere_else(served: tuple[str, str, Path], path: str):
    host, token, _ = served
    status, content, _ = raw(host, f"/{token}/{path}")
    assert status in (400, 404) and b"secret" not in content and b"root:" not in content


def raw(host: str, path: str) -> tuple[int, bytes, bytes]:
    """A request whose path no client has cleaned."""
    name, _, port = host.partition(":")
    with socket.create_connection((name, int(port)), timeout=30) as connection:
        connection.sendall(f"GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode())
        answer = b"".join(iter(lambda: connection.recv(65536), b""))
    head, _, body = answer.partition(b"\r\n\r\n")
    return int(head.split()[1]), body, head


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "TRACE"])
def test_nothing_can_be_sent(served: tuple[str, str, Path], method: str):
    host, token, _ = served
    assert ask(host, f"/{token}/", method)[0] == 501


def test_many_ask_at_once_and_a_dead_one_holds_nobody_up(served: tuple[str, str, Path]):
    host, token, folder = served
    name, _, port = host.partition(":")
    idle = socket.create_connection((name, int(port)))  # says nothing
    found: list[bytes] = []
    threads = [threading.Thread(target=lambda: found.append(ask(host, f"/{token}/scan/0/0")[1])) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    idle.close()
    assert found == [packed(read_shown(folder / "0.npy"))] * 8


def test_a_browser_that_went_away_is_no_fault(capsys: pytest.CaptureFixture[str]):
    """While its scan was read, as a tab is closed, or the slider moved on: the socket is reset."""
    asked, gone = threading.Event(), threading.Event()

    class Slow:
        names, count, cut = ["a"], 1, ()

        def __getitem__(self, index: int) -> Shown:
            if threading.current_thread() is not threading.main_thread():
                asked.set()
                gone.wait(30)
            return Shown(turn())

    show = Show("scans", {"scans": Slow()})
    with serve(show) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        host = urlsplit(address(server, show)).netloc
        with socket.create_connection((host.split(":")[0], int(host.split(":")[1]))) as browser:
            browser.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            browser.sendall(f"GET /{show.token}/scan/0/0 HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
            assert asked.wait(30)
        gone.set()
        assert ask(host, f"/{show.token}/scan/0/0")[0] == 200
        server.shutdown()
        thread.join()
    for other in threading.enumerate():
        if "process_request_thread" in other.name:
            other.join(30)
    assert capsys.readouterr().err == ""


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as end:
        main(["view", *arguments])
    assert end.value.code == 2
    return capsys.readouterr().err.strip()


def test_a_file_to_send(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Whole, alone, and a name cannot end an element of the page."""
    name = "</script><script>alert(1)<!--"
    folder = tmp_path / "scans"
    folder.mkdir()
    write(folder / "a.npy", turn())
    path = tmp_path / "out" / "view.html"
    main(["view", str(folder / "a.npy"), "--with", str(folder), "--out", str(path)])
    text = path.read_text()
    assert re.fullmatch(
        r"wrote .*view.html, 0\.\d MB: open it in any browser, without a network\n", capsys.readouterr().out
    )
    assert not re.search(r"https?://|src=|@import|url\(", text)
    assert "connect-src" not in text and text.count('id="scan-') == 2
    assert [p.name for p in path.parent.iterdir()] == ["view.html"]
    hostile = folder / f"{name.replace('/', '_')}.npy"
    write(hostile, turn())
    main(["view", str(hostile), "--out", str(path)])
    assert "<script>alert" not in path.read_text()


def test_the_page_is_the_same_in_every_locale():
    program = "import json; from lidarsynth.viewer.page import page; print(json.dumps(page({}, 'nonce')))"
    bare = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = subprocess.run([sys.executable, "-c", program], env=os.environ | bare, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == page({}, "nonce")


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write(tmp_path / "a.npy", turn())
    (tmp_path / "others").mkdir()
    (tmp_path / "broken.npy").write_bytes(b"nothing")
    old = tmp_path / "old.html"
    old.write_text("old")
    a = str(tmp_path / "a.npy")
    assert "expected a name that ends in .html, found 'x.ply'" in refused(capsys, a, "--out", "x.ply")
    assert "broken.npy: expected" in refused(capsys, str(tmp_path / "broken.npy"), "--out", str(old))
    assert "broken.npy: expected" in refused(capsys, str(tmp_path / "broken.npy"))
    write(tmp_path / "others" / "b.npy", turn())
    write(tmp_path / "others" / "c.npy", turn())
    assert "others: expected 1 scan to compare" in refused(capsys, a, "--with", str(tmp_path / "others"))
    assert "expected --port of at least 0" in refused(capsys, a, "--port", "-1")
    assert "expected a free port of 127.0.0.1, found 99999" in refused(capsys, a, "--port", "99999", "--no-browser")
    assert old.read_text() == "old"


def test_broken_scans_are_left_out_and_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A file of the whole ones; from the server their words; nothing at all only where all are broken."""
    folder, page = tmp_path / "scans", tmp_path / "view.html"
    folder.mkdir()
    for name in "ac":
        (folder / f"{name}.npy").write_bytes(b"nothing")
    for name in "bd":
        write(folder / f"{name}.npy", turn())
    main(["view", str(folder), "--out", str(page)])
    assert "2 that could not be read were left out, the first: " in (said := capsys.readouterr().err)
    assert "a.npy: expected" in said
    assert page.read_text().count('id="scan-') == 2 and re.findall(r'"name": "(\w)', page.read_text()) == ["b", "d"]
    with serve(Show("scans", compared([folder], None, Reading()))) as server:
        assert server.server_address[1] > 0, "the page's colours are the first whole scan's"
    for name in "bd":
        (folder / f"{name}.npy").write_bytes(b"nothing")
    assert "expected scans, found all 4 broken; the first: " in refused(capsys, str(folder), "--out", str(page))
    with pytest.raises(ValueError, match=r"a\.npy: expected"):
        serve(Show("scans", compared([folder], None, Reading())))
    assert page.read_text().count('id="scan-') == 2, "the former page stays"


def test_a_topic_is_of_a_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("rosbags", reason="lidarsynth[ros] is not installed")
    write(tmp_path / "a.pcd", turn())
    bag(tmp_path / "a.mcap", [10**18])
    for verb, *more in (["view", "--out", str(tmp_path / "a.html")], ["sensor", "--out", str(tmp_path / "a.toml")]):
        with pytest.raises(SystemExit, match="2"):
            main([verb, str(tmp_path / "a.pcd"), "--topic", "/points", *more])
        assert "expected a bag or a capture for --topic /points, found none" in capsys.readouterr().err
        with pytest.raises(SystemExit, match="2"):
            main([verb, str(tmp_path / "a.pcd"), "--metadata", str(tmp_path / "o.json"), *more])
        said = capsys.readouterr().err
        assert "o.json" in said and (verb == "sensor" or "a bag of an Ouster's packets, for --metadata" in said)
    for one, other in (("a.pcd", "a.mcap"), ("a.mcap", "a.pcd")):
        series = compared([tmp_path / one], tmp_path / other, Reading(topic="/points"))
        assert [scans[0].scan.xyz.shape[1] for scans in series.values()] == [3, 3]


def test_too_many_for_a_file_are_refused_before_any_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for i in range(49):
        (tmp_path / f"{i}.npy").write_bytes(b"never read")
    line = refused(capsys, str(tmp_path), "--out", str(tmp_path / "view.html"))
    assert "expected at most 48 scans for one file, found 49" in line


def test_colours_fit_the_first_scan():
    near, far = (colourings(turn(far=distance))["range"]["high"] for distance in (15.0, 100.0))
    assert (near, far) == (20, 120)
    fields = {word: scale["fields"] for word, scale in colourings(turn()).items()}
    assert fields == {"range": [], "height": []} | {
        word: [word] for word in ("reflectance", "label", "new", "confidence")
    }


def test_a_range_image_is_shown_as_its_points(tmp_path: Path):
    from lidarsynth.lidar.projection import project

    image = project(turn(), SENSORS["vlp-16"], width=256)
    write(tmp_path / "a.npz", image)
    np.testing.assert_allclose(read_shown(tmp_path / "a.npz").scan.xyz, read(tmp_path / "a.npz").xyz)


def test_of_a_file_of_several_sensors_the_rings_of_one_are_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    scan, page = turn(), tmp_path / "page.html"
    write(tmp_path / "two.pcd", scan)
    for label, note in ((np.where(np.arange(len(scan)) % 2, 40, 50), None), (np.zeros(7), "labels left out")):
        label.astype(np.uint32).tofile(tmp_path / "two.label")
        for words, count in (([], 4096), (["--rings", "0-7"], 2048)):
            main(["view", str(tmp_path / "two.pcd"), "--out", str(page), *words])
            (found,) = re.findall(r'id="scan-0-0">([^<]*)<', page.read_text())
            header, _ = unpacked(gzip.decompress(base64.b64decode(found)))
            assert header["points"] == count
            assert [text.split(":")[0] for text in header["notes"]] == ([] if note is None else [note])
    assert "expected --rings FIRST-LAST" in refused(
        capsys, str(tmp_path / "two.pcd"), "--out", str(page), "--rings", "7"
    )
