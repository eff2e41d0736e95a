"""Of several drawn layouts one is kept, by the odds that the judge gives it as a street's."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import lidarsynth as ls
from lidarsynth.diffusion.samplers import generators
from lidarsynth.experiment.record import Experiment, Model
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.coarse_unet import CoarseUNet, grid_rays
from lidarsynth.networks.column_neighbours import Grid, known_grid
from lidarsynth.networks.column_transformer import ColumnTransformer
from lidarsynth.networks.fill_unet import FillUNet
from lidarsynth.networks.grid_judge import GridJudge, openness
from lidarsynth.systems.cascade import layout
from lidarsynth.systems.cascade.family import build
from lidarsynth.systems.cascade.images import grid_of
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.verbs.generation import Drawing, precision_of

SENSOR = ls.Sensor("small", tuple(np.linspace(5, -25, 32).tolist()), 256, 0.5, 120.0, mount=1.8)


class Fullest(nn.Module):
    """Takes the grid with the most returns."""

    def forward(self, grid: Grid, rays: Tensor) -> Tensor:
        assert rays.shape[1:] == (8, 16, 128)
        return 100 * grid.returned.float().sum((1, 2))


def cascade(judge: nn.Module | None) -> CascadeModel:
    torch.manual_seed(3)
    columns = ColumnTransformer(16, layers=1, pixel=16, blocks=1)
    parts = CoarseUNet(16, (1, 1, 2, 2), 1), FillUNet((16, 16, 16, 16)), None, columns
    network = Cascade(*parts, judge=judge).eval()  # type: ignore[arg-type]
    record = Experiment("small")
    return CascadeModel(network, SENSOR, record)


def random_grid(count: int, seed: int) -> tuple[Grid, Tensor]:
    rng = torch.Generator().manual_seed(seed)
    code, shade = (torch.rand(count, 16, 128, generator=rng) for _ in range(2))
    rows, columns = np.arange(0, 32, 2), np.arange(0, 256, 2)
    rays = grid_rays(SENSOR, np.zeros((32, 256), bool), rows, columns)[0]
    return Grid(code, shade, code > 0.3), rays.expand(count, *rays.shape)


def test_its_odds_go_around_the_turn_with_grid_and_rays():
    torch.manual_seed(1)
    judge = GridJudge(16).eval()
    for along in judge.along:
        nn.init.normal_(along.out.weight, std=0.1)  # type: ignore[union-attr, arg-type]
    grid, rays = random_grid(3, 2)
    odds = judge(grid, rays)
    assert odds.shape == (3,) and odds.std() > 0
    turned = judge(Grid(*(part.roll(37, 2) for part in grid)), rays.roll(37, 3))
    torch.testing.assert_close(turned, odds, atol=2e-3, rtol=2e-3)


def test_it_learns_to_tell_two_kinds_of_grids():
    torch.manual_seed(1)
    judge = GridJudge(16)
    optimizer = torch.optim.AdamW(judge.parameters(), 3e-3)
    for step in range(40):
        grid, rays = random_grid(8, step)
        flat = grid._replace(code=grid.code.mean(2, keepdim=True).expand(grid.code.shape))
        odds = torch.cat([judge(grid, rays), judge(flat, rays)])
        loss = nn.functional.binary_cross_entropy_with_logits(odds, (torch.arange(16) < 8).float())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss.item() < 0.1


def test_openness_tells_how_near_things_stand_and_what_returns():
    rows, columns = np.arange(0, 32, 2), np.arange(0, 256, 2)
    rays = grid_rays(SENSOR, np.zeros((32, 256), bool), rows, columns)[0][None]
    elevation = np.radians(np.asarray(SENSOR.elevations))[rows][:, None]
    flat = np.where(elevation < 0, SENSOR.mount / np.maximum(np.sin(-elevation), 1e-3), 100.0)
    metres = np.broadcast_to(np.minimum(flat, 100.0), (16, 128)).copy()
    plain = known_grid(torch.from_numpy(metres).float()[None], torch.zeros(1, 16, 128))
    assert openness(plain, rays)[0, :5].tolist() == pytest.approx([0, 0, 0, 0, 1])
    metres[:4, :32] = 5.0  # of sixteen beams the upper four, a quarter of the turn
    metres[0, 64:] = 0
    numbers = openness(known_grid(torch.from_numpy(metres).float()[None], torch.zeros(1, 16, 128)), rays)[0]
    assert numbers[:5].tolist() == pytest.approx([0, 0.25, 0.25, 0.25, 1 - 1 / 32], abs=1e-4)
    assert numbers[5].item() == pytest.approx(np.log(metres[metres > 0]).mean(), rel=1e-3)


def test_odds_lose_what_they_owe_to_openness():
    grid, rays = random_grid(6, 3)
    torch.manual_seed(2)
    plain, less = GridJudge(16), GridJudge(16, (0.5, 0, 0, 0, -2.0, 0.1))
    less.load_state_dict(plain.state_dict())
    numbers = openness(grid, rays)
    owed = 0.5 * numbers[:, 0] - 2 * numbers[:, 4] + 0.1 * numbers[:, 5]
    torch.testing.assert_close(less(grid, rays), plain(grid, rays) - owed)
    torch.testing.assert_close(less.of_all(grid, rays), plain(grid, rays))
    with pytest.raises(ValueError, match=r"model.judge_openness: expected six numbers or none, found \(1.0,\)"):
        build(Experiment("small", model=Model(judge_channels=16, judge_openness=(1.0,))), SENSOR)


def test_the_best_of_each_scans_own_draws_is_kept(monkeypatch: pytest.MonkeyPatch):
    drawn: list[Grid] = []
    true_draw = layout.draw

    def seen(*args: object, **kwargs: object) -> Grid:
        drawn.append(true_draw(*args, **kwargs))  # type: ignore[arg-type]
        return drawn[-1]

    monkeypatch.setattr(layout, "draw", seen)
    model = cascade(Fullest())
    images = model.generate(2, seed=4)
    (every,) = drawn
    assert len(every.code) == layout.CHOICE * layout.block(("columns", 128), layout.CHOICE)
    counts = every.returned.flatten(1).sum(1).view(-1, layout.CHOICE)
    assert (counts.float().std(1) > 0).any(), "draws of one scan differ"
    rng = generators(4, 8)
    rays = grid_rays(SENSOR, np.zeros((32, 256), bool), *grid_of(SENSOR))
    told, standing = (part.expand(8, *part.shape) for part in rays)
    with torch.inference_mode():
        kept = layout._chosen(model.network, told, standing, rng, lambda: None, layout.CHOICE)
    assert torch.equal(kept.returned.flatten(1).sum(1), counts.amax(1))
    assert len(images) == 2 and images[0].mask.any()


def test_one_is_kept_by_its_odds(monkeypatch: pytest.MonkeyPatch):
    """Three times as often, where they are three times as good."""
    count = 4000

    class Odds(nn.Module):
        def forward(self, grid: Grid, rays: Tensor) -> Tensor:
            return grid.code[:, 0, 0] * np.log(3)

    numbers = torch.arange(2.0).repeat(count).view(-1, 1, 1)
    grids = Grid(numbers, numbers, numbers > 0)
    monkeypatch.setattr(layout, "draft", lambda *args: None)
    monkeypatch.setattr(layout, "draw", lambda *args: grids)
    none = torch.zeros(count, 1, 1)
    kept = layout._chosen(cascade(Odds()).network, none, none, generators(4, count), lambda: None, 2)
    assert kept.code.shape == (count, 1, 1) and kept.code.mean().item() == pytest.approx(0.75, abs=0.03)
    assert torch.equal(kept.returned, kept.code > 0)


def test_a_chosen_scan_is_the_same_however_many_are_made():
    model = cascade(Fullest())
    three = model.generate(3, seed=5)
    (last,) = model.stream(3, seed=5, first=2)
    np.testing.assert_array_equal(three[2].range, last.range)
    assert (three[0].mask != three[1].mask).any()
    without = replace(model, network=cascade(None).network)
    (plain,), (one,) = without.generate(1, seed=5), model.choosing(1).generate(1, seed=5)
    np.testing.assert_array_equal(one.range, plain.range)
    assert (plain.mask != three[0].mask).any()


def test_scans_differ_by_precision_and_folders_know_it():
    quick = Drawing("default", precision="bf16").of(cascade(None))
    assert precision_of(quick) == {"precision": "bf16"} and precision_of(Drawing().of(quick)) == {}
    assert precision_of(Drawing("bilinear", precision="auto").of(ls.load("bilinear"))) == {}
    (exact,), (near,) = (model.generate(1, seed=5) for model in (cascade(None), quick))
    assert (exact.range != near.range).any()
    with pytest.raises(ValueError, match="expected precision fp32, or a cascade such as default for bf16"):
        Drawing("bilinear", precision="bf16").of(ls.load("bilinear"))


def test_what_cannot_choose_says_so():
    with pytest.raises(ValueError, match="expected a model that chooses among layouts, such as default, found small"):
        cascade(None).choosing(2)
    with pytest.raises(ValueError, match="expected at least 1 layout, found 0"):
        cascade(Fullest()).choosing(0)
    with pytest.raises(
        ValueError, match="expected a model that chooses among layouts, such as default, found bilinear"
    ):
        Drawing("bilinear", layouts=2).of(ls.load("bilinear"))
