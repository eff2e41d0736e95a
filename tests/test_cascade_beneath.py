"""A hole that reaches the lowest beam is filled where whoever made it says which rays found nothing."""

import numpy as np
import pytest
import torch

import lidarsynth as ls
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade.beneath import beneath

HOLE = (slice(4, 8), slice(10, 20))


def found(returned: np.ndarray, told: np.ndarray, closed: np.ndarray | None = None) -> np.ndarray:
    blocked = np.zeros_like(told) if closed is None else closed
    parts = (torch.from_numpy(part)[None, None] for part in (told, told & returned))
    return beneath(*parts, torch.from_numpy(blocked))[0, 0].numpy()


def road(sky: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Which rays return, all but of the uppermost beams, and what is told: all but a hole; (8, 32) each."""
    returned, told = np.ones((8, 32), bool), np.ones((8, 32), bool)
    returned[:sky], told[HOLE] = False, False
    return returned, told


def test_a_hole_down_to_the_lowest_beam_returns():
    returned, told = road()
    assert np.array_equal(found(returned, told), ~told)


def test_it_goes_around_the_turn():
    returned, told = (np.roll(part, 16, 1) for part in road())
    assert np.array_equal(found(returned, told), ~told)


def test_nothing_is_said_of_returns_alone():
    returned, told = road()
    assert not found(returned, told & returned).any()
    assert not found(*road(sky=0)).any()


def test_nothing_is_said_of_a_beam_of_which_little_is_known_or_most_found_nothing():
    returned, told = road()
    returned[6, :20] = False  # 10 of these are known, of 22
    assert np.array_equal(found(returned, told), ~told)
    returned[6, 20:22] = False
    assert np.array_equal(found(returned, told)[5], ~told[5]) and not found(returned, told)[6].any()
    told[7, :16] = False
    assert not found(returned, told)[7].any()


def test_nothing_is_said_of_a_hole_with_known_rays_below_or_none_above():
    returned, told = road()
    told[7] = True
    assert not found(returned, told).any()
    returned, told = road()
    told[:, 10:20] = False
    assert not found(returned, told).any()
    returned, told = road(sky=4)
    assert not found(returned, told).any()  # what is above it found nothing


def test_nothing_is_said_of_scattered_rays_and_blocked_ones():
    returned, told = road()
    told[HOLE] = np.arange(10) % 3 == 0
    assert not found(returned, told).any()
    returned, told = road()
    closed = np.zeros_like(told)
    closed[6:, 12:15] = True
    assert np.array_equal(found(returned, told, closed), ~told & ~closed)


@pytest.mark.parametrize("method", ["conditional", "sample"])
@pytest.mark.parametrize("word", ["os1-64", "vlp-16"])
def test_the_road_behind_a_sensor_is_filled(word, method):
    model = ls.load("default").into(word)
    image = SyntheticStreets(5151, 16, model.sensor).image(0)
    known = corrupt(image, "region:-8:-2:-4:4")
    dense = model.complete(image.keep(known), known, method=method)
    lost = image.mask & ~known
    assert lost.sum() > 200 and (dense.mask & lost).sum() > 0.8 * lost.sum()
    sure = dense.confidence
    if sure is not None:
        far = np.abs(dense.range - image.range)[lost]
        right = dense.mask[lost] & (far < 0.3 + 0.02 * image.range[lost])
        assert abs(sure[lost].mean() - right.mean()) < 0.25


def test_returns_alone_leave_it_to_the_network():
    model = ls.load("default").into("os1-64")
    image = SyntheticStreets(5151, 16, model.sensor).image(0)
    known = corrupt(image, "region:-8:-2:-4:4")
    lost = image.mask & ~known
    dense = model.complete(image.keep(known).to_scan())
    assert (dense.mask & lost).sum() < 0.5 * lost.sum()  # as it may be its carrier
