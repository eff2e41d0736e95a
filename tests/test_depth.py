"""Depth codecs: inverse pairs, the reference program's values, and what happens to pixels without a return."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import lidarsynth as ls
from lidarsynth.lidar.depth import CODECS, decode, encode, from_x_0, to_x_0, valid
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor, get_sensor

OFFICIAL = {"log": "log_depth", "inverse": "inverse_depth", "metric": "depth"}  # our word -> the reference's
SENSOR = get_sensor("hdl-64e").resized(16, 64)


@pytest.mark.parametrize("codec", OFFICIAL)
def test_codecs_equal_the_reference(fixture_tensors, codec):
    expected = fixture_tensors("r2dm/lidar_utility")
    tight = {"rtol": 0, "atol": 1e-7}
    torch.testing.assert_close(
        encode(expected["metric"], SENSOR, codec), expected[f"{OFFICIAL[codec]}.convert"], **tight
    )
    reverted = expected[f"{OFFICIAL[codec]}.revert"]
    torch.testing.assert_close(decode(expected["normalized"], SENSOR, codec), reverted, rtol=0, atol=8e-4)
    torch.testing.assert_close(valid(expected["metric"], SENSOR).float(), expected["mask"], rtol=0, atol=0)


@pytest.mark.parametrize("codec", OFFICIAL)
@pytest.mark.parametrize("name", ["hdl-64e", "vlp-16", "pandar64"])
def test_codecs_are_inverse_pairs(codec, name):
    sensor = get_sensor(name)
    distance = torch.linspace(sensor.min_range, sensor.max_range, 1002, dtype=torch.float64)[1:-1]
    code = encode(distance, sensor, codec)
    assert code.min() > 0 and code.max() <= 1
    # `inverse` has the reference's 1e-8 against division by zero in both directions: d / min_range * 1e-8
    torch.testing.assert_close(decode(code, sensor, codec), distance, rtol=1e-5, atol=0)
    single = decode(encode(distance.float(), sensor, codec), sensor, codec)
    torch.testing.assert_close(single, distance.float(), rtol=3e-5, atol=1e-5)


def test_codecs_have_their_closed_forms():
    """R2DM table II, rows C, D and E, at one metre-valued point each."""
    distance = torch.tensor([8.0, 40.0])
    assert encode(distance, SENSOR, "log").tolist() == pytest.approx([2 / 4, np.log2(41) / np.log2(81)])
    assert encode(distance, SENSOR, "metric").tolist() == pytest.approx([0.1, 0.5])
    assert encode(distance, SENSOR, "inverse").tolist() == pytest.approx([1.45 / 8, 1.45 / 40])


@pytest.mark.parametrize("codec", CODECS)
def test_what_is_not_strictly_inside_the_limits_is_no_return(codec):
    outside = torch.tensor([0.0, 1.0, 1.45, 80.0, 80.5, 1e6])
    assert encode(outside, SENSOR, codec).tolist() == [0.0] * 6
    assert torch.isfinite(decode(torch.linspace(0, 1, 101), SENSOR, codec)).all()
    none = decode(torch.zeros(1), SENSOR, codec)
    assert none.item() == 0, "the code of an empty pixel is empty again, also where 1 / 0 is far beyond the limit"


def image_of(distance: np.ndarray, sensor: Sensor = SENSOR) -> RangeImage:
    mask = distance > 0
    reflectance = np.random.default_rng(1).random(distance.shape, np.float32) * mask
    return RangeImage(distance, reflectance, mask, sensor)


@pytest.mark.parametrize("codec", OFFICIAL)
def test_images_become_x_0_and_images_again(codec):
    rng = np.random.default_rng(0)
    distance = rng.uniform(2, 79, (16, 64)).astype(np.float32)
    distance[rng.random((16, 64)) < 0.3] = 0
    image = image_of(distance)
    x_0 = to_x_0(image, codec)
    assert x_0.shape == (2, 16, 64) and x_0.dtype == torch.float32
    assert x_0.min() == -1 and x_0.max() <= 1
    assert (x_0[:, ~torch.from_numpy(image.mask)] == -1).all(), "both channels of an empty pixel"
    back = from_x_0(x_0, SENSOR, codec)
    np.testing.assert_array_equal(back.mask, image.mask)
    np.testing.assert_allclose(back.range, image.range, rtol=2e-5, atol=1e-5)
    np.testing.assert_allclose(back.reflectance, image.reflectance, atol=1e-7)


def test_samples_a_little_beyond_the_data_range_are_clamped():
    x_0 = torch.full((2, 16, 64), 1.04)
    x_0[0, 0] = -1.04
    image = from_x_0(x_0 * torch.ones((), requires_grad=True), SENSOR, "log")
    assert not image.mask[0].any() and image.reflectance[0].max() == 0
    assert image.range.max() <= 80 and image.reflectance.max() <= 1


def test_arrays_and_ranges_alone_become_images():
    x_0 = to_x_0(image_of(np.random.default_rng(0).uniform(2, 79, (16, 64)).astype(np.float32)))
    x_0[:, 0] = -1
    expected = from_x_0(x_0, SENSOR)
    for given in (x_0.numpy(), x_0.double(), x_0.numpy()[:1], x_0.to(torch.bfloat16)[:1]):
        image = from_x_0(given, SENSOR)
        np.testing.assert_array_equal(image.mask, expected.mask)
        np.testing.assert_allclose(image.range, expected.range, rtol=0.05)
        assert image.reflectance.any() == (len(given) == 2)
    assert from_x_0(np.full((2, 64, 1024), -1.0), "hdl-64e").sensor is ls.SENSORS["hdl-64e"]


def test_arrays_may_be_read_only_turned_and_of_the_other_byte_order():
    image = image_of(np.random.default_rng(0).uniform(2, 79, (16, 64)).astype(np.float32))
    x_0 = to_x_0(image)
    other = x_0.numpy().astype(x_0.numpy().dtype.newbyteorder())
    frozen = replace(image, range=image.range.copy(), reflectance=image.reflectance.copy())
    for part in (other, frozen.range, frozen.reflectance):
        part.flags.writeable = False
    torch.set_warn_always(True)
    try:
        for given in (other, other[:, ::-1][:, ::-1], x_0.numpy()[..., ::-1].copy()[..., ::-1]):
            np.testing.assert_array_equal(from_x_0(given, SENSOR).range, from_x_0(x_0, SENSOR).range)
        torch.testing.assert_close(to_x_0(frozen), x_0, rtol=0, atol=0)
    finally:
        torch.set_warn_always(False)


def test_other_codes_are_no_x_0():
    code = torch.rand(2, 16, 64, generator=torch.Generator().manual_seed(0))
    wide, coded = 1.5 * (2 * code - 1), r"a code of 0 to 1 becomes 2 \* code - 1"
    for given, found in ((80 * code, "metres"), (wide, "metres"), (code * torch.nan, "nan to nan"), (code, coded)):
        with pytest.raises(ValueError, match=f"expected x_0 of -1 to 1.* found .*{found}"):
            from_x_0(given, SENSOR)


def test_unknown_words_and_shapes_are_refused():
    with pytest.raises(
        ValueError, match="expected a depth codec of log, inverse, metric, log-63m, inverse-minmax, found 'log_depth'"
    ):
        encode(torch.ones(1), SENSOR, "log_depth")
    with pytest.raises(
        ValueError, match="expected a depth codec of log, inverse, metric, log-63m, inverse-minmax, found ''"
    ):
        decode(torch.ones(1), SENSOR, "")
    with pytest.raises(ValueError, match=r"x_0 must be \(2, H, W\), .*, got \(1, 2, 16, 64\)"):
        from_x_0(torch.zeros(1, 2, 16, 64), SENSOR)
