"""Sampling: reference steps and trajectories, exact solutions, orders of convergence, independence of the batch."""

import math
from functools import partial
from itertools import pairwise

import oracle
import pytest
import torch
from oracles import gaussian_denoiser, gaussian_flow, mixture_denoiser
from torch import Tensor
from torch.testing import assert_close

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.samplers import (
    STEPS,
    State,
    ddim,
    ddpm,
    dpmpp_2m,
    even_log_snr,
    even_times,
    generators,
    heun,
    noise_like,
    sample,
    sde_dpmpp_2m,
    starting_noise,
)
from lidarsynth.diffusion.schedule import SCHEDULES, cosine, flow, ve
from lidarsynth.networks.efficient_unet import EfficientUNet

DOUBLE = torch.float64


def tiny_denoiser(reference) -> Denoiser:
    """The reference's small network of config H (fixtures/r2dm/tiny_H.pth), EMA weights."""
    checkpoint = torch.load(reference / "fixtures/r2dm/tiny_H.pth", weights_only=True)
    cfg = checkpoint["cfg"]["model"]
    network = EfficientUNet(
        resolution=checkpoint["cfg"]["data"]["resolution"],
        base_channels=cfg["base_channels"],
        channel_multipliers=cfg["channel_multiplier"],
        num_residual_blocks=cfg["num_residual_blocks"],
        gn_num_groups=cfg["gn_num_groups"],
        attn_num_heads=cfg["attn_num_heads"],
        coords_encoding=cfg["coords_encoding"],
    ).eval()
    weights = {key.removeprefix("model."): value for key, value in checkpoint["ema_weights"].items()}
    network.load_state_dict({key: value for key, value in weights.items() if key != "_dummy"})
    return Denoiser(network, cosine(), kind="eps")


def close_trajectory(actual: Tensor, expected: Tensor) -> None:
    """The fixtures' tolerance: 2e-3 of the largest value, and 99.9 % of the values within 1e-4 of it."""
    most = oracle.largest(expected)
    oracle.assert_close(actual, expected, atol=2e-3 * most, rtol=0)
    off = (actual - expected).abs()[~expected.isnan()]
    assert float((off <= 1e-4 * most).double().mean()) >= 0.999


@pytest.mark.parametrize("clip", [0, 1])
@pytest.mark.parametrize("kind", ["eps", "x_0", "v"])
@pytest.mark.parametrize("name", ["ddpm", "ddim.eta0", "ddim.eta0.5", "ddim.eta1"])
def test_steps_equal_the_reference(fixture_tensors, name, kind, clip):
    steps = fixture_tensors("diffusion/steps")
    step = ddpm if name == "ddpm" else partial(ddim, eta=float(name.removeprefix("ddim.eta")))
    denoiser = Denoiser(lambda x_t, log_snr: steps["model_output"], cosine(), kind, clip=bool(clip))
    x_s, x_0_hat = step(denoiser, steps["x_t"], steps["step_t"], steps["step_s"], lambda x: steps["noise"], None)
    expected = steps[f"p_step.{name}.{kind}.clip{clip}"]
    for one, one_expected in zip(x_s, expected, strict=True):  # each sample by its own largest value
        assert_close(one, one_expected, atol=1e-5 * float(one_expected.abs().max()), rtol=0)
    assert x_0_hat.shape == x_s.shape


@pytest.mark.parametrize("name", ["ddpm", "ddim_eta0", "ddim_eta0.5", "ddim_eta1"])
def test_trajectories_equal_the_reference(reference, fixture_tensors, name):
    values = fixture_tensors("r2dm/tiny_H_trajectories")
    step = ddpm if name == "ddpm" else partial(ddim, eta=float(name.removeprefix("ddim_eta")))
    x_1, *noises = values["sample.noise_sequence"]
    rest = iter(noises)
    states = list(sample(tiny_denoiser(reference), x_1, step, 3, lambda x: next(rest)))
    assert next(rest, None) is None  # every noise was used, also where eta = 0
    oracle.assert_close(states[0].x_t, values[f"{name}.states"][0])
    for state, expected in zip(states, values[f"{name}.states"][1:], strict=True):
        close_trajectory(state.x_s, expected)


def test_generators_draw_the_reference_noise(fixture_tensors):
    expected = fixture_tensors("r2dm/tiny_H_trajectories")["sample.noise_sequence"]
    rng = generators(seed=0, count=2)
    assert torch.equal(torch.stack([noise_like(expected[0], rng) for _ in expected]), expected)


def test_ddpm_is_a_draw_from_the_posterior():
    """The ancestral step in the papers' own words (mean and variance of q(x_s | x_t, x_0)) equals DDIM with eta = 1."""
    schedule, generator = cosine(), torch.Generator().manual_seed(0)
    x_t = torch.randn(6, 2, 4, 8, generator=generator, dtype=DOUBLE)
    noise = torch.randn(6, 2, 4, 8, generator=generator, dtype=DOUBLE)
    t = torch.tensor([1.0, 0.9, 0.5, 0.3, 0.1, 0.02], dtype=DOUBLE)
    s = torch.tensor([0.97, 0.2, 0.4, 0.0, 0.0, 0.01], dtype=DOUBLE)
    denoiser = gaussian_denoiser(schedule)
    (log_snr_t, alpha_t, _), (log_snr_s, alpha_s, sigma_s) = schedule.at(t, x_t), schedule.at(s, x_t)
    c = -torch.expm1(log_snr_t - log_snr_s)
    expected = alpha_s * (x_t * (1 - c) / alpha_t + c * denoiser(x_t, t)) + sigma_s * c.sqrt() * noise
    assert_close(ddpm(denoiser, x_t, t, s, lambda x: noise, None)[0], expected)
    assert_close(ddim(denoiser, x_t, t, s, lambda x: noise, eta=1)[0], expected)


def test_ddim_on_the_straight_schedule_is_eulers_step():
    x_t, velocity = torch.randn(3, 2, 4, 8, generator=torch.Generator().manual_seed(0)), torch.ones(3, 2, 4, 8)
    t, s = torch.tensor([1.0, 0.6, 0.2]), torch.tensor([0.7, 0.5, 0.0])
    denoiser = Denoiser(lambda x_t, log_snr: velocity, flow(), kind="velocity", clip=False)
    x_s, _ = ddim(denoiser, x_t, t, s, torch.Generator(), eta=0)
    assert_close(x_s, x_t + (s - t).view(3, 1, 1, 1) * velocity, atol=3e-6, rtol=0)


@pytest.mark.parametrize("schedule", ["cosine", "linear", "flow", "ve", "cosine-shifted", "cosine-interpolated"])
@pytest.mark.parametrize(("name", "order"), [("ddim", 1), ("dpmpp-2m", 2), ("heun", 2)])
def test_order_of_convergence(name, order, schedule):
    """Errors against the exact probability flow fall by 2^order when the number of steps doubles."""
    chosen = SCHEDULES[schedule]()
    denoiser, rng = gaussian_denoiser(chosen), generators(0, 4)
    x_1 = torch.tensor([1.7, -0.4, 0.9, 0.1], dtype=DOUBLE).view(4, 1, 1, 1)
    one = torch.ones(4, dtype=DOUBLE)
    exact = gaussian_flow(chosen, x_1, one, 0 * one)
    errors = []
    for steps in (64, 128):
        *_, last = sample(denoiser, x_1, STEPS[name], steps, rng, even_log_snr)
        errors.append(float((last.x_s - exact).abs().max()))
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15)
    assert errors[1] < {1: 6e-2, 2: 4e-3}[order]


def test_fresh_noise_of_second_order_spreads_as_the_data_in_few_steps():
    """Of Gaussian data; and it takes off what went wrong at first, which a deterministic step carries to the end."""
    denoiser, spreads = gaussian_denoiser(cosine()), {}
    for name in ("ddpm", "sde-dpmpp-2m", "dpmpp-2m"):
        rng = torch.Generator().manual_seed(0)
        x_1 = starting_noise(denoiser, torch.zeros(1, 1, 128, 256), rng)
        for wrong in (0.0, 1.0):
            *_, last = sample(denoiser, x_1 + wrong, STEPS[name], 12, rng, even_log_snr)
            spreads[name, wrong] = float(last.x_s.mean()), float(last.x_s.std())
    *_, fine = sample(denoiser, x_1, ddpm, 1000, rng, even_log_snr)
    mean, std = float(fine.x_s.mean()), float(fine.x_s.std())
    off = {name: abs(spreads[name, 0.0][1] / std - 1) for name in ("ddpm", "sde-dpmpp-2m")}
    assert off["sde-dpmpp-2m"] < 0.05 < off["ddpm"]
    moved = {name: abs(spreads[name, 1.0][0] - mean) / std for name in ("sde-dpmpp-2m", "dpmpp-2m")}
    assert moved["sde-dpmpp-2m"] < 0.1 < moved["dpmpp-2m"]


def test_fresh_noise_goes_from_none_to_all_of_it_and_may_be_larger():
    """With eta 0 the deterministic step, with 1 and no estimate before it the ancestral one; s_noise enlarges noise."""
    denoiser, noise = gaussian_denoiser(cosine()), torch.randn(3, 2, 4, 8, generator=torch.Generator().manual_seed(1))
    x_t, (t, s) = (
        torch.randn(3, 2, 4, 8, generator=torch.Generator().manual_seed(0)),
        torch.tensor([[0.7] * 3, [0.6] * 3]),
    )
    before = State(0, t + 0.1, t, x_t, x_t, x_t / 2)

    def step(previous=None, **how):
        return sde_dpmpp_2m(denoiser, x_t, t, s, lambda x: noise, previous, **how)[0]

    assert_close(step(before, eta=0.0), dpmpp_2m(denoiser, x_t, t, s, lambda x: noise, before)[0])
    assert_close(step(eta=1.0), ddpm(denoiser, x_t, t, s, lambda x: noise)[0])
    log_snr, _, sigma = cosine().at(s, x_t)
    h = log_snr - cosine().at(t, x_t)[0]
    assert_close(step(eta=0.5, s_noise=1.1) - step(eta=0.5), 0.1 * sigma * (1 - torch.exp(-h / 2)).sqrt() * noise)


@pytest.mark.parametrize("name", sorted(STEPS))
def test_samples_have_the_distribution_of_the_data(name):
    """Two modes at -0.5 (30 %) and 0.5 (70 %) with std 0.05: shares, means and spreads come out."""
    means, weights = torch.tensor([-0.5, 0.5]), torch.tensor([0.3, 0.7])
    denoiser = mixture_denoiser(cosine(), means, weights)
    rng = torch.Generator().manual_seed(0)
    x_1 = starting_noise(denoiser, torch.zeros(1, 1, 64, 128), rng)
    *_, last = sample(denoiser, x_1, STEPS[name], 256, rng, even_log_snr)
    low, high = last.x_s[last.x_s < 0], last.x_s[last.x_s > 0]
    assert len(low) / last.x_s.numel() == pytest.approx(0.3, abs=0.01)
    for mode, mean in ((low, -0.5), (high, 0.5)):
        assert float(mode.mean()) == pytest.approx(mean, abs=0.003)
        assert float(mode.std()) == pytest.approx(0.05, abs=0.003)


@pytest.mark.parametrize("name", sorted(STEPS))
def test_samples_do_not_depend_on_the_batch(name):
    denoiser = gaussian_denoiser(cosine())

    def run(seed: int, count: int, offset: int = 0) -> Tensor:
        rng = generators(seed, count, offset)
        x_1 = starting_noise(denoiser, torch.zeros(count, 2, 4, 8), rng)
        *_, last = sample(denoiser, x_1, STEPS[name], 5, rng)
        return last.x_s

    together = run(7, 4)
    assert torch.equal(together, torch.cat([run(7, 1), run(7, 3, offset=1)]))
    assert torch.equal(together[2:], run(9, 2))
    assert not torch.equal(together[0], together[1])


def test_states_join_and_take_no_gradients():
    weight = torch.ones(1, requires_grad=True)
    denoiser = Denoiser(lambda x_t, log_snr: weight * x_t, cosine(), kind="v")
    states = list(sample(denoiser, torch.ones(2, 1, 2, 2), ddpm, 4, torch.Generator()))
    assert [state.index for state in states] == [0, 1, 2, 3]
    assert_close(torch.stack([state.t for state in states])[:, 0], torch.tensor([1.0, 0.75, 0.5, 0.25]))
    assert_close(states[-1].s, torch.zeros(2))
    assert all(before.x_s is after.x_t for before, after in pairwise(states))
    assert not states[-1].x_s.requires_grad
    assert torch.is_grad_enabled()


def test_noise_sources():
    x = torch.zeros(3, 2, 4, 8)
    assert torch.equal(noise_like(x, torch.ones_like), torch.ones_like(x))
    assert torch.equal(
        noise_like(x, torch.Generator().manual_seed(1)),
        torch.randn(x.shape, generator=torch.Generator().manual_seed(1)),
    )
    assert noise_like(x.double(), generators(0, 3)).dtype == DOUBLE
    assert_close(noise_like(x.double(), generators(0, 3)).float(), noise_like(x, generators(0, 3)))
    with pytest.raises(ValueError, match="one generator or 3, one per sample, got 2"):
        noise_like(x, generators(0, 2))


@pytest.mark.parametrize("grid", [even_times, even_log_snr])
@pytest.mark.parametrize("schedule", sorted(SCHEDULES))
def test_grids_fall_from_one_to_zero(grid, schedule):
    times = grid(SCHEDULES[schedule](), 10)
    assert times.shape == (11,) and float(times[0]) == 1 and float(times[-1]) == 0
    assert bool((times.diff() < 0).all())


def test_grid_spacing():
    assert_close(even_times(cosine(), 4), torch.tensor([1, 0.75, 0.5, 0.25, 0], dtype=DOUBLE))
    log_snr = cosine().log_snr(even_log_snr(cosine(), 6))
    assert_close(log_snr, torch.linspace(-15, 15, 7, dtype=DOUBLE), atol=1e-9, rtol=0)


def test_starting_noise_has_the_schedule_scale():
    x = torch.zeros(1, 1, 64, 64)
    denoiser = gaussian_denoiser(ve(0.01, 50))
    assert_close(starting_noise(denoiser, x, generators(0, 1)), 50 * noise_like(x, generators(0, 1)))
    for name in ("cosine", "linear", "flow"):
        plain = starting_noise(gaussian_denoiser(SCHEDULES[name]()), x, generators(0, 1))
        assert torch.equal(plain, noise_like(x, generators(0, 1)))


def test_no_steps_is_refused():
    with pytest.raises(ValueError, match="steps must be at least 1, got 0"):
        next(sample(gaussian_denoiser(cosine()), torch.zeros(1, 1, 2, 2), heun, 0, torch.Generator()))


def test_times_that_float32_cannot_tell_apart_are_refused():
    x = torch.zeros(1, 1, 2, 2)
    with pytest.raises(ValueError, match="times must fall at every step"):
        next(sample(gaussian_denoiser(flow()), x, heun, 1024, torch.Generator(), even_log_snr))
    next(sample(gaussian_denoiser(flow()), x.double(), heun, 1024, torch.Generator(), even_log_snr))
