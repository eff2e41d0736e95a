"""ASPRS `.las` and `.laz` files through laspy (the extra `data`)."""

from __future__ import annotations

import struct
from io import BytesIO

import numpy as np

from lidarsynth.files.fields import MAX_POINTS, NAMES, Fields, FileError

MAX_RATIO = 100  # LAZ packs real points 5 to 20 times


def check_header(data: bytes) -> None:
    """The numbers laspy would believe and loop over: records, points and places against the size of the file.

    Source: LAS 1.4 specification, public header block. Raises FileError.
    """
    if data[:4] != b"LASF" or len(data) < 227:
        raise FileError(f"expected a LAS header of at least 227 bytes that starts with LASF, found {data[:12]!r}")
    header, start, records = struct.unpack_from("<HII", data, 94)
    kind, size, count = struct.unpack_from("<BHI", data, 104)
    if data[25] >= 4 and len(data) >= 375:
        place, extended, count = struct.unpack_from("<QIQ", data, 235)
        if extended and place + 60 * extended > len(data):
            raise FileError(f"expected {extended} extended records within {len(data)} bytes, found them at {place}")
    if not 227 <= header <= header + 54 * records <= start <= len(data):
        raise FileError(f"expected a LAS header of {header} bytes, {records} records, then points at {start}, "
                        f"found {len(data)} bytes")  # fmt: skip
    if kind & 0xC0:
        _check_chunks(data, start, count)
        _check_items(data, header, records, size)
    room = (len(data) - start) * (MAX_RATIO if kind & 0xC0 else 1)  # the two high bits mark LAZ
    if count > MAX_POINTS or count * size > room:
        raise FileError(
            f"expected {count} points of {size} bytes in a LAS file, found {len(data) - start} bytes of points"
        )


def _check_chunks(data: bytes, start: int, count: int) -> None:
    """A LAZ file's table of chunks: its place stands before the points, its length in its second word. The
    decoder reserves memory for that many chunks, and ends the whole program when there is not enough."""
    place = struct.unpack_from("<q", data, start)[0] if len(data) >= start + 8 else -1
    if place == -1 and len(data) >= start + 16:  # written by a program that could not go back
        place = struct.unpack_from("<q", data, len(data) - 8)[0]
    if not start + 8 <= place <= len(data) - 8:
        raise FileError(f"expected a LAZ chunk table between {start + 8} and {len(data) - 8}, found it at {place}")
    chunks = struct.unpack_from("<I", data, place + 4)[0]
    if chunks > max(count, 1):  # of no points there is one
        raise FileError(f"expected at most one LAZ chunk for each of {count} points, found {chunks}")


def _check_items(data: bytes, at: int, records: int, size: int) -> None:
    """The parts of a point that the record `laszip encoded` lists must fill its `size` bytes, or the decoder panics."""
    items = []
    for _ in range(records):
        name, length = data[at + 2 : at + 18].rstrip(b"\0"), int.from_bytes(data[at + 20 : at + 22], "little")
        if name == b"laszip encoded" and length >= 34:
            last = min(int.from_bytes(data[at + 86 : at + 88], "little"), 64)
            items = [int.from_bytes(data[at + 90 + 6 * i : at + 92 + 6 * i], "little") for i in range(last)]
        at += 54 + length
    if sum(items) != size:
        raise FileError(f"expected LAZ items that fill {size} bytes a point, found {items[:8]}")


def read_las(data: bytes) -> Fields:
    """x, y, z in metres, intensity, every extra dimension, and every one of the format's that is not 0 everywhere.

    Raises FileError for anything laspy cannot read, and where laspy is missing, naming the extra that brings it.
    """
    try:
        import laspy
    except ImportError:
        raise FileError("expected laspy to read .las/.laz (pip install 'lidarsynth[data]'), found none") from None
    check_header(data)
    try:
        with laspy.open(BytesIO(data), laz_backend=laspy.LazBackend.Lazrs) as reader:
            points = reader.read()
            usual = {name for names in NAMES.values() for name in names}
            told = [n for n in points.point_format.dimension_names if n in usual]
            added = [n for n in points.point_format.extra_dimension_names if n not in told]
            columns = {name: np.asarray(points[name]) for name in ("x", "y", "z", *told, *added)}
            own = [n for n in points.point_format.standard_dimension_names if n not in ("X", "Y", "Z", *told)]
            columns |= {name: column for name in own if (column := np.asarray(points[name])).any()}
            return {name: column for name, column in columns.items() if column.ndim == 1}
    except FileError:
        raise
    except BaseException as error:  # laspy and its Rust decoder raise a dozen types on broken files
        if isinstance(error, (KeyboardInterrupt, SystemExit)):
            raise
        reason = (str(error).splitlines() or [""])[0][:120] or type(error).__name__
        raise FileError(f"expected a LAS file laspy can read, found: {reason}") from None
