"""With `--keep-topics` the new bag takes the place of the old: messages of which nothing is made are in it, too."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest

from lidarsynth.cli.main import main
from lidarsynth.data.bag_records import POINTS, Cloud, Message, cloud_of
from lidarsynth.data.bag_writer import FORMATS, message_of, points_topic, write_bag
from lidarsynth.data.bags import open_bag
from lidarsynth.lidar.sensor import get_sensor
from lidarsynth.streets.reader import SyntheticStreets

pytest.importorskip("rosbags", reason="rosbags comes with the extra `ros`")
pytest.importorskip("mcap", reason="mcap comes with the extra `ros`")
BROKEN = 3  # the number of the message that is


def drive(path: Path, counts: list[int]) -> list[Message]:
    """A bag of messages of so many points; a last one is broken."""
    scan = SyntheticStreets(5, 1, get_sensor("vlp-16")).image(0).to_scan()
    encoding = FORMATS[path.suffix]
    with write_bag(path) as writer:
        for i, count in enumerate(counts):
            fields = {**dict(zip("xyz", scan.xyz[:count].T, strict=True)), "intensity": scan.reflectance[:count]}
            fields["ring"] = scan.ring[:count].astype(np.uint16)
            data = message_of(Cloud(i + 7, "lidar", i + 1, fields), encoding)
            writer.put(Message(points_topic("/points", encoding), i + 1, data[:40] if i == BROKEN else data))
    return messages(path)


def messages(path: Path) -> list[Message]:
    with open_bag(path) as bag:
        return [message for message in bag.messages() if message.topic.kind == POINTS]


@pytest.mark.parametrize(("suffix", "into", "workers"), [*product(FORMATS, FORMATS, "1"), (".mcap", ".mcap", "2")])
def test_they_are_copied(suffix: str, into: str, workers: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    before = drive(tmp_path / f"a{suffix}", [14300, 0, 60, 5, 14300])
    words = ["--model", "nearest", "--out", str(tmp_path / f"b{into}"), "--workers", workers]
    main(["complete", str(tmp_path / f"a{suffix}"), "--keep-topics", *words])
    said, alike = capsys.readouterr(), FORMATS[suffix] == FORMATS[into]
    copied = [1, 2, 3] if alike else [1, 2]
    named = ", ".join(f"{i:06d}" for i in copied)
    assert f"{len(copied)} messages that failed were copied unchanged: {named}\n" in said.err
    assert "3 failed: a/000001, a/000002, a/000003" in said.out
    after = messages(tmp_path / f"b{into}")
    assert [message.time for message in after] == [i + 1 for i in (0, *copied, 4)]
    for i, found in zip(copied, after[1:], strict=False):
        assert found.published in (None, before[i].published, before[i].time)
        if alike:
            assert found.data == before[i].data
        else:
            new, old = cloud_of(found), cloud_of(before[i])
            assert (new.stamp, new.frame_id) == (old.stamp, old.frame_id) and new.fields.keys() == old.fields.keys()
            assert all(new.fields[name].tobytes() == column.tobytes() for name, column in old.fields.items())
    assert "new" in cloud_of(after[0]).fields


def test_where_all_fail_there_is_no_new_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    drive(tmp_path / "a.mcap", [0, 0])
    with pytest.raises(SystemExit) as ended:
        main(
            [
                "complete",
                str(tmp_path / "a.mcap"),
                "--keep-topics",
                "--model",
                "nearest",
                "--out",
                str(tmp_path / "b.mcap"),
            ]
        )
    assert ended.value.code == 2 and not (tmp_path / "b.mcap").exists() and "copied" not in capsys.readouterr().err
