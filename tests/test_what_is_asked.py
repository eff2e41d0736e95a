"""What is asked for does not fit what is there: said before the work, in one line, and nothing is lost."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_frame import moved, street

import lidarsynth as ls
from lidarsynth.cli.main import main
from lidarsynth.data.dataset import write_cache
from lidarsynth.evaluation.evaluate import evaluate
from lidarsynth.files.formats import write
from lidarsynth.lidar.frame import parse_transform
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.training.examples import folders_of
from lidarsynth.verbs.training_start import shared_images

SMALL = SENSORS["hdl-64e-kitti"].resized(16, 64)


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that the command line says of it."""
    with pytest.raises(SystemExit, match="2"):
        main(words)
    line = capsys.readouterr().err.strip()
    assert "\n" not in line
    return line


def noise_image(i: int, sensor: Sensor = SMALL) -> RangeImage:
    rng, shape = np.random.default_rng(i), (sensor.height, sensor.width)
    mask = rng.random(shape) < 0.9
    return RangeImage(rng.uniform(2, 60, shape).astype(np.float32) * mask, mask * np.float32(0.3), mask, sensor)


@pytest.fixture
def two_sensors(tmp_path: Path) -> Path:
    folder = tmp_path / "mixed"
    folder.mkdir()
    for name, sensor in (("a", "hdl-64e-kitti"), ("b", "hdl-32e")):
        write(folder / f"{name}.pcd", street(sensor))
    return folder


def test_a_cache_does_not_come_among_the_scans(two_sensors: Path, capsys: pytest.CaptureFixture[str]):
    here, before = str(two_sensors), sorted(two_sensors.iterdir())
    assert "other than that of the scans" in refused(["data", "files", here, here], capsys)
    assert "expected an empty folder for a cache" in refused(["data", "synthetic", here, "-n", "1"], capsys)
    assert "expected -n with synthetic" in refused(["data", "files", here, f"{here}-cache", "-n", "5"], capsys)
    assert sorted(two_sensors.iterdir()) == before


def test_scans_of_two_sensors_are_no_set_of_one(two_sensors: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    words = ["data", "files", str(two_sensors), str(tmp_path / "cache"), "--workers", "0"]
    line = refused(words, capsys)
    assert "a.pcd of hdl-64e-kitti and" in line and "b.pcd of hdl-32e: name the sensor with --sensor" in line
    main([*words, "--sensor", "hdl-64e-kitti"])
    capsys.readouterr()
    (tmp_path / "one").mkdir()
    for name in "ab":
        write(tmp_path / "one" / f"{name}.pcd", street("hdl-64e-kitti"))
    report = evaluate(two_sensors, tmp_path / "one", "bev-1")
    assert any("hdl-64e-kitti, hdl-32e" in text and "other beams" in text for text in report.warnings)


def test_the_same_images_on_both_sides_are_noted(tmp_path: Path):
    folder = tmp_path / "cache"
    list(write_cache(folder, noise_image, 4, SMALL, {"name": "noise"}))
    assert any("the same images" in text for text in evaluate(folder, folder, "bev-1").warnings)


def test_ranges_that_are_no_metres_are_noted(tmp_path: Path):
    near = [replace(image, range=image.range / 80) for image in map(noise_image, range(4))]
    report = evaluate(near, [noise_image(i) for i in range(4, 8)], "bev-1")
    assert [text for text in report.warnings if "ranges of samples are 0.75 m at most" in text]
    assert not any("the reference are" in text for text in report.warnings)


def test_a_batch_of_no_images_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    none = np.zeros((0, 16, 64), np.float32)
    np.savez(tmp_path / "none.npz", range=none, reflectance=none, mask=none > 0)
    words = ["evaluate", str(tmp_path / "none.npz"), "--reference", str(tmp_path / "none.npz")]
    assert "expected at least one range image" in refused(words, capsys)


@pytest.mark.parametrize(("option", "found"), [("--steps=2.5", "'2.5'"), ("--count=many", "'many'")])
def test_what_is_no_number_is_named_and_not_its_parser(option: str, found: str, capsys: pytest.CaptureFixture[str]):
    said = refused(["generate", option], capsys)
    assert said.endswith(f"as --help says, found {found}") and "int()" not in said and "Errors" not in said


def test_a_report_replaces_reports_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for k in (0, 1):
        list(write_cache(tmp_path / f"c{k}", lambda i, k=k: noise_image(4 * k + i), 4, SMALL, {"name": f"noise {k}"}))
    words = ["evaluate", str(tmp_path / "c0"), "--reference", str(tmp_path / "c1"), "--out", str(tmp_path / "r.json")]
    main(words)
    main(words)
    (tmp_path / "r.md").write_text("# Notes of mine\n")
    assert "which is no report" in refused(words, capsys)
    assert (tmp_path / "r.md").read_text() == "# Notes of mine\n"
    assert "expected --side reference with --part" in refused([*words, "--side", "reference"], capsys)


@pytest.mark.parametrize("option", ["--traffic=-1", "--kerbs=nan", "--walls=1e6"])
def test_streets_that_cannot_be_leave_no_folder_behind(option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "set"
    words = ["streets", "-n", "1", "--sensor", "vlp-16", "--out", str(out), "--workers", "1", "--no-picture"]
    assert "of 0 to 100" in refused([*words, option], capsys)
    assert not (out / "streets.json").exists()


def test_validation_is_of_the_sensor_that_is_trained_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    other = SENSORS["hdl-64e-kitti"].resized(16, 128)
    list(write_cache(tmp_path / "a", noise_image, 4, SMALL, {"name": "noise"}))
    list(write_cache(tmp_path / "b", lambda i: noise_image(i, other), 4, other, {"name": "noise"}))
    words = ["train", "tiny", "--data", str(tmp_path / "a"), "--validation", str(tmp_path / "b"), "--workers", "0"]
    assert "expected the sensor and the projection" in refused([*words, "--out", str(tmp_path / "run")], capsys)


def test_a_sensor_that_was_learned_in_its_frame_is_not_told_to_move(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A roof's sensor whose points' origin is on the ground: its beams leave from 1.6 m above it."""
    raised = moved(street("vlp-16"), parse_transform("0:0:1.61:0:0:0"))
    write(tmp_path / "roof.pcd", raised)
    main(["sensor", str(tmp_path / "roof.pcd"), "--out", str(tmp_path / "own.toml"), "--no-picture"])
    capsys.readouterr()
    words = ["complete", str(tmp_path / "roof.pcd"), "--out", str(tmp_path / "o.ply"), "--no-picture"]
    main([*words, "--sensor", str(tmp_path / "own.toml")])
    assert "above the origin" not in capsys.readouterr().err
    main([*words, "--sensor", "vlp-16"])
    assert "above the origin" in capsys.readouterr().err


def test_an_upside_down_sensor_is_told_so_though_its_beams_are_as_many_above_as_below(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    sensor = SENSORS["os1-64"].resized(width=256)
    rays = sensor.directions()
    near = np.random.default_rng(0).uniform(1.5, 3, 16).repeat(16) / np.hypot(rays[..., 0], rays[..., 1])
    rows, columns = (index.reshape(-1) for index in np.indices(near.shape))
    xyz = sensor.points(near.astype(np.float32)).reshape(-1, 3) * np.float32([1, -1, -1])
    write(tmp_path / "over.ply", Scan(xyz, ring=rows, time=columns / 2560))
    words = ["complete", str(tmp_path / "over.ply"), "--out", str(tmp_path / "o.ply"), "--no-picture"]
    main([*words, "--sensor", "os1-64"])
    assert "upside down" in capsys.readouterr().err


def test_a_folder_of_training_data_may_have_a_comma(tmp_path: Path):
    (tmp_path / "a,b").mkdir()
    assert folders_of(tmp_path / "a,b") == [str(tmp_path / "a,b")]
    assert folders_of("cache/a,cache/b") == ["cache/a", "cache/b"]


def test_what_is_left_out_for_doubt_is_no_error_of_the_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write(tmp_path / "a.pcd", street("vlp-16"))
    said, left = [], []
    for more in ([], ["--min-confidence", "0.9"]):
        words = ["complete", str(tmp_path / "a.pcd"), "--corrupt", "beams:2", "--out", str(tmp_path / "o.ply"), *more]
        main([*words, "--no-picture"])
        said.append(next(line for line in capsys.readouterr().out.splitlines() if "lidarsynth" in line))
        left.append(len(ls.read(tmp_path / "o.ply")))
    assert said[0] == said[1] and left[1] < left[0]
    assert len(ls.read(tmp_path / "o.ply")) < 16 * 1024


def test_a_sensor_that_cannot_be_the_scans_is_told_where_images_are_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "in").mkdir()
    write(tmp_path / "in" / "a.pcd", street("hdl-32e"))
    words = ["data", "files", str(tmp_path / "in"), str(tmp_path / "cache"), "--workers", "0", "--sensor"]
    main([*words, "vlp-16"])
    assert "a.pcd: expected points of vlp-16, found them on 32 rings" in capsys.readouterr().err
    main([*words[:3], str(tmp_path / "own"), *words[4:], "hdl-32e"])
    assert "expected points of" not in capsys.readouterr().err
    project = ["project", str(tmp_path / "in" / "a.pcd"), "--out", str(tmp_path / "a.npz"), "--sensor", "vlp-16"]
    main(project)
    assert "expected points of vlp-16, found them on 32 rings" in capsys.readouterr().err
    assert "expected points of vlp-16" in refused([*project, "--strict"], capsys)


def test_a_file_that_begins_with_a_mark_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "own.toml"
    path.write_bytes(b"\xef\xbb\xbfname = 'own'\r\nbeams = 16\r\ntop = 10\r\nbottom = -10\r\n")
    main(["info", str(path)])
    assert "16 from +10.00" in capsys.readouterr().out


def test_more_beams_than_an_image_has_are_refused_by_what_was_asked():
    with pytest.raises(ValueError, match="expected at most 4096 beams, found 100 times 64, 6301: fewer times"):
        SENSORS["os1-64"].denser(100)
    assert SENSORS["os1-64"].denser(64).height == 4033


@pytest.mark.parametrize("recipe", [None, 4, ["beams:4"]])
def test_a_recipe_is_words(recipe: object):
    with pytest.raises(ValueError, match="expected a recipe such as beams:4, found a"):
        ls.corrupt(noise_image(0), recipe)  # type: ignore[arg-type]


def test_a_field_of_the_file_that_another_has_the_name_of_is_shown_as_it_is_written():
    scan = Scan(np.ones((3, 3)), ring=np.arange(3), extra={"ring": np.arange(3), "more": np.arange(3)})
    assert repr(scan).endswith("ring, file_ring, more)")


def test_streets_of_another_sensor_are_told_by_its_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    words = ["streets", "-n", "1", "--out", str(tmp_path / "set"), "--format", "pcd", "--sensor"]
    main([*words, "vlp-16"])
    capsys.readouterr()
    line = refused([*words, "hdl-32e"], capsys)
    assert "made with {sensor hdl-32e}, found {sensor vlp-16}; use another --out" in line


def test_scans_to_judge_on_that_are_learned_from_are_told_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    def made(name: str, root: str, first: int) -> Path:
        """A cache of four scans of a folder, from a number on."""
        frames, source = (lambda i: ("files", ".", f"{first + i}.bin")), {"name": "files", "root": root}
        list(write_cache(tmp_path / name, lambda i: noise_image(first + i), 4, SMALL, source, frames))
        return tmp_path / name

    a, b, some = made("a", "/in", 0), made("b", "/in", 9), made("some", "/in", 2)
    copy, others = made("copy", "/elsewhere", 0), made("others", "/elsewhere", 9)
    told = "expected scans that are not trained on, found"
    assert shared_images(f"{a},{b}", others).startswith(f"{others}: {told} 4 of its 4 in {a},{b}: what they judge")
    assert f"{told} 4 of its 4" in shared_images(a, a) and f"{told} 4 of its 4" in shared_images(a, copy)
    assert f"{told} 2 of its 4" in shared_images(a, some), "by the paths of the scans"
    for data, validation in ((a, others), (a, "synthetic"), ("synthetic", "synthetic"), (a, None)):
        assert shared_images(data, validation) == ""
    words = ["train", "tiny", "--data", str(a), "--out", str(tmp_path / "run"), "--training.steps", "1"]
    main([*words, "--workers", "0", "--sample-every", "0", "--validation", str(a)])
    assert f"{a}: {told} 4 of its 4 in {a}" in capsys.readouterr().err
