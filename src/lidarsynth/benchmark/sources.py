"""Where a benchmark's images come from: a path, synthetic streets that are cast once, or the shipped scan."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path

import numpy as np

from lidarsynth.benchmark.config import Upsampling, protocols_of
from lidarsynth.data.sources import SYNTHETIC, cache_synthetic
from lidarsynth.evaluation.accumulation import OnImages
from lidarsynth.evaluation.image_sets import ImageSet, image_set, sensor_of
from lidarsynth.evaluation.notes import other_frames, out_of_images, tensors_taken, unlike_metres, unlike_sensors
from lidarsynth.evaluation.protocols import get_protocol
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.lidar.projection import PROJECTIONS
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor, get_sensor

STREET = "street"  # the scan that comes with the package


def located(word: str, folder: Path, sensor: str | None = None, on_images: OnImages = None) -> Path:
    """The file, folder or cache of a word of a benchmark's file.

    `synthetic:COUNT:SEED`, each scan from a street of its own, is cast into a cache below `folder`, which goes on where
    it was stopped. Raises ValueError.
    """
    if word == STREET:
        return Path(__file__).parents[1] / "shipped" / "street.npz"
    if not word.startswith("synthetic:"):
        return Path(word).expanduser()
    numbers = word.split(":")[1:]
    if len(numbers) != 2 or not all(n.isdecimal() for n in numbers) or not int(numbers[0]):
        raise ValueError(f"expected synthetic:COUNT:SEED, such as synthetic:64:777, found {word!r}")
    count, seed = map(int, numbers)
    cache = folder / f"streets-{count}-{seed}{f'-{Path(sensor).stem}' if sensor else ''}"
    for done, total in cache_synthetic(cache, count, sensor or SYNTHETIC, seed=seed, apart=True):
        if on_images:
            on_images("streets", done, total)
    return cache


@dataclass(frozen=True)
class Corrupted:
    """Measured images of which a part is hidden: `len(data)`, `data[i] -> (truth, known (H, W) bool)`."""

    images: ImageSet
    sensor: Sensor
    projection: str
    recipe: str
    seed: int
    count: int

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, i: int) -> tuple[RangeImage, np.ndarray]:
        truth = self.images.image(i, self.sensor, self.projection)
        known = corrupt(truth, self.recipe, self.seed + i)
        if known.all():
            raise ValueError(f"expected a corruption that hides at least one pixel, found {self.recipe!r}")
        return truth, known

    @property
    def names(self) -> tuple[str, ...]:
        """Of the images, `sequence/frame` where they are of a cache."""
        return self.images.names[: self.count]

    def stamps(self, on_image: Callable[[int], object] | None = None) -> tuple[dict[int, str], tuple[str, ...]]:
        """What is told and what is to be found, scan by scan: 16 hex digits of the truth, the known pixels, and the
        sensor, as its file says it now; and the names of all their sensors, of images their own."""
        found, sensors = {}, {}
        for i in range(len(self)):
            truth, known = self[i]
            content = [np.ascontiguousarray(v).tobytes() for v in (truth.range, truth.reflectance, truth.mask, known)]
            told = json.dumps(truth.sensor.to_dict()).encode()
            sensors[truth.sensor.name] = None
            found[i] = blake2b(b"".join([*content, told]), digest_size=8).hexdigest()
            if on_image:
                on_image(i + 1)
        return found, tuple(sensors)

    def notes(self, named: str | None) -> tuple[str, ...]:
        """What is unlike in the scans and the images that they are taken as, as `evaluate` says it of a reference.

        named  the sensor of points and tensors that the file names, if it does
        """
        sides = {"the scans": self.images}
        told = unlike_sensors(sides, self.sensor) + out_of_images(sides, self.sensor)
        return told + tensors_taken(sides, self.sensor, named) + unlike_metres(sides) + other_frames(sides)

    def shown(self, number: int | None) -> int:
        """The scan of the figure: the given one, or the first with labels of the first hundred, or the first."""
        if number is not None:
            return number
        return next((i for i in range(min(len(self), 100)) if self[i][0].label is not None), 0)


def corrupted(config: Upsampling, folder: Path, on_images: OnImages = None) -> Corrupted:
    """The images of an upsampling benchmark. Raises ValueError."""
    if config.projection not in PROJECTIONS:
        raise ValueError(f"projection: expected one of {', '.join(PROJECTIONS)}, found {config.projection!r}")
    images = image_set(located(config.data, folder, config.sensor, on_images))
    sensor = get_sensor(config.sensor or get_protocol(protocols_of(config)[0]).sensor)
    count = min(config.images or len(images), len(images))
    if config.figure is not None and config.figure >= count:
        raise ValueError(f"figure: expected the number of one of {count} images, 0 to {count - 1}, "
                         f"found {config.figure}")  # fmt: skip
    return Corrupted(
        images, sensor_of(images.item(0), sensor), config.projection, config.corruption, config.seed, count
    )
