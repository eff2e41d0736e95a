"""Angle correction files of Hesai's units, whole and broken, as makers and editors leave them."""

from pathlib import Path

import numpy as np
import pytest
from hesai_packets import angles_csv

from lidarsynth.data.angle_files import is_angles, read_angles
from lidarsynth.files.fields import FileError

WHOLE = angles_csv(np.linspace(10, -10, 5), np.linspace(-1, 1, 5))


@pytest.mark.parametrize(
    "text",
    ["\ufeff" + WHOLE, WHOLE.replace("\n", "\r\n"), WHOLE.rstrip("\n"), WHOLE + "\n,,\n",
     WHOLE.replace("Laser id", "Channel"), WHOLE.replace("Laser id,", " LASER ID , "), "EEFF,1,1\n" + WHOLE,
     "\n".join([*WHOLE.splitlines()[:1], *WHOLE.splitlines()[:0:-1]]),
     "\n".join(line + ",0.3,note" for line in WHOLE.splitlines()),
     "\n".join(",".join(line.split(",")[::-1]) for line in WHOLE.splitlines())],
    ids=["mark", "CRLF", "no end", "empty lines", "channel", "spaces", "version", "unsorted", "more", "other columns"],
)  # fmt: skip
def test_angle_files_as_editors_leave_them(text: str, tmp_path: Path):
    (tmp_path / "a.csv").write_bytes(text.encode())
    found = read_angles(tmp_path / "a.csv")
    assert is_angles(tmp_path / "a.csv")
    np.testing.assert_allclose(found.elevations, np.linspace(10, -10, 5))
    np.testing.assert_allclose(found.azimuths, np.linspace(-1, 1, 5))


@pytest.mark.parametrize(
    ("text", "found"),
    [(WHOLE.replace("\n3,", "\n7,"), "found 1 to 7 without 3"), (WHOLE.replace("\n3,", "\n2,"), "found 2 again"),
     (WHOLE.replace("0.0,0.0", "up,0.0"), "line 4: expected a channel and two angles, found '3,up"),
     (WHOLE.replace("0.0,0.0", "nan,0.0"), r"line 4: expected degrees within .* found '3,nan"),
     (WHOLE.replace("0.0,0.0", "0.0,inf"), "line 4: expected degrees"), (WHOLE.replace("0.0,0.0", "91,0"), "line 4"),
     (WHOLE.replace("0.0,0.0", "0.0"), "line 4: expected a channel and two angles"),
     (WHOLE.replace("\n3,", "\n3.5,"), "line 4: expected a channel"), (WHOLE.splitlines()[0], "found none"),
     ("x,y,z\n1,2,3\n", "with the columns Channel, Elevation and Azimuth, found 'x,y,z'"), ("", "found 'nothing'"),
     ("x,y,z,channel,elevation,azimuth\n1,2,3,4,5,6", "with the columns"), (b"\xff\xfe\0\0", "UTF-8")],
)  # fmt: skip
def test_broken_angle_files_are_one_line(text: str | bytes, found: str, tmp_path: Path):
    (tmp_path / "a.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(FileError, match=rf"a.csv: .*{found}|a.csv: line.*{found}|a.csv.*{found}") as told:
        read_angles(tmp_path / "a.csv")
    assert "\n" not in str(told.value)
    with pytest.raises(FileError, match="expected a readable file"):
        read_angles(tmp_path / "b.csv")
