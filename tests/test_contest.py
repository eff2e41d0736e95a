"""Columns that learn from what they draw: what counts as alike, who wins, and that a stopped run goes on."""

import copy
import math
from itertools import islice

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.coarse_unet import COLUMNS, ROWS, grid_rays
from lidarsynth.networks.column_neighbours import Grid, known_grid
from lidarsynth.networks.column_transformer import ColumnTransformer, draw
from lidarsynth.networks.pixel_mixture import CODES, NEAR, chance_near, picked
from lidarsynth.systems.cascade import contest as module
from lidarsynth.systems.cascade.contest import PART, contest, contested

SENSOR = Sensor("sixteen", tuple(np.linspace(6, -24, ROWS).tolist()), COLUMNS, 0.5, 120.0, mount=1.8)
EVERY = torch.arange(COLUMNS)


def fresh() -> ColumnTransformer:
    torch.manual_seed(0)
    return ColumnTransformer(32, layers=1, pixel=24, blocks=1).eval()


@pytest.fixture(scope="module")
def rays() -> torch.Tensor:
    blocked = np.zeros((ROWS, COLUMNS), bool)
    return grid_rays(SENSOR, blocked, np.arange(ROWS), np.arange(COLUMNS))[0][None].expand(4, -1, -1, -1)


@pytest.fixture(scope="module")
def walls() -> Grid:
    """Two turns of walls all around, at 8 and 12 m."""
    metres = torch.tensor([8.0, 12.0])[:, None, None].expand(2, ROWS, COLUMNS)
    return known_grid(metres, torch.full_like(metres, 0.3))


def own(network: ColumnTransformer, rays: torch.Tensor) -> Grid:
    drawn = draw(network, rays, [torch.Generator().manual_seed(k) for k in range(len(rays))])
    return Grid(*(part.clone() for part in drawn))


def test_the_chance_to_be_near_is_that_of_draws():
    rng = torch.Generator().manual_seed(1)
    choice = torch.randn(1, 3 + CODES[2], generator=rng)
    choice[:, :3] += 3
    choice, centre, scale = (
        choice.log_softmax(-1),
        torch.tensor([[-0.2, 0.1, 0.11]]),
        torch.tensor([[0.001, 0.01, 0.03]]),
    )
    u = torch.rand(400_000, 2, generator=rng).clamp(1e-6, 1 - 1e-6)
    draws = picked(*(part.expand(len(u), -1) for part in (choice, centre, scale)), u, 1.0, 1.0, CODES)
    middle = CODES[0] + (CODES[1] - CODES[0]) * 50.5 / CODES[2]  # of a bin, far from all hypotheses
    for x in (-0.2, 0.1, 0.13, middle):
        share = ((draws - x).abs() < NEAR).double().mean()
        said = chance_near(torch.tensor([x]), choice, centre, scale, CODES).exp()
        # a bin's share counts as if it went on evenly around: hypotheses' are exact
        assert abs(share - said) < 0.002 + 0.1 * share, x


def test_pixels_that_are_blocked_or_empty_count_as_they_should(rays: torch.Tensor, walls: Grid):
    network, told = fresh(), rays[:2].clone()
    told[:, 6, :4] = 1
    part = Grid(*(p.clone() for p in walls))
    part.returned[:, 10] = False
    with torch.inference_mode():
        plain, alike = network.judged(part, told)
        assert_close(plain, network(part, told))
        one = network.judged(part, told, torch.tensor([5, 77]))[1]
    assert alike.shape == (2, ROWS, COLUMNS) and not alike[:, :4].any() and (alike[:, 4:] < 0).all()
    assert_close(one, alike[:, :, [5, 77]])


def test_a_network_that_is_its_own_rival_cannot_tell(rays: torch.Tensor, walls: Grid):
    network = fresh()
    missed, fooled, plain = contest(network, copy.deepcopy(network), walls, own(network, rays[:2]), rays, EVERY)
    assert_close(torch.stack([missed, fooled]), torch.full((2,), math.log(2)))
    assert_close(plain, network(walls, rays[:2]).sum(1).mean())


def test_what_streets_have_gains_and_what_only_draws_have_loses(rays: torch.Tensor, walls: Grid):
    network, rival = fresh().requires_grad_(True), fresh()
    drawn, optimizer = own(rival, rays[:2]), torch.optim.Adam(network.parameters(), 1e-3)
    rng = np.random.default_rng(0)
    for _ in range(15):
        runs = PART * rng.permutation(COLUMNS // PART)[:8, None] + np.arange(PART)
        losses = contest(network, rival, walls, drawn, rays, torch.from_numpy(runs.ravel()))
        optimizer.zero_grad()
        losses[:2].sum().backward()
        optimizer.step()
    with torch.no_grad():
        missed, fooled, _ = contest(network, rival, walls, drawn, rays, EVERY)
        gain = [(network.judged(g, rays[:2])[1] - rival.judged(g, rays[:2])[1]).mean() for g in (walls, drawn)]
    assert missed < 0.3 and fooled < 0.3 and gain[0] > 0 > gain[1]


class Walls:
    """Images of the sensor with a wall ahead, nearer from one to the next."""

    def take(self, indices: list[int]) -> list[RangeImage]:
        metres = [np.full((ROWS, COLUMNS), 20 - k % 10, np.float32) for k in indices]
        return [RangeImage(m, np.full_like(m, 0.3), m > 0, SENSOR) for m in metres]


def test_a_run_that_was_stopped_goes_on_as_if_it_had_not_been(monkeypatch: pytest.MonkeyPatch):
    for word, value in (("FRESH", 4), ("ROUND", 2), ("HALF", 2), ("TOGETHER", 4)):
        monkeypatch.setattr(module, word, value)

    def run(steps: int, state=None):
        network = fresh().requires_grad_(True)
        each = [(copy.deepcopy(s), x) for s, x in islice(contested(network, Walls(), 5, 3, state), steps)]
        return network, each

    whole, steps = run(5)
    part, first = run(3)
    again, rest = run(5, first[-1][0])
    assert [s["step"] for s, _ in first + rest] == [1, 2, 3, 4, 5]
    assert all(torch.equal(a[1], b[1]) for a, b in zip(steps, first + rest, strict=True))
    pairs = zip(whole.state_dict().values(), again.state_dict().values(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    assert any(not torch.equal(a, b) for a, b in zip(part.parameters(), again.parameters(), strict=True))
    rivals = [s["rival"]["enter.weight"] for s, _ in steps]
    assert torch.equal(rivals[0], rivals[1]) and not torch.equal(rivals[1], rivals[2])  # as it was when a round began
