"""Network captures `.pcap` and `.pcapng`: the UDP payloads in them. Fragments of large packets are put together."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

from lidarsynth.files.fields import FileError
from lidarsynth.lidar.small_file import check_regular

ENDING = re.compile(r"\.pcap(ng)?\d*$", re.IGNORECASE)
MAGIC = {b"\xd4\xc3\xb2\xa1": "<", b"\xa1\xb2\xc3\xd4": ">", b"\x4d\x3c\xb2\xa1": "<", b"\xa1\xb2\x3c\x4d": ">"}
NANO = (b"\x4d\x3c\xb2\xa1", b"\xa1\xb2\x3c\x4d")
NEXT_GENERATION = b"\x0a\x0d\x0d\x0a"
INTERFACE, SIMPLE, ENHANCED = 1, 3, 6  # kinds of blocks of pcapng (draft-ietf-opsawg-pcapng)
RESOLUTION, OFFSET = 9, 14  # if_tsresol and if_tsoffset, options of an interface
MAX_RECORD = 1 << 18
PATIENCE = 10**9  # nanoseconds that fragments wait for others: their number comes again after 65,536 packets
ETHERNET, RAW_IP, LOOPBACK = 1, (12, 101, 228), 0  # link types (the tcpdump group's list)
COOKED = {113: (14, 16), 276: (0, 20)}  # `tcpdump -i any`, before 4.99.0 and since: where kind and packet are
IPV4, UDP = 0x0800, 17
VLAN = (b"\x81\x00", b"\x88\xa8", b"\x91\x00")  # IEEE 802.1Q, 802.1ad, and what came before it


class _Waiting(NamedTuple):
    """Fragments of a packet by their places, -1 its length as four bytes, and when the first of them came."""

    since: int
    parts: dict[int, bytes]


class Datagram(NamedTuple):
    """One UDP packet: nanoseconds of its capture, its destination port, its payload, the IPv4 address of its sender.

    A simple packet of pcapng has no time: it gets that of the packet before it, or 0.
    """

    time: int
    port: int
    payload: bytes
    address: str = ""

    @property
    def sender(self) -> str:
        """ADDRESS:PORT: several sensors differ in where they are, or in the port that they send to."""
        return f"{self.address}:{self.port}"


def is_capture(path: str | Path) -> bool:
    """Whether a path is a capture by its name: also drive.pcap1, drive.pcap2, ..., as `tcpdump -C` goes on. A folder is
    none."""
    return ENDING.search(Path(path).name) is not None and not Path(path).is_dir()


def datagrams(path: str | Path) -> Iterator[Datagram]:
    """The UDP packets over IPv4 of a capture, in order, in flat memory; anything else in it is passed over.

    A record cut short at the end of the file ends it. Raises FileError for a file that is no capture, and, after the
    packets before it, where a record is longer than any packet.
    """
    path = Path(path)
    fragments: dict[bytes, _Waiting] = {}
    with _open(path) as file:
        start = file.read(4)
        if start == NEXT_GENERATION:
            frames = _blocks(file)
        elif start in MAGIC:
            frames = _records(file, MAGIC[start], start in NANO)
        else:
            raise FileError(f"{path}: expected a capture (pcap or pcapng), found a file that begins with {start!r}")
        for time, link, frame in frames:
            if (found := _udp(_ip(frame, link), time, fragments)) is not None:
                yield Datagram(time, *found)


def _open(path: Path) -> IO[bytes]:
    try:
        check_regular(path)
        return open(path, "rb")
    except OSError as error:
        raise FileError(f"{path}: expected a readable file, found: {error.strerror}") from None
    except ValueError as error:
        raise FileError(str(error)) from None


def _records(file: IO[bytes], order: str, nano: bool) -> Iterator[tuple[int, int, bytes]]:
    """(nanoseconds, link type, frame) of each record of a classic pcap, after its magic number."""
    header = file.read(20)
    if len(header) < 20:
        return
    link = struct.unpack(order + "I", header[16:])[0] & 0xFFFF
    while len(head := file.read(16)) == 16:
        seconds, part, size, _ = struct.unpack(order + "4I", head)
        _check_record(file, size)
        if len(frame := file.read(size)) < size:
            return
        yield seconds * 10**9 + part * (1 if nano else 1000), link, frame


def _check_record(file: IO[bytes], size: int, least: int = 0) -> None:
    """Raises FileError for the size of a record that is none: where the next one begins, nobody knows."""
    if not least <= size <= MAX_RECORD:
        raise FileError(f"{file.name}: expected records of {least} to {MAX_RECORD} bytes, found one of {size} before "
                        f"byte {file.tell()}: the capture is broken there")  # fmt: skip


class _Interface(NamedTuple):
    """What a capture was made from: its link type, the most bytes kept of a packet (0 = all), how often its clock
    ticks in a second, and the seconds since 1970 that it counts from."""

    link: int = ETHERNET
    longest: int = 0
    ticks: int = 10**6
    start: int = 0


def _blocks(file: IO[bytes]) -> Iterator[tuple[int, int, bytes]]:
    """The same of a pcapng file: sections (their byte order), interfaces, enhanced and simple packets; these have no
    time, so that they get that of the packet before, or 0."""
    file.seek(0)
    order, time = "<", 0
    interfaces: list[_Interface] = []
    while len(head := file.read(8)) == 8:
        if head[:4] == NEXT_GENERATION:
            magic = file.read(4)
            order, interfaces = ("<" if magic == b"\x4d\x3c\x2b\x1a" else ">"), []
            file.seek(-4, 1)
        kind, size = struct.unpack(order + "2I", head)
        _check_record(file, size, 12)
        if len(body := file.read(size - 8)) < size - 8:
            return
        body = body[:-4]  # the size once more
        if kind == INTERFACE and len(body) >= 8:
            interfaces.append(_interface(body, order))
        elif kind == ENHANCED and len(body) >= 20:
            which, high, low, length, _ = struct.unpack(order + "5I", body[:20])
            one = interfaces[which] if which < len(interfaces) else _Interface()
            time = one.start * 10**9 + ((high << 32) | low) * 10**9 // one.ticks
            yield time, one.link, body[20 : 20 + length]
        elif kind == SIMPLE and len(body) >= 4:
            one = interfaces[0] if interfaces else _Interface()
            length = struct.unpack(order + "I", body[:4])[0]  # as it was sent, of which less may be kept
            yield time, one.link, body[4 : 4 + min(length, one.longest or length)]


def _interface(body: bytes, order: str) -> _Interface:
    link, _, longest = struct.unpack(order + "HHI", body[:8])
    at, ticks, start = 8, _Interface().ticks, 0
    while at + 4 <= len(body):
        option, length = struct.unpack(order + "HH", body[at : at + 4])
        if option == RESOLUTION and length == 1 and at + 4 < len(body):
            power = body[at + 4]
            ticks = 2 ** (power & 127) if power & 128 else 10**power
        elif option == OFFSET and length == 8 and at + 12 <= len(body):
            (start,) = struct.unpack(order + "q", body[at + 4 : at + 12])
        at += 4 + -(-length // 4) * 4
        if option == 0:  # the end of them
            break
    return _Interface(link, longest, ticks, start)


def _ip(frame: bytes, link: int) -> bytes:
    """The IPv4 packet in a frame of a link layer, or nothing."""
    if link in RAW_IP:
        return frame
    if link == LOOPBACK:
        return frame[4:]
    place, at = COOKED.get(link, (12, 14))
    kind = frame[place : place + 2]
    while kind in VLAN:  # a tag each
        kind, at = frame[at + 2 : at + 4], at + 4
    return frame[at:] if kind == IPV4.to_bytes(2, "big") else b""


def _udp(packet: bytes, time: int, fragments: dict[bytes, _Waiting]) -> tuple[int, bytes, str] | None:
    """(destination port, payload, sender's address) once a UDP packet is whole; `fragments` keeps what waits."""
    if len(packet) < 20 or packet[0] >> 4 != 4 or packet[9] != UDP:
        return None
    head, total = (packet[0] & 15) * 4, int.from_bytes(packet[2:4], "big")
    body = packet[head : total or None]
    place = int.from_bytes(packet[6:8], "big")
    offset, more = (place & 0x1FFF) * 8, bool(place & 0x2000)
    if more or offset:
        body = _joined(packet[4:6] + packet[12:20], time, offset, more, body, fragments)
    if len(body) < 8:
        return None
    return int.from_bytes(body[2:4], "big"), body[8:], ".".join(map(str, packet[12:16]))


def _joined(key: bytes, time: int, offset: int, more: bool, body: bytes, fragments: dict[bytes, _Waiting]) -> bytes:
    """The whole packet when its last missing fragment has come, else nothing. Those of an earlier packet of the same
    number, which lost one, are given up."""
    waiting = fragments.get(key)
    if waiting is None or abs(time - waiting.since) > PATIENCE or waiting.parts.get(offset, body) != body:
        fragments.pop(key, None)
        waiting = fragments[key] = _Waiting(time, {})
    parts = waiting.parts
    parts[offset] = body
    if not more:
        parts[-1] = (offset + len(body)).to_bytes(4, "big")
    if len(fragments) > 64:  # packets that lost a fragment
        del fragments[next(iter(fragments))]
    if -1 not in parts:
        return b""
    whole = b"".join(parts[at] for at in sorted(parts) if at >= 0)
    if len(whole) < int.from_bytes(parts[-1], "big"):
        return b""
    fragments.pop(key, None)
    return whole
