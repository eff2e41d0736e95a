"""The verbs as a user meets them: what they write, that they go on where they were stopped, and how they refuse."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import pytest
import tyro
from broken import BROKEN
from forked import Forked
from networks import trained
from PIL import Image

from lidarsynth.cli import parsing
from lidarsynth.cli.main import VERBS, main
from lidarsynth.experiment.folder import save
from lidarsynth.experiment.presets import preset
from lidarsynth.files.formats import read, read_image, write
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.systems.cascade.layout import block, sampling
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.diffusion.model import LidarModel
from lidarsynth.systems.notes import elsewhere
from lidarsynth.verbs.generation import cut, processes, steps_of
from lidarsynth.weights.load import load


class Answer(NamedTuple):
    code: int
    out: str
    err: str


Run = Callable[..., Answer]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs the command line in this process."""

    def run(*words: object) -> Answer:
        code = 0
        try:
            main([str(word) for word in words])
        except SystemExit as end:
            code = int(end.code or 0)
        return Answer(code, *capsys.readouterr())

    return run


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model folder of the preset `tiny`, 16 x 64 pixels."""
    experiment = preset("tiny")
    return save(tmp_path_factory.mktemp("model"), experiment, trained(experiment))


def street(name: str = "hdl-64e-kitti") -> Scan:
    """A road between walls with ray-drop, as a sensor sees it."""
    sensor = SENSORS[name].resized(width=256)
    rays = sensor.directions()
    with np.errstate(divide="ignore"):
        distance = np.minimum(np.where(rays[..., 2] < 0, -1.7 / rays[..., 2], np.inf), 8 / np.abs(rays[..., 1]))
    rng = np.random.default_rng(0)
    mask = (distance < 60) & (distance > 2) & (rng.random(distance.shape) < 0.9)
    reflectance = rng.random(distance.shape).astype(np.float32) * mask
    return RangeImage(np.where(mask, distance, 0).astype(np.float32), reflectance, mask, sensor).to_scan()


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scans") / "street.pcd"
    write(path, street())
    return path


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def refused(answer: Answer, *words: str) -> None:
    """Exit code 2, nothing on stdout, one line on stderr that holds the words."""
    assert answer.code == 2, answer
    assert answer.out == ""
    line = answer.err.split("\r")[-1]  # after a progress bar, where the machine was slow
    assert line.startswith("lidarsynth: ") and line.count("\n") == 1 and line.endswith("\n")
    for word in words:
        assert word in answer.err


# generate


def test_generate_writes_scans_and_pictures(run: Run, tiny: Path, tmp_path: Path):
    answer = run("generate", "-n", 2, "--out", tmp_path / "g", "--model", tiny, "--steps", 2)
    assert answer.code == 0, answer.err
    names = ["000000.ply", "000000.png", "000001.ply", "000001.png", "generate.json"]
    assert list(files(tmp_path / "g")) == names
    assert "2 scans, 2 of them new" in answer.out
    assert 0 < len(read(tmp_path / "g" / "000001.ply")) <= 16 * 64


def test_the_command_line_takes_as_many_steps_as_the_library(run: Run, tmp_path: Path):
    """The steps of a cascade's progress are one more than its coarse stage takes."""
    words = ("--model", "default", "--sensor", "vlp-16", "--steps", 1, "--format", "npz", "--no-picture")
    assert run("generate", "-n", 1, "--out", tmp_path / "g", *words).code == 0
    (image,) = load("default").into("vlp-16").generate(1, steps=1, seed=0)
    with np.load(tmp_path / "g" / "000000.npz") as file:
        np.testing.assert_array_equal(file["range"], image.range)


def test_scans_are_the_same_bytes_whatever_the_batch_and_the_count(run: Run, tiny: Path, tmp_path: Path):
    for name, count, batch in (("a", 5, 1), ("b", 5, 4), ("c", 3, 2)):
        words = ("--no-picture", "--model", tiny, "--steps", 2, "--seed", 7, "--batch-size", batch, "--format", "bin")
        assert run("generate", "-n", count, "--out", tmp_path / name, *words).code == 0
    a, b, c = (files(tmp_path / name) for name in "abc")
    assert a == b
    assert {name: a[name] for name in c} == c
    assert len(set(a.values())) == 5 + 1


def test_generate_replaces_no_picture_of_the_users(run: Run, tiny: Path, tmp_path: Path):
    words = ("generate", "--out", tmp_path, "--model", tiny, "--steps", 2, "-n")
    run(*words, 1)
    (tmp_path / "000000.ply").unlink()
    Image.new("RGB", (8, 8)).save(tmp_path / "000001.png")
    before = (tmp_path / "000001.png").read_bytes()
    refused(run(*words, 2), "000001.png: expected a picture of lidarsynth to replace, found another; use another --out")
    assert (tmp_path / "000001.png").read_bytes() == before and run(*words, 1).code == 0  # whose picture was ours
    assert run(*words, 2, "--no-picture").code == 0 and (tmp_path / "000001.png").read_bytes() == before


def test_processes_generate_what_one_does(run: Run, tiny: Path, tmp_path: Path):
    words = ("generate", "-n", 3, "--model", tiny, "--steps", 2, "--format", "npz", "--no-picture", "--seed", 5)
    for workers in (1, 2):
        assert run(*words, "--workers", workers, "--out", tmp_path / str(workers)).code == 0
    for name in ("000000.npz", "000001.npz", "000002.npz"):
        one, two = (np.load(tmp_path / workers / name) for workers in ("1", "2"))
        np.testing.assert_allclose(one["range"], two["range"], rtol=1e-4)


def test_runs_are_cut_where_blocks_end_and_each_process_has_one():
    assert cut([range(3, 20), range(40, 41)], 16) == [range(3, 16), range(16, 20), range(40, 41)]
    for model, size in ((load("default"), 8), (load("default").choosing(1), 16)):
        blocks = [range(4 * size)]
        assert isinstance(model, CascadeModel)
        assert model.together == size == block(sampling(model.network, None, None), model.layouts)
        for runs, asked, found in ((blocks, 3, 3), (blocks, 9, 4), ([range(size)], None, 1), ([], 2, 1)):
            assert processes(model, runs, asked) == found
        assert processes(model, blocks) == min(4, os.cpu_count() or 1)


def test_generate_makes_only_what_lacks(run: Run, tiny: Path, tmp_path: Path):
    words = ("generate", "--out", tmp_path, "--model", tiny, "--steps", 2, "-n")
    assert run(*words, 3).code == 0
    whole = files(tmp_path)
    (tmp_path / "000000.ply").unlink()
    (tmp_path / "000001.png").unlink()
    kept = (tmp_path / "000002.ply").stat().st_mtime_ns
    assert "3 scans, 2 of them new" in run(*words, 3).out
    assert files(tmp_path) == whole
    assert (tmp_path / "000002.ply").stat().st_mtime_ns == kept
    assert "2 scans, 0 of them new" in run(*words, 2).out


def test_killed_in_the_middle_the_same_command_goes_on(run: Run, tiny: Path, tmp_path: Path):
    words = ("generate", "-n", 6, "--model", tiny, "--steps", 3, "--out")
    process = Forked(*words, tmp_path / "killed")
    while process.poll() is None and not (tmp_path / "killed" / "000001.ply").exists():
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    assert process.wait(timeout=60) == -signal.SIGKILL, "it ended before it was killed"
    half = {
        name: data
        for name, data in files(tmp_path / "killed").items()
        if name != ".lock" and not name.endswith(".part")
    }
    assert run(*words, tmp_path / "whole").code == 0
    whole = files(tmp_path / "whole")
    assert 4 < len(half) < len(whole) == 13
    assert half == {name: whole[name] for name in half}, "every file in its place is whole"
    assert run(*words, tmp_path / "killed").code == 0
    assert files(tmp_path / "killed") == whole


def test_ctrl_c_is_one_line(tiny: Path, tmp_path: Path):
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs inherit "ignored"
    process = Forked("generate", "-n", 100000, "--model", tiny, "--steps", 2, "--out", tmp_path, "--no-picture")
    while process.poll() is None and not (tmp_path / "000002.ply").exists():
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert out == ""
    assert err.strip().splitlines()[-1] == "lidarsynth: stopped"
    assert "Traceback" not in err
    assert not list(tmp_path.glob(".*.part"))
    assert all(len(read(path)) > 0 for path in tmp_path.glob("*.ply"))


@pytest.mark.parametrize("other", [("--steps", 3), ("--seed", 1), ("--sampler", "ddim"), ("--format", "bin")])
def test_a_folder_made_with_other_settings_is_refused(run: Run, tiny: Path, tmp_path: Path, other: tuple):
    words = ("generate", "-n", 1, "--out", tmp_path, "--model", tiny, "--no-picture")
    assert run(*words, "--steps", 2).code == 0
    before = files(tmp_path)
    refused(
        run(*words, "--steps", 2, *other), f"{tmp_path}: expected a folder of scans made with", other[0][2:], "found"
    )
    assert files(tmp_path) == before


def test_a_folder_of_other_weights_is_refused_and_one_of_the_same_is_not(run: Run, tiny: Path, tmp_path: Path):
    experiment = preset("tiny")
    same = save(tmp_path / "same", experiment, trained(experiment))
    other = save(tmp_path / "other", experiment, trained(experiment, seed=1))
    words = ("generate", "-n", 1, "--out", tmp_path / "g", "--steps", 2, "--no-picture", "--model")
    assert run(*words, tiny).code == 0
    assert "0 of them new" in run(*words, same).out
    asked, found = (f"{{'model': '{folder}'}}" for folder in (other, tiny))
    refused(run(*words, other), f"expected a folder of scans made with {asked}, found {found}; use another --out")


def test_a_folder_of_another_sensor_is_refused_by_name_and_one_of_before_goes_on(run: Run, tmp_path: Path):
    words = ("generate", "-n", 1, "--out", tmp_path, "--no-picture", "--steps", 1, "--sensor")
    record = tmp_path / "generate.json"
    first = run(*words, "vlp-16")
    assert first.code == 0 and "drawn by dpmpp-2m, not by columns" in first.err
    refused(run(*words, "hdl-32e"), "made with {'sensor': 'hdl-32e'}, found {'sensor': 'vlp-16'}; use")
    before = {key: value for key, value in json.loads(record.read_text()).items() if key not in ("model", "sensor")}
    record.write_text(json.dumps(before))
    assert "0 of them new" in run(*words, "vlp-16").out
    told = "made with {'model': 'default', 'sensor': 'hdl-32e', 'weights': "
    refused(run(*words, "hdl-32e"), told, f"found {{'weights': '{before['weights']}'}}; use")


def test_a_model_that_was_tuned_to_another_sensor_says_so_where_it_generates(run: Run, tmp_path: Path):
    words = ("generate", "-n", 1, "--no-picture", "--steps", 1, "--sensor", "vlp-16", "--out")
    told = "lidarsynth: kitti was tuned to hdl-64e-kitti, and vlp-16 is another; use --model default\n"
    assert told in run(*words, tmp_path / "kitti", "--model", "kitti").err
    assert "was tuned to" not in run(*words, tmp_path / "default").err
    assert [elsewhere(load("kitti").into(own)) for own in ("hdl-64e-kitti", "hdl-64e")] == [None, None]


def test_layouts_that_a_sampler_would_ignore_are_refused(run: Run, tmp_path: Path):
    words = ("generate", "-n", 1, "--no-picture", "--sensor", "vlp-16", "--out", tmp_path / "g", "--layouts")
    for more, sampler in (("--steps 1", "dpmpp-2m"), ("--sampler ddim --steps 1", "ddim")):
        told = f"expected 1 layout of the sampler {sampler}, for only columns chooses among them, found 5; leave"
        refused(run(*words, 5, *more.split()), told)
        assert not (tmp_path / "g").exists()
    assert run(*words, 1, "--steps", 1).code == 0


def test_a_cascades_folder_records_the_samplers_steps_apart_from_the_fills_and_one_of_before_goes_on(
    run: Run, tmp_path: Path
):
    words = ("generate", "-n", 1, "--out", tmp_path, "--no-picture", "--sensor", "vlp-16", "--steps")
    record = tmp_path / "generate.json"
    assert run(*words, 2).code == 0
    found = json.loads(record.read_text())
    assert (found["steps"], found["fill_steps"]) == (2, 1)
    refused(run(*words, 3), "made with {'steps': 3}, found {'steps': 2}; use")
    record.write_text(json.dumps({key: value for key, value in found.items() if key != "fill_steps"} | {"steps": 3}))
    assert "0 of them new" in run(*words, 2).out  # 3 were those of both
    refused(run(*words, 3), "made with {'steps': 3}, found {'steps': 2}; use")


def test_columns_are_recorded_as_they_are_drawn():
    model = load("default")
    assert steps_of(model) == {"steps": 128, "fill_steps": 1}
    assert steps_of(model, 4) == {"steps": 4, "fill_steps": 1}


def test_scans_of_others_are_not_taken_for_generated_ones(run: Run, tiny: Path, tmp_path: Path):
    write(tmp_path / "000000.ply", street())
    before = files(tmp_path)
    words = ("generate", "-n", 2, "--out", tmp_path, "--model", tiny, "--steps", 2)
    refused(run(*words), "found 000000.ply")
    assert files(tmp_path) == before
    (tmp_path / "generate.json").write_text("[]")
    refused(run(*words), "generate.json", "found []")
    (tmp_path / "generate.json").write_text("{")
    refused(run(*words), "generate.json", "JSON")


# complete and upsample


def measured_in(points: Scan, scan: Scan) -> bool:
    """Whether every point of `scan` is in `points`, bit by bit, reflectance too."""
    have, want = (
        np.column_stack([s.xyz, s.reflectance]).astype(np.float32).view(np.void(16).dtype).ravel()
        for s in (points, scan)
    )
    return bool(np.isin(want, have).all())


@pytest.mark.parametrize("suffix", ["ply", "pcd", "bin", "npy"])
def test_complete_keeps_every_measured_point(run: Run, tiny: Path, scan: Path, tmp_path: Path, suffix: str):
    picture = "--picture" if suffix == "ply" else "--no-picture"
    answer = run("complete", scan, "--out", tmp_path / f"new/dense.{suffix}", "--model", tiny, picture)
    assert answer.code == 0, answer.err
    beside = ["new/dense.new"] if suffix in ("bin", "npy") else []  # has no place for which points are new
    beside += ["new/dense.png"] if suffix == "ply" else []
    assert sorted(files(tmp_path)) == sorted([f"new/dense.{suffix}", *beside])
    assert measured_in(read(tmp_path / f"new/dense.{suffix}"), read(scan))


@pytest.mark.parametrize("method", ["conditional", "repaint"])
def test_complete_with_a_corruption_prints_errors_and_keeps_known_points(
    run: Run, tiny: Path, scan: Path, tmp_path: Path, method: str
):
    out = tmp_path / "dense.npz"
    words = ("--corrupt", "beams:4", "--steps", 2, "--method", method, "--no-picture")
    words += ("--resamples", 2) if method == "repaint" else ()
    answer = run("complete", scan, "--out", out, "--model", tiny, *words)
    assert answer.code == 0, answer.err
    table = answer.out.splitlines()
    assert "768 hidden pixels" in table[1]
    assert [line.split()[0] for line in table[3:]] == ["lidarsynth", "nearest", "bilinear", "bicubic", "left"]
    image = read_image(out)
    truth = project(read(scan), image.sensor)
    known = truth.mask & (np.arange(16) % 4 == 0)[:, None]
    assert known.any() and image.xyz is not None and truth.xyz is not None
    np.testing.assert_array_equal(image.xyz[known], truth.xyz[known])
    np.testing.assert_array_equal(image.range[known], truth.range[known])
    np.testing.assert_array_equal(image.reflectance[known], truth.reflectance[known])


def test_complete_takes_several_scans_or_a_folder(run: Run, tiny: Path, tmp_path: Path):
    scans = tmp_path / "in"
    scans.mkdir()
    write(scans / "a.b.bin", street())
    write(scans / "c.ply", street())
    words = ("--model", tiny, "--corrupt", "sector:90", "--no-picture", "--steps", 1)
    folder = run("complete", scans, "--out", tmp_path / "x", *words)
    several = run("complete", scans / "a.b.bin", scans / "c.ply", "--out", tmp_path / "y", *words)
    assert folder.code == several.code == 0
    assert list(files(tmp_path / "x")) == list(files(tmp_path / "y")) == ["a.b.ply", "c.ply", "report.json"]
    assert "mean of 2 scans" in folder.out
    refused(run("complete", scans, "--out", tmp_path / "z.ply", *words), "the name of a folder for 2 scans")
    refused(run("complete", tmp_path / "x" / "..", "--out", tmp_path / "c.ply", *words), "the name of a folder")
    write(scans / "c.bin", street())
    refused(run("complete", scans, "--out", tmp_path / "z", *words), "found two named c: ", "c.bin and ", "c.ply\n")
    refused(run("complete", "--out", tmp_path / "z", *words), "found none")
    (scans / "c.bin.gz").touch()
    (scans / "more").mkdir()
    for pattern, found in (("*.gz", "c.bin.gz"), ("m*", "more"), ("*.las", "none")):
        refused(run("complete", scans / pattern, "--out", tmp_path / "z", *words), f"of this pattern, found {found}\n")
    assert not (tmp_path / "z").exists()
    for name in ("one", "two", "empty"):
        (tmp_path / "days" / name).mkdir(parents=True)
    write(tmp_path / "days" / "one" / "a.ply", street())
    write(tmp_path / "days" / "two" / "b.bin", street())
    assert run("complete", tmp_path / "days" / "*", "--out", tmp_path / "z", *words).code == 0  # a folder of none aside
    (tmp_path / "days" / "one" / "one2").mkdir()
    write(tmp_path / "days" / "one" / "one2" / "c.ply", street())
    within = run("complete", tmp_path / "days" / "**" / "one*", "--out", tmp_path / "w", *words)  # one in the other
    assert within.code == 0 and list(files(tmp_path / "w")) == ["a.ply", "c.ply", "report.json"]


def test_nothing_is_put_before_a_point_beyond_the_range_limits(run: Run, tiny: Path, tmp_path: Path):
    far = street()
    lonely = np.array([[0, -300, -60]], np.float32)
    write(tmp_path / "far.ply", Scan(np.vstack([far.xyz, lonely]), np.append(far.reflectance, np.float32(0.5))))
    assert run("complete", tmp_path / "far.ply", "--out", tmp_path / "d.ply", "--model", tiny, "--no-picture").code == 0
    assert measured_in(read(tmp_path / "d.ply"), Scan(lonely, np.float32([0.5])))


@pytest.mark.parametrize("sensor", ["vlp-16", "hdl-32e", "os1-64"])
@pytest.mark.parametrize("named", [True, False])
def test_upsample_keeps_every_measured_point(run: Run, tiny: Path, tmp_path: Path, sensor: str, named: bool):
    write(tmp_path / "s.pcd", street(sensor))
    words = ("--from", sensor) if named else ()
    out = tmp_path / "dense.ply"
    answer = run("upsample", tmp_path / "s.pcd", "--out", out, "--model", tiny, "--no-picture", *words)
    assert answer.code == 0, answer.err
    assert f"points of {sensor} became" in answer.out
    before, after = read(tmp_path / "s.pcd"), read(out)
    assert measured_in(after, before)
    assert len(after) > len(before)


def test_upsample_fills_between_the_rings_of_a_thinned_scan(run: Run, tiny: Path, tmp_path: Path):
    whole = street()
    assert whole.ring is not None
    write(tmp_path / "thin.pcd", whole[whole.ring % 8 == 0])
    answer = run("upsample", tmp_path / "thin.pcd", "--out", tmp_path / "d.npz", "--model", tiny, "--no-picture")
    assert answer.code == 0, answer.err
    image = read_image(tmp_path / "d.npz")
    assert f" became {image.mask.sum()}" in answer.out, "what the file holds is counted"
    assert image.mask[1::2].mean() > 0.3, "the rows between measured ones are filled"


def test_upsample_takes_a_sensor_file_or_asks_for_one(run: Run, tiny: Path, tmp_path: Path):
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-20, 20, (3000, 3)).astype(np.float32) * np.float32([1, 1, 0.1])
    write(tmp_path / "cloud.ply", Scan(cloud, rng.random(3000).astype(np.float32)))
    words = ("upsample", tmp_path / "cloud.ply", "--out", tmp_path / "d.ply", "--model", tiny, "--no-picture")
    refused(run(*words), "name the sensor with --from", "found no rings")
    refused(run(*words, "--from", "vlp-17"), "expected a sensor of hdl-64e", "found 'vlp-17'")
    refused(run(*words, "--from", tmp_path / "none.toml"), "none.toml")
    (tmp_path / "own.toml").write_text("beams = 16\ntop = 10\nbottom = -10\nwidth = 256\n")
    (tmp_path / "own.json").write_text('{"elevations": [5, 0, -5, -10], "width": 256}')
    assert "points of own became" in run(*words, "--from", tmp_path / "own.toml").out
    assert "points of own became" in run(*words, "--from", tmp_path / "own.json").out


@pytest.mark.parametrize(
    ("name", "text"),
    {
        "list.json": "[1, 2]",
        "broken.json": "{",
        "deep.json": "[" * 100000,
        "word.json": '{"elevations": ["up", "down"]}',
        "number.json": '{"elevations": 5}',
        "text.toml": 'beams = 4\ntop = "a"\nbottom = -10\n',
        "width.toml": "beams = 4\ntop = 1\nbottom = -10\nwidth = 'x'\n",
        "unknown.toml": "beams = 4\ntop = 1\nbottom = -10\nspin = 3\n",
        "empty.toml": "",
        "latin.toml": "# \udcff",
        "suffix.yaml": "beams: 4",
    }.items(),
)
def test_broken_sensor_files_are_one_line(run: Run, scan: Path, tmp_path: Path, name: str, text: str):
    (tmp_path / name).write_text(text, errors="surrogateescape")
    refused(run("project", scan, "--sensor", tmp_path / name, "--out", tmp_path / "o.npz"), "expected", "found")
    assert list(files(tmp_path)) == [name]


# project, info, demo


def test_project_writes_the_image_of_the_scan(run: Run, scan: Path, tmp_path: Path):
    answer = run("project", scan, "--out", tmp_path / "image.npz", "--width", 128)
    assert answer.code == 0 and "hdl-64e-kitti" in answer.out
    image = read_image(tmp_path / "image.npz")
    expected = project(read(scan), "hdl-64e-kitti", width=128)
    np.testing.assert_array_equal(image.range, expected.range)
    assert (tmp_path / "image.png").stat().st_size > 1000


def test_info_knows_scans_models_presets_and_sensors(run: Run, tiny: Path, scan: Path):
    answers = [run("info", what) for what in (scan, tiny, "r2dm-h", "vlp-16")]
    assert [a.code for a in answers] == [0] * 4
    for answer, word in zip(answers, ("hdl-64e-kitti (", "42,", "31,099,650", "16 from +15.00"), strict=True):
        assert word in answer.out


@pytest.mark.parametrize(("word", "meant"), [("vlp16", "vlp-16"), ("defaut", "default"), ("zzz", None)])
def test_info_of_an_unknown_word_names_one_that_is_near(run: Run, word: str, meant: str | None):
    answer = run("info", word)
    refused(answer, word, *(["found no file or folder of that name"] if meant is None else [f"was {meant} meant?"]))
    assert ("meant?" in answer.err) == (meant is not None)


@pytest.mark.parametrize("found", [
    {"settings": {}, "done": True, "scans": []}, {"settings": {}, "done": 1, "scans": 3, "skipped": 0, "failed": 0,
    "seconds": 1}, {"protocol": 1, "version": 2, "values": [3]}, {"world": 0, "frame": 0, "boxes": 3, "points": 1},
    {"protocol": 1, "version": 2, "values": {"a": {"value": 1.0, "unit": 3}, "b": {"value": "x"}}, "scans": 0},
])  # fmt: skip
def test_info_of_somebody_elses_json_of_the_same_words_is_a_line(run: Run, tmp_path: Path, found: dict):
    (tmp_path / "a.json").write_text(json.dumps(found))
    answer = run("info", tmp_path / "a.json")
    if answer.code:
        refused(answer, "a.json: expected a sensor, Ouster metadata or a report in JSON, found ", ", ".join(found))


@pytest.mark.parametrize(("sensor", "said"), [
    ('{"name": "mine"}', "mine"), ("[1, 2]", "[1, 2]"), ("HDL", "HDL"), ("{}", "{}"), ("3", "3"),
])  # fmt: skip
def test_info_of_a_network_tells_what_others_call_a_sensor(run: Run, tmp_path: Path, sensor: str, said: str):
    onnx = pytest.importorskip("onnx", reason="the extra onnx is not installed")
    values = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1]) for name in "xy"]
    graph = onnx.helper.make_graph([onnx.helper.make_node("Identity", ["x"], ["y"])], "g", values[:1], values[1:])
    model = onnx.helper.make_model(graph)
    onnx.helper.set_model_props(model, {"sensor": sensor})
    onnx.save(model, str(tmp_path / "a.onnx"))
    answer = run("info", tmp_path / "a.onnx")
    assert answer.code == 0 and re.search(rf"sensor +{re.escape(said)}\n", answer.out), answer


def test_a_recipe_that_stands_twice_is_refused(run: Run, scan: Path, tmp_path: Path):
    recipes = ("--corrupt", "beams:4", "--out", str(tmp_path / "a.ply"), "--corrupt=sector:90")
    refused(run("complete", str(scan), *recipes), "expected --corrupt once", "joined by +", "found it 2 times")
    assert not list(tmp_path.iterdir())


def test_train_takes_every_field_of_an_experiment(run: Run):
    fields = ("--training.steps", "7", "--set", "data.roll=true", "--training.learning-rate=0.5", "--card.licence=x=y")
    answer = run("train", "tiny", "--seed", "3", *fields, "--dry-run")
    found = json.loads(answer.out)
    assert (found["training"]["steps"], found["training"]["learning_rate"], found["training"]["seed"]) == (7, 0.5, 3)
    assert found["data"]["roll"] is True and found["card"]["licence"] == "x=y"
    assert found == json.loads(run("train", "tiny", *fields, "--dry-run", "--seed", "3").out)
    sets = ("--set", "training.steps=7", "--dry-run", "--set=training.learning_rate=0.5", "--seed", "3",
            "--set", "data.roll=true", "card.licence=x=y")  # fmt: skip
    assert found == json.loads(run("train", "tiny", *sets).out)  # a later one adds to what stands before it
    refused(run("train", "tiny", "--dry-run", "--training.stepps", "7"), "'training.stepps'")
    refused(run("train", "tiny", "--dry-run", "--training.steps", "x"), "training.steps")
    refused(run("train", "tiny", "--dry-run", "--training.steps"), "--training.steps")
    refused(run("train", "tiny", "--dry-run", "--set", "training.steps=7", "--set", "training.stepps=7"), "stepps")


def test_demo_runs_and_lists_what_it_made(run: Run, tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(LidarModel, "generation_steps", lambda *_: 2)  # of 32
    out = tmp_path / "demo"
    answer = run("demo", "--out", out, "--model", tiny)
    assert answer.code == 0, answer.err
    listed = {line.strip() for line in answer.out.splitlines() if line.startswith("  ") and str(out) in line}
    assert listed == {str(out / name) for name in files(out)}
    assert len(listed) >= 14


# refusals


KINDS = ("missing", "named pipe", "bin truncated", "pcd endless header")  # `read` has tests of all
UNLIT = [name for name in BROKEN if name.endswith("without intensity")]


@pytest.mark.parametrize("name", UNLIT)
def test_info_of_a_scan_without_intensity_says_so_and_what_it_is(run: Run, tmp_path: Path, name: str):
    said = run("info", BROKEN[name](tmp_path)).out
    assert "points       50" in said and "reflectance  none in the file: --intensity none" in said


@pytest.mark.parametrize(
    ("name", "verb"),
    [*((name, "info") for name in BROKEN if name not in UNLIT), *product(KINDS, ("project", "complete", "upsample"))],
)
def test_broken_scans_are_one_line_and_leave_nothing(run: Run, tiny: Path, tmp_path: Path, name: str, verb: str):
    (tmp_path / "in").mkdir()
    path = BROKEN[name](tmp_path / "in")
    words = () if verb == "info" else ("--out", tmp_path / "made" / "dense.npz")
    words += ("--model", tiny) if verb in ("complete", "upsample") else ()
    refused(run(verb, path, *words), "expected", "found")
    assert [p.name for p in tmp_path.iterdir()] == ["in"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("gnerate", "gnerate"),
        ("compete SCAN", "found 'compete'; was complete meant?"),
        ("generate -n x", "'x'"),
        ("generate -n 0", "--count of at least 1, found 0"),
        ("generate -n -3", "-3"),
        ("generate --steps 0", "--steps of at least 1, found 0"),
        ("generate --seed -1", "--seed of at least 0, found -1"),
        ("generate --seed 99999999999999999999999", "--seed"),
        ("generate --batch-size 0", "--batch-size"),
        ("generate --workers 0", "--workers of at least 1, found 0"),
        ("generate --sampler euler", "'euler'"),
        ("generate --format docx", "'docx'"),
        ("generate --model nothing", "nothing: expected"),
        ("generate --nope 3", "--nope"),
        ("generate --sead 3", "found --sead 3; was --seed meant?"),
        ("data kitti ROOT --out c", "data: expected SOURCE ROOT CACHE and its options, found --out c\n"),
        ("upsample SCAN --out d.ply --sensor-in vlp-16", "found --sensor-in vlp-16; was --from meant?"),
        ("complete SCAN --out d.ply --ring 0-9", "found --ring 0-9; was --rings meant?"),
        ("complete SCAN --out d.ply --model TINY --rings 9", "expected --rings FIRST-LAST, such as 32-63, found '9'"),
        ("complete SCAN --out d.ply --model TINY --rings 9-3", "found '9-3'"),
        ("complete SCAN --out d.ply --model TINY --rings 900-901", "expected rings 900-901, found"),
        ("generate --model TINY --device quantum", "'quantum'"),
        ("generate --model TINY --out SCAN", "expected a folder to write to, found a file"),
        ("complete", "--out"),
        ("complete SCAN", "--out"),
        ("complete SCAN --out d.docx", "expected a name that ends in .bin"),
        ("complete SCAN --out SCAN", "found the same"),
        ("complete SCAN --out SCAN/d.ply", "a file at"),
        ("complete SCAN --out d.ply --model TINY --corrupt beams:0", "EVERY"),
        ("complete SCAN --out d.ply --model TINY --corrupt rain", "'rain'"),
        ("complete SCAN --out d.ply --model TINY --corrupt points:1", "hides some of the measured pixels"),
        ("complete SCAN --out d.ply --model TINY --corrupt region:5:x", "numbers"),
        ("complete SCAN --out d.ply --model TINY --steps 0", "--steps"),
        ("complete SCAN --out d.ply --model TINY --resamples 0", "--resamples"),
        ("complete SCAN --out d.ply --intensity percent", "'percent'"),
        ("complete SCAN --out d.ply --format xyz", "expected a folder with --format xyz, found the name of a file"),
        ("complete SCAN --out d.ply --topic /a", "expected a bag or a capture for --topic /a, found none"),
        ("complete SCAN --out d.ply --mount nan", "expected --mount of finite metres"),
        ("project SCAN --out d --transform=nan:0:0:0:0:0", "of finite numbers, found 'nan:0:0:0:0:0'"),
        ("view SCAN --out d.html --mount inf", "expected --mount of finite metres"),
        ("complete none.bin --out d.ply --model TINY", "No such file"),
        ("complete none --out d --model TINY", "none"),
        ("upsample SCAN --out d.docx", "expected a name"),
        ("upsample SCAN --out d.ply --from nothing", "'nothing'"),
        ("upsample SCAN", "--out"),
        ("project SCAN --out i.docx", "expected a name"),
        ("project SCAN --out i.npz --sensor nothing", "'nothing'"),
        ("project SCAN --out i.npz --sensor vlp-16 --method unfolding", "16 rings"),
        ("project SCAN --out i.npz --width 0", "--width of at least 4"),
        ("info nothing", "nothing: expected"),
        ("info .", "a model in the folder, found nothing"),
        ("info none.bin", "no file or folder of that name"),
        ("info none.toml", "none.toml"),
        ("data files . ", "CACHE"),
        ("data files nowhere cache", "nowhere"),
        ("train nothing --data nowhere --out o", "nothing"),
    ],
)
def test_bad_words_are_one_line_and_leave_nothing(
    run: Run, tiny: Path, scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, said: str
):
    monkeypatch.chdir(tmp_path)
    given = [word.replace("TINY", str(tiny)).replace("SCAN", str(scan)) for word in words.split()]
    refused(run(*given), said)
    assert list(tmp_path.iterdir()) == []


def test_names_are_told_as_python_310_describes_parameters(monkeypatch: pytest.MonkeyPatch):
    def verb(cache=None, sensor_in=None): ...

    verb.__annotations__ = {
        "cache": tyro.conf.Positional[str | None] | None,
        "sensor_in": Annotated[str | None, tyro.conf.arg(name="from")] | None,
    }
    assert parsing._options(verb) == {"--cache": "--cache", "--sensor-in": "--from", "--from": "--from"}
    assert parsing._plain_words(verb) == ["CACHE"]


def test_a_folder_in_the_way_is_refused_before_the_work(run: Run, scan: Path, tmp_path: Path):
    (tmp_path / "d.npz").mkdir()
    refused(run("project", scan, "--out", tmp_path / "d.npz"), "found a folder")
    refused(run("upsample", scan, "--out", tmp_path / "d.npz"), "found a folder")


@pytest.mark.parametrize("words", [("complete", "a.bin", "--out", ""), ("complete", "", "--out", "x.ply"),
                                   ("view", ""), ("generate", "--out="), ("info", "a.ply", "")])  # fmt: skip
def test_an_empty_word_is_not_the_current_folder(
    run: Run, words: tuple[str, ...], scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "cwd").mkdir()
    (tmp_path / "cwd" / "a.bin").write_bytes(scan.read_bytes())
    monkeypatch.chdir(tmp_path / "cwd")
    refused(run(*words), "found an empty one")
    assert [path.name for path in Path().iterdir()] == ["a.bin"]


def test_a_fault_of_our_own_is_not_hidden(monkeypatch: pytest.MonkeyPatch):
    def fail(what: str) -> None:
        raise RuntimeError("a fault") if what == "fault" else RuntimeError("not enough memory: 8 bytes\nmore")

    monkeypatch.setitem(VERBS, "info", fail)
    with pytest.raises(RuntimeError, match="a fault"):
        main(["info", "--what", "fault"])
    with pytest.raises(SystemExit, match="2"):
        main(["info", "--what", "memory"])


def test_without_its_hooks_tyro_speaks_itself(run: Run, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(parsing, "events", None)
    answer = run("generate", "--nope", 3)
    assert answer.code == 2 and answer.out == "" and "--nope" in answer.err


# the terminal


@pytest.mark.parametrize(
    ("verb", "encoding"),
    [*(((verb,), "ascii") for verb in VERBS), *(((), encoding) for encoding in ("ascii", "latin-1", "utf-8"))],
)
def test_help_reads_on_any_terminal(monkeypatch: pytest.MonkeyPatch, verb: tuple[str, ...], encoding: str):
    screen = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    monkeypatch.setattr(sys, "stdout", screen)
    with pytest.raises(SystemExit) as end:
        main([*verb, "--help"])
    assert not end.value.code
    screen.flush()
    text = screen.buffer.getvalue().decode(encoding)
    assert text.startswith(f"usage: {' '.join(['lidarsynth', *verb])} ")
    assert "\\u" not in text, "boxes are drawn with what the terminal has"


@pytest.mark.parametrize("verb", ["export", "generate", "label", "realise", "demo"])
def test_help_offers_interpolations_and_recognition_where_they_are_taken(run: Run, verb: str):
    assert "bilinear" not in run(verb, "--help").out and "bilinear" in run("complete", "--help").out
    assert "recognised" not in run("export", "--help").out


def test_any_file_name_can_be_said_on_any_terminal(scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "straße.pcd"
    path.write_bytes(scan.read_bytes())
    screen = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", screen)
    main(["info", str(path)])
    screen.flush()
    assert b"stra\\xdfe.pcd" in screen.buffer.getvalue()


def test_a_closed_pipe_ends_quietly():
    read_end, write_end = os.pipe()
    os.close(read_end)
    process = Forked("info", "vlp-16", stdout=write_end)
    os.close(write_end)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (141, "")


def test_refusals_of_a_process():
    """As a shell starts it: what a verb refuses once it has imported torch goes the same way."""
    command = [sys.executable, "-m", "lidarsynth", "gnerate"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    refused(Answer(done.returncode, done.stdout, done.stderr), "gnerate")


def test_every_file_of_the_command_line_is_a_verb_or_serves_them():
    files = {path.stem for path in Path(parsing.__file__).parent.glob("*.py")} - {"__init__"}
    assert files - VERBS.keys() == {"arguments", "main", "many", "outcomes", "parsing", "scan_files", "terminal"}


def test_the_version_and_without_a_verb_the_help(run: Run):
    assert run("--version").out == f"lidarsynth {version('lidarsynth')}\n"
    assert run().code == 0
    assert run().out == run("--help").out
