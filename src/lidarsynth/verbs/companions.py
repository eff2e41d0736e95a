"""What lies beside a .bin or .npy: the labels of its points, which of them are new, and how sure those are."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from lidarsynth.files.fields import FileError
from lidarsynth.files.formats import BARE, BESIDE, READERS
from lidarsynth.files.labels import label_path

LABEL = ".label"  # ending of a file with SemanticKITTI's id of each point
BYTES = {LABEL: 4} | {f".{name}": kind.itemsize for name, kind in BESIDE.items()}  # a point


def companion(scan: Path, ending: str) -> Path:
    """Where the companion of that ending of a scan file is written."""
    return label_path(scan) if ending == LABEL else scan.with_suffix(ending)


def check_companions(out: Path, source: Path, endings: Iterable[str]) -> None:
    """Raises ValueError where a companion of `out`, with one of the endings, would replace one of `source`."""
    for ending in endings if out.suffix.lower() in BARE else ():
        file = companion(out, ending)
        if file.exists() and _is_of(source, file, ending) and not _is_of_former(out, source, file, ending):
            raise ValueError(f"{out}: expected a name whose {ending} is not that of {source}, found {file}")


def check_labels(out: Path) -> None:
    """Raises ValueError where labels lie beside a `.bin` or `.npy` that gets none of its own: they would be taken for
    those of its points."""
    if out.suffix.lower() in BARE and (file := companion(out, LABEL)).exists():
        raise ValueError(f"{out}: expected a name without the labels of other points beside it, found {file}")


def _is_of(source: Path, file: Path, ending: str) -> bool:
    """Whether a companion is where those of `source` are looked for: only a .bin or .npy has others than labels."""
    if ending != LABEL and source.suffix.lower() not in BARE:
        return False
    own = companion(source, ending), source.with_suffix(ending)
    return any(path.exists() and path.samefile(file) for path in own)


def _is_of_former(out: Path, source: Path, file: Path, ending: str) -> bool:
    """Whether a companion was written with an `out` that is there already, and does not fit the points of `source`."""
    if not out.exists():
        return False
    if source.suffix.lower() not in BARE:  # its own labels are inside
        return True
    try:
        fields = READERS[source.suffix.lower()](source.read_bytes())
    except (FileError, OSError):
        return False
    return file.stat().st_size != BYTES[ending] * len(next(iter(fields.values()), ()))
