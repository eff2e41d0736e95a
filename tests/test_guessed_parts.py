"""What is said of a wide part of the turn without points: only where points are put there, whoever asks."""

import warnings
from pathlib import Path

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.cli.main import main
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sector import runs_outside
from lidarsynth.lidar.sensor import Sensor

BEAMS, WIDTH = tuple(np.linspace(10.0, -14.0, 16).tolist()), 360
AROUND = Sensor("own-around", BEAMS, WIDTH, mount=1.8)
AHEAD = Sensor("own-ahead", BEAMS, WIDTH, mount=1.8, blocked=tuple(runs_outside((-60.0, 60.0), 16, WIDTH, "own")))
GUESS = "hardly any in 2.. degrees of the turn: what is put there is a guess"


@pytest.fixture
def ahead() -> Scan:
    """Of a sensor that looks ahead only: a wall 9 m away, and ground."""
    elevation, azimuth = np.meshgrid(np.radians(BEAMS), np.radians(np.arange(-59.5, 60.0)), indexing="ij")
    depth = np.minimum(9.0, 1.8 / np.maximum(-np.sin(elevation), 1e-3))
    flat = depth * np.cos(elevation)
    xyz = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), depth * np.sin(elevation)], -1)
    return Scan(xyz.reshape(-1, 3).astype(np.float32), np.full(depth.size, 0.4, np.float32))


def said(asked) -> str:
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        asked()
    return " ".join(str(each.message) for each in heard)


def test_nothing_is_guessed_behind_a_sensor_that_is_bound_and_looks_ahead(ahead: Scan):
    model = ls.load("default")
    assert "is a guess" not in said(lambda: model.into(AHEAD).complete(ahead))
    with pytest.warns(UserWarning, match=GUESS):
        model.into(AROUND).complete(ahead)


def test_beams_between_beams_guess_nothing_where_there_are_none(ahead: Scan):
    model = ls.load("default")
    assert "is a guess" not in said(lambda: model.upsample(ahead, AROUND, times=2))
    with pytest.warns(UserWarning, match=GUESS):
        model.into("vlp-16").upsample(ahead, AHEAD)


def test_the_command_line_says_the_same(ahead: Scan, tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    ls.write(tmp_path / "ahead.pcd", ahead)
    lines = [f'name = "around"\nelevations = {list(BEAMS)}\nwidth = {WIDTH}\nmount = 1.8\n']
    lines += ["view = [-60, 60]\n"]
    (tmp_path / "around.toml").write_text(lines[0])
    (tmp_path / "ahead.toml").write_text("".join(lines))
    source, out = str(tmp_path / "ahead.pcd"), str(tmp_path / "out.ply")

    def heard(*words: str) -> str:
        main([*words, "--out", out, "--no-picture"])
        return capfd.readouterr().err

    between = ["upsample", source, "--from", str(tmp_path / "around.toml")]
    assert "is a guess" not in heard(*between, "--times", "2")
    assert "is a guess" in heard("upsample", source, "--from", str(tmp_path / "ahead.toml"), "--to", "vlp-16")
    assert "is a guess" not in heard(*between, "--to", str(tmp_path / "ahead.toml"))
