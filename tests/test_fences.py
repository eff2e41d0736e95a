"""Fences of generated scans: what was drawn of one becomes flat, or bars with what is behind; what stands in no line
stays."""

from dataclasses import replace

import numpy as np
import pytest
from test_recast import ROAD, SENSOR, points, scene, turn

import lidarsynth as ls
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.streets.hdl64e import hidden
from lidarsynth.streets.objects import FENCES, cars_and_people, fence, garden_wall, library
from lidarsynth.streets.shapes import Mesh, box, join, moved
from lidarsynth.systems.cascade.canvas import canvas_of
from lidarsynth.systems.cascade.fences import FENCE, SOLID, Line, _lines, _open_fences, _run
from lidarsynth.systems.cascade.recast import recast

WALL, PERSON = CLASS_NUMBER["building"], CLASS_NUMBER["person"]
AWAY = 6.0  # metres to the left, where fences of these tests stand


def row(piece: Mesh, first: float, last: float, sensor: Sensor = SENSOR) -> Mesh:
    """Pieces of two metres along x, AWAY to the left, on the ground."""
    return join(*(moved(piece, x, AWAY, -sensor.mount) for x in np.arange(first + 1, last, 2.0)))


def house(sensor: Sensor = SENSOR) -> Mesh:
    """A front 12 m to the left."""
    return moved(box((-30, 30), (0, 0.5), (0, 8), "wall", "building"), 0, 12, -sensor.mount)


def rough(image: RangeImage, metres: float, seed: int = 0) -> RangeImage:
    """What is of a fence, as far away as it is, give or take."""
    there = image.label == FENCE
    off = np.random.default_rng(seed).normal(0, metres, there.sum())
    metres_of = image.range.copy()
    metres_of[there] += off
    return replace(image, range=metres_of)


def thickness(image: RangeImage) -> float:
    """Metres, standard deviation of the fence's points across it."""
    return float(points(image, FENCE)[:, 1].std())


def test_pieces_are_the_streets_own() -> None:
    kinds = library()
    for ours, theirs in zip((fence(*how) for how in FENCES), kinds["fence"], strict=True):
        np.testing.assert_array_equal(ours.corners, theirs.corners)
    np.testing.assert_array_equal(garden_wall(0.9).corners, kinds["garden wall"][1].corners)


def test_shares_of_rays_that_meet_bars_are_as_they_are_met() -> None:
    for (height, share, mesh), how in zip(_open_fences(), FENCES, strict=True):
        spots = np.stack(np.meshgrid(np.linspace(-0.99, 0.99, 400), np.linspace(0.05, height, 200)), -1).reshape(-1, 2)
        met = np.zeros(len(spots), bool)
        for triangle in mesh.corners[:, :, [0, 2]]:
            a, b, c = triangle
            size = (b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0]
            if abs(size) < 1e-9:
                continue
            u, v = (
                (spots - a) @ np.array(way) / size for way in ([(c - a)[1], -(c - a)[0]], [-(b - a)[1], (b - a)[0]])
            )
            met |= (u >= 0) & (v >= 0) & (u + v <= 1)
        assert abs(met.mean() - share) < 0.06, how


def test_a_rough_wall_becomes_flat() -> None:
    truth = scene(SENSOR, row(garden_wall(1.3), -6, 6), house())
    drawn = rough(truth, 0.1)
    found = recast(drawn, np.random.default_rng(0))
    both = (truth.label == FENCE) & (found.label == FENCE)
    assert both.sum() > 0.9 * (truth.label == FENCE).sum()
    assert (found.label == FENCE).sum() < 1.1 * (truth.label == FENCE).sum()
    assert np.median(np.abs(found.range - truth.range)[both]) < 0.06
    assert thickness(found) < 0.5 * thickness(drawn)
    near = points(found, FENCE)
    assert abs(near[:, 2].max() + SENSOR.mount - 1.3) < 0.25
    away = (truth.label == WALL) & (found.label == WALL)
    np.testing.assert_array_equal(found.range[away], truth.range[away])


def test_what_is_half_there_becomes_bars_and_what_is_behind() -> None:
    """Two fifths of the rays were drawn on the fence, none as bars are; the others met the front or the ground."""
    solid, bare = scene(SENSOR, row(garden_wall(1.3), -6, 6), house()), scene(SENSOR, house())
    there = solid.label == FENCE
    kept = there & (np.random.default_rng(1).random(there.shape) < 0.4)
    parts = {name: np.where(there & ~kept, getattr(bare, name), getattr(solid, name)) for name in ("range", "label")}
    drawn = rough(replace(solid, **parts, mask=parts["range"] > 0), 0.1)
    found = recast(drawn, np.random.default_rng(0))
    of = found.label == FENCE
    assert 0.1 < of[there].mean() < 0.6
    assert thickness(found) < 0.05
    behind = there & ~of & found.mask & bare.mask
    assert behind.sum() > 0.3 * there.sum()
    assert np.median(np.abs(found.range - bare.range)[behind]) < 0.1
    assert ((found.label == bare.label) | (found.label == ROAD))[behind].mean() > 0.95
    assert upright(of, there) > upright(kept, there) + 0.15  # bars, no speckle


def upright(of: np.ndarray, there: np.ndarray) -> float:
    """How often a ray does as the one above does, of those that are there."""
    return float((of[1:] == of[:-1])[there[1:] & there[:-1]].mean())


def test_gates_stay_open_and_who_stands_before_a_fence_stays() -> None:
    person = moved(cars_and_people()["person"][0], -3, 4, -SENSOR.mount)
    both = join(row(garden_wall(1.3), -8, -2), row(garden_wall(1.3), 2, 8))
    truth = scene(SENSOR, both, house(), person)
    alone = recast(rough(scene(SENSOR, both, house()), 0.1), np.random.default_rng(0))
    gate = np.abs(points(alone, FENCE)[:, 0]) < 1.5
    assert not gate.any()
    found = recast(rough(truth, 0.1), np.random.default_rng(0))
    in_front = (truth.label == PERSON) & (found.label != PERSON)
    assert (truth.label == PERSON).sum() > 50
    assert in_front.mean() < 0.01


def test_what_stands_in_no_line_stays_bit_by_bit() -> None:
    """A heap of 4 m x 4 m that the classes call a fence."""
    image, rng = scene(SENSOR), np.random.default_rng(2)
    rays = SENSOR.directions() @ turn(SENSOR).T
    heap = (np.abs(np.arctan2(rays[..., 1], rays[..., 0]) - 0.3) < 0.25) & (np.abs(rays[..., 2]) < 0.12)
    metres = np.where(heap, rng.uniform(7, 12, heap.shape), image.range).astype(np.float32)
    drawn = replace(image, range=metres, mask=metres > 0, label=np.where(heap, FENCE, image.label))
    found = recast(drawn, rng)
    assert heap.sum() > 500
    np.testing.assert_array_equal(found.range, drawn.range)
    np.testing.assert_array_equal(found.label, drawn.label)


@pytest.mark.parametrize("high", [0.2, 4.0])
def test_what_is_too_low_or_too_high_for_a_fence_stays(high: float) -> None:
    drawn = scene(SENSOR, row(garden_wall(high), -6, 6))
    assert (drawn.label == FENCE).sum() > 100
    np.testing.assert_array_equal(recast(drawn, np.random.default_rng(0)).range, drawn.range)


def test_lines_of_a_corner_are_two() -> None:
    rng, along = np.random.default_rng(0), np.linspace(0, 6, 200)
    corner = np.concatenate([np.stack([along, 0 * along], 1), np.stack([0 * along, along], 1)])
    found = list(_lines(corner + rng.normal(0, 0.03, corner.shape), rng))
    assert len(found) == 2
    ways = np.abs([line.way for _, line in found])
    np.testing.assert_allclose(np.sort(ways.argmax(1)), [0, 1])
    assert (ways.max(1) > 0.99).all()


def test_rays_reach_a_line_where_it_is() -> None:
    line = Line(np.array([3.0, 4.0]), np.array([1.0, 0.0]))
    rays = np.array([[0.0, 1.0, 0.0], [0.6, 0.8, 0.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(line.reached(rays)[:2], [4.0, 5.0])
    assert np.isinf(line.reached(rays)[2])
    assert line.reached(rays)[3] > 1e5
    np.testing.assert_allclose(line.along(rays[:2]), [-3.0, -2.4])
    np.testing.assert_allclose(line.off(rays[:2]), [-3.0, -3.2])


def test_how_solid_a_fence_is_says_how_many_rays_end_on_it() -> None:
    for mesh, solid in ((garden_wall(1.3), True), (fence(*FENCES[0]), False)):
        canvas = canvas_of(scene(SENSOR, row(mesh, -6, 6), house()))
        (at,) = canvas.things(FENCE)
        ((chosen, line),) = _lines(canvas.points_at(at)[:, :2].astype(float), np.random.default_rng(0))
        run = _run(canvas, at[chosen], line)
        assert run is not None
        assert (run.solid > SOLID) == solid
        assert len(run.stretches) == 1
        assert abs(np.ptp(run.stretches) - 12) < 0.5


def test_blocked_rays_and_limits_are_kept_and_seeds_tell() -> None:
    sensor = ls.get_sensor("hdl-64e-kitti")
    drawn = rough(scene(sensor, row(garden_wall(1.3), -6, 6, sensor), house(sensor)), 0.1)
    found, again, other = (recast(drawn, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert not np.array_equal(found.range, drawn.range)
    np.testing.assert_array_equal(found.range, again.range)
    assert not np.array_equal(found.range, other.range)
    assert not found.mask[hidden(sensor)].any()
    np.testing.assert_array_equal(found.mask, found.range > 0)
    assert (found.label[~found.mask] == 0).all() and (found.reflectance[~found.mask] == 0).all()
    assert found.range[found.mask].min() >= sensor.min_range
    assert found.range.max() <= sensor.max_range
