"""Examples and benchmarks as programs: a scan is of the sensor that took it, and what cannot be done is one line."""

import json
import runpy
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
