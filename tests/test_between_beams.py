"""What draws the beams between those of a grid: told what is known and drawn before, it draws what it says."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from planes import plane_grid
from torch.testing import assert_close

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.between_beams import STRIDES, BetweenBeams, draw_beams, interleaved, phases, with_between
from lidarsynth.networks.between_columns import BetweenColumns
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.coarse_unet import ROWS, CoarseUNet, grid_columns, grid_rays, grid_rows
from lidarsynth.networks.column_neighbours import Grid, known_grid
from lidarsynth.networks.column_transformer import ColumnTransformer
from lidarsynth.networks.fill_unet import FillUNet
from lidarsynth.networks.pixel_mixture import CODES, TONES, picked
from lidarsynth.networks.rays import decode_range
from lidarsynth.systems.cascade import layout
from lidarsynth.systems.cascade.examples import TALL, WIDE, taller
from lidarsynth.systems.cascade.layout import beyond, grids

WIDTH = 64
SENSOR = Sensor("thirty-one", tuple(np.linspace(6, -24, TALL).tolist()), WIDTH, 0.5, 120.0, mount=1.8)
BLOCKED = np.zeros((TALL, WIDTH), bool)
BLOCKED[24:, 40:50] = True


@pytest.fixture(scope="module")
def network() -> BetweenBeams:
    torch.manual_seed(0)
    return BetweenBeams(14, layers=1, blocks=1).eval()


def rays(first: int) -> torch.Tensor:
    """Of every second beam, two alike."""
    told, _ = grid_rays(SENSOR, BLOCKED, np.arange(first, TALL, 2), np.arange(WIDTH))
    return told.expand(2, -1, -1, -1)


def seen(normal: tuple[float, float, float], level: float) -> Grid:
    return plane_grid(SENSOR, BLOCKED, normal, level)


def every_second(grid: Grid, first: int) -> Grid:
    return Grid(*(part[:, first::2] for part in grid))


@pytest.fixture(scope="module")
def known() -> Grid:
    return every_second(seen((1.0, 0.4, -0.2), 9.0), 0)


def rngs() -> list[torch.Generator]:
    return [torch.Generator().manual_seed(k) for k in range(2)]


@pytest.fixture(scope="module")
def drawn(network: BetweenBeams, known: Grid) -> Grid:
    return draw_beams(network, known, rays(0), rays(1), rngs(), sharp=0.5, heats=(1.0, 1.0))


def test_every_column_is_drawn_once_after_those_it_is_told_of():
    order = phases(WIDTH)
    assert [len(part) for part in order] == [8, 8, 16, 32] and len(order) == len(STRIDES)
    assert torch.cat(order).sort().values.tolist() == list(range(WIDTH))


@torch.inference_mode()
def test_new_beams_are_drawn_as_the_network_says_of_the_whole(network: BetweenBeams, known: Grid, drawn: Grid):
    chance = torch.stack([torch.rand(5, ROWS - 1, WIDTH, generator=one) for one in rngs()]).clamp(0.001, 0.999)
    u = chance.permute(0, 2, 3, 1).flatten(0, 2)
    said, hypotheses, *copies = network.said(known, rays(0), drawn, rays(1), torch.arange(WIDTH))
    shades = network.shades(said, drawn.code, hypotheses, *copies)
    returns, choice, centre, scale = (part.flatten(0, 2) for part in said[:4])
    back = (u[:, 0] < returns.sigmoid()) & (rays(1)[:, 6] < 0.5).flatten()
    assert (back == drawn.returned.flatten()).all() and 300 < back.sum() < back.numel()
    assert_close(picked(choice, centre, scale, u[:, 1:3], 0.5, 1, CODES)[back], drawn.code.flatten()[back])
    shade = picked(*(part.flatten(0, 2) for part in shades), u[:, 3:5], 1, 1, TONES)
    assert_close(shade[back], drawn.shade.flatten()[back], atol=1e-3, rtol=0)
    assert not drawn.code[~drawn.returned].any() and not drawn.returned[:, 12:, 40:50].any()


@torch.inference_mode()
def test_a_new_pixel_knows_the_known_ones_and_those_of_earlier_phases_alone(
    network: BetweenBeams, known: Grid, drawn: Grid
):
    def changes(other: Grid, hidden: Grid) -> torch.Tensor:
        columns = torch.arange(WIDTH)
        pairs = ((network.said(k, rays(0), h, rays(1), columns)[0]) for k, h in ((known, drawn), (other, hidden)))
        return torch.stack([(a - b).abs().reshape(2, ROWS - 1, WIDTH, -1).amax((0, 3))
                            for a, b in zip(*(pair[:4] for pair in pairs), strict=True)]).amax(0) > 1e-5  # fmt: skip

    def changed(grid: Grid, column: int) -> Grid:
        other = Grid(*(part.clone() for part in grid))
        other.code[:, 7, column], other.shade[:, 7, column], other.returned[:, 7, column] = 0.3, 0.7, True
        return other

    for column, told in ((16, {12, 20, 14, 18, 15, 17}), (20, {18, 22, 19, 21}), (22, {21, 23}), (23, set())):
        after = changes(known, changed(drawn, column))
        assert set(after[7].nonzero()[:, 0].tolist()) == told and after.sum() == after[7].sum()
    around = changes(changed(known, 20), drawn)
    assert around[6:8, 18:23].any() and not around[:, :9].any() and not around[:, 31:].any()


@pytest.mark.parametrize(
    ("normal", "level", "which"),
    [((0.0, 0.0, 1.0), -1.8, (0, 3, 4, 5)), ((0.03, 0.02, 1.0), -1.8, (3, 4, 5, 9)), ((1.0, 0.4, 0.0), 9.0, (1, 2, 3))],
)
def test_hypotheses_of_surfaces_are_exact(
    network: BetweenBeams, normal: tuple[float, float, float], level: float, which: tuple[int, ...]
):
    whole = seen(normal, level)
    known, hidden = every_second(whole, 0), every_second(whole, 1)
    said = network.said(known, rays(0), hidden, rays(1), torch.arange(WIDTH))[1]
    judged = hidden.returned & (hidden.code < 0.4)
    judged[:, -4:] = False  # those below are known, and none of them blocked
    for one in which:
        off = (said[..., one] - hidden.code).abs()[judged]
        assert off.numel() > 50 and float(off.median()) < 1e-3, one


def test_the_mean_likelihood_is_of_what_is_free_and_judged(network: BetweenBeams, known: Grid, drawn: Grid):
    one = network(known, rays(0), drawn, rays(1))
    assert one.shape == (2, 3) and torch.isfinite(one).all()
    hidden = Grid(*(part.clone() for part in drawn))
    hidden.code[:, 12:, 40:50] = 0.5  # blocked: no return, and never told
    assert_close(network(known, rays(0), hidden, rays(1)), one)
    halves = [network(known, rays(0), drawn, rays(1), torch.arange(k, WIDTH, 2)) for k in (0, 1)]
    assert_close((halves[0] + halves[1])[:, 0] / 2, one[:, 0], rtol=1e-2, atol=0)


def test_what_is_between_is_in_its_place(known: Grid, drawn: Grid):
    both = interleaved(known, drawn)
    assert torch.equal(both.code[:, ::2], known.code) and torch.equal(both.returned[:, 1::2], drawn.returned)
    assert with_between(np.array([2, 6, 11])).tolist() == [2, 4, 6, 8, 11]


@pytest.mark.parametrize(
    ("beams", "width", "shape"),
    [(16, 520, (16, 512)), (30, 520, (16, 512)), (31, 520, (31, 512)), (32, 520, (32, 512)), (40, 520, (33, 512)),
     (64, 520, (64, 512)), (128, 520, (68, 512)), (64, 300, (16, 256))],
)  # fmt: skip
def test_grids_are_as_tall_as_the_sensor_has_beams(
    network: BetweenBeams, beams: int, width: int, shape: tuple[int, int], monkeypatch: pytest.MonkeyPatch
):
    """All of 31, 32 or 64 beams; of 40, 31 and the two beyond them; of 128, 61 and seven; of fewer, 16."""
    monkeypatch.setattr(layout, "landed", lambda grid, rng: grid)  # else others hang in the one and the other
    monkeypatch.setattr(layout, "_in_line", lambda grid, rows, sensor: grid)  # else all move a little
    torch.manual_seed(1)
    sensor = Sensor("any", tuple(np.linspace(6, -24, beams).tolist()), width, 0.5, 120.0, mount=1.8)
    blocked, rows, columns = np.zeros((beams, width), bool), grid_rows(beams), grid_columns(width)
    blocked[-1, 30:90] = True
    between = BetweenColumns(16, layers=1, blocks=1).eval()
    columns_first = ColumnTransformer(16, layers=1, pixel=16, blocks=1).eval()
    coarse, fill = CoarseUNet(16, (1, 1, 1, 1), 1).eval(), FillUNet((16, 16), (1, 1)).eval()

    def rays_of(chosen: np.ndarray, which: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        told, standing = grid_rays(sensor, blocked, chosen, which)
        return told.expand(2, -1, -1, -1), standing.expand(2, -1, -1)

    drawn = partial(grids, sensor=sensor, rows=rows, columns=columns, rays_of=rays_of, how=("columns", 128))
    parts = (coarse, fill, None, columns_first, between)
    tall = drawn(Cascade(*parts, network), rng=rngs(), on_step=lambda: None)
    plain = drawn(Cascade(*parts), rng=rngs(), on_step=lambda: None)
    metres, shade, chosen, places = tall
    assert metres.shape == shade.shape == (2, *shape) and (len(chosen), len(places)) == shape
    assert chosen.tolist() == sorted(set(chosen.tolist())) and set(rows) <= set(chosen)
    kept = np.isin(chosen, rows)
    assert torch.equal(metres[:, kept], plain[0])
    assert torch.isfinite(metres).all() and not shade[metres == 0].any()
    assert not metres[:, np.ix_(chosen, places)[0][:, 0] == beams - 1][..., blocked[-1, places]].any()


@pytest.mark.parametrize(("beams", "straightened"), [(16, []), (32, [31]), (64, [61])])
def test_drawn_beams_are_put_in_line_with_the_grids(
    network: BetweenBeams, beams: int, straightened: list[int], monkeypatch: pytest.MonkeyPatch
):
    """What was drawn between beams is straightened with them before those beyond go on with it."""
    seen: list[int] = []

    def half_as_far(metres: torch.Tensor, rows: np.ndarray, sensor: Sensor) -> torch.Tensor:
        seen.append(len(rows))
        return metres / 2

    torch.manual_seed(1)
    sensor = Sensor("any", tuple(np.linspace(6, -24, beams).tolist()), 512, 0.5, 120.0, mount=1.8)
    rows, columns = grid_rows(beams), grid_columns(512)
    between = BetweenColumns(16, layers=1, blocks=1).eval()
    cascade = Cascade(CoarseUNet(16, (1, 1, 1, 1), 1), FillUNet((16, 16), (1, 1)), None, None, between, network)
    grid = known_grid(torch.full((2, 16, 128), 5.0), torch.full((2, 16, 128), 0.3))

    def rays_of(chosen: np.ndarray, which: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        told, standing = grid_rays(sensor, np.zeros((beams, 512), bool), chosen, which)
        return told.expand(2, -1, -1, -1), standing.expand(2, -1, -1)

    monkeypatch.setattr(layout, "landed", lambda grid, rng: grid)
    parts = (grid, (rows, columns), rays_of, sensor, np.zeros((beams, 1), np.float32))
    plain = layout.detailed(cascade, *parts, rngs())[0]
    monkeypatch.setattr(layout, "across_rings", half_as_far)
    moved = layout.detailed(cascade, *parts, rngs())[0]
    assert seen == straightened
    own = slice(None) if not straightened else slice(1, 1 + straightened[0])
    expected = plain[:, own] / (2 if straightened else 1)
    assert (moved[:, own] - expected).abs().le(1e-3 * expected + 1e-3).float().mean() > 0.99  # a code has a least range


def test_what_is_beyond_goes_on_with_the_plane_or_stands_upright():
    for normal, level in (((0.0, 0.0, 1.0), -1.8), ((1.0, 0.4, 0.0), 9.0)):
        whole = seen(normal, level)
        told = grid_rays(SENSOR, BLOCKED, np.arange(TALL), np.arange(WIDTH))[0].expand(2, -1, -1, -1)
        for inner, outer, side in ((slice(2, None), slice(0, 2), (0, 1)), (slice(None, 29), slice(29, None), (-1, -2))):
            grid, truth = (Grid(*(part[:, rows] for part in whole)) for rows in (inner, outer))
            found = beyond(grid, told[:, :, inner], told[:, :, outer], side)
            both = found.returned & truth.returned & (truth.code < 0.4)
            assert (found.returned == truth.returned)[..., 10:14].all()
            nearer = torch.minimum(truth.code, told[:, 1, outer] / 2)  # a wall ends on the ground
            assert not both.any() or float((found.code - nearer).abs()[both].max()) < 2e-3


def test_the_ground_goes_on_as_ground_however_far_apart_beams_are_and_nothing_is_below_it():
    """A VLP-32C has beams at -11.3, -15.6 and -25 degrees: the road ended at a wall where the last one was beyond."""
    sensor = Sensor("far apart", (1.0, -6.0, -11.3, -15.6, -25.0), 64, mount=1.8)
    told = grid_rays(sensor, np.zeros((5, 64), bool), np.arange(5), np.arange(64))[0][None]
    road = 1.8 / -sensor.directions()[..., 2]
    metres = np.where(road > 0, road, 20)
    metres[:4, 20:30] = 5 / np.cos(np.radians(np.asarray(sensor.elevations[:4])))[:, None]  # a wall, 5 m away
    grid = known_grid(torch.from_numpy(metres).float()[None], torch.full((1, 5, 64), 0.3))
    found = beyond(Grid(*(part[:, :4] for part in grid)), told[:, :, :4], told[:, :, 4:], (-1, -2))
    np.testing.assert_allclose(decode_range(found.code)[0, 0].numpy(), road[4], rtol=0.02)


def test_kerbs_run_along_the_street_beyond_the_last_beam():
    """3 m to each side the ground is 15 cm higher, and brighter: the last ring is on the road where the one above it is
    not any more."""
    sensor = Sensor("far apart", (1.0, -6.0, -11.3, -15.6, -25.0), 512, mount=1.8)
    told = grid_rays(sensor, np.zeros((5, 512), bool), np.arange(5), np.arange(512))[0][None]
    _, side, down = np.moveaxis(sensor.directions(), -1, 0)
    road, walk = (height / np.maximum(-down, 1e-3) for height in (1.8, 1.65))
    on_walk = np.abs(walk * side) > 3
    metres = np.where(down > 0, 20, np.where(on_walk, walk, road))
    grid = known_grid(
        torch.from_numpy(metres).float()[None], torch.from_numpy(np.where(on_walk, 0.5, 0.2)).float()[None]
    )
    found = beyond(Grid(*(part[:, :4] for part in grid)), told[:, :, :4], told[:, :, 4:], (-1, -2))
    off = np.abs(decode_range(found.code)[0, 0].numpy() - metres[4])
    assert on_walk[4].mean() + 0.1 < on_walk[3].mean() and (off < 0.02).mean() > 0.97
    assert ((found.shade[0, 0].numpy() > 0.35) == on_walk[4]).mean() > 0.97


def test_taller_grids_of_training_have_each_beam_with_its_own_rays():
    sensor = Sensor("any", tuple(np.linspace(6, -24, 64).tolist()), 1024, 0.5, 120.0, mount=1.8)
    metres = np.repeat(np.arange(1.0, 65)[:, None], 1024, 1)
    image = RangeImage(metres, np.full(metres.shape, 0.5), np.ones(metres.shape, bool), sensor)
    for fine, step in ((False, 2), (True, 1)):
        found, shade, told, standing = taller(image, np.random.default_rng(2), fine)
        assert found.shape == shade.shape == standing.shape == (TALL, WIDE)
        rows = found[:, 0].numpy().astype(int) - 1
        assert (np.diff(rows) == step).all()
        elevations = np.radians(np.asarray(sensor.elevations)[rows])
        assert np.allclose(told[0, :, 0].numpy() / 3, elevations, atol=1e-5)
    few = Sensor("few", tuple(np.linspace(6, -24, 16).tolist()), 1024, 0.5, 120.0, mount=1.8)
    image = RangeImage(metres[:16], np.full((16, 1024), 0.5), np.ones((16, 1024), bool), few)
    found, _, told, _ = taller(image, np.random.default_rng(2), True)
    assert not found.any() and (told[6] == 1).all()


def test_taller_grids_of_training_have_no_speckle():
    sensor = Sensor("any", tuple(np.linspace(6, -24, 64).tolist()), 1024, 0.5, 120.0, mount=1.8)
    speckled = 0.4 + np.random.default_rng(0).normal(0, 0.02, (64, 1024))
    image = RangeImage(np.full((64, 1024), 9.0), speckled, np.ones((64, 1024), bool), sensor)
    shade = taller(image, np.random.default_rng(2), True)[1].numpy()
    assert shade.std() < 0.5 * speckled.std()
    assert abs(shade.mean() - 0.4) < 0.005


def test_beams_are_told_a_grid_without_speckle(monkeypatch: pytest.MonkeyPatch):
    """What the network that draws between the beams gets of a wall of one reflectance and its speckle."""
    told = []

    def noted(_, grid: Grid, *__) -> Grid:
        told.append(grid.shade)
        return Grid(*(part[:, :-1] for part in grid))

    monkeypatch.setattr(layout, "draw_beams", noted)
    speckle = torch.randn(1, 16, 512, generator=torch.Generator().manual_seed(1))
    grid = known_grid(torch.full((1, 16, 512), 9.0), 0.4 + 0.02 * speckle)
    rows, columns = np.arange(0, 64, 4), np.arange(0, 1024, 2)

    def rays_of(rows: np.ndarray, columns: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.zeros(1, 8, len(rows), len(columns)), torch.zeros(1, len(rows), len(columns))

    layout._taller(SimpleNamespace(beams=object()), grid, rows, columns, rays_of, [])  # type: ignore[arg-type]
    assert told[0].std() < 0.5 * grid.shade.std()
