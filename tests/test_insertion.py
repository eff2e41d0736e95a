"""Road users put into recorded scans: where they stand, what they hide, and that all else stays bit by bit."""

import importlib
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import REPO_ROOT
from test_realise import write_bag_of

import lidarsynth as ls
from lidarsynth.cli.main import main
from lidarsynth.files.formats import read, write, write_labels
from lidarsynth.files.labels import read_words
from lidarsynth.lidar.frame import parse_transform, transformed
from lidarsynth.lidar.lost_rays import lost_rays
from lidarsynth.lidar.removal import TRAFFIC
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER, CLASS_OF_RAW
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.streets.actors import KINDS
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.streets.wanted import Wanted, wanted
from lidarsynth.systems.insertion import Inserted
from lidarsynth.systems.scan_model import ScanModel

CAR, PERSON, ROAD, BUILDING = (CLASS_NUMBER[word] for word in ("car", "person", "road", "building"))
FLAT = Sensor("flat", tuple(np.linspace(8, -20, 29)), 720, max_range=100.0, mount=1.8)
TOML = f"elevations = {list(FLAT.elevations)}\nwidth = 720\nmax_range = 100.0\nmount = 1.8\n"


@pytest.fixture(scope="module")
def model() -> ScanModel:
    return ls.load("default")


@pytest.fixture(scope="module")
def street() -> Scan:
    """A street without traffic, with its labels."""
    return SyntheticStreets(311, 64, "hdl-32e", TRAFFIC)[5]


def flat_scan(sensor: Sensor = FLAT, wall: float | None = None, reflectance: float = 0.3) -> Scan:
    """Flat road all around, and a wall across it, so many metres ahead, 3 m high; rays to the sky do not return."""
    rays = sensor.directions().astype(np.float64)
    x, _, z = np.moveaxis(rays, -1, 0)
    metres = np.where(z < -0.01, -sensor.mount / np.minimum(z, -0.01), np.inf)
    label = np.full(metres.shape, ROAD)
    if wall is not None:
        there = np.where(x > 0.05, wall / np.maximum(x, 0.05), np.inf)
        up = sensor.mount + np.where(there < 60, there, 60) * z
        hit = (there < metres) & (up < 3)
        metres, label = np.where(hit, there, metres), np.where(hit, BUILDING, label)
    seen = metres < 60
    metres = np.where(seen, metres, 0)
    row = np.broadcast_to(np.arange(sensor.height)[:, None], seen.shape)
    xyz = (rays * metres[..., None])[seen].astype(np.float32)
    light = np.full(seen.sum(), reflectance, np.float32)
    column = np.broadcast_to(np.arange(sensor.width) / sensor.width / 10, seen.shape)
    return Scan(xyz, light, row[seen].astype(np.int64), column[seen], label[seen].astype(np.int64))


def unchanged(found: Scan, scan: Scan) -> np.ndarray:
    """(M,) numbers of the points of a scan that are left, in their order; all that they have is as it was."""
    old = found[found.extra["new"] == 0]
    place = {row.tobytes(): k for k, row in enumerate(scan.xyz)}
    assert len(place) == len(scan)
    kept = np.array([place[row.tobytes()] for row in old.xyz])
    assert 0 < len(kept) < len(scan) and (np.diff(kept) > 0).all()
    for name in ("reflectance", "ring", "time"):
        if (value := getattr(scan, name)) is not None:
            np.testing.assert_array_equal(getattr(old, name), value[kept])
    if scan.label is not None:
        np.testing.assert_array_equal(old.label, scan.label[kept])
    return kept


@pytest.mark.parametrize(
    ("said", "asked"),
    [
        ("car", [Wanted("car")]),
        ("car:2", [Wanted("car")] * 2),
        (" person , car@8/-3", [Wanted("car", (8, -3)), Wanted("person")]),
        (["bus@-20/1.5/90", "van"], [Wanted("bus", (-20, 1.5), math.pi / 2), Wanted("van")]),
    ],
)
def test_things_are_asked_for_in_words(said: str | list[str], asked: list[Wanted]):
    assert wanted(said) == asked


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ("", "with a kind of car, van, .*, found ''"),
        ("cow", "found 'cow'"),
        ("car:0", "a count of 1 to 100, found 'car:0'"),
        ("car:x", "found 'car:x'"),
        ("car:", "found 'car:'"),
        ("car@1", "a place of two numbers of metres and, maybe, degrees, found 'car@1'"),
        ("car@1/2/3/4", "found 'car@1/2/3/4'"),
        ("car@nan/2", "found 'car@nan/2'"),
        ("car:60,person:60", "expected 1 to 100 things to insert, found 120"),
        ([], "expected 1 to 100 things to insert, found 0"),
    ],
)
def test_other_words_are_refused(said: str | list[str], expected: str):
    with pytest.raises(ValueError, match=expected):
        wanted(said)


@pytest.mark.parametrize("word", ["hdl-64e-kitti", "vlp-16"])
def test_things_are_as_if_they_had_been_there(word: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(REPO_ROOT / "benchmarks"))
    benchmark = importlib.import_module("insertion")
    columns = max(2083, ls.get_sensor(word).width)
    ((found, cast, count),) = benchmark.pairs(word, 1, "car:3,person:2")
    mine, theirs, both, near, more, less, rest = benchmark.compared(found, cast, columns)
    assert count >= 4 and both > 300
    assert abs(mine - theirs) < 0.06 * theirs and both > 0.85 * theirs and near > 0.97 * both
    assert more < 1e-4 * rest and less < 2e-3 * rest  # of what is seen through panes


def test_all_else_stays_bit_by_bit(model: ScanModel, street: Scan):
    count = len(street)
    scan = replace(street, extra={"ambient": np.arange(count, dtype=np.float32), "new": np.full(count, 7)})
    found, boxes = model.insert(scan, "car:2,person:2", seed=1)
    kept = unchanged(found, scan)
    old, new = found.extra["new"] == 0, found.extra["new"] == 1
    np.testing.assert_array_equal(found.extra["ambient"][old], kept)
    assert (found.extra["ambient"][new] == 0).all() and (found.extra["file_new"][old] == 7).all()
    assert (np.diff(found.ring) >= 0).all(), "new points stand in their rings"
    assert {box.kind for box in boxes} <= {"car", "person"} and len(boxes) >= 3
    for box in boxes:
        own = found.extra["instance"] == box.instance
        assert own.sum() == box.points >= 8 and new[own].all()
        assert (found.label[own] == CLASS_NUMBER[box.kind]).all() and box.holds(found.xyz[own]).mean() > 0.98
    assert (found.extra["instance"][old] == 0).all()


def test_a_seed_gives_the_same_again_and_another_something_else(model: ScanModel, street: Scan):
    one, again, other = (model.insert(street, "car,person", seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.scan.xyz, again.scan.xyz)
    assert one.boxes == again.boxes != other.boxes


def test_a_named_place_is_where_it_stands(model: ScanModel):
    scan = flat_scan()
    found, (box,) = model.insert(scan, "car@12/-3/30", sensor=FLAT)
    kept = unchanged(found, scan)
    assert np.hypot(box.centre[0] - 12, box.centre[1] + 3) < 0.3 and math.isclose(box.yaw, math.radians(30))
    assert abs(box.centre[2] - box.size[2] / 2 + 1.8) < 0.1, "it stands on the ground"
    gone = np.setdiff1d(np.arange(len(scan)), kept)
    far, own = np.linalg.norm(scan.xyz[gone], axis=1), found.xyz[found.extra["instance"] == 1]
    assert far.min() > np.linalg.norm(own, axis=1).min() and len(gone) > 0.5 * len(own)


@pytest.mark.filterwarnings("ignore:expected points of flat")
def test_rays_that_had_met_nothing_meet_what_is_put_there(model: ScanModel):
    low = replace(FLAT, mount=0.6)
    scan = flat_scan(low)
    found = model.insert(scan, "bus@10/0/0", sensor=low).scan
    own = found.xyz[found.extra["instance"] == 1]
    up = np.degrees(np.arctan2(own[:, 2], np.hypot(own[:, 0], own[:, 1])))
    assert np.degrees(np.arctan2(scan.xyz[:, 2], np.hypot(*scan.xyz.T[:2]))).max() < 0
    assert {-2, 0, 3, 6} <= {round(angle) for angle in up} and own[:, 2].max() > 0.5
    assert (np.diff(found.ring) >= 0).all()
    row = np.array([low.elevations[k] for k in found.ring[found.extra["instance"] == 1]])
    np.testing.assert_allclose(np.degrees(np.arctan2(own[:, 2], np.hypot(*own.T[:2]))), row, atol=0.2)
    of = found.time[found.extra["instance"] == 1]
    column = (np.pi - np.arctan2(own[:, 1], own[:, 0])) / (2 * np.pi) / 10
    np.testing.assert_allclose(of, column, atol=0.1 / FLAT.width * 2)


def test_what_stands_before_it_hides_it(model: ScanModel):
    _, (whole,) = model.insert(flat_scan(), "car@14/0/90", sensor=FLAT)
    wall = flat_scan()
    ahead = (wall.xyz[:, 0] > 8) & (np.abs(wall.xyz[:, 1]) < 0.5 * wall.xyz[:, 0] / 8)
    wall.xyz[ahead] *= (8 / wall.xyz[ahead, 0])[:, None]  # a post, a metre wide, 8 m ahead
    half, (box,) = model.insert(wall, "car@14/0/90", sensor=FLAT)
    assert whole.occlusion < 0.02 and 0.2 < box.occlusion < 0.7 and box.points < 0.8 * whole.points
    azimuth = np.arctan2(*half.xyz[half.extra["instance"] == 1].T[[1, 0]])
    assert np.abs(azimuth).min() > np.arctan(0.4 / 8)


def test_a_place_that_another_thing_hides_is_refused(model: ScanModel):
    with pytest.raises(ValueError, match="that the scan's rays reach, found 14 m ahead, 0 m to the left"):
        model.insert(flat_scan(), "truck@9/0/90,person@14/0", sensor=FLAT)


@pytest.mark.parametrize(
    ("things", "expected"),
    [
        ("car@25/0", "expected a free place for car, found [0-9]+ measured points in it 25 m ahead, 0 m to the left"),
        ("car@1/1", "expected a free place for car, 3 m and more away, found the sensor or another thing 1 m ahead"),
        ("car@10/5/0,van@11/5/0", "found the sensor or another thing 11 m ahead"),
        ("car@50/0", "expected a place for car on ground that the scan shows, found none 50 m ahead"),
        ("bus@0/0", "the sensor or another thing"),
    ],
)
def test_a_place_that_is_not_free_is_refused(model: ScanModel, things: str, expected: str):
    with pytest.raises(ValueError, match=expected):
        model.insert(flat_scan(wall=25), things, sensor=FLAT)


def test_who_finds_no_room_is_left_out_and_nobody_is_refused(model: ScanModel):
    scan = flat_scan()
    near = scan[np.hypot(*scan.xyz.T[:2]) < 7]
    found = model.insert(near, "person:100", sensor=FLAT)
    assert 0 < len(found.boxes) < 100
    grass = replace(scan, label=np.full(len(scan), CLASS_NUMBER["terrain"]))
    with pytest.raises(ValueError, match="expected a scan that shows free ground for bus, car, found none where"):
        model.insert(grass, "bus,car", sensor=FLAT)
    assert model.insert(grass, "person", sensor=FLAT).boxes


@pytest.mark.parametrize("kind", KINDS)
def test_all_kinds_have_their_class_and_size(model: ScanModel, kind: str):
    found, (box,) = model.insert(flat_scan(), f"{kind}@12/2/90", sensor=FLAT)
    own = found.extra["instance"] == box.instance
    assert set(np.unique(found.label[own])) == {CLASS_OF_RAW[KINDS[kind].raw]} and own.sum() == box.points
    assert box.holds(found.xyz[own]).all() and (np.asarray(box.size) > 0.3).all()


@pytest.mark.filterwarnings("ignore:expected points of flat")
def test_ground_that_rises_is_stood_on(model: ScanModel):
    scan = flat_scan()
    slope = replace(scan, xyz=(scan.xyz + scan.xyz[:, :1] * [0, 0, 0.08]).astype(np.float32))
    found, (box,) = model.insert(slope, "car@12/0/0", sensor=FLAT)
    own = found.xyz[found.extra["instance"] == 1]
    feet = own[own[:, 2] < -1.8 + 0.08 * own[:, 0] + 0.4]
    assert len(feet) > 20 and (feet[:, 2] > -1.8 + 0.08 * feet[:, 0] - 0.05).all()
    assert abs(box.centre[2] - (-1.8 + 0.08 * 12 + 0.75)) < 0.3 and box.holds(own).all()


def test_reflectance_is_in_the_terms_of_the_scan(model: ScanModel, street: Scan):
    dark = replace(street, reflectance=np.float32(0.2) * street.reflectance)
    bright, dim, none = (
        model.insert(scan, "car:3", seed=5).scan for scan in (street, dark, replace(street, reflectance=0 * dark.label))
    )
    new = bright.extra["new"] > 0
    ratio = dim.reflectance[new].mean() / bright.reflectance[new].mean()
    assert 0.1 < ratio < 0.4 and not none.reflectance.any()


def test_what_is_inserted_fades_with_distance_as_the_scan_does(model: ScanModel, street: Scan):
    away = np.linalg.norm(street.xyz, axis=1)
    dark = replace(street, reflectance=(street.reflectance / np.maximum(away, 1)).astype(np.float32))
    bright, faded = (model.insert(scan, "car:6", seed=5).scan for scan in (street, dark))
    new = bright.extra["new"] > 0
    away, light = np.linalg.norm(bright.xyz[new], axis=1), bright.reflectance[new]
    parts = [part & (light > 0.05) for part in (away < 10, away > 20)]
    shares = [np.median(faded.reflectance[new][part] / light[part]) for part in parts]
    assert shares[1] < 0.6 * shares[0] and min(part.sum() for part in parts) > 20
    assert shares[1] < 0.6 * shares[0]


def test_lost_rays_are_where_rings_have_gaps():
    azimuth = np.radians(np.arange(0.25, 360, 0.5))
    kept = np.ones((2, 720), bool)
    kept[0, 100:103] = kept[1, 300] = False
    kept[:, 500:520] = False  # nothing was looked at there
    flat = [np.stack([np.cos(azimuth), np.sin(azimuth), np.full(720, z)], 1)[on] * 9
            for z, on in zip((0.0, -0.2), kept, strict=True)]  # fmt: skip
    sensor = Sensor("two", (0.0, -11.3), 720)
    row = np.repeat([0, 1], kept.sum(1))
    lost = lost_rays(Scan(np.concatenate(flat).astype(np.float32)), sensor, row)
    assert lost.row.tolist() == [0, 0, 0, 1]
    degrees = np.degrees(lost.azimuth) % 360
    np.testing.assert_allclose(degrees, [50.25, 50.75, 51.25, 150.25], atol=0.01)
    np.testing.assert_allclose(lost.share, [0.25, 0.5, 0.75, 0.5])
    assert (lost.after - lost.before).tolist() == [1] * 4 and lost.before.tolist()[:3] == [99] * 3


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a sensor and a scan of it."""
    monkeypatch.chdir(tmp_path)
    Path("own.toml").write_text(TOML)
    write("scan.ply", flat_scan())
    return tmp_path


WORDS = ("--sensor", "own.toml", "--no-picture")


def test_files_get_labels_and_boxes(place: Path, capsys: pytest.CaptureFixture[str]):
    scan = flat_scan()
    write("a.bin", scan)
    words = np.full(len(scan), 40, "<u4")
    words[5] |= 9 << 16
    Path("a.label").write_bytes(words.tobytes())
    main(["insert", "a.bin", "--add", "car@10/3,person:2", "--out", "new/b.bin", *WORDS])
    said = capsys.readouterr().out
    assert "inserted 1 car, 2 person: " in said and ".new, .confidence, .label, .json beside it" in said
    found, told = read("new/b.bin"), json.loads(Path("new/b.json").read_text())
    new = np.fromfile("new/b.new", np.uint8)
    raw = read_words("new/b.label", len(found))
    assert told["points"] == len(found) and told["boxes"][0]["kind"] == "car"
    assert [box["instance"] for box in told["boxes"]] == [10, 11, 12], "9 is taken"
    assert set(raw[new == 0]) == {40, 40 | 9 << 16}
    assert set(raw[new == 1]) == {10 | 10 << 16, 30 | 11 << 16, 30 | 12 << 16}
    main(["info", "new/b.json"])
    assert f"boxes of one scan: 3, of {len(found)} points" in capsys.readouterr().out


def test_the_command_line_gives_what_the_library_gives(place: Path, model: ScanModel):
    main(["insert", "scan.ply", "--add", "car:2", "--seed", "4", "--out", "b.ply", *WORDS])
    one = read("b.ply")
    two = model.insert(read("scan.ply"), "car:2", seed=4, sensor=ls.read_sensor("own.toml"))
    np.testing.assert_array_equal(one.xyz, two.scan.xyz)
    np.testing.assert_array_equal(one.extra["instance"], two.scan.extra["instance"])
    assert json.loads(Path("b.json").read_text())["boxes"] == [box.record() for box in two.boxes]
    write("tacs.ply", read("scan.ply"))
    main(["insert", "scan.ply", "tacs.ply", "--add", "car:2", "--seed", "3", "--out", "many", *WORDS])
    files = sorted(Path("many").glob("*.ply"))
    assert len(files) == 2
    first, second = (json.loads(file.with_suffix(".json").read_text())["boxes"] for file in files)
    assert second == [box.record() for box in two.boxes] != first, "of scan i by seed + i"


def test_boxes_are_in_the_frame_of_the_file(place: Path):
    text = "1:2:0.5:0:0:90"
    matrix = parse_transform(text)
    scan = flat_scan()
    write("moved.ply", replace(scan, xyz=transformed(scan.xyz, np.linalg.inv(matrix)).astype(np.float32)))
    main(["insert", "moved.ply", "--add", "car@10/3/20", "--transform", text, "--out", "b.ply", *WORDS])
    found, (told,) = read("b.ply"), json.loads(Path("b.json").read_text())["boxes"]
    own = found.xyz[found.extra["instance"] == 1]
    x, y, _ = (own - told["centre"]).T
    c, s = np.cos(told["yaw"]), np.sin(told["yaw"])
    assert (np.abs(c * x + s * y) < told["size"][0] / 2 + 0.01).all()
    assert (np.abs(c * y - s * x) < told["size"][1] / 2 + 0.01).all()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("scan.ply --add cow --out b.ply", "with a kind of car"),
        ("scan.ply --add car@1/1 --out b.ply", "a free place for car"),
        ("scan.ply --add car --out taken.ply", "taken.ply: expected a name beside which taken.json may be written"),
        ("scan.ply --add car --seed -1 --out b.ply", "seed"),
    ],
)
def test_what_cannot_be_done_is_one_line(place: Path, capsys: pytest.CaptureFixture[str], words: str, expected: str):
    Path("taken.json").write_text('{"lidar": 1}')
    with pytest.raises(SystemExit) as stopped:
        main(["insert", *words.split(), *WORDS])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and expected in error and "Traceback" not in error
    assert Path("taken.json").read_text() == '{"lidar": 1}' and not Path("b.ply").exists()
    assert not Path("taken.ply").exists()


def test_a_bag_holds_no_boxes_but_its_messages_become_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                            capsys: pytest.CaptureFixture[str]):  # fmt: skip
    pytest.importorskip("mcap")
    monkeypatch.chdir(tmp_path)
    Path("own.toml").write_text(TOML)
    scan = flat_scan()
    write_bag_of(replace(scan, extra={"object": np.arange(len(scan))}), Path("a.mcap"), 2)
    with pytest.raises(SystemExit) as stopped:
        main(["insert", "a.mcap", "--add", "car", "--out", "b.mcap", *WORDS])
    assert stopped.value.code == 2 and "expected a file or folder for boxes, found a bag" in capsys.readouterr().err
    assert not Path("b.mcap").exists()
    main(["insert", "a.mcap", "--add", "person@8/2", "--out", "b", *WORDS])
    files = sorted(Path("b").rglob("*.ply"))
    assert len(files) == 2 and all(file.with_suffix(".json").is_file() for file in files)


def test_labels_of_other_words_are_refused(model: ScanModel):
    scan = replace(flat_scan(), label=None, extra={"raw_label": np.full(len(flat_scan()), 7777, np.uint32)})
    with pytest.raises(ValueError, match="expected labels of SemanticKITTI's raw ids"):
        model.insert(scan, "car", sensor=FLAT)


def test_a_model_without_classes_takes_the_labels_of_the_scan(street: Scan):
    bilinear = ls.load("bilinear")
    found = bilinear.insert(street, "car", seed=1)
    assert isinstance(found, Inserted) and found.boxes
    with pytest.raises(ValueError, match="expected a model that has learned classes"):
        bilinear.insert(replace(street, label=None), "car", seed=1)


def test_a_scan_without_labels_is_named_by_the_network(model: ScanModel, street: Scan):
    found, boxes = model.insert(replace(street, label=None), "car:2", seed=1)
    new = found.extra["new"] > 0
    assert boxes and (found.label[~new] == 0).all() and (found.label[new] == CAR).all()


def test_labels_beside_a_bin_are_those_of_its_points(place: Path):
    scan = flat_scan()
    for folder in ("velodyne", "labels"):
        Path(folder).mkdir()
    write("velodyne/a.bin", scan)
    write_labels(Path("labels/a.label"), scan)
    main(["insert", "velodyne/a.bin", "--add", "van@9/3/10", "--out", "out/velodyne/a.bin", *WORDS])
    found = read("out/velodyne/a.bin")
    raw = read_words("out/labels/a.label", len(found))
    assert ((raw & 0xFFFF) == 10).sum() == json.loads(Path("out/velodyne/a.json").read_text())["boxes"][0]["points"]
