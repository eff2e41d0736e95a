"""Scans by number, read when asked for: files of a folder, messages of a bag, turns of a capture."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Protocol

from lidarsynth.data.bags import is_bag, metadata_from, open_bag
from lidarsynth.data.folder import by_number, scan_files
from lidarsynth.data.frames import moved
from lidarsynth.data.whole_turns import TimedTurn
from lidarsynth.files.fields import FileError, dropped_points
from lidarsynth.verbs.inputs import FileInput, Input, Loaded, MessageInput, Reading, TurnInput, inputs_of
from lidarsynth.viewer.beside import can_do_without, read_shown, without_reflectance
from lidarsynth.viewer.packing import Shown

SCAN_FOLDERS = ("velodyne", "LIDAR_TOP")  # of data sets that have other files of the same ending beside their scans


class Series(Protocol):
    """Scans by number: `series[i] -> Shown`, IndexError behind the last; ValueError where that scan is broken.

    names  of those known so far; count: how many there are, or None where only reading tells
    cut    what is to be said, a line each, of bags that end early, and of bags and captures that are passed over
    """

    @property
    def names(self) -> Sequence[str]: ...
    @property
    def count(self) -> int | None: ...
    @property
    def cut(self) -> Sequence[str]: ...
    def __getitem__(self, index: int, /) -> Shown: ...


class Files:
    """Scan files, with what lies beside them."""

    def __init__(self, names: Sequence[str], paths: Sequence[Path], reading: Reading, cut: Sequence[str] = ()):
        self.names, self.paths, self.reading, self.cut = list(names), list(paths), reading, cut

    @property
    def count(self) -> int:
        """How many files."""
        return len(self.paths)

    def __getitem__(self, index: int) -> Shown:
        shown = read_shown(self.paths[index], self.reading.intensity, self.reading.rings)
        if self.reading.transform is None:
            return shown
        notes = (*shown.notes, "boxes left out: they belong to the frame before --transform") if shown.boxes else ()
        return replace(shown, scan=moved(shown.scan, self.reading.transform), boxes=(), notes=notes or shown.notes)


Opener = Callable[[int, int], Iterator[tuple[int, Input]]]


class Stream:
    """Scans that come one after the other, one held at a time; going back starts again at a mark on the way.

    open_at  (mark, number) -> (mark, scan) of all scans from that mark on, the first of which is scan `number`; marks
             never fall: times of messages, or all 0 where one must start anew
    count    how many there are, or None
    """

    def __init__(self, open_at: Opener, count: int | None, cut: Sequence[str] = ()):
        self.open_at, self.count, self.cut = open_at, count, cut
        self.names: list[str] = []
        self._marks: list[int] = []
        self._thread = ThreadPoolExecutor(1)  # a bag of SQLite may be read by the thread only that opened it
        self._stream: Iterator[tuple[int, Input]] | None = None
        self._next = 0  # what the stream gives next

    def __getitem__(self, index: int) -> Shown:
        item = self._thread.submit(self._at, index).result()
        loaded, notes = _read(item)
        notes += (dropped_points(loaded.dropped),) if loaded.dropped else ()
        notes += (loaded.left_out,) if loaded.left_out else ()
        return Shown(loaded.scan, notes=notes, name=item.name)

    def _at(self, index: int) -> Input:
        if index < 0:
            raise IndexError(index)
        mark = self._marks[min(index, len(self._marks) - 1)] if self._marks else 0
        start = bisect_left(self._marks, mark)  # the first scan of that mark
        if self._stream is None or index < self._next or start > self._next:
            self._stream, self._next = self.open_at(mark, start), start
        stream, self._stream = self._stream, None  # not to be gone on with where it ends, or breaks
        for mark, item in stream:
            if self._next == len(self._marks):
                self._marks.append(mark)
                self.names.append(item.name)
            self._next += 1
            if self._next == index + 1:
                self._stream = stream
                return item
        self.count = len(self._marks)
        raise IndexError(index)


def _read(item: Input) -> tuple[Loaded, tuple[str, ...]]:
    """A scan, also one that has no intensity, as of files, and then the note of that."""
    try:
        return item.read(), ()
    except FileError as error:
        known = isinstance(item, FileInput | MessageInput | TurnInput)
        if not (known and can_do_without(error, item.reading.intensity)):
            raise
        return replace(item, reading=replace(item.reading, intensity="none")).read(), (without_reflectance(error),)


def series_of(paths: Sequence[Path], reading: Reading) -> Series:
    """The scans of files, folders, globs, bags and captures. Raises ValueError where there is nothing to show."""
    if len(paths) == 1 and is_bag(paths[0]):
        return _bag(paths[0], reading)
    given = [found for path in paths for found in _scans_only(path)]
    inputs = inputs_of(given, reading)
    files: list[FileInput] = []
    for item in inputs.stream():
        if not isinstance(item, FileInput):  # of a capture, or of one bag of several
            return Stream(lambda mark, number: ((0, item) for item in inputs.stream()), inputs.count, inputs.cut)
        files.append(item)
    files = _in_order(files, given)
    return Files([item.name for item in files], [item.path for item in files], reading, inputs.words)


def _scans_only(path: Path) -> list[Path]:
    """A data set's scans without its other files of the same ending, by name; any other path as it is."""
    if not path.is_dir() or is_bag(path):
        return [path]
    try:
        found = [p for p in scan_files(path) if p.parent.name in SCAN_FOLDERS]
    except ValueError:
        return [path]  # a folder of bags, or of nothing
    drives = {p: p.parent.parent if p.parent.name == "velodyne" else path for p in found}
    return sorted(found, key=lambda p: (by_number(drives[p]), by_number(Path(p.name)))) or [path]


def _in_order(files: Sequence[FileInput], given: Sequence[Path]) -> list[FileInput]:
    """The files as their paths, folders and patterns were given; those of one folder or pattern 2 before 10, as bags
    are, so that frames play in their order."""
    place = {path: i for i, path in enumerate(given)}

    def found_by(item: FileInput) -> int:
        return next((place[path] for path in (item.path, *item.path.parents) if path in place), -1)

    return [
        item for _, those in groupby(files, found_by) for item in sorted(those, key=lambda one: by_number(one.path))
    ]


def _bag(path: Path, reading: Reading) -> Stream:
    with open_bag(path) as bag:
        topic = bag.point_topic(reading.topic)
        count, cut = bag.count_of(topic), bag.cut

    def open_at(mark: int, number: int) -> Iterator[tuple[int, Input]]:
        with open_bag(path) as bag:
            for scan in bag.scans(topic, metadata_from(reading.metadata, bag, topic), mark):
                name = f"{topic} {scan.time / 1e9:.3f} s"
                yield 0 if isinstance(scan, TimedTurn) else scan.time, MessageInput(name, path, reading, scan)

    return Stream(open_at, count, cut)
