"""LiDARGen as a model: its records, official files, score matching, Langevin sampling and posterior completion."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from forked import pair
from networks import trained
from oracle import assert_close, assert_within
from torch import Tensor, nn

import lidarsynth
from lidarsynth.cli.main import main
from lidarsynth.data.dataset import write_cache
from lidarsynth.diffusion import langevin
from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.repaint import repaint
from lidarsynth.diffusion.samplers import STEPS, even_log_snr, generators, starting_noise
from lidarsynth.diffusion.schedule import ve
from lidarsynth.experiment.folder import save
from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import Score, from_dict, with_fields
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.files.formats import write
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.lidar.depth import decode, encode, from_x_0, to_x_0
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import SENSORS, get_sensor
from lidarsynth.networks.refinenet import geometric_sigmas
from lidarsynth.systems.diffusion import score_matching as matching
from lidarsynth.systems.diffusion.build import build_denoiser
from lidarsynth.systems.diffusion.model import LidarModel
from lidarsynth.systems.diffusion.score_matching import SCORE, ScoreMatching
from lidarsynth.systems.diffusion.validation import TIMES, fixed_losses
from lidarsynth.systems.table import assemble, build_network, task_of
from lidarsynth.systems.table import load_folder as load
from lidarsynth.training.checkpoint import checkpoints
from lidarsynth.training.loop import start, train
from lidarsynth.training.options import Options
from lidarsynth.verbs.description import describe
from lidarsynth.verbs.training import run
from lidarsynth.weights.official import read_official

SIZE = (8, 32)
SMALLER = {"data.height": 8, "data.width": 32, "score.levels": 4}
TINY = with_fields(preset("lidargen-tiny"), SMALLER)
SENSOR = SENSORS["hdl-64e-kitti"].resized(*SIZE)
QUIET = Options(sample_every=0, workers=0)


def wall(i: int) -> RangeImage:
    """A wavy wall 8 to 20 m around with drop-outs."""
    rng = np.random.default_rng(i)
    wave = 14 + 6 * np.sin(np.linspace(0, 2 * np.pi, SIZE[1]) * rng.integers(1, 4) + rng.uniform(0, 6))
    distance = np.broadcast_to(wave, SIZE).astype(np.float32) * (rng.random(SIZE) < 0.95)
    return RangeImage(distance, ((distance > 0) * 0.4).astype(np.float32), distance > 0, SENSOR)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lidargen") / "cache"
    list(write_cache(folder, wall, 12, SENSOR, {"name": "walls"}))
    return folder


@pytest.fixture(scope="module")
def model() -> LidarModel:
    return assemble(TINY, trained(TINY))  # type: ignore[return-value]


@pytest.fixture(scope="module")
def r2dm() -> LidarModel:
    small = {"model.network": "efficient-unet", "diffusion.kind": "eps", "data.height": 8, "data.width": 32}
    experiment = with_fields(preset("tiny"), small)
    return assemble(experiment, trained(experiment))  # type: ignore[return-value]


@pytest.fixture(scope="module")
def official(official_file) -> Path:
    return official_file("lidargen/checkpoint_100.pth")


# ---------------------------------------------------------------- records


def test_info_tells_the_published_number_of_parameters():
    lines = describe("lidargen").splitlines()
    assert lines[0] == "lidargen"
    said = {line[:16].strip(): line[16:].strip() for line in lines[1:]}
    assert said["parameters"] == "29,694,082"
    assert said["network"] == "refinenet of LiDARGen, base 128, column and row as coordinates"
    assert said["score matching"].startswith("232 noise levels, sigma 50 to 0.01 of data in [0, 1]; sampled in 5 ")
    assert "29,694,082" in describe("r2dm-refinenet")


def test_the_record_has_the_numbers_of_the_sampler_and_the_network():
    score = Score()
    assert (score.levels, score.steps, score.rate) == (langevin.LEVELS, langevin.STEPS, langevin.RATE)
    network = build_network(replace(TINY, score=score))
    torch.testing.assert_close(network.get_buffer("sigmas"), geometric_sigmas(), rtol=0, atol=0)
    schedule = build_denoiser(preset("lidargen"), network).schedule
    _, alpha, sigma = schedule.at(torch.linspace(1, 0, 232), torch.zeros(232, 1))
    torch.testing.assert_close(sigma[:, 0], 2 * geometric_sigmas(), rtol=5e-6, atol=0)  # images here are twice as wide
    assert bool((alpha == 1).all())


def test_presets_train_as_published():
    training = preset("lidargen").training
    told = (training.steps, training.batch_size, training.learning_rate, training.betas)
    assert told == (300_001, 24, 1e-4, (0.9, 0.999))
    assert (training.warmup, training.decay, training.clip_norm) == (0, "constant", None)
    assert [matching.average(training, step) for step in (1, 2, 300_001)] == [0.999] * 3
    assert task_of(preset("lidargen")) is SCORE and task_of(preset("r2dm-refinenet")) is not SCORE
    assert from_dict(json.loads(json.dumps(TINY.to_dict()))) == TINY
    assert "score" not in preset("r2dm-h").to_dict()


def test_a_score_needs_the_schedule_of_its_levels():
    experiment = with_fields(TINY, {"diffusion.schedule": "cosine"})
    with pytest.raises(ValueError, match=r"diffusion.schedule: expected ve beside a score group, found cosine"):
        build_denoiser(experiment, build_network(experiment))


def test_the_range_code_is_lidargens(scan64, fixture_tensors):
    """The published item from points to the network's input; empty pixels, 2.4e-5 there, are 0 here."""
    expected = fixture_tensors("projection/lidargen_input")["lidargen.network_input"]
    points = np.frombuffer(scan64, np.float32).reshape(-1, 4)
    everything = replace(get_sensor("hdl-64e"), min_range=0.0, max_range=math.inf)  # no gate
    image = project(Scan(points[:, :3], points[:, 3]), everything, "spherical")
    assert_close((to_x_0(image, "log-63m") + 1) / 2, expected, atol=3e-5, rtol=0)
    assert (expected[0] == 1).any(), "what is farther than 63 m"
    own = project(Scan(points[:, :3], points[:, 3]), build_sensor(preset("lidargen")), "spherical")
    assert_close((to_x_0(own, "log-63m") + 1) / 2, expected, atol=3e-5, rtol=0)


def test_the_range_code_does_not_depend_on_the_sensor():
    near, far = get_sensor("vlp-16"), get_sensor("hdl-64e")
    distance = torch.linspace(2, 62.9, 100)
    torch.testing.assert_close(encode(distance, near, "log-63m"), encode(distance, far, "log-63m"))
    torch.testing.assert_close(decode(encode(distance, far, "log-63m"), far, "log-63m"), distance)
    assert decode(encode(torch.tensor([70.0]), far, "log-63m"), far, "log-63m").item() == pytest.approx(63, abs=1e-4)


# ---------------------------------------------------------------- official files


@torch.no_grad()
def test_official_weights_say_what_the_reference_says(official, fixture_tensors):
    io = fixture_tensors("lidargen/io")
    sigma = io["sigmas"][io["labels"].long()]
    for ema, key in ((True, "score"), (False, "score_online_weights")):
        if key not in io:  # tests/oracles has one set of weights
            continue
        loaded = lidarsynth.load(official, ema=ema)
        assert isinstance(loaded, LidarModel) and not loaded.network.training
        score = 2 * loaded.network(2 * io["input"] - 1, -2 * (2 * sigma).log())
        assert_within(score, io[key], 1e-4)
    assert loaded.experiment == replace(
        preset("lidargen"), name="checkpoint_100", model=replace(preset("lidargen").model, base_channels=8),
        card=loaded.experiment.card,
    )  # fmt: skip
    assert loaded.experiment.card.history == ("official LiDARGen checkpoint, 100 steps",)
    assert loaded.generation_steps() == loaded.evaluations() == 1161


def test_official_weights_generate_and_save_as_ours(official, tmp_path):
    experiment, network = read_official(official)
    small = with_fields(experiment, {"data.height": 16, "data.width": 64})
    (image,) = assemble(small, network).generate(1, steps=11)
    assert image.shape == (16, 64)
    save(tmp_path, small, network)
    again, same = load(tmp_path)
    assert again == small
    torch.testing.assert_close(same.state_dict(), network.state_dict())


@torch.no_grad()
def test_official_weights_sample_as_the_reference(official, fixture_tensors, reference):
    """The published chain from [0, 1] images, with its own few noise levels, as ours from [-1, 1] images."""
    tensors = fixture_tensors("lidargen/langevin")
    stated = json.loads((reference / "fixtures" / "lidargen" / "info.json").read_text())["langevin"]
    loaded = lidarsynth.load(official)
    assert isinstance(loaded, LidarModel)
    x_1, noise = 2 * tensors["chain.init"] - 1, iter(tensors["chain.noise"])
    chain = langevin.langevin(loaded.denoiser, x_1, lambda x: next(noise), stated["n_levels"], stated["n_steps_each"])
    for state, expected in zip(chain, tensors["chain.states_then_denoised"], strict=True):
        assert_within((state.x_s + 1) / 2, expected, 1e-4)


@pytest.fixture(scope="module")
def shapes(reference) -> dict[str, list[int]]:
    return json.loads((reference / "fixtures" / "lidargen" / "state_dict_full.json").read_text())["model"]


def file_of(path: Path, shapes: dict[str, list[int]], step: int = 100_000, average: bool = True) -> Path:
    """A file in the official format, whose tensors are one number each: 0 raw, 1 averaged."""
    model = {f"module.{name}": torch.zeros(1).expand(shape) for name, shape in shapes.items()}
    model["module.sigmas"] = geometric_sigmas(*shapes["sigmas"])
    ema = {name: torch.ones(1).expand(shape) for name, shape in shapes.items() if name != "sigmas"}
    torch.save([model, {"state": {}}, 7, step, *([ema] if average else [])], path)
    return path


def test_a_file_of_the_published_size_loads(shapes, tmp_path):
    experiment, network = read_official(file_of(tmp_path / "checkpoint_100000.pth", shapes))
    assert sum(p.numel() for p in network.parameters()) == 29_694_082
    assert replace(experiment, name="lidargen", card=preset("lidargen").card) == preset("lidargen")
    assert all(bool((p == 1).all()) for p in network.parameters())
    raw = read_official(file_of(tmp_path / "raw.pth", shapes, average=False))[1]
    assert all(bool((p == 0).all()) for p in raw.parameters())
    other = file_of(tmp_path / "other.pth", shapes)
    lists = torch.load(other, weights_only=True)
    lists[0]["module.sigmas"] = geometric_sigmas(shapes["sigmas"][0], 50.0, 0.02)
    torch.save(lists, other)
    score = read_official(other)[0].score
    assert score is not None and score.rate * score.sigma_min**2 == pytest.approx(6.2e-6)  # its step_lr


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"res2.0.conv1.weight": [64, 128, 3, 3]},
            r"res2.0.conv1.weight \(128, 128, 3, 3\), found \(64,",
        ),
        ({"begin_conv.weight": [64, 4, 3, 3]}, r"\(64,\), found \(128,\); \d+ tensors do not fit"),
        ({"begin_conv.weight": [128, 3, 3, 3]}, r"for range, reflectance and two coordinates|tensors do not fit"),
        ({"refine4.crp.convs.0.weight": None}, r"\(128, 128, 3, 3\), found none; 1 tensors do not fit"),
        ({"res5.0.conv1.weight": [256, 256, 3, 3]}, r"res5.0.conv1.weight not to be there"),
        ({"sigmas": [1]}, "noise levels `sigmas` that fall geometrically, found 1 from 50 to 50"),
        ({"begin_conv.weight": None}, "expected LiDARGen's begin_conv.weight and sigmas, found"),
    ],
)
def test_official_files_of_other_networks_are_refused_in_one_line(shapes, tmp_path, changes, message):
    different = {name: shape for name, shape in {**shapes, **changes}.items() if shape is not None}
    path = file_of(tmp_path / "other.pth", different)
    with pytest.raises(ValueError, match=message) as caught:
        read_official(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


def test_broken_files_and_other_systems_are_named(shapes, official, tmp_path):
    cut = tmp_path / "cut.pth"
    cut.write_bytes(official.read_bytes()[:-1000])
    with pytest.raises(ValueError, match=r"cut.pth: expected .* lidargen.*, found a truncated file"):
        lidarsynth.load(cut)
    torch.save([1, 2, 3], tmp_path / "list.pth")
    with pytest.raises(ValueError, match=r"list.pth: expected an official R2DM checkpoint, or one of .*lidargen.*list"):
        lidarsynth.load(tmp_path / "list.pth")
    torch.save([{"module.conv.weight": 1}, {}, 0, 0], tmp_path / "number.pth")
    with pytest.raises(ValueError, match=r"LiDARGen's list .* with tensors by name, found 'module.conv.weight' int"):
        lidarsynth.load(tmp_path / "number.pth")


# ---------------------------------------------------------------- score matching


class Said(nn.Module):
    """Always says the same."""

    def __init__(self, prediction: Tensor):
        super().__init__()
        self.prediction = prediction

    def forward(self, x_t: Tensor, log_snr: Tensor) -> Tensor:
        return self.prediction


def test_the_objective_is_lidargens(fixture_tensors):
    stored = fixture_tensors("lidargen/loss")
    objective = ScoreMatching(preset("lidargen"), Said(stored["score"] / 2))
    batch = matching.ScoreBatch(2 * stored["samples"] - 1, 1 - stored["labels"] / 231, stored["noise"])
    losses = objective(batch)["score"]
    torch.testing.assert_close(losses, stored["per_sample_loss"], rtol=1e-4, atol=0)
    torch.testing.assert_close(losses.mean(), stored["loss"], rtol=1e-4, atol=0)


def test_levels_are_drawn_evenly_and_by_seed_step_and_position_only():
    x_0 = torch.zeros(4, 2, *SIZE)
    whole = matching.draw(TINY, x_0, 5, [0, 1, 2, 3])
    part = matching.draw(TINY, x_0[1::2], 5, [1, 3])
    for name in ("x_0", "t", "eps"):
        assert torch.equal(getattr(part, name), getattr(whole, name)[1::2])
    small = torch.zeros(4, 2, 2, 8)
    batches = [matching.draw(TINY, small, step, [0, 1, 2, 3]) for step in range(400)]
    levels = torch.stack([b.t for b in batches]).flatten() * 3
    torch.testing.assert_close(levels, levels.round(), atol=1e-5, rtol=0)
    counts = torch.unique(levels.round().int(), return_counts=True)[1]
    assert len(counts) == 4 and int(counts.min()) > 330 and int(counts.max()) < 470
    eps = torch.stack([b.eps for b in batches])
    assert abs(float(eps.mean())) < 0.01 and abs(float(eps.std()) - 1) < 0.01


class Walls:
    """Images of `wall`, without a cache."""

    def __init__(self, length: int):
        self.length = length
        self.source = {"name": "walls"}

    def __len__(self) -> int:
        return self.length

    def x_0(self, indices: list[int], codec: str = "log") -> Tensor:
        return torch.stack([to_x_0(wall(i), codec) for i in indices])


def test_training_lowers_the_error_at_every_level():
    experiment, images = with_fields(TINY, {"training.steps": 15, "training.learning_rate": 4e-3}), Walls(4)
    torch.manual_seed(0)
    state = start(experiment, build_network(experiment), task_of(experiment))
    before = fixed_losses(experiment, state.network, images.x_0([0, 1]))
    losses = [p.losses["loss"] for p in train(experiment, state, images, QUIET)]  # type: ignore[arg-type]
    assert np.mean(losses[-5:]) < 0.6 * np.mean(losses[:3])
    after = fixed_losses(experiment, state.network, images.x_0([0, 1]))
    assert list(after) == [f"t_{time}" for time in TIMES]
    for name in after:
        assert after[name] < 0.7 * before[name], name


def test_the_average_is_that_of_the_parameters_alone():
    experiment = with_fields(TINY, {"training.steps": 2, "training.ema_decay": 0.75})
    state = start(experiment, build_network(experiment), task_of(experiment))
    first = {name: p.detach().clone() for name, p in state.network.named_parameters()}
    expected = first
    for _ in train(experiment, state, Walls(4), QUIET):  # type: ignore[arg-type]
        expected = {name: 0.75 * expected[name] + 0.25 * p.detach() for name, p in state.network.named_parameters()}
    torch.testing.assert_close(dict(state.ema.named_parameters()), expected)
    assert torch.equal(state.ema.get_buffer("sigmas"), geometric_sigmas(4))


def curve(out: Path) -> list[float]:
    with (out / "losses.csv").open() as file:
        return [float(row["loss"]) for row in csv.DictReader(file)]


def test_a_stopped_run_continues_bit_by_bit(cache: Path, tmp_path: Path):
    experiment = with_fields(TINY, {"training.steps": 4})
    list(run(experiment, cache, tmp_path / "whole", options=QUIET))
    for progress in run(experiment, cache, tmp_path / "broken", options=replace(QUIET, save_every=2)):
        if progress.step == 3:
            break
    assert checkpoints(tmp_path / "broken")[-1].name == "step-00000002"
    list(run(experiment, cache, tmp_path / "broken", options=QUIET, resume=True))
    for name in ("losses.csv", "model.safetensors"):
        assert (tmp_path / "broken" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_accumulated_passes_give_the_curve_of_one():
    losses = []
    for passes in (1, 4):
        experiment = with_fields(TINY, {"training.steps": 2})
        torch.manual_seed(0)
        steps = train(
            experiment,
            start(experiment, build_network(experiment), task_of(experiment)),
            Walls(8),  # type: ignore[arg-type]
            replace(QUIET, accumulate=passes),
        )
        losses.append([p.losses["loss"] for p in steps])
    np.testing.assert_allclose(losses[1], losses[0], rtol=1e-4)


@pytest.mark.timeout(300)
def test_two_processes_give_the_curve_of_one(cache: Path, tmp_path: Path):
    list(run(with_fields(TINY, {"training.steps": 2}), cache, tmp_path / "one", options=QUIET))
    words = ["train", "lidargen-tiny", "--data", str(cache), "--out", str(tmp_path / "two"), "--sample-every", "0"]
    words += ["--threads", "1", "--workers", "0", "--set", "training.steps=2"]
    words += [f"{field}={value}" for field, value in SMALLER.items()]
    ends = pair(*words)
    assert [code for code, _, _ in ends] == [0, 0], ends
    np.testing.assert_allclose(curve(tmp_path / "two"), curve(tmp_path / "one"), rtol=1e-4)


def test_training_draws_pictures_of_its_chains():
    network = trained(TINY)
    pictures = matching.picture_chains(TINY, network, [])
    assert len(pictures) == 2 and pictures[0].dtype == np.uint8 and pictures[0].ndim == 3


def test_fine_tuning_begins_with_official_weights(official, cache, tmp_path):
    same = with_fields(TINY, {"training.steps": 1, "training.learning_rate": 0.0, "data.sensor": "hdl-64e-kitti"})
    list(run(same, cache, tmp_path / "tuned", str(official), options=QUIET))
    found, network = load(tmp_path / "tuned")
    torch.testing.assert_close(dict(network.named_parameters()), dict(load_official(official).named_parameters()))
    assert found.card.data == "KITTI-360, then 12 images of walls"
    wide = with_fields(same, {"model.base_channels": 16})
    with pytest.raises(ValueError, match=r"expected an experiment like that of the weights \(--set model.base_chan"):
        list(run(wide, cache, tmp_path / "wide", str(official), options=QUIET))


def load_official(path: Path) -> nn.Module:
    return read_official(path)[1]


def test_the_network_is_also_a_noise_predictor():
    experiment = with_fields(
        preset("r2dm-refinenet"),
        {"model.base_channels": 8, "data.height": 8, "data.width": 32, "data.sensor": "hdl-64e-kitti",
         "training.steps": 10, "training.batch_size": 4, "training.warmup": 1, "training.learning_rate": 5e-3},
    )  # fmt: skip
    torch.manual_seed(0)
    state = start(experiment, build_network(experiment), task_of(experiment))
    losses = [p.losses["loss"] for p in train(experiment, state, Walls(4), QUIET)]  # type: ignore[arg-type]
    assert np.mean(losses[-3:]) < 0.7 * np.mean(losses[:3])
    made = assemble(experiment, state.network)
    assert made.generation_steps() == 32 and made.evaluations() == 311
    assert made.generate(1, steps=2)[0].range.max() < 80


# ---------------------------------------------------------------- sampling


def test_generation_is_the_published_chain(model):
    calls = []
    (image,) = model.generate(1, seed=3, on_step=lambda: calls.append(1))
    assert len(calls) == model.generation_steps() == 4 * 5 + 1
    rng = generators(3, 1)
    x_1 = langevin.starting_uniform(torch.zeros(1, 2, *SIZE), rng, -1, 1)
    *_, last = langevin.langevin(model.denoiser, x_1, rng, levels=4, grid=even_log_snr)
    expected = from_x_0(last.x_s[0].clamp(-1, 1), model.sensor, "log-63m")
    np.testing.assert_array_equal(image.range, expected.range)
    np.testing.assert_array_equal(image.reflectance, expected.reflectance)


def test_a_chain_depends_on_its_seed_only(model):
    together = model.generate(2, steps=11, seed=5)
    alone = model.generate(1, steps=11, seed=6)[0]
    np.testing.assert_allclose(alone.range, together[1].range, rtol=1e-3, atol=1e-3)
    assert (alone.range != together[0].range).any()


@pytest.mark.parametrize("sampler", STEPS)
def test_a_score_is_a_denoiser_for_every_sampler(model, sampler):
    (image,) = model.generate(1, steps=3, sampler=sampler)
    assert np.isfinite(image.range).all() and image.range.max() < 80


@pytest.mark.parametrize(("asked", "taken"), [(11, 11), (15, 11), (16, 16), (1161, 1161), (None, 1161)])
def test_r2dm_is_sampled_by_langevin_steps_too(r2dm, asked, taken):
    assert r2dm.generation_steps(asked, "langevin") == taken == r2dm.generation_steps(taken, "langevin")
    if taken > 20:
        return
    calls = []
    (image,) = r2dm.generate(1, asked, sampler="langevin", on_step=lambda: calls.append(1))
    assert len(calls) == taken and image.range.max() < 80
    rng = generators(0, 1)
    x_1 = starting_noise(r2dm.denoiser, torch.zeros(1, 2, *SIZE), rng)
    *_, last = langevin.langevin(r2dm.denoiser, x_1, rng, levels=taken // 5, grid=even_log_snr)
    np.testing.assert_array_equal(image.range, from_x_0(last.x_s[0].clamp(-1, 1), r2dm.sensor).range)


def test_too_few_steps_for_langevin_are_refused(model, r2dm):
    for made in (model, r2dm):
        for few in (0, 10):
            with pytest.raises(ValueError, match=rf"at least 11 network calls for langevin, .* and 1, found {few}$"):
                made.generate(1, few, sampler="langevin")
    with pytest.raises(ValueError, match=r"at least 11 network calls for langevin"):
        model.complete(wall(0), method="posterior", steps=4)


# ---------------------------------------------------------------- completion


@pytest.mark.parametrize("recipe", ["beams:4", "points:0.1", "sector:90"])
def test_known_pixels_come_back_bit_by_bit(model, r2dm, recipe):
    truth = wall(1)
    known = corrupt(truth, recipe)
    for made, method in ((model, "auto"), (r2dm, "posterior"), (model, "repaint")):
        counts = {"steps": 2, "resamples": 2} if method == "repaint" else {"steps": 16}
        result = made.complete(truth.keep(known), known, method, **counts)
        for field in ("range", "reflectance", "mask"):
            np.testing.assert_array_equal(getattr(result, field)[known], getattr(truth, field)[known])
        assert np.isfinite(result.range).all() and result.mask[~known].any()


def test_auto_is_the_posterior_for_score_matching_only(model, r2dm):
    truth = wall(1)
    known = corrupt(truth, "beams:4")
    auto, own = (model.complete(truth.keep(known), known, m, steps=11).range for m in ("auto", "posterior"))
    np.testing.assert_array_equal(auto, own)
    assert (model.evaluations(), model.evaluations(steps=30), model.evaluations("repaint")) == (21, 26, 311)
    assert (r2dm.evaluations(), r2dm.evaluations("posterior")) == (311, 1161)
    with pytest.raises(ValueError, match=r"lidargen-tiny: expected method repaint or posterior, .* found conditional"):
        model.complete(truth, method="conditional")


def test_progress_is_told_once_per_network_call(model):
    calls, asked = [], []
    hook = model.network.register_forward_hook(lambda *_: asked.append(1))
    model.complete(wall(1), steps=16, on_step=lambda: calls.append(1))
    hook.remove()
    assert len(calls) == len(asked) == model.evaluations(steps=16) == 16


def test_the_posterior_hears_the_known_pixels_and_no_others(model):
    truth = wall(1)
    known = corrupt(truth, "beams:4")
    seen, hidden = (model.complete(i, known, seed=1).range for i in (truth, truth.keep(known)))
    np.testing.assert_array_equal(seen, hidden)
    nearer = replace(truth, range=truth.range * np.float32(0.5))
    other = model.complete(nearer.keep(known), known, seed=1).range
    assert (other != seen)[~known].any()


def test_upsampling_keeps_what_was_measured(model):
    sparse = wall(2).to_scan()
    sparse = sparse[np.asarray(sparse.ring) % 2 == 0]
    result = model.upsample(replace(sparse, ring=None), "vlp-16", steps=11)
    assert result.shape == SIZE and result.mask.any()


def correlated(correlation: float = 0.9, std: float = 0.3) -> Denoiser:
    """The exact denoiser of two correlated channels on the schedule of LiDARGen: S (S + sigma^2 I)^-1 x_t."""
    covariance = std**2 * torch.tensor([[1.0, correlation], [correlation, 1.0]], dtype=torch.float64)

    def network(x_t: Tensor, log_snr: Tensor) -> Tensor:
        noise = (-log_snr.double()).exp().view(-1, 1, 1) * torch.eye(2)
        return torch.einsum("bij,bjhw->bihw", covariance @ torch.linalg.inv(covariance + noise), x_t.double()).float()

    return Denoiser(network, ve(0.02, 100.0), kind="x_0", clip=False)


@pytest.mark.parametrize("method", ["repaint", "posterior"])
def test_completion_where_noise_explodes_follows_the_conditional_law(method):
    """Channel 0 is known to be 0.4, channel 1 is then N(0.36, 0.13^2)."""
    known, mask, rng = torch.full((1, 2, 32, 32), 0.4), torch.zeros(1, 2, 32, 32), generators(0, 1)
    mask[:, 0] = 1
    denoiser = correlated()
    x_1 = starting_noise(denoiser, known, rng)
    if method == "repaint":
        states = repaint(denoiser, x_1, known, mask, rng, steps=64)
    else:
        # at the published rate of 0.062 the chain cools before it is there, at a mean of 0.32
        states = langevin.langevin_posterior(denoiser, x_1, known, mask, rng, rate=0.2)
    *_, last = states
    assert float(last.x_s[:, 1].mean()) == pytest.approx(0.36, abs=0.03)
    assert float(last.x_s[:, 1].std()) == pytest.approx(0.3 * (1 - 0.9**2) ** 0.5, abs=0.03)


# ---------------------------------------------------------------- the command line


def test_the_command_line_trains_generates_and_completes(cache: Path, tmp_path: Path, capsys):
    made, scan = tmp_path / "run", tmp_path / "wall.npz"
    write(scan, wall(3).to_scan())
    words = ["--model", str(made), "--steps", "11", "--no-picture"]
    smaller = [f"{field}={value}" for field, value in (SMALLER | {"score.levels": 2}).items()]
    few = ["--set", "training.steps=2", *smaller, "--threads", "1", "--workers", "0", "--sample-every", "2"]
    main(["train", "lidargen-tiny", "--data", str(cache), "--out", str(made), *few])
    assert list((made / "pictures").glob("sample-*.png"))
    main(["generate", "-n", "1", "--out", str(tmp_path / "out"), *words])
    main(["complete", str(scan), "--out", str(tmp_path / "full.ply"), "--corrupt", "beams:4", *words])
    main(["complete", str(scan), "--out", str(tmp_path / "posterior.ply"), "--method", "posterior", *words])
    main(["upsample", str(scan), "--out", str(tmp_path / "dense.ply"), "--from", "hdl-64e-kitti", *words])
    main(["info", str(made)])
    told = capsys.readouterr().out
    assert "range MAE" in told and "score matching  2 noise levels" in told
    for name in ("out/000000.ply", "full.ply", "posterior.ply", "dense.ply"):
        assert (tmp_path / name).stat().st_size > 1000
    default = str(tmp_path / "langevin")
    main(["generate", "-n", "1", "--out", default, "--model", str(made), "--steps", "12", "--sampler", "langevin"])
    assert json.loads((tmp_path / "langevin" / "generate.json").read_text())["steps"] == 11
