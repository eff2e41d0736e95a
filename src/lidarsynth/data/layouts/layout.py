"""What a layout of a labelled data set has to say: which files a frame becomes, and the tables beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from lidarsynth.lidar.small_file import LARGEST_INDEX, read_json
from lidarsynth.streets.frame import Frame, LabelledStreets

Content = Iterator[tuple[str, bytes | BinaryIO]]  # path below the folder, what is in it


class Layout(NamedTuple):
    """How one kind of data set lies on disk.

    record  the path of frame i's JSON, which is written last: where it and the scan are, the frame is there
    scan    that of its points
    files   all files of frame i but the JSON
    tables  the files that tell about the whole set, written when all frames are there
    """

    record: Callable[[LabelledStreets, int], str]
    scan: Callable[[LabelledStreets, int], str]
    files: Callable[[LabelledStreets, int, Frame], Content]
    tables: Callable[[LabelledStreets, Path], Content]


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
