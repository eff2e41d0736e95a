"""`GanModel`, the model of a GAN: scans from one evaluation each, and completion by inversion of its generator."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from lidarsynth.diffusion.samplers import checked_seed, generators
from lidarsynth.experiment.record import Adversarial, Experiment
from lidarsynth.lidar.depth import from_x_0
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor, get_sensor
from lidarsynth.networks.device import each_usually
from lidarsynth.networks.gan.inverse_depth import to_depth, to_inverse_depth
from lidarsynth.networks.gan.inversion import invert, tune, unit_rms
from lidarsynth.networks.gan.scan_generator import ScanGenerator
from lidarsynth.systems.any_sensor import imaged_by
from lidarsynth.systems.description import Description
from lidarsynth.systems.filling import Filling
from lidarsynth.systems.gan.description import DESCRIPTION
from lidarsynth.systems.known_pixels import with_known
from lidarsynth.systems.scan_model import OnStep, ScanModel

METHODS = ("auto", "inversion", "w-plus", "pivotal")
SPREAD = 5e-3  # what the angles between the styles of W+ weigh, as published
STEPS = 500  # of an inversion, as published


@dataclass(frozen=True, repr=False)
class GanModel(ScanModel):
    """A trained GAN with its sensor: Vanilla GAN, DUSty v1 or DUSty v2. It knows range only: reflectance is 0.

    network  (latents (B, Z), uniform noise) -> images (B, 1, H, W) of inverse depth
    """

    network: ScanGenerator
    sensor: Sensor
    experiment: Experiment
    description: ClassVar[Description] = DESCRIPTION

    def into(self, sensor: Sensor | str) -> GanModel:
        """The same weights with images of another sensor, for DUSty v2, which renders any ray angles.

        Raises ValueError for the other two, and for sizes that are no multiples of 16, at least 32.
        """
        sensor = get_sensor(sensor) if isinstance(sensor, str) else sensor
        if self.network.angles is None:
            raise ValueError(f"{self.experiment.name}: expected images of {self.sensor.name}, since only dusty-v2 "
                             f"renders any rays, found {sensor.name}")  # fmt: skip
        if sensor.height % 16 or sensor.width % 16 or min(sensor.height, sensor.width) < 32:
            raise ValueError(f"{self.experiment.name}: expected beams and columns divisible by 16, at least 32, "
                             f"found {sensor.height} x {sensor.width}")  # fmt: skip
        angles = torch.from_numpy(sensor.ray_angles())[None].to(self._device)
        network = ScanGenerator(self.network.generator, angles).eval()
        return GanModel(network, sensor, imaged_by(self.experiment, sensor))

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
        """Scans `first` .. n - 1 of `generate`, of one evaluation each, in the memory of one batch.

        Whether a ray returns is decided by the same noise in all scans, as in DUSty's evaluation. Raises ValueError for
        a sampler, for more than one step and for counts below 1.
        """
        self._checked(n, steps, seed, sampler, batch_size, first)
        return each_usually(self._drawn(n, checked_seed(seed), self.at_once(batch_size), first, on_step))

    def _drawn(self, n: int, seed: int, size: int, first: int, on_step: OnStep) -> Iterator[RangeImage]:
        fixed = torch.Generator().manual_seed(0)
        uniform = torch.rand(1, 1, *self._size, generator=fixed).to(self._device)
        for start in range(first, n, size):
            streams = generators(seed, size, offset=start)
            z = torch.stack([self._latent(rng) for rng in streams])
            with torch.no_grad():
                images = self.network(z.to(self._device), uniform).image
            if on_step is not None:
                on_step()
            yield from map(self._image, images[: n - start])

    def resolved(self, how: Filling) -> Filling:
        """The request with this model's own choices: method inversion, in 500 steps of the optimiser as published.

        inversion  one style for all layers, or a latent of networks without styles
        w-plus     a style of its own for every layer of DUSty v2, held together by their angles
        pivotal    inversion, then as many steps of all weights of the network (pivotal tuning, of a copy)
        """
        if how.method not in METHODS:
            raise ValueError(f"{self.experiment.name}: expected a method of {', '.join(METHODS)}, found {how.method!r}")
        if how.method == "w-plus" and self.network.angles is None:
            raise ValueError(f"{self.experiment.name}: expected w-plus of a network with styles, such as DUSty v2's")
        self._refuse(how.sampler)
        how.at_least_one().without("resamples", reason="which only repaint has")
        method = "inversion" if how.method == "auto" else how.method
        return replace(how, method=method, steps=STEPS if how.steps is None else how.steps)

    def calls(self, how: Filling) -> int:
        """How many steps the optimiser takes."""
        assert how.steps is not None
        return how.steps * (2 if how.method == "pivotal" else 1)

    def fill(self, image: RangeImage, known: np.ndarray, how: Filling, on_step: OnStep = None) -> RangeImage:
        """The image that agrees best with what is known: inversion, i.e. auto-decoding, by a method of `resolved`.

        Known pixels come back exactly as they were, in metres; reflectance is 0 everywhere, since the network knows
        none. Filled pixels are those that return more likely than not. Raises ValueError when nothing is measured.
        """
        (rng,) = generators(how.seed, 1)
        assert how.steps is not None
        network, w = self._inverted(image, known & image.mask, how.steps, rng, on_step, how.method)
        with torch.no_grad():
            images = network.synthesize(w, torch.full((1, 1, 1, 1), 0.5, device=self._device)).image
        return with_known(self._image(images[0]), image, known, keep_reflectance=False)

    def returned(self, perfect: RangeImage, seed: int = 0, steps: int = STEPS) -> np.ndarray:
        """(H, W) bool: which rays of a simulator's image a real sensor would report, as DUSty v2 tells (WACV 2023).

        The network is inverted to the image's ranges and its own ray-drop drawn. Raises ValueError for an image of
        another size, or when nothing is measured.
        """
        if perfect.shape != self._size:
            raise ValueError(f"expected an image of {self._size}, found {perfect.shape}")
        (rng,) = generators(seed, 1)
        _, w = self._inverted(perfect, perfect.mask, steps, rng, None)
        uniform = torch.rand(1, 1, *self._size, generator=rng).to(self._device)
        with torch.no_grad():
            images = self.network.synthesize(w, uniform).image
        return perfect.mask & self._image(images[0]).mask

    def generation_steps(self, steps: int | None = None, sampler: str | None = None) -> int:
        """1, how often `generate` evaluates the network per batch. Raises ValueError for other wishes."""
        self._refuse(sampler)
        if steps not in (None, 1):
            raise ValueError(f"{self.experiment.name}: expected no steps, since a GAN takes one, found {steps}")
        return 1

    def _refuse(self, sampler: str | None) -> None:
        if sampler is not None:
            raise ValueError(f"{self.experiment.name}: expected no sampler, since a GAN has none, found {sampler!r}")

    def _inverted(
        self,
        image: RangeImage,
        measured: np.ndarray,
        steps: int,
        rng: torch.Generator,
        on_step: OnStep,
        method: str = "inversion",
    ) -> tuple[ScanGenerator, Tensor]:
        """The network, and styles (1, D) or (1, L, D) whose image before ray-drop agrees with the `measured` (H, W)
        pixels.

        Of DUSty v2 from the mean style on, as published; the styles of the others are latents, kept where N(0, I) is.
        """
        if not measured.any():
            raise ValueError("expected at least one known pixel with a return, found none")
        mapped, limits = self.network.angles is not None, (self.sensor.min_range, self.sensor.max_range)
        with torch.no_grad():
            w = self.network.mean_style(rng) if mapped else unit_rms(self._latent(rng)[None]).to(self._device)
            w = self.network.of_layers(w) if method == "w-plus" else w
        depth = torch.from_numpy(np.where(measured, image.range, np.float32(0)))[None, None].to(self._device)
        reference = to_inverse_depth(depth, *limits)
        network, told = self.network, (reference, reference.gt(0).float(), limits, steps)
        spread, project = SPREAD if method == "w-plus" else 0.0, None if mapped else unit_rms
        with torch.inference_mode(False), torch.enable_grad():  # also where the caller wants none
            for fit in invert(self._renderer(network), w, *told, project=project, spread=spread):
                w = fit.latents
                if fit.step and on_step is not None:
                    on_step()
            if method == "pivotal":
                network = copy.deepcopy(network).requires_grad_(True)
                for fit in tune(network, self._renderer(network), w, *told):
                    if fit.step and on_step is not None:
                        on_step()
        return network, w

    def _renderer(self, network: ScanGenerator) -> Callable[[Tensor], Tensor]:
        """Styles (1, D) -> min_range / depth before ray-drop, as 2x - 1, (1, 1, H, W)."""
        noise = torch.full((1, 1, 1, 1), 0.5, device=self._device)  # not looked at before ray-drop
        farthest = 0.0  # min_range / depth where the code is 0
        if self.experiment.data.codec == "inverse-minmax":
            farthest = self.sensor.min_range / self.sensor.max_range

        def render(w: Tensor) -> Tensor:
            return 1 - (1 - network.synthesize(w, noise).image_orig) * (1 - farthest)

        return render

    def _image(self, x: Tensor) -> RangeImage:
        """Code (1, H, W) in [-1, 1] as an image without reflectance."""
        empty = (self.experiment.adversarial or Adversarial()).empty_below
        code = torch.where((x + 1) / 2 > empty, x, -1.0)
        if self.experiment.data.codec == "inverse":  # both limits count, as in the published program
            limits = self.sensor.min_range, self.sensor.max_range
            metres = to_depth(((code[0] + 1) / 2).float().cpu().clamp(0, 1), *limits).numpy()
            return RangeImage(metres, np.zeros_like(metres), metres > 0, self.sensor)
        return from_x_0(torch.cat([code, torch.full_like(x, -1)]).clamp(-1, 1), self.sensor, self.experiment.data.codec)

    def _latent(self, rng: torch.Generator) -> Tensor:
        """(Z,) ~ N(0, I), on the CPU."""
        return torch.randn(self.network.latent_channels, generator=rng)

    @property
    def _size(self) -> tuple[int, int]:
        return self.sensor.height, self.sensor.width

    @property
    def _device(self) -> torch.device:
        return next(self.network.parameters()).device
