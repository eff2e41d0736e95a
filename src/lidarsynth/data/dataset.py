"""Any reader + projection -> a cache on disk -> x_0. A cache is a folder of memory-mapped shards and an index."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lidarsynth.lidar import sensor as sensors
from lidarsynth.lidar.depth import encode
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor

INDEX = "index.json"
RANGE_STEP = 0.002  # metres per unit of the stored uint16; 0 = nothing returned, up to 131 m
SHARD = 64  # images per shard


def record_type(sensor: Sensor) -> np.dtype:
    """One stored image: range in steps of 2 mm, reflectance in steps of 1/255, SemanticKITTI class."""
    shape = (sensor.height, sensor.width)
    return np.dtype([("range", "<u2", shape), ("reflectance", "u1", shape), ("label", "u1", shape)])


def pack(image: RangeImage) -> np.ndarray:
    """RangeImage -> one record (); measured pixels never become 0, empty ones always are."""
    record = np.zeros((), record_type(image.sensor))
    steps = np.clip(np.round(image.range / RANGE_STEP), 1, 65535)
    record["range"] = np.where(image.mask, steps, 0)
    record["reflectance"] = np.round(np.clip(image.reflectance, 0, 1) * 255)
    if image.label is not None:
        record["label"] = image.label
    return record


def write_cache(
    folder: str | Path,
    image: Callable[[int], RangeImage],
    count: int,
    sensor: Sensor,
    source: dict[str, Any],
) -> Iterator[int]:
    """Store images 0..count-1 and yield how many are stored so far, shard by shard.

    Interrupted at any moment, the next call continues: a shard is moved into place when it is whole. `source` says what
    the images are and must be the same when continuing. Raises ValueError when the folder holds something else.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    head = {"source": source, "sensor": sensor.to_dict(), "count": count, "shards": {}}
    index = read_index(folder) if (folder / INDEX).exists() else head
    if {k: index[k] for k in ("source", "sensor")} != json.loads(
        json.dumps({k: head[k] for k in ("source", "sensor")})
    ):
        raise ValueError(f"{folder}: expected a cache of {source}, found one of {index['source']}")
    index["count"] = max(count, index["count"])
    for first in range(0, count, SHARD):
        name = f"{first:07d}.npy"
        if name not in index["shards"] or not (folder / name).exists():
            records = np.stack([pack(image(i)) for i in range(first, min(first + SHARD, count))])
            index["shards"][name] = {"count": len(records), "sha256": _store(folder / name, records)}
            _write_index(folder, index)
        yield min(first + SHARD, count)


def _store(path: Path, records: np.ndarray) -> str:
    scratch = path.with_suffix(".tmp.npy")
    try:
        np.save(scratch, records)
        digest = hashlib.sha256(scratch.read_bytes()).hexdigest()
        os.replace(scratch, path)
    finally:
        scratch.unlink(missing_ok=True)
    return digest


def _write_index(folder: Path, index: dict) -> None:
    scratch = folder / (INDEX + ".tmp")
    scratch.write_text(json.dumps(index, indent=1))
    os.replace(scratch, folder / INDEX)


def read_index(folder: str | Path) -> dict:
    """The index of a cache. Raises ValueError when the folder is not one."""
    path = Path(folder) / INDEX
    try:
        index = json.loads(path.read_text())
    except OSError as error:
        raise ValueError(f"{folder}: expected a cache folder with {INDEX}, found {error.strerror}") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: expected JSON, found {error}") from None
    if not isinstance(index, dict) or not {"source", "sensor", "count", "shards"} <= index.keys():
        raise ValueError(f"{path}: expected the fields source, sensor, count, shards, found another table")
    return index


class CachedImages:
    """The images of a cache, memory-mapped: `len(images)`, `images[i] -> RangeImage`, `images.x_0(indices)`."""

    def __init__(self, folder: str | Path):
        index = read_index(folder)
        self.sensor = sensors.from_dict(index["sensor"], str(folder))
        self.source = index["source"]
        shards = [np.load(Path(folder) / name, mmap_mode="r") for name in sorted(index["shards"])]
        if not shards:
            raise ValueError(f"{folder}: expected a cache with at least one shard, found none")
        self._shards = shards
        self._starts = np.cumsum([0, *(len(s) for s in shards)])

    def __len__(self) -> int:
        return int(self._starts[-1])

    def record(self, i: int) -> np.ndarray:
        """The stored record () of image i."""
        if not 0 <= i < len(self):
            raise IndexError(f"expected an image number in 0..{len(self) - 1}, got {i}")
        shard = int(np.searchsorted(self._starts, i, side="right")) - 1
        return self._shards[shard][i - self._starts[shard]]

    def __getitem__(self, i: int) -> RangeImage:
        record = self.record(i)
        distance = record["range"].astype(np.float32) * np.float32(RANGE_STEP)
        reflectance = record["reflectance"].astype(np.float32) / 255
        return RangeImage(distance, reflectance, distance > 0, self.sensor, record["label"].astype(np.int64))

    def x_0(self, indices: list[int], codec: str = "log") -> Tensor:
        """(B, 2, H, W) float32 in [-1, 1]: range code and reflectance of the images."""
        records = [self.record(i) for i in indices]
        distance = np.stack([r["range"] for r in records]).astype(np.float32) * np.float32(RANGE_STEP)
        reflectance = np.stack([r["reflectance"] for r in records]).astype(np.float32) / 255
        code = encode(torch.from_numpy(distance), self.sensor, codec)
        return 2 * torch.stack([code, torch.from_numpy(reflectance)], dim=1) - 1
