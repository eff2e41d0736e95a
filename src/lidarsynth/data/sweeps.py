"""Turns of a sensor that spins and sends blocks, each of what its lasers measured at one azimuth.

One way for Velodyne's packets and Hesai's: where a turn ends, what comes late or twice, and where returns lie.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import chain, islice, pairwise
from typing import NamedTuple

import numpy as np

from lidarsynth.data.capture import Datagram
from lidarsynth.data.whole_turns import Unread, until_broken, whole_turns
from lidarsynth.files.fields import Fields, FileError

TURN = 36000  # hundredths of a degree
LATE = 2000  # of them: two packets of the fastest spin; what lies no farther back is late, and begins no turn
A_TURN_LOST = 0.9 * TURN  # in time, beyond what the sensor has turned
LOOKED_AT = 2000  # packets for the sector that a sensor is set to: more than a turn of any
STRETCH = 50  # packets: a turn is some hundred
REPEATED = 8  # packets that are looked through for the same one
NAMES = ("x", "y", "z", "intensity", "ring", "time")


class Blocks(NamedTuple):
    """How a sensor's packets are read.

    belongs   whether a payload is one of its data packets
    check     raises FileError for one that belongs, and of which no returns can be made
    azimuths  hundredths of a degree of each block of one, clockwise seen from above, as the sensor turns
    clock     nanoseconds of a packet: best the sensor's own, which knows of no delay on the way
    decode    (payload, nanoseconds of the packet) -> NAMES and `block`, each return's; goes to other processes
    """

    belongs: Callable[[bytes], bool]
    check: Callable[[bytes], object]
    azimuths: Callable[[bytes], np.ndarray]
    clock: Callable[[Datagram], int]
    decode: Callable[[bytes, int], Fields]


def returns(packets: Iterable[Datagram], how: Blocks) -> Fields:
    """All returns of some packets, as one turn. Raises FileError for a packet that `how` does not read."""
    return _decoded([(packet, 0, len(how.azimuths(packet.payload))) for packet in packets], how.decode)


def unread_turns(packets: Iterable[Datagram], how: Blocks) -> Iterator[Unread]:
    """Turns (`whole_turns`): NAMES of each return, in the order of firing; each decoded when it is called.

    A turn ends where the azimuth passes 0, of a sensor that is set to a sector where that ends.
    """
    fault: list[FileError] = []
    stream = until_broken(packets, fault)
    first = list(islice(stream, LOOKED_AT))
    own = [packet for packet in first if how.belongs(packet.payload)]
    return whole_turns(_parts(chain(first, stream), how, _seam(own, how), _pace(own, how)), fault)


def _seam(packets: list[Datagram], how: Blocks) -> int:
    """Where one turn ends and the next begins, hundredths of a degree: amid what a sector leaves out, else 0."""
    own = [how.azimuths(packet.payload) for packet in packets]
    seen = np.unique(np.concatenate(own)).astype(int) if own else np.zeros(1, int)
    gaps = np.diff(seen, append=seen[0] + TURN)
    widest = int(gaps.argmax())
    return int(seen[widest] + gaps[widest] // 2) % TURN if gaps[widest] >= LATE else 0


def _pace(packets: list[Datagram], how: Blocks) -> float:
    """Nanoseconds in which the sensor turns by a hundredth of a degree: the median of stretches, as packets may come in
    bursts, and some are lost; 0 where the times do not tell."""
    steps = np.diff([int(how.azimuths(packet.payload)[0]) for packet in packets]) % TURN
    times = np.diff([how.clock(packet) for packet in packets])
    onward = (steps > 0) & (steps < LATE) & (times >= 0)
    parts = np.arange(0, onward.sum(), STRETCH)
    if not len(parts):
        return 0.0
    return float(np.median(np.add.reduceat(times[onward], parts) / np.add.reduceat(steps[onward], parts)))


_Piece = tuple[Datagram, int, int]  # a packet, the first of its blocks that are meant, and the one after the last


def _parts(packets: Iterable[Datagram], how: Blocks, seam: int, pace: float) -> Iterator[tuple[float, Unread]]:
    """Share and turn of each, from seam to seam, or to where the packets of a turn's time and more were lost. A packet
    that comes once more, as from two interfaces, is passed over; one that comes after its next is of its own turn."""
    before: list[_Piece] = []  # of the turn that ended last, which is held until the next one has ended
    pieces: list[_Piece] = []
    recent: deque[bytes] = deque(maxlen=REPEATED)
    last: int | None = None
    begun = swept = ended = came = 0
    for packet in packets:
        if not how.belongs(packet.payload) or packet.payload in recent:
            continue
        recent.append(packet.payload)
        how.check(packet.payload)
        azimuth = (how.azimuths(packet.payload).astype(int) - seam) % TURN
        time = how.clock(packet)
        for first, end in _runs(azimuth):
            start = int(azimuth[first])
            late = last is not None and 0 < (last - start) % TURN < LATE
            step = 0 if late or last is None else (start - last) % TURN
            lost = last is not None and pace > 0 and time - came > pace * (step + A_TURN_LOST)
            late = late and not lost
            if last is None:
                begun = start
            elif lost or (not late and start < last):  # passed the seam
                if before:
                    yield ended / TURN, partial(_decoded, before, how.decode)
                before, ended = pieces, swept
                pieces, begun = [], start
            own = before if before and last is not None and late and start > last else pieces
            own.append((packet, first, end))
            if not late:
                last, came = int(azimuth[end - 1]), time
                swept = last - begun
    for share, held in ((ended, before), (swept, pieces)):
        if held:
            yield share / TURN, partial(_decoded, held, how.decode)


def _runs(azimuth: np.ndarray) -> list[tuple[int, int]]:
    """Runs (first block, block after the last) of a packet, cut where the azimuth, from the seam on, falls."""
    cuts = [0, *(np.flatnonzero(np.diff(azimuth) <= -LATE) + 1).tolist(), len(azimuth)]
    return list(pairwise(cuts))


def _decoded(pieces: list[_Piece], decode: Callable[[bytes, int], Fields]) -> Fields:
    """The returns of a turn."""
    parts: list[Fields] = []
    for packet, first, end in pieces:
        points = decode(packet.payload, packet.time)
        inside = (points["block"] >= first) & (points["block"] < end)
        parts.append({name: points[name][inside] for name in NAMES})
    return {name: np.concatenate([part[name] for part in parts]) for name in NAMES}


def rows(elevations: Sequence[float]) -> np.ndarray:
    """(lasers,) int32 the ring of each laser, 0 the highest beam."""
    row = np.empty(len(elevations), np.int32)
    row[np.argsort(-np.array(elevations), kind="stable")] = np.arange(len(elevations))
    return row


def points(distance: np.ndarray, elevation: np.ndarray, azimuth: np.ndarray, height: np.ndarray | float = 0) -> Fields:
    """x forward (azimuth 0), y left, z up of returns: the azimuth runs clockwise from x.

    distance, height     metres, from the beam's origin and of it above the sensor's
    elevation, azimuth   degrees
    """
    up, angle = np.radians(elevation), np.radians(azimuth)
    flat = distance * np.cos(up)
    return {
        "x": (flat * np.cos(angle)).astype(np.float32),
        "y": (-flat * np.sin(angle)).astype(np.float32),
        "z": (distance * np.sin(up) + height).astype(np.float32),
    }
