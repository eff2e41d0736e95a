"""Packets of a Velodyne driver in bags (velodyne_msgs/VelodyneScan) are scans, as point clouds are."""

from pathlib import Path

import numpy as np
import pytest
from test_captures import spun

from lidarsynth.cli.main import main
from lidarsynth.data import velodyne
from lidarsynth.data.bag_records import PACKET, PACKETS, Cloud, Message, Topic, typestore
from lidarsynth.data.bag_writer import FORMATS, MSG_CDR, MSG_ROS1, write_bag
from lidarsynth.data.bags import open_bag
from lidarsynth.data.capture import Datagram
from lidarsynth.files.fields import FileError
from lidarsynth.verbs.file_kinds import file_lines
from lidarsynth.verbs.inputs import Reading, inputs_of

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
