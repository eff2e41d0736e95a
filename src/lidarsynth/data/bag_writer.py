"""Point clouds into a new bag: ROS 1 `.bag`, or `.mcap` as ROS 2 records it, of ROS 1 where messages of that are
copied; other topics are copied as they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from lidarsynth.data.bag_errors import BROKEN, library_errors, one_line
from lidarsynth.data.bag_records import POINTS, Attached, Cloud, Message, Topic, cloud_of, typestore
from lidarsynth.files.fields import FileError
from lidarsynth.files.point_cloud2 import encode
from lidarsynth.lidar.whole_file import whole_file

Put: TypeAlias = "Callable[[Message | Attached], None]"
FORMATS = {".bag": "ros1", ".mcap": "cdr"}  # what each kind of file holds, unless it is told otherwise
PROFILES = {"ros1": "ros1", "cdr": "ros2"}  # of MCAP, by the encoding of its messages (mcap.dev/spec/registry)
NAMES = {"ros1": "ROS 1", "cdr": "ROS 2"}
MSG_CDR, MSG_ROS1 = "ros2msg", "ros1msg"


@dataclass
class BagWriter:
    """An open new bag."""

    path: Path
    encoding: str
    put: Put
    topics: dict[str, Topic] = field(default_factory=dict)

    def write_cloud(self, topic: str, cloud: Cloud) -> None:
        """A PointCloud2 with the cloud's stamp, frame and fields, recorded at its time."""
        with _telling(self.path):
            data = message_of(cloud, self.encoding)
            self.put(Message(self._topic(topic), cloud.time, data, cloud.published, cloud.sequence))

    def copy_cloud(self, topic: str, message: Message) -> bool:
        """A PointCloud2 of another bag among those of `topic`: its bytes as they are, in a bag of the other ROS its
        fields. Whether it could be."""
        if message.topic.encoding != self.encoding:
            try:
                self.write_cloud(topic, cloud_of(message))
            except FileError:  # a broken one
                return False
            return True
        with _telling(self.path):
            self.put(message._replace(topic=self._topic(topic)))
        return True

    def publish_as(self, topic: Topic) -> None:
        """Clouds on a topic of this name are to be published as it was (`Topic.offered`), in a bag of the same ROS."""
        if (topic.kind, topic.encoding) == (POINTS, self.encoding):
            self.topics[topic.name] = replace(points_topic(topic.name, self.encoding), offered=topic.offered)

    def _topic(self, name: str) -> Topic:
        if name not in self.topics:
            self.topics[name] = points_topic(name, self.encoding)
        return self.topics[name]

    def copy(self, message: Message) -> None:
        """A message of another bag as it is. Raises FileError where this kind of file cannot hold it."""
        _check_copied(self.path, message.topic, self.encoding)
        with _telling(self.path):
            self.put(message)

    def attach(self, record: Attached) -> bool:
        """An attachment, or metadata, of another MCAP file as it is. Whether this kind of file can hold it."""
        if self.path.suffix.lower() == ".bag":
            return False
        with _telling(self.path):
            self.put(record)
        return True


@contextmanager
def write_bag(path: str | Path, copied: Sequence[Topic] = ()) -> Iterator[BagWriter]:
    """A new `.bag` or `.mcap`; it appears whole or not at all, over an old one of that name.

    copied  topics whose messages are to be copied: where any is of ROS 1, so is all that a `.mcap` gets
    Raises FileError, also for topics that do not fit, and OSError that names it where it cannot be written; what else
    the block raises passes as it is.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise FileError(f"{path}: expected a name that ends in {', '.join(FORMATS)} for a bag, found {path.suffix!r}")
    encodings = {topic.encoding for topic in copied}
    encoding = "ros1" if "ros1" in encodings else FORMATS[path.suffix.lower()]
    for topic in copied:
        _check_copied(path, topic, encoding)
    profile = PROFILES[encoding] if encodings <= {encoding} else ""
    opened = _bag if path.suffix.lower() == ".bag" else partial(_mcap, profile)
    with whole_file(path) as scratch, opened(scratch) as put:
        yield BagWriter(path, encoding, put)


def _check_copied(path: Path, topic: Topic, encoding: str) -> None:
    """Raises FileError for a topic that a bag of this encoding cannot hold beside its points; MCAP holds any, but not
    ROS 1 and ROS 2 in one."""
    if path.suffix.lower() == ".bag" and topic.encoding != "ros1":
        raise FileError(f"{path}: expected messages of ROS 1 to copy into a .bag, found {topic.name} in "
                        f"{topic.encoding}; write a .mcap")  # fmt: skip
    if topic.encoding in PROFILES and topic.encoding != encoding:
        raise FileError(f"{path}: expected messages of {NAMES[encoding]} to copy beside points of it, found "
                        f"{topic.name} of {NAMES[topic.encoding]}")  # fmt: skip


@contextmanager
def _telling(path: Path) -> Iterator[None]:
    """Turns what a message makes a library raise into one line that names the bag; errors of the disk pass."""
    try:
        yield
    except (FileError, OSError):
        raise
    except (*BROKEN, *library_errors()) as error:
        raise FileError(f"{path}: expected a message that a bag can hold, found: {one_line(error)}") from None


def points_topic(name: str, encoding: str) -> Topic:
    """A topic of PointCloud2 with its definition in the words of ROS 1 (`ros1`) or ROS 2 (`cdr`)."""
    store = typestore(encoding)
    if encoding == "ros1":
        text, digest = store.generate_msgdef(POINTS)
        return Topic(name, POINTS, encoding, (MSG_ROS1, text.encode()), 0, digest)
    text, _ = store.generate_msgdef(POINTS, ros_version=2)
    return Topic(name, POINTS, encoding, (MSG_CDR, text.encode()), 0, store.hash_rihs01(POINTS))


def message_of(cloud: Cloud, encoding: str) -> bytes:
    """The bytes of a PointCloud2: little endian, packed, one row."""
    store, layout = typestore(encoding), encode(cloud.fields)
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](cloud.stamp // 10**9, cloud.stamp % 10**9)
    first = encoding == "ros1"
    header = types["std_msgs/msg/Header"](*([cloud.sequence] if first else []), stamp, cloud.frame_id)
    fields = [types["sensor_msgs/msg/PointField"](n, at, kind, 1) for n, at, kind in layout.fields]
    count = len(layout.data) // layout.point_step
    points: Any = types[POINTS](header, 1, count, fields, False, layout.point_step, len(layout.data), layout.data,
                                _dense(cloud))  # fmt: skip
    return bytes((store.serialize_ros1 if first else store.serialize_cdr)(points, POINTS))


def _dense(cloud: Cloud) -> bool:
    return all(bool(np.isfinite(cloud.fields[axis]).all()) for axis in "xyz" if axis in cloud.fields)


@contextmanager
def _bag(path: Path) -> Iterator[Put]:
    from rosbags.rosbag1 import Writer

    with Writer(path) as writer:
        connections: dict[Any, Any] = {}  # one for each node that published, whose last message may be a latched one

        def put(message: Message | Attached) -> None:
            assert isinstance(message, Message)
            topic = message.topic
            key = topic.name, topic.kind, topic.encoding, topic.offered
            if key not in connections:
                text, offered = topic.schema[1].decode(), dict(topic.offered)
                connections[key] = writer.add_connection(
                    topic.name,
                    topic.kind,
                    msgdef=text,
                    md5sum=topic.digest or _digest(topic.kind, text),
                    callerid=offered.get("callerid"),
                    latching=1 if offered.get("latching") == "1" else None,
                )
            writer.write(connections[key], message.time, message.data)

        yield put


def _digest(kind: str, text: str) -> str:
    """ROS 1's checksum of a message definition, of a bag that does not tell it, such as an MCAP file."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, kind))
    return store.generate_msgdef(kind)[1]


@contextmanager
def _mcap(profile: str, path: Path) -> Iterator[Put]:
    from mcap.records import Attachment, Metadata
    from mcap.writer import Writer

    with open(path, "xb") as file:
        writer = Writer(file)
        writer.start(profile=profile, library="lidarsynth")
        channels: dict[Any, int] = {}

        def put(message: Message | Attached) -> None:
            if isinstance(message, Metadata):
                return writer.add_metadata(message.name, message.metadata)
            if isinstance(message, Attachment):
                whose = message.name, message.media_type, message.data
                return writer.add_attachment(message.create_time, message.log_time, *whose)
            topic = message.topic
            key = topic.name, topic.kind, topic.encoding, topic.offered
            if key not in channels:
                kind = topic.kind.replace("/msg/", "/") if topic.schema[0] == MSG_ROS1 else topic.kind
                schema = writer.register_schema(kind, *topic.schema) if kind or topic.schema[1] else 0
                offered = dict(topic.offered)
                channels[key] = writer.register_channel(topic.name, topic.encoding, schema, metadata=offered)
            sent = message.time if message.published is None else message.published
            writer.add_message(channels[key], message.time, message.data, sent, message.sequence)

        yield put
        writer.finish()
