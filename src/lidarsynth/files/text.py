"""Points as text: `.csv`, `.xyz`, `.txt`, `.asc`, `.pts`, with named columns or with columns told by their numbers."""

from __future__ import annotations

import re

import numpy as np

from lidarsynth.files.fields import MAX_POINTS, NAMES, SCALED, Fields, FileError, check_names
from lidarsynth.files.whole_numbers import exact
from lidarsynth.lidar.plural import plural

SEPARATORS = (",", ";", "\t", None)  # None: any white space
COMMENT = ("#", "//", "%")
HEADER_LINES = 64
TRUTHS = {"true": "1", "false": "0"}
OUSTER = {"x1": "x", "y1": "y", "z1": "z", "row": "ring"}  # of ouster-cli's csv, where two returns have numbers
BLOCK = 1 << 16  # lines
WITH_COMMA = re.compile(r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?")  # a number as most of Europe's spreadsheets write it
DIGITS = 18  # of a count of points, at most


def read_text(data: bytes) -> Fields:
    """Columns under their own names where a line names them, else x y z, then what the numbers can be.

    The line with names may be a comment, as CloudCompare and numpy write it; a lone count of points before them (.pts)
    must be theirs. Of unnamed columns the fourth is the intensity, and a fifth of whole numbers 0-255 the ring; three
    whole columns of 0-255 after x y z are colours, which are left out. Raises FileError for anything else.
    """
    lines, start = _lines(data), 0
    names: list[str] | None = None
    counts: list[int] = []
    separator: str | None = None
    for start, line in enumerate(lines):
        separator = _separator(line)
        words = _words(line.lstrip("#/% "), separator)
        empty = names is not None and not any(words)  # of a point without a return
        told = words if names is None else _with_truths(words)
        if (_numeric(told) or empty) and len(words) >= 3 and not line.startswith(COMMENT):
            break
        if _names(words):
            names = _told(words)
        elif line.startswith(COMMENT) and start < HEADER_LINES:
            continue
        elif len(words) == 1 and words[0].isdecimal() and len(words[0]) <= DIGITS and start < HEADER_LINES:
            counts.append(int(words[0]))
        elif names is not None and len(told) == len(names) and not _numeric(told):
            raise FileError(_no_number(told, names))
        else:
            raise FileError(f"expected lines of x y z and more numbers, or a line that names them, found {line[:40]!r}")
    else:
        if names is not None and not any(counts):  # and nothing else: a scan of no point
            return {name: np.zeros(0) for name in names}
        raise FileError(f"expected lines of x y z and more numbers, found none in {plural(len(lines), 'line')}")
    rows = [line for line in lines[start:] if not line.startswith(COMMENT)]
    table = _table(rows, separator, names)
    if len(counts) == 1 and counts[0] != len(table):
        raise FileError(f"expected {plural(counts[0], 'point')}, the number before them, found {len(table)}")
    if names is not None and len(names) != table.shape[1]:
        raise FileError(f"expected a number for each of {', '.join(names)[:80]}, found {table.shape[1]} a line")
    if names is None:
        return guessed(table)
    check_names(names)
    return {n: exact(table[:, i], (_bare(row.split(separator)[i]) for row in rows)) for i, n in enumerate(names)}


def guessed(table: np.ndarray) -> Fields:
    """The columns (N, 3 or more) of points without names, by what their numbers can be; SCALED of a scan station's."""
    fields = dict(zip("xyz", table[:, :3].T, strict=True))
    more = [table[:, i] for i in range(3, table.shape[1])]
    whole = [bool(np.all((c >= 0) & (c <= 255) & (c == np.floor(c)))) for c in more]
    if len(more) == 3 and all(whole):
        return fields  # x y z r g b
    if more:
        fields["intensity"] = more[0]
    if len(more) == 4 and all(whole[1:]) and more[0].min() < 0 and abs(more[0]).max() <= 2048:
        fields[SCALED] = (more[0] + 2048) / 4095  # -2048 to 2047, as Leica's scan stations write .pts
    if len(more) == 2 and whole[1]:
        fields["ring"] = more[1]
    return fields


def _lines(data: bytes) -> list[str]:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise FileError(f"expected lines of numbers as text, found bytes: {data[:12]!r}") from None
    rows = text.splitlines()
    first = [row.strip() for row in rows[:HEADER_LINES]]
    tabs = next((row.count("\t") for row in first if _separator(row) == "\t" and _names(row.split("\t"))), 0)
    lines = [line for line in (_without_blanks(row, tabs) for row in rows) if line]
    if any(map(_has_decimal_commas, lines[:HEADER_LINES])):
        lines = [line.replace(",", ".") for line in lines]
    if len(lines) > MAX_POINTS:
        raise FileError(f"expected at most {MAX_POINTS} points of one turn, found {len(lines)} lines")
    return lines


def _separator(line: str) -> str | None:
    return next((s for s in SEPARATORS if s is not None and s in line), None)


def _has_decimal_commas(line: str) -> bool:
    """Whether a line is of numbers with decimal commas, between which `;`, a tab or blanks stand."""
    if "," not in line or "." in line:
        return False
    cells = _words(line, ";" if ";" in line else None)
    return len(cells) >= 3 and all(cell == "" or WITH_COMMA.fullmatch(cell) for cell in cells)


def _words(line: str, separator: str | None) -> list[str]:
    return [word.strip().strip("\"'") for word in line.split(separator)]


def _without_blanks(line: str, tabs: int) -> str:
    """A line without blanks around it; the tabs of a line of as many as there are between the names (0: none) stay, for
    the first and last of its cells may be empty."""
    whole = line.strip(" ")
    return whole if tabs and whole.count("\t") == tabs else line.strip()


def _names(words: list[str]) -> bool:
    """Whether a line names columns."""
    return {"x", "y", "z"} <= set(map(_ours, _told([word.strip("#/% \"'") for word in words])))


def _told(words: list[str]) -> list[str]:
    """The names without units; those of ouster-cli's first returns, and of the row of their beam, in usual words."""
    names = [_without_unit(word) or word for word in words]
    lower = {name.lower() for name in names}
    ousters = {"x1", "y1", "z1"} <= lower and lower.isdisjoint({"x", "y", "z", "ring"})
    return [OUSTER.get(name.lower(), name) for name in names] if ousters else names


def _ours(word: str) -> str:
    """x, y or z for a name that means it."""
    name = _without_unit(word).lower()
    return next((axis for axis in "xyz" if name in NAMES[axis]), name)


def _without_unit(word: str) -> str:
    """A name such as `x [m]` or `X(m)` without what is in brackets."""
    return re.sub(r"[\[(].*", "", word).strip()


def _numeric(words: list[str]) -> bool:
    try:
        return all(word == "" or float(word) is not None for word in words) and any(words)
    except ValueError:
        return False


def _with_truths(words: list[str]) -> list[str]:
    """The words, 1 for True and 0 for False, as pandas writes them."""
    return [TRUTHS.get(word.lower(), word) for word in words]


def _no_number(words: list[str], names: list[str] | None) -> str:
    """What is to be said of a line with a word that is no number: the word, and the name of its column."""
    column, word = next((i, word) for i, word in enumerate(words) if not _numeric([word, "0"]))
    where = f" in column {names[column][:40]}" if names is not None and column < len(names) else ""
    return f"expected numbers{where}, found {word[:40]!r}"


def _table(lines: list[str], separator: str | None, names: list[str] | None) -> np.ndarray:
    """(N, columns) float64; an empty cell is NaN. Words are held of BLOCK lines at a time."""
    width = len(_words(lines[0], separator))
    return np.concatenate(
        [_numbers(lines[i : i + BLOCK], separator, names, width) for i in range(0, len(lines), BLOCK)]
    )


def _numbers(lines: list[str], separator: str | None, names: list[str] | None, width: int) -> np.ndarray:
    rows = [line.split(separator) for line in lines]
    if uneven := next((row for row in rows if len(row) != width), None):
        raise FileError(f"expected {width} numbers a line, found {len(uneven)}: {' '.join(uneven)[:40]!r}")
    try:
        return np.array(rows, dtype=np.float64)
    except ValueError:  # quoted, or empty
        words = [[_bare(word) or "nan" for word in row] for row in rows]
    try:
        return np.array(words, dtype=np.float64)
    except ValueError:
        words = words if names is None else [_with_truths(row) for row in words]
        if lost := next((row for row in words if not _numeric(row)), None):
            raise FileError(_no_number(lost, names)) from None
        return np.array(words, dtype=np.float64)


def _bare(word: str) -> str:
    return word.strip("\"' ")
