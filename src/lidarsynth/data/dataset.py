"""The images of a cache, as range images or as x_0 for training."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lidarsynth.data.cache import (
    NO_LABEL,
    SHARD,
    npy_header,
    pack,
    record_type,
    sha256,
    write_cache,
)
from lidarsynth.data.frames import Name
from lidarsynth.data.index import INDEX, REPORT, read_index, stored_step
from lidarsynth.lidar import sensor as sensors
from lidarsynth.lidar.depth import encode
from lidarsynth.lidar.scan import RangeImage

ANY = "any projection"  # of streets, which need none

__all__ = [
    "INDEX", "REPORT", "SHARD", "CachedImages", "SeveralCaches", "pack", "read_index", "record_type",
    "verify", "write_cache",
]  # fmt: skip


class CachedImages:
    """The images of a cache: `len(images)`, `images[i] -> RangeImage`, `images.x_0(indices)`, `images.name(i)`.

    Each image is mapped from its shard while it is read and let go again, so neither memory nor open files grow with
    the cache, and the object can be sent to the workers of a loader. Raises ValueError when the folder is no cache or a
    shard has not the size that the index tells; `verify` compares the checksums too.
    """

    def __init__(self, folder: str | Path):
        index = read_index(folder)
        self.sensor = sensors.from_dict(index["sensor"], str(folder))
        self.source = index["source"]
        shards = [(name, entry) for name, entry in sorted(index["shards"].items()) if entry["count"]]
        if not shards:
            raise ValueError(f"{folder}: expected a cache with at least one shard, found none")
        self._step = stored_step(index)
        self._type = record_type(self.sensor)
        self._paths = [str(Path(folder) / name) for name, _ in shards]
        self._offsets = [_offset(Path(folder) / name, self._type, entry["count"]) for name, entry in shards]
        self._frames = [entry.get("frames") for _, entry in shards]
        self._starts = np.cumsum([0, *(entry["count"] for _, entry in shards)])
        self._tables: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def __len__(self) -> int:
        return int(self._starts[-1])

    def _place(self, i: int) -> tuple[int, int]:
        """Number of the shard, and of the image in it."""
        if not 0 <= i < len(self):
            raise IndexError(f"expected an image number in 0..{len(self) - 1}, got {i}")
        shard = int(np.searchsorted(self._starts, i, side="right")) - 1
        return shard, int(i - self._starts[shard])

    def record(self, i: int) -> np.ndarray:
        """The stored record of image i, read-only: the fields range, reflectance, label, each (H, W).

        Raises ValueError where its shard is no longer whole.
        """
        shard, row = self._place(i)
        offset = self._offsets[shard] + row * self._type.itemsize
        try:
            return np.memmap(self._paths[shard], self._type, "r", offset, (1,))[0]
        except (OSError, ValueError) as error:
            found = error.strerror if isinstance(error, OSError) else f"{os.path.getsize(self._paths[shard])} bytes"
            least = offset + self._type.itemsize
            raise ValueError(f"{self._paths[shard]}: expected a shard of the cache of {least} bytes and more, found "
                             f"{found}; data ... --check makes it anew") from None  # fmt: skip

    def name(self, i: int) -> Name:
        """Source, sequence and frame of image i; sequence "" and frame = its number in a cache without names."""
        shard, row = self._place(i)
        frames = self._frames[shard]
        return Name(self.source["name"], *(frames[row] if frames else ("", str(i))))

    def __getitem__(self, i: int) -> RangeImage:
        record = self.record(i)
        distance = record["range"].astype(np.float32) * np.float32(self._step)
        reflectance = record["reflectance"].astype(np.float32) / 255
        label = None if record["label"][0, 0] == NO_LABEL else record["label"].astype(np.int64)
        return RangeImage(distance, reflectance, distance > 0, self.sensor, label)

    def take(self, indices: list[int]) -> list[RangeImage]:
        """Images by their numbers."""
        return [self[i] for i in indices]

    def spread(self, count: int) -> list[int]:
        """Numbers of at most `count` images from everywhere."""
        count = min(count, len(self))
        return [k * len(self) // count for k in range(count)]

    def x_0(self, indices: list[int], codec: str = "log") -> Tensor:
        """(B, 2, H, W) float32 in [-1, 1]: range code and reflectance of the images, as `to_x_0` makes them."""
        if codec not in self._tables:
            self._tables[codec] = _tables(self.sensor, codec, self._step)
        code, reflectance = self._tables[codec]
        x_0 = np.empty((len(indices), 2, self.sensor.height, self.sensor.width), np.float32)
        for sample, i in zip(x_0, indices, strict=True):
            record = self.record(i)
            np.take(code, record["range"], out=sample[0], mode="clip")  # every code is in the table; clip spares a copy
            np.take(reflectance, record["reflectance"], out=sample[1], mode="clip")
        return torch.from_numpy(x_0)


class SeveralCaches:
    """The images of several caches of one sensor as one, of each equally many: those of a small cache come again.

    Used like `CachedImages`; `scans` counts each once. Raises ValueError when the caches' sensors or projections
    differ; streets, which are cast into the sensor's rays, have none and suit any.
    """

    def __init__(self, folders: Sequence[str | Path]):
        self._parts = [CachedImages(folder) for folder in folders]
        first, sources = self._parts[0], [part.source for part in self._parts]
        projection = next(filter(None, (source.get("projection") for source in sources)), None)
        for folder, part in zip(folders, self._parts, strict=True):
            if part.sensor != first.sensor or part.source.get("projection") not in (projection, None):
                raise ValueError(
                    f"{folder}: expected the sensor and the projection of {folders[0]}, {first.sensor.name} of "
                    f"{first.sensor.height} x {first.sensor.width} and {projection or ANY}, found "
                    f"{part.sensor.name} of {part.sensor.height} x {part.sensor.width} and "
                    f"{part.source.get('projection') or ANY}"
                )
        self.sensor = first.sensor
        places = [Path(folder).resolve() for folder in folders]
        own, often = dict(zip(places, self._parts, strict=True)), Counter(places)
        self.scans = sum(map(len, own.values()))
        named = " and ".join(f"{len(part):,} of {part.source['name']}{f' ({n} x)' if (n := often[place]) > 1 else ''}"
                             for place, part in own.items())  # fmt: skip
        self.source = {"name": f"several caches ({named})"} | ({"projection": projection} if projection else {})

    def __len__(self) -> int:
        return len(self._parts) * max(map(len, self._parts))

    def _place(self, i: int) -> tuple[CachedImages, int]:
        """The cache of image i, and its number there."""
        if not 0 <= i < len(self):
            raise IndexError(f"expected an image number in 0..{len(self) - 1}, got {i}")
        part = self._parts[i % len(self._parts)]
        return part, i // len(self._parts) % len(part)

    def name(self, i: int) -> Name:
        """Source, sequence and frame of image i."""
        part, place = self._place(i)
        return part.name(place)

    def __getitem__(self, i: int) -> RangeImage:
        part, place = self._place(i)
        return part[place]

    def take(self, indices: list[int]) -> list[RangeImage]:
        """Images by their numbers."""
        return [self[i] for i in indices]

    def spread(self, count: int) -> list[int]:
        """Numbers of at most `count` images from everywhere, of each cache in turn."""
        count, parts = min(count, len(self)), len(self._parts)
        return [k * len(self) // count // parts * parts + k % parts for k in range(count)]

    def x_0(self, indices: list[int], codec: str = "log") -> Tensor:
        """(B, 2, H, W) float32 in [-1, 1]."""
        return torch.cat([part.x_0([place], codec) for part, place in map(self._place, indices)])


def _tables(sensor: sensors.Sensor, codec: str, step: float) -> tuple[np.ndarray, np.ndarray]:
    """x_0 of every stored range (65536,) and of every stored reflectance (256,), float32: logarithms are taken once."""
    distance = torch.arange(1 << 16, dtype=torch.float32) * step
    reflectance = torch.arange(256, dtype=torch.float32) / 255
    return (2 * encode(distance, sensor, codec) - 1).numpy(), (2 * reflectance - 1).numpy()


def _offset(path: Path, kind: np.dtype, count: int) -> int:
    """Where the records of a shard begin. Raises ValueError when the file cannot hold them."""
    header = len(npy_header(kind, count))
    size = path.stat().st_size if path.is_file() else 0
    if size != header + count * kind.itemsize:
        raise ValueError(f"{path}: expected {header + count * kind.itemsize} bytes, found {size}; "
                         "prepare the cache again, the same command repairs it")  # fmt: skip
    return header


def verify(folder: str | Path) -> int:
    """Compare every shard of a cache with its checksum; returns how many images are sound.

    Raises ValueError that names the damaged shards; `write_cache(..., check=True)` makes them anew.
    """
    shards = {name: entry for name, entry in read_index(folder)["shards"].items() if entry["count"]}
    paths = {name: Path(folder) / name for name in shards}
    bad = [n for n in sorted(shards) if not paths[n].is_file() or sha256(paths[n]) != shards[n]["sha256"]]
    if bad:
        raise ValueError(f"{folder}: expected the checksums of {INDEX}, found others in {', '.join(bad)}; "
                         "prepare the cache again with --check")  # fmt: skip
    return sum(entry["count"] for entry in shards.values())
