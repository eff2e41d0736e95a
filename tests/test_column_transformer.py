"""The transformer that draws grids: it sees what was drawn before alone, and draws what it says."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.coarse_unet import COLUMNS, ROWS, grid_rays
from lidarsynth.networks.column_neighbours import (
    SECTORS,
    Grid,
    known_grid,
    openness,
    ranges_expected,
    shades_expected,
    told,
)
from lidarsynth.networks.column_transformer import ColumnTransformer, draw, drawn_plan
from lidarsynth.networks.pixel_mixture import CODES, TONES, mixture, picked

SENSOR = Sensor("sixteen", tuple(np.linspace(6, -24, ROWS).tolist()), COLUMNS, 0.5, 120.0, mount=1.8)


@pytest.fixture(scope="module")
def network() -> ColumnTransformer:
    """Untrained, and not indifferent to the plan."""
    torch.manual_seed(0)
    network = ColumnTransformer(32, layers=2, pixel=24, blocks=1).eval()
    torch.nn.init.normal_(network.planned.weight, std=0.3)
    return network


@pytest.fixture(scope="module")
def rays() -> torch.Tensor:
    blocked = np.zeros((ROWS, COLUMNS), bool)
    blocked[12:, 40:50] = True
    return grid_rays(SENSOR, blocked, np.arange(ROWS), np.arange(COLUMNS))[0][None].expand(2, -1, -1, -1)


@pytest.fixture(scope="module")
def drawn(network: ColumnTransformer, rays: torch.Tensor) -> Grid:
    return draw(network, rays, rngs(), sharp=0.5, heat=1.0)


def rngs(first: int = 0) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(first + k) for k in range(2)]


def to_plane(normal: tuple[float, float, float], level: float) -> torch.Tensor:
    """Metres (1, 16, 128) to the plane normal . p = level, 0 where no ray meets it within 120 m."""
    nearer = (SENSOR.directions() @ np.array(normal)) / level
    return torch.from_numpy(np.where(nearer > 1 / 120, 1 / np.maximum(nearer, 1 / 120), 0)).float()[None]


def chances() -> tuple[torch.Tensor, torch.Tensor]:
    """What `rngs()` give: (2, 5, 16, 128) for the pixels, then (2, 16) for the plan."""
    drawn = [(torch.rand(5, ROWS, COLUMNS, generator=one), torch.rand(SECTORS, generator=one)) for one in rngs()]
    pixels, sectors = (torch.stack(part) for part in zip(*drawn, strict=True))
    return pixels.clamp(0.001, 0.999), sectors


@torch.inference_mode()
def said(network: ColumnTransformer, grid: Grid, rays: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """All that a network says of a whole grid, by the plan that `rngs()` draw."""
    plan = drawn_plan(network, rays, chances()[1])
    around = network.context(grid, rays, plan)[:, None]
    *expected, wall = ranges_expected(grid, rays)
    drawn = network.pixel(told(grid, rays, *expected, wall, plan), around, *expected)
    return (*drawn[:4], *network.shades(drawn, grid.code, expected[0], *shades_expected(grid)))


def test_a_grid_is_drawn_as_the_network_says_of_the_whole(network: ColumnTransformer, rays: torch.Tensor, drawn: Grid):
    u = chances()[0].permute(0, 2, 3, 1).flatten(0, 2)
    returns, choice, centre, scale, shade_choice, copies, spread = (x.flatten(0, 2) for x in said(network, drawn, rays))
    back = (u[:, 0] < returns.sigmoid()) & (rays[:, 6] < 0.5).flatten()
    assert (back == drawn.returned.flatten()).all() and 500 < back.sum() < back.numel()
    code = picked(choice, centre, scale, u[:, 1:3], 0.5, 1.0, CODES)
    assert_close(code[back], drawn.code.flatten()[back], atol=1e-4, rtol=0)
    shade = picked(shade_choice, copies, spread, u[:, 3:5], 1.0, 1.0, TONES)
    assert_close(shade[back], drawn.shade.flatten()[back], atol=1e-3, rtol=0)
    assert not drawn.code[~drawn.returned].any() and not drawn.returned[:, 12:, 40:50].any()


def test_a_pixel_knows_what_was_drawn_before_it_alone(network: ColumnTransformer, rays: torch.Tensor, drawn: Grid):
    row, column = 7, 60
    other = Grid(*(part.clone() for part in drawn))
    other.code[:, row, column], other.shade[:, row, column], other.returned[:, row, column] = 0.3, 0.7, True
    pairs = zip(said(network, drawn, rays)[:4], said(network, other, rays)[:4], strict=True)
    changed = [(a - b).abs().reshape(2, ROWS, COLUMNS, -1).amax(-1) > 1e-5 for a, b in pairs]
    seen = torch.stack(changed).any(0).any(0)
    assert not seen[:, :column].any() and not seen[row:, column].any()
    assert seen[:row, column].any() and seen[:, column + 1].any()


def test_a_plan_says_how_far_sectors_are_open_and_is_drawn_in_turn(network: ColumnTransformer, rays: torch.Tensor):
    metres = torch.where(torch.arange(COLUMNS) < 64, 5.0, 50.0).expand(1, ROWS, COLUMNS).clone()
    metres[..., 120:] = 0
    metres[:, 8:] = 2.0  # the lower beams do not count
    plan = openness(known_grid(metres, torch.ones_like(metres)))
    near, far = (1 + int(23 * (math.log2(r + 1) / 4 - 1 + 0.6) / 1.6) for r in (5, 50))
    assert plan[0].tolist() == [near] * 8 + [far] * 7 + [0]
    with torch.inference_mode():
        chosen = drawn_plan(network, rays, chances()[1])
        shares = network.levels(chosen, rays).softmax(-1).cumsum(-1)
        again = network.levels(torch.where(torch.arange(SECTORS) < 9, chosen, 1), rays)
    below = torch.cat([torch.zeros(2, SECTORS, 1), shares], -1).gather(2, chosen[..., None])[..., 0]
    u = chances()[1]
    assert (below <= u + 1e-5).all() and (u <= shares.gather(2, chosen[..., None])[..., 0] + 1e-5).all()
    assert_close(again.softmax(-1).cumsum(-1)[:, :10], shares[:, :10])
    assert (network.plans(chosen) != network.plans(chosen.flip(1))).any()


def test_columns_that_are_judged_are_judged_as_among_all(network: ColumnTransformer, rays: torch.Tensor, drawn: Grid):
    free = (rays[:, 6] < 0.5).sum(1)
    each = [network(drawn, rays, torch.tensor([k]))[:, :3] * free[:, k, None] for k in range(COLUMNS)]
    assert_close(sum(each) / free.sum(1)[:, None], network(drawn, rays)[:, :3], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    ("normal", "level", "which"),
    [((0.0, 0.0, 1.0), -1.8, 0), ((0.0, 0.0, 1.0), -1.5, 4), ((0.03, 0.02, 1.0), -1.8, 5), ((1.0, 0.4, 0.0), 9.0, 3)],
)
def test_hypotheses_are_exact_on_ground_slopes_and_walls(normal: tuple[float, float, float], level: float, which: int):
    grid = known_grid(to_plane(normal, level), torch.full((1, ROWS, COLUMNS), 0.3))
    rays, _ = grid_rays(SENSOR, np.zeros((ROWS, COLUMNS), bool), np.arange(ROWS), np.arange(COLUMNS))
    codes, valid, _ = ranges_expected(grid, rays[None])
    judged = valid[..., which] & grid.returned & (grid.code < 0.5)  # to 60 m
    if which == 0:
        judged &= torch.arange(ROWS)[None, :, None] > 4  # flat ground below the horizon
    assert judged.sum() > 100
    assert (codes[..., which] - grid.code)[judged].abs().max() < 0.004


def test_an_untrained_networks_hypotheses_need_neighbours():
    grid = known_grid(torch.zeros(1, ROWS, COLUMNS), torch.zeros(1, ROWS, COLUMNS))
    rays, _ = grid_rays(
        replace(SENSOR, tilt=(2.0, 1.0)), np.zeros((ROWS, COLUMNS), bool), np.arange(ROWS), np.arange(COLUMNS)
    )
    codes, valid, _ = ranges_expected(grid, rays[None])
    assert valid[..., 0].all() and not valid[..., 1:].any()
    assert torch.isfinite(codes).all()


def test_a_mixture_is_a_density_and_is_drawn_from():
    rng = torch.Generator().manual_seed(0)
    choice = torch.randn(8, generator=rng).log_softmax(-1)
    centre, scale = torch.tensor([0.2, 0.5]), torch.tensor([0.01, 0.05])
    x, span = torch.linspace(-1, 2, 30001), (0.0, 1.0, 6)

    def mixtures(count: int) -> list[torch.Tensor]:
        return [part.expand(count, -1) for part in (choice, centre, scale)]

    inside = (x >= 0) & (x < 1)
    density = mixture(x, *mixtures(len(x)), span=span).exp()
    total = torch.where(inside, density, 0).sum() * 1e-4
    assert total.item() == pytest.approx(1, abs=0.01)
    u = torch.rand(20000, 2, generator=rng).clamp(0.001, 0.999)
    found = picked(*mixtures(20000), u=u, sharp=1.0, heat=1.0, span=span)
    for edge in (0.1, 0.35, 0.6):
        expected = torch.where(inside & (x < edge), density, 0).sum().item() * 1e-4
        assert (found < edge).float().mean().item() == pytest.approx(expected, abs=4 * math.sqrt(0.25 / 20000) + 0.01)


def test_it_learns_a_road(rays: torch.Tensor):
    """Eighty steps on flat ground: which rays return, and that it is the ground, far likelier than one bin of 64."""
    torch.manual_seed(0)
    network = ColumnTransformer(32, layers=1, pixel=32, blocks=1)
    ground = to_plane((0.0, 0.0, 1.0), -1.8)
    grid = known_grid(ground.expand(2, -1, -1), torch.full((2, ROWS, COLUMNS), 0.3))
    optimizer = torch.optim.Adam(network.parameters(), 3e-3)
    losses = torch.zeros(4)
    for step in range(80):
        losses = network(grid, rays, torch.arange(step % 8, COLUMNS, 8)).mean(0)
        optimizer.zero_grad()
        losses.sum().backward()
        optimizer.step()
    returned = grid.returned.float().mean()
    assert losses[0] < 0.1
    assert losses[1] < -returned * math.log(64 / 1.9) - 1 and losses[2] < -2
