"""Sensors and scans that a model cannot do anything with are refused in one line; the rest of the odd ones are done."""

import pickle
import warnings
from dataclasses import replace

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import Sensor, from_dict, get_sensor
from lidarsynth.lidar.view import out_of_view
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade.gaps import straight_in_gaps
from lidarsynth.verbs import generation

BEAMS = tuple(np.linspace(10.0, -20.0, 16).tolist())


@pytest.fixture(scope="module")
def model():
    return ls.load("default")


@pytest.fixture(scope="module")
def street() -> Scan:
    return SyntheticStreets(3, 1, get_sensor("os1-64"))[0]


def test_a_beam_alone_has_nothing_between(model, street: Scan):
    sensor = Sensor("alone", (-5.0,), width=64)
    with pytest.warns(UserWarning, match="most of what is put between is a guess"):
        done = model.upsample(ls.project(street, sensor).to_scan(), sensor, times=2)
    assert done.shape == (1, 64)


def test_classes_of_too_few_columns_are_refused(model, street: Scan):
    sensor = Sensor("narrow", BEAMS, width=32)
    with pytest.raises(
        ValueError, match=r"^sensor narrow: expected more than 32 columns to name classes by, found 32$"
    ):
        model.label(ls.project(street, sensor).to_scan(), sensor)
    assert model.label(ls.project(street, "vlp-16").to_scan(), Sensor("wider", BEAMS, width=33)).label is not None


def test_beams_that_begin_below_the_ground_are_refused(model, street: Scan):
    sensor = Sensor("deep", BEAMS, width=256, offsets=tuple(np.linspace(3.0, -3.0, 16).tolist()))
    for ask in (lambda m: m.complete(ls.project(street, sensor)), lambda m: m.generate(1)):
        with pytest.raises(ValueError, match=r"^sensor deep: expected beams that begin above the ground .*-1\.27 m$"):
            ask(model.into(sensor))


def test_a_ring_number_that_means_none_is_refused(street: Scan):
    ring = np.zeros(len(street), np.int64)
    ring[::16] = 2**32 - 1
    with pytest.raises(ValueError, match=r"^ring: expected numbers of beams below 1048576, found 4294967295$"):
        Scan(street.xyz, street.reflectance, ring=ring)


def test_values_of_other_types_are_refused_in_one_line(street: Scan):
    image = ls.project(street, "os1-64")
    for ask in (
        lambda: ls.corrupt(image, "points:0.5", seed=2.5),
        lambda: ls.corrupt(image, "points:0.5", seed=-1),
        lambda: ls.evaluate([image], [image], ["bev-1"]),
        lambda: ls.load("bilinear", device=None),
        lambda: replace(image, label=np.full(image.shape, np.nan)),
        lambda: replace(image, completed=3),
    ):
        with pytest.raises(ValueError, match=r"^(expected .*, found|label: expected|completed must)") as caught:
            ask()
        assert "\n" not in str(caught.value)


def test_a_model_can_be_sent_to_another_process(street: Scan):
    model = ls.load("kitti-streets")
    again = pickle.loads(pickle.dumps(model))
    images = [m.generate(1, steps=2, seed=4)[0].range for m in (model, again)]
    assert np.array_equal(*images)


def test_nothing_in_a_gap_comes_nearer_than_the_sensor_sees():
    """A round wall just beyond the least range: put straight in a gap it would be before it."""
    sensor, metres = Sensor("near", BEAMS, width=256, min_range=1.0), np.full((16, 256), 1.0002, np.float32)
    told = np.ones(metres.shape, bool)
    told[:, 100:140] = False
    image = RangeImage(metres, np.zeros_like(metres), np.ones_like(told), sensor)
    far = RangeImage(metres + 1, np.zeros_like(metres), np.ones_like(told), sensor)
    assert straight_in_gaps(image, told).range.min() > 1.0
    assert straight_in_gaps(far, told).range.min() < 2.0002  # it does come nearer where it may


@pytest.mark.parametrize(("top", "bottom", "mount"), [(-5, -60, 1.5), (90, -90, 0.6), (10, -55, 0.5)])
def test_beams_that_meet_the_ground_within_three_metres_are_seen_to_be_there(top, bottom, mount):
    sensor = ls.Sensor(
        "steep", tuple(np.linspace(top, bottom, 32).tolist()), 512, min_range=0.1, max_range=30.0, mount=mount
    )
    points = SyntheticStreets(7, 1, sensor).image(0).to_scan().xyz
    assert out_of_view(points, sensor) is None
    raised = points + np.array([0, 0, mount], np.float32)  # a dome sees points there, too
    assert (out_of_view(raised, sensor) is None) == (bottom == -90)


@pytest.mark.parametrize(("mount", "told"), [(4.0, 0), (15.0, 1)])
def test_scans_of_a_sensor_on_a_roof_are_said_to_have_too_little_ground(model, mount, told):
    roof = model.into(Sensor("roof", BEAMS, width=128, mount=mount)).choosing(1)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        roof.generate(1, steps=1)
    assert [str(warning.message).startswith("expected a sensor up to 5 m") for warning in caught] == [True] * told


def test_nothing_is_put_where_the_sensor_of_a_sparse_scan_never_looks(model):
    table = {"name": "ahead", "beams": 64, "top": 12.5, "bottom": -12.5, "width": 1024, "view": [-60, 60]}
    ahead = from_dict(table)
    scan = SyntheticStreets(777, 1, ahead)[0]
    with pytest.warns(UserWarning, match="found hardly any in 23. degrees of the turn"):
        done = model.into("hdl-64e").upsample(scan, ahead)
    row, column = np.nonzero(done.new)
    azimuth = np.degrees(done.sensor.ray_angles()[1][row, column])
    assert (np.array(done.sensor.elevations)[row] < -13).sum() > 1000, "below its beams, ahead, much is put"
    assert np.abs(azimuth).max() < 61


def test_processes_say_nothing_of_a_sensor_on_a_roof_again(model, tmp_path, monkeypatch):
    roof = model.into(Sensor("roof", BEAMS, width=128, mount=15.0)).choosing(1)
    monkeypatch.setattr(generation, "_opened", lambda source, threads: roof)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        parts = tmp_path, roof, [range(1)], 4, (".npz",), 1
        assert len(list(generation.generate_into(*parts, workers=2, source=generation.Drawing()))) == 1  # by this one
        assert len(caught) == 1
        roof.generate(1, steps=1)
        assert len(caught) == 2, "whose program is told of others as before"
