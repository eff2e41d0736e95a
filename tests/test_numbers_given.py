"""What metrics are given as arrays or tensors: with gradients, of odd types, masked, or no numbers at all."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import lidarsynth as ls
from lidarsynth.evaluation.evaluate import gather_part
from lidarsynth.lidar.depth import to_x_0
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import get_sensor
from lidarsynth.metrics.bev import bev_histograms
from lidarsynth.metrics.distributions import (
    Moments,
    frechet_distance,
    gaussian_mmd,
    jensen_shannon_distance,
    kernel_distance,
    moments,
)
from lidarsynth.metrics.neighbours import coverage, fidelity, minimum_matching_distance
from lidarsynth.metrics.occupancy import Occupancy, cells_along, occupied_cells, total_variation
from lidarsynth.metrics.point_sets import earth_movers_distance, farthest_points, sphere_counts
from lidarsynth.metrics.reconstruction import (
    accuracy,
    chamfer_distance,
    class_iou,
    confusion_matrix,
    mean_iou,
    voxel_errors,
    weighted_iou,
)
from lidarsynth.metrics.sensor_report import BeamCounts

POSITIVE = np.abs(np.random.default_rng(0).normal(0, 20, (30, 3))).astype(np.float32)
OTHER = np.abs(np.random.default_rng(1).normal(0, 20, (30, 3))).astype(np.float32)
JUDGES = {
    "moments": lambda v: moments(v).mean.sum(),
    "kernel": lambda v: kernel_distance(v, OTHER, np.random.default_rng(0), 3, 20),
    "kernel, real": lambda v: kernel_distance(OTHER, v, np.random.default_rng(0), 3, 20),
    "mmd": lambda v: gaussian_mmd(v, OTHER),
    "jsd": lambda v: jensen_shannon_distance(v, OTHER),
    "fidelity": lambda v: fidelity(v, OTHER).density,
    "coverage": coverage,
    "matching": minimum_matching_distance,
    "variation": lambda v: total_variation(v, OTHER),
    "chamfer": lambda v: chamfer_distance(v, OTHER),
    "voxels": lambda v: voxel_errors(v, OTHER).iou,
    "cells": lambda v: occupied_cells(v, 0.5).sum(),
    "farthest": lambda v: farthest_points(v, 5).sum(),
    "earth mover's": lambda v: earth_movers_distance(v, OTHER),
    "sphere": lambda v: (sphere_counts(v) ** 2).sum(),
}


@pytest.mark.parametrize("name", JUDGES)
def test_gradients_and_odd_types_change_nothing(name: str):
    judge, rounded = JUDGES[name], torch.tensor(POSITIVE).bfloat16()
    expected = float(judge(POSITIVE))
    for given in (torch.tensor(POSITIVE, requires_grad=True), POSITIVE.astype(np.longdouble), POSITIVE.astype(">f4")):
        assert float(judge(given)) == pytest.approx(expected, rel=1e-6)
    assert float(judge(rounded)) == pytest.approx(float(judge(rounded.float())), rel=1e-6)


@pytest.mark.parametrize("name", JUDGES)
def test_what_is_no_array_of_plain_numbers_is_refused(name: str):
    masked, judge = np.ma.array(POSITIVE, mask=POSITIVE > 30), JUDGES[name]
    odd = (masked, POSITIVE + 1j, POSITIVE.astype(object), POSITIVE.astype(str), torch.tensor(POSITIVE).to_sparse())
    for given in (*odd, torch.tensor(POSITIVE) + 1j, torch.tensor(POSITIVE, device="meta"), None, "abc"):
        with pytest.raises(ValueError, match="expected an array or tensor of plain numbers, found a"):
            judge(given)


def test_one_of_a_reversed_set_is_taken():
    """numpy counts an array as in order whose only row steps backwards, torch does not."""
    held, whole = Moments(3), Moments(3)
    for row in np.split(POSITIVE[::-1], len(POSITIVE)):
        held.update(row)
    whole.update(POSITIVE)
    assert np.allclose(held.mean, whole.mean)
    scans = POSITIVE.reshape(2, 15, 3)
    assert torch.equal(bev_histograms(scans[::-1][:1]), bev_histograms(scans[1:]))


def test_images_of_one_beam_may_be_turned_over():
    sensor = ls.Sensor("one", (-1.0,), width=64)
    half = np.full((1, 64), 0.5, np.float32)
    image = RangeImage(10 * half, half, np.ones((1, 64), bool), sensor)
    known = np.arange(64)[None] % 2 == 0
    turned = replace(image, range=image.range[::-1], reflectance=image.reflectance[::-1])
    assert torch.equal(to_x_0(turned), to_x_0(image))
    filled = [ls.load("nearest").complete(one, pixels) for one, pixels in ((image, known), (turned, known[::-1]))]
    np.testing.assert_array_equal(filled[0].range, filled[1].range)


def test_moments_of_features_with_gradients_hold_none():
    network, held = torch.nn.Linear(3, 4), Moments(4)
    for _ in range(3):
        held.update(network(torch.tensor(POSITIVE)))
    assert not any(value.requires_grad for value in (held.mean, held.scatter))
    held.mean.numpy()


def test_features_in_place_of_moments_and_seeds_in_place_of_generators_are_refused():
    with pytest.raises(ValueError, match=r"expected Moments, found a ndarray; moments\(features\) makes them"):
        frechet_distance(POSITIVE, moments(OTHER))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"expected a generator such as numpy.random.default_rng\(0\), found a int"):
        kernel_distance(POSITIVE, OTHER, 0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"expected histograms \(N, \.\.\.\), found \(30,\)"):
        gaussian_mmd(POSITIVE[:, 0], OTHER[:, 0])


def test_beams_are_counted_of_tensors_of_any_kind():
    sensor, rng = get_sensor("hdl-64e"), np.random.default_rng(0)
    far, mask = rng.uniform(2, 70, (64, 32)).astype(np.float32), rng.random((64, 32)) > 0.3
    counts, word, rough = BeamCounts(sensor), BeamCounts("hdl-64e"), BeamCounts(sensor)  # type: ignore[arg-type]
    counts.update(far, mask)
    word.update(torch.tensor(far, requires_grad=True), torch.tensor(mask))
    assert (counts.histogram == word.histogram).all()
    rough.update(torch.tensor(far).bfloat16(), torch.tensor(mask))
    assert (rough.pixels == counts.pixels).all()
    for bad in (float("nan"), 0.0, -1.0):
        with pytest.raises(ValueError, match=f"expected a step above 0, found {bad}"):
            BeamCounts(sensor, bad)
    with pytest.raises(ValueError, match="found a list"):
        counts.update(far.tolist(), mask)  # type: ignore[arg-type]


def test_cells_that_do_not_divide_the_square_have_numbers_of_their_own():
    edges = np.array([[x, y, 0.0] for x in (-49.9, 49.9) for y in (-49.9, 49.9)])
    for cell in (7.0, 0.3, 30.0, 0.05):
        cells, size = occupied_cells(edges, cell), cells_along(cell)
        assert len(cells) == 4 and cells.min() >= 0 and cells.max() < size**2
        Occupancy(cell, cell).update(edges)
    assert cells_along(0.05) == 2000 and cells_along(0.5) == 200
    for cell in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match=f"expected a cell above 0, found {cell}"):
            occupied_cells(edges, cell)


@pytest.mark.parametrize("measure", [class_iou, mean_iou, weighted_iou, accuracy])
def test_labels_in_place_of_their_confusion_are_refused(measure):
    labels = np.arange(8).reshape(2, 4)
    assert measure(confusion_matrix(labels, torch.tensor(labels))) is not None
    for bad in (labels, labels[0], labels[:, :0]):
        with pytest.raises(ValueError, match=r"expected a confusion matrix \(C, C\), found \(.*confusion_matrix makes"):
            measure(bad)


def tensors() -> np.ndarray:
    """(2, 5, 16, 64): samples as R2DM's program saves them, of a wall around the sensor."""
    sensor = get_sensor("vlp-16").resized(16, 64)
    far = np.full((16, 64), 12.0, np.float32)
    image = RangeImage(far, far / 40, far > 0, sensor)
    one = np.concatenate([far[None], np.moveaxis(image.points(), -1, 0), image.reflectance[None]])
    return np.stack([one, one * np.array([1.5, 1.5, 1.5, 1.5, 1], np.float32)[:, None, None]])


def test_samples_of_odd_types_are_judged_as_others():
    samples = tensors()
    expected = ls.evaluate(samples, samples[::-1], sensor="vlp-16").values
    for odd in (samples.astype(">f4"), samples.astype(np.longdouble), torch.tensor(samples, requires_grad=True)):
        assert ls.evaluate(odd, samples[::-1], sensor="vlp-16").values == expected


@pytest.mark.parametrize("kind", ["masked", "complex", "objects", "sparse"])
def test_samples_that_are_no_plain_numbers_are_refused_by_number(kind: str):
    samples = tensors()
    one = {
        "masked": np.ma.array(samples[1], mask=samples[1] > 15),
        "complex": samples[1] + 0j,
        "objects": samples[1].astype(object),
        "sparse": torch.tensor(samples[1]).to_sparse(),
    }[kind]
    with pytest.raises(ValueError, match=r"^image 1: expected an array or tensor of plain numbers, found a"):
        ls.evaluate([samples[0], one], samples, sensor="vlp-16")


def test_parts_and_sides_that_are_none_are_refused(tmp_path: Path):
    out = tmp_path / "part.safetensors"
    with pytest.raises(ValueError, match="expected a side of samples, reference, found 'real'"):
        gather_part(tensors(), "1/1", out, sensor="vlp-16", side="real")  # type: ignore[arg-type]
    for part in (None, 1, (1, 2)):
        with pytest.raises(ValueError, match="expected a part such as '1/2', found "):
            gather_part(tensors(), part, out, sensor="vlp-16")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="expected a protocol of "):
        gather_part(tensors(), "1/1", out, 3, sensor="vlp-16")  # type: ignore[arg-type]
    assert not out.exists()


def test_views_from_above_take_points_with_gradients():
    points = torch.tensor(POSITIVE[None], requires_grad=True)
    assert bev_histograms(points).equal(bev_histograms(POSITIVE[None]))


@pytest.mark.parametrize("stack", [False, True])
@pytest.mark.parametrize("channels", [5, 2])
def test_samples_in_a_npy_are_told_which_files_are_judged(channels: int, stack: bool, tmp_path: Path):
    made = tensors()[:, :channels]
    np.save(tmp_path / "0.npy", made if stack else made[0])
    judged = r"samples \(5, H, W\) and \(2, H, W\) are judged as .pth, which torch.save writes$"
    with pytest.raises(ValueError, match=judged):
        ls.evaluate(tmp_path, tensors(), sensor="vlp-16")
