"""How LiDAR-SR, ILN and LIIF learn: what a step sees, that the loss falls, and that a run continues bit by bit."""

import io
import math

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from lidarsynth.data.dataset import write_cache
from lidarsynth.data.frames import Name
from lidarsynth.experiment.presets import PRESETS, preset
from lidarsynth.experiment.record import Experiment, Training, with_fields
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.metrics.reconstruction import reconstruction_errors
from lidarsynth.systems.interpolation.model import interpolated
from lidarsynth.systems.table import build_network, task_of, transfer
from lidarsynth.systems.table import load_folder as load
from lidarsynth.systems.upsampling.model import places
from lidarsynth.systems.upsampling.training import PairBatch, QueryBatch, draw_pairs, draw_queries
from lidarsynth.training.loop import Run, learning_rate, start, train
from lidarsynth.training.options import Options
from lidarsynth.verbs.training import run as run_in

LIIF = {"model.network": "liif"}
KINDS = {"lidar-sr": ("lidar-sr-tiny", {}), "iln": ("iln-tiny", {}), "liif": ("iln-tiny", LIIF)}
SENSOR = build_sensor(preset("iln-tiny"))


def scan(i: int) -> RangeImage:
    """Smooth walls 5 to 40 m around, a twentieth of the pixels empty."""
    rng, columns = np.random.default_rng(i), np.arange(64) / 64 * 2 * np.pi
    wave = np.sin(columns + rng.uniform(0, 6)) + 0.3 * np.sin(3 * columns + rng.uniform(0, 6))
    distance = (20 + 8 * wave + 0.4 * np.arange(16)[:, None]).astype(np.float32)
    mask = rng.random(distance.shape) < 0.95
    return RangeImage(distance * mask, np.zeros_like(distance), mask, SENSOR)


class Walls:
    """Images of a seed, without a cache."""

    def __init__(self, length: int = 8):
        self.length = length
        self.source = {"name": "walls"}

    def __len__(self) -> int:
        return self.length

    def name(self, i: int) -> Name:
        return Name("walls", "", str(i))

    def take(self, indices: list[int]) -> list[RangeImage]:
        return [scan(i) for i in indices]


def tiny(kind: str, **changes) -> Experiment:
    word, fields = KINDS[kind]
    return with_fields(preset(word), {**fields, **changes})


def fresh(experiment: Experiment) -> Run:
    torch.manual_seed(0)
    return start(experiment, build_network(experiment), task_of(experiment))


# ---------------------------------------------------------------- what a step sees


def test_a_pair_is_every_fourth_row_and_all_rows_from_the_lowest_up():
    low, high = draw_pairs(tiny("lidar-sr"), Walls(), [3], 0, [0])
    assert low.shape == (1, 1, 4, 64) and high.shape == (1, 1, 16, 64)
    upright = high[0, 0].flip(0)
    torch.testing.assert_close(low[0, 0].flip(0), upright[::4], rtol=0, atol=0)
    image = scan(3)
    expected = np.where(image.mask, image.range / 100, 1)  # no return is as far as it goes
    np.testing.assert_allclose(upright.numpy(), expected, rtol=1e-6)
    keras = draw_pairs(tiny("lidar-sr", **{"upsampling.keras": True, "upsampling.first": 3}), Walls(), [3], 0, [0])
    np.testing.assert_allclose(keras.high[0, 0].flip(0).numpy(), image.range / 100, rtol=1e-6)
    torch.testing.assert_close(keras.low[0, 0], keras.high[0, 0, ::4], rtol=0, atol=0)  # the lowest of each four


def test_noise_is_of_metres_on_returns_alone_and_the_same_in_both():
    noisy = draw_pairs(tiny("lidar-sr", **{"upsampling.noise": 0.5}), Walls(), [0, 1], 0, [0, 1])
    clean = draw_pairs(tiny("lidar-sr"), Walls(), [0, 1], 0, [0, 1])
    moved = 100 * (noisy.high - clean.high)
    assert bool((moved[clean.high == 1] == 0).all())
    assert float(moved[clean.high < 1].std()) == pytest.approx(0.5, rel=0.1)
    torch.testing.assert_close(noisy.low.flip(2), noisy.high.flip(2)[:, :, ::4], rtol=0, atol=0)


def test_queries_ask_for_the_pixels_they_are_compared_with():
    low, queries, ranges = draw_queries(tiny("iln", **{"upsampling.queries": 16 * 64}), Walls(), [2], 0, [0])
    assert queries.shape == (1, 1024, 2) and len({tuple(q) for q in queries[0].tolist()}) == 1024
    # a query at the centre of a known row's pixel is that pixel, four lie on each of four rows and 64 columns
    on_row = (((queries[0, :, 0] + 1) * 4 / 2) % 1 - 0.5).abs() < 1e-5
    assert int(on_row.sum()) == 4 * 64
    there = F.grid_sample(low, queries[:, on_row][:, None].flip(-1), mode="nearest", align_corners=False)
    torch.testing.assert_close(there[0, 0, 0], ranges[0, on_row], rtol=0, atol=0)
    image = scan(2)
    expected = np.sort(np.where(image.mask, image.range / 50 - 1, 1).ravel())
    np.testing.assert_allclose(np.sort(ranges[0].numpy()), expected, atol=1e-6)


def test_rows_between_known_ones_are_asked_for_at_their_elevation():
    queries = draw_queries(tiny("iln", **{"upsampling.queries": 16 * 64}), Walls(), [2], 0, [0]).queries
    found = np.unique(queries[0, :, 0].numpy())[::-1]  # from the highest row
    assert len(found) == 16
    # the frame of the network goes up: place 0 is the lowest known row, 3 the highest
    place = ((found + 1) * 4 - 1) / 2
    elevation = np.asarray(SENSOR.elevations)
    np.testing.assert_allclose(np.interp(place[:13], np.arange(4), elevation[[12, 8, 4, 0]]), elevation[:13], atol=1e-4)
    assert (place[13:] < 0).all(), "rows below the last known one"


@pytest.mark.parametrize(("kind", "draw"), [("lidar-sr", draw_pairs), ("iln", draw_queries)])
def test_a_sample_depends_on_seed_step_and_position_only(kind, draw):
    experiment = tiny(kind, **{"upsampling.noise": 0.1, "data.roll": True, "data.mirror": True})
    whole = draw(experiment, Walls(), [0, 1, 2, 3], 5, [0, 1, 2, 3])
    part = draw(experiment, Walls(), [1, 3], 5, [1, 3])
    for name in whole._fields:
        torch.testing.assert_close(getattr(part, name), getattr(whole, name)[1::2], rtol=0, atol=0)
    for other in ((experiment, 6), (with_fields(experiment, {"training.seed": 1}), 5)):
        assert not torch.equal(draw(other[0], Walls(), [0], other[1], [0]).low, whole.low[:1])


def test_keras_program_knows_the_lowest_beam_and_every_fourth_from_there():
    """Row 0 of its images is the lowest beam, and rows 0, 4, 8, ... are its low image: of 64 beams 63, 59, ..., 3."""
    small = {"data.height": 16, "data.width": 64, "model.base_channels": 4}
    experiment = with_fields(preset("lidar-sr-keras"), small)
    low, high = draw_pairs(experiment, Walls(), [3], 0, [0])  # noise is drawn before rows are taken
    torch.testing.assert_close(low, high[:, :, ::4], rtol=0, atol=0)
    beams = SENSOR.elevations[experiment.upsampling.first :: experiment.upsampling.factor[0]]
    assert beams == SENSOR.elevations[::-1][::4][::-1] and beams[-1] == min(SENSOR.elevations)


def test_columns_are_thinned_too():
    experiment = tiny("lidar-sr", **{"upsampling.factor": (4, 2)})
    low, high = draw_pairs(experiment, Walls(), [3], 0, [0])
    torch.testing.assert_close(low.flip(2), high.flip(2)[:, :, ::4, ::2], rtol=0, atol=0)
    batch = draw_queries(tiny("iln", **{"upsampling.factor": (4, 2)}), Walls(), [3], 0, [0])
    assert batch.low.shape == (1, 1, 4, 32)


# ---------------------------------------------------------------- losses and rates


def test_losses_are_those_of_the_papers():
    for keras, scale in ((False, 2), (True, 1)):  # ILN's repository compares in [-1, 1], Keras in [0, 1]
        experiment = tiny("lidar-sr", **{"upsampling.keras": keras})
        run = fresh(experiment)
        batch = PairBatch(torch.rand(2, 1, 4, 64), torch.rand(2, 1, 16, 64))
        (phase,) = task_of(experiment).phases(experiment, run.network.eval())
        expected = scale * (run.network(batch.low) - batch.high).abs().mean((1, 2, 3))
        torch.testing.assert_close(phase.objective(batch), {"range": expected})
    experiment = tiny("iln")
    run = fresh(experiment)
    batch = QueryBatch(torch.rand(2, 1, 4, 64), torch.rand(2, 9, 2) * 2 - 1, torch.rand(2, 9))
    (phase,) = task_of(experiment).phases(experiment, run.network.eval())
    expected = (run.network(batch.low, batch.queries) - batch.ranges).abs().mean(1)
    torch.testing.assert_close(phase.objective(batch), {"range": expected})


def test_rates_are_those_of_the_papers():
    keras = preset("lidar-sr-keras").training
    for step in (0, 1, 1000, 99_999):
        assert learning_rate(keras, step) == pytest.approx(1e-4 / (1 + 1e-5 * step))
    for steps in (1000, 400_000):  # a decay per iteration, however many there are
        other = with_fields(preset("lidar-sr-keras"), {"training.steps": steps}).training
        assert all(learning_rate(other, step) == learning_rate(keras, step) for step in range(0, 1000, 37))
        assert learning_rate(other, steps - 1) == pytest.approx(1e-4 / (1 + 1e-5 * (steps - 1)))
    iln = Training(steps=1000, learning_rate=1e-4, warmup=0, decay="halving")  # a step for each epoch of the paper
    expected = [1e-4 * 0.5 ** sum(epoch >= m for m in (200, 400, 600, 800)) for epoch in range(1000)]
    assert [learning_rate(iln, epoch) for epoch in range(1000)] == pytest.approx(expected)
    assert {preset(word).training.decay for word in ("iln", "iln-0d", "iln-2d", "liif")} == {"halving"}
    assert learning_rate(preset("lidar-sr").training, 299_999) == 1e-4


@pytest.mark.parametrize("word", [w for w, make in PRESETS.items() if make().upsampling])
def test_presets_know_that_they_have_no_reflectance(word):
    experiment = preset(word)
    assert not experiment.data.reflectance and experiment.data.codec == "metric"
    assert experiment.training.betas == (0.9, 0.999) and experiment.training.clip_norm is None


# ---------------------------------------------------------------- the loop


@pytest.mark.parametrize("kind", KINDS)
def test_the_loss_falls(kind):
    experiment = tiny(kind, **{"training.steps": 20, "training.learning_rate": 4e-3})
    losses = [p.losses["range"] for p in train(experiment, fresh(experiment), Walls(4), Options(workers=0))]
    assert np.mean(losses[-4:]) < 0.7 * np.mean(losses[:4]), losses


@pytest.mark.parametrize("kind", KINDS)
def test_a_stopped_run_continues_bit_by_bit(kind):
    experiment = tiny(kind, **{"training.steps": 3})
    whole, broken = fresh(experiment), fresh(experiment)
    curve = [p.losses["loss"] for p in train(experiment, whole, Walls(), Options(workers=0))]
    steps = train(experiment, broken, Walls(), Options(workers=0))
    first = [next(steps).losses["loss"] for _ in range(2)]
    file = io.BytesIO()
    torch.save(broken.state_dict(), file)
    file.seek(0)
    torch.manual_seed(5)  # nothing may hang on the global generator
    resumed = start(experiment, build_network(experiment), task_of(experiment))
    resumed.load_state_dict(torch.load(file, weights_only=True))
    assert first + [p.losses["loss"] for p in train(experiment, resumed, Walls(), Options(workers=0))] == curve
    for key, value in whole.network.state_dict().items():
        assert torch.equal(resumed.network.state_dict()[key], value), key
        assert torch.equal(resumed.ema.state_dict()[key], value), f"{key}: the newest weights are the result"


def test_shared_batches_give_the_curve_of_one_where_nothing_is_normalised_or_dropped():
    def curve(kind: str, passes: int, **changes) -> list[float]:
        experiment = tiny(kind, **{"training.steps": 2, **changes})
        steps = train(experiment, fresh(experiment), Walls(), Options(workers=0, accumulate=passes))
        return [p.losses["loss"] for p in steps]

    for kind, changes in (("liif", {}), ("iln", {"upsampling.depth": 0})):
        assert curve(kind, 2, **changes) == pytest.approx(curve(kind, 1, **changes), rel=1e-5)
    assert curve("lidar-sr", 2) != pytest.approx(curve("lidar-sr", 1), rel=1e-5), "batch statistics are of a pass"


@pytest.mark.parametrize("kind", ["lidar-sr", "iln"])
def test_the_judge_compares_with_bilinear_interpolation_on_missing_rows(kind):
    experiment, images = tiny(kind), [scan(i) for i in range(3)]
    run, known = fresh(experiment), np.zeros((16, 64), bool)
    known[::4] = True
    found = task_of(experiment).judge(experiment, run.ema, images)
    assert set(found) == {"range_mae", "range_mae_bilinear"} and math.isfinite(found["range_mae"])
    expected = [reconstruction_errors(interpolated(i.keep(known), known, "bilinear"), i, ~known) for i in images]
    assert found["range_mae_bilinear"] == pytest.approx(np.mean([e.range_mae for e in expected]))
    assert task_of(experiment).judge(experiment, run.ema, images) == found
    pictures = task_of(experiment).pictures(experiment, run.ema, images)
    assert len(pictures) == 2 and all(p.dtype == np.uint8 and p.ndim == 3 for p in pictures)


def test_a_run_in_a_folder_learns_from_a_cache_and_starts_another(tmp_path):
    cache = tmp_path / "cache"
    list(write_cache(cache, lambda i, sensor=SENSOR: scan(i), 8, SENSOR, {"name": "walls"}))
    for word in ("lidar-sr-tiny", "iln-tiny"):
        experiment = with_fields(preset(word), {"training.steps": 2})
        list(run_in(experiment, cache, tmp_path / word, options=Options(workers=0, sample_every=2)))
        assert len(list((tmp_path / word / "pictures").glob("*.png"))) == 2
        kept, network = load(tmp_path / word)
        assert kept.upsampling == experiment.upsampling
        other = with_fields(experiment, {"data.sensor": "os1-64", "upsampling.first": 2})
        transfer(build := build_network(other), other, network, kept, word)
        assert all(torch.equal(v, network.state_dict()[k]) for k, v in build.state_dict().items())
        wide = with_fields(experiment, {"model.base_channels": 16})
        with pytest.raises(ValueError, match=r"expected .*\(16, 1, 3, 3\)|expected .*\(1, 16, 3, 3\)"):
            transfer(build_network(wide), wide, network, kept, word)
    ours, theirs = tiny("lidar-sr"), tiny("iln")
    with pytest.raises(ValueError, match=r"expected weights of lidar-sr, \(4, 1\), False, .*, found iln"):
        transfer(build_network(ours), ours, build_network(theirs), theirs, "iln")


@pytest.mark.parametrize(
    ("word", "factor", "said"),
    [
        ("iln-tiny", (16, 1), "two known beams at least, and others between them, found 1 known of 16"),
        ("lidar-sr-tiny", (16, 1), "two known beams at least, and others between them, found 1 known of 16"),
        ("iln-tiny", (1, 2), "two known beams at least, and others between them, found 16 known of 16"),
        ("iln-tiny", (4, 3), "a divisor of 64 columns, found 3"),
    ],
)
def test_what_leaves_nothing_to_put_between_is_refused_before_anything_is_written(tmp_path, word, factor, said):
    """With columns that do not divide the turn, the last gap was narrower, and queries were off by part of a column."""
    list(write_cache(tmp_path / "cache", scan, 2, SENSOR, {"name": "walls"}))
    experiment = with_fields(preset(word), {"upsampling.factor": factor, "training.steps": 1})
    with pytest.raises(ValueError, match=f"^upsampling.factor: expected {said}$"):
        list(run_in(experiment, tmp_path / "cache", tmp_path / "run", options=Options(workers=0, sample_every=0)))
    assert not (tmp_path / "run").exists()


def test_one_known_beam_is_too_few_to_learn_what_lies_between():
    with pytest.raises(ValueError, match="expected two known beams at least to put others between, found 1"):
        places([3.0], [3.0])
