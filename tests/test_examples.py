"""Examples and benchmarks as programs: a scan is of the sensor that took it, and what cannot be done is one line."""

import json
import os
import runpy
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.streets.reader import SyntheticStreets

ROOT = Path(__file__).resolve().parents[1]
FORTY = ls.Sensor("forty", tuple(np.linspace(11.8, -24.2, 40).tolist()), 512)
Program = Callable[..., tuple[int, str, str]]


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Program:
    """Runs a script below the root with arguments: exit code, stdout, stderr."""

    def run(script: str, *words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", [script, *map(str, words)])
        code = 0
        try:
            runpy.run_path(str(ROOT / script), run_name="__main__")
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 1
        out, error = capsys.readouterr()
        return code, out, error.strip()

    return run


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a street of three sensors: KITTI's, an HDL-32E and one that nobody knows, and its sensor file."""
    folder = tmp_path_factory.mktemp("scans")
    for sensor in (ls.SENSORS["hdl-64e-kitti"], ls.SENSORS["hdl-32e"], FORTY):
        image = SyntheticStreets(4, 1, sensor.resized(width=512)).image(0)
        ls.write(folder / f"{sensor.name}.ply", replace(image.to_scan(), label=None))
    (folder / "forty.json").write_text(json.dumps(FORTY.to_dict()))
    return folder


def test_beams_are_those_of_the_sensor_that_took_the_scan(program: Program, scans: Path, tmp_path: Path):
    for name, given in (("hdl-64e-kitti", ()), ("hdl-32e", ()), ("forty", ("--sensor", scans / "forty.json"))):
        scan = ls.read(scans / f"{name}.ply")
        code, out, _ = program("examples/thin_beams.py", scans / f"{name}.ply", tmp_path / f"{name}.ply", *given)
        assert code == 0 and out.strip().endswith(f" of {len(scan)} points of {name}")
        assert scan.ring is not None
        np.testing.assert_array_equal(ls.read(tmp_path / f"{name}.ply").xyz, scan.xyz[scan.ring % 4 == 0])


@pytest.mark.parametrize("script", ["thin_beams", "front_page", "labelled_scans"])
def test_an_example_without_arguments_says_how_it_is_used(program: Program, script: str):
    code, _, error = program(f"examples/{script}.py")
    assert code == 2 and error.startswith(f"usage: {script}.py [-h] [--sensor SENSOR] ")


@pytest.mark.parametrize(("script", "before", "after"), [
    ("benchmarks/any_sensor.py", ("errors",), ()),
    ("benchmarks/confidence.py", (), ("--corrupt", "beams:4")),
    ("examples/thin_beams.py", (), ("out.ply",)),
    ("examples/front_page.py", ("out.png",), ()),
    ("examples/labelled_scans.py", ("out.png",), ("other.ply",)),
])  # fmt: skip
def test_what_a_script_cannot_read_is_one_line(
    program: Program, scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    script: str, before: tuple[str, ...], after: tuple[str, ...],
):  # fmt: skip
    monkeypatch.chdir(tmp_path)
    for path, told in ((scans / "forty.ply", "expected the beams of hdl-64e, "),
                       (tmp_path / "nowhere.bin", "expected a readable file, found: No such file")):  # fmt: skip
        code, out, error = program(script, *before, path, *after)
        assert code == 2 and out == "" and error.startswith(f"lidarsynth: {path}: {told}") and "\n" not in error
        assert "model.into" not in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("report", ["errors", "phantoms", "floating", "shadow"])
def test_a_benchmark_prints_no_head_of_a_table_that_it_cannot_make(program: Program, scans: Path, report: str):
    good = scans / "hdl-32e.ply"
    for words, told in (((), "expected SCAN..., found none"),
                        ((good, scans / "forty.ply"), f"{scans / 'forty.ply'}: expected the beams of"),
                        ((good, "--models", "nonsense"), "nonsense: expected shipped weights"),
                        ((good, "--models", "nearest", "kitti-streets"), "hdl-32e, found kitti-streets")):  # fmt: skip
        code, out, error = program("benchmarks/any_sensor.py", report, *words)
        assert (code, out) == (2, "") and told in error and "\n" not in error


def test_a_sensor_of_one_s_own_is_named_to_a_benchmark(program: Program, scans: Path):
    words = ("errors", scans / "forty.ply", "--sensor", scans / "forty.json", "--models", "nearest")
    code, out, error = program("benchmarks/any_sensor.py", *words)
    assert (code, error) == (0, "") and "| forty.ply 1/4 |" in out


def test_the_recipe_of_default_goes_on_after_each_of_its_chunks(tmp_path: Path):
    """timeout(1) says 124 where it stopped a command, whatever that ended with."""
    real = shutil.which("timeout")
    for name, lines in {
        "lidarsynth": """echo "$@" >> calls
            [ "$1" = train ] && [ $(grep -c ^train calls) = 1 ] || exit 0
            trap 'echo stopped after step 3; exit 0' TERM
            sleep 9 & wait""",
        "timeout": f'exec {real} "${{@/#580/0.2}}"',
        "python": 'echo "python $2 $3" >> calls',
    }.items():
        (tmp_path / name).write_text(f"#!/bin/bash\n{lines}\n")
        (tmp_path / name).chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    script = ["bash", str(ROOT / "examples" / "train_default.sh"), "out", "--cpu"]
    subprocess.run(script, cwd=tmp_path, env=environment, check=True, capture_output=True)
    calls = (tmp_path / "calls").read_text().splitlines()
    assert [call.split()[0] for call in calls] == ["train", "train", "python", "python", "info"]
    assert calls[-1] == "info out-done"
