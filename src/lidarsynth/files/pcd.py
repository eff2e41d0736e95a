"""Point Cloud Library `.pcd` files, versions 0.5 to 0.7: ascii, binary and binary_compressed."""

from __future__ import annotations

from collections.abc import Callable
from io import BufferedIOBase
from typing import NamedTuple

import numpy as np

from lidarsynth.files.fields import MAX_BYTES, MAX_POINTS, Fields, FileError, check_names, rings_of_grid, scan_table
from lidarsynth.files.lzf import decompress
from lidarsynth.files.several import PADDING, numbered, several_left_out
from lidarsynth.files.whole_numbers import typed
from lidarsynth.lidar.scan import Scan

MAX_HEADER = 1 << 16
SAME = 1e-4  # metres, radians: a sensor so near is at the origin
TYPES = {"F4": "<f4", "F8": "<f8"} | {f"{t}{n}": f"<{t.lower()}{n}" for t in "IU" for n in (1, 2, 4, 8)}


class Header(NamedTuple):
    """What stands before the points: names, types and counts of the fields, size, encoding, where the data starts."""

    names: list[str]
    types: list[np.dtype]
    counts: list[int]
    points: int
    rows: int
    encoding: str
    start: int

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of an organised cloud."""
        return self.rows, self.points // self.rows

    @property
    def stride(self) -> int:
        """Bytes per point."""
        return sum(dtype.itemsize * count for dtype, count in zip(self.types, self.counts, strict=True))


def read_pcd(data: bytes) -> Fields:
    """The fields of a PCD file under their own names, each (N,) in the file's type; of COUNT > 1 each number under its
    own (`several.numbered`), but for those that `fields_left_out` tells. Padding is skipped.

    Organised clouds are flattened row by row; rows that are beams become the field `ring`. Points stay in the file's
    frame, whatever its VIEWPOINT. Raises FileError when header and data do not fit.
    """
    header = read_header(data)
    columns = DECODERS[header.encoding](data[header.start :], header)
    check_names([n for n, count in zip(header.names, header.counts, strict=True) if count == 1 and n != PADDING])
    fields: Fields = {}
    for names, column in zip(_kept(header), columns, strict=True):
        fields |= zip(names, column.T, strict=True) if names else {}
    if header.rows > 1 and (ring := rings_of_grid(fields, header.shape)) is not None:
        fields["ring"] = ring
    return fields


def fields_left_out(data: bytes) -> str | None:
    """What is said of fields of too many numbers to keep, in one line, or None. Raises FileError as `read_header`."""
    header = read_header(data)
    return several_left_out(header.names, header.counts)


def _kept(header: Header) -> list[list[str]]:
    """The names of each field's numbers that are read, none of padding."""
    found = numbered(header.names, header.counts)
    return [[] if name == PADDING else names for name, names in zip(header.names, found, strict=True)]


def viewpoint(data: bytes) -> np.ndarray | None:
    """(4, 4) from the sensor's frame into the one that VIEWPOINT tells its place in (x y z, then a quaternion w x y z),
    or None where that is the origin, or no place.

    The format does not say in which of the two frames the points are: PCL's viewer turns them by it, its normals take
    them as they are. So `read_pcd` does. Raises FileError where there is no header.
    """
    words = _entries(data)[0].get("VIEWPOINT", [])
    try:
        place = np.array(words, np.float64)
    except ValueError:
        return None
    if place.shape != (7,) or not np.isfinite(place).all() or not place[3:].any():
        return None
    turn = place[3:] / np.abs(place[3:]).max()
    w, x, y, z = turn / np.linalg.norm(turn)
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = place[:3]
    return None if np.allclose(matrix, np.eye(4), atol=SAME) else matrix


def read_header(data: bytes) -> Header:
    """The header, every number checked against the others. Raises FileError."""
    entries, start = _entries(data)
    for key in ("FIELDS", "SIZE", "TYPE"):
        if key not in entries:
            raise FileError(f"expected a {key} line in the PCD header, found {', '.join(entries)}")
    names, sizes, types = entries["FIELDS"], entries["SIZE"], entries["TYPE"]
    counts = _whole(entries, "COUNT") if "COUNT" in entries else [1] * len(names)
    if not len(names) == len(sizes) == len(types) == len(counts):
        raise FileError(f"expected SIZE, TYPE and COUNT for each of {len(names)} PCD fields, "
                        f"found {len(sizes)}, {len(types)} and {len(counts)}")  # fmt: skip
    if unknown := [t + s for t, s in zip(types, sizes, strict=True) if t + s not in TYPES]:
        raise FileError(f"expected PCD types of F4, F8, I1-I8 or U1-U8, found {unknown[0][:20]}")
    if not all(1 <= count <= 4096 for count in counts):
        raise FileError(f"expected PCD counts of 1-4096, found {min(counts) if min(counts) < 1 else max(counts)}")
    encoding = " ".join(entries["DATA"]).lower()
    if encoding not in DECODERS:
        raise FileError(f"expected DATA of {', '.join(DECODERS)}, found {encoding[:40]!r}")
    dtypes = [np.dtype(TYPES[t + s]) for t, s in zip(types, sizes, strict=True)]
    points, rows = _points(entries)
    return Header(names, dtypes, counts, points, rows, encoding, start)


def _entries(data: bytes) -> tuple[dict[str, list[str]], int]:
    """Key -> words of each header line up to DATA, and the place of the first byte after it."""
    entries: dict[str, list[str]] = {}
    at = 0
    while at < min(len(data), MAX_HEADER):
        end = data.find(b"\n", at, MAX_HEADER)
        if end < 0:
            break
        words = data[at:end].decode("ascii", "replace").split("#")[0].split()
        at = end + 1
        if words:
            entries[words[0].upper()] = words[1:]
            if words[0].upper() == "DATA":
                return entries, at
    raise FileError(
        f"expected a PCD header that ends with a DATA line, found none in {min(len(data), MAX_HEADER)} bytes"
    )


def _whole(entries: dict[str, list[str]], key: str) -> list[int]:
    try:
        return [int(word[:20]) for word in entries[key]]
    except ValueError:
        raise FileError(f"expected whole numbers after {key}, found {' '.join(entries[key])[:40]!r}") from None


def _points(entries: dict[str, list[str]]) -> tuple[int, int]:
    """The number of points and of rows."""
    sizes = {}
    for key in ("WIDTH", "HEIGHT", "POINTS"):
        if key in entries:
            numbers = _whole(entries, key)
            if len(numbers) != 1 or numbers[0] < 0:
                raise FileError(f"expected one number of at least 0 after {key}, found {entries[key][:4]}")
            sizes[key] = numbers[0]
    if "POINTS" not in sizes and "WIDTH" not in sizes:
        raise FileError(f"expected a POINTS or WIDTH line in the PCD header, found {', '.join(entries)}")
    points = sizes.get("POINTS", sizes.get("WIDTH", 0) * sizes.get("HEIGHT", 1))
    if "WIDTH" in sizes and sizes["WIDTH"] * sizes.get("HEIGHT", 1) != points:
        raise FileError(f"expected WIDTH x HEIGHT = POINTS, found {sizes['WIDTH']} x {sizes.get('HEIGHT', 1)} "
                        f"and {points}")  # fmt: skip
    if points > MAX_POINTS:
        raise FileError(f"expected at most {MAX_POINTS} points of one turn, found {points} in the PCD header")
    return points, max(sizes.get("HEIGHT", 1), 1)


def _ascii(body: bytes, header: Header) -> list[np.ndarray]:
    """(N, COUNT) of each field, as those below; only fields that are kept get their type."""
    width = sum(header.counts)
    words = body.split(maxsplit=header.points * width)
    if len(words) < header.points * width or len(words) > header.points * width:
        found = f"{len(words)} numbers" if len(words) < header.points * width else "more"
        raise FileError(f"expected {header.points} lines of {width} numbers, found {found}")
    try:
        table = np.array(words, dtype=np.bytes_).astype(np.float64).reshape(header.points, width)
    except ValueError as error:
        raise FileError(f"expected numbers in an ascii PCD, found {_tail(error)}") from None
    starts = np.cumsum([0, *header.counts[:-1]]).tolist()
    columns = []
    for at, count, dtype, kept in zip(starts, header.counts, header.types, _kept(header), strict=True):
        column = table[:, at : at + count]
        if kept and dtype.kind != "f":
            own = [word for first in range(at, len(words), width) for word in words[first : first + count]]
            column = typed(column.reshape(-1), own, dtype).reshape(column.shape)
        columns.append(column)
    return columns


def _tail(error: Exception) -> str:
    return str(error).replace("\n", " ").rpartition(":")[2].strip()[:40]


def _binary(body: bytes, header: Header) -> list[np.ndarray]:
    need = header.points * header.stride
    if not need <= len(body) < need + max(header.stride, 16):
        raise FileError(f"expected {need} bytes for {header.points} points of {header.stride} bytes, found {len(body)}")
    table = np.frombuffer(body, np.uint8, need).reshape(header.points, header.stride)
    columns, at = [], 0
    for dtype, count in zip(header.types, header.counts, strict=True):
        column = np.ascontiguousarray(table[:, at : at + dtype.itemsize * count])
        columns.append(column.reshape(-1).view(dtype).reshape(header.points, count))
        at += dtype.itemsize * count
    return columns


def _compressed(body: bytes, header: Header) -> list[np.ndarray]:
    if len(body) < 8:
        raise FileError(f"expected 8 bytes of compressed and full size, found {len(body)}")
    packed, full = (int(size) for size in np.frombuffer(body, "<u4", 2))
    need = header.points * header.stride
    if full != need or full > MAX_BYTES:
        raise FileError(
            f"expected {need} bytes for {header.points} points of {header.stride} bytes, found {full} packed"
        )
    if packed > len(body) - 8:
        raise FileError(f"expected {packed} compressed bytes, found {len(body) - 8}")
    block = decompress(body[8 : 8 + packed], full)
    columns, at = [], 0
    for dtype, count in zip(header.types, header.counts, strict=True):  # field after field, not point after point
        columns.append(np.frombuffer(block, dtype, header.points * count, at).reshape(header.points, count))
        at += dtype.itemsize * header.points * count
    return columns


DECODERS: dict[str, Callable[[bytes, Header], list[np.ndarray]]] = {
    "ascii": _ascii,
    "binary": _binary,
    "binary_compressed": _compressed,
}


def write_pcd(file: BufferedIOBase, scan: Scan) -> None:
    """The scan as a binary PCD 0.7: x y z intensity (reflectance 0-1), and ring, timestamp, label where known."""
    write_table(file, scan_table(scan))


def write_table(file: BufferedIOBase, table: np.ndarray) -> None:
    """A structured array (N,) as a binary PCD 0.7, its fields under their own names."""
    kinds = [(table.dtype[name].kind.upper(), table.dtype[name].itemsize) for name in table.dtype.names or ()]
    n = len(table)
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(table.dtype.names or ())}",
        f"SIZE {' '.join(str(size) for _, size in kinds)}",
        f"TYPE {' '.join(kind for kind, _ in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n",
    ]
    file.write("\n".join(header).encode("ascii"))
    file.write(table.tobytes())
