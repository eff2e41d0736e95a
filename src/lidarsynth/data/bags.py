"""ROS 1 bags, ROS 2 bags (sqlite3, MCAP) and bare MCAP files as streams of messages, without ROS (the extra `ros`).

Two libraries behind one record: `rosbags` for `.bag`, ROS 2 folders and `.db3`, `mcap` for `.mcap`. Messages stay bytes
until they are asked for, so that a bag of any size passes in the memory of one chunk.
"""

from __future__ import annotations

import heapq
import sqlite3
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from copy import copy
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import IO, Any, NamedTuple

from lidarsynth.data import ouster
from lidarsynth.data.angle_files import read_angles
from lidarsynth.data.bag_errors import BROKEN, check_packages, library_errors, naming
from lidarsynth.data.bag_records import HESAI, Attached, Bag, Message, Told, Topic, opened
from lidarsynth.data.cut_bags import Mended, mend
from lidarsynth.data.cut_databases import has_log, read_database
from lidarsynth.files.fields import FileError
from lidarsynth.lidar.small_file import check_regular

METADATA, KEY = "metadata.yaml", b"rosbag2_bagfile_information"  # of a folder that is a ROS 2 bag, which it begins with
LOOKED_AT = 4096  # bytes of it
COMPRESSED = (".mcap.zstd", ".db3.zstd")  # by `ros2 bag record --compression-mode file`
SUFFIXES = (".bag", ".bag.active", ".mcap", ".db3")  # active: what a killed `rosbag record` leaves


def is_bag(path: str | Path) -> bool:
    """Whether a path is a bag by its name, or a folder, of any name, that holds a ROS 2 bag."""
    path = Path(path)
    return _tells_of_a_bag(path / METADATA) if path.is_dir() else path.name.lower().endswith(SUFFIXES)


def _tells_of_a_bag(path: Path) -> bool:
    """Whether a file is the metadata of a ROS 2 bag: data sets have others of that name, a killed recording may have
    none that tells, and of a folder that cannot be read nobody knows."""
    with suppress(OSError):
        if path.is_file():
            with path.open("rb") as file:
                return KEY in file.read(LOOKED_AT)
    return False


def packed_bags(files: Iterable[str]) -> list[str]:
    """Of the files of a folder those that ROS 2 has compressed as a whole, and that do not lie there unpacked, too."""
    names = set(files)
    packed = (name for name in names if name.lower().endswith(COMPRESSED))
    return sorted(name for name in packed if name[: name.rindex(".")] not in names)


@contextmanager
def open_bag(path: str | Path) -> Iterator[Bag]:
    """A bag for reading. Raises FileError, in one line, for what is none, and where the extra `ros` is missing."""
    path = Path(path)
    if not path.exists():
        raise FileError(f"{path}: expected a bag, found nothing")
    check_packages()
    inside = sorted(path.glob("*.mcap")) if path.is_dir() else []
    if inside and (packed := packed_bags(entry.name for entry in path.iterdir())):
        raise FileError(f"{path}: expected parts of a bag that are all unpacked, or all packed, found {packed[0]} "
                        f"beside {inside[0].name}: unpack it (zstd -d)")  # fmt: skip
    for file in inside if path.is_dir() else [path]:
        try:
            check_regular(file)
        except ValueError as error:
            raise FileError(str(error)) from None
    bare = [path] if path.suffix.lower() == ".mcap" and not path.is_dir() else inside
    opened = _mcap(path, bare) if bare else _rosbags(path)
    with naming(path):
        bag = next(opened)
    try:
        yield bag
    finally:
        opened.close()


def metadata_from(path: Path | None, bag: Bag, topic: str) -> Told | None:
    """What a file tells of the sensor whose packets a topic of a bag holds: the angles of a Hesai in a `.csv`, the
    metadata of an Ouster in a `.json`, or in another bag, on the topic beside one of that name: of a recording that
    ROS 1 has split the first alone may hold it. None for no file, and for a topic of something else. Raises
    FileError."""
    if path is None or not bag.takes_metadata(topic):
        return None
    if bag.kind_of(topic) in HESAI:
        return read_angles(path)
    if not is_bag(path):
        return ouster.read_metadata(path)
    with open_bag(path) as other:
        return other.metadata_of(topic)


def _rosbags(path: Path) -> Generator[Bag, None, None]:
    """A ROS 1 `.bag`, a ROS 2 folder or a `.db3`, through rosbags."""
    first = not path.is_dir() and path.suffix.lower() != ".db3"
    offered = {} if first else _qualities(path)
    reader, cut = _ros1(path) if first else _ros2(path)
    with closing(reader):
        topics = {c.id: _topic(c, "ros1" if first else "cdr", offered) for c in reader.connections}
        parts = _files_of(reader)

        def messages(names: frozenset[str], start: int) -> Iterator[Message]:
            chosen = [c for c in reader.connections if not names or c.topic in names]
            each = (part.messages(chosen, start or None) for part in parts if chosen)
            for connection, time, data in heapq.merge(*each, key=lambda message: message[1]):
                yield Message(topics[connection.id], time, opened(topics[connection.id], bytes(data)))

        # rosbags counts to the nanosecond after the last message
        duration = max(reader.duration - 1, 0) / 1e9 if reader.message_count else 0.0
        yield Bag(path, _together(topics.values()), duration, messages, cut)


def _ros2(path: Path) -> tuple[Any, tuple[str, ...]]:
    """The reader of a ROS 2 folder or a database, opened, and what is to be said of a database that ends early. Raises
    FileError for one without a message."""
    from rosbags.rosbag2 import Reader

    reader = Reader(path)
    log = path.is_file() and has_log(path)  # which rosbags passes over
    try:
        if not log:
            reader.open()
            return reader, ()
    except (*BROKEN, *library_errors()):
        if path.is_dir() or (found := read_database(path)) is None:
            raise
    else:
        found = read_database(path)
    words = Mended(path, b"", 0, b"", found.message_count if found else 0, 0).words()
    if found is None or not found.rows:
        if found is not None:
            found.close()
        raise FileError(words)
    return found, (words,)


def _ros1(path: Path) -> tuple[Any, tuple[str, ...]]:
    """The reader of a ROS 1 bag, opened, and what is to be said of one that ends early. Raises FileError for one
    without a message."""
    from rosbags.rosbag1 import Reader

    reader = Reader(path)
    try:
        reader.open()
        return reader, ()
    except (*BROKEN, *library_errors()):
        mended: Any = mend(path)
        if mended is None:
            raise
        if not mended.messages:
            raise FileError(mended.words()) from None
        reader = Reader(mended)
        reader.open()
        return reader, (mended.words(),)


def _together(topics: Iterable[Topic]) -> tuple[Topic, ...]:
    """One of each name and type, with the messages of all: a topic has a connection for each node that published it,
    and so one more where a driver was started anew."""
    found: dict[tuple[str, str, str], Topic] = {}
    for topic in topics:
        before = found.get(_key(topic))
        found[_key(topic)] = topic if before is None else replace(before, count=before.count + topic.count)
    return tuple(found.values())


def _key(topic: Topic) -> tuple[str, str, str]:
    return topic.name, topic.kind, topic.encoding


def _files_of(reader: Any) -> list[Any]:
    """A reader of messages for each file of a ROS 2 folder, whose own reader goes by the order of the metadata, which
    need not be that of the times; of anything else the reader itself."""
    from rosbags.rosbag2 import Reader
    from rosbags.rosbag2.reader import DirectoryReader

    if not (isinstance(reader, Reader) and isinstance(reader.storage, DirectoryReader)):
        return [reader]
    parts = [copy(reader.storage) for _ in reader.storage.storages]
    for part, storage in zip(parts, reader.storage.storages, strict=True):
        part.storages = [storage]
    return parts


def _qualities(path: Path) -> dict[str, str]:
    """Topic -> the quality of service that its publishers offered, in the words of the databases at `path`, or of the
    metadata beside those that are compressed."""
    found = _told_qualities(path / METADATA) if path.is_dir() else {}
    for file in sorted(path.glob("*.db3")) if path.is_dir() else [path]:
        with suppress(sqlite3.Error), closing(sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro", uri=True)) as base:
            found |= dict(base.execute("SELECT name, offered_qos_profiles FROM topics"))
    return found


def _told_qualities(path: Path) -> dict[str, str]:
    """The same of a metadata.yaml, which holds them as text, since its version 9 as a list; none of one that does not
    tell."""
    from ruamel.yaml import YAML, YAMLError

    yaml, found = YAML(typ="safe"), dict[str, str]()
    with suppress(OSError, ValueError, LookupError, TypeError, AttributeError, YAMLError):
        for one in yaml.load(path.read_text(encoding="utf-8"))[KEY.decode()]["topics_with_message_count"]:
            name, told = one["topic_metadata"]["name"], one["topic_metadata"].get("offered_qos_profiles")
            if isinstance(told, list):
                text = StringIO()
                yaml.dump(told, text)
                told = text.getvalue().strip()
            if told:
                found[name] = told
    return found


def _topic(connection: Any, encoding: str, qualities: dict[str, str]) -> Topic:
    kind = {"ros1": "ros1msg"}.get(encoding, "ros2idl" if connection.msgdef.format.name == "IDL" else "ros2msg")
    text, name = connection.msgdef.data.encode(), connection.topic
    if encoding == "ros1":
        told = {"callerid": connection.ext.callerid, "latching": connection.ext.latching}
    else:
        told = {"offered_qos_profiles": qualities.get(name)}
    offered = tuple((key, str(word)) for key, word in told.items() if word is not None)
    return Topic(name, connection.msgtype, encoding, (kind, text), connection.msgcount, connection.digest, offered)


def _mcap(path: Path, files: list[Path]) -> Generator[Bag, None, None]:
    """MCAP files as one, whatever their names: a bare one, or those of a ROS 2 folder."""
    from contextlib import ExitStack

    with ExitStack() as stack:
        mended = {file: found for file in files if (found := mend(file)) is not None}
        if len(mended) == len(files) and not any(found.messages for found in mended.values()):
            raise FileError(mended[files[0]].words())
        streams = [stack.enter_context(mended.get(file, file).open("rb")) for file in files]
        parts = sorted(map(_mcap_part, streams), key=lambda part: part.first)
        topics = {_key(topic): topic for topic in _together(one for part in parts for one in part.topics.values())}

        def messages(names: frozenset[str], start: int) -> Iterator[Message]:
            for together in _overlapping(parts):
                each = (_mcap_messages(part, names, topics, start) for part in together)
                yield from heapq.merge(*each, key=lambda message: message.time)

        full = [part for part in parts if part.last]
        seconds = (max(part.last for part in full) - full[0].first) / 1e9 if full else 0.0
        words = tuple(found.words() for found in mended.values())
        yield Bag(path, tuple(topics.values()), seconds, messages, words, lambda: _attached(streams))


class _Part(NamedTuple):
    """An open MCAP file: its topics by channel, the times of its first and last message (nanoseconds), 0 where it has
    none, and whether it is read by its index."""

    stream: IO[bytes]
    topics: dict[int, Topic]
    first: int
    last: int
    indexed: bool


def _overlapping(parts: list[_Part]) -> list[list[_Part]]:
    """The parts, given in the order of their first messages: together those whose times overlap."""
    groups: list[list[_Part]] = []
    for part in parts:
        if groups and part.first < max(before.last for before in groups[-1]):
            groups[-1].append(part)
        else:
            groups.append([part])
    return groups


def _mcap_part(stream: IO[bytes]) -> _Part:
    """What a file holds, by its summary; one without, or with one that leaves out channels or schemas, as writers may
    to save room, is read through once."""
    from mcap.reader import make_reader

    summary = make_reader(stream).get_summary()
    s = None if summary is None else summary.statistics
    if summary is not None and s is not None and _tells_of(summary, s.channel_message_counts):
        counts = s.channel_message_counts
        topics = {
            number: _mcap_topic(channel, summary.schemas.get(channel.schema_id), counts.get(number, 0))
            for number, channel in summary.channels.items()
        }
        return _Part(stream, topics, s.message_start_time, s.message_end_time, True)
    seen: dict[int, list[Any]] = {}
    times = [0, 0]
    for schema, channel, message in _mcap_reader(stream, summary is None).iter_messages(log_time_order=False):
        times = [min(times[0] or message.log_time, message.log_time), max(times[1], message.log_time)]
        seen.setdefault(channel.id, [channel, schema, 0])[2] += 1
    topics = {number: _mcap_topic(*found) for number, found in seen.items()}
    return _Part(stream, topics, times[0], times[1], summary is None or _tells_of(summary, seen))


def _tells_of(summary: Any, channels: Iterable[int]) -> bool:
    """Whether a summary holds these channels, and the schemas of all that it holds."""
    schemas = {channel.schema_id for channel in summary.channels.values()} - {0}  # 0: it has none
    return set(channels) <= summary.channels.keys() and schemas <= summary.schemas.keys()


def _mcap_reader(stream: IO[bytes], indexed: bool) -> Any:
    """A reader by the index, if there is one, or from the first byte to the last, which asks no summary."""
    from mcap.reader import NonSeekingReader, make_reader

    stream.seek(0)
    return (make_reader if indexed else NonSeekingReader)(stream, validate_crcs=True)


def _mcap_topic(channel: Any, schema: Any, count: int) -> Topic:
    name = schema.name if schema else ""
    parts = name.split("/")
    kind = f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name  # ROS 1 leaves out msg
    text = (schema.encoding, schema.data) if schema else ("", b"")
    return Topic(channel.topic, kind, channel.message_encoding, text, count, offered=tuple(channel.metadata.items()))


def _mcap_messages(
    part: _Part, names: frozenset[str], topics: dict[tuple[str, str, str], Topic], start: int
) -> Iterator[Message]:
    reader = _mcap_reader(part.stream, part.indexed)
    for _, channel, message in reader.iter_messages(topics=sorted(names) or None, starting_at=start or None):
        topic = topics[_key(part.topics[channel.id])]
        told = message.publish_time, message.sequence
        yield Message(topic, message.log_time, opened(topic, message.data), *told)


def _attached(streams: Iterable[IO[bytes]]) -> Iterator[Attached]:
    """Attachments and metadata of MCAP files, whether their summaries list them or not."""
    from mcap.records import Attachment, Metadata
    from mcap.stream_reader import StreamReader

    for stream in streams:
        stream.seek(0)
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Attachment) or (isinstance(record, Metadata) and record.name != "rosbag2"):
                yield record
