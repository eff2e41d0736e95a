"""ASTM E57 files of one scan through pye57 (the extra `data`)."""

from __future__ import annotations

import struct
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from lidarsynth.files.fields import MAX_POINTS, Fields, FileError

OURS = {"cartesianX": "x", "cartesianY": "y", "cartesianZ": "z", "timeStamp": "time", "rowIndex": "row"}
INVALID = "cartesianInvalidState"


def check_header(data: bytes) -> None:
    """That the file is as long as its header says, and its XML lies within. Source: ASTM E2807. Raises FileError."""
    if data[:8] != b"ASTM-E57" or len(data) < 48:
        raise FileError(f"expected an E57 header of 48 bytes that starts with ASTM-E57, found {data[:12]!r}")
    size, place, length = struct.unpack_from("<QQQ", data, 16)
    if size != len(data) or place + length > len(data):
        raise FileError(
            f"expected an E57 file of {size} bytes with {length} bytes of XML at {place}, found {len(data)}"
        )


def read_e57(data: bytes) -> Fields:
    """The fields of the file's only scan in the scanner's own frame; invalid points are left out. Raises FileError."""
    try:
        import pye57
    except ImportError:
        raise FileError("expected pye57 to read .e57 (pip install 'lidarsynth[data]'), found none") from None
    check_header(data)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scan.e57"
        path.write_bytes(data)
        try:
            with pye57.E57(str(path)) as file:
                return _fields(file)
        except FileError:
            raise
        except Exception as error:  # of the C++ library, in classes of its own
            line = (str(error).splitlines() or [type(error).__name__])[0][:120]
            raise FileError(f"expected an E57 file, found: {line.replace(str(path), 'one that is broken')}") from None


def _fields(file) -> Fields:
    if file.scan_count != 1:
        raise FileError(f"expected an E57 file of one scan, found {file.scan_count}")
    count = file.get_header(0).point_count
    if not 1 <= count <= MAX_POINTS:
        raise FileError(f"expected 1 to {MAX_POINTS} points of one turn, found {count}")
    found = file.read_scan_raw(0)
    if "cartesianX" not in found:
        raise FileError(f"expected cartesian points, found {', '.join(found)}")
    valid = found.pop(INVALID, np.zeros(count)) == 0
    numeric = {str(name): values[valid] for name, values in found.items() if values.dtype.kind in "fiu"}
    return {OURS.get(name, name): values for name, values in numeric.items()}
