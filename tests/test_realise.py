"""The verb `realise`: whose points, fields and labels stay, in files, folders and bags; and what is refused."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from networks import tiny_cascade
from test_cascade import SMALL, perfect
from test_columns import turn

from lidarsynth.cli.main import main
from lidarsynth.files.fields import PLACE, full_scale, scan_from_fields
from lidarsynth.files.formats import read, write, write_labels
from lidarsynth.files.labels import read_words
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.systems.cascade.perfect import fitting
from lidarsynth.systems.scan_model import ScanModel
from lidarsynth.verbs.inputs import Loaded, Reading, inputs_of
from lidarsynth.verbs.realisation import realise_scan, realised_fields
from lidarsynth.weights.load import load

WORDS = ("--sensor", "own.toml", "--no-picture")


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a model, a sensor and a perfect scan."""
    monkeypatch.chdir(tmp_path)
    save_model_and_sensor()
    return tmp_path


def save_model_and_sensor() -> None:
    """`model` and `own.toml`, here."""
    tiny_cascade(SMALL).save("model")
    elevations = list(SMALL.elevations)
    Path("own.toml").write_text(
        f"elevations = {elevations}\nwidth = 256\nmin_range = 0.5\nmax_range = 120.0\nmount = 1.8\n"
    )


def write_bag_of(scan: Scan, path: Path, count: int) -> dict[str, np.ndarray]:
    """The columns of a bag of so many messages, each of the same scan."""
    from lidarsynth.data.bag_records import Cloud
    from lidarsynth.data.bag_writer import write_bag

    fields = {**dict(zip("xyz", scan.xyz.T, strict=True)), "intensity": np.full(len(scan), 100, np.float32),
              "ring": scan.ring.astype(np.uint16), "object": scan.extra["object"]}  # type: ignore[union-attr]  # fmt: skip
    with write_bag(path) as writer:
        for k in range(count):
            writer.write_cloud("/points", Cloud(10**9 + k, "lidar", 10**9 + k, fields))
    return fields


def is_part_of(real: Scan, whole: Scan) -> np.ndarray:
    """(N,) which points of the whole they are, in order; they are the same bit by bit."""
    order = {row.tobytes(): k for k, row in enumerate(whole.xyz)}
    assert len(order) == len(whole)
    found = np.array([order[row.tobytes()] for row in real.xyz])
    assert 0 < len(found) < len(whole) and np.all(np.diff(found) > 0)
    return found


def test_fields_and_points_survive(place: Path, capsys: pytest.CaptureFixture[str]):
    scan = perfect(SMALL)
    write("sim.pcd", scan)
    main(["realise", "sim.pcd", "--out", "real.pcd", "--model", "model", *WORDS])
    real, sim = read("real.pcd"), read("sim.pcd", intensity="none")
    kept = is_part_of(real, sim)
    assert f"would report {len(real)} of {len(sim)} points" in capsys.readouterr().out
    for name in ("ring", "time", "label"):
        np.testing.assert_array_equal(getattr(real, name), getattr(sim, name)[kept])
    np.testing.assert_array_equal(real.extra["object"], sim.extra["object"][kept])
    assert "new" not in real.extra and real.reflectance.any()
    library = load("model").realise(sim, "own.toml")
    np.testing.assert_array_equal(library.xyz, real.xyz)
    np.testing.assert_array_equal(library.reflectance, real.reflectance)


def test_columns_of_the_scans_own_are_said_in_the_line(place: Path, capsys: pytest.CaptureFixture[str]):
    note = "own in 512 columns, by the scan's own steps"  # and so it is where the sensor is named
    for width, told in ((512, 1), (256, 0)):
        write("sim.pcd", perfect(SMALL.resized(width=width)))
        main(["realise", "sim.pcd", "--out", "real.pcd", "--model", "model", *WORDS])
        assert capsys.readouterr().out.count(f" points; {note}\n") == told
    dense = turn(SENSORS["os1-64"], 2048, jitter=0.0, keep=1.0)
    write("sim.pcd", dense)
    for words in ((), ("--sensor", "os1-64")):
        main(["realise", "sim.pcd", "--out", "real.pcd", "--model", "model", "--no-picture", *words])
        assert f"of {len(dense)} points; os1-64 in 2048 columns, by the scan's own steps\n" in capsys.readouterr().out


def test_columns_are_of_the_whole_turn_though_the_scan_is_a_part_of_it_or_lost_points_or_has_two_beams_a_row():
    sensor = SENSORS["os1-64"]
    whole = turn(sensor, 2048, jitter=0.0, keep=1.0)
    for low, high in ((-180, 0), (-90, 90), (30, 90)):
        angle = np.degrees(np.arctan2(whole.xyz[:, 1], whole.xyz[:, 0]))
        assert fitting(whole[(angle > low) & (angle < high)], sensor, "spherical").width == 2048
    dropped = whole[np.random.default_rng(0).random(len(whole)) < 0.55]  # as CARLA does by itself
    assert fitting(dropped, sensor, "spherical").width == 2048
    two = turn(SENSORS["os1-128"], 1024, jitter=0.0, keep=1.0)
    assert fitting(two, sensor, "spherical") is sensor
    assert fitting(whole[:1], sensor, "spherical") is sensor


def test_axes_and_files_of_simulators(place: Path, capsys: pytest.CaptureFixture[str]):
    """CARLA's left-handed text, AirSim's z down, Isaac's rows with what did not return: the same points stay."""
    scan = perfect(SMALL)
    lines = [f"{x:.9g} {-y:.9g} {z:.9g} 1" for x, y, z in scan.xyz]
    header = ["ply", "format ascii 1.0", f"element vertex {len(lines)}"]
    header += [f"property float32 {name}" for name in ("x", "y", "z", "I")]
    Path("carla.ply").write_text("\n".join([*header, "end_header", *lines, ""]))
    np.save("airsim.npy", scan.xyz * np.array([1, -1, -1], np.float32))
    rows = np.full((2, len(scan) // 2 + 3, 3), np.inf, np.float32)
    rows.reshape(-1, 3)[: len(scan)] = scan.xyz
    np.save("isaac.npy", rows)
    kept = is_part_of(load("model").realise(scan, "own.toml"), scan)
    for name, axes, signs in (
        ("carla.ply", "fru", (1, -1, 1)),
        ("airsim.npy", "frd", (1, -1, -1)),
        ("isaac.npy", "flu", (1, 1, 1)),
    ):
        main(["realise", name, "--out", "real.ply", "--axes", axes, "--model", "model", *WORDS])
        np.testing.assert_array_equal(read("real.ply").xyz, scan.xyz[kept] * np.array(signs, np.float32))
    with pytest.raises(SystemExit):
        main(["realise", "isaac.npy", "--out", "real.ply", "--axes", "fuu", "--model", "model", *WORDS])
    assert "one each of f b, l r and u d, such as flu or fru, found 'fuu'" in capsys.readouterr().err


def test_a_folder_draws_each_scan_anew_and_thins_its_labels(place: Path):
    scan = perfect(SMALL)
    folder = place / "00" / "velodyne"
    folder.mkdir(parents=True)
    (place / "00" / "labels").mkdir()
    words = np.arange(len(scan), dtype=np.uint32) << np.uint32(16) | np.uint32(40)
    for name in ("a", "b"):
        write(folder / f"{name}.bin", scan)
        write_labels(place / "00" / "labels" / f"{name}.label", replace(scan, extra={"raw_label": words}))
    main(["realise", "00/velodyne", "--out", "real", "--format", "bin", "--model", "model", *WORDS])
    kept = []
    for name in ("a", "b"):
        real = read(f"real/{name}.bin")
        kept.append(is_part_of(real, scan))
        np.testing.assert_array_equal(read_words(f"real/{name}.label", len(real)), words[kept[-1]])
    assert not np.array_equal(*kept)
    np.testing.assert_array_equal(is_part_of(load("model").realise(scan, SMALL, seed=1), scan), kept[1])
    main(["realise", "00/velodyne", "--out", "real", "--format", "bin", "--model", "model", *WORDS, "--skip-existing"])
    main(["realise", "00/velodyne/a.bin", "--out", "a.ply", "--model", "model", *WORDS])
    np.testing.assert_array_equal(read("a.ply").extra["raw_label"], words[kept[0]])


def test_labels_that_do_not_fit_are_named(place: Path, capsys: pytest.CaptureFixture[str]):
    write("a.bin", perfect(SMALL))
    Path("a.label").write_bytes(b"1234")
    with pytest.raises(SystemExit):
        main(["realise", "a.bin", "--out", "o.ply", "--model", "model", *WORDS])
    assert "a.label: expected" in capsys.readouterr().err and not Path("o.ply").exists()


def test_bags_keep_their_columns(place: Path):
    pytest.importorskip("rosbags")
    scan = perfect(SMALL)
    fields = write_bag_of(scan, Path("sim.mcap"), 2)
    main(["realise", "sim.mcap", "--out", "real.mcap", "--model", "model", "--sensor", "own.toml"])
    clouds = [item.read() for item in inputs_of([Path("real.mcap")], Reading("none")).stream()]
    assert [cloud.stamp for cloud in clouds] == [10**9, 10**9 + 1]
    for cloud in clouds:
        kept = cloud.given["object"].astype(int)
        assert 0 < len(kept) < len(scan) and cloud.given.keys() == fields.keys()
        for name in ("x", "y", "z", "ring"):
            np.testing.assert_array_equal(cloud.given[name], fields[name][kept])
        assert cloud.given["intensity"].max() > 1 and cloud.given["intensity"].std() > 0


@pytest.mark.parametrize("full", [1, 255, 65535])
def test_the_scale_of_a_message_is_that_which_it_was_read_by(full: int):
    """One point in 2000 is brighter than its scale, half of them did not return, and one has no intensity."""
    xyz = np.random.default_rng(0).normal(0, 10, (4000, 3)).astype(np.float32)
    light = np.random.default_rng(1).random(4000).astype(np.float32) * full
    light = np.ceil(light) if full > 1 else light
    xyz[::2], light[::2], light[1] = 0, 0, np.nan
    light[3] = {1: 1.5, 255: 300}.get(full, full)
    given = {"intensity": light, **dict(zip("xyz", xyz.T, strict=True))}
    scan, _ = scan_from_fields({**given, PLACE: np.arange(1, 4001)})
    back = realised_fields(scan, Loaded(scan, given, 0, full_scale(given)))["intensity"]
    np.testing.assert_allclose(back[2:], light[1::2][2:], rtol=1e-6)
    assert back[0] == 0 and back[1] == full


@pytest.mark.parametrize(("intensity", "full"), [("auto", 255), ("byte", 255), ("uint16", 65535), ("none", 255)])
def test_a_bag_of_a_forced_scale_is_written_in_it(intensity: str, full: float, place: Path):
    """Intensities of 100: of 255, unless someone knows that the sensor counts to 65535."""
    pytest.importorskip("rosbags")
    scan = perfect(SMALL)
    write_bag_of(scan, Path("sim.mcap"), 1)
    words = ["--model", "model", "--sensor", "own.toml", "--intensity", intensity]
    main(["realise", "sim.mcap", "--out", "real.mcap", *words])
    main(["realise", "sim.mcap", "--out", "real", "--no-picture", *words])
    (given,) = [item.read().given for item in inputs_of([Path("real.mcap")], Reading("none")).stream()]
    light = read("real/sim/000000.ply", "unit").reflectance
    assert light.max() > 0
    np.testing.assert_allclose(given["intensity"], light * full, rtol=1e-6)


def test_a_model_that_cannot_is_refused_before_any_work(place: Path, capsys: pytest.CaptureFixture[str]):
    write("sim.pcd", perfect(SMALL))
    for words in (["realise", "sim.pcd", "--out", "o"], ["generate", "--labels", "--out", "o"]):
        with pytest.raises(SystemExit) as stop:
            main([*words, "--model", "kitti-streets"])
        said = capsys.readouterr().err
        assert stop.value.code == 2 and said.count("expected a model that has learned") == 1
    assert not Path("o").exists()


def test_a_scan_of_which_nothing_returns_is_refused():
    scan = perfect(SMALL)[:1]
    real = project(scan, SMALL)
    model = cast(ScanModel, SimpleNamespace(realised=lambda *_: real.keep(np.zeros(real.shape, bool))))
    with pytest.raises(ValueError, match="expected points of which some return, found that none of 1 does"):
        realise_scan(model, scan, SMALL)


def test_labels_of_generated_scans(place: Path):
    main(["generate", "-n", "2", "--labels", "--steps", "1", "--model", "model", "--out", "made", "--no-picture"])
    scan = read("made/000001.ply", intensity="unit")
    assert scan.label is not None and scan.label.min() >= 1
    raw = read_words("made/000001.label", len(scan))
    assert set(raw.tolist()) <= {10, 11, 15, 18, 13, 30, 31, 32, 40, 44, 48, 49, 50, 51, 70, 71, 72, 80, 81}
    from lidarsynth.lidar.semantic_kitti import CLASS_OF_RAW

    np.testing.assert_array_equal(CLASS_OF_RAW[raw], scan.label)


def test_boxes_of_generated_scans(place: Path):
    words = ["generate", "-n", "2", "--steps", "1", "--model", "model", "--no-picture"]
    main([*words, "--labels", "--out", "made"])
    main([*words, "--boxes", "--out", "boxed"])
    assert json.loads(Path("boxed/generate.json").read_text())["boxes"] is True
    for name in ("000000", "000001"):
        scan, plain = (read(f"{folder}/{name}.ply", intensity="unit") for folder in ("boxed", "made"))
        np.testing.assert_array_equal(scan.xyz, plain.xyz)  # the same scans
        assert "instance" not in plain.extra
        told = json.loads(Path(f"boxed/{name}.json").read_text())
        numbers = np.arange(1, 1 + len(told["boxes"]))
        assert told["points"] == len(scan) and [box["instance"] for box in told["boxes"]] == numbers.tolist()
        counts = [(scan.extra["instance"] == number).sum() for number in numbers]
        assert [box["points"] for box in told["boxes"]] == counts and all(counts)
        raw = read_words(f"boxed/{name}.label", len(scan))
        np.testing.assert_array_equal(raw >> 16, scan.extra["instance"])
        np.testing.assert_array_equal(raw & 0xFFFF, read_words(f"made/{name}.label", len(plain)))
    Path("boxed/000001.json").unlink()
    main([*words, "--boxes", "--out", "boxed"])
    assert Path("boxed/000001.json").exists()
    with pytest.raises(SystemExit, match="2"):
        main([*words, "--boxes", "--out", "made"])  # begun without


def test_a_tilt_of_which_boxes_lack_points_is_told(place: Path, capsys: pytest.CaptureFixture[str]):
    for tilt in (3, 20):
        Path(f"own{tilt}.toml").write_text(f"beams = 16\ntop = 15.0\nbottom = -15.0\nwidth = 128\ntilt = [0, {tilt}]\n")
        main(["generate", "-n", "1", "--steps", "1", "--model", "model", "--no-picture", "--boxes", "--sensor",
              f"own{tilt}.toml", "--out", f"tilted{tilt}"])  # fmt: skip
        assert (f"own{tilt} is tilted by {tilt} degrees, and boxes" in capsys.readouterr().out) is (tilt == 20)
