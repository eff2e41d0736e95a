"""Drafts of a layout begin with pure noise, through which not even how open a scene is shows."""

import pytest
import torch
from torch import Tensor

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.samplers import sample
from lidarsynth.diffusion.schedule import Schedule, flow
from lidarsynth.experiment.presets import PRESETS
from lidarsynth.networks.coarse_unet import BOUND, CoarseUNet
from lidarsynth.systems.cascade.layout import DRAFT, DRAFT_STEPS, DRAFTING, to_draft
from lidarsynth.systems.cascade.training import layout_times
from lidarsynth.weights.load import load


def spread_of_drafts(schedule: Schedule, pixels: int, count: int = 4000) -> float:
    """Variance of drafts over that of true ones at their time, of scenes that differ by one number of unit variance
    that so many pixels share: along it, by the exact coarse network."""

    def velocity(x_t: Tensor, log_snr: Tensor) -> Tensor:
        alpha, sigma = schedule.alpha_sigma(log_snr.view(-1, 1, 1, 1))
        x_0 = alpha * pixels / (alpha**2 * pixels + sigma**2) * x_t
        return (x_t - alpha * x_0) / sigma - x_0

    denoiser, rng = Denoiser(velocity, schedule, "velocity", clip=False), torch.Generator().manual_seed(0)
    x_1 = torch.randn(count, 1, 1, 1, generator=rng, dtype=torch.float64)
    *_, last = sample(denoiser, x_1, DRAFTING, DRAFT_STEPS, rng, to_draft)
    _, alpha, sigma = schedule.at(last.s, last.x_s)
    return float((last.x_s.square() / (alpha**2 * pixels + sigma**2)).mean())


def test_scenes_drawn_from_pure_noise_are_as_unlike_as_true_ones():
    begins = flow(BOUND, PRESETS["default"]().model.noisiest)
    assert spread_of_drafts(flow(BOUND), 3000) < 0.75  # where a network that knows no more noise has to begin
    for pixels in (30, 300, 3000):
        assert spread_of_drafts(begins, pixels) == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize("noisiest", [BOUND, 10.0])
def test_steps_to_a_draft_fall_evenly_from_pure_noise(noisiest: float):
    schedule = flow(BOUND, noisiest)
    times = to_draft(schedule, DRAFT_STEPS)
    assert times[0] == 1 and float(times[-1]) == pytest.approx(DRAFT, abs=1e-9) and bool((times.diff() < 0).all())
    log_snr = schedule.log_snr(times)
    assert float(log_snr[0]) == pytest.approx(-noisiest, abs=1e-4)
    assert float(log_snr.diff().max() - log_snr.diff().min()) < 1e-4


def test_the_coarse_stage_learns_from_pure_noise_on():
    schedule = CoarseUNet(16, (1, 1, 1, 1), 1, noisiest=14.0).schedule
    rngs = [torch.Generator().manual_seed(seed) for seed in range(2000)]
    times = layout_times(schedule, rngs)
    log_snr = schedule.log_snr(times.double())
    deep = (log_snr < -10).double().mean()
    assert 0.03 < float(deep) < 0.1  # of a fifth of the times 4 of 14
    assert float(log_snr.min()) < -13.5 and bool((times > 0).all()) and bool((times <= 1).all())
    assert torch.equal(times[5:6], layout_times(schedule, [torch.Generator().manual_seed(5)]))


def test_new_cascades_begin_with_more_noise_and_old_records_where_they_did():
    model = PRESETS["default"]().model
    assert model.noisiest == 10 and type(model)().noisiest == BOUND


@pytest.mark.parametrize("preset", ["tuned", "kitti"])
def test_what_goes_on_from_the_shipped_model_draws_from_the_noise_that_this_has_learned(preset: str):
    start, shipped = PRESETS[preset](), load("default").experiment
    assert start.base == shipped.name and start.model.noisiest == shipped.model.noisiest
