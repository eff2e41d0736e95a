"""Packets of Hesai's drivers in bags are scans, message by message, as the bag itself defines these messages."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hesai_packets import angles_csv, asked_for_angles
from test_hesai import OFFSETS, PANDAR64, spun

from lidarsynth.cli.main import main
from lidarsynth.data import hesai
from lidarsynth.data.angle_files import Angles
from lidarsynth.data.bag_records import Cloud
from lidarsynth.data.bags import open_bag
from lidarsynth.data.capture import Datagram
from lidarsynth.files.fields import FileError
from lidarsynth.verbs.file_kinds import file_lines
from lidarsynth.verbs.inputs import Reading, inputs_of
from lidarsynth.viewer.series import series_of

pytest.importorskip("rosbags", reason="rosbags comes with the extra `ros`")
pytest.importorskip("mcap", reason="mcap comes with the extra `ros`")
TURN = 150  # packets of 6 blocks of 0.4 degrees
KINDS = {  # packets of as many bytes as they have, or in a place for the longest
    "hesai_lidar/msg/PandarScan": ("PandarPacket", "time stamp\nuint8[1500] data\nuint32 size\n"),
    "hesai_ros_driver/msg/UdpFrame": ("UdpPacket", "uint8[] data\nuint32 size\n"),
}


def recorded(path: Path, kind: str, messages: list[list[Datagram]], fields: str | None = None) -> Path:
    """A bag of such messages, a tenth of a second each, written by the library's own writer."""
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    first = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    word, told = KINDS[kind]
    told, package = (fields or told).replace("time ", "builtin_interfaces/Time "), kind.split("/")[0]
    store.register(get_types_from_msg(told, f"{package}/msg/{word}"))
    store.register(get_types_from_msg(f"std_msgs/Header header\n{package}/{word}[] packets\n", kind))
    plugin = rosbag2.StoragePlugin.SQLITE3 if path.suffix == ".db3" else rosbag2.StoragePlugin.MCAP
    folder = path if first else path.with_suffix("")
    writer: Any = rosbag1.Writer(path) if first else rosbag2.Writer(folder, version=9, storage_plugin=plugin)
    types = store.types
    with writer:
        topic = writer.add_connection("/packets", kind, typestore=store)
        for i, packets in enumerate(messages):
            stamp = types["builtin_interfaces/msg/Time"](100, i * 10**8)
            held = []
            for packet in packets:
                payload = packet.payload if "[]" in told else packet.payload.ljust(1500, b"\xee")
                values = {"data": np.frombuffer(payload, np.uint8), "size": len(packet.payload), "stamp": stamp}
                names = [line.split()[1] for line in told.splitlines()]
                held.append(types[f"{package}/msg/{word}"](*(values.get(name, 0) for name in names)))
            header = types["std_msgs/msg/Header"](*([i] if first else []), stamp, "Pandar64")
            data = (store.serialize_ros1 if first else store.serialize_cdr)(types[kind](header, held), kind)
            writer.write(topic, 100 * 10**9 + i * 10**8, data)
    return folder


def with_angles(folder: Path) -> Path:
    (folder / "angles.csv").write_text(angles_csv(PANDAR64.elevations, OFFSETS))
    return folder / "angles.csv"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("suffix", [".bag", ".db3", ".mcap"])
def test_messages_of_packets_are_scans(suffix: str, kind: str, tmp_path: Path):
    packets = spun("Pandar64", 0, 2 * TURN)
    path = recorded(tmp_path / f"in{suffix}", kind, [packets[:TURN], packets[TURN:]])
    told = with_angles(tmp_path)
    inputs = inputs_of([path])
    assert inputs.count == 2
    for i, item in enumerate(inputs.stream()):
        loaded = item.read()
        stamped = [packet._replace(time=100 * 10**9 + i * 10**8) for packet in packets[i * TURN :][:TURN]]
        true = hesai.returns(stamped, Angles(PANDAR64.elevations, OFFSETS))
        np.testing.assert_array_equal(loaded.scan.xyz, np.stack([true[axis] for axis in "xyz"], axis=1))
        for mine, theirs in ((loaded.scan.ring, "ring"), (loaded.scan.time, "time")):
            np.testing.assert_array_equal(mine, true[theirs])
        assert (loaded.stamp, loaded.frame_id) == (100 * 10**9 + i * 10**8, "Pandar64")
    lines = file_lines(path, Reading())
    assert lines is not None and lines["/packets: points"] == str(TURN * 6 * 64)
    told.rename(moved := tmp_path / "angles.txt")
    assert np.array_equal(series_of([path], Reading(metadata=moved))[1].scan.xyz, loaded.scan.xyz)


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_their_points_get_a_topic_beside_them(suffix: str, tmp_path: Path):
    path = recorded(tmp_path / f"in{suffix}", "hesai_lidar/msg/PandarScan", [spun("Pandar64", 0, TURN)])
    out, told = tmp_path / f"out{suffix}", with_angles(tmp_path)
    how = ["complete", str(path), "--model", "nearest", "--out", str(out), "--metadata", str(told)]
    for more, topics in (([], {"/packets/points"}), (["--keep-topics"], {"/packets/points", "/packets"})):
        main([*how, "--sensor", "pandar64", *more])
        with open_bag(out) as bag:
            assert {topic.name for topic in bag.topics} == topics and bag.point_topic() == "/packets/points"
            (cloud,) = bag.clouds("/packets/points")
        assert isinstance(cloud, Cloud) and np.count_nonzero(cloud.fields["new"] == 0) == TURN * 6 * 64


def test_what_lacks_is_asked_for_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = recorded(tmp_path / "in.bag", "hesai_lidar/msg/PandarScan", [spun("Pandar64", 0, TURN)])
    for words in (["complete", str(path), "--out", str(tmp_path / "o")], ["info", str(path)]):
        asked_for_angles(words, capsys)
    (tmp_path / "xt.csv").write_text(angles_csv(range(16), [0] * 16))
    (item,) = inputs_of([path], Reading(metadata=tmp_path / "xt.csv")).stream()
    with pytest.raises(FileError, match=r"in.bag: in/000000: expected packets of 16 channels, .* of a Pandar64"):
        item.read()
    with pytest.raises(FileError, match=r"in.bag: expected an angle correction|in.bag.* UTF-8"):
        list(inputs_of([path], Reading(metadata=path)).stream())


def test_nominal_angles_of_packets_in_a_bag_are_told_of(tmp_path: Path):
    path = recorded(tmp_path / "in.mcap", "hesai_ros_driver/msg/UdpFrame", [spun("PandarXT-16", 0, TURN)])
    with pytest.warns(UserWarning, match="PandarXT-16, .*: its nominal angles are taken"):
        (item,) = inputs_of([path]).stream()
    assert np.unique(item.read().scan.ring).tolist() == list(range(16))


@pytest.mark.parametrize(
    ("packets", "found"),
    [([], "found none"), ([Datagram(0, 0, b"\xee\xff" * 400)], "found others, of 800 bytes")],
)
def test_packets_of_other_sensors_are_refused(packets: list[Datagram], found: str, tmp_path: Path):
    path = recorded(tmp_path / "in.bag", "hesai_lidar/msg/PandarScan", [packets, spun("Pandar64", 0, TURN)])
    with_angles(tmp_path)
    bad, good = inputs_of([path]).stream()
    with pytest.raises(FileError, match=f"in.bag: in/000000: expected packets of Pandar40P, .*{found}"):
        bad.read()
    assert len(good.read().scan) == TURN * 6 * 64


def test_messages_of_other_fields_are_refused(tmp_path: Path):
    path = recorded(tmp_path / "in.bag", "hesai_lidar/msg/PandarScan", [spun("Pandar64", 0, 3)], "uint32 length\n")
    (item,) = inputs_of([path]).stream()
    with pytest.raises(FileError, match="expected packets with data in a hesai_lidar/msg/PandarScan, found length"):
        item.read()
