"""Large holes are drawn as streets are, around what is known."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

import lidarsynth as ls
from lidarsynth.diffusion.samplers import generators
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade.holes import Told, _placed, with_holes_drawn, with_planes
from lidarsynth.systems.cascade.known import band_of, best_known
from lidarsynth.systems.filling import Filling

HDL = ls.get_sensor("hdl-64e-kitti")


@pytest.fixture(scope="module")
def halves() -> list[tuple[ls.RangeImage, ls.RangeImage]]:
    """A street of which all behind the car is lost, and two samples of the whole."""
    image = SyntheticStreets(4321, 16, HDL).image(0)
    known = ls.corrupt(image, "sector:180:180")
    model = ls.load("default")
    return [(image, model.complete(image.keep(known), known, method="repaint", seed=seed)) for seed in (1, 2)]


def test_what_is_known_stays_and_the_hole_is_a_street(halves: list[tuple[ls.RangeImage, ls.RangeImage]]):
    for image, drawn in halves:
        known = ls.corrupt(image, "sector:180:180")
        np.testing.assert_array_equal(drawn.range[known], np.where(image.mask, image.range, 0)[known])
        hole = ~known & drawn.mask
        far = [np.quantile(of.range[~known & of.mask], 0.9) for of in (image, drawn)]
        assert hole.sum() > 15_000 and far[1] > 0.6 * far[0], "no wall around the car"
        ground = []
        for of, mask in ((image, ~known & image.mask), (drawn, hole)):
            x, y, z = of.points()[mask].T
            ground.append(np.mean(np.abs(z[np.hypot(x, y) < 12] + HDL.mount) < 0.3))
        assert ground[1] > 0.5 * ground[0], "the ground goes on"


def test_what_is_drawn_reads_as_dim_as_the_beams_do():
    """Of beams that read 0.2 less than others, what is drawn does too: as much as what is known of the same street."""
    image, model = SyntheticStreets(4321, 16, replace(HDL, name="own")).image(0), ls.load("default")
    known = ls.corrupt(image, "sector:180:180")
    own, dim = model.into(image.sensor), np.full((64, 1), 0.2, np.float32)
    told = Told(image.range * image.mask, np.maximum(image.reflectance - dim, 0), known)
    how, rays_of = Filling("repaint", 2, 1), partial(own._grid_rays, count=1)
    with torch.inference_mode():
        parts = model.network, told, image.sensor, dim, rays_of, generators(1, 1), how, None
        drawn = with_holes_drawn(*parts)
    new = drawn.known & ~known & (drawn.metres > 0)
    assert drawn.reflectance[new].mean() < told.reflectance[known & image.mask].mean() + 0.08


def test_samples_of_a_hole_differ_by_their_seeds(halves: list[tuple[ls.RangeImage, ls.RangeImage]]):
    (image, one), (_, two) = halves
    both = ~ls.corrupt(image, "sector:180:180") & one.mask & two.mask
    assert np.median(np.abs(np.log(one.range[both] / two.range[both]))) > 0.01


def test_the_best_known_rows_are_the_same_of_each_band():
    told = np.zeros((64, 1024), bool)
    told[2::4] = True
    told[5, :600] = True  # more of this beam of its band is known, but not of the others
    rows, columns, cell = best_known(told)
    np.testing.assert_array_equal(rows, np.arange(2, 64, 4))
    assert cell.all() and len(columns) == 128
    np.testing.assert_array_equal(band_of(rows, 64, 16), np.arange(16))
    np.testing.assert_array_equal(band_of(columns, 1024, 128), np.arange(128))
    assert len(np.unique(best_known(told[:50])[0])) == 16  # bands of three and four rows


def test_new_pixels_are_put_where_the_hole_is_alone():
    told = Told(np.full((32, 256), 5.0, np.float32), np.zeros((32, 256), np.float32), np.ones((32, 256), bool))
    told.known[:, 128:] = False
    hole = np.zeros((16, 128), bool)
    hole[:, 70:] = True
    rows, columns = np.arange(32), np.arange(0, 256, 2)
    new = np.full((32, 128), 9.0), np.full((32, 128), 0.5)
    found = _placed(told, hole, *new, rows, columns, 8.0)
    assert not found.metres[:, 140::2].any() and found.known[:, 140::2].all() and not found.known[:, 141::2].any()
    np.testing.assert_array_equal(found.metres[:, :128], told.metres[:, :128])
    np.testing.assert_array_equal(found.known[:, 128:140], told.known[:, 128:140])
    assert not told.known[:, 140:].any(), "what was given is not changed"


def test_planes_go_on_between_the_beams_and_columns_that_were_drawn_in_a_hole():
    """Of 128 beams every second one is drawn: told these alone, the fill made rings that strayed by 5 %."""
    sensor = ls.get_sensor("os1-128").resized(width=64)
    up = sensor.directions()[..., 2]
    road = np.where(up < -0.05, -sensor.mount / np.minimum(up, -0.05), 0).astype(np.float32)
    known = np.ones(road.shape, bool)
    known[:, 20:41] = False
    there = known.copy()
    there[1::2, 20:41:2] = True
    told = Told(road * there, 0.3 * (road > 0) * there.astype(np.float32), there)
    slopes = np.tan(np.radians(np.asarray(sensor.elevations)))
    found = with_planes(told, known, slopes)
    inner = np.s_[1:, 20:41]
    assert found.known[inner][:-1].mean() > 0.97  # all but the row where the road begins
    both = found.known & (found.metres > 0) & (road > 0)
    np.testing.assert_allclose(found.metres[both], road[both], rtol=1e-3)
    assert not found.metres[found.known & (road == 0)].any()
    np.testing.assert_array_equal(found.metres[there], told.metres[there])
    every = there.copy()
    every[:, 20:41:2] = True
    assert with_planes(told._replace(known=every), known, slopes).known is every
