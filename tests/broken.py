"""Broken scan files, one function each: `BROKEN[name](folder)` writes the file into the folder and returns its path.

No reader may meet one with anything but one line that says what was expected and what was found.
"""

from __future__ import annotations

import io
import os
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

Maker = Callable[[Path], Path]


def points(n: int = 50, columns: int = 4) -> np.ndarray:
    """(n, columns) float32: x y z in metres, then values in [0, 1]."""
    table = np.random.default_rng(0).uniform(0, 1, (n, columns)).astype(np.float32)
    table[:, :3] = table[:, :3] * 40 - 20
    return table


def _bytes(name: str, data: bytes) -> Maker:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(data)
        return folder / name

    return make


def _with(row: int | None, column: int, value: float) -> bytes:
    """Good points but for one value, or one column (row None)."""
    table = points()
    table[slice(None) if row is None else row, column] = value
    return table.tobytes()


def _npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def _npy_header(text: str, body: bytes = b"", version: int = 1) -> bytes:
    header = text.encode("latin1") + b"\n"
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H" if version == 1 else "<I", len(header)) + header + body


def _npy_shape(shape: str) -> bytes:
    return _npy_header(f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}", bytes(160))


def _npz(**arrays: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def _zip(members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return file.getvalue()


def _pcd(body: bytes, encoding: str = "binary", **changed: str | None) -> bytes:
    """A PCD of 50 points x y z intensity; `changed` replaces header lines, None leaves one out."""
    header: dict[str, str | None] = {
        "VERSION": "0.7", "FIELDS": "x y z intensity", "SIZE": "4 4 4 4", "TYPE": "F F F F", "COUNT": "1 1 1 1",
        "WIDTH": "50", "HEIGHT": "1", "POINTS": "50", "DATA": encoding,
    }  # fmt: skip
    lines = [f"{key} {value}\n" for key, value in (header | changed).items() if value is not None]
    return "".join(lines).encode() + body


BODY = points().tobytes()
XYZI = "property float x\nproperty float y\nproperty float z\nproperty float intensity\n"


def _ply(
    body: bytes = BODY, encoding: str = "binary_little_endian", count: str = "50", properties: str = XYZI
) -> bytes:
    header = f"ply\nformat {encoding} 1.0\nelement vertex {count}\n{properties}end_header\n"
    return header.encode() + body


def _packed(packed: int, full: int, body: bytes) -> bytes:
    return _pcd(struct.pack("<II", packed, full) + body, "binary_compressed")


def _image(**changed: np.ndarray) -> bytes:
    sensor = '{"name": "s", "elevations": [1.0, -1.0], "width": 4}'
    arrays = {
        "range": np.ones((2, 4), np.float32),
        "reflectance": np.ones((2, 4), np.float32),
        "mask": np.ones((2, 4), bool),
        "sensor": np.array(sensor),
    }
    return _npz(**(arrays | changed))


def _las(records: int = 0, count: int = 10, kind: int = 0, body: bytes = bytes(200)) -> bytes:
    """A LAS 1.2 header of 227 bytes for points of 20 bytes, then the body."""
    header = bytearray(227)
    header[:4], header[24:26] = b"LASF", b"\x01\x02"
    struct.pack_into("<HII", header, 94, 227, 227, records)
    struct.pack_into("<BHI", header, 104, kind, 20, count)
    return bytes(header) + body


def _folder(folder: Path) -> Path:
    (folder / "folder.bin").mkdir()
    return folder / "folder.bin"


def _missing(folder: Path) -> Path:
    return folder / "missing.pcd"


def _parent_is_file(folder: Path) -> Path:
    (folder / "file").write_bytes(b"x")
    return folder / "file" / "scan.bin"


def _link_to_nothing(folder: Path) -> Path:
    (folder / "link.ply").symlink_to(folder / "gone.ply")
    return folder / "link.ply"


def _link_to_itself(folder: Path) -> Path:
    (folder / "loop.npy").symlink_to(folder / "loop.npy")
    return folder / "loop.npy"


def _pipe(folder: Path) -> Path:
    os.mkfifo(folder / "pipe.bin")
    return folder / "pipe.bin"


def _device(folder: Path) -> Path:
    (folder / "zero.bin").symlink_to("/dev/zero")
    return folder / "zero.bin"


def _huge(folder: Path) -> Path:
    with open(folder / "huge.bin", "wb") as file:
        file.truncate(1 << 40)  # a sparse file: a terabyte that takes no room
    return folder / "huge.bin"


def _bomb(folder: Path) -> Path:
    """128 MiB of zeros in 128 KiB, behind a header that says ten points."""
    member = _npy_shape("(10, 4)")[:-160] + bytes(1 << 27)
    (folder / "bomb.npz").write_bytes(_zip({"points.npy": member}, zipfile.ZIP_DEFLATED))
    return folder / "bomb.npz"


def _ascii(rows: int = 50) -> bytes:
    return "".join(" ".join(f"{v:.3f}" for v in row) + "\n" for row in points(rows)).encode()


BROKEN: dict[str, Maker] = {
    # what is not a file
    "missing": _missing,
    "folder": _folder,
    "parent is a file": _parent_is_file,
    "link to nothing": _link_to_nothing,
    "link to itself": _link_to_itself,
    "named pipe": _pipe,
    "endless device": _device,
    "a terabyte": _huge,
    "unknown suffix": _bytes("scan.foo", BODY),
    "no suffix": _bytes("scan", BODY),
    # bin
    "bin empty": _bytes("empty.bin", b""),
    "bin truncated": _bytes("cut.bin", BODY[:-3]),
    "bin text": _bytes("text.bin", b"1.0 2.0 3.0 0.5\n" * 50),
    "bin with three floats": _bytes("three.bin", (points(48, 3) - 50).astype(np.float32).tobytes()),
    "bin with five floats": _bytes("five.bin", (points(48, 5) * [1, 1, 1, 255, 31]).astype(np.float32).tobytes()),
    "bin all NaN": _bytes("nan.bin", _with(None, 0, np.nan)),
    "bin all infinite": _bytes("inf.bin", _with(None, 0, np.inf)),
    "bin all zero": _bytes("zero.bin", bytes(1600)),
    "bin beyond 10 km": _bytes("far.bin", _with(7, 0, 2e4)),
    "bin of noise": _bytes("noise.bin", np.random.default_rng(1).bytes(1600)),
    "bin negative intensity": _bytes("negative.bin", _with(7, 3, -0.5)),
    "bin intensity too large": _bytes("bright.bin", _with(7, 3, 7e4)),
    "pcd.bin truncated": _bytes("cut.pcd.bin", points(50, 5).tobytes()[:-4]),
    "pcd.bin of four floats": _bytes("four.pcd.bin", BODY),
    "pcd.bin text": _bytes("text.pcd.bin", b"# .PCD v0.7 - Point Cloud Data\n" * 20),
    "pcd.bin ring of NaN": _bytes("nan.pcd.bin", (points(50, 5) * np.float32([1, 1, 1, 1, np.nan])).tobytes()),
    # npy
    "npy empty": _bytes("empty.npy", b""),
    "npy text": _bytes("text.npy", b"x,y,z,intensity\n1,2,3,4\n"),
    "npy magic only": _bytes("magic.npy", b"\x93NUMPY"),
    "npy truncated header": _bytes("header.npy", _npy(points())[:40]),
    "npy truncated": _bytes("cut.npy", _npy(points())[:-5]),
    "npy pickled objects": _bytes("pickle.npy", _npy(np.array([{"x": 1}, None], dtype=object))),
    "npy one-dimensional": _bytes("flat.npy", _npy(np.arange(200, dtype=np.float32))),
    "npy two columns": _bytes("pairs.npy", _npy(points()[:, :2])),
    "npy an image": _bytes("image.npy", _npy(np.ones((64, 1024), np.float32))),
    "npy three-dimensional": _bytes("cube.npy", _npy(np.ones((2, 64, 2), np.float32))),
    "npy without intensity": _bytes("xyz.npy", _npy(points()[:, :3].copy())),
    "npy complex": _bytes("complex.npy", _npy(points().astype(np.complex64))),
    "npy strings": _bytes("strings.npy", _npy(points().astype("U8"))),
    "npy lying shape": _bytes("lie.npy", _npy_shape("(1000000000000, 4)")),
    "npy negative shape": _bytes("minus.npy", _npy_shape("(-10, 4)")),
    "npy shape that overflows": _bytes("overflow.npy", _npy_shape("(4294967296, 4294967296, 4)")),
    "npy header that is code": _bytes("code.npy", _npy_header("__import__('os').getcwd()")),
    "npy header of brackets": _bytes("brackets.npy", _npy_header("(" * 60000)),
    "npy endless header": _bytes("long.npy", b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**32 - 1) + b" " * 100000),
    "npy unknown version": _bytes("version.npy", _npy_header("{}", version=9)),
    "npy structured without y": _bytes("struct.npy", _npy(np.zeros(9, [("x", "f4"), ("z", "f4"), ("i", "f4")]))),
    # npz
    "npz empty": _bytes("empty.npz", b""),
    "npz text": _bytes("text.npz", b"not a zip at all"),
    "npz truncated": _bytes("cut.npz", _npz(points=points())[:-30]),
    "npz no arrays": _bytes("none.npz", _zip({"readme.txt": b"hello"})),
    "npz lying shape": _bytes("lie.npz", _zip({"points.npy": _npy_shape("(1000000000, 4)")})),
    "npz bomb": _bomb,
    "npz damaged": _bytes("bad.npz", _npz(points=points()).replace(BODY[:64], bytes(64))),
    "npz pickled objects": _bytes("pickle.npz", _npz(points=np.array([{"x": 1}], dtype=object))),
    "npz lengths differ": _bytes("length.npz", _npz(x=np.ones(5), y=np.ones(5), z=np.ones(4), intensity=np.ones(5))),
    "npz without intensity": _bytes("xyz.npz", _npz(xyz=points()[:, :3])),
    "npz xyz of four": _bytes("four.npz", _npz(xyz=points(), reflectance=np.ones(50))),
    "npz name of two lines": _bytes("name.npz", _zip({"a\nb\x1b[31m.npy": _npy(np.ones(3))})),
    "npz image of another size": _bytes("size.npz", _image(range=np.ones((3, 4), np.float32))),
    "npz image of NaN": _bytes("nan.npz", _image(range=np.full((2, 4), np.nan, np.float32))),
    "npz image mask of floats": _bytes("mask.npz", _image(mask=np.ones((2, 4), np.float32))),
    "npz image sensor no JSON": _bytes("json.npz", _image(sensor=np.array("{"))),
    "npz image sensor a list": _bytes("list.npz", _image(sensor=np.array("[1, 2]"))),
    "npz image sensor unknown field": _bytes("field.npz", _image(sensor=np.array('{"elevations": [1, -1], "x": 1}'))),
    "npz image sensor of NaN": _bytes("sensor.npz", _image(sensor=np.array('{"elevations": [NaN, -1], "width": 4}'))),
    # pcd
    "pcd empty": _bytes("empty.pcd", b""),
    "pcd endless header": _bytes("endless.pcd", b"# comment\n" * 50000),
    "pcd header of one line": _bytes("line.pcd", b"VERSION 0.7 " * 20000),
    "pcd no fields": _bytes("fields.pcd", _pcd(BODY, FIELDS=None)),
    "pcd no size": _bytes("size.pcd", _pcd(BODY, SIZE=None)),
    "pcd no points": _bytes("points.pcd", _pcd(BODY, WIDTH=None, HEIGHT=None, POINTS=None)),
    "pcd lists differ": _bytes("lists.pcd", _pcd(BODY, TYPE="F F F")),
    "pcd counts differ": _bytes("counts.pcd", _pcd(BODY, COUNT="1 1")),
    "pcd negative count": _bytes("count.pcd", _pcd(BODY, COUNT="1 1 1 -1")),
    "pcd huge count": _bytes("count.pcd", _pcd(BODY, COUNT="1 1 1 99999999999")),
    "pcd type of 3 bytes": _bytes("type.pcd", _pcd(BODY, SIZE="4 4 4 3")),
    "pcd unknown type": _bytes("type.pcd", _pcd(BODY, TYPE="F F F Q")),
    "pcd a trillion points": _bytes("lie.pcd", _pcd(BODY, WIDTH="1000000000000", POINTS="1000000000000")),
    "pcd negative points": _bytes("minus.pcd", _pcd(BODY, WIDTH="-50", HEIGHT="-1")),
    "pcd points no number": _bytes("word.pcd", _pcd(BODY, POINTS="many")),
    "pcd width x height": _bytes("area.pcd", _pcd(BODY, WIDTH="49")),
    "pcd unknown encoding": _bytes("data.pcd", _pcd(BODY, "zstd")),
    "pcd truncated": _bytes("cut.pcd", _pcd(BODY[:-1])),
    "pcd too long": _bytes("long.pcd", _pcd(BODY + BODY)),
    "pcd without intensity": _bytes("xyz.pcd", _pcd(BODY, FIELDS="x y z w")),
    "pcd without z": _bytes("xy.pcd", _pcd(BODY, FIELDS="x y w intensity")),
    "pcd ascii truncated": _bytes("ascii.pcd", _pcd(_ascii(49), "ascii")),
    "pcd ascii too long": _bytes("ascii.pcd", _pcd(_ascii(51), "ascii")),
    "pcd ascii word": _bytes("word.pcd", _pcd(_ascii(50).replace(b"0.", b"O.", 1), "ascii")),
    "pcd ascii is binary": _bytes("binary.pcd", _pcd(BODY, "ascii")),
    "pcd packed no sizes": _bytes("packed.pcd", _pcd(b"\x01\x02", "binary_compressed")),
    "pcd packed truncated": _bytes("packed.pcd", _packed(900, 800, b"\x1f" + bytes(32))),
    "pcd packed lies about its size": _bytes("packed.pcd", _packed(40, 2**32 - 1, bytes(40))),
    "pcd packed too little": _bytes("packed.pcd", _packed(33, 800, b"\x1f" + bytes(32))),
    "pcd packed too much": _bytes("packed.pcd", _packed(2 + 3 * 40, 800, b"\x00\x00" + b"\xe0\xff\x00" * 40)),
    "pcd packed before the start": _bytes("packed.pcd", _packed(20, 800, b"\xe0\xff\xff" + bytes(17))),
    "pcd packed ends in a match": _bytes("packed.pcd", _packed(21, 800, b"\x11" + bytes(18) + b"\xe0\xff")),
    # ply
    "ply empty": _bytes("empty.ply", b""),
    "ply no magic": _bytes("magic.ply", b"poly\nformat ascii 1.0\n"),
    "ply endless header": _bytes("endless.ply", b"ply\n" + b"comment endless\n" * 20000),
    "ply no end_header": _bytes("end.ply", _ply(b"").replace(b"end_header\n", b"")),
    "ply no format": _bytes("format.ply", _ply().replace(b"format binary_little_endian 1.0\n", b"")),
    "ply unknown format": _bytes("format.ply", _ply(encoding="binary_middle_endian")),
    "ply no vertex": _bytes("vertex.ply", _ply().replace(b"vertex", b"corner")),
    "ply negative count": _bytes("minus.ply", _ply(count="-50")),
    "ply 10^18 vertices": _bytes("lie.ply", _ply(count="1000000000000000000")),
    "ply count no number": _bytes("word.ply", _ply(count="many")),
    "ply property before element": _bytes("order.ply", b"ply\nformat ascii 1.0\nproperty float x\nend_header\n"),
    "ply unknown type": _bytes("type.ply", _ply(properties=XYZI.replace("float z", "quad z"))),
    "ply list in vertex": _bytes("list.ply", _ply(properties=XYZI + "property list uchar int n\n")),
    "ply property twice": _bytes("twice.ply", _ply(properties=XYZI.replace("float y", "float x"))),
    "ply truncated": _bytes("cut.ply", _ply(BODY[:-1])),
    "ply big endian as little": _bytes("swap.ply", _ply(points().astype(">f4").tobytes())),
    "ply faces swallow the file": _bytes("faces.ply", _ply().replace(
        b"element vertex", b"element face 3\nproperty list int int n\nelement vertex")),
    "ply faces of negative length": _bytes("faces.ply", _ply(b"\xff" * 800).replace(
        b"element vertex", b"element face 3\nproperty list int int n\nelement vertex")),
    "ply ascii truncated": _bytes("ascii.ply", _ply(_ascii(49), "ascii")),
    "ply ascii word": _bytes("word.ply", _ply(_ascii(50).replace(b"0.", b"O.", 1), "ascii")),
    "ply without intensity": _bytes("xyz.ply", _ply(properties=XYZI.replace("intensity", "w"))),
    # through a library of its own
    "las empty": _bytes("empty.las", b""),
    "las text": _bytes("text.las", b"hello" * 100),
    "las header only": _bytes("header.las", b"LASF" + bytes(371)),
    "las a billion points": _bytes("lie.las", _las(count=10**9)),
    "las endless records": _bytes("records.las", _las(records=2**32 - 1)),
    "las truncated": _bytes("cut.las", _las(body=bytes(199))),
    "laz a billion chunks": _bytes("chunks.laz", _las(kind=0x80, body=struct.pack("<qqII", 235 + 8, 0, 0, 10**9))),
    "laz without items": _bytes("items.laz", _las(kind=0x80, body=struct.pack("<qqII", 235 + 8, 0, 0, 1))),
    "laz truncated": _bytes("cut.laz", b"LASF\x00\x00\x00\x00"),
    "feather text": _bytes("text.feather", b"hello" * 100),
    "feather truncated": _bytes("cut.feather", b"ARROW1\x00\x00" + bytes(100) + b"ARROW1"),
}  # fmt: skip
