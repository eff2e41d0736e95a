"""Writing a cache: a folder of .npy shards of packed range images, an index with every image's name, and a report."""

from __future__ import annotations

import hashlib
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from lidarsynth.data.index import MOVED, close_index, open_index, resumable_file, stored_step, write_index
from lidarsynth.data.workers import in_order
from lidarsynth.files.lock import only_writer
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.lidar.stored import RANGE_STEP, range_step

NO_LABEL = 255  # in every pixel of an image without labels
SHARD = 64  # images per shard
INDEX_EVERY = 2.0  # seconds between two writings of the index: what a kill can cost

Namer = Callable[[int], Sequence[str]]  # image number -> (..., sequence, frame)
Stamp = Callable[[int], tuple[str, str]]  # image number -> what changes when its files do, and also when they move


def record_type(sensor: Sensor) -> np.dtype:
    """One stored image: range in the index's steps, reflectance in steps of 1/255, SemanticKITTI class or NO_LABEL."""
    shape = (sensor.height, sensor.width)
    return np.dtype([("range", "<u2", shape), ("reflectance", "u1", shape), ("label", "u1", shape)])


def pack(image: RangeImage, step: float = RANGE_STEP) -> np.ndarray:
    """RangeImage -> one record () with ranges in `step` metres; measured pixels never become 0, empty ones always are.

    Raises ValueError for a range that does not fit.
    """
    record = np.zeros((), record_type(image.sensor))
    steps = np.maximum(np.round(image.range / step), 1)
    if (furthest := float(steps.max(initial=0, where=image.mask))) > 65535:
        raise ValueError(f"expected ranges up to {65535 * step:.2f} m, found {furthest * step:.2f} m")
    record["range"] = np.where(image.mask, steps, 0)
    record["reflectance"] = np.round(np.clip(image.reflectance, 0, 1) * 255)
    record["label"] = NO_LABEL if image.label is None else image.label
    return record


def write_cache(
    folder: str | Path,
    image: Callable[[int], RangeImage],
    count: int,
    sensor: Sensor,
    source: dict[str, Any],
    name: Namer | None = None,
    workers: int = 0,
    check: bool = False,
    stamp: Stamp | None = None,
) -> Iterator[int]:
    """Store images 0..count-1 and yield how many are done so far, shard by shard; skipped scans count as done.

    image    image number -> its range image; ValueError = that scan is broken: it is skipped and named in REPORT
    source   says what the images are; the same call goes on with a cache only where this and the names are the same
    name     image number -> (..., sequence, frame), kept in the index
    workers  processes; two or more need a picklable `image` and `name`, with fewer this one works itself
    check    compare the checksums of the shards that are there, and make anew those that differ
    stamp    image number -> a text that changes when its files do, and one that also does where they were copied
             elsewhere; shards of changed files are made anew
    Interrupted at any moment, the next call continues: a shard is moved into place when it is whole. Raises ValueError
    when the folder holds something else, another process writes to it, an image has not the sensor's shape or no scan
    can be read, OSError of one line when the disk is full.
    """
    folder = Path(folder)
    with only_writer(folder, "preparation of a cache"):
        yield from _write(folder, image, count, sensor, source, name, workers, check, stamp)


def _write(
    folder: Path,
    image: Callable[[int], RangeImage],
    count: int,
    sensor: Sensor,
    source: dict[str, Any],
    name: Namer | None,
    workers: int,
    check: bool,
    stamp: Stamp | None,
) -> Iterator[int]:
    index = open_index(folder, sensor, source, count, range_step(sensor))
    task = _Task(folder, image, name, count, stored_step(index), stamp, (sensor.height, sensor.width))
    _refuse_gone(index, task)
    if stamp is not None:  # fewer than before, where the last of a shard are gone
        index["count"] = count
    firsts = range(0, count, SHARD)
    for first in firsts if index.pop(MOVED, False) else ():  # a copy has other times
        if (entry := index["shards"].get(_shard(first))) and entry.get("files", [None])[0] == task.files(first)[0]:
            entry["files"] = task.files(first)
    todo = [first for first in firsts if not _is_stored(index, task, record_type(sensor), first, check)]
    done = count - sum(len(task.numbers(first)) for first in todo)
    if done:
        yield done
    entries, written = in_order(task.store, todo, workers), time.monotonic()
    try:
        for first, entry in zip(todo, entries, strict=True):
            _refuse_none(index, entry)
            index["shards"][_shard(first)] = entry
            done += len(task.numbers(first))
            if time.monotonic() - written > INDEX_EVERY:
                write_index(folder, index)
                written = time.monotonic()
            yield done
    finally:
        entries.close()
        close_index(folder, index)


@dataclass(frozen=True)
class _Task:
    """What a worker has to know to make any shard."""

    folder: Path
    image: Callable[[int], RangeImage]
    name: Namer | None
    count: int
    step: float
    stamp: Stamp | None
    shape: tuple[int, int]

    def numbers(self, first: int) -> range:
        return range(first, min(first + SHARD, self.count))

    def frame(self, i: int) -> list[str]:
        """[sequence, frame] of image i."""
        return [*self.name(i)][-2:] if self.name else ["", str(i)]

    def files(self, first: int) -> list[str]:
        """Hashes that change when any file of a shard does, the second also where they are copies; [""] of no files."""
        if self.stamp is None:
            return [""]
        parts = zip(*(self.stamp(i) for i in self.numbers(first)), strict=True)
        return [hashlib.sha256("\n".join(part).encode()).hexdigest()[:16] for part in parts]

    def store(self, first: int) -> dict[str, Any]:
        """Make the shard whose first image is `first`, and say what its entry in the index is. Raises ValueError for an
        image of another shape than the sensor's: that is no broken scan, the others will have it too."""
        records, frames, skipped, files = [], [], [], self.files(first)
        for i in self.numbers(first):
            try:
                image = self.image(i)
                record = pack(image, self.step)
            except ValueError as error:
                skipped.append([*self.frame(i), str(error)])
                continue
            if image.shape != self.shape:
                raise ValueError(f"{self.folder}: expected images of {self.shape}, as the sensor has, found image {i} "
                                 f"of {image.shape}")  # fmt: skip
            records.append(record)
            frames.append(self.frame(i))
        entry: dict[str, Any] = {"count": len(records), "tried": len(self.numbers(first))}
        if records:
            entry["sha256"] = _store(self.folder / _shard(first), np.stack(records))
        if self.name:
            entry["frames"] = frames
        if self.stamp is not None:
            entry["files"] = files
        return entry | ({"skipped": skipped} if skipped else {})


def _shard(first: int) -> str:
    return f"{first:07d}.npy"


def _is_stored(index: dict[str, Any], task: _Task, kind: np.dtype, first: int, check: bool) -> bool:
    """Whether the shard is there, whole and of the same scans. Raises ValueError when it holds others."""
    entry, path = index["shards"].get(_shard(first)), task.folder / _shard(first)
    if entry is None or entry.get("tried", entry["count"]) < len(task.numbers(first)):
        return False
    if "frames" in entry and task.name:
        lost = [scan[:2] for scan in entry.get("skipped", [])]
        now = [frame for i in task.numbers(first) if (frame := task.frame(i)) not in lost]
        stored = entry["frames"][: len(now)]
        if now != stored:
            old, new = next((old, new) for old, new in zip_longest(stored, now) if old != new)
            raise ValueError(f"{task.folder}: expected the scan {shown(old)}, as in this cache, found {shown(new)} in "
                             "its place; name another folder")  # fmt: skip
    if "files" in entry and task.stamp is not None and task.files(first) != entry["files"]:
        return False
    if entry["count"] == 0:
        return True
    return _is_whole(path, kind, entry["count"]) and (not check or sha256(path) == entry["sha256"])


def _is_whole(path: Path, kind: np.dtype, count: int) -> bool:
    """Whether a shard of `count` images is there, by its size."""
    size = len(npy_header(kind, count)) + count * kind.itemsize
    return path.is_file() and path.stat().st_size == size


def lost_shards(folder: Path, index: dict[str, Any], sensor: Sensor) -> list[str]:
    """The names of the shards of a cache's index whose files are gone or not whole, by their sizes."""
    kind, shards = record_type(sensor), sorted(index["shards"].items())
    return [name for name, entry in shards if entry["count"] and not _is_whole(folder / name, kind, entry["count"])]


def _refuse_gone(index: dict[str, Any], task: _Task) -> None:
    """Raises ValueError where whole shards are of files that are gone: the last of the others may be made anew, fewer,
    so that the cache would have neither all scans nor those that are there."""
    later = range(-(-task.count // SHARD) * SHARD, index["count"], SHARD) if task.stamp is not None else ()
    entries = [entry for first in later if (entry := index["shards"].get(_shard(first)))]
    if frames := [frame for entry in entries for frame in entry.get("frames", [])]:
        raise ValueError(f"{task.folder}: expected the scan {shown(frames[0])}, as in this cache, found none in its "
                         "place; name another folder")  # fmt: skip


def shown(frame: Sequence[str] | None) -> str:
    """[sequence, frame] as one word of a message, without the sequence of files that lie in the folder itself."""
    return "none" if frame is None else "/".join(part for part in frame if part not in ("", "."))


def _refuse_none(index: dict[str, Any], entry: dict[str, Any]) -> None:
    """One scan in many is broken; where a whole shard is, the projection or the disk is wrong."""
    if entry["count"] == 0 and (entry["tried"] == SHARD or not any(e["count"] for e in index["shards"].values())):
        sequence, frame, reason = entry["skipped"][0]
        raise ValueError(f"expected a scan that can be projected among {entry['tried']}, found none; "
                         f"the first, {shown((sequence, frame))}: {reason}")  # fmt: skip


def begins_shard(start: bytes) -> bool:
    """Whether a file's first 256 bytes are those of a shard, of whichever sensor; by their look, as nobody knows whose
    file it is."""
    return bool(
        re.match(rb"\x93NUMPY\x01\0..{'descr': \[\('range', .*\('reflectance', .*\('label', ", start, re.DOTALL)
    )


def npy_header(dtype: np.dtype, count: int) -> bytes:
    """What stands before the records of a shard of `count` images."""
    header = BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": (count,)}
    )
    return header.getvalue()


def _store(path: Path, records: np.ndarray) -> str:
    """Write a shard, whole or not at all; returns its checksum."""
    header, body = npy_header(records.dtype, len(records)), records.view(np.uint8)
    with resumable_file(path, len(header) + body.nbytes) as scratch, open(scratch, "wb") as file:
        file.write(header)
        file.write(body.data)
    digest = hashlib.sha256(header)
    digest.update(body.data)
    return digest.hexdigest()


def sha256(path: Path) -> str:
    """The checksum of a file, read a piece at a time."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while piece := file.read(1 << 20):
            digest.update(piece)
    return digest.hexdigest()
