"""The VIEWPOINT of a PCD: where a file says that the sensor stood, and what is said of it."""

from pathlib import Path

import numpy as np
import pytest
from full_scan import full_scan

from lidarsynth.cli.main import main
from lidarsynth.files.formats import read, write
from lidarsynth.files.pcd import viewpoint
from lidarsynth.lidar.frame import parse_transform, transformed
from lidarsynth.verbs.viewpoint import viewpoint_note
from lidarsynth.viewer.beside import read_shown

POSES = ["1:2:1.8:0:0:0", "0:0:0:90:0:0", "0:0:0:0:90:0", "0:0:0:0:0:90", "500000.25:-3:1:10:-20:170"]


def header(place: str) -> bytes:
    return f"VERSION 0.7\nVIEWPOINT {place}\nDATA ascii\n".encode()


def quaternion(turn: np.ndarray) -> np.ndarray:
    """w x y z, the eigenvector of Bar-Itzhack's matrix: another way than the one that is tested."""
    m = turn
    k = np.array([
        [m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]],
        [m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]],
        [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1], m[1, 0] - m[0, 1]],
        [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m.trace()],
    ])  # fmt: skip
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    return np.array([w, x, y, z])


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("length", [1, -2])
def test_it_is_the_pose_that_it_tells(pose: str, length: float):
    """A quaternion of any length, and its opposite, is the same turn."""
    matrix = parse_transform(pose)
    words = " ".join(f"{v:.12g}" for v in (*matrix[:3, 3], *(length * quaternion(matrix[:3, :3]))))
    found = viewpoint(header(words))
    assert found is not None
    np.testing.assert_allclose(found, matrix, atol=1e-9)


@pytest.mark.parametrize("scale", ["1e200", "1e-200"])
def test_a_rotation_of_any_length_is_one(scale: str):
    found = viewpoint(header(f"1 2 3 0 0 0 {scale}"))
    assert found is not None
    np.testing.assert_allclose(found, viewpoint(header("1 2 3 0 0 0 1")))


NOWHERE = ["0 0 0 1 0 0 0", "0 0 0 -1 0 0 0", "0 0 0 0 0 0 0", "0 0 0", "a b c 1 0 0 0", "nan 0 0 1 0 0 0"]


@pytest.mark.parametrize("place", NOWHERE)
def test_the_origin_and_what_is_no_place_are_none(place: str):
    assert viewpoint(header(place)) is None and viewpoint(b"VERSION 0.7\nDATA ascii\n") is None


def test_points_stay_and_it_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    scan, path, words = full_scan(), tmp_path / "a.pcd", ["--sensor", "pandar64", "--no-picture"]
    write(path, scan)
    assert viewpoint_note(path) is None and viewpoint_note(tmp_path / "no.pcd") is None
    path.write_bytes(path.read_bytes().replace(b"VIEWPOINT 0 0 0 1 0 0 0", b"VIEWPOINT 1 2 3 0 0 0 1"))
    np.testing.assert_array_equal(read(path).xyz, scan.xyz)
    note = viewpoint_note(path)
    assert note is not None and "found 1:2:3:0:0:180 (x:y:z:roll:pitch:yaw)" in note and note in read_shown(path).notes
    main(["project", str(path), "--out", str(tmp_path / "b.npz"), *words])
    said = capsys.readouterr().err
    assert said == f"lidarsynth: {path}: {note}\n"
    main(["info", str(path)])
    assert note in capsys.readouterr().out
    back = said.split("--transform ")[1].strip()
    stood = transformed(scan.xyz, parse_transform("1:2:3:0:0:180"))
    np.testing.assert_allclose(transformed(stood, parse_transform(back)), scan.xyz, atol=1e-4)
    main(["project", str(path), "--out", str(tmp_path / "c.npz"), "--transform", back, *words])
    assert "VIEWPOINT" not in capsys.readouterr().err, "who says where the sensor is need not be told"
