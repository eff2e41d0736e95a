"""How folders are looked through: behind links to others, each once, and not at all without the right to."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from full_scan import full_scan

from lidarsynth.cli.main import main
from lidarsynth.data.bags import is_bag
from lidarsynth.data.folder import scan_files
from lidarsynth.evaluation.image_sets import image_set
from lidarsynth.files.formats import write
from lidarsynth.verbs.expansion import streams_below
from lidarsynth.verbs.file_kinds import file_lines
from lidarsynth.verbs.inputs import Reading, inputs_of
from lidarsynth.viewer.series import series_of

NOBODY = 65534


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scan and a capture, and links: two to a folder elsewhere with the same, and circles from both."""
    scans, other = tmp_path / "in", tmp_path / "other"
    for where in (scans / "day", other / "deep"):
        where.mkdir(parents=True)
    for path in (scans / "a", scans / "day" / "b", other / "c", other / "deep" / "d"):
        write(path.with_suffix(".ply"), full_scan())
        path.with_suffix(".pcap").write_bytes(b"")
    for link, target in (
        ("in/far", "../other"), ("in/twin", "../other"), ("in/deeper", "../other/deep"), ("in/again", "day"),
        ("in/loop", "."), ("in/day/up", ".."), ("in/above", "../.."), ("other/home", "../in"), ("other/deep/up", ".."),
    ):  # fmt: skip
        (tmp_path / link).symlink_to(target)
    return scans


def test_links_to_folders_elsewhere_are_gone_through_once(folder: Path, capsys: pytest.CaptureFixture[str]):
    expected = ["a.ply", "day/b.ply", "deeper/d.ply", "far/c.ply"]
    assert [str(path.relative_to(folder)) for path in scan_files(folder)] == expected
    streams = [str(path.relative_to(folder)) for path in streams_below(folder)]
    assert streams == [name.replace("ply", "pcap") for name in expected]
    assert [item.name for item in inputs_of([folder]).stream()] == ["a", "b", "d", "c"]
    assert series_of([folder], Reading()).count == 4
    main(["info", str(folder)])
    said = " ".join(capsys.readouterr().out.split())
    assert "scans 4 .ply" in said and "passed over 4 .pcap" in said


def test_what_macos_keeps_beside_files_is_no_scan(tmp_path: Path):
    """Each was a broken scan, and the first of its folder in what `info` tells of it."""
    for name in ("1.ply", "._own.ply"):
        write(tmp_path / name, full_scan())
    for name in ("._1.ply", "._drive.pcap"):
        (tmp_path / name).write_bytes(b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X")
    assert [path.name for path in scan_files(tmp_path)] == ["._own.ply", "1.ply"]
    assert streams_below(tmp_path) == []


@contextmanager
def nobody() -> Iterator[None]:
    """Without the rights of an administrator, whom no folder stops."""
    admin = os.geteuid() == 0
    if admin:
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        if admin:
            os.seteuid(0)


@pytest.mark.skipif(os.name == "nt", reason="rights of another kind")
@pytest.mark.parametrize("rights", [0, 0o444], ids=["none", "to list alone"])
def test_a_folder_without_the_right_to_read_is_named(rights: int):
    """And not a file that it may not even have; also where it is one of several."""
    with tempfile.TemporaryDirectory() as place:  # that of pytest is the administrator's
        os.chmod(place, 0o755)
        root, closed = Path(place), Path(place, "closed")
        closed.mkdir()
        write(root / "a.ply", full_scan())
        os.chmod(closed, rights)
        told = rf"{closed}: expected a readable folder, found: Permission denied$"
        try:
            with nobody():
                assert not is_bag(closed)
                for path in (closed, root):
                    for look in (scan_files, streams_below, image_set, lambda path: inputs_of([path])):
                        with pytest.raises(ValueError, match=told):
                            look(path)
                    with pytest.raises(ValueError, match=told):
                        file_lines(path, Reading())
        finally:
            os.chmod(closed, 0o755)
