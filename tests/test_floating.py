"""Points that float between two surfaces go onto the likelier one; all else stays, bit by bit."""

import numpy as np
import pytest
import torch

import lidarsynth as ls
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.systems.cascade.floating import onto_surfaces, settled

SENSOR = ls.get_sensor("vlp-16").resized(width=32)


def corner() -> np.ndarray:
    """A wall at 5 m on the left and one at 20 m on the right, that go on around the turn."""
    return np.where(np.arange(32) < 16, 5.0, 20.0)[None].repeat(16, 0).astype(np.float32)


def moved(metres: np.ndarray, told: np.ndarray | None = None) -> np.ndarray:
    told = np.zeros(metres.shape, bool) if told is None else told
    return onto_surfaces(*(torch.from_numpy(part)[None, None] for part in (metres, told)))[0, 0].numpy()


@pytest.mark.parametrize("column", [0, 15, 16, 31])
@pytest.mark.parametrize(("between", "surface"), [(7.0, 5.0), (14.0, 20.0)])
def test_what_floats_goes_onto_the_nearer_wall(column: int, between: float, surface: float):
    """At either end of a wall, across the seam too."""
    metres = corner()
    metres[8, column] = between
    true = metres.copy()
    true[8, column] = surface
    np.testing.assert_allclose(moved(metres), true, rtol=1e-6)
    same = np.ones(metres.shape, bool)
    same[8, column] = False
    np.testing.assert_array_equal(moved(metres)[same], metres[same])


def test_the_larger_surface_counts_for_more():
    """Between both alike, of six neighbours at 5 m and eight at 20 m."""
    metres = corner()
    metres[8, 16] = 10.0
    metres[7, 14] = metres[9, 14] = metres[8, 14] = 0
    assert moved(metres)[8, 16] == pytest.approx(20, rel=1e-6)


def test_measured_things_poles_and_gaps_stay():
    metres, told = corner(), np.zeros((16, 32), bool)
    metres[8, 15], told[8, 15] = 10.0, True  # measured
    metres[3:6, 4] = 2.0  # a pole: as far as those above and below
    metres[12, 24] = 0.0  # no return
    np.testing.assert_array_equal(moved(metres, told), metres)


def test_without_a_surface_nothing_moves():
    """Leaves: no two are as far; and a point far from all walls."""
    leaves = np.random.default_rng(0).uniform(4, 40, (16, 32)).astype(np.float32)
    leaves[::2] = 0
    leaves[:, ::3] = 0
    np.testing.assert_array_equal(moved(leaves), leaves)
    metres = np.full((16, 32), 60.0, np.float32)
    metres[8, 8] = 2.0
    np.testing.assert_array_equal(moved(metres), metres)


@pytest.mark.parametrize("shape", [(1, 4), (2, 5), (16, 32)])
def test_any_size_and_nothing_at_all(shape: tuple[int, int]):
    np.testing.assert_array_equal(moved(np.zeros(shape, np.float32)), np.zeros(shape))
    np.testing.assert_array_equal(moved(np.full(shape, 9, np.float32)), np.full(shape, 9))


def test_known_pixels_are_surfaces_with_their_own_ranges():
    """What the network says where something is known does not count, nor is it changed."""
    truth, told = corner(), np.zeros((16, 32), bool)
    told[::2] = True
    said = truth.copy()
    said[told] = 3.0
    said[9, 15] = 8.0
    known = RangeImage(truth * told, np.zeros_like(truth), told, SENSOR)
    filled = RangeImage(said, np.zeros_like(truth), np.ones_like(told), SENSOR)
    done = settled(filled, known, told)
    np.testing.assert_array_equal(done.range[told], said[told])
    np.testing.assert_allclose(done.range[~told], truth[~told], rtol=1e-6)


def test_completion_has_fewer_of_them(monkeypatch: pytest.MonkeyPatch):
    """On a held-out street: new points far from all that was cast, with and without."""
    from lidarsynth.streets.reader import SyntheticStreets
    from lidarsynth.systems.cascade import model as module

    street = SyntheticStreets(4321, 4, ls.get_sensor("hdl-32e")).image(2)
    known = np.zeros(street.shape, bool)
    known[::4] = True
    model = ls.load("default").into(street.sensor)

    def floating() -> tuple[int, float]:
        filled = model.complete(street.keep(known), known)
        np.testing.assert_array_equal(filled.range[known & street.mask], street.range[known & street.mask])
        new, true = filled.mask & ~known, street.range * street.mask
        around = np.stack([np.roll(np.pad(true, ((2, 2), (0, 0)))[down : down + len(true)], right, 1)
                           for down in range(5) for right in range(-3, 4)])  # fmt: skip
        off = np.abs(np.where(around > 0, around, np.inf) - filled.range).min(0)
        return int((off > np.maximum(0.5, 0.03 * filled.range))[new].sum()), float(np.abs(filled.range - true).mean())

    count, error = floating()
    monkeypatch.setattr(module, "settled", lambda filled, known, told: filled)
    before, error_before = floating()
    assert count < 0.75 * before and error < 1.005 * error_before
