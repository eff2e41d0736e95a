"""Files of statistics that several machines gathered, each of its part of the images, as one set."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from lidarsynth.evaluation.protocol import EvaluationProtocol
from lidarsynth.evaluation.statistics import GATHERED, Statistics, load_metadata, load_statistics

ENDING = ".safetensors"  # of a file of statistics
NAMED = 8  # parts that lack, of a note


def statistics_files(source: object) -> list[Path]:
    """The files of statistics that a source names, or [] where it names images. Raises ValueError for both at once."""
    sources = [source] if isinstance(source, str | Path) else source if isinstance(source, list | tuple) else []
    paths = [Path(item) for item in sources if isinstance(item, str | Path)]
    if not [path for path in paths if path.suffix == ENDING]:
        if len(paths) > 1 and len(paths) == len(sources):
            raise ValueError(f"expected one folder or file of images, or several of statistics ({ENDING}), found "
                             f"{', '.join(map(str, paths[:3]))}")  # fmt: skip
        return []
    if len(paths) != len(sources) or not all(path.suffix == ENDING for path in paths):
        raise ValueError(f"expected only files of statistics ({ENDING}), or none, found {', '.join(map(str, sources))}")
    return paths


def merged(files: Sequence[Path], protocol: EvaluationProtocol) -> tuple[Statistics, tuple[str, ...]]:
    """One set of statistics of several files, and warnings where parts are lacking, or were gathered by other rules.

    Parts come in the order of their numbers, however the files are named and given: which features the subsets of the
    squared MMD draw depends on their order. Wholes, which have none, stay as they are given.

    Raises ValueError where two hold the same images, or may: parts of different divisions. Those of one division that
    are alike, as of a generator that makes one scan again and again, are each their own.
    """
    loaded = [load_statistics(file, protocol) for file in files]
    parts = [tuple(map(int, metadata.get("part", "1/1").split("/"))) for _, metadata in loaded]
    held = [(part, statistics.digest) for part, (statistics, _) in zip(parts, loaded, strict=True)]
    shared = [part for part in parts if part[1] > 1]
    for i, file in enumerate(files):
        if held[i] in held[:i] or (parts[i] in shared and parts[i] in parts[:i]):
            raise ValueError(f"{file}: expected a part of its own, found the images of another part")
    if len({n for _, n in parts}) > 1:  # a whole beside parts, too: the images of these may be in it
        raise ValueError(f"expected parts of one division, found {', '.join(f'{i}/{n}' for i, n in parts)}")
    first, *others = sorted(range(len(files)), key=parts.__getitem__)  # of equal ones in their own order
    total, _ = loaded[first]
    for i in others:
        try:
            total.merge(loaded[i][0])
        except ValueError as error:
            raise ValueError(f"{files[first]} and {files[i]}: {error}") from None
    unlike = [file for file, (_, metadata) in zip(files, loaded, strict=True) if _by_other_rules(metadata)]
    told = (_gathered_otherwise(unlike),) if unlike else ()
    if shared and len(shared) < (n := shared[0][1]):
        lacking = [f"{i}/{n}" for i in range(1, n + 1) if (i, n) not in shared]
        more = f" and {len(lacking) - NAMED} more" if len(lacking) > NAMED else ""
        return total, (f"expected all parts of the images, found none of {', '.join(lacking[:NAMED])}{more}", *told)
    return total, told


def notes_of(files: Sequence[str | Path]) -> tuple[str, ...]:
    """What was unlike in the images that files of statistics were gathered of, as each keeps it; every note once.

    Raises ValueError for what is no such file.
    """
    found: dict[str, None] = {}
    for file in files:
        try:
            notes = json.loads(load_metadata(Path(file)).get("notes", "[]"))  # files of before keep none
        except json.JSONDecodeError:
            notes = None
        if not isinstance(notes, list) or not all(isinstance(note, str) for note in notes):
            raise ValueError(f"{file}: expected notes as a list of texts, found another thing")
        found |= dict.fromkeys("".join(c if c.isprintable() else " " for c in note) for note in notes)
    return tuple(found)


def _by_other_rules(metadata: Mapping[str, str]) -> bool:
    """Whether a program gathered them by whose rules the same files may have been drawn or counted otherwise."""
    return metadata.get("gathered") != str(GATHERED)


def _gathered_otherwise(files: Sequence[Path]) -> str:
    more = f" and {len(files) - 1} more" if len(files) > 1 else ""
    return (f"{files[0]}{more}: expected statistics gathered as by this version, found those of another, which may "
            "have drawn or counted the same scans otherwise: --part gathers them anew")  # fmt: skip
