"""Bags of ROS 2 in the parts that its recorder leaves: nothing of them is lost, and nothing is written among them."""

from pathlib import Path

import numpy as np
import pytest

from lidarsynth.cli.main import main
from lidarsynth.data.bag_records import POINTS, Cloud, typestore
from lidarsynth.data.bag_writer import message_of
from lidarsynth.data.bags import open_bag
from lidarsynth.files.fields import FileError
from lidarsynth.verbs.inputs import inputs_of

pytest.importorskip("rosbags", reason="rosbags comes with the extra `ros`")
pytest.importorskip("mcap", reason="mcap comes with the extra `ros`")
CLOUD = Cloud(0, "lidar", 0, {axis: np.ones(3, np.float32) for axis in "xyz"})
MADE = ["--model", "bilinear", "--sensor", "vlp-16"]


def recorded(path: Path, storage: str = "MCAP", mode: str | None = None, cloud: Cloud = CLOUD) -> Path:
    """A ROS 2 bag of two clouds on a latched topic."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    ever = QosTime(2147483647, 4294967295)
    own = Qos(QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, ever, ever,
              QosLiveliness.AUTOMATIC, ever, False)  # fmt: skip
    writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage])
    if mode is not None:
        writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer:
        points = writer.add_connection("/points", POINTS, typestore=typestore("cdr"), offered_qos_profiles=[own])
        for time in (1, 2):
            writer.write(points, time, message_of(cloud, "cdr"))
    return path


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
def test_the_quality_of_service_of_compressed_files_is_kept(storage: str, tmp_path: Path):
    """Only the metadata beside them tell it, without unpacking."""
    with open_bag(recorded(tmp_path / "drive", storage, "FILE")) as bag:
        ((key, words),) = bag.topics[0].offered
        assert [message.time for message in bag.messages()] == [1, 2]
    assert key == "offered_qos_profiles" and words.startswith("- ") and "durability: transient_local" in words


@pytest.mark.parametrize("name", ["drive.mcap", "dense.mcap"])
def test_no_bag_is_written_among_the_parts_of_another(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """It would replace one, or become one more."""
    folder = recorded(tmp_path / "drive")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(SystemExit, match="2"):
        main(["complete", str(folder), "--out", str(folder / name), *MADE])
    assert f"{name}: expected a place outside the bag {folder}" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_the_bag_that_holds_the_metadata_is_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Those of an Ouster lie in the first part of a split recording alone."""
    from rosbags.rosbag1 import Writer

    paths = tmp_path / "run_0.bag", tmp_path / "run_1.bag"
    for path in paths:
        with Writer(path) as writer:
            kind = "ouster_ros/msg/PacketMsg"
            packets = writer.add_connection("/ouster/lidar_packets", kind, typestore=typestore("ros1"))
            writer.write(packets, 1, b"\xd0\x07\0\0" + bytes(2000))
    before = paths[0].read_bytes()
    with pytest.raises(SystemExit, match="2"):
        main(["complete", str(paths[1]), "--metadata", str(paths[0]), "--out", str(paths[0]), *MADE])
    assert "run_0.bag: expected a bag other than the one that is read" in capsys.readouterr().err
    assert paths[0].read_bytes() == before


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
def test_a_killed_recording_may_have_compressed_its_first_files(
    storage: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """It leaves no metadata; the last file is not compressed yet."""
    from zstandard import ZstdCompressor

    (whole,) = (p for p in recorded(tmp_path / "drive", storage).iterdir() if p.suffix != ".yaml")
    folder = tmp_path / "killed"
    folder.mkdir()
    whole.rename(last := folder / f"run_1{whole.suffix}")
    (folder / f"run_0{whole.suffix}.zstd").write_bytes(ZstdCompressor().compress(last.read_bytes()))
    words = inputs_of([folder]).words
    assert [item.name for item in inputs_of([folder]).stream()] == ["run_1/000000", "run_1/000001"]
    assert words == (f"1 compressed bag was passed over: {folder}/run_0{whole.suffix}.zstd; unpack it (zstd -d) to "
                     "read it",)  # fmt: skip
    (folder / f"run_0{whole.suffix}").write_bytes(last.read_bytes())
    assert not inputs_of([folder]).words


def test_parts_of_which_some_are_compressed_are_refused(tmp_path: Path):
    """Those that are not would be taken for all."""
    folder = recorded(tmp_path / "drive", mode="FILE")
    (folder / "drive_1.mcap").write_bytes(next(recorded(tmp_path / "other").glob("*.mcap")).read_bytes())
    with pytest.raises(FileError, match=r"all packed, found drive\.mcap\.zstd beside drive_1\.mcap: unpack it"):
        inputs_of([folder])


@pytest.mark.parametrize("kind", ["SQLITE3", "MCAP", "bag"])
def test_a_topic_on_which_nothing_was_said_is_none_to_choose(kind: str, tmp_path: Path):
    """As of a node that was recorded (`ros2 bag record --all`) and had no listeners."""
    from rosbags import rosbag1, rosbag2

    path, ros = tmp_path / "drive.bag", "ros1" if kind == "bag" else "cdr"
    if kind == "bag":
        opened = rosbag1.Writer(path)
    else:
        path = tmp_path / "drive"
        opened = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[kind])
    with opened as writer:
        writer.add_connection("/filtered", POINTS, typestore=typestore(ros))
        points = writer.add_connection("/points", POINTS, typestore=typestore(ros))
        writer.write(points, 1, message_of(CLOUD, ros))
    with open_bag(path) as bag:
        assert bag.point_topic() == "/points" and bag.point_topic("/filtered") == "/filtered"


@pytest.mark.parametrize("kind", ["SQLITE3", "MCAP", "bag"])
def test_completed_points_are_published_as_they_were(kind: str, tmp_path: Path):
    around = np.radians(np.arange(0, 360, 0.5, dtype=np.float32))
    scan = {"x": 9 * np.cos(around), "y": 9 * np.sin(around), "z": 0 * around, "intensity": 0 * around}
    path, out = tmp_path / "drive", tmp_path / ("new.bag" if kind == "bag" else "new.mcap")
    if kind == "bag":
        from rosbags.rosbag1 import Writer

        path = tmp_path / "drive.bag"
        with Writer(path) as writer:
            points = writer.add_connection("/points", POINTS, typestore=typestore("ros1"), callerid="/node", latching=1)
            writer.write(points, 1, message_of(Cloud(0, "lidar", 0, scan), "ros1"))
    else:
        recorded(path, kind, cloud=Cloud(0, "lidar", 0, scan))
    main(["complete", str(path), "--out", str(out), *MADE])
    with open_bag(path) as before, open_bag(out) as after:
        assert after.topics[0].offered == before.topics[0].offered
        assert ("latching", "1") in after.topics[0].offered or "transient_local" in str(after.topics[0].offered)


def test_what_a_killed_run_left_of_a_bag_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """As large as a drive, and hidden; another run may be at work on it, so that it stays."""
    path, left = recorded(tmp_path / "drive"), tmp_path / ".new [1].0123456789abcdef.part"
    left.write_bytes(b"part")
    (tmp_path / ".new [1].part").write_bytes(b"of others")
    with pytest.raises(SystemExit, match="2"):
        main(["complete", str(path), "--out", str(tmp_path / "new [1].mcap"), *MADE])
    told = [line for line in capsys.readouterr().err.splitlines() if ".part" in line]
    assert told == [f"lidarsynth: {left}: of a run that was killed; remove it, unless one is at work there"]
    assert left.exists()
