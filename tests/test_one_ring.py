"""A laser of one beam is none that is tilted, nor one that does not spin: a line says that no image is made of it."""

from pathlib import Path

import numpy as np
import pytest

from lidarsynth.cli.main import main
from lidarsynth.files.formats import write
from lidarsynth.lidar.frame import check_frame
from lidarsynth.lidar.recognition import on_one_ring
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import SENSORS, get_sensor
from lidarsynth.streets.reader import SyntheticStreets

SAID = "found points of one ring, as of a laser that looks along one plane (2-D)"


def laser(turn: float = 360, elevation: float = 0, pitch: float = 0, count: int = 1081) -> np.ndarray:
    """(count, 3) points of a laser that looks so many degrees around."""
    azimuth, tilt, up = np.radians(np.linspace(-turn / 2, turn / 2, count)), np.radians(pitch), np.radians(elevation)
    depth = 6 + 3 * np.sin(3 * azimuth) + np.random.default_rng(0).normal(0, 0.02, count)
    x, y, z = depth * np.cos(azimuth), depth * np.sin(azimuth), depth * np.tan(up)
    return np.stack([np.cos(tilt) * x - np.sin(tilt) * z, y, np.sin(tilt) * x + np.cos(tilt) * z], 1).astype(np.float32)


@pytest.mark.parametrize("turn", [90, 270, 360])
@pytest.mark.parametrize(("elevation", "pitch"), [(0, 0), (9, 0), (-15, 0), (0, 3), (0, 90), (9, 30)])
def test_one_ring_has_no_frame_to_advise(turn: float, elevation: float, pitch: float):
    xyz = laser(turn, elevation, pitch)
    assert on_one_ring(xyz) and check_frame(Scan(xyz)).warning() is None
    xyz[::60, 2] += 1  # strays
    assert on_one_ring(xyz)


@pytest.mark.parametrize("name", SENSORS)
def test_two_beams_are_no_ring(name: str):
    scan = SyntheticStreets(5, 1, get_sensor(name)).image(0).to_scan()
    for kept in (scan.ring >= 0, scan.ring % 4 == 0, np.abs(scan.xyz[:, 1]) < 0.2 * scan.xyz[:, 0]):
        assert not on_one_ring(scan.xyz[kept])
    rng = np.random.default_rng(0)
    assert not on_one_ring(rng.normal([50, 0, 0], 0.1, (500, 3))) and not on_one_ring(np.zeros((50, 3)))


@pytest.mark.parametrize("ring", [None, np.zeros(1081, int)])
def test_the_verbs_say_what_it_is(ring: np.ndarray | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "a.pcd"
    write(path, Scan(laser(270), np.full(1081, 0.5, np.float32), ring=ring))
    main(["info", str(path)])
    said = capsys.readouterr().out
    assert SAID in said and "tilted" not in said and "--sensor" not in said
    for verb in (["sensor", str(path), "--out", str(tmp_path / "a.toml")],
                 ["complete", str(path), "--out", str(tmp_path / "b.ply"), "--model", "nearest"]):  # fmt: skip
        with pytest.raises(SystemExit):
            main(verb)
        said = capsys.readouterr().err
        assert SAID in said and "Livox" not in said and "tilted" not in said
    main(["complete", str(path), "--out", str(tmp_path / "b.ply"), "--model", "nearest", "--sensor", "vlp-16"])
    assert "expected points of vlp-16, found none on its 7 lowest beams of 16" in capsys.readouterr().err
