"""The index of a cache: what its images are, shard by shard; and files that appear whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lidarsynth.lidar.sensor import Sensor

INDEX, REPORT = "index.json", "report.json"
PLACE = ("root", "missing")  # of a source: where it lies on this disk, not what it is


def read_index(folder: str | Path) -> dict[str, Any]:
    """The index of a cache. Raises ValueError when the folder is not one."""
    path = Path(folder) / INDEX
    try:
        index = json.loads(path.read_text())
    except OSError as error:
        raise ValueError(f"{folder}: expected a cache folder with {INDEX}, found {error.strerror}") from None
    except ValueError as error:
        raise ValueError(f"{path}: expected JSON, found {error}") from None
    if not isinstance(index, dict) or not {"source", "sensor", "count", "shards"} <= index.keys():
        raise ValueError(f"{path}: expected the fields source, sensor, count, shards, found another table")
    return index


def open_index(folder: Path, sensor: Sensor, source: dict[str, Any], count: int) -> dict[str, Any]:
    """The index to go on with, or a new one in a folder that is made for it."""
    folder.mkdir(parents=True, exist_ok=True)
    head = json.loads(json.dumps({"source": source, "sensor": sensor.to_dict(), "count": count, "shards": {}}))
    if not (folder / INDEX).exists():
        return head
    index = read_index(folder)
    for key in ("source", "sensor"):
        expected, found = ({k: v for k, v in table[key].items() if k not in PLACE} for table in (head, index))
        if expected != found and any(entry["count"] for entry in index["shards"].values()):
            differ = sorted(k for k in expected.keys() | found.keys() if expected.get(k) != found.get(k))
            both = [{k: t.get(k) for k in differ} for t in (expected, found)]
            raise ValueError(f"{folder}: expected a cache of {key} {both[0]!s:.200}, found one of {both[1]!s:.200}; "
                             "name another folder")  # fmt: skip
        if expected != found:  # nothing of the other kind is stored: no scan could be read
            return head
    sweep(folder)
    return index | {"source": head["source"], "count": max(count, index["count"])}


def sweep(folder: Path) -> None:
    """Remove what killed calls left unfinished; nobody may be writing."""
    for stale in folder.glob(".*.part"):
        stale.unlink(missing_ok=True)


def close_index(folder: Path, index: dict[str, Any]) -> None:
    """Write the index when all shards are; a killed call's worker may have outlived the sweep of `open_index`."""
    sweep(folder)
    write_index(folder, index)


def write_index(folder: Path, index: dict[str, Any]) -> None:
    """The index, one shard a line, and the report beside it."""
    lines = [f" {json.dumps(name)}: {json.dumps(index['shards'][name])}" for name in sorted(index["shards"])]
    head = [f"{json.dumps(key)}: {json.dumps(value)}" for key, value in index.items() if key != "shards"]
    head.append('"shards": {\n' + ",\n".join(lines) + "\n}")
    _write_text(folder / INDEX, "{\n" + ",\n".join(head) + "\n}\n")
    _write_text(folder / REPORT, json.dumps(report(index), indent=1) + "\n")


def _write_text(path: Path, text: str) -> None:
    with whole(path, len(text)) as scratch:
        scratch.write_text(text)


def report(index: dict[str, Any]) -> dict[str, Any]:
    """What an index tells: images stored, how many of each sequence, sequences missing, why which scan was skipped."""
    shards, sequences = list(index["shards"].values()), {}
    for sequence, _ in (frame for entry in shards for frame in entry.get("frames", [])):
        sequences[sequence] = sequences.get(sequence, 0) + 1
    skipped = [dict(zip(("sequence", "frame", "reason"), s, strict=True)) for e in shards for s in e.get("skipped", [])]
    return {
        "stored": sum(entry["count"] for entry in shards),
        "sequences": sequences,
        "missing": index["source"].get("missing", []),
        "skipped": skipped,
    }


@contextmanager
def whole(path: Path, size: int) -> Iterator[Path]:
    """A place to write `path` to, moved there afterwards. Raises OSError of one line that says how much was wanted."""
    scratch = path.with_name(f".{path.stem}.{os.getpid()}.part")
    try:
        yield scratch
        os.replace(scratch, path)
    except OSError as error:
        raise OSError(f"{path.parent}: expected a writable folder with room for {size / 2**20:.1f} MiB more, found: "
                      f"{error.strerror}; the same command goes on") from None  # fmt: skip
    finally:
        scratch.unlink(missing_ok=True)
