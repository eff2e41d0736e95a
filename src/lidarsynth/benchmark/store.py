"""Scans that a method has made, each kept as soon as it is there, with the seconds it took: what makes a run resumable.

A finished scan is NNNNNN.npz, the image, and NNNNNN.json, which is written last. Both appear whole or not at all.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

from lidarsynth.files.formats import read_image, write
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.small_file import LARGEST_INDEX, read_json
from lidarsynth.lidar.whole_file import sweep, write_whole


class Seconds(NamedTuple):
    """What a scan took: by the clock, and of the processor, all cores together, where a crowded machine shows less."""

    wall: float
    processor: float


@dataclass(frozen=True)
class Store:
    """The folder of one method under one group of settings."""

    folder: Path

    def lacks(self, stamps: Mapping[int, str]) -> list[int]:
        """Numbers of the scans that are not there, or were made of another input than the stamp says."""
        return [i for i, stamp in stamps.items() if self._record(i).get("input") != stamp]

    def put(self, i: int, image: RangeImage, seconds: Seconds, stamp: str) -> None:
        """Keep scan i. Raises FileError, OSError where the disk is full."""
        (self.folder / f"{i:06d}.json").unlink(missing_ok=True)
        write(self.folder / f"{i:06d}.npz", image)
        write_whole(self.folder / f"{i:06d}.json", json.dumps({"seconds": seconds._asdict(), "input": stamp}) + "\n")

    def image(self, i: int) -> RangeImage:
        """Scan i. Raises FileError."""
        return read_image(self.folder / f"{i:06d}.npz")

    def count(self) -> int:
        """How many images lie here, of any run."""
        return sum(1 for _ in self.folder.glob("[0-9]*.npz"))

    def seconds(self, count: int) -> list[Seconds]:
        """What each of the first `count` scans took, whenever it was made."""
        return [Seconds(**self._record(i)["seconds"]) for i in range(count)]

    def report(
        self,
        key: Sequence[Any],
        judge: Callable[[], dict[str, Any]],
        final: Callable[[dict[str, Any]], bool] = lambda report: True,
    ) -> dict[str, Any]:
        """What `judge` says, kept where `final` under `key`, which must tell all that the result depends on."""
        digest = sha256(json.dumps(list(key), sort_keys=True).encode()).hexdigest()[:16]
        path = self.folder / f"report-{digest}.json"
        if found := _read_table(path):
            return found
        report = judge()
        if final(report):
            write_whole(path, json.dumps(report, allow_nan=False) + "\n")
        return report

    def _record(self, i: int) -> dict[str, Any]:
        record = _read_table(self.folder / f"{i:06d}.json")
        seconds = record.get("seconds")
        if not isinstance(seconds, dict) or seconds.keys() != set(Seconds._fields):
            return {}
        told = all(isinstance(value, int | float) for value in seconds.values())
        whole = zipfile.is_zipfile(self.folder / f"{i:06d}.npz")  # a loss of power may leave a part, or none
        return record if told and whole else {}


def open_store(folder: Path, name: str, settings: dict[str, Any]) -> Store:
    """The store of a row of the table below `folder`; other settings have another one."""
    digest = sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]
    slug = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")[:40] or "method"
    store = Store(folder / f"{slug}-{digest}")
    store.folder.mkdir(parents=True, exist_ok=True)
    sweep(store.folder)
    write_whole(store.folder / "settings.json", json.dumps(settings, indent=1) + "\n")
    return store


def _read_table(path: Path) -> dict[str, Any]:
    """A JSON table, or {} where there is none."""
    try:
        found = read_json(path, LARGEST_INDEX)
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
