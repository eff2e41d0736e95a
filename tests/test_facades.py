"""Walls that were drawn a little askew become straight, corners stay, and what is no wall is left alone."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from lidarsynth.lidar.sensor import Sensor
from lidarsynth.systems.cascade.facades import LEAST, MOST, on_fewest_lines, with_facades

COLUMNS = 128
AZIMUTH = 2 * np.pi / COLUMNS * np.arange(COLUMNS)
SENSOR = Sensor("sixteen", tuple(np.linspace(6, -24, 16).tolist()), COLUMNS, 0.5, 120.0, mount=1.8)


def room(*walls: tuple[float, float]) -> np.ndarray:
    """(128,) nearness of the nearest of walls so far away in so many degrees; 0 where there is none within 40 m."""
    near = np.max([np.cos(AZIMUTH - np.radians(towards)) / away for away, towards in walls], 0)
    return np.where(near > 1 / 40, near, 0)


@pytest.fixture
def wavy() -> tuple[np.ndarray, np.ndarray]:
    """Eight rings of a street with a corner as it is, and as it is drawn: noise, and waves of some columns."""
    rng = np.random.default_rng(0)
    true = np.repeat(room((6.0, 80), (9.0, 170), (7.0, 260))[None], 8, 0)
    waves = 0.015 * np.sin(AZIMUTH * rng.uniform(8, 12, (8, 1)) + rng.uniform(0, 6, (8, 1)))
    return true, true * (1 + waves + rng.normal(0, 0.004, true.shape))


def test_waves_go_and_corners_stay(wavy: tuple[np.ndarray, np.ndarray]):
    true, drawn = wavy
    seen = true > 0
    before, after = (np.abs(near / np.where(seen, true, 1) - 1)[seen] for near in (drawn, on_fewest_lines(drawn)))
    assert after.mean() < 0.75 * before.mean()
    bends = [np.median(np.abs(np.diff(near - true, 2, axis=1))[:, 20:60]) for near in (drawn, on_fewest_lines(drawn))]
    assert bends[1] < 0.1 * bends[0]
    assert (np.abs(on_fewest_lines(drawn) - drawn) <= MOST * drawn + 1e-12).all()


def test_what_is_straight_empty_or_scattered_stays():
    exact = room((6.0, 80), (9.0, 170))[None]
    assert_allclose(on_fewest_lines(exact), exact, rtol=1e-6)
    assert not on_fewest_lines(np.zeros((2, COLUMNS))).any()
    scattered = np.random.default_rng(1).uniform(0.03, 0.3, (4, COLUMNS))
    assert (on_fewest_lines(scattered) == scattered).mean() > 0.7
    few = np.zeros((1, COLUMNS))
    few[0, 40 : 40 + LEAST - 1] = 0.2, 0.21, 0.2
    assert (on_fewest_lines(few) == few).all()


def test_a_wall_goes_on_behind_a_window(wavy: tuple[np.ndarray, np.ndarray]):
    drawn = wavy[1].copy()
    drawn[:, 25:28] = 0
    straight = on_fewest_lines(drawn)
    assert not straight[:, 25:28].any()
    assert np.abs(np.diff(straight[:, :25], 2, axis=1)).mean() < np.abs(np.diff(drawn[:, :25], 2, axis=1)).mean()


def test_flat_ground_and_what_does_not_return_stay_as_they_are():
    down = np.radians(-np.asarray(SENSOR.elevations))
    ground = np.where(down > 0.05, 1.8 / np.sin(np.maximum(down, 0.05)), 0)
    rough = ground[:, None] * (1 + 0.01 * np.random.default_rng(2).normal(size=(16, COLUMNS)))
    metres = torch.from_numpy(rough).float()[None]
    flat = with_facades(metres, np.arange(16), SENSOR)
    assert ((flat > 0) == (metres > 0)).all()
    lower = metres[:, 6:], flat[:, 6:]
    assert torch.allclose(*lower, rtol=0.02)
