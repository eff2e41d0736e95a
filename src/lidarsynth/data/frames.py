"""What a reader is; a reader over the files of a data set, scan i = file i; the quick way into KITTI's files."""

from __future__ import annotations

import os
import stat
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from lidarsynth.files.arrays import is_text
from lidarsynth.files.fields import MAX_BYTES, MAX_METRES, MAX_POINTS, find, rings_from_top
from lidarsynth.files.formats import BESIDE, read
from lidarsynth.lidar.frame import transformed
from lidarsynth.lidar.scan import MEDIAN, Scan


class Name(NamedTuple):
    """Where a scan comes from: the data set, the drive or scene in it, and the frame in that."""

    source: str
    sequence: str
    frame: str


class Reader(Protocol):
    """Scans by number: `len(reader)`, `reader[i] -> Scan`, `reader.name(i)`; `missing` names absent sequences.

    `reader[i]` raises ValueError, naming the file, where that one scan cannot be read.
    """

    @property
    def missing(self) -> tuple[str, ...]: ...
    def __len__(self) -> int: ...
    def __getitem__(self, index: int, /) -> Scan: ...
    def name(self, index: int, /) -> Name: ...


class Frame(NamedTuple):
    """One scan on disk; `labels` is its SemanticKITTI `.label` file, if it has one."""

    path: str
    sequence: str
    frame: str
    labels: str | None = None


def stamped(frames: Sequence[Frame], index: int) -> tuple[str, str]:
    """Sizes and times of the files of scan `index`: they change when the scan does; of a copy, the times alone."""
    frame = frames[index]
    found = [os.stat(path) for path in (frame.path, frame.labels) if path is not None and os.path.exists(path)]
    return repr([stat.st_size for stat in found]), repr([stat.st_mtime_ns for stat in found])


@dataclass(frozen=True)
class Frames:
    """A reader over scan files, in the order given.

    source     word of the data set
    frames     one per scan
    missing    sequences of the chosen split that are not on this disk
    intensity  scale of the files, as in `files.formats.read`
    transform  (4, 4) that brings the points into the sensor's frame, or None
    rings      of files of several sensors, the first and last to read, as in `files.formats.read`
    """

    source: str
    frames: Sequence[Frame]
    missing: tuple[str, ...] = ()
    intensity: str = "unit"
    transform: np.ndarray | None = None
    rings: tuple[int, int] | None = None

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Scan:
        frame = self.frames[index]
        kitti = frame.path.endswith(".bin") and not frame.path.endswith(".pcd.bin")
        if kitti and frame.labels is None and self.intensity == "unit" and self.rings is None:
            scan = read_velodyne(frame.path)
        else:
            scan = read(frame.path, self.intensity, frame.labels, self.rings)
        return scan if self.transform is None else moved(scan, self.transform)

    def name(self, index: int) -> Name:
        """Source, sequence and frame of scan `index`."""
        return Name(self.source, self.frames[index].sequence, self.frames[index].frame)


def moved(scan: Scan, transform: np.ndarray) -> Scan:
    """The scan in another frame, by a (4, 4) `transform`: where up is elsewhere then, its rings count from the other
    end, and `extra["ring"]` has the numbers as they were. Raises FileError for ring numbers that are none."""
    xyz, ring, extra = transformed(scan.xyz, transform), scan.ring, dict(scan.extra)
    if (was := scan.ring) is not None:
        ring = rings_from_top(was, xyz)
        if (ring != was).any() and find(extra, "ring") is None:
            extra["ring"] = was
    return replace(scan, xyz=xyz, ring=ring, extra=extra)


def read_velodyne(path: str | Path) -> Scan:
    """A KITTI `.bin` with reflectance 0-1: as `files.read(path, "unit")`, three times faster where nothing is amiss."""
    table = _whole_points(Path(path))
    if table is None or not _flawless(columns := np.ascontiguousarray(table.T)) or is_text(table[:256].tobytes()):
        return read(path, "unit")  # drops what must be dropped, adds what lies beside, or says what is wrong
    return Scan(table[:, :3], columns[3])


def _whole_points(path: Path) -> np.ndarray | None:
    """(N, 4) float32 of a file of whole points that has no marks beside it, or None."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):  # a pipe would be waited for
            return None
        if status.st_size % 16 or not 0 < status.st_size <= min(MAX_BYTES, 16 * MAX_POINTS):
            return None
        if any(path.with_suffix(f".{name}").exists() for name in BESIDE):
            return None
        return np.fromfile(path, "<f4").reshape(-1, 4)
    except (OSError, ValueError):
        return None


def _flawless(columns: np.ndarray) -> bool:
    """Whether (4, N) x y z reflectance are finite metres with a reflectance of 0-1 and no point at the origin."""
    far = np.abs(columns[:3])
    limit = far.max(initial=0)  # NaN where any coordinate is
    low, high = columns[3].min(initial=0), columns[3].max(initial=0)
    if not (limit <= MAX_METRES and low >= 0 and high <= 1 and columns[:2].any(axis=0).all()):
        return False
    return bool(limit <= MEDIAN or np.median(far[:, ::16].max(axis=0)) <= MEDIAN)


def list_frames(folder: Path, sequence: str, suffix: str = ".bin", labels: Path | None = None) -> list[Frame]:
    """The scans of one sequence, sorted by name; none if the folder is not there. `labels`: the folder of `.label`s.

    Raises ValueError for nuScenes' `.pcd.bin` where KITTI's `.bin` are expected, whose names end alike.
    """
    names, known = _names(folder, suffix), set(_names(labels, ".label")) if labels else set()
    if alien := [name for name in names if suffix == ".bin" and name.endswith(".pcd")]:
        raise ValueError(f"{folder}/{alien[0]}.bin: expected a .bin of four floats a point, found a .pcd.bin, as "
                         "nuScenes writes them: data files takes such scans")  # fmt: skip
    return [
        Frame(f"{folder}/{name}{suffix}", sequence, name, f"{labels}/{name}.label" if name in known else None)
        for name in names
    ]


def _names(folder: Path, suffix: str) -> list[str]:
    if not folder.is_dir():
        return []
    return sorted(name.removesuffix(suffix) for name in os.listdir(folder) if name.endswith(suffix))


def choose(word: str, split: str, splits: Sequence[str]) -> None:
    """Raises ValueError when `split` is not one of the source's."""
    if split not in splits:
        raise ValueError(f"{word}: expected a split of {', '.join(splits)}, found {split!r}")


def gather(source: str, root: Path, split: str, frames: dict[str, list[Frame]]) -> Frames:
    """One reader over the sequences of a split, in order. Raises ValueError when there is no scan at all."""
    if not any(frames.values()):
        wanted = ", ".join([*list(frames)[:3], "..."]) if len(frames) > 3 else ", ".join(frames) or "any sequence"
        raise ValueError(f"{root}: expected scans of the split {split} ({wanted}), found none; choose another split")
    missing = tuple(sequence for sequence, found in frames.items() if not found)
    return Frames(source, [frame for found in frames.values() for frame in found], missing)
