"""docs/own-data.md as a new user walks it, from `.pcd` files of a 32-beam sensor to a model, at tiny scale.

What is made smaller: few narrow scans, few steps, and a tiny model in place of the shipped default.
"""

import ast
import re
import shlex
from pathlib import Path

import pytest
from test_readme import REPO_ROOT, blocks, commands, smaller

from lidarsynth.cli.main import main
from lidarsynth.data.dataset import CachedImages
from lidarsynth.experiment.folder import save
from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import with_fields
from lidarsynth.files.formats import read, write
from lidarsynth.lidar.sensor import read_sensor
from lidarsynth.systems.table import build_network
from lidarsynth.systems.table import load_folder as load

DOC = REPO_ROOT / "docs" / "own-data.md"
SHOWN = blocks(DOC.read_text())
SMALLER = (  # besides those of the README
    (r"train tuned", "train tiny --from start"),
    (r"model\.own_classes=true ", ""),  # tiny names nothing; that tuned learns it, test_cascade_training says
    (r"label held-out --model \S+", "label held-out"),
    (r"training\.steps=\d+", "training.steps=2"),
    (r"(train .*)", r"\1 --threads 1 --workers 0 --sample-every 2"),
    (r"(data files .*)", r"\1 --workers 0"),
)


def small(words: list[str]) -> list[str]:
    line = shlex.join(smaller(words))
    for pattern, replacement in SMALLER:
        line = re.sub(pattern, replacement, line)
    return shlex.split(line)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the user stands: scans of one street, scans of another, the sensor as the document writes it."""
    pytest.importorskip("embreex", reason="needs lidarsynth[synthetic]")
    from lidarsynth.streets.reader import SyntheticStreets

    folder = tmp_path_factory.mktemp("own-data")
    (toml,) = ("\n".join(block.lines) for block in SHOWN if block.language == "toml")
    (folder / "full.toml").write_text(toml)
    (folder / "my-lidar.toml").write_text(toml.replace("width = 1024", "width = 64"))
    sensor = read_sensor(folder / "full.toml").resized(width=256)
    assert sensor.height == 32
    for name, seed, count in (("scans", 1, 4), ("held-out", 2, 2)):
        (folder / name).mkdir()
        streets = SyntheticStreets(seed, count, sensor)
        for i in range(count):
            write(folder / name / f"{i:06d}.pcd", streets.image(i).to_scan())
    save(folder / "start", preset("tiny"), build_network(preset("tiny")))
    return folder


@pytest.mark.timeout(900)
def test_the_walk_through_walks(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.chdir(folder)
    said = {}
    for words in (c for b in SHOWN if b.language == "bash" and b.run for c in commands(b)):
        main(small(words)[1:])  # a refusal is a SystemExit
        said[" ".join(words[1:3])] = capsys.readouterr().out
    assert "found 32 rings from +15.0 to -25.0 degrees" in said["info scans/000000.pcd"]
    assert CachedImages(folder / "cache/mine").sensor == read_sensor(folder / "my-lidar.toml")
    experiment, _ = load(folder / "runs/mine")
    assert (experiment.data.height, experiment.data.width) == (32, 64)
    assert "4 images of files" in experiment.card.data and str(folder) not in str(experiment)
    assert len(read(folder / "generated/000000.pcd")) > 100 and (folder / "generated/000000.png").exists()
    assert len(read(folder / "dense.pcd")) >= len(read(folder / "scans/000000.pcd"))
    assert "mean of 2 scans" in said["complete held-out"] and "bilinear" in said["complete held-out"]
    (python,) = (block for block in SHOWN if block.language == "python" and block.run)
    exec(compile("\n".join(python.lines), str(DOC), "exec"), {})
    measured = ast.literal_eval(capsys.readouterr().out)
    assert len(measured) == 32
    assert max(abs(a - b) for a, b in zip(measured, read_sensor("full.toml").elevations, strict=True)) < 0.1


def test_what_the_document_says_of_rows_and_columns_is_so():
    """A multiple of 32 rows and 8 columns builds, of 16 and 4 does not."""
    beams = {"name": "own", "elevations": [-i / 4 for i in range(192)]}
    for height, width, fits in ((32, 64, True), (64, 104, True), (48, 64, False), (32, 100, False)):
        fields = {"data.sensor": beams, "data.height": height, "data.width": width, "model.base_channels": 8}
        experiment = with_fields(preset("kitti-streets"), fields)
        if fits:
            build_network(experiment)
        else:
            with pytest.raises(ValueError, match="must be divisible by"):
                build_network(experiment)
