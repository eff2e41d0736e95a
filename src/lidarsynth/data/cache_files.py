"""Which files are a cache's own: they are no scans, wherever a folder of scans holds a cache."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from lidarsynth.data.cache import begins_shard
from lidarsynth.data.index import INDEX, REPORT, SHARD_NAME, read_index


def is_cache(folder: Path) -> bool:
    """Whether a folder is a cache, also one that was begun and has no index yet, or whose index is damaged. Raises
    OSError for a folder that cannot be read."""
    return bool(cache_files(folder, os.listdir(folder)))


def cache_files(folder: Path, names: Sequence[str]) -> frozenset[str]:
    """Of the names in a folder those of a cache: shards, index and report; none where neither its first shard nor its
    index is a cache's."""
    shards = [name for name in names if SHARD_NAME.fullmatch(name)]
    if (shards and _is_shard(folder / min(shards))) or (INDEX in names and _is_index(folder)):
        return frozenset(shards).union({INDEX, REPORT}.intersection(names))
    return frozenset()


def _is_shard(path: Path) -> bool:
    try:
        if not path.is_file():  # a pipe would be waited for
            return False
        with open(path, "rb") as file:
            return begins_shard(file.read(256))
    except OSError:
        return False


def _is_index(folder: Path) -> bool:
    try:
        read_index(folder)
    except ValueError:
        return False
    return True
