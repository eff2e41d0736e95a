"""RePaint: reference trajectories, the number of evaluations, known pixels, and a conditional law in closed form."""

from functools import partial

import oracle
import pytest
import torch
from oracles import gaussian_denoiser
from test_samplers import close_trajectory, tiny_denoiser
from torch import Tensor
from torch.testing import assert_close

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.repaint import evaluations, repaint
from lidarsynth.diffusion.samplers import STEPS, ddim, generators
from lidarsynth.diffusion.schedule import cosine


@pytest.mark.parametrize("jump", [1, 2])
def test_equals_the_reference(reference, fixture_tensors, jump):
    values = fixture_tensors("r2dm/tiny_H_trajectories")
    expected = values[f"repaint.jump{jump}.states"]
    x_1, *noises = values[f"repaint.jump{jump}.noise_sequence"]
    rest = iter(noises)
    known, mask = values["repaint.known"], values["repaint.mask"]
    denoiser = tiny_denoiser(reference)
    states = list(repaint(denoiser, x_1, known, mask, lambda x: next(rest), steps=3, resamples=3, jump=jump))
    oracle.assert_close(states[0].x_t, expected[0])
    for state, one in zip(states[jump - 1 :: jump], expected[1:], strict=True):
        close_trajectory(state.x_s, one)
    assert next(rest, None) is None  # every noise was used


@pytest.mark.parametrize(("steps", "resamples", "jump"), [(1, 1, 1), (1, 5, 2), (4, 1, 1), (4, 3, 1), (3, 2, 4)])
def test_number_of_evaluations(steps, resamples, jump):
    calls = []

    def network(x_t: Tensor, log_snr: Tensor) -> Tensor:
        calls.append(log_snr)
        return x_t

    x = torch.zeros(2, 2, 4, 8)
    rng = generators(0, 2)
    run = repaint(Denoiser(network, cosine()), x, x, x, rng, steps=steps, resamples=resamples, jump=jump)
    states = list(run)
    assert len(calls) == len(states) == evaluations(steps, resamples, jump) == ((steps - 1) * resamples + 1) * jump
    assert [state.index for state in states] == list(range(len(states)))
    assert float(states[-1].s[0]) == 0


def test_paper_setting_takes_311_evaluations():
    assert evaluations() == 311


@pytest.mark.parametrize("name", sorted(STEPS))
def test_known_pixels_return_with_sigma_0(name):
    known = torch.rand(2, 2, 8, 16, generator=torch.Generator().manual_seed(0)) * 2 - 1
    mask = torch.zeros(2, 2, 8, 16, dtype=torch.bool)
    mask[:, 0, ::4] = True  # range and reflectance are known at different pixels
    mask[:, 1, 1::2] = True
    spoiled = torch.where(mask, known, torch.nan)  # unknown pixels may hold anything
    x_1 = torch.randn(2, 2, 8, 16, generator=torch.Generator().manual_seed(1))
    denoiser, rng = gaussian_denoiser(cosine()), generators(0, 2)
    *_, last = repaint(denoiser, x_1, spoiled, mask, rng, STEPS[name], steps=4, resamples=2)
    assert bool(last.x_s.isfinite().all())
    assert_close(last.x_s[mask], known[mask], atol=6 * 5.6e-4, rtol=0)
    assert float((last.x_s - known)[~mask].abs().min()) > 0


def test_everything_known_or_nothing_known():
    x_1 = torch.randn(2, 1, 4, 8, generator=torch.Generator().manual_seed(1))
    known, all_known = torch.full_like(x_1, 0.5), torch.ones(2, 1, 4, 8)
    denoiser = gaussian_denoiser(cosine())
    *_, full = repaint(denoiser, x_1, known, all_known, generators(0, 2), steps=3, resamples=1)
    *_, empty = repaint(denoiser, x_1, known, 0 * all_known, generators(0, 2), steps=3, resamples=1)
    *_, other = repaint(denoiser, x_1, -known, 0 * all_known, generators(0, 2), steps=3, resamples=1)
    assert_close(full.x_s, known, atol=6 * 5.6e-4, rtol=0)
    assert torch.equal(empty.x_s, other.x_s)  # without known pixels their values cannot matter


def correlated_denoiser(correlation: float = 0.9, std: float = 0.3) -> Denoiser:
    """The exact denoiser of two correlated channels: E[x_0 | x_t] = alpha S (alpha^2 S + sigma^2 I)^-1 x_t."""
    covariance = std**2 * torch.tensor([[1.0, correlation], [correlation, 1.0]])

    def network(x_t: Tensor, log_snr: Tensor) -> Tensor:
        alpha, sigma = (value.view(-1, 1, 1) for value in cosine().alpha_sigma(log_snr))
        gain = alpha * covariance @ torch.linalg.inv(alpha**2 * covariance + sigma**2 * torch.eye(2))
        return torch.einsum("bij,bjhw->bihw", gain, x_t)

    return Denoiser(network, cosine(), kind="x_0")


def test_harmonisation_approaches_the_conditional_law():
    """Channel 0 is known to be 0.4, channel 1 is then N(0.36, 0.13^2): more passes come closer."""
    x_1 = torch.randn(1, 2, 32, 32, generator=torch.Generator().manual_seed(0))
    known, mask = torch.full_like(x_1, 0.4), torch.zeros_like(x_1)
    mask[:, 0] = 1
    run = partial(repaint, correlated_denoiser(), x_1, known, mask, generators(0, 1), steps=64)
    means = []
    for resamples in (1, 10):
        *_, last = run(resamples=resamples)
        means.append(float(last.x_s[:, 1].mean()))
    assert abs(means[1] - 0.36) < abs(means[0] - 0.36) / 2
    assert means[1] == pytest.approx(0.36, abs=0.03)
    assert float(last.x_s[:, 1].std()) == pytest.approx(0.3 * (1 - 0.9**2) ** 0.5, abs=0.03)


def test_one_channel_mask_serves_both_channels():
    x_1 = torch.randn(2, 2, 4, 8, generator=torch.Generator().manual_seed(1))
    mask = torch.zeros(2, 1, 4, 8)
    mask[..., ::2] = 1
    run = partial(repaint, gaussian_denoiser(cosine()), x_1, 0 * x_1, step=ddim, steps=2, resamples=2)
    *_, one = run(mask=mask, rng=generators(0, 2))
    *_, two = run(mask=mask.expand_as(x_1), rng=generators(0, 2))
    assert torch.equal(one.x_s, two.x_s)


def test_arguments_that_do_not_fit_are_refused():
    x, rng, denoiser = torch.zeros(2, 2, 4, 8), generators(0, 2), gaussian_denoiser(cosine())
    for known, mask, counts, message in (
        (x[:1], x, {}, r"known must have the shape of x_1, \(2, 2, 4, 8\), got \(1, 2, 4, 8\)"),
        (x, x[0], {}, r"mask must be \(2, 2, 4, 8\) or \(2, 1, 4, 8\), got \(2, 4, 8\)"),
        (x, x + 0.5, {}, "mask must hold 0"),
        (x, x, {"resamples": 0}, "at least 1, got 32, 0, 1"),
    ):
        with pytest.raises(ValueError, match=message):
            next(repaint(denoiser, x, known, mask, rng, **counts))
