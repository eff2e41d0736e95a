"""`LidarModel`, the model of a denoiser: generate, complete and upsample scans."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from lidarsynth.diffusion.denoiser import Denoiser
from lidarsynth.diffusion.repaint import evaluations, repaint
from lidarsynth.diffusion.samplers import STEPS, State, generators, sample, starting_noise
from lidarsynth.experiment import Experiment
from lidarsynth.hub import push
from lidarsynth.lidar.depth import from_x_0, to_x_0
from lidarsynth.lidar.mixed_pixels import without_mixed_pixels
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.scan_model import OnStep, image_in, known_pixels, sensor_that_made, sparse_image, with_known

METHODS = ("auto", "conditional", "repaint")


@dataclass(frozen=True)
class LidarModel:
    """A trained model with its sensor.

    network     the bare torch module: raw prediction (B, 2, H, W) from x_t (B, 2, H, W) and log_snr (B,)
    denoiser    (x_t, t) -> x_0_hat
    sensor      the beams and columns of its images
    experiment  what it is and how it was trained
    """

    network: nn.Module
    denoiser: Denoiser
    sensor: Sensor
    experiment: Experiment

    @property
    def conditional(self) -> bool:
        """Whether the network can be told the known pixels."""
        return self.experiment.model.network == "conditional-unet"

    def to(self, device: str | torch.device) -> LidarModel:
        """The same model with its network on another device."""
        self.network.to(device)
        return self

    def generate(
        self,
        n: int = 1,
        steps: int | None = None,
        seed: int = 0,
        sampler: str | None = None,
        batch_size: int = 4,
        on_step: OnStep = None,
    ) -> list[RangeImage]:
        """`n` new scans as range images; scan i depends on seed + i only, not on n or batch_size.

        steps    network evaluations per scan (twice as many for `heun`); default 32
        sampler  ddpm (default) | ddim | dpmpp-2m | heun

        Raises ValueError for an unknown sampler or counts below 1.
        """
        return list(self.stream(n, steps, seed, sampler, batch_size, on_step=on_step))

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
        """Scans `first` .. n - 1 of `generate`, one after the other, in the memory of one batch."""
        steps = self.generation_steps(steps, sampler)
        if n < 1 or steps < 1 or batch_size < 1:
            raise ValueError(f"expected n, steps and batch_size of at least 1, found {n}, {steps}, {batch_size}")
        for start in range(first, n, batch_size):
            count = min(batch_size, n - start)
            rng = generators(seed, count, offset=start)
            x_1 = starting_noise(self.denoiser, self._blank(count), rng)
            for x in _last(sample(self.denoiser, x_1, _step(sampler or "ddpm"), steps, rng), on_step):
                yield self._image(x)

    def complete(
        self,
        scan: Scan | RangeImage,
        known: np.ndarray | None = None,
        method: str = "auto",
        steps: int | None = None,
        resamples: int = 10,
        sampler: str | None = None,
        seed: int = 0,
        on_step: OnStep = None,
    ) -> RangeImage:
        """Fill what was not measured; measured pixels come back exactly as they were, in metres.

        scan    points, or an image of this model's sensor
        known   (H, W) bool: pixels to keep, where an empty pixel means that nothing returned; None = the measured ones
        method  `conditional`: the network is told the known pixels (few steps); `repaint`: R2DM's way, for any network;
                `auto`: conditional where the network can
        steps   default 4, or 32 for repaint, where `resamples` passes go over each step

        A scan whose reflectance is 0 everywhere gets a reflectance. Raises ValueError when shapes or words do not fit.
        """
        image = self.image_of(scan)
        known = known_pixels(image, known)
        method = self._method(method)
        steps = (4 if method == "conditional" else 32) if steps is None else steps
        x_0 = to_x_0(image, self.experiment.data.codec)[None].to(self._device)
        mask = torch.from_numpy(known).to(self._device).expand(1, 2, *known.shape).clone()
        mask[:, 1] &= bool(image.reflectance[known].any())
        rng = generators(seed, 1)
        x_1 = starting_noise(self.denoiser, x_0, rng)
        if method == "conditional":
            states = sample(self.denoiser.given(x_0, mask), x_1, _step(sampler or "ddim"), steps, rng)
        else:
            states = repaint(self.denoiser, x_1, x_0, mask, rng, _step("ddpm"), steps, resamples)
        filled = self._image(_last(states, on_step)[0])
        return with_known(filled, image, known, keep_reflectance=bool(mask[:, 1].any()))

    def upsample(
        self,
        scan: Scan,
        sensor_in: Sensor | str | None = None,
        method: str = "auto",
        steps: int | None = None,
        seed: int = 0,
        on_step: OnStep = None,
    ) -> RangeImage:
        """A sparse scan, of a sensor with fewer beams, as an image of this model's sensor.

        sensor_in  the sensor that made the scan; None = recognised from the points. Its beams tell which rows of the
                   image were looked at; points outside this model's view are left out.

        Raises ValueError when the sensor is not recognised or sees nothing that the model does.
        """
        image, known = sparse_image(scan, sensor_that_made(scan, sensor_in), self.sensor)
        return self.complete(image, known, method, steps, seed=seed, on_step=on_step)

    def push_to_hub(self, repo_id: str, private: bool = False, half: bool = False) -> str:
        """Upload the model, with a card filled in from its experiment, to `owner/name` of the Hugging Face hub.

        half  weights in float16, at half the size

        Returns the address; `load("owner/name")` then gives the model anywhere. Needs the extra `hub` and a token.
        Raises ValueError in one line when the hub refuses or cannot be reached.
        """
        return push(self.experiment, self.network, repo_id, private, half)

    def image_of(self, scan: Scan | RangeImage) -> RangeImage:
        """The scan in this model's image. Raises ValueError for an image of another size."""
        return image_in(scan, self.sensor, self.experiment.data.projection)

    def generation_steps(self, steps: int | None = None, sampler: str | None = None) -> int:
        """How many steps of the sampler `generate` takes per batch."""
        return 32 if steps is None else steps

    def evaluations(self, method: str = "auto", steps: int | None = None, resamples: int = 10) -> int:
        """How many network evaluations `complete` takes."""
        if self._method(method) == "conditional":
            return 4 if steps is None else steps
        return evaluations(32 if steps is None else steps, resamples)

    def _method(self, method: str) -> str:
        if method not in METHODS:
            raise ValueError(f"expected a method of {', '.join(METHODS)}, found {method!r}")
        if method == "conditional" and not self.conditional:
            raise ValueError(f"{self.experiment.name}: expected method repaint, since this network cannot be told the "
                             f"known pixels, found conditional")  # fmt: skip
        return method if method != "auto" else "conditional" if self.conditional else "repaint"

    def _image(self, x_0: Tensor) -> RangeImage:
        """x_0 (2, H, W) as an image; mixed pixels are mended for our own kind of network, R2DM's stay as published."""
        image = from_x_0(x_0, self.sensor, self.experiment.data.codec)
        return without_mixed_pixels(image) if self.conditional else image

    @property
    def _device(self) -> torch.device:
        return next(self.network.parameters()).device

    def _blank(self, count: int) -> Tensor:
        return torch.zeros(count, 2, self.sensor.height, self.sensor.width, device=self._device)


def _step(name: str):
    if name not in STEPS:
        raise ValueError(f"expected a sampler of {', '.join(STEPS)}, found {name!r}")
    return STEPS[name]


def _last(states: Iterator[State], on_step: OnStep) -> Tensor:
    """Run the sampler to its end; (B, 2, H, W)."""
    state = None
    for state in states:  # noqa: B007, the last one counts
        if on_step is not None:
            on_step()
    assert state is not None
    return state.x_s
