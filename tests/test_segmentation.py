"""Training RangeNet on labelled range images: what a sample is, its loss, the judge, exact continuation."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from lidarsynth.cli.main import main
from lidarsynth.data.cache import write_cache
from lidarsynth.data.dataset import CachedImages, SeveralCaches
from lidarsynth.experiment.folder import save
from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import Experiment, from_dict, with_fields
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.systems.segmentation.adaptation import adapted
from lidarsynth.systems.segmentation.training import (
    CrossEntropy,
    SegmentationBatch,
    augment,
    class_shares,
    class_weights,
    classify,
    confusion,
    draw,
    judge,
    pictures,
    pixels,
)
from lidarsynth.systems.table import assemble, build_network, task_of, transfer
from lidarsynth.systems.table import load_folder as load
from lidarsynth.training.loop import start, train
from lidarsynth.training.options import Options
from lidarsynth.training.randomness import sample_rng
from lidarsynth.verbs.training import run

SENSOR = SENSORS["hdl-64e-kitti"].resized(16, 64)
CLASSES_THERE = (1, 9, 13, 15)


def scene(i: int) -> RangeImage:
    """Blocks of 8 columns, each of one class at its own distance and brightness; a tenth of the pixels empty."""
    rng, shape = np.random.default_rng(i), (SENSOR.height, SENSOR.width)
    kind = np.repeat(rng.integers(0, 4, 8), 8)[None] * np.ones((16, 1), int)
    mask = rng.random(shape) < 0.9
    distance = (np.array([5.0, 10.0, 20.0, 40.0])[kind] * rng.uniform(0.95, 1.05, shape) * mask).astype(np.float32)
    reflectance = (np.array([0.1, 0.3, 0.5, 0.9])[kind] * mask).astype(np.float32)
    return RangeImage(distance, reflectance, mask, SENSOR, np.where(mask, np.array(CLASSES_THERE)[kind], 0))


def small(steps: int = 30, **changes) -> Experiment:
    sizes = {
        "data.height": 16,
        "data.width": 64,
        "model.base_channels": 2,
        "segmentation.columns": 32,
        "training.steps": steps,
        "training.warmup": 2,
        "training.ema_start": 0,
        "training.ema_decay": 0.8,
        "training.ema_every": 1,
    }
    return with_fields(preset("rangenet-street"), {**sizes, **changes})


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("segmentation") / "cache"
    list(write_cache(folder, scene, 24, SENSOR, {"name": "blocks"}))
    return folder


def network(experiment: Experiment, seed: int = 0) -> RangeNet:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        built = build_network(experiment)
    assert isinstance(built, RangeNet)
    return built


@pytest.mark.parametrize(
    ("name", "count"), [("rangenet-53", 50_377_364), ("rangenet-21", 24_712_980), ("rangenet-street", 1_549_908)]
)
def test_presets_have_the_published_sizes_and_survive_a_file(name: str, count: int):
    experiment = preset(name)
    with torch.device("meta"):
        assert sum(p.numel() for p in build_network(experiment).parameters()) == count
    assert from_dict(experiment.to_dict()) == experiment
    assert task_of(experiment).parts == ("cross_entropy",)


def test_a_sample_is_a_turned_and_mirrored_scan_whose_points_lie_on_its_rays():
    experiment, image = small(**{"segmentation.columns": 64, "segmentation.drop": 0.0}), scene(0)
    wide = range(SENSOR.width)
    seen = set()
    for step in range(60):
        values, label = augment(experiment, image, sample_rng(0, step, 0))
        turns = [(s, f) for s in wide for f in (1, -1) if np.array_equal(_turned(image.range, s, f), values[0])]
        assert len(turns) == 1
        seen |= set(turns)
        np.testing.assert_array_equal(label, _turned(image.label, *turns[0]))
        np.testing.assert_array_equal(values[4], _turned(image.reflectance, *turns[0]))
        np.testing.assert_allclose(values[1:4], np.moveaxis(SENSOR.points(values[0]), -1, 0), atol=1e-5)
    assert len(seen) > 30 and {flip for _, flip in seen} == {1, -1}
    still = with_fields(experiment, {"data.roll": False, "data.mirror": False})
    np.testing.assert_array_equal(augment(still, image, sample_rng(0, 0, 0))[0][0], image.range)


def _turned(values, shift: int, flip: int) -> np.ndarray:
    return np.roll(values, shift, axis=1)[:, ::flip]


def test_dropped_points_are_empty_and_have_no_class():
    experiment, image = small(**{"segmentation.columns": 64, "segmentation.drop": 0.5}), scene(1)
    shares = []
    for step in range(40):
        values, label = augment(experiment, image, sample_rng(0, step, 0))
        assert ((label > 0) == (values[0] > 0)).all() and not values[:, values[0] == 0].any()
        shares.append(1 - (values[0] > 0).sum() / image.mask.sum())
    assert max(shares) == pytest.approx(0.5, abs=0.08) and min(shares) < 0.1


def test_a_cut_is_part_of_the_scan_anywhere():
    experiment = small(**{"data.roll": False, "data.mirror": False, "segmentation.drop": 0.0})
    metres = np.tile(np.arange(1, 65, dtype=np.float32), (16, 1))
    image = replace(scene(2), label=np.full((16, 64), 9), mask=np.ones((16, 64), bool), range=metres)
    firsts = set()
    for step in range(200):
        columns = augment(experiment, image, sample_rng(0, step, 0))[0][0, 0]
        np.testing.assert_array_equal(columns, np.arange(columns[0], columns[0] + 32))
        firsts.add(int(columns[0]))
    assert {1, 33} <= firsts <= set(range(1, 34))
    for columns in (33, 96):
        with pytest.raises(ValueError, match=f"multiple of 32 up to 64, found {columns}"):
            augment(with_fields(experiment, {"segmentation.columns": columns}), image, sample_rng(0, 0, 0))


def test_a_sample_depends_on_seed_step_and_position_only(cache: Path):
    images = CachedImages(cache)
    whole = draw(small(), images, [4, 5, 6, 7], 3, [0, 1, 2, 3])
    part = draw(small(), images, [5, 7], 3, [1, 3])
    assert torch.equal(part.image, whole.image[1::2]) and torch.equal(part.label, whole.label[1::2])
    assert torch.equal(part.weights, whole.weights)
    assert not torch.equal(draw(small(), images, [4, 5, 6, 7], 4, [0, 1, 2, 3]).image, whole.image)


def test_rare_classes_weigh_more_and_the_mean_pixel_weighs_one(cache: Path):
    shares = class_shares(CachedImages(cache))
    assert shares.sum() == pytest.approx(1) and set(np.flatnonzero(shares)) == set(CLASSES_THERE)
    labels = np.concatenate([scene(i).label[scene(i).mask] for i in range(24)])
    np.testing.assert_allclose(shares, np.bincount(labels, minlength=20) / len(labels))
    np.testing.assert_array_equal(class_shares(SeveralCaches([cache, cache])), shares)
    weights = class_weights(np.array([0, 0.9, 0.1, 0.0])).double()
    assert float(weights @ torch.tensor([0, 0.9, 0.1, 0.0]).double()) == pytest.approx(1)
    assert float(weights[2] / weights[1]) == pytest.approx(np.log(1.92) / np.log(1.12))
    assert float(weights[3] / weights[2]) == pytest.approx(np.log(1.12) / np.log(1.02))


def test_the_loss_is_the_weighted_cross_entropy_of_labelled_pixels():
    net = network(small()).eval()
    values = torch.from_numpy(np.stack([augment(small(), scene(i), sample_rng(0, 0, i))[0] for i in range(2)]))
    label = torch.zeros(2, 16, 32, dtype=torch.int64)
    label[0, 3, 4], label[0, 5, 6] = 1, 13
    weights = torch.linspace(1, 3, 20)
    losses = CrossEntropy(net)(SegmentationBatch(values, label, weights))["cross_entropy"]
    log = net(net.network_input(values, values[:, :1] > 0)).log_softmax(1)
    expected = -(weights[1] * log[0, 1, 3, 4] + weights[13] * log[0, 13, 5, 6]) / 2
    torch.testing.assert_close(losses, torch.stack([expected, torch.zeros(())]))


def test_the_judge_counts_labelled_pixels_of_the_classes_that_occur():
    net = network(small())
    truth = [classify(net, scene(i)) for i in range(3)]
    assert all((image.label[~image.mask] == 0).all() for image in truth)
    assert confusion(net, truth)[1:, 1:].sum() == sum(int(image.mask.sum()) for image in truth)
    assert judge(small(), net, truth) == {"miou": 1.0, "accuracy": 1.0}
    half = [replace(i, label=np.where(i.range > 15, i.label, 0)) for i in truth]
    assert judge(small(), net, half) == {"miou": 1.0, "accuracy": 1.0}, "pixels without a class do not count"
    wrong = [replace(i, label=np.where(i.mask, i.label % 19 + 1, 0)) for i in truth]
    assert judge(small(), net, wrong) == {"miou": 0.0, "accuracy": 0.0}
    shown = pictures(small(), net, [scene(0), scene(1), scene(2)])
    assert len(shown) == 2 and all(p.dtype == np.uint8 and p.ndim == 3 for p in shown)


def test_images_without_labels_are_refused(tmp_path: Path):
    bare = replace(scene(0), label=None)
    with pytest.raises(ValueError, match="expected images with labels"):
        augment(small(), bare, sample_rng(0, 0, 0))
    nowhere = np.zeros((16, 64), int)
    for name, label, message in (("bare", None, "with labels"), ("zero", nowhere, "labelled pixels, found none")):
        list(write_cache(tmp_path / name, lambda i: replace(scene(i), label=label), 3, SENSOR, {"name": name}))  # noqa: B023
        with pytest.raises(ValueError, match=message):
            class_shares(CachedImages(tmp_path / name))


def trained(experiment: Experiment, cache: Path, stop: int | None = None, state: dict | None = None):
    run = start(experiment, network(experiment), task_of(experiment))
    if state:
        run.load_state_dict(state)
    losses = []
    for progress in train(experiment, run, CachedImages(cache), Options(workers=0)):  # type: ignore[arg-type]
        losses.append(progress.losses["loss"])
        if progress.step == stop:
            break
    return run, losses


def test_the_loss_falls(cache: Path):
    _, losses = trained(small(25, **{"model.base_channels": 4, "training.learning_rate": 0.01}), cache)
    assert np.mean(losses[-5:]) < 0.6 * np.mean(losses[:5])


def test_a_resumed_run_is_bit_identical_with_its_batch_statistics(cache: Path):
    experiment = small(4, **{"model.dropout": 0.1})
    whole, losses = trained(experiment, cache)
    half, first = trained(experiment, cache, stop=2)
    resumed, second = trained(experiment, cache, state=half.state_dict())
    assert first + second == losses
    for ours, theirs in ((resumed.network, whole.network), (resumed.ema, whole.ema)):
        expected = theirs.state_dict()
        assert any("running_var" in name for name in expected)
        assert all(torch.equal(value, expected[name]) for name, value in ours.state_dict().items())
    fresh = network(experiment).state_dict()
    means = [name for name in fresh if "running_mean" in name]
    assert not any(torch.equal(fresh[name], whole.ema.state_dict()[name]) for name in means)


def test_weights_continue_and_others_are_refused(tmp_path: Path):
    source, target = network(small(), 1), network(small(), 2)
    with torch.no_grad():
        source.backbone.bn1.running_mean += 1
    transfer(target, small(), source, small(), "weights")
    expected: dict[str, Tensor] = source.state_dict()
    assert all(torch.equal(value, expected[name]) for name, value in target.state_dict().items())
    wide = small(**{"model.base_channels": 4})
    with pytest.raises(ValueError, match=r"weights: expected backbone.conv1.weight \(4, 5, 3, 3\), found \(2, 5"):
        transfer(network(wide), wide, source, small(), "weights")
    other = nn.Linear(2, 2)
    with pytest.raises(ValueError, match="weights: expected weights of rangenet of log range, found conditional-unet"):
        transfer(target, small(), other, preset("tiny"), "weights")


def test_a_file_keeps_the_network_and_a_model_of_scans_it_is_not(tmp_path: Path):
    net = network(small(), 3)
    save(tmp_path, small(), net, half=True)
    experiment, again = load(tmp_path)
    assert isinstance(again, RangeNet) and again.width == 2
    torch.testing.assert_close(again.state_dict(), net.state_dict(), rtol=1e-3, atol=1e-3)
    with pytest.raises(ValueError, match=r"^rangenet-street: expected a network of .* found rangenet$"):
        assemble(experiment, again)


@pytest.mark.timeout(120)
def test_the_command_line_trains_and_describes_it(cache: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    changes = ["model.base_channels=2", "segmentation.columns=32", "training.steps=3", "training.warmup=1"]
    options = ["--threads", "1", "--sample-every", "2", "--workers", "0", "--validation", str(cache)]
    main(["train", "rangenet-street", "--data", str(cache), "--out", str(tmp_path), "--set", *changes, *options])
    assert (tmp_path / "losses.csv").read_text().startswith("step,loss,cross_entropy,")
    assert len(list((tmp_path / "pictures").glob("*.png"))) == 4
    capsys.readouterr()
    main(["info", str(tmp_path)])
    text = capsys.readouterr().out
    assert "RangeNet-21" in text and "98,220" in text and "schedule" not in text


def test_a_turn_of_any_number_of_columns_is_judged():
    """As a Pandar64's of 1,800: cuts of 32 columns are learned from, and the whole is seen on into the next turn."""
    image, net = scene(0), network(small(), 3).eval()
    order = np.arange(80) % 64
    parts = (part[:, order] for part in (image.range, image.reflectance, image.mask))
    wide = RangeImage(*parts, SENSORS["hdl-64e-kitti"].resized(16, 80), image.label[:, order])
    assert classify(net, wide).label.shape == (16, 80)
    assert 0 <= judge(small(), net, [wide])["accuracy"] <= 1
    values = torch.from_numpy(pixels(image))[None]
    expected = net(net.network_input(values, values[:, :1] > 0))[0, 1:].argmax(0).numpy() + 1
    np.testing.assert_array_equal(classify(net, image).label, np.where(image.mask, expected, 0))


def test_what_cannot_be_learned_from_or_judged_is_refused_before_anything_is_written(cache: Path, tmp_path: Path):
    """A cache without labels, as of scans that nobody has labelled, and cuts wider than the images."""
    bare = tmp_path / "bare"
    list(write_cache(bare, lambda i: replace(scene(i), label=None), 4, SENSOR, {"name": "bare"}))
    for data, validation, columns, said in (
        (bare, None, 32, "^expected images with labels, .*, found one without$"),
        (cache, bare, 32, f"^{bare}: expected images with labels, .*, found one without$"),
        (cache, None, 96, "^segmentation.columns: expected a multiple of 32 up to 64, found 96$"),
    ):
        experiment = small(2, **{"segmentation.columns": columns})
        with pytest.raises(ValueError, match=said):
            list(run(experiment, data, tmp_path / "run", validation=validation, options=Options(workers=0)))
        assert not (tmp_path / "run").exists()


def test_an_adapted_network_has_the_statistics_of_the_images():
    """The first normalisation holds the mean and the variance of what reaches it; weights and the original stay."""
    network, images = RangeNet(21, 2).eval(), [scene(i) for i in range(4)]
    before = {name: value.clone() for name, value in network.state_dict().items()}
    values = torch.from_numpy(np.stack([pixels(image) for image in images]))
    x = network.network_input(values, values[:, :1] > 0)
    new = adapted(network, [x[:2], x[2:]])
    with torch.no_grad():
        reached = new.backbone.conv1(x).unflatten(0, (2, 2))
    torch.testing.assert_close(new.backbone.bn1.running_mean, reached.mean((0, 1, 3, 4)))
    torch.testing.assert_close(new.backbone.bn1.running_var, reached.var((1, 3, 4)).mean(0))
    assert new.backbone.bn1.momentum == 0.01
    torch.testing.assert_close(network.state_dict(), before)
    torch.testing.assert_close(new.head.state_dict(), network.head.state_dict())
    with pytest.raises(ValueError, match="found none"):
        adapted(network, [])
