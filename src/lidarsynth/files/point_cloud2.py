"""`sensor_msgs/PointCloud2`, of ROS 1 and ROS 2, of any field layout: to named columns and back. Plain numpy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lidarsynth.files.fields import MAX_POINTS, Fields, FileError, check_names, rings_of_grid
from lidarsynth.files.several import numbered, several_left_out

# PointField.datatype -> numpy (ros2/common_interfaces, sensor_msgs/msg/PointField.msg)
TYPES: dict[int, str] = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
DATATYPE_OF: dict[str, int] = {kind: number for number, kind in TYPES.items()}


class PointField(Protocol):
    """One field of a message: `count` numbers of `datatype` (a key of TYPES), `offset` bytes into each point."""

    name: str
    offset: int
    datatype: int
    count: int


class PointCloud2(Protocol):
    """What the decoder reads of a message; `data` is anything with a buffer."""

    height: int
    width: int
    fields: Sequence[PointField]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: np.ndarray


@dataclass(frozen=True)
class Layout:
    """The fields (name, offset, datatype) of packed points, the bytes per point, and the points' bytes."""

    fields: list[tuple[str, int, int]]
    point_step: int
    data: np.ndarray


def decode(message: PointCloud2) -> Fields:
    """The fields under their own names, each (N,) in the machine's byte order, N = height * width; of several numbers
    each under its own (`several.numbered`), but for those that `fields_left_out` tells.

    Padding between fields, points and rows is skipped. Rows or columns of an organised cloud that are beams become
    `ring`. Raises FileError where layout and data do not fit.
    """
    table = _table(message)
    fields = {name: np.ascontiguousarray(table[name].astype(table[name].dtype.newbyteorder("=")))
              for name in table.dtype.names or ()}  # fmt: skip
    shape = (int(message.height), int(message.width))
    if shape[0] > 1 and (ring := rings_of_grid(fields, shape)) is not None:
        fields["ring"] = ring.astype(np.uint16)  # a type of messages; there are 256 at most
    return fields


def fields_left_out(fields: Sequence[PointField]) -> str | None:
    """What is said of fields of too many numbers to keep, in one line, or None."""
    return several_left_out(*_told(fields))


def _told(fields: Sequence[PointField]) -> tuple[list[str], list[int]]:
    """Names, and how many numbers each has: a count of 0 is taken for 1, as drivers do."""
    return [field.name for field in fields], [max(int(field.count), 1) for field in fields]


def _table(message: PointCloud2) -> np.ndarray:
    """(N,) structured view of the message's points."""
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    if not 0 <= height * width <= MAX_POINTS:
        raise FileError(f"expected at most {MAX_POINTS} points of one turn, found {height} x {width}")
    dtype = _dtype(message.fields, step, ">" if message.is_bigendian else "<")
    data = np.frombuffer(message.data, np.uint8)
    stride = int(message.row_step) or width * step  # some drivers leave it 0
    if stride < width * step:
        raise FileError(f"expected row_step of at least {width} points x {step} bytes, found {stride}")
    need = (height - 1) * stride + width * step
    if len(data) < need:
        raise FileError(f"expected {need} bytes for {height} x {width} points of {step} bytes, found {len(data)}")
    if stride == width * step:
        return np.frombuffer(data, dtype, height * width)
    padded = np.zeros(height * stride, np.uint8)
    padded[: min(len(data), height * stride)] = data[: height * stride]
    rows = np.ascontiguousarray(padded.reshape(height, stride)[:, : width * step])
    return np.frombuffer(rows.reshape(-1), dtype)


def _dtype(fields: Sequence[PointField], step: int, order: str) -> np.dtype:
    names, formats, offsets = [], [], []
    check_names([field.name for field in fields if field.count <= 1])
    for field, own in zip(fields, numbered(*_told(fields)), strict=True):
        if field.datatype not in TYPES:
            raise FileError(f"expected a datatype of 1-8 for the field {field.name}, found {field.datatype}")
        kind = np.dtype(order + TYPES[field.datatype])
        if field.offset + kind.itemsize * max(int(field.count), 1) > step:
            raise FileError(f"expected the field {field.name} within the {step} bytes of a point, "
                            f"found it at {field.offset}")  # fmt: skip
        names += own
        formats += [kind] * len(own)
        offsets += [int(field.offset) + kind.itemsize * i for i in range(len(own))]
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})


def encode(fields: Mapping[str, np.ndarray]) -> Layout:
    """Columns (N,) of one length as packed little-endian points; types that the message lacks become float64."""
    columns = {name: _storable(column) for name, column in fields.items()}
    kinds = [column.dtype.newbyteorder("<") for column in columns.values()]
    dtype = np.dtype([(f"f{i}", kind) for i, kind in enumerate(kinds)])  # numpy gives one without a name its own
    table = np.empty(len(next(iter(columns.values()))), dtype)
    for name, column in zip(dtype.names or (), columns.values(), strict=True):
        table[name] = column
    places = np.cumsum([0, *(kind.itemsize for kind in kinds)])
    described = [(name, int(at), DATATYPE_OF[column.dtype.str[1:]])
                 for (name, column), at in zip(columns.items(), places[:-1], strict=True)]  # fmt: skip
    return Layout(described, dtype.itemsize, np.frombuffer(table.tobytes(), np.uint8))


def _storable(column: np.ndarray) -> np.ndarray:
    if column.dtype == np.bool_:
        return column.astype(np.uint8)
    return column if column.dtype.str[1:] in DATATYPE_OF else column.astype(np.float64)
