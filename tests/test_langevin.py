"""Annealed Langevin dynamics: parity with LiDARGen's sampler, and distributions that are known."""

import json
import math

import pytest
import torch
from oracle import assert_within
from oracles import gaussian_denoiser
from torch import Tensor

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.langevin import evaluations, langevin, langevin_posterior, starting_uniform
from lidarsynth.diffusion.samplers import even_log_snr, starting_noise
from lidarsynth.diffusion.schedule import Schedule, cosine, ve
from lidarsynth.networks.refinenet import from_official


def assert_net(actual: Tensor, expected: Tensor) -> None:
    assert_within(actual, expected, 1e-4)


@pytest.fixture
def trajectories(fixture_tensors):
    return fixture_tensors("lidargen/langevin")


@pytest.fixture(scope="module")
def denoiser(official_file):
    path = official_file("lidargen/checkpoint_100.pth")
    return Denoiser(from_official(torch.load(path, weights_only=True)), ve(), "score", clip=False)


@pytest.fixture
def numbers(reference):
    stated = json.loads((reference / "fixtures" / "lidargen" / "info.json").read_text())["langevin"]
    return {"levels": stated["n_levels"], "steps": stated["n_steps_each"], "rate": stated["step_lr"] / 0.01**2}


def sequence(noise: Tensor):
    """The stored noises, one per step."""
    draws = iter(noise)
    return lambda x: next(draws)


def test_the_levels_of_ve_are_lidargens(trajectories):
    _, _, sigma = ve().at(torch.linspace(1, 0, 232), torch.zeros(232, 1))
    torch.testing.assert_close(sigma[:, 0], trajectories["sigmas_full"], atol=0, rtol=5e-6)


@pytest.mark.parametrize("level", [0, 100, 231])
def test_one_step_equals_the_reference(trajectories, level):
    sigma = trajectories["sigmas_full"][level].item()
    fixed = Denoiser(
        lambda x, log_snr: trajectories["score"], ve(1e-9, sigma) if sigma > 1 else at(sigma), "score", False
    )
    step = next(langevin(fixed, trajectories["x"], lambda x: trajectories["noise"]))
    assert_net(step.x_s, trajectories[f"one_step.level{level}"])


def at(sigma: float):
    """A schedule that starts at a noise level below 1, which `ve` does not allow."""
    whole = ve(0.01 * sigma, 1.0)
    return type(whole)(lambda t: whole.log_snr(t) - 2 * math.log(sigma), whole.t, whole.alpha_sigma)


def test_the_chain_equals_the_reference(trajectories, denoiser, numbers):
    states = [*langevin(denoiser, trajectories["chain.init"], sequence(trajectories["chain.noise"]), **numbers)]
    expected = trajectories["chain.states_then_denoised"]
    assert len(states) == len(expected) == evaluations(numbers["levels"], numbers["steps"])
    for state, image in zip(states, expected, strict=True):
        assert_net(state.x_s, image)


def test_densification_equals_the_reference(trajectories, denoiser, numbers):
    known, mask = trajectories["densify.reference"], torch.zeros(2, 1, 64, 32)
    mask[:, :, ::4] = 1
    noise = sequence(trajectories["densify.noise"])
    states = [*langevin_posterior(denoiser, trajectories["chain.init"], known, mask, noise, **numbers)]
    expected = trajectories["densify.states_denoised_final"]
    for state, image in zip(states, expected, strict=True):
        assert_net(state.x_s, image)
    torch.testing.assert_close(states[-1].x_s[:, :, ::4], known[:, :, ::4], atol=1e-6, rtol=0)


def test_the_loss_is_lidargens(fixture_tensors):
    stored = fixture_tensors("lidargen/loss")
    denoiser = Denoiser(lambda x, log_snr: stored["score"], ve(), "score")
    t = 1 - stored["labels"] / 231
    loss = denoiser.loss(stored["samples"], t, stored["noise"], gamma=torch.inf)  # a mean, theirs half the sum
    half_sum = 0.5 * stored["samples"][0].numel() * loss
    assert_net(half_sum, stored["per_sample_loss"])
    assert_net(half_sum.mean(), stored["loss"])


def expected_spread(schedule: Schedule, rate: float, std: float = 0.4) -> float:
    """The standard deviation that 232 x 5 steps make of pixels from N(., std^2): the variance of x / alpha, by hand."""
    _, alphas, sigmas = schedule.at(even_log_snr(schedule, 231), torch.zeros(232, 1, dtype=torch.float64))
    ratios = (sigmas / alphas).flatten().tolist()
    variance = max(ratios[0], sigmas[0].item()) ** 2
    for ratio in ratios:
        for _ in range(5):
            shrink = 1 - rate * ratio**2 / (std**2 + ratio**2)
            variance = shrink**2 * variance + 2 * rate * ratio**2
    return math.sqrt(variance) * std**2 / (std**2 + ratios[-1] ** 2)


@pytest.mark.parametrize("schedule", [ve(), cosine()], ids=["ve", "cosine"])
@pytest.mark.parametrize("rate", [0.062, 0.02])
def test_gaussian_data_come_out_as_the_closed_form_says(schedule, rate):
    denoiser, rng = gaussian_denoiser(schedule), torch.Generator().manual_seed(0)
    x_1 = starting_noise(denoiser, torch.zeros(2, 1, 64, 64), rng)
    *_, last = langevin(denoiser, x_1, rng, rate=rate, grid=even_log_snr)
    assert abs(last.x_s.mean().item() - 0.3) < 0.02
    spread = expected_spread(schedule, rate)
    assert 0.4 < spread < 0.7  # cooled in finite time, the samples are warmer than the data
    assert abs(last.x_s.std().item() / spread - 1) < 0.02


def test_one_level_has_the_stationary_spread_of_the_closed_form():
    # data at the single point 0: x <- (1 - rate) x + sqrt(2 rate) sigma z, hence var = sigma^2 / (1 - rate / 2)
    denoiser = Denoiser(lambda x, log_snr: torch.zeros_like(x), ve(0.9999, 1.0), "x_0")
    rng = torch.Generator().manual_seed(1)
    x_1 = torch.zeros(1, 1, 128, 128)
    *_, before, last = langevin(denoiser, x_1, rng, levels=2, steps=60, rate=0.4)
    assert abs(before.x_s.var().item() - 1 / (1 - 0.4 / 2)) < 0.03
    assert torch.equal(last.x_s, x_1)


@pytest.mark.parametrize("schedule", [ve(), cosine()], ids=["ve", "cosine"])
def test_known_pixels_end_as_given_and_the_rest_is_sampled(schedule):
    denoiser, rng = gaussian_denoiser(schedule), torch.Generator().manual_seed(0)
    known, mask = torch.rand(1, 2, 32, 32), torch.zeros(1, 1, 32, 32)
    mask[:, :, ::4] = 1
    x_1 = starting_noise(denoiser, known, rng)
    *_, last = langevin_posterior(denoiser, x_1, known, mask, rng, grid=even_log_snr)
    torch.testing.assert_close(last.x_s[:, :, ::4], known[:, :, ::4], atol=1e-5, rtol=0)
    rest = last.x_s[mask.expand_as(known) == 0]
    assert abs(rest.mean().item() - 0.3) < 0.05
    assert abs(rest.std().item() - 0.4) < 0.05


def test_the_start_is_uniform_and_its_own_per_sample():
    draws = [torch.Generator().manual_seed(seed) for seed in (3, 4)]
    x = starting_uniform(torch.zeros(2, 1, 64, 64), draws, -1, 1)
    assert -1 <= x.min() < -0.99 and 0.99 < x.max() <= 1
    assert abs(x.var().item() - 1 / 3) < 0.02
    alone = starting_uniform(torch.zeros(1, 1, 64, 64), [torch.Generator().manual_seed(4)], -1, 1)
    assert torch.equal(alone[0], x[1])


def test_lidargen_calls_the_network_1161_times():
    calls = []
    denoiser = Denoiser(lambda x, log_snr: calls.append(1) or torch.zeros_like(x), ve(), "score")
    assert len([*langevin(denoiser, torch.zeros(1, 1, 2, 2), lambda x: x)]) == len(calls) == evaluations() == 1161


def test_errors_say_both_sides():
    denoiser, x = gaussian_denoiser(ve()), torch.zeros(1, 2, 4, 4)
    rng = torch.Generator()
    with pytest.raises(ValueError, match="levels must be at least 2 and steps at least 1, got 1 and 5"):
        next(langevin(denoiser, x, rng, levels=1))
    with pytest.raises(ValueError, match=r"rate must be in \(0, 1\], got 2"):
        next(langevin(denoiser, x, rng, rate=2))
    with pytest.raises(ValueError, match=r"mask must be \(1, 2, 4, 4\) or \(1, 1, 4, 4\), got \(1, 3, 4, 4\)"):
        next(langevin_posterior(denoiser, x, x, torch.zeros(1, 3, 4, 4), rng))


@pytest.mark.parametrize("weight", [0.25, 1.0])
def test_the_weight_is_the_share_of_the_way_to_known_pixels_in_every_step(weight):
    """Without noise, and told that every image is clean, only the pull of the known pixels moves anything."""
    still = Denoiser(lambda x_t, log_snr: x_t, ve(), "x_0", clip=False)
    x_1, known = torch.rand(2, 1, 2, 4, 8, generator=torch.Generator().manual_seed(0))
    mask = torch.zeros(1, 1, 4, 8)
    mask[..., ::2] = 1
    *_, last = langevin_posterior(still, x_1, known, mask, torch.zeros_like, weight, levels=2, steps=2)
    left = 1 - weight  # of the way, after each of four steps; the last pull but one is that of the fourth step again
    rest = left * (left**4 - weight * left**3)
    torch.testing.assert_close(last.x_s, x_1 + mask * (1 - rest) * (known - x_1), atol=1e-5, rtol=0)
