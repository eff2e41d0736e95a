"""What a file or folder on disk is, in words: scans, bags, captures, sensors, caches, statistics, reports."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lidarsynth.data import ouster
from lidarsynth.data.bags import POINTS, Cloud, is_bag, open_bag
from lidarsynth.data.capture import datagrams, is_capture
from lidarsynth.data.folder import scan_files
from lidarsynth.data.index import INDEX, read_index, report
from lidarsynth.experiment.folder import RECORD, WEIGHTS
from lidarsynth.files.fields import FileError, scan_from_fields
from lidarsynth.files.formats import READERS, read_with_report
from lidarsynth.lidar.frame import check_frame
from lidarsynth.lidar.recognition import recognise
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.small_file import LARGEST_INDEX, read_json
from lidarsynth.verbs.inputs import capture_turns, has_scans

Lines = dict[str, str]
LOOKED_AT = 400  # packets of a capture that are counted


def file_lines(path: Path) -> Lines | None:
    """What a path is, as lines by title, or None for what is no file of ours to tell: a model, a sensor, a word.

    Raises FileError, in one line, for a file that is broken or of no kind that is known.
    """
    model = path.name in (WEIGHTS, RECORD) or (path.is_dir() and (path / RECORD).exists())
    if model or path.suffix.lower() in MODELS:
        return None
    if not path.exists():
        if path.name.lower().endswith((*READERS, *KINDS, *STREAMS)):
            raise FileError(f"{path}: expected a file, found no file or folder of that name")
        return None
    if path.is_dir():
        if not any(path.iterdir()):
            raise FileError(f"{path}: expected scans, a bag, a cache or a model in the folder, found nothing")
        if not (is_bag(path) or (path / INDEX).exists() or has_scans(path)):
            return None
        return _bag(path) if is_bag(path) else _cache(path) if (path / INDEX).exists() else _folder(path)
    if path.name.lower().endswith(tuple(READERS)):
        return scan_lines(*read_with_report(path))
    if is_bag(path):
        return _bag(path)
    if is_capture(path):
        return _capture(path)
    if path.suffix.lower() in KINDS:
        return KINDS[path.suffix.lower()](path)
    with open(path, "rb") as file:
        start = file.read(12)
    raise FileError(f"{path}: expected a scan ({', '.join(READERS)}), bag, capture, sensor, cache or model, "
                    f"found {path.stat().st_size} bytes that begin with {start!r}")  # fmt: skip


def scan_lines(scan: Scan, dropped: int = 0) -> Lines:
    """Points, range, reflectance, fields, sensor and frame of a scan."""
    name, reason = recognise(scan)
    depth, light = np.linalg.norm(scan.xyz, axis=1), scan.reflectance
    own = [field for field in ("ring", "time", "label") if getattr(scan, field) is not None]
    lines = {
        "points": f"{len(scan)}" + (f" ({dropped} without a return dropped)" if dropped else ""),
        "range": f"{depth.min():.2f} to {depth.max():.2f} m, median {np.median(depth):.2f} m",
        "reflectance": f"{light.min():.2f} to {light.max():.2f}, mean {light.mean():.3f}",
        "fields": " ".join(["x y z reflectance", *own, *scan.extra]),
        "sensor": f"{name} ({reason})" if name else reason,
    }
    warning = check_frame(scan).warning()
    return lines | ({"frame": warning} if warning else {})


def _bag(path: Path) -> Lines:
    with open_bag(path) as bag:
        lines = {"kind": f"bag of {bag.seconds:.1f} s, {len(bag.topics)} topics"}
        for topic in bag.topics:
            rate = f", {(topic.count - 1) / bag.seconds:.1f} a second" if bag.seconds > 0 and topic.count > 1 else ""
            lines[topic.name] = f"{topic.kind}, {topic.count} messages{rate} ({topic.encoding})"
        clouds = [topic.name for topic in bag.topics if topic.kind == POINTS]
        for name in clouds:
            first = next(bag.clouds(name), None)
            if isinstance(first, Cloud):
                scan, dropped = scan_from_fields(first.fields, _scale(first))
                lines |= {f"{name}: {key}": text for key, text in scan_lines(scan, dropped).items()}
    return lines


def _scale(cloud: Cloud) -> str:
    known = ("reflectance", "reflectivity", "intensity", "remission", "intensities", "i")
    return "auto" if any(name.lower() in known for name in cloud.fields) else "none"


def _capture(path: Path) -> Lines:
    sizes: dict[tuple[int, int], int] = {}
    for number, packet in enumerate(datagrams(path)):
        if number >= LOOKED_AT:
            break
        key = packet.port, len(packet.payload)
        sizes[key] = sizes.get(key, 0) + 1
    listed = ", ".join(f"{count} of {size} bytes to port {port}" for (port, size), count in sizes.items())
    lines = {"kind": "network capture", "packets": f"{listed or 'none'} (of the first {LOOKED_AT})"}
    turns = capture_turns(path)
    fields = next(turns)
    return lines | {f"first turn: {key}": text for key, text in scan_lines(*scan_from_fields(fields)).items()}


def _cache(path: Path) -> Lines:
    told = report(read_index(path))
    return {"kind": "cache of range images, for training and as a reference", "images": str(told["stored"])} | {
        key: str(len(told[key])) for key in ("sequences", "skipped", "missing")
    }


def _folder(path: Path) -> Lines:
    files = scan_files(path)
    kinds: dict[str, int] = {}
    for file in files:
        kinds[file.suffix] = kinds.get(file.suffix, 0) + 1
    return {"kind": "folder of scans", "scans": ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items())),
            "first": str(files[0].relative_to(path))} | _first(files[0])  # fmt: skip


def _first(path: Path) -> Lines:
    return {f"first: {key}": text for key, text in scan_lines(*read_with_report(path)).items()}


def _tensors(path: Path) -> Lines:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "np") as file:
            shapes = {name: file.get_slice(name).get_shape() for name in file.keys()}  # noqa: SIM118, no dict
            told = file.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise FileError(f"{path}: expected tensors in safetensors, found: {error}") from None
    listed = ", ".join(f"{name} {tuple(shape)}" for name, shape in list(shapes.items())[:6])
    kind = "statistics of images, for evaluate" if "sha256" in told else "tensors"
    lines = {"kind": kind, "holds": f"{len(shapes)}: {listed}"}
    return lines | {key: text[:200] for key, text in list(told.items())[:8]}


def _json(path: Path) -> Lines:
    if ouster.is_metadata(path):
        found = ouster.read_metadata(path)
        beams = f"{len(found.altitudes)} from {max(found.altitudes):+.2f} to {min(found.altitudes):+.2f} degrees"
        return {"kind": "metadata of an Ouster sensor", "beams": beams, "columns": str(found.columns),
                "packets": found.profile}  # fmt: skip
    try:
        values: Any = read_json(path, LARGEST_INDEX)
    except OSError as error:
        raise FileError(f"{path}: expected JSON, found: {error.strerror}") from None
    if isinstance(values, Mapping) and {"settings", "done", "scans"} <= values.keys():
        return {"kind": "report of many scans"} | {k: str(values[k]) for k in ("done", "skipped", "failed", "seconds")}
    if isinstance(values, Mapping) and ("elevations" in values or "beams" in values):
        return {}
    keys = ", ".join(list(values)[:6]) if isinstance(values, Mapping) else type(values).__name__
    raise FileError(f"{path}: expected a sensor, Ouster metadata or a report in JSON, found {keys}")


MODELS = (".pth", ".pt", ".h5", ".toml")  # `load_parts` and `get_sensor` know them
STREAMS = (".bag", ".mcap", ".db3", ".pcap", ".pcapng")
KINDS: dict[str, Callable[[Path], Lines]] = {".safetensors": _tensors, ".json": _json}
