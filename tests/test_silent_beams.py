"""A few beams of which nothing is known, as of a dead laser, are filled in, and drawn, as those of sparse scans are."""

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.lidar.corruption import every_beam
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade.holes import Told
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.cascade.silent import silent_rows, told_of_silent

NONE = np.zeros((16, 40), bool)


def silent(told: np.ndarray, closed: np.ndarray = NONE) -> list[int]:
    return np.flatnonzero(silent_rows(told, told, closed)).tolist()


def without(*rows: int) -> np.ndarray:
    told = ~NONE
    told[list(rows)] = False
    return told


@pytest.mark.parametrize("rows", [(8,), (3, 8), (8, 9), (7, 8, 9), (1, 5, 9, 14)])
def test_a_few_beams_without_a_return_are_silent(rows):
    assert silent(without(*rows)) == list(rows)


@pytest.mark.parametrize("rows", [(), (0,), (15,), (0, 1), (6, 7, 8, 9), (1, 4, 7, 10, 13)])
def test_others_are_not(rows):
    assert silent(without(*rows)) == []


@pytest.mark.parametrize("step", [2, 3, 4, 8])
def test_none_are_of_every_kth_beam(step):
    assert silent(every_beam(NONE.shape, step)) == []


def test_none_is_where_its_neighbours_look_at_the_sky():
    told = without(4)
    told[:4, 3:] = False  # 3 of 40 return
    assert silent(told) == []
    told[:4, 3] = True
    assert silent(told) == [4]


def test_none_is_where_its_neighbours_are_known_to_see_nothing():
    told, returned = without(4), without(4)
    returned[:4, 3:] = False  # 3 of 40 return
    assert not silent_rows(told, returned, NONE).any()
    returned[:4, 3] = True
    assert np.flatnonzero(silent_rows(told, returned, NONE)).tolist() == [4]


def test_blocked_beams_are_not():
    told, closed = without(4, 5), NONE.copy()
    closed[4] = True
    assert silent(told, closed) == [5]
    closed[5, :30] = True
    assert silent(told, closed) == [5]


def test_those_beside_tell_and_each_third_from_there():
    beams = np.zeros(16, bool)
    beams[[8, 9]] = True
    assert np.flatnonzero(told_of_silent(beams)).tolist() == [1, 4, 7, 10, 13]


@pytest.mark.parametrize(("word", "row"), [("vlp-16", 8), ("os1-64", 30)])
@pytest.mark.parametrize("method", ["conditional", "sample"])
def test_the_beam_of_a_dead_laser_is_filled_in(word, row, method):
    street, model = SyntheticStreets(4321, 4, ls.SENSORS[word]).image(0), ls.load("default").into(word)
    known = street.mask.copy()
    known[row] = False
    scan = street.keep(known)
    made, plain = model.complete(scan, method=method), ls.load("bilinear").into(word).complete(scan)
    there = street.mask[row]
    assert made.mask[row][there].mean() > 0.9
    errors = [np.abs(of.range - street.range)[row].mean() for of in (made, plain)]
    assert errors[0] < (1.0 if method == "conditional" else 1.3) * errors[1]
    assert np.array_equal(made.range[known], street.range[known])
    assert np.array_equal(made.reflectance[known], street.reflectance[known])


def test_repaint_draws_no_hole_where_beams_are_silent(monkeypatch: pytest.MonkeyPatch):
    """Three side by side fill whole cells of its grid."""

    def all_drawn(network: object, told: Told, *how: object) -> Told:
        return Told(np.where(told.known, told.metres, 3.0), told.reflectance, np.ones_like(told.known))

    street, model = SyntheticStreets(4321, 4, ls.SENSORS["vlp-16"]).image(0), ls.load("default").into("vlp-16")
    known = street.mask.copy()
    known[7:10] = False
    monkeypatch.setattr("lidarsynth.systems.cascade.model.with_holes_drawn", all_drawn)
    made = model.complete(street.keep(known), method="repaint", steps=1, resamples=1)
    drawn = (np.abs(made.range - 3) < 0.2) & ~known
    assert drawn[~known].sum() > 1000 and drawn[7:10].mean() < 0.1


def test_a_beam_that_the_grid_lacks_is_drawn_as_those_beside_it():
    sensor = ls.Sensor("seventeen", tuple(np.linspace(15, -15, 17)), width=512)
    model = ls.load("default").into(sensor)
    assert isinstance(model, CascadeModel)
    model = model.choosing(1)
    images = model.generate(3, seed=0)
    back = np.stack([image.mask for image in images])
    lone = ~back[:, 1:-1] & back[:, :-2] & back[:, 2:]
    assert lone[:, 7].mean() < 0.06  # 0.22 where it was not
    (again,) = model.generate(1, seed=1)
    assert np.array_equal(again.range, images[1].range)
