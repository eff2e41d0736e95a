"""Hesai's packets, made here by the published layouts from known points, come back as these points."""

import pickle
import struct
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from hesai_packets import HEADS, angles_csv, asked_for_angles, packet, stream
from test_captures import pcap, pcapng, udp, velodyne_packet

from lidarsynth.cli.main import main
from lidarsynth.data import hesai
from lidarsynth.data.angle_files import Angles
from lidarsynth.data.capture import Datagram
from lidarsynth.data.turns import capture_turns, senders
from lidarsynth.files.fields import Fields, FileError
from lidarsynth.files.formats import read
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.verbs.file_kinds import file_lines
from lidarsynth.verbs.inputs import Reading, inputs_of
from lidarsynth.viewer.series import series_of

STEP = 0.004  # metres
PANDAR64 = SENSORS["pandar64"]
OFFSETS = tuple(np.tile([-1.0, 3.2, 5.2, 1.0, -3.2, -5.2, 0.0, 1.0], 8))  # degrees, as a unit's own: whole columns
SIZES = {"Pandar40P": 1262, "Pandar64": 1194, "PandarXT-32": 1076, "PandarXT-16": 564, "XT32M": 816, "PandarQT64": 1068}


def layout(model: str) -> hesai.Layout:
    return next(one for one in hesai.LAYOUTS if one.name == model)


def angles(lasers: int) -> Angles:
    return Angles(tuple(np.linspace(14.3, -16.9, lasers).tolist()), tuple((np.arange(lasers) % 5 - 1.7).tolist()))


def room(model: str, azimuths: np.ndarray) -> np.ndarray:
    """(blocks, lasers) distances in steps, every one another one, some nothing."""
    rng = np.random.default_rng(3)
    distance = rng.integers(200, 60000, (len(azimuths), HEADS[model][3]))
    return np.where(rng.random(distance.shape) < 0.9, distance, 0)


def as_capture(path: Path, payloads: list[bytes], apart: int = 333) -> Path:
    """A capture of packets that come so many microseconds apart."""
    content = bytearray(pcap(frames := [udp(payload, 2368) for payload in payloads]))
    at = 24
    for i, frame in enumerate(frames):
        content[at : at + 8] = struct.pack("<II", *divmod(5 * 10**6 + apart * i, 10**6))
        at += 16 + len(frame)
    path.write_bytes(content)
    return path


@lru_cache(maxsize=1)
def street() -> np.ndarray:
    """(64, 1800) ranges in steps of a street that our own caster saw with a Pandar64, columns from behind clockwise."""
    pytest.importorskip("embreex", reason="lidarsynth[synthetic] is not installed")
    image = project(SyntheticStreets(5, 1, "pandar64")[0], PANDAR64)
    return np.round(image.range / STEP).astype(int)


def street_packets(turns: int = 3) -> list[bytes]:
    """A Pandar64's packets of that street: laser i of block b looks to column b + its offset."""
    column = (np.arange(1800)[:, None] + np.round(np.array(OFFSETS) / 0.2).astype(int)) % 1800
    distance = street()[np.arange(64), column]  # (blocks, lasers)
    azimuth = (18010 + 20 * np.arange(1800)) % 36000  # 0.01 degrees clockwise from ahead, of each column's centre
    return stream("Pandar64", np.tile(azimuth, turns), np.tile(distance, (turns, 1)))


def street_capture(folder: Path, csv: bool = True) -> Path:
    if csv:
        (folder / "unit.csv").write_text(angles_csv(PANDAR64.elevations, OFFSETS))
    return as_capture(folder / "c.pcap", street_packets())


def of_order(turn: Fields) -> Fields:
    """The returns ordered by ring and then clockwise."""
    order = np.lexsort((np.arctan2(-turn["y"], turn["x"]), turn["ring"]))
    return {name: column[order] for name, column in turn.items()}


@pytest.mark.parametrize("number", [0, None])
@pytest.mark.parametrize("model", HEADS)
def test_a_packet_has_the_size_of_its_manual_and_tells_its_model(model: str, number: int | None):
    (payload,) = stream(model, 40 * np.arange(HEADS[model][2]), room(model, np.arange(HEADS[model][2])), number=number)
    assert len(payload) == SIZES[model] + (0 if number is None else 4)
    assert (found := hesai.layout_of(payload)) is not None and found.name == model
    for other in (payload[:-1], payload + b"\0", b"\0" + payload[1:], payload[:-60], b""):
        assert not hesai.is_hesai(other)
    if model != "Pandar40P":  # that tells no counts
        counts = 2 if model == "Pandar64" else 6
        for at in (counts, counts + 1):
            assert not hesai.is_hesai(payload[:at] + bytes([payload[at] - 1]) + payload[at + 1 :])


@pytest.mark.parametrize("model", HEADS)
def test_returns_lie_where_they_were_measured(model: str):
    blocks, lasers = HEADS[model][2:4]
    azimuths, known = (35800 + 20 * np.arange(blocks)) % 36000, angles(lasers)
    distance = room(model, azimuths)
    (payload,) = stream(model, azimuths, distance)
    found = hesai.decode(layout(model), known, payload, 5 * 10**9)
    block, laser = np.nonzero(distance)
    xyz = np.stack([found[axis] for axis in "xyz"], axis=1).astype(float)
    metres = distance[block, laser] * STEP
    np.testing.assert_allclose(np.linalg.norm(xyz, axis=1), metres, rtol=1e-6)
    np.testing.assert_allclose(np.degrees(np.arcsin(xyz[:, 2] / metres)), np.array(known.elevations)[laser], atol=1e-4)
    # Clockwise seen from above, so that y is negative at 90 degrees.
    angle = azimuths[block] / 100 + np.array(known.azimuths)[laser]
    off = (np.degrees(np.arctan2(-xyz[:, 1], xyz[:, 0])) - angle + 180) % 360 - 180
    assert np.abs(off).max() < 1e-3
    np.testing.assert_array_equal(found["ring"], laser)
    np.testing.assert_array_equal(found["intensity"], distance[block, laser] % 251)
    micros = {"Pandar40P": 500 / 9, "Pandar64": 500 / 9, "PandarQT64": 500 / 3}.get(model, 50)
    np.testing.assert_allclose(found["time"] - 5, block * micros * 1e-6, atol=1e-7)


@pytest.mark.parametrize("order", [0, 1])
@pytest.mark.parametrize("model", [model for model in HEADS if model != "XT32M"])
def test_of_two_returns_the_last_is_taken_in_whichever_order_they_come(model: str, order: int):
    blocks, lasers = HEADS[model][2:4]
    azimuths = np.repeat(9000 + 40 * np.arange(blocks // 2), 2)
    distance = np.zeros((blocks, lasers), int)
    distance[order::2], distance[1 - order :: 2] = 5000, 3000  # the last is the farther one
    distance[:, 3], distance[1 - order :: 2, 4] = 1000, 0  # both one and the same; and only one
    distance[:, 5] = 0
    (payload,) = stream(model, azimuths, distance, np.where(distance == 5000, 77, 9))
    found = hesai.decode(layout(model), angles(lasers), payload)
    assert len(found["x"]) == blocks // 2 * (lasers - 1)
    steps = np.round(np.linalg.norm([found[axis] for axis in "xyz"], axis=0) / STEP)
    np.testing.assert_array_equal(steps, np.where(found["ring"] == 3, 1000, 5000))
    np.testing.assert_array_equal(found["intensity"], np.where(steps == 5000, 77, 9))
    micros = np.unique(np.round(found["time"] * 1e6, 1))
    np.testing.assert_allclose(micros, np.arange(blocks // 2) * layout(model).firing, atol=0.1)


def test_of_three_returns_the_last_is_taken():
    azimuths, distance = np.repeat([9000, 9018], 3), np.tile(np.arange(1000, 7000, 1000)[:, None], 32)
    (payload,) = stream("XT32M", azimuths, distance)
    found = hesai.decode(layout("XT32M"), angles(32), payload)
    steps = np.round(np.linalg.norm([found[axis] for axis in "xyz"], axis=0) / STEP)
    assert sorted(steps) == [3000] * 32 + [6000] * 32


def test_a_street_goes_into_packets_and_comes_out(tmp_path: Path):
    turns = list(capture_turns(street_capture(tmp_path)))
    assert len(turns) == 2, "and two halves, which the capture has cut"
    turn = of_order(turns[1])
    true = PANDAR64.points((street() * STEP).astype(np.float32))
    row, column = np.nonzero(street())
    order = np.lexsort((np.arctan2(-true[row, column, 1], true[row, column, 0]), row))
    true, row, column = true[row, column][order], row[order], column[order]
    xyz = np.stack([turn[axis] for axis in "xyz"], axis=1)
    np.testing.assert_array_equal(turn["ring"], row)
    assert np.linalg.norm(xyz - true, axis=1).max() < 0.002
    # Packet after packet, and in each a block after the other is fired.
    block = (column - np.round(np.array(OFFSETS) / 0.2).astype(int)[row]) % 1800
    turned = np.where(block < 900, block + 1800, block) + 1800  # the second, from ahead to ahead
    np.testing.assert_allclose(turn["time"] - 5, turned // 6 * 333e-6 + turned % 6 * 500 / 9 * 1e-6, atol=1e-7)


def test_a_capture_of_a_pandar64_is_recognised(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = street_capture(tmp_path)
    main(["info", str(path)])
    said = capsys.readouterr().out
    assert "first turn: sensor" in said and "pandar64" in said.split("first turn: sensor")[1].splitlines()[0]
    assert "400 of 1198 bytes as 10.0.0.1:2368" in said
    main(["info", str(tmp_path / "unit.csv")])
    assert "angle correction file" in capsys.readouterr().out


def test_verbs_take_such_a_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path, out = street_capture(tmp_path), tmp_path / "out"
    main(["complete", str(path), "--model", "nearest", "--out", str(out)])
    files = sorted(out.rglob("*.ply"))
    assert [str(file.relative_to(out)) for file in files] == ["c/000000.ply", "c/000001.ply"]
    scan, (_, turn) = read(files[1]), capture_turns(path)
    measured, given = scan.xyz[scan.extra["new"] == 0], np.stack([turn[axis] for axis in "xyz"], axis=1)
    np.testing.assert_array_equal(measured[np.lexsort(measured.T)], given[np.lexsort(given.T)])
    assert scan.ring is not None and scan.time is not None and (scan.extra["new"] == 1).any()
    main(["sensor", str(path), "--out", str(tmp_path / "my.toml")])
    main(["project", str(path), "--sensor", str(tmp_path / "my.toml"), "--out", str(tmp_path / "images")])
    image = np.load(tmp_path / "images" / "c" / "000001.npz")
    assert image["range"].shape[0] == 64
    assert "64 beams from +14.88 to -24.90" in capsys.readouterr().out
    series = series_of([path], Reading(metadata=tmp_path / "unit.csv"))
    np.testing.assert_array_equal(series[1].scan.xyz, given)


def test_a_run_does_not_go_on_with_scans_of_other_angles(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = street_capture(tmp_path, csv=False)
    (told := tmp_path / "a.csv").write_text(angles_csv(PANDAR64.elevations, OFFSETS))
    words = ["project", str(path), "--out", str(tmp_path / "o"), "--sensor", "pandar64", "--no-picture", "--metadata"]
    main([*words, str(told)])
    told.rename(moved := tmp_path / "b.csv")
    main([*words, str(moved), "--skip-existing"])
    assert "2 were there already" in capsys.readouterr().out
    moved.write_text(angles_csv(PANDAR64.elevations, OFFSETS[::-1]))
    with pytest.raises(SystemExit, match="2"):
        main([*words, str(moved), "--skip-existing"])
    assert "found other settings: metadata " in capsys.readouterr().err


def test_without_angles_one_line_asks_for_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = street_capture(tmp_path, csv=False)
    for words in (["info", str(path)], ["complete", str(path), "--out", str(tmp_path / "o")]):
        assert "web page exports it" in asked_for_angles(words, capsys)
    (tmp_path / "xt.csv").write_text(angles_csv(range(15, -17, -1), [0] * 32))
    with pytest.raises(FileError, match="the Pandar64, or one of 64 channels beside it, found none"):
        next(capture_turns(path))
    with pytest.raises(FileError, match=r"xt.csv: expected the 64 channels of a Pandar64, found 32"):
        next(capture_turns(path, tmp_path / "xt.csv"))
    for name in ("one.csv", "two.csv"):
        (tmp_path / name).write_text(angles_csv(PANDAR64.elevations, OFFSETS))
    with pytest.raises(FileError, match=r"found several beside it: one.csv, two.csv"):
        next(capture_turns(path))
    (tmp_path / "one.csv").rename(tmp_path / "c_angles.csv")
    assert len(list(capture_turns(path))) == 2, "that of its name"


@pytest.mark.parametrize(("model", "lowest"), [("PandarXT-32", -16), ("PandarXT-16", -15)])
def test_nominal_angles_are_told_of(model: str, lowest: int, tmp_path: Path):
    azimuths = (18 * np.arange(2 * 2000)) % 36000
    path = as_capture(tmp_path / "xt.pcap", stream(model, azimuths, np.full((4000, HEADS[model][3]), 2500)))
    with pytest.warns(UserWarning, match=rf"xt.pcap: found no angle .* {model}, .*: its nominal angles are taken"):
        turn = next(capture_turns(path))
    elevation = np.degrees(np.arcsin(turn["z"] / 10.0))
    np.testing.assert_allclose(np.unique(np.round(elevation, 3)), np.linspace(lowest, 15, HEADS[model][3]), atol=1e-3)
    for verb in (["info"], ["project", "--sensor", "vlp-16", "--no-picture", "--out", str(tmp_path / "o")]):
        with pytest.warns(UserWarning, match="nominal angles") as told:
            main([*verb, str(path)])
        assert len({str(one.message) for one in told}) == 1, "of which the command line says each once"
    (tmp_path / "angles.CSV").write_text(angles_csv(np.linspace(9, -9, HEADS[model][3]), [0.5] * HEADS[model][3]))
    turn = next(capture_turns(path))
    assert np.degrees(np.arcsin(turn["z"] / 10.0)).max() == pytest.approx(9, abs=1e-3)


def spun(model: str, first: int, count: int, step: int = 40) -> list[Datagram]:
    """Packets from azimuth `first` on, each told from the others by its number."""
    blocks, lasers = HEADS[model][2:4]
    return [
        Datagram(i, 2368, packet(model, [(first + step * (i * blocks + b)) % 36000 for b in range(blocks)],
                                 np.full((blocks, lasers), 2500), np.full((blocks, lasers), 9), i))
        for i in range(count)
    ]  # fmt: skip


@pytest.mark.parametrize("model", HEADS)
def test_packets_that_come_twice_or_late_make_no_turn(model: str):
    blocks, lasers = HEADS[model][2:4]
    how, turn = (layout(model), angles(lasers)), 900 // blocks
    packets = spun(model, 36000 - 40 * blocks * 10 + 120, 2 * turn + 20)
    one, other = list(hesai.turns(packets, *how))[-2:]
    assert len(one["x"]) == 900 * lasers
    swapped, lost = list(packets), [p for i, p in enumerate(packets) if i not in (20, 21, 30)]
    for at in (9, turn + 10):
        swapped[at], swapped[at + 1] = swapped[at + 1], swapped[at]
    for stream_ in ([p for p in packets for _ in range(2)], swapped):
        for found, true in zip(list(hesai.turns(stream_, *how))[-2:], (one, other), strict=True):
            order, given = (np.lexsort((t["time"], t["ring"], t["x"], t["y"])) for t in (found, true))
            for name, column in true.items():
                np.testing.assert_array_equal(found[name][order], column[given])
    assert [len(t["x"]) for t in list(hesai.turns(lost, *how))[-2:]] == [(900 - 3 * blocks) * lasers, len(other["x"])]


@pytest.mark.parametrize(("begins", "ends"), [(10000, 16000), (27000, 45000), (34000, 39000)])
def test_a_sensor_that_is_set_to_a_sector_has_turns(begins: int, ends: int):
    azimuths = np.tile(np.arange(begins, ends, 20) % 36000, 6)
    payloads = stream("Pandar64", azimuths, np.full((len(azimuths), 64), 2500))
    found = list(hesai.turns([Datagram(i, 0, p) for i, p in enumerate(payloads)], layout("Pandar64"),
                             Angles(PANDAR64.elevations, (0.0,) * 64)))  # fmt: skip
    assert len(found) in (5, 6)
    for turn in found:
        azimuth = (np.degrees(np.arctan2(-turn["y"], turn["x"])) - begins / 100 + 1) % 360
        assert azimuth.min() > 0.9 and azimuth.max() < (ends - begins) / 100 + 1.1
        assert np.all(np.diff(azimuth[::64]) > -0.1), "swept once"


def test_sensors_of_a_capture_are_told_apart_whoever_made_them(tmp_path: Path):
    """Two of Hesai's of different models, with their own angle files, and a Velodyne, in turns of one another."""

    def frames(payloads: list[bytes], host: int) -> list[bytes]:
        return [f[:26] + bytes([10, 0, 0, host]) + f[30:] for f in (udp(payload, 2368) for payload in payloads)]

    pandar = frames([p.payload for p in spun("Pandar64", 0, 320)], 1)
    xt = frames([p.payload for p in spun("PandarXT-16", 0, 320)], 2)
    puck = frames([velodyne_packet(0x22, i * 480, 40, 5000) for i in range(320)], 3)
    path = tmp_path / "three.pcap"
    path.write_bytes(pcap([frame for each in zip(pandar, xt, puck, strict=True) for frame in each]))
    (tmp_path / "p.csv").write_text(angles_csv(PANDAR64.elevations, OFFSETS))
    (tmp_path / "x.csv").write_text(angles_csv(np.linspace(14, -14, 16), [0] * 16))
    named = [f"10.0.0.{host}:2368" for host in (1, 2, 3)]
    assert senders(path) == named
    with pytest.raises(FileError, match=r"one LiDAR, or --topic ADDRESS:PORT, found " + ", ".join(named)):
        next(capture_turns(path))
    for name, lasers, top in zip(named, (64, 16, 16), (14.882, 14, 15), strict=True):
        turn = next(capture_turns(path, None, name))
        up = np.degrees(np.arctan2(turn["z"], np.hypot(turn["x"], turn["y"])))
        assert turn["ring"].max() == lasers - 1 and up.max() == pytest.approx(top, abs=0.1)
    lines = file_lines(path, Reading())
    assert lines is not None and f"--topic {named[1]}: points" in lines


@pytest.mark.parametrize("kind", ["pcap", "pcapng"])
def test_turns_before_a_broken_record_come_and_it_is_told(kind: str, tmp_path: Path):
    frames = [udp(p.payload, 2368) for p in spun("PandarXT-32", 0, 300)]
    content = bytearray(pcap(frames) if kind == "pcap" else pcapng(frames))
    at = content.index(frames[260]) - (8 if kind == "pcap" else 24)
    content[at : at + 4] = b"\xff" * 4
    (tmp_path / f"c.{kind}").write_bytes(content)
    (tmp_path / "c.csv").write_text(angles_csv(range(15, -17, -1), [0] * 32))
    stream = capture_turns(tmp_path / f"c.{kind}")
    assert [len(next(stream)["x"]) for _ in range(2)] == [900 * 32, 900 * 32]
    with pytest.raises(FileError, match=rf"c.{kind}: expected records of .* found one of 4294967295"):
        next(stream)


def test_malformed_packets_are_passed_over_or_told(tmp_path: Path):
    packets, how = spun("Pandar64", 0, 320), (layout("Pandar64"), Angles(PANDAR64.elevations, OFFSETS))
    (true, *_) = hesai.turns(packets, *how)
    wrong = [p.payload for p in packets[20:23]]
    for i, payload in enumerate((wrong[0][:-1], wrong[1][:3] + b"\7" + wrong[1][4:], b"\0" * 1198)):
        packets.insert(20 + i, Datagram(0, 2368, payload))  # short, of seven blocks, of nothing
    turn = next(hesai.turns(packets, *how))
    for name, column in true.items():
        np.testing.assert_array_equal(turn[name], column)
    bad = [p.payload[:5] + b"\0" + p.payload[6:] for p in spun("Pandar64", 0, 320)]
    path = as_capture(tmp_path / "c.pcap", bad)
    (tmp_path / "c.csv").write_text(angles_csv(PANDAR64.elevations, OFFSETS))
    with pytest.raises(FileError, match=r"c.pcap: expected a Pandar64's distances .* found steps of 0 mm"):
        next(capture_turns(path))
    flagless = bytearray(spun("Pandar40P", 0, 1)[0].payload)
    flagless[124:126] = b"\0\0"
    assert len(hesai.decode(layout("Pandar40P"), angles(40), bytes(flagless))["x"]) == 9 * 40
    with pytest.raises(FileError, match="expected a packet of a Pandar40P, found 12 bytes"):
        hesai.decode(layout("Pandar40P"), angles(40), b"\0" * 12)


def test_turns_go_to_other_processes_in_their_packets(tmp_path: Path):
    path = street_capture(tmp_path)
    _, item = inputs_of([path]).stream()
    data = pickle.dumps(item)
    assert len(data) < 320 * 1300
    _, turn = capture_turns(path)
    np.testing.assert_array_equal(pickle.loads(data).read().scan.xyz, np.stack([turn[a] for a in "xyz"], axis=1))


def test_the_points_of_a_real_pandar64_lie_as_its_packets_say(shared: Path, tmp_path: Path):
    """What the maker's driver wrote of a turn: azimuth 0 along its y axis, clockwise, times by packet: of 6 firings, of
    which every laser looks as far beside as its offset says. Put into packets again they come out as they are."""
    scan = read(shared / "scans" / "other" / "sensorscalibration_top.pcd")
    assert scan.ring is not None and scan.time is not None
    x, y, _ = scan.xyz.astype(float).T
    distance, azimuth = np.linalg.norm(scan.xyz.astype(float), axis=1) / STEP, np.degrees(np.arctan2(x, y)) % 360
    assert np.abs(distance - np.round(distance)).max() < 0.05, "steps of 4 mm"
    _, sent = np.unique(np.round(scan.time, 5), return_inverse=True)
    assert sent.max() == 300, "6 firings of 0.2 degrees a packet, 1,800 a turn"
    first = np.array([azimuth[(sent == i) & (scan.ring == 63)].min() for i in range(301)])
    beside = (azimuth - first[sent] + 180) % 360 - 180
    offsets = np.array([beside[scan.ring == r].min() if (scan.ring == r).any() else 0 for r in range(64)])
    block = (beside - offsets[scan.ring]) / 0.2
    assert np.abs(block - np.round(block)).max() < 0.02 and block.max() < 5.1, "no angle turns on amid a firing"
    blocks = np.zeros((301 * 6, 64), int)
    blocks[sent * 6 + np.round(block).astype(int), scan.ring] = np.round(distance)
    angle = (np.round(first * 100).astype(int)[:, None] + 20 * np.arange(6)).ravel() % 36000
    (tmp_path / "c.csv").write_text(angles_csv(PANDAR64.elevations, offsets))
    path = as_capture(tmp_path / "c.pcap", stream("Pandar64", np.tile(angle, 2), np.tile(blocks, (2, 1))))
    turn = max(capture_turns(path), key=lambda turn: len(turn["x"]))
    found = np.stack([-turn["y"], turn["x"], turn["z"]], axis=1)  # as the driver has them
    sides = []
    for xyz, ring in ((found, turn["ring"]), (scan.xyz, scan.ring)):
        fired = (np.degrees(np.arctan2(xyz[:, 0], xyz[:, 1])) - offsets[ring] - first[0] + 0.1) % 360 // 0.2
        sides.append(xyz[np.lexsort((np.linalg.norm(xyz, axis=1), fired, ring))])
    assert len(sides[0]) == len(sides[1]) == 80748
    assert np.linalg.norm(sides[0] - sides[1], axis=1).max() < 0.005, (
        "millimetres, as angles are hundredths of a degree"
    )


def test_another_model_of_hesais_is_told_by_its_packets_size(tmp_path: Path):
    other = b"\xee\xff\x01\x04" + bytes(1450)
    path = as_capture(tmp_path / "at128.pcap", [other] * 20)
    with pytest.raises(FileError, match=r"expected a Hesai's packets of Pandar40P, .* found those of another model, "
                                        r"of 1454 bytes"):  # fmt: skip
        next(capture_turns(path))
