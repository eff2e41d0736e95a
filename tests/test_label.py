"""The verb `label`: every point gets a class and stays as it was, in files, folders and bags; and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_cascade import SMALL, perfect
from test_realise import save_model_and_sensor, write_bag_of
from test_upsampling_model import model_of

from lidarsynth.cli.main import main
from lidarsynth.files.formats import read, read_image, write
from lidarsynth.files.labels import read_words
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASSES
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade.naming import class_of_points
from lidarsynth.verbs.description import describe
from lidarsynth.verbs.inputs import Reading
from lidarsynth.weights.load import load

WORDS = ("--model", "model", "--sensor", "own.toml", "--no-picture")


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a model, a sensor and a scan of it that says nothing of classes."""
    monkeypatch.chdir(tmp_path)
    save_model_and_sensor()
    write("scan.ply", replace(perfect(SMALL), label=None, reflectance=np.linspace(0, 1, len(perfect(SMALL)))))
    return tmp_path


def test_points_and_fields_stay_and_get_a_class(place: Path, capsys: pytest.CaptureFixture[str]):
    main(["label", "scan.ply", "--out", "named.ply", *WORDS])
    before, after = read("scan.ply"), read("named.ply")
    assert f"{len(before)} points of own" in capsys.readouterr().out
    for name in ("xyz", "reflectance", "ring", "time"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    np.testing.assert_array_equal(after.extra["object"], before.extra["object"])
    assert after.label is not None and after.label.min() >= 1 and after.label.max() < len(CLASSES)
    library = load("model").label(before, "own.toml")
    np.testing.assert_array_equal(library.label, after.label)
    again = load("model").label(library, "own.toml")  # labels that it had are replaced by the same
    np.testing.assert_array_equal(again.label, after.label)


def test_a_model_knows_the_sensor_that_it_was_tuned_on(place: Path, capsys: pytest.CaptureFixture[str]):
    scan = read("scan.ply")
    assert load("model").suited_to(scan).sensor.elevations == SMALL.elevations
    with pytest.raises(ValueError, match=r"or take model.into\(sensor\)"):
        load("default").suited_to(scan)
    for verb in ("label", "complete", "upsample", "realise"):
        main([verb, "scan.ply", "--model", "model", "--out", "o.ply", "--no-picture"])
        assert "wrote o.ply" in capsys.readouterr().out


def test_a_bin_gets_a_file_of_raw_ids_and_a_folder_is_worked_through(place: Path):
    Path("in").mkdir()
    for name in "ab":
        write(f"in/{name}.bin", replace(perfect(SMALL), ring=None))
    main(["label", "in", "--out", "out", "--format", "bin", *WORDS])
    assert sorted(path.name for path in Path("out").iterdir() if path.suffix != ".json") == [
        "a.bin", "a.label", "b.bin", "b.label"]  # fmt: skip
    assert Path("out/a.bin").read_bytes() == Path("in/a.bin").read_bytes()
    assert (read_words(Path("out/a.label"), 6144) > 0).all()


def test_labels_get_a_folder_beside_that_of_the_scans(place: Path):
    write("scan.bin", replace(perfect(SMALL), ring=None))
    main(["label", "scan.bin", "--out", "new/velodyne/000.bin", *WORDS])
    assert (read_words(Path("new/labels/000.label"), 6144) > 0).all()


@pytest.mark.parametrize("verb", ["label", "realise", "complete --labels", "upsample --labels"])
@pytest.mark.parametrize("to", ["d/odo.bin --out d/odo.npy", "d --out d --format npy", "d/odo.ply --out d/odo.bin"])
def test_labels_of_the_source_are_never_replaced(place: Path, capsys: pytest.CaptureFixture[str], verb: str, to: str):
    source = Path("d/odo.ply" if "ply" in to else "d/odo.bin")
    source.parent.mkdir()
    write(source, replace(perfect(SMALL), ring=None))
    words = np.arange(6144, dtype=np.uint32)
    words.tofile("d/odo.label")
    sensor = ("--from", "own.toml") if "upsample" in verb else ("--sensor", "own.toml")
    with pytest.raises(SystemExit) as end:
        main([*verb.split(), *to.split(), *sensor, "--model", "model", "--no-picture"])
    assert end.value.code == 2
    line = capsys.readouterr().err.split("\r")[-1]
    assert f"expected a name whose .label is not that of {source}, found d/odo.label" in line and line.count("\n") == 1
    np.testing.assert_array_equal(read_words(Path("d/odo.label"), 6144), words)
    assert sorted(Path("d").iterdir()) == sorted([source, Path("d/odo.label")])


@pytest.mark.parametrize(
    "words",
    ["complete d/odo.bin --out o/a.npy", "complete d/odo.ply --out o/a.bin", "upsample d --out o --format bin",
     "complete d/odo.bin --out d/odo.npy"],
)  # fmt: skip
def test_labels_of_other_points_are_not_taken_for_those_of_new_files(
    words: str, place: Path, capsys: pytest.CaptureFixture[str]
):
    for name in ("d", "o"):
        Path(name).mkdir()
    write("d/odo.ply" if "ply" in words else "d/odo.bin", replace(perfect(SMALL), ring=None, label=None))
    labels = Path("d/odo.label" if "d/odo.npy" in words else "o/a.label" if "/a." in words else "o/odo.label")
    labels.write_bytes(b"mine")
    before = sorted(Path().rglob("*"))
    with pytest.raises(SystemExit) as end:
        main([*words.split(), *(word.replace("--sensor", "--from") if "upsample" in words else word for word in WORDS)])
    line = capsys.readouterr().err.split("\r")[-1]
    assert f"expected a name without the labels of other points beside it, found {labels}\n" in line
    assert end.value.code == 2 and line.count("\n") == 1
    assert labels.read_bytes() == b"mine" and sorted(Path().rglob("*")) == before


def test_classes_of_a_file_are_labels_beside_its_new_one(place: Path, capsys: pytest.CaptureFixture[str]):
    write("a.ply", replace(perfect(SMALL), ring=None))
    main(["complete", "a.ply", "--out", "b.npy", *WORDS])
    assert "wrote b.npy, with .new, .label beside it\n" in capsys.readouterr().out
    Path("a.label").write_bytes(b"mine")
    with pytest.raises(SystemExit):
        main(["complete", "a.ply", "--out", "a.npy", *WORDS])
    assert "expected a name whose .label is not that of a.ply" in capsys.readouterr().err


def test_what_a_former_run_wrote_beside_is_replaced(place: Path, capsys: pytest.CaptureFixture[str]):
    write("odo.bin", replace(perfect(SMALL), ring=None, label=None)[np.arange(6144) % 2 == 0])
    for words in (
        "label scan.ply --out scan.bin",
        "complete odo.bin --out odo.npy --labels",
        "complete odo.bin --out o.npy",
    ):
        for _ in range(2):
            main([*words.split(), *WORDS])
    said = capsys.readouterr().out
    assert said.count("wrote scan.bin, with .label beside it\n") == 2
    assert said.count("wrote odo.npy, with .new, .label beside it\n") == 2
    assert said.count("wrote o.npy, with .new beside it\n") == 2


def test_marks_and_raw_labels_of_the_source_are_never_replaced(place: Path, capsys: pytest.CaptureFixture[str]):
    scan = replace(perfect(SMALL), ring=None)
    write("a.bin", replace(scan, extra={"new": np.zeros(len(scan), np.uint8)}))
    write("b.ply", replace(scan, extra={"raw_label": np.full(len(scan), 40, np.uint32)}))
    Path("b.label").write_bytes(b"mine")
    for words, ending in (("a.bin --out a.npy", "new"), ("b.ply --out b.npy", "label")):
        with pytest.raises(SystemExit):
            main(["complete", *words.split(), *WORDS])
        assert f"expected a name whose .{ending} is not that of {words[:5]}" in capsys.readouterr().err
    assert Path("a.new").stat().st_size == len(scan) and Path("b.label").read_bytes() == b"mine"
    assert not Path("a.npy").exists() and not Path("b.npy").exists()


def test_bags_keep_their_columns(place: Path):
    pytest.importorskip("rosbags")
    from lidarsynth.verbs.inputs import Reading, inputs_of

    scan = perfect(SMALL)
    fields = write_bag_of(scan, Path("in.mcap"), 1)
    main(["label", "in.mcap", "--out", "out.mcap", "--model", "model", "--sensor", "own.toml"])
    (cloud,) = (item.read() for item in inputs_of([Path("out.mcap")], Reading("none")).stream())
    assert cloud.given.keys() == fields.keys() | {"label"}
    for name, column in fields.items():
        np.testing.assert_array_equal(cloud.given[name], column)
    assert cloud.given["label"].min() >= 1


@pytest.mark.parametrize(("name", "word"), [("label", 13), ("class", 13), ("label", 252)])
def test_new_points_of_bags_get_their_class_where_the_message_has_a_column(place: Path, name: str, word: int):
    """Measured ones keep theirs; words that are no training classes stay beside ours, as in files."""
    pytest.importorskip("rosbags")
    from lidarsynth.data.bag_records import Cloud
    from lidarsynth.data.bag_writer import write_bag
    from lidarsynth.verbs.inputs import inputs_of

    scan = perfect(SMALL)[np.arange(6144) % 256 % 2 == 0]
    fields = {**dict(zip("xyz", scan.xyz.T, strict=True)), "intensity": np.full(len(scan), 100, np.float32),
              name: np.full(len(scan), word, np.uint8)}  # fmt: skip
    with write_bag("in.mcap") as writer:
        writer.write_cloud("/points", Cloud(10**9, "lidar", 10**9, fields))
    main(["complete", "in.mcap", "--out", "out.mcap", "--labels", *WORDS])
    (cloud,) = (item.read() for item in inputs_of([Path("out.mcap")]).stream())
    given, new = cloud.given, cloud.given["new"] > 0
    own = name if word < 20 else "file_label"
    assert given.keys() - fields.keys() == {"new"} | {own} - {name} and new.sum() > 100
    assert (given[own][~new] == word).all() and given[name][new].min() >= 1
    assert word < 20 or (given[own][new] == 0).all()


def test_classes_that_are_not_sure_are_left_out(place: Path, capsys: pytest.CaptureFixture[str]):
    scan, model = read("scan.ply"), load("model")
    all_of_them = model.label(scan, "own.toml").label
    counts = []
    for least in (0.0, 0.06, 0.07, 0.1, 1.0):
        label = model.label(scan, "own.toml", least=least).label
        assert ((label == 0) | (label == all_of_them)).mean() > 0.99  # a point may take that of a surer pixel beside it
        counts.append(int((label > 0).sum()))
    assert counts == sorted(counts, reverse=True) and counts[0] == len(scan) and counts[-1] == 0
    main(["label", "scan.ply", "--out", "sure.ply", "--min-confidence", "0.07", *WORDS])
    np.testing.assert_array_equal(read("sure.ply").label, model.label(scan, "own.toml", least=0.07).label)
    for words in (["--min-confidence", "1.5"], ["--min-confidence", "-0.1"]):
        with pytest.raises(SystemExit) as refused:
            main(["label", "scan.ply", "--out", "no.ply", *words, *WORDS])
        assert refused.value.code == 2 and "expected --min-confidence of 0 to 1" in capsys.readouterr().err
    with pytest.raises(ValueError, match="expected a least confidence of 0 to 1, found 2"):
        model.label(scan, "own.toml", least=2)


def test_pictures_show_classes(place: Path):
    main(["label", "scan.ply", "--out", "named.ply", *WORDS[:-1]])
    assert Path("named.png").stat().st_size > 10_000


def test_points_out_of_view_have_no_class_and_those_behind_others_their_own():
    metres = np.full((24, 256), 20.0, np.float32)
    metres[:, 128:] = 5.0
    label = np.where(np.arange(256) < 128, 13, 1) * np.ones((24, 1), int)
    image = RangeImage(metres, metres / 40, metres > 0, SMALL, label)
    row, column = np.array([3, 3, 3, -1, 3]), np.array([127, 128, 40, 40, 40])
    depth = np.array([5.1, 19.0, 20.0, 20.0, 0.1])  # before its pixel; behind it; at it; out of view; too near
    xyz = np.stack([depth, np.zeros(5), np.zeros(5)], 1)
    assert class_of_points(xyz, image, (row, column)).tolist() == [1, 13, 13, 0, 0]


def test_what_cannot_be_labelled_is_refused_in_one_line(place: Path, capsys: pytest.CaptureFixture[str]):
    for words, said in (
        (
            ["label", "scan.ply", "--out", "o.ply", "--model", "kitti-streets"],
            "expected a model that has learned classes",
        ),
        (["label", "none.ply", "--out", "o.ply"], "none.ply"),
        (["label", "scan.ply", "--out", "o.ply"], "--sensor"),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(words)
        error = capsys.readouterr().err.strip()
        assert stopped.value.code == 2 and said in error and "\n" not in error and not Path("o.ply").exists()


def test_a_seed_is_taken_and_nothing_sure_enough_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write(tmp_path / "a.pcd", SyntheticStreets(5, 1, "vlp-16").image(0).to_scan())
    words = ["label", str(tmp_path / "a.pcd"), "--out", str(tmp_path / "b.pcd"), "--no-picture", "--seed", "3"]
    main([*words, "--min-confidence", "1"])
    assert " points of vlp-16: " in (out := capsys.readouterr().out) and ": ," not in out


@pytest.mark.parametrize("verb", ["label", "complete", "upsample", "realise", "project"])
def test_a_range_image_is_of_the_sensor_that_its_file_holds(verb: str, place: Path, capsys: pytest.CaptureFixture[str]):
    main(["project", "scan.ply", "--sensor", "own.toml", "--out", "image.npz", "--no-picture"])
    asked = [] if verb == "project" else ["--model", "default"]
    with pytest.raises(SystemExit):  # of its points alone nobody can tell
        main([verb, "scan.ply", *asked, "--out", "o.ply", "--no-picture"])
    assert "name" in capsys.readouterr().err
    main([verb, "image.npz", *asked, "--out", "o.npz", "--no-picture"])
    made = read_image("o.npz").sensor
    beams = [e for e in made.elevations if any(abs(e - own) < 1e-9 for own in SMALL.elevations)]
    assert made.name == ("ownx4" if verb == "upsample" else "own") and len(beams) == SMALL.height
    main([verb, "image.npz", *asked, "--from" if verb == "upsample" else "--sensor", "vlp-16", "--out", "o.npz"])
    assert read_image("o.npz").sensor.name.startswith("vlp-16")  # unless another is named


def test_a_model_of_one_sensor_completes_a_range_image_in_its_own(place: Path):
    model_of("lidar-sr").save("sr")
    main(["project", "scan.ply", "--sensor", "own.toml", "--out", "image.npz", "--no-picture"])
    main(["complete", "image.npz", "--model", "sr", "--steps", "2", "--corrupt", "beams:4", "--out", "o.npz"])
    assert read_image("o.npz").sensor == model_of("lidar-sr").sensor


def test_info_tells_the_sensor_that_a_range_image_holds_until_its_points_are_moved(place: Path):
    main(["project", "scan.ply", "--sensor", "own.toml", "--out", "image.npz", "--no-picture"])
    assert "own (the file holds it)" in describe("image.npz")
    assert "name the sensor" in describe("image.npz", Reading(transform=np.eye(4)))


def test_a_range_image_is_of_its_own_sensor_in_python_too(place: Path):
    image = project(read("scan.ply"), "own.toml")
    with pytest.raises(ValueError, match="name the sensor"):
        load("default").label(image.to_scan())
    whole = load("default").label(image)
    np.testing.assert_array_equal(whole.label, load("default").label(image.to_scan(), "own.toml").label)
