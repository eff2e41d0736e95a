"""Scans without cars and people: what goes, what stays bit by bit, and what is filled in behind."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from test_cascade import SMALL, perfect
from test_realise import save_model_and_sensor, write_bag_of

from lidarsynth.cli.main import main
from lidarsynth.files.formats import read, write
from lidarsynth.lidar.frame import parse_transform, transformed
from lidarsynth.lidar.removal import TRAFFIC, hidden_behind, in_the_way, in_whole_pieces, in_words, removable
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems import removal
from lidarsynth.systems.interpolation.model import interpolated
from lidarsynth.weights.load import load

CAR, PERSON, ROAD, BUILDING = (CLASS_NUMBER[word] for word in ("car", "person", "road", "building"))
THINGS = [CLASS_NUMBER[word] for word in TRAFFIC]
WALL = Sensor("wall", tuple(np.linspace(4, -10, 15)), 64, max_range=100.0)  # a degree from beam to beam
WALL_SHAPE = WALL.height, WALL.width


def image_of(metres: np.ndarray, label: np.ndarray | None = None) -> RangeImage:
    metres = metres.astype(np.float32)
    return RangeImage(metres, (metres > 0) * np.float32(0.5), metres > 0, WALL, label)


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ("car,person", ("car", "person")),
        (" person, car,car ", ("car", "person")),
        (["person"], ("person",)),
        ("traffic", TRAFFIC),
        (("pole", "traffic"), (*TRAFFIC, "pole")),
    ],
)
def test_classes_are_words_or_all_of_traffic(said: str | list[str], words: tuple[str, ...]):
    assert removable(said) == words


@pytest.mark.parametrize(
    ("said", "found"), [("cra", "'cra'"), ("", "''"), ("car,", "''"), ([], "none"), ("unlabeled", "'unlabeled'")]
)
def test_other_words_are_refused(said: str | list[str], found: str):
    with pytest.raises(ValueError, match=f"expected classes to take away of traffic, car, .*, found {found}"):
        removable(said)


def test_all_of_traffic_is_one_word():
    assert in_words(removable("traffic")) == "traffic"
    assert in_words(removable("person,car")) == "car, person"


def test_lost_rays_of_panes_and_roof_are_hidden_too():
    metres, gone = np.full(WALL_SHAPE, 50.0), np.zeros(WALL_SHAPE, bool)
    gone[6:11, 18:23] = True
    gone[7:9, 20] = False
    metres[gone] = 20.0
    metres[7, 20] = 0  # a pane; what is seen through it, below, stays
    metres[2:6, 20] = 0  # the roof: 0.6 m at 20 m is less than two degrees
    metres[7, 25] = 0  # beside the car
    hidden = hidden_behind(image_of(metres), gone)
    assert np.argwhere(hidden & ~gone).tolist() == [[5, 20], [7, 20]]
    near = hidden_behind(image_of(np.where(gone, 8.0, metres)), gone)  # there it is more than four
    assert np.argwhere(near & ~hidden).tolist() == [[2, 20], [3, 20], [4, 20]]
    assert not hidden_behind(image_of(metres), np.zeros(WALL_SHAPE, bool)).any()


def test_what_lies_between_two_things_stays_told():
    metres, gone = np.full(WALL_SHAPE, 50.0), np.zeros(WALL_SHAPE, bool)
    metres[4, 20], metres[9, 20] = 40.0, 10.0
    gone[[4, 9], 20] = True
    metres[5, 20] = 0  # lost between a far car and a near one, of neither
    metres[7, 20] = 0  # the near one's roof
    assert np.argwhere(hidden_behind(image_of(metres), gone)).tolist() == [[4, 20], [7, 20], [9, 20]]


def test_things_go_whole_or_not_at_all():
    metres, label = np.full(WALL_SHAPE, 30.0), np.full(WALL_SHAPE, ROAD)
    metres[4:8, 10:20], label[4:8, 10:20] = 10.0, CAR
    label[4:6, 10:14] = BUILDING  # 8 of 40 pixels of a car, named wrongly
    metres[4:8, 40:50], label[4:8, 40:50] = 10.0, BUILDING
    label[4, 40:44] = CAR  # 4 of 40 of a house
    metres[10:12, 30:34], label[10:12, 30:34] = 5.0, ROAD
    label[10, 30:32] = CAR  # ground does not go with a car on it
    image = image_of(metres, label)
    whole = in_whole_pieces(image, (label == CAR) & image.mask)
    expected = np.zeros(WALL_SHAPE, bool)
    expected[4:8, 10:20] = expected[10, 30:32] = True
    np.testing.assert_array_equal(whole, expected)
    none = np.zeros(WALL_SHAPE, bool)
    assert not in_whole_pieces(image, none).any()
    assert not in_whole_pieces(image_of(metres, np.full(WALL_SHAPE, ROAD)), none).any()  # where nothing stands


def test_nothing_stands_before_what_was_hit():
    metres, gone = np.full(WALL_SHAPE, 20.0), np.ones(WALL_SHAPE, bool)
    gone[:, 40:] = False
    filled = image_of(np.where(np.arange(64) % 2, 19.5, 19.0) * np.ones((15, 1)))
    nearer = in_the_way(filled, image_of(metres), gone)
    assert nearer[:, :40:2].all() and not nearer[:, 1:40:2].any() and not nearer[:, 40:].any()


@pytest.fixture(scope="module")
def pairs() -> list[tuple[RangeImage, RangeImage]]:
    """Two streets of an OS1-64, as they are, and without traffic."""
    streets = [SyntheticStreets(8113, 100, "os1-64", words) for words in ((), TRAFFIC)]
    return [(streets[0].image(number), streets[1].image(number)) for number in (3, 35)]


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def errors(pairs: list[tuple[RangeImage, RangeImage]], filled: list[RangeImage]) -> float:
    """Mean error in metres, no return being 0, of rays that end on traffic."""
    total = [
        np.abs(new.range * new.mask - truth.range * truth.mask)[np.isin(seen.label, THINGS)]
        for (seen, truth), new in zip(pairs, filled, strict=True)
    ]
    return float(np.concatenate(total).mean())


def test_streets_without_traffic_are_nearer_to_such_streets_than_interpolation_is(
    pairs: list[tuple[RangeImage, RangeImage]],
):
    model = load("default")
    filled = [model.complete(seen, without="traffic") for seen, _ in pairs]
    things = [np.isin(seen.label, THINGS) for seen, _ in pairs]
    assert min(thing.sum() for thing in things) > 1000
    interpolation = [interpolated(seen.keep(~t), ~t, "bilinear") for (seen, _), t in zip(pairs, things, strict=True)]
    assert errors(pairs, filled) < 0.6 * errors(pairs, interpolation)
    assert errors(pairs, filled) < 0.6 * errors(pairs, [seen for seen, _ in pairs])
    for (seen, _), thing, new in zip(pairs, things, filled, strict=True):
        stays = seen.mask & ~thing
        np.testing.assert_array_equal(new.range[stays], seen.range[stays])
        assert new.new is not None and not new.new[stays].any() and new.new[thing & new.mask].all()
        lost = ~seen.mask & ~hidden_behind(seen, thing)
        assert not new.mask[lost].any()  # nothing else is filled
        free = thing & new.mask & (new.range < 0.97 * seen.range - 0.3)
        assert not free.any()


def test_points_of_a_scan_stay_bit_by_bit_but_those_taken_away(pairs: list[tuple[RangeImage, RangeImage]]):
    seen, _ = pairs[0]
    scan = seen.to_scan()
    scan = replace(scan, extra={"ambient": np.arange(len(scan), dtype=np.float32)})
    new = load("default").complete(scan, without=("car", "truck")).to_scan()
    stays = ~np.isin(scan.label, [CAR, CLASS_NUMBER["truck"]])
    measured = new[new.extra["new"] == 0]
    order = np.argsort(measured.extra["ambient"])
    assert not stays.all() and len(measured) == np.count_nonzero(stays)
    for name in ("xyz", "reflectance", "label"):
        np.testing.assert_array_equal(getattr(measured, name)[order], getattr(scan, name)[stays])
    np.testing.assert_array_equal(measured.extra["ambient"][order], scan.extra["ambient"][stays])
    assert 0 < np.count_nonzero(new.extra["new"]) <= 2 * np.count_nonzero(~stays)


def test_without_labels_the_model_says_what_goes(pairs: list[tuple[RangeImage, RangeImage]]):
    model = load("default").into("os1-64")
    for seen, _ in pairs:
        thing, bare = np.isin(seen.label, THINGS), replace(seen, label=None)
        image = model.complete(bare, without="traffic")
        points = model.complete(bare.to_scan(), without="traffic")
        for new in (image, points):
            assert new.new is not None
            gone = seen.mask & (new.new | ~new.mask)
            assert gone[thing].mean() > 0.75 and gone[seen.mask & ~thing].mean() < 0.03
        np.testing.assert_array_equal(image.mask, points.mask)


def test_known_rays_are_told_and_all_others_filled(pairs: list[tuple[RangeImage, RangeImage]]):
    seen, _ = pairs[0]
    known = np.tile((np.arange(seen.shape[0]) % 2 == 0)[:, None], (1, seen.shape[1]))
    new = load("default").complete(seen, known, without="car")
    hidden = hidden_behind(seen, seen.label == CAR)
    told = known & ~hidden
    np.testing.assert_array_equal(new.range[told], (seen.range * seen.mask)[told])
    assert new.mask[~known & seen.mask & ~hidden].mean() > 0.9


def test_a_scan_without_such_points_comes_back_as_it_is(pairs: list[tuple[RangeImage, RangeImage]]):
    _, empty = pairs[0]
    scan = empty.to_scan()
    new = load("default").complete(scan, without="traffic").to_scan()
    assert len(new) == len(scan) and not new.extra["new"].any()
    assert {tuple(point) for point in new.xyz.tolist()} == {tuple(point) for point in scan.xyz.tolist()}


def test_a_scan_of_nothing_else_is_refused():
    sensor = replace(SMALL, min_range=0.5)
    image = SyntheticStreets(1, 4, sensor).image(0)
    all_cars = replace(image, label=np.where(image.mask, CAR, 0))
    for given in (all_cars, all_cars.to_scan()):
        with pytest.raises(ValueError, match="found none of"):
            load("default").into(sensor).complete(given, without="car")


def test_models_without_classes_ask_for_labels():
    model = load("bilinear").into("vlp-16")
    image = SyntheticStreets(1, 4, "vlp-16").image(0)
    with pytest.raises(ValueError, match="expected a model that has learned classes, such as default, found"):
        model.complete(replace(image, label=None), without="car")
    assert isinstance(model.complete(image, without="car"), RangeImage)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a model, a sensor and a labelled scan of it."""
    monkeypatch.chdir(tmp_path)
    save_model_and_sensor()
    write("scan.ply", labelled())
    return tmp_path


def labelled() -> Scan:
    scan = perfect(SMALL)
    return replace(scan, label=np.where(np.arange(len(scan)) % 97 < 9, CAR, BUILDING))


WORDS = ("--model", "model", "--sensor", "own.toml", "--no-picture")


def test_the_verb_takes_away_and_says_how_much_and_who_said_so(place: Path, capsys: pytest.CaptureFixture[str]):
    cars = np.count_nonzero(labelled().label == CAR)
    words = ["--without", "car,person", "--model", "model", "--sensor", "own.toml"]
    main(["complete", "scan.ply", "--out", "a.ply", *words])
    count = len(labelled())
    assert f"took away {cars} of {count} points, car, person as its labels name them" in capsys.readouterr().out
    after = read("a.ply")
    assert np.count_nonzero(after.extra["new"] == 0) == count - cars and Path("a.png").stat().st_size > 1000
    write("bare.ply", replace(labelled(), label=None))
    main(["complete", "bare.ply", "--without", "traffic", "--out", "b.ply", *WORDS])
    assert "points, traffic as model names them" in capsys.readouterr().out


def test_what_was_filled_in_before_is_counted_where_it_goes(place: Path, capsys: pytest.CaptureFixture[str],
                                                            monkeypatch: pytest.MonkeyPatch):  # fmt: skip
    scan = labelled()
    new = np.arange(len(scan)) % 2
    write("again.ply", replace(scan, extra={"new": new.astype(np.uint8)}))
    cars = np.count_nonzero(scan.label == CAR)
    main(["complete", "again.ply", "--without", "car", "--out", "a.ply", *WORDS])
    assert f"took away {cars} of {len(scan)} points, car as its labels name them" in capsys.readouterr().out
    write("again.ply", replace(scan, label=None, extra={"new": new.astype(np.uint8)}))
    monkeypatch.setattr(removal, "_going", lambda model, scan, gone: np.arange(len(scan)) % 97 < 9)
    main(["complete", "again.ply", "--without", "car", "--out", "b.ply", *WORDS])
    told = capsys.readouterr().out.split("took away ")[1].split()
    assert cars - 20 < int(told[0]) <= cars, "but for those that were filled in again where they were"


def test_labels_beside_a_bin_are_its_own(place: Path, capsys: pytest.CaptureFixture[str]):
    scan = labelled()
    write("scan.bin", replace(scan, ring=None))
    main(["complete", "scan.bin", "--without", "car", "--out", "new/a.bin", *WORDS])
    gone = np.count_nonzero(scan.label == CAR)
    assert f"took away {gone} of {len(scan)} points, car as its labels name them" in capsys.readouterr().out
    left = read("new/a.bin", labels="new/a.label")
    assert left.label is not None and np.count_nonzero(left.label == BUILDING) == len(scan) - gone
    assert not (left.label == CAR).any()
    Path("scan.label").write_bytes(np.full(len(scan), 7, "<u4").tobytes())  # no id of SemanticKITTI's
    main(["complete", "scan.bin", "--without", "car", "--out", "other/a.bin", *WORDS])
    assert "car as model names them" in capsys.readouterr().out


def test_two_requests_at_once_and_other_words_are_refused(place: Path, capsys: pytest.CaptureFixture[str]):
    for more, line in (
        (["--without", "car", "--corrupt", "beams:2"], "expected --corrupt or --without, found both"),
        (["--without", "lorry"], "expected classes to take away of traffic, car, "),
    ):
        with pytest.raises(SystemExit) as left:
            main(["complete", "scan.ply", "--out", "a.ply", *WORDS, *more])
        assert left.value.code == 2 and line in capsys.readouterr().err
    assert not Path("a.ply").exists()


def test_gaps_of_a_scan_are_no_matter_where_none_is_filled(
    place: Path, capsys: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder
):
    scan = labelled()
    half = scan[scan.xyz[:, 0] > 0]
    write("half.ply", half)
    main(["complete", "half.ply", "--out", "a.ply", *WORDS])
    assert "expected points all around" in capsys.readouterr().err
    main(["complete", "half.ply", "--out", "b.ply", "--without", "car", *WORDS])
    assert "all around" not in capsys.readouterr().err
    left = read("b.ply")
    assert (left.xyz[:, 0] > -0.5).all() and len(left) < 1.05 * len(half)
    load("model").into("own.toml").complete(half, without="car")
    assert not [each for each in recwarn if "all around" in str(each.message)]


def test_results_with_other_classes_are_not_taken_for_these(place: Path, capsys: pytest.CaptureFixture[str]):
    Path("in").mkdir()
    for name in "ab":
        write(f"in/{name}.ply", labelled())
    words = ["complete", "in", "--out", "out", *WORDS, "--skip-existing", "--without"]
    main([*words, "car"])
    before = Path("out/a.ply").read_bytes()
    main([*words, "car"])
    assert Path("out/a.ply").read_bytes() == before
    capsys.readouterr()
    with pytest.raises(SystemExit) as left:
        main([*words, "building"])
    assert left.value.code == 2 and "removed" in capsys.readouterr().err
    assert Path("out/a.ply").read_bytes() == before


def test_messages_and_moved_points_keep_what_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pairs: list[tuple[RangeImage, RangeImage]]
):
    pytest.importorskip("rosbags")
    from lidarsynth.verbs.inputs import Reading, inputs_of

    monkeypatch.chdir(tmp_path)
    scan = replace(pairs[0][0].to_scan(), extra={"object": np.arange(len(pairs[0][0].to_scan()), dtype=np.float32)})
    turned = replace(scan, xyz=transformed(scan.xyz, parse_transform("0:0:0:0:0:-90")))
    fields = write_bag_of(turned, Path("in.mcap"), 1)
    words = ["--sensor", "os1-64", "--transform=0:0:0:0:0:90", "--no-picture"]
    main(["complete", "in.mcap", "--out", "out.mcap", "--without", "traffic", *words])
    (cloud,) = (item.read() for item in inputs_of([Path("out.mcap")], Reading("none")).stream())
    old = cloud.given["new"] == 0
    kept = cloud.given["object"][old].astype(int)
    assert np.isin(scan.label, THINGS)[np.setdiff1d(np.arange(len(scan)), kept)].mean() > 0.8
    for name in fields:
        np.testing.assert_array_equal(cloud.given[name][old], fields[name][kept])
    assert (~old).any()
