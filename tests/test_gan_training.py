"""Training of GANs: what each network sees, its penalties and averages, exact continuation, and that it learns."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from forked import pair
from torch import Tensor
from torch.testing import assert_close

from lidarsynth.data.dataset import write_cache
from lidarsynth.data.frames import Name
from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import Experiment, with_fields
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.networks.gan.losses import r1_penalty
from lidarsynth.networks.gan.scan_generator import ScanGenerator
from lidarsynth.systems.gan import training as adversarial
from lidarsynth.systems.gan.batch import AdversarialBatch, draw, warmup_drop
from lidarsynth.systems.gan.build import build_discriminator
from lidarsynth.systems.gan.model import GanModel
from lidarsynth.systems.gan.training import ADVERSARIAL, AdversarialNetworks
from lidarsynth.systems.table import build_network, task_of, transfer
from lidarsynth.systems.table import load_folder as load
from lidarsynth.training.loop import Run, start, train, update_ema
from lidarsynth.training.machine import accelerator_of
from lidarsynth.training.options import Options
from lidarsynth.verbs.training import run

WORDS = ("vanilla-gan", "dusty-v1", "dusty-v2")
SENSOR = SENSORS["hdl-64e-kitti"].resized(32, 64)


class Flat:
    """Images of one value and a little noise, without a cache."""

    source = {"name": "flat"}  # noqa: RUF012

    def __len__(self) -> int:
        return 10

    def name(self, i: int) -> Name:
        return Name("flat", "", str(i))

    def x_0(self, indices: list[int], codec: str = "log") -> Tensor:
        noise = [torch.randn(2, 32, 64, generator=torch.Generator().manual_seed(i)) for i in indices]
        return 0.6 + 0.1 * torch.stack(noise)


def tiny(word: str = "vanilla-gan", **changes) -> Experiment:
    return with_fields(preset("tiny-gan"), {"model.network": word, **changes})


def plain(word: str = "vanilla-gan", **changes) -> Experiment:
    """Nothing between the images and the discriminator."""
    quiet = {"adversarial.augmentation_target": None, "adversarial.warmup_images": 0}
    return tiny(word, **quiet, **changes)


def started(experiment: Experiment) -> Run:
    torch.manual_seed(experiment.training.seed)
    return start(experiment, build_network(experiment), task_of(experiment))


def networks_of(experiment: Experiment) -> AdversarialNetworks:
    network = started(experiment).network.train()
    assert isinstance(network, AdversarialNetworks)
    return network


def batch_of(experiment: Experiment, step: int = 0, positions: tuple[int, ...] = (0, 1, 2, 3)) -> AdversarialBatch:
    return draw(experiment, Flat(), list(positions), step, list(positions))  # type: ignore[arg-type]


def flat(batch) -> list[Tensor]:
    return [batch] if isinstance(batch, Tensor) else [leaf for part in batch for leaf in flat(part)]


@pytest.mark.parametrize("word", WORDS)
def test_a_sample_s_randomness_depends_on_seed_step_and_position_only(word):
    experiment = tiny(word, **{"adversarial.path_length_weight": 2.0})
    whole, part = batch_of(experiment, 5), batch_of(experiment, 5, (1, 3))
    for ours, theirs in zip(flat(part), flat(whole), strict=True):
        assert torch.equal(ours, theirs[1::2])
    assert not torch.equal(batch_of(experiment, 6).latents.z, whole.latents.z)
    assert not torch.equal(whole.latents.z, whole.fake_latents.z), "the discriminator's phase has fresh latents"
    views = [whole.view, whole.fake_view, whole.real_view, whole.penalty_view]
    assert len({float(view.dice.uniform[0, 0]) for view in views}) == 4


def test_the_warm_up_drops_half_of_the_pixels_and_then_fewer():
    experiment = tiny(**{"adversarial.warmup_images": 40})  # ten steps
    for step, share in ((0, 0.5), (5, 0.25), (10, 0.0), (99, 0.0)):
        batch = batch_of(experiment, step)
        assert 1 - float(batch.real_view.keep.float().mean()) == pytest.approx(share, abs=0.02)
    networks, group = networks_of(experiment), experiment.adversarial
    seen = adversarial.shown(networks, plain().adversarial, batch_of(experiment).real, batch_of(experiment).view)  # type: ignore[arg-type]
    assert float((seen == -1).float().mean()) == pytest.approx(0.5, abs=0.02)
    assert group and group.augmentation_target == 0.6


@pytest.mark.parametrize("word", WORDS)
def test_a_phase_moves_its_own_network_only(word):
    experiment = tiny(word, **{"adversarial.path_length_weight": 2.0})
    networks, batch = networks_of(experiment), batch_of(experiment)
    for phase in ADVERSARIAL.phases(experiment, networks):
        own = networks.generator if phase.optimizer == "generator" else networks.discriminator
        assert {id(p) for p in phase.objective.parameters()} == {id(p) for p in own.parameters()}
        networks.zero_grad()
        torch.cat([*phase.objective(batch).values()]).mean().backward()
        for name, parameter in networks.named_parameters():
            mine = name.startswith(phase.optimizer)
            assert (parameter.grad is not None) == mine, f"{type(phase.objective).__name__}: {name}"
    assert [phase.every for phase in ADVERSARIAL.phases(experiment, networks)] == [1, 4, 1, 4]
    published = ADVERSARIAL.phases(tiny(word), networks)
    assert [phase.optimizer for phase in published] == ["generator", "discriminator", "discriminator"]


def test_losses_are_those_of_the_papers():
    experiment = plain(**{"adversarial.r1_weight": 3.0, "adversarial.r1_every": 5})
    networks, batch = networks_of(experiment), batch_of(experiment)
    generator, discriminator, penalty = (p.objective(batch) for p in ADVERSARIAL.phases(experiment, networks))
    with torch.no_grad():
        fake = networks.generator(batch.latents.z, batch.latents.uniform).image
        others = networks.generator(batch.fake_latents.z, batch.fake_latents.uniform).image
        logits, real, fakes = (networks.discriminator(x).flatten() for x in (fake, batch.real, others))
    assert_close(generator["generator"][0], torch.log1p(torch.exp(-logits)).mean())
    expected = torch.log1p(torch.exp(-real)).mean() + torch.log1p(torch.exp(fakes)).mean()
    assert_close(discriminator["discriminator"][0], expected)
    x = batch.real.clone().requires_grad_()
    assert_close(penalty["r1"][0], 3.0 / 2 * 5 * r1_penalty(networks.discriminator(x), x))


def test_lazy_penalties_have_adam_s_factors_and_intervals():
    experiment = with_fields(preset("tiny-gan"), {"adversarial.r1_every": 16, "training.steps": 3})
    state = started(experiment)
    generator, discriminator = (state.optimizers[name].param_groups[0] for name in ("generator", "discriminator"))
    assert (generator["factor"], generator["betas"]) == (1.0, (0.0, 0.99))
    assert discriminator["factor"] == pytest.approx(16 / 17)
    assert discriminator["betas"] == pytest.approx((0.0, 0.99 ** (16 / 17)))
    experiment = tiny(**{"adversarial.r1_every": 2, "training.steps": 3})
    state = started(experiment)
    losses = [p.losses for p in train(experiment, state, Flat(), Options(workers=0))]  # type: ignore[arg-type]
    assert ["r1" in found for found in losses] == [True, False, True]
    assert state.optimizers["discriminator"].param_groups[0]["lr"] == pytest.approx(2e-3 * 2 / 3)
    assert losses[0]["loss"] == pytest.approx(sum(losses[0][part] for part in ("generator", "discriminator", "r1")))


def test_the_average_halves_its_past_in_a_half_life_and_copies_buffers():
    training = tiny(**{"training.ema_half_life": 8, "training.batch_size": 4}).training
    assert ADVERSARIAL.average(training, 1) == pytest.approx(0.5 ** (4 / (0.05 * 4)))  # type: ignore[arg-type]
    assert ADVERSARIAL.average(training, 10_000) == pytest.approx(0.5 ** (4 / 8))
    network = build_network(tiny("dusty-v2"))
    ema = build_network(tiny("dusty-v2"))
    key = "generator.synthesis_network.layers.0.conv1"
    before, ours = (net.state_dict()[f"{key}.weight"].clone() for net in (ema, network))
    network.get_buffer(f"{key}.ema_var").fill_(7.0)
    update_ema(ema, network, 0.75, ADVERSARIAL.buffers)
    assert_close(ema.state_dict()[f"{key}.weight"], 0.75 * before + 0.25 * ours)
    assert float(ema.get_buffer(f"{key}.ema_var")) == 7.0


def test_the_augmentation_follows_the_signs_of_real_images():
    experiment = tiny()  # 100 images to one, every 4 steps
    networks, accelerator = networks_of(experiment), accelerator_of(Options())
    for sign, expected in ((1.0, 0.16), (1.0, 0.32), (-1.0, 0.16)):
        for step in range(1, 5):
            networks.augmentation.observe(torch.full((4, 1), sign))
            adversarial.after(experiment, networks, step, accelerator)
        assert float(networks.augmentation.p) == pytest.approx(expected)
    batch = batch_of(experiment, 99)
    networks.augmentation.p.fill_(0.0)
    adversarial.DiscriminatorLoss(experiment, networks)(batch)
    assert float(networks.augmentation.n_pred_cum) == 4, "real logits only"


def test_the_groups_of_the_minibatch_deviation_are_the_same_in_two_processes():
    experiment = tiny("dusty-v2")
    torch.manual_seed(0)
    discriminator, images = build_discriminator(experiment), torch.randn(8, 1, 32, 64)
    with torch.no_grad():
        whole = discriminator(images)
        halves = [discriminator(images[part::2]) for part in (0, 1)]
    assert_close(torch.stack(halves, dim=1).flatten(0, 1), whole)


def test_dusty_ii_draws_its_second_mask_once_for_an_image():
    experiment = tiny("dusty-v1", **{"adversarial.image_mask": True, "training.steps": 2})
    latents = draw(experiment, Flat(), [0, 1, 2], 0, [0, 1, 2]).latents  # type: ignore[arg-type]
    assert latents.uniform.shape == (3, 2, 32, 64)
    image = latents.uniform[:, 1].flatten(1)
    assert (image == image[:, :1]).all() and len(image[:, 0].unique()) == 3
    other = draw(tiny("dusty-v1"), Flat(), [0], 0, [0]).latents  # type: ignore[arg-type]
    assert torch.equal(latents.uniform[:1, :1], other.uniform), "pixels have the noise of DUSty-I"
    state = started(experiment)
    head = "generator.generator.synthesis_network.4.heads.raydrop_logit.1.module.bias"
    before = state.network.get_parameter(head).detach().clone()
    list(train(experiment, state, Flat(), Options(workers=0)))  # type: ignore[arg-type]
    assert (state.network.get_parameter(head) != before).all(), "both masks have gradients"


@pytest.mark.parametrize("word", WORDS)
def test_training_brings_the_samples_to_the_data(word):
    steps = 12 if word == "dusty-v2" else 16
    changes = {"training.steps": steps, "training.learning_rate": 0.01, "adversarial.r1_weight": 10.0}
    experiment = plain(word, **changes)
    state = started(experiment)
    before = _mean_error(state.ema)
    list(train(experiment, state, Flat(), Options(workers=0)))  # type: ignore[arg-type]
    assert _mean_error(state.ema) < 0.7 * before
    assert not state.ema.training


def _mean_error(network: torch.nn.Module) -> float:
    z = torch.randn(16, 8, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        return float((network(z, torch.full((1, 1, 1, 1), 0.5)).image - 0.6).abs().mean())


def noise_image(i: int) -> RangeImage:
    rng, shape = np.random.default_rng(i), (32, 64)
    mask = rng.random(shape) < 0.9
    distance = rng.uniform(2, 60, shape).astype(np.float32)
    return RangeImage(distance * mask, (rng.random(shape) * mask).astype(np.float32), mask, SENSOR)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("training") / "cache"
    list(write_cache(folder, noise_image, 12, SENSOR, {"name": "noise"}))
    return folder


def table(out: Path) -> list[dict[str, str]]:
    with (out / "losses.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(("word", "weight"), [("vanilla-gan", 0.0), ("dusty-v2", 2.0)])
def test_a_broken_run_continues_bit_by_bit(cache: Path, tmp_path: Path, word: str, weight: float):
    changes = {"training.steps": 4, "adversarial.path_length_weight": weight, "adversarial.path_length_every": 2}
    experiment = tiny(word, **changes, **{"adversarial.r1_every": 2})
    options = Options(sample_every=0, save_every=2, workers=0)
    list(run(experiment, cache, tmp_path / "whole", options=options))
    for progress in run(experiment, cache, tmp_path / "broken", options=options):
        if progress.step == 3:  # as a kill: a step behind the checkpoint
            break
    list(run(experiment, cache, tmp_path / "broken", options=options, resume=True))
    for name in ("losses.csv", "model.safetensors"):
        assert (tmp_path / "broken" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    rows = table(tmp_path / "whole")
    assert [bool(row["r1"]) for row in rows] == [True, False] * 2
    assert [bool(row["path_length"]) for row in rows] == ([True, False] * 2 if weight else [False] * 4)
    for name in ("checkpoints/step-00000004/state.pt", "checkpoints/step-00000002/state.pt"):
        ours, theirs = (torch.load(tmp_path / side / name, weights_only=True) for side in ("broken", "whole"))
        assert_close(ours, theirs, rtol=0, atol=0)


@pytest.mark.timeout(300)
def test_two_processes_give_the_curve_of_one(cache: Path, tmp_path: Path):
    words = ["train", "tiny-gan", "--data", str(cache), "--sample-every", "0", "--threads", "1", "--workers", "0"]
    # dusty-v1 has no statistics of batches in a forward pass; the warm-up and the augmentation act from the start
    fields = {"model.network": "dusty-v1", "training.steps": 3, "adversarial.augmentation_images": 30,
              "adversarial.augmentation_every": 2, "adversarial.augmentation_target": -1.5}  # fmt: skip
    list(run(tiny(**fields), cache, tmp_path / "one", options=Options(sample_every=0, workers=0)))
    changes = ["--set", *(f"{name}={value}" for name, value in fields.items())]
    ends = pair(*words, "--out", tmp_path / "two", *changes)
    assert [code for code, _, _ in ends] == [0, 0], ends
    for column in ("generator", "discriminator", "r1", "grad_norm"):
        one, two = ([float(row[column] or 0) for row in table(tmp_path / name)] for name in ("one", "two"))
        np.testing.assert_allclose(two, one, rtol=5e-3, err_msg=column)
    ours, theirs = (load(tmp_path / name)[1].state_dict() for name in ("one", "two"))
    assert_close(theirs["generator.w_avg"], ours["generator.w_avg"], rtol=1e-4, atol=1e-5)
    states = [torch.load(tmp_path / name / "checkpoints/latest/state.pt", weights_only=True) for name in ("one", "two")]
    assert states[0]["network"]["augmentation.p"] == states[1]["network"]["augmentation.p"] > 0


def test_a_run_is_judged_without_its_discriminator(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(adversarial, "JUDGED", 12)
    experiment = tiny("dusty-v1", **{"training.steps": 2})
    list(run(experiment, cache, tmp_path, options=Options(sample_every=2, workers=0), validation=cache))
    assert len(list((tmp_path / "pictures").glob("sample-00000002-*.png"))) == 4
    network = load(tmp_path)[1]
    assert isinstance(network, ScanGenerator), "the folder holds the generator"
    model = GanModel(network, build_sensor(experiment), experiment)
    own = model.generate(adversarial.JUDGED, seed=0)
    assert ADVERSARIAL.judge(experiment, network, own) == {"bev_jsd": pytest.approx(0, abs=1e-6), "returns": 0.0}
    others = [noise_image(i) for i in range(4)]
    found = ADVERSARIAL.judge(experiment, network, others)
    assert 0 < found["bev_jsd"] < math.sqrt(math.log(2)) and -1 < found["returns"] < 0
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
        dict(network.named_parameters())["generator.synthesis_network.4.heads.image.1.module.bias"].fill_(-1.0)
    assert ADVERSARIAL.judge(experiment, network, others)["bev_jsd"] == pytest.approx(math.sqrt(math.log(2)))


def test_fine_tuning_copies_equal_generators_and_refuses_others():
    source = tiny("dusty-v2")
    trained = build_network(source)
    target = with_fields(source, {"data.sensor": "hdl-64e", "data.width": 128})
    network = build_network(target)
    angles = network.get_buffer("angles").clone()
    transfer(network, target, trained, source, "weights")
    assert torch.equal(network.get_buffer("angles"), angles), "any angles are rendered"
    for key, value in trained.state_dict().items():
        assert key == "angles" or torch.equal(network.state_dict()[key], value)
    with pytest.raises(ValueError, match="weights: expected weights of dusty-v1 of inverse range, found dusty-v2 of"):
        transfer(build_network(tiny("dusty-v1")), tiny("dusty-v1"), trained, source, "weights")
    with pytest.raises(ValueError, match="expected weights of conditional-unet of log range, found dusty-v2"):
        transfer(build_network(preset("tiny")), preset("tiny"), trained, source, "weights")
    wide = tiny("vanilla-gan", **{"data.width": 128})  # its first layer is as large as the coarsest map
    with pytest.raises(ValueError, match=r"expected generator.synthesis_network.0.1.module.weight .* found"):
        transfer(build_network(wide), wide, build_network(tiny()), tiny(), "weights")


@pytest.mark.parametrize("word", WORDS)
def test_presets_train_as_published(word):
    experiment = preset(word)
    training, group = experiment.training, experiment.adversarial
    assert task_of(experiment) is ADVERSARIAL and group is not None
    assert training.steps * training.batch_size == 25_000_000
    assert (training.learning_rate, training.betas, training.clip_norm) == (2e-3, (0.0, 0.99), None)
    assert (group.r1_weight, group.r1_every, group.path_length_weight) == (1.0, 16, 0.0)
    assert (group.augmentation_target, group.augmentation_images, group.warmup_images) == (0.6, 500_000, 200_000)
    assert (experiment.data.codec, experiment.data.reflectance, experiment.data.width) == ("inverse", False, 512)
    assert adversarial.average(training, 781_250) == pytest.approx(0.5 ** (32 / 10_000))
    assert warmup_drop(group, 100_000) == 0.25


def test_half_precision_keeps_coordinates_and_penalties_whole():
    from accelerate.state import AcceleratorState

    experiment, curves = tiny("dusty-v2", **{"training.steps": 2}), []
    for precision in ("fp32", "bf16"):
        options = Options(workers=0, precision=precision)
        AcceleratorState._reset_state()  # one precision per process otherwise
        curves.append([p.losses for p in train(experiment, started(experiment), Flat(), options)])  # type: ignore[arg-type]
    AcceleratorState._reset_state()
    for whole, half in zip(*curves, strict=True):
        for part, value in whole.items():
            assert half[part] == pytest.approx(value, rel=0.02), part
