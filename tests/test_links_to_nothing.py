"""Links to nothing and pipes that have the name of a scan are told and counted as broken ones, and never opened."""

import json
import os
import socket
from pathlib import Path

import pytest
from full_scan import full_scan

from lidarsynth.cli.main import main
from lidarsynth.data.folder import scan_files
from lidarsynth.evaluation.image_sets import image_set
from lidarsynth.files.formats import holds_image, write

LINK = "a link to ../annex/b, which is not there"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scan, links to nothing, pipes and a socket, and what a folder may hold beside scans."""
    scans = tmp_path / "in"
    scans.mkdir()
    write(scans / "a.ply", full_scan())
    for name in ("b.pcd", "times.txt", ".#a.ply"):
        (scans / name).symlink_to("../annex/b")
    (scans / "others.bin").mkdir()
    for name in ("c.npz", "d.pcd", "e.bin"):
        os.mkfifo(scans / name)
    return scans


def test_they_are_counted_as_broken_and_the_rest_is_done(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    assert [path.name for path in scan_files(folder)] == ["a.ply", "b.pcd", "c.npz", "d.pcd", "e.bin"]
    main(["complete", str(folder), "--out", str(tmp_path / "out"), "--model", "bilinear", "--sensor", "vlp-16"])
    said = capsys.readouterr()
    assert f"b.pcd: expected a file, found {LINK}" in said.err and "4 failed: b, c, d, e" in said.out
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["failed"] == 4 and (tmp_path / "out" / "a.ply").is_file()
    told = {row["name"]: row.get("error", "") for row in report["scans"]}
    assert not told["a"] and LINK in told["b"] and all("found a device or pipe" in told[name] for name in "cde")
    main(["data", "files", str(folder), str(tmp_path / "cache"), "--sensor", "vlp-16", "--workers", "0"])
    assert "4 broken scans skipped" in capsys.readouterr().out


def test_info_tells_of_them(folder: Path, capsys: pytest.CaptureFixture):
    main(["info", str(folder)])
    said = capsys.readouterr().out
    assert f"4 of them: b.pcd: {LINK}, c.npz: a device or pipe, d.pcd: a device or pipe, ...\n" in said
    for name in ("b.pcd", "c.npz", "d.pcd"):
        with pytest.raises(SystemExit):
            main(["info", str(folder / name)])
        assert f"{name}: expected a file, found" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"b\.pcd: expected a file, found a link to"):
        image_set(folder)


def test_where_all_are_broken_nothing_was_done(tmp_path: Path, capsys: pytest.CaptureFixture):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.bin").symlink_to("nowhere")
    with socket.socket(socket.AF_UNIX) as one:
        place = os.getcwd()
        os.chdir(tmp_path / "in")  # the name of a socket may be 100 characters long
        try:
            one.bind("b.bin")
        finally:
            os.chdir(place)
        with pytest.raises(SystemExit) as ended:
            main(["complete", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--model", "bilinear"])
    assert ended.value.code == 2 and "found all 2 broken" in capsys.readouterr().err
    assert not holds_image(tmp_path / "in" / "b.bin")
