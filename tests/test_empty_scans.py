"""Scans of no point: files that say so are read as such, and what needs points says in a line that there are none."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from full_scan import full_scan

import lidarsynth as ls
from lidarsynth.cli.main import main
from lidarsynth.data.bag_records import Cloud
from lidarsynth.data.bag_writer import write_bag
from lidarsynth.data.frames import moved
from lidarsynth.evaluation.image_sets import image_set
from lidarsynth.files.fields import FileError, scan_from_fields
from lidarsynth.files.formats import WRITERS, read, write
from lidarsynth.files.point_cloud2 import decode, encode
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import SENSORS

NONE = "expected points, found a scan of none"
EMPTY = replace(full_scan(), extra={"tag": np.ones(len(full_scan()), np.uint64)})[:0]


def test_files_of_no_point_come_back(tmp_path: Path):
    for ending in set(WRITERS) - {".bin"}:
        write(tmp_path / f"none{ending}", EMPTY)
        again = read(tmp_path / f"none{ending}")
        assert len(again) == 0 and again.xyz.shape == (0, 3), ending
        if ending != ".npy":
            assert again.ring is not None and again.time is not None and again.label is not None
            assert again.extra["tag"].dtype.kind == "u"
    dark = np.zeros((16, 1024), np.float32)
    write(tmp_path / "image.npz", RangeImage(dark, dark, dark > 0, SENSORS["vlp-16"]))
    assert len(read(tmp_path / "image.npz")) == 0


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.pcd", "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH 0\nHEIGHT 1\nDATA ascii\n"),
        ("a.csv", "x,y,z,intensity\n"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\n"
                  "property uchar intensity\nproperty int time\nproperty ushort ring\nend_header\n"),
    ],
)  # fmt: skip
def test_texts_of_no_point_are_read(name: str, content: str, tmp_path: Path):
    (tmp_path / name).write_text(content)
    assert len(read(tmp_path / name)) == 0


def test_a_laz_of_no_point_is_read(tmp_path: Path):
    laspy = pytest.importorskip("laspy", reason="laspy comes with the extra `data`")
    for name in ("none.las", "none.laz"):
        laspy.LasData(laspy.LasHeader(point_format=1, version="1.2")).write(tmp_path / name)
        assert len(read(tmp_path / name)) == 0


def test_a_file_of_no_byte_is_no_scan(tmp_path: Path):
    """What is left where a copy was interrupted; so none is written either."""
    (tmp_path / "cut.bin").write_bytes(b"")
    with pytest.raises(FileError, match="expected 1 to 268435456 bytes of one scan, found 0"):
        read(tmp_path / "cut.bin")
    with pytest.raises(FileError, match=r"expected points for \.bin, whose file would be empty, found none"):
        write(tmp_path / "none.bin", EMPTY)
    assert not (tmp_path / "none.bin").exists()


def test_points_that_are_all_dropped_are_not_none(tmp_path: Path):
    np.save(tmp_path / "zeros.npy", np.zeros((7, 4), np.float32))
    with pytest.raises(FileError, match="at least one finite point away from the origin, found none in 7"):
        read(tmp_path / "zeros.npy")


def test_messages_of_no_point_are_scans_of_none():
    columns = {name: np.zeros(0, np.float32) for name in ("x", "y", "z", "intensity")}

    layout = encode(columns)
    places = [SimpleNamespace(name=n, offset=at, datatype=kind, count=1) for n, at, kind in layout.fields]
    message = SimpleNamespace(height=1, width=0, fields=places, is_bigendian=False, point_step=layout.point_step,
                              row_step=0, data=layout.data)  # fmt: skip
    scan, dropped = scan_from_fields(decode(message))
    assert (len(scan), dropped) == (0, 0)
    assert len(moved(EMPTY, np.eye(4))) == 0


@pytest.mark.parametrize("verb", ["complete", "upsample", "label", "realise", "project"])
def test_verbs_say_that_there_are_none(verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write(tmp_path / "none.ply", EMPTY)
    model = [] if verb == "project" else ["--model", "bilinear" if verb in ("complete", "upsample") else "default"]
    out = tmp_path / f"out.{'npz' if verb == 'project' else 'ply'}"
    with pytest.raises(SystemExit) as ended:
        main([verb, str(tmp_path / "none.ply"), "--out", str(out), *model])
    assert ended.value.code == 2 and not out.exists()
    assert capsys.readouterr().err == f"lidarsynth: {tmp_path / 'none.ply'}: {NONE}\n"


def test_it_is_left_out_of_many_and_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "in").mkdir()
    write(tmp_path / "in" / "a.ply", full_scan())
    write(tmp_path / "in" / "b.ply", EMPTY)
    main(["project", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--sensor", "vlp-16"])
    said = capsys.readouterr()
    assert f"b.ply: {NONE}" in said.err and "1 failed: b" in said.out
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [row.get("error") for row in report["scans"]] == [None, f"{tmp_path / 'in' / 'b.ply'}: {NONE}"]
    main(["data", "files", str(tmp_path / "in"), str(tmp_path / "cache"), "--sensor", "vlp-16", "--workers", "0"])
    assert "1 broken scan skipped" in capsys.readouterr().out


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_messages_of_no_point_are_left_out_of_a_bag(suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("rosbags", reason="rosbags comes with the extra `ros`")
    scan, words = full_scan(), ["--model", "bilinear", "--sensor", "vlp-16", "--no-picture"]
    for name, counts in (("some", (len(scan), 0)), ("none", (0,))):
        with write_bag(tmp_path / f"{name}{suffix}") as writer:
            for i, count in enumerate(counts):
                fields = {**dict(zip("xyz", scan.xyz[:count].T, strict=True)), "intensity": scan.reflectance[:count]}
                writer.write_cloud("/points", Cloud(i, "lidar", i + 1, fields))
    main(["complete", str(tmp_path / f"some{suffix}"), "--out", str(tmp_path / f"out{suffix}"), *words])
    said = capsys.readouterr()
    assert f"some{suffix}: 000001: {NONE}" in said.err and "1 scan in" in said.out
    with pytest.raises(SystemExit):
        main(["complete", str(tmp_path / f"none{suffix}"), "--out", str(tmp_path / f"no{suffix}"), *words])
    said = capsys.readouterr().err
    assert said == f"lidarsynth: {tmp_path / 'none'}{suffix}: 000000: {NONE}\n", "and not that the new bag is broken"
    assert not (tmp_path / f"no{suffix}").exists()


def test_info_and_view_take_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write(tmp_path / "none.ply", EMPTY)
    main(["info", str(tmp_path / "none.ply")])
    assert capsys.readouterr().out.split()[1:4] == ["points", "0", "fields"]
    main(["view", str(tmp_path / "none.ply"), "--out", str(tmp_path / "none.html")])
    assert (tmp_path / "none.html").stat().st_size > 10_000


def test_evaluate_counts_it_as_an_image_of_nothing(tmp_path: Path):
    (tmp_path / "in").mkdir()
    for name, scan in (("a", full_scan()), ("b", EMPTY), ("c", full_scan())):
        write(tmp_path / "in" / f"{name}.ply", scan)
    images = image_set(tmp_path / "in")
    assert [bool(images.image(i, SENSORS["vlp-16"], "spherical").mask.any()) for i in range(3)] == [True, False, True]
    assert isinstance(images.item(1), Scan) and len(ls.read(tmp_path / "in" / "b.ply")) == 0
