"""Data sets of labelled streets: read back by the published formats, stopped and gone on with, others refused."""

import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from lidarsynth.cli.main import main
from lidarsynth.data import street_sets
from lidarsynth.data.dataset import CachedImages
from lidarsynth.data.layouts.calibration import AXES, PROJECTION
from lidarsynth.data.layouts.kitti import in_view, label_line
from lidarsynth.data.layouts.nuscenes_tables import quaternion
from lidarsynth.data.nuscenes import nuscenes
from lidarsynth.data.sources import cache_source
from lidarsynth.data.street_sets import LAYOUTS, chunks, write_streets
from lidarsynth.files.formats import read
from lidarsynth.files.labels import read_labels
from lidarsynth.lidar.boxes import Box
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import SENSORS, Sensor, same_rays
from lidarsynth.streets import drawing
from lidarsynth.streets.areas import Density
from lidarsynth.streets.edition import EDITION
from lidarsynth.streets.frame import Frame, LabelledStreets, Options
from lidarsynth.verbs.json_kinds import json_lines

pytest.importorskip("embreex", reason="lidarsynth[synthetic] is not installed")

SENSOR = SENSORS["vlp-16"].resized(width=256)
DRIVE = Options(frames=7, deskewed=True)


STREETS = LabelledStreets(0, 1, SENSOR, DRIVE)  # holds its world, so that it is built once


@pytest.fixture(scope="module", autouse=True)
def cast_once() -> Iterator[None]:
    """Each frame of a drive, which does not depend on when it is asked for, is cast once for all tests of this file."""
    kept: dict[tuple, Frame] = {}
    cast = LabelledStreets._driven

    def driven(self: LabelledStreets, number: int, k: int) -> Frame:
        key = (self.seed, self.sensor, self.options, number, k)
        if key not in kept:
            kept[key] = cast(self, number, k)
        return kept[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LabelledStreets, "_driven", driven)
        yield


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [STREETS[k] for k in range(7)]


def written(folder: Path, layout: str, streets: LabelledStreets = STREETS) -> Path:
    assert list(write_streets(folder, streets, layout))[-1] == len(streets)
    return folder


def files_of(layout: str, index: int, streets: LabelledStreets = STREETS) -> list[str]:
    return [path for path, _ in LAYOUTS[layout].sizes(streets, index, 0)]


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_semantickitti_reads_back(tmp_path: Path, frames: list[Frame]):
    sequence = written(tmp_path / "set", "semantickitti") / "sequences" / "00"
    frame = frames[3]
    points = np.fromfile(sequence / "velodyne" / "000003.bin", "<f4").reshape(-1, 4)
    np.testing.assert_array_equal(points[:, :3], frame.scan.xyz)
    raw = np.fromfile(sequence / "labels" / "000003.label", "<u4")
    np.testing.assert_array_equal(raw, frame.raw)
    np.testing.assert_array_equal(read_labels(sequence / "labels" / "000003.label", len(points)), frame.scan.label)
    times = np.fromfile(sequence / "point_times" / "000003.bin", "<f4")
    np.testing.assert_array_equal(times, frame.scan.time)
    assert len((sequence / "times.txt").read_text().split()) == 7


def test_poses_are_those_of_the_drive(tmp_path: Path, frames: list[Frame]):
    """As semantic-kitti-api has it: pose in the sensor's frame = Tr^-1 P Tr."""
    sequence = written(tmp_path / "set", "semantickitti") / "sequences" / "00"
    calibration = {line.split(":")[0]: line.split()[1:] for line in (sequence / "calib.txt").read_text().splitlines()}
    tr = np.eye(4)
    tr[:3] = np.array(calibration["Tr"], float).reshape(3, 4)
    poses = np.loadtxt(sequence / "poses.txt").reshape(-1, 3, 4)
    assert (tmp_path / "set" / "poses" / "00.txt").read_bytes() == (sequence / "poses.txt").read_bytes()
    whole = np.tile(np.eye(4), (7, 1, 1))
    whole[:, :3] = poses
    truth = np.linalg.inv(frames[0].to_world) @ np.stack([frame.to_world for frame in frames])
    np.testing.assert_allclose(np.linalg.inv(tr) @ whole @ tr, truth, atol=2e-5)
    told = [json.loads(path.read_text())["pose"] for path in (sequence / "boxes").glob("*.json")]
    turns = np.concatenate([poses[:, :, :3], np.array(told)[:, :3, :3]])
    off = turns.transpose(0, 2, 1) @ turns - np.eye(3)
    assert len(off) == 14 and np.abs(off).max() < 1e-7, "pytransform3d, and others, take 1e-6 for a rotation"


def test_places_are_split_by_world(tmp_path: Path):
    line = Sensor("line", (-10.0,), 32, 1.0, 30.0)
    folder = written(tmp_path / "set", "semantickitti", LabelledStreets(0, 18, line))
    assert len(list((folder / "sequences" / "00" / "velodyne").iterdir())) == 16
    assert len(list((folder / "sequences" / "01" / "velodyne").iterdir())) == 2


def box_of(line: str) -> tuple[np.ndarray, np.ndarray, float]:
    """OpenPCDet's way from a line of label_2 to a box in the sensor frame: centre, size, yaw."""
    numbers = np.array(line.split()[1:], float)
    height, width, length = numbers[7:10]
    bottom = np.linalg.inv(AXES) @ [*numbers[10:13], 1]
    centre = bottom[:3] + np.array([0, 0, height / 2])
    return centre, np.array([length, width, height]), -(numbers[13] + np.pi / 2)


def test_kitti_labels_are_the_boxes():
    zero = (0.0, 0.0, 0.0)
    box = Box("car", 1, (14.0, 3.0, -0.9), (4.2, 1.8, 1.5), 0.3, zero, zero, 0.0, zero, 90, 0.3)
    line = label_line(box)
    assert line is not None and line.split()[:3] == ["Car", "0.00", "1"]
    centre, size, yaw = box_of(line)
    np.testing.assert_allclose(centre, box.centre, atol=0.011)
    np.testing.assert_allclose(size, box.size, atol=0.011)
    assert np.cos(yaw - box.yaw) > 0.999
    pixels = (np.c_[box.corners(), np.ones(8)] @ AXES.T) @ np.c_[PROJECTION[:, :3], np.zeros(3)].T
    pixels = pixels[:, :2] / pixels[:, 2:]
    found = np.array(line.split()[4:8], float)
    np.testing.assert_allclose(found, [*pixels.min(axis=0), *pixels.max(axis=0)], atol=0.01)
    behind = Box("car", 1, (-14.0, 3.0, -0.9), (4.2, 1.8, 1.5), 0.3, zero, zero, 0.0, zero, 90, 0.3)
    assert label_line(behind) is None


def test_kitti_lists_what_has_a_point_in_the_cameras_image():
    """Two cars whose boxes reach into the image, and the points of one of them."""
    zero = (0.0, 0.0, 0.0)
    beside, ahead = (Box("car", k, (x, 3.0, -0.9), (4.2, 1.8, 1.5), 0.0, zero, zero, 0.0, zero, 2, 0.0)
                     for k, x in ((1, 0.5), (2, 14.0)))  # fmt: skip
    assert label_line(beside) is not None and label_line(ahead) is not None
    xyz = np.float32([[0.5, 2.1, -0.9], [-1.0, 2.1, -0.5], [12.0, 2.2, -0.9], [12.0, 3.0, -0.9], [9.0, 0.0, -1.7]])
    raw = np.array([10 | 1 << 16, 10 | 1 << 16, 10 | 2 << 16, 10 | 2 << 16, 40], np.uint32)
    frame = Frame(Scan(xyz), raw, [beside, ahead], np.eye(4), 0.0, 0, 0)
    assert in_view(frame) == {2}
    files = dict(LAYOUTS["kitti"].files(STREETS, 0, frame))
    assert files["training/label_2/000000.txt"] == f"{label_line(ahead)}\n".encode()


def test_points_of_a_thing_lie_in_its_box_as_openpcdet_reads_it():
    streets = LabelledStreets(0, 64, Sensor("even", tuple(np.linspace(7, -16, 40).tolist()), 512, mount=2.0))
    inside, told = [], []
    for frame in (streets[index] for index in (6, 24, 39, 50)):
        for box in frame.boxes:
            if box.points > 2 and (line := label_line(box)):
                centre, size, yaw = box_of(line)
                away = frame.scan.xyz[frame.raw >> 16 == box.instance] - centre
                c, s = np.cos(yaw), np.sin(yaw)
                local = np.column_stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0], away[:, 2]])
                inside.append((np.abs(local) <= size / 2).all(axis=1).sum())
                told.append(box.points)
    share = np.array(inside) / told
    assert len(told) > 15 and np.sum(inside) > 0.98 * np.sum(told)
    assert (share > 0.5).all()


def test_kitti_has_what_openpcdet_opens(tmp_path: Path):
    folder = written(tmp_path / "set", "kitti")
    lines = (folder / "training" / "calib" / "000002.txt").read_text().splitlines()
    names = ["P0", "P1", "P2", "P3", "R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo"]
    assert [line.split(":")[0] for line in lines if line] == names
    assert [len(line.split()) for line in lines if line] == [13, 13, 13, 13, 10, 13, 13]
    assert (folder / "ImageSets" / "train.txt").read_text().split() == [f"{k:06d}" for k in range(7)]
    assert {path.name for path in (folder / "training").iterdir()} == {
        "velodyne",
        "label_2",
        "calib",
        "image_2",
        "boxes",
    }
    for line in (folder / "training" / "label_2" / "000002.txt").read_text().splitlines():
        assert len(line.split()) == 15


def test_nuscenes_reads_back(tmp_path: Path, frames: list[Frame]):
    folder = written(tmp_path / "set", "nuscenes")
    reader = nuscenes(folder)
    assert len(reader) == 2  # key frames: 0 and 5 of seven at 10 Hz
    for scan, frame in zip((reader[0], reader[1]), (frames[0], frames[5]), strict=True):
        np.testing.assert_allclose(scan.xyz, frame.scan.xyz, atol=1e-5)
        np.testing.assert_array_equal(scan.ring, frame.scan.ring)
        assert scan.label is not None and (scan.label == frame.scan.label).mean() > 0.5
    tables = {path.stem: json.loads(path.read_text()) for path in (folder / "v1.0-trainval").glob("*.json")}
    assert len(tables["sample_data"]) == 7 and len(tables["lidarseg"]) == 2
    tokens = {row["token"] for row in tables["sample_annotation"]}
    for row in tables["instance"]:
        assert {row["first_annotation_token"], row["last_annotation_token"]} <= tokens
    samples = {row["token"]: row for row in tables["sample"]}
    for row in tables["sample_annotation"]:
        assert row["sample_token"] in samples and row["num_lidar_pts"] > 0


def test_a_cache_of_a_nuscenes_set_is_of_the_sensor_that_it_was_cast_for(tmp_path: Path, frames: list[Frame]):
    folder = written(tmp_path / "set", "nuscenes")
    assert list(cache_source("nuscenes", folder, tmp_path / "cache"))[-1] == (2, 2)
    images = CachedImages(tmp_path / "cache")
    assert same_rays(images.sensor, SENSORS["vlp-16"].resized(width=1024))  # as --sensor vlp-16 has it
    row = (images[0].range > 0).nonzero()[0]
    assert set(row) == set(frames[0].scan.ring)
    (folder / "streets.json").write_text("{}")  # somebody's own
    assert list(cache_source("nuscenes", folder, tmp_path / "other"))[-1] == (2, 2)
    assert CachedImages(tmp_path / "other").sensor.name == "hdl-32e"


def test_nuscenes_boxes_are_where_the_points_are(tmp_path: Path, frames: list[Frame]):
    """From LIDAR_TOP's own frame through calibration and ego pose to the global frame, as the devkit goes."""
    folder = written(tmp_path / "set", "nuscenes")
    tables = {path.stem: json.loads(path.read_text()) for path in (folder / "v1.0-trainval").glob("*.json")}
    points = np.fromfile(folder / tables["sample_data"][0]["filename"], "<f4").reshape(-1, 5)[:, :3]
    for row in (tables["calibrated_sensor"][0], tables["ego_pose"][0]):
        points = points @ rotation(row["rotation"]).T + row["translation"]
    truth = frames[0].scan.xyz @ frames[0].to_world[:3, :3].T + frames[0].to_world[:3, 3]
    np.testing.assert_allclose(points, truth, atol=1e-3)


def rotation(q: list[float]) -> np.ndarray:
    """(3, 3) of a unit quaternion w, x, y, z."""
    w, x, y, z = q
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def test_quaternions_invert():
    rng = np.random.default_rng(0)
    for _ in range(20):
        q = rng.normal(size=4)
        q = q / np.linalg.norm(q) * np.sign(q[0])
        np.testing.assert_allclose(quaternion(rotation(q.tolist())), q, atol=1e-12)


def test_pcd_reads_back(tmp_path: Path, frames: list[Frame]):
    folder = written(tmp_path / "set", "pcd")
    scan = read(folder / "000004.pcd")
    np.testing.assert_array_equal(scan.xyz, frames[4].scan.xyz)
    np.testing.assert_array_equal(scan.label, frames[4].scan.label)
    np.testing.assert_array_equal(scan.ring, frames[4].scan.ring)
    boxes = json.loads((folder / "000004.json").read_text())["boxes"]
    assert [box["instance"] for box in boxes] == [box.instance for box in frames[4].boxes]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_stopped_set_goes_on_to_the_same_files(tmp_path: Path, layout: str):
    whole = content(written(tmp_path / "whole", layout))
    folder = tmp_path / "stopped"
    writing = write_streets(folder, STREETS, layout)
    next(writing)
    writing.close()
    frames = written(folder, layout)
    for index in (1, 4):  # killed between the files of a frame, and in the middle of one
        record = folder / LAYOUTS[layout].record(STREETS, index)
        record.unlink()
        (record.parent / f".{record.stem}.123.part").write_bytes(b"{")
    (folder / files_of(layout, 3)[0]).unlink()  # somebody else's doing
    written(folder, layout)
    assert content(frames) == whole


@pytest.mark.parametrize("layout", LAYOUTS)
def test_frames_that_somebody_cut_off_are_made_anew(tmp_path: Path, layout: str):
    folder = written(tmp_path / "set", layout)
    whole = content(folder)
    cut = [name for name in files_of(layout, 0) if "label_2" not in name]  # text of any length
    for index, name in enumerate([*cut, LAYOUTS[layout].record(STREETS, 0)]):
        mine = folder / name.replace("000000", f"{index:06d}")
        mine = mine if mine.exists() else folder / name  # of nuScenes a class file has a name of its own
        mine.write_bytes(mine.read_bytes()[:-3] if index % 2 else b"")
    assert next(write_streets(folder, STREETS, layout)) < 7
    written(folder, layout)
    assert content(folder) == whole


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_smaller_number_leaves_a_larger_set_whole(tmp_path: Path, layout: str):
    line = Sensor("line", (-10.0,), 32, 1.0, 30.0)
    for name, options, count in (("places", Options(), 18), ("drives", Options(frames=2), 2)):
        folder = written(tmp_path / name, layout, LabelledStreets(0, count, line, options))
        whole, larger = content(folder), LabelledStreets(0, count, line, options)
        (folder / files_of(layout, 1, larger)[0]).unlink()
        beside = (folder / LAYOUTS[layout].record(larger, 0)).parent
        (beside / "99999999.json").write_text("{}")
        assert list(write_streets(folder, LabelledStreets(0, 1, line, options), layout))[-1] == len(larger)
        (beside / "99999999.json").unlink()
        assert content(folder) == whole


def test_tracks_are_of_the_stamps_and_boxes_of_when_they_were_seen(tmp_path: Path, frames: list[Frame]):
    sequence = written(tmp_path / "set", "semantickitti") / "sequences" / "00"
    tracks = json.loads((sequence / "tracks.json").read_text())
    told = {"kind": f"tracks of one labelled drive: {len(tracks)} road users in 7 frames"}
    assert json_lines(sequence / "tracks.json") == told
    record, moved = json.loads((sequence / "boxes" / "000003.json").read_text()), 0.0
    there = {box.instance: box for box in LabelledStreets(0, 1, SENSOR, Options(frames=7))[3].boxes}
    for box in record["boxes"]:
        truth = there[box["instance"]].place
        np.testing.assert_allclose(tracks[str(box["instance"])]["frames"]["3"][:3], truth, atol=5e-3)
        moved = max(moved, float(np.linalg.norm(np.array(box["place"]) - truth)))
    assert moved > 0.05  # m


def test_a_scan_without_a_point_is_no_scan(tmp_path: Path):
    blind = Sensor("blind", (89.0,), 16)
    with pytest.raises(ValueError, match=r"blind: expected a sensor that sees something .* found no return .* scan 0"):
        list(write_streets(tmp_path / "set", LabelledStreets(0, 1, blind), "pcd"))
    assert not (tmp_path / "set").exists()


def test_other_settings_and_other_folders_are_refused(tmp_path: Path):
    written(tmp_path / "set", "pcd")
    with pytest.raises(ValueError, match=r"made with .*seed 5.*found .*seed 0"):
        list(write_streets(tmp_path / "set", LabelledStreets(5, 1, SENSOR, DRIVE), "pcd"))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    with pytest.raises(ValueError, match="expected an empty folder"):
        list(write_streets(tmp_path / "mine", LabelledStreets(0, 1, SENSOR), "pcd"))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_disk_that_is_full_at_the_first_file_leaves_the_folder_to_the_same_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layout: str
):
    put = street_sets._put

    def full(path: Path, content: object) -> None:
        if path.name == street_sets.RECORD:
            return put(path, content)  # type: ignore[arg-type]
        path.parent.mkdir(parents=True, exist_ok=True)
        raise OSError("expected room; the same command goes on")

    with monkeypatch.context() as patch:
        patch.setattr(street_sets, "_put", full)
        with pytest.raises(OSError, match="the same command goes on"):
            written(tmp_path / "set", layout)
    written(tmp_path / "set", layout)


def test_sets_and_caches_have_one_edition(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    line = LabelledStreets(0, 1, Sensor("line", (-10.0,), 32, 1.0, 30.0))
    written(tmp_path / "set", "pcd", line)
    assert json.loads((tmp_path / "set" / "streets.json").read_text())["edition"] == EDITION
    crowded = Options(density=Density(pedestrians=2))
    for options in (crowded, Options(frames=3)):  # whose boxes met before 2026-11-28, and houses before 2026-11-29
        written(tmp_path / "other" / str(options.frames), "pcd", LabelledStreets(0, 1, line.sensor, options))
        record = json.loads((tmp_path / "other" / str(options.frames) / "streets.json").read_text())
        assert record["edition"] == EDITION + 2
    monkeypatch.setattr("lidarsynth.data.street_sets.EDITION", EDITION + 1)
    with pytest.raises(ValueError, match=r"made with \{edition \d\}, found \{edition \d\}"):
        written(tmp_path / "set", "pcd", line)


def test_what_is_refused_leaves_the_folder_to_the_corrected_command(tmp_path: Path):
    folder = tmp_path / "long"
    with pytest.raises(ValueError, match=r"expected a drive of at most 3760 m, found 500 s .* choose fewer frames"):
        list(write_streets(folder, LabelledStreets(0, 2, SENSOR, Options(frames=5000)), "pcd"))
    assert not folder.exists()
    folder, blind = tmp_path / "new" / "set", LabelledStreets(0, 1, Sensor("blind", (89.0,), 16))
    with pytest.raises(ValueError, match="expected a sensor that sees"):
        list(write_streets(folder, blind, "nuscenes"))
    assert not (tmp_path / "new").exists()
    line = LabelledStreets(0, 1, Sensor("line", (-10.0,), 32, 1.0, 30.0))
    written(folder, "pcd", line)
    with pytest.raises(ValueError, match=r"made with {sensor blind}, found {sensor line}"):
        list(write_streets(folder, blind, "pcd"))


@pytest.mark.parametrize("words", ["streets --out", "streets --inside --out", "data synthetic", "train default --out"])
def test_without_embreex_nothing_is_begun(words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    def missing() -> None:
        raise ImportError("No module named 'embreex'")

    monkeypatch.setattr("lidarsynth.streets.raycast.library", missing)
    monkeypatch.chdir(tmp_path)
    more = ["--data", "varied"] if words.startswith("train") else ["--sensor", "vlp-16"]
    with pytest.raises(SystemExit) as refused:
        main([*words.split(), str(tmp_path / "new" / "set"), *more])
    assert refused.value.code == 2 and not list(tmp_path.iterdir())
    wants = "synthetic streets need embreex: pip install 'lidarsynth[synthetic]'"
    assert capsys.readouterr().err == f"lidarsynth: {wants}\n"


def test_a_drive_that_is_too_long_is_found_before_the_first_is_made():
    """Streets have speeds of their own: 370 s are short enough for the first two, not for the third."""
    LabelledStreets(0, 2, SENSOR, Options(frames=3700)).check_drives()
    with pytest.raises(ValueError, match=r"expected a drive of at most .* found 370 s at 12\.1 m/s"):
        LabelledStreets(0, 3, SENSOR, Options(frames=3700)).check_drives()
    LabelledStreets(0, 3, SENSOR, Options(frames=3700, speed=9.0)).check_drives()


def test_the_first_of_very_many_scans_is_there_at_once(tmp_path: Path):
    line = Sensor("line", (-10.0,), 32, 1.0, 30.0)
    streets = LabelledStreets(0, 10**8, line)
    start, writing = time.perf_counter(), write_streets(tmp_path, streets, "pcd")
    assert [next(writing), next(writing)] == [0, 16]
    writing.close()
    assert time.perf_counter() - start < 20
    (tmp_path / "000003.pcd").unlink()
    writing = write_streets(tmp_path, streets, "pcd")
    assert [next(writing), next(writing), next(writing)] == [15, 16, 32]
    writing.close()


def test_runs_of_frames_are_of_one_world_and_leave_out_what_is_there():
    places, drives = LabelledStreets(0, 40, SENSOR), LabelledStreets(0, 2, SENSOR, Options(frames=20))
    assert [(run[0], run[-1]) for run in chunks(places, [])] == [(0, 15), (16, 31), (32, 39)]
    assert [(run[0], run[-1]) for run in chunks(drives, [])] == [(0, 15), (16, 19), (20, 35), (36, 39)]
    assert list(chunks(drives, [*range(1, 19), *range(20, 40)])) == [[0], [19]]


def test_boxes_of_a_sensor_that_leans_are_told_to_fit_in_the_world_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    for tilt, format, told in ((3, "pcd", False), (20, "pcd", True), (20, "nuscenes", False)):
        own = tmp_path / f"own{tilt}.toml"
        own.write_text(f"beams = 16\ntop = 5.0\nbottom = -20.0\nwidth = 360\ntilt = [{tilt}.0, 0.0]\n")
        folder = tmp_path / f"{format}{tilt}"
        main(["streets", "--out", str(folder), "--sensor", str(own), "--format", format, "-n", "1", "--workers", "1",
              "--no-picture"])  # fmt: skip
        assert ("own20 is tilted by 20 degrees, and boxes" in capsys.readouterr().out) is told
    frame = LabelledStreets(0, 1, str(tmp_path / "own20.toml"))[0]
    points = frame.scan.xyz @ frame.to_world[:3, :3].T + frame.to_world[:3, 3]
    for box in frame.boxes:
        c, s = np.cos(box.heading), np.sin(box.heading)
        mine = (points[frame.raw >> 16 == box.instance] - box.place) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        assert (np.abs(mine) <= np.array(box.size) / 2 + 0.01).all()


@pytest.mark.parametrize(("count", "wide"), [(1, 1), (2, 2), (3, 3), (4, 2)])
def test_frames_of_the_overview_are_all_of_one_size(count: int, wide: int, monkeypatch: pytest.MonkeyPatch):
    drawn = []
    monkeypatch.setattr(street_sets, "panel", lambda rows: drawn.extend(rows))
    street_sets.overview(LabelledStreets(0, count, Sensor("own", (5.0, -5.0, -20.0), 128), Options()))
    assert [len(row) for row in drawn] == [wide] * (count // wide) + [1]


@pytest.mark.parametrize(("beams", "tall"), [(16, 192), (64, 192), (128, 256), (300, 300)])
def test_the_strips_of_an_overview_are_about_equally_tall(beams: int, tall: int):
    sensor = Sensor("own", tuple(np.linspace(5, -20, beams)), 256)
    assert drawing.strips(LabelledStreets(0, 1, sensor, Options())[0], sensor).shape == (2 * tall, 1024, 3)


def test_the_verb_writes_says_and_grows(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    sensor = tmp_path / "own.toml"
    sensor.write_text("beams = 8\ntop = 5.0\nbottom = -20.0\nwidth = 128\n")
    words = ["streets", "--out", str(tmp_path / "set"), "--sensor", str(sensor), "--format", "pcd", "--workers", "1"]
    main([*words, "-n", "1"])
    main([*words, "-n", "2"])
    assert "has 2 labelled scans of own in the layout of pcd\n" in capsys.readouterr().out
    main([*words, "-n", "1"])
    assert "has 2 labelled scans of own in the layout of pcd, more than -n 1 asks for" in capsys.readouterr().out
    assert (tmp_path / "set" / "000001.pcd").exists() and (tmp_path / "set" / "overview.png").stat().st_size > 1000
    with pytest.raises(SystemExit) as refused:
        main([*words, "-n", "2", "--rain", "-3"])
    assert refused.value.code == 2
    assert "expected rain of 0 to 200 mm/h" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main([*words[:-1], "-1", "-n", "2"])
    assert "expected --workers of at least 0, found -1" in capsys.readouterr().err
