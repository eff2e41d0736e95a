"""Insides of buildings: floors, walls with doors, robots that stand clear, labelled sets of them."""

import json
from dataclasses import replace

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.cli.main import main
from lidarsynth.data.layouts import nuscenes
from lidarsynth.data.street_sets import write_streets
from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import with_fields
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.streets.floors import SMALLEST, Opening, draw_rooms, wall, walls_between
from lidarsynth.streets.frame import FURNITURE, LabelledStreets, Options
from lidarsynth.streets.furniture import KINDS
from lidarsynth.streets.interiors import building, buildings, interiors
from lidarsynth.streets.raycast import Caster
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.streets.shapes import join
from lidarsynth.streets.weather import Weather
from lidarsynth.streets.world import POSES, visible
from lidarsynth.training.examples import open_images, words_of

pytest.importorskip("embreex", reason="lidarsynth[synthetic] is not installed")

ROBOT = Sensor("robot", tuple(np.linspace(22.5, -22.5, 32).tolist()), 256, 0.2, 60.0, mount=0.6)
BUILDING, FLOOR, PERSON, CAR = (CLASS_NUMBER[word] for word in ("building", "other-ground", "person", "car"))


def test_scans_depend_on_their_number_alone_and_share_sensors():
    first, again = interiors(5, 400), interiors(5, 400)
    late = again.image(33)
    np.testing.assert_array_equal(first.image(2).range, again.image(2).range)
    np.testing.assert_array_equal(first.image(33).range, late.range)
    assert first.sensor(4) == first.sensor(7) != first.sensor(8)
    sensors = [first.sensor(i).sensor for i in range(0, 400, 4)]
    assert all(0.25 <= s.mount <= 1.8 and s.name != "hdl-64e-kitti" for s in sensors)
    assert max(s.elevations[0] for s in sensors) > 30  # some look far up


def test_one_stands_under_a_ceiling_on_a_floor_between_walls():
    reader = LabelledStreets(3, 64, ROBOT, Options(inside=True, perfect=True))
    seen = {"rooms": 0, "halls": 0}
    for index in range(0, 64, 4):
        scan = reader[index].scan
        assert scan.label is not None
        floor, up = scan.label == FLOOR, scan.xyz[:, 2] + ROBOT.mount
        assert abs(np.median(up[floor])) < 0.06  # robots lean by half a degree
        ceiling = (scan.label == BUILDING) & (up > 2.1)
        level = np.quantile(up[ceiling], 0.99) if ceiling.sum() > 100 else 2.5
        seen["rooms" if level < 4 else "halls"] += 1
        assert level < 11 and up.min() > -1.5
        assert np.linalg.norm(scan.xyz, axis=1).min() > 0.2
        assert (scan.label == BUILDING).mean() > 0.15
    assert min(seen.values()) > 0


def test_robots_stand_in_the_open():
    """Nobody's sensor is in a wall or a table: the nearest surface is a hand's breadth away, for nearly all."""
    close = []
    for number in range(24):
        world = building(np.random.default_rng((1, number)))
        caster = Caster(world.corners)
        turn = np.linspace(0, 2 * np.pi, 90, endpoint=False)
        rays = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1).astype(np.float32)
        for pose in world.poses:
            origin = np.tile(np.float32((pose[0], pose[1], pose[2] + 0.6)), (len(rays), 1))
            close.append(caster.cast(origin, rays)[1].min())
    assert np.mean(np.array(close) > 0.2) > 0.97


@pytest.mark.parametrize("seed", range(8))
def test_rooms_fill_the_plan_without_overlap(seed):
    rng = np.random.default_rng(seed)
    length, width = rng.uniform(9, 45), rng.uniform(6, 25)
    rooms = draw_rooms(rng, length, width)
    assert np.isclose(sum(room.area for room in rooms), length * width)
    assert all(min(r.x1 - r.x0, r.y1 - r.y0) >= min(1.5, SMALLEST) - 1e-9 for r in rooms)
    spots = rng.uniform((0, 0), (length, width), (200, 2))
    inside = [sum(r.x0 <= x < r.x1 and r.y0 <= y < r.y1 for r in rooms) for x, y in spots]
    assert inside == [1] * 200


def test_one_sees_through_an_open_door_and_not_through_a_shut_one():
    holes = [Opening(4.0, 5.0, 0.0, 2.0, "door"), Opening(1.0, 2.0, 0.0, 2.0), Opening(6.0, 8.0, 0.9, 2.0)]
    caster = Caster(join(*wall(True, 3.0, (0.0, 10.0), 2.5, 0.1, "plaster", holes)).corners)

    def far(x: float, z: float) -> float:
        return float(caster.cast(np.array([[x, 0, z]], np.float32), np.array([[0, 1, 0]], np.float32))[1][0])

    assert far(0.5, 1.0) == pytest.approx(2.9) and far(4.5, 1.0) == pytest.approx(2.98)
    assert np.isinf(far(1.5, 1.0)) and far(1.5, 2.2) == pytest.approx(2.9)
    assert far(7.0, 0.5) == pytest.approx(2.9) and np.isinf(far(7.0, 1.5)) and np.isinf(far(11.0, 1.0))


def test_furniture_stands_on_the_floor():
    rng = np.random.default_rng(0)
    for kind, make in KINDS.items():
        for _ in range(12):
            corners = make(rng).corners
            assert -1e-6 < corners[..., 2].min() < 0.25 and corners[..., 2].max() < 3.2, kind
            assert np.abs(corners[..., :2]).max() < 3.0, kind


def test_labelled_sets_have_instances_and_furniture(tmp_path):
    reader, people = LabelledStreets(0, 96, ROBOT, Options(inside=True)), 0
    for index in range(0, 96, 6):
        frame = reader[index]
        assert frame.scan.label is not None
        raw = frame.raw & 0xFFFF
        assert ((raw == FURNITURE) == (frame.scan.label == 0)).all()
        of_things = np.isin(frame.scan.label, (PERSON, CAR))
        assert ((frame.raw >> 16 > 0) == of_things).all()
        assert {box.kind for box in frame.boxes} <= {"person", "car", "van"}
        for box in frame.boxes:
            inside = frame.scan.xyz[frame.raw >> 16 == box.instance]
            low, high = box.corners().min(0) - 0.1, box.corners().max(0) + 0.1
            assert len(inside) == box.points and ((inside > low) & (inside < high)).all()
            people += box.kind == "person" and box.points > 0
        assert (nuscenes.classes(frame)[raw == FURNITURE] == 29).all()  # static.other
    assert people > 3


def test_who_is_seen_through_a_window_is_not_hidden():
    frame = LabelledStreets(5, 6, SENSORS["os1-64"].resized(width=512), Options(inside=True))[3]
    boxes = [box for box in frame.boxes if box.points]
    assert [(box.kind, box.points > 20) for box in boxes] == [("person", True)]  # all through panes
    assert 0.2 < boxes[0].occlusion < 0.9


@pytest.mark.parametrize("asked", [{"frames": 5}, {"weather": Weather(rain=3.0)}, {"overlap": False}])
def test_buildings_have_no_drives_and_no_weather(asked):
    with pytest.raises(
        ValueError,
        match="expected places of buildings, where nothing drives or rains, found",
    ):
        Options(inside=True, **asked)


def test_kitti_s_car_does_not_fit():
    with pytest.raises(ValueError, match="expected a robot's sensor in buildings"):
        LabelledStreets(0, 1, "hdl-64e-kitti", Options(inside=True))


def test_a_cache_of_buildings_is_not_added_to_by_streets(tmp_path, capsys):
    sensor, rooms = tmp_path / "robot.toml", tmp_path / "rooms"
    sensor.write_text('name = "robot"\nbeams = 16\ntop = 20\nbottom = -20\nmax_range = 60\nmount = 0.5\n')
    asked = ["data", "synthetic", str(rooms), "-n", "3", "--sensor", str(sensor), "--workers", "0"]
    main([*asked, "--inside"])
    assert json.loads((rooms / "index.json").read_text())["source"]["inside"] is True
    of_files = ["data", "files", str(rooms), str(tmp_path / "c"), "--inside"]
    for words, said in ((asked, "found one of {inside True}"), (of_files, "expected --inside with synthetic")):
        with pytest.raises(SystemExit) as stopped:
            main(words)
        assert stopped.value.code == 2 and said in capsys.readouterr().err


def test_words_take_turns_world_by_world():
    images = open_images("varied,interiors", preset("default"))
    assert words_of("varied,interiors") == ("varied", "interiors") and words_of("varied-elsewhere") == ()
    indices = images.indices(0, 4)  # type: ignore[union-attr]
    assert [images.name(i)[0] for i in indices] == ["varied", "interiors"] * 2
    first = images.take(indices)[1]
    np.testing.assert_array_equal(
        first.range, interiors(preset("default").training.seed, 1 << 40).image(indices[1]).range
    )
    assert images.source["name"] == "varied,interiors"


def test_worlds_are_kept_whole():
    """Also what is farther than the sensor sees from every place."""
    whole = building(np.random.default_rng((0, 4, 6)))
    near = replace(ROBOT, max_range=3.0)
    assert len(buildings(0, near)[4][0].corners) == len(whole.corners) > len(visible(whole, near).corners)


def test_processes_share_a_set_of_buildings(tmp_path):
    """The same files as one alone writes."""
    for workers in (0, 2):
        streets = LabelledStreets(4, 20, replace(ROBOT, width=128), Options(inside=True))
        assert list(write_streets(tmp_path / str(workers), streets, "pcd", workers))[-1] == 20
    names = [path.name for path in sorted((tmp_path / "0").glob("*.pcd"))]
    assert len(names) == 20
    for name in names:
        assert (tmp_path / "0" / name).read_bytes() == (tmp_path / "2" / name).read_bytes(), name


@pytest.mark.parametrize("mount", [2.1, 12.0])
def test_no_sensor_stands_above_a_ceiling(mount):
    with pytest.raises(ValueError, match=r"expected a mount of 0 to 2\.1 m in buildings"):
        buildings(0, replace(ROBOT, mount=mount))


def test_every_room_has_a_door_or_an_opening():
    """From the middle of its floor one sees beyond its walls, at the height of a robot."""
    rng, out = np.random.default_rng(3), []
    for _ in range(12):
        length, width = rng.uniform(14, 30), rng.uniform(10, 20)
        rooms = draw_rooms(rng, length, width)
        caster = Caster(join(*walls_between(rng, rooms, (length, width, 2.6), windows=False)).corners)
        for room in rooms if len(rooms) > 1 else ():
            seen = 0.0
            for x, y in rng.uniform((room.x0 + 0.3, room.y0 + 0.3), (room.x1 - 0.3, room.y1 - 0.3), (12, 2)):
                turn = np.linspace(0, 2 * np.pi, 360, endpoint=False)
                rays = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1).astype(np.float32)
                far = caster.cast(np.tile(np.float32((x, y, 0.5)), (360, 1)), rays)[1]
                ends = np.array((x, y)) + rays[:, :2] * far[:, None]
                off = (ends < (room.x0 - 0.2, room.y0 - 0.2)) | (ends > (room.x1 + 0.2, room.y1 + 0.2))
                seen = max(seen, off.any(1).mean())
            out.append(seen > 0)
    assert len(out) > 60 and np.mean(out) > 0.7  # a third of the doors is shut, one of several per room


def test_mixed_words_and_folders_are_refused_by_name(tmp_path):
    for data, other in (("varied,interior", "interior"), (f"interiors,{tmp_path / 'c'}", "c'"), ("interiors,", "''")):
        with pytest.raises(ValueError, match=f"expected words of .* alone, or caches alone, found .*{other}"):
            open_images(data, preset("default"))
    with pytest.raises(
        ValueError, match="expected streets of one sensor, such as synthetic, for the network conditional-unet"
    ):
        open_images("synthetic,interiors", preset("tiny"))


@pytest.mark.parametrize(("own", "floors"), [(False, True), (True, False)])
def test_a_room_is_named_by_the_network_of_insides_unless_a_model_has_classes_of_its_own(own: bool, floors: bool):
    """A robot's scan: `default` says what is floor; what was learned from a user's own labels stands."""
    image = interiors(77, 3 * POSES).image(2 * POSES)
    model = ls.load("default").into(image.sensor)
    if own:
        model = replace(model, experiment=with_fields(model.experiment, {"model.own_classes": True}))
    named = model.label(replace(image, label=None).to_scan()).label
    truth = image.to_scan().label
    assert named is not None and truth is not None
    assert bool(np.mean(named[truth == FLOOR] == FLOOR) > 0.9) is floors
    assert bool(np.mean(named == truth) > 0.7) is floors


def test_no_street_is_taken_for_the_inside_of_a_building():
    image = SyntheticStreets(77, 16).image(3)
    named = ls.load("default").into(image.sensor).label(replace(image, label=None).to_scan()).label
    assert named is not None and not (named == FLOOR).any() and named.min() >= 1
