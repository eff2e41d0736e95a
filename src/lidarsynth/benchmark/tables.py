"""Results as a page of tables: a row per method, a column per measure, the paper's value beside the measured one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarsynth.benchmark.rows import Row
from lidarsynth.evaluation.protocols import get_protocol
from lidarsynth.lidar.plural import plural

RANK: dict[
    str, Callable[[float], float]
] = {  # measure of a protocol's row -> the less the better; others are themselves
    "iou": lambda value: -value,
    "iou-weighted": lambda value: -value,
    "voxel-iou": lambda value: -value,
    "voxel-precision": lambda value: -value,
    "voxel-recall": lambda value: -value,
    "voxel-f1": lambda value: -value,
    "sets-coverage": lambda value: -value,
    "sets-1nna": lambda value: abs(value - 50),
}
ERRORS = {"range MAE": ("m", 3), "reflectance MAE": ("", 4)}  # of each scan: unit and digits


@dataclass(frozen=True)
class Column:
    """One measure: its heading, and each row's value, the paper's value, and why there is none."""

    heading: str
    value: Callable[[Row], float | None]
    digits: int = 3
    rank: Callable[[float], float] = float  # the best value has the least
    competes: bool = True  # whether the best is bold
    published: Callable[[Row], float | None] = lambda row: None
    why: Callable[[Row], str] = lambda row: row.reason
    images: Callable[[Row], str] = lambda row: ""  # that a row was judged as; of several nobody is best

    def cells(self, rows: Sequence[Row]) -> list[str]:
        """A cell per row; the best of the rows of most scans is bold, and what is shown equal to it; bounds and shorter
        ones take no part."""
        values = [self.value(row) for row in rows]
        most = max((row.count for row in rows if not row.floor), default=0)
        competing = [
            self.competes and not row.floor and row.count == most and v is not None
            for v, row in zip(values, rows, strict=True)
        ]
        if len({self.images(row) for row, competes in zip(rows, competing, strict=True) if competes}) > 1:
            competing = [False] * len(rows)
        shown = [None if v is None else round(v, self.digits) + 0.0 for v in values]  # no -0.000
        ranks = [self.rank(v) for v, competes in zip(shown, competing, strict=True) if competes and v is not None]
        cells = []
        for value, competes, row in zip(shown, competing, rows, strict=True):
            cell = "N/A" if value is None else f"{value:.{self.digits}f}"
            if value is not None and competes and len(ranks) > 1 and self.rank(value) == min(ranks):
                cell = f"**{cell}**"
            paper = self.published(row)
            cells.append(cell if paper is None else f"{cell} ({paper:.{self.digits}f})")
        return cells


def page(title: str, command: str, rows: Sequence[Row], protocols: Sequence[str], about: Mapping[str, Any]) -> str:
    """The tables in Markdown: one per protocol, for upsampling one of the scans that slow methods did, and notes.

    about  what was compared with what, as lines of a list
    """
    lines = [f"# {title}", "", "```bash", command, "```", ""]
    lines += [f"- {name}: {value}" for name, value in about.items()]
    for name in protocols:
        columns = protocol_columns(name) + error_columns(rows, hidden_only=True) + seconds_columns()
        lines += ["", f"## {get_protocol(name).title}", "", *table(rows, columns), "", *notes(rows, columns, name)]
    most = max((row.count for row in rows), default=0)
    for count in sorted({row.count for row in rows if row.errors and row.count < most}):
        lines += ["", f"## The first {plural(count, 'scan')} only", ""]
        lines += table([row for row in rows if row.errors], error_columns(rows, first=count), counted=False)
    return "\n".join(lines) + "\n"


def table(rows: Sequence[Row], columns: Sequence[Column], counted: bool = True) -> list[str]:
    """The lines of a Markdown table."""
    heads = ["method", *(["scans"] if counted else []), *(column.heading for column in columns)]
    names = [_escaped(row.name) for row in rows]
    counts = [[str(row.count) if row.count else "N/A" for row in rows]] if counted else []
    body = zip(names, *counts, *(column.cells(rows) for column in columns), strict=True)
    rule = "|".join(["---", *["---:"] * (len(heads) - 1)])
    return [f"| {' | '.join(heads)} |", f"|{rule}|", *(f"| {' | '.join(cells)} |" for cells in body)]


def protocol_columns(name: str) -> list[Column]:
    """The measures of a protocol."""
    protocol = get_protocol(name)

    def column(row_name: str, unit: str, digits: int, measure: str) -> Column:
        return Column(
            f"{row_name}, {unit}" if unit else row_name,
            lambda row: row.value(name, row_name),
            digits,
            RANK.get(measure, float),
            True,
            lambda row: row.published.get(name, {}).get(row_name),
            lambda row: row.why(name, row_name),
            lambda row: row.reports.get(name, {}).get("images", ""),
        )

    absent = [column(row_name, "", 3, "") for row_name, _ in protocol.absent]
    return [column(row.name, row.unit, row.digits, row.measure) for row in protocol.rows] + absent


def error_columns(rows: Sequence[Row], first: int | None = None, hidden_only: bool = False) -> list[Column]:
    """Means of the errors of each scan, of the `first` so many scans."""
    names = dict.fromkeys(name for row in rows for name in row.errors
                           if not hidden_only or name.startswith("hidden"))  # fmt: skip

    def column(name: str) -> Column:
        def mean(row: Row) -> float | None:
            return float(np.mean(row.errors[name][:first])) if name in row.errors else None

        unit, digits = ERRORS[name.removeprefix("hidden ")]
        why = "the samples have no reflectance"
        return Column(f"{name}, {unit}" if unit else name, mean, digits, why=lambda row: row.reason or why)

    return [column(name) for name in names]


def seconds_columns() -> list[Column]:
    """Seconds per scan, the median, by the clock and of the processor."""
    clocks = {"s/scan": "wall", "CPU s/scan": "processor"}

    def column(heading: str, clock: str) -> Column:
        return Column(heading, lambda row: row.median(clock), competes=False, why=lambda row: "")

    return [column(*item) for item in clocks.items()]


def notes(rows: Sequence[Row], columns: Sequence[Column], protocol: str) -> list[str]:
    """Why cells are N/A, and what the protocol warns of, with the rows that it is said of where it is not all."""
    told: dict[str, list[str]] = {}
    for row in rows:
        for column in columns:
            reason = column.why(row) if column.value(row) is None else ""
            if reason:
                told.setdefault(reason, []).append(row.name if reason == row.reason else column.heading)
    lines = [f"- N/A, {', '.join(dict.fromkeys(names))}: {_escaped(reason)}" for reason, names in told.items()]
    judged = [row for row in rows if "values" in row.reports.get(protocol, {})]
    kinds: dict[str, list[str]] = {}
    for row in judged:
        kinds.setdefault(row.reports[protocol].get("images", ""), []).append(row.name)
    if len(kinds) > 1:
        each = "; ".join(f"{', '.join(names)} as {images}" for images, names in kinds.items())
        lines.append(f"- {_escaped(f'numbers of other images are not to be compared: {each}')}; "
                     "`sensor` in the file draws points and tensors into those of one")  # fmt: skip
    for warning in dict.fromkeys(text for row in judged for text in row.reports[protocol].get("warnings", ())):
        warned = [row.name for row in judged if warning in row.reports[protocol].get("warnings", ())]
        whose = "" if len(warned) == len(judged) else f"{', '.join(warned)}: "
        lines.append(f"- {_escaped(whose + in_the_file(warning))}")
    return lines


def in_the_file(note: str) -> str:
    """A note of `evaluate`, whose option is a key of a benchmark's file."""
    return note.replace("--sensor", "`sensor` in the file")


def _escaped(text: str) -> str:
    """Text that cannot break out of a cell."""
    return " ".join(text.split()).replace("|", "\\|")
