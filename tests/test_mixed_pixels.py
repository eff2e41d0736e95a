"""Mixed pixels: ranges between a surface and nothing go onto the surface; everything else stays."""

import numpy as np

from lidarsynth.lidar.mixed_pixels import without_mixed_pixels
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS

SENSOR = SENSORS["vlp-16"].resized(width=32)


def wall(distance: float = 10.0) -> np.ndarray:
    return np.full((16, 32), distance, np.float32)


def image(ranges: np.ndarray) -> RangeImage:
    return RangeImage(ranges, np.full_like(ranges, 0.5) * (ranges > 0), ranges > 0, SENSOR)


def test_blends_between_a_wall_and_nothing_go_onto_the_wall():
    ranges = wall()
    ranges[:, :8] = 0
    ranges[:, 8] = 3.0  # the blend
    mended = without_mixed_pixels(image(ranges))
    expected = wall()
    expected[:, :8] = 0
    np.testing.assert_array_equal(mended.range, expected)
    np.testing.assert_array_equal(mended.mask, expected > 0)


def test_the_seam_is_no_border():
    ranges = wall()
    ranges[:, 31] = 0
    ranges[:, 0] = 3.0
    assert without_mixed_pixels(image(ranges)).range[:, 0].min() == 10


def test_near_things_stay_where_nothing_is_empty_or_they_are_wide():
    pole = wall()
    pole[:, 15] = 3.0
    np.testing.assert_array_equal(without_mixed_pixels(image(pole)).range, pole)
    car = wall()
    car[8:, 10:20] = 4.0
    car[:8, 10:20] = 0  # its window
    mended = without_mixed_pixels(image(car)).range
    np.testing.assert_array_equal(mended[:, 12:18], car[:, 12:18])  # all but its corners


def test_full_and_empty_images_stay():
    for ranges in (wall(), wall(0)):
        np.testing.assert_array_equal(without_mixed_pixels(image(ranges)).range, ranges)
