"""What a `.json` file is: a sensor, metadata of one, or what a verb of ours wrote."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from lidarsynth.data import ouster
from lidarsynth.files.fields import FileError
from lidarsynth.lidar.plural import plural
from lidarsynth.lidar.small_file import LARGEST_INDEX, read_json

Lines = dict[str, str]


def json_lines(path: Path) -> Lines | None:
    """What a `.json` file is, as lines by title, or None for a sensor. Raises FileError for others."""
    if ouster.is_metadata(path):
        found = ouster.read_metadata(path)
        beams = f"{len(found.altitudes)} from {max(found.altitudes):+.2f} to {min(found.altitudes):+.2f} degrees"
        return {"kind": "metadata of an Ouster sensor", "beams": beams, "columns": str(found.columns),
                "packets": found.profile}  # fmt: skip
    try:
        values: Any = read_json(path, LARGEST_INDEX)
    except OSError as error:
        raise FileError(f"{path}: expected JSON, found: {error.strerror}") from None
    keys = set(values) if isinstance(values, Mapping) else set()
    for needed, told in OURS.items():
        if set(needed) <= keys:
            with suppress(LookupError, TypeError, AttributeError, ValueError):  # somebody else's of the same words
                return told(values)
    if keys and all(isinstance(one, Mapping) and isinstance(one.get("frames"), Mapping) for one in values.values()):
        return _tracks(values)
    if keys & {"elevations", "beams"}:
        return None
    listed = ", ".join(list(values)[:6]) if keys else type(values).__name__
    raise FileError(f"{path}: expected a sensor, Ouster metadata or a report in JSON, found {listed}")


def _many(values: Mapping[str, Any]) -> Lines:
    lines = {"kind": "report of many scans"} | {k: str(values[k]) for k in ("done", "skipped", "failed", "seconds")}
    if (rate := values.get("scans_per_second")) is not None:
        lines["rate"] = f"{rate} scans a second"
    if values.get("unfinished"):
        lines["kind"] += ", which is not done: stopped, or still running"
    if values.get("mixed"):
        lines["kind"] += ", made with several settings"
    wrong = [row for row in values["scans"] if "error" in row]
    return lines | ({"first failure": str(wrong[0]["error"])[:200]} if wrong else {})


def _evaluation(values: Mapping[str, Any]) -> Lines:
    rows = {name: row for name, row in values["values"].items() if isinstance(row, Mapping)}
    first = [f"{name} {row['value']:.4g} {row.get('unit', '')}".strip() for name, row in rows.items()
             if isinstance(row.get("value"), float)]  # fmt: skip
    return {"kind": f"report of lidarsynth evaluate under {values['protocol']}, version {values['version']}",
            "values": f"{len(rows)}: {', '.join(first[:3])}, ...; the .md beside it is to be read"}  # fmt: skip


def _streets(values: Mapping[str, Any]) -> Lines:
    name = values["sensor"].get("name") if isinstance(values["sensor"], Mapping) else values["sensor"]
    return {"kind": f"settings of lidarsynth streets: {name}, layout {values['layout']}, seed {values['seed']}"}


def _boxes(values: Mapping[str, Any]) -> Lines:
    return {"kind": f"boxes of one labelled street scan: {len(values['boxes'])}, of {values['points']} points"}


def _boxes_alone(values: Mapping[str, Any]) -> Lines:
    return {"kind": f"boxes of one scan: {len(values['boxes'])}, of {values['points']} points"}


def _tracks(values: Mapping[str, Any]) -> Lines:
    frames = {frame for one in values.values() for frame in one["frames"]}
    return {
        "kind": f"tracks of one labelled drive: {plural(len(values), 'road user')} in {plural(len(frames), 'frame')}"
    }


def _generated(values: Mapping[str, Any]) -> Lines:
    return {"kind": "settings of lidarsynth generate, with which it goes on: "
                    f"{plural(values['steps'], 'step')}, seed {values['seed']}, {values['format']}"}  # fmt: skip


OURS = {
    ("settings", "done", "scans"): _many,
    ("protocol", "version", "values"): _evaluation,
    ("layout", "seed", "sensor"): _streets,
    ("world", "frame", "boxes", "points"): _boxes,
    ("boxes", "points"): _boxes_alone,
    ("weights", "format", "steps", "seed"): _generated,
}
