"""The index of a cache: what its images are, shard by shard; and files that appear whole or not at all."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lidarsynth.lidar.sensor import Sensor
from lidarsynth.lidar.small_file import LARGEST_INDEX, read_json
from lidarsynth.lidar.stored import RANGE_STEP
from lidarsynth.lidar.whole_file import sweep, whole_file

INDEX, REPORT = "index.json", "report.json"
SHARD_NAME = re.compile(r"\d{7}\.npy")
PLACE = ("root", "missing")  # of a source: where it lies on this disk, not what it is
MOVED = "moved"  # of an opened index: that the source lies elsewhere than when it was written


def read_index(folder: str | Path) -> dict[str, Any]:
    """The index of a cache. Raises ValueError when the folder is not one."""
    path = Path(folder) / INDEX
    try:
        index = read_json(path, LARGEST_INDEX)
    except OSError as error:
        lacks = isinstance(error, FileNotFoundError) and Path(folder).is_dir()
        found = "a folder without; `lidarsynth data` makes a cache of scans" if lacks else error.strerror
        raise ValueError(f"{folder}: expected a cache folder with {INDEX}, found {found}") from None
    _check(index, path)
    return index


KINDS = {"source": dict, "sensor": dict, "count": int, "shards": dict}


def _check(index: Any, path: Path) -> None:
    """Raises ValueError by name unless the index has the fields and types that `write_index` writes."""
    if not isinstance(index, dict) or not KINDS.keys() <= index.keys():
        raise ValueError(f"{path}: expected the fields source, sensor, count, shards, found another table")
    for key, kind in KINDS.items():
        if type(index[key]) is not kind:
            raise ValueError(f"{path}: expected {key} as {kind.__name__}, found {index[key]!r:.60}")
    step = index.get("step", RANGE_STEP)
    if type(step) is not float or not 0 < step < 1:
        raise ValueError(f"{path}: expected a step of 0 to 1 m, found {step!r:.60}")
    if not isinstance(index["source"].get("name", ""), str) or not isinstance(index["source"].get("missing", []), list):
        raise ValueError(f"{path}: expected a source with a name, found {index['source']!r:.60}")
    for name, shard in index["shards"].items():
        lists = [shard.get("frames", []), shard.get("skipped", [])] if isinstance(shard, dict) else [None]
        if not all(isinstance(part, list) for part in lists) or type(shard.get("count")) is not int:
            raise ValueError(f"{path}: expected the shard {name!r:.60} with count and frames, found {shard!r:.60}")
        rows = [(row, size) for part, size in zip(lists, (2, 3), strict=True) for row in part or ()]
        if wrong := [row for row, size in rows if not _words(row, size)]:
            raise ValueError(f"{path}: expected frames as [sequence, frame] in {name!r:.60}, found {wrong[0]!r:.60}")
        if shard["count"] < 0 or (shard.get("frames") and len(shard["frames"]) != shard["count"]):
            raise ValueError(f"{path}: expected as many frames as {name!r:.60} counts, found {shard['count']}")


def _words(row: Any, size: int) -> bool:
    return isinstance(row, list) and len(row) == size and all(isinstance(word, str) for word in row)


def stored_step(index: dict[str, Any]) -> float:
    """Metres per unit of the ranges of a cache; 2 mm where its index is older than this field."""
    return index.get("step", RANGE_STEP)


def open_index(folder: Path, sensor: Sensor, source: dict[str, Any], count: int, step: float) -> dict[str, Any]:
    """The index to go on with, or a new one, with ranges in `step` metres, in a folder that is made for it."""
    folder.mkdir(parents=True, exist_ok=True)
    head = {"source": source, "sensor": sensor.to_dict(), "count": count, "step": step, "shards": {}}
    head = json.loads(json.dumps(head))
    if not (folder / INDEX).exists():
        if others := sorted(path.name for path in folder.iterdir() if not _begun(path)):
            raise ValueError(f"{folder}: expected an empty folder for a cache, or one that was begun, found "
                             f"{others[0]!r:.80}; name another folder")  # fmt: skip
        return head
    index = read_index(folder)
    for key in ("source", "sensor"):
        expected, found = ({k: v for k, v in table[key].items() if k not in PLACE} for table in (head, index))
        if expected != found and any(entry["count"] for entry in index["shards"].values()):
            differ = sorted(k for k in expected.keys() | found.keys() if expected.get(k) != found.get(k))
            both = [", ".join(f"{k} {short(t.get(k))}" for k in differ) for t in (expected, found)]
            raise ValueError(f"{folder}: expected a cache of {key} {{{both[0]}}}, found one of {{{both[1]}}}; "
                             "name another folder")  # fmt: skip
        if expected != found:  # nothing of the other kind is stored: no scan could be read
            return head
    sweep(folder)
    moved = index["source"].get("root") != head["source"].get("root")
    return index | {"source": head["source"], "count": max(count, index["count"]), MOVED: moved}


def short(value: Any) -> str:
    """A setting in a message: the beginning and the end of a long one."""
    text = str(value)
    return text if len(text) <= 40 else f"{text[:30]} ... {text[-6:]}"


def _begun(path: Path) -> bool:
    """Whether a file is of a cache whose index is not written yet: a shard, its report, or what is hidden."""
    return path.name[0] == "." or path.name == REPORT or SHARD_NAME.fullmatch(path.name) is not None


def close_index(folder: Path, index: dict[str, Any]) -> None:
    """Write the index of what is stored, if anything is, and sweep away what workers that were ended left unfinished;
    a killed call's may have outlived the sweep of `open_index`."""
    sweep(folder)
    if index["shards"]:
        write_index(folder, index)


def write_index(folder: Path, index: dict[str, Any]) -> None:
    """The index, one shard a line, and the report beside it."""
    lines = [f" {json.dumps(name)}: {json.dumps(index['shards'][name])}" for name in sorted(index["shards"])]
    head = [f"{json.dumps(key)}: {json.dumps(value)}" for key, value in index.items() if key != "shards"]
    head.append('"shards": {\n' + ",\n".join(lines) + "\n}")
    texts = {INDEX: "{\n" + ",\n".join(head) + "\n}\n", REPORT: json.dumps(report(index), indent=1) + "\n"}
    for name, text in texts.items():
        with resumable_file(folder / name, len(text)) as scratch:
            scratch.write_text(text, encoding="utf-8")


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


def done(index: dict[str, Any]) -> int:
    """How many of the `count` scans of an index are stored, or were skipped: fewer, where it was killed."""
    return sum(entry["count"] + len(entry.get("skipped", [])) for entry in index["shards"].values())


@contextmanager
def resumable_file(path: Path, size: int) -> Iterator[Path]:
    """`whole_file` of `size` bytes; its OSError is one line that says how much room was wanted, and how to go on."""
    try:
        with whole_file(path) as scratch:
            yield scratch
    except OSError as error:
        raise OSError(f"{path.parent}: expected a writable folder with room for {size / 2**20:.1f} MiB more, found: "
                      f"{error.strerror}; the same command goes on") from None  # fmt: skip
