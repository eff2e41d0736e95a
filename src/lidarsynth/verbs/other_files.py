"""What a file is that holds no scan: a picture, a page, an archive, a network in ONNX, labels, text."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lidarsynth.files.fields import FileError
from lidarsynth.lidar.small_file import LARGEST_WEIGHTS, check_regular, read_text

Lines = dict[str, str]
START = 4096  # bytes that are looked at to tell the kind
PAGE = 1 << 30  # bytes of a page that are read to count its scans
PICTURES = {b"\x89PNG\r\n\x1a\n": "PNG", b"\xff\xd8\xff": "JPEG", b"GIF8": "GIF"}
ARCHIVES = {b"\x1f\x8b": "gzip", b"PK\x03\x04": "zip", b"\xfd7zXZ\x00": "xz", b"BZh": "bzip2",
            b"\x28\xb5\x2f\xfd": "zstd", b"7z\xbc\xaf\x27\x1c": "7z"}  # fmt: skip
PACKED = (".zip", ".tar", ".tgz", ".gz", ".xz", ".bz2", ".zst", ".7z", ".rar")  # endings of archives
ENTRIES = '"entries": '  # before the list of a page's scans
TAR = 257, b"ustar"  # of a tar that is not packed: where it says so


def other_lines(path: Path) -> Lines | None:
    """What a file without a scan is, as lines by title, or None where it cannot be told. Raises ValueError."""
    if known := BY_NAME.get(path.suffix.lower()):
        return known(path)
    check_regular(path)
    with open(path, "rb") as file:
        start = file.read(START)
    for begin, kind in PICTURES.items():
        if start.startswith(begin):
            return {"kind": f"picture, {kind}{_size(start)}", "holds": "no points that could be read back"}
    for begin, kind in ARCHIVES.items():
        if start.startswith(begin):
            return _archive(path, kind)
    if start[TAR[0] :].startswith(TAR[1]):
        return _archive(path, "tar")
    if re.match(rb"\s*(<!doctype html|<html)", start, re.IGNORECASE):
        return _page(path, start)
    return {"kind": "text, no scan"} if path.suffix.lower() in TEXTS and _is_text(start) else None


def _size(png: bytes) -> str:
    """Of a PNG, from its first chunk (the PNG specification, IHDR)."""
    if png[12:16] != b"IHDR":
        return ""
    width, height = (int.from_bytes(png[at : at + 4], "big") for at in (16, 20))
    return f" of {width} x {height}"


def _archive(path: Path, kind: str) -> Lines:
    return {
        "kind": f"archive, {kind}, {path.stat().st_size / 1e6:.1f} MB",
        "to do": "unpack it and name what is inside",
    }


def _page(path: Path, start: bytes) -> Lines:
    """A page; those of `lidarsynth view` say their title, and each stop of their slider, in their settings."""
    if b"<title>lidarsynth</title>" not in start:
        return {"kind": "web page, not one of lidarsynth's"}
    text = read_text(path, PAGE)
    try:
        entries = json.JSONDecoder().raw_decode(text, text.rindex(ENTRIES) + len(ENTRIES))[0]
        names = [str(entry["name"]) for entry in entries]
    except (ValueError, TypeError, KeyError, RecursionError):
        raise FileError(f"{path}: expected a page of lidarsynth view, found one without its list of scans") from None
    listed = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
    return {"kind": "page of lidarsynth view: open it in any browser", "scans": f"{len(names)}: {listed}"}


def _onnx(path: Path) -> Lines:
    try:
        import onnx
        from google.protobuf.message import DecodeError
    except ImportError:
        return {"kind": "network in ONNX; lidarsynth[onnx] reads what it takes and gives"}
    check_regular(path, LARGEST_WEIGHTS)
    try:
        proto: Any = onnx.load(str(path), load_external_data=False)
    except (DecodeError, ValueError, OSError) as error:
        raise FileError(f"{path}: expected a network in ONNX, found: {error!s:.120}") from None
    if not proto.graph.node:
        raise FileError(f"{path}: expected a network in ONNX, found none in {path.stat().st_size} bytes")
    told = {entry.key: entry.value for entry in proto.metadata_props}
    by = f"written by {proto.producer_name}" if proto.producer_name else "of an unknown writer"
    lines = {"kind": f"network in ONNX, {by}, opset {max((o.version for o in proto.opset_import), default=0)}"}
    lines |= {key: told[key] for key in ("model", "does", "licence", "data", "columns") if told.get(key)}
    if told.get("sensor"):
        lines["sensor"] = _sensor(told["sensor"])
    return lines | {"in": _tensors(proto.graph.input), "out": _tensors(proto.graph.output)}


def _sensor(text: str) -> str:
    """The name of a sensor in JSON, or the start of what other writers say under this word."""
    try:
        return str(json.loads(text)["name"])
    except (ValueError, LookupError, TypeError, RecursionError):
        return text[:60]


def _tensors(values: Any) -> str:
    """Names and shapes of a graph's inputs or outputs."""
    shapes = {v.name: [str(d.dim_value or d.dim_param or "?") for d in v.type.tensor_type.shape.dim] for v in values}
    return ", ".join(f"{name} ({' x '.join(shape)})" for name, shape in shapes.items())


def _words(kind: str, dtype: str, told: Callable[[np.ndarray], str]) -> Callable[[Path], Lines]:
    """Of files with one value of `dtype` for each point of the scan of their name."""

    def lines(path: Path) -> Lines:
        check_regular(path)
        size = np.dtype(dtype).itemsize
        if path.stat().st_size % size or not path.stat().st_size:
            raise FileError(f"{path}: expected {kind}, {size} bytes a point, found {path.stat().st_size} bytes")
        values = np.fromfile(path, dtype)
        return {"kind": f"{kind} of {len(values)} points", "holds": told(values)}

    return lines


def _classes(words: np.ndarray) -> str:
    ids, counts = np.unique(words & 0xFFFF, return_counts=True)
    most = [str(i) for i in ids[np.argsort(-counts)][:6]]
    instances = np.unique(words[words >> 16 > 0]).size
    return f"{len(ids)} ids, most often {', '.join(most)}; {instances} instances"


TEXTS = (".md", ".rst", ".yaml", ".yml", ".log", ".ini", ".cfg", ".py", ".sh", ".launch", ".xml")
BY_NAME: Mapping[str, Callable[[Path], Lines]] = {
    ".onnx": _onnx,
    ".label": _words("SemanticKITTI labels", "<u4", _classes),
    ".new": _words("marks of a completed scan", "u1", lambda v: f"{np.count_nonzero(v)} filled in, others measured"),
    ".confidence": _words("confidences of a completed scan", "<f4", lambda v: f"{v.min():.2f} to {v.max():.2f}"),
}


def _is_text(start: bytes) -> bool:
    try:
        start[: len(start) - 4].decode()  # the last character may be cut
    except UnicodeDecodeError:
        return False
    return b"\0" not in start
