"""What a bag holds, whatever its format: topics, messages, whose bytes wait until they are asked for, point clouds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from lidarsynth.data.bag_errors import BROKEN, library_errors, naming, one_line
from lidarsynth.data.capture import Datagram
from lidarsynth.data.velodyne import returns
from lidarsynth.files.fields import Fields, FileError
from lidarsynth.files.point_cloud2 import decode

if TYPE_CHECKING:
    from mcap.records import Attachment, Metadata

Attached: TypeAlias = "Attachment | Metadata"
POINTS = "sensor_msgs/msg/PointCloud2"
PACKET = "velodyne_msgs/msg/VelodynePacket"
PACKETS = "velodyne_msgs/msg/VelodyneScan"  # packets of about a turn, as velodyne_driver publishes them
PACKED = b"\x28\xb5\x2f\xfd"  # a frame of zstd (RFC 8878); a message in CDR begins with 0


@dataclass(frozen=True)
class Topic:
    """What one connection of a bag carries.

    name      such as /points
    kind      message type in ROS 2's style, such as sensor_msgs/msg/PointCloud2, or the schema's name
    encoding  of the messages: ros1, cdr (ROS 2), json, ...
    schema    (its own encoding, its text): the message definition
    count     messages, or 0 where the bag does not tell
    digest    checksum of the definition, ROS 1 and 2 only
    offered   how it was published, as words of the bag: `latching` and `callerid` of ROS 1, the quality of service of
              ROS 2; without them a latched message, as of /tf_static, is not played back as one
    """

    name: str
    kind: str
    encoding: str
    schema: tuple[str, bytes]
    count: int
    digest: str = ""
    offered: tuple[tuple[str, str], ...] = ()


class Message(NamedTuple):
    """One message.

    time       nanoseconds, when it was recorded
    data       its bytes
    published  nanoseconds, when it was sent, of MCAP; None = `time`
    sequence   its number, of MCAP; 0 where nobody counted
    """

    topic: Topic
    time: int
    data: bytes
    published: int | None = None
    sequence: int = 0


@dataclass(frozen=True)
class Cloud:
    """The points of one message.

    stamp     nanoseconds, of the header
    frame_id  the coordinate frame's name
    time      nanoseconds, when it was recorded
    fields    as `point_cloud2.decode`
    published, sequence  as of a `Message`; of ROS 1 the number is that of the header
    """

    stamp: int
    frame_id: str
    time: int
    fields: Fields
    published: int | None = None
    sequence: int = 0


@dataclass(frozen=True)
class Bag:
    """An open bag. `messages(names)` streams those of the topics named, or all; `seconds` is its duration.

    attached  gives the attachments and metadata of MCAP, records of its library, but what ROS 2 tells there of the file
    cut       what is to be said, a line a file, of a recording that ends early, as `cut_bags.Mended.words`
    """

    path: Path
    topics: tuple[Topic, ...]
    seconds: float
    source: Callable[[frozenset[str], int], Iterator[Message]]
    cut: tuple[str, ...] = ()
    attached: Callable[[], Iterator[Attached]] = lambda: iter(())

    def messages(self, names: frozenset[str] = frozenset(), start: int = 0) -> Iterator[Message]:
        """Messages in the order of their times, from `start` (nanoseconds) on. Raises FileError for a broken bag."""
        with naming(self.path):
            yield from self.source(names, start)

    def clouds(self, topic: str) -> Iterator[Cloud | FileError]:
        """The point clouds of a topic, one at a time; a broken one comes as its error, and the next follow."""
        for message in self.messages(frozenset([topic])):
            try:
                yield cloud_of(message)
            except FileError as error:
                yield FileError(f"{self.path}: {topic}: {error}")

    def point_topic(self, name: str | None = None) -> str:
        """The topic named, or the only one of points, else of packets. Raises ValueError that lists those there are."""
        clouds = [topic.name for topic in self.topics if topic.kind == POINTS]
        packets = [topic.name for topic in self.topics if topic.kind == PACKETS]
        clouds = [*clouds, *packets] if name in packets or not clouds else clouds
        listed = ", ".join(clouds) or "none; it holds " + (
            ", ".join(sorted({t.kind for t in self.topics})) or "nothing"
        )
        if name is None and len(clouds) == 1:
            return clouds[0]
        if name is None:
            expected = "one topic of points, or --topic" if clouds else f"a topic of {POINTS}"
            raise ValueError(f"{self.path}: expected {expected}, found {listed}")
        if name not in clouds:
            raise ValueError(f"{self.path}: expected a topic of points named {name}, found {listed}")
        return name


def opened(topic: Topic, data: bytes) -> bytes:
    """The bytes of a message, unpacked where `ros2 bag record --compression-mode message` has packed each: only the
    metadata.yaml beside the file tells of that. What does not unpack is given as it is."""
    if topic.encoding != "cdr" or data[:4] != PACKED:
        return data
    from zstandard import ZstdDecompressor, ZstdError

    try:
        return ZstdDecompressor().decompress(data)
    except (ZstdError, MemoryError):
        return data


def cloud_of(message: Message) -> Cloud:
    """The point cloud in a message of PointCloud2, or of packets. Raises FileError, without the bag's path, for one
    that is broken."""
    kind = message.topic.kind if message.topic.kind == PACKETS else POINTS
    store = typestore(message.topic.encoding)
    read = store.deserialize_ros1 if message.topic.encoding == "ros1" else store.deserialize_cdr
    try:
        points: Any = read(message.data, kind)
        stamp, frame_id = points.header.stamp, points.header.frame_id
        number = points.header.seq if message.topic.encoding == "ros1" else message.sequence
        times = stamp.sec * 10**9 + stamp.nanosec, frame_id, message.time
        fields = decode(points) if kind == POINTS else returns(map(_datagram, points.packets))
        return Cloud(*times, fields, message.published, number)
    except FileError:
        raise
    except (*BROKEN, *library_errors()) as error:
        raise FileError(f"expected a point cloud, found {len(message.data)} broken bytes: {one_line(error)}") from None


def _datagram(packet: Any) -> Datagram:
    return Datagram(packet.stamp.sec * 10**9 + packet.stamp.nanosec, 0, packet.data.tobytes())


_STORES: dict[str, Any] = {}  # encoding -> the types of that ROS; a second to build, so once


def typestore(encoding: str) -> Any:
    """rosbags' message types of ROS 1 (`ros1`) or ROS 2 (`cdr`). Raises FileError for another encoding."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    stores = {"ros1": Stores.ROS1_NOETIC, "cdr": Stores.LATEST}
    if encoding not in stores:
        raise FileError(f"expected messages of ROS 1 or ROS 2, found the encoding {encoding!r}")
    if encoding not in _STORES:
        store = _STORES[encoding] = get_typestore(stores[encoding])
        store.register(get_types_from_msg("builtin_interfaces/Time stamp\nuint8[1206] data", PACKET))
        store.register(get_types_from_msg(f"std_msgs/Header header\n{PACKET}[] packets", PACKETS))
    return _STORES[encoding]
