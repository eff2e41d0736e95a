"""`LidarModel`, the model of a denoiser: generate, complete and upsample scans."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from lidarsynth.diffusion import langevin, repaint
from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.samplers import (
    STEPS,
    Rng,
    State,
    checked_seed,
    even_log_snr,
    generators,
    sample,
    starting_noise,
)
from lidarsynth.experiment.record import Experiment, Score
from lidarsynth.lidar.angles import unit_vectors
from lidarsynth.lidar.depth import from_x_0, to_x_0
from lidarsynth.lidar.mixed_pixels import without_mixed_pixels
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.conditional import ConditionalUNet
from lidarsynth.networks.device import each_usually
from lidarsynth.networks.efficient_unet import EfficientUNet
from lidarsynth.systems.description import Description
from lidarsynth.systems.diffusion.description import DESCRIPTION
from lidarsynth.systems.filling import Filling
from lidarsynth.systems.known_pixels import with_known
from lidarsynth.systems.scan_model import OnStep, ScanModel

METHODS = ("auto", "conditional", "repaint", "posterior")
REPAINT_STEPS, REPAINT_RESAMPLES = 32, 10  # R2DM, section IV-C
SAME_RAYS = 1e-4  # of unit vectors: coordinates in float32 are even ones within it


@dataclass(frozen=True, repr=False)
class LidarModel(ScanModel):
    """A trained denoiser with its sensor.

    network   raw prediction (B, 2, H, W) from x_t (B, 2, H, W) and log_snr (B,)
    denoiser  (x_t, t) -> x_0_hat
    """

    network: nn.Module
    denoiser: Denoiser
    sensor: Sensor
    experiment: Experiment
    description: ClassVar[Description] = DESCRIPTION

    @property
    def conditional(self) -> bool:
        """Whether the network can be told the known pixels."""
        return isinstance(self.network, ConditionalUNet)

    def stream(
        self,
        n: int,
        steps: int | None = None,
        seed: int = 0,
        sampler: str | None = None,
        batch_size: int = 4,
        first: int = 0,
        on_step: OnStep = None,
    ) -> Iterator[RangeImage]:
        """Scans `first` .. n - 1 of `generate`, one after the other, in the memory of one batch.

        steps    network evaluations per scan (twice as many for `heun`; for `langevin` at most as many, in whole noise
                 levels); default 32, or 1161 for `langevin`: 232 levels x 5 and a final denoising
        sampler  ddpm | ddim | dpmpp-2m | sde-dpmpp-2m | heun | langevin; default ddpm, or langevin after score matching

        Raises ValueError for an unknown sampler or counts below 1, or below 11 for `langevin`.
        """
        self._checked(n, steps, seed, sampler, batch_size, first)
        steps = self.generation_steps(steps, sampler)
        size = self.at_once(batch_size)
        return each_usually(self._drawn(n, steps, checked_seed(seed), self._sampler(sampler), size, first, on_step))

    def _drawn(
        self, n: int, steps: int, seed: int, sampler: str, size: int, first: int, on_step: OnStep
    ) -> Iterator[RangeImage]:
        for start in range(first, n, size):
            rng = generators(seed, size, offset=start)  # also of the last batch: a smaller one would round differently
            x_1 = self._start(self._blank(size), rng, sampler == "langevin")
            for x in _last(self._states(self.denoiser, x_1, rng, sampler, steps), on_step)[: n - start]:
                yield self._image(x)

    def resolved(self, how: Filling) -> Filling:
        """The request with this model's own choices.

        method     `conditional`: the network is told the known pixels (one step, or few); `repaint`: R2DM's way, for
                   any network; `posterior`: LiDARGen's, also for any; `auto`: conditional where the network can, else
                   posterior after score matching, else repaint
        steps      default 1 where conditional, which errs least; 32 where repaint, and `resamples` passes, default
                   10, go over each step; where posterior, at most so many network evaluations, default 1161
        sampler    of conditional any, default ddim; of repaint the one that takes its steps, default ddpm

        Raises ValueError for other words, and for what the method would ignore.
        """
        how, method = how.at_least_one(), self._method(how.method)
        if how.sampler is not None:
            self._sampler(how.sampler)
        if method == "posterior":
            how.without("resamples", "sampler", reason="since posterior is Langevin dynamics")
            return replace(how, method=method)
        if method == "conditional":
            how.without("resamples", reason="which only repaint has")
            steps = 1 if how.steps is None else how.steps
            return replace(how, method=method, steps=steps, sampler=how.sampler or "ddim")
        if how.sampler not in (None, *STEPS):
            raise ValueError(f"expected a sampler of {', '.join(STEPS)} for repaint, found {how.sampler!r}")
        steps, resamples = how.steps or REPAINT_STEPS, how.resamples or REPAINT_RESAMPLES
        return replace(how, method=method, steps=steps, resamples=resamples, sampler=how.sampler or "ddpm")

    def calls(self, how: Filling) -> int:
        """How many network evaluations a resolved request takes; of heun as a sampler, half of them."""
        if how.method == "posterior":
            return self._langevin_calls(how.steps)
        assert how.steps is not None
        if how.method == "conditional":
            return self._langevin_calls(how.steps) if how.sampler == "langevin" else how.steps
        assert how.resamples is not None
        return repaint.evaluations(how.steps, how.resamples)

    def fill(self, image: RangeImage, known: np.ndarray, how: Filling, on_step: OnStep = None) -> RangeImage:
        """The image, filled; one whose reflectance is 0 everywhere gets a reflectance."""
        x_0 = to_x_0(image, self.experiment.data.codec)[None].to(self._device)
        mask = torch.from_numpy(known).to(self._device).expand(1, 2, *known.shape).clone()
        mask[:, 1] &= bool(image.reflectance[known].any())
        states = self._completion(x_0, mask, how, generators(how.seed, 1))
        filled = self._image(_last(states, on_step, self.calls(how))[0])
        return with_known(filled, image, known, keep_reflectance=bool(mask[:, 1].any()))

    def generation_steps(self, steps: int | None = None, sampler: str | None = None) -> int:
        """How many steps of the sampler `generate` takes per batch."""
        if self._sampler(sampler) != "langevin":
            return 32 if steps is None else steps
        return self._langevin_calls(steps)

    def sampler_used(self, steps: int | None = None, sampler: str | None = None) -> str | None:
        """The sampler of `generate`. Raises ValueError for an unknown word."""
        return self._sampler(sampler)

    def _method(self, method: str) -> str:
        if method not in METHODS:
            raise ValueError(f"expected a method of {', '.join(METHODS)}, found {method!r}")
        if method == "conditional" and not self.conditional:
            raise ValueError(f"{self.experiment.name}: expected method repaint or posterior, since this network cannot "
                             f"be told the known pixels, found conditional")  # fmt: skip
        if method != "auto":
            return method
        return "conditional" if self.conditional else "repaint" if self.experiment.score is None else "posterior"

    def _sampler(self, sampler: str | None) -> str:
        if sampler is None:
            return "ddpm" if self.experiment.score is None else "langevin"
        if sampler not in (*STEPS, "langevin"):
            raise ValueError(f"expected a sampler of {', '.join(STEPS)}, langevin, found {sampler!r}")
        return sampler

    def _completion(self, x_0: Tensor, mask: Tensor, how: Filling, rng: Rng) -> Iterator[State]:
        """The states of completing x_0 (1, 2, H, W) where `mask` is False; the last pull of `posterior` is one more."""
        x_1 = self._start(x_0, rng, how.method == "posterior")
        if how.method == "posterior":
            levels, per_level, rate = self._annealing(how.steps)
            return langevin.langevin_posterior(
                self.denoiser, x_1, x_0, mask, rng, levels=levels, steps=per_level, rate=rate, grid=even_log_snr
            )
        assert how.steps is not None and how.sampler is not None
        if how.method == "conditional":
            return self._states(self.denoiser.given(x_0, mask), x_1, rng, how.sampler, how.steps)
        assert how.resamples is not None
        return repaint.repaint(
            self.denoiser, x_1, x_0, mask, rng, STEPS[how.sampler], steps=how.steps, resamples=how.resamples
        )

    def _states(self, denoiser: Denoiser, x_1: Tensor, rng: Rng, sampler: str, steps: int) -> Iterator[State]:
        if sampler != "langevin":
            return sample(denoiser, x_1, STEPS[sampler], steps, rng)
        levels, per_level, rate = self._annealing(steps)
        return langevin.langevin(denoiser, x_1, rng, levels, per_level, rate, even_log_snr)

    def _start(self, x: Tensor, rng: Rng, annealed: bool) -> Tensor:
        """x_1 like x: LiDARGen's chains, and only those, begin at uniform noise between the limits of the data."""
        if annealed and self.experiment.score is not None:
            return langevin.starting_uniform(x, rng, -1, 1)
        return starting_noise(self.denoiser, x, rng)

    def _annealing(self, calls: int | None) -> tuple[int, int, float]:
        """Noise levels, Langevin steps at each and their rate, for at most `calls` network calls; None = all levels."""
        score = self.experiment.score or Score()
        levels = score.levels if calls is None else langevin.levels_within(calls, score.steps)
        return levels, score.steps, score.rate

    def _langevin_calls(self, calls: int | None) -> int:
        levels, per_level, _ = self._annealing(calls)
        return langevin.evaluations(levels, per_level)

    def _image(self, x_0: Tensor) -> RangeImage:
        """x_0 (2, H, W) as an image; mixed pixels are mended if `data.mend`, R2DM's stay as published."""
        image = self._along_own_rays(from_x_0(x_0.clamp(-1, 1), self.sensor, self.experiment.data.codec))
        return without_mixed_pixels(image) if self.conditional and self.experiment.data.mend else image

    def _along_own_rays(self, image: RangeImage) -> RangeImage:
        """The image, with points along the network's `coords` where these are no even turn's: official R2DM files of
        unfolded scans have measured azimuths, and their program makes points of them."""
        if not isinstance(self.network, EfficientUNet):
            return image
        own = unit_vectors(self.network.coords[0].cpu().numpy())
        if np.abs(own - self.sensor.directions()).max() < SAME_RAYS:
            return image
        return replace(image, xyz=own * (image.range * image.mask)[..., None])

    @property
    def _device(self) -> torch.device:
        return next(self.network.parameters()).device

    def _blank(self, count: int) -> Tensor:
        return torch.zeros(count, 2, self.sensor.height, self.sensor.width, device=self._device)


def _last(states: Iterator[State], on_step: OnStep, calls: int | None = None) -> Tensor:
    """Run the sampler to its end; (B, 2, H, W). States behind the first `calls` took no network step."""
    state = None
    for index, state in enumerate(states):  # noqa: B007, the last one counts
        if on_step is not None and (calls is None or index < calls):
            on_step()
    assert state is not None
    return state.x_s
