"""Noise schedules: reference values, inverse pairs, end points, and the forward process."""

import math
import pickle

import pytest
import torch
from torch.testing import assert_close

from lidarsynth.diffusion.schedule import SCHEDULES, cosine, cosine_interpolated, cosine_shifted, flow, renoise, ve

NAMES = sorted(SCHEDULES)
DOUBLE = torch.float64


@pytest.mark.parametrize("name", ["cosine", "linear"])
def test_equals_the_reference(fixture_tensors, name):
    expected = fixture_tensors("diffusion/schedule")
    schedule = SCHEDULES[name]()
    log_snr = schedule.log_snr(expected["t"])
    alpha, sigma = schedule.alpha_sigma(log_snr)
    steep = (expected["t"] < 0.01) | (expected["t"] > 0.99)
    assert_close(log_snr[steep], expected[f"{name}.log_snr"][steep], atol=1e-4, rtol=0)
    assert_close(log_snr[~steep], expected[f"{name}.log_snr"][~steep], atol=1e-5 * 15, rtol=0)
    assert_close(alpha, expected[f"{name}.alpha"], atol=1e-5, rtol=0)
    assert_close(sigma, expected[f"{name}.sigma"], atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float32, 3e-6), (DOUBLE, 1e-10)])
def test_t_inverts_log_snr(name, dtype, atol):
    schedule = SCHEDULES[name]()
    t = torch.linspace(0, 1, 257, dtype=dtype)
    assert_close(schedule.t(schedule.log_snr(t)), t, atol=atol, rtol=0)


@pytest.mark.parametrize("name", NAMES)
def test_a_schedule_can_be_pickled(name):
    again, t = pickle.loads(pickle.dumps(SCHEDULES[name]())), torch.linspace(0, 1, 9)
    assert torch.equal(again.log_snr(t), SCHEDULES[name]().log_snr(t))


@pytest.mark.parametrize("name", SCHEDULES)
def test_log_snr_falls_and_is_that_of_alpha_and_sigma(name):
    schedule = SCHEDULES[name]()
    log_snr = schedule.log_snr(torch.linspace(0, 1, 1001, dtype=DOUBLE))
    alpha, sigma = schedule.alpha_sigma(log_snr)
    assert bool((log_snr.diff() < 0).all()) and bool(log_snr.isfinite().all())
    assert_close(2 * (alpha.log() - sigma.log()), log_snr)


@pytest.mark.parametrize("name", ["cosine", "linear", "cosine-shifted", "cosine-interpolated"])
def test_variance_is_preserved(name):
    schedule = SCHEDULES[name]()
    alpha, sigma = schedule.alpha_sigma(schedule.log_snr(torch.linspace(0, 1, 101)))
    assert_close(alpha**2 + sigma**2, torch.ones(101))


def test_cosine_is_a_quarter_circle_between_its_bounds():
    t = torch.linspace(0, 1, 11, dtype=DOUBLE)
    alpha, sigma = cosine(bound=60).alpha_sigma(cosine(bound=60).log_snr(t))
    assert_close(alpha, torch.cos(math.pi / 2 * t), atol=1e-12, rtol=0)  # R2DM's paper: alpha = cos(pi t / 2)
    assert_close(sigma, torch.sin(math.pi / 2 * t), atol=1e-12, rtol=0)
    assert_close(cosine().log_snr(torch.tensor([0.0, 0.5, 1.0])), torch.tensor([15.0, 0.0, -15.0]), atol=1e-4, rtol=0)


def test_cosine_has_the_roundings_of_the_reference(fixture_tensors):
    """Not required by the tolerance, but seeds of the released models name the same samples only with these digits."""
    expected = fixture_tensors("diffusion/schedule")
    assert_close(cosine().log_snr(expected["t"]), expected["cosine.log_snr"], atol=2e-6, rtol=2e-7)


def test_shifts_follow_the_image_side():
    t = torch.linspace(0, 1, 11)
    plain = cosine().log_snr(t)
    assert_close(cosine_shifted(256).log_snr(t), plain - 2 * math.log(4))
    ends = cosine_interpolated(256, low=32, high=256).log_snr(t) - plain
    assert_close(ends[[0, -1]], torch.tensor([0.0, -2 * math.log(8)]), atol=3e-6, rtol=0)
    with pytest.raises(ValueError, match="positive"):
        cosine_shifted(0)


def test_flow_is_straight():
    t = torch.linspace(0, 1, 101)
    alpha, sigma = flow().alpha_sigma(flow().log_snr(t))
    assert_close(alpha, 1 - t, atol=1e-6, rtol=0)
    assert_close(sigma, t, atol=1e-6, rtol=0)


def test_variance_exploding_is_geometric():
    schedule = ve(0.01, 50)
    alpha, sigma = schedule.alpha_sigma(schedule.log_snr(torch.tensor([0.0, 0.5, 1.0], dtype=DOUBLE)))
    assert_close(alpha, torch.ones(3, dtype=DOUBLE))
    assert_close(sigma, torch.tensor([0.01, math.sqrt(0.5), 50], dtype=DOUBLE))
    with pytest.raises(ValueError, match=r"0 < min < 1 <= max, got 0.01 and 0.5"):
        ve(0.01, 0.5)


def test_variance_is_sigma_squared():
    for name in NAMES:
        schedule = SCHEDULES[name]()
        alpha, sigma = schedule.alpha_sigma(schedule.log_snr(torch.linspace(0, 1, 33, dtype=DOUBLE)))
        assert_close(schedule.variance(alpha, sigma), sigma**2, rtol=1e-8, atol=0)


def test_at_gives_one_value_per_sample_and_refuses_other_times():
    x = torch.zeros(3, 2, 4, 8)
    assert [value.shape for value in cosine().at(torch.rand(3), x)] == [(3, 1, 1, 1)] * 3
    with pytest.raises(ValueError, match=r"t must be \(3,\).*got \(\)"):
        cosine().at(torch.tensor(0.5), x)


def test_renoise_equals_the_reference(fixture_tensors):
    steps = fixture_tensors("diffusion/steps")
    actual = renoise(cosine(), steps["x_t"], steps["step_s"], steps["step_t"], steps["noise"])
    expected = steps["q_step"]
    assert_close(actual, expected, atol=1e-5 * float(expected.abs().max()), rtol=0)
    _, alpha, sigma = cosine().at(steps["step_t"], steps["x_0"])
    expected = steps["q_step_from_x_0"]
    actual = alpha * steps["x_0"] + sigma * steps["noise"]
    assert_close(actual, expected, atol=1e-5 * float(expected.abs().max()), rtol=0)


@pytest.mark.parametrize("name", NAMES)
def test_two_jumps_make_one(name):
    """Mean and variance of x_0 -> s -> t are those of x_0 -> t; this fails with the paper's formula without squares."""
    schedule = SCHEDULES[name]()
    s, t, one, zero = (torch.tensor([value], dtype=DOUBLE) for value in (0.2, 0.7, 1.0, 0.0))
    _, alpha_s, sigma_s = schedule.at(s, one)
    _, alpha_t, sigma_t = schedule.at(t, one)
    scale = renoise(schedule, one, s, t, zero)
    spread = renoise(schedule, zero, s, t, one)
    assert_close(scale * alpha_s, alpha_t)
    assert_close((scale * sigma_s) ** 2 + spread**2, sigma_t**2)
