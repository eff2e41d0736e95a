"""Intensities of a scale that is none of ours make a black scan: a line says so, and no line says it of other scans."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_cascade import SMALL, perfect
from test_realise import save_model_and_sensor

from lidarsynth.cli.main import main
from lidarsynth.lidar.unseen import darkness

SAID = "expected bright points among others, found no reflectance above"


def saved(name: str, kind: type, most: float) -> None:
    """A `.npy` of a street whose intensities are of a type and 0 to `most`, evenly."""
    xyz = perfect(SMALL).xyz
    fields = np.zeros(len(xyz), [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", kind)])
    fields["x"], fields["y"], fields["z"] = xyz.T
    fields["intensity"] = np.linspace(0, most, len(xyz))
    np.save(name, fields)


@pytest.mark.parametrize(
    ("kind", "most", "told"),
    [(np.uint16, 4000, True), (np.float32, 300, True), (np.uint16, 60000, False), (np.uint8, 100, False),
     (np.float32, 0.4, False), (np.float32, 200, False)],
)  # fmt: skip
def test_verbs_tell_of_black_scans(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], kind: type, most: float,
    told: bool,
):  # fmt: skip
    monkeypatch.chdir(tmp_path)
    save_model_and_sensor()
    saved("a.npy", kind, most)
    for words in (["complete", "--model", "model"], ["project"], ["realise", "--model", "model"]):
        main([*words, "a.npy", "--sensor", "own.toml", "--out", "o.ply", "--no-picture"])
        assert (SAID in capsys.readouterr().err) == (told and words[0] != "realise")
        main([*words, "a.npy", "--sensor", "own.toml", "--out", "o.ply", "--no-picture", "--intensity", "none"])
        assert SAID not in capsys.readouterr().err
    main(["info", "a.npy"])
    assert (SAID in capsys.readouterr().out) == told


def test_scans_without_reflectance_and_of_few_points_are_not_judged():
    scan = perfect(SMALL)
    dim = replace(scan, reflectance=np.full(len(scan), 0.01, np.float32))
    assert darkness(dim) is not None and darkness(dim[:100]) is None
    assert darkness(replace(scan, reflectance=np.zeros(len(scan), np.float32))) is None
