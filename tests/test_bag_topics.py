"""What a bag says of its topics is kept where they are copied: who published them, and how they are played back."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarsynth.cli.main import main
from lidarsynth.data.bag_records import POINTS, Cloud, Message, Topic, typestore
from lidarsynth.data.bag_writer import message_of, points_topic, write_bag
from lidarsynth.data.bags import open_bag
from lidarsynth.files.fields import FileError
from lidarsynth.verbs.file_kinds import file_lines
from lidarsynth.verbs.inputs import Reading

pytest.importorskip("rosbags", reason="rosbags comes with the extra `ros`")
pytest.importorskip("mcap", reason="mcap comes with the extra `ros`")
STRING = "std_msgs/msg/String"
SUM = "992ce8a1687cec8c8bd883ec73ca41d1"  # of std_msgs/String, as `rosmsg md5` prints it
QUALITY = "- history: 3\n  durability: 1"  # transient local: what /tf_static offers
CLOUD = Cloud(0, "lidar", 0, {axis: np.ones(3, np.float32) for axis in "xyz"})
NOTE = b"\2\0\0\0hi"


def restarted(path: Path) -> Path:
    """A ROS 1 bag in which two nodes published the points, one after the other, and two latched a note."""
    from rosbags.rosbag1 import Writer

    store = typestore("ros1")
    with Writer(path) as writer:
        for number, node in enumerate(("/first", "/second")):
            points = writer.add_connection("/points", POINTS, typestore=store, callerid=node, latching=0)
            note = writer.add_connection("/note", STRING, typestore=store, callerid=node, latching=1)
            writer.write(note, number, NOTE)
            for time in range(2):
                writer.write(points, 10 * number + time, message_of(CLOUD, "ros1"))
    return path


def notes(path: Path) -> list[tuple[str | None, int | None, str, int]]:
    from rosbags.rosbag1 import Reader

    with Reader(path) as reader:
        found: list[Any] = [c for c in reader.connections if c.topic == "/note"]
        return [(c.ext.callerid, c.ext.latching, c.digest, c.msgcount) for c in found]


def test_a_driver_that_was_started_anew_is_one_topic(tmp_path: Path):
    with open_bag(restarted(tmp_path / "drive.bag")) as bag:
        assert {t.name: t.count for t in bag.topics} == {"/points": 4, "/note": 2} and len(bag.topics) == 2
        assert bag.point_topic() == "/points"
        assert [m.time for m in bag.messages(frozenset(["/points"]))] == [0, 1, 10, 11]


@pytest.mark.parametrize("by_way_of", [".bag", ".mcap"])
def test_latched_messages_of_every_node_stay_latched(by_way_of: str, tmp_path: Path):
    paths = [restarted(tmp_path / "drive.bag"), tmp_path / f"one{by_way_of}", tmp_path / "two.bag"]
    for source, copied in pairwise(paths):
        with open_bag(source) as bag, write_bag(copied, bag.topics) as writer:
            for message in bag.messages(frozenset(["/note"])):
                writer.copy(message)
        with open_bag(copied) as bag:
            assert [m.data for m in bag.messages()] == [NOTE, NOTE]
    if by_way_of == ".bag":  # a topic of MCAP has one publisher
        assert notes(paths[-1]) == notes(paths[0]) == [("/first", 1, SUM, 1), ("/second", 1, SUM, 1)]
    assert {(latching, digest) for _, latching, digest, _ in notes(paths[-1])} == {(1, SUM)}


def database(folder: Path) -> Path:
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
    from rosbags.rosbag2 import StoragePlugin, Writer

    store, never = typestore("cdr"), QosTime(0, 0)
    quality = Qos(QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, never, never,
                  QosLiveliness.AUTOMATIC, never, False)  # fmt: skip
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        note = writer.add_connection("/note", STRING, typestore=store, offered_qos_profiles=[quality])
        writer.write(note, 7, store.serialize_cdr(store.types[STRING]("hi"), STRING))
    return folder


@pytest.mark.parametrize("alone", [True, False])
def test_the_quality_of_service_of_a_database_is_kept(alone: bool, tmp_path: Path):
    folder = database(tmp_path / "drive")
    with open_bag(next(folder.glob("*.db3")) if alone else folder) as bag, write_bag(tmp_path / "new.mcap") as writer:
        for message in bag.messages():
            writer.copy(message)
    with open_bag(tmp_path / "new.mcap") as bag:
        ((key, words),) = bag.topics[0].offered
    assert key == "offered_qos_profiles" and "durability: transient_local" in words


def test_the_quality_of_service_of_mcap_is_kept(tmp_path: Path):
    schema = ("ros2msg", b"string data\n")
    topic = Topic("/tf_static", STRING, "cdr", schema, 0, offered=(("offered_qos_profiles", QUALITY),))
    for path, source in ((tmp_path / "a.mcap", None), (tmp_path / "b.mcap", tmp_path / "a.mcap")):
        with write_bag(path) as writer:
            if source is None:
                writer.copy(Message(topic, 5, b"\0\1\0\0\3\0\0\0hi\0"))
            else:
                with open_bag(source) as bag:
                    for message in bag.messages():
                        writer.copy(message)
    with open_bag(tmp_path / "b.mcap") as bag:
        assert bag.topics[0].offered == topic.offered


def test_a_definition_that_lacks_a_part_is_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Of ROS 1 in MCAP, whose checksum a `.bag` needs."""
    odd = Topic("/odd", "my_msgs/msg/Odd", "ros1", ("ros1msg", b"other_msgs/Thing thing\n"), 0)
    with write_bag(tmp_path / "in.mcap") as writer:
        writer.put(Message(odd, 5, b""))
        writer.put(Message(points_topic("/points", "ros1"), 6, message_of(CLOUD, "ros1")))
    words = ["--keep-topics", "--model", "bilinear", "--sensor", "vlp-16"]
    with pytest.raises(SystemExit, match="2"):
        main(["complete", str(tmp_path / "in.mcap"), "--out", str(tmp_path / "new.bag"), *words])
    assert "Thing' is unknown" in capsys.readouterr().err and not (tmp_path / "new.bag").exists()


def two_topics(path: Path) -> Path:
    """Points, and a map of the same type whose coordinates are no metres from a sensor."""
    around = np.radians(np.arange(0, 360, 0.5, dtype=np.float32))
    scan = {"x": 9 * np.cos(around), "y": 9 * np.sin(around), "z": 0 * around, "intensity": 0 * around}
    with write_bag(path) as writer:
        for time in range(3):
            writer.write_cloud("/map", Cloud(0, "map", time, scan | {"x": scan["x"] + 450_000}))
            writer.write_cloud("/points", Cloud(0, "lidar", time, scan))
    return path


def test_a_topic_that_is_no_scan_is_told_beside_the_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    main(["info", str(two_topics(tmp_path / "in.mcap"))])
    told = capsys.readouterr().out
    assert "/map: fault" in told and "coordinate of 4.5e+05" in told and "/points: range" in told
    with write_bag(tmp_path / "map.mcap") as writer, open_bag(tmp_path / "in.mcap") as bag:
        for message in bag.messages(frozenset(["/map"])):
            writer.copy(message)
    with pytest.raises(SystemExit, match="2"):
        main(["info", str(tmp_path / "map.mcap")])
    assert "map.mcap: /map: expected metres from the sensor" in capsys.readouterr().err


def test_a_bit_that_a_disk_lost_is_no_point(tmp_path: Path):
    """An uncompressed chunk, in which every other bit is a coordinate; its checksum tells."""
    from mcap.writer import CompressionType, Writer

    with open_bag(two_topics(tmp_path / "in.mcap")) as bag, open(tmp_path / "bad.mcap", "wb") as file:
        messages = list(bag.messages(frozenset(["/points"])))
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        channel = writer.register_channel("/points", "cdr", writer.register_schema(POINTS, *messages[0].topic.schema))
        for message in messages:
            writer.add_message(channel, message.time, message.data, message.time)
        writer.finish()
    bad = bytearray((tmp_path / "bad.mcap").read_bytes())
    bad[bad.index(messages[0].data) + 500] ^= 1
    (tmp_path / "bad.mcap").write_bytes(bad)
    with open_bag(tmp_path / "bad.mcap") as bag, pytest.raises(FileError, match=r"bad.mcap: expected a bag .*crc"):
        list(bag.clouds("/points"))


@pytest.mark.parametrize("notes_first", [True, False])
@pytest.mark.parametrize("by", ["library", ".mcap", ".mcap without its end", ".bag"])
def test_a_topic_of_two_types_is_read_and_copied_by_them(by: str, notes_first: bool, tmp_path: Path):
    """The notes were taken for broken clouds, or the clouds not found, and the types of copies exchanged."""
    from mcap.writer import Writer

    path, out = tmp_path / f"in{by[:5] if by[0] == '.' else '.mcap'}", tmp_path / "out.mcap"
    encoding = "ros1" if by == ".bag" else "cdr"
    digest, kind = (SUM, "ros1msg") if by == ".bag" else ("", "ros2msg")
    note = Topic("/points", STRING, encoding, (kind, b"string data\n"), 0, digest), NOTE[:4] + b"hi"
    around = np.radians(np.arange(0, 360, 0.5, dtype=np.float32))
    scan = {"x": 9 * np.cos(around), "y": 9 * np.sin(around), "z": 0 * around, "intensity": 0 * around}
    cloud = points_topic("/points", encoding), message_of(Cloud(0, "lidar", 0, scan), encoding)
    pairs = [note, cloud] if notes_first else [cloud, note]
    if by == "library":
        with open(path, "wb") as file:
            writer = Writer(file)
            writer.start("ros2")
            channels = [writer.register_channel("/points", "cdr", writer.register_schema(topic.kind, *topic.schema))
                        for topic, _ in pairs]  # fmt: skip
            for number in range(6):
                writer.add_message(channels[number % 2], number + 1, pairs[number % 2][1], number + 1)
            writer.finish()
    else:
        with write_bag(path) as bag:
            for number in range(6):
                bag.put(Message(pairs[number % 2][0], number + 1, pairs[number % 2][1]))
    if by == ".mcap without its end":
        path.write_bytes(path.read_bytes()[:-9])
    words = ["--keep-topics", "--model", "bilinear", "--sensor", "vlp-16"]
    main(["complete", str(path), "--out", str(out), *words])
    for file, types in ((path, {STRING: 3, POINTS: 3}), (out, {STRING: 3, POINTS: 3})):
        with open_bag(file) as found:
            assert {topic.kind: topic.count for topic in found.topics} == types and found.point_topic() == "/points"
            assert all(isinstance(one, Cloud) for one in found.clouds("/points"))
            assert [m.data for m in found.messages() if m.topic.kind == STRING] == [note[1]] * 3
        lines = file_lines(file, Reading())
        assert lines is not None and all(f"{kind}, 3 messages" in lines["/points"] for kind in types)


def numbered(path: Path) -> Path:
    """An MCAP whose messages were sent before they were recorded, and are counted."""
    with write_bag(path) as writer:
        for number in range(1, 4):
            note = Topic("/note", STRING, "cdr", ("ros2msg", b"string data\n"), 0)
            writer.put(Message(note, 10 * number, b"\0\1\0\0\3\0\0\0hi\0", 10 * number - 3, number))
            around = np.radians(np.arange(0, 360, 0.5, dtype=np.float32))
            scan = {"x": 9 * np.cos(around), "y": 9 * np.sin(around), "z": 0 * around, "intensity": 0 * around}
            writer.write_cloud("/points", Cloud(0, "lidar", 10 * number, scan, 10 * number - 4, number + 7))
    return path


def test_when_a_message_was_sent_and_its_number_stay(tmp_path: Path):
    """Read by the library itself."""
    from mcap.reader import make_reader

    words = ["--keep-topics", "--model", "bilinear", "--sensor", "vlp-16"]
    main(["complete", str(numbered(tmp_path / "in.mcap")), "--out", str(tmp_path / "out.mcap"), *words])
    with open(tmp_path / "out.mcap", "rb") as file:
        found = sorted(
            (c.topic, m.log_time, m.publish_time, m.sequence) for _, c, m in make_reader(file).iter_messages()
        )
    notes = [("/note", 10 * n, 10 * n - 3, n) for n in (1, 2, 3)]
    assert found == notes + [("/points", 10 * n, 10 * n - 4, n + 7) for n in (1, 2, 3)]


@pytest.mark.parametrize(("ending", "cut"), [(".mcap", False), (".mcap", True), (".bag", False)])
def test_attachments_and_metadata_are_kept_too(
    ending: str, cut: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """But what ROS 2 tells there of the file itself; of a recording that was cut as well. A .bag holds none, and a line
    says so."""
    from mcap.reader import make_reader
    from mcap.records import Attachment, Metadata

    with write_bag(
        tmp_path / "in.mcap", [Topic("/p", POINTS, "ros1" if ending == ".bag" else "cdr", ("", b""), 0)]
    ) as writer:
        around = np.radians(np.arange(0, 360, 0.5, dtype=np.float32))
        scan = {"x": 9 * np.cos(around), "y": 9 * np.sin(around), "z": 0 * around, "intensity": 0 * around}
        writer.write_cloud("/points", Cloud(0, "lidar", 10, scan))
        writer.attach(Attachment(3, 4, "camera.yaml", "text/yaml", b"a: 1"))
        writer.attach(Metadata("drive", {"driver": "Ada"}))
        writer.attach(Metadata("rosbag2", {"serialized_metadata": "of in.mcap"}))
    source, out = tmp_path / "in.mcap", tmp_path / f"out{ending}"
    if cut:
        source.write_bytes(source.read_bytes()[:-9])
    main(["complete", str(source), "--out", str(out), "--keep-topics", "--model", "bilinear", "--sensor", "vlp-16"])
    said = capsys.readouterr().err
    if ending == ".bag":
        assert "found a .bag, which holds none: camera.yaml, drive left out" in said
        return
    assert "left out" not in said
    with open(out, "rb") as file:
        (attached,) = make_reader(file).iter_attachments()
        file.seek(0)
        (told,) = make_reader(file).iter_metadata()
    assert attached == Attachment(3, 4, "camera.yaml", "text/yaml", b"a: 1")
    assert told == Metadata("drive", {"driver": "Ada"})


def test_a_header_of_ros_1_keeps_its_number(tmp_path: Path):
    with write_bag(tmp_path / "in.bag") as writer:
        writer.write_cloud("/points", Cloud(5, "lidar", 6, CLOUD.fields, sequence=41))
    with open_bag(tmp_path / "in.bag") as bag:
        (cloud,) = bag.clouds("/points")
    assert isinstance(cloud, Cloud) and (cloud.sequence, cloud.stamp, cloud.time) == (41, 5, 6)


def test_topics_of_ros_1_make_an_mcap_of_ros_1(tmp_path: Path):
    """All of it: the profile, the points, the messages that are copied; without them it is one of ROS 2."""
    from mcap.reader import make_reader

    two_topics(tmp_path / "in.bag")
    words = ["--topic", "/points", "--model", "bilinear", "--sensor", "vlp-16"]
    for name, more in (("kept", ["--keep-topics"]), ("alone", [])):
        main(["complete", str(tmp_path / "in.bag"), "--out", str(tmp_path / f"{name}.mcap"), *words, *more])
    told = {}
    for name in ("kept", "alone"):
        with open(tmp_path / f"{name}.mcap", "rb") as file:
            reader = make_reader(file)
            kinds = {(s.encoding, s.name, c.message_encoding) for s, c, _ in reader.iter_messages() if s is not None}
            told[name] = (reader.get_header().profile, kinds)
    assert told["kept"] == ("ros1", {("ros1msg", "sensor_msgs/PointCloud2", "ros1")})
    assert told["alone"] == ("ros2", {("ros2msg", POINTS, "cdr")})
    with open_bag(tmp_path / "in.bag") as old, open_bag(tmp_path / "kept.mcap") as new:
        assert [m.data for m in new.messages(frozenset(["/map"]))] == [
            m.data for m in old.messages(frozenset(["/map"]))
        ]
        assert all(isinstance(cloud, Cloud) and "new" in cloud.fields for cloud in new.clouds("/points"))


def test_points_without_an_intensity_are_told_of_a_bag_as_of_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with write_bag(tmp_path / "in.mcap") as writer:
        writer.write_cloud("/points", Cloud(0, "lidar", 0, {axis: np.ones(3, np.float32) for axis in "xyz"}))
    main(["info", str(tmp_path / "in.mcap")])
    assert "/points: reflectance  none in the file: --intensity none" in capsys.readouterr().out


def test_ros_1_and_ros_2_are_not_put_into_one(tmp_path: Path):
    with open_bag(two_topics(tmp_path / "in.bag")) as bag, write_bag(tmp_path / "out.mcap") as writer:
        message = next(bag.messages())
        with pytest.raises(
            FileError, match="expected messages of ROS 2 to copy beside points of it, found /map of ROS 1"
        ):
            writer.copy(message)
