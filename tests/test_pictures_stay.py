"""A picture of the user's where one of ours would go, under a name that nobody typed, stays."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_recognise import turn

from lidarsynth.cli.main import main
from lidarsynth.files.formats import write
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.pictures.figure import PAPER, in_the_way, panel
from lidarsynth.pictures.portrait import portrait
from lidarsynth.pictures.render import save_png

SAID = "expected a picture of lidarsynth to replace, found another; it stays: use another --out, or --no-picture"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A flat one as KITTI's tools make them: a scan and what the camera saw."""
    write(tmp_path / "8.bin", turn(SENSORS["vlp-16"]))
    camera(tmp_path / "8.png")
    return tmp_path


def camera(path: Path) -> Path:
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)).save(path)
    return path


@pytest.mark.parametrize(
    "words",
    [("project",), ("complete", "--model", "bilinear"), ("upsample", "--model", "bilinear", "--times", "2")],
)
def test_a_cameras_picture_beside_the_scan_stays(
    words: tuple[str, ...], folder: Path, capsys: pytest.CaptureFixture[str]
):
    before, sensor = (folder / "8.png").read_bytes(), "--from" if words[0] == "upsample" else "--sensor"
    verb, *others = words
    main([verb, str(folder / "8.bin"), *others, sensor, "vlp-16", "--out", str(folder / "8.ply")])
    said = capsys.readouterr()
    assert f"8.png: {SAID}" in said.err and "wrote" in said.out and "8.png" not in said.out
    assert (folder / "8.png").read_bytes() == before and (folder / "8.ply").is_file()


def test_of_many_scans_only_those_beside_a_picture_have_none(folder: Path, capsys: pytest.CaptureFixture[str]):
    write(folder / "9.bin", turn(SENSORS["vlp-16"]))
    before = (folder / "8.png").read_bytes()
    for _ in range(2):  # ours are replaced
        main(["project", str(folder / "*.bin"), "--sensor", "vlp-16", "--out", str(folder)])
        said = capsys.readouterr()
        assert f"8.png: {SAID}" in said.err and "9.npz and " in said.out and "2 scans in" in said.out
    assert (folder / "8.png").read_bytes() == before and in_the_way(folder / "9.png") is None


def test_sensor_leaves_it(folder: Path, capsys: pytest.CaptureFixture[str]):
    before = camera(folder / "my.png").read_bytes()
    main(["sensor", str(folder / "8.bin"), "--out", str(folder / "my.toml")])
    assert f"my.png: {SAID}" in capsys.readouterr().err and (folder / "my.png").read_bytes() == before


def test_streets_leaves_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("embreex", reason="embreex comes with the extra `synthetic`")
    drawn, words = tmp_path / "o" / "overview.png", ["-n", "1", "--frames", "1", "--sensor", "vlp-16", "--workers", "1"]
    main(["streets", *words, "--out", str(drawn.parent)])
    assert in_the_way(drawn) is None
    before = camera(drawn).read_bytes()
    main(["streets", *words, "--out", str(drawn.parent)])
    assert f"overview.png: {SAID}" in capsys.readouterr().err and drawn.read_bytes() == before


def ours(image: np.ndarray, path: Path) -> None:
    save_png(path, image)


def former(image: np.ndarray, path: Path) -> None:
    Image.fromarray(image).save(path, format="PNG", compress_level=3)


@pytest.mark.parametrize("put", [ours, former])
def test_our_pictures_are_known_also_those_of_before_the_mark(put: Callable[[np.ndarray, Path], None], tmp_path: Path):
    sensor = SENSORS["vlp-16"]
    image = project(turn(sensor), sensor)
    for drawn in (portrait(image), panel([[("", np.zeros((9, 9, 3), np.uint8))]], "a title", 200)):
        put(drawn, tmp_path / "a.png")
        assert in_the_way(tmp_path / "a.png") is None


def test_what_is_none_of_ours_is_in_the_way(tmp_path: Path):
    assert in_the_way(tmp_path / "a.png") is None
    drawn = panel([[("", np.zeros((9, 9, 3), np.uint8))]], width=100)
    framed = np.pad(drawn, ((1, 1), (1, 1), (0, 0)), constant_values=255)
    for other in (framed, drawn[1:], np.full((90, 90, 3), PAPER, np.uint8), np.zeros((4, 4, 3), np.uint8)):
        former(other, tmp_path / "a.png")
        assert in_the_way(tmp_path / "a.png") is not None
    Image.fromarray(drawn).save(tmp_path / "a.png", dpi=(100, 100))  # as of a program that says more
    assert in_the_way(tmp_path / "a.png") is not None
    Image.fromarray(drawn).save(tmp_path / "a.png", format="JPEG")
    assert in_the_way(tmp_path / "a.png") is not None
    save_png(tmp_path / "b.png", drawn)
    (tmp_path / "a.png").write_bytes((tmp_path / "b.png").read_bytes()[:20])
    assert in_the_way(tmp_path / "a.png") is not None
    (tmp_path / "d.png").mkdir()
    assert in_the_way(tmp_path / "d.png") is not None
