"""The texts of `info` and the tables of errors hold the numbers they should."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from networks import trained

from lidarsynth.experiment.folder import save
from lidarsynth.experiment.presets import PRESETS, preset
from lidarsynth.experiment.record import Card
from lidarsynth.files.formats import write
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.metrics.reconstruction import Errors
from lidarsynth.systems.table import build_network
from lidarsynth.verbs.description import describe, describe_sensor, errors_table, mean_table


def table(text: str) -> dict[str, str]:
    """The lines under the title by their first word."""
    return {line.split()[0]: line.split(maxsplit=1)[1] for line in text.splitlines()[1:]}


def test_scan(tmp_path: Path):
    xyz = np.float32([[3, 4, 0], [0, 0, 10], [np.nan, 1, 1], [6, 8, 0]])
    write(tmp_path / "s.npz", Scan(xyz, np.float32([0, 0.5, 1, 1]), ring=np.arange(4)))
    said = table(describe(str(tmp_path / "s.npz")))
    assert said["points"] == "3 (1 without a return dropped)"
    assert said["range"] == "5.00 to 10.00 m, median 10.00 m"
    assert said["reflectance"] == "0.00 to 1.00, mean 0.500"
    assert said["fields"] == "x y z reflectance ring"
    assert "expected at least 100 points" in said["sensor"]


@pytest.mark.parametrize("name", [n for n in PRESETS if n.startswith("r2dm-h") or n == "tiny"])
def test_preset_without_weights(name: str):
    said = table(describe(name))
    assert said["from"] == "preset, no weights"
    network = build_network(preset(name))
    assert said["parameters"] == f"{sum(p.numel() for p in network.parameters()):,}"


def test_model_folder_says_its_card(tmp_path: Path):
    card = Card("MIT", "streets of our own", ("20 steps on a laptop",), ("MAE 1.5 m",))
    experiment = replace(preset("tiny"), name="mine", card=card)
    save(tmp_path / "m", experiment, trained(experiment))
    text = describe(str(tmp_path / "m"))
    assert text.splitlines()[0] == "mine"
    for words in ("MIT", "streets of our own", "20 steps on a laptop", "MAE 1.5 m", "16 x 64", "hdl-64e-kitti"):
        assert words in text
    assert describe(str(tmp_path / "m" / "experiment.json")).splitlines()[0] == "mine"


def test_a_model_folder_may_be_named_like_a_scan_or_a_preset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    experiment = preset("tiny")
    save(tmp_path / "run.bin", experiment, trained(experiment))
    assert "conditional-unet" in describe(str(tmp_path / "run.bin"))


@pytest.mark.parametrize("name", SENSORS)
def test_sensor(name: str):
    sensor = SENSORS[name]
    said = table(describe(name))
    assert said["beams"].startswith(f"{sensor.height} from {sensor.elevations[0]:+.2f}")
    assert said["range"] == f"{sensor.min_range:g} to {sensor.max_range:g} m"
    assert describe(name) == describe_sensor(sensor)


def test_sensor_of_one_beam(tmp_path: Path):
    (tmp_path / "one.json").write_text('{"elevations": [0], "width": 36}')
    said = table(describe(str(tmp_path / "one.json")))
    assert said["beams"] == "1 from +0.00 to +0.00 degrees"
    assert said["columns"] == "36, 10.000 degrees apart"


def test_unknown_words_are_refused():
    with pytest.raises(ValueError, match=r"^nothing: expected .* found no file or folder"):
        describe("nothing")


def test_tables_of_errors():
    first = {"lidarsynth": Errors(1.0, 0.1, 2.0, 0.2, 100), "nearest": Errors(2.0, 0.2, 3.0, 0.3, 100)}
    second = {"lidarsynth": Errors(2.0, 0.3, 2.0, 0.2, 1100), "nearest": Errors(2.5, 0.2, 3.0, 0.3, 1100)}
    lines = errors_table("a.bin", second).splitlines()
    assert lines[0] == "a.bin: errors of the 1,100 hidden pixels, an empty pixel counts as 0 m"
    assert lines[2].split() == ["lidarsynth", "2.000", "m", "0.3000"]
    mean = mean_table([first, second]).splitlines()
    assert mean[0].startswith("mean of 2 scans: errors of the 1,200 hidden")
    assert mean[2].split() == ["lidarsynth", "1.500", "m", "0.2000"]
    assert mean[3].split() == ["nearest", "2.250", "m", "0.2000"]
