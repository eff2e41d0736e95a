"""The texts of `info` and the tables of errors hold the numbers they should."""

import gzip
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from networks import trained

import lidarsynth as ls
from lidarsynth.data.folder import scan_files
from lidarsynth.experiment.folder import save
from lidarsynth.experiment.presets import PRESETS, preset
from lidarsynth.experiment.record import Card
from lidarsynth.files.formats import write
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.metrics.reconstruction import Errors
from lidarsynth.systems.table import build_network
from lidarsynth.verbs.batch import Result
from lidarsynth.verbs.batch_report import report_of
from lidarsynth.verbs.description import describe, describe_sensor, errors_table, mean_table
from lidarsynth.viewer.packing import Shown
from lidarsynth.viewer.page import Entry, write_page


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


PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + (640).to_bytes(4, "big") + (480).to_bytes(4, "big")
OTHERS = {
    "a.png": (PNG, "picture, PNG of 640 x 480"),
    "a.tar.gz": (gzip.compress(b"scans"), "archive, gzip"),
    "page.html": (b"<!DOCTYPE html><title>mine</title>", "web page, not one of lidarsynth's"),
    "a.yaml": (b"lidar: 1\n", "text, no scan"),
    "a.label": (np.uint32([40, 40, (7 << 16) | 10]).tobytes(), "SemanticKITTI labels of 3 points"),
    "a.new": (b"\0\1\1", "marks of a completed scan of 3 points"),
    "a.confidence": (np.float32([0.25, 1]).tobytes(), "confidences of a completed scan of 2 points"),
    "own.toml": (b"beams = 4\ntop = 2\nbottom = -2", "sensor"),
    "report.json": (b'{"settings": 0, "done": 2, "skipped": 0, "failed": 1, "seconds": 1, "scans": []}', "report of"),
}  # fmt: skip


@pytest.mark.parametrize("name", OTHERS)
def test_what_is_no_scan_is_named(tmp_path: Path, name: str):
    content, kind = OTHERS[name]
    (tmp_path / name).write_bytes(content)
    assert table(describe(str(tmp_path / name)))["kind"].startswith(kind)


def test_a_page_of_ours_says_its_scans(tmp_path: Path):
    scan = Scan(np.float32([[5, 4, 0], [3, 0, 1]]), np.float32([0, 1]))
    write_page(tmp_path / "v.html", "t", [Entry(f"it's {i} <b>", {"s": Shown(scan)}) for i in range(4)])
    said = table(describe(str(tmp_path / "v.html")))
    assert said["kind"].startswith("page of lidarsynth view")
    assert said["scans"] == "4: it's 0 <b>, it's 1 <b>, it's 2 <b>, ..."


def test_a_folder_says_what_it_holds_and_passes_over(tmp_path: Path):
    scan = Scan(np.float32([[5, 4, 0], [3, 0, 1]]), np.float32([0, 1]))
    for name in ("a.ply", "b.bin", "rings/b.ply", "RADAR_FRONT/b.pcd"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write(tmp_path / name, scan)
    (tmp_path / "notes.md").write_text("no scan")
    assert [p.name for p in scan_files(tmp_path)] == ["a.ply", "b.bin"]
    assert [p.name for p in scan_files(tmp_path / "rings")] == ["b.ply"], "named by itself, it is meant"
    said = table(describe(str(tmp_path)))
    assert said["kind"] == "folder of scans" and said["scans"] == "1 .bin, 1 .ply"
    assert said["passed"] == "over         1 .md, 1 .pcd, 1 .ply"


def test_a_folder_without_scans_is_refused_by_what_it_holds(tmp_path: Path):
    (tmp_path / "notes.md").write_text("no scan")
    with pytest.raises(ValueError, match=r"expected scans.* found 1 \.md"):
        describe(str(tmp_path))


def test_a_range_image_says_its_sensor(tmp_path: Path):
    ls.write(tmp_path / "i.npz", ls.project(Scan(np.float32([[9, 0, 0]]), np.float32([1])), "vlp-16", "spherical"))
    assert table(describe(str(tmp_path / "i.npz")))["kind"].startswith("range image of vlp-16, 16 x 1024")


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


def test_what_knows_no_reflectance_has_no_error_of_it():
    errors = {"lidarsynth": Errors(1.0, math.nan, 2.0, math.nan, 10), "bilinear": Errors(1.5, 0.1, 2.0, 0.2, 10)}
    lines = errors_table("a.bin", errors).splitlines()
    assert lines[2].split() == ["lidarsynth", "1.000", "m", "none"] and lines[3].split()[-1] == "0.1000"
    result = Result("a", Path("a.bin"), None, 0.1, errors=errors)
    report = json.loads(json.dumps(report_of([result, result], 0, 1.0, {}), allow_nan=False))
    assert report["errors"]["lidarsynth"]["reflectance_mae"] is None
    assert report["errors"]["bilinear"]["pixels"] == 20 and report["scans"][0]["errors"]["bilinear"]["range_mae"] == 1.5
