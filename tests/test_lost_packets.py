"""Captures that lost packets: what is left of one packet, or of one turn, is not put together with another's."""

import struct
from pathlib import Path

import numpy as np
import pytest
from test_captures import pcap, udp, velodyne_packet

from lidarsynth.data import velodyne
from lidarsynth.data.capture import Datagram, datagrams

STEP, PACE = 40, 138_240 / 50  # of a VLP-16 at ten turns a second: 0.01 degrees a block, nanoseconds each


def fragments(packet: int, size: int = 40) -> list[bytes]:
    """A UDP packet of its own bytes, in five frames of one IP packet's number."""
    payload = bytes([packet]) * (5 * size - 8)
    whole = [udp(payload[: size - 8], 7, more=True, total=len(payload))]
    return whole + [
        udp(payload[at - 8 : at - 8 + size], 7, at, more=at < 4 * size) for at in range(size, 5 * size, size)
    ]


def at_second(frames: list[tuple[float, bytes]]) -> bytes:
    data = bytearray(pcap([frame for _, frame in frames]))
    place = 24
    for second, frame in frames:
        data[place : place + 8] = struct.pack("<II", int(second), round(second % 1 * 1e6))
        place += 16 + len(frame)
    return bytes(data)


@pytest.mark.parametrize("lost", [0, 2, 4])
def test_fragments_of_two_packets_of_one_number_make_none(lost: int, tmp_path: Path):
    """An IP packet's number comes again after 65,536 others; of a first one, which lost a fragment, others wait."""
    first = [frame for number, frame in enumerate(fragments(1)) if number != lost]
    later = [(60.0 * packet, frame) for packet in (2, 3) for frame in fragments(packet)]
    (tmp_path / "c.pcap").write_bytes(at_second([*((0.0, frame) for frame in first), *later]))
    assert [set(found.payload) for found in datagrams(tmp_path / "c.pcap")] == [{2}, {3}]


def test_fragments_that_come_in_any_order_make_a_packet(tmp_path: Path):
    first, second, *others = fragments(1)
    (tmp_path / "c.pcap").write_bytes(pcap([*reversed(others), second, second, first, *fragments(2)]))
    assert [set(found.payload) for found in datagrams(tmp_path / "c.pcap")] == [{1}, {2}]


def spun(azimuths: range, time: int = 0) -> list[Datagram]:
    """A packet at each azimuth, all of one distance, at the times at which it is there, by the sensor's clock, too."""
    found = []
    for azimuth in azimuths:
        nanoseconds = time + round(azimuth * PACE)
        payload = velodyne_packet(0x22, azimuth % 36000, STEP, 5000)
        clock = struct.pack("<I", nanoseconds // 1000 % 3_600_000_000)
        found.append(Datagram(nanoseconds, 2368, payload[:1200] + clock + payload[1204:]))
    return found


@pytest.mark.parametrize("turns", [1, 3])
@pytest.mark.parametrize("shift", [0, -960, 4800])
def test_halves_of_two_turns_make_none(shift: int, turns: int):
    """A disk that stood still for a turn's time lost what is between: the azimuth goes on as if nothing was lost."""
    block = 12 * STEP
    before, after = (
        range(0, 36000 + 12000, block),
        range(36000 * (1 + turns) + 12000 + shift, 36000 * (4 + turns), block),
    )
    found = list(velodyne.turns([*spun(before), *spun(after)]))
    seconds = [float(np.ptp(turn["time"])) for turn in found]
    assert max(seconds) <= 36000 * PACE / 1e9 + 0.001
    assert len(found) == 4, "the whole one before, that from 120 degrees on, and two after it"


def test_a_gap_of_less_than_a_turn_stays_in_its_turn():
    block = 12 * STEP
    azimuths = [a for a in range(0, 4 * 36000, block) if not 36000 + 6000 < a < 36000 + 20000]
    found = list(velodyne.turns([packet for a in azimuths for packet in spun(range(a, a + 1))]))
    assert [len(turn["x"]) // 32 // 12 for turn in found] == pytest.approx([75, 46, 75, 75], abs=1)


def test_packets_that_wait_on_the_way_end_no_turn():
    """A computer that is busy gets those of a turn's time at once, with times of its own."""
    block = 12 * STEP
    packets = spun(range(0, 4 * 36000, block))
    late = [packet._replace(time=max(packet.time, packets[190].time)) if at > 100 else packet
            for at, packet in enumerate(packets)]  # fmt: skip
    assert [len(turn["x"]) for turn in velodyne.turns(late)] == [len(turn["x"]) for turn in velodyne.turns(packets)]
    assert len(list(velodyne.turns(packets))) == 4


def test_a_new_hour_of_the_clock_ends_no_turn():
    packets = spun(range(0, 4 * 36000, 12 * STEP), time=3_600 * 10**9 - 150_000_000)
    assert [len(turn["x"]) // 32 // 12 for turn in velodyne.turns(packets)] == [75, 75, 75, 75]
