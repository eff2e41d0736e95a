"""What a layout of a labelled data set has to say: which files a frame becomes, and the tables beside them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from lidarsynth.lidar.small_file import LARGEST_INDEX, check_regular, read_json
from lidarsynth.streets.frame import Frame, LabelledStreets

Content = Iterator[tuple[str, bytes | BinaryIO]]  # path below the folder, what is in it
Sizes = Iterator[tuple[str, int | None]]  # path below the folder, bytes
HEAD = 160  # bytes of a JSON in which its number of points is


class Layout(NamedTuple):
    """How one kind of data set lies on disk.

    record  the path of frame i's JSON, which is written last: where it and all files are, the frame is there
    files   all files of frame i but the JSON
    sizes   what they are and how many bytes each has where frame i has that many points, None = any number
    records pattern of the paths of all JSONs; index: the frame that the one at such a path is of, -1 for none
    tables  the files that tell about the whole set, written when all frames are there
    """

    record: Callable[[LabelledStreets, int], str]
    files: Callable[[LabelledStreets, int, Frame], Content]
    sizes: Callable[[LabelledStreets, int, int], Sizes]
    tables: Callable[[LabelledStreets, Path], Content]
    records: str
    index: Callable[[LabelledStreets, Path], int]

    def has(self, folder: Path, streets: LabelledStreets, index: int) -> bool:
        """Whether frame `index` is there and none of its files is cut off, by their sizes and the JSON's ends alone."""
        points = points_told(folder / self.record(streets, index))
        if points is None:
            return False
        found = ((size, _size(folder / path)) for path, size in self.sizes(streets, index, points))
        return all(has is not None and need in (None, has) for need, has in found)


def _size(path: Path) -> int | None:
    try:
        return path.stat().st_size
    except OSError:
        return None


def points_told(path: Path) -> int | None:
    """How many points the JSON of a frame tells of, None for one that is missing, cut off or something else.

    It begins with this number and ends with its boxes, so that few bytes are read. Raises ValueError for no file.
    """
    try:
        check_regular(path)
        with path.open("rb") as file:
            told = re.search(rb'"points": (\d+)', file.read(HEAD))
            file.seek(-2, 2)
            return int(told[1]) if told and file.read() == b"]}" else None
    except OSError:
        return None


def numbered(_: LabelledStreets, path: Path) -> int:
    """The frame of a file that has its number for a name, -1 for another file."""
    return int(path.stem) if path.stem.isdecimal() else -1


def read_record(path: Path) -> dict[str, Any]:
    """The JSON of one frame. Raises ValueError that names the file."""
    try:
        return read_json(path, LARGEST_INDEX)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"{path}: expected the JSON of a frame, found {error}; remove it, the same command goes on"
        ) from (None)


def is_held_out(world: int) -> bool:
    """Every fifth world or drive is for validation in layouts that have lists of their own."""
    return world % 5 == 4
