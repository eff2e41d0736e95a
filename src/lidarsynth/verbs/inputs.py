"""What verbs read: files, folders, globs, bags and captures alike, as one row of scans that are read when asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from lidarsynth.data.bag_records import Packed, cloud_of
from lidarsynth.data.bags import is_bag, metadata_from, open_bag
from lidarsynth.data.frames import moved
from lidarsynth.data.turns import unread_turns
from lidarsynth.data.whole_turns import Unread
from lidarsynth.files.fields import (
    PLACE,
    Fields,
    FileError,
    find,
    full_scale,
    scan_from_fields,
    written_names,
)
from lidarsynth.files.formats import holds_image, left_out, read_with_report, sensor_in
from lidarsynth.files.labels import labels_of
from lidarsynth.lidar.frame import transformed
from lidarsynth.lidar.marks import MARKS
from lidarsynth.lidar.plural import plural, was
from lidarsynth.lidar.removal import own_classes
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.verbs.earlier_results import earlier_results
from lidarsynth.verbs.expansion import (
    all_expanded,
    is_folder,
    is_stream,
    packed_below,
    scan_names,
    stream_folders,
    streams_below,
)

NAMED = 5  # bags and captures that are passed over
OF_METADATA = "expected a capture, or a bag of an Ouster's packets, for --metadata"


@dataclass(frozen=True)
class Reading:
    """How scans are read.

    intensity  scale, as in `files.formats.read_with_report`
    topic      of a bag, or ADDRESS:PORT of a sensor in a capture; None = the only one
    metadata   `.json` of the Ouster of a capture, or of packets in a bag, then also another bag that holds it; angle
               correction `.csv` of the Hesai of a capture; None = what the bag tells, or the only one beside it
    transform  (4, 4) that brings the points into the sensor's frame, or None
    labels     whether the words of a `.label` file that belongs to a scan are kept in `extra["raw_label"]`, and their
               classes as `label`
    needed     whether such a file that does not fit is refused; else it is left out, and a line says so
    rings      of a file of several sensors, the first and last ring to read, as it numbers them; None = all
    """

    intensity: str = "auto"
    topic: str | None = None
    metadata: Path | None = None
    transform: np.ndarray | None = None
    labels: bool = False
    needed: bool = False
    rings: tuple[int, int] | None = None

    @property
    def moves(self) -> bool:
        """Whether points are to be moved, or some rings of them taken."""
        return self.transform is not None or self.rings is not None


@dataclass(frozen=True)
class Loaded:
    """A scan that was read.

    scan     in the sensor's frame; of a message, or where a transform was asked for, `extra[PLACE]` is each point's
             place in `given`, from 1
    given    the columns of the message, or x y z of the file
    dropped  points without a return, or not finite
    scale    what a reflectance of 1 is in the intensities of a message
    stamp, frame_id, time, published, sequence  of a message, as of a `Cloud`, and so is its `left_out`
    sensor   of a range image, whose points were not moved and are on all of its beams; else None
    left_out  what is to be said of files beside it that do not fit, and of fields that are not kept, or None
    """

    scan: Scan
    given: Fields
    dropped: int
    scale: float = 1.0
    stamp: int = 0
    frame_id: str = ""
    time: int = 0
    published: int | None = None
    sequence: int = 0
    sensor: Sensor | None = None
    left_out: str | None = None


class Input(Protocol):
    """One scan to come. `name` is where its result belongs below the output folder, without an ending."""

    @property
    def name(self) -> str: ...
    @property
    def path(self) -> Path: ...
    def read(self) -> Loaded: ...


@dataclass(frozen=True)
class FileInput:
    """A scan file."""

    name: str
    path: Path
    reading: Reading

    def read(self) -> Loaded:
        """The scan. Raises FileError."""
        words = labels_of(self.path) if self.reading.labels and not holds_image(self.path) else None
        (scan, dropped), misfit = self._read_with(words)
        told = [*left_out(self.path, scan, dropped), *misfit]
        if self.reading.labels and scan.label is None:
            scan = replace(scan, label=own_classes(scan))
        sensor = None if self.reading.moves else sensor_in(self.path)
        return replace(_loaded(scan, dropped, self.reading), sensor=sensor, left_out="; ".join(told) or None)

    def _read_with(self, words: Path | None) -> tuple[tuple[Scan, int], list[str]]:
        """The scan with the words of its labels, how many points were dropped, and what is to be said of labels that do
        not fit."""
        how = self.path, self.reading.intensity, None
        try:
            return read_with_report(*how, words, self.reading.rings), []
        except FileError as error:
            if words is None or self.reading.needed:
                raise
            told = f"{words} left out: {str(error).removeprefix(f'{words}: ')}"
        return read_with_report(*how, None, self.reading.rings), [told]  # raises what else is wrong


@dataclass(frozen=True)
class MessageInput:
    """A point cloud in a bag, still in its bytes: a message, or a turn of an Ouster's packets."""

    name: str
    path: Path
    reading: Reading
    message: Packed

    def read(self) -> Loaded:
        """The scan, with the message's stamp and frame. Raises FileError that names bag and message."""
        try:
            cloud = cloud_of(self.message)
            how = self.reading.intensity, self.reading.rings
            places = np.arange(1, len(next(iter(cloud.fields.values()), ())) + 1)
            scan, dropped = scan_from_fields({**cloud.fields, PLACE: places}, *how)
            scale = full_scale(cloud.fields, *how)
            loaded = replace(_loaded(scan, dropped, self.reading), given=cloud.fields, scale=scale)
        except ValueError as error:
            raise FileError(f"{self.path}: {self.name}: {error}") from None
        own = {name: vars(cloud)[name] for name in ("stamp", "frame_id", "time", "published", "sequence", "left_out")}
        return replace(loaded, **own)


@dataclass(frozen=True)
class TurnInput:
    """A turn of a capture, still in its packets."""

    name: str
    path: Path
    reading: Reading
    turn: Unread

    def read(self) -> Loaded:
        """The scan. Raises FileError that names the capture."""
        try:
            return _loaded(*scan_from_fields(self.turn(), self.reading.intensity, self.reading.rings), self.reading)
        except ValueError as error:
            raise FileError(f"{self.path}: {self.name}: {error}") from None


@dataclass(frozen=True)
class BrokenInput:
    """What is left of a bag or capture from where it is broken; all of it where nothing tells what is to be read."""

    name: str
    path: Path
    error: str

    def read(self) -> Loaded:
        """Raises FileError."""
        raise FileError(self.error)


@dataclass(frozen=True)
class Inputs:
    """Scans to come, in order.

    single   True where one file was named, whose result may go to a file of any name
    count    how many there are, or None where only reading tells (captures)
    stream   gives them; from the start each time
    streams  whether bags or captures are among them
    passed   bags and captures in a folder of scan files, which alone are read
    below    scans below the output folder that are not read, though no report there tells of them
    cut      what is to be said, a line each, of bags that end early, or are compressed and not read
    places   where the result of each file belongs below the output folder, without an ending, and in which folder there
             those of each bag or capture
    """

    single: bool
    count: int | None
    stream: Callable[[], Iterator[Input]]
    streams: bool
    passed: tuple[Path, ...] = ()
    cut: tuple[str, ...] = ()
    below: tuple[Path, ...] = ()
    places: Mapping[Path, str] = field(default_factory=dict)

    @property
    def words(self) -> tuple[str, ...]:
        """What is to be said of `passed` and `cut`, a line each."""
        if not self.passed:
            return self.cut
        count, what = len(self.passed), "bags or captures" if self.passed[1:] else "bag or capture"
        named = ", ".join(map(str, self.passed[:NAMED])) + (", ..." if self.passed[NAMED:] else "")
        line = f"{count} {what} beside scan files {was(count)} passed over: {named}; name them to read them"
        return (line, *self.cut)


def inputs_of(paths: Sequence[Path], reading: Reading | None = None, out: Path | None = None) -> Inputs:
    """The scans of files, folders, globs, bags and captures, without the results that lie in an output folder `out`.
    Raises ValueError where there is nothing to read, or nothing that a topic or metadata could be of."""
    reading = reading or Reading()
    if not paths:
        raise ValueError("expected one scan or more, found none")
    expanded, below = all_expanded(paths, earlier_results(out))
    if not expanded:
        raise ValueError(f"{out}: expected scans to read, found only what lies in this output folder; name another")
    streams = [path for path in expanded if is_stream(path)]
    if reading.topic is not None and not streams:
        raise ValueError(f"expected a bag or a capture for --topic {reading.topic}, found none")
    files = [FileInput(name, path, reading) for name, path in scan_names(expanded)]
    single = len(files) == 1 and not streams and not (len(paths) == 1 and is_folder(paths[0]))
    count: int | None = len(files)
    folders = stream_folders(streams)
    cut = [words for folder in filter(is_folder, paths) if (words := _packed_words(packed_below(folder)))]
    packets = False
    for path in streams:
        try:
            more, of_packets = _stream_count(path, reading, cut)
        except ValueError:
            if len(expanded) == 1:
                raise
            more, of_packets = 1, True  # told in its place, and the others go on
        count, packets = None if more is None or count is None else count + more, packets or of_packets
    if reading.metadata is not None and not packets:
        raise ValueError(f"{OF_METADATA} {reading.metadata}, found none")

    def stream() -> Iterator[Input]:
        yield from files
        for path in streams:
            try:
                inputs = _bag_inputs if is_bag(path) else _capture_inputs
                yield from inputs(path, reading, folders[path])
            except ValueError as error:
                if len(expanded) == 1:
                    raise
                yield BrokenInput(folders[path], path, str(error))  # the others go on

    inside = [p for folder in filter(is_folder, paths) for p in streams_below(folder) if p not in streams]
    places = {item.path: item.name for item in files} | folders
    return Inputs(single, count, stream, bool(streams), tuple(inside), tuple(dict.fromkeys(cut)), below, places)


def _packed_words(packed: Sequence[Path]) -> str:
    """What is said of compressed bags that are not read, in one line; nothing of none."""
    named = ", ".join(map(str, packed[:NAMED])) + (", ..." if packed[NAMED:] else "")
    them, count = "them" if packed[1:] else "it", plural(len(packed), "compressed bag")
    return f"{count} {was(len(packed))} passed over: {named}; unpack {them} (zstd -d) to read {them}" if packed else ""


def _stream_count(path: Path, reading: Reading, cut: list[str]) -> tuple[int | None, bool]:
    """Scans of a bag, or None where only reading tells, and whether it, or a capture, holds packets that metadata may
    be of; `cut` gets what is to be said of it."""
    if not is_bag(path):
        return None, True
    with open_bag(path) as bag:
        name = bag.point_topic(reading.topic)
        cut += bag.cut
        return bag.count_of(name), bag.takes_metadata(name)


def _bag_inputs(path: Path, reading: Reading, folder: str) -> Iterator[Input]:
    with open_bag(path) as bag:
        topic = bag.point_topic(reading.topic)
        for number, scan in enumerate(bag.scans(topic, metadata_from(reading.metadata, bag, topic))):
            yield MessageInput(f"{folder}/{number:06d}", path, reading, scan)


def _capture_inputs(path: Path, reading: Reading, folder: str) -> Iterator[Input]:
    for number, turn in enumerate(unread_turns(path, reading.metadata, reading.topic)):
        yield TurnInput(f"{folder}/{number:06d}", path, reading, turn)


def _loaded(scan: Scan, dropped: int, reading: Reading) -> Loaded:
    given = dict(zip("xyz", scan.xyz.T, strict=True))
    if reading.transform is None:
        return Loaded(scan, given, dropped)
    extra = {PLACE: np.arange(1, len(scan) + 1), **scan.extra}  # that of a message stays
    return Loaded(moved(replace(scan, extra=extra), reading.transform), given, dropped)


def back_in_place(filled: Scan, loaded: Loaded, transform: np.ndarray | None) -> Scan:
    """A filled scan in the frame of its file: measured points bit by bit as given, new ones transformed back."""
    if transform is None:
        return filled
    place, old = filled.extra[PLACE] - 1, filled.extra[PLACE] > 0
    xyz = transformed(filled.xyz, np.linalg.inv(transform))
    given = np.stack([loaded.given[str(find(loaded.given, axis))] for axis in "xyz"], axis=1)
    xyz[old] = given[place[old]]
    return replace(filled, xyz=xyz)


def without_places(scan: Scan) -> Scan:
    """The scan without `extra[PLACE]`."""
    return replace(scan, extra={name: values for name, values in scan.extra.items() if name != PLACE})


def message_fields(filled: Scan, loaded: Loaded) -> Fields:
    """A filled scan as the columns that its message had, bit by bit for measured points, and `new`, `confidence`.

    New points have their x y z, a reflectance in the message's own scale, the ring number that their row, or the next
    one that has any, has there, the time of the points in their direction, and their class; other fields are 0.
    """
    given, new = loaded.given, filled.extra[PLACE] == 0
    place = np.where(new, 0, filled.extra[PLACE] - 1)
    fields = {name: column[place] for name, column in given.items()}
    for column in fields.values():
        column[new] = 0
    for i, axis in enumerate("xyz"):
        fields[str(find(given, axis))][new] = filled.xyz[new, i]
    old = ~new
    if (name := find(given, "reflectance")) is not None:
        fields[name][new] = (filled.reflectance[new] * loaded.scale).astype(fields[name].dtype)
    if (name := find(given, "ring")) is not None and filled.ring is not None:
        rows, first = np.unique(filled.ring[old], return_index=True)
        nearest = np.searchsorted((rows[1:] + rows[:-1]) / 2, filled.ring[new])
        fields[name][new] = fields[name][old][first][nearest]
    if (name := find(given, "time")) is not None:
        azimuth = np.arctan2(filled.xyz[:, 1], filled.xyz[:, 0])
        order = np.flatnonzero(old)[np.argsort(azimuth[old])]
        nearest = np.searchsorted(azimuth[order], azimuth[new]).clip(0, len(order) - 1)
        fields[name][new] = fields[name][order[nearest]]
    for word in sorted(filled.extra.keys() - fields.keys() - {*MARKS}):
        if (name := word.replace("file_", "")) in MARKS:  # which are none of ours
            fields[word] = fields.pop(name)
    more = {name: filled.extra[name] for name in ("confidence",) if name in filled.extra}
    if filled.label is not None:
        if (name := find(given, "label")) is not None and loaded.scan.label is not None:
            fields[name][new] = filled.label[new]
        else:
            if "label" in fields:  # of other words than ours
                fields[written_names(["label"], given)[0]] = fields.pop("label")
            more["label"] = filled.label.astype(np.uint8)
    return fields | {"new": filled.extra["new"]} | more
