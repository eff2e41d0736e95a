"""Hesai's data packets: Pandar40P, Pandar64, PandarXT-16, XT-32, XT32M and PandarQT64, into whole turns.

Layouts: the makers' user manuals, "Point cloud data packet"; formulas only. Angles are those of the unit's angle
correction file (`angle_files`), nominal ones of the XT-16 and XT-32.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from operator import attrgetter
from pathlib import Path

import numpy as np

from lidarsynth.data import sweeps
from lidarsynth.data.angle_files import HOW, Angles, angles_beside, read_angles
from lidarsynth.data.capture import Datagram
from lidarsynth.data.sweeps import Blocks
from lidarsynth.data.whole_turns import Unread
from lidarsynth.files.fields import Fields, FileError

SEQUENCE = 4  # bytes of a packet's number, which some send and others do not
FLAG = 0xEEFF  # of each block of a Pandar40P, as it has no header
MILLIMETRES = 4  # of one step of distance, where no header tells it


@dataclass(frozen=True)
class Layout:
    """What a packet holds.

    name      of the model
    begins    its first bytes
    counts    where lasers, blocks and, two bytes on, millimetres of a step of distance are told, each a byte; None =
              nowhere
    header    bytes before the blocks
    lasers    per block
    blocks    per packet
    stride    bytes of a return: distance (2), reflectivity (1), and what is reserved
    tail      bytes after the blocks, before the packet's number
    firing    microseconds from firing to firing
    nominal   angles of every unit, where they are near enough to its own; else None
    """

    name: str
    begins: bytes
    counts: int | None
    header: int
    lasers: int
    blocks: int
    stride: int
    tail: int
    firing: float
    nominal: Angles | None = None

    @cached_property
    def block(self) -> np.dtype:
        """One block: the flag where there is one, hundredths of a degree, the returns."""
        spare = [("spare", f"V{self.stride - 3}")] if self.stride > 3 else []
        point = np.dtype([("distance", "<u2"), ("light", "u1"), *spare])
        flag = [("flag", "<u2")] if self.counts is None else []
        return np.dtype([*flag, ("azimuth", "<u2"), ("return", point, (self.lasers,))])

    @cached_property
    def size(self) -> int:
        """Bytes of a packet without its number."""
        return self.header + self.blocks * self.block.itemsize + self.tail

    def fits(self, payload: bytes) -> bool:
        """Whether a payload is such a packet."""
        if len(payload) not in (self.size, self.size + SEQUENCE) or not payload.startswith(self.begins):
            return False
        return self.counts is None or payload[self.counts : self.counts + 2] == bytes((self.lasers, self.blocks))


def _even(top: int, step: int, count: int) -> Angles:
    return Angles(tuple(float(top - step * i) for i in range(count)), (0.0,) * count)


HEADER, XT = b"\xee\xff", b"\xee\xff\x06\x01"  # and the protocol's version, 6.1
LAYOUTS = (
    Layout("Pandar40P", b"\xff\xee", None, 0, 40, 10, 3, 22, 55.56),
    Layout("Pandar64", HEADER, 2, 8, 64, 6, 3, 22, 55.56),
    Layout("PandarXT-32", XT, 6, 12, 32, 8, 4, 24, 50.0, _even(15, 1, 32)),
    Layout("PandarXT-16", XT, 6, 12, 16, 8, 4, 24, 50.0, _even(15, 2, 16)),
    Layout("XT32M", XT, 6, 12, 32, 6, 4, 24, 50.0),
    Layout("PandarQT64", HEADER, 6, 12, 64, 4, 4, 24, 166.67),
)


def layout_of(payload: bytes) -> Layout | None:
    """Which of LAYOUTS a payload has, or None."""
    return next((layout for layout in LAYOUTS if layout.fits(payload)), None)


def is_hesai(payload: bytes) -> bool:
    """Whether a payload is a data packet of a model of LAYOUTS."""
    return layout_of(payload) is not None


def turns(packets: Iterable[Datagram], layout: Layout, angles: Angles) -> Iterator[Fields]:
    """Turns (`sweeps.unread_turns`): x y z intensity (0-255) ring time (seconds) of each return.

    x forward (azimuth 0), y left, z up; ring 0 is the highest beam. Of several returns of a firing the last is taken.
    Packets of other layouts are passed over. Raises FileError for a packet whose header tells no distances.
    """
    return (turn() for turn in unread_turns(packets, layout, angles))


def layout_in(packets: Iterable[Datagram]) -> Layout | None:
    """Which of LAYOUTS the first has that has any."""
    return next((found for packet in packets if (found := layout_of(packet.payload)) is not None), None)


def returns(packets: Sequence[Datagram], angles: Angles | None) -> Fields:
    """The same of all returns of some packets of one sensor, as one turn. Raises FileError where none is of LAYOUTS, or
    its angles are those of another number of lasers, or of none."""
    if (layout := layout_in(packets)) is None or angles is None:
        sizes = ", ".join(sorted({str(len(packet.payload)) for packet in packets})[:4])
        raise FileError(f"expected packets of {', '.join(one.name for one in LAYOUTS)}, found "
                        + (f"others, of {sizes} bytes" if sizes else "none"))  # fmt: skip
    if len(angles.elevations) != layout.lasers:
        raise FileError(f"expected packets of {len(angles.elevations)} channels, as the angles are, found those of a "
                        f"{layout.name}")  # fmt: skip
    return sweeps.returns([packet for packet in packets if layout.fits(packet.payload)], _blocks(layout, angles))


def unread_turns(packets: Iterable[Datagram], layout: Layout, angles: Angles) -> Iterator[Unread]:
    """The same, each decoded when it is called."""
    return sweeps.unread_turns(packets, _blocks(layout, angles))


def angles_for(layout: Layout, path: Path, metadata: Path | None) -> Angles:
    """The angles of a sensor in a recording: of the file named, else of the only one beside it, else nominal ones, of
    which a warning tells. Raises FileError where there are none, or the file has another number of channels."""
    if metadata is not None:
        found = read_angles(metadata)
        if len(found.elevations) != layout.lasers:
            raise FileError(f"{metadata}: expected the {layout.lasers} channels of a {layout.name}, found "
                            f"{len(found.elevations)}")  # fmt: skip
        return found
    if (beside := angles_beside(path, layout.lasers, layout.name)) is not None:
        return beside
    asked = f"the angle correction file of the {layout.name}, or one of {layout.lasers} channels beside it"
    if layout.nominal is None:
        raise FileError(f"{path}: expected --metadata ANGLES.csv, {asked}, found none: {HOW}")
    warnings.warn(f"{path}: found no {asked.removeprefix('the ')}: its nominal angles are taken, which may be some "
                  "tenths of a degree off; --metadata ANGLES.csv names one", stacklevel=2)  # fmt: skip
    return layout.nominal


def _blocks(layout: Layout, angles: Angles) -> Blocks:
    how = partial(_unit, layout), partial(_azimuths, layout), attrgetter("time"), partial(decode, layout, angles)
    return Blocks(layout.fits, *how)


def _azimuths(layout: Layout, payload: bytes) -> np.ndarray:
    """(blocks,) hundredths of a degree."""
    return np.frombuffer(payload, layout.block, layout.blocks, layout.header)["azimuth"]


def _unit(layout: Layout, payload: bytes) -> float:
    """Metres of a step of distance. Raises FileError where a header tells none."""
    unit = MILLIMETRES if layout.counts is None else payload[layout.counts + 3]
    if not unit:
        raise FileError(f"expected a {layout.name}'s distances in steps of {MILLIMETRES} mm or so, found steps of 0 mm")
    return unit / 1000


def decode(layout: Layout, angles: Angles, payload: bytes, time: int = 0) -> Fields:
    """The returns of one packet: x y z intensity ring time, and block.

    time  nanoseconds of the packet; a point's is that plus when its block was fired
    Raises FileError.
    """
    if not layout.fits(payload):
        raise FileError(f"expected a packet of a {layout.name}, found {len(payload)} bytes")
    blocks = np.frombuffer(payload, layout.block, layout.blocks, layout.header)
    distance = blocks["return"]["distance"] * _unit(layout, payload)
    if layout.counts is None:
        distance[blocks["flag"] != FLAG] = 0
    azimuth = blocks["azimuth"].astype(int)
    firing = np.concatenate([[0], np.cumsum(np.diff(azimuth) != 0)])
    block, laser = np.nonzero(_last(distance, firing))
    angle = azimuth[block] / 100 + np.array(angles.azimuths)[laser]
    fields = sweeps.points(distance[block, laser], np.array(angles.elevations)[laser], angle)
    fields |= {"intensity": blocks["return"]["light"][block, laser], "ring": sweeps.rows(angles.elevations)[laser]}
    return fields | {"time": time / 1e9 + firing[block] * layout.firing / 1e6, "block": block}


def _last(distance: np.ndarray, firing: np.ndarray) -> np.ndarray:
    """(blocks, lasers) bool, which returns are meant: of those of one firing, which lie in blocks of one azimuth, the
    last, which is the farthest, in whatever order the return mode puts them."""
    meant = distance > 0
    for number in np.flatnonzero(np.bincount(firing) > 1):
        same = firing == number
        meant[same] &= np.arange(same.sum())[:, None] == distance[same].argmax(axis=0)
    return meant
