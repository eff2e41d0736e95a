"""What draws the columns between those of a grid: it sees the known ones and what is below, and draws what it says."""

from functools import partial

import numpy as np
import pytest
import torch
from planes import plane_grid
from torch.testing import assert_close

from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.between_columns import BetweenColumns, draw_between, joined
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.coarse_unet import COLUMNS, ROWS, CoarseUNet, grid_columns, grid_rays
from lidarsynth.networks.column_neighbours import Grid
from lidarsynth.networks.column_transformer import ColumnTransformer
from lidarsynth.networks.fill_unet import FillUNet
from lidarsynth.networks.pixel_mixture import CODES, TONES, picked
from lidarsynth.systems.cascade import layout
from lidarsynth.systems.cascade.layout import grids

SENSOR = Sensor("sixteen", tuple(np.linspace(6, -24, ROWS).tolist()), 2 * COLUMNS, 0.5, 120.0, mount=1.8)
BLOCKED = np.zeros((ROWS, 2 * COLUMNS), bool)
BLOCKED[12:, 80:100] = True


@pytest.fixture(scope="module")
def network() -> BetweenColumns:
    torch.manual_seed(0)
    return BetweenColumns(16, layers=1, blocks=1).eval()


def rays(first: int) -> torch.Tensor:
    """Of every second column, two alike."""
    told, _ = grid_rays(SENSOR, BLOCKED, np.arange(ROWS), np.arange(first, 2 * COLUMNS, 2))
    return told.expand(2, -1, -1, -1)


def seen(normal: tuple[float, float, float], level: float) -> Grid:
    return plane_grid(SENSOR, BLOCKED, normal, level)


def every_second(grid: Grid, first: int) -> Grid:
    return Grid(*(part[..., first::2] for part in grid))


@pytest.fixture(scope="module")
def known() -> Grid:
    return every_second(seen((1.0, 0.4, -0.2), 9.0), 0)


def rngs() -> list[torch.Generator]:
    return [torch.Generator().manual_seed(k) for k in range(2)]


@pytest.fixture(scope="module")
def drawn(network: BetweenColumns, known: Grid) -> Grid:
    return draw_between(network, known, rays(0), rays(1), rngs(), sharp=0.5, heat=1.0)


@torch.inference_mode()
def test_new_columns_are_drawn_as_the_network_says_of_the_whole(network: BetweenColumns, known: Grid, drawn: Grid):
    chance = torch.stack([torch.rand(5, ROWS, COLUMNS, generator=one) for one in rngs()]).clamp(0.001, 0.999)
    u = chance.permute(0, 2, 3, 1).flatten(0, 2)
    said, hypotheses, *copies = network.said(known, rays(0), drawn, rays(1))
    shades = network.shades(said, drawn.code, hypotheses, *copies)
    returns, choice, centre, scale = (part.flatten(0, 2) for part in said[:4])
    back = (u[:, 0] < returns.sigmoid()) & (rays(1)[:, 6] < 0.5).flatten()
    assert (back == drawn.returned.flatten()).all() and 500 < back.sum() < back.numel()
    assert_close(picked(choice, centre, scale, u[:, 1:3], 0.5, 1, CODES)[back], drawn.code.flatten()[back])
    shade = picked(*(part.flatten(0, 2) for part in shades), u[:, 3:5], 1, 1, TONES)
    assert_close(shade[back], drawn.shade.flatten()[back], atol=1e-3, rtol=0)
    assert not drawn.code[~drawn.returned].any() and not drawn.returned[:, 12:, 40:50].any()


@torch.inference_mode()
def test_a_new_pixel_knows_the_known_ones_and_those_below_it_alone(network: BetweenColumns, known: Grid, drawn: Grid):
    def changes(other: Grid, hidden: Grid) -> torch.Tensor:
        pairs = ((network.said(k, rays(0), h, rays(1))[0]) for k, h in ((known, drawn), (other, hidden)))
        return torch.stack([(a - b).abs().reshape(2, ROWS, COLUMNS, -1).amax((0, 3))
                            for a, b in zip(*(pair[:4] for pair in pairs), strict=True)]).amax(0) > 1e-5  # fmt: skip

    row, column = 7, 60
    other, beside = (Grid(*(part.clone() for part in grid)) for grid in (drawn, known))
    for grid in (other, beside):
        grid.code[:, row, column], grid.shade[:, row, column], grid.returned[:, row, column] = 0.3, 0.7, True
    above = changes(known, other)
    assert above[:row, column].any() and above.sum() == above[:row, column].sum()
    around = changes(beside, drawn)
    assert around[row, column - 1] and around[row, column]
    assert not around[:, : column - 5].any() and not around[:, column + 5 :].any()


@pytest.mark.parametrize(
    ("normal", "level", "which"),
    [((0.0, 0.0, 1.0), -1.8, (0,)), ((0.03, 0.02, 1.0), -1.8, (7, 8)), ((1.0, 0.4, 0.0), 9.0, (6, 8))],
)
def test_hypotheses_of_surfaces_are_exact(
    network: BetweenColumns, normal: tuple[float, float, float], level: float, which: tuple[int, ...]
):
    whole = seen(normal, level)
    known, hidden = every_second(whole, 0), every_second(whole, 1)
    said = network.said(known, rays(0), hidden, rays(1))[1]
    judged = hidden.returned & (hidden.code < 0.4)
    judged[:, 9:] = False  # those below are known, and none of them blocked
    for one in which:
        off = (said[..., one] - hidden.code).abs()
        off = off[:, :, 2:-2][judged[:, :, 2:-2] if one else hidden.returned[:, :, 2:-2]]
        assert off.numel() > 50 and float(off.median()) < 1e-3, one


def test_the_mean_likelihood_is_of_what_is_free(network: BetweenColumns, known: Grid, drawn: Grid):
    one = network(known, rays(0), drawn, rays(1))
    assert one.shape == (2, 3) and torch.isfinite(one).all()
    hidden = Grid(*(part.clone() for part in drawn))
    hidden.code[:, 12:, 40:50] = 0.5  # blocked: no return, and never told
    assert_close(network(known, rays(0), hidden, rays(1)), one)


def test_what_is_between_is_joined_in_its_place(known: Grid, drawn: Grid):
    both = joined(known, drawn)
    assert torch.equal(both.code[..., ::2], known.code) and torch.equal(both.returned[..., 1::2], drawn.returned)


@pytest.mark.parametrize(("width", "count"), [(130, 128), (300, 256), (600, 512), (1024, 512)])
def test_grids_are_as_fine_as_the_sensor_has_columns(
    network: BetweenColumns, width: int, count: int, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(layout, "landed", lambda grid, rng: grid)  # else others hang in the one and the other
    torch.manual_seed(1)
    sensor = Sensor("any", SENSOR.elevations, width, 0.5, 120.0, mount=1.8)
    blocked, rows, columns = np.zeros((ROWS, width), bool), np.arange(ROWS), grid_columns(width)
    columns_first = ColumnTransformer(16, layers=1, pixel=16, blocks=1).eval()
    coarse, fill = CoarseUNet(16, (1, 1, 1, 1), 1).eval(), FillUNet((16, 16), (1, 1)).eval()

    def rays_of(chosen: np.ndarray, which: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        told, standing = grid_rays(sensor, blocked, chosen, which)
        return told.expand(2, -1, -1, -1), standing.expand(2, -1, -1)

    drawn = partial(grids, sensor=sensor, rows=rows, columns=columns, rays_of=rays_of, how=("columns", 128))
    told: list[int] = []
    finer = drawn(Cascade(coarse, fill, None, columns_first, network), rng=rngs(), on_step=lambda: told.append(1))
    plain = drawn(Cascade(coarse, fill, None, columns_first), rng=rngs(), on_step=lambda: None)
    assert len(told) == COLUMNS and finer[3].tolist() == sorted(set(finer[3].tolist())) and len(finer[3]) == count
    assert finer[0].shape == finer[1].shape == (2, ROWS, count) and set(columns) <= set(finer[3])
    assert (finer[2] == rows).all()
    kept = np.isin(finer[3], columns)
    assert torch.equal(finer[0][..., kept] > 0, plain[0] > 0)
    assert not finer[1][finer[0] == 0].any()
