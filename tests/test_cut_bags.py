"""What a killed recorder left of a bag is read up to where it ends, and a line says so."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarsynth.cli.main import main
from lidarsynth.data.bag_records import POINTS, Cloud, Message, typestore
from lidarsynth.data.bag_writer import message_of, points_topic
from lidarsynth.data.bags import is_bag, open_bag
from lidarsynth.files.fields import FileError
from lidarsynth.verbs.inputs import Reading, inputs_of
from lidarsynth.viewer.series import series_of

pytest.importorskip("rosbags", reason="rosbags comes with the extra `ros`")
pytest.importorskip("mcap", reason="mcap comes with the extra `ros`")
BILINEAR = ["--model", "bilinear", "--sensor", "vlp-16"]
EARLY = "found one that ends early, as of a recording that was killed"
COUNT = 9


def clouds(encoding: str) -> Iterator[Message]:
    """Of 720 points, 12 kB each."""
    around = np.radians(np.arange(0, 360, 0.5, dtype=np.float32))
    topic = points_topic("/points", encoding)
    for n in range(COUNT):
        fields = {"x": (9 + n) * np.cos(around), "y": 9 * np.sin(around), "z": 0 * around, "intensity": 0 * around}
        yield Message(topic, n + 1, message_of(Cloud(n, "lidar", n + 1, fields), encoding), n + 1, n)


def mcap(path: Path, compression: str = "NONE", chunked: bool = True) -> Path:
    """Two clouds a chunk, or none."""
    from mcap.writer import CompressionType, Writer

    with open(path, "wb") as file:
        writer = Writer(file, chunk_size=20_000, compression=CompressionType[compression], use_chunking=chunked)
        writer.start("ros2")
        for n, (topic, time, data, _, number) in enumerate(clouds("cdr")):
            if n == 0:
                channel = writer.register_channel("/points", "cdr", writer.register_schema(POINTS, *topic.schema))
            writer.add_message(channel, time, data, time, number)
        writer.finish()
    return path


def bag(path: Path, compression: str | None = None) -> Path:
    from rosbags.rosbag1 import Writer

    writer: Any = Writer(path)
    if compression is not None:
        writer.set_compression(writer.CompressionFormat[compression])
    writer.chunk_threshold = 20_000
    with writer:
        for n, message in enumerate(clouds("ros1")):
            if n == 0:
                text, digest = message.topic.schema[1].decode(), message.topic.digest
                points = writer.add_connection("/points", POINTS, msgdef=text, md5sum=digest, latching=1)
            writer.write(points, message.time, message.data)
    return path


def cut(path: Path, length: int) -> Path:
    """A part of it, of the same ending."""
    data = path.read_bytes()
    part = path.with_name(f"cut{path.suffix}")
    part.write_bytes(data[: length if length >= 0 else len(data) + length])
    return part


def check_start(part: Path, whole: Path) -> int:
    """How many messages of the whole bag a part of it has, which are the first ones, and are counted in its line."""
    found: list[Message] = []
    try:
        with open_bag(part) as opened:
            found, (line,) = list(opened.messages()), opened.cut
            assert sum(topic.count for topic in opened.topics) == len(found)
            assert [message.time for message in opened.messages(start=2)] == [m.time for m in found if m.time >= 2]
    except FileError as error:
        line = str(error)
    if not found:
        assert line == f"{part}: expected a bag with a whole message, {EARLY}, before its first"
        return 0
    number = f"{len(found)} message{'' if len(found) == 1 else 's'}"
    assert line.startswith(f"{part}: expected a whole bag, {EARLY}: {number} read")
    with open_bag(whole) as opened:
        assert opened.cut == ()
        assert [m[1:] for m in opened.messages()][: len(found)] == [m[1:] for m in found]
    return len(found)


def whole_in(part: Path, whole: Path) -> int:
    """Messages whose bytes are all in an uncompressed part."""
    data = part.read_bytes()
    with open_bag(whole) as opened:
        return sum(message.data in data for message in opened.messages())


@pytest.mark.parametrize("chunked", [True, False])
def test_every_whole_message_of_a_cut_mcap_is_read(chunked: bool, tmp_path: Path):
    whole = mcap(tmp_path / "in.mcap", chunked=chunked)
    lengths = [0, 5, 8, 12, 300, *range(5_000, whole.stat().st_size, 7_000), -1, -60]
    counts = [check_start(cut(whole, length), whole) for length in lengths]
    assert counts == [whole_in(cut(whole, length), whole) for length in lengths]
    assert counts[:5] == [0] * 5 and counts[-2:] == [COUNT, COUNT] and set(counts) == set(range(COUNT + 1))


@pytest.mark.parametrize("compression", ["LZ4", "ZSTD"])
def test_so_are_those_that_are_compressed(compression: str, tmp_path: Path):
    whole = mcap(tmp_path / "in.mcap", compression)
    size = whole.stat().st_size
    counts = [check_start(cut(whole, length), whole) for length in (*range(20, size, size // 40), -1)]
    assert counts == sorted(counts) and counts[0] == 0 and counts[-1] == COUNT and len(set(counts)) >= COUNT // 2


@pytest.mark.parametrize("compression", [None, "LZ4", "BZ2"])
@pytest.mark.parametrize("active", [True, False])
def test_a_bag_of_ros_1_is_read_up_to_its_last_whole_message(active: bool, compression: str | None, tmp_path: Path):
    """As `rosbag record` leaves it, which writes last where the index is, or a copy that was not gone through with."""
    whole = bag(tmp_path / "in.bag", compression)
    data, size = bytearray(whole.read_bytes()), whole.stat().st_size
    if active:
        for name, width in ((b"index_pos=", 8), (b"conn_count=", 4), (b"chunk_count=", 4)):
            at = data.index(name) + len(name)
            data[at : at + width] = bytes(width)
    part, counts = tmp_path / "cut.bag.active", []
    assert is_bag(part)
    for length in (0, 5, 13, 40, 4117, *range(5_000, size, size // 40), size - 1):
        part.write_bytes(data[:length])
        counts.append(check_start(part, whole))
        assert compression is not None or counts[-1] == whole_in(part, whole)
    assert counts == sorted(counts) and counts[0] == 0 and counts[-1] == COUNT and len(set(counts)) >= COUNT // 2
    with open_bag(part) as opened:
        assert dict(opened.topics[0].offered)["latching"] == "1"


def test_what_is_behind_a_broken_chunk_of_ros_1_is_counted_as_lost(tmp_path: Path):
    whole = bag(tmp_path / "in.bag")
    data = bytearray(whole.read_bytes())
    with open_bag(whole) as opened:
        fourth = data.index(list(opened.messages())[3].data)  # the second of the second chunk
    name = data.rindex(b"conn=", 0, fourth)
    data[name : name + 5] = b"none="
    part = tmp_path / "part.bag"
    part.write_bytes(data[:-1])
    assert check_start(part, whole) == 3
    with open_bag(part) as opened:
        lost = int(opened.cut[0].partition("the last ")[2].partition(" ")[0])
    assert 0 < len(data) - fourth < lost < len(data) - fourth + 200


def test_what_is_behind_a_broken_chunk_or_is_zeros_is_left_out_and_told(tmp_path: Path):
    whole = mcap(tmp_path / "in.mcap")
    data = bytearray(whole.read_bytes())
    with open_bag(whole) as opened:
        third = data.index(list(opened.messages())[2].data)
    part = cut(whole, third)  # within the second chunk
    kept = check_start(part, whole)
    part.write_bytes(data[:third] + bytes(3000))
    assert check_start(part, whole) == kept == 2
    data[third + 500] ^= 1
    part.write_bytes(data[:-1])
    assert check_start(part, whole) == 2
    with open_bag(part) as opened:
        assert f"the last {len(data) - 1 - third}" not in opened.cut[0] and "bytes hold no whole one" in opened.cut[0]


def test_verbs_say_it_in_a_line_and_go_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    part = cut(mcap(tmp_path / "in.mcap"), 60_000)
    line = f"lidarsynth: {part}: expected a whole bag, {EARLY}: 5 messages read"
    for out in ("out.mcap", "out/"):
        main(["complete", str(part), "--out", str(tmp_path / out), *BILINEAR])
        assert capsys.readouterr().err.count(line) == 1
    with open_bag(tmp_path / "out.mcap") as opened:
        assert opened.cut == () and opened.topics[0].count == 5
    assert len(list((tmp_path / "out" / "cut").glob("*.ply"))) == 5
    main(["view", str(part), "--out", str(tmp_path / "out.html")])
    assert capsys.readouterr().err.count(line) == 1
    main(["info", str(part)])
    told = capsys.readouterr()
    assert f"{EARLY}: 5 messages read" in told.out and "5 messages" in told.out and not told.err
    with pytest.raises(SystemExit, match="2"):
        main(["sensor", str(part), "--out", str(tmp_path / "out.toml")])
    assert capsys.readouterr().err.count(line) == 1


def test_a_bag_without_a_whole_message_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for part in (cut(mcap(tmp_path / "in.mcap"), 3_000), cut(bag(tmp_path / "in.bag"), 9_000)):
        for words in (["info", str(part)], ["complete", str(part), "--out", str(tmp_path / "o.mcap"), *BILINEAR]):
            with pytest.raises(SystemExit, match="2"):
                main(words)
            assert capsys.readouterr().err == (
                f"lidarsynth: {part}: expected a bag with a whole message, {EARLY}, before its first\n"
            )
    assert not (tmp_path / "o.mcap").exists()


def test_the_other_parts_of_a_folder_are_read_beside_one_that_holds_nothing(tmp_path: Path):
    folder = tmp_path / "drive"
    folder.mkdir()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    mcap(folder / "drive_0.mcap")
    (folder / "drive_1.mcap").write_bytes((folder / "drive_0.mcap").read_bytes()[:40])
    inputs = inputs_of([folder])
    assert [line.split(": ")[0] for line in inputs.cut] == [str(folder / "drive_1.mcap")]
    assert inputs.count == len(list(inputs.stream())) == COUNT
    series = series_of([folder], Reading())
    assert series.cut == inputs.cut and len(series[COUNT - 1].scan) == 720


def database(folder: Path) -> Path:
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(folder / "drive", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        points = writer.add_connection("/points", POINTS, typestore=typestore("cdr"))
        for message in reversed(list(clouds("cdr"))):
            writer.write(points, message.time, message.data)
    return folder / "drive" / "drive.db3"


def test_every_whole_message_of_a_cut_database_is_read(tmp_path: Path):
    """By their times, of those that were recorded first: here from the last one back."""
    whole = database(tmp_path)
    sent = [message.data for message in clouds("cdr")]
    for length, least in ((90_000, 2), (whole.stat().st_size - 9000, 6)):
        with open_bag(cut(whole, length)) as bag:
            found = list(bag.messages(frozenset(["/points"])))
            assert [m.time for m in bag.messages(start=COUNT - 1)] == [COUNT - 1, COUNT]
            (line,) = bag.cut
            assert EARLY in line and f": {len(found)} messages read" in line and bag.topics[0].count == len(found)
            assert bag.topics[0].schema[1] and bag.topics[0].kind == POINTS
        assert least <= len(found) < COUNT
        assert [(m.time, m.data) for m in found] == list(enumerate(sent, 1))[-len(found) :]
    with pytest.raises(FileError, match="expected a bag with a whole message"), open_bag(cut(whole, 45_056)):
        pass


def test_messages_in_the_log_of_a_killed_recorder_are_read(tmp_path: Path):
    import shutil
    import sqlite3
    from contextlib import closing

    with closing(sqlite3.connect(database(tmp_path))) as base:
        base.execute("PRAGMA journal_mode = WAL")
        base.execute("INSERT INTO messages SELECT 99, topic_id, 99, data FROM messages WHERE id = 1")
        base.commit()
        for ending in ("", "-wal"):
            shutil.copy(tmp_path / "drive" / f"drive.db3{ending}", tmp_path / f"killed.db3{ending}")
    before = (tmp_path / "killed.db3").read_bytes()
    with open_bag(tmp_path / "killed.db3") as bag:
        assert [message.time for message in bag.messages()] == [*range(1, COUNT + 1), 99]
        assert EARLY in bag.cut[0] and bag.seconds == pytest.approx(98e-9)
    assert (tmp_path / "killed.db3").read_bytes() == before


@pytest.mark.parametrize("length", [0, 100, 5_000, -1])
def test_a_database_that_is_cut_is_a_line(length: int, tmp_path: Path):
    part = cut(database(tmp_path), length)
    with pytest.raises(FileError, match=rf"^{part}: expected a bag of ROS 1 or ROS 2.*"), open_bag(part) as opened:
        list(opened.messages())


def test_a_damaged_length_is_no_want_of_memory(tmp_path: Path):
    """Of the bytes of the second chunk."""
    bad = mcap(tmp_path / "bad.mcap", "ZSTD")
    data = bytearray(bad.read_bytes())
    second = data.index(b"zstd", data.index(b"zstd") + 4) + 4
    data[second : second + 8] = (1 << 60).to_bytes(8, "little")
    bad.write_bytes(data)
    with pytest.raises(FileError, match=r"bad.mcap: expected a bag"), open_bag(bad) as opened:
        list(opened.messages())
