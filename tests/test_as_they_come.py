"""Files as users have them: other axes with rings, bags of one name, fields named like ours, times in odd units."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_recognise import turn

from lidarsynth.cli.main import main
from lidarsynth.data.bag_records import Cloud, cloud_of
from lidarsynth.data.bag_writer import write_bag
from lidarsynth.data.bags import open_bag
from lidarsynth.files.fields import scan_from_fields, seconds_from
from lidarsynth.files.formats import read, write
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import SENSORS, Sensor, get_sensor
from lidarsynth.verbs.inputs import Reading, inputs_of
from lidarsynth.verbs.learned_sensor import sensor_toml
from lidarsynth.viewer.series import series_of

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def scan() -> Scan:
    return turn(SENSORS["hdl-32e"])


def ringed(scan: Scan) -> Scan:
    """With the ring of each point from the top."""
    elevation = np.degrees(np.arctan2(scan.xyz[:, 2], np.hypot(scan.xyz[:, 0], scan.xyz[:, 1])))
    beams = np.array(SENSORS["hdl-32e"].elevations)
    return replace(scan, ring=np.abs(elevation[:, None] - beams).argmin(1).astype(np.int32))


def bag(path: Path, scan: Scan, count: int = 2) -> Path:
    fields = dict(zip("xyz", scan.xyz.T, strict=True)) | {"intensity": scan.reflectance}
    path.parent.mkdir(parents=True, exist_ok=True)
    with write_bag(path) as writer:
        for number in range(count):
            writer.write_cloud("/points", Cloud(number * 10**8, "lidar", number * 10**8, fields))
    return path


@pytest.mark.parametrize("rings", ["from the top", "from the bottom"])
def test_rings_are_counted_anew_where_axes_are_turned(scan: Scan, rings: str, tmp_path: Path):
    upright = ringed(scan)
    assert upright.ring is not None
    ring = upright.ring if rings == "from the top" else 31 - upright.ring
    turned = replace(upright, xyz=upright.xyz * np.float32([1, -1, -1]), ring=ring)
    write(tmp_path / "frd.pcd", turned)
    words = ["complete", str(tmp_path / "frd.pcd"), "--model", "bilinear", "--no-picture", "--corrupt", "beams:2"]
    main([*words[:-2], "--axes", "frd", "--out", str(tmp_path / "o.pcd")])
    filled = read(tmp_path / "o.pcd")
    old = filled.extra["new"] == 0
    same = filled.xyz[old][np.lexsort(filled.xyz[old].T)], turned.xyz[np.lexsort(turned.xyz.T)]
    np.testing.assert_array_equal(*same)
    main([*words[:-2], "--transform", "0:0:0:180:0:0", "--out", str(tmp_path / "p.pcd")])
    assert (read(tmp_path / "p.pcd").extra["new"] == 1).sum() == (~old).sum()


def test_bags_of_one_name_keep_their_folders(scan: Scan, tmp_path: Path, capsys: Capture):
    bags = [str(bag(tmp_path / folder / "drive.bag", scan)) for folder in ("d1", "d2")]
    main(
        ["complete", *bags, "--model", "bilinear", "--no-picture", "--sensor", "hdl-32e", "--out", str(tmp_path / "o")]
    )
    assert "4 scans in" in capsys.readouterr().out
    made = sorted(path.relative_to(tmp_path / "o").as_posix() for path in (tmp_path / "o").rglob("*.ply"))
    assert made == [f"{folder}/drive/{number:06d}.ply" for folder in ("d1", "d2") for number in (0, 1)]


def test_a_bag_is_not_lost_to_a_run_that_fails(scan: Scan, tmp_path: Path, capsys: Capture):
    wrong = bag(tmp_path / "mm.bag", replace(scan, xyz=scan.xyz * 1000))
    kept = bag(tmp_path / "kept.bag", scan)
    before = kept.read_bytes()
    for words in (["complete", "--model", "bilinear"], ["project"], ["complete", "--corrupt", "beams:2"]):
        source = wrong if "--corrupt" not in words and words[0] == "complete" else bag(tmp_path / "good.bag", scan)
        with pytest.raises(SystemExit, match="2"):
            main([words[0], str(source), *words[1:], "--sensor", "hdl-32e", "--out", str(kept)])
        error = capsys.readouterr().err
        assert "expected" in error and kept.read_bytes() == before
    with pytest.raises(SystemExit, match="2"):
        main(["project", str(tmp_path / "good.bag"), "--sensor", "hdl-32e", "--out", str(tmp_path / "new.bag")])
    assert "found a bag, which holds points" in capsys.readouterr().err and not (tmp_path / "new.bag").exists()


def test_labels_go_into_bags_too(scan: Scan, tmp_path: Path):
    source = bag(tmp_path / "a.bag", scan, 1)
    words = ["--sensor", "hdl-32e", "--labels"]
    main(["complete", str(source), "--out", str(tmp_path / "b.bag"), *words])
    main(["complete", str(source), "--out", str(tmp_path / "o"), "--no-picture", *words])
    with open_bag(tmp_path / "b.bag") as opened:
        (message,) = opened.messages(frozenset(["/points"]))
        fields = cloud_of(message).fields
    expected = next((tmp_path / "o").rglob("*.ply"))
    assert sorted(fields["label"]) == sorted(np.asarray(read(expected).label)) and fields["label"].any()


def test_a_files_own_confidence_stays(scan: Scan, tmp_path: Path):
    own = np.arange(len(scan)).astype(np.uint16)
    write(tmp_path / "a.pcd", replace(scan, extra={"confidence": own}))
    words = ["--model", "default", "--sensor", "hdl-32e", "--no-picture"]
    main(["complete", str(tmp_path / "a.pcd"), "--out", str(tmp_path / "b.pcd"), *words])
    filled = read(tmp_path / "b.pcd")
    old = filled.extra["new"] == 0
    assert sorted(filled.extra["file_confidence"][old]) == sorted(own) and (filled.extra["confidence"][old] == 1).all()


@pytest.mark.parametrize("suffix", [".pcd", ".bag"])
def test_fields_that_are_called_as_our_marks_and_are_none_stay(suffix: str, scan: Scan, tmp_path: Path):
    own = {
        "new": (np.arange(len(scan)) % 5).astype(np.float32),
        "confidence": np.linspace(-4, 7, len(scan), dtype="f4"),
    }
    source, out = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    fields = dict(zip("xyz", scan.xyz.T, strict=True)) | {"intensity": scan.reflectance} | own
    if suffix == ".bag":
        with write_bag(source) as writer:
            writer.write_cloud("/points", Cloud(0, "lidar", 0, fields))
    else:
        write(source, replace(scan, extra=own))
    main(["complete", str(source), "--out", str(out), "--sensor", "hdl-32e", "--no-picture"])
    if suffix == ".bag":
        with open_bag(out) as opened:
            (message,) = opened.messages(frozenset(["/points"]))
            found = cloud_of(message).fields
    else:
        found = read(out).extra
    old = found["new"] == 0
    assert old.sum() == len(scan) and set(found["new"]) == {0, 1} and (found["confidence"][old] == 1).all()
    for name, values in own.items():
        np.testing.assert_array_equal(np.sort(found[f"file_{name}"][old]), np.sort(values))


def test_each_scan_of_many_is_said_to_hold_points_that_were_filled_in(scan: Scan, tmp_path: Path):
    (tmp_path / "in").mkdir()
    for number in range(4):
        write(tmp_path / "in" / f"{number}.pcd", replace(scan, extra={"new": (np.arange(len(scan)) < 7).astype("u1")}))
    main(["complete", str(tmp_path / "in"), "--out", str(tmp_path / "o"), "--sensor", "hdl-32e", "--no-picture",
          "--model", "nearest"])  # fmt: skip
    rows = json.loads((tmp_path / "o" / "report.json").read_text())["scans"]
    assert [row["warning"].count(f"found 7 of {len(scan)} that were filled in before") for row in rows] == [1] * 4


def test_marks_that_do_not_fit_are_said_by_every_verb(scan: Scan, tmp_path: Path, capsys: Capture):
    source, count = tmp_path / "in" / "a.bin", len(scan)
    source.parent.mkdir()
    marks = {"new": np.ones(count, np.uint8), "confidence": np.full(count, 0.5, np.float32)}
    write(source, replace(scan, extra=marks))
    for name, size in (("new", 1), ("confidence", 4)):
        beside = source.with_suffix(f".{name}")
        beside.write_bytes(beside.read_bytes()[:-1])
        assert beside.stat().st_size == size * count - 1
    said = (
        f"a.new left out: expected {count} bytes for {count} points, found {count - 1} bytes; a.confidence left out: "
    )
    said += f"expected {4 * count} bytes for {count} points, found {4 * count - 1} bytes"
    main(["info", str(source)])
    assert f"beside       {said}\n" in capsys.readouterr().out
    for verb, words in (("complete", ["--model", "nearest"]), ("project", []), ("label", []), ("realise", [])):
        main([verb, str(source), "--out", str(tmp_path / "o.npz"), "--sensor", "hdl-32e", "--no-picture", *words])
        assert f"lidarsynth: {source}: {said}\n" in capsys.readouterr().err
    main(["complete", str(source.parent), "--out", str(tmp_path / "o"), "--model", "nearest", "--no-picture"])
    (row,) = json.loads((tmp_path / "o" / "report.json").read_text())["scans"]
    assert row["warning"] == f"{source}: {said}"


def test_arrays_beside_a_table_are_its_points_too(scan: Scan, tmp_path: Path):
    ring = np.asarray(ringed(scan).ring, np.uint8)
    np.savez(tmp_path / "a.npz", points=scan.xyz, intensity=scan.reflectance, ring=ring, beam_id=ring * 2)
    found = read(tmp_path / "a.npz")
    np.testing.assert_array_equal(found.reflectance, scan.reflectance)
    np.testing.assert_array_equal(found.ring, ring)
    np.testing.assert_array_equal(found.extra["beam_id"], ring * 2)


def test_chosen_rings_keep_the_files_numbers(scan: Scan, tmp_path: Path):
    write(tmp_path / "a.pcd", ringed(scan))
    found = read(tmp_path / "a.pcd", rings=(8, 31))
    assert found.ring is not None and found.ring.min() == 0
    np.testing.assert_array_equal(found.extra["file_ring"], found.ring + 8)


@pytest.mark.parametrize(
    ("unit", "start", "kind"),
    [(1e6, 0, "f4"), (1e6, 1.7e15, "f8"), (1e9, 0, "f8"), (1e9, 1.7e18, "f8"), (1e3, 0, "f4"), (1, 0, "f4"),
     (1, 1.7e9, "f8")],
)  # fmt: skip
def test_times_of_floats_become_seconds(unit: float, start: float, kind: str):
    true = np.linspace(0, 0.1, 1000)
    found = seconds_from((start + true * unit).astype(kind))
    np.testing.assert_allclose(found - found[0], true, atol=2e-6)
    fields = dict.fromkeys(("x", "y", "z", "intensity"), np.linspace(0.1, 0.9, 1000))
    scan, _ = scan_from_fields({**fields, "time": (start + true * unit).astype(kind)})
    assert ("time" in scan.extra) == (unit != 1), "what is no seconds stays beside"


def test_a_sensors_name_is_quoted(tmp_path: Path):
    for name in ('my "odd" lidar', "a\\qb", "länge"):
        (tmp_path / "s.toml").write_text(sensor_toml(Sensor(name, (1.0, 0.0, -1.0), 64)), "utf-8")
        assert get_sensor(str(tmp_path / "s.toml")).name == name


@pytest.mark.parametrize(
    "header", ["x [m],y [m],z [m],intensity,range [m]", "X(m);Y(m);Z(m);Intensity;Range", "# x y z intensity range"]
)
def test_names_of_columns_may_have_units(header: str, tmp_path: Path):
    separator = next(s for s in (",", ";", " ") if s in header.lstrip("# ").replace(" [", "["))
    rows = [separator.join(map(str, (i, 2, 0.5, 0.25, 7 + i))) for i in range(1, 20)]
    (tmp_path / "a.csv").write_text("\n".join([header, *rows]))
    found = read(tmp_path / "a.csv")
    np.testing.assert_array_equal(found.xyz[:, 0], np.arange(1, 20))
    (name,) = found.extra
    assert name.lower() == "range" and found.extra[name][0] == 8 and (found.reflectance == 0.25).all()


def npz_with_x_twice(path: Path, columns: list[np.ndarray]) -> None:
    np.savez(path, **dict(zip("xyzi_", columns, strict=True)))
    path.write_bytes(path.read_bytes().replace(b"_.npy", b"x.npy"))


def feather_with_x_twice(path: Path, columns: list[np.ndarray]) -> None:
    pyarrow = pytest.importorskip("pyarrow", reason="needs lidarsynth[data]")
    with pyarrow.OSFile(str(path), "wb") as file:
        table = pyarrow.table(columns, names=list("xyzix"))
        with pyarrow.ipc.new_file(file, table.schema) as writer:
            writer.write_table(table)


def bag_with_x_twice(path: Path, columns: list[np.ndarray]) -> None:
    with write_bag(path) as writer:
        fields = dict(zip(("x", "y", "z", "i", "_"), columns, strict=True))
        writer.write_cloud("/points", Cloud(1, "lidar", 1, fields))
    path.write_bytes(path.read_bytes().replace(b"\x01\x00\x00\x00_", b"\x01\x00\x00\x00x"))


def text_with_x_twice(head: str) -> Callable[[Path, list[np.ndarray]], None]:
    def put(path: Path, columns: list[np.ndarray]) -> None:
        rows = [" ".join(map(str, row)) for row in zip(*columns, strict=True)]
        path.write_text("\n".join([head, *rows]) + "\n")

    return put


PLY = "\n".join(
    ["ply", "format ascii 1.0", "element vertex 100", *(f"property float {n}" for n in "xyzix"), "end_header"]
)
PCD = "FIELDS x y z i x\nSIZE 4 4 4 4 4\nTYPE F F F F F\nPOINTS 100\nDATA ascii"
TWICE = {
    "a.csv": text_with_x_twice("x y z i x"),
    "a.ply": text_with_x_twice(PLY),
    "a.pcd": text_with_x_twice(PCD),
    "a.npz": npz_with_x_twice,
    "a.feather": feather_with_x_twice,
    "a.bag": bag_with_x_twice,
}


@pytest.mark.parametrize("name", TWICE)
def test_two_fields_of_one_name_are_refused(name: str, tmp_path: Path, capsys: Capture):
    columns = [np.full(100, value) for value in (1.0, 2.0, 3.0, 0.5, 7.0)]
    TWICE[name](tmp_path / name, columns)
    with pytest.raises(SystemExit, match="2"):
        main(["info", str(tmp_path / name)])
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{name}: " in line and "expected fields of different names, found 2 named x" in line


def test_padding_of_a_pcd_may_come_twice(tmp_path: Path):
    rows = ["1 2 3 9 0.5 9"] * 100
    head = "FIELDS x y z _ i _\nSIZE 4 4 4 4 4 4\nTYPE F F F F F F\nPOINTS 100\nDATA ascii"
    (tmp_path / "a.pcd").write_text("\n".join([head, *rows]) + "\n")
    assert len(read(tmp_path / "a.pcd")) == 100 and not read(tmp_path / "a.pcd").extra


@pytest.mark.parametrize("ending", [".pcap", ".pcap2", ".pcapng", ".bag", ".mcap", ".db3", ".ply", ".pcd.bin", ".npz"])
def test_a_folder_is_a_folder_whatever_its_name_ends_in(ending: str, scan: Scan, tmp_path: Path, capsys: Capture):
    """Named itself, or found in another, of scans or of bags."""
    folders = tmp_path / f"scans{ending}", tmp_path / "all" / f"bags{ending}"
    for folder in folders:
        folder.mkdir(parents=True)
    write(folders[0] / "a.pcd", scan)
    bag(folders[1] / "drive.bag", scan, 1)
    for path, name in ((folders[0], "a"), (folders[1], "drive/000000"), (tmp_path / "all", "drive/000000")):
        inputs = inputs_of([path])
        assert [item.name for item in inputs.stream()] == [name] and not inputs.single and not inputs.passed
        assert len(series_of([path], Reading())[0].scan) == len(scan)
        main(["info", str(path)])
        assert "folder of" in capsys.readouterr().out
    assert [item.name for item in inputs_of([tmp_path]).stream()] == ["a"]
    assert inputs_of([tmp_path]).passed == (folders[1] / "drive.bag",)


def test_what_is_not_read_is_told(scan: Scan, tmp_path: Path, capsys: Capture):
    (tmp_path / "in").mkdir()
    write(tmp_path / "in" / "a.pcd", scan)
    bag(tmp_path / "in" / "drive.bag", scan, 1)
    words = [str(tmp_path / "in"), "--sensor", "hdl-32e", "--no-picture", "--out", str(tmp_path / "o")]
    main(["project", *words])
    said = capsys.readouterr()
    passed = f"1 bag or capture beside scan files was passed over: {tmp_path / 'in' / 'drive.bag'};"
    assert passed in said.err and "1 scan in" in said.out
    for verb, out in (("view", "v.html"), ("sensor", "s.toml")):
        main([verb, str(tmp_path / "in"), "--out", str(tmp_path / out)])
        assert passed in capsys.readouterr().err
    write(tmp_path / "in" / "c.pcd", ringed(scan))
    (tmp_path / "in" / "b.pcd").write_bytes(b"no points")
    main(["sensor", str(tmp_path / "in"), "--out", str(tmp_path / "s.toml"), "--no-picture"])
    assert "1 that could not be read was left out, the first: " in capsys.readouterr().err
    (tmp_path / "text").mkdir()
    (tmp_path / "text" / "a.csv").write_text("x,y,z,intensity\n1,2,3,0.5\n")
    with pytest.raises(SystemExit, match="2"):
        main(["project", str(tmp_path / "text"), "--out", str(tmp_path / "p")])
    assert ".csv and .txt by name), found none" in capsys.readouterr().err
