"""The conditional network: what it adds to the U-Net it wraps."""

import pytest
import torch

from lidarsynth.networks.conditional import ConditionalUNet
from lidarsynth.networks.efficient_unet import EfficientUNet
from lidarsynth.networks.interpolation import fill_in, interpolate


@pytest.fixture
def net() -> ConditionalUNet:
    torch.manual_seed(0)
    unet = EfficientUNet(8, 2, (16, 64), 8, None, (1, 1, 2, 2), (1, 1, 1, 1), stem=(2, 4))
    return ConditionalUNet(unet).eval().requires_grad_(False)


@pytest.fixture
def case() -> dict:
    generator = torch.Generator().manual_seed(1)
    x_t, known = torch.randn(2, 3, 2, 16, 64, generator=generator)
    mask = torch.zeros(3, 2, 16, 64)
    mask[0, :, ::4] = 1  # sample 0: every fourth beam; sample 1: range only; sample 2: nothing
    mask[1, 0] = torch.rand(16, 64, generator=generator) < 0.1
    return {"x_t": x_t, "log_snr": torch.tensor([1.0, -2.0, 5.0]), "known": known, "mask": mask}


def randomised(net: ConditionalUNet) -> ConditionalUNet:
    for parameter in net.parameters():
        parameter.add_(torch.randn(parameter.shape) * 0.1)
    return net


def test_an_untrained_network_returns_the_interpolation(net, case):
    torch.testing.assert_close(net(**case), fill_in(case["known"], case["mask"]))
    torch.testing.assert_close(net(case["x_t"], case["log_snr"]), torch.zeros(3, 2, 16, 64))


@pytest.fixture
def chooser() -> ConditionalUNet:
    torch.manual_seed(0)
    unet = EfficientUNet(8, 14, (16, 64), 8, None, (1, 1, 2, 2), (1, 1, 1, 1), stem=(2, 4))
    return ConditionalUNet(unet).eval().requires_grad_(False)


def test_candidates_replace_the_interpolation_where_the_network_says_so(chooser, case):
    untrained = chooser(**case)
    fill = fill_in(case["known"], case["mask"])
    inside = slice(5, 8)  # between known rows 4 and 8: two beams and "nothing returned" compete with the interpolation
    above, below = case["known"][0, :, 4], case["known"][0, :, 8]
    prior = torch.tensor([3.0, 0.0, 0.0, 0.0]).softmax(0)
    for row in range(inside.start, inside.stop):
        expected = prior[0] * fill[0, :, row] + prior[1] * above + prior[2] * below - prior[3]
        torch.testing.assert_close(untrained[0, :, row], expected)
    out = chooser.unet.out_conv
    bias = next(value for name, value in out.named_parameters() if name.endswith("bias")).view(14, 8)
    for word, expected in ((3, above), (4, below), (5, torch.full_like(above, -1))):
        bias.zero_()
        bias[2 + 2 * word : 4 + 2 * word] = 100.0
        torch.testing.assert_close(chooser(**case)[0, :, 6], expected)


def test_the_nearest_in_any_direction_is_a_seventh_candidate(case):
    torch.manual_seed(0)
    unet = EfficientUNet(8, 16, (16, 64), 8, None, (1, 1, 2, 2), (1, 1, 1, 1), stem=(2, 4))
    net = ConditionalUNet(unet).eval().requires_grad_(False)
    bias = next(value for name, value in unet.out_conv.named_parameters() if name.endswith("bias")).view(16, 8)
    bias[14:16] = 100.0
    expected = interpolate(case["known"], case["mask"], "nearest")
    out = net(**case)
    torch.testing.assert_close(out[1, 0], expected[1, 0])  # scattered points
    torch.testing.assert_close(out[0], expected[0])  # every fourth beam
    assert torch.equal(out[2], torch.zeros(2, 16, 64)), "nothing known in sample 2"


def test_candidates_need_known_pixels(chooser, case):
    assert torch.equal(chooser(case["x_t"], case["log_snr"]), torch.zeros(3, 2, 16, 64))
    assert torch.equal(chooser(**case)[2], torch.zeros(2, 16, 64)), "nothing known in sample 2"
    assert torch.equal(chooser(**case)[1, 1], torch.zeros(16, 64)), "no reflectance known in sample 1"
    assert bool(randomised(chooser)(**case).isfinite().all())


def test_a_network_of_another_width_is_refused():
    unet = EfficientUNet(8, 3, (16, 64), 8, None, (1, 1, 2, 2), (1, 1, 1, 1), stem=(2, 4))
    with pytest.raises(ValueError, match="out_channels = C, 7 C or 8 C, got 8 and 3"):
        ConditionalUNet(unet)


def test_an_empty_mask_is_no_mask(net, case):
    case["mask"].zero_()
    torch.testing.assert_close(randomised(net)(**case), net(case["x_t"], case["log_snr"]))


def test_values_of_unknown_pixels_do_not_matter(net, case):
    expected = randomised(net)(**case)
    case["known"] = torch.where(case["mask"] == 1, case["known"], torch.nan)
    assert torch.equal(net(**case), expected)


def test_known_pixels_masks_and_noise_all_matter(net, case):
    expected = randomised(net)(**case)
    for name in ("x_t", "known"):
        changed = net(**{**case, name: case[name] + 1})
        assert (changed - expected).abs().amax((1, 2, 3))[:2].min() > 1e-3
    assert (net(**{**case, "mask": case["mask"].flip(1)}) - expected)[1].abs().max() > 1e-3


def test_samples_with_and_without_known_pixels_share_a_batch(net, case):
    together = randomised(net)(**case)
    for i in range(3):
        alone = net(**{name: value[i : i + 1] for name, value in case.items()})
        torch.testing.assert_close(together[i : i + 1], alone, atol=1e-5, rtol=1e-5)


def test_a_boolean_mask_is_a_mask(net, case):
    expected = randomised(net)(**case)
    assert torch.equal(net(**{**case, "mask": case["mask"].bool()}), expected)


def test_impossible_inputs_are_refused(net, case):
    with pytest.raises(ValueError, match=r"mask must have the shape of x_t, .* got None"):
        net(**{**case, "mask": None})
    with pytest.raises(ValueError, match=r"known must have the shape of x_t, .* got \(3, 1, 16, 64\)"):
        net(**{**case, "known": case["known"][:, :1]})
    with pytest.raises(ValueError, match="out_channels = C, 7 C or 8 C, got 2 and 2"):
        ConditionalUNet(EfficientUNet(resolution=(16, 64), base_channels=8))
