"""What the paths that a user names stand for: scan files, bags and captures, those of folders and of patterns too."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterator, Sequence
from itertools import takewhile
from pathlib import Path

from lidarsynth.data.bags import is_bag, packed_bags
from lidarsynth.data.cache_files import cache_files
from lidarsynth.data.capture import is_capture
from lidarsynth.data.folder import by_number, scan_files, scans_below, stem, walk
from lidarsynth.files.formats import READERS
from lidarsynth.verbs.earlier_results import EarlierResults

NAMED = 3  # files of a pattern that are no scans
MAGIC = "*?["  # of patterns


def is_stream(path: Path) -> bool:
    """Whether a path holds many scans one after the other: a bag or a capture."""
    return is_bag(path) or is_capture(path)


def streams_below(folder: Path) -> list[Path]:
    """The bags and captures under a folder, at any depth, 2 before 10; a folder that is a bag is one, whatever it
    holds. Raises FileError for a folder that cannot be read."""
    found: list[Path] = []
    for here, folders, files in walk(folder):
        bags = {name for name in folders if is_bag(here / name)}
        folders[:] = [name for name in folders if name not in bags]
        found += filter(is_stream, (here / name for name in (*bags, *files)))
    return sorted(found, key=by_number)


def packed_below(folder: Path) -> list[Path]:
    """The compressed bags under a folder that no metadata beside them tells of, as of a recording that was killed."""
    found: list[Path] = []
    for here, folders, files in walk(folder):
        folders[:] = [name for name in folders if not is_bag(here / name)]
        found += [here / name for name in packed_bags(files)]
    return sorted(found, key=by_number)


def all_expanded(paths: Sequence[Path], earlier: EarlierResults | None) -> tuple[list[Path], tuple[Path, ...]]:
    """What the paths stand for, without results of earlier runs, and scans as `Inputs.below`."""
    parts = [_expanded(path, earlier) for path in paths]
    found, below = ([path for part in parts for path in part[side]] for side in (0, 1))
    if earlier is not None:
        streams = {path for path in found if is_stream(path)}
        scans, _ = earlier.parted([path for path in found if path not in streams], list(streams), None)
        kept = streams.union(scans)
        found = [path for path in found if path in kept]
    return found, tuple(below)


def _expanded(path: Path, earlier: EarlierResults | None) -> tuple[list[Path], list[Path]]:
    """The path, the files of a folder, or those that a glob finds, where these are folders alone theirs; of a folder
    without scans its bags and captures. Beside them, scans as `Inputs.below`."""
    if not path.exists() and any(c in str(path) for c in MAGIC):
        found = sorted(Path(name) for name in glob.glob(str(path), recursive=True))
        found = _without_caches(found)
        scans, bags = [p for p in found if is_scan(p)], {p for p in found if p.is_dir() and is_bag(p)}
        streams = sorted((p for p in found if is_stream(p) and p.parent not in bags), key=by_number)
        if not (scans or streams):
            folders = [p for p in found if is_folder(p) and (has_scans(p) or streams_below(p))]
            folders = [p for p in folders if not any(other in p.parents for other in folders)]
            if folders:
                parts = [_expanded(folder, earlier) for folder in folders]
                return [p for part in parts for p in part[0]], [p for part in parts for p in part[1]]
            others = ", ".join(p.name for p in found[:NAMED]) + (", ..." if found[NAMED:] else "")
            raise ValueError(f"{path}: expected scans, bags or captures of this pattern, found {others or 'none'}")
        fixed = Path(*takewhile(lambda part: not any(c in part for c in MAGIC), path.parts))
        scans, below = earlier.parted(scans, streams, fixed) if earlier else (scans, [])
        return scans + streams, below
    if is_folder(path):
        streams = streams_below(path)
        scans = scans_below(path) if streams else scan_files(path)
        scans, below = earlier.parted(scans, streams, path) if earlier else (scans, [])
        return scans or streams, below
    if not (path.exists() or is_scan(path) or is_stream(path)):
        raise ValueError(f"{path}: expected a file, folder, bag or capture, found nothing of that name")
    return [path], []


def _without_caches(found: list[Path]) -> list[Path]:
    """The paths that are no files of caches."""
    names: dict[Path, list[str]] = {}
    for path in found:
        names.setdefault(path.parent, []).append(path.name)
    own = {folder: cache_files(folder, of) for folder, of in names.items()}
    return [path for path in found if path.name not in own[path.parent]]


def is_folder(path: Path) -> bool:
    """Whether a path is a folder of scans, bags or captures: of any kind but a bag."""
    return path.is_dir() and not is_bag(path)


def is_scan(path: Path) -> bool:
    """Whether a path is a scan file by its name. A folder is none."""
    return path.name.lower().endswith(tuple(READERS)) and not path.is_dir()


def has_scans(folder: Path) -> bool:
    """Whether a folder holds a scan file, at any depth."""
    try:
        return bool(scan_files(folder))
    except ValueError:
        return False


def scan_names(expanded: list[Path]) -> Iterator[tuple[str, Path]]:
    """(name, path) of each scan file: its stem, with the folders above it as far as names repeat without them."""
    files = [path for path in expanded if not is_stream(path)]
    return iter(zip(_unlike([stem(path) for path in files], files), files, strict=True))


def stream_folders(streams: Sequence[Path]) -> dict[Path, str]:
    """Where the results of each bag or capture belong, below the output folder."""
    each = list(dict.fromkeys(streams))
    return dict(zip(each, _unlike([_folder(path) for path in each], each), strict=True))


def _folder(path: Path) -> str:
    """Where the results of a bag or capture belong: its stem, of drive.pcap2 drive_2."""
    number = re.sub(r"\D", "", path.suffix) if is_capture(path) else ""
    return f"{path.stem}_{number}" if number else path.stem


def _unlike(stems: list[str], files: list[Path]) -> list[str]:
    """The stems, or, where any is there twice, all with the folders above their files. Raises ValueError where these
    do not tell them apart."""
    if len(set(stems)) == len(stems):
        return stems
    root = Path(os.path.commonpath([path.absolute().parent for path in files]))
    names = [str(path.absolute().parent.relative_to(root) / one) for path, one in zip(files, stems, strict=True)]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        one, other = [path for name, path in zip(names, files, strict=True) if name == twice[0]][:2]
        raise ValueError(f"expected scans of different names, found two named {twice[0]}: {one} and {other}")
    return names
