"""The cascade's training: proper scores, patterns, standards, and a run of the command line's own loop."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch.testing import assert_close

from lidarsynth.data.dataset import CachedImages, SeveralCaches, write_cache
from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import with_fields
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.networks.coarse_unet import BINS, CoarseUNet, grid_columns, grid_rays, grid_rows
from lidarsynth.networks.column_neighbours import known_grid, spoilt
from lidarsynth.networks.fill_unet import Filled, Known
from lidarsynth.networks.rays import encode_range, rays_of
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.streets.virtual import VirtualStreets
from lidarsynth.systems.cascade import patterns
from lidarsynth.systems.cascade import training as cascade_training
from lidarsynth.systems.cascade.examples import crop, draw, mixed
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.cascade.patterns import pattern
from lidarsynth.systems.cascade.scores import absolute_errors, energy_score, expected_errors, misnamed
from lidarsynth.systems.cascade.training import fit_standard
from lidarsynth.systems.table import build_network, transfer
from lidarsynth.training import monitor
from lidarsynth.training.options import Options
from lidarsynth.verbs.training import run

TINY = with_fields(
    preset("default"),
    {"model.base_channels": 16, "model.channel_multipliers": (1, 1, 1, 1), "model.num_residual_blocks": (1, 1, 1, 1),
     "model.guide_channels": 8, "model.column_channels": 16, "model.between_channels": 16,
     "model.beam_channels": 14, "model.inside_channels": 8,
     "training.batch_size": 2, "training.steps": 2, "training.warmup": 0, "model.gn_num_groups": 8},
)  # fmt: skip


def test_the_energy_score_is_lowest_for_the_true_distribution():
    rng = torch.Generator().manual_seed(0)

    def score(mean: float, spread: float) -> float:
        first, second = (mean + spread * torch.randn(64, 3, 16, 32, generator=rng) for _ in range(2))
        return energy_score(first, second, torch.randn(64, 3, 16, 32, generator=rng)).mean().item()

    true = score(0, 1)
    assert true < min(score(0, 0.3), score(0, 2), score(0.5, 1))


def test_a_copy_of_the_truth_scores_nothing():
    truth = torch.randn(2, 3, 16, 32, generator=torch.Generator().manual_seed(1))
    assert_close(energy_score(truth, truth, truth), torch.zeros(2), atol=3e-3, rtol=0)


def test_beams_of_crops_answer_each_in_its_own_way_but_in_samples():
    sensor = SENSORS["vlp-16"].resized(width=1024)
    full = np.full((16, 1024), 10.0, np.float32)
    image = RangeImage(full, full / 25, full > 0, sensor)
    apart = {}
    for seed in range(60):
        known, _, (metres, reflectance, _) = crop(image, np.random.default_rng(seed), seed % 2 == 0)
        assert_close(known.reflectance, reflectance * known.lit)
        assert (reflectance[metres == 0] == 0).all()
        beams = reflectance[0, 0, :16].median(1).values
        apart.setdefault(seed % 2 == 0, []).append(float(beams.std()))
    assert max(apart[True]) < 1e-6
    uneven = np.array(apart[False]) > 1e-3
    assert 0.5 < uneven.mean() < 0.9 and max(apart[False]) > 0.05


def test_absolute_errors_count_hidden_returns_of_the_sensor_alone():
    sensor = SENSORS["vlp-16"]
    rays = rays_of(sensor, sensor.blocked_rays(), np.arange(64))
    shape = rays.elevation.shape
    metres = torch.full(shape, 10.0)
    told = torch.zeros(shape, dtype=torch.bool)
    told[:, :, :4] = True
    known = Known(metres, metres / 50, told, told, told)
    code = encode_range(metres).clone()
    code[:, :, :4] += 1  # known
    code[:, :, 16:] += 1  # padding
    code[..., :16] += 1  # beyond the seam
    filled = Filled(code, metres / 50, torch.full(shape, 50.0))
    assert_close(absolute_errors(filled, known, rays, metres, metres / 50), torch.zeros(1), atol=1e-5, rtol=0)
    code[:, :, 8, 30] += 0.1
    assert absolute_errors(Filled(code, *filled[1:]), known, rays, metres, metres / 50).item() > 0


def test_expected_errors_are_those_of_the_result_where_the_answer_is_sure():
    sensor = SENSORS["vlp-16"]
    rays = rays_of(sensor, sensor.blocked_rays(), np.arange(64))
    shape = rays.elevation.shape
    metres, none = torch.full(shape, 10.0), torch.zeros(shape, dtype=torch.bool)
    metres[..., 32:] = 0
    known = Known(torch.zeros(shape), torch.zeros(shape), none, none, none)
    sure = torch.where(metres > 0, 50.0, -50.0)

    def errors(logit: torch.Tensor, off: float = 0.0) -> float:
        filled = Filled(encode_range(torch.full(shape, 10.0 + off)), torch.full(shape, 0.5), logit)
        return expected_errors(filled, known, rays, metres, 0.5 * (metres > 0)).item()

    assert errors(sure) == pytest.approx(0, abs=1e-4)
    step = 1.5 * (np.log2(12) - np.log2(11)) / 4
    assert errors(sure, 1.0) == pytest.approx(0.25 * 0.5 + step, rel=1e-3)  # half of the pixels return
    assert errors(-sure) > 0.25 * 10 + 4 * 0.5  # all are wrong, by 10 m and by the reflectance


def test_an_arc_of_another_scan_of_the_same_sensor_is_mixed_in():
    class Pair(list):
        def take(self, indices):
            return [self[i] for i in indices]

    one, other = (RangeImage(np.full((4, 1024), r, np.float32), np.full((4, 1024), r / 9, np.float32),
                             np.ones((4, 1024), bool), SENSORS["vlp-16"].rows(range(4)))
                  for r in (1, 2))  # fmt: skip
    rng = np.random.default_rng(0)
    found = [mixed(one, Pair([other]), 0.5, rng) for _ in range(40)]
    shares = [float((image.range == 2).mean()) for image in found]
    assert 8 < sum(share > 0 for share in shares) < 32 and max(shares) <= 0.5
    assert all(((image.range == 2) == (image.reflectance > 0.2)).all() for image in found)
    assert (one.range == 1).all()
    elsewhere = replace(other, sensor=replace(other.sensor, mount=9.0))
    assert mixed(one, Pair([elsewhere]), 1.0, rng) is one and mixed(one, Pair([other]), 0.0, rng) is one


STREETS = VirtualStreets(6, 32)  # holds its world, so that it is built once


@lru_cache
def street(place: int) -> RangeImage:
    return STREETS.image(4 * place)


@pytest.mark.parametrize("seed", range(12))
def test_crops_tell_the_truth_and_nothing_else(seed: int):
    image = street(seed % 4)
    known, rays, (metres, reflectance, label) = crop(image, np.random.default_rng(seed), seed % 2 == 0)
    assert metres.shape == reflectance.shape == label.shape == rays.ground.shape == (1, 1, 64, 256)
    assert torch.equal(known.metres[known.told], (metres * known.returned)[known.told])
    assert not bool((known.lit & ~known.returned).any()) and not bool((known.lit & ~known.told).any())
    assert bool(known.told[rays.inside == 0].all())
    assert not bool(((metres > 0) & (rays.inside == 0)).any())
    assert not bool((rays.blocked.bool() & (metres > 0)).any())
    assert not bool((label.bool() & (metres == 0) & known.told).any())


def test_some_crops_are_of_perfect_scans_and_some_are_wholly_known():
    image = street(0)
    crops = [crop(image, np.random.default_rng(seed), seed % 2 == 0) for seed in range(80)]
    perfect = [(known, metres) for known, _, (metres, _, _) in crops if bool((known.returned & ~known.told).any())]
    assert 4 <= len(perfect) <= 22  # of 80: a fifth of those to be drawn, a tenth of the others
    for known, metres in perfect:
        assert bool(((metres == 0) | known.returned)[~known.told].all())  # nothing returns but from a surface
        assert torch.equal(metres[metres > 0], known.metres[metres > 0]) and not bool(known.lit.any())
    dropped = torch.stack([(known.returned & (metres == 0)).float().mean() for known, metres in perfect])
    assert 0.001 < dropped.mean().item() < 0.9
    assert any(bool(known.told.all()) for known, _, _ in crops)


def test_classes_are_learned_where_somebody_has_said_them():
    sensor = SENSORS["vlp-16"]
    rays = rays_of(sensor, sensor.blocked_rays(), np.arange(64))
    classes = torch.zeros(rays.elevation.shape, dtype=torch.long)
    classes[:, :, :8] = 9
    classes[:, :, 20:] = 3  # padding
    logits = torch.zeros(1, 20, *classes.shape[2:])
    filled = Filled(*(torch.zeros(classes.shape) for _ in range(3)), classes=logits)
    assert_close(misnamed(filled, rays, classes), torch.tensor([np.log(20.0)]).float())
    logits[:, 9] = 50
    assert misnamed(filled, rays, classes).item() < 1e-6


def test_patterns_leave_something_known_and_something_to_learn():
    shares = [pattern((64, 256), 1024, np.random.default_rng(i), i % 2 == 0).mean() for i in range(200)]
    assert 0 < min(shares) < 0.02
    assert max(shares) < 1
    assert 0.1 < np.mean(shares) < 0.5


def test_what_is_sparse_has_holes_at_times():
    """A run of 24 columns without any known pixel, beside others that know some beams and not all."""
    found = 0
    for i in range(400):
        known = pattern((64, 256), 1024, np.random.default_rng(i), False)
        lost = np.convolve(known.any(0), np.ones(24), "valid").min() == 0
        found += lost and known.any(1).sum() < 40 and known.any(1).sum() > 4 and known.mean() > 0.01
    assert 10 < found < 120


def test_what_learns_the_likeliest_image_knows_some_columns_alone_at_times():
    """A fill that had never met such ones left half of a scan empty that lacks columns."""
    counts = []
    for sampled in (False, True):
        each = [pattern((64, 256), 1024, np.random.default_rng(i), sampled) for i in range(600)]
        counts.append(sum(0.05 < known.mean() < 0.9 and (known == known[:1]).all() for known in each))
    assert 30 < counts[0] < 120
    assert counts[1] < counts[0] / 2  # generation needs none but holes


def test_one_part_of_a_scan_may_know_less_than_another(monkeypatch: pytest.MonkeyPatch):
    whole, none = np.ones((64, 256), bool), np.zeros((64, 256), bool)
    monkeypatch.setattr(patterns, "PARTED", 1)
    for i in range(8):
        some = iter((whole, none))
        monkeypatch.setattr(patterns, "pattern", lambda *_, some=some: next(some))
        known = pattern(whole.shape, 1024, np.random.default_rng(i), False)
        assert 0 < known.mean() < 1
        assert (known == known[:1]).all() or (known == known[:, :1]).all()  # a sector, or what is above a beam


def test_standards_make_the_ground_as_wide_as_the_horizon():
    network = CoarseUNet(16, (1, 1, 1, 1), 1)
    streets = VirtualStreets(6, 64)
    images = [streets.image(i) for i in range(0, 32, 4)]
    fit_standard(network, images)
    assert network.standard.shape == (2, 2, BINS)
    values = []
    for image in images:
        rows, columns = grid_rows(image.shape[0]), grid_columns(image.shape[1])
        _, standing = grid_rays(image.sensor, image.sensor.blocked_rays(), rows, columns)
        at = np.ix_(rows, columns)
        metres, reflectance = (
            torch.from_numpy(v[at].astype(np.float32))[None] for v in (image.range, image.reflectance)
        )
        x_0, low = network.encode(metres, reflectance, standing[None]), (standing < np.radians(-10))[None]
        values.append(x_0[:, 0][low & (metres > 0)])
    assert 0.6 < torch.cat(values).std().item() < 1.6


@pytest.mark.slow
def test_a_run_trains_both_stages_and_goes_on(tmp_path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cascade_training, "FITTED", 8)
    monkeypatch.setattr(monitor, "IMAGES", 1)  # each is a street of its own
    before = None
    for progress in run(TINY, "virtual", tmp_path / "run", options=Options(workers=0)):
        before = before or progress
    losses = progress.losses
    assert {"sample", "median", "likeliest", "layout", "guide", "columns", "between", "beams"} <= losses.keys()
    assert all(np.isfinite(value) for value in losses.values())
    from lidarsynth import load

    model = load(tmp_path / "run")
    assert model.network.columns is not None and model.network.between is not None and model.network.beams is not None
    assert model.generate(1, steps=1)[0].shape == (64, 1024)


@pytest.mark.slow
def test_with_a_base_what_one_sensor_has_of_its_own_alone_is_learned_and_kept(
    tmp_path, monkeypatch: pytest.MonkeyPatch
):
    from lidarsynth import load

    monkeypatch.setattr(monitor, "IMAGES", 1)
    monkeypatch.setattr(CascadeModel, "stream", None)  # what the base generates does not change, and is not drawn
    few = {"training.batch_size": 2, "training.steps": 2, "training.warmup": 0}
    for progress in run(with_fields(preset("kitti"), few), "virtual", tmp_path / "run", options=Options(workers=0)):
        parts = {"likeliest", "named", *(["observed"] if progress.step == 1 else [])}  # every fourth step
        assert progress.step == 0 or set(progress.losses) == {"loss", *parts}
    assert len(list((tmp_path / "run" / "pictures").glob("sample-00000002-*.png"))) == 1
    kept = load_file(tmp_path / "run" / "model.safetensors")
    assert kept and {name.split(".")[0] for name in kept} == {"likeliest", "observer", "classes"}
    before, after = (load(source).network.state_dict() for source in ("default", tmp_path / "run"))
    changed = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert changed == {"likeliest", "observer", "classes"}


@pytest.mark.slow
def test_classes_of_ones_own_are_learned_from_labels_and_kept_beside_a_base(tmp_path, monkeypatch: pytest.MonkeyPatch):
    from lidarsynth import load

    monkeypatch.setattr(monitor, "IMAGES", 1)
    few = {"training.batch_size": 2, "training.steps": 1, "training.warmup": 0, "model.observer_channels": 0}
    tuned = with_fields(preset("tuned"), few | {"model.own_classes": True})
    for progress in run(tuned, "recordings", tmp_path / "run", options=Options(workers=0)):
        assert progress.step == 0 or set(progress.losses) == {"loss", "likeliest", "named"}
    kept = load_file(tmp_path / "run" / "model.safetensors")
    assert {name.split(".")[0] for name in kept} == {"likeliest", "classes"}
    network = load(tmp_path / "run").network
    for name, value in kept.items():
        torch.testing.assert_close(network.state_dict()[name], value, atol=0, rtol=0)
    classes = load("default").network.classes.state_dict()
    assert any(not torch.equal(network.classes.state_dict()[name], value) for name, value in classes.items())
    judged = cascade_training.judge(tuned, network, [SyntheticStreets(3, 1).image(0)])
    assert 0 < judged["classes"] <= 1


def test_classes_are_not_learned_from_scans_that_nobody_has_labelled(tmp_path):
    image = SyntheticStreets(3, 1, SENSORS["hdl-64e-kitti"].resized(width=256)).image(0)
    tuned = with_fields(preset("tuned"), {"model.own_classes": True, "training.batch_size": 1})
    for name, label in (("bare", None), ("zero", np.zeros(image.shape, int)), ("named", image.label)):
        list(write_cache(tmp_path / name, lambda i: replace(image, label=label), 2, image.sensor, {"name": name}))  # noqa: B023
    for words in ("bare", "zero"):
        with pytest.raises(ValueError, match=r"expected images with labels, as model\.own_classes .*, found none; "):
            draw(tuned, CachedImages(tmp_path / words), [0], 0, [0])
        with pytest.raises(ValueError, match=r"expected images with labels, as model\.own_classes"):
            list(run(tuned, tmp_path / words, tmp_path / "run", options=Options(workers=0)))
        assert not (tmp_path / "run").exists()
    draw(tuned, SeveralCaches([tmp_path / "bare", tmp_path / "named"]), [0], 0, [0])


def test_an_arc_of_another_scan_brings_its_labels():
    class Two:
        def __len__(self) -> int:
            return 2

        def take(self, indices: list[int]) -> list[RangeImage]:
            return [other for _ in indices]

    metres = np.full((4, 64), 5.0, np.float32)
    sensor = Sensor("four", (2.0, 0.0, -2.0, -4.0), 64)
    image = RangeImage(metres, metres / 10, metres > 0, sensor)
    other = RangeImage(2 * metres, metres / 10, metres > 0, sensor, np.full(metres.shape, 9))
    both = mixed(image, Two(), 1.0, np.random.default_rng(0))
    assert both.label is not None and 0 < (both.label == 9).mean() < 1
    np.testing.assert_array_equal(both.label == 9, both.range == 10)
    assert set(np.unique(both.label)) == {0, 9}


def test_what_columns_are_told_of_their_neighbours_is_spoilt_at_times_and_never_what_they_learn():
    rng = torch.Generator().manual_seed(0)
    metres = 5 + 20 * torch.rand(16, 16, 128, generator=rng)
    grid = known_grid(metres, torch.rand(metres.shape, generator=rng))
    whole = [part.clone() for part in grid]
    wrong = spoilt(grid, torch.Generator().manual_seed(1))
    assert all((a == b).all() for a, b in zip(grid, whole, strict=True))
    share = ((wrong.code - grid.code).abs() > 1e-6).float().mean((1, 2))
    assert 3 <= (share == 0).sum() <= 13 and share.max() < 0.12
    assert (wrong.code[~wrong.returned] == 0).all() and not wrong.returned.all()


def test_a_share_of_a_batch_without_crops_of_the_most_likely_image_is_learned_from(tmp_path):
    """Of two samples one is drawn: the pass that has it, and of one sample every second step, has none to complete."""
    sensor = SENSORS["vlp-16"].resized(width=128)
    streets = SyntheticStreets(3, 2, sensor)
    list(write_cache(tmp_path / "cache", streets.image, 2, sensor, {"name": "synthetic"}))
    for size, accumulate in ((2, 2), (1, 1)):
        few = with_fields(TINY, {"training.batch_size": size, "data.sensor": "vlp-16", "data.height": 16,
                                 "data.width": 128, "data.projection": "auto"})  # fmt: skip
        quiet = Options(workers=0, sample_every=0, accumulate=accumulate)
        *_, last = run(few, tmp_path / "cache", tmp_path / f"{size}", options=quiet)
        assert last.step == 2 and np.isfinite(last.losses["loss"]) and np.isfinite(last.grad_norm)


def test_the_most_likely_image_learns_from_all_crops_alike_however_a_batch_is_shared(tmp_path):
    """Of three samples one is drawn: one pass of three has no crop to complete, the others one each."""
    sensor = SENSORS["vlp-16"].resized(width=128)
    list(write_cache(tmp_path / "cache", SyntheticStreets(3, 3, sensor).image, 3, sensor, {"name": "synthetic"}))
    few = with_fields(TINY, {"training.batch_size": 3, "training.steps": 1, "training.clip_norm": None,
                             "data.sensor": "vlp-16", "data.height": 16, "data.width": 128,
                             "data.projection": "auto"})  # fmt: skip
    moments = []
    for passes in (1, 3):
        quiet = Options(workers=0, sample_every=0, accumulate=passes)
        list(run(few, tmp_path / "cache", tmp_path / f"{passes}", options=quiet))
        state = torch.load(tmp_path / f"{passes}" / "checkpoints" / "step-00000001" / "state.pt", weights_only=True)
        moments.append([m["exp_avg"] for m in state["optimizers"]["likeliest"]["state"].values()])
    for one, three in zip(*moments, strict=True):
        assert_close(three, one, rtol=1e-3, atol=1e-6)


def test_no_crops_have_gradients_of_nothing():
    """As a distributed wrapper expects one for every parameter."""
    network = torch.nn.Linear(2, 3)
    losses = cascade_training._of_none(network)
    torch.cat([losses, network.weight.new_zeros(1)]).mean().backward()
    assert losses.shape == (0,) and all(not p.grad.any() for p in network.parameters())


def test_what_names_insides_alone_starts_as_what_tells_them_from_streets():
    """Where a network of its own told which scans are of insides, the one that names them need not know streets."""
    source = with_fields(TINY, {"model.indoors_channels": 8})
    weights, both, alone = build_network(source), build_network(source), build_network(TINY)
    for network, record in ((both, source), (alone, TINY)):
        transfer(network, record, weights, source, "weights")
    first = {name: value for name, value in weights.state_dict().items() if name.endswith("stem.weight")}
    assert not torch.equal(first["inside.stem.weight"], first["indoors.stem.weight"])
    assert_close(both.state_dict()["inside.stem.weight"], first["inside.stem.weight"])
    assert_close(both.state_dict()["indoors.stem.weight"], first["indoors.stem.weight"])
    assert_close(alone.state_dict()["inside.stem.weight"], first["indoors.stem.weight"])


def test_a_fill_for_the_least_error_of_other_blocks_does_not_start_from_nothing_unsaid():
    source = with_fields(TINY, {"model.likeliest": True, "model.likeliest_blocks": (1, 1, 1, 2)})
    other = with_fields(source, {"model.likeliest_blocks": (1, 1, 1, 1)})
    none = with_fields(TINY, {"model.likeliest": False})
    weights, same = build_network(source), build_network(source)
    transfer(same, source, weights, source, "weights")
    learned = {name: value for name, value in weights.state_dict().items() if name.startswith("likeliest.down")}
    assert learned and all(torch.equal(same.state_dict()[name], value) for name, value in learned.items())
    transfer(build_network(none), none, weights, source, "weights")
    found = (
        r"weights: expected .* model.likeliest_blocks \[1, 1, 1, 1\], found \[1, 1, 1, 2\]: .*=\[1, 1, 1, 2\]' goes on"
    )
    with pytest.raises(ValueError, match=found):
        transfer(build_network(other), other, weights, source, "weights")
