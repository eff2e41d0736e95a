"""The report of many scans: what was done, skipped and failed, how fast; reports of shards become one."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lidarsynth.lidar.small_file import LARGEST_INDEX, read_json
from lidarsynth.lidar.whole_file import write_whole
from lidarsynth.verbs.batch import Result

REPORT = "report.json"
Shard = tuple[int, int]  # this part, counted from 1, and all parts


def parse_shard(text: str | None) -> Shard:
    """(3, 64) from 3/64; None is the whole. Raises ValueError."""
    if text is None:
        return 1, 1
    part, slash, parts = text.partition("/")
    if not (slash and part.isdecimal() and parts.isdecimal() and 1 <= int(part) <= int(parts)):
        raise ValueError(f"expected --shard I/N with I from 1 to N, such as 3/64, found {text!r}")
    return int(part), int(parts)


def report_path(out: Path, shard: Shard) -> Path:
    """Where a folder's report lies, or that of a shard of it."""
    return out / (REPORT if shard[1] == 1 else f"report-{shard[0]}-of-{shard[1]}.json")


def report_of(results: Sequence[Result], skipped: int, seconds: float, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Plain values: settings, totals, rate, and a row per scan."""
    failed = [result for result in results if result.error is not None]
    done = len(results) - len(failed)
    return {
        "settings": dict(settings),
        "done": done,
        "skipped": skipped,
        "failed": len(failed),
        "seconds": round(seconds, 3),
        "scans_per_second": round(done / seconds, 3) if seconds > 0 else None,
        "scans": [_row(result) for result in results],
    }


def _row(result: Result) -> dict[str, Any]:
    row: dict[str, Any] = {"name": result.name, "source": str(result.source), "seconds": round(result.seconds, 4)}
    row |= {"target": str(result.target)} if result.target else {}
    if result.error is not None:
        return row | {"error": result.error}
    row |= {"points": result.points[0], "points_after": result.points[1], "dropped": result.dropped}
    return row | ({"warning": result.warning} if result.warning else {})


def write_report(path: Path, report: Mapping[str, Any]) -> None:
    """The report as JSON, whole or not at all."""
    write_whole(path, json.dumps(report, indent=1) + "\n")


def merge_shards(out: Path, parts: int) -> Path | None:
    """One report of all shards in a folder, written once the last of them is there; None before."""
    paths = [report_path(out, (part, parts)) for part in range(1, parts + 1)]
    if parts == 1 or not all(path.is_file() for path in paths):
        return None
    reports = [read_json(path, LARGEST_INDEX) for path in paths]
    total: dict[str, Any] = {key: sum(r[key] for r in reports) for key in ("done", "skipped", "failed")}
    longest = max(r["seconds"] for r in reports)
    merged = {"settings": reports[0]["settings"] | {"shards": parts}, **total, "seconds": longest}
    merged |= {"scans_per_second": round(total["done"] / longest, 3) if longest else None}
    merged |= {"scans": sorted((row for r in reports for row in r["scans"]), key=lambda row: row["name"])}
    write_report(out / REPORT, merged)
    return out / REPORT
