"""Bare arrays: KITTI `.bin`, nuScenes `.pcd.bin`, numpy `.npy` and `.npz`. Nothing is ever unpickled."""

from __future__ import annotations

import ast
import json
import lzma
import math
import struct
import zipfile
import zlib
from io import BufferedIOBase, BytesIO
from typing import IO, Any

import numpy as np

from lidarsynth.files.fields import (
    MAX_BYTES,
    MAX_METRES,
    SCALED,
    Fields,
    FileError,
    check_names,
    find,
    rings_of_grid,
    written_names,
)
from lidarsynth.files.labels import MOST_INSTANCES
from lidarsynth.files.several import numbered
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import WORDS, from_dict

COLUMNS: tuple[str, ...] = ("x", "y", "z", "intensity", "ring")
MAX_HEADER = 1 << 16
# What zipfile and what it unpacks with raise of damaged archives: RuntimeError is also of other packings, and of a
# password; ValueError also of wrong text, and FileError.
ZIP_ERRORS = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError),
    *(LookupError, OSError, RuntimeError, ValueError),
)
PRINTABLE = frozenset(b"\t\n\r" + bytes(range(32, 127)))


def read_bin(data: bytes) -> Fields:
    """KITTI: x y z reflectance, four float32 a point. Raises FileError for text or a size that is not whole points."""
    hint = " (three floats a point, without reflectance, are read from .npy)" if len(data) % 12 == 0 else ""
    hint = " (five floats a point, as nuScenes writes them, are read from .pcd.bin)" if len(data) % 20 == 0 else hint
    return _floats(data, 4, hint)


def read_pcd_bin(data: bytes) -> Fields:
    """nuScenes: x y z intensity (0-255) ring, five float32 a point; x right, y forward there, x forward, y left here.

    The field SCALED is the intensity / 255, but where someone has scaled the file before, or it goes beyond. Raises
    FileError as `read_bin`.
    """
    fields = _floats(data, 5, "")
    fields["x"], fields["y"] = fields["y"], -fields["x"]
    light = fields["intensity"]
    unit = np.nanmax(light, initial=0) <= 1 and np.mean((light > 0) & (light < 1)) > 0.5  # scaled by someone before
    if not unit and np.nanmax(light, initial=0) <= 255:
        fields[SCALED] = light / np.float32(255)  # the format fixes the scale, however dark the scan
    return fields


def is_text(data: bytes) -> bool:
    """Whether these are printable characters, as far as the first 4096 tell."""
    return PRINTABLE.issuperset(data[:4096])


def _floats(data: bytes, columns: int, hint: str) -> Fields:
    if len(data) == 0 or len(data) % (4 * columns):
        raise FileError(
            f"expected whole points of {columns} float32 ({4 * columns} bytes), found {len(data)} bytes{hint}"
        )
    if is_text(data):
        raise FileError(f"expected {columns} binary float32 a point, found text: {data[:24].decode('ascii')!r}")
    table = np.frombuffer(data, "<f4").reshape(-1, columns)
    extreme = np.nanmin(table[:, 3], initial=0), np.nanmax(table[:, 3], initial=0)
    if hint and not 0 <= extreme[0] <= extreme[1] <= 65535:
        raise FileError(
            f"expected a reflectance in every fourth float32, found {extreme[0]:.4g} to {extreme[1]:.4g}{hint}"
        )
    return dict(zip(COLUMNS, table.T, strict=False))


def read_npy(data: bytes) -> Fields:
    """An (N, 3) to (N, 10) array of x y z intensity ..., also in rows (H, W, 3 to 10), or a structured array (N,) whose
    fields have names.

    A fifth column of whole numbers 0-255 is the ring, as in nuScenes; any other further columns are left out.
    """
    return fields_of(read_array(BytesIO(data), len(data)))


def _columns(table: np.ndarray) -> Fields:
    """The columns of a structured array (N,); of a field of several numbers one each, as of a `.pcd`."""
    names = [name for name in table.dtype.names or () if 0 not in table.dtype[name].shape]
    counts = [math.prod(table.dtype[name].shape) for name in names]
    parts = zip(names, counts, numbered(names, counts), strict=True)
    return {word: table[name].reshape(-1, count)[:, i] for name, count, own in parts for i, word in enumerate(own)}


def fields_of(array: np.ndarray) -> Fields:
    """Columns of an array of points, see `read_npy`. Raises FileError for any other shape or type."""
    if array.dtype.names:
        return _columns(array.reshape(-1))
    if array.ndim == 3 and 3 <= array.shape[2] <= 10:
        array = array.reshape(-1, array.shape[2])
    if array.ndim != 2 or not 3 <= array.shape[1] <= 10 or array.dtype.kind not in "fiu":
        looks = array.ndim > 1 and sorted(array.shape)[-2] >= LOWEST
        raise FileError(f"expected an (N, 3) to (N, 10) array of points, found {array.shape} of {array.dtype}"
                        + (", which looks like an image: its file is an npz of range, reflectance, mask and sensor"
                           if looks else "")
                        + ("; published samples (5, H, W) and (2, H, W) are judged as .pth, which torch.save writes"
                           if looks and array.ndim > 2 and array.shape[-3] in (2, 5) else ""))  # fmt: skip
    fields = dict(zip(COLUMNS, array.T, strict=False))
    ring = fields.get("ring")
    if ring is not None and not (
        np.isfinite(ring).all() and np.all((ring >= 0) & (ring < 256) & (ring == np.floor(ring)))
    ):
        del fields["ring"]
    return fields


def read_array(file: IO[bytes], size: int) -> np.ndarray:
    """The array of an npy stream of `size` bytes; no more is read than the header's shape asks for, and that must fit.

    Raises FileError for objects (pickles), a broken header, or a shape that lies.
    """
    if (start := file.read(8))[:6] != b"\x93NUMPY" or len(start) < 8 or start[6] not in (1, 2, 3):
        raise FileError(f"expected a numpy array (version 1-3), found {start!r}")
    width = 2 if start[6] == 1 else 4
    length = int.from_bytes(file.read(width), "little")
    text = file.read(min(length, MAX_HEADER))
    shape, dtype, columns_first = _npy_header(text)
    if dtype.hasobject:
        raise FileError("expected an array of numbers, found pickled Python objects, which are never loaded")
    need = dtype.itemsize
    for n in shape:
        need *= n
    found = size - 8 - width - length
    if need > MAX_BYTES or need != found:
        raise FileError(f"expected {need} bytes for an array {shape} of {dtype}, found {max(found, 0)}")
    data = file.read(need)
    if len(data) != need:
        raise FileError(f"expected {need} bytes for an array {shape} of {dtype}, found {len(data)}")
    if need == 0:
        return np.zeros(shape, dtype)
    return np.frombuffer(data, dtype).reshape(shape, order="F" if columns_first else "C")


def _npy_header(text: bytes) -> tuple[tuple[int, ...], np.dtype, bool]:
    try:
        header = ast.literal_eval(text.decode("latin1").strip())
        dtype = np.lib.format.descr_to_dtype(header["descr"])
        shape, columns_first = header["shape"], header["fortran_order"]
    except (ValueError, SyntaxError, TypeError, KeyError, IndexError, MemoryError, RecursionError):
        raise FileError(f"expected a numpy header with descr, shape and fortran_order, found {text[:40]!r}") from None
    if not isinstance(shape, tuple) or not all(isinstance(n, int) and 0 <= n < 2**40 for n in shape) or len(shape) > 8:
        raise FileError(f"expected a shape of up to 8 whole numbers of at least 0, found {str(shape)[:60]!r}")
    return shape, dtype, bool(columns_first)


POSES = ((3, 3), (3, 4), (4, 4))


def read_npz(data: bytes) -> Fields:
    """Our own scan (xyz, reflectance, ring, time, label), our own range image (`image_of`), columns under the usual
    names, or a single array of points under any name, also in rows (`read_npy`), and what else there is of each of
    them; beside it matrices of the size of a pose are none. Arrays (H, W, 3) and (H, W) are flattened."""
    arrays = unzip(data)
    if "sensor" in arrays and "mask" in arrays:
        return scan_fields(image_of(arrays).to_scan())
    if "xyz" not in arrays:
        table = _points_among(arrays)
        if table is None:
            if "range" in arrays and arrays["range"].ndim > 1 and find(arrays, "x") is None:
                image_of(arrays)  # says what it lacks
            return dict(arrays)
        cells = table.shape if table.dtype.names else table.shape[:-1]
        more = {name: array for name, array in arrays.items() if array.shape == cells and array is not table}
        return fields_of(table) | {name: array.reshape(-1) for name, array in more.items()}
    xyz = arrays.pop("xyz")
    if xyz.ndim < 2 or xyz.shape[-1] != 3:
        raise FileError(f"expected xyz of (N, 3) or (H, W, 3), found {xyz.shape}")
    points = dict(zip("xyz", xyz.reshape(-1, 3).T, strict=True))
    points |= {name: array.reshape(-1) for name, array in arrays.items() if array.shape == xyz.shape[:-1]}
    if xyz.ndim == 3 and (ring := rings_of_grid(points, xyz.shape[:2])) is not None:
        points["ring"] = ring
    return points


def _points_among(arrays: dict[str, np.ndarray]) -> np.ndarray | None:
    """The only array of points, poses apart: a table or structured, or, where none could be one, in rows (H, W, 3 to
    10). None where there is no such array, or several."""
    tables = [array for array in arrays.values() if array.ndim == 2 or array.dtype.names]
    rows = [array for array in arrays.values() if array.ndim == 3 and 3 <= array.shape[2] <= 10]
    if tables[1:] or len(rows) == 1:
        tables = [table for table in tables if table.shape not in POSES]
    if len(rows) == 1 and not any(table.dtype.names or 3 <= table.shape[1] <= 10 for table in tables):
        return rows[0]
    return tables[0] if len(tables) == 1 else None


def unzip(data: bytes) -> dict[str, np.ndarray]:
    """Every array of an npz by its name, packed or not. Raises FileError; never unpacks more than a header asks for."""
    try:
        with zipfile.ZipFile(BytesIO(data)) as archive:
            members = [m for m in archive.infolist() if m.filename.endswith(".npy")]
            if not 1 <= len(members) <= 64 or sum(m.file_size for m in members) > MAX_BYTES:
                raise FileError(f"expected 1 to 64 arrays of at most {MAX_BYTES} bytes in all, found {len(members)} "
                                f"of {sum(m.file_size for m in members)}")  # fmt: skip
            check_names([m.filename[:-4] for m in members])
            return {m.filename[:-4]: _member(archive, m) for m in members}
    except FileError:
        raise
    except ZIP_ERRORS as error:
        raise FileError(f"expected an npz (a zip of numpy arrays), found {_first_line(error)}") from None


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(member) as file:
        try:
            return read_array(file, member.file_size)
        except FileError as error:
            raise FileError(f"{error} (in {member.filename[:40]})") from None


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


IMAGE: dict[str, tuple[str, float, float]] = {  # array -> numpy kinds, least and greatest value
    "range": ("f", 0, MAX_METRES),
    "reflectance": ("f", 0, 1),
    "mask": ("biu", 0, 1),  # 0 and 1 as numbers, too, as other programs save it
    "label": ("iu", 0, 19),
    "xyz": ("f", -MAX_METRES, MAX_METRES),
    "confidence": ("f", 0, 1),
    "new": ("biu", 0, 1),
    "instance": ("iu", 0, MOST_INSTANCES),
}


NEEDED = {"range", "reflectance", "mask", "sensor"}  # arrays of a range image
LOWEST = 16  # rows of what looks like an image, not like a table of points


def image_of(arrays: dict[str, np.ndarray]) -> RangeImage:
    """The range image of our own npz: range, reflectance, mask, sensor (JSON text), and what else of IMAGE it has."""
    if missing := NEEDED - arrays.keys():
        raise FileError(f"expected a saved range image, found no {', '.join(sorted(missing))} in {', '.join(arrays)}")
    mask = arrays["mask"]
    mask = _checked("mask", mask, np.ones(mask.shape, bool)).astype(bool)
    arrays = {name: _checked(name, array, mask) if name in IMAGE else array for name, array in arrays.items()}
    try:
        values = _sensor_table(str(arrays["sensor"]))
        if not isinstance(values, dict) or "elevations" not in values:
            raise FileError("expected a sensor with elevations in the range image, found another JSON text")
        label = arrays["label"].astype(np.int32) if "label" in arrays else None
        xyz = arrays["xyz"].astype(np.float32) if "xyz" in arrays else None
        sure = arrays["confidence"].astype(np.float32) if "confidence" in arrays else None
        numbers = arrays["range"].astype(np.float32), arrays["reflectance"].astype(np.float32)
        new = arrays["new"].astype(bool) if "new" in arrays else _filled_in(mask, xyz, sure)
        number = arrays["instance"].astype(np.int32) if "instance" in arrays else None
        return RangeImage(*numbers, mask, from_dict(values), label, xyz, confidence=sure, new=new, instance=number)
    except FileError:
        raise
    except (ValueError, TypeError, RecursionError) as error:
        raise FileError(f"expected a range image that fits its sensor, found: {_first_line(error)}") from None


def _sensor_table(text: str) -> Any:
    """A sensor's fields from JSON, or of the known one whose word the text is."""
    if text in WORDS:
        return WORDS[text].to_dict()
    try:
        return json.loads(text)
    except ValueError:
        raise FileError(f"expected a sensor's fields as JSON, or its word, found {text!r:.60}") from None


def _filled_in(mask: np.ndarray, xyz: np.ndarray | None, sure: np.ndarray | None) -> np.ndarray | None:
    """(H, W) bool, which pixels were filled in, of a file that does not say so, as those of before 2026-11-28: such as
    are not sure, or have no measured point where others have one; None where there are none."""
    new = np.zeros_like(mask)
    if sure is not None and sure.shape == mask.shape:
        new |= mask & (sure < 1)
    if xyz is not None and xyz.shape == (*mask.shape, 3):
        new |= mask & ~xyz.any(axis=-1)
    return new if new.any() else None


def _checked(name: str, array: np.ndarray, returned: np.ndarray) -> np.ndarray:
    """An array of a range image, within its limits where a ray returned; what is not, elsewhere, becomes 0: NaN or -1
    is what programs put where nothing returned."""
    kinds, low, high = IMAGE[name]
    if array.dtype.kind not in kinds:
        words = {"b": "truth values", "f": "floats", "i": "whole numbers"}
        raise FileError(f"expected {name} of {words[kinds[0]]}, found {array.dtype}")
    off = ~((array >= low) & (array <= high))
    if array.shape[: returned.ndim] == returned.shape:
        array = np.where(off & ~_like(returned, array), array.dtype.type(0), array) if off.any() else array
        off &= _like(returned, array)
    if off.any():
        found = array[off]
        raise FileError(f"expected finite {name} of {low:g} to {high:g}, found {len(found)} such as {found[0]}")
    return array


def check_saved(image: RangeImage) -> None:
    """Raises FileError for numbers of an image that `image_of` would refuse."""
    for name in IMAGE:
        if (array := getattr(image, name)) is not None:
            _checked(name, array, image.mask)


def _like(returned: np.ndarray, array: np.ndarray) -> np.ndarray:
    return returned.reshape(*returned.shape, *(1,) * (array.ndim - returned.ndim))


def scan_fields(scan: Scan) -> Fields:
    """Our own npz keys, xyz split into x, y, z."""
    fields = {axis: scan.xyz[:, i] for i, axis in enumerate("xyz")} | {"reflectance": scan.reflectance}
    optional = {**scan.extra, "ring": scan.ring, "time": scan.time, "label": scan.label}
    return fields | {name: value for name, value in optional.items() if value is not None}


def write_bin(file: BufferedIOBase, scan: Scan) -> None:
    """x y z reflectance, four little-endian float32 a point; ring, time and label have no place in this format."""
    file.write(_table(scan).tobytes())


def write_npy(file: BufferedIOBase, scan: Scan) -> None:
    """An (N, 4) float32 array x y z reflectance; ring, time and label have no place in this format."""
    np.lib.format.write_array(file, _table(scan), allow_pickle=False)


def _table(scan: Scan) -> np.ndarray:
    return np.column_stack([scan.xyz, scan.reflectance]).astype("<f4")


QUICK = 1  # of zlib: numpy's own 6 takes most of the time of projecting a scan, for a fiftieth of the bytes


def write_npz(file: BufferedIOBase, scan: Scan | RangeImage) -> None:
    """Every array of the scan or image under its own name, compressed; the sensor of an image as JSON text."""
    if isinstance(scan, RangeImage):
        arrays = {name: getattr(scan, name) for name in IMAGE}
        arrays["sensor"] = np.array(json.dumps(scan.sensor.to_dict()))
    else:
        own = {name: getattr(scan, name) for name in ("xyz", "reflectance", "ring", "time", "label")}
        names = written_names(scan.extra, [*own, *"xyz", "sensor", "file", "allow_pickle"])  # the last two: np.savez's
        arrays = dict(zip(names, scan.extra.values(), strict=True)) | own
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=QUICK) as archive:
        for name, array in arrays.items():
            if array is not None:
                with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                    np.lib.format.write_array(entry, np.asanyarray(array), allow_pickle=False)
