"""What a GanModel does, and how official checkpoints of GANs become one."""

import json
import math
import sys
import types
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from oracle import assert_close
from torch import Tensor

import lidarsynth
from lidarsynth.cli.main import main
from lidarsynth.evaluation.pairs import Pairs
from lidarsynth.evaluation.protocols import R2DM, R2DM_UPSAMPLING
from lidarsynth.evaluation.report import results_of
from lidarsynth.evaluation.statistics import Statistics
from lidarsynth.experiment.folder import save
from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import Experiment, with_fields
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.lidar.depth import decode, encode
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import get_sensor
from lidarsynth.systems.gan.model import GanModel
from lidarsynth.systems.table import assemble, build_network
from lidarsynth.verbs.description import describe
from lidarsynth.weights.load import load_parts
from lidarsynth.weights.official import read_official

WORDS = ("vanilla-gan", "dusty-v1", "dusty-v2")
TOLERANCE = {"atol": 2e-5, "rtol": 1e-4}


def tiny(word: str, **changes) -> Experiment:
    return with_fields(preset("tiny-gan"), {"model.network": word, **changes})


def model_of(experiment: Experiment) -> GanModel:
    """Its images are about 3 to 10 m, with drop-outs where the network has them."""
    torch.manual_seed(0)
    model = assemble(experiment, build_network(experiment))
    assert isinstance(model, GanModel)
    with torch.no_grad():
        for name, parameter in model.network.named_parameters():
            if name.endswith(("image.bias", "image.1.module.bias")):
                parameter.fill_(-0.4)
    return model


@pytest.fixture(scope="module", params=WORDS)
def model(request: pytest.FixtureRequest) -> GanModel:
    return model_of(tiny(request.param))


def assert_same(one: RangeImage, two: RangeImage) -> None:
    """Up to the rounding of other batch sizes."""
    assert (one.mask != two.mask).mean() < 0.002
    both = one.mask & two.mask
    np.testing.assert_allclose(one.range[both], two.range[both], rtol=1e-3)


# ---------------------------------------------------------------- generation


def test_a_scan_depends_on_seed_plus_index_only(model: GanModel):
    calls: list[int] = []
    images = model.generate(5, seed=3, batch_size=2, on_step=lambda: calls.append(1))
    assert len(images) == 5 and len(calls) == 5 * model.generation_steps()
    for i in (0, 4):
        for same in (model.generate(1, seed=3 + i)[0], next(model.stream(i + 1, seed=3, first=i))):
            np.testing.assert_array_equal(same.range, images[i].range)
    assert not np.allclose(images[0].range, images[1].range, atol=0.1)
    assert all(image.mask.mean() > 0.05 and not image.reflectance.any() for image in images)
    assert not model.experiment.data.reflectance


def test_rays_drop_by_one_noise_map_for_all_scans():
    model = model_of(tiny("dusty-v1"))
    uniform = torch.rand(1, 1, 32, 64, generator=torch.Generator().manual_seed(0))
    for seed in (0, 7):
        z = torch.randn(8, generator=torch.Generator().manual_seed(seed))[None]
        with torch.no_grad():
            out = model.network(z, torch.full((1, 1, 1, 1), 0.5))
        assert out.raydrop_logit is not None
        kept = (out.raydrop_logit + torch.log(uniform) - torch.log1p(-uniform) > 0)[0, 0].numpy()
        image = model.generate(1, seed=seed)[0]
        assert 0.2 < kept.mean() < 0.8 and not image.mask[~kept].any()
        depth = decode((out.image_orig[0, 0].clamp(-1, 1) + 1) / 2, model.sensor, "inverse").numpy()
        np.testing.assert_allclose(image.range, depth * kept, rtol=1e-5)


def test_what_a_gan_cannot_do_is_said(model: GanModel):
    with pytest.raises(ValueError, match="expected no steps, since a GAN takes one, found 32"):
        model.generate(1, steps=32)
    with pytest.raises(ValueError, match="expected no sampler, since a GAN has none, found 'ddpm'"):
        model.generate(1, sampler="ddpm")
    with pytest.raises(ValueError, match="expected n, steps and batch_size of at least 1, found 0"):
        model.generate(0)
    image = model.generate(1)[0]
    with pytest.raises(ValueError, match="expected a method of auto, inversion, w-plus, pivotal, found 'repaint'"):
        model.complete(image, method="repaint")
    with pytest.raises(ValueError, match="expected no sampler"):
        model.complete(image, sampler="ddim")
    with pytest.raises(ValueError, match=r"expected points within .*'s view, found none of \d+ points"):
        model.complete(image, np.zeros(image.shape, bool), steps=1)
    with pytest.raises(ValueError, match=r"data.codec: expected inverse or inverse-minmax for .*, found 'log'"):
        build_network(with_fields(model.experiment, {"data.codec": "log"}))
    assert len(model.generate(1, steps=1)) == 1, "one step is what it takes"


# ---------------------------------------------------------------- completion


def test_inversion_finds_its_own_image_again(model: GanModel):
    """Every second beam of a scan that the generator can make: the hidden ones come near."""
    torch.manual_seed(1)
    truth = model.generate(1, seed=11)[0]
    known = corrupt(truth, "beams:2", 0)
    before = truth.keep(known)
    calls: list[int] = []
    filled = model.complete(before, known, steps=20, on_step=lambda: calls.append(1))
    assert len(calls) == 20 == model.evaluations(steps=20) and model.evaluations() == 500
    np.testing.assert_array_equal(filled.range[known], truth.range[known])
    np.testing.assert_array_equal(filled.mask[known], truth.mask[known])
    assert not filled.reflectance.any()
    start = model.complete(before, known, steps=1)
    hidden = ~known & truth.mask & filled.mask & start.mask
    assert hidden.any()
    errors = [np.abs(1 / image.range[hidden] - 1 / truth.range[hidden]).mean() for image in (filled, start)]
    assert errors[0] < 0.8 * errors[1]
    again = model.complete(before, known, steps=1)
    np.testing.assert_array_equal(again.range, start.range)


def test_the_nearest_that_can_be_said_is_a_return():
    """Both limits count, as in the published program: outputs of 1 and more are min_range."""
    model = model_of(tiny("vanilla-gan"))
    near, far = model.sensor.min_range, model.sensor.max_range
    outputs = torch.tensor([1.0, 1.2, 0.0, 2.001 * near / far - 1, 1.999 * near / far - 1, -1.0])
    image = model._image(outputs.repeat(11)[:64].expand(1, 32, 64))
    np.testing.assert_allclose(image.range[0, :6], [near, near, 2 * near, far, 0, 0], rtol=1e-3)
    np.testing.assert_array_equal(image.range[0, :2], np.float32(near))


@pytest.mark.parametrize("method", ["w-plus", "pivotal"])
def test_more_of_an_inversion_is_free_to_move(method: str, model: GanModel):
    """A style per layer, or all weights of a copy: nearer to what is known than by one style alone."""
    truth = model.generate(1, seed=11)[0]
    known = corrupt(truth, "beams:2", 0)
    before, weights = truth.keep(known), {k: v.clone() for k, v in model.network.state_dict().items()}
    if model.network.angles is None and method == "w-plus":
        with pytest.raises(ValueError, match="expected w-plus of a network with styles"):
            model.complete(before, known, method=method)
        return
    calls: list[int] = []
    filled = model.complete(before, known, method=method, steps=8, on_step=lambda: calls.append(1))
    assert len(calls) == model.evaluations(method=method, steps=8) == (16 if method == "pivotal" else 8)
    np.testing.assert_array_equal(filled.range[known], truth.range[known])
    plain = model.complete(before, known, steps=8)
    assert (filled.range[~known] != plain.range[~known]).any()
    assert all(torch.equal(value, weights[key]) for key, value in model.network.state_dict().items())


def test_inversion_tells_which_rays_of_a_simulation_return():
    """DUSty's simulation-to-real: drop is drawn anew by each seed, about as often as the network drops."""
    model = model_of(tiny("dusty-v2"))
    height, width = model.sensor.height, model.sensor.width
    far = np.full((height, width), 6.0, np.float32)
    perfect = RangeImage(far, np.zeros_like(far), far > 0, model.sensor)
    small = RangeImage(far[:16], 0 * far[:16], far[:16] > 0, get_sensor("vlp-16").resized(width=width))
    kept = [model.returned(perfect, seed=seed, steps=3) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(kept[0], kept[1])
    assert (kept[0] != kept[2]).mean() > 0.05 and 0 < kept[0].mean() < 1
    with pytest.raises(ValueError, match="expected an image of"):
        model.returned(small)


def test_a_sparse_scan_becomes_an_image_of_the_model(model: GanModel):
    sensor = get_sensor("vlp-16").resized(width=64)
    wall = np.full((16, 64), 8.0, np.float32)
    scan = RangeImage(wall, 0 * wall, wall > 0, sensor).to_scan()
    dense = model.upsample(scan, "vlp-16", steps=2)
    assert dense.shape == (32, 64) and dense.mask.sum() > 200


def test_dusty_v2_renders_the_rays_of_any_sensor():
    model = model_of(tiny("dusty-v2"))
    same = model.into(model.sensor)
    np.testing.assert_array_equal(same.generate(1)[0].range, model.generate(1)[0].range)
    other = model.into(get_sensor("hdl-32e").resized(width=128))
    image = other.generate(1)[0]
    assert image.shape == (32, 128) and image.mask.any() and image.sensor.name == "hdl-32e"
    assert model.generate(1)[0].shape == (32, 64), "the model itself stays"
    with pytest.raises(ValueError, match="divisible by 16, at least 32, found 16 x 1024"):
        model.into("vlp-16")
    with pytest.raises(ValueError, match="only dusty-v2 renders any rays, found hdl-32e"):
        model_of(tiny("dusty-v1")).into("hdl-32e")


def test_rows_that_need_reflectance_are_not_computed(model: GanModel):
    images, sensor = model.generate(3), model.sensor
    real = [RangeImage(i.range, 0.5 * i.mask.astype(np.float32), i.mask, i.sensor) for i in images]
    sides = [Statistics(R2DM, sensor, "samples"), Statistics(R2DM, sensor, "real")]
    for statistics, scans in zip(sides, (images, real), strict=True):
        statistics.update(scans, [True] * 3, [True] * 3)
        for kind in ("rangenet", "pointnet"):
            statistics.add_features(kind, np.random.default_rng(0).random((3, 4)), [True] * 3)
    results = {result.name: result for result in results_of(*sides)}
    assert str(results["FRD"]) == "N/A" and "have no return with a reflectance" in results["FRD"].reason
    assert results["FPD"].value is not None and results["JSD x1e2"].value is not None
    pairs = Pairs(R2DM_UPSAMPLING)
    pairs.update([model.complete(real[0], steps=1)], [real[0]])
    assert not pairs.lit, "also where known pixels had a reflectance"


def test_it_saves_loads_and_is_described(model: GanModel, tmp_path: Path, capsys: pytest.CaptureFixture):
    save(tmp_path / "m", model.experiment, model.network)
    again = lidarsynth.load(tmp_path / "m")
    assert isinstance(again, GanModel) and again.experiment == model.experiment
    np.testing.assert_array_equal(again.generate(1)[0].range, model.generate(1)[0].range)
    main(["generate", "-n", "2", "--out", str(tmp_path / "out"), "--model", str(tmp_path / "m"), "--format", "npz"])
    assert (tmp_path / "out" / "000001.png").exists()
    scan = str(tmp_path / "out" / "000000.npz")
    target = str(tmp_path / "full.npz")
    words = ["complete", scan, "--out", target, "--corrupt", "beams:2", "--method", "inversion", "--steps", "3"]
    main([*words, "--model", str(tmp_path / "m"), "--no-picture"])
    said = capsys.readouterr().out
    assert "lidarsynth" in said and Path(target).exists()


@pytest.mark.parametrize(
    ("word", "generator", "discriminator"),
    [("vanilla-gan", 36_308_929, 2_821_057), ("dusty-v1", 36_309_954, 2_821_057), ("dusty-v2", 4_367_594, 38_445_569)],
)
def test_info_prints_the_published_counts(word: str, generator: int, discriminator: int):
    said = describe(word)
    assert f"{generator:,}\n" in said and f"{discriminator:,} parameters, in training only" in said
    assert "stem" not in said and "schedule" not in said and "range only" in said


def test_min_max_inverse_depth_ends_at_both_limits():
    sensor = get_sensor("hdl-64e-kitti")
    distance = torch.tensor([1.4500001, 2 / (1 / 1.45 + 1 / 80), 79.9999, 80.0], dtype=torch.float64)
    assert encode(distance, sensor, "inverse-minmax").tolist() == pytest.approx([1, 0.5, 0, 0], abs=1e-6)
    assert decode(torch.zeros(1), sensor, "inverse-minmax").item() == 0


# ---------------------------------------------------------------- official checkpoints


def parts(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}


def released(tensors: dict[str, Tensor], angle: Tensor | None = None) -> dict:
    """A checkpoint as the official programs save it, from a fixture; G differs from G_ema."""
    average = parts(tensors, "G_ema.")
    raw = {key: value + 1 if key.endswith("weight") else value for key, value in average.items()}
    angle = {} if angle is None else {"angle": angle}
    return {"step": 781_250, "G": raw, "D": parts(tensors, "D."), "G_ema": average, "optim_G": {}, **angle}


def angles(height: int, width: int) -> Tensor:
    elevation = torch.linspace(0.05, -0.4, height)
    azimuth = math.pi * (1 - 2 * (torch.arange(width) + 0.5) / width)
    return torch.stack(torch.meshgrid(elevation, azimuth, indexing="ij"))[None]


@pytest.mark.parametrize("word", WORDS)
@torch.no_grad()
def test_official_weights_say_what_the_reference_says(fixture_tensors, tmp_path: Path, word: str):
    expected = fixture_tensors({"vanilla-gan": "gan_vanilla_small", "dusty-v1": "gan_dusty_v1_small",
                                "dusty-v2": "gan_dusty_v2_small"}[word])  # fmt: skip
    angle = expected.get("angle", angles(*expected["eval.image"].shape[2:]))
    torch.save(released(expected, angle), tmp_path / "official.pth")
    experiment, network = read_official(tmp_path / "official.pth")
    out = network(expected["z"], expected.get("uniform"))
    assert_close(out.image, expected["eval.image"], **TOLERANCE)
    assert not network.training and experiment.model.network == word
    assert "step 781250" in experiment.card.history[0] and "NC-SA" in experiment.card.licence
    found = torch.from_numpy(build_sensor(experiment).ray_angles())
    assert_close(found[0], angle[0, 0], atol=1e-6, rtol=0)
    assert float(torch.sin(found[1] - angle[0, 1]).abs().max()) < 2 * math.pi / angle.shape[3], "within a pixel"
    raw = load_parts(tmp_path / "official.pth", ema=False)[1](expected["z"], expected.get("uniform")).image
    assert float((raw - out.image).abs().max()) > 1e-2
    assert describe(str(tmp_path / "official.pth")).startswith("official\n")
    save(tmp_path / "ours", experiment, network)
    again = load_parts(tmp_path / "ours")[1](expected["z"], expected.get("uniform"))
    assert torch.equal(again.image, out.image), "angles are saved too"


def test_the_released_angles_have_a_word(fixture_tensors, reference: Path, tmp_path: Path):
    table = json.loads((reference / "facts" / "gans_state_dict_shapes.json").read_text())["wacv23/vanilla.G"]
    state = {key: torch.zeros(()).expand(entry["shape"]) for key, entry in table.items()}  # a file of few bytes
    angle = fixture_tensors("gan_coords")["angle_64x512"]
    for name, moved, sensor in (("released", 0.0, "hdl-64e-dusty"), ("other", 1e-3, "other")):
        angle = angle + torch.tensor([moved, 0.0])[:, None, None]
        torch.save({"step": 1, "angle": angle, "G": state, "D": {}, "G_ema": state}, tmp_path / f"{name}.pth")
        assert build_sensor(read_official(tmp_path / f"{name}.pth")[0]).name == sensor


@pytest.mark.parametrize(
    ("name", "word"),
    [("gan_iros21_vanilla", "vanilla-gan"), ("gan_iros21_dusty1", "dusty-v1"), ("gan_iros21_dusty2", "dusty-v1")],
)
@torch.no_grad()
def test_the_first_release_is_read_too(fixture_tensors, tmp_path: Path, name: str, word: str):
    expected = fixture_tensors(name)
    torch.save(released(expected), tmp_path / "iros.pth")
    experiment, network = read_official(tmp_path / "iros.pth")
    out = network(expected["z"], torch.full((1, 1, 1, 1), 0.5))
    assert_close(out.image_orig, expected.get("eval.depth_orig", expected["eval.depth"]), **TOLERANCE)
    sensor = build_sensor(experiment)
    assert (experiment.model.network, experiment.data.codec) == (word, "inverse-minmax")
    assert (sensor.min_range, sensor.max_range, sensor.height, sensor.width) == (0.9, 120.0, 64, 128)
    model = assemble(experiment, network)
    image = model.generate(1)[0]
    assert image.range.max() < (62 if word == "vanilla-gan" else 120), "codes up to 0.008 are no returns"
    truth = image.keep(corrupt(image, "points:0.5", 0))
    assert model.complete(truth, steps=2).mask.sum() >= truth.mask.sum()


@torch.no_grad()
def test_dusty_ii_is_read_generated_and_kept(fixture_tensors, tmp_path: Path):
    expected = fixture_tensors("gan_iros21_dusty2")
    torch.save(released(expected), tmp_path / "dusty2.pth")
    model = lidarsynth.load(tmp_path / "dusty2.pth")
    assert isinstance(model, GanModel) and "official DUSty-II checkpoint" in model.experiment.card.history[0]
    assert "dusty-v1 with a mask of images (DUSty-II)" in describe(str(tmp_path / "dusty2.pth"))
    out = model.network(expected["z"], torch.full((1, 1, 1, 1), 0.5))
    assert_close(out.raydrop_logit, expected["eval.confidence"], **TOLERANCE)
    assert torch.equal(out.raydrop_mask, (out.raydrop_logit > 0).float())
    uniform = torch.rand(1, 1, 64, 128, generator=torch.Generator().manual_seed(0))
    z = torch.randn(16, generator=torch.Generator().manual_seed(4))[None]
    logit = model.network(z, uniform).raydrop_logit[0].numpy()
    kept = (logit[0] + (torch.log(uniform) - torch.log1p(-uniform))[0, 0].numpy() > 0) & (logit[1] > 0)
    (image,) = model.generate(1, seed=4)
    assert 0.05 < kept.mean() < 0.95 and not image.mask[~kept].any() and image.mask[kept].all()
    save(tmp_path / "own", model.experiment, model.network)
    np.testing.assert_array_equal(lidarsynth.load(tmp_path / "own").generate(1, seed=4)[0].range, image.range)
    with pytest.raises(ValueError, match=r"adversarial.image_mask: expected false for vanilla-gan, .*, found true"):
        build_network(tiny("vanilla-gan", **{"adversarial.image_mask": True}))


@pytest.mark.parametrize(("official", "word"), [("vanilla", "vanilla-gan"), ("dusty_v2", "dusty-v2")])
def test_the_published_sizes_are_read(reference: Path, tmp_path: Path, official: str, word: str):
    table = json.loads((reference / "facts" / "gans_state_dict_shapes.json").read_text())
    entries = table[f"wacv23/{official}.G"].items()
    state = {key: torch.zeros(()).expand(entry["shape"]) for key, entry in entries}  # a file of few bytes
    checkpoint = {"step": 1, "angle": angles(64, 512), "G": state, "D": {}, "G_ema": state, "A": {}}
    torch.save(checkpoint, tmp_path / "full.pth")
    experiment, _ = read_official(tmp_path / "full.pth")
    ours = preset(word)
    assert (experiment.model, experiment.adversarial) == (ours.model, ours.adversarial)
    kept = [f.name for f in fields(ours.data) if f.name != "sensor"]
    assert [getattr(experiment.data, name) for name in kept] == [getattr(ours.data, name) for name in kept]


@pytest.fixture
def omegaconf(monkeypatch: pytest.MonkeyPatch):
    """The classes of OmegaConf as its pickles name them, with a constructor that must not run again."""
    kinds = {}
    monkeypatch.setitem(sys.modules, "omegaconf", types.ModuleType("omegaconf"))
    for name in ("dictconfig.DictConfig", "nodes.AnyNode", "base.Metadata", "base.ContainerMetadata"):
        home, _, word = name.partition(".")
        module = types.ModuleType(f"omegaconf.{home}")
        kinds[word] = type(word, (), {"__module__": f"omegaconf.{home}"})
        module = sys.modules.get(module.__name__, module)
        setattr(module, word, kinds[word])
        monkeypatch.setitem(sys.modules, module.__name__, module)
    return kinds


def test_a_pickled_configuration_is_read_without_its_package(fixture_tensors, tmp_path: Path, monkeypatch, omegaconf):
    from collections import defaultdict
    from typing import Any

    tensors = fixture_tensors("gan_vanilla_small")
    config, node = omegaconf["DictConfig"](), omegaconf["AnyNode"]()
    node.__dict__ |= {"_val": 64, "_parent": config}
    metadata = omegaconf["ContainerMetadata"]()
    metadata.__dict__ |= {"ref_type": Any, "object_type": dict, "resolver_cache": defaultdict(dict), "key": None}
    config.__dict__ |= {"_metadata": metadata, "_content": {"ch_base": node}}
    height, width = tensors["eval.image"].shape[2:]
    torch.save({"cfg": config, **released(tensors, angles(height, width))}, tmp_path / "official.pth")
    for name in [name for name in sys.modules if name.startswith("omegaconf")]:
        monkeypatch.delitem(sys.modules, name)
    assert read_official(tmp_path / "official.pth")[0].model.network == "vanilla-gan"
    assert not [name for name in sys.modules if name.startswith("omegaconf")]


class Foreign:
    """Something that no file may bring."""


def changed(checkpoint: dict, key: str, value: Tensor | None) -> dict:
    """The checkpoint with one tensor of G_ema replaced or, for None, gone."""
    state = {k: v for k, v in checkpoint["G_ema"].items() if k != key}
    return {**checkpoint, "G_ema": state if value is None else {**state, key: value}}


def test_other_files_are_named(fixture_tensors, tmp_path: Path):
    tensors = fixture_tensors("gan_dusty_v1_small")
    height, width = tensors["eval.image"].shape[2:]
    good = released(tensors, angles(height, width))
    first, second = "synthesis_network.0.1.module.weight", "synthesis_network.1.1.module.weight"
    third = "backbone.4.heads.confidence.1.module.bias"
    cases = {
        "no angle": ({**good, "angle": None}, r"expected angle \(1, 2, H, W\) beside G, found NoneType"),
        "size": ({**good, "angle": angles(height, 2 * width)}, r"of the size of angle \(\d+, \d+\), found"),
        "upside down": ({**good, "angle": -good["angle"]}, "elevations that fall from row to row"),
        "width": (changed(good, second, torch.zeros(2, 2, 4, 4)), rf"G_ema: expected generator.{second} .* found"),
        "truncated": (
            changed(good, second, None),
            rf"expected generator.{second} .*, found none; 1 tensors do not fit",
        ),
        "headless": (changed(good, first, None), f"expected a generator with {first} of 4 dimensions, found"),
        "no tensors": ({**good, "G_ema": [1]}, "expected G_ema with tensors by name, found list"),
        "three masks": (
            changed(released(fixture_tensors("gan_iros21_dusty2")), third, torch.zeros(3)),
            r"1 ray-drop logit per pixel \(DUSty-I\) or 2 \(DUSty-II\), found \(3,\)",
        ),
        "foreign": ({**good, "cfg": Foreign()}, "found a damaged or unsafe file .*Foreign"),
    }
    for name, (checkpoint, message) in cases.items():
        path = tmp_path / f"{name}.pth"
        torch.save(checkpoint, path)
        with pytest.raises(ValueError, match=message) as caught:
            read_official(path)
        assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)
    torch.save(good, tmp_path / "good.pth")
    content = (tmp_path / "good.pth").read_bytes()
    (tmp_path / "cut.pth").write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"cut.pth: expected .*dusty-v2.*, found a truncated file"):
        read_official(tmp_path / "cut.pth")
