"""Confidence: a closed form, calibrated by construction; measured points sure; written to every kind of file."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import lidarsynth as ls
from lidarsynth.experiment.record import Confidence, from_dict
from lidarsynth.files.fields import PLACE
from lidarsynth.files.formats import read_image
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.networks.fill_unet import Filled
from lidarsynth.networks.rays import encode_range, rays_of
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade.calibration import held_out, judged, right
from lidarsynth.systems.cascade.confidence import confidence, fitted, reliability, signals
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.verbs.inputs import Loaded, message_fields

SENSOR = ls.Sensor("small", tuple(np.linspace(5, -25, 32).tolist()), 256, 0.5, 120.0)


@pytest.fixture(scope="module")
def model() -> CascadeModel:
    loaded = ls.load("default")
    assert isinstance(loaded, CascadeModel)
    return loaded


@pytest.fixture(scope="module")
def street() -> RangeImage:
    return SyntheticStreets(5, 1, SENSOR).image(0)


def wall(metres: float, spread: float, near: float) -> Filled:
    """What a network would say that put every pixel at the same range."""
    full = torch.full((1, 1, 32, 256), 1.0)
    code = encode_range(full * metres)
    return Filled(code, full * 0.2, full * 2, None, full * spread, (full * near).expand(1, 4, 32, 256))


def test_signals_are_those_of_the_definition():
    rays = rays_of(SENSOR, SENSOR.blocked_rays())
    seen = signals(wall(10.0, 0.25, 0.5), rays)[0, :, 5, 7]
    across = min(2 * np.pi / 256, np.radians(30 / 31))  # one pixel away, in the row
    expected = [np.log(0.27 / 0.5), np.log(across + 1e-3), 2.0, *[np.log(0.02 / 0.5)] * 2, np.log(11), 0]
    assert_close(seen, torch.tensor(expected, dtype=torch.float32), rtol=1e-4, atol=1e-4)
    alone = signals(wall(10.0, 0.25, 0.0), rays)[0, 6, 5, 7]  # nothing is known in the row and the column
    assert_close(alone, torch.tensor(np.log(1.501 / 0.2), dtype=torch.float32), rtol=1e-4, atol=1e-4)


def test_confidence_is_the_logistic_of_the_signals_and_falls_with_doubt():
    rays, weights = rays_of(SENSOR, SENSOR.blocked_rays()), Confidence(-1.0, -0.5, 0.3, -0.2, -0.1, -0.4, 0.7, -0.6)
    seen = signals(wall(10.0, 0.25, 0.5), rays)[0, :, 5, 7].double()
    logit = (seen * torch.tensor([-1.0, -0.5, 0.3, -0.2, -0.1, -0.4, -0.6]).double()).sum() + 0.7
    stated = confidence(wall(10.0, 0.25, 0.5), rays, weights)[0, 0, 5, 7].double()
    assert_close(stated, 1 / (1 + torch.exp(-logit)), rtol=1e-5, atol=1e-6)
    unanswered = wall(10.0, 0.25, 0.5)._replace(logit=torch.zeros(1, 1, 32, 256))
    for worse in (wall(10.0, 0.5, 0.5), wall(10.0, 0.25, 0.2), wall(10.0, 0.25, 0.0), unanswered):
        assert confidence(worse, rays, weights)[0, 0, 5, 7] < stated


def test_the_fit_finds_the_weights_that_made_the_data_and_refuses_wrong_signs():
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(100_000, 7))
    truth = np.array([-1.0, -0.3, 0.5, 0.0, -0.2, -0.4, -0.6])
    hits = rng.random(len(seen)) < 1 / (1 + np.exp(-(seen @ truth + 0.8)))
    found = fitted(seen, hits)
    np.testing.assert_allclose(
        [found.spread, found.angle, found.answer, found.columns, found.range, found.far, found.constant],
        [-1.0, -0.3, 0.5, -0.2, -0.4, -0.6, 0.8],
        atol=0.03,
    )
    assert fitted(-seen, hits).spread == 0.0  # more spread, more often right: not believed


def test_reliability_of_honest_chances_lies_on_the_diagonal():
    rng = np.random.default_rng(1)
    stated = rng.random(200_000)
    rows = reliability(stated, rng.random(200_000) < stated)
    assert sum(row[2] for row in rows) == pytest.approx(1)
    assert all(abs(said - hits) < 0.015 for *_, said, hits in rows)


def test_the_shipped_confidences_hold_on_streets_of_new_sensors(model: CascadeModel):
    stated, hits, off = judged(model, held_out(515153, 4))
    apart = sum(share * abs(said - real) for _, _, share, said, real in reliability(stated, hits, 5) if share)
    assert apart < 0.08  # four streets; of 22 it is 0.013
    assert hits[stated > 0.9].mean() > hits.mean() + 0.05 > hits[stated < 0.5].mean() + 0.2
    assert np.median(off[stated > 0.9]) < np.median(off[stated < 0.5])


def test_right_is_within_the_tolerance_and_a_return():
    flat = np.full((32, 256), 10.0, np.float32)
    truth = RangeImage(flat, flat * 0, flat > 0, SENSOR)
    for metres, expected in ((10.48, True), (10.52, False), (9.51, True), (9.49, False)):
        filled = RangeImage(np.full_like(flat, metres), flat * 0, flat > 0, SENSOR)
        assert right(filled, truth).all() == expected
        assert not right(filled, replace(truth, mask=flat < 0)).any()


@pytest.mark.parametrize("ending", ["ply", "pcd", "npz"])
def test_new_points_carry_their_confidence_into_files(
    model: CascadeModel, street: RangeImage, tmp_path: Path, ending: str
):
    sparse = street.keep(corrupt(street, "beams:4")).to_scan()
    filled = model.into(SENSOR).complete(sparse)
    points = filled.to_scan()
    new = points.extra["new"] > 0
    assert 0 < new.sum() < len(new)
    assert (points.extra["confidence"][~new] == 1).all()
    assert (points.extra["confidence"][new] < 1).all() and np.ptp(points.extra["confidence"][new]) > 0.3
    ls.write(tmp_path / f"dense.{ending}", points)
    np.testing.assert_array_equal(ls.read(tmp_path / f"dense.{ending}").extra["confidence"], points.extra["confidence"])
    if ending == "npz":
        ls.write(tmp_path / "image.npz", filled)
        np.testing.assert_array_equal(read_image(tmp_path / "image.npz").confidence, filled.confidence)


def test_bin_files_get_their_confidences_beside_them(model: CascadeModel, street: RangeImage, tmp_path: Path):
    points = model.into(SENSOR).complete(street.keep(corrupt(street, "beams:4")).to_scan()).to_scan()
    ls.write(tmp_path / "dense.bin", points)
    stored = np.fromfile(tmp_path / "dense.confidence", "<f4")
    np.testing.assert_array_equal(stored, points.extra["confidence"])
    assert len(np.fromfile(tmp_path / "dense.new", "u1")) == len(points)


def test_surer_than_keeps_what_was_measured(model: CascadeModel, street: RangeImage):
    filled = model.into(SENSOR).complete(street.keep(corrupt(street, "beams:4")).to_scan())
    assert filled.confidence is not None
    some, none = filled.surer_than(0.7), filled.surer_than(1.0)
    before, after = filled.to_scan(), some.to_scan()
    assert after.extra["new"].sum() == (before.extra["new"][before.extra["confidence"] >= 0.7] > 0).sum()
    assert (after.extra["new"] == 0).sum() == (before.extra["new"] == 0).sum() == len(none.to_scan())
    np.testing.assert_array_equal(some.mask, filled.mask & (filled.confidence >= 0.7))


def test_what_has_no_confidence_says_so(model: CascadeModel, street: RangeImage):
    draw = model.into(SENSOR).complete(street.keep(corrupt(street, "beams:4")).to_scan(), method="sample")
    assert "confidence" not in draw.to_scan().extra
    with pytest.raises(ValueError, match="expected a completion with confidences"):
        draw.surer_than(0.5)
    with pytest.raises(ValueError, match="expected a least confidence of 0 to 1, found 2"):
        draw.surer_than(2)
    with pytest.raises(ValueError, match="spread"):
        from_dict({"name": "x", "confidence": {"spread": 1.0}})


def test_points_that_were_filled_in_without_a_confidence_get_none_later(model: CascadeModel, street: RangeImage):
    sparse = street.keep(corrupt(street, "beams:4")).to_scan()
    interpolated = ls.load("nearest").into(SENSOR).complete(sparse).to_scan()
    some = interpolated[(interpolated.extra["new"] == 0) | (np.arange(len(interpolated)) % 2 > 0)]
    with pytest.warns(UserWarning, match="filled in before"):
        twice = model.into(SENSOR).complete(some).to_scan()
    ours = {xyz.tobytes() for xyz in some.xyz[some.extra["new"] > 0]}
    earlier = np.array([xyz.tobytes() in ours for xyz in twice.xyz])
    assert earlier.sum() == len(ours) > 100
    assert (twice.extra["confidence"][earlier] == 0).all()
    assert (twice.extra["confidence"][twice.extra["new"] == 0] == 1).all()


def test_bags_get_a_column_of_confidences(model: CascadeModel, street: RangeImage):
    sparse = street.keep(corrupt(street, "beams:4")).to_scan()
    given = {"x": sparse.xyz[:, 0], "y": sparse.xyz[:, 1], "z": sparse.xyz[:, 2]}
    numbered = replace(sparse, extra={PLACE: np.arange(1, len(sparse) + 1)})
    filled = model.into(SENSOR).complete(numbered).to_scan()
    columns = message_fields(filled, Loaded(sparse, given, 0))
    np.testing.assert_array_equal(columns["confidence"], filled.extra["confidence"])
    assert columns["confidence"].dtype == np.float32 and (columns["confidence"][columns["new"] == 0] == 1).all()


def test_denser_scans_have_confidences_too(model: CascadeModel, street: RangeImage):
    points = model.upsample(street.to_scan(), sensor_in=SENSOR, times=2).to_scan()
    new = points.extra["new"] > 0
    assert new.any() and (points.extra["confidence"][new] < 1).all() and (points.extra["confidence"][~new] == 1).all()
