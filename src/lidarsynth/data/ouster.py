"""Ouster captures: lidar packets and the sensor's metadata `.json`, into whole turns and into a `Sensor`.

Packet layouts and the point formula are those of Ouster's published sensor documentation; equal to `ouster-sdk` 1.0.1
point by point (tests/test_captures.py). That library is not asked for: it pins click, Flask and psutil to old versions.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidarsynth.data.capture import Datagram
from lidarsynth.data.whole_turns import TimedTurn, Unread, until_broken, whole_turns
from lidarsynth.files.fields import Fields, FileError
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.lidar.small_file import read_text

MODES = {"512x10": 512, "512x20": 512, "1024x10": 1024, "1024x20": 1024, "2048x10": 2048, "4096x5": 4096}
KEY = '"beam_altitude_angles"'  # of all metadata
LATE = 8  # packets into a turn, at most, after which one of the turn before may come
ORIGIN = 12.163  # mm from the lidar's axis to a beam's origin where the metadata does not say: a first-generation OS1
LIFT = 36.18  # mm from the sensor's base to the lidar's centre, the same


@dataclass(frozen=True)
class Profile:
    """Where the numbers of a pixel stand in a packet.

    header, footer  bytes around the packet's columns
    column          bytes before a column's pixels, and after them
    pixel           bytes of a pixel
    range           (numpy type, mask, metres a step)
    fields          name -> (offset, numpy type)
    """

    header: int
    footer: int
    column: tuple[int, int]
    pixel: int
    range: tuple[str, int, float]
    fields: dict[str, tuple[int, str]]


PROFILES: dict[str, Profile] = {
    "LEGACY": Profile(0, 0, (16, 4), 12, ("<u4", 0xFFFFF, 0.001),
                      {"reflectivity": (4, "<u2"), "signal": (6, "<u2"), "ambient": (8, "<u2")}),
    "RNG19_RFL8_SIG16_NIR16": Profile(32, 32, (12, 0), 12, ("<u4", 0x7FFFF, 0.001),
                      {"reflectivity": (4, "u1"), "signal": (6, "<u2"), "ambient": (8, "<u2")}),
    "RNG19_RFL8_SIG16_NIR16_DUAL": Profile(32, 32, (12, 0), 16, ("<u4", 0x7FFFF, 0.001),
                      {"reflectivity": (3, "u1"), "signal": (8, "<u2"), "ambient": (12, "<u2")}),
    "RNG15_RFL8_NIR8": Profile(32, 32, (12, 0), 4, ("<u2", 0x7FFF, 0.008),
                      {"reflectivity": (2, "u1"), "ambient": (3, "u1")}),
    "RNG15_RFL8_NIR8_DUAL": Profile(32, 32, (12, 0), 8, ("<u2", 0x7FFF, 0.008),
                      {"reflectivity": (2, "u1"), "ambient": (3, "u1")}),
}  # fmt: skip


@dataclass(frozen=True)
class Metadata:
    """What a sensor's metadata says.

    altitudes, azimuths  degrees of each beam, row 0 the highest; azimuths counter-clockwise beside the encoder's angle
    columns              per turn
    packet_columns       per packet
    origin               metres from the lidar's axis to the beams' origins
    to_sensor            (4, 4) lidar frame -> sensor frame, metres
    profile              of the packets
    lift                 metres from the lidar's centre up to the beams' origins
    """

    name: str
    altitudes: tuple[float, ...]
    azimuths: tuple[float, ...]
    columns: int
    packet_columns: int
    origin: float
    to_sensor: np.ndarray
    profile: str
    lift: float = 0.0


def read_metadata(path: str | Path) -> Metadata:
    """The metadata `.json` of an Ouster sensor, of any firmware. Raises FileError for a file that is none."""
    path = Path(path)
    try:
        text = read_text(path)
    except OSError as error:
        raise FileError(f"{path}: expected a readable file, found: {error.strerror}") from None
    except ValueError as error:
        raise FileError(f"{error}; it should be metadata of an Ouster sensor") from None
    return parse_metadata(text, str(path), path.stem)


def parse_metadata(text: str, where: str, name: str) -> Metadata:
    """The metadata of a sensor that is called `name`, in the text of such a file, found at `where`. Raises FileError
    that names it."""
    try:
        flat = flatten(json.loads(text))
    except (ValueError, RecursionError) as error:
        raise FileError(f"{where}: expected JSON, found {error!s:.120}; it should be metadata of an Ouster "
                        "sensor") from None  # fmt: skip
    if not {"beam_altitude_angles", "beam_azimuth_angles"} <= flat.keys():
        raise FileError(f"{where}: expected Ouster metadata with beam_altitude_angles and beam_azimuth_angles, found "
                        f"{', '.join(list(flat)[:6]) or 'nothing'}")  # fmt: skip
    try:
        return _metadata(flat, name)
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        raise FileError(f"{where}: expected Ouster metadata, found: {error}") from None


def flatten(values: Any) -> dict[str, Any]:
    """Firmware 3 puts the same keys into groups (beam_intrinsics, lidar_data_format, ...): one level of all."""
    flat: dict[str, Any] = {}
    for key, value in values.items() if isinstance(values, dict) else ():
        flat |= flatten(value) if isinstance(value, dict) else {key: value}
    return flat


def _metadata(flat: dict[str, Any], name: str) -> Metadata:
    altitudes, azimuths = flat["beam_altitude_angles"], flat["beam_azimuth_angles"]
    if not (isinstance(altitudes, list) and len(altitudes) == len(azimuths) >= 4):
        raise ValueError(f"{len(altitudes)} altitudes and {len(azimuths)} azimuths of beams")
    aside = float(flat.get("lidar_origin_to_beam_origin_mm", ORIGIN))
    beam = np.array(flat.get("beam_to_lidar_transform") or [1, 0, 0, aside, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1])
    origin, _, lift = (beam.astype(np.float64).reshape(4, 4)[:3, 3] / 1000).tolist()
    matrix = np.array(flat.get("lidar_to_sensor_transform", [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, LIFT, 0, 0, 0, 1]))
    matrix = matrix.astype(np.float64).reshape(4, 4) * np.array([1, 1, 1, 0.001])
    matrix[3, 3] = 1
    columns = int(flat.get("columns_per_frame") or MODES[flat.get("lidar_mode", "1024x10")])
    profile = str(flat.get("udp_profile_lidar", "LEGACY"))
    return Metadata(name, tuple(map(float, altitudes)), tuple(map(float, azimuths)), columns,
                    int(flat.get("columns_per_packet", 16)), origin, matrix, profile, lift)  # fmt: skip


def is_metadata(path: str | Path) -> bool:
    """Whether a `.json` file is Ouster metadata: it has the beams' altitudes."""
    path = Path(path)
    try:
        return path.suffix.lower() == ".json" and KEY in read_text(path)
    except (OSError, ValueError):
        return False


def metadata_beside(path: Path, where: str) -> Path:
    """The only metadata file in the folder of a recording, or in that which the recording is. Raises FileError that
    asks for it, or for one at `where`."""
    folders = [path.parent, path] if path.is_dir() else [path.parent]
    found = [p for folder in folders for p in sorted(folder.glob("*.json")) if is_metadata(p)]
    named = [p for p in found if p.stem.startswith(path.stem) or path.stem.startswith(p.stem)]
    if len(named or found) == 1:
        return (named or found)[0]
    listed = ", ".join(p.name for p in found) or "none"
    raise FileError(f"{path}: expected --metadata FILE.json of the Ouster, or one {where}, found {listed}")


def sensor_of(metadata: Metadata, name: str | None = None) -> Sensor:
    """The sensor that the metadata describes: its beams, columns, and the height of their origin in its frame."""
    lift = float(metadata.to_sensor[2, 3] + metadata.to_sensor[2, 2] * metadata.lift)
    pairs = sorted(set(metadata.altitudes), reverse=True)
    return Sensor(name or metadata.name, tuple(pairs), metadata.columns, 0.3, 240.0, (lift,) * len(pairs))


def packet_size(metadata: Metadata) -> int:
    """Bytes of a lidar packet. Raises FileError for a profile that is not in PROFILES."""
    if metadata.profile not in PROFILES:
        raise FileError(f"expected packets of {', '.join(PROFILES)}, found {metadata.profile}")
    profile = PROFILES[metadata.profile]
    return profile.header + metadata.packet_columns * _column_size(metadata) + profile.footer


def _column_size(metadata: Metadata) -> int:
    profile = PROFILES[metadata.profile]
    return sum(profile.column) + len(metadata.altitudes) * profile.pixel


def turns(packets: Iterable[Datagram], metadata: Metadata) -> Iterator[Fields]:
    """Turns (`whole_turns`): x y z intensity (signal) reflectivity ambient ring time (seconds) of each return.

    Row by row, in the sensor frame: x forward, y left, z up; ring = row, 0 the highest beam. A turn ends where the
    frame's number changes; packets of other sizes are passed over. Raises FileError for a profile not in PROFILES.
    """
    return (turn() for turn in unread_turns(packets, metadata))


def unread_turns(packets: Iterable[Datagram], metadata: Metadata) -> Iterator[Unread]:
    """The same, each decoded when it is called."""
    return (one.turn for one in timed_turns(packets, metadata))


def timed_turns(packets: Iterable[Datagram], metadata: Metadata) -> Iterator[TimedTurn]:
    """The same, with the times of their packets."""
    fault: list[FileError] = []
    return whole_turns(_parts(until_broken(packets, fault), metadata), fault)


def _parts(packets: Iterable[Datagram], metadata: Metadata) -> Iterator[tuple[float, TimedTurn]]:
    """Share of a turn and the turn of each. A packet that comes after the first of the next turn is of its own."""
    size, profile = packet_size(metadata), PROFILES[metadata.profile]
    before: list[Datagram] = []
    own: list[Datagram] = []
    ended, number = None, None
    for packet in packets:
        if len(packet.payload) != size:
            continue
        frame = _frame_number(packet.payload, profile)
        if frame == ended and len(own) <= LATE:
            before.append(packet)
            continue
        if frame != number:
            yield from _turn(before, metadata)
            before, own, ended, number = own, [], number, frame
        own.append(packet)
    yield from _turn(before, metadata)
    yield from _turn(own, metadata)


def _turn(packets: list[Datagram], metadata: Metadata) -> Iterator[tuple[float, TimedTurn]]:
    """Share and turn, or nothing where no column was measured."""
    payloads = [packet.payload for packet in packets]
    if columns := sum(len(_columns(payload, metadata)) for payload in payloads):
        turn = partial(_decoded, metadata, payloads)
        yield columns / metadata.columns, TimedTurn(packets[0].time, packets[-1].time, turn)


def _columns(payload: bytes, metadata: Metadata) -> list[tuple[int, bytes]]:
    """Number and bytes of each column of a packet that was measured."""
    profile, size = PROFILES[metadata.profile], _column_size(metadata)
    columns: list[tuple[int, bytes]] = []
    for start in range(profile.header, profile.header + metadata.packet_columns * size, size):
        block = payload[start : start + size]
        where = int.from_bytes(block[8:10], "little")
        good = block[-4:] == b"\xff\xff\xff\xff" if profile.column[1] else bool(block[10] & 1)
        if good and where < metadata.columns:
            columns.append((where, block))
    return columns


def _decoded(metadata: Metadata, payloads: list[bytes]) -> Fields:
    """The returns of a turn."""
    turn = _Turn(metadata)
    for payload in payloads:
        turn.add(payload)
    return turn.fields()


def _frame_number(payload: bytes, profile: Profile) -> int:
    at = 2 if profile.header else 10
    return int.from_bytes(payload[at : at + 2], "little")


class _Turn:
    """The columns of one turn as they come in, (H, W) images by name."""

    def __init__(self, metadata: Metadata):
        self.metadata, self.profile = metadata, PROFILES[metadata.profile]
        shape = (len(metadata.altitudes), metadata.columns)
        self.range = np.zeros(shape)
        self.seconds = np.zeros(metadata.columns)
        self.images = {name: np.zeros(shape, kind) for name, (_, kind) in self.profile.fields.items()}

    def add(self, payload: bytes) -> None:
        before, after = self.profile.column
        for where, block in _columns(payload, self.metadata):
            pixels = np.frombuffer(block, np.uint8, len(block) - before - after, before).reshape(-1, self.profile.pixel)
            kind, mask, unit = self.profile.range
            self.range[:, where] = (_number(pixels, 0, kind) & mask) * unit
            for name, (at, kind) in self.profile.fields.items():
                self.images[name][:, where] = _number(pixels, at, kind)
            self.seconds[where] = int.from_bytes(block[:8], "little") / 1e9

    def fields(self) -> Fields:
        hit = self.range > 0
        row, column = np.nonzero(hit)
        xyz = points_of(self.range, self.metadata)[hit].astype(np.float32)
        fields: Fields = dict(zip("xyz", xyz.T, strict=True))
        fields |= {{"signal": "intensity"}.get(name, name): image[hit] for name, image in self.images.items()}
        return fields | {"ring": row.astype(np.int32), "time": self.seconds[column]}


def _number(pixels: np.ndarray, at: int, kind: str) -> np.ndarray:
    """(H,) the number of a type at a place of each pixel (H, bytes)."""
    size = np.dtype(kind).itemsize
    return np.ascontiguousarray(pixels[:, at : at + size]).view(kind)[:, 0]


def points_of(distance: np.ndarray, metadata: Metadata) -> np.ndarray:
    """(H, W, 3) metres in the sensor frame of ranges (H, W) metres, column by column as measured.

    The encoder's angle falls from 0 at column 0; a beam stands `azimuths` beside it, and leaves `origin` off the axis:
    x = (r - |n|) cos(e + a) cos(phi) + n_x cos(e), and so `lift` above the centre, n = (n_x, n_z)
    (Ouster's software manual, "Lidar range to XYZ").
    """
    encoder = 2 * np.pi * (1 - np.arange(metadata.columns) / metadata.columns)
    angle = encoder[None, :] - np.radians(metadata.azimuths)[:, None]
    elevation, n = np.radians(metadata.altitudes)[:, None], metadata.origin
    travel = distance - np.hypot(n, metadata.lift)
    x = travel * np.cos(angle) * np.cos(elevation) + n * np.cos(encoder)
    y = travel * np.sin(angle) * np.cos(elevation) + n * np.sin(encoder)
    points = np.stack([x, y, travel * np.sin(elevation) + metadata.lift], axis=-1)
    return points @ metadata.to_sensor[:3, :3].T + metadata.to_sensor[:3, 3]
