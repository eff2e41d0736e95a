"""Bags written by their libraries' own writers, in other layouts than ours, read as they are and come back whole."""

import errno
import sqlite3
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from full_scan import full_scan

from lidarsynth.cli.main import main
from lidarsynth.data.bag_records import POINTS, Cloud, Message, Topic, cloud_of, typestore
from lidarsynth.data.bag_writer import FORMATS, message_of, points_topic, write_bag
from lidarsynth.data.bags import is_bag, open_bag
from lidarsynth.files.fields import PLACE, FileError, find, scan_from_fields
from lidarsynth.verbs.batch import Job, Work, run
from lidarsynth.verbs.file_kinds import file_lines
from lidarsynth.verbs.inputs import Reading, inputs_of
from lidarsynth.verbs.output_files import works
from lidarsynth.viewer.series import series_of

pytest.importorskip("rosbags", reason="rosbags comes with the extra `ros`")
pytest.importorskip("mcap", reason="mcap comes with the extra `ros`")
STRING = "std_msgs/msg/String"


def table(seed: int, big: bool) -> np.ndarray:
    scan, order = full_scan(), ">" if big else "<"
    kinds = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"), ("ring", "u2"), ("t", "u4"), ("tag", "u1")]
    dtype = np.dtype({"names": [n for n, _ in kinds], "formats": [order + k for _, k in kinds],
                      "offsets": [0, 4, 8, 16, 20, 24, 28], "itemsize": 48})  # fmt: skip
    points = np.zeros(len(scan), dtype)
    for i, axis in enumerate("xyz"):
        points[axis] = scan.xyz[:, i] + seed
    points["intensity"] = scan.reflectance * 255
    points["ring"] = np.arange(len(scan)) % 16
    points["t"] = np.arange(len(scan)) * 1000
    points["tag"] = 7
    return points


def message(store, points: np.ndarray, number: int, big: bool, first: bool):
    t = store.types
    stamp = t["builtin_interfaces/msg/Time"](100 + number, 7)
    header = t["std_msgs/msg/Header"](*([number] if first else []), stamp, "lidar")
    number_of = {"f4": 7, "u2": 4, "u4": 6, "u1": 2}
    places = points.dtype.fields
    fields = [
        t["sensor_msgs/msg/PointField"](n, places[n][1], number_of[places[n][0].str[1:]], 1) for n in points.dtype.names
    ]
    data = np.frombuffer(points.tobytes(), np.uint8)
    return t[POINTS](header, 1, len(points), fields, big, 48, len(data), data, True)


def ros1(folder: Path) -> Path:
    from rosbags.rosbag1 import Writer

    store = typestore("ros1")
    with Writer(folder / "drive.bag") as writer:
        points = writer.add_connection("/points", POINTS, typestore=store)
        note = writer.add_connection("/note", STRING, typestore=store)
        for i in range(3):
            data = store.serialize_ros1(message(store, table(i, True), i, True, True), POINTS)
            writer.write(points, (100 + i) * 10**9, data)
            writer.write(note, (100 + i) * 10**9 + 1, store.serialize_ros1(store.types[STRING](f"n{i}"), STRING))
    return folder / "drive.bag"


def ros2(folder: Path, plugin: str, step: int = 10**9, packed: bool = False) -> Path:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    store, out = typestore("cdr"), Writer(folder / plugin, version=9, storage_plugin=StoragePlugin[plugin])
    if packed:
        out.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with out as writer:
        points = writer.add_connection("/points", POINTS, typestore=store)
        note = writer.add_connection("/note", STRING, typestore=store)
        for i in range(3):
            data = store.serialize_cdr(message(store, table(i, False), i, False, False), POINTS)
            time = 100 * 10**9 + i * step
            writer.write(points, time, data)
            writer.write(note, time + min(step, 1), store.serialize_cdr(store.types[STRING](f"n{i}"), STRING))
    return folder / plugin


def packed_mcap(folder: Path) -> Path:
    """As `ros2 bag record -s mcap --compression-mode message --compression-format zstd`."""
    from mcap.reader import make_reader
    from mcap.writer import Writer
    from zstandard import compress

    with open(next(ros2(folder, "MCAP").glob("*.mcap")), "rb") as old, open(folder / "packed.mcap", "wb") as new:
        writer, numbers = Writer(new), {}
        writer.start("ros2")
        for schema, channel, one in make_reader(old).iter_messages():
            if schema is not None and channel.id not in numbers:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, kind)
            writer.add_message(numbers[channel.id], one.log_time, compress(one.data), one.publish_time)
        writer.finish()
    return folder / "packed.mcap"


KINDS: dict[str, Callable[[Path], Path]] = {
    "ros1": ros1,
    "sqlite3": lambda folder: ros2(folder, "SQLITE3"),
    "db3 alone": lambda folder: next(ros2(folder, "SQLITE3").glob("*.db3")),
    "mcap folder": lambda folder: ros2(folder, "MCAP"),
    "db3 of packed messages": lambda folder: next(ros2(folder, "SQLITE3", packed=True).glob("*.db3")),
    "mcap of packed messages": packed_mcap,
    "bare mcap": lambda folder: next(ros2(folder, "MCAP").glob("*.mcap")),
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_bag_streams_its_clouds(kind: str, tmp_path: Path):
    path = KINDS[kind](tmp_path)
    assert is_bag(path)
    with open_bag(path) as bag:
        assert {t.name: (t.kind, t.count) for t in bag.topics} == {"/points": (POINTS, 3), "/note": (STRING, 3)}
        assert bag.seconds == pytest.approx(2, abs=1e-3)
        clouds = list(bag.clouds(bag.point_topic()))
    for i, cloud in enumerate(clouds):
        assert isinstance(cloud, Cloud)
        assert (cloud.stamp, cloud.frame_id, cloud.time) == ((100 + i) * 10**9 + 7, "lidar", (100 + i) * 10**9)
        for name, column in cloud.fields.items():
            np.testing.assert_array_equal(column, table(i, False)[name])


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_what_is_written_comes_back_and_other_topics_too(suffix: str, tmp_path: Path):
    with open_bag(ros1(tmp_path)) as bag, write_bag(tmp_path / f"new{suffix}", bag.topics) as writer:
        for cloud in bag.clouds("/points"):
            assert isinstance(cloud, Cloud)
            writer.write_cloud("/dense", cloud)
        for other in bag.messages(frozenset(["/note"])):
            writer.copy(other)
    with open_bag(tmp_path / f"new{suffix}") as bag, open_bag(tmp_path / "drive.bag") as old:
        assert {t.name: t.count for t in bag.topics} == {"/dense": 3, "/note": 3}
        for new, cloud in zip(bag.clouds("/dense"), old.clouds("/points"), strict=True):
            assert isinstance(new, Cloud) and isinstance(cloud, Cloud)
            assert (new.stamp, new.frame_id, new.time) == (cloud.stamp, cloud.frame_id, cloud.time)
            for name, column in cloud.fields.items():
                np.testing.assert_array_equal(new.fields[name], column)
        assert [m.data for m in bag.messages(frozenset(["/note"]))] == [
            m.data for m in old.messages(frozenset(["/note"]))
        ]
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(["drive.bag", f"new{suffix}"])


def test_a_topic_is_chosen_or_all_are_listed(tmp_path: Path):
    with open_bag(ros1(tmp_path)) as bag:
        assert bag.point_topic() == bag.point_topic("/points") == "/points"
        with pytest.raises(ValueError, match="named /note, found /points"):
            bag.point_topic("/note")


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
def test_what_is_no_bag_is_one_line(name: str, tmp_path: Path):
    (tmp_path / name).write_bytes(b"not a bag at all" * 10)
    with pytest.raises(FileError, match=f"{name}: expected a bag"), open_bag(tmp_path / name):
        pass
    whole = ros1(tmp_path).read_bytes()
    (tmp_path / "cut.bag").write_bytes(whole[:5000])  # within the first message
    with pytest.raises(FileError, match=r"cut.bag: expected a bag"), open_bag(tmp_path / "cut.bag") as bag:
        list(bag.clouds("/points"))


def test_databases_that_rosbags_reads_with_sqlite_are_refused_in_one_line(tmp_path: Path, monkeypatch):
    def broken(self):
        raise sqlite3.DatabaseError("file is not a database")  # rosbags 0.11.0, which has no apsw

    monkeypatch.setattr("rosbags.rosbag2.Reader.open", broken)
    (tmp_path / "a.db3").write_bytes(b"not a bag at all" * 10)
    with pytest.raises(FileError, match=r"a.db3: expected a bag"), open_bag(tmp_path / "a.db3"):
        pass


def test_one_of_the_sensors_of_a_topic_is_read_and_its_points_stay(tmp_path: Path):
    path = ros1(tmp_path)
    with open_bag(path) as bag:
        clouds = list(bag.clouds("/points"))
    wanted = inputs_of([path], Reading(rings=(2, 5), transform=np.eye(4)))
    for one, cloud in zip(wanted.stream(), clouds, strict=True):
        loaded, ring = one.read(), cloud.fields[str(find(cloud.fields, "ring"))]
        place = loaded.scan.extra[PLACE] - 1
        whole = scan_from_fields({**cloud.fields, "place": np.arange(len(ring))})[0].extra["place"]
        np.testing.assert_array_equal(place, whole[(ring[whole] >= 2) & (ring[whole] <= 5)])
        assert 0 < len(loaded.scan) < len(whole) and set(np.unique(loaded.scan.ring)) <= set(range(4))


def test_a_bag_completed_keeps_every_measured_bit(tmp_path: Path):
    """Through the verb's own work: fields of the message as they were, new points marked, in the message's scales."""
    path = ros1(tmp_path)
    works = (Work(item, None, False) for item in inputs_of([path]).stream())
    results = list(run(Job("complete", model="bilinear", sensor="vlp-16", picture=False), works))
    assert [r.error for r in results] == [None] * 3
    with open_bag(path) as bag:
        for result, cloud in zip(results, bag.clouds("/points"), strict=True):
            assert result.cloud is not None and isinstance(cloud, Cloud)
            old = result.cloud.fields["new"] == 0
            kept = [result.cloud.fields[n][old] for n in cloud.fields]
            assert result.cloud.stamp == cloud.stamp and result.cloud.fields.keys() - cloud.fields.keys() == {"new"}
            order, given = np.lexsort(kept), list(cloud.fields.values())
            finite = scan_from_fields(cloud.fields)[1] == 0
            if finite:
                for mine, theirs in zip(kept, given, strict=True):
                    np.testing.assert_array_equal(mine[order], theirs[np.lexsort(given)])


def clouds_at(path: Path, times: list[float], cut: int | None = None) -> Path:
    """A bag of clouds that were recorded at these seconds, with only the start of message `cut`."""
    encoding = FORMATS[path.suffix]
    with write_bag(path) as writer:
        for i, seconds in enumerate(times):
            time, points = int(seconds * 10**9), table(i, False)
            fields = {name: points[name].copy() for name in points.dtype.names or ()}
            data = message_of(Cloud(time, "lidar", time, fields), encoding)
            part = data[: len(data) // 2 if i == cut else None]
            writer.put(Message(points_topic("/points", encoding), time, part))
    return path


CUT = r"1: expected a point cloud, found \d+ broken bytes: "


@pytest.mark.parametrize(("suffix", "workers"), [(".bag", 1), (".mcap", 1), (".mcap", 2)])
def test_the_messages_beside_a_broken_one_become_files(suffix: str, workers: int, tmp_path: Path):
    path = clouds_at(tmp_path / f"in{suffix}", [100, 101, 102, 103], cut=1)
    out = tmp_path / "o"
    results = list(run(Job("project", sensor="vlp-16", picture=False), works(inputs_of([path]), out, "npz"), workers))
    assert [r.error is None for r in results] == [True, False, True, True]
    with pytest.raises(AssertionError, match=f"^{path}: in/00000{CUT}"):
        raise AssertionError(results[1].error)
    assert sorted(p.name for p in (out / "in").iterdir()) == ["000000.npz", "000002.npz", "000003.npz"]


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_the_messages_beside_a_broken_one_go_into_a_bag(
    suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    path = clouds_at(tmp_path / f"in{suffix}", [100, 101, 102, 103], cut=1)
    words = ["--model", "bilinear", "--sensor", "vlp-16", "--no-picture"]
    main(["complete", str(path), "--out", str(tmp_path / f"out{suffix}"), *words])
    assert f"in{suffix}: in/000001: expected a point cloud" in capsys.readouterr().err
    with open_bag(tmp_path / f"out{suffix}") as bag:
        assert [m.time // 10**9 for m in bag.messages()] == [100, 102, 103]


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_a_broken_message_is_told_in_words_and_the_next_are_shown(suffix: str, tmp_path: Path):
    path = clouds_at(tmp_path / f"in{suffix}", [100, 101, 102], cut=1)
    series = series_of([path], Reading())
    with pytest.raises(FileError, match=rf"in{suffix}: /points 101.000 s: expected a point cloud, found \d+ broken"):
        series[1]
    assert len(series[2].scan) == len(full_scan())
    with open_bag(path) as bag:
        kinds = [type(cloud) for cloud in bag.clouds("/points")]
    assert kinds == [Cloud, FileError, Cloud]


def without_summary(path: Path) -> None:
    """The MCAP file as a recorder leaves it that was killed, or was told to save the room."""
    from mcap.writer import Writer

    with open_bag(path) as bag:
        messages = list(bag.messages())
    with open(path, "wb") as file:
        writer = Writer(file, use_statistics=False)
        writer.start()
        schema = writer.register_schema(POINTS, *messages[0].topic.schema)
        channel = writer.register_channel("/points", "cdr", schema)
        for message in messages:
            writer.add_message(channel, message.time, message.data, message.time)
        writer.finish()


@pytest.mark.parametrize("left_out", [("channels",), ("schemas",), ("channels", "schemas")])
@pytest.mark.parametrize("statistics", [True, False])
@pytest.mark.parametrize("chunks", [True, False])
def test_an_mcap_is_read_whose_summary_leaves_out_what_it_may(
    left_out: tuple[str, ...], statistics: bool, chunks: bool, tmp_path: Path
):
    from mcap.writer import Writer

    path = clouds_at(tmp_path / "drive.mcap", [102, 100, 101])
    with open_bag(path) as bag:
        whole, before = list(bag.messages()), bag.topics
    with open(path, "wb") as file:
        rest = {f"repeat_{word}": False for word in left_out}
        writer = Writer(file, use_statistics=statistics, use_chunking=chunks, **rest)
        writer.start()
        channel = writer.register_channel("/points", "cdr", writer.register_schema(POINTS, *whole[0].topic.schema))
        note = writer.register_channel("/note", "json", 0)
        for message in whole:
            writer.add_message(channel, message.time, message.data, message.time)
            writer.add_message(note, message.time + 1, b"{}", message.time + 1)
        writer.finish()
    with open_bag(path) as bag:
        assert [(t.name, t.kind, t.count) for t in bag.topics if t.name != "/note"] == [
            (t.name, t.kind, t.count) for t in before
        ]
        assert bag.seconds == pytest.approx(2) and bag.point_topic() == "/points"
        assert [(m.time, m.data) for m in bag.messages(frozenset(["/points"]))] == [(m.time, m.data) for m in whole]
        assert len(list(bag.messages())) == 6 and len(list(bag.messages(start=101 * 10**9))) == 4
    assert sum(len(item.read().scan) > 0 for item in inputs_of([path]).stream()) == 3


@pytest.mark.parametrize("summary", [True, False])
def test_the_parts_of_a_bag_are_read_in_the_order_of_their_times(summary: bool, tmp_path: Path):
    """Names sort as 10, 11, 12, 2; the parts overlap, and one is empty."""
    folder = tmp_path / "drive"
    folder.mkdir()
    parts = {2: [100, 101, 103], 10: [102, 104], 11: [], 12: [109, 110]}
    for number, times in parts.items():
        clouds_at(folder / f"drive_{number}.mcap", times)
        if not summary and times:
            without_summary(folder / f"drive_{number}.mcap")
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    true = [100, 101, 102, 103, 104, 109, 110]
    with open_bag(folder) as bag:
        assert bag.seconds == 10 and [(t.name, t.count) for t in bag.topics] == [("/points", 7)]
        assert [m.time // 10**9 for m in bag.messages()] == true
        assert [m.time // 10**9 for m in bag.messages(start=103 * 10**9)] == true[3:]
    series = series_of([folder], Reading())
    shift = [0, 1, 0, 2, 1, 0, 1]  # `table` moves the i-th cloud of each part by i metres
    first = full_scan().xyz[0]
    for number in (6, 2, 3, 0, 5, 4, 1):
        np.testing.assert_allclose(series[number].scan.xyz[0], first + shift[number], rtol=1e-5)
    assert list(series.names) == [f"/points {t}.000 s" for t in true]


def test_databases_are_read_in_the_order_of_their_times(tmp_path: Path):
    """Three files of one bag that its metadata names in another order, two of which overlap."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    store, times = typestore("cdr"), {0: [100, 101, 103], 1: [102, 104], 10: [109, 110]}
    for part, seconds in times.items():
        with Writer(tmp_path / f"p{part}", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
            points = writer.add_connection("/points", POINTS, typestore=store)
            for at in seconds:
                data = store.serialize_cdr(message(store, table(at, False), at, False, False), POINTS)
                writer.write(points, at * 10**9, data)
    folder = tmp_path / "drive"
    folder.mkdir()
    for part in times:
        next((tmp_path / f"p{part}").glob("*.db3")).rename(folder / f"drive_{part}.db3")
    told = (tmp_path / "p0" / "metadata.yaml").read_text()
    told = told.replace("- p0.db3", "- drive_10.db3\n  - drive_0.db3\n  - drive_1.db3")
    assert "drive_10" in told
    (folder / "metadata.yaml").write_text(told)
    with open_bag(folder) as bag:
        true = [100, 101, 102, 103, 104, 109, 110]
        assert [m.time // 10**9 for m in bag.messages(frozenset(["/points"]))] == true
        assert [m.time // 10**9 for m in bag.messages(start=103 * 10**9)] == true[3:]
        assert [cloud.stamp // 10**9 - 100 for cloud in bag.clouds("/points") if isinstance(cloud, Cloud)] == true


def test_parts_without_metadata_are_read_by_their_numbers(tmp_path: Path):
    """Bags of their own then, 2 before 10."""
    for number in (10, 2, 1):
        clouds_at(tmp_path / f"drive_{number}.mcap", [100 + number])
    for paths in ([tmp_path], [tmp_path / "drive_*.mcap"]):
        assert [item.name for item in inputs_of(paths).stream()] == [f"drive_{n}/000000" for n in (1, 2, 10)]


def test_bags_in_subfolders_are_found_as_scans_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A week of drives, a folder for each day, one with a bag of ROS 2, which is a folder that holds others."""
    days = [tmp_path / "week" / f"day_{day}" for day in (2, 10, 11)]
    for day, kind in zip(days, ("ros1", "mcap folder", "sqlite3"), strict=True):
        day.mkdir(parents=True)
        KINDS[kind](day)
    clouds_at(days[1] / "drive.mcap", [100])
    bags = [days[0] / "drive.bag", days[1] / "MCAP", days[1] / "drive.mcap", days[2] / "SQLITE3"]
    names = ["day_2/drive"] * 3 + ["day_10/MCAP"] * 3 + ["day_10/drive"] + ["day_11/SQLITE3"] * 3
    for path in (tmp_path / "week", tmp_path / "week" / "**"):
        inputs = inputs_of([path])
        assert [item.path for item in inputs.stream()] == [*bags[:1] * 3, *bags[1:2] * 3, bags[2], *bags[3:] * 3]
        assert [item.name.rpartition("/")[0] for item in inputs.stream()] == names and inputs.count == 10
    main(["info", str(tmp_path / "week")])
    listed = ", ".join(str(path.relative_to(tmp_path / "week")) for path in bags)
    assert (said := capsys.readouterr().out).count(listed) == 1 and "folder of 4 bags and captures" in said
    assert len(series_of([tmp_path / "week"], Reading())[9].scan) == len(full_scan())
    np.save(days[0] / "a.npy", np.ones((9, 4), np.float32))
    inputs = inputs_of([tmp_path / "week"])
    assert inputs.count == 1 and list(inputs.passed) == bags


def test_one_bag_that_cannot_be_read_does_not_end_a_week(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Of no bytes, of none of a bag, without a topic of points, or of two."""
    week = tmp_path / "week"
    week.mkdir()
    clouds_at(week / "a.mcap", [100, 101])
    (week / "b.bag").write_bytes(b"not a bag at all" * 10)
    (week / "c.db3").write_bytes(b"")
    with write_bag(week / "d.mcap") as writer:
        writer.put(Message(Topic("/note", STRING, "cdr", ("ros2msg", b"string data\n"), 0), 5, b"\0\1\0\0\1\0\0\0\0"))
    with write_bag(week / "e.mcap") as writer:
        for topic in ("/front", "/rear"):
            writer.write_cloud(topic, Cloud(0, "lidar", 5, {axis: np.ones(3, np.float32) for axis in "xyz"}))
    clouds_at(week / "f.bag", [100])
    inputs = inputs_of([week])
    assert [item.name for item in inputs.stream()] == ["a/000000", "a/000001", *"bcde", "f/000000"]
    assert inputs.count == 7
    words = ["--model", "bilinear", "--sensor", "vlp-16", "--no-picture", "--out"]
    main(["complete", str(week), *words, str(tmp_path / "o")])
    said = capsys.readouterr()
    assert "3 scans in" in said.out and "4 failed: b, c, d, e" in said.out
    assert all(name in said.err for name in ("b.bag: expected", "c.db3", "d.mcap: expected", "e.mcap: expected"))
    for name, words in (("b.bag", "File magic"), ("e.mcap", "or --topic, found /front, /rear")):
        with pytest.raises(ValueError, match=words):
            inputs_of([week / name])
    with pytest.raises(SystemExit, match="2"):
        main(["complete", str(week / "b.bag"), str(week / "d.mcap"), "--out", str(tmp_path / "p")])


@pytest.mark.parametrize("ending", [".mcap", ".db3", ".bag"])
@pytest.mark.parametrize("kind", ["mcap folder", "sqlite3"])
def test_a_folder_is_a_bag_by_what_it_holds_and_not_by_its_name(kind: str, ending: str, tmp_path: Path):
    path = KINDS[kind](tmp_path).rename(tmp_path / f"drive{ending}")
    assert is_bag(path) and file_lines(path, Reading()) is not None
    assert [item.name for item in inputs_of([path], Reading()).stream()] == [f"drive/{n:06d}" for n in range(3)]
    (path / "metadata.yaml").unlink()  # as of a recording that was killed
    assert not is_bag(path) and len(list(inputs_of([path], Reading()).stream())) == 3


@pytest.mark.parametrize(
    "told", ["", "name: a set of scans\n"], ids=["of a recording that was killed", "of a data set"]
)
def test_a_folder_is_no_bag_by_another_metadata_file(told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = KINDS["mcap folder"](tmp_path)
    (folder / "metadata.yaml").write_text(told)
    assert len(list(inputs_of([folder]).stream())) == 3
    np.save(folder / "a.npy", np.ones((9, 4), np.float32))
    assert [item.name for item in inputs_of([folder]).stream()] == ["a"]
    main(["info", str(folder)])
    assert "folder of scans" in capsys.readouterr().out


@pytest.mark.parametrize("kind", [".bag", ".mcap", "SQLITE3", "MCAP", "alone"])
def test_messages_of_one_stamp_have_no_rate(kind: str, tmp_path: Path):
    if kind.startswith("."):
        path = clouds_at(tmp_path / f"drive{kind}", [100, 100, 100])
    else:
        path = ros2(tmp_path, kind, 0) if kind.isupper() else next(ros2(tmp_path, "SQLITE3", 0).glob("*.db3"))
    lines = file_lines(path, Reading())
    assert lines is not None and "3 messages (" in lines["/points"]


def test_a_full_disk_is_no_broken_bag(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    path = clouds_at(tmp_path / "in.mcap", [100])

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("mcap.writer.Writer.add_message", full)
    with pytest.raises(SystemExit, match="2"):
        main(["complete", str(path), "--out", str(tmp_path / "out.mcap"), "--model", "bilinear", "--sensor", "vlp-16"])
    assert "out.mcap: expected room to write, found: No space left" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["in.mcap"]


def test_a_folder_is_no_bag_to_write_and_no_scan_is_worked_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    path, out = clouds_at(tmp_path / "in.mcap", [100]), tmp_path / "out.mcap"
    out.mkdir()
    monkeypatch.setattr("lidarsynth.verbs.batch.run", None)
    with pytest.raises(SystemExit, match="2"):
        main(["complete", str(path), "--out", str(out), "--model", "bilinear", "--sensor", "vlp-16"])
    assert "out.mcap: expected the name of a bag to write, found a folder" in capsys.readouterr().err


def test_a_bag_is_told_by_its_ending_in_any_case(tmp_path: Path):
    with open_bag(KINDS["bare mcap"](tmp_path)) as bag, write_bag(tmp_path / "NEW.BAG") as writer:
        note = next(bag.messages(frozenset(["/note"])))
        with pytest.raises(FileError, match=r"expected messages of ROS 1 to copy into a \.bag, found /note in cdr"):
            writer.copy(note)


def test_an_encoding_of_neither_ros_is_a_line():
    topic = Topic("/points", POINTS, "json", ("jsonschema", b"{}"), 1)
    with pytest.raises(FileError, match="expected messages of ROS 1 or ROS 2, found the encoding 'json'"):
        cloud_of(Message(topic, 0, b"{}"))
