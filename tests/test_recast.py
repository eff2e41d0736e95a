"""Cars and people of generated scans: found, placed, cast, and what else was drawn of them taken away."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.files.formats import read_image, write_labels
from lidarsynth.files.labels import read_labels, read_words
from lidarsynth.lidar.boxes import Box
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.streets.apart import meet
from lidarsynth.streets.hdl64e import hidden
from lidarsynth.streets.objects import cars_and_people, library
from lidarsynth.streets.raycast import Caster, FewTriangles
from lidarsynth.streets.shapes import Mesh, moved
from lidarsynth.streets.turn import sensor_pose
from lidarsynth.systems.cascade import recast as module
from lidarsynth.systems.cascade.canvas import canvas_of, mirrored, numbered
from lidarsynth.systems.cascade.placing import View, best_place
from lidarsynth.systems.cascade.recast import as_cast, recast

CAR, PERSON, ROAD = (CLASS_NUMBER[name] for name in ("car", "person", "road"))
SENSOR = replace(ls.get_sensor("os1-64"), mount=1.8)


def turn(sensor: Sensor) -> np.ndarray:
    return sensor_pose(sensor, np.zeros(6))[:3, :3].astype(np.float32)


def scene(sensor: Sensor, *things: Mesh) -> RangeImage:
    """A flat road and things on it, as exact first hits with their classes."""
    rays = (sensor.directions() @ turn(sensor).T).reshape(-1, 3)
    down = rays[:, 2]
    metres = np.where(down < -0.01, -sensor.mount / np.minimum(down, -0.01), np.inf)
    label = np.where(metres < np.inf, ROAD, 0)
    for thing in things:
        face, away, _ = FewTriangles(thing.corners).cast(np.zeros_like(rays), rays)
        nearer = (face >= 0) & (away < metres)
        metres, label = np.where(nearer, away, metres), np.where(nearer, thing.label[face], label)
    metres[metres > 60] = np.inf
    metres[hidden(sensor).ravel()] = np.inf
    there = np.isfinite(metres)
    shape = (sensor.height, sensor.width)
    parts = np.where(there, metres, 0).astype(np.float32), 0.2 * there.astype(np.float32), there
    return RangeImage(*(part.reshape(shape) for part in parts), sensor, (label * there).reshape(shape))


def standing(words: str, number: int, x: float, y: float, yaw: float, mount: float = SENSOR.mount) -> Mesh:
    return moved(cars_and_people()[words][number], x, y, -mount, yaw=yaw)


def blob(image: RangeImage, of: int) -> RangeImage:
    """What is of a class as a blob: all of it as far as its middle, give or take half a metre."""
    there = image.label == of
    rough = np.random.default_rng(0).uniform(-0.5, 0.5, there.sum())
    metres = image.range.copy()
    metres[there] = np.median(image.range[there]) + rough
    return replace(image, range=metres)


def points_of(image: RangeImage) -> np.ndarray:
    return image.sensor.points(image.range).reshape(*image.shape, 3)


def points(image: RangeImage, of: int) -> np.ndarray:
    return (image.sensor.points(image.range) @ turn(image.sensor).T)[(image.label == of) & image.mask]


def test_cars_and_people_are_the_streets_own() -> None:
    first, all_of_them = cars_and_people(), library()
    assert set(first) == {"car", "van", "truck", "bus", "person"}
    for words, shapes in first.items():
        for one, other in zip(shapes, all_of_them[words], strict=False):
            np.testing.assert_array_equal(one.corners, other.corners)


@pytest.mark.parametrize("scattered", [False, True])
def test_a_few_triangles_are_met_where_embree_says(scattered: bool) -> None:
    pytest.importorskip("embreex")
    rng, shape = np.random.default_rng(1), standing("car", 2, 8, 2, 0.5)
    azimuth, elevation = rng.uniform(-0.2, 0.7, 3000), rng.uniform(-0.3, 0.05, 3000)
    level = np.cos(elevation)
    rays = np.stack([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)], 1).astype(np.float32)
    starts = rays * rng.uniform(5, 9, (3000, 1)).astype(np.float32) if scattered else np.zeros_like(rays)
    theirs, ours = Caster(shape.corners).cast(starts, rays), FewTriangles(shape.corners).cast(starts, rays)
    assert (theirs[0] >= 0).mean() > 0.1
    assert (theirs[0] == ours[0]).mean() > 0.99
    same = (theirs[0] == ours[0]) & (ours[0] >= 0)
    for a, b in zip(theirs[1:], ours[1:], strict=True):
        np.testing.assert_allclose(a[same], b[same], rtol=1e-4)
    assert np.isinf(ours[1][ours[0] < 0]).all()


def test_no_ray_meets_nothing() -> None:
    face, away, cosine = FewTriangles(standing("car", 0, 8, 0, 0).corners).cast(np.zeros((0, 3)), np.zeros((0, 3)))
    assert len(face) == len(away) == len(cosine) == 0


def test_rays_along_the_side_of_a_place_do_not_meet_it() -> None:
    """Numpy warned of them, in the middle of `generate`."""
    seen = np.stack([np.linspace(8, 9, 30), np.zeros(30), np.full(30, -1)], 1).astype(np.float32)
    metres = np.linalg.norm(seen, axis=1)
    rays = seen / metres[:, None]
    yes, shape = np.ones(30, bool), module.KINDS[0].shapes[0]
    place = best_place(shape, 2, [seen], View(rays, metres, yes, ~yes, ~yes, yes.astype(np.float32)), -1.8, None)
    assert np.isfinite(place).all()
    assert place.share == 1


@pytest.mark.parametrize(("x", "y", "yaw"), [(9.0, 3.0, 0.4), (-7.0, -6.0, 1.3), (4.0, 14.0, 2.6)])
def test_a_car_is_found_where_it_stands(x: float, y: float, yaw: float) -> None:
    image = scene(SENSOR, standing("car", 1, x, y, yaw))
    canvas = canvas_of(image)
    (at,) = module._suggestions(canvas, module.KINDS[0])
    seen = canvas.points.reshape(-1, 3)[at]
    view = module._view(canvas, at, np.median(seen, 0), -SENSOR.mount, longer=1)
    place = best_place(module.KINDS[0].shapes[0], 24, [seen], view, -SENSOR.mount, None)
    assert np.hypot(place.x - x, place.y - y) < 0.35
    assert abs((place.yaw - yaw + np.pi / 2) % np.pi - np.pi / 2) < 0.12
    assert place.share > 0.9
    assert place.cost < 0.3


def dark_car(x: float, y: float, yaw: float) -> RangeImage:
    """A car of which the left third returns alone."""
    image = scene(SENSOR, standing("car", 1, x, y, yaw))
    rows, columns = np.nonzero(image.label == CAR)
    dark = columns > np.quantile(columns, 0.35)
    metres, mask = image.range.copy(), image.mask.copy()
    metres[rows[dark], columns[dark]], mask[rows[dark], columns[dark]] = 0, False
    return replace(image, range=metres, mask=mask, label=np.where(mask, image.label, 0))


def test_a_car_of_which_most_does_not_return_is_found_by_what_it_swallows() -> None:
    """Black on the road beside a heap: before, no car was put there, as it would have hidden what is farther."""
    x, y, yaw = 9.0, 3.0, 0.4
    canvas = canvas_of(dark_car(x, y, yaw))
    at = max(module._suggestions(canvas, module.KINDS[0]), key=len)
    seen = canvas.points.reshape(-1, 3)[at]
    view = module._view(canvas, at, np.median(seen, 0), -SENSOR.mount, longer=1)
    blind = view._replace(lost=np.zeros_like(view.lost))
    found, missed = (best_place(module.KINDS[0].shapes[0], 24, [seen], each, -SENSOR.mount, None)
                     for each in (view, blind))  # fmt: skip
    assert view.lost @ view.weight > 0.5 * (view.own @ view.weight)
    assert np.hypot(found.x - x, found.y - y) < 0.7
    assert found.cost < 0.4 < missed.cost


def test_what_does_not_return_elsewhere_is_not_swallowed() -> None:
    canvas = canvas_of(dark_car(9.0, 3.0, 0.4))
    at = max(module._suggestions(canvas, module.KINDS[0]), key=len)
    middle = np.median(canvas.points.reshape(-1, 3)[at], 0)
    before = module._swallowed(canvas, at, middle, -SENSOR.mount)
    assert len(before) > 100
    rows, columns = np.divmod(at, SENSOR.width)
    canvas.metres[rows.max() - 3 :, columns.min() - 40 : columns.min() - 10] = 0
    np.testing.assert_array_equal(module._swallowed(canvas, at, middle, -SENSOR.mount), before)


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (12.0, -6.0)])
def test_a_blob_becomes_a_car_that_stands_on_the_road(tilt: tuple[float, float]) -> None:
    sensor = replace(SENSOR, tilt=tilt)
    truth = scene(sensor, standing("car", 1, 9.0, 3.0, 0.4))
    drawn = blob(truth, CAR)
    found = recast(drawn, np.random.default_rng(3))
    both = (truth.label == CAR) & (found.label == CAR) & found.mask
    assert both.sum() > 0.4 * (truth.label == CAR).sum()  # panes hardly return

    def off(image: RangeImage) -> float:
        return float(np.median(np.abs(image.range - truth.range)[both]))

    assert off(drawn) > 0.2
    assert off(found) < 0.2
    seen, true = (points(image, CAR)[:, 2] for image in (found, truth))
    assert abs(seen.min() - true.min()) < 0.3
    assert abs(seen.max() - true.max()) < 0.3
    rays = sensor.directions() @ turn(sensor).T
    far = np.abs(np.arctan2(rays[..., 1], rays[..., 0]) - np.arctan2(3.0, 9.0)) > 0.5
    assert (far & truth.mask).sum() > 5000
    np.testing.assert_array_equal(found.range[far], truth.range[far])


def test_a_row_of_parked_cars_that_was_drawn_as_one_heap_becomes_cars() -> None:
    row = [standing("car", number, x, 4.2, 0.02) for number, x in ((0, -5.0), (1, 0.5), (2, 6.0))]
    truth = scene(SENSOR, *row)
    mine = [(scene(SENSOR, one).label == CAR) & (truth.label == CAR) for one in row]
    drawn = truth
    for there in mine:
        rough = np.random.default_rng(0).uniform(-0.4, 0.4, there.sum())
        metres = drawn.range.copy()
        metres[there] = np.median(np.sort(metres[there])[: there.sum() // 2]) + rough
        drawn = replace(drawn, range=metres)
    between = (np.abs(points_of(drawn)[..., 0]) < 6) & (np.abs(points_of(drawn)[..., 1] - 4.2) < 1.2)
    drawn = replace(drawn, label=np.where(between, CAR, drawn.label))  # the road between them, too: one heap
    assert sum(len(at) > 500 for at in module._suggestions(canvas_of(drawn), module.KINDS[0])) == 1
    found = recast(drawn, np.random.default_rng(0))
    for there in mine:
        assert (found.label == CAR)[there].mean() > 0.35  # panes hardly return
        assert np.median(np.abs(found.range - truth.range)[there & (found.label == CAR) & found.mask]) < 0.5


def test_a_column_becomes_a_person() -> None:
    truth = scene(SENSOR, standing("person", 0, 7.0, -2.0, 0.3))
    drawn = blob(truth, PERSON)
    found = recast(drawn, np.random.default_rng(0))
    assert not np.array_equal(found.range, drawn.range)
    seen = points(found, PERSON)
    assert len(seen) > 60
    assert np.ptp(seen[:, 2]) < 2.1
    assert np.hypot(seen[:, 0] - 7.0, seen[:, 1] + 2.0).max() < 1.2


def called_a_car(metres: np.ndarray, there: np.ndarray) -> RangeImage:
    """A road, and pixels (H, W) called a car that end `metres` away."""
    image = scene(SENSOR)
    metres = np.where(there, metres, image.range).astype(np.float32)
    return replace(image, range=metres, mask=metres > 0, label=np.where(there, CAR, image.label))


def test_a_heap_that_is_no_car_becomes_what_is_beside_it() -> None:
    """Nine metres to either side, anywhere from 5 to 30 m: no place explains it."""
    points_of, rng = SENSOR.points(np.full((SENSOR.height, SENSOR.width), 12.0, np.float32)), np.random.default_rng(5)
    heap = (np.abs(points_of[..., 1]) < 9) & (points_of[..., 0] > 0) & (points_of[..., 2] > -1.7)
    drawn, bare = called_a_car(rng.uniform(5, 30, heap.shape), heap), scene(SENSOR)
    found = recast(drawn, rng)
    assert heap.sum() > 5000
    assert (found.label != CAR).all()
    near = heap & bare.mask & (bare.range < 20)
    assert near.sum() > 500
    np.testing.assert_allclose(found.range[near], bare.range[near], atol=0.15)
    np.testing.assert_array_equal(found.range[~heap], drawn.range[~heap])


@pytest.mark.parametrize("turned", [0, 512])
def test_what_a_heap_lost_goes_with_it_and_the_sky_stays(turned: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Holes in a heap ahead or behind, across the seam of the image, are filled; what is beside and above it is not."""
    monkeypatch.setattr(module, "KINDS", tuple(kind._replace(most=0) for kind in module.KINDS))  # no place is good
    points_of, rng = SENSOR.points(np.full((SENSOR.height, SENSOR.width), 12.0, np.float32)), np.random.default_rng(5)
    heap = (np.abs(points_of[..., 1]) < 4) & (points_of[..., 0] > 0) & (np.abs(points_of[..., 2] + 1) < 0.7)
    inner = (np.abs(points_of[..., 1]) < 2.5) & (points_of[..., 0] > 0) & (np.abs(points_of[..., 2] + 1) < 0.4)
    beside = (np.abs(points_of[..., 1] - 6) < 1) & (points_of[..., 0] > 0) & (np.abs(points_of[..., 2] + 1) < 0.4)
    heap, inner, beside = (np.roll(part, turned, 1) for part in (heap, inner, beside))
    drawn = called_a_car(rng.uniform(5, 30, heap.shape), heap)
    empty = inner | beside
    drawn = replace(drawn, range=np.where(empty, 0, drawn.range), mask=drawn.mask & ~empty)
    found, bare = recast(drawn, rng), scene(SENSOR)
    there = inner & bare.mask & (bare.range < 20)
    assert there.sum() > 100 and beside.sum() > 100
    np.testing.assert_allclose(found.range[there], bare.range[there], atol=0.15)
    assert not found.mask[beside].any()
    assert not found.mask[~heap & ~bare.mask].any()


def test_columns_that_are_gone_are_as_those_beyond_the_nearer_end_of_the_gap() -> None:
    left = np.array([0, 1, 2, 3, 9, 10, 11])
    found = mirrored(np.array([4, 5, 6, 7, 8]), left, 12)
    np.testing.assert_array_equal(found, [3, 2, 1, 10, 9])
    np.testing.assert_array_equal(mirrored(np.array([0, 11]), np.array([1, 2, 3, 9, 10]), 12), [1, 10])


def test_a_heap_below_the_ground_goes() -> None:
    drawn = blob(scene(SENSOR, standing("car", 0, 7.0, 3.0, 0.0)), CAR)
    there = drawn.label == CAR
    below = replace(drawn, range=np.where(there & (SENSOR.directions()[..., 2] < -0.1), 3 * drawn.range, drawn.range))
    below = replace(below, label=np.where(there & (below.range == drawn.range), 0, below.label))
    assert points(below, CAR)[:, 2].max() < -SENSOR.mount
    found = recast(below, np.random.default_rng(0))
    assert (below.label == CAR).sum() > 200 and not (found.label == CAR).any()


def test_a_wall_that_is_called_a_car_stays_as_it_was_drawn() -> None:
    rays = SENSOR.directions()
    metres = 9 / np.maximum(rays[..., 0], 0.1)
    wall = (np.abs(metres * rays[..., 1]) < 9) & (rays[..., 0] > 0.3) & (metres * rays[..., 2] > -1.6)
    drawn = called_a_car(metres, wall)
    found = recast(drawn, np.random.default_rng(0))
    assert wall.sum() > 5000
    np.testing.assert_array_equal(found.range, drawn.range)
    np.testing.assert_array_equal(found.label, drawn.label)


def test_a_scan_without_any_stays_bit_by_bit() -> None:
    image = scene(ls.get_sensor("hdl-64e-kitti"))
    found = recast(image, np.random.default_rng(0))
    for name in ("range", "reflectance", "mask", "label"):
        np.testing.assert_array_equal(getattr(found, name), getattr(image, name))


def test_the_same_seed_gives_the_same_scan() -> None:
    drawn = blob(scene(SENSOR, standing("car", 4, 8.0, -3.0, 0.1)), CAR)
    first, again, other = (recast(drawn, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.range, again.range)
    assert not np.array_equal(first.range, other.range)


def test_blocked_rays_and_limits_are_kept() -> None:
    sensor = ls.get_sensor("hdl-64e-kitti")
    drawn = blob(scene(sensor, standing("car", 3, 5.0, 2.5, 0.0, sensor.mount)), CAR)
    found = recast(drawn, np.random.default_rng(4))
    assert not np.array_equal(found.range, drawn.range)
    assert not found.mask[hidden(sensor)].any()
    np.testing.assert_array_equal(found.mask, found.range > 0)
    assert (found.reflectance[~found.mask] == 0).all()
    assert found.range[found.mask].min() >= sensor.min_range
    assert found.range.max() <= sensor.max_range


def test_what_is_cast_has_its_class_and_the_rest_what_is_seen() -> None:
    image = scene(SENSOR, standing("car", 1, 9.0, 3.0, 0.4))
    seen = replace(image, label=np.where(image.mask, CLASS_NUMBER["terrain"], 0))
    (named,) = as_cast([seen], [image])
    car = image.label == CAR
    assert named.label is not None
    assert (named.label[car] == CAR).all()
    np.testing.assert_array_equal(named.label[~car], seen.label[~car])
    (bare,) = as_cast([replace(seen, label=None)], [image])
    assert bare.label is None


def in_box(box: Box, points: np.ndarray) -> np.ndarray:
    """(N,) bool: points (N, 3) of the sensor frame within a box."""
    away, c, s = points - box.centre, np.cos(box.yaw), np.sin(box.yaw)
    own = np.stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0], away[:, 2]], 1)
    return (np.abs(own) <= np.array(box.size) / 2 + 0.02).all(1)


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (5.0, -3.0)])
def test_what_is_cast_has_a_box_and_its_returns_a_number(tilt: tuple[float, float]) -> None:
    sensor = replace(SENSOR, tilt=tilt)
    things = standing("car", 1, 9, 3, 0.4), standing("person", 2, -6, 5, 1.0), standing("van", 0, 3, -12, 1.5)
    image = recast(blob(scene(sensor, *things), PERSON), np.random.default_rng(4))
    assert image.instance is not None
    assert sorted(box.kind for box in image.boxes) == ["car", "person", "van"]
    assert [box.instance for box in image.boxes] == [1, 2, 3]
    to_sensor, points = turn(sensor), points_of(image)
    for box in image.boxes:
        own = image.instance == box.instance
        assert box.points == own.sum() > 50
        assert set(image.label[own]) == {PERSON if box.kind == "person" else CAR}
        inside = in_box(box, points[own])
        assert inside.mean() > (0.97 if tilt == (0.0, 0.0) else 0.9)  # boxes stand upright in the sensor's frame
        x, y, yaw = {"car": (9, 3, 0.4), "person": (-6, 5, 0), "van": (3, -12, 1.5)}[box.kind]
        assert np.linalg.norm((to_sensor @ box.centre)[:2] - (x, y)) < 0.7
        if box.kind != "person":
            assert abs((box.yaw - yaw + np.pi / 2) % np.pi - np.pi / 2) < 0.2
            assert 3.5 < box.size[0] < 7 and 1.7 < box.size[1] < 2.5 and 1.3 < box.size[2] < 3
        assert box.occlusion < 0.05
    assert not image.instance[~image.mask].any() and image.instance.max() == 3


def test_a_box_tells_how_much_of_it_is_hidden() -> None:
    image = scene(SENSOR, standing("car", 1, 12, 5, 1.5), standing("van", 0, 8, 0, 1.5))
    boxes = recast(image, np.random.default_rng(1)).boxes
    near, far = sorted(boxes, key=lambda box: box.centre[0])
    assert near.occlusion < 0.05 and 0.3 < far.occlusion < 0.95


def test_boxes_of_what_is_kept_are_counted_anew() -> None:
    image = recast(scene(SENSOR, standing("car", 1, 9, 3, 0.4)), np.random.default_rng(4))
    (box,), half = image.boxes, np.zeros(image.shape, bool)
    half[::2] = True
    kept = image.keep(half)
    assert kept.boxes[0].points == (image.instance[half] == 1).sum() < box.points
    assert not kept.instance[~half].any()


def test_a_label_file_has_the_instances(tmp_path: Path) -> None:
    image = recast(scene(SENSOR, standing("car", 1, 9, 3, 0.4)), np.random.default_rng(4))
    scan = image.to_scan()
    write_labels(tmp_path / "a.label", scan)
    words = read_words(tmp_path / "a.label", len(scan))
    np.testing.assert_array_equal(words >> 16, scan.extra["instance"])
    np.testing.assert_array_equal(read_labels(tmp_path / "a.label", len(scan)), scan.label)
    for other in (-1, 70000):
        odd = replace(scan, extra={"instance": np.full(len(scan), other)})  # another program's numbers
        write_labels(tmp_path / "b.label", odd)
        np.testing.assert_array_equal(read_words(tmp_path / "b.label", len(scan)), words & 0xFFFF)
    ls.write(tmp_path / "a.npz", image)
    again = read_image(tmp_path / "a.npz")
    np.testing.assert_array_equal(again.instance, image.instance)


@pytest.mark.parametrize("rough", [False, True])
def test_nothing_is_cast_in_another(rough: bool) -> None:
    """What was left of a heap became a car in the one that had been put there."""
    row = [standing("car", number, 7, y, 1.5) for number, y in ((0, -4.6), (1, 0.0), (2, 4.4))]
    image = scene(SENSOR, *row, standing("person", 1, 4, 5, 0))
    image = blob(image, CAR) if rough else image
    each = [recast(image, np.random.default_rng(seed)).boxes for seed in range(4)]
    assert sum(map(len, each)) >= 8
    for boxes in each:
        stands = [np.array([*box.centre[:2], box.yaw, box.size[0] / 2, box.size[1] / 2]) for box in boxes]
        assert not any(meet(one, other) for i, one in enumerate(stands) for other in stands[:i])


def test_returns_of_a_class_within_a_box_of_it_have_its_number():
    sensor = Sensor("own", tuple(np.linspace(10, -20, 31)), 360, max_range=50.0)
    metres = np.full((31, 360), 12.0, np.float32)
    label = np.full(metres.shape, CLASS_NUMBER["car"])
    label[:, :180] = CLASS_NUMBER["building"]
    instance = np.zeros(metres.shape, np.int32)
    instance[10, 200] = 1
    points = sensor.points(metres)
    middle = points[15, 250].astype(float) / 12 * 12.5
    still = (0.0, 0.0, 0.0)
    turned = Box("van", 2, tuple(middle), (4.0, 2.0, 1.5), 0.4, still, tuple(middle), 0.4, still, 0, 0.0)
    other = Box(
        "person", 1, tuple(points[15, 300].astype(float)), (1.0, 1.0, 2.0), 0.0, still, still, 0.0, still, 1, 0.0
    )
    image = RangeImage(metres, metres * 0, metres > 0, sensor, label, instance=instance, boxes=(other, turned))
    found = numbered(image)
    away = points.reshape(-1, 3) - middle
    ahead, left = (
        away[:, 0] * np.cos(0.4) + away[:, 1] * np.sin(0.4),
        away[:, 1] * np.cos(0.4) - away[:, 0] * np.sin(0.4),
    )
    inside = (np.abs(ahead) <= 2) & (np.abs(left) <= 1) & (np.abs(away[:, 2]) <= 0.75)
    expected = np.where(inside.reshape(metres.shape), 2, instance)
    np.testing.assert_array_equal(found.instance, expected)
    assert inside.sum() > 20 and [box.points for box in found.boxes] == [1, inside.sum()]
