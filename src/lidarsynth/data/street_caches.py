"""Caches of synthetic streets that do not tell their edition: whether they hold what today's streets give."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lidarsynth.data.cache import pack, record_type
from lidarsynth.data.index import INDEX, read_index, stored_step
from lidarsynth.streets.edition import EDITION

if TYPE_CHECKING:
    from lidarsynth.streets.reader import SyntheticStreets

LEAST = 0.999  # of an image's pixels that are the same, within a step, from machine to machine


def begins_alike(folder: Path, source: dict[str, Any], streets: SyntheticStreets) -> bool:
    """Whether a cache of this source is there, which tells no edition, and begins as the streets do.

    source  of the streets, without an edition
    Raises ValueError where such a cache begins otherwise: it was made by older streets, or newer ones.
    """
    if not (folder / INDEX).is_file():
        return False
    index = read_index(folder)
    if index["source"] != source or index["sensor"] != json.loads(json.dumps(streets.sensor.to_dict())):
        return False
    for name, entry in sorted(index["shards"].items()):
        stored = _first(folder / name, entry, record_type(streets.sensor))
        if stored is None or int(name[:7]) >= len(streets):
            continue
        if _same(stored, pack(streets.image(int(name[:7])), stored_step(index))) < LEAST:
            raise ValueError(f"{folder}: expected a cache of streets of edition {EDITION}, found one of other streets: "
                             "it can be used, and not be added to; name another folder")  # fmt: skip
        break
    return True


def _first(path: Path, entry: dict[str, Any], kind: np.dtype) -> np.ndarray | None:
    """The first record of a shard; None of one that is broken, and is made anew, or whose first scan was skipped."""
    if not re.fullmatch(r"\d{7}\.npy", path.name) or not entry["count"] or entry.get("skipped"):
        return None
    try:
        records = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None
    return np.asarray(records[0]) if records.dtype == kind and records.ndim == 1 else None


def _same(stored: np.ndarray, made: np.ndarray) -> float:
    """The share of pixels of two records that are the same, within a step of range and of reflectance."""
    apart = [np.abs(stored[name].astype(int) - made[name]) > 1 for name in ("range", "reflectance")]
    empty = (stored["range"] == 0) != (made["range"] == 0)
    return 1 - float((apart[0] | apart[1] | empty | (stored["label"] != made["label"])).mean())
