"""What a bag holds, whatever its format: topics, messages, whose bytes wait until they are asked for, point clouds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from lidarsynth.data import hesai, ouster
from lidarsynth.data.angle_files import Angles
from lidarsynth.data.bag_errors import BROKEN, library_errors, naming, one_line
from lidarsynth.data.capture import Datagram
from lidarsynth.data.velodyne import returns
from lidarsynth.data.whole_turns import TimedTurn
from lidarsynth.files.fields import Fields, FileError
from lidarsynth.files.point_cloud2 import decode, fields_left_out

if TYPE_CHECKING:
    from mcap.records import Attachment, Metadata

Attached: TypeAlias = "Attachment | Metadata"
POINTS = "sensor_msgs/msg/PointCloud2"
PACKET = "velodyne_msgs/msg/VelodynePacket"
PACKETS = "velodyne_msgs/msg/VelodyneScan"  # packets of about a turn, as velodyne_driver publishes them
OUSTER = (  # a packet each, as ouster_ros publishes them; of its inertial sensor, too, on another topic
    "ouster_ros/msg/PacketMsg", "ouster_sensor_msgs/msg/PacketMsg", "ouster_msgs/msg/PacketMsg"
)  # fmt: skip
HESAI = (
    "hesai_lidar/msg/PandarScan",
    "hesai_ros_driver/msg/UdpFrame",
)  # packets of about a turn, as its drivers cut it
OF_PACKETS = (PACKETS, *HESAI, *OUSTER)
Told: TypeAlias = "ouster.Metadata | Angles"  # what is to be known of a sensor whose packets do not tell its beams
STRING = "std_msgs/msg/String"  # as which it publishes the metadata
LARGE = 1000  # bytes: smaller packets are inertial measurements
ASKED = "in or beside the bag, or a bag as --metadata that holds it (the first of a split recording)"
FRAME = "os_sensor"  # the driver's name of the frame that an Ouster's points are in
PACKED = b"\x28\xb5\x2f\xfd"  # a frame of zstd (RFC 8878); a message in CDR begins with 0


@dataclass(frozen=True)
class Topic:
    """What one connection of a bag carries: messages of one type; a name may have several.

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


class AngledMessage(NamedTuple):
    """A message of a Hesai's packets, and its beams' angles; None where the packets do not tell whose they are."""

    message: Message
    angles: Angles | None

    @property
    def time(self) -> int:
        """Nanoseconds, when it was recorded."""
        return self.message.time


Packed: TypeAlias = "Message | AngledMessage | TimedTurn"  # a scan still in its bytes


@dataclass(frozen=True)
class Cloud:
    """The points of one message.

    stamp     nanoseconds, of the header
    frame_id  the coordinate frame's name
    time      nanoseconds, when it was recorded
    fields    as `point_cloud2.decode`
    published, sequence  as of a `Message`; of ROS 1 the number is that of the header
    left_out  what is to be said of fields that are not kept, or None
    """

    stamp: int
    frame_id: str
    time: int
    fields: Fields
    published: int | None = None
    sequence: int = 0
    left_out: str | None = None


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

    def scans(self, topic: str, told: Told | None = None, start: int = 0) -> Iterator[Packed]:
        """The scans of a topic, still in their bytes: messages, from `start` (nanoseconds) on, or, of an Ouster's
        packets, all turns (`whole_turns`).

        told  of the Ouster; None = as `metadata_of`; of the Hesai; None = as `hesai.angles_for`
        Raises FileError for a broken bag, where nothing tells of an Ouster or Hesai, and for packets of another.
        """
        if self.kind_of(topic) in OUSTER:
            return self._turns(topic, None if isinstance(told, Angles) else told)
        if self.kind_of(topic) in HESAI:
            return self._angled(topic, told if isinstance(told, Angles) else None, start)
        return self._messages(topic, start)

    def _angled(self, topic: str, angles: Angles | None, start: int) -> Iterator[AngledMessage]:
        """A Hesai's messages with its angles; whose they must be its first packet tells."""
        for message in self._messages(topic, start):
            if angles is None and (layout := _layout_in(message)) is not None:
                angles = hesai.angles_for(layout, self.path, None)
            yield AngledMessage(message, angles)

    def count_of(self, topic: str) -> int | None:
        """How many scans a topic holds, or None where only reading tells."""
        kind = self.kind_of(topic)
        counts = [one.count for one in self.topics if (one.name, one.kind) == (topic, kind)]
        return None if kind in OUSTER else sum(counts) or None

    def takes_metadata(self, topic: str) -> bool:
        """Whether a topic is of an Ouster's or Hesai's packets, which do not tell their beams themselves."""
        return self.kind_of(topic) in (*OUSTER, *HESAI)

    def kind_of(self, topic: str) -> str:
        """The type of a topic's messages; of several that which is read: points, else packets."""
        kinds = [one.kind for one in self.topics if one.name == topic]
        return next((kind for kind in (POINTS, *OF_PACKETS, *kinds) if kind in kinds), "")

    def _messages(self, topic: str, start: int = 0, kind: str | None = None) -> Iterator[Message]:
        """Those of a topic that are of one type; None = that which is read."""
        kind = self.kind_of(topic) if kind is None else kind
        return (message for message in self.messages(frozenset([topic]), start) if message.topic.kind == kind)

    def _turns(self, topic: str, metadata: ouster.Metadata | None) -> Iterator[TimedTurn]:
        described = metadata or self.metadata_of(topic)
        try:
            size = ouster.packet_size(described)
        except FileError as error:
            raise FileError(f"{self.path}: {error}") from None
        first, found = next(self._packets(topic, size), None), 0
        if first is not None and len(first.payload) != size:
            raise FileError(f"{self.path}: expected packets of {size} bytes on {topic}, as its metadata says, found "
                            f"one of {len(first.payload)}")  # fmt: skip
        for turn in ouster.timed_turns(self._packets(topic, size), described):
            found += 1
            yield turn
        if not found:
            raise FileError(f"{self.path}: expected a turn of the LiDAR on {topic}, found less than half of one")

    def _packets(self, topic: str, size: int) -> Iterator[Datagram]:
        """The packets of a topic; the driver's older versions put one byte more after those of `size`."""
        for message in self._messages(topic):
            try:
                payload = _deserialized(message, message.topic.kind).buf.tobytes()
            except (*BROKEN, *library_errors()) as error:
                raise FileError(f"{self.path}: {topic}: expected a packet, found {len(message.data)} broken bytes: "
                                f"{one_line(error)}") from None  # fmt: skip
            yield Datagram(message.time, 0, payload[:size] if len(payload) == size + 1 else payload)

    def metadata_of(self, topic: str) -> ouster.Metadata:
        """What tells of the Ouster whose packets a topic holds: the topic of metadata beside it, else the only one in
        the bag, else the only `.json` beside the bag. Raises FileError where none does."""
        strings = [self._first(one) for one in self.topics if one.kind == STRING]
        told = {one.topic.name: one for one in strings if one is not None and ouster.KEY.encode() in one.data}
        beside = f"{topic.rpartition('/')[0]}/metadata"
        own = [beside] if beside in told else sorted(told)
        if not own:
            return ouster.read_metadata(ouster.metadata_beside(self.path, ASKED))
        if len(own) > 1:
            raise FileError(f"{self.path}: expected --metadata FILE.json of the Ouster of {topic}, found in the bag "
                            f"that of several: {', '.join(own)}")  # fmt: skip
        where = f"{self.path}: {own[0]}"
        try:
            text = _deserialized(told[own[0]], STRING).data
        except (*BROKEN, *library_errors()) as error:
            raise FileError(f"{where}: expected Ouster metadata, found: {one_line(error)}") from None
        return ouster.parse_metadata(text, where, self.path.stem)

    def _first(self, topic: Topic) -> Message | None:
        return next(self._messages(topic.name, kind=topic.kind), None)

    def clouds(self, topic: str, told: Told | None = None) -> Iterator[Cloud | FileError]:
        """The point clouds of a topic, as `scans`, one at a time; a broken one comes as its error, and the next
        follow."""
        for scan in self.scans(topic, told):
            try:
                yield cloud_of(scan)
            except FileError as error:
                yield FileError(f"{self.path}: {topic}: {error}")

    def point_topic(self, name: str | None = None) -> str:
        """The topic named, or the only one of points, else of packets; of several the only one that has messages.
        Raises ValueError that lists those there are."""
        clouds = list(dict.fromkeys(topic.name for topic in self.topics if topic.kind == POINTS))
        packets = [topic.name for topic in self.topics if self._of_lidar(topic)]
        clouds = [*clouds, *packets] if name in packets or not clouds else clouds
        listed = ", ".join(clouds) or "none; it holds " + (
            ", ".join(sorted({t.kind for t in self.topics})) or "nothing"
        )
        if name is None and len(clouds) > 1:
            full = [one for one in clouds if any(topic.count for topic in self.topics if topic.name == one)]
            clouds = full if len(full) == 1 else clouds
        if name is None and len(clouds) == 1:
            return clouds[0]
        if name is None:
            expected = "one topic of points, or --topic" if clouds else f"a topic of {POINTS}"
            raise ValueError(f"{self.path}: expected {expected}, found {listed}")
        if name not in clouds:
            raise ValueError(f"{self.path}: expected a topic of points named {name}, found {listed}")
        return name

    def scan_topics(self) -> list[str]:
        """Topics that hold scans: points, or packets of a LiDAR."""
        found = [one.name for one in self.topics if one.kind == POINTS or self._of_lidar(one)]
        return list(dict.fromkeys(found))

    def _of_lidar(self, topic: Topic) -> bool:
        """Whether a topic is of a LiDAR's packets: those of an Ouster's inertial sensor are small."""
        first = self._first(topic) if topic.kind in OUSTER else None
        return topic.kind in (PACKETS, *HESAI) or (first is not None and len(first.data) > LARGE)


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


def cloud_of(scan: Packed) -> Cloud:
    """The point cloud in a message of PointCloud2, or of packets, or in a turn of an Ouster's: its stamp is then when
    the first packet was recorded, and its time when the last was. Raises FileError, without the bag's path, for one
    that is broken."""
    if isinstance(scan, TimedTurn):
        return Cloud(scan.stamp, FRAME, scan.time, scan.turn())
    message, angles = scan if isinstance(scan, AngledMessage) else (scan, None)
    kind = message.topic.kind if message.topic.kind in (PACKETS, *HESAI) else POINTS
    try:
        points = _deserialized(message, kind)
        stamp, frame_id = points.header.stamp, points.header.frame_id
        number = points.header.seq if message.topic.encoding == "ros1" else message.sequence
        times = stamp.sec * 10**9 + stamp.nanosec, frame_id, message.time
        fields = decode(points) if kind == POINTS else _returns(message, points, angles)
        left_out = fields_left_out(points.fields) if kind == POINTS else None
        return Cloud(*times, fields, message.published, number, left_out)
    except FileError:
        raise
    except (*BROKEN, *library_errors()) as error:
        raise FileError(f"expected a point cloud, found {len(message.data)} broken bytes: {one_line(error)}") from None


def _returns(message: Message, scan: Any, angles: Angles | None) -> Fields:
    """The returns of a message of packets."""
    packets = _datagrams(message, scan)
    return returns(packets) if message.topic.kind == PACKETS else hesai.returns(packets, angles)


def _layout_in(message: Message) -> hesai.Layout | None:
    """What the packets of a Hesai in a message are; None where they, or the message, are broken."""
    try:
        return hesai.layout_in(_datagrams(message, _deserialized(message, message.topic.kind)))
    except (FileError, *BROKEN, *library_errors()):
        return None


def _deserialized(message: Message, kind: str) -> Any:
    store = defined(message.topic) if kind in HESAI else typestore(message.topic.encoding)
    read = store.deserialize_ros1 if message.topic.encoding == "ros1" else store.deserialize_cdr
    return read(message.data, kind)


def _datagrams(message: Message, scan: Any) -> list[Datagram]:
    """The packets in a message; one that says no time has that of the message. Raises FileError for other fields."""
    found: list[Datagram] = []
    for held in map(vars, vars(scan).get("packets", [scan])):
        if "data" not in held:
            raise FileError(f"expected packets with data in a {message.topic.kind}, found {', '.join(held)}")
        time = held["stamp"].sec * 10**9 + held["stamp"].nanosec if "stamp" in held else message.time
        data = held["data"].tobytes()
        found.append(Datagram(time, 0, data[: held.get("size", len(data))]))
    return found


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
        for kind in OUSTER:
            store.register(get_types_from_msg("uint8[] buf", kind))
    return _STORES[encoding]


def defined(topic: Topic) -> Any:
    """The types of a topic's ROS, and those of its messages as the bag itself defines them. Raises FileError where it
    does not."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    language, text = topic.schema[0], topic.schema[1].decode("utf-8", "replace")
    if not text.strip() or language not in ("ros1msg", "ros2msg"):
        raise FileError(f"expected a bag that defines {topic.kind}, found {'another language' if text else 'none'}")
    key = f"{topic.encoding} {text}"
    if key not in _STORES:
        known = typestore(topic.encoding).types  # refuses other encodings
        store = get_typestore(Stores.ROS1_NOETIC if topic.encoding == "ros1" else Stores.LATEST)
        types = get_types_from_msg(text, topic.kind)
        store.register({name: told for name, told in types.items() if name not in known})
        _STORES[key] = store
    return _STORES[key]
