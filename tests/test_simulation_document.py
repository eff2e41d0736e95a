"""docs/simulation.md as a new user walks it: one scan of a small sensor, drives of two frames, one process."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from networks import tiny_cascade
from test_readme import REPO_ROOT, blocks, commands, smaller

from lidarsynth.cli.main import main
from lidarsynth.data import street_sets
from lidarsynth.files.formats import read, write
from lidarsynth.files.labels import read_words
from lidarsynth.lidar.sensor import SENSORS, get_sensor
from lidarsynth.streets.frame import LabelledStreets, Options

pytest.importorskip("embreex", reason="lidarsynth[synthetic] is not installed")

DOC = REPO_ROOT / "docs" / "simulation.md"
SHOWN = blocks(DOC.read_text())


def small(words: list[str]) -> list[str]:
    line = shlex.join(smaller(words))
    line = re.sub(r"--frames \d+", "--frames 2", re.sub(r"--sensor \S+", "", line))
    model = [] if words[1] == "streets" else ["--model", "tiny"]
    workers = [] if words[1] == "generate" else ["--workers", "1"]
    return [*shlex.split(line), "--sensor", "own.toml", *workers, *model]


def test_the_walk_through_walks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.chdir(tmp_path)
    # which casts the frames again; tests/test_street_sets.py looks at a real one
    monkeypatch.setattr(street_sets, "overview", lambda streets: np.zeros((8, 8, 3), np.uint8))
    (toml,) = ("\n".join(block.lines) for block in SHOWN if block.language == "toml")
    (tmp_path / "own.toml").write_text(toml.replace("width = 900", "width = 128"))
    tiny_cascade(SENSORS["vlp-16"]).save("tiny")
    scan = LabelledStreets(0, 1, get_sensor("own.toml"), Options(perfect=True))[0].scan
    Path("simulated").mkdir()
    for name in ("simulated.pcd", "simulated/000000.pcd"):
        write(name, scan)
    for words in (c for b in SHOWN if b.language == "bash" and b.run for c in commands(b)):
        main(small(words)[1:])  # a refusal is a SystemExit
        said = capsys.readouterr().out
        assert re.search(r"labelled scans? of own", said) or words[1] != "streets"
    for name in ("places", "detection", "drives", "scenes", "wet", "fog", "crowd", "indoors", "perfect"):
        assert (tmp_path / name / "overview.png").exists() and (tmp_path / name / "streets.json").exists(), name
    assert (tmp_path / "drives/sequences/00/poses.txt").read_text().count("\n") == 2
    tracks = json.loads((tmp_path / "drives/sequences/00/tracks.json").read_text())
    assert all(set(track["frames"]) <= {"0", "1"} for track in tracks.values())
    sizes = [len(read(name, "none")) for name in ("realised/000000.pcd", "perfect/000000.pcd", "simulated.pcd")]
    assert sizes[0] < sizes[1] == sizes[2] and len(read("real.pcd")) == len(read("real/000000.bin")) == sizes[0]
    assert read_words("labelled/000000.label", len(read("labelled/000000.ply"))).all()
    assert (tmp_path / "scenes/v1.0-trainval/sample_annotation.json").exists()
    (python,) = ("\n".join(block.lines) for block in SHOWN if block.language == "python")
    names: dict = {}
    exec(compile(python, str(DOC), "exec"), names)
    assert len(names["frame"].scan) > 5000
