"""What lies beside a scan file: labels, boxes that `lidarsynth streets` wrote, which points are new and how sure."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from lidarsynth.data.folder import stem
from lidarsynth.files.fields import WITHOUT, FileError, dropped_points
from lidarsynth.files.formats import left_out, read_with_report
from lidarsynth.files.labels import read_labels
from lidarsynth.lidar.small_file import LARGEST_INDEX, read_json
from lidarsynth.verbs.viewpoint import viewpoint_note
from lidarsynth.viewer.packing import Shown

THREE = ("centre", "size")  # fields of a box with three numbers


def read_shown(path: Path, intensity: str = "auto", rings: tuple[int, int] | None = None) -> Shown:
    """A scan file with the labels, boxes, `new` and `confidence` beside it; what cannot be used becomes a note.

    Labels: NAME.label beside it or in ../labels, as SemanticKITTI has them. Boxes: NAME.json beside it or in a folder
    `boxes` up to three levels up, as `lidarsynth streets` writes them. Of a file of several sensors `rings` are the
    first and last to show. A scan whose intensity is missing, or none of ours, is shown without reflectance where
    `intensity` is "auto": the page needs none. Raises FileError for the scan itself.
    """
    try:
        return _shown(path, intensity, rings)
    except FileError as error:
        if not can_do_without(error, intensity):
            raise
        shown = _shown(path, "none", rings)
        return replace(shown, notes=(without_reflectance(error), *shown.notes))


def can_do_without(error: FileError, intensity: str) -> bool:
    """Whether nothing but its intensity keeps a scan from being read, and nobody has said what that is."""
    return intensity == "auto" and WITHOUT in str(error)


def without_reflectance(error: FileError) -> str:
    """The note of a scan that is shown without."""
    return f"reflectance left out: {error}".removesuffix(f"; {WITHOUT}")


def _shown(path: Path, intensity: str, rings: tuple[int, int] | None) -> Shown:
    labels = next((p for p in _label_places(path) if p.is_file()), None)
    notes: list[str] = []
    try:
        scan, dropped = read_with_report(path, intensity, labels, rings=rings)
    except FileError:
        if labels is None:
            raise
        scan, dropped = read_with_report(path, intensity)  # a broken scan raises again
        notes.append(_why(labels, len(scan) + dropped))
        scan, dropped = (scan, dropped) if rings is None else read_with_report(path, intensity, rings=rings)
    if dropped:
        notes.append(dropped_points(dropped))
    if (placed := viewpoint_note(path)) is not None:
        notes.append(placed)
    notes += left_out(path, scan, dropped)
    try:
        boxes = next((found for p in _box_places(path) if (found := _boxes(p)) is not None), [])
    except ValueError as error:
        return Shown(scan, [], (*notes, f"boxes left out: {error}"))
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
    """The boxes of a frame's JSON; None where there is no such file, or it holds something else.

    Raises ValueError for one that is no JSON, and for boxes that are none."""
    try:
        record = read_json(path, LARGEST_INDEX // 16) if path.is_file() else None
    except OSError as error:
        raise ValueError(f"{path}: expected a file that can be read, found: {error.strerror}") from None
    if not isinstance(record, dict) or "boxes" not in record:
        return None
    if not isinstance(found := record["boxes"], list):
        raise ValueError(f"{path}: expected a list of boxes, found {found!r:.60}")
    if wrong := [box for box in found if not _is_box(box)]:
        raise ValueError(f"{path}: expected boxes of a kind, a centre, a size and a yaw, found {wrong[0]!r:.60}")
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
