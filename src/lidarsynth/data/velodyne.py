"""Velodyne data packets of 1206 bytes: VLP-16, Puck Hi-Res, HDL-32E and VLP-32C, into whole turns.

Layout, firing times and angles: the makers' manuals as ros-drivers/velodyne (`rawdata.h`, `rawdata.cc`) and
valgur/velodyne_decoder (`types.h`, `packet_decoder.cpp`) have them; formulas only.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from lidarsynth.data import sweeps
from lidarsynth.data.capture import Datagram
from lidarsynth.data.sweeps import TURN, Blocks
from lidarsynth.data.whole_turns import Unread
from lidarsynth.files.fields import Fields, FileError

SIZE = 1206  # bytes of a packet's payload
FLAG = 0xEEFF  # of a block
BLOCK = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("return", [("distance", "<u2"), ("light", "u1")], 32)])
DUAL = 0x39


@dataclass(frozen=True)
class Model:
    """What a packet's product byte means.

    name        as users know it
    elevations  degrees, by laser in the order of firing
    azimuths    degrees that a laser looks to the right of the block's azimuth, to be taken off; () for none
    heights     metres of each laser's origin above the sensor's; () for none
    unit        metres of one step of distance
    firing      microseconds: from block to block, from pulse to pulse, and of one firing sequence
    lasers      per firing sequence; a block of 32 returns holds one or two
    pairs       lasers that fire at once
    """

    name: str
    elevations: tuple[float, ...]
    firing: tuple[float, float, float]
    azimuths: tuple[float, ...] = ()
    heights: tuple[float, ...] = ()
    unit: float = 0.002
    pairs: int = 1

    @property
    def lasers(self) -> int:
        return len(self.elevations)


# fmt: off
_VLP_16 = (-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15)
_VLP_16_HEIGHTS = (11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2)  # mm
_HI_RES = (-10, .67, -8.67, 2, -7.33, 3.33, -6, 4.67, -4.67, 6, -3.33, 7.33, -2, 8.67, -.67, 10)
_HDL_32E = (
    -30.67, -9.33, -29.33, -8, -28, -6.67, -26.67, -5.33, -25.33, -4, -24, -2.67, -22.67, -1.33, -21.33, 0, -20, 1.33,
    -18.67, 2.67, -17.33, 4, -16, 5.33, -14.67, 6.67, -13.33, 8, -12, 9.33, -10.67, 10.67)
_VLP_32C = (
    -25, -1, -1.667, -15.639, -11.31, 0, -.667, -8.843, -7.254, .333, -.333, -6.148, -5.333, 1.333, .667, -4, -4.667,
    1.667, 1, -3.667, -3.333, 3.333, 2.333, -2.667, -3, 7, 4.667, -2.333, -2, 15, 10.333, -1.333)
_VLP_32C_AZIMUTHS = (
    -1.4, 4.2, -1.4, 1.4, -1.4, 1.4, -4.2, 1.4, -1.4, 4.2, -1.4, 1.4, -4.2, 1.4, -4.2, 1.4, -1.4, 4.2, -1.4, 4.2, -4.2,
    1.4, -1.4, 1.4, -1.4, 1.4, -1.4, 4.2, -4.2, 1.4, -1.4, 1.4)
MODELS: dict[int, Model] = {  # product byte -> model
    0x21: Model("hdl-32e", _HDL_32E, (46.080, 1.152, 46.080)),
    0x22: Model("vlp-16", _VLP_16, (110.592, 2.304, 55.296), heights=tuple(h / 1000 for h in _VLP_16_HEIGHTS)),
    0x24: Model("puck-hi-res", _HI_RES, (110.592, 2.304, 55.296)),
    0x28: Model("vlp-32c", _VLP_32C, (55.296, 2.304, 55.296), _VLP_32C_AZIMUTHS, unit=0.004, pairs=2),
}
# fmt: on


def is_velodyne(payload: bytes) -> bool:
    """Whether a payload is a Velodyne data packet of any model."""
    return len(payload) == SIZE and payload[:2] == b"\xff\xee"


def turns(packets: Iterable[Datagram]) -> Iterator[Fields]:
    """Turns (`whole_turns`): x y z intensity (0-255) ring time (seconds) of each return, in the order of firing.

    A turn ends where the azimuth passes 0, of a sensor that is set to a sector where that ends. x forward (azimuth 0),
    y left, z up; ring 0 is the highest beam. Of two returns the last is taken. Raises FileError for a model that is not
    in MODELS.
    """
    return (turn() for turn in unread_turns(packets))


def returns(packets: Iterable[Datagram]) -> Fields:
    """The same of all returns of some packets, as one turn. Raises FileError for what is none of a model of MODELS."""
    own = list(packets)
    if not own:
        raise FileError("expected Velodyne packets, found none")
    for packet in own:
        _check_size(packet.payload)
    return sweeps.returns(own, BLOCKS)


def unread_turns(packets: Iterable[Datagram]) -> Iterator[Unread]:
    """The same, each decoded when it is called."""
    return sweeps.unread_turns(packets, BLOCKS)


def _azimuths(payload: bytes) -> np.ndarray:
    """(12,) hundredths of a degree, of each block."""
    return np.frombuffer(payload, BLOCK, 12)["azimuth"]


def _clock(packet: Datagram) -> int:
    """Nanoseconds since the hour, of the sensor, which begins anew with it."""
    return int.from_bytes(packet.payload[1200:1204], "little") * 1000


def _returns_of(payload: bytes, time: int) -> Fields:
    return decode(payload, time)[0]


def _check_size(payload: bytes) -> None:
    if not is_velodyne(payload):
        raise FileError(f"expected a Velodyne packet of {SIZE} bytes, found {len(payload)}")


def decode(payload: bytes, time: int = 0) -> tuple[Fields, np.ndarray]:
    """The returns of one packet, and the azimuth (hundredths of a degree) of each of its blocks.

    time  nanoseconds of the packet; a point's is that plus its place in the firing order
    Fields x y z intensity ring time, and block and azimuth (hundredths of a degree, as fired). Raises FileError.
    """
    _check_size(payload)
    model, dual = _model(payload), payload[1204] == DUAL
    blocks = np.frombuffer(payload, BLOCK, 12)
    block, place = np.meshgrid(np.arange(12), np.arange(32), indexing="ij")
    micros = firing_time(model, block, place, dual)
    turn = _rate(blocks["azimuth"], micros[:, 0])
    azimuth = blocks["azimuth"][:, None] + turn * (micros - micros[:, :1])
    distance = blocks["return"]["distance"] * model.unit
    keep = (distance > 0) & (blocks["flag"] == FLAG)[:, None]
    if dual:  # even blocks hold the last return, odd ones the strongest
        keep &= block % 2 == 0
    laser = place % model.lasers
    seconds = time / 1e9 + micros / 1e6
    fields = _points(model, laser[keep], azimuth[keep], distance[keep])
    ring = sweeps.rows(model.elevations)[laser[keep]]
    fields |= {"intensity": blocks["return"]["light"][keep], "ring": ring, "time": seconds[keep]}
    return fields | {"block": block[keep], "azimuth": azimuth[keep]}, blocks["azimuth"]


def _model(payload: bytes) -> Model:
    """Which one sent a packet. Raises FileError for one that is not in MODELS."""
    if payload[1205] not in MODELS:
        known = ", ".join(model.name for model in MODELS.values())
        raise FileError(f"expected a packet of {known}, found the product byte {payload[1205]:#04x}")
    return MODELS[payload[1205]]


def firing_time(model: Model, block: np.ndarray, place: np.ndarray, dual: bool) -> np.ndarray:
    """Microseconds from the packet's first firing to the return at `place` (0-31) of `block` (0-11).

    Blocks of dual returns come in pairs of one firing.
    """
    per_block, pulse, sequence = model.firing
    cycle = block // 2 if dual else block
    return per_block * cycle + sequence * (place // model.lasers) + pulse * (place % model.lasers // model.pairs)


def _rate(azimuth: np.ndarray, micros: np.ndarray) -> float:
    """Hundredths of a degree per microsecond, of this packet, but for what a sector leaves out between blocks."""
    steps, spent = np.diff(azimuth.astype(int)) % TURN, np.diff(micros)
    even = steps <= 2 * np.median(steps[spent > 0])
    return float(steps[even].sum()) / float(max(spent[even].sum(), 1e-3))


def _points(model: Model, laser: np.ndarray, azimuth: np.ndarray, distance: np.ndarray) -> Fields:
    """x y z of returns whose lasers fired at an azimuth, in hundredths of a degree."""
    angle = azimuth / 100 - (np.array(model.azimuths)[laser] if model.azimuths else 0)
    height = np.array(model.heights)[laser] if model.heights else 0
    return sweeps.points(distance, np.array(model.elevations)[laser], angle, height)


BLOCKS = Blocks(is_velodyne, _model, _azimuths, _clock, _returns_of)
