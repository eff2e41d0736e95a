"""PointCloud2 of any layout decodes to the numbers that were put in, and encoding is its inverse."""

from dataclasses import dataclass

import numpy as np
import pytest

from lidarsynth.files.fields import FileError, scan_from_fields
from lidarsynth.files.point_cloud2 import DATATYPE_OF, decode, encode


@dataclass
class Field:
    name: str
    offset: int
    datatype: int
    count: int = 1


@dataclass
class Message:
    fields: list[Field]
    point_step: int
    data: np.ndarray
    width: int
    height: int = 1
    is_bigendian: bool = False
    row_step: int = 0


XYZ = {"x": "f4", "y": "f4", "z": "f4"}
LAYOUTS = {  # numpy type of each field, where it stands, and the bytes of a point, as drivers write them
    "velodyne": (XYZ | {"intensity": "f4", "ring": "u2", "time": "f4"}, (0, 4, 8, 16, 20, 24), 32),
    "hesai": (XYZ | {"intensity": "f4", "ring": "u2", "timestamp": "f8"}, (0, 4, 8, 12, 16, 18), 26),
    "ouster": (XYZ | {"t": "u4", "reflectivity": "u2", "channel": "u1"}, (0, 4, 8, 20, 24, 26), 48),
    "livox": (XYZ | {"intensity": "f4", "tag": "u1", "line": "u1", "timestamp": "f8"}, (0, 4, 8, 12, 16, 17, 18), 26),
    "doubles": ({"z": "f8", "y": "f8", "x": "f8", "intensity": "u1"}, (16, 8, 0, 24), 25),
}


def columns(kinds: dict[str, str], n: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {name: (rng.random(n) * 100 + 1).astype(kind) for name, kind in kinds.items()}


def packed(values: dict[str, np.ndarray], offsets: tuple[int, ...], step: int, order: str) -> Message:
    dtype = np.dtype({"names": list(values), "formats": [order + v.dtype.str[1:] for v in values.values()],
                      "offsets": list(offsets), "itemsize": step})  # fmt: skip
    n = len(next(iter(values.values())))
    table = np.frombuffer(np.random.default_rng(1).bytes(n * step), dtype).copy()  # padding is not zero
    for name, column in values.items():
        table[name] = column
    described = [Field(n, at, DATATYPE_OF[v.dtype.str[1:]]) for (n, v), at in zip(values.items(), offsets, strict=True)]
    return Message(described, step, np.frombuffer(table.tobytes(), np.uint8), n, is_bigendian=order == ">")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_decodes_to_its_numbers(name: str, order: str):
    kinds, offsets, step = LAYOUTS[name]
    values = columns(kinds, 50)
    found = decode(packed(values, offsets, step, order))
    assert found.keys() == values.keys()
    for key, column in values.items():
        np.testing.assert_array_equal(found[key], column)
        assert found[key].dtype == column.dtype and found[key].dtype.isnative


def test_rows_with_padding_and_fields_of_several_numbers():
    values = columns({"x": "f4", "y": "f4", "z": "f4"}, 12)
    message = packed(values, (0, 4, 8), 16, "<")
    rows = message.data.reshape(3, 4 * 16)
    message.data = np.concatenate([np.pad(row, (0, 7), constant_values=9) for row in rows])
    message.height, message.width, message.row_step = 3, 4, 4 * 16 + 7
    message.fields += [Field("normal", 4, DATATYPE_OF["f4"], count=3), Field("_", 0, DATATYPE_OF["u1"], count=4)]
    found = decode(message)
    assert list(found) == [*values, "normal_0", "normal_1", "normal_2"]
    np.testing.assert_array_equal(found["z"], values["z"])
    np.testing.assert_array_equal(found["normal_1"], values["z"])
    message.fields[-1].name = "normal_2"  # which is a field of its own
    message.fields[-1].count = 0
    assert list(decode(message))[3:] == ["normal_0", "normal_1", "normal_2_2", "normal_2"]


def test_rows_of_an_organised_cloud_become_rings():
    angle = np.radians(np.linspace(10, -20, 16))[:, None] * np.ones((1, 90))
    turn = np.linspace(-np.pi, np.pi, 90, endpoint=False)[None] * np.ones((16, 1))
    values = {"x": np.cos(turn).ravel() * 9, "y": np.sin(turn).ravel() * 9, "z": (np.tan(angle) * 9).ravel()}
    message = packed({k: v.astype("f4") for k, v in values.items()}, (0, 4, 8), 12, "<")
    message.height, message.width = 16, 90
    np.testing.assert_array_equal(decode(message)["ring"], np.repeat(np.arange(16), 90))
    assert DATATYPE_OF[decode(message)["ring"].dtype.str[1:]] == 4, "uint16, as drivers have it: it is written back"


def test_encoding_is_the_inverse():
    values = columns({"x": "f4", "y": "f4", "z": "f4", "ring": "u2", "time": "f8", "new": "u1", "": "f4"}, 20)
    values["flag"] = np.arange(20) % 2 == 0
    layout = encode(values)
    message = Message([Field(*place) for place in layout.fields], layout.point_step, layout.data, 20)
    for key, column in decode(message).items():
        np.testing.assert_array_equal(column, values[key])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"width": 51}, "expected 1632 bytes"),
        ({"width": 10**7 + 1}, "at most 10000000 points"),
        ({"point_step": 10}, "within the 10 bytes"),
        ({"row_step": 100}, "row_step"),
    ],
)
def test_lying_messages_are_one_line(change: dict, words: str):
    message = packed(columns(LAYOUTS["velodyne"][0], 50), *LAYOUTS["velodyne"][1:], "<")
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(FileError, match=words):
        decode(message)
    message.fields[0].datatype = 9
    with pytest.raises(FileError, match=r"datatype of 1-8|expected"):
        decode(message)


def test_times_of_the_drivers_become_seconds():
    base = {"x": np.ones(3), "y": np.ones(3), "z": np.ones(3), "intensity": np.ones(3)}
    for name, values in {
        "t": np.array([0, 50_000_000, 100_000_000], np.uint32),  # Ouster, nanoseconds
        "time": np.array([0, 0.05, 0.1], np.float32),
        "timestamp": np.array([1.7e18, 1.7e18 + 5e7, 1.7e18 + 1e8]),  # Livox, nanoseconds since 1970
        "offset_time": np.array([0, 50_000_000, 100_000_000], np.uint32),
        "time_stamp": np.array([0, 50_000_000, 100_000_000], np.uint32),  # Autoware's PointXYZIRCAEDT
        "GpsTime": 3e8 + np.array([0, 0.05, 0.1]),  # PDAL
    }.items():
        scan, _ = scan_from_fields({**base, name: values})
        assert scan.time is not None
        np.testing.assert_allclose(scan.time - scan.time[0], [0, 0.05, 0.1], atol=1e-6)


def test_offset_times_are_nanoseconds_only_where_a_turn_may_last_as_long():
    base = {axis: np.ones(3) for axis in "xyzi"}
    for values in (
        np.array([0, 50, 99.9], np.float32),  # milliseconds
        np.array([0, 50_000, 99_900], np.uint32),  # microseconds
        np.array([0, 0.05, 0.0999]),  # seconds
        np.array([0, 5e7, 9.99e7]),  # nanoseconds, in floats
        np.array([0, 50_000_000, 99_900_000], np.uint32),
        1_700_000_000_000_000_000 + np.array([0, 50_000_000, 99_900_000]),
    ):
        scan, _ = scan_from_fields({**base, "offset_time": values})
        assert scan.time is not None
        np.testing.assert_allclose(scan.time, [0, 0.05, 0.0999], atol=1e-6)
    scan, _ = scan_from_fields({**base, "offset_ns": np.array([0, 50_000, 99_900], np.int32)})  # its name says so
    np.testing.assert_allclose(scan.time, [0, 5e-5, 9.99e-5], atol=1e-9)
    empty, _ = scan_from_fields({name: np.zeros(0, np.float32) for name in (*base, "offset_time")})
    assert empty.time is not None and not len(empty.time)


def test_further_fields_stay_with_their_points():
    keep = {"ambient": np.array([1, 2, 3], np.uint16), "label": np.array([70, 71, 72])}
    fields = {"x": np.array([1.0, np.nan, 3]), "y": np.ones(3), "z": np.ones(3), "i": np.ones(3), **keep}
    scan, dropped = scan_from_fields(fields)
    assert dropped == 1 and scan.label is None  # not training classes: kept as they are
    np.testing.assert_array_equal(scan.extra["ambient"], [1, 3])
    np.testing.assert_array_equal(scan.extra["label"], [70, 72])
    np.testing.assert_array_equal(scan[[1]].extra["ambient"], [3])
