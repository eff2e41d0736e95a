"""Errors of completed scans: parity with LiDARGen and the RangeNet repository, agreement with scipy, axioms."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import cdist, directed_hausdorff

from lidarsynth.evaluation.evaluate import evaluate
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.metrics.reconstruction import (
    accuracy,
    chamfer_distance,
    class_iou,
    confusion_matrix,
    mean_errors,
    mean_iou,
    point_errors,
    reconstruction_errors,
    voxel_errors,
    weighted_iou,
)

SENSOR = Sensor("test", tuple(float(-i) for i in range(16)), width=64)


@pytest.fixture
def values(reference: Path) -> dict:
    return json.loads((reference / "fixtures/metrics/values.json").read_text())


def image(distance: np.ndarray, reflectance: np.ndarray) -> RangeImage:
    return RangeImage(distance, reflectance, distance > 0, SENSOR)


def cloud(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-5, 5, (count, 3))


def test_mae_equals_the_reference(fixture_tensors, values):
    tensors = fixture_tensors("metrics/inputs")
    sets = [tensors[f"lidargen_{name}"].numpy().astype(np.float64) for name in ("result", "target")]
    # LiDARGen's codec: range = 2^(6 x) - 1 metres
    pairs = zip(*([image(2 ** (6 * x[0]) - 1, x[1]) for x in images] for images in sets), strict=True)
    errors = mean_errors([reconstruction_errors(result, target) for result, target in pairs])
    assert errors.range_mae == pytest.approx(values["lidargen_range_mae_m"], rel=1e-5)
    assert errors.reflectance_mae == pytest.approx(values["reflectance_mae_all_pixels"], rel=1e-5)
    assert errors.pixels == 3 * 16 * 64
    judged = evaluate(*(list(tensors[f"lidargen_{name}"]) for name in ("result", "target")), "r2dm-upsampling-2024")
    assert judged.values["range MAE"] == pytest.approx(values["lidargen_range_mae_m"], rel=1e-5)
    assert judged.values["reflectance MAE"] == pytest.approx(values["reflectance_mae_all_pixels"], rel=1e-5)


def test_errors_of_chosen_pixels_in_closed_form():
    truth = image(np.full((16, 64), 10.0), np.full((16, 64), 0.5))
    result = image(np.full((16, 64), 10.0), np.full((16, 64), 0.5))
    result.range[0] += np.tile([1.0, -3.0], 32)
    where = np.zeros((16, 64), bool)
    where[:2] = True
    errors = reconstruction_errors(result, truth, where)
    assert (errors.range_mae, errors.range_rmse) == (1.0, pytest.approx(np.sqrt(2.5)))
    assert (errors.reflectance_mae, errors.reflectance_rmse, errors.pixels) == (0, 0, 128)
    assert reconstruction_errors(result, truth, ~where).range_mae == 0
    with pytest.raises(ValueError, match="at least one pixel"):
        reconstruction_errors(result, truth, np.zeros((16, 64), bool))


def test_iou_equals_the_reference(fixture_tensors, values):
    tensors = fixture_tensors("metrics/inputs")
    truth, predicted = tensors["labels_gt"], tensors["labels_pred"]
    confusion = confusion_matrix(truth, predicted)
    np.testing.assert_allclose(class_iou(confusion), values["iou_per_class"], rtol=1e-9)
    assert weighted_iou(confusion) == pytest.approx(values["iou_weighted_lidargen"], rel=1e-9)
    assert mean_iou(confusion) == pytest.approx(values["iou_mean_ignore0_rangenet_repo"], rel=1e-9)
    np.testing.assert_allclose(class_iou(confusion, (0,)), values["iou_per_class_ignore0_rangenet_repo"], rtol=1e-9)
    assert accuracy(confusion) == pytest.approx(values["acc_ignore0_rangenet_repo"], rel=1e-9)
    one_by_one = sum(confusion_matrix(t, p) for t, p in zip(truth.numpy(), predicted.numpy(), strict=True))
    np.testing.assert_array_equal(one_by_one, confusion)


def test_iou_axioms():
    labels = np.random.default_rng(0).integers(0, 4, (8, 8))
    perfect = confusion_matrix(labels, labels, 4)
    assert mean_iou(perfect) == weighted_iou(perfect) == accuracy(perfect) == 1
    wrong = confusion_matrix(labels, (labels + 1) % 4, 4)
    np.testing.assert_array_equal(class_iou(wrong), 0)
    np.testing.assert_array_equal(class_iou(wrong), class_iou(wrong.T))
    with pytest.raises(ValueError, match="labels 0-2"):
        confusion_matrix(labels, labels, 3)
    with pytest.raises(ValueError, match=r"found \(8, 8\) and \(4, 8\)"):
        confusion_matrix(labels, labels[:4])
    np.testing.assert_array_equal(confusion_matrix(labels, labels.astype(np.float32), 4), perfect)
    for wrong_label in (1.7, np.nan, np.inf, -0.5):
        with pytest.raises(ValueError, match=r"expected .*labels"):
            confusion_matrix(labels, np.where(labels == 1, wrong_label, labels), 4)


@pytest.mark.parametrize("label", [-1, 4, 1.5])
@pytest.mark.parametrize("side", [0, 1])
def test_a_label_that_is_none_is_named(label: float, side: int):
    labels = np.random.default_rng(0).integers(0, 4, (8, 8))
    both = [labels, np.where(labels == 1, label, labels)]
    expected = "labels of whole numbers" if label % 1 else "labels 0-3"
    with pytest.raises(ValueError, match=rf"expected .*{expected}, found {label}$"):
        confusion_matrix(*(both if side else both[::-1]), 4)


@pytest.mark.parametrize("judge", [class_iou, mean_iou, accuracy])
@pytest.mark.parametrize("number", [-1, 20, 255])
def test_a_class_to_leave_out_that_is_none_is_refused(judge, number: int):
    """-1, by which others ignore pixels, left out the last class without a word."""
    with pytest.raises(ValueError, match=rf"expected classes 0-19 to leave out, found {number}$"):
        judge(np.eye(20), (0, number))
    with pytest.raises(ValueError, match="expected at least one class to judge, found all 2 left out"):
        mean_iou(np.eye(2), (0, 1))


def test_numbers_that_make_no_sense_are_refused():
    points = np.ones((4, 3))
    for size in (0, -0.1, np.nan):
        with pytest.raises(ValueError, match=f"expected a size above 0, found {size}"):
            voxel_errors(points, points, size=size)
    for threshold in (-1, np.nan):
        with pytest.raises(ValueError, match=f"expected a threshold of at least 0, found {threshold}"):
            point_errors(points, points, threshold=threshold)
    with pytest.raises(ValueError, match="expected a confusion of at least one pixel, found none"):
        weighted_iou(np.zeros((20, 20), np.int64))


def test_point_distances_equal_scipy():
    a, b = cloud(80, 1), cloud(70, 2)
    between = cdist(a, b)
    errors = point_errors(a, b, threshold=0.8)
    assert errors.chamfer == pytest.approx(between.min(1).mean() + between.min(0).mean())
    assert errors.chamfer == chamfer_distance(a, b)
    squared = between**2
    assert errors.chamfer_squared == pytest.approx(squared.min(1).mean() + squared.min(0).mean())
    assert errors.hausdorff == pytest.approx(max(directed_hausdorff(a, b)[0], directed_hausdorff(b, a)[0]))
    precision, recall = (between.min(1) <= 0.8).mean(), (between.min(0) <= 0.8).mean()
    assert 0 < precision < 1
    assert errors.f_score == pytest.approx(2 / (1 / precision + 1 / recall))


def test_point_errors_are_symmetric_and_zero_for_equal_sets():
    a, b = cloud(80, 1), cloud(70, 2)
    there, back, same = point_errors(a, b), point_errors(b, a), point_errors(a, a[::-1])
    assert (there.chamfer, there.hausdorff, there.f_score) == (back.chamfer, back.hausdorff, back.f_score)
    assert (there.precision, there.recall) == (back.recall, back.precision)
    assert (same.chamfer, same.chamfer_squared, same.hausdorff, same.f_score) == (0, 0, 0, 1)
    assert point_errors(a, a + 100).f_score == 0


def test_voxels_in_closed_form():
    truth = np.array([[0.05, 0.05, 0.05], [0.06, 0.01, 0.09], [0.15, 0, 0], [-0.05, 0, 0]])  # three voxels
    result = np.array([[0.01, 0.01, 0.01], [0.17, 0.02, 0.03], [5, 5, 5], [6, 6, 6]])  # four, two of them right
    errors = voxel_errors(result, truth)
    assert (errors.iou, errors.precision, errors.recall) == (2 / 5, 2 / 4, 2 / 3)
    assert errors.f1 == pytest.approx(2 * 2 / (3 + 4))
    assert voxel_errors(truth, truth[::-1]).iou == 1
    assert voxel_errors(truth, truth + 9).f1 == 0


@pytest.mark.parametrize("judge", [point_errors, voxel_errors, chamfer_distance])
@pytest.mark.parametrize("bad", [np.ones((0, 3)), np.ones((4, 2)), np.full((4, 3), np.nan)])
def test_points_that_cannot_be_judged(judge, bad):
    with pytest.raises(ValueError, match=r"expected finite points \(N, 3\), at least one, found"):
        judge(bad, np.ones((4, 3)))
