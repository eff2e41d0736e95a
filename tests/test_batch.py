"""Many scans: which are read, what is written, skipped, failed and told; in parts and in processes."""

import errno
import json
import multiprocessing
import time
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from test_frame import street
from test_recognise import turn

from lidarsynth.cli.main import main
from lidarsynth.data.bag_records import POINTS, typestore
from lidarsynth.data.windows import in_window
from lidarsynth.data.workers import in_order
from lidarsynth.experiment.folder import save
from lidarsynth.files.formats import read, write
from lidarsynth.files.lock import only_writer
from lidarsynth.lidar.frame import parse_transform, transformed
from lidarsynth.lidar.scan import Scan, scan_of
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.systems.scan_model import ScanModel
from lidarsynth.verbs.batch import Result
from lidarsynth.verbs.batch_report import add_to_journal, merge_shards, parse_shard
from lidarsynth.verbs.inputs import inputs_of
from lidarsynth.weights.load import load, load_parts


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    """Five scans in two drives whose names repeat, one of them broken."""
    scan = turn(SENSORS["vlp-16"])
    for drive, count in (("d1", 3), ("d2", 2)):
        (tmp_path / "in" / drive).mkdir(parents=True)
        for i in range(count):
            write(tmp_path / "in" / drive / f"{i:03d}.pcd", scan)
    (tmp_path / "in" / "d1" / "001.pcd").write_bytes(b"no points")
    (tmp_path / "in" / "times.txt").write_text("0.1\n0.2\n")
    return tmp_path / "in"


def told(folder: Path, name: str = "report.json") -> dict:
    return json.loads((folder / name).read_text())


def names(folder: Path) -> list[str]:
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


WORDS = ("--no-picture", "--sensor", "vlp-16")


def test_one_broken_file_is_named_and_counted(scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    main(["project", str(scans), "--out", str(tmp_path / "o"), *WORDS])
    said = capsys.readouterr()
    assert "4 scans in" in said.out and "1 failed: d1/001" in said.out
    assert "d1/001.pcd: expected a PCD header" in said.err and said.err.count("expected") == 1
    assert names(tmp_path / "o") == ["d1/000.npz", "d1/002.npz", "d2/000.npz", "d2/001.npz", "report.json"]
    report = told(tmp_path / "o")
    assert (report["done"], report["failed"], report["skipped"]) == (4, 1, 0)
    assert [row["name"] for row in report["scans"] if "error" in row] == ["d1/001"]
    assert all(row["seconds"] > 0 for row in report["scans"])


def test_a_file_of_an_earlier_run_is_told_where_its_scan_fails_now(
    scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    words = ["project", str(scans), "--out", str(tmp_path / "o"), *WORDS]
    main(words)
    (scans / "d2" / "000.pcd").write_bytes(b"no points")
    main([*words, "--width", "256"])
    old = tmp_path / "o" / "d2" / "000.npz"
    assert f"; {old} is of an earlier run" in capsys.readouterr().err and old.exists()
    errors = {row["name"]: row["error"] for row in told(tmp_path / "o")["scans"] if "error" in row}
    assert "earlier run" in errors["d2/000"] and "earlier run" not in errors["d1/001"]


@pytest.mark.parametrize("name", ["x.db3", "y.pcap", "z.las", "d3.zip", "w.csv", "v.tar.gz", "U.E57"])
def test_a_kind_that_is_not_written_is_no_folder(
    scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
):
    with pytest.raises(SystemExit) as end:
        main(["project", str(scans), "--out", str(tmp_path / name), *WORDS])
    line = capsys.readouterr().err.split("\r")[-1]
    assert end.value.code == 2 and line.count("\n") == 1
    assert f"{name}: expected the name of a folder for 5 scans, found that of a file; written are .bin, " in line
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize("name", ["run.v2", "2026.11.25", "there.las"])
def test_a_folder_may_have_a_dot(scans: Path, tmp_path: Path, name: str):
    if name == "there.las":
        (tmp_path / name).mkdir()
    main(["project", str(scans / "d2"), "--out", str(tmp_path / name), *WORDS])
    assert names(tmp_path / name) == ["000.npz", "001.npz", "report.json"]


def test_what_is_there_is_skipped(scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = ["--out", str(tmp_path / "o"), *WORDS]
    main(["project", str(scans / "d2"), *out])
    first = {name: (tmp_path / "o" / name).stat().st_mtime_ns for name in ("000.npz", "001.npz")}
    (tmp_path / "o" / "001.npz").unlink()
    main(["project", str(scans / "d2"), *out, "--skip-existing"])
    assert "1 scan in" in capsys.readouterr().out and told(tmp_path / "o")["skipped"] == 1
    assert (tmp_path / "o" / "000.npz").stat().st_mtime_ns == first["000.npz"]
    main(["project", str(scans / "d2"), *out, "--skip-existing"])
    assert told(tmp_path / "o")["skipped"] == 2


@pytest.mark.parametrize("shards", [1, 2])
def test_the_report_tells_of_the_scans_that_were_there(shards: int, scans: Path, tmp_path: Path):
    """Rows and errors of those that a run before has made, without those that were taken away and failed."""
    words = ["complete", str(scans / "d2"), "--out", str(tmp_path / "o"), *WORDS, "--model", "bilinear"]
    words += ["--corrupt", "beams:2", "--no-picture"]
    parts = [["--shard", f"{i + 1}/{shards}"] for i in range(shards)] if shards > 1 else [[]]
    for part in parts:
        main([*words, *part])
    whole = told(tmp_path / "o")
    assert len(whole["scans"]) == 2 and whole["errors"]["lidarsynth"]["pixels"] > 0
    for gone in ("001.ply", None):
        if gone is not None:
            (tmp_path / "o" / gone).unlink()
        for part in parts:
            main([*words, *part, "--skip-existing"])
        again = told(tmp_path / "o")
        assert again["errors"] == whole["errors"] and again["skipped"] == (1 if gone else 2)
        assert sorted(row["name"] for row in again["scans"]) == ["000", "001"]


def test_a_folder_may_be_called_otherwise_by_the_run_that_goes_on(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    words = ["complete", "in/d2", *WORDS, "--model", "nearest", "--corrupt", "beams:2", "--out"]
    main([*words, "o"])
    whole = told(tmp_path / "o")
    (tmp_path / "o").rename(tmp_path / "moved")
    for out in (str(tmp_path / "moved"), "./in/../moved"):
        main([*words, out, "--skip-existing"])
        again = told(tmp_path / "moved")
        assert (again["errors"], again["skipped"], len(again["scans"])) == (whole["errors"], 2, 2)
        assert [row["target"] for row in again["scans"]] == [str(Path(out) / f"{i:03d}.ply") for i in (0, 1)]


@pytest.mark.parametrize("shards", [1, 2])
@pytest.mark.parametrize("corrupt", [[], ["--corrupt", "beams:2"]], ids=["filled", "judged"])
def test_what_a_killed_run_has_made_stays_in_the_report(
    corrupt: list[str], shards: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "in").mkdir()
    for i in range(4 * shards):
        write(tmp_path / "in" / f"{i:03d}.pcd", turn(SENSORS["vlp-16"]))
    words = ["complete", str(tmp_path / "in"), *WORDS, "--model", "nearest", *corrupt, "--skip-existing", "--out"]
    parts = [["--shard", f"{i + 1}/{shards}"] for i in range(shards)] if shards > 1 else [[]]
    for part in parts:
        main([*words, str(tmp_path / "whole"), *part])
        with monkeypatch.context() as patch:  # the third file is there, and no row yet, as where processes are ahead
            patch.setattr("lidarsynth.verbs.batch_report.add_to_journal", third_time())
            with pytest.raises(SystemExit, match="130"):
                main([*words, str(tmp_path / "o"), *part])
    place, whole = tmp_path / "o", told(tmp_path / "whole")
    (journal, *_) = sorted(place.glob(".report*.jsonl"))
    with journal.open("a") as file:
        file.write('{"name": "00')
    capsys.readouterr()
    for part in parts:
        main([*words, str(place), *part])
    again, said = told(place), capsys.readouterr().out
    assert again["skipped"] == (2 if corrupt else 3) * shards and again.get("errors") == whole.get("errors")
    assert len(again["scans"]) == (4 if corrupt else 3) * shards and not [n for n in names(place) if n[0] == "."]
    assert said.count("mean of 4 scans") == (shards if corrupt else 0)


def third_time():
    """What adds to a journal twice, then is stopped."""
    rows = []

    def add(report: Path, result: Result) -> None:
        rows.append(result)
        if len(rows) == 3:
            raise KeyboardInterrupt
        add_to_journal(report, result)

    return add


def test_what_is_there_of_another_recipe_is_not_gone_on_with(
    scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    words = ["complete", str(scans / "d2"), "--out", str(tmp_path / "o"), *WORDS, "--model", "bilinear"]
    main([*words, "--corrupt", "beams:2"])
    first = told(tmp_path / "o")
    assert first["settings"]["recipe"]["corrupt"] == "beams:2" and first["settings"]["recipe"]["model"] == "bilinear"
    for other, said in (
        ([], "corrupt none for beams:2"),
        (["--corrupt", "beams:4"], "corrupt beams:4 for beams:2"),
        (["--corrupt", "beams:2", "--intensity", "byte"], "intensity byte for none"),
        (["--corrupt", "beams:2", "--seed", "3"], "seed 3 for 0"),
        (["--corrupt", "beams:2", "--mount", "1.7"], "transform"),
    ):
        with pytest.raises(SystemExit, match="2"):
            main([*words, *other, "--skip-existing"])
        error = capsys.readouterr().err
        assert said in error and "expected scans made as they are asked for now" in error and error.count("\n") == 1
    assert told(tmp_path / "o") == first
    main([*words, "--corrupt", "beams:2", "--skip-existing", "--workers", "2"])
    assert told(tmp_path / "o")["skipped"] == 2
    (tmp_path / "o" / "report-of-mine.json").write_text("[1]")
    main([*words, "--corrupt", "beams:2", "--skip-existing"])


def test_a_killed_run_tells_how_its_scans_were_made(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    words = ["complete", str(scans / "d1"), "--out", str(tmp_path / "o"), *WORDS, "--model", "bilinear"]
    with monkeypatch.context() as patch:
        patch.setattr("lidarsynth.cli.many.tell_of_many", killed)
        with pytest.raises(SystemExit, match="130"):
            main(words)
    assert told(tmp_path / "o")["unfinished"]
    assert names(tmp_path / "o") == [".report.jsonl", "000.ply", "report.json"]
    main(["info", str(tmp_path / "o" / "report.json")])
    assert "not done" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        main([*words, "--sensor", "hdl-32e", "--skip-existing"])
    assert "sensor hdl-32e for vlp-16" in capsys.readouterr().err
    main([*words, "--skip-existing"])
    assert "unfinished" not in told(tmp_path / "o") and told(tmp_path / "o")["skipped"] == 1
    capsys.readouterr()
    with monkeypatch.context() as patch:  # another recipe, killed after its first scan: two recipes are in the folder
        patch.setattr("lidarsynth.cli.many.tell_of_many", killed)
        with pytest.raises(SystemExit, match="130"):
            main([*words, "--seed", "1"])
    for seed, said in (("0", "seed 0 for 1"), ("1", "scans of two settings")):
        with pytest.raises(SystemExit, match="2"):
            main([*words, "--seed", seed, "--skip-existing"])
        assert said in capsys.readouterr().err
    main([*words, "--seed", "1"])
    assert not {"mixed", "unfinished"} & told(tmp_path / "o").keys()


def killed(*_: object) -> None:
    raise KeyboardInterrupt


def test_errors_of_what_was_hidden_stand_in_the_report(scans: Path, tmp_path: Path):
    words = ["complete", str(scans), *WORDS, "--model", "bilinear", "--corrupt", "beams:2"]
    main([*words, "--out", str(tmp_path / "o")])
    report = told(tmp_path / "o")
    rows = [row["errors"]["bilinear"] for row in report["scans"] if "error" not in row]
    assert len(rows) == 4 and all(row["pixels"] > 100 and row["range_mae"] > 0 for row in rows)
    assert report["errors"]["bilinear"]["range_mae"] == pytest.approx(np.mean([row["range_mae"] for row in rows]))
    for part in ("1/2", "2/2"):
        main([*words, "--out", str(tmp_path / "parts"), "--shard", part])
    for method, errors in told(tmp_path / "parts")["errors"].items():
        assert errors == pytest.approx(report["errors"][method])


def test_of_one_file_nothing_that_is_asked_for_is_ignored(
    scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    words = ["project", str(scans / "d1" / "000.pcd"), "--out", str(tmp_path / "a.npz"), *WORDS]
    with pytest.raises(SystemExit, match="2"):
        main([*words, "--shard", "3/2"])
    assert "a.npz: expected a folder with --shard 3/2" in capsys.readouterr().err
    main(words)
    (tmp_path / "a.npz").write_bytes(b"kept")
    main([*words, "--skip-existing"])
    assert "a.npz is there already" in capsys.readouterr().out and (tmp_path / "a.npz").read_bytes() == b"kept"


def test_a_full_disk_stops_at_once_and_what_a_kill_left_is_swept(
    scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    words, place = ["project", str(scans / "d2"), "--out", str(tmp_path / "o"), *WORDS], tmp_path / "o"
    place.mkdir()
    (place / ".000.0123456789abcdef.part").write_bytes(b"half")
    (place / ".mine.part").write_bytes(b"a user's own")
    with monkeypatch.context() as patch:
        patch.setattr("lidarsynth.lidar.whole_file.os.replace", full)
        with pytest.raises(SystemExit, match="2"):
            main(words)
    assert capsys.readouterr().err.count("No space left") == 1 and names(place) == [".mine.part"]
    main(words)
    assert "2 scans in" in capsys.readouterr().out


def test_a_scan_whose_picture_does_not_fit_on_the_disk_is_not_done(scans, tmp_path, capsys, monkeypatch):
    words = ["project", str(scans / "d2"), "--out", str(tmp_path / "o"), "--sensor", "vlp-16"]
    with monkeypatch.context() as patch:
        patch.setattr("lidarsynth.verbs.batch.save_png", full)
        with pytest.raises(SystemExit, match="2"):
            main(words)
    assert "No space left" in capsys.readouterr().err and not (tmp_path / "o").exists()
    main([*words, "--skip-existing"])
    assert names(tmp_path / "o") == ["000.npz", "000.png", "001.npz", "001.png", "report.json"]


def full(*names: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("out", ["o.mcap", "o"])
def test_a_topic_without_messages_is_told(out: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("rosbags", reason="rosbags comes with the extra `ros`")
    from rosbags.rosbag1 import Writer

    with Writer(tmp_path / "in.bag") as writer:
        writer.add_connection("/points", POINTS, typestore=typestore("ros1"))
    main(["complete", str(tmp_path / "in.bag"), "--out", str(tmp_path / out), *WORDS, "--model", "nearest"])
    assert " s; there was none to read; see " in capsys.readouterr().out


def test_shards_are_the_whole(scans: Path, tmp_path: Path):
    for part in (2, 1):
        main(["project", str(scans), "--out", str(tmp_path / "parts"), *WORDS, "--shard", f"{part}/2"])
        assert (tmp_path / "parts" / "report.json").exists() == (part == 1)
    main(["project", str(scans), "--out", str(tmp_path / "whole"), *WORDS])
    arrays = [name for name in names(tmp_path / "whole") if name.endswith(".npz")]
    assert [name for name in names(tmp_path / "parts") if name.endswith(".npz")] == arrays
    for name in arrays:
        with np.load(tmp_path / "parts" / name) as one, np.load(tmp_path / "whole" / name) as other:
            np.testing.assert_array_equal(one["range"], other["range"])
    merged, whole = told(tmp_path / "parts"), told(tmp_path / "whole")
    assert merged["settings"]["shards"] == 2
    assert [(r["name"], r.get("points")) for r in merged["scans"]] == [
        (r["name"], r.get("points")) for r in whole["scans"]
    ]
    assert merge_shards(tmp_path / "whole", 2) is None
    assert parse_shard(None) == (1, 1)
    for wrong in ("3", "0/2", "3/2", "a/b"):
        with pytest.raises(ValueError, match="I/N"):
            parse_shard(wrong)


@pytest.mark.parametrize("verb", ["project", "complete"])
def test_where_only_broken_files_are_left_they_are_counted(
    verb: str, scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """So that a job that goes on where it was stopped, and a shard, end as the whole run does."""
    words = [verb, str(scans / "d1"), "--out", str(tmp_path / "o"), *WORDS]
    words += ["--model", "bilinear"] if verb == "complete" else []
    for skipped in (0, 2):
        main([*words, "--skip-existing"])
        report = told(tmp_path / "o")
        assert (report["done"], report["failed"], report["skipped"]) == (2 - skipped, 1, skipped)
        assert len(report["scans"]) == 3
    said = capsys.readouterr()
    assert "2 were there already; 1 failed: 001" in said.out and said.err.count("001.pcd: expected") == 2
    words[3] = str(tmp_path / "parts")
    for part in (1, 2, 3, 2):
        main([*words, "--shard", f"{part}/3"])
    assert capsys.readouterr().err.count("001.pcd: expected") == 2
    merged = told(tmp_path / "parts")
    assert (merged["done"], merged["failed"], merged["skipped"]) == (2, 1, 0) and len(merged["scans"]) == 3


def test_globs_folders_and_files_are_alike(scans: Path):
    count = [inputs_of(paths).count for paths in ([scans], [scans / "d1", scans / "d2"], [scans / "*" / "*.pcd"])]
    assert count == [5, 5, 5]
    items = list(inputs_of([scans]).stream())
    assert [item.name for item in items] == ["d1/000", "d1/001", "d1/002", "d2/000", "d2/001"]
    assert inputs_of([scans / "d1" / "000.pcd"]).single and not inputs_of([scans / "d2"]).single
    with pytest.raises(ValueError, match="found none"):
        inputs_of([scans / "*.bin"])
    with pytest.raises(ValueError, match="two named"):
        inputs_of([scans / "d1" / "000.pcd", scans / "d1" / "000.pcd"])


def test_all_broken_is_a_refusal_and_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "in").mkdir()
    for name in ("a.pcd", "b.pcd"):
        (tmp_path / "in" / name).write_bytes(b"no points")
    with pytest.raises(SystemExit, match="2"):
        main(["project", str(tmp_path / "in"), "--out", str(tmp_path / "o"), *WORDS])
    assert "found all 2 broken; the first: " in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_shards_that_are_all_broken_end_as_a_refusal_of_the_last(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "in").mkdir()
    for name in ("a.pcd", "b.pcd"):
        (tmp_path / "in" / name).write_bytes(b"no points")
    words = ["project", str(tmp_path / "in"), "--out", str(tmp_path / "o"), *WORDS, "--shard"]
    main([*words, "1/2"])
    with pytest.raises(SystemExit, match="2"):
        main([*words, "2/2"])
    assert "report.json: expected scans, found all 2 of 2 shards broken" in capsys.readouterr().err


def test_a_broken_shard_does_not_speak_for_the_scans_of_another_recipe(scans: Path, tmp_path: Path):
    words = ["project", str(scans / "d2"), "--out", str(tmp_path / "o"), *WORDS, "--shard", "1/2", "--width"]
    main([*words, "256"])
    first = told(tmp_path / "o", "report-1-of-2.json")
    (scans / "d2" / "000.pcd").write_bytes(b"no points")
    with pytest.raises(SystemExit, match="2"):
        main([*words, "512"])
    assert told(tmp_path / "o", "report-1-of-2.json") == first


def test_points_of_another_frame_come_back_where_they_were(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """With --mount the scan is filled in the sensor's frame; the file keeps its own, measured points bit by bit."""
    scan = street("hdl-64e-kitti")
    raised = Scan(transformed(scan.xyz, parse_transform("0:0:1.73:0:0:0")), scan.reflectance, ring=scan.ring,
                  extra={"ambient": np.arange(len(scan))})  # fmt: skip
    write(tmp_path / "raised.ply", raised)
    words = ["complete", str(tmp_path / "raised.ply"), "--model", "bilinear", "--no-picture", "--out"]
    with pytest.raises(SystemExit, match="2"):
        main([*words, str(tmp_path / "a.ply"), "--strict"])
    assert "m above the origin" in (error := capsys.readouterr().err) and "--transform 0:0:-1." in error
    main([*words, str(tmp_path / "a.ply"), "--sensor", "hdl-64e-kitti"])
    assert "above the origin" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):  # the beams are no known sensor's, as the frame is another
        main(["project", *words[1:2], "--no-picture", "--out", str(tmp_path / "a.npz")])
    error = capsys.readouterr().err
    assert error.index("above the origin") < error.index("as they are: ") < error.index("--sensor")
    main([*words, str(tmp_path / "b.ply"), "--mount", "1.73", "--strict"])
    assert capsys.readouterr().err == ""
    filled = read(tmp_path / "b.ply")
    old = filled.extra["new"] == 0
    order = np.argsort(filled.extra["ambient"][old])
    np.testing.assert_array_equal(filled.xyz[old][order], raised.xyz)
    assert (~old).sum() > 500 and np.all(filled.extra["ambient"][~old] == 0)
    ground = filled.xyz[~old][:, 2]
    assert abs(np.median(ground[ground < 1])) < 0.3, "new points lie on the file's ground, not 1.73 m below it"


@pytest.mark.parametrize("count", [1, 200])
def test_what_fails_is_said_in_the_words_of_the_command_line(
    count: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Not in those of Python, and without what would be said of a completion that there is none of."""
    rng = np.random.default_rng(0)
    write(tmp_path / "a.ply", Scan(rng.uniform(1, 20, (count, 3)).astype(np.float32), rng.random(count, np.float32)))
    with pytest.raises(SystemExit, match="2"):
        main(["complete", str(tmp_path / "a.ply"), "--out", str(tmp_path / "o.ply"), WORDS[0]])
    error = capsys.readouterr().err
    assert error.startswith(f"lidarsynth: {tmp_path / 'a.ply'}: expected ") and error.count("expected") == 1
    assert error.endswith("with --sensor\n")


def test_processes_answer_in_order():
    make = partial(partial, pow, 2)
    assert list(in_window(make, iter(range(20)), 2)) == [2**i for i in range(20)]
    assert list(in_window(make, iter(range(5)), 0)) == [2**i for i in range(5)]


def test_workers_in_the_midst_of_long_items_are_left_at_once():
    begun = time.monotonic()
    made = in_order(time.sleep, [0, 60, 60], 2)
    next(made)
    made.close()
    assert time.monotonic() - begun < 30 and not multiprocessing.active_children()


def test_arrays_are_scans():
    scan = turn(SENSORS["hdl-64e-kitti"])
    model = load("bilinear")
    table = np.column_stack([scan.xyz, np.full(len(scan), 0.5)])
    image = model.complete(table.astype(np.float32))
    expected = model.complete(Scan(scan.xyz, np.full(len(scan), 0.5, np.float32)))
    np.testing.assert_array_equal(image.range, expected.range)
    assert Scan(scan.xyz).reflectance.sum() == 0 and len(scan_of(scan.xyz).reflectance) == len(scan)
    for wrong, words in (
        (table * [1, 1, 1, 300], "0 to 1 in the fourth"),
        (table * 300, "millimetres"),
        (table[0], "(N, 3)"),
        (table * np.nan, "finite"),
    ):
        with pytest.raises(ValueError, match=words.replace("(", r"\(").replace(")", r"\)")):
            model.complete(wrong)


@pytest.mark.parametrize("verb", ["complete", "upsample", "label", "realise"])
def test_what_is_no_scan_is_said_in_a_line(verb: str):
    with pytest.raises(ValueError, match="expected a scan or an array of points, found a list"):
        getattr(load("default"), verb)([[1.0, 2.0, 3.0]])
    with pytest.raises(ValueError, match="kitti-streets: expected a model such as default for 4 times as many beams"):
        load("kitti-streets").upsample(turn(SENSORS["vlp-16"]), times=4)


def test_a_model_says_what_it_is_and_saves_itself(tmp_path: Path):
    model = load("default")
    assert isinstance(model, ScanModel)
    lines = repr(model).splitlines()
    assert len(lines) == 3 and "64 beams x 1024" in lines[1] and "parameters, on cpu" in lines[2]
    again = load(model.save(tmp_path / "m"))
    assert repr(again).splitlines()[1:] == lines[1:]


def test_a_model_that_was_tuned_to_another_sensor_says_so(scans: Path, tmp_path: Path, capsys):
    experiment, network = load_parts("default")
    save(tmp_path / "tuned", replace(experiment, card=replace(experiment.card, sensor="hdl-64e-kitti")), network)
    said = {}
    for model in ("tuned", "default", "kitti"):
        source = str(tmp_path / "tuned") if model == "tuned" else model
        main(["complete", str(scans / "d1" / "000.pcd"), "--model", source, "--out", str(tmp_path / "o.ply"), WORDS[0]])
        said[model] = capsys.readouterr().err
    for model in ("tuned", "kitti"):
        words = f"{model} was tuned to hdl-64e-kitti, and this is a scan of vlp-16; use --model default"
        assert words in said[model]
    assert "this is a scan of" not in said["default"]
    named = ["--sensor", "hdl-64e-kitti", "--out", str(tmp_path / "o.ply"), WORDS[0]]
    main(["complete", str(scans / "d1" / "000.pcd"), "--model", "kitti", *named])
    assert "was tuned to" not in capsys.readouterr().err, "the user says whose scan it is"
    for verb, *more in (["label"], ["upsample", "--times", "2"]):
        out = ["--out", str(tmp_path / "named.ply"), *more]
        main([verb, str(scans / "d1" / "000.pcd"), "--model", "kitti", *out])
        assert "kitti was tuned to hdl-64e-kitti, and this is a scan of vlp-16" in capsys.readouterr().err


@pytest.mark.parametrize("word", ["kitti", "kitti-streets"])
def test_the_library_warns_of_another_sensor_as_the_verbs_do(word: str):
    model, scan = load(word), turn(SENSORS["vlp-16"])
    with pytest.warns(UserWarning, match=r"hdl-64e-kitti.*, and this is a scan of vlp-16; use load\("):
        model.complete(scan, seed=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load("nearest").upsample(scan, "vlp-16")  # made to
        model.complete(street("hdl-64e-kitti"))


SENSOR_FILE = "name = 'mine'\nwidth = 512\nelevations = [{}]\n"


def test_upsample_says_how_many_points_lie_beyond_the_beams_of_the_sensor_it_gives(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    scan, path, out = turn(SENSORS["hdl-32e"]), tmp_path / "s.pcd", tmp_path / "o.pcd"
    write(path, scan)
    words = ["upsample", str(path), "--model", "bilinear", "--no-picture", "--out", str(out), "--to"]
    with pytest.raises(SystemExit, match="2"):
        main([*words, "vlp-16", "--strict"])
    elevation = np.degrees(np.arctan2(scan.xyz[:, 2], np.hypot(*scan.xyz[:, :2].T)))
    said = (
        f"expected points in vlp-16's view of -15.0 to +15.0 degrees, found {(elevation < -16).sum()} of {len(scan)} "
    )
    assert said in capsys.readouterr().err and not out.exists()
    main([*words, "vlp-16"])
    assert f"{path}: {said}" in capsys.readouterr().err
    narrow = np.array(SENSORS["hdl-32e"].elevations).clip(-30, 10) + np.linspace(0.01, 0, 32)
    (tmp_path / "narrow.toml").write_text(SENSOR_FILE.format(", ".join(map(str, narrow))))
    main([*words, str(tmp_path / "narrow.toml"), "--strict"])
    assert capsys.readouterr().err == ""


def test_a_recipe_is_what_its_words_mean(scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A sensor that is learned anew under its name is another, one that is only called otherwise is the same."""
    mine, other = tmp_path / "mine.toml", tmp_path / "other.toml"
    for path in (mine, other):
        path.write_text(SENSOR_FILE.format("2.0, 0.0, -2.0"))
    words = ["project", str(scans / "d2"), "--out", str(tmp_path / "o"), "--no-picture", "--skip-existing", "--sensor"]
    main([*words, str(mine)])
    main([*words, str(other)])
    assert told(tmp_path / "o")["skipped"] == 2
    mine.write_text(SENSOR_FILE.format("2.0, 0.0, -3.0"))
    capsys.readouterr()
    with pytest.raises(SystemExit, match="2"):
        main([*words, str(mine)])
    error = capsys.readouterr().err
    assert "expected scans made as they are asked for now" in error and "sensor_is" in error and error.count("\n") == 1
    report = told(tmp_path / "o")
    report["settings"]["recipe"] = {"verb": "project", "sensor": str(mine), "projection": "auto"}
    (tmp_path / "o" / "report.json").write_text(json.dumps(report))
    main([*words, str(mine)])
    assert told(tmp_path / "o")["skipped"] == 2, "a report of before tells words alone"


def test_a_model_that_was_trained_further_does_not_go_on(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    experiment, network = load_parts("default")
    save(tmp_path / "run", experiment, network)
    words = ["complete", str(scans / "d2"), "--out", str(tmp_path / "o"), *WORDS, "--skip-existing", "--model"]
    with monkeypatch.context() as patch:
        patch.setattr("lidarsynth.cli.many.tell_of_many", killed)
        with pytest.raises(SystemExit, match="130"):
            main([*words, str(tmp_path / "run")])
    report = told(tmp_path / "o")
    weights = report["settings"]["recipe"]["weights"]
    monkeypatch.chdir(tmp_path)
    main([*words, "run/"])
    assert told(tmp_path / "o")["skipped"] == 1 and told(tmp_path / "o")["settings"]["recipe"]["weights"] == weights
    with torch.no_grad():
        next(network.parameters()).mul_(1.5)
    save(tmp_path / "run", experiment, network)
    capsys.readouterr()
    with pytest.raises(SystemExit, match="2"):
        main([*words, "run"])
    assert f" for {weights}; another --out" in capsys.readouterr().err
    del report["settings"]["recipe"]["weights"], report["settings"]["recipe"]["sensor_is"], report["unfinished"]
    report["settings"]["recipe"]["model"] = "run"
    (tmp_path / "o" / "report.json").write_text(json.dumps(report))
    (tmp_path / "o" / "000.ply").unlink()
    with monkeypatch.context() as patch:
        patch.setattr("lidarsynth.cli.many.tell_of_many", killed)
        with pytest.raises(SystemExit, match="130"):
            main([*words, "run"])
    assert "mixed" not in told(tmp_path / "o"), "one of before goes on, and tells from now on"
    assert told(tmp_path / "o")["settings"]["recipe"]["weights"] != weights


def test_shards_of_several_recipes_are_told(scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    words = ["project", str(scans), "--out", str(tmp_path / "o"), *WORDS]
    main([*words, "--shard", "1/2", "--width", "256"])
    main([*words, "--shard", "2/2", "--width", "512"])
    said = capsys.readouterr().err
    assert "report.json: expected shards of one recipe, found several" in said and told(tmp_path / "o")["mixed"] is True
    with pytest.raises(SystemExit, match="2"):
        main([*words, "--width", "256", "--skip-existing"])
    assert "other settings" in capsys.readouterr().err
    main(["info", str(tmp_path / "o" / "report.json")])
    assert "made with several settings" in capsys.readouterr().out
    main([*words, "--shard", "1/2", "--width", "512"])
    assert "mixed" not in told(tmp_path / "o") and "several" not in capsys.readouterr().err


def test_a_second_run_into_a_folder_is_refused_and_touches_nothing(
    scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    words, place = ["project", str(scans / "d2"), "--out", str(tmp_path / "o"), *WORDS], tmp_path / "o"
    place.mkdir()
    at_work = ".000.0123456789abcdef.part"
    (place / at_work).write_bytes(b"what the first is at")
    with only_writer(place, "run"), pytest.raises(SystemExit, match="2"):
        main(words)
    assert "expected a folder that nobody else writes to, found another run at work" in capsys.readouterr().err
    assert names(place) == [at_work]
    with only_writer(place, "run", shared=True):  # by a shard that is at work beside others
        main([*words, "--shard", "1/2"])
        assert at_work in names(place)
        with pytest.raises(SystemExit, match="2"):
            main(words)
    with only_writer(place, "run"), pytest.raises(SystemExit, match="2"):
        main([*words, "--shard", "1/2"])
    assert capsys.readouterr().err.count("found another run at work") == 2 and at_work in names(place)
    main(words)
    assert at_work not in names(place)


def test_a_whole_run_takes_over_from_shards_and_says_so(
    scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    place = tmp_path / "o"
    words = ["project", str(scans / "d2"), "--out", str(place), *WORDS]
    main([*words, "--shard", "1/2", "--width", "256"])
    rows = told(place, "report-1-of-2.json")["scans"]
    with pytest.raises(SystemExit, match="2"):
        main([*words, "--width", "512", "--skip-existing"])
    assert "report-1-of-2.json: expected scans made as they are asked for now" in capsys.readouterr().err
    main([*words, "--width", "256", "--skip-existing"])
    assert "report.json: of this run's scans now, in place of report-1-of-2.json, of shards" in capsys.readouterr().err
    assert names(place) == ["000.npz", "001.npz", "report.json"] and rows[0] in told(place)["scans"]
    assert len(told(place)["scans"]) == 2
    main([*words, "--width", "256", "--shard", "2/2"])  # as they are asked for: they may come from either
    with pytest.raises(SystemExit, match="2"):
        main([*words, "--width", "512", "--shard", "1/2"])
    assert "found those of a whole run of other settings: width 512 for 256; name an" in capsys.readouterr().err
    main([*words, "--width", "512"])
    assert names(place) == ["000.npz", "001.npz", "report.json"] and "mixed" not in told(place)


def test_a_whole_run_that_is_killed_among_shards_of_another_recipe_is_mixed(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    words = ["project", str(scans / "d2"), "--out", str(tmp_path / "o"), *WORDS]
    for part in ("1/2", "2/2"):
        main([*words, "--shard", part, "--width", "256"])
    (tmp_path / "o" / "report.json").unlink()
    with monkeypatch.context() as patch:
        patch.setattr("lidarsynth.cli.many.tell_of_many", killed)
        with pytest.raises(SystemExit, match="130"):
            main([*words, "--width", "512"])
    assert told(tmp_path / "o")["unfinished"] and told(tmp_path / "o")["mixed"]


def test_where_nobody_knows_of_locks_a_whole_run_waits_for_shards(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    fcntl = pytest.importorskip("fcntl")
    words, report = ["project", str(scans / "d2"), "--out", str(tmp_path / "o"), *WORDS], "report-1-of-2.json"
    main([*words, "--shard", "1/2"])
    shard = told(tmp_path / "o", report)
    (tmp_path / "o" / report).write_text(json.dumps({"unfinished": True} | shard))

    def refuse(file: object, kind: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(SystemExit, match="2"):
        main(words)
    assert f"{report}: expected shards that are done, found one at work, or killed" in capsys.readouterr().err
    (tmp_path / "o" / report).write_text(json.dumps(shard))
    main(words)
