"""What a file or folder on disk is, in words: scans, bags, captures, sensors, caches, statistics, reports."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np

from lidarsynth.data.angle_files import is_angles, read_angles
from lidarsynth.data.bag_records import Bag, Cloud
from lidarsynth.data.bags import SUFFIXES, is_bag, metadata_from, open_bag
from lidarsynth.data.cache import lost_shards
from lidarsynth.data.cache_files import is_cache
from lidarsynth.data.capture import is_capture
from lidarsynth.data.folder import check_readable, scan_files, walk
from lidarsynth.data.frames import moved
from lidarsynth.data.index import INDEX, done, read_index, report
from lidarsynth.data.turns import capture_turns, senders, sound_datagrams
from lidarsynth.experiment.record import RECORD, WEIGHTS
from lidarsynth.files.fields import WITHOUT, FileError, scan_from_fields
from lidarsynth.files.formats import (
    READERS,
    fields_left_out,
    holds_image,
    marks_left_out,
    no_file,
    read_image,
    read_with_report,
    sensor_in,
)
from lidarsynth.files.several import listed
from lidarsynth.lidar.columns import columns_note, own_columns
from lidarsynth.lidar.frame import check_frame
from lidarsynth.lidar.ground import LEANING, stance
from lidarsynth.lidar.plural import plural
from lidarsynth.lidar.recognition import recognise
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import from_dict, get_sensor
from lidarsynth.lidar.unseen import darkness
from lidarsynth.verbs.expansion import has_scans, streams_below
from lidarsynth.verbs.inputs import OF_METADATA, Reading
from lidarsynth.verbs.json_kinds import json_lines
from lidarsynth.verbs.other_files import other_lines
from lidarsynth.verbs.viewpoint import viewpoint_note

Lines = dict[str, str]
NO_INTENSITY = {"reflectance": "none in the file: --intensity none for the other verbs"}
NAMED = 3  # broken files
GOES_ON = "the same data command goes on"
LOOKED_AT = 400  # packets of a capture that are counted


def file_lines(path: Path, reading: Reading) -> Lines | None:
    """What a path is, as lines by title, or None for what is no file of ours to tell: a model, a sensor, a word.

    reading  of which transform, rings and metadata count
    Raises FileError, in one line, for a file that is broken or of no kind that is known, or holds no scan to move, or
    no packets that metadata could be of.
    """
    if path.is_dir():
        check_readable(path)
    model = path.name in (WEIGHTS, RECORD) or (path.is_dir() and (path / RECORD).exists())
    model = model or path.suffix.lower() in MODELS
    absent = not path.exists()
    if absent and not model and (path.name.lower().endswith((*READERS, *KINDS, *STREAMS)) or is_capture(path)):
        raise FileError(f"{path}: expected a file, found no file or folder of that name")
    if reading.metadata is not None and (absent or not (is_bag(path) or is_capture(path))):
        raise FileError(f"{path}: {OF_METADATA} {reading.metadata}, found another kind of file or word")
    if model or absent:
        return None
    if not path.is_dir() and (what := no_file(path)) is not None:
        raise FileError(f"{path}: expected a file, found {what}")
    if path.is_dir():
        if not any(path.iterdir()):
            raise FileError(f"{path}: expected scans, a bag, a cache or a model in the folder, found nothing")
        if is_bag(path):
            return _bag(path, reading)
        if not is_cache(path):
            return _folder(path, reading)
    if is_angles(path):
        return _angles(path)
    if path.name.lower().endswith(tuple(READERS)) and not path.is_dir():
        placed = {} if reading.moves or (note := viewpoint_note(path)) is None else {"viewpoint": note}
        return _image(path) | _scan_file(path, reading) | placed
    if is_bag(path):
        return _bag(path, reading)
    if is_capture(path):
        return _capture(path, reading)
    if reading.moves:
        raise FileError(f"{path}: expected a scan to move or take rings of, found another kind of file or folder")
    if path.is_dir():
        return _cache(path)
    if path.suffix.lower() in KINDS:
        return KINDS[path.suffix.lower()](path)
    if lines := other_lines(path):
        return lines
    with open(path, "rb") as file:
        start = file.read(12)
    content = f"{path.stat().st_size} bytes that begin with {start!r}" if start else "an empty file"
    raise FileError(
        f"{path}: expected a scan ({', '.join(READERS)}), bag, capture, sensor, cache or model, found {content}"
    )


def _image(path: Path) -> Lines:
    """Of a range image in `.npz`."""
    if path.suffix.lower() != ".npz" or not holds_image(path):
        return {}
    image = read_image(path)
    return {"kind": f"range image of {image.sensor.name}, {image.shape[0]} x {image.shape[1]}, "
                    f"{image.mask.mean():.1%} of its pixels filled"}  # fmt: skip


def _scan_file(path: Path, reading: Reading) -> Lines:
    """Of a scan; also of one without intensities, for which other verbs want to be told that."""
    own = None if reading.moves else sensor_in(path)
    told = {} if own is None else {"sensor": f"{own.name} (the file holds it)"}
    try:
        read = read_with_report(path, rings=reading.rings)
        beside, left = marks_left_out(path, *read), fields_left_out(path)
        told |= ({"beside": "; ".join(beside)} if beside else {}) | ({"left out": "; ".join(left)} if left else {})
        return scan_lines(*read, reading) | told
    except FileError as error:
        if WITHOUT not in str(error):
            raise
        lines, why = scan_lines(*read_with_report(path, "none", rings=reading.rings), reading), str(error)
        unfit = {"reflectance": why.removeprefix(f"{path}: ")}
        return lines | (NO_INTENSITY if "expected an intensity field" in why else unfit)


def scan_lines(scan: Scan, dropped: int, reading: Reading) -> Lines:
    """Points, range, reflectance, fields, sensor and frame of a scan, moved as `reading` says."""
    if reading.transform is not None:
        scan = moved(scan, reading.transform)
    own = [field for field in ("ring", "time", "label") if getattr(scan, field) is not None]
    fields = " ".join(["x y z reflectance", *own, *listed(name for name in scan.extra if name not in own)])
    if not len(scan):
        return {"points": "0", "fields": fields}
    name, reason = recognise(scan)
    depth, light = np.linalg.norm(scan.xyz, axis=1), scan.reflectance
    shades = f"{light.min():.2f} to {light.max():.2f}, mean {light.mean():.3f}"
    lines = {
        "points": f"{len(scan)}" + (f" ({dropped} without a return dropped)" if dropped else ""),
        "range": f"{depth.min():.2f} to {depth.max():.2f} m, median {np.median(depth):.2f} m",
        "reflectance": "; ".join(filter(None, (shades, darkness(scan)))),
        "fields": fields,
        "sensor": f"{name} ({reason})" if name else reason,
    }
    if name and (note := columns_note(own_columns(scan, get_sensor(name)))):
        lines["columns"] = note
    warning = check_frame(scan).warning()
    if warning:
        return lines | {"frame": warning}
    return lines | ({"stands": _stands(*found)} if (found := stance(scan.xyz)) is not None else {})


def _stands(height: float, nose: float, left: float) -> str:
    """Metres, and degrees of tilt, in the words of `sensor`; a tilt that may be a slope of the road is not told."""
    tilted = f", nose {nose:+.0f} and left side {left:+.0f} degrees up" if max(abs(nose), abs(left)) > LEANING else ""
    return f"about {height:.1f} m above the ground{tilted}"


def _bag(path: Path, reading: Reading) -> Lines:
    with open_bag(path) as bag:
        names = {topic.name for topic in bag.topics}
        lines = {"kind": f"bag of {bag.seconds:.1f} s, {plural(len(names), 'topic')}"}
        for topic in bag.topics:
            rate = f", {(topic.count - 1) / bag.seconds:.1f} a second" if bag.seconds > 0 and topic.count > 1 else ""
            told = f"{topic.kind}, {plural(topic.count, 'message')}{rate} ({topic.encoding})"
            lines[topic.name] = f"{lines[topic.name]}; {told}" if topic.name in lines else told
        if bag.cut:
            lines["ends early"] = "; ".join(text.removeprefix(f"{path}: ") for text in bag.cut)
        clouds = bag.scan_topics()
        if reading.metadata is not None and not any(bag.takes_metadata(name) for name in clouds):
            raise FileError(f"{path}: {OF_METADATA} {reading.metadata}, found none")
        told = [_first_of_topic(bag, name, reading) for name in clouds]
    if told and all(fault is not None for _, fault in told):
        raise FileError(f"{path}: {clouds[0]}: {told[0][1]}")
    for name, (found, fault) in zip(clouds, told, strict=True):
        lines |= {f"{name}: {key}": text for key, text in found.items()} | ({f"{name}: fault": fault} if fault else {})
    return lines


def _first_of_topic(bag: Bag, name: str, reading: Reading) -> tuple[Lines, str | None]:
    """What there is to say of the first scan of a topic, and what is wrong with it: others may be sound, as beside a
    topic of a map."""
    try:
        first = next(bag.clouds(name, metadata_from(reading.metadata, bag, name)), None)
        if isinstance(first, FileError):
            return {}, str(first).removeprefix(f"{bag.path}: {name}: ")
        if first is None:
            return {}, None
        scale = _scale(first)
        lines = scan_lines(*scan_from_fields(first.fields, scale, reading.rings), reading)
        lines |= {} if first.left_out is None else {"left out": first.left_out}
        return lines | (NO_INTENSITY if scale == "none" else {}), None
    except ValueError as error:
        return {}, str(error).removeprefix(f"{bag.path}: ")


def _scale(cloud: Cloud) -> str:
    known = ("reflectance", "reflectivity", "intensity", "remission", "intensities", "i")
    return "auto" if any(name.lower() in known for name in cloud.fields) else "none"


def _capture(path: Path, reading: Reading) -> Lines:
    sizes = Counter((p.sender, len(p.payload)) for p in islice(sound_datagrams(path), LOOKED_AT))
    listed = ", ".join(f"{count} of {size} bytes as {sender}" for (sender, size), count in sizes.most_common(6))
    listed += ", ..." if len(sizes) > 6 else ""
    lines = {"kind": "network capture", "packets": f"{listed or 'none'} (of the first {LOOKED_AT})"}
    found = senders(path, reading.metadata)
    for sender in found:
        scan, dropped = scan_from_fields(next(capture_turns(path, reading.metadata, sender)), rings=reading.rings)
        title = "first turn" if len(found) == 1 else f"--topic {sender}"
        lines |= {f"{title}: {key}": text for key, text in scan_lines(scan, dropped, reading).items()}
    return lines


def _angles(path: Path) -> Lines:
    up = read_angles(path).elevations
    beams = f"{len(up)} from {max(up):+.2f} to {min(up):+.2f} degrees"
    return {"kind": "angle correction file of a Hesai sensor, for --metadata", "beams": beams}


def _cache(path: Path) -> Lines:
    if not (path / INDEX).exists():  # killed before it was written
        return {"kind": f"cache of range images that was begun, still without {INDEX}; {GOES_ON}"}
    index = read_index(path)
    told, sensor = report(index), from_dict(index["sensor"], str(path), "own")
    lines = {"kind": "cache of range images, for training and as a reference", "images": str(told["stored"])}
    if lost := lost_shards(path, index, sensor):
        named = ", ".join(lost[:NAMED]) + (", ..." if lost[NAMED:] else "")
        lines["broken"] = f"{plural(len(lost), 'shard')} of {len(index['shards'])} gone or cut ({named}); " \
                          "the same data command makes them anew"  # fmt: skip
    if done(index) < index["count"]:
        lines["unfinished"] = f"{done(index)} of {plural(index['count'], 'scan')} done; {GOES_ON}"
    lines["sensor"] = f"{sensor.name}, {sensor.height} beams x {sensor.width} columns, to {sensor.max_range:g} m"
    lines |= {"projection": index["source"]["projection"]} if "projection" in index["source"] else {}
    return lines | {key: str(len(told[key])) for key in ("sequences", "skipped", "missing")}


def _folder(path: Path, reading: Reading) -> Lines:
    """A folder of scans, or of bags and captures: what it holds, what else, and the first scan."""
    files = scan_files(path) if has_scans(path) else []
    streams = streams_below(path)
    if not files and not streams:
        found = _counted(path, []) or "only caches or empty folders in it"
        raise FileError(f"{path}: expected scans, a bag, a cache or a model in the folder, found {found}")
    if not files and reading.moves:
        raise FileError(f"{path}: expected a scan to move or take rings of, found bags and captures: name one of them")
    if not files:
        listed = ", ".join(str(p.relative_to(path)) for p in streams[:6]) + (", ..." if len(streams) > 6 else "")
        kind = f"folder of {len(streams)} bags and captures" if streams[1:] else "folder of a bag or capture"
        return {"kind": kind, "files": listed}
    lines = {"kind": "folder of scans", "scans": _counted(None, files)}
    if rest := _counted(path, files):
        lines["passed over"] = rest
    if broken := [f"{file.relative_to(path)}: {what}" for file in files if (what := no_file(file)) is not None]:
        lines["broken"] = f"{len(broken)} of them: {', '.join(broken[:NAMED])}" + (", ..." if broken[NAMED:] else "")
    try:
        first = {f"first: {key}": text for key, text in _scan_file(files[0], reading).items()}
    except FileError as error:
        first = {"first: broken": str(error)}
    return lines | {"first": str(files[0].relative_to(path))} | first


def _counted(folder: Path | None, scans: list[Path]) -> str:
    """Files by ending, the most first: the scans, or what else is below `folder`."""
    beside = set(scans)
    below = (here / name for here, _, names in walk(folder) for name in names) if folder is not None else ()
    files = scans if folder is None else [path for path in below if path.is_file() and path not in beside]
    kinds = Counter(sorted(ending(file.name) for file in files))
    listed = [f"{count} {kind}" for kind, count in kinds.most_common(8)]
    return ", ".join(listed) + (", ..." if len(kinds) > 8 else "")


def ending(name: str) -> str:
    """What tells the kind of a file: .pcd.bin of a.pcd.bin, or the name of one without an ending."""
    known = [suffix for suffix in READERS if name.lower().endswith(suffix)]
    return max(known, key=len, default=Path(name).suffix.lower() or name)


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


MODELS = (".pth", ".pt", ".h5", ".toml")  # `load_parts` and `get_sensor` know them
STREAMS = (*SUFFIXES, ".pcap", ".pcapng")
KINDS: dict[str, Callable[[Path], Lines | None]] = {".safetensors": _tensors, ".json": json_lines}
