"""Road users put into scans of all kinds: thinned, tilted, sorted by time, without labels, inserted into before; and
what lies beside their files."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_insertion import FLAT, ROAD, WORDS, flat_scan
from test_insertion import model as model
from test_insertion import place as place
from test_insertion import street as street

import lidarsynth as ls
from lidarsynth.cli.main import main
from lidarsynth.files.formats import read, write, write_labels
from lidarsynth.lidar.boxes import Box
from lidarsynth.lidar.removal import TRAFFIC
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.streets.turn import sensor_pose
from lidarsynth.streets.wanted import wanted
from lidarsynth.systems.cascade.canvas import levelled
from lidarsynth.systems.free_places import Surroundings
from lidarsynth.systems.scan_model import ScanModel

TILTED = replace(FLAT, tilt=(10.0, 5.0))


def road_scan(sensor: Sensor) -> Scan:
    """Flat road all around a sensor that may be tilted, column after column clockwise from behind."""
    rays = sensor.directions()
    down = levelled(sensor, rays)[..., 2]
    seen = down < -sensor.mount / 60
    column, row = np.nonzero(seen.T)
    xyz = rays[row, column] * (-sensor.mount / down[row, column])[:, None]
    time = column / sensor.width / 10 + 1000.0
    return Scan(xyz.astype(np.float32), np.full(len(xyz), 0.3, np.float32), row, time, np.full(len(xyz), ROAD))


def own_of(scan: Scan, number: int = 1) -> Scan:
    return scan[scan.extra["instance"] == number]


def test_what_was_inserted_into_without_labels_is_inserted_into_again(model: ScanModel, street: Scan):
    once = model.insert(replace(street, label=None), "car", seed=1)
    assert set(np.unique(once.scan.label)) == {0, 1}, "recorded points have no class"
    twice = model.insert(once.scan, "car", seed=2)
    assert twice.boxes[0].instance == 2 and {0, 1, 2} == set(np.unique(twice.scan.extra["instance"]))
    assert (twice.scan.label[twice.scan.extra["new"] == 0] == 0).all()


@pytest.mark.parametrize("kind", ["at random", "every fourth"])
def test_in_thinned_scans_things_are_thinned_too(model: ScanModel, kind: str):
    scan = flat_scan()
    scan = scan[scan.ring > 12]
    kept = np.random.default_rng(0).random(len(scan)) < 0.25 if kind == "at random" else np.arange(len(scan)) % 4 == 0
    whole, thin = (model.insert(one, "car@10/3/30", sensor=FLAT).boxes[0].points for one in (scan, scan[kept]))
    assert whole > 100 and 0.15 < thin / whole < 0.35


@pytest.mark.filterwarnings("ignore:expected points of flat")
def test_lost_rays_have_their_time_also_where_most_of_a_ring_is_lost(model: ScanModel):
    scan = road_scan(TILTED)
    found = model.insert(scan, "bus@4/-8/-33", sensor=TILTED).scan
    own = own_of(found)
    column = (np.pi - np.arctan2(own.xyz[:, 1], own.xyz[:, 0])) / (2 * np.pi)
    assert len(own) > 1000
    np.testing.assert_allclose(own.time, 1000 + column / 10, atol=0.1 / TILTED.width)
    assert (np.diff(scan.time) >= 0).all() and (np.diff(found.time) >= 0).all(), "sorted as before"


@pytest.mark.filterwarnings("ignore:expected points of flat")
def test_lost_rays_of_a_scan_column_by_column_stand_beside_their_neighbours(model: ScanModel):
    low = replace(FLAT, mount=0.6)
    scan = replace(road_scan(low), time=None)
    found = model.insert(scan, "bus@10/0/0", sensor=low).scan
    place = np.flatnonzero(found.extra["instance"] == 1)
    assert (found.ring[place] < scan.ring.min()).sum() > 50 and place.min() > len(scan) / 4


@pytest.mark.filterwarnings("ignore:expected points of flat")
def test_rings_as_the_file_counts_them_are_those_of_the_beams(model: ScanModel):
    low = replace(FLAT, mount=0.6)
    scan = road_scan(low)
    found = model.insert(replace(scan, extra={"file_ring": (28 - scan.ring).astype(np.float32)}), "bus@10/0/0",
                         sensor=low).scan  # fmt: skip
    np.testing.assert_array_equal(found.extra["file_ring"], 28 - found.ring)
    assert found.extra["file_ring"].dtype == np.float32 and found.ring.min() < scan.ring.min()
    assert found.extra["instance"].dtype == np.int32, "as in generated scans; PCL has no numbers of 8 bytes"


@pytest.mark.filterwarnings("ignore:expected measured points, found .* filled in before")
def test_a_completion_of_sure_points_keeps_what_was_inserted(model: ScanModel, street: Scan):
    found, boxes = model.insert(street, "car:2", seed=1)
    assert (found.extra["confidence"] == 1).all()
    kept = model.complete(found).surer_than(0.5).to_scan()
    for box in boxes:
        assert (kept.extra["instance"] == box.instance).sum() == box.points


@pytest.mark.parametrize("label", [40, -1])
def test_labels_that_are_no_training_classes_are_refused(model: ScanModel, label: int):
    scan = flat_scan()
    with pytest.raises(ValueError, match=f"expected labels of 0-19, SemanticKITTI's training classes, found {label}"):
        model.insert(replace(scan, label=np.full(len(scan), label)), "car", sensor=FLAT)


@pytest.mark.parametrize("things", [5, ["car", 3], None])
def test_what_is_no_text_is_refused(things: object):
    with pytest.raises(ValueError, match=r"expected KIND, .*, as text or a list of texts, found"):
        wanted(things)  # type: ignore[arg-type]


def test_images_are_taken_as_their_points(model: ScanModel):
    image = ls.project(flat_scan(), FLAT)
    one, two = (
        model.insert(scan, "car@10/3", sensor=sensor) for scan, sensor in ((image, None), (image.to_scan(), FLAT))
    )
    np.testing.assert_array_equal(one.scan.xyz, two.scan.xyz)
    assert one.boxes == two.boxes


def test_a_ring_alone_does_not_tell_how_the_ground_rises():
    rng, few = np.random.default_rng(0), Sensor("few", tuple(np.linspace(15, -15, 16)), 900, max_range=100.0, mount=1.8)
    scan = flat_scan(few)
    points = scan.xyz + rng.normal(0, 0.02, scan.xyz.shape).astype(np.float32)
    ground = Surroundings(points, scan.label, None)
    spots = [ground.spot(away * np.cos(way), away * np.sin(way), 0.0)
             for away in (9, 11, 14, 20) for way in np.linspace(0, 6, 40)]  # fmt: skip
    slopes = np.array([spot.slope for spot in spots if spot is not None])
    assert len(slopes) > 100 and np.hypot(*slopes.T).max() < 0.02


def test_nothing_that_is_put_hides_what_was_put_before(model: ScanModel):
    scan = flat_scan()
    with pytest.raises(ValueError, match="that leaves the others in sight, found that it hides one 9 m ahead, 0 m to"):
        model.insert(scan, "person@14/0,truck@9/0/90", sensor=FLAT)
    for seed in (0, 1):  # without a place they are put elsewhere
        boxes = model.insert(scan, "person@15/0,person@15/2,bus:3,truck:4", seed=seed, sensor=FLAT).boxes
        assert [box.kind for box in boxes[:2]] == ["person"] * 2 and all(box.points >= 8 for box in boxes)


def boxes_of(file: str) -> tuple[int, list[Box]]:
    """How many points a file of boxes tells of, and its boxes."""
    told: dict[str, Any] = json.loads(Path(file).read_text())
    records: list[dict[str, Any]] = told["boxes"]
    return told["points"], [Box(**record) for record in records]


@pytest.mark.parametrize("ending", ["npz", "ply", "pcd"])
def test_boxes_are_those_of_the_file_that_they_lie_beside(place: Path, ending: str):
    scan = flat_scan()
    double = scan[np.repeat(np.arange(len(scan)), 2)]  # a pixel takes one of two
    back = [(0, 1, 0), (-1, 0, 0), (0, 0, 1)]
    write("moved.ply", replace(double, xyz=((double.xyz - [1, 2, 0.5]) @ np.transpose(back)).astype(np.float32)))
    main(["insert", "moved.ply", "--add", "car@10/3/20", "--out", f"b.{ending}", *WORDS,
          "--transform", "1:2:0.5:0:0:90"])  # fmt: skip
    found, (count, (box,)) = read(f"b.{ending}"), boxes_of("b.json")
    own = own_of(found)
    assert count == len(found) and len(own) == box.points and box.holds(own.xyz).all()
    assert (box.centre[0] > 5) == (ending == "npz"), "an image is in its sensor's frame"


def test_an_image_of_a_scan_with_a_label_file_has_the_classes_of_all_its_points(place: Path):
    write("a.bin", flat_scan())
    main(["insert", "a.bin", "--add", "car@10/3/20", "--out", "b.npz", *WORDS])
    found = read("b.npz")
    assert found.label is not None and set(np.unique(own_of(found).label)) == {CLASS_NUMBER["car"]}
    assert set(np.unique(own_of(found, 0).label)) == {ROAD}


def test_beside_points_that_stand_level_boxes_of_a_tilted_sensor_do_so(place: Path, capsys: pytest.CaptureFixture[str]):
    tilted = replace(FLAT, tilt=(18.0, -20.0))
    level = sensor_pose(tilted, np.zeros(6))
    scan, words = road_scan(tilted), ["--add", "bus@10/3/-33", "--sensor", "tilted.json", "--no-picture"]
    Path("tilted.json").write_text(json.dumps(tilted.to_dict()))
    np.savetxt("level.txt", level.T)
    write("level.ply", replace(scan, xyz=(scan.xyz @ level[:3, :3].T).astype(np.float32)))
    write("scan.ply", scan)
    for name, told in ("scan", "flat is tilted by 27 degrees"), ("level", ""):
        more = ["--transform", "level.txt"] if name == "level" else []
        main(["insert", f"{name}.ply", "--out", f"{name}.pcd", *words, *more])
        assert told in (said := capsys.readouterr().out) and ("lack points" in said) == (name == "scan")
        own, (box,) = own_of(read(f"{name}.pcd")), boxes_of(f"{name}.json")[1]
        assert box.holds(own.xyz).all() == (name == "level") and box.points > 500


def test_beside_points_that_lie_on_their_side_no_boxes_stand(place: Path, capsys: pytest.CaptureFixture[str]):
    scan = flat_scan()
    write("camera.ply", replace(scan, xyz=np.stack([-scan.xyz[:, 1], -scan.xyz[:, 2], scan.xyz[:, 0]], 1)))
    words = ["--add", "car@10/3/20", "--axes", "rdf", *WORDS]
    with pytest.raises(SystemExit) as stopped:
        main(["insert", "camera.ply", "--out", "b.ply", *words])
    assert stopped.value.code == 2 and "expected points whose z is up or down" in capsys.readouterr().err
    assert not Path("b.ply").exists() and not Path("b.json").exists()
    main(["insert", "camera.ply", "--out", "b.npz", *words])
    (box,) = boxes_of("b.json")[1]
    assert box.holds(own_of(read("b.npz")).xyz).all() and box.centre[0] == pytest.approx(10, abs=0.5)
    write("leans.ply", replace(scan, xyz=(scan.xyz @ sensor_pose(TILTED, np.zeros(6))[:3, :3]).astype(np.float32)))
    np.savetxt("up.txt", sensor_pose(TILTED, np.zeros(6)))
    main(["insert", "leans.ply", "--add", "car@10/3/20", "--transform", "up.txt", "--out", "c.ply", *WORDS])
    assert "z of the points is 11 degrees off, and boxes, upright in their frame, lack" in capsys.readouterr().out


def test_boxes_of_the_scan_itself_are_not_replaced(place: Path, capsys: pytest.CaptureFixture[str]):
    main(["insert", "scan.ply", "--add", "car@10/3", "--out", "b.ply", *WORDS])
    before = Path("b.json").read_bytes()
    with pytest.raises(SystemExit) as stopped:
        main(["insert", "b.ply", "--add", "car@10/-4", "--out", "b.pcd", *WORDS])
    assert stopped.value.code == 2
    assert "b.pcd: expected a name whose .json is not that of b.ply, found b.json" in capsys.readouterr().err
    assert Path("b.json").read_bytes() == before and not Path("b.pcd").exists()
    for _ in range(2):  # those of an earlier run are
        main(["insert", "scan.ply", "--add", "car@10/3", "--out", "scan.pcd", *WORDS])


def test_numbers_that_a_label_file_cannot_hold_are_refused(place: Path, capsys: pytest.CaptureFixture[str]):
    scan = flat_scan()
    write("far.ply", replace(scan, extra={"instance": np.full(len(scan), 70_000, np.int32)}))
    main(["insert", "far.ply", "--add", "car@10/3", "--out", "b.ply", *WORDS])
    assert len(own_of(read("b.ply"), 70_001)) > 50
    with pytest.raises(SystemExit):
        main(["insert", "far.ply", "--add", "car@10/3", "--out", "c.bin", *WORDS])
    assert "expected instances of 0-65535 for a .label, found 70000" in capsys.readouterr().err
    assert not Path("c.bin").exists() and not Path("c.label").exists()


def test_other_things_are_not_gone_on_with(place: Path, capsys: pytest.CaptureFixture[str]):
    Path("more").mkdir()
    write("more/a.ply", flat_scan())
    write_labels("more/a.label", flat_scan())
    main(["insert", "more", "--add", "car@10/3", "--out", "out", *WORDS])
    with pytest.raises(SystemExit):
        main(["insert", "more", "--add", "car@10/-3", "--out", "out", "--skip-existing", *WORDS])
    assert "found other settings: things car@10/-3 for car@10/3" in capsys.readouterr().err


def test_bicyclists_are_named_so_by_a_network_of_streets_alone(monkeypatch: pytest.MonkeyPatch):
    from lidarsynth.systems.cascade import model as module

    asked, ask = [], module.named
    monkeypatch.setattr(module, "named", lambda *told, **more: asked.append(told[6]) or ask(*told, **more))
    found = ls.load("default").insert(SyntheticStreets(991, 64, "os1-64", TRAFFIC)[3], "bicyclist:3", seed=3).scan
    new = found.extra["new"] > 0
    named = ls.load("default").label(found).label
    assert (named[new] == CLASS_NUMBER["bicyclist"]).mean() > 0.5  # hardly any without a logit more
    ls.load("kitti").label(SyntheticStreets(991, 64, "hdl-64e-kitti")[3])
    assert asked == [{"bicyclist": 1.0}, None], "scans that one has learned from tell for themselves"


def test_a_ray_of_two_returns_brings_back_one_from_what_stands_before_both(model: ScanModel):
    scan = flat_scan(wall=25)
    far = scan[np.linalg.norm(scan.xyz, axis=1) > 14]
    both = Scan(*(np.concatenate([getattr(one, name) for one in (scan, replace(far, xyz=far.xyz * np.float32(0.95)))])
                  for name in ("xyz", "reflectance", "ring", "time", "label")))  # fmt: skip
    one, two = (own_of(model.insert(each, "car@9/0/90", sensor=FLAT).scan) for each in (scan, both))
    ways = np.round(two.xyz / np.linalg.norm(two.xyz, axis=1, keepdims=True) * 2000)
    assert len(np.unique(ways, axis=0)) == len(two) > 100
    assert abs(len(two) / len(one) - 1) < 0.05
