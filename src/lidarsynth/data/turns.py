"""The turns in a capture: of its one LiDAR, or of the one named; Velodyne's by the packets, Hesai's with their angles
beside, Ouster's with metadata."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain, islice
from pathlib import Path

from lidarsynth.data import hesai, ouster, velodyne
from lidarsynth.data.capture import Datagram, datagrams
from lidarsynth.data.whole_turns import Unread
from lidarsynth.files.fields import Fields, FileError

LOOKED_AT = 2000  # packets from the first of a LiDAR on: 0.2 s of the fastest sensor, so that every other one shows
LARGE = 1000  # bytes: smaller packets are positions and inertial measurements, but some of a Hesai's
Test = Callable[[Datagram], bool]
Turns = Callable[[Iterator[Datagram]], Iterator[Unread]]


def capture_turns(path: Path, metadata: Path | None = None, sender: str | None = None) -> Iterator[Fields]:
    """The turns of a LiDAR in a capture. Raises FileError where there is none, or several and none is named.

    metadata  `.json` of an Ouster, angle correction `.csv` of a Hesai; None = the only one beside the capture
    sender    ADDRESS:PORT, of the sensor and to which its packets go; None = the only one
    """
    return (turn() for turn in unread_turns(path, metadata, sender))


def unread_turns(path: Path, metadata: Path | None = None, sender: str | None = None) -> Iterator[Unread]:
    """The same, each decoded when it is called: what is only passed over costs a tenth."""
    belongs, turns = _kind(path, metadata, sender)
    listed = _listed(path, belongs)
    if sender is None and len(listed) > 1:
        raise FileError(f"{path}: expected packets of one LiDAR, or --topic ADDRESS:PORT, found {', '.join(listed)}")
    if sender is not None and sender not in listed:
        raise FileError(f"{path}: expected packets of a LiDAR as {sender}, found {', '.join(listed)}")
    own = (packet for packet in datagrams(path) if packet.sender == (sender or listed[0]) and belongs(packet))
    found, streamed = 0, turns(own)
    while (turn := _next(path, streamed)) is not None:
        found += 1
        yield turn
    if not found:
        raise FileError(f"{path}: expected a turn of the LiDAR, found less than half of one")


def _next(path: Path, turns: Iterator[Unread]) -> Unread | None:
    """The next turn; what is wrong with a packet is said with the capture's name."""
    try:
        return next(turns, None)
    except FileError as error:
        text = str(error)
        raise FileError(text if text.startswith(str(path)) else f"{path}: {text}") from None


def senders(path: Path, metadata: Path | None = None) -> list[str]:
    """ADDRESS:PORT of each LiDAR of one kind in a capture. Raises FileError where there is none."""
    return _listed(path, _kind(path, metadata, None)[0])


def sound_datagrams(path: Path) -> Iterator[Datagram]:
    """The packets before a capture is broken; that it is, is said where they are read for their turns."""
    come = False
    try:
        for packet in datagrams(path):
            come = True
            yield packet
    except FileError:
        if not come:
            raise


def _kind(path: Path, metadata: Path | None, sender: str | None) -> tuple[Test, Turns]:
    """How the packets of a LiDAR are told, and what makes turns of them: a Velodyne or Hesai where one sends, else an
    Ouster."""
    large = [p for p in islice(sound_datagrams(path), 2 * LOOKED_AT) if _is_large(p)]
    large = [p for p in large if sender in (None, p.sender)] or large
    if not large:
        large = list(islice(filter(_is_large, sound_datagrams(path)), 1))
    if not large:
        raise FileError(f"{path}: expected packets of a LiDAR, found none")
    if any(map(_of_blocks, large)):
        return _of_blocks, lambda packets: _block_turns(packets, path, metadata)
    if all(p.payload.startswith(hesai.HEADER) for p in large):
        known = ", ".join(layout.name for layout in hesai.LAYOUTS)
        raise FileError(f"{path}: expected a Hesai's packets of {known}, found those of another model, of "
                        f"{len(large[0].payload)} bytes")  # fmt: skip
    described = ouster.read_metadata(metadata or ouster.metadata_beside(path, "beside the capture"))
    size = ouster.packet_size(described)
    return lambda packet: len(packet.payload) == size, lambda packets: ouster.unread_turns(packets, described)


def _is_large(packet: Datagram) -> bool:
    return len(packet.payload) > LARGE or hesai.is_hesai(packet.payload)


def _of_blocks(packet: Datagram) -> bool:
    """Whether a packet tells by itself whose it is."""
    return velodyne.is_velodyne(packet.payload) or hesai.is_hesai(packet.payload)


def _block_turns(packets: Iterator[Datagram], path: Path, metadata: Path | None) -> Iterator[Unread]:
    """The turns of one sensor whose packets tell whose they are."""
    first = next(packets)
    own = chain([first], packets)
    if (layout := hesai.layout_of(first.payload)) is None:
        return velodyne.unread_turns(own)
    return hesai.unread_turns(own, layout, hesai.angles_for(layout, path, metadata))


def _listed(path: Path, belongs: Test) -> list[str]:
    """ADDRESS:PORT of those whose packets belong."""
    found = list(dict.fromkeys(p.sender for p in islice(filter(belongs, sound_datagrams(path)), LOOKED_AT)))
    if not found:
        first = next(len(p.payload) for p in sound_datagrams(path) if _is_large(p))
        raise FileError(f"{path}: expected packets of a Velodyne, of a Hesai that is known or of the Ouster that the "
                        f"metadata describes, found none; the first large packet has {first} bytes")  # fmt: skip
    return sorted(found)
