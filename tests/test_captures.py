"""Captures: packets built here by the published layouts decode to the points they were built from; one real capture."""

import pickle
import struct
from pathlib import Path

import numpy as np
import pytest

from lidarsynth.data import ouster, velodyne
from lidarsynth.data.capture import Datagram, datagrams
from lidarsynth.data.turns import capture_turns, senders
from lidarsynth.data.whole_turns import whole_turns
from lidarsynth.files.fields import FileError
from lidarsynth.lidar.recognition import recognise
from lidarsynth.verbs.file_kinds import file_lines
from lidarsynth.verbs.inputs import Reading, inputs_of

OUSTER_SDK = (3203.2061, 20918.6877, 7149.6797)  # metres, sums of x, y, z


def udp(payload: bytes, port: int, offset: int = 0, more: bool = False, total: int = 0) -> bytes:
    """An Ethernet frame with an IPv4 packet, whole or a fragment of a UDP packet."""
    head = b"" if offset else struct.pack(">HHHH", 9, port, 8 + (total or len(payload)), 0)
    body = head + payload
    flags = (0x2000 if more else 0) | (offset // 8)
    ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(body), 77, flags, 64, 17, 0, b"\x0a\0\0\1", b"\x0a\0\0\2")
    return b"\0" * 12 + b"\x08\0" + ip + body


def pcap(frames: list[bytes], order: str = "<", nano: bool = False) -> bytes:
    magic = 0xA1B23C4D if nano else 0xA1B2C3D4
    parts = [struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 65535, 1)]
    parts += [struct.pack(order + "IIII", 5, 6, len(f), len(f)) + f for f in frames]
    return b"".join(parts)


def pcapng(frames: list[bytes]) -> bytes:
    def block(kind: int, body: bytes) -> bytes:
        body += b"\0" * (-len(body) % 4)
        return struct.pack("<II", kind, len(body) + 12) + body + struct.pack("<I", len(body) + 12)

    parts = [block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)), block(1, struct.pack("<HHI", 1, 0, 0))]
    parts += [block(6, struct.pack("<IIIII", 0, 0, 5_000_006, len(f), len(f)) + f) for f in frames]
    return b"".join(parts)


@pytest.mark.parametrize("kind", ["<", ">", "nano", "next generation"])
def test_payloads_of_a_capture(kind: str, tmp_path: Path):
    frames = [udp(b"first", 2368), b"\0" * 30, udp(b"x" * 16, 7, more=True, total=24), udp(b"y" * 8, 7, offset=24)]
    path = tmp_path / "c.pcap"
    path.write_bytes(pcapng(frames) if kind[0] == "n" and kind != "nano" else
                     pcap(frames, "<" if kind == "nano" else kind, kind == "nano"))  # fmt: skip
    found = list(datagrams(path))
    assert [(d.port, d.payload) for d in found] == [(2368, b"first"), (7, b"x" * 16 + b"y" * 8)]
    assert found[0].time == (5_000_000_006 if kind == "nano" else 5_000_006_000)
    path.write_bytes(path.read_bytes()[:-9])
    assert len(list(datagrams(path))) == 1, "a record cut short ends the capture"


@pytest.mark.parametrize(("link", "head"), [
    (113, b"\0" * 14 + b"\x08\0"), (276, b"\x08\0" + b"\0" * 18), (101, b""), (0, b"\2\0\0\0"),
    (113, b"\0" * 14 + b"\x81\0\0\5\x08\0"), (276, b"\x81\0" + b"\0" * 18 + b"\0\5\x08\0"),
])  # fmt: skip
def test_captures_of_other_link_layers(link: int, head: bytes, tmp_path: Path):
    """As of `tcpdump -i any`, which writes another one since its version 4.99."""
    content = pcap([head + udp(b"first", 2368)[14:]])
    (tmp_path / "c.pcap").write_bytes(content[:20] + struct.pack("<I", link) + content[24:])
    assert [(d.port, d.payload, d.address) for d in datagrams(tmp_path / "c.pcap")] == [(2368, b"first", "10.0.0.1")]


def test_what_is_no_capture_is_one_line(tmp_path: Path):
    (tmp_path / "c.pcap").write_bytes(b"hello, hello")
    with pytest.raises(FileError, match=r"c.pcap: expected a capture"):
        list(datagrams(tmp_path / "c.pcap"))


def velodyne_packet(product: int, azimuth: int, step: int, distance: int, dual: bool = False) -> bytes:
    """A packet whose returns lie at one distance; `azimuth` of block 0 and `step` between blocks in 0.01 degrees."""
    blocks = []
    for block in range(12):
        turn = (azimuth + step * (block // 2 if dual else block)) % 36000
        returns = b"".join(struct.pack("<HB", distance, laser) for laser in range(32))
        blocks.append(struct.pack("<HH", 0xEEFF, turn) + returns)
    return b"".join(blocks) + struct.pack("<IBB", 0, 0x39 if dual else 0x37, product)


@pytest.mark.parametrize("product", velodyne.MODELS)
def test_velodyne_returns_lie_on_their_beams(product: int):
    model = velodyne.MODELS[product]
    points, _ = velodyne.decode(velodyne_packet(product, 9000, 40, 5000))
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(float)
    xyz[:, 2] -= np.tile(np.resize(model.heights or (0.0,), 32), 12)
    np.testing.assert_allclose(np.linalg.norm(xyz, axis=1), 5000 * model.unit, rtol=1e-6)
    elevation = np.degrees(np.arcsin(xyz[:, 2] / (5000 * model.unit)))
    np.testing.assert_allclose(elevation[:32], np.resize(model.elevations, 32), atol=1e-3)
    order = np.argsort(-np.array(model.elevations))
    np.testing.assert_array_equal(points["ring"][: model.lasers][order], np.arange(model.lasers))
    # Azimuth 90 degrees is to the right, so that y is negative; it grows clockwise within the packet.
    azimuth = np.degrees(np.arctan2(-xyz[:, 1], xyz[:, 0]))
    spread = max(model.azimuths, default=0) - min(model.azimuths, default=0)
    assert np.all((azimuth > 89.9 - spread) & (azimuth < 95 + spread))


def test_velodyne_firing_times():
    """VLP-16: 55.296 (2 b + floor(j/16)) + 2.304 (j mod 16) us; HDL-32E: 46.080 b + 1.152 j us."""
    block, place = np.meshgrid(np.arange(12), np.arange(32), indexing="ij")
    puck = velodyne.firing_time(velodyne.MODELS[0x22], block, place, False)
    np.testing.assert_allclose(puck, 55.296 * (2 * block + place // 16) + 2.304 * (place % 16))
    hdl = velodyne.firing_time(velodyne.MODELS[0x21], block, place, False)
    np.testing.assert_allclose(hdl, 46.080 * block + 1.152 * place)
    dual = velodyne.firing_time(velodyne.MODELS[0x22], block, place, True)
    np.testing.assert_allclose(dual, 55.296 * (2 * (block // 2) + place // 16) + 2.304 * (place % 16))


def test_velodyne_turns_are_cut_at_azimuth_0():
    step = 40
    packets = [Datagram(0, 2368, velodyne_packet(0x22, 30000 + i * 12 * step, step, 5000)) for i in range(190)]
    found = list(velodyne.turns(packets))  # 30000 to 36000, then a little over two turns
    assert len(found) == 2
    for turn in found:
        assert len(turn["x"]) == 36000 // step * 32
        assert np.all(np.diff(np.unwrap(np.arctan2(-turn["y"][::32], turn["x"][::32]))) > 0)
    with pytest.raises(FileError, match="product byte 0xa1"):
        velodyne.decode(velodyne_packet(0xA1, 0, 40, 5000))
    both = velodyne.decode(velodyne_packet(0x22, 0, 40, 5000, dual=True))[0]
    assert len(both["x"]) == 6 * 32, "of two returns the last one"


def spun(first: int, count: int, step: int = 40) -> list[Datagram]:
    """Packets of a VLP-16 from azimuth `first` on, each told from the others by its time."""
    return [
        Datagram(0, 2368, velodyne_packet(0x22, first + i * 12 * step, step, 5000)[:1200] + struct.pack("<I", i)
                 + b"\x37\x22") for i in range(count)
    ]  # fmt: skip


def test_packets_that_come_twice_or_late_make_no_turn():
    packets = spun(30000, 190)
    one, other = velodyne.turns(packets)
    swapped = list(packets)
    swapped[12], swapped[13] = swapped[13], swapped[12]  # 35760 to 36200, and the next one
    ends = list(packets)
    ends[87], ends[88] = ends[88], ends[87]  # 35760 to 36200 of the next turn, and the next one
    for stream in ([p for p in packets for _ in range(2)], swapped, ends):
        found = list(velodyne.turns(stream))
        assert len(found) == 2
        for turn, true in zip(found, (one, other), strict=True):
            order, given = (np.lexsort((t["ring"], t["x"], t["y"])) for t in (turn, true))
            for name, column in true.items():
                np.testing.assert_array_equal(turn[name][order], column[given])


@pytest.mark.parametrize(("begins", "ends"), [(10000, 16000), (10000, 30000), (27000, 45000), (34000, 39000)])
def test_a_sensor_that_is_set_to_a_sector_has_turns(begins: int, ends: int):
    """To less or more than half a turn on, also over azimuth 0; packets go on over what is left out."""
    step, blocks = 40, []
    for _ in range(6):
        blocks += [azimuth % 36000 for azimuth in range(begins, ends, step)]
    packets = []
    for i in range(0, len(blocks) - 11, 12):
        payload = bytearray(velodyne_packet(0x22, 0, step, 5000))
        for number, azimuth in enumerate(blocks[i : i + 12]):
            payload[100 * number + 2 : 100 * number + 4] = struct.pack("<H", azimuth)
        packets.append(Datagram(i, 2368, bytes(payload)))
    found = list(velodyne.turns(packets))
    assert len(found) in (5, 6)
    for turn in found:
        azimuth = (np.degrees(np.arctan2(-turn["y"], turn["x"])) - begins / 100 + 1) % 360
        assert azimuth.min() > 0.9 and azimuth.max() < (ends - begins) / 100 + 1.5
        assert np.all(np.diff(azimuth[::16]) > -0.1), "swept once"


def test_captures_that_tcpdump_goes_on_in_are_captures(tmp_path: Path):
    """Of `tcpdump -C 100 -w drive.pcap`: a folder of them was read as the first alone."""
    for name in ("drive.pcap", "drive.pcap2", "drive.pcap10", "drive.pcapng1"):
        (tmp_path / name).write_bytes(pcap([udp(packet.payload, 2368) for packet in spun(0, 160)]))
    (tmp_path / "drive.pcap1.json").write_text("{}")
    names = [item.name for item in inputs_of([tmp_path]).stream()]
    folders = ["drive", "drive_2", "drive_10", "drive_1"]
    assert names == [f"{folder}/{turn:06d}" for folder in folders for turn in (0, 1)]
    assert "4 bags and captures" in str(file_lines(tmp_path, Reading()))


def test_turns_that_are_passed_over_are_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """As of a shard, or of a page that goes back to one; to another process go packets."""
    path = tmp_path / "c.pcap"
    path.write_bytes(pcap([udp(packet.payload, 2368) for packet in spun(30000, 190)]))
    with monkeypatch.context() as broken:
        broken.setattr(velodyne, "decode", None)
        _, item = inputs_of([path]).stream()
    data = pickle.dumps(item)
    assert len(data) < 80 * 1300, "75 packets, and no points"
    _, other = capture_turns(path)
    scan = pickle.loads(data).read().scan
    np.testing.assert_array_equal(scan.xyz, np.stack([other[axis] for axis in "xyz"], axis=1))


@pytest.mark.parametrize("kind", ["pcap", "pcapng"])
def test_turns_before_a_broken_record_come_and_it_is_told(kind: str, tmp_path: Path):
    frames = [udp(packet.payload, 2368) for packet in spun(0, 190)]
    content = bytearray(pcap(frames) if kind == "pcap" else pcapng(frames))
    at = content.index(frames[160]) - (8 if kind == "pcap" else 24)
    content[at : at + 4] = b"\xff" * 4
    (tmp_path / f"c.{kind}").write_bytes(content)
    stream = capture_turns(tmp_path / f"c.{kind}")
    assert [len(next(stream)["x"]) for _ in range(2)] == [900 * 32, 900 * 32]
    with pytest.raises(FileError, match=rf"c.{kind}: expected records of .* found one of 4294967295"):
        next(stream)


def test_what_a_capture_cuts_at_its_ends_is_no_turn():
    def left(*shares: float) -> list[float]:
        return [turn["x"].tolist()[0] for turn in whole_turns((s, {"x": np.array([s])}) for s in shares)]

    assert left(0.6, 1, 0.98, 0.7, 1, 0.55) == [1, 0.98, 0.7, 1], "packets that were lost in the midst are no end"
    assert left(0.95, 1) == [0.95, 1] and left(0.4, 0.7) == [0.7]
    assert left(0.1, 0.25, 0.25, 0.2) == [0.25, 0.25], "of a sensor that is set to a sector"
    assert left(0.6) == [0.6] and left(0.4) == [] and left() == []


def test_two_sensors_of_a_capture_are_told_apart(tmp_path: Path):
    def frames(distance: int, host: int, tag: bytes = b"") -> list[bytes]:
        packets = [udp(velodyne_packet(0x22, i * 480, 40, distance), 2368) for i in range(160)]
        packets = [p[:26] + bytes([10, 0, 0, host]) + p[30:] for p in packets]  # whose they are
        return [p[:12] + tag + p[12:] for p in packets]

    path = tmp_path / "two.pcap"
    both = zip(frames(5000, 1, b"\x88\xa8\0\5\x81\0\0\6"), frames(2000, 2), strict=True)
    path.write_bytes(pcap([frame for pair in both for frame in pair]))
    assert senders(path) == ["10.0.0.1:2368", "10.0.0.2:2368"]
    with pytest.raises(FileError, match=r"one LiDAR, or --topic .* found 10.0.0.1:2368, 10.0.0.2:2368"):
        next(capture_turns(path))
    with pytest.raises(FileError, match=r"as 10.0.0.3:1, found"):
        next(capture_turns(path, None, "10.0.0.3:1"))
    later, after = inputs_of([path, path.with_name("two.pcap")], Reading()).stream()
    assert {later.name, after.name} == {"two"}, "one broken capture is named, and the others go on"
    with pytest.raises(FileError, match="one LiDAR"):
        later.read()
    for host, metres in ((1, 10), (2, 4)):
        turn = next(capture_turns(path, None, f"10.0.0.{host}:2368"))
        flat = np.hypot(turn["x"], turn["y"])
        assert len(flat) == 900 * 32 and flat.max() == pytest.approx(metres, rel=1e-3)


@pytest.mark.parametrize("name", ouster.PROFILES)
def test_ouster_packets_hold_what_was_put_in(name: str):
    rng, height, columns = np.random.default_rng(0), 16, 64
    altitudes, azimuths = np.linspace(15, -15, height), np.tile([3.0, 1, -1, -3], 4)
    matrix = np.diag([-1.0, -1, 1, 1])
    metadata = ouster.Metadata("o", tuple(altitudes), tuple(azimuths), columns, 16, 0.015, matrix, name)
    profile = ouster.PROFILES[name]
    kind, mask, unit = profile.range
    distance = (rng.integers(200, min(mask, 20000), (height, columns)) * (rng.random((height, columns)) < 0.9)).astype(
        int
    )
    light = rng.integers(0, 255, (height, columns))
    packets = []
    for start in range(0, columns, 16):
        payload = bytearray(profile.header)
        payload[2:4] = struct.pack("<H", 3) if profile.header else b""
        for column in range(start, start + 16):
            head = struct.pack("<QHH", column * 1000, column, 3 if not profile.header else 1)
            payload += head.ljust(profile.column[0], b"\0")
            for row in range(height):
                pixel = bytearray(profile.pixel)
                size = np.dtype(kind).itemsize
                pixel[:size] = int(distance[row, column]).to_bytes(size, "little")
                pixel[profile.fields["reflectivity"][0]] = int(light[row, column])
                payload += pixel
            payload += b"\xff" * profile.column[1]
        packets.append(Datagram(0, 7502, bytes(payload) + bytes(profile.footer)))
    (turn,) = ouster.turns(packets, metadata)
    hit = distance > 0
    np.testing.assert_array_equal(turn["reflectivity"], light[hit])
    np.testing.assert_array_equal(turn["ring"], np.nonzero(hit)[0])
    np.testing.assert_allclose(turn["time"], np.nonzero(hit)[1] * 1e-6)
    # Beside the axis by the beam's origin, as far as was measured: |p - n (cos e, sin e, 0)| = r - n.
    encoder = (2 * np.pi * (1 - np.arange(columns) / columns))[np.nonzero(hit)[1]]
    xyz = np.stack([-turn["x"], -turn["y"], turn["z"]], axis=1)
    beam = xyz - 0.015 * np.stack([np.cos(encoder), np.sin(encoder), 0 * encoder], axis=1)
    np.testing.assert_allclose(np.linalg.norm(beam, axis=1), distance[hit] * unit - 0.015, atol=1e-5)
    np.testing.assert_allclose(np.degrees(np.arcsin(beam[:, 2] / (distance[hit] * unit - 0.015))),
                               altitudes[np.nonzero(hit)[0]], atol=1e-3)  # fmt: skip
    turned = np.mod(np.arctan2(beam[:, 1], beam[:, 0]) - encoder, 2 * np.pi)
    np.testing.assert_allclose(np.cos(turned), np.cos(np.radians(azimuths[np.nonzero(hit)[0]])), atol=1e-6)


def test_packets_of_an_ouster_that_come_late_are_of_their_own_turn():
    """The turns beside lost points, and the first, which a capture cuts, came."""
    metadata = ouster.Metadata("o", (1.0, 0.0, -1.0, -2.0), (0.0,) * 4, 64, 16, 0.0, np.eye(4), "LEGACY")

    def packet(number: int, first: int) -> Datagram:
        columns = [
            struct.pack("<QHHI", column, column, number, 0) + struct.pack("<III", 5000, 7, 9) * 4 + b"\xff" * 4
            for column in range(first, first + 16)
        ]
        return Datagram(0, 7502, b"".join(columns))

    packets = [packet(65534, 32), packet(65534, 48), *(packet(n, 16 * i) for n in (65535, 0, 1) for i in range(4))]
    whole = list(ouster.turns(packets, metadata))
    assert [len(turn["x"]) for turn in whole] == [256, 256, 256], "and half a turn before"
    for at in (2, 6, 10):
        packets[at], packets[at - 1] = packets[at - 1], packets[at]
    for turn, other in zip(whole, ouster.turns(packets, metadata), strict=True):
        for name, column in turn.items():
            np.testing.assert_array_equal(other[name], column)


def test_a_real_ouster_capture(shared: Path):
    """Sums over all points as `ouster-sdk` 1.0.1 computes them (XYZLut without extrinsics) from the same capture."""
    path = shared / "scans" / "other" / "OS-1-64_1024x10_fw20.pcap"
    (item,) = inputs_of([path], Reading()).stream()
    loaded = item.read()
    assert len(loaded.scan) == 16749 and loaded.scan.ring is not None
    np.testing.assert_allclose(loaded.scan.xyz.astype(float).sum(axis=0), OUSTER_SDK, rtol=1e-5)
    assert loaded.scan.extra["intensity"].max() == 1241 and loaded.scan.ring.max() == 63
    assert recognise(loaded.scan)[0] == "os1-64"
    sensor = ouster.sensor_of(ouster.read_metadata(path.with_name("OS-1-64_sensor_config_reduced.json")))
    assert (sensor.height, sensor.width, sensor.elevations[0]) == (64, 1024, 16.46)


def blocks(
    order: str, option: bytes, packets: list[tuple[int, bytes]], longest: int = 0, start: int | None = None
) -> bytes:
    """A pcapng of one interface with an option if_tsresol, and if_tsoffset where it has a start; each packet (ticks,
    frame), or a simple one where -1."""

    def block(kind: int, body: bytes) -> bytes:
        body += b"\0" * (-len(body) % 4)
        return struct.pack(order + "II", kind, len(body) + 12) + body + struct.pack(order + "I", len(body) + 12)

    options = struct.pack(order + "HH", 2, 3) + b"eth\0"  # its name, before
    options += struct.pack(order + "HH", 9, len(option)) + option + b"\0" * (-len(option) % 4) if option else b""
    options += struct.pack(order + "HHq", 14, 8, start) if start is not None else b""
    parts = [block(0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1)),
             block(1, struct.pack(order + "HHI", 1, 0, longest) + options + b"\0\0\0\0")]  # fmt: skip
    for ticks, frame in packets:
        high, low = divmod(max(ticks, 0), 1 << 32)
        enhanced = struct.pack(order + "IIIII", 0, high, low, len(frame), len(frame)) + frame
        simple = struct.pack(order + "I", len(frame)) + frame[: longest or None]
        parts.append(block(6, enhanced) if ticks >= 0 else block(3, simple))
    return b"".join(parts)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("option", "per_second"),
    [(b"", 10**6), (b"\x06", 10**6), (b"\x09", 10**9), (b"\x03", 10**3), (b"\x0c", 10**12), (b"\x94", 2**20)],
)
def test_times_of_a_capture_are_in_the_ticks_of_its_clock(order: str, option: bytes, per_second: int, tmp_path: Path):
    start = 17_000_000
    packets = [(start * per_second + per_second // 4, udp(b"one", 1)), (-1, udp(b"two", 2))]
    (tmp_path / "c.pcapng").write_bytes(blocks(order, option, packets))
    found = list(datagrams(tmp_path / "c.pcapng"))
    assert [(d.port, d.payload) for d in found] == [(1, b"one"), (2, b"two")]
    assert [d.time for d in found] == [start * 10**9 + 250_000_000] * 2, "a simple packet has that of the one before"


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("option", [b"", b"\x09"])
@pytest.mark.parametrize("start", [1_700_000_000, -3])
def test_a_clock_may_count_from_another_second_than_that_of_1970(start: int, option: bytes, order: str, tmp_path: Path):
    ticks = 5 * (10**9 if option else 10**6)
    (tmp_path / "c.pcapng").write_bytes(blocks(order, option, [(ticks, udp(b"one", 1))], start=start))
    assert [d.time for d in datagrams(tmp_path / "c.pcapng")] == [(5 + start) * 10**9]


def test_simple_packets_of_a_capture(tmp_path: Path):
    frames = [udp(b"x" * n, 5) for n in (1, 2, 3, 300)]
    (tmp_path / "c.pcapng").write_bytes(blocks("<", b"", [(-1, f) for f in frames], longest=64))
    found = list(datagrams(tmp_path / "c.pcapng"))
    assert [d.payload for d in found] == [b"x", b"xx", b"xxx", b"x" * 22], "no more than the interface keeps"
    assert {d.time for d in found} == {0}
