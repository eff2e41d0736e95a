"""The training step: R2DM's schedules, the order of the data, the randomness of a sample, and the loss."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from lidarsynth.data.frames import Name
from lidarsynth.diffusion.denoiser import min_snr_weight
from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import Experiment, Training, with_fields
from lidarsynth.lidar.depth import from_x_0, to_x_0
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.systems.diffusion.build import build_denoiser
from lidarsynth.systems.diffusion.training import DiffusionBatch, Objective, draw, draw_images, random_known, scaled
from lidarsynth.systems.diffusion.validation import TIMES, fixed_losses
from lidarsynth.systems.table import build_network, task_of
from lidarsynth.training.examples import Examples, Streets, batch_indices, load_batches
from lidarsynth.training.loop import learning_rate, start, train, update_ema
from lidarsynth.training.machine import accelerator_of
from lidarsynth.training.options import Options
from lidarsynth.training.randomness import augment
from lidarsynth.training.task import ema_decay, ema_due

TINY = preset("tiny")


class Noise:
    """Images of a seed, without a cache; image `broken` is NaN."""

    def __init__(self, length: int = 10, broken: int | None = None):
        self.length = length
        self.broken = broken
        self.source = {"name": "noise"}

    def __len__(self) -> int:
        return self.length

    def name(self, i: int) -> Name:
        return Name("noise", "", str(i))

    def x_0(self, indices: list[int], codec: str = "log") -> Tensor:
        images = [torch.rand(2, 16, 64, generator=torch.Generator().manual_seed(i)) * 2 - 1 for i in indices]
        return torch.stack([x * math.nan if i == self.broken else x for i, x in zip(indices, images, strict=True)])


@pytest.fixture
def schedules(reference: Path) -> dict:
    return json.loads((reference / "fixtures" / "diffusion" / "training_schedules.json").read_text())


def network(experiment: Experiment = TINY, seed: int = 0) -> nn.Module:
    """A network whose last layer is not zero, so that its output depends on all of it."""
    torch.manual_seed(seed)
    net = build_network(experiment)
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.02)
    return net


def test_learning_rate_is_r2dm_s(schedules: dict):
    expected = schedules["lr"]["lr_at_scheduler_step"]
    assert len(expected) > 10
    for step, rate in expected.items():
        assert learning_rate(Training(), int(step)) == pytest.approx(rate, rel=1e-9, abs=1e-18)


def test_average_follows_ema_pytorch(schedules: dict):
    oracle = schedules["ema"]
    training = Training(
        ema_decay=oracle["beta"], ema_every=oracle["update_every"], ema_start=oracle["update_after_step"]
    )
    rows = {row[0]: row for row in oracle["rows"]}
    average, weight = nn.Linear(1, 1, bias=False), nn.Linear(1, 1, bias=False)
    for k in range(1, 1001):
        nn.init.constant_(weight.weight, math.sin(k / 37))
        if ema_due(training, k):
            update_ema(average, weight, ema_decay(training, k))
        if k in rows:
            assert float(average.weight.detach()) == pytest.approx(rows[k][2], abs=2e-6), k
    assert len(rows) > 50


def test_average_includes_floating_buffers_and_copies_counters():
    ours, theirs = nn.BatchNorm1d(2), nn.BatchNorm1d(2)
    theirs.running_mean, theirs.num_batches_tracked = torch.ones(2), torch.tensor(7)
    update_ema(ours, theirs, 0.75)
    torch.testing.assert_close(ours.running_mean, torch.full((2,), 0.25))
    assert int(ours.num_batches_tracked) == 7


def test_every_epoch_visits_every_image_once():
    training, images = Training(batch_size=4, seed=3), Noise(10)
    seen = [i for step in range(10) for i in batch_indices(training, step, images)]  # type: ignore[arg-type]
    epochs = [seen[first : first + 10] for first in range(0, 40, 10)]
    assert all(sorted(epoch) == list(range(10)) for epoch in epochs)
    assert epochs[0] != epochs[1]


def test_streets_never_repeat_and_a_step_mixes_worlds():
    pytest.importorskip("embreex", reason="lidarsynth[synthetic] is not installed")
    from lidarsynth.streets.world import POSES

    streets = Streets(0, sensor=None)  # type: ignore[arg-type]
    steps = [streets.indices(step, 4) for step in range(3 * POSES)]
    assert len({i for step in steps for i in step}) == 4 * 3 * POSES
    assert all(len({i // POSES for i in step}) == 4 for step in steps)


def test_a_sample_s_randomness_depends_on_seed_step_and_position_only():
    x_0 = Noise().x_0([0, 1, 2, 3])
    whole = draw(TINY, x_0, step=5, positions=[0, 1, 2, 3])
    part = draw(TINY, x_0[1::2], step=5, positions=[1, 3])
    for name in ("x_0", "t", "eps", "known"):
        torch.testing.assert_close(getattr(part, name), getattr(whole, name)[1::2], rtol=0, atol=0)
    assert (whole.generation, part.generation) == (2, 1)
    others = (draw(TINY, x_0, 6, [0, 1, 2, 3]), draw(with_fields(TINY, {"training.seed": 1}), x_0, 5, [0, 1, 2, 3]))
    for other in others:
        assert not torch.equal(other.eps, whole.eps)
    assert len({float(x[0, 0, 0]) for x in whole.eps}) == 4


def test_times_and_noise_have_the_right_distribution():
    experiment = with_fields(TINY, {"training.generation_share": 0.5, "training.batch_size": 2})
    x_0 = torch.zeros(2, 2, 4, 8)
    batches = [draw(experiment, x_0, step, [0, 1]) for step in range(800)]
    t = torch.stack([b.t for b in batches])
    assert float(t[:, 0].mean()) == pytest.approx(0.5, abs=0.04)
    assert float(t[:, 0].std()) == pytest.approx(1 / math.sqrt(12), abs=0.02)
    assert float((t[:, 1] == 1).float().mean()) == pytest.approx(0.5, abs=0.06)  # where completion begins
    eps = torch.stack([b.eps for b in batches])
    assert float(eps.mean()) == pytest.approx(0, abs=0.01) and float(eps.std()) == pytest.approx(1, abs=0.01)


def test_augmentation_turns_and_mirrors_whole_columns():
    x_0 = torch.arange(2 * 3 * 8.0).view(2, 3, 8)
    rng = torch.Generator().manual_seed(0)
    turns = range(8)
    seen = set()
    for _ in range(200):
        result = augment(x_0, rng, roll=True, mirror=True)
        matches = {(s, f) for s in turns for f in (False, True) if torch.equal(_turned(x_0, s, f), result)}
        assert len(matches) == 1
        seen |= matches
    assert len(seen) == 16
    torch.testing.assert_close(augment(x_0, rng, roll=False, mirror=False), x_0)


def _turned(x: Tensor, shift: int, flip: bool) -> Tensor:
    x = torch.roll(x, shift, dims=-1)
    return x.flip(-1) if flip else x


def test_a_scaled_scan_is_that_of_a_larger_or_smaller_world():
    experiment, image = (
        with_fields(TINY, {"data.scale": 0.2}),
        from_x_0(Noise().x_0([0])[0], SENSORS["hdl-64e-kitti"].resized(16, 64)),
    )
    x_0 = to_x_0(image)
    factors = []
    for seed in range(20):
        found = from_x_0(scaled(experiment, x_0, torch.Generator().manual_seed(seed)), image.sensor)
        both = image.mask & found.mask
        ratio = found.range[both] / image.range[both]
        factors.append(float(np.median(ratio)))
        np.testing.assert_allclose(ratio, factors[-1], rtol=1e-4)
        np.testing.assert_allclose(found.reflectance[both], image.reflectance[both], atol=1e-6)
        assert not (found.mask & ~image.mask).any()
        left = image.range[image.mask & ~found.mask] * factors[-1]
        assert ((left <= image.sensor.min_range * 1.001) | (left >= image.sensor.max_range * 0.999)).all()
    assert 0.8 <= min(factors) < 0.9 and 1.1 < max(factors) <= 1.2


def test_a_share_of_the_completion_samples_gets_a_sector_of_another_image():
    experiment = with_fields(TINY, {"data.mix": 0.5, "training.batch_size": 4, "training.generation_share": 0.5})
    images = Noise(2)
    one, other = images.x_0([0, 1])
    shares = []
    for step in range(50):
        found = draw_images(experiment, images, [0] * 4, step, [0, 1, 2, 3])
        again = draw_images(experiment, images, [0] * 2, step, [2, 3])
        torch.testing.assert_close(found.x_0[2:], again.x_0, rtol=0, atol=0)
        for x_0 in found.x_0:
            columns = (x_0 == other).all(dim=(0, 1))
            assert ((x_0 == one).all(dim=(0, 1)) | columns).all()
            assert int((columns != columns.roll(1)).sum()) in (0, 2), "one sector"
            shares.append(float(columns.float().mean()))
    drawn = torch.tensor(shares).view(50, 4)
    assert not drawn[:, :2].any(), "generation learns whole scans"
    mixed = drawn[:, 2:][drawn[:, 2:] > 0]
    assert 10 < len(mixed) < 40  # half of them, and half of these meet themselves
    assert mixed.max() <= 0.5 and 0.15 < mixed.mean() < 0.35


def test_a_share_of_a_sample_is_one_of_several_steps():
    experiment = with_fields(TINY, {"training.generation_share": 0.1, "training.batch_size": 2})
    x_0 = Noise().x_0([0, 1])
    counts = [draw(experiment, x_0, step, [0, 1]).generation for step in range(50)]
    assert sum(counts) == 10 and set(counts) == {0, 1}


def test_random_patterns_leave_something_known_and_something_to_do():
    x_0 = Noise().x_0([0])[0]
    x_0[:, :, :5] = -1  # nothing measured
    rng = torch.Generator().manual_seed(0)
    known = torch.stack([random_known(x_0, rng) for _ in range(300)]).float()
    share = known.flatten(1).mean(1)
    assert 0.2 < float(share.mean()) < 0.6 and bool((share < 1).all())
    assert float((known[:, 1].flatten(1).sum(1) == 0).float().mean()) == pytest.approx(0.1, abs=0.06)
    hidden = (known[..., :5].flatten(1).sum(1) == 0).float().mean()
    assert 0.4 < float(hidden) < 0.7  # half of the samples hide drop-outs


def test_a_share_of_the_completion_samples_knows_every_fourth_beam_and_begins_at_noise():
    x_0 = Noise().x_0([0, 1, 2, 3])

    def upsampled(share: float) -> list[bool]:
        experiment = with_fields(TINY, {"training.upsampling_share": share})
        found = []
        for step in range(100):
            batch = draw(experiment, x_0, step, [0, 1, 2, 3])
            assert not batch.known[:2].any()  # generation stays what it is
            for t, known in zip(batch.t[2:], batch.known[2:], strict=True):
                rows = (torch.arange(known.shape[1]) % 4 == 0)[:, None].expand_as(known)
                found.append(bool(t == 1) and torch.equal(known, rows))
        return found

    assert all(upsampled(1.0))
    assert 0.5 < sum(upsampled(0.6)) / 200 < 0.75
    assert sum(upsampled(0.0)) / 200 < 0.15  # by chance


def test_loss_is_the_mean_over_generation_and_completion():
    objective = Objective(TINY, network())
    batch = draw(TINY, Noise().x_0([0, 1, 2, 3]), 0, [0, 1, 2, 3])
    losses = objective(batch)
    denoiser = build_denoiser(TINY, objective.network)
    generation = denoiser.loss(batch.x_0[:2], batch.t[:2], batch.eps[:2], loss="l2", gamma=5.0)
    known = batch.known[2:].float()
    x_0 = batch.x_0[2:]
    given = replace(denoiser, clip=False).given(x_0, known)
    code = given.loss(x_0, batch.t[2:], batch.eps[2:], mask=1 - known, loss="l1", gamma=None)
    _, alpha, sigma = denoiser.schedule.at(batch.t[2:], x_0)
    x_0_hat = given(alpha * x_0 + sigma * batch.eps[2:], batch.t[2:]).clamp(-1, 1)
    metres = (81 ** ((x_0_hat[:, 0] + 1) / 2) - 81 ** ((x_0[:, 0] + 1) / 2)).abs() / 10  # log code up to 80 m
    hidden = 1 - known
    completion = code + (metres * hidden[:, 0]).sum((1, 2)) / hidden.sum((1, 2, 3))
    torch.testing.assert_close(losses, {"generation": generation, "completion": completion})


def test_nothing_decays_the_weights_unless_it_is_said():
    run = start(TINY, network(), task_of(TINY))
    assert [group["weight_decay"] for group in run.optimizers["network"].param_groups] == [0.0]


def test_a_network_that_cannot_be_told_the_known_pixels_is_not_taught_completion():
    experiment = with_fields(TINY, {"model.network": "efficient-unet"})
    with pytest.raises(ValueError, match=r"generation_share: expected 1 for efficient-unet, .* found 0.5"):
        Objective(experiment, network(experiment))


def test_r2dm_s_mean_weight_is_that_of_the_global_batch():
    experiment = with_fields(preset("r2dm-h"), {"model.base_channels": 8, "model.attn_num_heads": 2, "data.width": 64,
                                                "data.height": 16, "training.batch_size": 4})  # fmt: skip
    objective = Objective(experiment, network(experiment))
    x_0 = Noise().x_0([0, 1, 2, 3])
    whole = objective(draw(experiment, x_0, 0, [0, 1, 2, 3]))["generation"]
    halves = [objective(draw(experiment, x_0[i::2], 0, [i, i + 2]))["generation"] for i in (0, 1)]
    torch.testing.assert_close(torch.stack(halves, dim=1).flatten(), whole)
    # what R2DM's program reports on one device: mean(loss) * mean(weight)
    batch, denoiser = draw(experiment, x_0, 0, [0, 1, 2, 3]), objective.denoiser
    weight = min_snr_weight(denoiser.kind, *denoiser.schedule.at(batch.t, batch.t), gamma=5.0)
    reference = denoiser.loss(batch.x_0, batch.t, batch.eps, gamma=None).mean() * weight.mean()
    torch.testing.assert_close(whole.mean(), reference)


def curve(passes: int = 1, workers: int = 0, steps: int = 2, **changes) -> list[float]:
    experiment = with_fields(TINY, {"training.steps": steps, "diffusion.mean_weight": True, **changes})
    run = start(experiment, network(experiment), task_of(experiment))
    options = Options(accumulate=passes, workers=workers)
    return [p.losses["loss"] for p in train(experiment, run, Noise(), options)]  # type: ignore[arg-type]


def test_accumulated_passes_give_the_curve_of_one():
    torch.testing.assert_close(curve(passes=4), curve(passes=1), rtol=1e-4, atol=0)


def test_workers_do_not_change_a_bit():
    assert curve(workers=2) == curve(workers=0)


def test_dropout_is_reproducible_and_leaves_global_randomness_alone():
    changes = {"model.dropout": 0.3}
    first = curve(**changes)
    torch.manual_seed(99)
    expected = torch.get_rng_state()
    experiment = with_fields(TINY, {"training.steps": 1, **changes})
    run = start(experiment, network(experiment), task_of(experiment))
    torch.set_rng_state(expected)
    list(train(experiment, run, Noise()))  # type: ignore[arg-type]
    assert torch.equal(torch.get_rng_state(), expected)
    assert curve(**changes) == first != curve()


def test_precisions_that_would_not_hold_are_refused(monkeypatch: pytest.MonkeyPatch):
    from accelerate.state import AcceleratorState

    monkeypatch.setenv("ACCELERATE_USE_CPU", "true")
    AcceleratorState._reset_state()
    with pytest.raises(ValueError, match="expected the precision bf16 or fp32 for training on a processor, found fp16"):
        accelerator_of(Options(precision="fp16"))
    assert accelerator_of(Options(precision="bf16")).mixed_precision == "bf16"
    for precision in (None, "fp32"):  # accelerate would go on in bfloat16 where nothing is asked for
        with pytest.raises(ValueError, match="expected the precision of this process's earlier run, found fp32"):
            accelerator_of(Options(precision=precision))
    AcceleratorState._reset_state()
    assert accelerator_of(Options()).mixed_precision == "no"


def test_batches_must_share_equally():
    with pytest.raises(ValueError, match="that 3 processes x passes share equally, found 4"):
        Examples(TINY, Noise(), 3, draw_images)  # type: ignore[arg-type]


def test_a_loss_that_is_not_finite_stops_with_step_and_scans():
    experiment = with_fields(TINY, {"training.steps": 10})
    images = Noise(20, broken=batch_indices(experiment.training, 2, Noise(20))[1])  # type: ignore[arg-type]
    run = start(experiment, network(), task_of(experiment))
    steps = train(experiment, run, images)  # type: ignore[arg-type]
    assert [next(steps).step, next(steps).step] == [1, 2]
    with pytest.raises(FloatingPointError, match=rf"step 3: expected a finite loss .* noise/{images.broken}\b"):
        next(steps)
    assert all(bool(p.isfinite().all()) for p in run.network.parameters()), "the bad step must not reach the weights"


def test_training_lowers_the_loss_on_fixed_noise():
    changes = {"training.steps": 30, "training.learning_rate": 6e-3, "data.roll": False, "data.mirror": False}
    experiment, images = with_fields(TINY, changes), Noise(1)
    run = start(experiment, network(experiment), task_of(experiment))
    before = fixed_losses(experiment, run.network.eval(), images.x_0([0]))
    list(train(experiment, run, images))  # type: ignore[arg-type]
    after = fixed_losses(experiment, run.network.eval(), images.x_0([0]))
    assert set(after) == {*(f"t_{time}" for time in TIMES), "completion"}
    # min-SNR weighting looks at low noise first
    assert after["t_0.1"] < 0.75 * before["t_0.1"] and after["t_0.3"] < 0.9 * before["t_0.3"]
    assert fixed_losses(experiment, run.network, images.x_0([0])) == after, "the noise is fixed"


def test_batches_travel_through_the_loader_in_order():
    experiment = replace(TINY, training=replace(TINY.training, steps=3))
    batches = list(load_batches(Examples(experiment, Noise(), 2, draw_images), 1, range(2)))  # type: ignore[arg-type]
    assert len(batches) == 4 and all(isinstance(b, DiffusionBatch) and len(b.x_0) == 2 for b in batches)


def test_steps_are_counted_as_they_come():
    experiment = with_fields(TINY, {"training.steps": 10**15})
    batches = load_batches(Examples(experiment, Noise(), 1, draw_images), 7, range(1))  # type: ignore[arg-type]
    assert tuple(next(batches).seeds) == draw(TINY, Noise().x_0([0, 1, 2, 3]), 7, [0, 1, 2, 3]).seeds
    batches.close()
