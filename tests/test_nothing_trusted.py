"""Files of settings, weights and caches that are pipes, devices, huge, crafted or cut short; and odd surroundings."""

import errno
import json
import os
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch

from lidarsynth.benchmark.config import read_config
from lidarsynth.cli.main import main
from lidarsynth.cli.terminal import check_device
from lidarsynth.data.index import read_index
from lidarsynth.evaluation import accumulation, evaluate
from lidarsynth.evaluation.image_sets import as_image, image_set
from lidarsynth.evaluation.statistics import load_statistics
from lidarsynth.experiment.folder import read_experiment, save
from lidarsynth.experiment.record import Experiment
from lidarsynth.files.formats import write
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import SENSORS, read_sensor
from lidarsynth.lidar.small_file import LARGEST_INDEX, PIECE, read_json, read_text, read_toml
from lidarsynth.lidar.whole_file import sweep, whole_file, write_whole
from lidarsynth.networks.tensors import read_state
from lidarsynth.pictures.render import save_png
from lidarsynth.systems.table import load_folder
from lidarsynth.verbs.description import describe
from lidarsynth.verbs.output_files import check_place
from lidarsynth.weights import download
from lidarsynth.weights.official import read_official

SENSOR = SENSORS["hdl-64e"].resized(8, 64)
READERS = {
    "a.toml": read_sensor,
    "a.json": read_sensor,
    "b.toml": lambda path: read_config("upsampling", path),
    "experiment.json": lambda path: read_experiment(path.parent),
    "index.json": lambda path: read_index(path.parent),
    "model.safetensors": lambda path: load_folder(_with_record(path.parent)),
    "a.safetensors": load_statistics,
    "a.pth": read_official,
    "sample.pth": lambda path: image_set(path).item(0),
}


def _with_record(folder: Path) -> Path:
    from lidarsynth.experiment.presets import preset

    (folder / "experiment.json").write_text(json.dumps(preset("tiny").to_dict()))
    return folder


@pytest.mark.timeout(60)
@pytest.mark.parametrize("kind", ["pipe", "device", "sparse", "folder"])
@pytest.mark.parametrize("name", READERS)
def test_pipes_devices_and_sparse_files_are_refused_at_once(name: str, kind: str, tmp_path: Path):
    path = tmp_path / name
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    else:
        with path.open("wb") as file:
            file.truncate(1 << 37)
    with pytest.raises((ValueError, OSError)) as error:
        READERS[name](path)
    assert "\n" not in str(error.value)


@pytest.mark.timeout(20)
def test_toml_of_a_thousand_dots_and_json_of_a_thousand_brackets_are_refused_at_once(tmp_path: Path):
    (tmp_path / "a.toml").write_text("a." * 30_000 + "a = 1\n")
    with pytest.raises(ValueError, match="expected keys of a few words"):
        read_toml(tmp_path / "a.toml")
    (tmp_path / "a.json").write_text("[" * 200_000)
    with pytest.raises(ValueError, match="expected JSON"):
        read_json(tmp_path / "a.json")
    (tmp_path / "b.toml").write_text('a.b.c = "x.y.z"\n')
    assert read_toml(tmp_path / "b.toml") == {"a": {"b": {"c": "x.y.z"}}}


CRAFTED = {
    "sparse": lambda: torch.eye(8).to_sparse(),
    "meta": lambda: torch.empty(5, 8, 64, device="meta"),
    "complex": lambda: torch.zeros(5, 8, 64, dtype=torch.complex64),
    "repeated": lambda: torch.zeros(1, 1, 1).expand(5, 8, 1 << 25),
}


@pytest.mark.parametrize("name", CRAFTED)
def test_tensors_without_plain_numbers_are_refused_in_one_line(name: str, tmp_path: Path, recwarn):
    path = tmp_path / "a.pth"
    torch.save({"w": CRAFTED[name]()}, path)
    with pytest.raises(ValueError, match="expected tensors of plain numbers, found one of"):
        read_state(path, "here")
    with pytest.raises(ValueError, match="plain numbers"):
        read_official(path)
    torch.save(CRAFTED[name](), path)
    with pytest.raises(ValueError, match="plain numbers"):
        image_set(path).item(0)
    assert not recwarn.list


def test_parameters_and_gradients_are_plain_numbers(tmp_path: Path):
    for tensor in (torch.nn.Parameter(torch.ones(5, 8, 64)), torch.ones(5, 8, 64, requires_grad=True)):
        torch.save(tensor, tmp_path / "a.pth")
        assert as_image(image_set(tmp_path / "a.pth").item(0), SENSOR, "auto").range.sum() == 8 * 64
        torch.save({"w": tensor}, tmp_path / "a.pth")
        assert not read_state(tmp_path / "a.pth", "here")["w"].requires_grad


@pytest.mark.parametrize(
    "change",
    [
        {"shards": []},
        {"shards": {"0000000.npy": 3}},
        {"shards": {"0000000.npy": {"count": "3"}}},
        {"shards": {"0000000.npy": {"count": 3, "frames": [1, 2, 3]}}},
        {"shards": {"0000000.npy": {"count": 1, "frames": [["a", "b"], ["c", "d"]]}}},
        {"source": "words"},
        {"source": {"name": 7}},
        {"sensor": [1]},
        {"count": True},
    ],
)
def test_indexes_with_other_types_are_refused_by_the_field(change: dict, tmp_path: Path):
    index = {"source": {"name": "x"}, "sensor": SENSOR.to_dict(), "count": 3, "shards": {}}
    (tmp_path / "index.json").write_text(json.dumps(index))
    assert read_index(tmp_path)
    (tmp_path / "index.json").write_text(json.dumps({**index, **change}))
    with pytest.raises(ValueError, match=r"index.json: expected .*, found"):
        read_index(tmp_path)


def noise(i: int) -> RangeImage:
    rng = np.random.default_rng(i)
    distance = rng.uniform(5, 60, (8, 64)).astype(np.float32)
    return RangeImage(distance, rng.random((8, 64)).astype(np.float32), distance > 0, SENSOR)


def saved(folder: Path, first: int) -> Path:
    from lidarsynth.files.formats import write

    folder.mkdir()
    for i in range(first, first + 3):
        write(folder / f"{i}.npz", noise(i))
    return folder


def test_damaged_statistics_of_the_cache_are_made_anew(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("LIDARSYNTH_CACHE", str(tmp_path / "cache"))
    samples, real = saved(tmp_path / "samples", 0), saved(tmp_path / "real", 10)
    expected = evaluate.evaluate(samples, real).values
    (kept,) = (tmp_path / "cache/statistics").glob("bev-1-*")
    whole = kept.read_bytes()
    for content in (whole[:-100], b"", whole[:8] + b"x" * 50):
        kept.write_bytes(content)
        assert evaluate.evaluate(samples, real).values == expected
        assert load_statistics(kept)[0].count == 3, "whole again"


def test_a_cache_that_cannot_be_written_to_costs_time_only(tmp_path: Path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("LIDARSYNTH_CACHE", str(tmp_path / "file/cache"))  # also root cannot make a folder in a file
    monkeypatch.setattr(accumulation, "SAVE_EVERY", 0.0)
    samples, real = saved(tmp_path / "samples", 0), saved(tmp_path / "real", 10)
    assert evaluate.evaluate(samples, real).values["JSD x1e2"] is not None
    assert evaluate.evaluate(samples, samples, "street-upsampling-1").values["range MAE"] == 0


def test_a_folder_without_rights_is_refused_before_the_work(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(ValueError, match="expected a folder that may be written to"):
        evaluate.check_out(tmp_path / "report.json")


def test_a_cache_folder_is_found_without_a_home(monkeypatch):
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("LIDARSYNTH_CACHE", raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    assert download.cache_folder().name == "lidarsynth-cache"


@pytest.mark.parametrize("word", ["r2dm-h-kitti360", "r2dm-h-kitti360-300k"])
def test_a_release_that_cannot_be_fetched_is_not_taken_for_another_word(word: str, tmp_path: Path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("LIDARSYNTH_CACHE", str(tmp_path / "file/cache"))
    with pytest.raises(ValueError, match=r"kitti360-300k\.pth; LIDARSYNTH_CACHE may name another folder for it$"):
        describe(word)
    with pytest.raises(ValueError, match=r"was r2dm-h-kitti360 meant\?$"):
        describe("r2dm-h-kiti360")


def test_a_short_file_costs_little_memory_whatever_its_bound(tmp_path: Path):
    (tmp_path / "report.json").write_text('{"done": 2}')
    tracemalloc.start()
    try:
        assert read_json(tmp_path / "report.json", LARGEST_INDEX) == {"done": 2}
        assert tracemalloc.get_traced_memory()[1] < LARGEST_INDEX / 64
    finally:
        tracemalloc.stop()


def test_text_is_read_whole_and_to_its_bound(tmp_path: Path):
    text = "0123456789" * (PIECE // 4)
    (tmp_path / "long.txt").write_text(text)
    assert read_text(tmp_path / "long.txt", len(text)) == text
    with pytest.raises(ValueError, match=f"expected at most {len(text) - 1} bytes"):
        read_text(tmp_path / "long.txt", len(text) - 1)


@pytest.mark.parametrize("verb", ["sensor lost.bin --out out.toml", "view lost.bin --out out.html"])
def test_what_cannot_be_written_is_refused_before_scans_are_read(verb: str, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(SystemExit, match="2"):
        main(verb.split())
    name = verb.rpartition(" ")[2]
    assert capsys.readouterr().err == f"lidarsynth: {name}: expected a writable folder, found no right at {tmp_path}\n"


def test_a_pipe_is_no_file_to_write(tmp_path: Path):
    os.mkfifo(tmp_path / "out.ply")
    with pytest.raises(ValueError, match=r"out\.ply: expected the name of a file to write, found a device or pipe"):
        check_place(tmp_path / "out.ply")


def test_a_report_takes_the_place_of_its_own_kind_alone(tmp_path: Path, capsys):
    judged = json.dumps({"protocol": "bev-1", "version": 1, "values": {}})
    out, report = tmp_path / "out", tmp_path / "out/report.json"
    xyz = np.random.default_rng(0).uniform(-20, 20, (500, 3)).astype(np.float32)
    write(tmp_path / "scan.ply", Scan(xyz, np.full(500, 0.5, np.float32)))
    words = ["complete", str(tmp_path / "scan.ply"), "--model", "bilinear", "--sensor", "vlp-16", "--no-picture"]
    out.mkdir()
    for theirs in ('{"thesis": 1}', "[]", "no JSON", judged):
        report.write_text(theirs)
        with pytest.raises(SystemExit, match="2"):
            main([*words, "--out", str(out)])
        assert "expected a place for the report of this run" in capsys.readouterr().err
        assert report.read_text() == theirs and list(out.iterdir()) == [report]
        if theirs != judged:
            with pytest.raises(ValueError, match="found a file that is no report of evaluate"):
                evaluate.check_out(report)
    evaluate.check_out(report)  # of its own
    report.write_text("")  # as mktemp leaves it
    evaluate.check_out(report)
    for _ in range(2):
        main([*words, "--out", str(out)])
    with pytest.raises(ValueError, match="found a file that is no report of evaluate"):
        evaluate.check_out(report)


def test_the_report_of_all_shards_takes_the_place_of_its_own_kind_alone(tmp_path: Path, capsys):
    out, report = tmp_path / "out", tmp_path / "out/report.json"
    for name in "ab":
        xyz = np.random.default_rng(0).uniform(-20, 20, (500, 3)).astype(np.float32)
        write(tmp_path / f"{name}.ply", Scan(xyz, np.full(500, 0.5, np.float32)))
    words = ["project", f"{tmp_path}/?.ply", "--sensor", "vlp-16", "--no-picture", "--out", str(out), "--shard"]
    out.mkdir()
    report.write_text('{"thesis": 1}')
    for part in ("1/2", "2/2"):
        with pytest.raises(SystemExit, match="2"):
            main([*words, part])
        assert "report.json: expected a place for the report of this run" in capsys.readouterr().err
    assert report.read_text() == '{"thesis": 1}' and list(out.iterdir()) == [report]
    report.unlink()
    for part in ("1/2", "2/2", "2/2"):
        main([*words, part])
    assert json.loads(report.read_text())["done"] == 2


@pytest.mark.parametrize("device", ["meta", "tpu-9", "", "cuda:99", "hpu"])
def test_devices_that_compute_nothing_are_refused(device: str):
    with pytest.raises(ValueError, match="expected a device"):
        check_device(device)


def test_files_have_the_rights_that_the_umask_leaves(tmp_path: Path):
    old = os.umask(0o027)
    try:
        save_png(tmp_path / "a.png", np.zeros((4, 4, 3), np.uint8))
        save(tmp_path, Experiment("linear"), torch.nn.Linear(2, 2))
        write(tmp_path / "scan.bin", Scan(np.zeros((1, 3), np.float32), np.zeros(1, np.float32)))
    finally:
        os.umask(old)
    rights = {path.name: path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
    assert rights == dict.fromkeys(("a.png", "experiment.json", "model.safetensors", "scan.bin"), 0o640)


def test_a_file_appears_whole_or_not_at_all(tmp_path: Path):
    path = tmp_path / "file"
    write_whole(path, "before")

    def fail(error: BaseException) -> None:
        with whole_file(path) as scratch:
            scratch.write_text("half")
            raise error

    for error in (ValueError(), KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left")):
        with pytest.raises(type(error)) as raised:
            fail(error)
        assert path.read_text() == "before" and [p.name for p in tmp_path.iterdir()] == ["file"]
    assert isinstance(raised.value, OSError) and raised.value.filename == str(path)
    with whole_file(path, durable=True) as scratch:
        scratch.write_text("after")
        assert path.read_text() == "before"
    assert path.read_text() == "after"
    (tmp_path / ".file.0.part").touch()
    sweep(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def command(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "lidarsynth", *words],
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ, **environment},
    )


def test_help_in_a_narrow_terminal_and_absurd_counts_answer_at_once(tmp_path: Path):
    assert command("--help", COLUMNS="5").returncode == 0
    done = command("data", "synthetic", str(tmp_path / "cache"), "-n", str(10**23))
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "--count of at most" in done.stderr
    assert not (tmp_path / "cache").exists()


def test_a_part_of_another_origin_is_not_continued(tmp_path: Path):
    first, second = tmp_path / "first", tmp_path / "second"
    first.write_bytes(b"a" * 1000)
    second.write_bytes(b"b" * 1000)
    part = tmp_path / "out.part"
    part.write_bytes(b"a" * 400)
    (tmp_path / "out.part.origin").write_text(f"{first.as_uri()}\n\n")
    list(download.download(second.as_uri(), tmp_path / "out"))
    assert (tmp_path / "out").read_bytes() == b"b" * 1000
    assert not (tmp_path / "out.part.origin").exists()
