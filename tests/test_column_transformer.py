"""The transformer that draws grids: it sees what was drawn before alone, and draws what it says."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.coarse_unet import COLUMNS, ROWS, CoarseUNet, grid_rays
from lidarsynth.networks.column_neighbours import (
    Grid,
    known_grid,
    ranges_expected,
    shades_expected,
    told,
)
from lidarsynth.networks.column_transformer import Block, ColumnTransformer, Kept, draw
from lidarsynth.networks.drafts import DRAFT_CHANNELS, drafted
from lidarsynth.networks.pixel_mixture import CODES, TONES, mixture, picked
from lidarsynth.networks.rays import encode_range

SENSOR = Sensor("sixteen", tuple(np.linspace(6, -24, ROWS).tolist()), COLUMNS, 0.5, 120.0, mount=1.8)


@pytest.fixture(scope="module")
def network() -> ColumnTransformer:
    """Untrained, and not indifferent to the draft."""
    torch.manual_seed(0)
    network = ColumnTransformer(32, layers=2, pixel=24, blocks=1).eval()
    torch.nn.init.normal_(network.read.weight, std=0.3)
    return network


@pytest.fixture(scope="module")
def rays() -> torch.Tensor:
    blocked = np.zeros((ROWS, COLUMNS), bool)
    blocked[12:, 40:50] = True
    return grid_rays(SENSOR, blocked, np.arange(ROWS), np.arange(COLUMNS))[0][None].expand(2, -1, -1, -1)


@pytest.fixture(scope="module")
def draft() -> torch.Tensor:
    return torch.randn(2, DRAFT_CHANNELS, ROWS, COLUMNS, generator=torch.Generator().manual_seed(5))


@pytest.fixture(scope="module")
def drawn(network: ColumnTransformer, rays: torch.Tensor, draft: torch.Tensor) -> Grid:
    return draw(network, rays, draft, rngs(), sharp=0.5, heat=1.0)


def of_rays() -> tuple[torch.Tensor, torch.Tensor]:
    """Of one image without anything blocked."""
    parts = grid_rays(SENSOR, np.zeros((ROWS, COLUMNS), bool), np.arange(ROWS), np.arange(COLUMNS))
    return parts[0][None], parts[1][None]


def rngs(first: int = 0) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(first + k) for k in range(2)]


def to_plane(normal: tuple[float, float, float], level: float) -> torch.Tensor:
    """Metres (1, 16, 128) to the plane normal . p = level, 0 where no ray meets it within 120 m."""
    nearer = (SENSOR.directions() @ np.array(normal)) / level
    return torch.from_numpy(np.where(nearer > 1 / 120, 1 / np.maximum(nearer, 1 / 120), 0)).float()[None]


def chances() -> torch.Tensor:
    """What `rngs()` give, (2, 5, 16, 128)."""
    return torch.stack([torch.rand(5, ROWS, COLUMNS, generator=one) for one in rngs()]).clamp(0.001, 0.999)


@torch.inference_mode()
def said(network: ColumnTransformer, grid: Grid, rays: torch.Tensor, draft: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """All that a network says of a whole grid."""
    read = network.reader(draft, rays)
    around = network.context(grid, rays, read)[:, None]
    *expected, wall = ranges_expected(grid, rays)
    drawn = network.pixel(told(grid, rays, *expected, wall, read), around, *expected)
    return (*drawn[:4], *network.shades(drawn, grid.code, expected[0], *shades_expected(grid)))


def test_a_grid_is_drawn_as_the_network_says_of_the_whole(
    network: ColumnTransformer, rays: torch.Tensor, draft: torch.Tensor, drawn: Grid
):
    u = chances().permute(0, 2, 3, 1).flatten(0, 2)
    returns, choice, centre, scale, shade_choice, copies, spread = (
        x.flatten(0, 2) for x in said(network, drawn, rays, draft)
    )
    back = (u[:, 0] < returns.sigmoid()) & (rays[:, 6] < 0.5).flatten()
    assert (back == drawn.returned.flatten()).all() and 500 < back.sum() < back.numel()
    code = picked(choice, centre, scale, u[:, 1:3], 0.5, 1.0, CODES)
    assert_close(code[back], drawn.code.flatten()[back], atol=1e-4, rtol=0)
    shade = picked(shade_choice, copies, spread, u[:, 3:5], 1.0, 1.0, TONES)
    assert_close(shade[back], drawn.shade.flatten()[back], atol=1e-3, rtol=0)
    assert not drawn.code[~drawn.returned].any() and not drawn.returned[:, 12:, 40:50].any()


def test_a_pixel_knows_what_was_drawn_before_it_alone(
    network: ColumnTransformer, rays: torch.Tensor, draft: torch.Tensor, drawn: Grid
):
    row, column = 7, 60
    other = Grid(*(part.clone() for part in drawn))
    other.code[:, row, column], other.shade[:, row, column], other.returned[:, row, column] = 0.3, 0.7, True
    pairs = zip(said(network, drawn, rays, draft)[:4], said(network, other, rays, draft)[:4], strict=True)
    changed = [(a - b).abs().reshape(2, ROWS, COLUMNS, -1).amax(-1) > 1e-5 for a, b in pairs]
    seen = torch.stack(changed).any(0).any(0)
    assert not seen[:, :column].any() and not seen[row:, column].any()
    assert seen[:row, column].any() and seen[:, column + 1].any()


def test_a_pixel_knows_the_draft_around_it_and_ahead(
    network: ColumnTransformer, rays: torch.Tensor, draft: torch.Tensor, drawn: Grid
):
    other = draft.clone()
    other[:, :, :, 60] += 1
    changed = (said(network, drawn, rays, draft)[0] - said(network, drawn, rays, other)[0]).abs().amax((0, 1)) > 1e-5
    assert changed[52:61].all() and not changed[:52].any()  # eight columns ahead; all later ones, by what is around
    assert changed[61:].all()


def test_a_draft_says_what_its_noise_may_become():
    """Of a grid that is no noise any more, the grid; of one that is nothing else, x_t alone tells."""
    coarse, (rays, standing) = CoarseUNet(16, (1, 1, 1, 1), 1).eval(), of_rays()
    coarse.standard[0], coarse.standard[1] = -0.2, 0.25
    metres = torch.full((1, ROWS, COLUMNS), 12.0)
    x_0 = coarse.encode(metres, torch.full_like(metres, 0.3), standing)
    t = torch.tensor([1e-4])
    draft = drafted(coarse, x_0, t, rays, standing)
    assert draft.shape == (1, DRAFT_CHANNELS, ROWS, COLUMNS)
    assert_close(draft[:, :2], x_0[:, ::2])
    assert_close(draft[:, 2:4], x_0[:, ::2], atol=0.01, rtol=0)
    away = (4 * (encode_range(metres) - rays[:, 1] / 2)).clamp(-4, 4)
    assert_close(draft[:, 4], away, atol=0.02, rtol=0)
    assert_close(draft[:, 5], torch.full_like(away, 4 * 0.25))
    halfway = drafted(coarse, x_0, torch.tensor([0.5]), rays, standing)
    assert abs(halfway[0, 6, 0, 0]) < 1e-5 < draft[0, 6, 0, 0]


def test_columns_that_are_judged_are_judged_as_among_all(
    network: ColumnTransformer, rays: torch.Tensor, draft: torch.Tensor, drawn: Grid
):
    free = (rays[:, 6] < 0.5).sum(1)
    each = [network(drawn, rays, draft, torch.tensor([k])) * free[:, k, None] for k in range(COLUMNS)]
    assert_close(sum(each) / free.sum(1)[:, None], network(drawn, rays, draft), atol=1e-4, rtol=1e-4)


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


def test_it_learns_a_road(rays: torch.Tensor, draft: torch.Tensor):
    """Eighty steps on flat ground: which rays return, and that it is the ground, far likelier than one bin of 64."""
    torch.manual_seed(0)
    network = ColumnTransformer(32, layers=1, pixel=32, blocks=1)
    ground = to_plane((0.0, 0.0, 1.0), -1.8)
    grid = known_grid(ground.expand(2, -1, -1), torch.full((2, ROWS, COLUMNS), 0.3))
    optimizer = torch.optim.Adam(network.parameters(), 3e-3)
    losses = torch.zeros(3)
    for step in range(80):
        losses = network(grid, rays, draft, torch.arange(step % 8, COLUMNS, 8)).mean(0)
        optimizer.zero_grad()
        losses.sum().backward()
        optimizer.step()
    returned = grid.returned.float().mean()
    assert losses[0] < 0.1
    assert losses[1] < -returned * math.log(64 / 1.9) - 1 and losses[2] < -2


def test_known_pixels_stay_and_others_are_drawn_around_them(
    network: ColumnTransformer, rays: torch.Tensor, draft: torch.Tensor, drawn: Grid
):
    here = torch.zeros(2, ROWS, COLUMNS, dtype=torch.bool)
    here[:, :, 20:60], here[0, 3, 100] = True, True
    other = known_grid(torch.full((2, ROWS, COLUMNS), 7.0), torch.full((2, ROWS, COLUMNS), 0.25))
    found = draw(network, rays, draft, rngs(), sharp=0.5, heat=1.0, known=(other, here))
    for part, given, free in zip(found, other, drawn, strict=True):
        assert_close(part[here], given[here])
        assert_close(part[:, :, :20], free[:, :, :20])  # drawn before any is known
    assert (found.code[:, :, 60:64] != drawn.code[:, :, 60:64]).any()
    again = draw(network, rays, draft, rngs(), sharp=0.5, heat=1.0, known=(drawn, here))
    assert_close(again.code, drawn.code)  # what it would have drawn changes nothing


def test_columns_that_come_one_by_one_are_attended_to_as_all_at_once():
    torch.manual_seed(3)
    layer, kept, x = Block(32).eval(), Kept(), torch.randn(5, 20, 32)
    with torch.inference_mode():
        whole, each = layer(x), torch.cat([layer(x[:, k : k + 1], kept) for k in range(x.shape[1])], 1)
    torch.testing.assert_close(each, whole)
    assert kept.count == 20
