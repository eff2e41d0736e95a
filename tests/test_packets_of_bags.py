"""Packets of a Velodyne's driver in bags (velodyne_msgs/VelodyneScan) are scans, as point clouds are, and those of an
Ouster's (ouster_ros/PacketMsg, ouster_sensor_msgs/PacketMsg) make turns with the metadata beside them."""

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_captures import spun

from lidarsynth.cli.main import main
from lidarsynth.data import ouster, velodyne
from lidarsynth.data.bag_records import OUSTER, PACKET, PACKETS, Cloud, Message, Topic, typestore
from lidarsynth.data.bag_writer import FORMATS, MSG_CDR, MSG_ROS1, write_bag
from lidarsynth.data.bags import open_bag
from lidarsynth.data.capture import Datagram, datagrams
from lidarsynth.files.fields import FileError
from lidarsynth.verbs.description import describe
from lidarsynth.verbs.file_kinds import file_lines
from lidarsynth.verbs.inputs import Reading, inputs_of
from lidarsynth.viewer.series import series_of

pytest.importorskip("rosbags", reason="rosbags comes with the extra `ros`")
pytest.importorskip("mcap", reason="mcap comes with the extra `ros`")
TURN = 75  # packets of 12 blocks of 0.4 degrees


def drive(path: Path, parts: list[list[Datagram]], points: bool = False) -> Path:
    """A bag of these packets, message by message, a tenth of a second each, and of points beside them."""
    encoding = FORMATS[path.suffix]
    first, store = encoding == "ros1", typestore(encoding)
    types = store.types
    text, digest = store.generate_msgdef(PACKETS, ros_version=1 if first else 2)
    digest = digest if first else store.hash_rihs01(PACKETS)
    topic = Topic("/packets", PACKETS, encoding, (MSG_ROS1 if first else MSG_CDR, text.encode()), 0, digest)
    with write_bag(path) as writer:
        for i, packets in enumerate(parts):
            stamp = types["builtin_interfaces/msg/Time"](100, i * 10**8)
            header = types["std_msgs/msg/Header"](*([i] if first else []), stamp, "velodyne")
            held = [types[PACKET](stamp, np.frombuffer(packet.payload, np.uint8)) for packet in packets]
            data = (store.serialize_ros1 if first else store.serialize_cdr)(types[PACKETS](header, held), PACKETS)
            writer.put(Message(topic, 100 * 10**9 + i * 10**8, bytes(data)))
            if points:
                fields = velodyne.returns(packets[:30])
                writer.write_cloud("/points", Cloud(100 * 10**9 + i, "lidar", 100 * 10**9 + i * 10**8, fields))
    return path


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_packets_are_scans(suffix: str, tmp_path: Path):
    packets = spun(0, 2 * TURN)
    path = drive(tmp_path / f"in{suffix}", [packets[:TURN], packets[TURN:]])
    inputs = inputs_of([path])
    assert inputs.count == 2
    for i, item in enumerate(inputs.stream()):
        loaded = item.read()
        stamped = [packet._replace(time=100 * 10**9 + i * 10**8) for packet in packets[i * TURN :][:TURN]]
        true = velodyne.returns(stamped)
        np.testing.assert_array_equal(loaded.scan.xyz, np.stack([true[axis] for axis in "xyz"], axis=1))
        for mine, theirs in ((loaded.scan.ring, "ring"), (loaded.scan.time, "time")):
            np.testing.assert_array_equal(mine, true[theirs])
        assert (loaded.stamp, loaded.frame_id) == (100 * 10**9 + i * 10**8, "velodyne")
    lines = file_lines(path, Reading())
    assert lines is not None and lines["/packets: points"] == str(TURN * 12 * 32)


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_points_of_packets_get_a_topic_beside_them(suffix: str, tmp_path: Path):
    path, out = drive(tmp_path / f"in{suffix}", [spun(0, TURN)]), tmp_path / f"out{suffix}"
    how = ["complete", str(path), "--model", "nearest", "--sensor", "vlp-16", "--out", str(out)]
    for more, topics in (([], {"/packets/points"}), (["--keep-topics"], {"/packets/points", "/packets"})):
        main([*how, *more])
        with open_bag(out) as bag:
            assert {topic.name for topic in bag.topics} == topics and bag.point_topic() == "/packets/points"
            (cloud,) = bag.clouds("/packets/points")
        assert isinstance(cloud, Cloud) and np.count_nonzero(cloud.fields["new"] == 0) == TURN * 12 * 32


def test_a_topic_of_points_comes_before_its_packets(tmp_path: Path):
    with open_bag(drive(tmp_path / "in.bag", [spun(0, TURN)], points=True)) as bag:
        assert (bag.point_topic(), bag.point_topic("/packets")) == ("/points", "/packets")
        with pytest.raises(ValueError, match="named /other, found /points"):
            bag.point_topic("/other")


@pytest.mark.parametrize(("payload", "found"), [(None, "Velodyne packets, found none"), (b"\xa1", "product byte 0xa1")])
def test_packets_of_another_sensor_are_refused(payload: bytes | None, found: str, tmp_path: Path):
    packets = [] if payload is None else [p._replace(payload=p.payload[:-1] + payload) for p in spun(0, TURN)]
    (item,) = inputs_of([drive(tmp_path / "in.bag", [packets])]).stream()
    with pytest.raises(FileError, match=f"in.bag: in/000000: expected .*{found}"):
        item.read()


BEAMS, COLUMNS, PER_TURN = 16, 64, 4  # packets of 16 columns
DESCRIBED = json.dumps({  # in groups, as firmware 3 has them
    "beam_intrinsics": {"beam_altitude_angles": list(range(15, -16, -2)), "beam_azimuth_angles": [0] * BEAMS},
    "lidar_data_format": {"columns_per_frame": COLUMNS, "columns_per_packet": 16, "udp_profile_lidar": "LEGACY"},
})  # fmt: skip
STRING = "std_msgs/msg/String"
OF_ROS = {".bag": "ouster_ros/msg/PacketMsg", ".db3": "ouster_sensor_msgs/msg/PacketMsg"}


def ouster_packets(turns: int, metres: float = 10) -> list[bytes]:
    """Whole turns, each a metre farther than the one before."""
    return [
        b"".join(
            struct.pack("<QHHI", 10**6 * (COLUMNS * turn + column), column, turn, 0)
            + struct.pack("<III", int(1000 * (metres + turn)), 7, 9) * BEAMS + b"\xff" * 4
            for column in range(first, first + 16)
        )
        for turn in range(turns) for first in range(0, COLUMNS, 16)
    ]  # fmt: skip


def ouster_drive(
    path: Path, sensors: Mapping[str, Sequence[bytes]], described: str | None = DESCRIBED, kind: str | None = None
) -> Path:
    """A bag as the driver has it recorded, written by the library's own writer: ROS 1, or a folder of ROS 2. The
    metadata first, as latched messages come; then a packet of each sensor by namespace a hundredth of a second."""
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    first, kind = path.suffix == ".bag", kind or OF_ROS.get(path.suffix, OF_ROS[".db3"])
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("uint8[] buf", kind))
    serialize = store.serialize_ros1 if first else store.serialize_cdr
    plugin = rosbag2.StoragePlugin.SQLITE3 if path.suffix == ".db3" else rosbag2.StoragePlugin.MCAP
    folder = path if first else path.with_suffix("")
    writer: Any = rosbag1.Writer(path) if first else rosbag2.Writer(folder, version=9, storage_plugin=plugin)
    with writer:
        for space, packets in sensors.items():
            large, small = (writer.add_connection(f"{space}/{word}_packets", kind, typestore=store)
                            for word in ("lidar", "imu"))  # fmt: skip
            if described is not None:
                told = writer.add_connection(f"{space}/metadata", STRING, typestore=store)
                writer.write(told, 10**9, serialize(store.types[STRING](described), STRING))
            for i, packet in enumerate(packets):
                for connection, buf in ((large, packet), (small, bytes(48))):
                    data = serialize(store.types[kind](np.frombuffer(buf, np.uint8)), kind)
                    writer.write(connection, 10**9 + i * 10**7, data)
    return folder


def true_turns(packets: Sequence[bytes]) -> list[Any]:
    metadata = ouster.parse_metadata(DESCRIBED, "here", "o")
    return list(ouster.turns([Datagram(0, 0, packet) for packet in packets], metadata))


@pytest.mark.parametrize("more", [b"", b"\0"], ids=["as sent", "a byte more, as by older drivers"])
@pytest.mark.parametrize("suffix", [".bag", ".db3", ".mcap"])
def test_packets_of_an_ouster_make_turns_with_the_metadata_of_the_bag(suffix: str, more: bytes, tmp_path: Path):
    packets = ouster_packets(3)
    path = ouster_drive(tmp_path / f"in{suffix}", {"/ouster": [packet + more for packet in packets]})
    inputs = inputs_of([path])
    assert inputs.count is None, "only reading tells"
    read, true = [item.read() for item in inputs.stream()], true_turns(packets)
    assert len(read) == len(true) == 3
    for i, (loaded, turn) in enumerate(zip(read, true, strict=True)):
        np.testing.assert_array_equal(loaded.scan.xyz, np.stack([turn[axis] for axis in "xyz"], axis=1))
        np.testing.assert_array_equal(loaded.scan.ring, turn["ring"])
        begun = 10**9 + PER_TURN * i * 10**7
        assert (loaded.stamp, loaded.time, loaded.frame_id) == (begun, begun + 3 * 10**7, "os_sensor")
    lines = file_lines(path, Reading())
    assert lines is not None and lines["/ouster/lidar_packets: points"] == str(BEAMS * COLUMNS)
    series = series_of([path], Reading())
    shown = {number: np.linalg.norm(series[number].scan.xyz, axis=1).max() for number in (2, 0, 1)}
    assert shown == {i: pytest.approx(np.linalg.norm(read[i].scan.xyz, axis=1).max()) for i in range(3)}


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_turns_of_an_ouster_go_into_a_bag(suffix: str, tmp_path: Path):
    path, out = ouster_drive(tmp_path / f"in{suffix}", {"/ouster": ouster_packets(2)}), tmp_path / f"out{suffix}"
    how = ["complete", str(path), "--model", "nearest", "--sensor", "vlp-16", "--out", str(out)]
    packets = {f"/ouster/{word}" for word in ("lidar_packets", "imu_packets", "metadata")}
    for more, topics in (([], set()), (["--keep-topics"], packets)):
        main([*how, *more])
        with open_bag(out) as bag:
            assert {topic.name for topic in bag.topics} == topics | {"/ouster/lidar_packets/points"}
            clouds = list(bag.clouds(bag.point_topic()))
        for cloud, turn in zip(clouds, true_turns(ouster_packets(2)), strict=True):
            assert isinstance(cloud, Cloud)
            for name, column in turn.items():
                np.testing.assert_array_equal(np.sort(cloud.fields[name][cloud.fields["new"] == 0]), np.sort(column))


def test_packets_of_an_ouster_without_metadata_ask_for_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = ouster_drive(tmp_path / "in.bag", {"/os1_node": ouster_packets(2)}, described=None)
    asks = "in.bag: expected --metadata FILE.json of the Ouster, or one in or beside the bag, or a bag"
    for words in (["complete", str(path), "--out", str(tmp_path / "o")], ["info", str(path)]):
        with pytest.raises(SystemExit, match="2"):
            main(words)
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and asks.split(": ")[1] in said
    (tmp_path / "of").mkdir()
    told = tmp_path / "of" / "os.json"
    told.write_text(DESCRIBED)
    assert len(list(inputs_of([path], Reading(metadata=told)).stream())) == 2
    main(["info", str(path), "--metadata", str(told)])
    (points,) = (line for line in capsys.readouterr().out.splitlines() if "/os1_node/lidar_packets: points" in line)
    assert points.split()[-1] == str(BEAMS * COLUMNS)
    told.rename(tmp_path / "os.json")
    assert len(list(inputs_of([path]).stream())) == 2, "that beside it"


def test_a_run_does_not_go_on_with_scans_of_other_metadata(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    ouster_drive(tmp_path / "in.bag", {"/os1_node": ouster_packets(2)}, described=None)
    told, moved = tmp_path / "of" / "os.json", tmp_path / "moved.json"
    told.parent.mkdir()
    told.write_text(DESCRIBED)
    words = ["project", str(tmp_path / "in.bag"), "--out", str(tmp_path / "o"), "--sensor", "vlp-16", "--no-picture"]
    main([*words, "--metadata", str(told)])
    told.rename(moved)
    main([*words, "--metadata", str(moved), "--skip-existing"])
    assert "2 were there already" in capsys.readouterr().out
    other = json.loads(DESCRIBED)
    other["beam_intrinsics"]["beam_altitude_angles"][0] += 1
    moved.write_text(json.dumps(other))
    with pytest.raises(SystemExit, match="2"):
        main([*words, "--metadata", str(moved), "--skip-existing"])
    assert "found other settings: metadata " in capsys.readouterr().err


def test_the_parts_of_a_split_recording_take_the_metadata_of_the_first(tmp_path: Path):
    """ROS 1 repeats no latched message in the parts."""
    first = ouster_drive(tmp_path / "run_0.bag", {"/ouster": ouster_packets(2)})
    other = ouster_drive(tmp_path / "run_1.bag", {"/ouster": ouster_packets(3)}, described=None)
    with pytest.raises(FileError, match="a bag as --metadata that holds it"):
        list(inputs_of([other]).stream())
    items = list(inputs_of([tmp_path], Reading(metadata=first)).stream())
    assert [item.name for item in items] == [f"run_0/{n:06d}" for n in (0, 1)] + [f"run_1/{n:06d}" for n in range(3)]
    assert len(items[4].read().scan) == BEAMS * COLUMNS
    assert len(series_of([other], Reading(metadata=first))[2].scan) == BEAMS * COLUMNS
    with pytest.raises(FileError, match=r"run_1.bag: expected --metadata FILE.json"):
        list(inputs_of([other], Reading(metadata=other)).stream())


def test_metadata_is_of_packets_and_not_of_points(tmp_path: Path):
    points = drive(tmp_path / "points.mcap", [spun(0, TURN)])
    with pytest.raises(ValueError, match=r"a bag of an Ouster's packets, for --metadata o.json, found none"):
        inputs_of([points], Reading(metadata=Path("o.json")))
    for what, found in ((str(points), "none"), ("vlp-16", "another kind of file or word")):
        with pytest.raises(ValueError, match=f"{what}: expected a capture, .* for --metadata o.json, found {found}"):
            describe(what, Reading(metadata=Path("o.json")))


@pytest.mark.parametrize("kind", OUSTER)
def test_two_ousters_of_a_bag_are_told_apart(kind: str, tmp_path: Path):
    sensors = {"/left": ouster_packets(2), "/right": ouster_packets(2, 20)}
    path = ouster_drive(tmp_path / "in.mcap", sensors, kind=kind)
    with pytest.raises(ValueError, match="or --topic, found /left/lidar_packets, /right/lidar_packets"):
        inputs_of([path])
    for topic, metres in (("/left/lidar_packets", 10), ("/right/lidar_packets", 20)):
        item = next(iter(inputs_of([path], Reading(topic=topic)).stream()))
        assert np.linalg.norm(item.read().scan.xyz, axis=1).max() == pytest.approx(metres, abs=0.1)


def test_metadata_of_another_ouster_is_refused(tmp_path: Path):
    other = DESCRIBED.replace("LEGACY", "RNG15_RFL8_NIR8")
    path = ouster_drive(tmp_path / "in.bag", {"/ouster": ouster_packets(2)}, other)
    with pytest.raises(FileError, match=r"in.bag: expected packets of 1280 bytes .* found one of 3392"):
        list(inputs_of([path]).stream())
    path = ouster_drive(tmp_path / "new.bag", {"/ouster": ouster_packets(2)}, DESCRIBED.replace("LEGACY", "FUSA"))
    with pytest.raises(FileError, match=r"new.bag: expected packets of LEGACY, .*, found FUSA"):
        list(inputs_of([path]).stream())
    path = ouster_drive(tmp_path / "cut.bag", {"/ouster": ouster_packets(2)}, DESCRIBED[:-9])
    with pytest.raises(FileError, match=r"cut.bag: /ouster/metadata: expected JSON"):
        list(inputs_of([path]).stream())


def test_turns_before_a_broken_packet_come_and_it_is_told(tmp_path: Path):
    with open_bag(ouster_drive(tmp_path / "in.mcap", {"/ouster": ouster_packets(3)})) as bag:
        messages, large = list(bag.messages()), 0
        with write_bag(tmp_path / "broken.mcap") as writer:
            for message in messages:
                large += message.topic.name == "/ouster/lidar_packets"
                writer.put(
                    message._replace(data=message.data[:2000]) if large == 10 and len(message.data) > 1000 else message
                )
    stream = iter(inputs_of([tmp_path / "broken.mcap"]).stream())
    assert [len(next(stream).read().scan) for _ in range(2)] == [BEAMS * COLUMNS] * 2
    with pytest.raises(FileError, match=r"broken.mcap: /ouster/lidar_packets: expected a packet, found 2000 broken"):
        next(stream)


def test_a_real_ouster_in_a_bag_is_as_in_its_capture(shared: Path, tmp_path: Path):
    path = shared / "scans" / "other" / "OS-1-64_1024x10_fw20.pcap"
    described = path.with_name("OS-1-64_sensor_config_reduced.json").read_text()
    packets = [packet.payload for packet in datagrams(path) if len(packet.payload) > 1000]
    (item,) = inputs_of([ouster_drive(tmp_path / "in.db3", {"/ouster": packets}, described)]).stream()
    (true,) = inputs_of([path]).stream()
    mine, theirs = item.read().scan, true.read().scan
    np.testing.assert_array_equal(mine.xyz, theirs.xyz)
    np.testing.assert_array_equal(mine.reflectance, theirs.reflectance)
