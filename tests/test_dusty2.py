"""DUSty v2: official weights, official sizes, any ray angles, the ring, and coordinate augmentation."""

import json
import math

import pytest
import torch
from oracle import assert_close
from test_gan import TOLERANCE, check_discriminator, check_structure, load

from lidarsynth.networks.gan.dusty2 import Discriminator, Generator, unshift
from lidarsynth.networks.gan.modulated import RandomFourierFeatures, circle, resize_angles

SMALL, FULL = "gan_dusty_v2_small", "gan_dusty_v2_full"


def generator(reference, name: str, tensors) -> Generator:
    facts = json.loads((reference / "fixtures" / f"{name}.json").read_text())
    mapping, config = (facts["config"]["generator"][f"{part}_kwargs"] for part in ("mapping", "synthesis"))
    resolution, widths = tuple(config["resolution"]), (config["ch_base"], config["ch_max"])
    net = Generator(resolution, mapping["in_ch"], mapping["out_ch"], *widths)
    return load(net, "G", facts, tensors)


def discriminator(reference, name: str, tensors) -> Discriminator:
    facts = json.loads((reference / "fixtures" / f"{name}.json").read_text())
    config = facts["config"]["discriminator"]["layer_kwargs"]
    net = Discriminator(tuple(config["resolution"]), config["ch_base"], config["ch_max"])
    return load(net, "D", facts, tensors)


@pytest.mark.parametrize("name", [SMALL, FULL])
def test_images_and_their_gradient_equal_the_reference(reference, fixture_tensors, name):
    expected = fixture_tensors(name)
    net = generator(reference, name, expected)
    angle, uniform, z = expected["angle"], expected["uniform"], expected["z"].requires_grad_()
    out = net(z, angle, uniform)
    for key in ("image", "image_orig", "raydrop_logit", "w"):
        assert_close(getattr(out, key).detach(), expected[f"eval.{key}"], **TOLERANCE)
    assert torch.equal(out.raydrop_mask.detach(), expected["eval.raydrop_mask"].float())
    (grad,) = torch.autograd.grad((out.image * expected["cotangent"]).sum(), z)
    assert (grad - expected["grad_z"]).abs().max() < 1e-3 * expected["grad_z"].abs().max()
    with torch.no_grad():
        truncated = net(expected["z"][:1], angle, uniform[:1], psi=0.7).image_orig
    assert_close(truncated, expected["trunc0.7.image_orig"], **TOLERANCE)


def test_other_angles_and_a_style_per_layer_equal_the_reference(reference, fixture_tensors):
    expected = fixture_tensors(SMALL)
    net = generator(reference, SMALL, expected)
    uniform = expected["uniform"][:1]
    with torch.no_grad():
        custom = net(expected["z"][:1], expected["angle_custom"], uniform)
        wplus = net.synthesize(expected["wplus"], expected["angle"], uniform)
    assert_close(custom.image_orig, expected["custom_angle.image_orig"], **TOLERANCE)
    assert_close(wplus.image_orig, expected["wplus.image_orig"], **TOLERANCE)


def test_every_block_equals_the_reference(reference, fixture_tensors):
    expected = fixture_tensors(SMALL)
    network = generator(reference, SMALL, expected).synthesis_network
    levels = network.pyramid(expected["angle"])
    w = expected["eval.w"][:1]
    h, maps = None, {}
    for i in range(4):
        angles = expected[f"inter.angle_multiscale.{i}"]
        assert_close(levels[i], angles, **TOLERANCE)
        with torch.no_grad():
            h, maps = network.layers[i](h, maps, angles, [w] * (2 if i == 0 else 3))
        feature = expected[f"inter.block{i}.feature"]
        assert_close(h[:, : feature.shape[1]], feature, **TOLERANCE)
        assert_close(maps["image"], expected[f"inter.block{i}.skip_image"], **TOLERANCE)
    fourier = network.layers[0].pe(expected["inter.angle_multiscale.0"])
    assert_close(fourier[:, ::16], expected["inter.fourier.block0"], **TOLERANCE)


def test_a_training_step_and_its_running_means_equal_the_reference(reference, fixture_tensors):
    expected = fixture_tensors(SMALL)
    net = generator(reference, SMALL, expected).train()
    with torch.no_grad():
        out = net(expected["z"], expected["angle"], expected["uniform"], shift=expected["train.shift_unit"])
    assert_close(out.image_orig, expected["train.image_orig"], **TOLERANCE)
    assert_close(out.raydrop_logit, expected["train.raydrop_logit"], **TOLERANCE)
    assert_close(net.w_avg, expected["train.w_avg_after"], **TOLERANCE)
    after = {key: value for key, value in expected.items() if key.startswith("train.after.")}
    assert len(after) == 19
    for key, value in after.items():
        assert_close(net.get_buffer(key.removeprefix("train.after.")), value, **TOLERANCE)


@pytest.mark.parametrize("name", [SMALL, FULL])
def test_discriminator_and_losses_equal_the_reference(reference, fixture_tensors, name):
    expected = fixture_tensors(name)
    check_discriminator(discriminator(reference, name, expected), expected)


def test_names_shapes_and_counts_are_the_official_ones(reference):
    with torch.device("meta"):
        nets = {"G": Generator(), "D": Discriminator()}
    check_structure(reference, "dusty_v2", nets, {"G": 4_367_594, "D": 38_445_569})


@pytest.mark.parametrize(("size", "count"), [((64, 512), 4), ((32, 128), 3), ((128, 256), 5), ((256, 64), 4)])
def test_the_discriminator_halves_an_image_until_it_is_four_pixels_high(size, count):
    net, maps = Discriminator(size, 2, 8), []  # as wide at the third halving as at the fourth: 2, 4, 8, 8, 8, 8
    net.epilogue[0].register_forward_hook(lambda module, inputs, output: maps.append(output.shape))
    assert net(torch.randn(4, 1, *size)).shape == (4, 1)
    assert maps == [(4, 9, size[0] >> count, size[1] >> count)] and min(maps[0][2:]) == 4
    blocks = {key.split(".")[1] for key in net.state_dict() if ".skip.0." in key}
    assert blocks == {str(3 + i) for i in range(count)}, "names go on as in the official file"
    shapes = {key: tuple(value.shape) for key, value in net.state_dict().items() if key.startswith("epilogue")}
    pixels = (size[0] >> count) * (size[1] >> count)
    assert shapes["epilogue.1.1.module.weight"] == (8, 9, 3, 3)
    assert shapes["epilogue.4.module.weight"] == (8, 8 * pixels)


def test_the_last_layers_of_the_discriminator_are_as_wide_as_after_four_halvings():
    for size, before in (((32, 128), 8), ((64, 128), 16), ((128, 128), 32)):
        net = Discriminator(size, 1, 64)
        assert net.get_parameter("epilogue.1.1.module.weight").shape == (16, before + 1, 3, 3)
        assert net(torch.randn(2, 1, *size)).isfinite().all()
    odd = Discriminator((48, 176), 1, 8)  # sizes that are no power of 2: at least 4, less than 8 pixels high
    assert len([key for key in odd.state_dict() if ".skip.0." in key]) == 3
    assert odd(torch.randn(2, 1, 48, 176)).shape == (2, 1)


def regular_angles(height: int, width: int) -> torch.Tensor:
    elevation = torch.linspace(0.05, -0.4, height)
    azimuth = math.pi * (1 - 2 * (torch.arange(width) + 0.5) / width)
    return torch.stack(torch.meshgrid(elevation, azimuth, indexing="ij"))[None]


def small_generator() -> Generator:
    return Generator((32, 64), 8, 8, 2, 8).eval().requires_grad_(False)


def test_turning_the_angles_turns_the_image():
    net, angles, w = small_generator(), regular_angles(32, 64), torch.randn(1, 8)
    image = net.synthesize(w, angles, torch.full((1, 1, 1, 1), 0.5)).image_orig
    turned = net.synthesize(w, angles.roll(16, 3), torch.full((1, 1, 1, 1), 0.5)).image_orig
    assert image.std() > 0.01
    assert_close(turned, image.roll(16, 3), atol=1e-4, rtol=1e-4)


def test_coordinate_augmentation_undoes_its_own_turn():
    net, angles, w = small_generator(), regular_angles(32, 64), torch.randn(2, 8)
    uniform = torch.full((1, 1, 1, 1), 0.5)
    plain = net.synthesize(w, angles, uniform).image_orig
    shifted = net.synthesize(w, angles, uniform, shift=torch.tensor([0.25, 0.5])).image_orig
    # the last column of a turn by W pixels would read beyond the doubled image; a quarter and a half do not
    assert_close(shifted, plain, atol=2e-4, rtol=1e-3)
    x = torch.randn(2, 1, 4, 8)
    assert_close(unshift(x, torch.tensor([0.25, 0.5])), torch.stack([x[0].roll(-2, 2), x[1].roll(-4, 2)]))


@pytest.mark.parametrize("training", [False, True])
def test_features_shared_by_the_batch_give_what_every_sample_s_own_would(training):
    shift, z, uniform = torch.tensor([0.0, 0.3, 0.77]), torch.randn(3, 8), torch.rand(3, 1, 32, 64)
    angles, results, variances = regular_angles(32, 64), [], []
    for given in (angles, angles.expand(3, -1, -1, -1)):
        torch.manual_seed(0)
        net = small_generator().train(training)
        results.append(net(z, given, uniform, shift=shift).image_orig)
        variances.append(net.synthesis_network.layers[1].conv1.ema_var)
    assert results[0].std() > 0.01
    assert_close(results[0], results[1], atol=1e-4, rtol=1e-4)
    assert_close(variances[0], variances[1])
    assert (variances[0] != 1) == training


def test_any_resolution_is_rendered_and_bad_sizes_are_named():
    net = small_generator()
    out = net(torch.randn(2, 8), regular_angles(48, 80), torch.rand(2, 1, 48, 80))
    assert out.image.shape == (2, 1, 48, 80)
    with pytest.raises(ValueError, match=r"multiples of 16, .* got \(40, 64\)"):
        net(torch.randn(1, 8), regular_angles(40, 64), torch.rand(1, 1, 40, 64))
    with pytest.raises(ValueError, match=r"w must hold 10 styles, got \(1, 3, 8\)"):
        net.synthesize(torch.randn(1, 3, 8), regular_angles(32, 64), torch.rand(1, 1, 32, 64))


def test_fourier_features_close_on_the_ring_in_the_bands_of_the_paper():
    for resolution, band, highest in [((4, 32), 16, 8), ((64, 512), 256, 128)]:
        features = RandomFourierFeatures(resolution, count=4096)
        elevation, azimuth = features.freqs[:, 0], features.freqs[:, 1]
        assert 0.9 * band < elevation.abs().max() <= band
        powers = {2.0**i for i in range(int(math.log2(highest)) + 1)}
        assert set(azimuth.unique().tolist()) == powers | {-p for p in powers} | {0.0}
        assert features.phase.min() >= 0 and features.phase.max() < 2 * math.pi
    angles = regular_angles(4, 32).double()
    turn = angles + torch.tensor([0, 2 * math.pi]).view(1, 2, 1, 1)
    features = RandomFourierFeatures((4, 32))
    assert_close(features(turn), features(angles), atol=2e-5, rtol=0)


def test_angle_tables_resize_as_the_reference(fixture_tensors):
    expected = fixture_tensors("gan_coords")
    rows, columns = expected["table_elevation_64"], expected["table_azimuth_2048"]
    table = torch.stack(torch.meshgrid(rows, columns, indexing="ij"))[None]
    assert_close(resize_angles(table, (64, 512)), expected["angle_64x512"], atol=1e-5, rtol=0)
    assert_close(resize_angles(table, (64, 2048))[:, :, 0], expected["angle_64x2048_row0"], atol=1e-5, rtol=0)
    assert_close(circle(table)[:, 2:].square().sum(1), torch.ones(1, 64, 2048))
