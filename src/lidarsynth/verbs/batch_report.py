"""The report of many scans: what was done, skipped and failed, how fast; reports of shards become one."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarsynth.lidar.plural import plural
from lidarsynth.lidar.small_file import LARGEST_INDEX, read_json
from lidarsynth.lidar.whole_file import write_whole
from lidarsynth.verbs.batch import MEANT, Result
from lidarsynth.verbs.earlier_results import journal_path, made_rows, read_report
from lidarsynth.verbs.expansion import is_stream

if TYPE_CHECKING:  # `project` needs no torch
    from lidarsynth.metrics.reconstruction import Errors

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


def check_report(out: Path, shard: Shard) -> None:
    """Raises ValueError where a report of a run, or of all its shards, would replace a file that is none."""
    for path in (report_path(out, shard), out / REPORT):
        if path.exists() and path.stat().st_size and read_report(path) is None:
            raise ValueError(f"{path}: expected a place for the report of this run, found a file that is no such "
                             "report; move it, or name another --out")  # fmt: skip


def check_same(out: Path, recipe: Mapping[str, Any]) -> None:
    """Raises ValueError where a report in the folder tells of results of another recipe: they are not to go on with."""
    for path in sorted(out.glob("report*.json")):
        if (report := read_report(path)) is None:
            continue  # something else of the user's
        other = ", ".join(f"{name} {now} for {was}" for name, (now, was) in _unlike(report, recipe).items())
        other = other or ("scans of two settings" if "mixed" in report else "")
        if other:
            raise ValueError(f"{path}: expected scans made as they are asked for now, found other settings: {other}; "
                             "another --out, or without --skip-existing all are made anew")  # fmt: skip


def same(path: Path, recipe: Mapping[str, Any], told: bool = True) -> bool:
    """Whether there is a report of scans of this recipe, and of no other.

    told  whether it has to say of each word what it meant; those of before 2026-11-26 do not
    """
    report = read_report(path) if path.is_file() else None
    if report is None or "recipe" not in report["settings"] or "mixed" in report or _unlike(report, recipe):
        return False
    return not told or all((name in recipe) == (name in report["settings"]["recipe"]) for name in MEANT.values())


def is_mixed(path: Path) -> bool:
    """Whether a report is of scans of several recipes."""
    return "mixed" in (read_report(path) or {})


def shard_reports(out: Path) -> list[Path]:
    """Reports of the shards of a folder."""
    return [path for path in sorted(out.glob("report-*-of-*.json")) if read_report(path) is not None]


def shards_at_work(out: Path) -> list[Path]:
    """Reports of those shards of a folder that are not done: at work, or killed."""
    return [path for path in shard_reports(out) if "unfinished" in (read_report(path) or {})]


def check_no_other_whole(out: Path, recipe: Mapping[str, Any]) -> None:
    """Raises ValueError where a folder has the scans of a whole run of another recipe, among which a shard would put
    its own. Those of other shards are told when they are merged."""
    path = out / REPORT
    report = read_report(path) if path.is_file() else None
    if report is not None and "shards" not in report["settings"] and not same(path, recipe, told=False):
        unlike = ", ".join(f"{name} {now} for {was}" for name, (now, was) in _unlike(report, recipe).items())
        raise ValueError(f"{path}: expected no scans beside those of shards, or such as are asked for now, found those "
                         f"of a whole run of other settings: {unlike or 'several'}; name another --out")  # fmt: skip


def _unlike(report: Mapping[str, Any], recipe: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """What differs from a report's recipe, now and as it was; what a word meant decides, where both tell that. Until
    2026-11-26 they had verb and model alone, then words alone."""
    found = report["settings"].get("recipe", {name: report["settings"][name] for name in ("verb", "model")})
    names = recipe.keys() | found.keys() if "recipe" in report["settings"] else recipe.keys() & found.keys()
    for word, meant in MEANT.items():
        told = meant in recipe and meant in found
        names = names - {word if told and recipe[meant] == found[meant] else meant if not told else ""}
    pairs = {name: (recipe.get(name), found.get(name)) for name in sorted(names)}
    return {name: (_word(now), _word(was)) for name, (now, was) in pairs.items() if now != was}


def _word(value: Any) -> str:
    return "none" if value is None else str(value)[:60]


def rows_before(out: Path, shard: Shard, ending: str) -> dict[Path, dict[str, Any]]:
    """What reports in a folder, and journals of runs that were killed, say of the scans that were made, by the files
    out/NAME.ending, however the folder was called then; a shard's own counts most."""
    rows = {}
    for path in (*(shard_reports(out) if shard[1] == 1 else ()), out / REPORT, report_path(out, shard)):
        report = read_report(path) if path.is_file() else None
        if report is None or report["settings"].get("format", ending) != ending:
            continue
        for row in made_rows(path, report):
            file = out / f"{row['name']}.{ending}"
            rows[file] = row | {"target": str(file)}
    return rows


def other_names(
    out: Path, ending: str, before: Mapping[Path, Mapping[str, Any]], places: Mapping[Path, str]
) -> str | None:
    """What is to be said of the scans of `rows_before` that get other names now, as names of new ones repeat theirs, or
    no longer do: their results are not found, but made anew. None where there are none.

    places  of the scans, as of `Inputs`
    """
    now = {path.absolute(): place for path, place in places.items()}
    found = []
    for file, row in before.items():
        place = now.get(source := Path(row["source"]).absolute())
        name = f"{place}/{Path(row['name']).name}" if is_stream(source) else place
        if place is not None and name != row["name"] and file.exists():
            found += [(file.relative_to(out), made)] if not (out / (made := f"{name}.{ending}")).exists() else []
    if not found:
        return None
    (old, new), count = found[0], plural(len(found), "scan")
    return (f"{out}: expected results of earlier runs under the names that scans get now, found {count} under others, "
            f"such as {old} for {new}: made anew, and the old files stay")  # fmt: skip


def begin_journal(report: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """A journal of the rows that are known, in place of any that lies there."""
    write_whole(journal_path(report), "".join(f"{json.dumps(row)}\n" for row in rows))


def add_to_journal(report: Path, result: Result) -> None:
    """The row of a scan that was made, which a kill leaves."""
    with journal_path(report).open("a", encoding="utf-8") as file:
        file.write(f"{json.dumps(_row(result))}\n")


def result_of(row: Mapping[str, Any]) -> Result:
    """A scan that a run before has made: whose it is, and its errors."""
    errors = {name: _errors(table) for name, table in row.get("errors", {}).items()}
    return Result(row["name"], Path(row["source"]), Path(row["target"]), row["seconds"], errors=errors)


def report_of(
    results: Sequence[Result],
    skipped: int,
    seconds: float,
    settings: Mapping[str, Any],
    before: Sequence[dict[str, Any]] = (),
) -> dict[str, Any]:
    """Plain values: settings, totals and rate of this run, mean errors where a corruption was asked for, and a row per
    scan; rows of those that a run before has made go `before`."""
    failed = [result for result in results if result.error is not None]
    done, rows = len(results) - len(failed), [*before, *(_row(result) for result in results)]
    return {
        "settings": dict(settings),
        "done": done,
        "skipped": skipped,
        "failed": len(failed),
        "seconds": round(seconds, 3),
        "scans_per_second": round(done / seconds, 3) if seconds > 0 else None,
        **_means(rows),
        "scans": rows,
    }


def unfinished(settings: Mapping[str, Any], mixed: bool = False) -> dict[str, Any]:
    """The report of a run that goes on, or was killed: how the scans that are there were made.

    mixed  some of them may be of another recipe, which the run replaces
    """
    return {"unfinished": True} | ({"mixed": True} if mixed else {}) | report_of([], 0, 0.0, settings)


def _means(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The mean over scans of each method's errors, or nothing."""
    tables = [row["errors"] for row in rows if "errors" in row]
    if not tables:
        return {}
    from lidarsynth.metrics.reconstruction import mean_errors

    methods = [name for name in tables[0] if all(name in table for table in tables)]
    means = {name: mean_errors([_errors(table[name]) for table in tables]) for name in methods}
    return {"errors": {name: _plain(mean) for name, mean in means.items()}} if means else {}


def _plain(errors: Errors) -> dict[str, float | None]:
    """JSON has no NaN."""
    return {name: None if math.isnan(value) else value for name, value in asdict(errors).items()}


def _errors(row: Mapping[str, Any]) -> Errors:
    from lidarsynth.metrics.reconstruction import Errors

    values: dict[str, Any] = {name: math.nan if value is None else value for name, value in row.items()}
    return Errors(**values)


def _row(result: Result) -> dict[str, Any]:
    row: dict[str, Any] = {"name": result.name, "source": str(result.source), "seconds": round(result.seconds, 4)}
    row |= {"target": str(result.target)} if result.target else {}
    if result.error is not None:
        return row | {"error": result.error}
    row |= {"points": result.points[0], "points_after": result.points[1], "dropped": result.dropped}
    row |= {"errors": {name: _plain(errors) for name, errors in result.errors.items()}} if result.errors else {}
    return row | ({"warning": result.warning} if result.warning else {})


def write_report(path: Path, report: Mapping[str, Any]) -> None:
    """The report as JSON, whole or not at all; once the run is done its journal goes."""
    write_whole(path, json.dumps(report, indent=1) + "\n")
    if "unfinished" not in report:
        journal_path(path).unlink(missing_ok=True)


def remove_report(path: Path) -> None:
    """Takes away a report that another one stands for, with its journal."""
    path.unlink(missing_ok=True)
    journal_path(path).unlink(missing_ok=True)


def merge_shards(out: Path, parts: int) -> Path | None:
    """One report of all shards in a folder, written once the last of them is there; None before."""
    paths = [report_path(out, (part, parts)) for part in range(1, parts + 1)]
    if parts == 1 or not all(path.is_file() for path in paths):
        return None
    reports = [read_json(path, LARGEST_INDEX) for path in paths]
    if any("unfinished" in report for report in reports):
        return None
    total: dict[str, Any] = {key: sum(r[key] for r in reports) for key in ("done", "skipped", "failed")}
    longest = max(r["seconds"] for r in reports)
    merged = {"settings": reports[0]["settings"] | {"shards": parts}, **total, "seconds": longest}
    recipe = reports[0]["settings"].get("recipe", {})
    merged |= {"mixed": True} if any("mixed" in r or _unlike(r, recipe) for r in reports) else {}
    merged |= {"scans_per_second": round(total["done"] / longest, 3) if longest else None}
    rows = sorted((row for r in reports for row in r["scans"]), key=lambda row: row["name"])
    merged |= {**_means(rows), "scans": rows}
    write_report(out / REPORT, merged)
    return out / REPORT
