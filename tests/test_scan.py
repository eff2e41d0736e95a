"""Scan and RangeImage: shapes that fit, points out of images and images out of parts of images."""

from dataclasses import replace

import numpy as np
import pytest

from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import get_sensor

SENSOR = get_sensor("hdl-64e-kitti").resized(16, 64)


@pytest.fixture
def image() -> RangeImage:
    rng = np.random.default_rng(0)
    mask = rng.random((16, 64)) < 0.8
    distance = np.where(mask, rng.uniform(5, 60, mask.shape), 0).astype(np.float32)
    reflectance = (rng.random(mask.shape, np.float32) * mask).astype(np.float32)
    label = np.where(mask, rng.integers(1, 20, mask.shape), 0)
    return RangeImage(distance, reflectance, mask, SENSOR, label)


def test_a_scan_picks_points_from_all_its_fields():
    scan = Scan(np.zeros((5, 3), np.float32), np.arange(5) / 5, ring=np.arange(5), label=np.arange(5) + 10)
    some = scan[np.array([True, False, True, False, True])]
    assert len(some) == 3 and some.ring.tolist() == [0, 2, 4] and some.label.tolist() == [10, 12, 14]
    assert some.time is None
    assert len(scan[1:3]) == 2 and scan[np.array([4, 4])].ring.tolist() == [4, 4]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"xyz": np.zeros((3, 4))}, r"xyz must be \(N, 3\), got \(3, 4\)"),
        ({"xyz": np.zeros(3)}, r"xyz must be \(N, 3\), got \(3,\)"),
        ({"reflectance": np.zeros(2)}, r"reflectance must be \(3,\) like xyz, got \(2,\)"),
        ({"ring": np.zeros((3, 1))}, r"ring must be \(3,\) like xyz, got \(3, 1\)"),
        ({"time": np.zeros(4)}, r"time must be \(3,\) like xyz, got \(4,\)"),
        ({"label": np.zeros(0)}, r"label must be \(3,\) like xyz, got \(0,\)"),
    ],
)
def test_scans_that_do_not_fit_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        Scan(**{"xyz": np.zeros((3, 3)), "reflectance": np.zeros(3), **fields})


@pytest.mark.parametrize("name", ["range", "reflectance", "mask", "label"])
def test_images_that_do_not_fit_their_sensor_are_refused(image, name):
    with pytest.raises(ValueError, match=rf"{name} must be \(16, 64\), the sensor's beams and columns, got \(16, 32\)"):
        replace(image, **{name: np.zeros((16, 32))})
    with pytest.raises(ValueError, match=r"xyz must be \(16, 64, 3\), got \(16, 64\)"):
        replace(image, xyz=np.zeros((16, 64)))


def test_an_image_becomes_the_points_of_its_measured_pixels(image):
    scan = image.to_scan()
    rows, columns = np.nonzero(image.mask)
    assert len(scan) == image.mask.sum() == len(rows)
    np.testing.assert_array_equal(scan.ring, rows)
    np.testing.assert_array_equal(scan.label, image.label[rows, columns])
    np.testing.assert_array_equal(scan.reflectance, image.reflectance[rows, columns])
    np.testing.assert_allclose(np.linalg.norm(scan.xyz, axis=1), image.range[rows, columns], rtol=1e-5)


def test_an_image_of_its_own_points_is_the_same_image(image):
    assert image.mask[-1].any() and image.mask[0].any()
    for method in ("unfolding", "auto", "spherical"):
        again = project(image.to_scan(), SENSOR, method)
        np.testing.assert_array_equal(again.mask, image.mask)
        np.testing.assert_allclose(again.range, image.range, rtol=1e-5)
        np.testing.assert_array_equal(again.reflectance, image.reflectance)
        np.testing.assert_array_equal(again.label, image.label)


def test_measured_points_win_over_rays(image):
    moved = np.zeros((16, 64, 3), np.float32)
    moved[3, :10] = [1, 2, 3]
    points = replace(image, xyz=moved).points()
    np.testing.assert_array_equal(points[3, :10], moved[3, :10])
    np.testing.assert_array_equal(points[4:], image.points()[4:])


def test_keeping_pixels_empties_the_others_in_every_field(image):
    image = replace(image, xyz=image.points())
    known = np.zeros((16, 64), bool)
    known[::4] = True
    kept = image.keep(known)
    np.testing.assert_array_equal(kept.mask, image.mask & known)
    for name in ("range", "reflectance", "label", "xyz"):
        ours, theirs = getattr(kept, name), getattr(image, name)
        np.testing.assert_array_equal(ours[known], theirs[known])
        assert not ours[~known].any()
        assert ours.dtype == theirs.dtype
    with pytest.raises(ValueError, match=r"known must be \(16, 64\), got \(64, 16\)"):
        image.keep(known.T)
