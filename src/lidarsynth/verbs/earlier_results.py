"""Results of earlier runs that lie where a run is to write: they are no scans to read."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidarsynth.data.folder import stem
from lidarsynth.lidar.small_file import LARGEST_INDEX, read_json

NEEDED = {"name", "source", "seconds"}  # of the row of a scan


def read_report(path: Path) -> dict[str, Any] | None:
    """A report of many scans, or None for anything else."""
    try:
        report = read_json(path, LARGEST_INDEX)
        return report if {"verb", "model"} <= report["settings"].keys() else None
    except (ValueError, LookupError, TypeError, AttributeError):
        return None


def journal_path(report: Path) -> Path:
    """Where the rows of a run's scans lie until its report is whole: hidden, a line of JSON each."""
    return report.with_name(f".{report.stem}.jsonl")


def made_rows(path: Path, report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The rows of scans that were made: those of the report at `path`, then those of its journal, which are later.
    Lines that a kill has torn are passed over."""
    journal, rows = journal_path(path), list(report.get("scans", ()))
    for line in journal.read_text(encoding="utf-8", errors="replace").splitlines() if journal.is_file() else ():
        with suppress(ValueError):
            rows.append(json.loads(line))
    return [row for row in rows if isinstance(row, dict) and row.keys() >= NEEDED and "error" not in row]


@dataclass(frozen=True)
class EarlierResults:
    """What earlier runs have left in a folder.

    folder   absolute, without links
    told     files that its reports name, and the journals of runs that were killed
    endings  of the files of its runs, also of those that were killed, and were not to name their last files
    """

    folder: Path
    told: frozenset[Path]
    endings: frozenset[str]

    def parted(
        self, found: Sequence[Path], streams: Sequence[Path], searched: Path | None
    ) -> tuple[list[Path], list[Path]]:
        """Of scan files those that are to be read, and those that are not though nothing tells that a run made them.

        streams   bags and captures that were found with them
        searched  the folder in which they were found; None = each was named
        Not read are those below the output folder, where it lies in the one that was searched, those that a report
        names, unless the user did, and those that a run has made, or would make, of another scan or stream.
        """
        root = None if searched is None else searched.resolve()
        within = root is not None and root in self.folder.parents
        real = {parent: parent.resolve() for parent in {path.parent for path in (*found, *streams)}}
        places = [real[path.parent] / path.name for path in found]
        sources: dict[str, list[Path]] = {}
        for path, place in zip(found, places, strict=True):
            sources.setdefault(stem(path), []).append(place)
        turns = {path.stem for path in streams}
        scans, unknown = [], []
        for path, place in zip(found, places, strict=True):
            if self.folder not in place.parents:
                scans.append(path)
                continue
            made = (root is not None and place in self.told) or self._is_of_another(place, sources, turns)
            if within and not made:
                unknown.append(path)
            elif not made:
                scans.append(path)
        return scans, unknown

    def _is_of_another(self, place: Path, sources: dict[str, list[Path]], turns: set[str]) -> bool:
        """Whether a file has the name that a run gives to the result of another: its stem, or that and folders above
        it; of bags and captures a number in a folder."""
        for ending in self.endings:
            if place.name.endswith(ending):
                *above, name = (*place.relative_to(self.folder).parts[:-1], place.name.removesuffix(ending))
                if above and above[-1] in turns and name.isdecimal():
                    return True
                others = (other for other in sources.get(name, ()) if other != place)
                return any(other.parts[:-1][len(other.parts) - 1 - len(above) :] == tuple(above) for other in others)
        return False


def earlier_results(out: Path | None) -> EarlierResults | None:
    """What lies in an output folder already; None where there is no such folder."""
    if out is None or not out.is_dir():
        return None
    told, endings, folder = set(), set(), out.resolve()
    for path in sorted(out.glob("report*.json")):
        if (report := read_report(path)) is None:
            continue  # something else of the user's
        ending = f".{report['settings'].get('format')}"
        endings.add(ending)
        told |= {folder / f"{row['name']}{ending}" for row in made_rows(path, report)}
    return EarlierResults(folder, frozenset(told), frozenset(endings))
