"""A second run: what the first one wrote is no scan to read, wherever --out lies."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from test_as_they_come import bag
from test_recognise import turn

from lidarsynth.cli.main import main
from lidarsynth.files.formats import write
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.verbs.inputs import inputs_of

WORDS = ("--no-picture", "--sensor", "vlp-16", "--skip-existing")


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    """Two scans, of other kinds."""
    (tmp_path / "in").mkdir()
    for name in ("a.bin", "b.pcd"):
        write(tmp_path / "in" / name, turn(SENSORS["vlp-16"]))
    return tmp_path / "in"


def files(folder: Path) -> list[str]:
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file() and p.suffix != ".lock")


def project(where: object, out: Path, *words: str) -> None:
    where = where if isinstance(where, list) else [where]
    main(["project", *map(str, where), "--out", str(out), *WORDS, *words])


def killed(out: Path) -> None:
    """As if the run had been killed: its report tells how scans are made, and of none."""
    for path in out.glob("report*.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"unfinished": True, "scans": []}))


def whole(out: Path) -> None:
    """The run came to its end."""


@pytest.mark.parametrize("end", [whole, killed])
@pytest.mark.parametrize("inside", [True, False], ids=["below", "in place"])
@pytest.mark.parametrize("words", [(), ("--format", "ply")])
def test_a_second_run_reads_what_the_first_one_read(
    end: Callable[[Path], None], inside: bool, words: tuple[str, ...], scans: Path, capsys: pytest.CaptureFixture[str]
):
    out = scans / "dense" if inside else scans
    project(scans, out, *words)
    before = files(scans)
    end(out)
    for where in (scans, scans / "*", f"{scans}/**/*", [path for path in scans.rglob("*") if path.suffix in KINDS]):
        capsys.readouterr()
        project(where, out, *words)
        said = capsys.readouterr()
        assert files(scans) == before and "2 were there already" in said.out and "passed over" not in said.err


KINDS = (".bin", ".pcd", ".ply", ".npz")


def test_a_killed_run_tells_what_it_made_though_its_scans_are_gone(scans: Path):
    project(scans, scans, "--format", "ply")
    report = scans / "report.json"
    rows = json.loads(report.read_text())["scans"]
    killed(scans)
    (scans / "a.bin").unlink()
    assert len(list(inputs_of([scans], None, scans).stream())) == 2  # a.ply may be anybody's
    (scans / ".report.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    assert [item.path.name for item in inputs_of([scans], None, scans).stream()] == ["b.pcd"]


@pytest.mark.parametrize("end", [whole, killed])
def test_shards_count_the_same_scans_whatever_the_others_have_written(end: Callable[[Path], None], scans: Path):
    for shard in ("1/2", "2/2", "1/2", "2/2"):
        project(scans, scans, "--shard", shard, "--format", "ply")
        end(scans)
    assert [name for name in files(scans) if "report" not in name] == ["a.bin", "a.ply", "b.pcd", "b.ply"]


def test_drives_whose_names_repeat_and_results_whose_scans_are_gone(scans: Path, tmp_path: Path):
    drives = tmp_path / "drives"
    for drive in ("d1", "d2"):
        shutil.copytree(scans, drives / drive)
    project(drives, drives, "--format", "ply")
    before = files(drives)
    (drives / "d2" / "a.bin").unlink()
    assert len(list(inputs_of([drives], None, drives).stream())) == 3
    main(["project", str(drives), "--out", str(drives), *WORDS[:-1], "--format", "ply"])  # makes them anew
    assert set(before) - set(files(drives)) == {"d2/a.bin"} and set(files(drives)) < set(before)
    assert len(list(inputs_of([drives / "d1" / "a.ply"], None, drives).stream())) == 1  # named: meant


def test_scans_that_get_other_names_are_said_to_be_made_anew(
    scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """As a file of a known name comes to another folder, and as it goes again; no more than once."""
    drives, out = tmp_path / "drives", tmp_path / "out"
    for drive, name in (("d1", "a.bin"), ("d2", "b.pcd"), ("d3", "a.bin")):
        (drives / drive).mkdir(parents=True)
        shutil.copy(scans / name, drives / drive)
    (drives / "d3" / "a.bin").rename(tmp_path / "a.bin")
    project(drives, out)
    assert capsys.readouterr().err == "" and files(out) == ["a.npz", "b.npz", "report.json"]
    (tmp_path / "a.bin").rename(drives / "d3" / "a.bin")
    project(drives, out)
    (line,) = capsys.readouterr().err.splitlines()
    assert "found 2 scans under others, such as a.npz for d1/a.npz: made anew" in line
    assert files(out) == ["a.npz", "b.npz", "d1/a.npz", "d2/b.npz", "d3/a.npz", "report.json"]
    project(drives, out)
    assert capsys.readouterr().err == ""
    (out / "a.npz").unlink()
    (drives / "d3" / "a.bin").unlink()
    project(drives, out)
    (line,) = capsys.readouterr().err.splitlines()
    assert "found 1 scan under others, such as d1/a.npz for a.npz: made anew" in line, "b.npz is there"


def test_bags_that_get_other_names_are_told_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("rosbags", reason="rosbags comes with the extra `ros`")
    for drive in ("d1", "d2"):
        (tmp_path / "in" / drive).mkdir(parents=True)
        bag(tmp_path / "in" / drive / "drive.bag", turn(SENSORS["vlp-16"]))
    (tmp_path / "in" / "d2" / "drive.bag").rename(tmp_path / "later")
    project(tmp_path / "in", tmp_path / "out")
    (tmp_path / "later").rename(tmp_path / "in" / "d2" / "drive.bag")
    assert capsys.readouterr().err == ""
    project(tmp_path / "in", tmp_path / "out")
    said = capsys.readouterr().err
    assert "found 2 scans under others, such as drive/000000.npz for d1/drive/000000.npz" in said


def test_turns_of_a_bag_do_not_take_its_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("rosbags", reason="rosbags comes with the extra `ros`")
    (tmp_path / "in").mkdir()
    bag(tmp_path / "in" / "drive.bag", turn(SENSORS["vlp-16"]))
    project(tmp_path / "in", tmp_path / "in", "--format", "ply")
    before = files(tmp_path / "in")
    for end in (whole, killed):
        end(tmp_path / "in")
        project(tmp_path / "in", tmp_path / "in", "--format", "ply")
        assert files(tmp_path / "in") == before
    assert "2 were there already" in capsys.readouterr().out


def test_scans_of_the_users_below_the_output_folder_are_told(scans: Path, capsys: pytest.CaptureFixture[str]):
    (scans / "d").mkdir()
    write(scans / "d" / "own.pcd", turn(SENSORS["vlp-16"]))
    project(scans, scans / "d")
    assert "1 scan below" in (said := capsys.readouterr().err) and "was passed over: own.pcd" in said
    assert files(scans / "d") == ["a.npz", "b.npz", "own.pcd", "report.json"]


def test_where_nothing_but_results_lies_a_line_says_so(scans: Path, capsys: pytest.CaptureFixture[str]):
    project(scans, scans.parent / "o")
    with pytest.raises(SystemExit, match="2"):
        project(scans.parent / "o", scans.parent / "o")
    (line,) = capsys.readouterr().err.splitlines()
    assert "expected scans to read, found only what lies in this output folder" in line
