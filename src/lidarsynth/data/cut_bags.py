"""Bags that a killed recorder left, up to where they end: the index that was never written is made anew, in memory."""

from __future__ import annotations

import io
import math
import struct
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple
from zlib import crc32

from lidarsynth.data.bag_errors import BROKEN, library_errors
from lidarsynth.files.fields import MAX_BYTES
from lidarsynth.lidar.plural import plural

MCAP = b"\x89MCAP0\r\n"  # the first and the last bytes of an MCAP file (mcap.dev/spec)
ROS1 = b"#ROSBAG V2.0\n"  # the first of a ROS 1 bag (wiki.ros.org/Bags/Format/2.0)
ROS1_HEADER, ROS1_MESSAGE, ROS1_INDEX, ROS1_CHUNK, ROS1_CHUNK_INFO, ROS1_CONNECTION = 3, 2, 4, 5, 6, 7  # its records


@dataclass(frozen=True)
class Mended:
    """A file as a whole bag; to `rosbags` it is a path.

    head      bytes in place of those at its start
    end       bytes of it that count
    tail      bytes that follow there
    messages  before the end
    torn      bytes after it that are left out
    """

    path: Path
    head: bytes
    end: int
    tail: bytes
    messages: int
    torn: int

    def words(self) -> str:
        """What is said of it, in one line."""
        early = "one that ends early, as of a recording that was killed"
        if not self.messages:
            return f"{self.path}: expected a bag with a whole message, found {early}, before its first"
        torn = f", the last {plural(self.torn, 'byte')} hold no whole one" if self.torn else ""
        return f"{self.path}: expected a whole bag, found {early}: {plural(self.messages, 'message')} read{torn}"

    def exists(self) -> bool:
        """Whether there is a file."""
        return self.path.exists()

    def open(self, mode: Literal["rb"]) -> BinaryIO:
        """The bytes of the whole bag."""
        return io.BufferedReader(_Spliced(open(self.path, mode), self))


class _Spliced(io.RawIOBase):
    """The bytes of a file that is mended."""

    def __init__(self, file: BinaryIO, mended: Mended):
        self._file, self._mended, self._at = file, mended, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = 0) -> int:
        begin = (0, self._at, self._mended.end + len(self._mended.tail))[whence]
        if begin + offset < 0:
            raise ValueError(f"expected a place in the file, found {begin + offset}")
        self._at = begin + offset
        return self._at

    def readinto(self, buffer: Any, /) -> int:
        whole, at = self._mended, self._at
        if at < len(whole.head):
            part = whole.head[at : at + len(buffer)]
        elif at < whole.end:
            self._file.seek(at)
            part = self._file.read(min(len(buffer), whole.end - at))
        else:
            part = whole.tail[at - whole.end : at - whole.end + len(buffer)]
        buffer[: len(part)] = part
        self._at += len(part)
        return len(part)

    def close(self) -> None:
        self._file.close()
        super().close()


def mend(path: Path) -> Mended | None:
    """What makes a whole bag of one that ends early; None for a whole MCAP file, and what nobody can mend.

    Of a ROS 1 bag, whose end does not tell, it is never None.
    """
    told = path.stat()
    return _mend(path, told.st_size, told.st_mtime_ns)


@lru_cache(maxsize=16)
def _mend(path: Path, size: int, changed: int) -> Mended | None:
    """The same, once for each state of a file: all of it is read."""
    with open(path, "rb") as file:
        begun = file.read(len(ROS1))
        if begun.startswith(MCAP):
            file.seek(max(size - len(MCAP), 0))
            return None if size >= 2 * len(MCAP) and file.read() == MCAP else _mcap(path, file, size)
        if begun == ROS1:
            return _ros1(path, file, size)
        return Mended(path, b"", 0, b"", 0, size) if MCAP.startswith(begun) or ROS1.startswith(begun) else None


def _mcap(path: Path, file: BinaryIO, size: int) -> Mended:
    """Of an MCAP file: all before the first record that is not whole, of no kind, or broken; of a chunk that is cut
    off the records in it that are whole, as another chunk."""
    from mcap.opcode import Opcode

    found, at, kind = _Found(), len(MCAP), 0
    torn, rest = None, b""
    file.seek(at)
    while len(begin := file.read(9)) == 9:
        kind, length = struct.unpack("<BQ", begin)
        if at + 9 + length > size:
            torn = _torn_chunk(file.read(MAX_BYTES)) if kind == Opcode.CHUNK else None
            break
        if kind in (0, Opcode.DATA_END) or not found.takes(kind, at, file.read(length)):
            break
        at += 9 + length
    left = 0 if kind == Opcode.DATA_END else size - at
    if torn is not None and found.takes(Opcode.CHUNK, at, torn[0][9:]):
        rest, left = torn
    tail = rest + found.written_at(at + len(rest))
    return Mended(path, b"", at, tail, found.counts.total(), left)


def _torn_chunk(data: bytes) -> tuple[bytes, int] | None:
    """The record of a chunk with what is whole of one that is cut off (`data` after its kind and length), and how many
    bytes are not; None where nothing is."""
    import lz4.frame
    import zstandard
    from mcap.data_stream import RecordBuilder
    from mcap.records import Chunk

    opened = {b"": bytes, b"zstd": zstandard.ZstdDecompressor().decompressobj().decompress,
              b"lz4": lz4.frame.LZ4FrameDecompressor().decompress}  # fmt: skip
    try:
        first, last, _, _, named = struct.unpack_from("<QQQII", data)
        held = opened[data[32 : 32 + named]](data[40 + named :])
    except (*BROKEN, *library_errors()):
        return None
    end = 0
    while end + 9 <= len(held):
        kind, length = struct.unpack_from("<BQ", held, end)
        if kind == 0 or end + 9 + length > len(held):
            break
        end += 9 + length
    builder = RecordBuilder()
    Chunk("", held[:end], last, first, crc32(held[:end]), end).write(builder)
    return (builder.end(), len(held) - end) if end else None


@dataclass
class _Found:
    """What an MCAP file holds, as its summary says it: records by their numbers, messages by their channels'."""

    schemas: dict[int, Any] = field(default_factory=dict)
    channels: dict[int, Any] = field(default_factory=dict)
    chunks: list[Any] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    times: list[int] = field(default_factory=list)  # of the first and the last message

    def takes(self, kind: int, at: int, data: bytes) -> bool:
        """Counts a record that stands at `at`, of `data` after its kind and length. Whether it is sound."""
        from mcap.data_stream import ReadDataStream
        from mcap.opcode import Opcode
        from mcap.records import Channel, Chunk, ChunkIndex, Message, Schema
        from mcap.stream_reader import breakup_chunk

        if kind not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK):
            return True
        chunked = kind == Opcode.CHUNK
        alone = struct.pack("<BQ", kind, len(data)) + data  # as a chunk of its own
        try:
            chunk = Chunk.read(ReadDataStream(BytesIO(data))) if chunked else Chunk("", alone, 0, 0, 0, len(alone))
            records = breakup_chunk(chunk, validate_crc=True)
        except (*BROKEN, *library_errors()):
            return False
        schemas = self.schemas | {r.id: r for r in records if isinstance(r, Schema)}
        channels = self.channels | {r.id: r for r in records if isinstance(r, Channel)}
        messages = [record for record in records if isinstance(record, Message)]
        whose = {channels[m.channel_id].schema_id if m.channel_id in channels else None for m in messages}
        if not whose <= {0, *schemas}:
            return False  # whose kind nobody tells
        self.schemas, self.channels = schemas, channels
        self.counts.update(message.channel_id for message in messages)
        times = [*self.times, *(message.log_time for message in messages)]
        self.times = [min(times), max(times)] if times else []
        if chunked:
            place = ChunkIndex(
                chunk_length=9 + len(data),
                chunk_start_offset=at,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.message_end_time,
                message_index_length=0,
                message_index_offsets={},
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
            self.chunks.append(place)
        return True

    def written_at(self, at: int) -> bytes:
        """The end of a file whose records end at `at`: the summary and what is around it."""
        from mcap.data_stream import RecordBuilder
        from mcap.records import DataEnd, Footer, Statistics

        first, last = self.times or (0, 0)
        told = Statistics(
            attachment_count=0,
            channel_count=len(self.channels),
            channel_message_counts=self.counts,
            chunk_count=len(self.chunks),
            message_count=self.counts.total(),
            message_end_time=last,
            message_start_time=first,
            metadata_count=0,
            schema_count=len(self.schemas),
        )
        tail = RecordBuilder()
        DataEnd(0).write(tail)
        start = at + tail.count
        for record in (*self.schemas.values(), *self.channels.values(), told, *self.chunks):
            record.write(tail)
        Footer(start, 0, 0).write(tail)
        return tail.end() + MCAP


def _ros1(path: Path, file: BinaryIO, size: int) -> Mended | None:
    """Of a ROS 1 bag: all before the first chunk that is not whole, or without the places of its messages after it; of
    that one the messages that are whole, as another chunk. None for one that is encrypted."""
    file.seek(len(ROS1))
    begin = _ros1_header(file, size)
    if begin is None or begin[0].get("encryptor"):
        return Mended(path, b"", 0, b"", 0, size) if begin is None else None
    end = file.seek(begin[1], 1)
    room, messages = end - len(ROS1), 0
    connections: dict[int, bytes] = {}
    chunks: list[bytes] = []
    while (found := _ros1_chunk(file, size, connections)) is not None:
        chunks.append(found.told(end))
        messages, end = messages + found.counts.total(), file.tell()
    file.seek(end)
    ended = (after := _ros1_header(file, size)) is not None and after[0]["op"][0] == ROS1_CONNECTION
    rest, left = b"", 0 if ended else size - end
    file.seek(end)
    if not ended and (torn := _ros1_torn_chunk(file, size, connections)) is not None:
        rest, left, found = torn
        chunks.append(found.told(end))
        messages += found.counts.total()
    told = {"op": bytes([ROS1_HEADER]), "index_pos": struct.pack("<Q", end + len(rest))}
    told |= {"conn_count": struct.pack("<I", len(connections)), "chunk_count": struct.pack("<I", len(chunks))}
    head = ROS1 + _ros1_record(told, b" " * (room - len(_ros1_record(told, b""))))
    tail = b"".join((rest, *connections.values(), *chunks))
    return Mended(path, head, end, tail, messages, left)


def _ros1_header(file: BinaryIO, size: float) -> tuple[dict[str, bytes], int] | None:
    """The header of the record that `file` is at, and how many bytes follow it; None where they are not all there."""
    from rosbags.rosbag1.reader import Header, ReaderError, read_uint32

    try:
        header, length = Header.read(file), read_uint32(file)
    except (ReaderError, UnicodeDecodeError):
        return None
    return (header, length) if len(header.get("op", b"")) == 1 and file.tell() + length <= size else None


def _ros1_record(header: dict[str, bytes], data: bytes) -> bytes:
    fields = [f"{name}=".encode() + value for name, value in header.items()]
    told = b"".join(struct.pack("<I", len(one)) + one for one in fields)
    return struct.pack("<I", len(told)) + told + struct.pack("<I", len(data)) + data


class _Inside(NamedTuple):
    """What is in a chunk of a ROS 1 bag: by connection the places of its messages, as (seconds, nanoseconds, byte), and
    the records of its own connections; `end` is where the last whole record ends."""

    places: dict[int, list[tuple[int, int, int]]]
    own: dict[int, bytes]
    end: int

    @property
    def counts(self) -> Counter[int]:
        """Messages by connection."""
        return Counter({number: len(places) for number, places in self.places.items()})

    def told(self, at: int) -> bytes:
        """The record that tells of the chunk, which stands at `at`."""
        times = [place[:2] for places in self.places.values() for place in places]
        return _ros1_record({
            "op": bytes([ROS1_CHUNK_INFO]), "ver": struct.pack("<I", 1), "chunk_pos": struct.pack("<Q", at),
            "start_time": struct.pack("<II", *min(times)), "end_time": struct.pack("<II", *max(times)),
            "count": struct.pack("<I", len(self.places)),
        }, b"".join(struct.pack("<II", *pair) for pair in self.counts.items()))  # fmt: skip


def _ros1_inside(data: bytes, connections: dict[int, bytes]) -> _Inside | None:
    """What is in a chunk of these bytes, up to the first record that is not whole; None where no message of a known
    connection is."""
    inside, end, places, own = BytesIO(data), 0, dict[int, list[tuple[int, int, int]]](), dict[int, bytes]()
    with suppress(*BROKEN, *library_errors()):  # a record that is none ends it
        while end < len(data) and (found := _ros1_header(inside, len(data))) is not None:
            header, length = found
            after = inside.seek(length, 1)
            (number,) = struct.unpack("<I", header["conn"])
            if header["op"][0] == ROS1_CONNECTION:
                own[number] = data[end:after]
            elif header["op"][0] == ROS1_MESSAGE:
                places.setdefault(number, []).append((*struct.unpack("<II", header["time"]), end))
            end = after
    return _Inside(places, own, end) if places and places.keys() <= {*connections, *own} else None


def _ros1_chunk(file: BinaryIO, size: int, connections: dict[int, bytes]) -> _Inside | None:
    """What is in the chunk that `file` is at, which is then past the places of its messages; its connections are added
    to those known. None where it is not sound."""
    from rosbags.rosbag1.reader import decompressors

    if (begin := _ros1_header(file, size)) is None or begin[0]["op"][0] != ROS1_CHUNK:
        return None
    try:
        data = decompressors[begin[0]["compression"].decode()](file.read(begin[1]))
    except (*BROKEN, *library_errors()):
        return None
    found = _ros1_inside(data, connections)
    if found is None or found.end < len(data):
        return None
    for _ in found.places:
        if (begin := _ros1_header(file, size)) is None or begin[0]["op"][0] != ROS1_INDEX:
            return None
        file.seek(begin[1], 1)
    connections |= found.own
    return found


def _ros1_torn_chunk(file: BinaryIO, size: int, connections: dict[int, bytes]) -> tuple[bytes, int, _Inside] | None:
    """Of the chunk that `file` is at, and that is cut off: the records of one with what is whole of it, and of its
    places, how many bytes up to the file's end are not, and what is in it; its connections are added to those known.
    None where nothing is."""
    import bz2

    import lz4.frame

    opened = {b"none": bytes, b"bz2": bz2.BZ2Decompressor().decompress,
              b"lz4": lz4.frame.LZ4FrameDecompressor().decompress}  # fmt: skip
    if (begin := _ros1_header(file, math.inf)) is None or begin[0]["op"][0] != ROS1_CHUNK:
        return None
    try:
        held = opened[begin[0]["compression"]](file.read(min(begin[1], MAX_BYTES)))
    except (*BROKEN, *library_errors()):
        return None
    if (found := _ros1_inside(held, connections)) is None:
        return None
    connections |= found.own
    chunk = {"op": bytes([ROS1_CHUNK]), "compression": b"none", "size": struct.pack("<I", found.end)}
    records = [_ros1_record(chunk, held[: found.end])]
    for number, places in found.places.items():
        told = {"op": bytes([ROS1_INDEX]), "ver": struct.pack("<I", 1)}
        told |= {"conn": struct.pack("<I", number), "count": struct.pack("<I", len(places))}
        records.append(_ros1_record(told, b"".join(struct.pack("<III", *place) for place in places)))
    return b"".join(records), len(held) - found.end + size - file.tell(), found
