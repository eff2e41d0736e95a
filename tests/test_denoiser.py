"""Predictions, losses and weights: reference values, inverse pairs, and what the network is given."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from lidarsynth.diffusion.denoiser import KINDS, LOSSES, Denoiser, masked_mean, min_snr_weight, target, to_x_0
from lidarsynth.diffusion.schedule import SCHEDULES, Schedule, cosine
from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import Diffusion
from lidarsynth.systems.diffusion.training import generation_loss


def close(actual: Tensor, expected: Tensor) -> None:
    """The fixtures' tight tolerance: 1e-5 of the largest value."""
    assert_close(actual, expected, atol=1e-5 * float(expected.abs().max()), rtol=0)


def noisy(schedule: Schedule, batch: int = 5) -> tuple[Tensor, ...]:
    generator = torch.Generator().manual_seed(0)
    x_0 = torch.rand(batch, 2, 4, 8, generator=generator, dtype=torch.float64) * 2 - 1
    eps = torch.randn(batch, 2, 4, 8, generator=generator, dtype=torch.float64)
    t = torch.linspace(0, 1, batch, dtype=torch.float64)
    _, alpha, sigma = schedule.at(t, x_0)
    return x_0, eps, t, alpha, sigma


@pytest.mark.parametrize("name", sorted(SCHEDULES))
@pytest.mark.parametrize("kind", sorted(KINDS))
def test_to_x_0_inverts_target(kind, name):
    x_0, eps, _, alpha, sigma = noisy(SCHEDULES[name]())
    x_t = alpha * x_0 + sigma * eps
    assert_close(to_x_0(kind, x_t, target(kind, x_0, eps, alpha, sigma), alpha, sigma), x_0, atol=1e-8, rtol=0)


@pytest.mark.parametrize("kind", ["eps", "x_0", "v"])
def test_target_and_weights_equal_the_reference(fixture_tensors, kind):
    losses, schedule = fixture_tensors("diffusion/losses"), fixture_tensors("diffusion/schedule")
    _, alpha, sigma = cosine().at(losses["steps"], losses["x_0"])
    close(target(kind, losses["x_0"], losses["noise"], alpha, sigma), losses[f"target.{kind}"])
    for t, prefix, values in ((losses["steps"], "per_sample_weight", losses), (schedule["t"], "loss_weight", schedule)):
        log_snr = cosine().log_snr(t)
        alpha, sigma = cosine().alpha_sigma(log_snr)
        for key, gamma in (("minsnr1", 5.0), ("minsnr0", math.inf)):
            expected = values[f"{prefix}.{kind}.{key}"]
            assert_close(min_snr_weight(kind, log_snr, alpha, sigma, gamma), expected, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("use_mask", [0, 1])
@pytest.mark.parametrize(("min_snr", "gamma"), [(0, math.inf), (1, 5.0)])
@pytest.mark.parametrize("loss", sorted(LOSSES))
@pytest.mark.parametrize("kind", ["eps", "x_0", "v"])
def test_loss_equals_the_reference(fixture_tensors, kind, loss, min_snr, gamma, use_mask):
    values = fixture_tensors("diffusion/losses")
    key = f"{kind}.{loss}.minsnr{min_snr}.mask{use_mask}"
    denoiser = Denoiser(lambda x_t, log_snr: values["model_output"], cosine(), kind)
    x_0, t, eps = values["x_0"], values["steps"], values["noise"]
    mask = values["loss_mask"] if use_mask else None
    close(denoiser.loss(x_0, t, eps, mask, loss, gamma=None), values[f"per_sample_loss.{key}"])
    weighted = denoiser.loss(x_0, t, eps, mask, loss, gamma)
    close(weighted.mean(), values[f"weighted_per_sample_loss.{key}"])
    weight = min_snr_weight(kind, *cosine().at(t, t), gamma)  # R2DM's program pairs every loss with every weight
    as_released = denoiser.loss(x_0, t, eps, mask, loss, gamma=None).mean() * weight.mean()
    close(as_released, values[f"reference_loss.{key}"])
    if not use_mask and min_snr:
        diffusion = Diffusion(kind=kind, loss=loss, gamma=gamma, mean_weight=True)
        experiment = replace(preset("r2dm-h"), diffusion=diffusion)
        close(generation_loss(experiment, denoiser, x_0, t, eps, t).mean(), values[f"reference_loss.{key}"])


@pytest.mark.parametrize("name", ["cosine", "flow"])
@pytest.mark.parametrize("kind", sorted(KINDS))
def test_weighted_loss_is_one_for_all_kinds(kind, name):
    """The weight turns a squared error of any kind into the same squared error of x_0, times min(snr, gamma)."""
    x_0, eps, t, alpha, sigma = noisy(SCHEDULES[name]())
    x_0_wrong = x_0 + 0.1
    eps_wrong = (alpha * x_0 + sigma * eps - alpha * x_0_wrong) / sigma
    said = target(kind, x_0_wrong, eps_wrong, alpha, sigma)
    loss = Denoiser(lambda x_t, log_snr: said, SCHEDULES[name](), kind).loss(x_0, t, eps)
    assert_close(loss, 0.01 * SCHEDULES[name]().log_snr(t).exp().clamp(max=5), rtol=1e-5, atol=1e-12)


def test_network_receives_log_snr_and_condition():
    seen = []

    def network(x_t: Tensor, log_snr: Tensor, *condition: Tensor) -> Tensor:
        seen.append((x_t, log_snr, *condition))
        return torch.zeros_like(x_t).half()

    x_t, t = torch.randn(3, 2, 4, 8), torch.tensor([0.0, 0.5, 1.0])
    known, mask = torch.rand(3, 2, 4, 8), torch.ones(3, 2, 4, 8)
    denoiser = Denoiser(network, cosine())
    assert denoiser(x_t, t).dtype == torch.float32
    conditioned = denoiser.given(known, mask)
    conditioned(x_t, t)
    conditioned.loss(x_t, t, x_t)
    assert [len(call) for call in seen] == [2, 4, 4]
    assert seen[1][0] is x_t and seen[1][2] is known and seen[1][3] is mask
    assert_close(seen[0][1], cosine().log_snr(t))
    assert denoiser.condition == ()
    with pytest.raises(ValueError, match="one shape"):
        denoiser.given(known, mask[:, :1])


def test_clip_bounds_the_estimate():
    x_t, t = 3 * torch.randn(2, 2, 4, 8), torch.tensor([0.5, 1.0])
    free = Denoiser(lambda x_t, log_snr: torch.zeros_like(x_t), cosine(), clip=False)(x_t, t)
    clipped = Denoiser(lambda x_t, log_snr: torch.zeros_like(x_t), cosine())(x_t, t)
    assert float(free.abs().max()) > 1000
    assert_close(clipped, free.clamp(-1, 1))


def test_masked_mean_counts_known_pixels_only():
    values = torch.arange(16.0).view(2, 2, 2, 2)
    mask = torch.tensor([[[[1, 0], [0, 0]]], [[[1, 1], [0, 0]]]], dtype=torch.bool)  # one mask for both channels
    assert_close(masked_mean(values, mask), torch.tensor([2.0, 10.5]))
    assert_close(masked_mean(values, torch.zeros(1, 1, 1, 1)), torch.zeros(2))


def test_unknown_words_are_refused():
    with pytest.raises(ValueError, match=r"kind must be one of eps, .*got 'noise'"):
        Denoiser(lambda x_t, log_snr: x_t, cosine(), kind="noise")
    x = torch.zeros(1, 1, 2, 2)
    with pytest.raises(ValueError, match=r"loss must be one of .*got 'l3'"):
        Denoiser(lambda x_t, log_snr: x_t, cosine()).loss(x, torch.zeros(1), x, loss="l3")
