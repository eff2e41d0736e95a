"""Labels of scans of which returns are missing here and there."""

from dataclasses import replace

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.streets.hdl64e import hidden
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade.sparse import BESIDE, missing, share_beside

OS1 = SENSORS["os1-64"].resized(width=512)


def street() -> RangeImage:
    return SyntheticStreets(98_011, 16, OS1).image(0)


def tenth(image: RangeImage) -> np.ndarray:
    return np.random.default_rng(0).random(image.shape) < 0.1


def beams(image: RangeImage) -> np.ndarray:
    known = np.zeros(image.shape, bool)
    known[::4] = True
    return known


@pytest.mark.parametrize(("known", "least"), [(tenth, 0.7), (beams, 0.81)])
def test_a_thinned_scan_is_named_nearly_as_well_as_the_whole_one(known, least: float):
    """As they are, 4 % of a tenth of the points were right, and 79 % of every fourth beam; 82 % of the whole scan."""
    image = street()
    scan = replace(image, label=None, surface=None).keep(known(image)).to_scan()
    named = ls.load("default").into(OS1).label(scan)
    truth = image.keep(known(image)).to_scan().label
    assert truth is not None and named.label is not None
    np.testing.assert_array_equal(named.xyz, scan.xyz)
    assert np.mean(named.label == truth) > least and named.label.min() >= 1


def test_what_is_missing_is_asked_for_near_returns_alone_and_of_thinned_scans_alone():
    image = street()
    blocked = np.zeros(image.shape, bool)
    blocked[-4:, 10:60] = True
    assert share_beside(image.mask, blocked) > BESIDE and not missing(image, blocked).any()
    half = image.keep(np.broadcast_to(np.arange(512) < 256, image.shape))
    assert not missing(half, blocked).any()
    thin = half.keep(tenth(half))
    asked = missing(thin, blocked)
    assert not (asked & (thin.mask | blocked)).any() and not asked[:, 270:500].any()
    assert asked[:, :256].mean() > 0.5
    assert not missing(image.keep(np.zeros(image.shape, bool)), blocked).any()


def test_scans_without_reflectance_that_are_thinned_are_named_too():
    image = street()
    plain = replace(image, label=None, surface=None, reflectance=np.zeros_like(image.reflectance))
    scan = plain.keep(tenth(image)).to_scan()
    named = ls.load("default").into(OS1).label(scan)
    truth = image.keep(tenth(image)).to_scan().label
    assert named.label is not None and np.mean(named.label == truth) > 0.6
    assert not named.reflectance.any()


def test_kittis_own_car_is_no_lack():
    image = SyntheticStreets(98_012, 16).image(0)
    share = share_beside(image.mask, hidden(image.sensor))
    assert share > 0.9
    assert share > share_beside(image.mask, np.zeros(image.shape, bool)) + 0.005  # were its rays counted
