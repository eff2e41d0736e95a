"""Stanford `.ply` files: ascii, binary_little_endian and binary_big_endian, any property order."""

from __future__ import annotations

from io import BufferedIOBase
from typing import NamedTuple

import numpy as np

from lidarsynth.files.fields import MAX_POINTS, Fields, FileError, check_names, scan_table
from lidarsynth.files.whole_numbers import typed
from lidarsynth.lidar.scan import Scan

MAX_HEADER = 1 << 16
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "int64": "i8", "long": "i8", "uint64": "u8", "ulong": "u8",
}  # fmt: skip
WRITTEN = {
    "f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "u4": "uint", "u8": "uint64",
    "i1": "char", "i2": "short", "i4": "int", "i8": "int64",
}  # fmt: skip
NARROWED = {"i8": ("<i4", "<u4", "<f8"), "u8": ("<u4", "<f8")}  # the published format has no whole numbers of 64 bits


class Element(NamedTuple):
    """One element of the header; `order` has the types of its properties, two of them (length, item) for a list."""

    name: str
    count: int
    order: list[tuple[str, ...]]
    names: list[str]

    @property
    def has_list(self) -> bool:
        return any(len(types) == 2 for types in self.order)


def read_ply(data: bytes) -> Fields:
    """The scalar properties of the element `vertex`, each (N,) in the file's type, native byte order.

    Other elements are skipped, lists and all. Raises FileError when header and data do not fit.
    """
    encoding, elements, start = read_header(data)
    place = next((i for i, element in enumerate(elements) if element.name == "vertex"), None)
    if place is None:
        raise FileError(f"expected an element vertex in the PLY header, found {[e.name for e in elements][:8]}")
    vertex, before = elements[place], elements[:place]
    if vertex.has_list:
        raise FileError("expected one number per vertex property, found a list property in the element vertex")
    if not vertex.names:
        raise FileError("expected properties of the element vertex, found none")
    check_names(vertex.names)
    if encoding == "ascii":
        return _ascii(data[start:], vertex, sum(element.count for element in before))
    dtypes = {types: tuple(FORMATS[encoding] + TYPES[t] for t in types) for e in elements for types in e.order}
    for element in before:
        start = _skip(data, start, element, dtypes)
    table = np.dtype([(name, dtypes[types][0]) for name, types in zip(vertex.names, vertex.order, strict=True)])
    need = vertex.count * table.itemsize
    if len(data) - start < need:
        raise FileError(f"expected {need} bytes for {vertex.count} vertices of {table.itemsize} bytes, "
                        f"found {max(len(data) - start, 0)}")  # fmt: skip
    points = np.frombuffer(data, table, vertex.count, start)
    return {name: points[name].astype(points[name].dtype.newbyteorder("=")) for name in vertex.names}


def read_header(data: bytes) -> tuple[str, list[Element], int]:
    """Format, elements and the place of the first byte after the header. Raises FileError."""
    lines, start = _lines(data)
    encoding = ""
    elements: list[Element] = []
    for words in lines:
        if words[0] == "format" and len(words) > 1:
            encoding = words[1]
        elif words[0] == "element":
            elements.append(Element(words[1] if len(words) > 1 else "", _count(words), [], []))
        elif words[0] == "property":
            if not elements:
                raise FileError("expected an element before the first PLY property, found none")
            elements[-1].order.append(_types(words))
            elements[-1].names.append(words[-1])
    if encoding not in FORMATS:
        raise FileError(f"expected a PLY format of {', '.join(FORMATS)}, found {encoding[:40] or 'none'!r}")
    return encoding, elements, start


def _lines(data: bytes) -> tuple[list[list[str]], int]:
    """The words of each header line, comments left out, and the place of the first byte after it."""
    if data[:4].split() != [b"ply"]:
        raise FileError(f"expected a file that starts with the line ply, found {data[:12]!r}")
    lines, at = [], 0
    while (end := data.find(b"\n", at, MAX_HEADER)) >= 0:
        words = data[at:end].decode("ascii", "replace").split()
        at = end + 1
        if words == ["end_header"]:
            return lines, at
        if words and words[0] not in ("ply", "comment", "obj_info"):
            lines.append(words)
    raise FileError(
        f"expected a PLY header that ends with end_header, found none in {min(len(data), MAX_HEADER)} bytes"
    )


def _count(words: list[str]) -> int:
    count = int(words[2]) if len(words) == 3 and words[2].isdecimal() and len(words[2]) < 20 else -1
    if not 0 <= count <= MAX_POINTS:
        raise FileError(f"expected 0 to {MAX_POINTS} of each PLY element, found {' '.join(words)[:60]!r}")
    return count


def _types(words: list[str]) -> tuple[str, ...]:
    types = tuple(words[2:4] if words[1:2] == ["list"] else words[1:2])
    if len(words) != (5 if words[1:2] == ["list"] else 3) or any(t not in TYPES for t in types):
        raise FileError(f"expected property TYPE NAME or property list TYPE TYPE NAME, found {' '.join(words)[:60]!r}")
    if len(types) == 2 and TYPES[types[0]][0] == "f":
        raise FileError(f"expected a whole type for the length of a PLY list, found {types[0]}")
    return types


def _ascii(body: bytes, vertex: Element, skipped_lines: int) -> Fields:
    lines = body.split(b"\n", skipped_lines + vertex.count)[skipped_lines : skipped_lines + vertex.count]
    words = b" ".join(lines).split()
    width = len(vertex.names)
    if len(lines) < vertex.count or len(words) != vertex.count * width:
        raise FileError(f"expected {vertex.count} lines of {width} numbers, found {len(words)} numbers")
    try:
        table = np.array(words, np.bytes_).astype(np.float64).reshape(vertex.count, width)
    except ValueError as error:
        raise FileError(
            f"expected numbers in an ascii PLY, found {str(error).rpartition(':')[2].strip()[:40]}"
        ) from None
    dtypes = [np.dtype(TYPES[types[0]]) for types in vertex.order]
    columns = [_typed(column, words[i::width], t) for i, (column, t) in enumerate(zip(table.T, dtypes, strict=True))]
    return dict(zip(vertex.names, columns, strict=True))


def _typed(column: np.ndarray, words: list[bytes], dtype: np.dtype) -> np.ndarray:
    """The numbers in the type that the header declares, or as they are where it does not tell them apart."""
    if dtype == np.float64:
        return column
    if dtype == np.float32:
        with np.errstate(over="ignore"):
            single = column.astype(dtype)
        return single if len(np.unique(single)) == len(np.unique(column)) else column
    return typed(column, words, dtype)


def _skip(data: bytes, at: int, element: Element, dtypes: dict[tuple[str, ...], tuple[str, ...]]) -> int:
    """The place after all items of an element that stands before the vertices."""
    kinds = [tuple(np.dtype(t) for t in dtypes[types]) for types in element.order]
    if not element.has_list:
        return at + element.count * sum(dtype.itemsize for (dtype,) in kinds)
    for _ in range(element.count):
        for kind in kinds:
            if at + kind[0].itemsize > len(data):
                raise FileError(
                    f"expected {element.count} items of the element {element.name}, found the end of the file"
                )
            length = int(np.frombuffer(data, kind[0], 1, at)[0]) if len(kind) == 2 else 0
            if length < 0:
                raise FileError(f"expected list lengths of at least 0 in the element {element.name}, found {length}")
            at += kind[0].itemsize + (length * kind[1].itemsize if len(kind) == 2 else 0)
    return at


def write_ply(file: BufferedIOBase, scan: Scan) -> None:
    """The scan as binary PLY: x y z intensity (reflectance 0-1), and ring, timestamp, label where known.

    Whole numbers of 64 bits become int, uint or double; those that none of these holds exactly, such as times in
    nanoseconds, stay int64 or uint64, which not all readers know.
    """
    table = _narrowed(scan_table(scan))
    properties = [f"property {WRITTEN[table.dtype[name].str[1:]]} {name}" for name in table.dtype.names or ()]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment lidarsynth",
        f"element vertex {len(table)}",
        *properties,
    ]
    file.write(("\n".join(header) + "\nend_header\n").encode("ascii"))
    file.write(table.tobytes())


def _narrowed(table: np.ndarray) -> np.ndarray:
    """The table with types that every reader of PLY knows in place of whole numbers of 64 bits, where one has them."""
    return table.astype([(name, _narrow(table[name])) for name in table.dtype.names or ()])


def _narrow(column: np.ndarray) -> np.dtype:
    kinds = map(np.dtype, NARROWED.get(column.dtype.str[1:], ()))
    return next((kind for kind in kinds if _holds(kind, column)), column.dtype)


def _holds(kind: np.dtype, column: np.ndarray) -> bool:
    """Whether a type has each of these whole numbers exactly."""
    if kind.kind == "f":
        double = column.astype(kind)
        return bool((np.abs(double) < 2.0**63).all()) and bool((double.astype(column.dtype) == column).all())
    limits = np.iinfo(kind)
    return bool(((limits.min <= column) & (column <= limits.max)).all())
