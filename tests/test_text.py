"""Points as text: named columns, guessed columns, and what is neither."""

import numpy as np
import pytest

from lidarsynth.files import text as text_files
from lidarsynth.files.fields import FileError
from lidarsynth.files.formats import read, read_with_report
from lidarsynth.files.text import read_text

ROWS = "1 2 3 0.5\n4 5 6 0.25\n"


@pytest.mark.parametrize(
    "text",
    [
        "x,y,z,intensity\n1,2,3,0.5\n4,5,6,0.25\n",
        "\ufeffX;Y;Z;Intensity\n1;2;3;0.5\n4;5;6;0.25\n",
        '"Points:0","Points:1","Points:2","intensity"\n1,2,3,0.5\n4,5,6,0.25\n',
        '"intensity","Points_m_XYZ:0","Points_m_XYZ:1","Points_m_XYZ:2"\n0.5,1,2,3\n0.25,4,5,6\n',
        "//X Y Z Scalar_Intensity\n" + ROWS,
        "# made by hand\n# x y z intensity\n" + ROWS,
        "2\n" + ROWS,
        ROWS,
        "intensity\tz\ty\tx\n0.5\t3\t2\t1\n0.25\t6\t5\t4\n",
        "x;y;z;intensity\n1,0;2;3,0;5,0e-1\n4;5;6;0,25\n",  # decimal commas
        '"x"\t"y"\t"z"\t"intensity"\n"1"\t"2"\t"3"\t"0,5"\n"4"\t"5"\t"6"\t"0,25"\n',
        "1 2 3 0,5\n4 5 6 0,25\n",
    ],
)
def test_every_way_of_writing_the_same_points(text: str, tmp_path):
    (tmp_path / "p.csv").write_text(text)
    scan = read(tmp_path / "p.csv")
    np.testing.assert_array_equal(scan.xyz, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(scan.reflectance, np.float32([0.5, 0.25]))


def test_quotes_blanks_and_empty_cells_change_no_number(monkeypatch: pytest.MonkeyPatch):
    """Files without any are read a shorter way, and all by so many lines at a time."""
    rows = [[str(i), f"{i / 7:.6f}", "-1e-3", str(2**60 + i)] for i in range(5)]
    plain = "\n".join(["x,y,z,t", *map(",".join, rows)]) + "\n"
    known = read_text(plain.encode())
    assert known["t"].tolist() == [2**60 + i for i in range(5)] and known["x"].tolist() == [0, 1, 2, 3, 4]
    for text in (plain.replace(",", '","').replace("\n", '"\n"')[:-1].join(('"', "")), plain.replace(",", " , ")):
        found = read_text(text.encode())
        assert list(found) == list(known) and all(np.array_equal(found[key], known[key]) for key in known)
    monkeypatch.setattr(text_files, "BLOCK", 2)  # lines
    found = read_text(plain.replace("1,0.", '"1",0.').encode())
    assert all(np.array_equal(found[key], known[key]) for key in known)
    with pytest.raises(FileError, match=r"expected numbers in column y, found 'two'"):
        read_text((plain + "5,two,0,0\n").encode())
    lost = read_text((plain + ",,,\n").encode())
    assert np.array_equal(lost["y"][:5], known["y"]) and np.isnan(lost["y"][5])


def test_unnamed_columns_are_told_by_their_numbers():
    assert list(read_text(b"1 2 3 255 0 9\n1 2 3 1 2 3\n")) == ["x", "y", "z"]  # colours
    assert list(read_text(b"1 2 3 0.5 7\n1 2 3 0.5 8\n")) == ["x", "y", "z", "intensity", "ring"]
    leica = read_text(b"2\n1 2 3 -2048 1 2 3\n1 2 3 2047 1 2 3\n")
    np.testing.assert_array_equal(leica["intensity"], [-2048, 2047])


def test_a_scan_stations_intensities_are_scaled_once(tmp_path):
    (tmp_path / "p.pts").write_text("3\n1 2 3 -2048 1 2 3\n1 2 3 0 1 2 3\n1 2 3 2047 1 2 3\n")
    found = read(tmp_path / "p.pts")
    np.testing.assert_allclose(found.reflectance, [0, 2048 / 4095, 1], rtol=1e-6)
    assert not found.extra
    with pytest.raises(FileError, match=r"expected an intensity of 0-255 \(byte\), found -2048 to 2047"):
        read(tmp_path / "p.pts", intensity="byte")
    np.testing.assert_array_equal(read(tmp_path / "p.pts", intensity="none").reflectance, [0, 0, 0])


def test_what_ouster_cli_writes_is_read_with_its_rings(tmp_path):
    """`ouster-cli source CAPTURE save o.csv`, version 1.0.1: metres of two returns, rows of beams, times in ns."""
    (tmp_path / "o.csv").write_text(
        "# frame num: 0\n"
        "# TIMESTAMP (ns), ROW, DESTAGGERED IMAGE COLUMN, MEASUREMENT_ID, RANGE (mm), REFLECTIVITY (%), "
        "SIGNAL (photons), X1 (m), Y1 (m), Z1 (m), RANGE2 (mm), X2 (m), Y2 (m), Z2 (m)\n"
        "278309695850,0,0,1006,1891,194,126,-1.8111,-0.1022,0.5685,0,0.0,0.0,0.0\n"
        "278309695850,1,0,1006,0,0,0,0.0000,0.0000,0.0000,0,0.0,0.0,0.0\n"
        "278409695850,2,0,1018,1911,51,193,-1.8405,-0.1055,-0.5379,0,0.0,0.0,0.0\n"
    )
    found, dropped = read_with_report(tmp_path / "o.csv")
    np.testing.assert_allclose(found.xyz, [[-1.8111, -0.1022, 0.5685], [-1.8405, -0.1055, -0.5379]], rtol=1e-6)
    np.testing.assert_allclose(found.reflectance, [194 / 255, 0.2], rtol=1e-6)
    assert found.ring is not None and found.ring.tolist() == [0, 2] and dropped == 1
    assert found.time is not None and np.ptp(found.time) == pytest.approx(0.1)
    own = read_text(b"x,y,z,i,row,x1,y1,z1\n1,2,3,0.5,7,4,5,6\n")  # columns of somebody else
    assert own["x"] == 1 and own["x1"] == 4 and own["row"] == 7


def test_an_empty_cell_is_a_lost_point(tmp_path):
    (tmp_path / "p.xyz").write_text("x,y,z,intensity\n1,,3,1\n1,2,3,1\n")
    assert len(read(tmp_path / "p.xyz")) == 1


def test_a_named_file_may_begin_with_lost_points(tmp_path):
    """As pandas writes rows of NaN, and organised clouds begin; between tabs the first and last cells may be empty."""
    header, rows = (
        ["x", "y", "z", "intensity", "ring"],
        [[""] * 5, ["1", "2", "3", "0.5", "0"], ["", "", "", "0.5", ""]],
    )
    for separator in (",", ";", "\t"):
        text = "\n".join(separator.join(row) for row in [header, *rows, ["4", "5", "6", "0.25", "1"]]) + "\n"
        (tmp_path / "p.csv").write_text(text)
        found, dropped = read_with_report(tmp_path / "p.csv")
        np.testing.assert_array_equal(found.xyz, [[1, 2, 3], [4, 5, 6]])
        np.testing.assert_array_equal(found.ring, [0, 1])
        assert dropped == 2
    (tmp_path / "p.csv").write_text("x\ty\tz\tintensity\n1\t2\t3\t0.5\t\n\t\n")  # a tab after each number
    np.testing.assert_array_equal(read(tmp_path / "p.csv").xyz, [[1, 2, 3]])


def test_true_and_false_in_a_named_column_are_1_and_0():
    """As pandas writes them, from the first point on or later."""
    for rows in ("1,2,3,True\n4,5,6,False\n", "1,2,3,0\n4,5,6,true\n"):
        moving = read_text(f"x,y,z,moving\n{rows}".encode())["moving"]
        np.testing.assert_array_equal(moving, [1, 0] if "True" in rows else [0, 1])


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"x,y,z,day\n1,2,3,2026-11-27\n", "expected numbers in column day, found '2026-11-27'"),
        (b"x,y,z,id\n-0.434,2,3,0x1f\n", "expected numbers in column id, found '0x1f'"),
        (b"x,y,z,day\n1,2,3,\n1,2,3,never\n", "expected numbers in column day, found 'never'"),
        (b"x,y,z,moving\n1,2,3,True\n1,2,maybe,True\n", "expected numbers in column z, found 'maybe'"),
        (b"1,2,3,True\n", "names them, found '1,2,3,True'"),
        (b"hello", "names them, found 'hello'"),
        (b"a,b,c\n1,2,3", "names them"),
        (b"1 2 3\n1 2", "3 numbers a line, found 2"),
        (b",,\n1,2,3\n", "names them, found ',,'"),
        (b"x y z i\n1 2 3\n", "a number for each of x, y, z, i"),
        (b"1 2 3\n1 2 b\n", "expected numbers, found"),
        (b"\xff\xfe\x00", "as text"),
        (b"# nothing\n", "found none"),
        (b"3\n1 2 3\n1 2 3\n", "expected 3 points, the number before them, found 2"),
        (b"1\nx y z\n1 2 3\n1 2 3\n", "expected 1 point, the number before them, found 2"),
        (b"3\nx y z\n", "found none"),
    ],
)
def test_what_is_no_text_of_points_is_one_line(data: bytes, words: str):
    with pytest.raises(FileError, match=words):
        read_text(data)
