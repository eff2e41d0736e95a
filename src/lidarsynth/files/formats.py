"""Scans from and to files: `read`, `write`, chosen by the end of the name. Every failure is one line, a `FileError`."""

from __future__ import annotations

import os
import stat
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedIOBase
from pathlib import Path
from typing import Any

import numpy as np

from lidarsynth.files import arrays, e57, feather, las, pcd, ply, text
from lidarsynth.files.fields import (
    INTENSITIES,
    MAX_BYTES,
    Fields,
    FileError,
    check_length,
    check_table,
    scan_from_fields,
)
from lidarsynth.files.labels import label_path, read_labels, read_words, words_of
from lidarsynth.files.whole_numbers import stray
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.lidar.whole_file import whole_file

READERS: dict[str, Callable[[bytes], Fields]] = {
    ".bin": arrays.read_bin,
    ".pcd.bin": arrays.read_pcd_bin,
    ".npy": arrays.read_npy,
    ".npz": arrays.read_npz,
    ".pcd": pcd.read_pcd,
    ".ply": ply.read_ply,
    ".las": las.read_las,
    ".laz": las.read_las,
    ".feather": feather.read_feather,
    ".e57": e57.read_e57,
    ".csv": text.read_text,
    ".txt": text.read_text,
    ".xyz": text.read_text,
    ".asc": text.read_text,
    ".pts": text.read_text,
}
BARE = (".bin", ".npy")  # without a place for further fields
BESIDE = {"new": np.dtype("u1"), "confidence": np.dtype("<f4")}  # which get a file of their own beside those
NAMED_ONLY = (".csv", ".txt")  # in a folder they may be anything, such as KITTI's times.txt: read where they are named

WRITERS: dict[str, Callable[[BufferedIOBase, Any], None]] = {  # a Scan; .npz also takes a RangeImage
    ".bin": arrays.write_bin,
    ".npy": arrays.write_npy,
    ".npz": arrays.write_npz,
    ".pcd": pcd.write_pcd,
    ".ply": ply.write_ply,
}


def read(
    path: str | Path,
    intensity: str = "auto",
    labels: str | Path | None = None,
    rings: tuple[int, int] | None = None,
) -> Scan:
    """One LiDAR turn from a file of any kind in READERS; see `read_with_report`. Warns of what `left_out` tells."""
    scan, dropped = read_with_report(path, intensity, labels, rings=rings)
    for line in left_out(path, scan, dropped):
        warnings.warn(f"{path}: {line}", stacklevel=2)
    return scan


def read_with_report(
    path: str | Path,
    intensity: str = "auto",
    labels: str | Path | None = None,
    words: str | Path | None = None,
    rings: tuple[int, int] | None = None,
) -> tuple[Scan, int]:
    """The scan, and how many of the file's points were dropped: not finite, or (0, 0, 0) where nothing returned.

    A file that says of itself that it has no point gives a scan of none.
    intensity  the file's scale: "unit" 0-1, "byte" 0-255, "uint16" 0-65535, "auto" as the kind of file
               fixes it, else by type and range (`fields.reflectance_from`), "none" to read a file without intensity
               with reflectance 0
    labels     a SemanticKITTI `.label` file with one word per point of the file
    words      likewise, of any ids, which are kept as they are in `extra["raw_label"]`
    rings      of a file of several sensors, the first and last to read, as the file numbers them; None = all
    Of `.bin` and `.npy`, `new` and `confidence` come from the files that `write` puts beside them, where these fit;
    `marks_left_out` says where they do not.
    Ring, time and label are kept where the file has them under a usual name (`fields.NAMES`), other fields as `extra`.
    Raises FileError, a ValueError of one line "path: expected ..., found ...".
    """
    if rings is not None and not (isinstance(rings, tuple) and len(rings) == 2):
        raise ValueError(f"expected rings (first, last), found {rings!r}")
    if intensity not in INTENSITIES:
        raise ValueError(f"expected an intensity of {', '.join(INTENSITIES)}, found {intensity!r}")
    reader = READERS[_suffix(path, READERS, "read")]
    data = _bytes(path)
    with naming(path):
        fields = reader(data)
    if labels is not None:
        fields["label"] = read_labels(labels, len(next(iter(fields.values()), ())))
    if words is not None:
        fields["raw_label"] = read_words(words, len(next(iter(fields.values()), ())))
    if _is_bare(path):
        fields = _marks_beside(Path(path), len(next(iter(fields.values()), ()))) | fields
    with naming(path):
        return scan_from_fields(fields, intensity, rings)


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Puts the path before a FileError's message and keeps it on one line, whatever a file's own names hold."""
    try:
        yield
    except FileError as error:
        text = " ".join(str(error).split())
        raise FileError(f"{path}: {''.join(c if c.isprintable() else '?' for c in text)}") from None
    except MemoryError:
        raise FileError(f"{path}: expected a scan that fits in memory, found one that does not") from None


def holds_image(path: str | Path) -> bool:
    """Whether a file is an `.npz` with the arrays of a range image, by their names; damaged files hold none."""
    if no_file(path) is not None:
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return {f"{name}.npy" for name in arrays.NEEDED} <= set(archive.namelist())
    except arrays.ZIP_ERRORS:
        return False


def read_image(path: str | Path) -> RangeImage:
    """A range image that `write` saved as `.npz`: range, reflectance, mask, sensor, and what else it had of it.

    Raises FileError as `read`.
    """
    _suffix(path, {".npz": None}, "read a range image")
    data = _bytes(path)
    with naming(path):
        return arrays.image_of(arrays.unzip(data))


def sensor_in(path: str | Path) -> Sensor | None:
    """The sensor of an `.npz` that holds a range image, None of other files. Raises FileError as `read`."""
    image = Path(path).suffix.lower() == ".npz" and holds_image(path)
    return read_image(path).sensor if image else None


def write(path: str | Path, scan: Scan | RangeImage) -> None:
    """Save a scan, or a range image, by the end of the name: .bin .npy .npz .pcd .ply, float32 exactly as given.

    An image keeps its range, reflectance, mask, label, measured points and sensor in `.npz`; elsewhere it becomes
    points. `.bin` and `.npy` hold x y z reflectance only, and of a labelled scan the labels where `label_path` says; of
    a filled one `new` beside them in a `.new` file, a byte a point, and `confidence` in a `.confidence` file, a float32
    a point; such marks of another scan that would be taken for this one's are removed. The others hold ring, time,
    label and every further field too. The file appears whole or not at all: it is written beside its place, then
    renamed. Raises FileError, before anything is written, for anything else, such as an array, for numbers that would
    not come back (a ring of -1, a class of 20, text as a field), and for a `.bin` of no point: it would be a file of no
    byte, which `read` takes for one that was cut off.
    """
    path = Path(path)
    if not isinstance(scan, Scan | RangeImage):
        raise FileError(f"{path}: expected a Scan or a RangeImage, found {type(scan).__name__}")
    if path.name.lower().endswith(".pcd.bin"):
        raise FileError(f"{path}: expected a name that ends in {', '.join(WRITERS)} to write, found .pcd.bin")
    suffix = _suffix(path, WRITERS, "write")
    content = scan.to_scan() if isinstance(scan, RangeImage) and suffix != ".npz" else scan
    if path.is_dir():
        raise FileError(f"{path}: expected the name of a file to write, found a folder")
    if isinstance(content, Scan) and suffix == ".bin" and not len(content):
        raise FileError(f"{path}: expected points for .bin, whose file would be empty, found none: .npy, .npz, .pcd "
                        "and .ply say so themselves")  # fmt: skip
    with naming(path):
        _check(content, suffix)
    if isinstance(content, Scan) and suffix in BARE:  # before the file itself: where that stands, all is whole
        _without_marks(path, content)
        for name, kind in BESIDE.items():
            if name in content.extra:
                values = content.extra[name].astype(kind).tobytes()
                _put(path.with_suffix(f".{name}"), lambda file, values=values: file.write(values))
        if content.label is not None or "raw_label" in content.extra:
            labels = label_path(path)
            if labels.parent != path.parent and path.parent.is_dir():
                labels.parent.mkdir(exist_ok=True)
            write_labels(labels, content)
    _put(path, lambda file: WRITERS[suffix](file, content))


def _check(content: Scan | RangeImage, suffix: str) -> None:
    """Raises FileError for what would not come back from the file, or from those beside it."""
    if isinstance(content, RangeImage):
        return arrays.check_saved(content)
    if suffix not in BARE:
        return check_table(content, suffix)
    words_of(content)
    for name, marks in content.extra.items():
        if name not in BESIDE:
            continue
        check_length(name, marks, len(content))
        if marks.dtype.kind not in "biuf":
            raise FileError(f"expected numbers as {name}, found {marks.dtype}")
        if name == "new" and (found := stray(marks, 255)) is not None:
            raise FileError(f"expected {name} of 0 and 1, at most 255, found {found}")


def write_labels(path: str | Path, scan: Scan) -> None:
    """Save the labels of a scan as SemanticKITTI's `.label`: its `extra["raw_label"]`, or its classes' raw ids.

    Raises FileError, and ValueError of a scan without labels.
    """
    if scan.label is None and "raw_label" not in scan.extra:
        raise ValueError(f"{path}: expected a scan with labels, found one without")
    with naming(path):
        words = words_of(scan)
    assert words is not None
    _put(Path(path), lambda file: file.write(words.tobytes()))


def _put(path: Path, write_to: Callable[[BufferedIOBase], object]) -> None:
    try:
        with whole_file(path) as scratch, open(scratch, "wb") as file:
            write_to(file)
    except OSError as error:
        raise FileError(f"{path}: expected an existing, writable folder with room, found: {error.strerror}") from error


def _is_bare(path: str | Path) -> bool:
    name = Path(path).name.lower()
    return name.endswith(BARE) and not name.endswith(".pcd.bin")


def _marks_beside(path: Path, count: int) -> Fields:
    """Of a file of so many points, what `write` put beside it of a filled scan, where it has as many."""
    marks = {name: path.with_suffix(f".{name}") for name in BESIDE}  # a name may be too long for some
    fit = {n: p for n, p in marks.items() if os.path.isfile(p) and p.stat().st_size == count * BESIDE[n].itemsize > 0}
    return {name: np.fromfile(place, BESIDE[name]) for name, place in fit.items()}


def left_out(path: str | Path, scan: Scan, dropped: int) -> list[str]:
    """What is to be said of a file whose scan was read, a line each: marks beside it, and fields, that are not kept."""
    return [*marks_left_out(path, scan, dropped), *fields_left_out(path)]


def fields_left_out(path: str | Path) -> list[str]:
    """What is to be said of fields of a file that has been read which are not kept, a line each."""
    if _suffix(path, READERS, "read") != ".pcd":
        return []
    try:
        with open(path, "rb") as file:
            told = pcd.fields_left_out(file.read(pcd.MAX_HEADER))
    except (OSError, FileError):  # reading the scan says so
        return []
    return [] if told is None else [told]


def marks_left_out(path: str | Path, scan: Scan, dropped: int) -> list[str]:
    """What is to be said of marks beside a file that do not fit its scan, which lost `dropped` points, a line each."""
    lines, count = [], len(scan) + dropped
    for name, kind in BESIDE.items() if _is_bare(path) else ():
        marks = Path(path).with_suffix(f".{name}")
        if os.path.isfile(marks) and name not in scan.extra:  # those that fit are read
            lines.append(f"{marks.name} left out: expected {count * kind.itemsize} bytes for {count} points, "
                         f"found {marks.stat().st_size} bytes")  # fmt: skip
    return lines


def _without_marks(path: Path, scan: Scan) -> None:
    """Removes the marks of the points of a file that is about to be replaced, and those of one that is gone which would
    fit the scan, but for those that are written anew."""
    counts = [len(scan)]
    with suppress(OSError, FileError):  # no such file, or none of ours
        counts.append(len(next(iter(READERS[path.suffix.lower()](path.read_bytes()).values()), ())))
    for name in {name for count in counts for name in _marks_beside(path, count)} - set(scan.extra):
        path.with_suffix(f".{name}").unlink(missing_ok=True)


def _suffix(path: str | Path, known: dict, verb: str) -> str:
    """The longest key of `known` that ends the name."""
    name = Path(path).name.lower()
    if fits := [suffix for suffix in known if name.endswith(suffix)]:
        return max(fits, key=len)
    raise FileError(f"{path}: expected a name that ends in {', '.join(known)} to {verb}, found {name[-20:]!r}")


def no_file(path: str | Path) -> str | None:
    """What stands where a file is expected, in words, without opening it: a folder, a device or pipe, which may never
    end, or a link to nothing. None of a file, and where nothing stands."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return f"a link to {os.readlink(path)}, which is not there" if os.path.islink(path) else None
    except (OSError, ValueError):
        return None
    return None if stat.S_ISREG(mode) else "a folder" if stat.S_ISDIR(mode) else "a device or pipe"


def _bytes(path: str | Path) -> bytes:
    """The content of a regular file of at most MAX_BYTES."""
    try:
        if (what := no_file(path)) is not None:
            raise FileError(f"{path}: expected a file, found {what}")
        status = os.stat(path)
        if not 0 < status.st_size <= MAX_BYTES:
            raise FileError(f"{path}: expected 1 to {MAX_BYTES} bytes of one scan, found {status.st_size}")
        return Path(path).read_bytes()
    except (OSError, ValueError) as error:
        if isinstance(error, FileError):
            raise
        reason = error.strerror if isinstance(error, OSError) else error
        raise FileError(f"{path}: expected a readable file, found: {reason}") from None
