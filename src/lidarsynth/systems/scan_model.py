"""What every model of scans can do, whatever its network, and how scans come into its images and back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch
from torch import nn

from lidarsynth.diffusion.samplers import checked_seed
from lidarsynth.experiment.folder import save
from lidarsynth.experiment.record import Experiment
from lidarsynth.lidar.measured import with_measured
from lidarsynth.lidar.projection import Pixels, occupied, pixel_of_points, project_thinned
from lidarsynth.lidar.removal import removable
from lidarsynth.lidar.scan import RangeImage, Scan, check_seen, least_confidence
from lidarsynth.lidar.sensor import Sensor, get_sensor
from lidarsynth.networks.device import check_device, usual_torch
from lidarsynth.streets.wanted import wanted
from lidarsynth.systems.description import Description, described
from lidarsynth.systems.filling import Filling, OnStep, check_counts, whole
from lidarsynth.systems.hub import checked_repository, push
from lidarsynth.systems.insertion import Inserted, inserted
from lidarsynth.systems.known_pixels import known_pixels, of_rays, sensor_that_made, sparse_image, with_own_classes
from lidarsynth.systems.model_card import card_text
from lidarsynth.systems.notes import Points, made_by, noted, stranger, taken
from lidarsynth.systems.removal import emptied

if TYPE_CHECKING:
    from typing_extensions import Self


class ScanModel(ABC):
    """A trained model with its sensor, as `load` returns it.

    network     the bare torch module
    sensor      the beams and columns of its images
    experiment  what it is and how it was trained

    Each kind is a frozen record of these and of what else it needs. One that cannot do what is asked, such as a GAN
    that is asked for a number of steps, raises ValueError. `steps`, `sampler` and `method` of None or `auto` are the
    model's own.
    """

    network: nn.Module
    sensor: Sensor
    experiment: Experiment
    description: ClassVar[Description]  # what a card says of it
    kind: ClassVar[str] = "one that completes scans"  # said of those that generate nothing
    any_sensor: ClassVar[bool] = False  # whether `into` takes any
    together: ClassVar[int] = 1  # scans that a CPU generates in hardly more time than one

    def to(self, device: str | torch.device) -> Self:
        """The same model with its network on another device. Raises ValueError for one that is not here."""
        check_device(device)
        self.network.to(device)
        return self

    def save(self, folder: str | Path, half: bool = False) -> Path:
        """Write `model.safetensors` (float16 if `half`) and `experiment.json`; `load(folder)` gives the model back.

        Raises OSError where the folder cannot be written.
        """
        return save(folder, self.experiment, self.network, half)

    def __repr__(self) -> str:
        """Three lines: what it is, its sensor, its network and where that is."""
        return described(type(self).__name__, self.experiment, self.sensor, self.network)

    def generate(
        self,
        n: int = 1,
        steps: int | None = None,
        seed: int = 0,
        sampler: str | None = None,
        batch_size: int = 4,
        on_step: OnStep = None,
        labels: bool = False,
    ) -> list[RangeImage]:
        """`n` new scans as range images; scan i depends on seed + i only.

        A CPU makes scans one by one, a cascade's grids in whole blocks, so that this holds bit by bit for any n and
        batch_size, with one number of threads; a GPU makes batch_size at once, and there it holds for one batch_size.
        Other numbers of threads, batches and processors add up in another order: scans differ by rounding.

        labels  the class of each return too, as `with_labels`

        Raises ValueError as `stream` does.
        """
        model = self.with_labels() if labels else self
        return list(model.stream(n, steps, seed, sampler, batch_size, on_step=on_step))

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

        What does not fit is said at once, not with the first scan: ValueError where the model only completes scans.
        """
        raise self._generates_nothing()

    def _checked(self, n: int, steps: int | None, seed: int, sampler: str | None, batch_size: int, first: int) -> None:
        """Raises ValueError for what `stream` cannot do."""
        calls = self.generation_steps(None if steps is None else whole("steps", steps), sampler)
        check_counts(n, calls, batch_size, first)
        checked_seed(seed)

    def complete(
        self,
        scan: Points | RangeImage,
        known: np.ndarray | None = None,
        method: str = "auto",
        steps: int | None = None,
        resamples: int | None = None,
        sampler: str | None = None,
        seed: int = 0,
        on_step: OnStep = None,
        precision: str | None = None,
        without: str | Sequence[str] | None = None,
    ) -> RangeImage:
        """Fill what was not measured; what was comes back exactly.

        scan       points: a scan, array or tensor (N, 3) x y z or (N, 4) x y z reflectance; or an image of this sensor
        known      (H, W) bool: pixels to keep bit by bit, where an empty pixel means that nothing returned. None =
                   those measured, and of points also rays that only have some beyond the range limits
        method, steps, resamples, sampler, precision  as `Filling` says; which words and defaults, the class of the
                   model says
        without    classes such as ("car", "person"), or "traffic": their points go, and what they hid is filled, all
                   else being known. Which these are, labels of the scan say, else the model

        Of a scan without `known`, `to_scan()` of the image gives every measured point bit by bit beside the new ones.
        Raises ValueError for what does not fit, for what this model cannot do, and where no point is in view or known.
        """
        removed = None if without is None else removable(without)
        how = Filling(method, steps, resamples, sampler, checked_seed(seed), precision, removed)
        scan = noted(self, scan, filling=removed is None)
        with usual_torch():
            return self.filled(scan, how, known, on_step)

    def upsample(
        self,
        scan: Points,
        sensor_in: Sensor | str | None = None,
        method: str = "auto",
        steps: int | None = None,
        seed: int = 0,
        on_step: OnStep = None,
        resamples: int | None = None,
        sampler: str | None = None,
        precision: str | None = None,
        times: int | None = None,
    ) -> RangeImage:
        """A sparse scan, of a sensor with fewer beams, as an image of this model's sensor; else as `complete`.

        A model of any sensor gives, until `into`, an image of the scan's own sensor, whose rays stay, with `times` - 1
        (default 3) new beams between each two.

        sensor_in  the sensor that made the scan; None = recognised from the points. Its beams tell which rows of the
                   image were looked at; points outside this model's view are kept by `to_scan()` alone.

        Raises ValueError when the sensor is not recognised or sees nothing that the model does, and for `times` as many
        beams of a model that cannot make them.
        """
        if self.any_sensor:  # others are made to take another's
            scan = noted(self, scan, sensor_in, filling=True, beams=True)
        how = Filling(method, steps, resamples, sampler, checked_seed(seed), precision)
        with usual_torch():
            return self.upsampled(scan, how, sensor_in, on_step, times)

    def realise(self, scan: Points | RangeImage, sensor: Sensor | str | None = None, seed: int = 0) -> Scan:
        """A simulator's scan, in which every ray returns, as the real sensor would have reported it.

        Points that return stay bit by bit with their fields, and get a reflectance; others, and those out of the
        sensor's view or limits, are gone. Which ones is drawn from the seed.

        scan    points: a scan, or an array or tensor (N, 3) x y z; their reflectance does not matter
        sensor  that the simulator plays; None = an image's own, else recognised from the points, or that of `into`

        Raises ValueError for a model that has not learned it, and where no point is in view.
        """
        made, seed = made_by(noted(self, scan, sensor), sensor), checked_seed(seed)
        with usual_torch():
            return self.realised(*made, seed).to_scan()

    def realised(self, scan: Scan | np.ndarray, sensor: Sensor | str | None = None, seed: int = 0) -> RangeImage:
        """The image of `realise`."""
        raise self._lacks("which rays return")

    def check_realises(self) -> None:
        """Raises ValueError for a model that cannot `realise`."""
        raise self._lacks("which rays return")

    def label(self, scan: Points | RangeImage, sensor: Sensor | str | None = None, least: float = 0.0) -> Scan:
        """The scan, bit by bit, with the class of each point: SemanticKITTI's 1-19, 0 out of the sensor's view or
        limits.

        scan    points: a scan, or an array or tensor (N, 3) x y z
        sensor  that made the scan; None = an image's own, else recognised from the points, or that of `into`
        least   points of whose class the network is less sure get 0 too; 0 to 1

        Labels that it had are replaced. Raises ValueError for a model that has learned no classes, where no point is in
        view, and for a `least` outside 0 to 1.
        """
        least, made = least_confidence(least), made_by(noted(self, scan, sensor), sensor)
        with usual_torch():
            return self.named(*made, least).to_scan()

    def named(self, scan: Scan | np.ndarray, sensor: Sensor | str | None = None, least: float = 0.0) -> RangeImage:
        """The image of `label`."""
        raise self._lacks("classes")

    def with_labels(self) -> ScanModel:
        """The same model, whose images also have the class of each return, SemanticKITTI's 1-19.

        Raises ValueError for a model that has learned no classes.
        """
        raise self._lacks("classes")

    def insert(
        self, scan: Points | RangeImage, things: str | Sequence[str], seed: int = 0, sensor: Sensor | str | None = None
    ) -> Inserted:
        """The scan with road users more, `scan` and `boxes`: what they hide is gone, what hides them stays.

        scan    points: a scan, or an array or tensor, as of `complete`; or an image, whose points are taken
        things  such as "car:2,person@8/-3": kinds, how many, or where: metres ahead, to the left, degrees of the front
        seed    of shapes, and of places where none is named, by the ground that the labels tell, else the model
        sensor  that made the scan; None = an image's own, else recognised from the points

        Points that stay are as they were, new ones have `new`, `instance`, a class; who finds no room is left out.
        Raises ValueError for other words, places that are not free, no room at all, and as `label`.
        """
        points, sensor = made_by(noted(self, scan, sensor), sensor)
        asked, rng = wanted(things), np.random.default_rng(checked_seed(seed))
        with usual_torch():
            return inserted(self.suited_to(points, sensor), points, asked, rng)

    def filled(
        self, scan: Points | RangeImage, how: Filling, known: np.ndarray | None = None, on_step: OnStep = None
    ) -> RangeImage:
        """`complete` of a record."""
        scan = scan if isinstance(scan, RangeImage) else taken(scan)
        model = self if how.precision is None else self.at_precision(how.precision)
        model = model.suited_to(scan) if isinstance(scan, Scan) else model.suited_to_image(scan)
        if model is not self:
            return model.filled(scan, replace(how, precision=None), known, on_step)
        how = self.resolved(how)
        if how.removed is not None:
            return emptied(self, scan, how, known, on_step)
        if known is not None or isinstance(scan, RangeImage):
            known = known_pixels(image := self.image_of(scan), known)
            image = check_seen(image.keep(known), int(image.mask.sum()))
            return with_own_classes(self.fill(image, known, how, on_step), image)
        pixels = pixel_of_points(scan, self.sensor, self.experiment.data.projection)
        image = check_seen(self.image_of(scan, pixels), len(scan))
        known = image.mask | occupied(scan, self.sensor, pixels)
        filled = with_own_classes(self.fill(image, known, how, on_step), image)
        return replace(filled, completed=with_measured(scan, image.mask, filled, pixels))

    def upsampled(
        self,
        scan: Points,
        how: Filling,
        sensor_in: Sensor | str | None = None,
        on_step: OnStep = None,
        times: int | None = None,
    ) -> RangeImage:
        """`upsample` of a record. Raises ValueError for `times` as many beams of a model that cannot make them."""
        if times is not None:
            raise ValueError(f"{self.experiment.name}: expected a model such as default for {times} times as many "
                             f"beams, found one with images of {self.sensor.name}")  # fmt: skip
        if how.precision is not None:
            return self.at_precision(how.precision).upsampled(scan, replace(how, precision=None), sensor_in, on_step)
        scan = taken(scan)
        how, sensor_in = self.resolved(how), sensor_that_made(scan, sensor_in)
        sparse, known = sparse_image(scan, sensor_in, self.sensor)
        loose = replace(scan, ring=None)  # its rings are not the model's
        pixels = pixel_of_points(loose, self.sensor, "spherical")
        known |= occupied(loose, self.sensor, pixels)
        filled = with_own_classes(self.fill_beams(scan, sensor_in, sparse, known, how, on_step), sparse)
        return replace(filled, completed=with_measured(scan, sparse.mask, filled, pixels))

    def check(self, how: Filling) -> None:
        """Raises ValueError, before any work, for a request that this model cannot do or would ignore."""
        self.resolved(how)
        self.at_precision(how.precision or "fp32")

    @abstractmethod
    def resolved(self, how: Filling) -> Filling:
        """The request with this model's own choices. Raises ValueError for what it cannot do, or would ignore."""

    @abstractmethod
    def calls(self, how: Filling) -> int:
        """How often a resolved request calls `on_step`."""

    @abstractmethod
    def fill(self, image: RangeImage, known: np.ndarray, how: Filling, on_step: OnStep = None) -> RangeImage:
        """The image, filled as a resolved request says; pixels of `known` (H, W) bool come back as they were."""

    def fill_beams(
        self,
        scan: Scan,
        sensor_in: Sensor,
        sparse: RangeImage,
        known: np.ndarray,
        how: Filling,
        on_step: OnStep = None,
    ) -> RangeImage:
        """`fill` of a scan of `sensor_in`, drawn into `sparse`; here without a look at its own beams."""
        return self.fill(sparse, known, how, on_step)

    @property
    def tuned(self) -> bool:
        """Whether the network saw real scans of this very sensor last."""
        return (card := self.experiment.card).sensor == self.sensor.name and not card.synthetic

    def stranger(self, scan: Scan, sensor: Sensor | str | None = None) -> str | None:
        """What a model that knows one sensor alone, or was tuned to one, has to say of another's scan, or None."""
        return stranger(self, scan, sensor)

    def into(self, sensor: Sensor | str) -> ScanModel:
        """The same model with images of another sensor. Raises ValueError for one that knows its own rays only."""
        name, own = get_sensor(sensor).name, self.sensor
        raise ValueError(f"{self.experiment.name}: expected a model of any sensor, such as default, for {name}, "
                         f"found one of {own.name} with {own.height} x {own.width} only")  # fmt: skip

    def suited_to(self, scan: Scan, sensor: Sensor | str | None = None) -> ScanModel:
        """The model that completes this scan in its own sensor's image; here itself, which knows one sensor.

        sensor  that made the scan; None = as recognised from the points

        Raises ValueError as `into` does for a sensor that is not the model's.
        """
        return self if sensor in (None, self.sensor, self.sensor.name) else self.into(sensor)  # type: ignore[arg-type]

    def suited_to_image(self, image: RangeImage) -> ScanModel:
        """The model that completes this image, of whose rays its own images are; here itself."""
        return self

    def at_precision(self, word: str) -> ScanModel:
        """The same model, its network at `fp32`, or `auto`, the fastest it knows. Raises ValueError for other words."""
        if word not in ("auto", "fp32"):
            raise ValueError(f"{self.experiment.name}: expected precision fp32, or a cascade such as default for bf16, "
                             f"found {word!r}")  # fmt: skip
        return self

    def at_once(self, batch_size: int) -> int:
        """How many scans to make at once: one on a CPU, where more are no faster and differ by rounding."""
        return 1 if next(self.network.parameters()).device.type == "cpu" else batch_size

    def image_of(self, scan: Scan | RangeImage, pixels: Pixels | None = None) -> RangeImage:
        """The scan in this model's image; `pixels` of its points, if known. Raises ValueError for one of other rays."""
        if isinstance(scan, Scan):
            wide = self.experiment.data.columns or self.sensor.width
            return project_thinned(scan, self.sensor, self.experiment.data.projection, wide, pixels=pixels)
        return of_rays(scan, self.sensor)

    def generation_steps(self, steps: int | None = None, sampler: str | None = None) -> int:
        """How often `generate` calls `on_step` per batch. Raises ValueError as `stream` does."""
        raise self._generates_nothing()

    def sampler_used(self, steps: int | None = None, sampler: str | None = None) -> str | None:
        """What a folder of generated scans records as its sampler: the word, None where there is none."""
        return sampler

    def evaluations(
        self, method: str = "auto", steps: int | None = None, resamples: int | None = None, sampler: str | None = None
    ) -> int:
        """How often `complete` calls `on_step`. Raises ValueError for what this model cannot do."""
        return self.calls(self.resolved(Filling(method, steps, resamples, sampler)))

    def push_to_hub(self, repo_id: str, private: bool = False, half: bool = False) -> str:
        """Upload the model, with a card filled in from its experiment, to `owner/name` of the Hugging Face hub.

        half  weights in float16, at half the size

        Returns the address; `load("owner/name")` then gives the model anywhere. Needs the extra `hub` and a token.
        Raises ValueError in one line when the hub refuses or cannot be reached.
        """
        card = card_text(self.experiment, self.description, checked_repository(repo_id))
        return push(self.experiment, self.network, repo_id, card, private, half)

    def _lacks(self, what: str) -> ValueError:
        return ValueError(f"{self.experiment.name}: expected a model that has learned {what}, such as default, found "
                          "one that has not")  # fmt: skip

    def _generates_nothing(self) -> ValueError:
        return ValueError(f"{self.experiment.name}: expected a model that makes scans from noise, found "
                          f"{self.kind}; use complete or upsample")  # fmt: skip
