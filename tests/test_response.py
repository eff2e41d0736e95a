"""How a sensor reports reflectance: found out from its scan, undone for the network, said in its own terms again."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import lidarsynth as ls
from lidarsynth.experiment.record import Card
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.networks.rays import padded, rays_of
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.cascade.naming import named
from lidarsynth.systems.cascade.response import (
    AS_STREETS,
    SHARES,
    USUAL,
    Response,
    dimness_of,
    response_of,
    tried,
)
from lidarsynth.systems.cascade.speckle import calm


@pytest.fixture(scope="module")
def street() -> RangeImage:
    """32 beams that all read alike."""
    return SyntheticStreets(4, 16, replace(SENSORS["hdl-32e"], width=512)).image(2)


def every(image: RangeImage, step: int) -> np.ndarray:
    known = np.zeros(image.shape, bool)
    known[::step] = True
    return known


def reported_as(image: RangeImage, values: np.ndarray) -> RangeImage:
    return replace(image, reflectance=np.clip(values * image.mask, 0, 1).astype(np.float32))


@pytest.mark.parametrize(("scale", "gamma"), [(0.2, 1.0), (0.6, 1.6), (0.5, 1.3)])
def test_scale_and_gamma_are_undone(street: RangeImage, scale: float, gamma: float):
    other = reported_as(street, scale * street.reflectance**gamma)
    known = every(street, 2)
    even = [response_of(image, known).even(image.reflectance)[street.mask] for image in (street, other)]
    np.testing.assert_allclose(even[1], even[0], atol=2e-3)
    back = response_of(other, known)
    even = back.even(other.reflectance)
    assert (even < 1).mean() > 0.9
    np.testing.assert_allclose(back.reported(even)[even < 1], other.reflectance[even < 1], atol=1e-5)


def fading(image: RangeImage, exponent: float, near: float) -> RangeImage:
    """As a sensor of 255 levels reports the energy that comes back."""
    light = image.reflectance * (near / np.maximum(image.range, near)) ** exponent
    return reported_as(image, (255 * light).round() / 255)


@pytest.mark.parametrize(("exponent", "near"), [(2.0, 6.0), (2.0, 2.0), (1.0, 1.0)])
def test_how_a_scan_fades_with_distance_is_found_and_undone(street: RangeImage, exponent: float, near: float):
    known, dark = every(street, 2), fading(street, exponent, near)
    found = response_of(dark, known)
    assert abs(found.fades - exponent) < 0.4
    even = found.unfaded(dark)
    lit = dark.reflectance > 10 / 255
    inside = lit & (even.reflectance < 1)
    np.testing.assert_allclose(found.faded(even.reflectance, dark.range)[inside], dark.reflectance[inside], atol=1e-5)
    logs = [np.log(image.reflectance[inside]) for image in (even, dark, street)]
    assert np.std(logs[0] - logs[2]) < 0.4 * np.std(logs[1] - logs[2])
    assert not response_of(dark, known, tuned=True).fades, "a model of the sensor has learned it so"
    assert not response_of(replace(dark, sensor=replace(dark.sensor, dimness=(0.0,) * 32)), known).fades


def test_nothing_fades_where_farther_surfaces_are_darker_alone():
    """Streets as they are, and with their second and fifth power; of the quarters of their turns hardly any."""
    streets = SyntheticStreets(5, 128, replace(SENSORS["hdl-32e"], width=512))
    images, parts = [streets.image(k) for k in range(0, 128, 16)], np.arange(512) // 128
    for power in (1, 2, 5):
        seen = [reported_as(image, (1.2 * image.reflectance) ** power) for image in images]
        assert not any(response_of(image, every(image, 4)).fades for image in seen)
        quarters = [np.broadcast_to(parts == part, images[0].shape) for part in range(4)]
        assert sum(response_of(image, part).fades > 0 for image in seen for part in quarters) <= 1


def test_what_is_filled_in_fades_as_the_scan_does(street: RangeImage, monkeypatch: pytest.MonkeyPatch):
    known, dark, model = every(street, 4), fading(street, 2.0, 2.0), ls.load("default").into(street.sensor)
    found = model.complete(dark.keep(known), known)
    np.testing.assert_array_equal(found.reflectance[known], dark.keep(known).reflectance[known])
    monkeypatch.setattr("lidarsynth.systems.cascade.response._fading", lambda reflectance, metres: AS_STREETS)
    others = model.complete(dark.keep(known), known), ls.load("bilinear").complete(dark.keep(known), known)
    errors = [np.abs(one.reflectance - dark.reflectance)[~known].mean() for one in (found, *others)]
    assert errors[0] < 0.95 * errors[1]
    assert errors[0] < 0.9 * errors[2]


def test_what_fades_is_named_as_what_does_not(street: RangeImage):
    model = ls.load("default").into(street.sensor).with_labels()
    dark = fading(street, 2.0, 2.0)
    found = response_of(dark, dark.mask)
    assert isinstance(model, CascadeModel) and model.network.classes is not None and found.fades
    ways = (dark, found), (found.unfaded(dark), found._replace(fades=0.0)), (dark, found._replace(fades=0.0))
    by = [named(model.network.classes, [image], response, street.sensor)[0].label for image, response in ways]
    np.testing.assert_array_equal(by[0], by[1])
    assert not np.array_equal(by[0], by[2]), "which it is told"


def test_a_darker_reading_sensor_gets_the_same_surfaces_and_darker_points(street: RangeImage):
    model, known = ls.load("default").into(street.sensor), every(street, 4)
    dark = reported_as(street, 0.2 * street.reflectance)
    a, b = (model.complete(image.keep(known), known) for image in (street, dark))
    both = a.mask & b.mask & ~known
    assert both.sum() > 0.99 * (a.mask & ~known).sum()
    assert np.median(np.abs(a.range - b.range)[both]) < 1e-3
    assert np.abs(0.2 * a.reflectance - b.reflectance)[both].mean() < 2e-3


def test_beams_that_read_less_are_found_where_they_have_neighbours(street: RangeImage):
    dim = np.random.default_rng(0).normal(0, 0.05, street.shape[0]).astype(np.float32)
    uneven = np.where(street.mask & (street.reflectance > 0.1), street.reflectance - dim[:, None], 0)
    found = dimness_of(uneven, street.range, street.mask & (uneven > 0))
    true = dim - np.convolve(np.pad(dim, 1, mode="edge"), np.full(3, 1 / 3), mode="valid")
    said = found != 0
    assert said.sum() > 12
    assert np.corrcoef(found[said], true[said])[0, 1] > 0.9
    assert np.abs(found[said] - true[said]).mean() < 0.4 * np.abs(true[said]).mean()
    assert not dimness_of(uneven, street.range, street.mask & every(street, 31)).any()


def test_a_sensor_whose_beams_are_measured_is_left_as_it_is(street: RangeImage):
    known = every(street, 2)
    assert response_of(replace(street, sensor=replace(street.sensor, dimness=(0.0,) * 32)), known) == AS_STREETS
    assert response_of(reported_as(street, 0 * street.reflectance), known) == AS_STREETS
    kitti = RangeImage(
        np.ones((64, 1024)), np.full((64, 1024), 0.5), np.ones((64, 1024), bool), SENSORS["hdl-64e-kitti"]
    )
    assert response_of(kitti, kitti.mask) == AS_STREETS


@pytest.mark.parametrize(("offset", "share"), [(0.0, 0.0), (0.3, 1.0)])
def test_the_share_of_the_mean_is_what_suits_the_scan(street: RangeImage, offset: float, share: float):
    """Told by a network that answers the truth, or something else, beside a mean that is 0.1 too bright."""
    size, told = padded(street.sensor), np.ones(street.shape, bool)
    response = Response(1.0, 1.000001)
    full = torch.zeros(size)
    full[: street.shape[0]] = torch.from_numpy(street.reflectance[:, np.arange(size[1]) % street.shape[1]])

    class Fill(torch.nn.Linear):
        def forward(self, known, rays, noise):
            assert not known.told[:, 0, 1::2][:, : street.shape[0] // 2 - 2].all()
            assert known.told.shape == (8, 1, size[0], 64)
            first = (np.arange(8) * size[1] // 8 + (size[1] - 64) // 2) % size[1]
            truth = torch.stack([full[:, (at + np.arange(64)) % size[1]] for at in first])[:, None]
            return SimpleNamespace(reflectance=truth + offset, plain=truth + 0.1)

    rays = rays_of(street.sensor, street.sensor.blocked_rays())
    fill, shades = Fill(1, 1), response.even(street.reflectance)
    found = tried(response, fill, street, told, shades, rays)  # type: ignore[arg-type]
    assert found.plain == share
    assert share in SHARES
    kitti = replace(street.sensor, dimness=(0.01,) * street.shape[0])
    measured = tried(AS_STREETS, fill, replace(street, sensor=kitti), told, shades, rays)  # type: ignore[arg-type]
    assert measured == Response(plain=USUAL)
    assert tried(AS_STREETS, fill, street, told, shades, rays, tuned=True) == AS_STREETS  # type: ignore[arg-type]
    few = told & (np.arange(len(told)) < 3)[:, None]
    assert tried(response, fill, street, few, shades, rays).plain == USUAL  # type: ignore[arg-type]
    dark = replace(street, reflectance=0 * street.reflectance)
    assert tried(AS_STREETS, fill, dark, told, shades, rays) == AS_STREETS  # type: ignore[arg-type]


@pytest.mark.parametrize(("offset", "straight"), [(0.3, 1.0), (0.0, 0.0)])
def test_the_line_between_returns_is_taken_where_it_errs_less(street: RangeImage, offset: float, straight: float):
    """Of a scan that brightens from beam to beam, which the line says exactly, and a network that errs, or does not."""
    height = street.shape[0]
    ramp = np.broadcast_to(np.linspace(0.1, 0.9, height, dtype=np.float32)[:, None], street.shape)
    whole = replace(street, mask=np.ones(street.shape, bool), range=np.full(street.shape, 9.0), reflectance=ramp.copy())
    known = every(whole, 2)
    size, response = padded(whole.sensor), Response(1.0, 1.000001)
    truth = torch.zeros(8, 1, size[0], 64)
    truth[:, :, :height] = torch.from_numpy(ramp[:, :64].copy())

    class Fill(torch.nn.Linear):
        def forward(self, known, rays, noise):
            return SimpleNamespace(reflectance=truth + offset, plain=truth + offset + 0.1)

    rays = rays_of(whole.sensor, whole.sensor.blocked_rays())
    found = tried(response, Fill(1, 1), whole, known, response.even(ramp), rays)  # type: ignore[arg-type]
    assert found.straight == straight
    between = Response(straight=1.0).straightened(np.zeros_like(ramp), whole, known)
    inner = slice(0, height - 1)  # beyond the last known beam it goes on as that is
    np.testing.assert_allclose(between[inner], ramp[inner], atol=1e-5)
    assert Response().straightened(ramp, whole, known) is ramp
    np.testing.assert_array_equal(between[known], ramp[known])


def test_an_hdl_64e_that_reports_otherwise_is_not_kittis_unit():
    streets = SyntheticStreets(4, 16)
    image = streets.image(1)
    known = every(image, 4)
    assert response_of(image, known) == AS_STREETS
    dark = reported_as(image, (0.2 * image.reflectance * 255).round() / 255)
    assert response_of(dark, known).scale > 2
    filled, told = ls.load("default").complete(dark.keep(known), known), ls.load("bilinear").complete(dark, known)
    hidden = ~known & dark.mask
    errors = [np.abs(one.reflectance - dark.reflectance)[hidden].mean() for one in (filled, told)]
    assert errors[0] < 0.9 * errors[1], "1.7 times as much, where it is taken for KITTI's unit"


def test_known_reflectances_are_calm_on_their_own_surface():
    """A near wall and one behind it, each of one reflectance but for its speckle; a sign alone; rays without return."""
    rng, shape = np.random.default_rng(3), (4, 64)
    metres = np.where(np.arange(64) < 32, 10.0, 20.0).astype(np.float32) * np.ones(shape, np.float32)
    even = np.where(metres < 15, 0.2, 0.6).astype(np.float32)
    shades = even + rng.normal(0, 0.05, shape).astype(np.float32)
    metres[:, 10], shades[:, 10] = 5.0, 0.9
    mask = rng.random(shape) < 0.9
    mask[:, 10] = True
    known = np.zeros(shape, bool)
    known[::2] = True
    image = RangeImage(metres * mask, shades * mask, mask, Sensor("s", (0.0, -1.0, -2.0, -3.0), 64))
    found, lit = calm(image.reflectance, image, known), known & mask
    assert not found[~lit].any()
    others = lit & (np.arange(64) != 10)
    assert np.abs(found - even)[others].mean() < 0.8 * np.abs(shades - even)[others].mean()
    assert np.allclose(found[lit & (np.arange(64) == 10)], 0.9)
    assert np.abs(found - even)[others].max() < 0.2


def test_few_columns_and_nothing_known_are_no_error():
    image = RangeImage(np.ones((2, 4)), np.full((2, 4), 0.5), np.ones((2, 4), bool), Sensor("s", (0.0, -1.0), 4))
    assert np.allclose(calm(np.full((2, 4), 0.5, np.float32), image, image.mask), 0.5)
    assert not calm(np.full((2, 4), 0.5, np.float32), image, ~image.mask).any()


def test_a_network_is_tuned_to_a_sensor_whose_scans_it_saw_and_not_by_streets_alone():
    model = ls.load("default").into("vlp-16")
    record = model.experiment
    for card, tuned in (
        (Card(sensor="vlp-16"), True),
        (Card(sensor="vlp-16", synthetic=True), False),
        (Card(sensor="os1-64"), False),
    ):
        assert replace(model, experiment=replace(record, card=card)).tuned is tuned
