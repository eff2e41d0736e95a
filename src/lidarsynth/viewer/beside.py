"""What lies beside a scan file: labels, boxes that `lidarsynth streets` wrote, which points are new and how sure."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarsynth.files.fields import FileError
from lidarsynth.files.formats import BARE, BESIDE, read_with_report
from lidarsynth.files.labels import read_labels
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.small_file import LARGEST_INDEX, read_json
from lidarsynth.verbs.inputs import stem
from lidarsynth.viewer.packing import Shown

THREE = ("centre", "size")  # fields of a box with three numbers


def read_shown(path: Path, intensity: str = "auto") -> Shown:
    """A scan file with the labels, boxes, `new` and `confidence` beside it; what cannot be used becomes a note.

    Labels: NAME.label beside it or in ../labels, as SemanticKITTI has them. Boxes: NAME.json beside it or in a folder
    `boxes` up to three levels up, as `lidarsynth streets` writes them. Raises FileError for the scan itself.
    """
    labels = next((p for p in _label_places(path) if p.is_file()), None)
    notes = []
    try:
        scan, dropped = read_with_report(path, intensity, labels)
    except FileError:
        if labels is None:
            raise
        scan, dropped = read_with_report(path, intensity)  # a broken scan raises again
        notes.append(_why(labels, len(scan) + dropped))
    if dropped:
        notes.append(f"{dropped} points without a return or not finite were dropped")
    for name in BESIDE if path.name.lower().endswith(BARE) else ():
        if (marks := path.with_suffix(f".{name}")).is_file() and name not in scan.extra:
            scan, note = _with_marks(scan, name, marks, dropped)
            notes += note
    boxes = next((found for p in _box_places(path) if (found := _boxes(p)) is not None), [])
    return Shown(scan, boxes, tuple(notes))


def _why(labels: Path, count: int) -> str:
    try:
        read_labels(labels, count)
    except FileError as error:
        return f"labels left out: {error}"
    return f"labels left out: {labels} does not fit the scan"


def _label_places(path: Path) -> list[Path]:
    return [path.with_suffix(".label"), path.parent.parent / "labels" / f"{stem(path)}.label"]


def _box_places(path: Path) -> list[Path]:
    name = stem(path)
    number = name.rpartition("__")[2]  # nuScenes' names end in __NUMBER
    folders = [path.absolute().parent, *path.absolute().parents[1:3]]
    return [folders[0] / f"{name}.json", *(folder / "boxes" / f"{number}.json" for folder in folders)]


def _boxes(path: Path) -> list[dict[str, Any]] | None:
    """The boxes of a frame's JSON; None where there is no such file, or it is of another kind."""
    try:
        record = read_json(path, LARGEST_INDEX // 16) if path.is_file() else None
    except (ValueError, OSError):
        return None
    found = record.get("boxes") if isinstance(record, dict) else None
    if not isinstance(found, list) or not all(_is_box(box) for box in found):
        return None
    keys = ("kind", *THREE, "yaw", "velocity", "points", "instance")
    return [{key: box[key] for key in keys if key in box} for box in found]


def _is_box(box: Any) -> bool:
    return (
        isinstance(box, dict)
        and isinstance(box.get("kind"), str)
        and all(_are_numbers(box.get(key), 3) for key in THREE)
        and _are_numbers([box.get("yaw")], 1)
        and _are_numbers(box.get("velocity", [0, 0, 0]), 3)
        and _are_numbers([box.get("points", 0), box.get("instance", 0)], 2)
    )


def _are_numbers(values: Any, count: int) -> bool:
    plain = isinstance(values, list) and len(values) == count and all(type(v) in (int, float) for v in values)
    return plain and all(math.isfinite(v) for v in values)


def _with_marks(scan: Scan, name: str, path: Path, dropped: int) -> tuple[Scan, list[str]]:
    """The scan with a field that has a file of its own, such as .new with a byte a point."""
    kind, count = BESIDE[name], len(scan) + dropped
    if dropped or path.stat().st_size != count * kind.itemsize:
        return scan, [f"{path.name} left out: expected {count * kind.itemsize} bytes for {count} points, none of them "
                      f"dropped, found {path.stat().st_size} bytes and {dropped} dropped"]  # fmt: skip
    return replace(scan, extra={**scan.extra, name: np.fromfile(path, kind)}), []
