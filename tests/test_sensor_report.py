"""Per-beam report: counts by hand, agreement with scipy, batches in any order."""

import numpy as np
import pytest
import torch

from lidarsynth.lidar.sensor import Sensor
from lidarsynth.metrics.sensor_report import BeamCounts, compare_beams

SENSOR = Sensor("test", (2.0, 0.0, -2.0), width=64, max_range=50.0)


def images(count: int, seed: int = 0, drop: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    mask = rng.random((count, 3, 64)) > drop
    return rng.gamma(4, 3, (count, 3, 64)).clip(0, 49.9) * mask, mask


def gathered(*batches: tuple[np.ndarray, np.ndarray]) -> BeamCounts:
    counts = BeamCounts(SENSOR)
    for distance, mask in batches:
        counts.update(distance, mask)
    return counts


def test_drop_rate_and_histogram_by_hand():
    distance = np.zeros((3, 64), np.float32)
    distance[0, :16], distance[1, :4] = 0.5, [0.49, 10.2, 10.4, 70]
    counts = gathered((distance, distance > 0))
    np.testing.assert_array_equal(counts.drop_rate, [48 / 64, 60 / 64, 1])
    assert counts.histogram[0].nonzero()[0].tolist() == [1], "0.5 m belongs to the second bin"
    assert counts.histogram[1, [0, 20, 99]].tolist() == [1, 2, 1], "what is beyond the last bin is counted in it"
    np.testing.assert_array_equal(counts.quantile(0.5), [0.75, 10.25, np.nan])


def test_counts_depend_neither_on_batches_nor_on_who_gathered_them():
    distance, mask = images(6)
    whole = gathered((distance, mask))
    merged = gathered((torch.from_numpy(distance[4:]), torch.from_numpy(mask[4:])))
    merged.merge(gathered((distance[0], mask[0]), (distance[1:4], mask[1:4].astype(np.float32))))
    np.testing.assert_array_equal(merged.histogram, whole.histogram)
    np.testing.assert_array_equal(merged.pixels, whole.pixels)
    np.testing.assert_allclose(whole.drop_rate, 1 - mask.mean((0, 2)))


def test_ranges_move_as_far_as_scipy_says():
    from scipy.stats import wasserstein_distance  # here, for it takes a second to import

    first, second = images(4, 1), images(5, 2)
    report = compare_beams(gathered(first), gathered((second[0] * 1.3, second[1])))
    for beam in range(3):
        values = [(np.floor(d[:, beam][m[:, beam]] * s / 0.5) * 0.5) for (d, m), s in ((first, 1), (second, 1.3))]
        expected = wasserstein_distance(*(v.clip(max=49.5) for v in values))
        assert report.range_distance[beam] == pytest.approx(expected)
    assert report.range_error == pytest.approx(report.range_distance.mean())


def test_the_report_is_zero_for_equal_sets_and_grows_with_dropped_returns():
    distance, mask = images(8)
    real = gathered((distance, mask))
    same = compare_beams(gathered((distance[::-1], mask[::-1])), real)
    assert (same.drop_rate_error, same.range_error) == (0, 0)
    scores = []
    for share in (0.1, 0.2, 0.4):
        kept = mask & (np.random.default_rng(9).random(mask.shape) > share)
        report, back = compare_beams(gathered((distance, kept)), real), compare_beams(real, gathered((distance, kept)))
        assert report.drop_rate_error == back.drop_rate_error
        scores.append(report.drop_rate_error)
    assert scores == sorted(scores)
    assert scores[0] > 0.05


def test_a_blocked_beam_is_told_in_the_table():
    distance, mask = images(2)
    blocked = mask.copy()
    blocked[:, 1] = False
    report = compare_beams(gathered((distance, blocked)), gathered((distance, mask)))
    assert report.drop_rate[1] == 1
    assert np.isnan(report.range_distance[1])
    assert report.range_error == 0, "the other beams are equal"
    lines = str(report).splitlines()
    assert len(lines) == 3 + 2
    assert "100.0%" in lines[2] and "+0.00°" in lines[2] and "nan" in lines[2]
    both = compare_beams(gathered((distance, blocked)), gathered((distance, blocked)))
    assert both.range_distance[1] == 0, "a beam that is silent in both sets is no difference"


def test_errors_say_both_sides():
    with pytest.raises(ValueError, match=r"\(B, 3, W\), found \(2, 64\)"):
        BeamCounts(SENSOR).update(np.ones((2, 64)), np.ones((2, 64)))
    with pytest.raises(ValueError, match="NaN, infinity or below 0"):
        BeamCounts(SENSOR).update(np.full((3, 64), np.nan), np.ones((3, 64)))
    with pytest.raises(ValueError, match="one sensor and step"):
        BeamCounts(SENSOR).merge(BeamCounts(SENSOR, step=1.0))
    with pytest.raises(ValueError, match="images on both sides, found 0 and 64"):
        compare_beams(BeamCounts(SENSOR), gathered(*[(np.ones((3, 64)), np.ones((3, 64)))]))


def test_beams_that_return_on_one_side_only_are_told():
    distance, mask = images(4)
    silent = mask.copy()
    silent[:, 1] = False
    report = compare_beams(gathered((distance * silent, silent)), gathered((distance, mask)))
    assert report.range_error == 0.0 and "; 1 of 3 beams return on one side only" in str(report).splitlines()[-1]
    assert "one side" not in str(compare_beams(gathered((distance, mask)), gathered((distance, mask))))
