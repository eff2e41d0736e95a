"""What a LidarModel does: generate, complete, upsample; measured pixels come back as they were."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from networks import trained

import lidarsynth
from lidarsynth.diffusion.samplers import STEPS
from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import Experiment, with_fields
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.lidar.depth import from_x_0
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import get_sensor
from lidarsynth.systems.diffusion.model import LidarModel
from lidarsynth.systems.known_pixels import sparse_image
from lidarsynth.systems.table import assemble


def model_of(experiment: Experiment) -> LidarModel:
    return assemble(experiment, trained(experiment))


@pytest.fixture(scope="module")
def model() -> LidarModel:
    """It can be told the known pixels."""
    return model_of(preset("tiny"))


@pytest.fixture(scope="module")
def unconditional() -> LidarModel:
    return model_of(with_fields(preset("tiny"), {"model.network": "efficient-unet", "diffusion.kind": "eps"}))


@pytest.fixture
def image(model) -> RangeImage:
    """A wall 10 to 30 m around with drop-outs, from points, so that it has them."""
    rng = np.random.default_rng(0)
    shape = model.sensor.height, model.sensor.width
    distance = rng.uniform(10, 30, shape).astype(np.float32) * (rng.random(shape) < 0.9)
    reflectance = (rng.uniform(0.1, 0.9, shape) * (distance > 0)).astype(np.float32)
    wall = RangeImage(distance, reflectance, distance > 0, model.sensor)
    return project(wall.to_scan(), model.sensor, "unfolding")


def assert_same(one: RangeImage, two: RangeImage) -> None:
    """Up to the rounding of other batch sizes, which may flip single pixels at the edge of validity."""
    both = one.mask & two.mask
    assert (one.mask != two.mask).mean() < 0.002
    np.testing.assert_allclose(one.range[both], two.range[both], rtol=1e-3)
    np.testing.assert_allclose(one.reflectance[both], two.reflectance[both], atol=1e-3)


# ---------------------------------------------------------------- generation


def test_the_public_way_in_loads_official_weights_and_samples_as_the_reference(reference, fixture_tensors):
    """R2DM's evaluation from end to end: file, per-sample seeds 0 and 1, DDPM, clamp, metres."""
    expected = fixture_tensors("r2dm/tiny_H_trajectories")["ddpm.states"][-1]
    model = lidarsynth.load(reference / "fixtures" / "r2dm" / "tiny_H.pth")
    assert isinstance(model, lidarsynth.LidarModel) and not model.conditional
    images = model.generate(2, steps=3, seed=0, sampler="ddpm")
    for image, x_0 in zip(images, expected, strict=True):
        reference = from_x_0(x_0.nan_to_num(-1), model.sensor)
        agree, kept = image.mask == reference.mask, ~x_0.isnan().any(0).numpy()
        close = np.isclose(image.range, reference.range, rtol=1e-3, atol=1e-3)
        close &= np.isclose(image.reflectance, reference.reflectance, atol=1e-3)
        close, agree = close[kept], agree[kept]
        assert agree.mean() > 0.999
        assert close.mean() > 0.995, "t = 1 amplifies rounding in a few pixels"


@pytest.mark.parametrize("sampler", STEPS)
def test_generated_images_are_sound_and_progress_is_told(model, sampler):
    calls = []
    (image,) = model.generate(1, steps=3, sampler=sampler, on_step=lambda: calls.append(1))
    assert len(calls) == 3
    assert image.sensor == model.sensor and image.shape == (16, 64)
    assert image.range.dtype == image.reflectance.dtype == np.float32 and image.mask.dtype == bool
    assert 0 < image.mask.mean() <= 1
    seen = image.range[image.mask]
    assert seen.min() > 1.45 and seen.max() < 80
    assert not image.range[~image.mask].any() and not image.reflectance[~image.mask].any()
    assert image.reflectance.min() >= 0 and image.reflectance.max() <= 1
    assert len(image.to_scan()) == image.mask.sum()


def test_scan_i_depends_on_seed_and_i_only(model):
    alone = model.generate(3, steps=2, seed=5, batch_size=1)
    for other in (model.generate(3, steps=2, seed=5, batch_size=2), model.generate(3, steps=2, seed=5)):
        for one, two in zip(alone, other, strict=True):
            np.testing.assert_array_equal(one.range, two.range, "bit by bit, on a CPU for any batch size")
            np.testing.assert_array_equal(one.reflectance, two.reflectance)
    for one, two in zip(alone[1:], model.stream(3, steps=2, seed=5, first=1), strict=True):
        np.testing.assert_array_equal(one.range, two.range)
    np.testing.assert_array_equal(alone[2].range, model.generate(1, steps=2, seed=7, batch_size=1)[0].range)
    assert (alone[0].range != alone[1].range).mean() > 0.1


def test_streams_hold_one_batch(model):
    calls = []
    stream = model.stream(100, steps=2, batch_size=2, on_step=lambda: calls.append(1))
    next(stream), next(stream)
    assert len(calls) == 4, "one scan at a time on a CPU"
    next(stream)
    assert len(calls) == 6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n": 0}, "expected n, steps and batch_size of at least 1, found 0, 32, 4"),
        ({"steps": 0}, "of at least 1, found 1, 0, 4"),
        ({"batch_size": -1}, "of at least 1, found 1, 32, -1"),
        ({"sampler": "euler"}, "of ddpm, ddim, dpmpp-2m, sde-dpmpp-2m, heun, langevin, found 'euler'"),
    ],
)
def test_generation_refuses_what_it_cannot_do(model, options, message):
    with pytest.raises(ValueError, match=message):
        model.generate(**options)


# ---------------------------------------------------------------- completion


def assert_known_is_kept(result: RangeImage, truth: RangeImage, known: np.ndarray) -> None:
    np.testing.assert_array_equal(result.range[known], truth.range[known])
    np.testing.assert_array_equal(result.mask[known], truth.mask[known])
    np.testing.assert_array_equal(result.reflectance[known], truth.reflectance[known])
    measured = known & truth.mask
    np.testing.assert_array_equal(result.points()[measured], truth.points()[measured])


@pytest.mark.parametrize("recipe", ["beams:4", "points:0.1", "sector:90", "region:5:20:-5:5"])
@pytest.mark.parametrize("method", ["conditional", "repaint"])
def test_known_pixels_come_back_bit_by_bit(model, image, recipe, method):
    known = corrupt(image, recipe)
    steps = {"conditional": 2, "repaint": 2}[method]
    result = model.complete(image.keep(known), known, method, steps=steps, resamples=2 if method == "repaint" else None)
    assert_known_is_kept(result, image, known)
    hidden = ~known
    assert result.mask[hidden].any() and len(np.unique(result.range[hidden])) > 1
    np.testing.assert_allclose(
        np.linalg.norm(result.to_scan().xyz, axis=1), result.range[result.mask], rtol=1e-4, atol=1e-4
    )


def test_unconditional_models_complete_too(unconditional, image):
    known = corrupt(image, "beams:4")
    assert not unconditional.conditional
    result = unconditional.complete(image.keep(known), known, steps=3, resamples=2)
    assert_known_is_kept(result, image, known)
    with pytest.raises(ValueError, match=r"tiny: expected method repaint or posterior, .*, found conditional"):
        unconditional.complete(image, known, method="conditional")


def test_mixed_pixels_are_mended_if_the_experiment_says_so(model, image):
    """A network that hardly learned interpolates: beside an empty row its ranges lie between a surface and nothing."""
    known = np.zeros(image.shape, bool)
    known[::4] = True
    wall = replace(image, range=np.full(image.shape, 20, np.float32), mask=np.ones(image.shape, bool))
    empty = np.zeros(image.shape, bool)
    empty[4] = True
    truth = replace(wall, range=np.where(empty, 0, wall.range), mask=~empty, xyz=None)
    plain = replace(model, experiment=with_fields(model.experiment, {"data.mend": False}))
    mixed, mended = (m.complete(truth.keep(known), known, "conditional", 1) for m in (plain, model))
    between = [int(((m.range > 0) & (m.range < 12)).sum()) for m in (mixed, mended)]
    assert between[1] < between[0], "beside nothing, ranges are those of the wall"
    np.testing.assert_array_equal(mixed.range[known], mended.range[known])


def test_what_was_not_measured_is_filled_by_default(model, image):
    scan = image.to_scan()
    result = model.complete(scan, steps=2)
    assert_known_is_kept(result, model.image_of(scan), image.mask)
    assert result.mask[~image.mask].any()
    np.testing.assert_array_equal(result.range, model.complete(image, image.mask, steps=2).range)
    nothing = model.complete(image, np.ones_like(image.mask), steps=2)
    np.testing.assert_array_equal(nothing.mask, image.mask, "an empty pixel that is known stays empty")


def test_completion_hears_the_known_pixels(model, image):
    known = corrupt(image, "beams:4")
    nearer = replace(image, range=image.range * np.float32(0.5), xyz=None)
    results = [model.complete(i.keep(known), known, steps=2) for i in (image, nearer)]
    assert (results[0].range[~known] != results[1].range[~known]).mean() > 0.1


def test_completion_does_not_see_the_hidden_pixels(model, image):
    known = corrupt(image, "beams:4")
    for method in ("conditional", "repaint"):
        seen, hidden = (model.complete(i, known, method, steps=2) for i in (image, image.keep(known)))
        np.testing.assert_array_equal(seen.range, hidden.range)


def test_a_scan_without_reflectance_gets_one(model, image):
    blind = replace(image, reflectance=np.zeros_like(image.reflectance))
    result = model.complete(blind, steps=2)
    np.testing.assert_array_equal(result.range[image.mask], image.range[image.mask])
    assert result.reflectance[image.mask].any()
    assert not result.reflectance[~result.mask].any()


def test_the_same_seed_completes_the_same(model, image):
    known = corrupt(image, "points:0.1")
    one, two, other = (model.complete(image, known, "repaint", 2, 2, seed=seed).range for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, two)
    assert (one != other).any()


@pytest.mark.parametrize(("method", "steps", "resamples"), [("conditional", 3, None), ("repaint", 3, 4)])
def test_evaluations_are_foretold(model, image, method, steps, resamples):
    calls = []
    model.complete(image, None, method, steps, resamples, on_step=lambda: calls.append(1))
    assert len(calls) == model.evaluations(method, steps, resamples)
    assert model.evaluations("repaint") == 311, "R2DM's 32 steps x 10"
    assert model.evaluations() == model.evaluations("conditional") == 1


def test_completion_refuses_what_does_not_fit(model, image):
    with pytest.raises(ValueError, match=r"known must be \(16, 64\) bool, got \(64, 16\) bool"):
        model.complete(image, image.mask.T)
    with pytest.raises(ValueError, match=r"known must be \(16, 64\) bool, got \(16, 64\) float32"):
        model.complete(image, image.range)
    with pytest.raises(ValueError, match="expected a method of auto, conditional, repaint, posterior, found 'inpaint'"):
        model.complete(image, method="inpaint")
    with pytest.raises(ValueError, match=r"expected a sampler of .* found 'euler'"):
        model.complete(image, sampler="euler")
    sensor = get_sensor("vlp-16")
    empty = np.zeros((16, 1024), np.float32)
    with pytest.raises(ValueError, match=r"expected an image of 16 x 64, found \(16, 1024\)"):
        model.complete(RangeImage(empty, empty, empty > 0, sensor))
    for method in ("conditional", "repaint"):
        with pytest.raises(ValueError, match=r"steps.* at least 1"):
            model.complete(image, method=method, steps=0)


# ---------------------------------------------------------------- upsampling


@pytest.fixture
def sparse(model) -> Scan:
    """A VLP-16 in a round room of 15 m, with the lower half of the turn to its right empty."""
    sensor = get_sensor("vlp-16").resized(width=512)
    distance = np.full((16, 512), 15, np.float32)
    distance[8:, 256:] = 0
    return RangeImage(distance, (distance > 0) * np.float32(0.3), distance > 0, sensor).to_scan()


def test_sparse_images_know_what_the_other_sensor_looked_at(model, sparse):
    sensor = get_sensor("vlp-16")
    image, known = sparse_image(sparse, sensor, model.sensor)
    np.testing.assert_array_equal(image.mask & ~known, False)
    assert image.mask.any() and not image.mask.all()
    rows = np.flatnonzero(known.any(axis=1))
    elevations = np.array(model.sensor.elevations)[rows]
    gaps = np.abs(np.subtract.outer(elevations, np.array(sensor.elevations))).min(axis=1)
    assert gaps.max() <= 2.0, "rows far from every beam are to be filled"
    empty = known & ~image.mask
    azimuth = model.sensor.ray_angles()[1][empty]
    assert empty.any() and (azimuth < 0.1).all(), "only the empty half was looked at in vain"


def test_upsampling_keeps_what_was_measured_and_fills_the_rest(model, sparse):
    image, known = sparse_image(sparse, get_sensor("vlp-16"), model.sensor)
    result = model.upsample(sparse, "vlp-16", steps=2)
    assert result.sensor == model.sensor
    assert_known_is_kept(result, image, known)
    assert result.mask[~known].any()
    np.testing.assert_array_equal(result.range, model.upsample(sparse, get_sensor("vlp-16"), steps=2).range)


def test_upsampling_recognises_the_sensor_by_its_rings(model, sparse):
    recognised = model.upsample(sparse, steps=2)
    np.testing.assert_array_equal(recognised.range, model.upsample(sparse, "vlp-16", steps=2).range)


def test_upsampling_refuses_scans_it_cannot_place(model, sparse):
    above = replace(sparse, xyz=np.abs(sparse.xyz) * [0.1, 0.1, 30])
    with pytest.raises(ValueError, match="expected points within hdl-64e-kitti/16's view, found none of"):
        model.upsample(above, "vlp-16")
    rng = np.random.default_rng(0)
    cloud = Scan(rng.normal(size=(500, 3)).astype(np.float32) * 20, np.zeros(500, np.float32))
    with pytest.raises(ValueError, match="--from"):
        model.upsample(cloud)
    with pytest.raises(ValueError, match=r"expected a sensor of .* found 'vlp16'"):
        model.upsample(sparse, "vlp16")


# ---------------------------------------------------------------- the object


def test_a_model_shows_what_it_is_made_of(model):
    assert [f.name for f in fields(model)] == ["network", "denoiser", "sensor", "experiment"]
    x_t, log_snr = torch.randn(2, 2, 16, 64, generator=torch.Generator().manual_seed(0)), torch.tensor([3.0, -3.0])
    with torch.no_grad():
        assert model.network(x_t, log_snr).shape == (2, 2, 16, 64)
        x_0_hat = model.denoiser(x_t, torch.tensor([0.3, 0.7]))
    assert x_0_hat.abs().max() <= 1
    assert model.to("cpu") is model and not model.network.training
