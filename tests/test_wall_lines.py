"""Walls that go on, turn by right angles and stand behind what hides them; let go of where they end."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.coarse_unet import COLUMNS, ROWS, grid_rays
from lidarsynth.networks.wall_lines import REACH, WINDOWS, Walls, through, walls

SENSOR = Sensor("sixteen", tuple(np.linspace(6, -24, ROWS).tolist()), COLUMNS, 0.5, 120.0, mount=1.8)
BLOCKED = np.zeros((ROWS, COLUMNS), bool)
RAYS = grid_rays(SENSOR, BLOCKED, np.arange(ROWS), np.arange(COLUMNS))[0][None, :, :1]  # one beam
AZIMUTH = SENSOR.ray_angles()[1, 0].astype(np.float64)
LINE, BEHIND, ALONG, ACROSS = range(4)  # of Walls.nearness
AHEAD = COLUMNS // 2  # the column that looks forward


def wall(away: float, towards: float) -> torch.Tensor:
    """(1, 1, 128) nearness of a wall so many metres away, in that direction in degrees; 0 where no ray meets it."""
    near = np.cos(AZIMUTH - math.radians(towards)) / away
    return torch.from_numpy(np.where(near > 0.005, near, 0)).float()[None, None]


def seen(near: torch.Tensor) -> Walls:
    return walls(near, RAYS.expand(len(near), -1, -1, -1))


def test_a_wall_goes_on_exactly():
    front = wall(6.0, 10)
    line = seen(front).nearness[..., LINE]
    said = (line > 0) & (front > 0)
    assert said.sum() >= (front > 0).sum() - WINDOWS[-1]
    assert_close(line[said], front[said], rtol=1e-3, atol=0)


def test_noise_turns_a_long_line_less_than_two_pixels_do():
    rng = torch.Generator().manual_seed(0)
    front, middle = wall(8.0, 0), slice(AHEAD - 10, AHEAD + 10)
    noisy = front * (1 + 0.004 * torch.randn(64, 1, COLUMNS, generator=rng))
    line = seen(noisy).nearness[..., LINE]
    off = (line / front - 1)[..., middle].abs().mean()
    pairs = ((2 * noisy.roll(1, 2) - noisy.roll(2, 2)) / front - 1)[..., middle].abs().mean()
    assert (line[..., middle] > 0).float().mean() > 0.95
    assert off < 0.5 * pairs


def test_a_wall_is_remembered_behind_what_hides_it_and_where_nothing_returns():
    front = wall(10.0, 0)
    hidden = front.clone()
    hidden[..., AHEAD - 9 : AHEAD - 2] = 1 / 4.0  # a car of seven columns
    hidden[..., AHEAD + 6 : AHEAD + 9] = 0  # a window
    near = seen(hidden).nearness
    part = slice(AHEAD - 14, AHEAD + 16)
    assert_close(near[..., part, BEHIND], front[..., part], rtol=0.01, atol=0)
    assert_close(near[..., AHEAD - 4 : AHEAD - 2, LINE], hidden[..., AHEAD - 4 : AHEAD - 2], rtol=0.04, atol=0)
    assert not near[..., AHEAD + 7 : AHEAD + 10, LINE].any()


def test_a_line_ends_where_something_farther_is_seen_and_after_a_while():
    front = wall(6.0, 0)
    opened = front.clone()
    opened[..., AHEAD : AHEAD + 6] = wall(30.0, 0)[..., AHEAD : AHEAD + 6]
    behind = seen(opened).nearness[..., BEHIND]
    assert_close(behind[..., AHEAD], front[..., AHEAD], rtol=1e-3, atol=0)
    assert not ((behind / front - 1).abs() < 0.1)[..., AHEAD + 2 : AHEAD + 6].any()
    gone = front.clone()
    gone[..., AHEAD:] = 0
    kept = seen(gone).nearness[0, 0, :, BEHIND] > 0
    assert kept[AHEAD + REACH - 1]
    assert not kept[AHEAD + REACH + 1 :].any()


@pytest.mark.parametrize("yaw", [-25.0, 0.0, 20.0])
@pytest.mark.parametrize("turned", [False, True])
def test_houses_have_right_angles_whatever_their_yaw(yaw: float, turned: bool):
    first, last = (-50.0, 30.0) if not turned else (30.0, -50.0)
    corner = torch.maximum(wall(7.0, yaw), wall(9.0, yaw + 90))  # seen from within a room
    rays = RAYS
    if turned:
        corner, rays = corner.flip(-1), RAYS.flip(-1)
    near = walls(corner, rays)
    assert near.character[0, 0, -1, 4] > 0.95  # all stand alike
    exact = ((near.nearness[..., ALONG:] / corner[..., None] - 1).abs().amin(-1) < 0.01)[0, 0]
    azimuth = np.degrees(AZIMUTH if not turned else AZIMUTH[::-1])
    both = (azimuth > yaw + min(first, last)) & (azimuth < yaw + 120)
    later = both & (np.arange(COLUMNS) > np.flatnonzero(both)[0] + 20)  # the first wall has told how it stands
    assert exact[torch.from_numpy(later)].float().mean() > 0.9


def test_what_is_scattered_and_flat_ground_tell_nothing_of_walls():
    rng = torch.Generator().manual_seed(1)
    near = 0.05 + 0.2 * torch.rand(64, 1, COLUMNS, generator=rng)
    assert (seen(near).nearness[..., LINE] > 0).float().mean() < 0.1
    assert not through(torch.zeros(3, WINDOWS[0])).there.any()
    low = grid_rays(SENSOR, BLOCKED, np.arange(ROWS), np.arange(COLUMNS))[0][None, :, -1:]
    road = torch.full((1, 1, COLUMNS), math.tan(math.radians(24)) / 1.8)
    tells = walls(road, low).character[0, 0, -1]
    assert tells[0] > 0.9 and tells[4] == 1  # a long line, but none that says how walls stand
