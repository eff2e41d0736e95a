"""Labels that lie beside a scan, as SemanticKITTI has them: verbs that keep points keep them, in every output."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_cascade import SMALL, perfect
from test_realise import save_model_and_sensor

from lidarsynth.cli.main import main
from lidarsynth.files.formats import read, read_image, write, write_labels
from lidarsynth.files.labels import read_words
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.semantic_kitti import CLASS_OF_RAW

WORDS = ("--model", "model", "--no-picture")
OWN = ("--sensor", "own.toml")
VERBS = ("complete", "upsample", "realise", "project", "complete --without car")
INSTANCE, ROAD, MOVING = 1 << 16, 40, 252


def words_for(verb: str) -> tuple[str, ...]:
    """What the verb is told of model and sensor."""
    if verb == "project":
        return (*OWN, "--no-picture")
    return (*WORDS, "--from" if verb == "upsample" else "--sensor", "own.toml")


@pytest.fixture
def scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scan:
    """Half of the columns of a street of road and moving cars, and where it lies: velodyne/a.bin, labels/a.label."""
    monkeypatch.chdir(tmp_path)
    save_model_and_sensor()
    whole = perfect(SMALL)
    half = replace(whole, ring=None, label=None, extra={}, reflectance=np.full(len(whole), 0.5, np.float32))
    half = half[np.arange(len(half)) % 256 % 2 == 0]
    words = np.where(np.arange(len(half)) % 97 < 9, MOVING | 7 * INSTANCE, ROAD).astype("<u4")
    for folder in ("velodyne", "labels"):
        Path(folder).mkdir()
    write("velodyne/a.bin", half)
    write_labels("labels/a.label", replace(half, extra={"raw_label": words}))
    return replace(half, extra={"raw_label": words})


def words_by_point(of: Scan, words: np.ndarray) -> dict[bytes, int]:
    return {point.tobytes(): int(word) for point, word in zip(of.xyz, words, strict=True)}


@pytest.mark.parametrize("verb", VERBS)
def test_measured_points_and_pixels_keep_them(scan: Scan, verb: str):
    given = words_by_point(scan, scan.extra["raw_label"])
    for name in ("o.npz", "o.ply", "new/velodyne/o.bin"):
        main([*verb.split(), "velodyne/a.bin", "--out", name, *words_for(verb)])
    image, points = read_image("o.npz"), read("o.ply")
    assert image.label is not None and points.label is not None
    bare = read("new/velodyne/o.bin")
    words = read_words("new/labels/o.label", len(bare))
    for found, said in ((image.to_scan(), image.label[image.mask]), (points, points.label), (bare, words)):
        old = found.extra.get("new", np.zeros(len(found))) == 0
        raw = [given[point.tobytes()] for point in found.xyz[old]]
        whole = found is bare and verb != "project"  # with the instance; an image holds classes alone
        assert (said[old] if whole else CLASS_OF_RAW[said & 0xFFFF][old] if found is bare else said[old]).tolist() == (
            raw if whole else [CLASS_OF_RAW[word & 0xFFFF] for word in raw]
        )
        assert len(raw) > 500 and not said[~old].any()


def test_new_points_get_theirs_and_measured_ones_keep_them_with_labels(scan: Scan):
    """Who asks for classes had those of the network for measured points, too, and none in the file of a `.bin`."""
    for name in ("o.ply", "o.bin", "o.npz"):
        main(["complete", "velodyne/a.bin", "--labels", "--out", name, *WORDS, *OWN])
    points, words, image = read("o.ply"), read_words("o.label", len(read("o.bin"))), read_image("o.npz")
    new = points.extra["new"] > 0
    given = words_by_point(scan, scan.extra["raw_label"])
    assert points.label is not None and new.sum() > 100 and (points.label[new] > 0).all()
    np.testing.assert_array_equal(CLASS_OF_RAW[words & 0xFFFF], points.label)
    assert [given[point.tobytes()] for point in points.xyz[~new]] == words[~new].tolist()
    assert image.label is not None and (image.label[image.mask] > 0).all()


@pytest.mark.parametrize("verb", ["complete", "project"])
def test_those_that_do_not_fit_are_left_out_with_a_line(scan: Scan, verb: str, capsys: pytest.CaptureFixture[str]):
    Path("labels/a.label").write_bytes(b"1234")
    main([verb, "velodyne/a.bin", "--out", "o.ply", *words_for(verb)])
    said = capsys.readouterr().err
    assert f"labels/a.label left out: expected {4 * len(scan)} bytes, one label of 4 for each of" in said
    assert read("o.ply").label is None


def test_those_in_the_folder_of_the_scans_are_read(scan: Scan):
    Path("labels/a.label").rename("velodyne/a.label")
    main(["project", "velodyne/a.bin", "--out", "o.npz", *OWN, "--no-picture"])
    assert read_image("o.npz").label is not None


def test_an_image_beside_labels_has_its_own(scan: Scan, capsys: pytest.CaptureFixture[str]):
    main(["project", "velodyne/a.bin", "--out", "velodyne/a.npz", *OWN, "--no-picture"])
    for verb in ("complete", "realise"):
        main([verb, "velodyne/a.npz", "--out", "o.npz", *WORDS])
        assert "label" not in capsys.readouterr().err and read_image("o.npz").label is not None


def test_project_replaces_no_labels_of_its_scan(scan: Scan, capsys: pytest.CaptureFixture[str]):
    before = Path("labels/a.label").read_bytes()
    with pytest.raises(SystemExit):
        main(["project", "velodyne/a.bin", "--out", "velodyne/a.npy", *OWN, "--no-picture"])
    assert "expected a name whose .label is not that of velodyne/a.bin" in capsys.readouterr().err
    assert Path("labels/a.label").read_bytes() == before and not Path("velodyne/a.npy").exists()
    main(["project", "velodyne/a.bin", "--out", "o.bin", *OWN, "--no-picture"])
    assert "wrote o.bin, with .label beside it" in capsys.readouterr().out
