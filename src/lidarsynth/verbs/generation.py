"""What the verb `generate` does: scans streamed into a folder, which goes on where it was stopped.

A finished scan is a file NNNNNN.ply and its picture NNNNNN.png. Each appears whole, the
scan last, so that a kill at any moment leaves whole files only. `generate.json` says what the scans were made with.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lidarsynth.files.formats import WRITERS, write, write_labels
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.small_file import read_json
from lidarsynth.lidar.whole_file import sweep, write_whole
from lidarsynth.pictures.portrait import portrait
from lidarsynth.pictures.render import save_png
from lidarsynth.systems.scan_model import OnStep, ScanModel

RECORD = "generate.json"
LABEL = ".label"  # ending of a file with SemanticKITTI's id of each point


def endings_of(format: str, labels: bool, picture: bool) -> tuple[str, ...]:
    """Of a finished scan's files, such as (".ply", ".png"). Raises ValueError for a format that is not written."""
    if f".{format}" not in WRITERS:
        words = ", ".join(ending.removeprefix(".") for ending in WRITERS)
        raise ValueError(f"expected a format of {words}, found {format!r}")
    return (f".{format}", *([LABEL] if labels else []), *([".png"] if picture else []))


def claim(folder: Path, settings: dict[str, Any]) -> None:
    """Begin a folder of generated scans, or go on with one that was begun with the same settings.

    Raises ValueError, and leaves the folder as it is, where its scans were made otherwise or by someone else.
    """
    record = folder / RECORD
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder to write to, found a file")
    if record.exists():
        found = _recorded(record)
        if other := [key for key in settings.keys() | found.keys() if settings.get(key) != found.get(key)]:
            asked, was = ({key: of.get(key) for key in sorted(other)} for of in (settings, found))
            raise ValueError(f"{folder}: expected a folder of scans made with {asked}, found {was}; use another --out")
        return
    if taken := sorted(folder.glob("[0-9]" * 6 + ".*")):
        raise ValueError(f"{folder}: expected a folder without scans, or with {RECORD}, found {taken[0].name}; "
                         f"use another --out")  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(record, json.dumps(settings, indent=1) + "\n")


def _recorded(record: Path) -> dict[str, Any]:
    found = read_json(record)
    if not isinstance(found, dict):
        raise ValueError(f"{record}: expected the settings of generated scans, found {found!r:.60}")
    return found


def missing(folder: Path, count: int, endings: tuple[str, ...]) -> list[range]:
    """The scans of 0 .. count - 1 that lack a file, as runs of numbers in a row.

    endings  of a finished scan's files, such as (".ply", ".png")
    """
    there = {path.name for path in folder.iterdir()}
    runs: list[range] = []
    for i in range(count):
        if all(f"{i:06d}{ending}" in there for ending in endings):
            continue
        if runs and runs[-1].stop == i:
            runs[-1] = range(runs[-1].start, i + 1)
        else:
            runs.append(range(i, i + 1))
    return runs


def generate_into(
    folder: Path,
    model: ScanModel,
    runs: list[range],  # of `missing`
    batch_size: int,
    endings: tuple[str, ...],
    steps: int | None = None,
    sampler: str | None = None,
    seed: int = 0,
    on_step: OnStep = None,
) -> Iterator[Path]:
    """Make the scans of `runs`, a batch in memory at a time, and yield each file when it and its picture are there."""
    sweep(folder)
    for run in runs:
        images = model.stream(run.stop, steps, seed, sampler, batch_size, run.start, on_step)
        for i, image in zip(run, images, strict=True):
            yield _store(folder, f"{i:06d}", image, endings)


def _store(folder: Path, name: str, image: RangeImage, endings: tuple[str, ...]) -> Path:
    """Write the files of one scan, the scan last."""
    for ending in reversed(endings):
        if ending == ".png":
            save_png(folder / f"{name}.png", portrait(image))
        elif ending == LABEL:
            write_labels(folder / f"{name}{LABEL}", image.to_scan())
        else:
            write(folder / f"{name}{ending}", image)
    return folder / f"{name}{endings[0]}"
