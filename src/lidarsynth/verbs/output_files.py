"""Which files a verb reads and writes: decided, and refused, before any work is done."""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path

from lidarsynth.data.sources import scan_files
from lidarsynth.files.formats import READERS, WRITERS


def targets(paths: list[Path], out: Path) -> list[tuple[Path, Path]]:
    """Each scan, of `paths` or of the one folder in it, with the file to write: `out` for one file, else out/NAME.ply.

    Raises ValueError where `out` cannot be written, is a scan's own file, or two scans would share a file.
    """
    if not paths:
        raise ValueError("expected one scan or more, found none")
    whole_folder = len(paths) == 1 and paths[0].is_dir() and not _is(READERS, paths[0])
    scans = scan_files(paths[0]) if whole_folder else paths
    if len(scans) == 1 and not whole_folder and not out.is_dir() and (out.suffix or out.is_file()):
        return [(scans[0], target(out, scans[0]))]
    if _is(WRITERS, out) or out.is_file():
        raise ValueError(f"{out}: expected the name of a folder for {len(scans)} scans, found that of a file")
    names = [_stem(path) for path in scans]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"{out}: expected scans of different names, found two named {twice[0]}")
    return [(path, target(out / f"{name}.ply", path)) for name, path in zip(names, scans, strict=True)]


def _is(kinds: Collection[str], path: Path) -> bool:
    return path.name.lower().endswith(tuple(kinds))


def _stem(path: Path) -> str:
    """The name without the ending that tells the kind of file: a.b.pcd.bin -> a.b."""
    endings = [suffix for suffix in READERS if path.name.lower().endswith(suffix)]
    return path.name[: -max(map(len, endings))] if endings else path.stem


def target(out: Path, source: Path) -> Path:
    """`out`, where it may be written. Raises ValueError for a folder, an unknown ending, or the source's own file."""
    if not _is(WRITERS, out) or _is([".pcd.bin"], out):
        raise ValueError(f"{out}: expected a name that ends in {', '.join(WRITERS)}, found {out.name[-20:]!r}")
    if out.is_dir():
        raise ValueError(f"{out}: expected the name of a file to write, found a folder")
    if out.exists() and source.exists() and out.samefile(source):
        raise ValueError(f"{out}: expected a file other than the scan that is read, found the same")
    parent = next(folder for folder in out.absolute().parents if folder.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise ValueError(
            f"{out}: expected a writable folder, found {'a file' if parent.is_file() else 'no right'} at {parent}"
        )
    return out
