"""How bright the surfaces of generated scans read: patches go, kinds of ground differ as streets' do, markings stay."""

from dataclasses import replace

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.streets.hdl64e import hidden, lasers, unevenness
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.streets.sensor_model import flat_ground
from lidarsynth.systems.cascade.shading import _around, _box, shaded

ROAD, SIDEWALK, GROWS, WALL = (CLASS_NUMBER[name] for name in ("road", "sidewalk", "vegetation", "building"))
KITTI = ls.get_sensor("hdl-64e-kitti")


def flat(sensor: Sensor, label: np.ndarray) -> RangeImage:
    """Flat ground under the horizon, and 10 m above it."""
    down = sensor.directions()[..., 2]
    metres = np.where(down < -0.03, -sensor.mount / np.minimum(down, -0.03), 10).astype(np.float32)
    there = ~hidden(sensor)
    return RangeImage(metres * there, 0.3 * there.astype(np.float32), there, sensor, label)


def rows_of(sensor: Sensor) -> np.ndarray:
    return np.broadcast_to(np.arange(sensor.height)[:, None], (sensor.height, sensor.width))


@pytest.mark.parametrize("size", [(8, 12, 2, 3), (5, 9, 7, 1)])
def test_sums_in_boxes_are_those_of_a_ring(size: tuple[int, int, int, int]) -> None:
    height, width, tall, wide = size
    values = np.random.default_rng(0).random((height, width))
    for row, column in ((0, 0), (height - 1, width - 1), (2, 5)):
        rows = slice(max(row - tall, 0), row + tall + 1)
        columns = np.arange(column - wide, column + wide + 1) % width
        np.testing.assert_allclose(_box(values, tall, wide)[row, column], values[rows][:, columns].sum())
    np.testing.assert_array_equal(_around(values, np.zeros((height, width), bool)), values)


def test_flat_ground_reads_as_that_of_streets() -> None:
    image = SyntheticStreets(616, 16, KITTI).image(5)
    seen, expected = ~hidden(KITTI), np.zeros(image.shape, np.float32)
    expected[seen] = flat_ground("road", image.range[seen], KITTI.mount, lasers(KITTI))
    road = image.mask & (image.label == ROAD) & (image.range < 15)
    assert road.sum() > 3000
    assert abs(np.median(image.reflectance[road] - expected[road])) < 0.03
    assert np.corrcoef(image.reflectance[road], expected[road])[0, 1] > 0.7


def test_dark_patches_of_what_grows_go_and_those_of_walls_stay() -> None:
    rows = rows_of(KITTI)
    for label, share in ((GROWS, 0.35), (WALL, 1.0)):
        image = flat(KITTI, np.where(rows < 24, label, ROAD))
        even = image.reflectance.copy()
        even[8:12, 300:308] = 0.0  # a cell of a grid
        found = shaded(even, image, own=True)
        assert (np.abs(0.3 - found[8:12, 300:308]) <= 0.3 * share + 0.02).all()
        if share == 1:
            np.testing.assert_array_equal(found[:24], even[:24])


@pytest.mark.parametrize("word", ["hdl-64e-kitti", "os1-64", "vlp-16"])
def test_a_sidewalk_that_reads_as_the_road_gets_brighter_and_the_scan_does_not(word: str) -> None:
    sensor = ls.get_sensor(word)
    image = flat(sensor, np.full((sensor.height, sensor.width), ROAD))
    image.label[:, : sensor.width // 4] = SIDEWALK
    ground = image.mask & (sensor.directions()[..., 2] < -0.06) & (image.range < 15)
    walk = ground & (image.label == SIDEWALK)
    even = np.where(image.mask, 0.2 - unevenness(sensor), 0).astype(np.float32)
    found = shaded(even, image, own=True)
    brighter = [float(np.median(found[part] - even[part])) for part in (walk, ground & ~walk)]
    assert brighter[0] > brighter[1] + 0.02
    assert abs(np.median(found[ground]) - np.median(even[ground])) < 0.03


@pytest.mark.parametrize("word", ["hdl-64e-kitti", "os1-64", "vlp-16"])
def test_layouts_of_dark_and_of_bright_sensors_read_as_bright_as_streets(word: str) -> None:
    """Each was as bright as a sensor of training, so that the scans of one sensor differed by a factor of five."""
    sensor = ls.get_sensor(word)
    image = flat(sensor, np.where(rows_of(sensor) < sensor.height // 3, WALL, ROAD))
    ground = image.mask & (image.label == ROAD) & (image.range < 15)
    expected = np.zeros(image.shape, np.float32)
    seen = ~hidden(sensor)
    expected[seen] = flat_ground("road", image.range[seen], sensor.mount, lasers(sensor))
    even = np.where(image.mask, 0.3 - unevenness(sensor), 0).astype(np.float32)
    dark, bright = (shaded(even + step, image) for step in (-0.1, 0.2))
    np.testing.assert_allclose(dark, bright, atol=1e-5)
    assert abs(np.median(dark[ground] - expected[ground])) < 0.01
    wall = image.mask & (image.label == WALL)
    assert abs(np.median((dark - even)[wall]) - np.median((dark - even)[ground])) < 0.05


def test_of_no_ground_one_cannot_tell_how_bright_a_scan_is() -> None:
    image = flat(KITTI, np.where(rows_of(KITTI) < 62, WALL, ROAD))
    image.label[62:, 9:] = WALL
    even = image.reflectance / 3
    np.testing.assert_array_equal(shaded(even, image)[:62], even[:62])


def test_markings_stay() -> None:
    image = flat(KITTI, np.full((64, 1024), ROAD))
    even = np.where(image.mask, 0.2 - unevenness(KITTI), 0).astype(np.float32)
    plain = shaded(even, image)
    marked = even.copy()
    marked[40:44, 500:504] += 0.25
    assert (shaded(marked, image) - plain)[40:44, 500:504][image.mask[40:44, 500:504]].min() > 0.2


def test_what_did_not_return_tells_nothing() -> None:
    image = flat(KITTI, np.where(rows_of(KITTI) < 24, GROWS, ROAD))
    even = image.reflectance.copy()
    there = image.mask & (np.random.default_rng(0).random(image.shape) < 0.5)
    lost = replace(image, range=image.range * there, mask=there)
    one, other = (shaded(np.where(there, even, value), lost)[there] for value in (0.0, 0.9))
    np.testing.assert_allclose(one, other, atol=1e-6)
