"""KITTI's own lasers: how much of what they read otherwise a scan shows, taken off for the network and put on again."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.streets import hdl64e
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade.response import AS_STREETS, Response
from lidarsynth.systems.cascade.unit import UNTOLD, Unit, as_streets, unit_of

KITTI = SENSORS["hdl-64e-kitti"]


@pytest.fixture(scope="module")
def streets() -> list[RangeImage]:
    """Four places of as many worlds, as the streets' lasers read them."""
    reader = SyntheticStreets(61, 64)
    return [reader.image(16 * k) for k in range(4)]


def every(image: RangeImage, step: int) -> np.ndarray:
    known = np.zeros(image.shape, bool)
    known[::step] = True
    return known


def test_what_is_read_otherwise_is_taken_off_and_put_on(streets: list[RangeImage]):
    unit = Unit(0.8)
    even = unit.even(streets[0])
    assert np.abs(even.reflectance - streets[0].reflectance).max() > 0.05
    np.testing.assert_array_equal(even.reflectance == 0, (streets[0].reflectance == 0) | (even.reflectance == 0))
    inside = (even.reflectance > 0) & (even.reflectance < 1)
    np.testing.assert_allclose(unit.read(even.reflectance, even)[inside], streets[0].reflectance[inside], atol=1e-6)
    assert Unit().even(streets[0]) is streets[0]


@pytest.mark.parametrize("step", [1, 2, 4, None])
def test_a_scan_shows_how_much_of_it_there_is(streets: list[RangeImage], step: int | None):
    """In every beam, every second and fourth, and in one point in ten."""
    scattered = np.random.default_rng(5).random(streets[0].shape) < 0.1
    for share in (0.0, 0.5, 1.0):
        read = (np.where(one.mask, Unit(share).read(one.reflectance, one), 0) for one in streets)
        seen = [replace(one, reflectance=shade) for one, shade in zip(streets, read, strict=True)]
        known = every(streets[0], step) if step else scattered
        assert np.mean([unit_of(one, known).share for one in seen]) == pytest.approx(share, abs=0.32)


def test_where_nothing_tells_it_is_half(streets: list[RangeImage]):
    few = np.zeros(streets[0].shape, bool)
    few[::32] = True
    assert unit_of(streets[0], few).share == UNTOLD
    scattered = np.random.default_rng(0).random(streets[0].shape) < 0.02
    assert unit_of(streets[0], scattered).share == UNTOLD


def test_other_sensors_models_tuned_to_kitti_and_scans_without_reflectance_stay(streets: list[RangeImage]):
    image, known = streets[0], every(streets[0], 2)
    other = replace(image, sensor=replace(KITTI, name="another"))
    dark = replace(image, reflectance=np.zeros_like(image.reflectance))
    darker = Response(scale=2.0)
    for one, response, tuned in ((other, AS_STREETS, False), (image, AS_STREETS, True), (image, darker, False),
                                 (dark, AS_STREETS, False)):  # fmt: skip
        even, unit = as_streets(one, known, response, tuned)
        assert even is one and unit == Unit()


def test_hidden_lasers_read_as_kitti_s_do(streets: list[RangeImage]):
    """Told a unit's scan, the likeliest image is that of the street, with the unit's pattern on the hidden beams."""
    model = ls.load("default").into(KITTI)
    for image in streets[:2]:
        known = every(image, 2)
        unit = replace(image, reflectance=np.where(image.mask, Unit(1.0).read(image.reflectance, image), 0))
        filled, plain = (model.complete(one.keep(known), known) for one in (unit, image))
        np.testing.assert_array_equal(filled.reflectance[known & image.mask], unit.reflectance[known & image.mask])
        both = filled.mask & plain.mask & ~known
        differs, should = (filled.reflectance - plain.reflectance)[both], hdl64e.misread(filled.range)[both]
        given = unit_of(unit, known).share - unit_of(image, known).share
        assert (differs * should).sum() / (should**2).sum() == pytest.approx(given, abs=0.1)
        assert given > 0.2


def test_real_scans_of_kitti_show_it(shared: Path, tmp_path: Path):
    paths = sorted((shared / "scans" / "test").glob("*.bin"))
    assert paths
    for path in paths:
        image = ls.load("nearest").into(KITTI).image_of(ls.read(path))
        assert unit_of(image, every(image, 4)).share > 0.5, path.name


def test_a_sensor_of_that_name_and_other_beams_is_another_one():
    few = Sensor(KITTI.name, tuple(np.linspace(10, -30, 32)), 256)
    many = replace(KITTI, elevations=tuple(np.linspace(15, -15, 64)))
    for sensor in (few, many):
        assert not hdl64e.hidden(sensor).any() and hdl64e.dimness(sensor) == () and hdl64e.written_out(sensor) == sensor
        assert hdl64e.shifts(sensor).shape == (sensor.height, 1) and len(hdl64e.lasers(sensor).loss)
    moved = replace(KITTI, elevations=tuple(0.1 + 1.02 * v for v in KITTI.elevations))
    assert hdl64e.hidden(moved).any(), "as of another day"
    image = SyntheticStreets(61, 16, few).image(0)
    known = every(image, 2)
    assert ls.load("default").into(few).complete(image.keep(known), known).mask[~known].any()


def test_the_tables_have_a_number_for_each_laser():
    off = hdl64e.misread(np.full((64, 3), 12.0, np.float32))
    np.testing.assert_allclose(off, np.array(hdl64e.RING_OFFSET)[:, None].repeat(3, 1), atol=1e-7)
    far = hdl64e.misread(np.full((64, 1), 12 * np.e, np.float32)) - off[:, :1]
    np.testing.assert_allclose(far[:, 0], hdl64e.RING_SLOPE, atol=1e-6)
