"""`CascadeModel`, one model for any sensor: a coarse layout from noise, and one step that fills in the rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from lidarsynth.diffusion.samplers import checked_seed, generators
from lidarsynth.experiment.record import Experiment
from lidarsynth.lidar.point_classes import class_of_points
from lidarsynth.lidar.projection import pixel_of_points, project
from lidarsynth.lidar.scan import RangeImage, Scan, as_scan, check_seen
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.lidar.whole_turn import whole_turn, within
from lidarsynth.networks.candidates import BEND
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.coarse_unet import ROWS, grid_rays
from lidarsynth.networks.device import each_usually
from lidarsynth.networks.fill_unet import ANYHOW, SNAP, Filled, Known
from lidarsynth.networks.rays import Rays, decode_range, padded
from lidarsynth.streets.hdl64e import unevenness, written_out
from lidarsynth.streets.kittis_car import Outline, outline_of, outlined
from lidarsynth.systems.any_sensor import AnySensorModel
from lidarsynth.systems.cascade.beneath import certain
from lidarsynth.systems.cascade.confidence import confidence, signals
from lidarsynth.systems.cascade.description import DESCRIPTION
from lidarsynth.systems.cascade.edges import with_edges
from lidarsynth.systems.cascade.floating import settled
from lidarsynth.systems.cascade.foliage import grown
from lidarsynth.systems.cascade.gaps import straight_in_gaps
from lidarsynth.systems.cascade.holes import Told, with_holes_drawn, with_planes
from lidarsynth.systems.cascade.images import (
    GENERATED,
    SPECKLE,
    Grain,
    agreed,
    answered,
    drawn,
    grid_of,
    noisy,
    parts,
    placed,
    shades_of,
    textured,
    with_doubts,
)
from lidarsynth.systems.cascade.known import known_of, rays_told, standing, unanswered
from lidarsynth.systems.cascade.layout import CHOICE, block, detailed, grids, one_thread, sampling, times, told_of
from lidarsynth.systems.cascade.naming import GROWING, RARER, RIDERS, named, sketched
from lidarsynth.systems.cascade.perfect import fitting, logistic, observed, observing
from lidarsynth.systems.cascade.recast import all_recast, as_cast, unnamed
from lidarsynth.systems.cascade.request import calls, resolved, warn_of_height
from lidarsynth.systems.cascade.response import AS_STREETS, Response, response_of, tried
from lidarsynth.systems.cascade.shading import shaded
from lidarsynth.systems.cascade.silent import silent_rows, with_silent
from lidarsynth.systems.cascade.sparse import filled_in, named_as
from lidarsynth.systems.cascade.speckle import ELSEWHERE, SHARE, calm
from lidarsynth.systems.cascade.surfaces import paved
from lidarsynth.systems.cascade.unit import as_streets
from lidarsynth.systems.description import Description
from lidarsynth.systems.filling import Filling, whole
from lidarsynth.systems.known_pixels import with_known
from lidarsynth.systems.precision import resolved_precision
from lidarsynth.systems.scan_model import OnStep

FILL_STEPS = 1  # after those of the layout
Each = list[torch.Generator] | None  # a scan's own


@dataclass(frozen=True, repr=False)
class CascadeModel(AnySensorModel):
    """A trained cascade with the sensor of its images, which `into` changes at no cost.

    network.coarse   velocity of flow matching on a grid of 16 beams x 128 columns of the sensor
    network.fill     known pixels and rays -> all pixels, in one step
    network.classes  an image -> the class of each return
    own              whether scans are completed, and made denser, in the sensor that made them: until `into`
    labelled         whether its images have classes: after `with_labels`
    precision        of the matrix products of the fill, and of the coarse stage in generation: fp32 | bf16
    response, car    how the sensor reports what it sees, and where KITTI's car is, as found out from the scan at hand
    grain            how much of each kind of noise its samples take
    layouts          drawn for each generated scan, of which one is kept, by its odds as a street's: see `choosing`
    """

    network: Cascade
    sensor: Sensor
    experiment: Experiment
    labelled: bool = False
    precision: str = "fp32"
    response: Response = AS_STREETS
    car: Outline | None = None
    grain: Grain = GENERATED
    layouts: int = CHOICE
    description: ClassVar[Description] = DESCRIPTION
    kind: ClassVar[str] = "a cascade"

    @property
    def together(self) -> int:
        """Scans that a CPU draws at once: fewer, where several layouts are drawn of each."""
        return block(sampling(self.network, None, None), self.layouts if self.network.judge is not None else 1)

    def at_precision(self, word: str) -> CascadeModel:
        """The same model, its fill at `fp32`, `bf16`, or `auto`: bf16 where the processor multiplies it itself."""
        return replace(self, precision=resolved_precision(word, self._device))

    def with_labels(self) -> CascadeModel:
        """The same model, whose images also have the class of each return."""
        if self.network.classes is None:
            super().with_labels()  # refuses
        return replace(self, labelled=True)

    def choosing(self, layouts: int) -> CascadeModel:
        """The same model, which draws so many layouts of each generated scan and keeps one, by the odds that it
        is a street's: with 1 scans take about half the time, and fewer of them look like streets.

        Raises ValueError for a number below 1, and for a model without a judge of layouts.
        """
        if self.network.judge is None:
            raise ValueError("expected a model that chooses among layouts, such as default, found "
                             f"{self.experiment.name}")  # fmt: skip
        if whole("layouts", layouts) < 1:
            raise ValueError(f"expected at least 1 layout, found {layouts}")
        return replace(self, layouts=layouts)

    def check_realises(self) -> None:
        """Raises ValueError for a cascade without classes: one recipe teaches both."""
        if not self.experiment.model.classes:
            super().check_realises()

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

        sampler  of the grid: columns, or one of diffusion; default columns, dpmpp-2m where steps are given
        steps    of diffusion, default 16; the fill takes one more
        Raises ValueError for an unknown sampler, steps of `columns`, counts below 1, or a sensor smaller than the grid.
        """
        self._checked(n, steps, seed, sampler, batch_size, first)
        warn_of_height(self.sensor)
        how, whole = sampling(self.network, steps, sampler), self.into(whole_turn(self.sensor))
        return each_usually(within(whole._drawn(n, how, checked_seed(seed), batch_size, first, on_step), self.sensor))

    def _drawn(
        self, n: int, how: tuple[str, int], seed: int, batch_size: int, first: int, on_step: OnStep
    ) -> Iterator[RangeImage]:
        (rows, columns), tell, size = grid_of(self.sensor), on_step or (lambda: None), self.at_once(batch_size)
        choice = self.layouts if self.network.judge is not None else 1
        count = max(size, block(how, choice))
        rays_of = partial(self._grid_rays, count=count)
        for start in range(first - first % count, n, count):  # whole blocks, so that a scan is the same bit by bit
            rng, wanted = generators(seed, count, offset=start), parts(first - start, min(count, n - start), size)
            parts_of = self.network, self.sensor, rows, columns, rays_of, rng, how, times(len(wanted), tell), choice
            grid = grids(*parts_of, self.precision)
            for part in wanted:
                yield from self._filled_grids(grid[0][part], grid[1][part], *grid[2:], rng[part])
                tell()

    def resolved(self, how: Filling) -> Filling:
        """The request with this model's own choices.

        method  `conditional` (`auto`): the most likely image, of least error; `sample`: one of many possible images,
                with the grain of a recorded scan; `repaint`: large holes first by the coarse network, then a sample
        steps   1; of `repaint`, those of the coarse network, default 16, with `resamples` passes, default 10, over each

        Raises ValueError for other words, and for what the method would ignore.
        """
        return resolved(how, self.experiment.name)

    def calls(self, how: Filling) -> int:
        """How many network evaluations a resolved request takes."""
        return calls(how)

    def fill(self, image: RangeImage, known: np.ndarray, how: Filling, on_step: OnStep = None) -> RangeImage:
        """The image, filled; one whose reflectance is 0 everywhere gets a reflectance. Blocked rays stay empty."""
        recorded = image.keep(known)  # on a blocked ray too, which is told as empty
        rng, lit = generators(how.seed, 1), bool(recorded.reflectance.any())
        own = replace(self._as_found(recorded, known), grain=SPECKLE)
        image, unit = as_streets(own.response.unfaded(recorded), known, own.response, self.tuned)
        known = known | (own._blocked & ~image.mask)
        metres, reflectance, told = image.range, own.response.even(image.reflectance), known
        if how.method == "repaint":
            grid_of(self.sensor)  # refuses those that are smaller
            dim, rays_at = own.response.unevenness(own.sensor), partial(own._grid_rays, count=1)
            parts = Told(metres, reflectance, told), own.sensor, dim, rays_at, rng, how, on_step
            slopes = np.tan(np.radians(np.asarray(own.sensor.elevations)))
            metres, reflectance, told = with_planes(with_holes_drawn(self.network, *parts), known, slopes)
            told &= known | ~silent_rows(known, image.mask, own._blocked)[:, None]  # those are no holes
        noise = None if how.method == "conditional" else rng
        if noise is None:
            reflectance = calm(reflectance, image, known, SHARE if own.response == AS_STREETS else ELSEWHERE)
            rays, fill = own.response.told(rays_told(own.sensor, own.car)), self.network.surest
            with torch.autocast(self._device.type, torch.bfloat16, enabled=self.precision == "bf16"):
                own = replace(own, response=tried(own.response, fill, image, known, reflectance, rays, self.tuned))
        filled = own._fill(metres[None], reflectance[None], told[None], lit, noise)[0]
        filled = straight_in_gaps(settled(filled, image, told), told) if noise is None else filled
        shade = own.response.straightened(own.response.reported(filled.reflectance), image, known)
        filled = replace(filled, reflectance=own.response.faded(unit.read(shade, filled), filled.range) * filled.mask)
        filled = with_known(filled if noise is None else noisy(filled, rng[0]), recorded, known, keep_reflectance=lit)
        (on_step or (lambda: None))()
        return own._named([filled], recorded=True)[0]

    def realised(self, scan: Scan | np.ndarray, sensor: Sensor | str | None = None, seed: int = 0) -> RangeImage:
        """The image of `realise`, of as many columns as the scan's rings have, where those are not the sensor's."""
        self.check_realises()
        scan, projection = as_scan(scan), self.experiment.data.projection
        model = self.suited_to(scan) if sensor is None else self.into(sensor)
        model = model.into(fitting(scan, model.sensor, projection))
        network, grain = observing(self.network, model.tuned)
        model = replace(model, network=network, grain=grain, labelled=False)
        image = check_seen(project(scan, model.sensor, projection).keep(~model._blocked), len(scan))
        model = replace(model, sensor=standing(model.sensor, image, image.mask))
        answer = model._answers(unanswered(image, padded(model.sensor)), generators(seed, 1), surely=image.range[None])
        return observed(scan, image, answer[0], projection)

    def named(self, scan: Scan | np.ndarray, sensor: Sensor | str | None = None, least: float = 0.0) -> RangeImage:
        """The image of `label`, with the classes of its pixels; what a thinned one lacks is filled in before."""
        scan, projection, model = as_scan(scan), self.experiment.data.projection, self.with_labels()
        model = model.labelling(scan) if sensor is None else model.into(sensor)
        pixels = pixel_of_points(scan, model.sensor, projection)
        image = check_seen(project(scan, model.sensor, projection, pixels=pixels), len(scan))
        whole = filled_in(replace(model, labelled=False), image)
        (answer,) = model._as_found(image, image.mask)._named([whole], least, recorded=True)
        image = named_as(image, answer)
        return replace(image, completed=replace(scan, label=class_of_points(scan.xyz, image, pixels)))

    def generation_steps(self, steps: int | None = None, sampler: str | None = None) -> int:
        """How often `generate` calls `on_step` per batch: the coarse steps, the fill. Raises ValueError as `stream`."""
        grid_of(self.sensor)
        return sampling(self.network, steps, sampler)[1] + FILL_STEPS

    def sampler_used(self, steps: int | None = None, sampler: str | None = None) -> str | None:
        """`columns` where they draw, by default too: 128 steps of diffusion are as many calls."""
        return sampling(self.network, steps, sampler)[0]

    def _grid_rays(self, rows: np.ndarray, columns: np.ndarray, count: int) -> tuple[Tensor, Tensor]:
        told, standing = (part.to(self._device) for part in grid_rays(self.sensor, self._blocked, rows, columns))
        return told.expand(count, *told.shape), standing.expand(count, *standing.shape)

    def _filled_grids(
        self, metres: Tensor, reflectance: Tensor, rows: np.ndarray, columns: np.ndarray, rng: list[torch.Generator]
    ) -> list[RangeImage]:
        """Grids (B, R, C) as whole images, with the texture of the classes that the fill draws, then of those that are
        seen in the result, by which surfaces are level and shaded, too, and cars and people cast anew."""
        drawn, shades = self._whole(metres, reflectance, rows, columns, rng)
        if self.network.classes is None:
            return self._named(grown(drawn, shades, self._blocked, rng))
        network, more = self.network.drawn, sketched(self.sensor)
        if network is None:  # one that has seen recorded scans alone: calm between the beams of the grid
            network, more = self.network.classes, RARER | (GROWING if len(rows) > ROWS else {})
        recorded = textured(drawn, shades, rng)
        seen = named(network, recorded, self.response, self.sensor, self.precision, more=more, alone=True)
        shades = np.stack([shaded(even, image, self.tuned) for even, image in zip(shades, seen, strict=True)])
        drawn = [paved(replace(a, label=b.label)) for a, b in zip(drawn, seen, strict=True)]
        cast = all_recast(grown(drawn, shades, self._blocked, rng), rng)
        if self.network.drawn is None:
            return as_cast(self._named(cast), cast)
        return cast if self.labelled else [unnamed(image) for image in cast]

    def _whole(
        self, metres: Tensor, reflectance: Tensor, rows: np.ndarray, columns: np.ndarray, rng: list[torch.Generator]
    ) -> tuple[list[RangeImage], np.ndarray]:
        """Grids (B, R, C) as whole images, with the labels of `answered`, and reflectances (B, H, W), the likeliest.

        First their beams are filled, then all between: at once, most pixels would know nothing above or below."""
        own = replace(self, sensor=written_out(self.sensor))
        told = metres.cpu().numpy(), reflectance.cpu().numpy()
        beams = own if len(rows) == own.sensor.height else replace(own, sensor=own.sensor.rows(rows.tolist()))
        noises = (rng, None) if len(rows) == ROWS else (None,)  # of more beams little is left to say
        some = [beams._between(*told, np.arange(len(rows)), columns, noise, rng) for noise in noises]
        some[0] = with_edges(agreed(some[0], some[-1], told[0], columns) if some[1:] else some[0], columns, rng)
        if len(rows) < self.sensor.height:
            told = np.stack([a.range for a in some[0]]), shades_of(some[0], some[-1])
            some = [own._between(*told, rows, np.arange(own.sensor.width), noise, rng) for noise in noises]
        whole = [replace(a, sensor=self.sensor, confidence=None, new=None) for a in some[0]]  # nothing was measured
        return whole, shades_of(some[0], some[-1])

    def sketched(self, images: Sequence[RangeImage], seed: int = 0) -> list[RangeImage]:
        """What generation would draw if the layouts of these images (H, W), in metres, of the model's sensor, had been
        drawn: scans in the making, before anybody has looked at them, for `network.drawn` to learn from; with the
        fill's likeliest classes.

        Raises ValueError for a sensor smaller than the grid.
        """
        places, rng, sensor = grid_of(self.sensor), generators(checked_seed(seed), len(images)), self.sensor
        rays_of = partial(self._grid_rays, count=len(images))
        with one_thread():
            grid = detailed(self.network, told_of(images, *places), places, rays_of, sensor, unevenness(sensor), rng)
        return textured(*self._whole(*grid, rng), rng)

    def _named(self, images: list[RangeImage], least: float = 0.0, recorded: bool = False) -> list[RangeImage]:
        """The images with the classes that `network.classes` sees in them, or without any that nobody asked for; of
        `recorded` ones of the insides of buildings, those of `network.inside`, unless the scans' own were learned."""
        if not self.labelled:
            return [unnamed(image) for image in images]
        assert self.network.classes is not None
        own, told = self.experiment.model.own_classes, (self.network.classes, images, self.response, self.sensor)
        inside, more = (self.network.inside, RIDERS) if recorded and not own else (None, None if recorded else RARER)
        return named(*told, self.precision, least, more, inside=inside, indoors=self.network.indoors)

    def _between(
        self, metres: np.ndarray, reflectance: np.ndarray, rows: np.ndarray, columns: np.ndarray, rng: Each, kinds: list
    ) -> list[RangeImage]:
        """Samples of whole images, told metres (B, R, C), 0 for no return, and reflectance of rows and columns."""
        ranges, shades, told = placed(metres, reflectance, rows, columns, self.sensor, self._blocked)
        samples = zip(self._fill(ranges, shades, told, True, rng, kinds), ranges, shades, told, strict=True)
        return [with_known(a, RangeImage(r, f, r > 0, self.sensor), t, keep_reflectance=True) for a, r, f, t in samples]

    def doubts(self, image: RangeImage, known: np.ndarray) -> Tensor:
        """(7, H, W) signals of `confidence.signals` of the most likely image, given the pixels `known` (H, W) bool."""
        image = image.keep(known)
        own = self._as_found(image, known)
        image, _ = as_streets(own.response.unfaded(image), known, own.response, self.tuned)
        shades, told = own.response.even(image.reflectance)[None], known | (own._blocked & ~image.mask)
        pixels = known_of(image.range[None], shades, told[None], True, padded(self.sensor))
        return signals(*own._network(pixels, None, doubt=True))[0, :, : self.sensor.height, : self.sensor.width]

    def _fill(
        self, metres: np.ndarray, reflectance: np.ndarray, told: np.ndarray, lit: bool, rng: Each, kinds: Each = None
    ) -> list[RangeImage]:
        """Images of (B, H, W) known pixels: the most likely ones, or, with generators, samples.

        kinds  generators that draw classes, and edges as one draws them; None = those of samples
        """

        def ask(told: np.ndarray) -> list[RangeImage]:
            known = known_of(metres, reflectance, told, lit, padded(self.sensor))
            return self._answers(known, rng, kinds=kinds or rng, recorded=kinds is None)

        if kinds is not None and rng is None:  # what a sample in the making is corrected by
            return ask(told)
        return with_silent(ask, told, metres > 0 if kinds is None else told, self._blocked)

    def _answers(
        self, known: Known, rng: Each, surely: np.ndarray | None = None, kinds: Each = None, recorded: bool = False
    ) -> list[RangeImage]:
        """Images of (B, 1, H', W') padded pixels.

        surely    (B, H, W) metres of the surfaces, where only is asked which rays return: drawn, each by its chance
        recorded  of recorded scans, whose holes are filled where they reach the lowest beam, too
        """
        weights = self.experiment.confidence if rng is None else None  # a sample is one of many
        reach = ANYHOW if rng is not None and surely is None else SNAP  # what has a range gets its class's roughness
        classify, bend = kinds is not None and bool(self.experiment.model.classes), BEND / (1 if kinds is None else 2)
        filled, rays = self._network(known, rng, weights is not None, classify, reach, bend)
        filled = certain(filled, known, self._blocked if recorded else None)
        logit = filled.logit if surely is None or rng is None else filled.logit + logistic(filled.logit, rng)
        height, width = self.sensor.height, self.sensor.width
        metres = decode_range(filled.code)[:, 0].cpu().numpy() if surely is None else surely
        sure = None if weights is None else confidence(filled, rays, weights)
        parts = (self.response.mixed(filled), logit, filled.classes, with_doubts(filled.classes, kinds), sure)
        cut = [[None] * len(metres) if part is None else part[..., :height, :width].cpu() for part in parts]
        each = zip(metres[:, :height, :width], *cut, strict=True)
        return [answered(self.sensor, self._blocked, *of_one) for of_one in each]

    @torch.inference_mode()
    def _network(
        self,
        known: Known,
        rng: Each,
        doubt: bool = False,
        classify: bool = False,
        reach: float = SNAP,
        bend: float = BEND,
    ) -> tuple[Filled, Rays]:
        """What the fill makes of (B, 1, H', W') padded pixels, and the rays it was told."""
        rays, device = self.response.told(rays_told(self.sensor, self.car)), self._device
        noise, lost = drawn(self.grain, known, rays, rng)
        lost = None if lost is None else lost.to(device)
        known = Known(*(part.to(device) for part in known))
        rays = Rays(*(part.to(device).expand(len(known.told), *part.shape[1:]) for part in rays))
        with torch.autocast(device.type, torch.bfloat16, enabled=self.precision == "bf16"):
            fill = self.network.fill if classify or rng is not None else self.network.surest
            return fill(known, rays, noise.to(device), classify, doubt, reach, lost, bend), rays

    def _as_found(self, image: RangeImage, known: np.ndarray) -> CascadeModel:
        """With what the known returns tell: how the sensor stands and reports reflectance, and where KITTI's car is."""
        seen, response = (self.sensor, image, known), response_of(image, known, self.tuned)
        return replace(self, sensor=standing(*seen), car=outline_of(*seen), response=response)

    @property
    def _blocked(self) -> np.ndarray:
        return outlined(self.sensor, self.car)

    @property
    def _device(self) -> torch.device:
        return next(self.network.parameters()).device
