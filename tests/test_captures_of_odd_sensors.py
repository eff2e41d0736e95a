"""Captures of an Ouster whose beams begin above the lidar's centre, as an OSDome's, or that sends two short returns."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from lidarsynth.data import ouster
from lidarsynth.data.capture import Datagram
from lidarsynth.evaluation.image_sets import image_set
from lidarsynth.files.fields import FileError

ALTITUDES, COLUMNS, METRES = [60.0, 30.0, 0.0, -30.0], 32, 5.0


def metadata(path: Path, beam: list[float]) -> ouster.Metadata:
    """Of an Ouster of four beams whose origins a matrix of 16 numbers, in millimetres, puts beside the axis."""
    told = {"beam_altitude_angles": ALTITUDES, "beam_azimuth_angles": [0.0] * 4, "columns_per_frame": COLUMNS}
    path.write_text(json.dumps(told | {"beam_to_lidar_transform": beam, "udp_profile_lidar": "RNG15_RFL8_NIR8_DUAL"}))
    return ouster.read_metadata(path)


def packet(first: int) -> Datagram:
    """Sixteen columns of returns at METRES, each with a second one half as far."""
    near = int(METRES / 0.008) // 2
    pixel = struct.pack("<HBBHBB", int(METRES / 0.008), 40, 3, near, 20, 0)
    columns = [struct.pack("<QHH", i * 1000, i, 1) + pixel * 4 for i in range(first, first + 16)]
    return Datagram(0, 7502, b"\1\0\3\0".ljust(32, b"\0") + b"".join(columns) + b"\0" * 32)


def test_beams_of_an_ouster_may_begin_above_its_centre(tmp_path: Path):
    """r - |n| from where the beam begins, n = (x, z) of its origin, as ouster-sdk 1.0.1 has it."""
    x, z, lift = 0.004, 0.030, 0.03618
    described = metadata(tmp_path / "dome.json", [1, 0, 0, 4, 0, 1, 0, 0, 0, 0, 1, 30, 0, 0, 0, 1])
    (turn,) = ouster.turns([packet(0), packet(16)], described)
    assert len(turn["x"]) == 4 * COLUMNS and set(turn["reflectivity"]) == {40}, "the first of two returns"
    travel, up = METRES - np.hypot(x, z), np.radians(ALTITUDES)[turn["ring"]]
    np.testing.assert_allclose(turn["z"], travel * np.sin(up) + z + lift, atol=1e-5)
    np.testing.assert_allclose(np.hypot(turn["x"], turn["y"]), travel * np.cos(up) + x, atol=1e-5)
    assert ouster.sensor_of(described).offsets == pytest.approx([z + lift] * 4)


def test_a_matrix_of_too_few_numbers_is_refused(tmp_path: Path):
    with pytest.raises(FileError, match=r"dome.json: expected Ouster metadata, found: cannot reshape array of size 4"):
        metadata(tmp_path / "dome.json", [1, 0, 0, 4])


@pytest.mark.parametrize("name", ["drive.pcap", "drive.mcap", "."])
def test_a_recording_that_is_to_be_judged_is_told_as_one(name: str, tmp_path: Path):
    for each in ("drive.pcap", "drive.mcap"):
        (tmp_path / each).write_bytes(b"")
    with pytest.raises(ValueError, match=r"found a bag or capture, of whose scans `lidarsynth project` makes a folder"):
        image_set(tmp_path / name)
    with pytest.raises(ValueError, match="found no such file or folder"):
        image_set(tmp_path / "none.pcap")
