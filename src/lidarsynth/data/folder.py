"""A folder of scan files of any kind that `files.formats.read` knows, at any depth."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from lidarsynth.data.bags import is_bag
from lidarsynth.data.cache_files import cache_files, is_cache
from lidarsynth.data.capture import is_capture
from lidarsynth.data.frames import Frame, Frames
from lidarsynth.files.fields import FileError
from lidarsynth.files.formats import NAMED_ONLY, READERS
from lidarsynth.files.labels import label_path
from lidarsynth.lidar.plural import plural

# Folders of published data sets, and of ours, whose .bin and .pcd hold a value a point, or a radar's points: no scans.
BESIDE = ("labels", "rings", "point_times", "lidarseg", "panoptic", "predictions", "sick_points")
RADAR = "radar_"
# Of an Argoverse 2 log, in small letters: its other files of such endings, and what is in the name of its map's.
TABLES = ("annotations.feather", "city_se3_egovehicle.feather", "egovehicle_se3_sensor.feather", "intrinsics.feather")
HEIGHTS = "_ground_height_surface_"
MACS, APPLE_DOUBLE = "._", b"\x00\x05\x16\x07"  # before the names, and the bytes, of what macOS keeps beside each file
LOCK = ".#"  # before the names of links to nothing by which editors lock a file


def folder(
    root: str | Path,
    intensity: str = "auto",
    transform: np.ndarray | None = None,
    rings: tuple[int, int] | None = None,
) -> Frames:
    """Every scan under `root`, sorted by path; sequence = the folder below `root`, frame = the file's name.

    intensity, transform, rings  as of `Frames`
    A `.label` file of the same name beside a scan, or where `write` puts it, gives its SemanticKITTI labels. Raises
    ValueError without any scan.
    """
    frames = [_frame(path, Path(root)) for path in scan_files(root)]
    return Frames("files", frames, intensity=intensity, transform=transform, rings=rings)


def _frame(path: Path, root: Path) -> Frame:
    labels = next((str(at) for at in (path.with_suffix(".label"), label_path(path)) if os.path.isfile(at)), None)
    return Frame(str(path), path.parent.relative_to(root).as_posix(), path.name, labels)


def scan_files(root: str | Path) -> list[Path]:
    """The scan files under a folder, sorted, but those of BESIDE, radars, other tables and caches. Raises ValueError
    without any."""
    root = Path(root)
    check_folder(root)
    paths = scans_below(root)
    if not paths:
        listed = ", ".join(suffix for suffix in READERS if suffix not in NAMED_ONLY)
        none = f"none{_named_only(root) or _recorded(root)}"
        raise ValueError(f"{root}: expected scans ({listed}; {' and '.join(NAMED_ONLY)} by name), found "
                         f"{'a cache of range images' if is_cache(root) else none}")  # fmt: skip
    return paths


def _named_only(root: Path) -> str:
    """What is to be said of tables of text in a folder without scans: how they are read, or nothing where none are."""
    tables = [here / name for here, _, files in walk(root) for name in files if name.lower().endswith(NAMED_ONLY)]
    if not tables:
        return ""
    endings = Counter(str(table.parent / f"*{table.suffix}") for table in sorted(tables))
    pattern = endings.most_common(1)[0][0]
    return (
        f" but {plural(len(tables), 'file')} of text: where they are scans, name them, as '{pattern}'; for a cache "
        f"`lidarsynth project '{pattern}' --out IMAGES` makes images first, which data files takes"
    )


def check_folder(root: Path) -> None:
    """Raises ValueError for what is no folder, and says how a bag or capture is read."""
    if not root.is_dir():
        found = "a file" if root.exists() else "nothing"
        raise ValueError(f"{root}: expected a folder of scans, found {found}{_recorded(root)}")


def _recorded(root: Path) -> str:
    """What is to be said of a bag or capture, or of those in a folder without scans: how they are read, or nothing."""
    if not (root.exists() and (_is_stream(root) or (root.is_dir() and _holds_streams(root)))):
        return ""
    what = "bags or captures in it" if root.is_dir() and not is_bag(root) else "a bag or capture"
    return f": of {what} `lidarsynth project {root} --out IMAGES` makes images first, which data files takes"


def _is_stream(path: Path) -> bool:
    return is_bag(path) or is_capture(path)


def _holds_streams(root: Path) -> bool:
    return any(_is_stream(here / name) for here, folders, files in walk(root) for name in (*folders, *files))


def scans_below(root: Path, more: tuple[str, ...] = ()) -> list[Path]:
    """The scan files under a folder as `scan_files`, and files of these further endings; there may be none. Raises
    FileError for a folder that cannot be read.

    Links to nothing, as of data that were not fetched, and pipes, of such names are among them: reading tells of them.
    """
    endings = (*(suffix for suffix in READERS if suffix not in NAMED_ONLY), *more)
    named = (here / name for here, _, files in walk(root) for name in files if name.lower().endswith(endings))
    return sorted(path for path in named if not _beside(path.relative_to(root)) and _is_meant(path))


def walk(root: Path) -> Iterator[tuple[Path, list[str], list[str]]]:
    """Each folder at and under `root` with the names of its folders and of its files, as `os.walk`, which leaves out
    folders that are taken out of that list; through links to folders elsewhere, too. A cache's own files are not told:
    what lies below it, is.

    A folder comes once, however many links lead to it, and those that lead to what holds `root`, or into it, are not
    gone through: links in a circle end. Raises FileError for a folder that cannot be read.
    """
    check_readable(root)
    home = Path(os.path.realpath(root))
    seen: set[Path] = set()
    for here, folders, files in os.walk(root, followlinks=True):
        kept = []
        for path in (Path(here, name) for name in sorted(folders)):
            real = Path(os.path.realpath(path))
            around = path.is_symlink() and (home == real or home in real.parents or real in home.parents)
            if not around and real not in seen:
                check_readable(path)
                kept.append(path.name)
                seen.add(real)
        folders[:] = kept
        own = cache_files(Path(here), files)
        yield Path(here), folders, [name for name in files if name not in own and not _macs(Path(here, name))]


def _macs(path: Path) -> bool:
    """Whether a file is what macOS keeps of another one (AppleDouble, RFC 1740): `._scan.pcd` beside `scan.pcd`."""
    if not path.name.startswith(MACS):
        return False
    with suppress(OSError):
        if path.is_file():
            with path.open("rb") as file:
                return file.read(len(APPLE_DOUBLE)) == APPLE_DOUBLE
    return False


def check_readable(folder: Path) -> None:
    """Raises FileError for a folder that nobody gave the right to list, or to look into."""
    try:
        os.stat(os.path.join(folder, os.curdir))
        os.scandir(folder).close()
    except OSError as error:
        raise FileError(f"{folder}: expected a readable folder, found: {error.strerror}") from None


def _is_meant(path: Path) -> bool:
    """Whether a name that is of no folder is of a file, or of what stands for one."""
    return path.is_file() or not path.name.startswith(LOCK)


def stem(path: Path) -> str:
    """The name without the ending that tells the kind of file: a.b.pcd.bin -> a.b."""
    endings = [suffix for suffix in READERS if path.name.lower().endswith(suffix)]
    return path.name[: -max(map(len, endings))] if endings else path.stem


def by_number(path: Path) -> tuple[str | int, ...]:
    """What paths are sorted by where the numbers in their names count: part_2 before part_10."""
    return tuple(int(word) if word.isdecimal() else word for word in re.split(r"(\d+)", str(path)))


def _beside(path: Path) -> bool:
    """Whether a path below the folder leads through one that holds something else of each point, or is a log's."""
    *folders, name = map(str.lower, path.parts)
    return any(part in BESIDE or part.startswith(RADAR) for part in folders) or name in TABLES or HEIGHTS in name
