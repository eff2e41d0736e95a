"""Sets of range images to judge, whatever they come as: a cache, saved images, published samples, scans, a list."""

from __future__ import annotations

import zipfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
from torch import Tensor

from lidarsynth.data.bags import is_bag
from lidarsynth.data.cache_files import is_cache
from lidarsynth.data.capture import is_capture
from lidarsynth.data.dataset import INDEX, CachedImages
from lidarsynth.data.folder import check_readable, scans_below
from lidarsynth.evaluation.protocol import Clouds
from lidarsynth.evaluation.sample_tensors import check_distances, check_points, from_tensor, within
from lidarsynth.files.arrays import ZIP_ERRORS, image_of, unzip
from lidarsynth.files.fields import INTENSITIES, MAX_BYTES
from lidarsynth.files.formats import NAMED_ONLY, READERS, holds_image, naming, no_file, read, read_image
from lidarsynth.lidar.corner_grid import decoded, drawn_and_coded, on_corner_grid
from lidarsynth.lidar.depth import OVERSHOOT
from lidarsynth.lidar.projection import project_thinned, thin
from lidarsynth.lidar.scan import RangeImage, Scan, as_scan, no_metres
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.lidar.small_file import check_regular
from lidarsynth.metrics.distributions import as_numbers
from lidarsynth.networks.device import usual_torch
from lidarsynth.networks.tensors import as_array, read_pickle, saved_shape

TENSORS = (".pth", ".pt")  # (5, H, W) of R2DM, (2, H, W) of LiDARGen, or (B, ...) of either
Item: TypeAlias = RangeImage | Scan | Tensor
HELD = "a range image, a scan, points (N, 3) or (N, 4), or a tensor (5, H, W) or (2, H, W)"  # by a list


@runtime_checkable
class Numbered(Protocol):
    """What has a length and gives its i-th: a list, a stacked array, a data set that reads or makes each when asked.

    Each is a range image, a scan, an array of points as `lidar.scan.as_scan` takes it, or a published sample (5, H, W)
    or (2, H, W), as an array or a tensor. One is held at a time; some are asked for several times, and must then be
    the same.
    """

    def __len__(self) -> int: ...
    def __getitem__(self, i: int, /) -> Any: ...


@dataclass(frozen=True)
class Cloud:
    """The points of an image or scan, float32 metres: `xyz` (n, 3) as a protocol takes them, `held` (m, 3) all."""

    xyz: np.ndarray
    held: np.ndarray


@dataclass(frozen=True)
class ImageSet:
    """Images, read one at a time: `len(images)`, `images[i]`.

    names   one per image; `sequence/frame` in a cache. Errors begin with it
    item    image number -> what is stored: a range image, points, or a published tensor
    source  in words
    stamp   changes when the files do; "" where nothing can be kept from one run to the next
    """

    names: tuple[str, ...]
    item: Callable[[int], Item]
    source: str
    stamp: str

    def __len__(self) -> int:
        return len(self.names)

    def image(
        self,
        i: int,
        sensor: Sensor,
        projection: str,
        resize: bool = False,
        resizing: str = "nearest-exact",
        whole: bool = False,
    ) -> RangeImage:
        """Image i in the sensor's size, its empty pixels 0; points are projected, larger images thinned where `resize`.

        resizing  as in `projection.thin`; whole  as in `from_tensor`
        Raises ValueError that begins with the image's name.
        """
        try:
            item = self.item(i)  # made as the program around this wants it
            with usual_torch():
                return as_image(judged(item), sensor, projection, resize, resizing, whole)
        except ValueError as error:
            raise self._named(i, error) from None

    def sensor(self, fallback: Sensor) -> Sensor:
        """Of the first image, as `sensor_of`. Raises ValueError that begins with its name."""
        try:
            return sensor_of(self.item(0), fallback)
        except ValueError as error:
            raise self._named(0, error) from None

    def points(self, i: int, sensor: Sensor, clouds: Clouds, real: bool) -> Cloud:
        """The points of image i as the record takes those of real scans or of samples.

        sensor  of tensors, at their size
        Raises ValueError that begins with the image's name, also for a scan without any point in range.
        """
        try:
            item = self.item(i)
            with usual_torch():
                return points_of(judged(item), sensor, clouds, real)
        except ValueError as error:
            raise self._named(i, error) from None

    def _named(self, i: int, error: ValueError) -> ValueError:
        name, text = self.names[i], str(error)
        file = name.rpartition("[")[0] or name  # of one of a batch, the batch's
        return ValueError(f"{name}: {text.removeprefix(f'{name}: ').removeprefix(f'{file}: ')}")


def image_set(source: str | Path | Numbered, intensity: str = "auto") -> ImageSet:
    """The images of a cache, a folder at any depth, one file, or by number. Raises ValueError when there is none.

    intensity  scale of files of points, as in `files.formats.read`
    """
    if intensity not in INTENSITIES:  # said of images, too, which have no use for it
        raise ValueError(f"expected an intensity of {', '.join(INTENSITIES)}, found {intensity!r:.60}")
    if not isinstance(source, str | Path):
        names = tuple(f"image {i}" for i in range(len(source)))
        if not names:
            raise ValueError("expected at least one range image, found an empty list")
        return ImageSet(names, lambda i: _taken(source[i], names[i]), "a list of images", "")
    path = Path(source)
    if path.is_dir():
        check_readable(path)
    if path.is_dir() and is_cache(path):
        cache = CachedImages(path)
        names = tuple("/".join(cache.name(i)[1:]) for i in range(len(cache)))
        return ImageSet(names, cache.__getitem__, str(path), sha256((path / INDEX).read_bytes()).hexdigest())
    files = _files(path)
    stats = [(str(file.relative_to(path)), file.stat()) for file in files] if path.is_dir() else [("", path.stat())]
    kept = [(name, s.st_size, s.st_mtime_ns, s.st_ctime_ns, s.st_ino) for name, s in stats]  # archives keep times
    stamp = sha256(repr((str(path.resolve()), kept, intensity)).encode()).hexdigest()
    items = [(file, k) for file in files for k in _numbers(file)]
    if not items:
        raise ValueError(f"{path}: expected at least one range image, found {len(files)} files of none")
    names = tuple(str(file) if k is None else f"{file}[{k}]" for file, k in items)
    return ImageSet(names, lambda i: read_item(*items[i], intensity), str(path), stamp)


def is_numbered(source: object) -> bool:
    """Whether it is a list of scans or like one; a scan, a range image and a dict are not."""
    return isinstance(source, Numbered) and not isinstance(source, Mapping | Scan)


def _taken(given: object, name: str) -> Item:
    """One of `Numbered` as it is stored elsewhere. Raises ValueError that begins with its name."""
    if isinstance(given, RangeImage):
        return given
    if not isinstance(given, Tensor | np.ndarray | Scan):
        raise ValueError(f"{name}: expected {HELD}, or one folder for all, found {' '.join(repr(given).split()):.80}")
    try:
        if not isinstance(given, Scan) and given.ndim == 3:
            return as_numbers(given).cpu()
        return as_scan(as_array(given))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _is_recording(path: Path) -> bool:
    return is_bag(path) or is_capture(path)


def _files(path: Path) -> list[Path]:
    """The readable files under a folder, sorted, or the file itself. Hidden files and folders are left out, and what a
    folder of scans may hold beside them, as the other verbs do."""
    known: tuple[str, ...] = (*READERS, *TENSORS)
    if path.is_dir():
        files, known = scans_below(path, TENSORS), tuple(suffix for suffix in known if suffix not in NAMED_ONLY)
    else:
        files = [path] if path.is_file() and path.name.lower().endswith(known) else []
    files = [file for file in files if not any(part[0] == "." for part in file.relative_to(path).parts)]
    if not files:
        found = "none" if path.is_dir() else "another file" if path.is_file() else "no such file or folder"
        if path.exists() and any(map(_is_recording, (path, *(path.iterdir() if path.is_dir() else ())))):
            found = "a bag or capture, of whose scans `lidarsynth project` makes a folder of images"
        raise ValueError(f"{path}: expected a cache, or samples ({', '.join(known)}), found {found}")
    stems = [file.with_name(stem_of(file.name)) for file in files]
    if doubled := [stem for stem, count in Counter(stems).items() if count > 1]:
        two = [file.name for file, stem in zip(files, stems, strict=True) if stem == doubled[0]][:2]
        raise ValueError(f"{path}: expected one file per scan, found {' and '.join(two)}")
    if broken := next(((file, what) for file in files if (what := no_file(file)) is not None), None):
        raise ValueError(f"{broken[0]}: expected a file, found {broken[1]}")
    return files


def stem_of(name: str) -> str:
    """The last part of a name, without the ending of a readable file."""
    last = name.rpartition("/")[2]
    endings = [ending for ending in (*READERS, *TENSORS) if last.lower().endswith(ending)]
    return last[: -len(max(endings, key=len))] if endings else last


def _numbers(path: Path) -> Sequence[int | None]:
    """Numbers of the images of a batch, by the header of its `.npz` or `.pth`; [None] for a file of one scan."""
    if path.suffix.lower() in TENSORS:
        shape = saved_shape(path)
        return range(shape[0]) if len(shape) == 4 else [None]
    if path.suffix.lower() != ".npz":
        return [None]
    try:
        with zipfile.ZipFile(path) as archive, archive.open("range.npy") as file:
            version = np.lib.format.read_magic(file)
            read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
            shape = read_header[version](file)[0]
    except ZIP_ERRORS:
        return [None]  # something else, or damaged: reading it says so
    return range(shape[0]) if len(shape) == 3 else [None]


def read_item(path: Path, number: int | None = None, intensity: str = "auto") -> Item:
    """A range image (our `.npz`), points of any readable file, or the tensor of a published sample (`.pth`).

    number     which image of a batch: an `.npz` whose range, reflectance, mask, and label, xyz are (B, ...), or tensors
               (B, 5, H, W) or (B, 2, H, W)
    intensity  scale of points, as in `files.formats.read`
    Raises ValueError that begins with the path.
    """
    if path.suffix.lower() in TENSORS:
        tensor = _tensor(path, _stamp(path))
        return tensor if number is None else tensor[number]
    if number is not None:
        batch = _arrays(path, _stamp(path))
        arrays = {name: array if name == "sensor" else array[number] for name, array in batch.items()}
        with naming(f"{path}[{number}]"):
            return image_of(arrays)
    return read_image(path) if holds_image(path) else read(path, intensity)


def _stamp(path: Path) -> tuple[int, ...]:
    """Of a file as it is now."""
    s = path.stat()
    return s.st_size, s.st_mtime_ns, s.st_ctime_ns, s.st_ino


@lru_cache(maxsize=1)  # images of a batch are read one after the other
def _arrays(path: Path, stamp: tuple[int, ...]) -> dict[str, np.ndarray]:
    with naming(path):
        arrays = unzip(path.read_bytes())
    sizes = {name: array.shape[:1] for name, array in arrays.items() if name != "sensor"}
    if len(set(sizes.values())) != 1:
        raise ValueError(f"{path}: expected a batch of arrays (B, ...), found {sizes}")
    return arrays


@lru_cache(maxsize=1)
def _tensor(path: Path, stamp: tuple[int, ...]) -> Tensor:
    check_regular(path, MAX_BYTES)
    tensor = read_pickle(path, str(path))
    if not isinstance(tensor, Tensor):
        raise ValueError(f"{path}: expected a tensor (5, H, W) or (2, H, W), or a stack of such, found "
                         f"{type(tensor).__name__}")  # fmt: skip
    return tensor


def judged(item: Item) -> Item:
    """What counts of a stored form: an empty pixel holds nothing. Raises ValueError for a tensor or image whose ranges
    are not those of its points, for ranges that are no metres, and an image's reflectance outside 0 to 1 (up to 0.05 is
    clipped)."""
    if isinstance(item, Tensor):
        check_points(item)
        if item.ndim == 3 and len(item) == 5:
            _check_metres(item[0].detach().double().numpy())
        return item
    if isinstance(item, RangeImage):
        _check_metres(item.range[item.mask])
        image = emptied(item)
        farthest, brightest = float(image.range.max()), float(image.reflectance.max())
        if farthest <= 1 + OVERSHOOT < brightest:
            found = f"ranges of at most {farthest:.3g} and a reflectance of up to {brightest:.3g}: are they exchanged?"
            raise ValueError(f"expected ranges in metres and a reflectance of 0 to 1, found {found}")
        if image.reflectance.min() < 0 or image.reflectance.max() > 1:
            image = replace(image, reflectance=within("a reflectance", image.reflectance, 1))
        if image.xyz is not None:
            check_distances("range", image.range, image.xyz)
        return image
    return item


def _check_metres(far: np.ndarray) -> None:
    if text := no_metres(far):
        raise ValueError(text)


def emptied(image: RangeImage) -> RangeImage:
    """The image with 0 in its empty pixels, whatever stood there."""
    layers = [image.range, image.reflectance, *([] if image.xyz is None else [image.xyz])]
    return image.keep(image.mask) if any(layer[~image.mask].any() for layer in layers) else image


def as_image(
    item: Item,
    sensor: Sensor,
    projection: str,
    resize: bool = False,
    resizing: str = "nearest-exact",
    whole: bool = False,
) -> RangeImage:
    """Any stored form as a range image of the sensor's size. Raises ValueError for another size, NaN, other shapes."""
    size = (sensor.height, sensor.width)
    if isinstance(item, Scan):
        return project_thinned(item, sensor, projection, resizing=resizing)
    if isinstance(item, Tensor):
        return from_tensor(item, sensor, whole)
    if item.shape != size and not (resize and _divides(size, item.shape)):
        raise ValueError(f"expected images of one size, {size[0]} x {size[1]}, found one of {item.shape[0]} x "
                         f"{item.shape[1]}")  # fmt: skip
    return item if item.shape == size else thin(item, *size, resizing)


def points_of(item: Item, sensor: Sensor, clouds: Clouds, real: bool) -> Cloud:
    """The points of any stored form, as `ImageSet.points`. Raises ValueError for NaN, or none in range."""
    if isinstance(item, Tensor):
        item = from_tensor(item, sensor_of(item, sensor))
    xyz = (item.xyz if isinstance(item, Scan) else item.points()[item.mask]).astype(np.float32)
    xyz = xyz[(xyz != 0).any(axis=1)]
    if not np.isfinite(xyz).all():
        raise ValueError(f"expected finite points, found {np.sum(~np.isfinite(xyz).all(1))} with NaN or infinity")
    distance = np.linalg.norm(xyz, axis=1)
    within = (distance > clouds.near) & (distance < clouds.far)
    if not within.any():
        raise ValueError(f"expected points between {clouds.near:g} and {clouds.far:g} m, found none of {len(xyz)}")
    if not (real and clouds.redrawn):
        return Cloud(xyz[within] if clouds.gated and not real else xyz, xyz)
    if isinstance(item, RangeImage) and item.xyz is None and on_corner_grid(item.sensor):
        return Cloud(decoded(item.range * item.mask, clouds.near, clouds.far), xyz)  # drawn once already
    return Cloud(drawn_and_coded(xyz, clouds.near, clouds.far), xyz)


def _divides(size: tuple[int, int], larger: tuple[int, int]) -> bool:
    return all(b % a == 0 for a, b in zip(size, larger, strict=True))


def sensor_of(first: Item, fallback: Sensor) -> Sensor:
    """The sensor of a set by its first item: an image's own; a tensor's size on `fallback`; `fallback` for points.

    Raises ValueError for a tensor whose rows `fallback` cannot be thinned to.
    """
    if isinstance(first, RangeImage):
        return first.sensor
    if isinstance(first, Scan):
        return fallback
    if first.ndim != 3 or first.shape[0] not in (2, 5) or first.shape[2] < 4 or fallback.height % first.shape[1]:
        raise ValueError(f"expected a tensor (5, H, W) or (2, H, W) with rows that divide {fallback.name}'s "
                         f"{fallback.height}, found {tuple(first.shape)}")  # fmt: skip
    return resized(fallback, first.shape[1], first.shape[2])


def resized(sensor: Sensor, height: int, width: int) -> Sensor:
    """The sensor at this size, by its own name."""
    return replace(sensor.resized(height, width), name=sensor.name)
