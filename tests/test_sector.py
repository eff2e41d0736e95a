"""Sensors that see a sector of the turn alone: which rays their files say are none of theirs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidarsynth.lidar.sector import runs_outside
from lidarsynth.lidar.sensor import Sensor, from_dict, read_sensor
from lidarsynth.lidar.whole_turn import whole_turn
from lidarsynth.weights.load import load

FRONT = {"beams": 4, "top": 5.0, "bottom": -10.0, "width": 360}


def azimuths(sensor: Sensor) -> np.ndarray:
    """(N,) azimuths of the columns that a sensor of one view sees, in degrees to the left."""
    open_rays = ~sensor.blocked_rays()
    assert (open_rays == open_rays[0]).all()
    return (180 - (np.arange(sensor.width) + 0.5) * 360 / sensor.width)[open_rays[0]]


@pytest.mark.parametrize(
    ("view", "right", "left"),
    [([-60, 60], -59.5, 59.5), ([-60.0, 20], -59.5, 19.5), ([30, 31], 30.5, 30.5), ([-180, 180], -179.5, 179.5)],
)
def test_a_view_is_what_lies_between_two_azimuths(view: list[float], right: float, left: float):
    seen = azimuths(from_dict(FRONT | {"view": view}))
    assert (seen.min(), seen.max()) == (right, left) and len(seen) == left - right + 1


@pytest.mark.parametrize("view", [[120, 240], [-240, -120]])
def test_a_view_may_go_around_the_seam(view: list[float]):
    seen = azimuths(from_dict(FRONT | {"view": view}))
    assert len(seen) == 120 and np.abs(seen).min() == 120.5


def test_what_is_blocked_within_a_view_stays_so():
    sensor = from_dict(FRONT | {"view": [-60, 60], "blocked": [[3, 170, 179]]})
    plain = from_dict(FRONT | {"view": [-60, 60]})
    assert (sensor.blocked_rays() & ~plain.blocked_rays()).sum() == 10


def test_it_stays_when_columns_and_beams_change():
    sensor = from_dict(FRONT | {"view": [-60, 60]})
    for other in (sensor.resized(width=180), sensor.denser(3), sensor.rows([0, 2]), sensor.inverted()):
        seen = azimuths(other)
        assert np.abs(seen).max() < 60 and len(seen) == other.width / 3
    assert from_dict(sensor.to_dict()) == sensor


def test_a_file_says_it(tmp_path: Path):
    file = tmp_path / "front.toml"
    file.write_text("beams = 32\ntop = 10\nbottom = -15\nview = [-35, 35]\n")
    assert len(azimuths(read_sensor(file))) == 200


@pytest.mark.parametrize(
    "view",
    [[60, -60], [-60], [-60, 0, 60], [-200, 200], "ahead", 120, [float("nan"), 60], ["a", "b"], [5, 5]],
)
def test_other_views_are_refused(view: object):
    with pytest.raises(ValueError, match=r"own: expected a view of two azimuths in degrees to the left, such as"):
        from_dict(FRONT | {"view": view}, "own")


def test_a_view_between_two_columns_is_refused():
    with pytest.raises(ValueError, match="expected a view of at least one of 360 columns"):
        from_dict(FRONT | {"view": [0.1, 0.2]}, "own")


def test_scans_of_a_sector_are_cut_from_whole_turns():
    whole = Sensor("own", tuple(np.linspace(8, -14, 32)), 512, max_range=90.0, blocked=((31, 250, 260),))
    sector = replace(whole, blocked=whole.blocked + runs_outside([-60, 60], 32, 512, "own"))
    assert whole_turn(sector) == whole and whole_turn(whole) is whole
    model = load("default").choosing(1).with_labels()
    (all_around,), (ahead,) = (list(model.into(sensor).stream(1, seed=5)) for sensor in (whole, sector))
    seen = ~sector.blocked_rays()
    assert ahead.sensor == sector and ahead.mask.mean() > 0.1
    np.testing.assert_array_equal(ahead.mask, all_around.mask & seen)
    for name in ("range", "reflectance", "label", "instance"):
        np.testing.assert_array_equal(getattr(ahead, name), np.where(ahead.mask, getattr(all_around, name), 0))
    assert 3 < len(ahead.boxes) < len(all_around.boxes)
    assert all(np.count_nonzero(ahead.instance == box.instance) == box.points > 0 for box in ahead.boxes)


def test_a_sensor_of_which_nothing_is_open_stays():
    shut = from_dict(FRONT | {"blocked": [[row, 0, 359] for row in range(4)]})
    assert whole_turn(shut) is shut
