"""A folder of scan files of any kind that `files.formats.read` knows, at any depth."""

from __future__ import annotations

from pathlib import Path

from lidarsynth.data.frames import Frame, Frames
from lidarsynth.files.formats import NAMED_ONLY, READERS


def folder(root: str | Path, intensity: str = "auto") -> Frames:
    """Every scan under `root`, sorted by path; sequence = the folder below `root`, frame = the file's name.

    intensity  scale of the files, as in `files.formats.read`
    A `.label` file beside a scan, of the same name, gives its SemanticKITTI labels. Raises ValueError without any scan.
    """
    frames = [_frame(path, Path(root)) for path in scan_files(root)]
    return Frames("files", frames, intensity=intensity)


def _frame(path: Path, root: Path) -> Frame:
    labels = path.with_suffix(".label")
    sequence = path.parent.relative_to(root).as_posix()
    return Frame(str(path), sequence, path.name, str(labels) if labels.is_file() else None)


def scan_files(root: str | Path) -> list[Path]:
    """The scan files under a folder, sorted. Raises ValueError when there is none."""
    root = Path(root)
    if not root.is_dir():
        raise ValueError(f"{root}: expected a folder of scans, found {'a file' if root.exists() else 'nothing'}")
    endings = tuple(suffix for suffix in READERS if suffix not in NAMED_ONLY)
    paths = sorted(p for p in root.rglob("*") if p.is_file() and p.name.lower().endswith(endings))
    if not paths:
        raise ValueError(f"{root}: expected scans ({', '.join(READERS)}), found none")
    return paths
