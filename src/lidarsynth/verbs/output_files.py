"""Which files a verb reads and writes: decided, and refused, before any work is done."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from lidarsynth.data.bag_writer import FORMATS
from lidarsynth.data.bags import is_bag
from lidarsynth.files.formats import READERS, WRITERS
from lidarsynth.files.labels import labels_of
from lidarsynth.verbs.batch import EVERY, FIRST, Work
from lidarsynth.verbs.companions import LABEL, check_companions, check_labels
from lidarsynth.verbs.file_kinds import STREAMS
from lidarsynth.verbs.inputs import Inputs
from lidarsynth.verbs.other_files import PACKED


def works(
    inputs: Inputs,
    out: Path,
    ending: str,
    shard: tuple[int, int] = (1, 1),
    skip: bool = False,
    skipped: list[Path] | None = None,
    beside: tuple[str, ...] = (),
    known: Collection[Path] | None = None,
) -> Iterator[Work]:
    """Each scan of this shard with its file: `out` for a single one that names a file, else out/NAME.ending.

    skip     leave out scans whose file is there already; they are added to `skipped`
    beside   endings of the files that are written beside a .bin or .npy
    known    the only files whose scans may be left out; None = all
    Raises ValueError where `out` cannot be written, is a scan's own file, or names one file for several scans, and
    where a file beside it is a scan's own, or holds the labels of other points.
    """
    named = bool(out.suffix or out.is_file())
    one = inputs.single and named and (_is(WRITERS, out) or not out.is_dir())
    if not one and _names_a_file(out):
        scans = "the scans of a folder" if inputs.count == 1 else f"{inputs.count or 'several'} scans"
        raise ValueError(
            f"{out}: expected the name of a folder for {scans}, found that of a file; "
            f"written are {', '.join(WRITERS)} of one scan, and {' and '.join(FORMATS)} of a bag"
        )
    part, parts = shard
    for number, item in enumerate(inputs.stream()):
        if number % parts != part - 1:
            continue
        file = target(out if one else out / f"{item.name}.{ending}", item.path)
        if skip and file.exists() and (known is None or file in known):
            if skipped is not None:
                skipped.append(file)
            continue
        check_companions(file, item.path, beside)
        if LABEL not in beside and item.path.suffix.lower() == ".bin" and labels_of(item.path) is None:
            check_labels(file)  # whose points bring none
        yield Work(item, file, looked_at(number), number)


def looked_at(number: int) -> bool:
    """Whether the frame of scan `number` is looked at: of the first ones, and every so many."""
    return number < FIRST or number % EVERY == 0


def _names_a_file(out: Path) -> bool:
    """Whether `out` is a file, or has the ending of a kind that we write, or read, or of an archive."""
    return out.is_file() or _is(WRITERS, out) or (_is([*READERS, *STREAMS, *PACKED], out) and not out.is_dir())


def _is(kinds: Collection[str], path: Path) -> bool:
    return path.name.lower().endswith(tuple(kinds))


def target(out: Path, source: Path) -> Path:
    """`out`, where it may be written. Raises ValueError for a folder, an unknown ending, or the source's own file."""
    if not _is(WRITERS, out) or _is([".pcd.bin"], out):
        raise ValueError(f"{out}: expected a name that ends in {', '.join(WRITERS)}, found {out.name[-20:]!r}")
    check_place(out)
    if out.exists() and source.exists() and out.samefile(source):
        raise ValueError(f"{out}: expected a file other than the scan that is read, found the same")
    return out


def check_place(out: Path) -> None:
    """Raises ValueError, before any work, where a file cannot be put: what is there is none, or its folder, or the
    nearest above it that there is, cannot be written to."""
    if out.exists() and not out.is_file():
        found = "a folder" if out.is_dir() else "a device or pipe"
        raise ValueError(f"{out}: expected the name of a file to write, found {found}")
    parent = next(folder for folder in out.absolute().parents if folder.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise ValueError(
            f"{out}: expected a writable folder, found {'a file' if parent.is_file() else 'no right'} at {parent}"
        )


def check_bag(out: Path, read: Sequence[Path]) -> None:
    """Raises ValueError where a new bag `out` would be a folder, one of the files that are `read`, or lie among the
    parts of a bag of ROS 2, of which it would become one."""
    if out.is_dir():
        raise ValueError(f"{out}: expected the name of a bag to write, found a folder")
    if out.exists() and any(path.exists() and out.samefile(path) for path in read):
        raise ValueError(f"{out}: expected a bag other than the one that is read, found the same")
    if out.suffix.lower() == ".mcap" and is_bag(out.parent):
        raise ValueError(f"{out}: expected a place outside the bag {out.parent}, whose parts are read as one, found "
                         "one in it")  # fmt: skip
