"""What `data` says of folders: caches are no scans, those in the making are told, and what is not as expected is."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from full_scan import full_scan
from random_images import SENSOR, WHAT, image

from lidarsynth.cli.main import main
from lidarsynth.data.cache_files import is_cache
from lidarsynth.data.dataset import CachedImages, read_index, write_cache
from lidarsynth.data.folder import scan_files
from lidarsynth.data.frames import list_frames
from lidarsynth.data.kitti import kitti_published
from lidarsynth.data.kitti360 import kitti360
from lidarsynth.data.sources import unfit
from lidarsynth.evaluation.image_sets import image_set
from lidarsynth.files.formats import write
from lidarsynth.verbs.expansion import has_scans
from lidarsynth.verbs.file_kinds import file_lines
from lidarsynth.verbs.inputs import Reading, inputs_of
from lidarsynth.verbs.training_start import unfinished
from lidarsynth.viewer.series import series_of


def refused(words: list[object], capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    with pytest.raises(SystemExit, match="2"):
        main([str(word) for word in words])
    return capsys.readouterr().err


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    folder = tmp_path / "scans"
    folder.mkdir()
    write(folder / "a.npy", full_scan())
    write(folder / "b.npy", full_scan())
    return folder


def test_a_cache_among_scans_is_none_of_them(scans: Path, monkeypatch, capsys: pytest.CaptureFixture[str]):
    words = ["data", "files", str(scans), str(scans / "cache"), "--sensor", "vlp-16", "--workers", "0"]
    main(words)
    main(words)
    said = capsys.readouterr()
    assert "nothing is new: 2 images" in said.out and "broken" not in said.out
    monkeypatch.chdir(scans)
    main(["data", "files", ".", "cache", "--sensor", "vlp-16", "--workers", "0"])
    assert "nothing is new: 2 images" in capsys.readouterr().out
    assert [path.name for path in scan_files(scans)] == ["a.npy", "b.npy"]
    assert [item.name for item in inputs_of([scans]).stream()] == ["a", "b"]
    assert [item.name for item in inputs_of([scans / "**"]).stream()] == ["a", "b"]
    assert series_of([scans], Reading()).count == len(image_set(scans)) == 2
    assert (file_lines(scans, Reading()) or {})["scans"] == "2 .npy"
    assert "found a cache of range images" in refused(["data", "files", scans / "cache", scans / "o"], capsys)
    assert not has_scans(scans / "cache")
    for path in scans.glob("*.npy"):
        path.write_bytes(b"broken")
    error = refused(["data", "files", scans, scans.parent / "o", "--sensor", "vlp-16", "--workers", "0"], capsys)
    assert "expected a scan that can be projected among 2, found none; the first, a.npy: " in error


def test_scans_that_lie_in_a_cache_and_others_of_such_names_are_read(scans: Path):
    list(write_cache(scans / "cache", image, 70, SENSOR, WHAT))
    shutil.copytree(scans / "cache", scans / "begun", ignore=lambda *_: ["index.json", "report.json", "0000064.npy"])
    (scans / "own").mkdir()
    for path in (scans / "cache" / "deep" / "c.npy", scans / "own" / "0000000.npy"):
        path.parent.mkdir(exist_ok=True)
        write(path, full_scan())
    (scans / "torn").mkdir()
    (scans / "torn" / "0000000.npy").write_bytes(b"\x93NUMPY\x01\0v\0{'descr': [('range', (((")  # no shard, nor a scan
    for folder in (scans, scans / "own"):
        (folder / "index.json").write_text('{"scans": 3}')  # somebody's own
    found = [path.relative_to(scans).as_posix() for path in scan_files(scans)]
    assert found == ["a.npy", "b.npy", "cache/deep/c.npy", "own/0000000.npy", "torn/0000000.npy"]
    assert [is_cache(scans / name) for name in ("cache", "begun", "own", "")] == [True, True, False, False]
    assert (file_lines(scans, Reading()) or {})["kind"] == "folder of scans", "whatever its index.json is of"
    assert len(image_set(scans / "own")) == 1


def test_info_tells_of_a_cache_in_the_making(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    made = write_cache(tmp_path / "cache", image, 150, SENSOR, WHAT)
    assert next(made) == 64
    made.close()
    main(["info", str(tmp_path / "cache")])
    told = " ".join(capsys.readouterr().out.split())
    assert "images 64" in told and "unfinished 64 of 150 scans done; the same data command goes on" in told
    assert "found 64 of 150 scans done" in unfinished(f"{tmp_path}/cache") and unfinished("synthetic") == ""
    (tmp_path / "cache" / "index.json").unlink()  # as one that was killed at once
    (tmp_path / "cache" / "report.json").unlink()
    main(["info", str(tmp_path / "cache")])
    assert "was begun, still without index.json; the same data command goes on" in capsys.readouterr().out
    list(write_cache(tmp_path / "cache", image, 150, SENSOR, WHAT))
    assert "unfinished" not in (file_lines(tmp_path / "cache", Reading()) or {})
    assert unfinished(tmp_path / "cache") == ""
    (tmp_path / "in" / "empty").mkdir(parents=True)
    shutil.copytree(tmp_path / "cache", tmp_path / "in" / "cache")
    assert "found only caches or empty folders" in refused(["info", tmp_path / "in"], capsys)


def test_info_tells_of_shards_that_are_gone_or_cut(tmp_path: Path):
    list(write_cache(tmp_path / "cache", image, 300, SENSOR, WHAT))
    assert "broken" not in (file_lines(tmp_path / "cache", Reading()) or {})
    for name in ("0000000.npy", "0000128.npy", "0000192.npy"):
        (tmp_path / "cache" / name).unlink()
    (tmp_path / "cache" / "0000256.npy").write_bytes(b"cut")
    told = (file_lines(tmp_path / "cache", Reading()) or {})["broken"]
    assert told == ("4 shards of 5 gone or cut (0000000.npy, 0000128.npy, 0000192.npy, ...); the same data command "
                    "makes them anew")  # fmt: skip
    list(write_cache(tmp_path / "cache", image, 300, SENSOR, WHAT))
    assert "broken" not in (file_lines(tmp_path / "cache", Reading()) or {}) and len(CachedImages(tmp_path / "cache"))


def test_other_files_of_data_sets_are_no_scans(tmp_path: Path):
    """Argoverse 2's tables and map beside its sweeps, KITTI-360's planar scanner beside its turns."""
    sweep, turn = "log/sensors/lidar/3159.feather", "drive_sync/velodyne_points/data/0.bin"
    others = ("log/annotations.feather", "log/city_SE3_egovehicle.feather", "log/calibration/intrinsics.feather",
              "log/calibration/egovehicle_SE3_sensor.feather", "log/map/log_ground_height_surface____PIT.npy",
              "drive_sync/sick_points/data/0.bin")  # fmt: skip
    for name in (sweep, turn, *others):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"0")
    assert [path.relative_to(tmp_path).as_posix() for path in scan_files(tmp_path)] == [turn, sweep]
    (named,) = inputs_of([tmp_path / others[0]]).stream()
    assert named.path == tmp_path / others[0], "one that is named is read, and refused as what it is"


def test_a_folder_of_text_says_how_such_scans_are_taken(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """VeloView writes each turn as a .csv, which a folder's scans are not taken to be."""
    folder = tmp_path / "turns"
    folder.mkdir()
    x, y, z = full_scan().xyz.T
    for i in range(2):
        rows = "\n".join(f"{a},{b},{c},9" for a, b, c in zip(x, y, z, strict=True))
        (folder / f"turn (Frame {i:04d}).csv").write_text(f"x,y,z,intensity\n{rows}\n")
    error = refused(["data", "files", folder, tmp_path / "cache", "--sensor", "vlp-16"], capsys)
    assert f"found none but 2 files of text: where they are scans, name them, as '{folder}/*.csv'; for a cache" in error
    assert f"`lidarsynth project '{folder}/*.csv' --out IMAGES` makes images first" in error
    (folder / "NOTES.txt").touch()
    error = refused(["data", "files", folder, tmp_path / "cache", "--sensor", "vlp-16"], capsys)
    assert f"none but 3 files of text: where they are scans, name them, as '{folder}/*.csv'; for a cache" in error
    main(["project", f"{folder}/*.csv", "--sensor", "vlp-16", "--out", str(tmp_path / "images"), "--no-picture"])
    main(["data", "files", str(tmp_path / "images"), str(tmp_path / "cache"), "--workers", "0"])
    assert len(CachedImages(tmp_path / "cache")) == 2
    with pytest.raises(ValueError, match=r"turns: expected a cache, or samples \(") as told:
        image_set(folder)
    assert ".csv" not in str(told.value) and ".txt" not in str(told.value), "of which a folder's are none"


def test_a_cache_whose_last_scans_are_gone_is_whole(scans: Path):
    words = ["data", "files", str(scans), str(scans / "cache"), "--sensor", "vlp-16", "--workers", "0"]
    main(words)
    (scans / "b.npy").unlink()
    main(words)
    assert read_index(scans / "cache")["count"] == 1
    assert "unfinished" not in (file_lines(scans / "cache", Reading()) or {})


def test_labels_where_write_puts_them_are_taken_and_only_labels_make_images_anew(tmp_path: Path, capsys):
    """`complete` and `label` read and write the labels of NN/velodyne/a.npy as NN/labels/a.label."""
    velodyne, cache = tmp_path / "00" / "velodyne", tmp_path / "cache"
    velodyne.mkdir(parents=True)
    scan = full_scan()
    table = np.column_stack([scan.xyz, scan.reflectance]).astype("<f4")
    table.tofile(velodyne / "a.bin")
    words = ["data", "files", str(tmp_path / "00"), str(cache), "--sensor", "vlp-16", "--workers", "0"]
    main(words)
    assert CachedImages(cache)[0].label is None
    (tmp_path / "00" / "labels").mkdir()
    np.full(len(table), 40, "<u4").tofile(tmp_path / "00" / "labels" / "a.label")
    capsys.readouterr()
    main(words)
    label = CachedImages(cache)[0].label
    assert label is not None and label.max() == 9 and "wrote 1 image" in capsys.readouterr().out
    np.ones(len(table), "u1").tofile(velodyne / "a.new")
    main(words)
    assert "nothing is new" in capsys.readouterr().out, "of marks no image depends"


def test_data_sets_say_what_they_expect(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "file").write_text("")
    (tmp_path / "dangling").symlink_to("nowhere")
    for source in ("kitti", "kitti-r2dm", "kitti360", "nuscenes", "files"):
        for root, found in (("file", "a file"), ("nothing", "nothing"), ("dangling", "nothing")):
            error = refused(["data", source, tmp_path / root, tmp_path / "cache"], capsys)
            assert f"{root}: expected a folder of scans, found {found}" in error
    with pytest.raises(ValueError, match="expected drives, data_3d_raw/2013_05_28_drive_NNNN_sync, found none"):
        kitti360(tmp_path)
    with pytest.raises(ValueError, match="expected raw drives, DATE/DATE_drive_NNNN_sync, found none"):
        kitti_published(tmp_path)
    error = refused(["data", "nuscenes", tmp_path, tmp_path / "cache"], capsys)
    assert "found none: data files takes scans without tables" in error
    (tmp_path / "a.pcd.bin").write_bytes(b"\0" * 20)
    with pytest.raises(ValueError, match=r"a\.pcd\.bin: expected a \.bin of four floats a point, found a \.pcd\.bin"):
        list_frames(tmp_path, "00")


def test_a_cache_that_cannot_be_written_is_one_line_that_names_its_folder(scans: Path, tmp_path: Path, capsys):
    (tmp_path / "file").write_text("")
    (tmp_path / "dangling").symlink_to("nowhere")
    for place, found in (("file", " a file"), ("dangling", " a link to nothing"), ("file/sub", ": Not a directory")):
        error = refused(["data", "files", scans, tmp_path / place, "--sensor", "vlp-16", "--workers", "0"], capsys)
        assert f"{place}: expected a folder to write to, found{found}" in error and error.count("\n") == 1
    assert not (tmp_path / "nowhere").exists() and (tmp_path / "file").read_text() == ""


def test_scans_of_another_sensor_in_a_data_set_are_told_of(tmp_path: Path):
    folder = tmp_path / "data_3d_raw" / "2013_05_28_drive_0003_sync" / "velodyne_points" / "data"
    folder.mkdir(parents=True)
    azimuth, up = np.meshgrid(np.linspace(-np.pi, np.pi, 400), np.radians(np.linspace(15, -15, 16)))
    ray = np.stack([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)], -1).reshape(-1, 3)
    for i in range(2):
        np.column_stack([10 * ray, np.full(len(ray), 0.5)]).astype("<f4").tofile(folder / f"{i:010d}.bin")
    line = unfit("kitti360", tmp_path, None)
    assert line is not None and "0000000000.bin: expected points of hdl-64e, found" in line
    assert "2 of 2 scans that were looked at are so, and drawn all the same" in line
    assert unfit("nuscenes", tmp_path, None) is None and unfit("synthetic", tmp_path, None) is None


@pytest.mark.parametrize("name", ["drive.pcap", "drive.bag", "drive"])
def test_of_a_bag_or_capture_data_files_says_how_it_is_read(name: str, tmp_path: Path, capsys: pytest.CaptureFixture):
    """It said that a file, or nothing, was found; `evaluate` told what to do."""
    (tmp_path / "in").mkdir()
    if name == "drive":
        (tmp_path / "in" / name).mkdir()
        (tmp_path / "in" / name / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  version: 9\n")
    else:
        (tmp_path / "in" / name).write_bytes(b"")
    for root, found in ((tmp_path / "in" / name, "a bag or capture"), (tmp_path / "in", "bags or captures in it")):
        error = refused(["data", "files", root, tmp_path / "cache"], capsys)
        assert f": of {found} `lidarsynth project {root} --out IMAGES` makes images first" in error
