"""Labelled streets: labels, instances and boxes fit the points, drives move as they say, weather as its formulas."""

from dataclasses import replace

import numpy as np
import pytest

from lidarsynth.files.labels import CLASS_OF_RAW
from lidarsynth.lidar.boxes import Box
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.streets.actors import MARGIN, actors_of
from lidarsynth.streets.apart import HARD, VEHICLES, bases, boxes_on_ground, meet, stand_apart, walls, what_stands
from lidarsynth.streets.areas import TODAY, Density
from lidarsynth.streets.drive import draw_drive
from lidarsynth.streets.frame import Frame, LabelledStreets, Options
from lidarsynth.streets.ground import Ground
from lidarsynth.streets.layout import build
from lidarsynth.streets.moving import Bundles
from lidarsynth.streets.objects import USUAL, library
from lidarsynth.streets.passing import _to_and_fro, set_apart
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.streets.recordings import RecordedStreets
from lidarsynth.streets.traffic import GAP, STEP, acceleration, follow
from lidarsynth.streets.weather import (
    Weather,
    _drop_table,
    fog_echo,
    fog_extinction,
    rain_extinction,
    strongest_drop,
)
from lidarsynth.streets.world import TRAFFIC, World, visible

pytest.importorskip("embreex", reason="lidarsynth[synthetic] is not installed")

SMALL = SENSORS["hdl-32e"].resized(width=512)


@pytest.fixture(scope="module")
def still() -> list[Frame]:
    reader = LabelledStreets(0, 48, SMALL)
    return [reader[index] for index in (4, 5, 40)]


@pytest.fixture(scope="module")
def driven() -> list[Frame]:
    reader = LabelledStreets(1, 1, SMALL, Options(frames=30, deskewed=True, density=Density(traffic=4)))
    return [reader[index] for index in (0, 1, 2, 29)]


def world(seed: int, density: Density) -> World:
    """The first of a seed, as `SMALL` can see it."""
    return visible(build(np.random.default_rng((seed, 0)), density), SMALL)


def inside(box: Box, xyz: np.ndarray, slack: float) -> np.ndarray:
    """(N,) bool: points within the box grown by `slack` metres."""
    c, s = np.cos(box.yaw), np.sin(box.yaw)
    local = (xyz - box.centre) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return np.all(np.abs(local) <= np.array(box.size) / 2 + slack, axis=1)


def test_places_are_those_of_the_streets():
    """The labels come on top: the points of scan i of a seed are what they always were."""
    frame = LabelledStreets(3, 4)[1]
    scan = SyntheticStreets(3, 4)[1]
    np.testing.assert_array_equal(frame.scan.xyz, scan.xyz)
    np.testing.assert_array_equal(frame.scan.label, scan.label)
    assert frame.scan.time is not None and frame.scan.time.min() >= 0 and frame.scan.time.max() <= 0.1


def test_a_frame_depends_on_nothing_else():
    options = Options(frames=30, deskewed=True, weather=Weather(rain=20))
    reader = LabelledStreets(2, 2, SMALL, options)
    assert len(reader[7].scan) and len(reader[31].scan)
    mine, fresh = reader[40], LabelledStreets(2, 3, SMALL, options)[40]
    np.testing.assert_array_equal(mine.scan.xyz, fresh.scan.xyz)
    assert mine.record() == fresh.record()


def test_labels_and_training_classes_agree(still: list[Frame], driven: list[Frame]):
    for frame in still + driven:
        np.testing.assert_array_equal(CLASS_OF_RAW[frame.raw & 0xFFFF], frame.scan.label)


def test_points_of_an_instance_are_in_its_box(still: list[Frame], driven: list[Frame]):
    """Within range noise, and for movers what they travel in half a turn."""
    checked = 0
    for frame in still + driven:
        instance = frame.raw >> 16
        assert set(np.unique(instance)) - {0} <= {box.instance for box in frame.boxes}
        for box in frame.boxes:
            mine = instance == box.instance
            assert mine.sum() == box.points
            slack = 0.12 + 0.06 * np.linalg.norm(box.velocity)
            assert inside(box, frame.scan.xyz[mine], slack).all(), box
            checked += int(mine.sum())
    assert checked > 500


def test_deskewed_boxes_stand_where_their_points_were_seen(driven: list[Frame]):
    """Where things are at the stamp, some of those that move would have no point at all."""
    held = []
    for frame in driven:
        for box in (box for box in frame.boxes if box.moves and box.points and box.late is not None):
            mine = frame.scan.xyz[frame.raw >> 16 == box.instance]
            at_stamp = replace(box, centre=tuple(np.array(box.centre) - box.late * np.array(box.velocity)))
            held.append((inside(box, mine, 0).sum(), inside(at_stamp, mine, 0).sum(), box.points))
    seen, stamped, told = np.array(held).T
    assert len(told) > 20 and seen.sum() > 0.99 * told.sum() and (seen > 0.5 * told).all()
    assert stamped.sum() < 0.95 * told.sum() and (stamped < 0.5 * told).any()
    beside = [box for frame in driven for box in frame.boxes if np.hypot(*box.centre[:2]) > 5 and box.late is not None]
    off = [10 * (box.late or 0.0) + np.arctan2(box.centre[1], box.centre[0]) / (2 * np.pi) for box in beside]
    np.testing.assert_allclose(off, np.round(off), atol=0.12)  # clockwise, the stamp ahead, both ends behind


def test_what_follows_the_carrier_is_one_thing_though_both_ends_of_a_turn_meet_it():
    """A turn begins and ends directly behind: two parts of a vehicle there are met 0.1 s apart, a metre at 36 km/h."""
    reader, twice = LabelledStreets(6, 1, SMALL, Options(frames=40, deskewed=True, density=Density(traffic=6))), 0
    for frame in (reader[k] for k in range(0, 40, 8)):
        assert frame.scan.time is not None
        for box in (box for box in frame.boxes if box.moves and box.points > 9 and box.centre[0] < -4):
            mine = frame.raw >> 16 == box.instance
            ahead = (frame.scan.xyz[mine] - box.centre) @ [np.cos(box.yaw), np.sin(box.yaw), 0]
            early = frame.scan.time[mine] < 0.05
            if early.any() and not early.all():
                twice += 1
                assert np.linalg.norm(box.velocity) > 7 and inside(box, frame.scan.xyz[mine], 0).all()
                assert abs(ahead[early].max() - ahead[~early].max()) < 0.3, box  # both parts of its front
    assert twice > 3


def test_boxes_hold_little_else(still: list[Frame]):
    """What returns from within a car's box is that car, its ground, or what leans against it."""
    for frame in still:
        for box in frame.boxes:
            if box.kind == "car" and box.points > 100:
                there = inside(box, frame.scan.xyz, -0.1)
                assert ((frame.raw >> 16)[there] == box.instance).mean() > 0.8


def test_occlusion_is_a_share(still: list[Frame]):
    boxes = [box for frame in still for box in frame.boxes]
    assert all(0 <= box.occlusion <= 1 for box in boxes)
    assert any(box.occlusion < 0.05 for box in boxes) and any(box.occlusion > 0.95 for box in boxes)
    assert all(box.occlusion < 1 for box in boxes if box.points)


def test_boxes_move_with_their_velocity(driven: list[Frame]):
    """Place after a turn = place + velocity * the time between both meetings, for everyone in both frames."""
    before, after = ({box.instance: box for box in frame.boxes} for frame in driven[1:3])
    moved = 0
    for number in before.keys() & after.keys():
        a, b = before[number], after[number]
        mean = (np.array(a.world_velocity) + b.world_velocity) / 2
        assert a.late is not None and b.late is not None and abs(a.late) <= 0.05 >= abs(b.late)
        np.testing.assert_allclose(np.array(b.place) - a.place, mean * (0.1 + b.late - a.late), atol=0.05)
        assert a.size == b.size and a.kind == b.kind
        moved += a.moves
    assert moved >= 3


@pytest.mark.parametrize("rate", [10, 20, 50])
def test_everyone_is_as_fast_in_the_first_turn_as_they_go(rate: int):
    """Of 50 turns a second the first is over before a step of the traffic's clock is: all were a third too slow."""
    drive = LabelledStreets(0, 1, SMALL, Options(frames=1, rate=rate, density=Density(traffic=2))).drive(0)
    begun, first = drive.moment(0.0), drive.moment(0.5 / rate)
    assert first.present.any() and np.linalg.norm(first.velocity, axis=1).max() > 3
    np.testing.assert_allclose(begun.place + first.velocity * 0.5 / rate, first.place, atol=2e-3)


def test_what_stands_is_at_one_place_through_a_drive(driven: list[Frame]):
    """Poses and deskewed points are of one world: parked boxes, and their points in it, do not wander."""
    first, last = driven[0], driven[-1]
    there = {box.instance: box for box in first.boxes if not box.moves}
    same = [box for box in last.boxes if box.instance in there and not box.moves]
    assert len(same) > 2
    for box in same:
        np.testing.assert_allclose(box.place, there[box.instance].place, atol=1e-6)
        world = last.to_world @ [*box.centre, 1]
        np.testing.assert_allclose(world[:3], box.place, atol=1e-6)


def test_a_moving_turn_smears_and_deskewing_undoes_it():
    options = Options(frames=3, speed=12.0)
    streets = LabelledStreets(4, 1, SMALL, options)
    raw = streets[1]
    streets.options = replace(options, deskewed=True)  # of the same drive
    flat = streets[1]
    np.testing.assert_array_equal(raw.raw, flat.raw)
    apart = np.linalg.norm(raw.scan.xyz - flat.scan.xyz, axis=1)
    assert raw.scan.time is not None
    late = np.abs(raw.scan.time - 0.05)
    speed = np.median(apart[late > 0.02] / late[late > 0.02])
    assert 5 < speed < 13  # m/s: the car's, as it sets off behind others
    assert apart[late < 0.001].max() < 0.1


def test_drivers_keep_their_distance():
    """Ten vehicles of wishes of 5 to 15 m/s behind one of 4: nobody meets the one in front, all end at its speed."""
    place = np.arange(10) * 14.0
    wished = np.linspace(15, 4, 10)
    track = follow(place, np.full(10, 4.5), wished, 120)
    assert np.diff(track, axis=1).min() > 4.5
    np.testing.assert_allclose((track[-1] - track[-21]) / (20 * STEP), 4.0, atol=0.1)


def test_driver_model_rests_where_its_equation_says():
    """Equilibrium gap (s0 + v T) / sqrt(1 - (v / v0)^4) (Treiber et al. 2000, eq. 3)."""
    speed, wished = np.array([8.0]), np.array([12.0])
    gap = (GAP + speed * 1.2) / np.sqrt(1 - (speed / wished) ** 4)
    np.testing.assert_allclose(acceleration(speed, wished, gap, np.zeros(1)), 0, atol=1e-12)
    assert acceleration(wished, wished, np.array([np.inf]), np.zeros(1)) == 0


def test_the_carrier_stays_on_its_road_and_meets_nobody():
    drive = draw_drive(5, 0, 12.0, Density(traffic=3))
    times = np.arange(0, 12, 0.25)
    poses = drive.poses(times)
    _, d = drive.world.ground.roads[0].coordinates(poses[:, 0], poses[:, 1])
    assert np.abs(d - drive.lane).max() < 0.2
    ahead = np.diff(poses[:, :2], axis=0)
    heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    moving = np.linalg.norm(ahead, axis=1) > 0.3
    np.testing.assert_allclose(np.cos(heading - poses[:-1, 3])[moving], 1, atol=0.01)
    for time, pose in zip(times, poses, strict=True):
        now = drive.moment(time)
        gap = np.linalg.norm(now.place[now.present, :2] - pose[:2], axis=1)
        vehicles = np.isin(drive.actors.kind[now.present], ["car", "van", "truck", "bus"])
        assert gap[vehicles].min(initial=99) > 1.5


CROWD = Density(traffic=2, pedestrians=4, groups=2, motorcycles=2, cyclists=2, riders=2, walkers=3, racks=1, heavy=1)


def apart(one: Box, other: Box) -> float:
    """m between two boxes as seen from above along the best of their four sides, negative where they meet."""
    sides = [np.array([np.cos(yaw), np.sin(yaw)]) for of in (one, other) for yaw in (of.yaw, of.yaw + np.pi / 2)]
    shadows = [[box.corners()[:, :2] @ side for box in (one, other)] for side in sides]
    return max(max(a.min() - b.max(), b.min() - a.max()) for a, b in shadows)


@pytest.mark.parametrize("frames", [0, 24])
def test_boxes_of_crowded_streets_never_meet(frames: int):
    """In scans of places, and in drives from one turn to the next, among them those who turn where their way ends."""
    reader = LabelledStreets(0, 2 if frames else 32, SMALL, Options(frames=frames, rate=2, density=CROWD))
    kinds, moving = set(), 0
    for k in range(0, len(reader), 4):
        boxes = reader[k].boxes
        kinds |= {box.kind for box in boxes}
        moving += sum(box.moves and box.kind == "person" for box in boxes)
        for number, one in enumerate(boxes):
            near = (box for box in boxes[:number] if np.hypot(*np.subtract(box.centre, one.centre)[:2]) < 14)
            assert all(apart(one, other) > -1e-3 for other in near), one
    assert {"person", "bicycle", "bicyclist", "car"} <= kinds and (moving > 50) == (frames > 0)


def test_nobody_in_crowded_streets_stands_in_a_pole_or_a_trunk():
    plain = world(0, CROWD)
    full, left = stand_apart(plain)
    posts = full.things["row"][np.isin(full.things["kind"], ["lamp", "sign", "bollard", "tree", "bin"]), :2]
    actors = actors_of(full)
    place = actors.place[actors.kind == "person"]
    assert len(place) > 40 and np.hypot(*(place[:, None, :2] - posts).T).min() > 0.3
    assert 0.8 * len(left) < left.sum() == len(actors) <= len(left)
    stayed = {corners.tobytes() for corners in full.corners} & {corners.tobytes() for corners in plain.corners}
    assert len(stayed) > 0.8 * len(full.corners)
    vehicles = boxes_on_ground(actors, 0.0)[np.isin(actors.kind, ["car", "van", "truck", "bus", "lorry", "coach"])]
    for x, y, yaw, *half in vehicles:
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        assert not (np.abs((posts - (x, y)) @ turn) < half).all(axis=1).any()
    gap = full.ground.carriageway(place[:, 0], place[:, 1])
    assert ((gap > 0) == (plain.ground.height(*place[:, :2].T) < place[:, 2] - 0.06)).mean() > 0.9  # on the kerb


def test_who_drives_or_rides_goes_through_no_thing_and_no_house():
    """Riders of sidewalks ride where least stands, and nothing does then; houses across a road end it."""
    seen, kept, ended = {"bicyclist": 0, "car": 0}, 0, 0
    for number in range(3):
        plain = draw_drive(5, number, 10.0, Density(cyclists=3))
        drive = set_apart(plain)
        kept += len(drive.world.things) / len(plain.world.things) / 3
        stands = what_stands(drive.world)
        for time in np.arange(0, 10, 0.5):
            now = drive.moment(time)
            going = now.present & (drive.number >= 0) & (drive.actors.kind != "person")
            boxes = boxes_on_ground(replace(drive.actors, place=now.place), 0.0, now.yaw)[going]
            assert not meet(boxes[:, None], stands[None]).any()
            for kind in seen:
                seen[kind] += int((drive.actors.kind[going] == kind).sum())
        road = drive.world.ground.roads[0]
        ended += int((drive.reach[0] != (road.start, road.stop)).sum())
    assert seen["bicyclist"] > 500 and seen["car"] > 200 and kept > 0.9 and ended > 0


def test_no_vehicle_stands_in_a_wall_or_a_barrier_beside_the_road():
    met, left = [], []
    for number in range(4):
        drawn = build(np.random.default_rng((0, number)), Density(walls=3, barriers=2))
        for which in (drawn, stand_apart(drawn)[0]):
            actors = actors_of(which)
            parked = boxes_on_ground(actors, -0.1)[np.isin(actors.kind, VEHICLES)]
            hard = bases(which, np.flatnonzero(np.isin(which.things["kind"], HARD)))
            met.append(int(meet(parked[:, None], hard[None]).any(axis=1).sum()))
            left.append(len(parked))
    assert sum(met[::2]) > 5 and not any(met[1::2])
    assert sum(left[1::2]) > 0.8 * sum(left[::2])


def test_nobody_of_usual_streets_without_overlap_stands_in_walls_or_in_others():
    told = {}
    for overlap in (True, False):
        reader = LabelledStreets(0, 48, SMALL, Options(overlap=overlap))
        boxes = [reader[k].boxes for k in range(0, 48, 16)]
        pairs = [apart(a, b) < -0.1 for of in boxes for k, a in enumerate(of) for b in of[:k]]
        built = [build(np.random.default_rng((0, number))) for number in range(3)]
        worlds = built if overlap else [stand_apart(each)[0] for each in built]
        walled = [meet(boxes_on_ground(actors_of(w), -0.2)[:, None], walls(w)[None]).any() for w in worlds]
        told[overlap] = (sum(pairs), sum(walled), sum(map(len, boxes)))
    assert told[True][0] > 0 and told[True][1] > 0 and told[False][:2] == (0, 0)
    assert told[True][2] > told[False][2] > 0.9 * told[True][2]
    with pytest.raises(ValueError, match="expected kerbs of at most 3 times 12 cm, found 9"):
        Density(kerbs=9)


def test_who_walks_turns_where_their_way_ends():
    """To and fro between 0 and 6 m at 1.5 m/s from the middle on, 2 s at each end."""
    times = np.arange(0, 30, 0.05)
    s, facing = _to_and_fro(0.0, 6.0, 3.0, 1.5, 1, times)
    assert s[0] == 3 and s.min() >= 0 and s.max() <= 6 and facing[0] == 0
    np.testing.assert_allclose(np.abs(np.diff(s)).max(), 1.5 * 0.05, atol=1e-9)
    back = (times > 4.1) & (times < 7.9)
    assert np.all(np.diff(s[back]) < 0) and np.allclose(facing[back], np.pi)
    assert np.diff(facing).max() < 0.2  # nobody turns at once
    assert _to_and_fro(0.0, 1.0, 0.5, 1.5, -1, times)[0].std() == 0


def test_density_does_what_it_says():
    base, bare = (world(6, density) for density in (TODAY, Density(0, 0, 0, 0)))
    kinds = set(bare.things["kind"])
    assert not kinds & {"person", "tree", "bush", "thicket"}
    assert len(bare.things) < len(base.things)
    with pytest.raises(ValueError, match=r"expected traffic of 0 to 100, found -1"):
        Density(traffic=-1).of(None)  # type: ignore[arg-type]


def test_without_traffic_and_parking_no_vehicle_is_left():
    """Not in car parks either, nor bicycles; with ever so little parking they are there, and all else is the same."""
    little, none = (world(0, Density(traffic=0, parking=parking)) for parking in (1e-9, 0))
    kinds = {"car", "van", "truck", "bus", "bicyclist", "motorcyclist", "bicycle", "motorcycle"}
    assert not kinds & set(none.things["kind"]) and {"car", "van", "truck", "bicycle"} <= set(little.things["kind"])
    left = little.things[~np.isin(little.things["kind"], list(kinds))]
    np.testing.assert_array_equal(none.things, left)
    np.testing.assert_array_equal(none.poses, little.poses)


def test_what_moves_is_met_whole_however_long_a_turn_lasts(monkeypatch: pytest.MonkeyPatch):
    asked = Options(frames=1, rate=0.5, perfect=True, density=Density(traffic=3, cyclists=2))
    streets = LabelledStreets(0, 1, SENSORS["vlp-16"].resized(width=256), asked)
    found = streets[0]
    monkeypatch.setattr(Bundles, "meet", lambda self, middle, radius: np.arange(len(self.rays)))
    np.testing.assert_array_equal(found.raw, streets[0].raw)


def test_steep_and_tilted_sensors_see_what_is_high_and_short_ones_what_comes_near():
    whole = build(np.random.default_rng((0, 5)), Density(walls=3))

    def left(**told) -> World:
        return visible(whole, replace(SMALL, **told))

    def high(top: float, **told) -> int:
        return len(left(elevations=(top, 0.0), **told).corners)

    assert high(90.0) >= high(89.0) >= high(80.0) > high(1.0)
    assert high(1.0, max_range=40.0, tilt=(0.0, 20.0)) == high(21.0, max_range=40.0)
    low, lines = whole.corners[:, :, 2].min(axis=1) < whole.poses[:, 2].min() + 2, whole.corners[:, :, :2]
    along, away = np.roll(lines, -1, axis=1) - lines, np.full(len(lines), np.inf)
    for place in whole.poses[:, :2]:
        part = ((place - lines) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-9)
        nearest = lines + np.clip(part, 0, 1)[..., None] * along
        away = np.minimum(away, np.linalg.norm(nearest - place, axis=-1).min(axis=1))
    kept = {face.tobytes() for face in left(max_range=8.0, mount=0.4, elevations=(40.0, -40.0)).corners}
    near = whole.corners[low & (away > 3) & (away < 8)]  # nearer, beams may pass beneath what hangs
    assert len(near) and all(face.tobytes() in kept for face in near)


def test_rain_extinction_is_the_integral():
    """pi/4 1e-6 integral of D^2 2 N(D) dD with Marshall-Palmer drops, by quadrature."""
    size = np.linspace(0, 30, 300_001)
    rate = 25.0
    drops = 8000 * np.exp(-4.1 * rate**-0.21 * size)
    whole = np.pi / 4 * 1e-6 * np.trapezoid(2 * size**2 * drops, size)
    np.testing.assert_allclose(rain_extinction(rate), whole, rtol=1e-4)


def test_strongest_drop_follows_its_counts():
    """P(strongest < p) = exp(-count(p))."""
    powers, count, _, _ = _drop_table(30.0, 1.0)
    echo, place = strongest_drop(30.0, 1.0, np.random.default_rng(0), (200, 200))
    for k in (60, 100, 140):
        assert abs((echo < powers[k]).mean() - np.exp(-count[k])) < 0.02
    assert place[echo > 0].min() >= 1.0 and np.median(place[echo > 1e-4]) < 10


def test_fog_echo_grows_to_its_peak():
    alpha = fog_extinction(50.0)
    assert alpha == pytest.approx(0.06, rel=0.01)
    peak, place = fog_echo(alpha, np.array([1.0, 5.0, 20.0, 100.0]))
    assert np.all(np.diff(peak) >= 0) and peak[2] == peak[3]
    assert 1 < place[3] < 8


def test_weather_takes_far_returns_and_adds_near_ones():
    counts, reader = [], LabelledStreets(0, 1, SMALL)
    for weather in (Weather(), Weather(rain=10), Weather(rain=80), Weather(fog=80), Weather(fog=20)):
        reader.options = Options(weather=weather)  # of the same world
        frame = reader[0]
        distance = np.linalg.norm(frame.scan.xyz, axis=1)
        counts.append([(distance > 25).sum(), ((frame.raw & 0xFFFF) == 1).sum()])
        assert np.all((frame.scan.reflectance >= 0) & (frame.scan.reflectance <= 1))
    far, scattered = np.array(counts).T
    assert far[0] > far[1] > far[2] and far[0] > far[3] > far[4]
    assert scattered[0] == 0 and scattered[2] > scattered[1] > 0 and scattered[4] > scattered[3] > 0


def test_wrong_options_are_named():
    with pytest.raises(ValueError, match=r"a rate of 0\.1 to 100 turns per second, found 0$"):
        Options(rate=0)
    with pytest.raises(ValueError, match=r"\(0.36 to 216 km/h\), found -5.55556 m/s \(-20 km/h\)"):
        Options(frames=2, speed=-20 / 3.6)
    with pytest.raises(ValueError, match="expected rain of 0 to 200"):
        Weather(rain=-1)
    with pytest.raises(ValueError, match="expected a drive of at most"):
        draw_drive(0, 0, 3600, speed=30.0)
    for mount in (-2.0, 0.0, 500.0, np.nan):
        why = r"expected a mount above the road .* 0 to 100 m, found (-2|0|500)$|expected finite numbers"
        with pytest.raises(ValueError, match=why):
            LabelledStreets(0, 4, Sensor("line", (-10.0,), 64, mount=mount))
    with pytest.raises(IndexError, match=r"0\.\.3, got 4"):
        LabelledStreets(0, 4, Sensor("line", (-10.0,), 64))[4]


@pytest.mark.parametrize(
    ("asked", "found"),
    [
        ({"count": 1.5}, r"a whole number as count, found 1\.5"),
        ({"count": 0}, "count of at least 1, found 0"),
        ({"seed": 0.5}, r"a whole number as seed, found 0\.5"),
        ({"seed": -1}, "seed of at least 0, found -1"),
        ({"count": 2**63}, r"at most 2\^62 - 1 scans, found 9223372036854775808"),
        ({"count": 2**61, "options": Options(frames=2)}, r"at most 2\^62 - 1 scans, found 4611686018427387904"),
        ({"sensor": "vlp-61"}, "a sensor of .* found 'vlp-61'"),
    ],
)
def test_wrong_numbers_of_streets_are_named(asked: dict, found: str):
    with pytest.raises(ValueError, match=f"expected {found}"):
        LabelledStreets(**asked)
    if "options" not in asked and asked.get("count") != 2**63:
        with pytest.raises(ValueError, match=f"expected {found}".replace("count", "length")):
            SyntheticStreets(**{{"count": "length"}.get(name, name): value for name, value in asked.items()})


def test_frames_are_whole_and_sensors_may_be_words():
    with pytest.raises(ValueError, match=r"expected a whole number as frames, found 2\.5"):
        Options(frames=2.5)  # type: ignore[arg-type]
    streets = LabelledStreets(np.int64(0), np.int64(2), "vlp-16", Options(frames=np.int64(3)))  # type: ignore[arg-type]
    assert streets.sensor == SENSORS["vlp-16"] and len(streets) == 6
    assert [type(number) for number in (streets.seed, streets.count, streets.options.frames)] == [int, int, int]


def test_a_perfect_sensor_reports_what_its_beams_meet(still: list[Frame]):
    """The same beams: all that was seen and more of it, without noise or reflectance, and no weather."""
    real, perfect = still[0], LabelledStreets(0, 48, SMALL, Options(perfect=True))[4]
    assert len(perfect.scan) > len(real.scan) and not perfect.scan.reflectance.any()
    assert perfect.scan.ring is not None and real.scan.ring is not None
    places = [set(zip(f.scan.ring.tolist(), f.scan.time.tolist(), strict=True)) for f in (perfect, real)]  # type: ignore[union-attr]
    assert len(places[1] - places[0]) < 0.001 * len(places[1])
    assert sum(b.points for b in perfect.boxes) >= 0.95 * sum(b.points for b in real.boxes)
    assert [b.centre for b in perfect.boxes] == [b.centre for b in real.boxes]
    with pytest.raises(ValueError, match="expected clear weather"):
        Options(perfect=True, weather=Weather(rain=1))


def test_more_comes_beside_what_is_there():
    """People in groups, motorcycles, works and cyclists: all else of the world stays where it was, to the bit."""
    more = Density(groups=3, motorcycles=3, works=2, cyclists=3)
    plain, crowded = (world(0, density) for density in (TODAY, more))
    before = {corners.tobytes() for corners in plain.corners}
    after = {corners.tobytes() for corners in crowded.corners}
    assert before <= after and len(after) > len(before) + 1000
    np.testing.assert_array_equal(plain.poses, crowded.poses)
    kinds = [[str(kind) for kind in actors_of(world).kind] for world in (plain, crowded)]
    for kind in ("person", "motorcycle", "bicyclist"):
        assert kinds[1].count(kind) > kinds[0].count(kind) + 3


def test_heavy_vehicles_walls_barriers_panels_and_garages_come_beside_what_is_there():
    more = Density(heavy=4, walls=3, barriers=1, panels=3, garages=2)
    plain, full = (world(0, density) for density in (TODAY, more))
    before, after = ({corners.tobytes() for corners in of.corners} for of in (plain, full))
    assert before <= after and len(after) > len(before) + 1000
    np.testing.assert_array_equal(plain.poses, full.poses)
    kinds = full.things["kind"].tolist()
    assert {"guard rail", "panel"} <= set(kinds) and set(kinds) & {"concrete barrier", "high wall", "board fence"}
    assert len(full.fronts) > len(plain.fronts)
    actors = actors_of(full)
    heavy = np.isin(actors.kind, ["lorry", "coach", "trailer"])
    assert heavy.sum() > 3 and np.all(actors.size[heavy][:, 0] > 2.8)
    vehicles = np.flatnonzero(np.isin(actors.kind, ["car", "van", "truck", "bus", "lorry", "coach", "trailer"]))
    for one in np.flatnonzero(heavy):  # a trailer is 5 m long; a lorry and a car's halves are 12 m
        gap = np.linalg.norm(actors.place[vehicles, :2] - actors.place[one, :2], axis=1)
        assert np.sort(gap)[1] > 5.9


def test_riders_walkers_and_racks_come_beside_what_is_there_and_ride_into_nobody():
    more = Density(riders=6, walkers=6, racks=2)
    plain, full = (world(0, density) for density in (TODAY, more))
    before, after = ({corners.tobytes() for corners in of.corners} for of in (plain, full))
    assert before <= after and len(after) > len(before) + 1000
    kinds = [[str(kind) for kind in actors_of(of).kind] for of in (plain, full)]
    for kind, least in (("person", 8), ("bicyclist", 2), ("motorcyclist", 2), ("bicycle", 4)):
        assert kinds[1].count(kind) >= kinds[0].count(kind) + least
        shapes = full.things["variant"][full.things["kind"] == kind]
        assert (shapes >= USUAL[kind]).any() and set(plain.things["kind"]) <= set(full.things["kind"])
    road, actors = full.ground.roads[0], actors_of(full)
    rides = np.isin(actors.kind, ["bicyclist", "motorcyclist"]) & (actors.pace == TRAFFIC)
    along, aside = road.coordinates(actors.place[:, 0], actors.place[:, 1])
    assert rides.sum() > 5 and (np.abs(aside[rides]) < road.half).all()
    facing = np.cos(actors.yaw[rides] - road.at(along[rides], aside[rides])[2])
    assert (np.sign(facing) == -np.sign(aside[rides])).all()  # with the traffic of their side
    on_road = np.isin(actors.kind, ["car", "van", "truck", "bus"])
    for one in np.flatnonzero(rides):
        near = (np.abs(along[on_road] - along[one]) < 3) & (np.abs(aside[on_road] - aside[one]) < 1)
        assert not near.any()
    where, beside = road.coordinates(full.poses[:, 0], full.poses[:, 1])
    near = np.abs(where[:, None] - along[rides]) + 3 * np.abs(beside[:, None] - aside[rides])
    assert near.min() > 5


def test_riders_of_drives_follow_the_traffic():
    drive = draw_drive(2, 0, 2.0, Density(riders=5, traffic=0.5))
    moment = drive.moment(1.0)
    rides = moment.present & np.isin(drive.actors.kind, ["bicyclist", "motorcyclist"]) & (drive.number == 0)
    speed = np.linalg.norm(moment.velocity[rides], axis=1)
    assert rides.sum() > 4 and speed.max() > 3


def test_shapes_of_people_and_two_wheelers_stand_on_the_ground_as_large_as_they_are():
    sizes = {"person": (0.9, 2.1), "bicyclist": (1.0, 2.2), "motorcyclist": (1.3, 2.3), "bicycle": (0.8, 1.6),
             "motorcycle": (0.9, 1.8)}  # fmt: skip
    for kind, (low, high) in sizes.items():
        assert len(library()[kind]) > USUAL[kind]
        for shape in library()[kind]:
            bottom, top = shape.corners[..., 2].min(), shape.corners[..., 2].max()
            assert abs(bottom) < 0.08 and low < top < high, (kind, bottom, top)
            assert set(shape.label) == {CLASS_NUMBER[kind]}


def test_lorries_and_trailers_have_boxes_and_their_own_classes():
    made = LabelledStreets(3, 64, SMALL, Options(density=Density(heavy=8)))
    seen = [(box.kind, box.points, frame.raw) for frame in (made[k] for k in range(0, 64, 4)) for box in frame.boxes]
    raws = {"lorry": 18, "coach": 13, "trailer": 20}
    for kind, raw in raws.items():
        found = [words for word, points, words in seen if word == kind and points > 5]
        assert found and any((words & 0xFFFF == raw).any() for words in found)


def test_cyclists_ride_forward_beside_the_road():
    drive = draw_drive(1, 0, 2.0, Density(cyclists=4, traffic=0))
    moment = drive.moment(1.0)
    rides = moment.present & (drive.actors.kind == "bicyclist") & (drive.number >= 0)
    speed = np.linalg.norm(moment.velocity[rides], axis=1)
    assert rides.sum() > 5 and np.all((speed > 3.8) & (speed < 6.2))
    ahead = np.column_stack([np.cos(moment.yaw[rides]), np.sin(moment.yaw[rides])])
    np.testing.assert_allclose(np.sum(ahead * moment.velocity[rides, :2], axis=1), speed, rtol=0.02)


def test_cyclists_brake_before_they_wait_at_the_main_road():
    """At 2 m/s^2, where they have the 9 m for it that it takes at 6 m/s; none passes the one before."""
    waits = 0
    for number in range(3):
        drive = set_apart(draw_drive(5, number, 15.0, Density(cyclists=4)))
        rides = np.flatnonzero((drive.actors.kind == "bicyclist") & (drive.number > 0) & (drive.ahead != 0))
        track = drive.ahead[rides] * drive.along[:, rides]
        speed = np.diff(track, axis=0) / STEP
        far = (speed[0] > 3.9) & (speed[-1] == 0) & (np.ptp(track, axis=0) > 9.1)
        waits += int(far.sum())
        np.testing.assert_array_less(-2.001, np.diff(speed[:, far], axis=0) / STEP)
        assert (speed > -1e-6).all()
        for road in np.unique(drive.number[rides]):
            for way in (-1, 1):
                mine = track[:, (drive.number[rides] == road) & (drive.ahead[rides] == way)]
                apart = np.diff(mine[:, np.argsort(mine[0])], axis=1)
                assert (apart > np.minimum(apart[0], 2.4) - 1e-6).all()
    assert waits > 10


def test_a_cyclist_beyond_the_ends_of_all_roads_stands():
    plain = draw_drive(5, 2, 15.0, Density(cyclists=4))
    assert np.isfinite(plain.aside).all()
    drive = set_apart(plain)
    moment = drive.moment(1.0)
    assert np.isfinite(moment.place).all() and np.isfinite(moment.velocity).all()


def test_cyclists_roll_off_kerbs_and_do_not_fall():
    """Their height changes with their velocity, where a side road meets theirs too."""
    lowest = 1.0
    for number in range(3):
        drive = draw_drive(0, number, 4.0, Density(cyclists=2, traffic=0))
        rides = (drive.actors.kind == "bicyclist") & (drive.number >= 0)
        for time in np.arange(0.05, 3.9, 0.1):
            before, after = drive.moment(time), drive.moment(time + 0.1)
            both = rides & before.present & after.present
            fall = (after.place - before.place)[both, 2] - 0.05 * (after.velocity + before.velocity)[both, 2]
            assert np.abs(fall).max(initial=0) < 0.03
            x, y, z = before.place[both].T
            lowest = min(lowest, (z - drive.world.ground.height(x, y)).min(initial=1))
    assert lowest < 0.02  # some do cross


def test_where_kerbs_end_is_asked_once_for_everyone_however_many_roads_a_drive_has(monkeypatch: pytest.MonkeyPatch):
    drive = draw_drive(0, 0, 60.0)
    asked: list[int] = []
    carriageway = Ground.carriageway

    def counted(ground: Ground, x: np.ndarray, y: np.ndarray, skip: int = -1) -> np.ndarray:
        asked.append(skip)
        return carriageway(ground, x, y, skip)

    monkeypatch.setattr(Ground, "carriageway", counted)
    drive.moment(1.0)
    assert len(drive.world.ground.roads) > 4 and asked == 3 * [-1]  # now, before and after


def test_kerbs_are_as_high_as_asked_and_all_else_stays():
    low, plain = (world(0, Density(kerbs=k)) for k in (0.5, 1))
    assert low.ground.kerb == pytest.approx(0.06) and plain.ground.kerb == 0.12
    np.testing.assert_array_equal(low.corners[..., :2], plain.corners[..., :2])
    raised = plain.corners[..., 2] - low.corners[..., 2]
    assert np.isclose(raised, 0, atol=1e-5).any() and np.allclose(raised[np.abs(raised) > 1e-3], 0.06, atol=1e-3)


def test_recordings_differ_as_days_do():
    """Four scans share a sensor; another day it stands and answers otherwise, and so does the same place's scan."""
    streets = RecordedStreets(5, 32)
    first, other = streets.recording(3), streets.recording(4)
    assert streets.recording(0) == first and other.sensor.mount != first.sensor.mount
    assert other.optics.loss != first.optics.loss
    image = streets.image(20)
    again = RecordedStreets(5, 99).image(20)
    np.testing.assert_array_equal(image.range, again.range)
    np.testing.assert_array_equal(image.reflectance, again.reflectance)
    assert image.sensor == streets.recording(20).sensor and image.label is not None


def test_people_are_as_large_as_kittis():
    """KITTI's mean pedestrian is 0.84 m long, 0.66 m wide and 1.76 m high, with the annotators' margin."""
    sizes = [np.ptp(one.corners.reshape(-1, 3), axis=0) + 2 * MARGIN for one in library()["person"]]
    np.testing.assert_allclose(np.mean(sizes, axis=0), [0.84, 0.66, 1.76], atol=0.12)
    assert np.ptp(sizes, axis=0)[0] > 0.3  # they are met at different moments of their step
