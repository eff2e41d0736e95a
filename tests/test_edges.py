"""Edges between the columns of a drawn grid: they are anywhere between two, and surfaces go on up to them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.systems.cascade.edges import with_edges, with_edges_at

SENSOR = replace(SENSORS["vlp-16"], width=512)
COLUMNS, WIDTH = np.arange(0, 512, 4), 512


def walls() -> np.ndarray:
    """(512,) metres of an oblique wall, straight in 1 / range, before another, from column 100 to 199."""
    metres = 1 / (0.1 + 1e-4 * np.abs(np.arange(WIDTH) - 300.0))
    metres[100:200] = 1 / (0.2 - 2e-4 * np.arange(100))
    return metres.astype(np.float32)


def as_filled(metres: np.ndarray, label: np.ndarray) -> RangeImage:
    """All between two known columns as the one to the left: what the fill makes of edges, here everywhere."""
    left = COLUMNS[np.arange(WIDTH) // 4]
    image = np.tile(metres[left], (16, 1))
    return RangeImage(image, 0.02 * np.minimum(image, 20), image > 0, SENSOR, np.tile(label[left], (16, 1)))


@pytest.mark.parametrize(("place", "first"), [(0.1, 197), (0.3, 198), (0.6, 199), (0.9, 200)])
def test_an_edge_is_where_it_was_drawn_and_surfaces_go_on_up_to_it(place: float, first: int) -> None:
    metres = walls()
    near = np.arange(WIDTH) // 100 == 1
    found = with_edges_at(as_filled(metres, 1 + near), COLUMNS, np.full(128, place))
    assert (found.label[:, 190:first] == 2).all() and (found.label[:, first:210] == 1).all()
    edge = np.r_[97:101, 197:201]  # of which some are of the other wall now
    smooth = np.setdiff1d(np.arange(WIDTH), np.r_[edge, 0, 298:303, 509:512])
    np.testing.assert_allclose(found.range[:, smooth], np.tile(metres[smooth], (16, 1)), rtol=2e-3)
    beyond = 1 / (0.2 - 2e-4 * np.arange(97, 100))  # of the near wall, going on
    np.testing.assert_allclose(found.range[0, 197:first], beyond[: first - 197], rtol=1e-3)
    np.testing.assert_allclose(found.reflectance[0, 197:first], 0.02 * metres[196], rtol=1e-6)


def test_what_the_fill_has_said_of_a_pixel_itself_stays() -> None:
    image = as_filled(walls(), np.ones(WIDTH, int))
    metres = image.range.copy()
    metres[:, 42] += 0.5
    metres[:, 198] *= 1.01
    metres[3, 50] = 0
    said = replace(image, range=metres, mask=metres > 0)
    found = with_edges_at(said, COLUMNS, np.full(128, 0.1))
    np.testing.assert_array_equal(found.range[:, [42, 198]], metres[:, [42, 198]])
    assert found.range[3, 50] == 0 and not found.mask[3, 50]
    np.testing.assert_array_equal(found.range[:, COLUMNS], metres[:, COLUMNS])


def test_beside_nothing_a_surface_goes_on_and_nothing_is_beyond_the_sensors_limit() -> None:
    metres = walls()
    metres[COLUMNS[60:70]] = 0
    image = as_filled(metres, np.ones(WIDTH, int))
    found = with_edges_at(image, COLUMNS, np.full(128, 0.01))
    assert (found.mask == image.mask).all()
    np.testing.assert_allclose(found.range[0, 237:240], walls()[237:240], rtol=1e-3)  # the last column is 236
    far = replace(image, sensor=replace(SENSOR, max_range=float(metres[236]) * 1.0001))
    np.testing.assert_array_equal(with_edges_at(far, COLUMNS, np.full(128, 0.01)).range[0, 237:240], metres[236])


def test_a_layouts_own_columns_are_left_to_the_fill() -> None:
    image = as_filled(walls(), np.ones(WIDTH, int))
    rng = [torch.Generator().manual_seed(0)]
    assert with_edges([image], COLUMNS, rng)[0] is image
    finer = with_edges([image], np.arange(0, WIDTH, 2), rng)[0]
    assert (finer.range != image.range).any()
    np.testing.assert_array_equal(finer.range[:, ::2], image.range[:, ::2])
