"""SemanticKITTI's `.label` files: a word a point, the raw class in its lower half, the instance in the upper."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidarsynth.files.fields import FileError, check_length
from lidarsynth.files.whole_numbers import stray
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.semantic_kitti import CLASS_OF_RAW, RAW

WORDS = 1 << 32  # that 4 bytes tell apart
MOST_INSTANCES = (1 << 16) - 1


def read_labels(path: str | Path, n: int) -> np.ndarray:
    """(n,) int32 training classes 0-19 of a SemanticKITTI `.label` file, in the point order of its `.bin`.

    Raises FileError when the file does not hold n words of 4 bytes or a raw id is not SemanticKITTI's.
    """
    raw = read_words(path, n) & 0xFFFF  # the high half is the instance
    classes = CLASS_OF_RAW[raw]
    if np.any(classes < 0):
        raise FileError(f"{path}: expected SemanticKITTI's raw ids, found {int(raw[classes < 0][0])}")
    return classes


def read_words(path: str | Path, n: int) -> np.ndarray:
    """(n,) uint32 words of a `.label` file as they are. Raises FileError when it does not hold n of them."""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise FileError(f"{path}: expected a readable .label file, found: {error.strerror}") from None
    if len(data) != 4 * n:
        raise FileError(f"{path}: expected {4 * n} bytes, one label of 4 for each of {n} points, found {len(data)}")
    return np.frombuffer(data, "<u4")


def words_of(scan: Scan) -> np.ndarray | None:
    """(N,) uint32 words of a scan's `.label` file: its `extra["raw_label"]`, and the raw ids of its classes where these
    say nothing, as of points that were filled in; of a scan without such words those of all its classes, with its
    `extra["instance"]` in the upper half where all of these are numbers of 0-65535; None where it has neither. Raises
    FileError (without the path) for what is no such word, or no class."""
    if "raw_label" in scan.extra:
        words = scan.extra["raw_label"]
        check_length("raw_label", words, len(scan))
        if words.dtype.kind not in "biuf":
            raise FileError(f"expected whole numbers as raw labels, found {words.dtype}")
        if (found := stray(words, WORDS - 1)) is not None:
            raise FileError(f"expected raw labels of 0-{WORDS - 1}, found {found}")
        words = words.astype("<u4")
        if scan.label is None:
            return words
        said = (words == 0) & (scan.label > 0) & (scan.label < len(RAW))
        return np.where(said, RAW[scan.label * said], words).astype("<u4")
    if scan.label is None:
        return None
    if (found := stray(scan.label, len(RAW) - 1)) is not None:
        raise FileError(f"expected labels of 0-{len(RAW) - 1}, SemanticKITTI's training classes, for a .label file, "
                        f'found {found}; extra["raw_label"] takes other ids')  # fmt: skip
    number = scan.extra.get("instance")
    if number is None or number.dtype.kind not in "iu" or stray(number, MOST_INSTANCES) is not None:
        return RAW[scan.label].astype("<u4")
    return RAW[scan.label].astype("<u4") | number.astype("<u4") << np.uint32(16)


def label_path(scan: Path) -> Path:
    """Where the labels of a scan file belong: of NN/velodyne/a.bin NN/labels/a.label, as published, else beside it."""
    folder = scan.parent.with_name("labels") if scan.parent.name == "velodyne" else scan.parent
    return folder / f"{scan.stem}.label"


def labels_of(scan: Path) -> Path | None:
    """The labels that lie where those of a scan file belong, or beside it; None where there are none."""
    return next((at for at in (label_path(scan), scan.with_suffix(".label")) if at.is_file()), None)
