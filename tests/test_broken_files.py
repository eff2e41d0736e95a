"""Every broken file is refused with one line that names it and says what was expected and what was found."""

import resource
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from broken import BODY, BROKEN, points

from lidarsynth.files import formats as files
from lidarsynth.files.formats import read, read_image, read_with_report, write
from lidarsynth.files.labels import read_labels
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import MOST, SENSORS


def refuse(path: Path, *words: str) -> str:
    """The one line that `read` answers with; it names the file and contains the words."""
    with pytest.raises(files.FileError) as error:
        read(path)
    message = str(error.value)
    assert message.startswith(f"{path}: expected ")
    assert "found" in message
    assert message.isprintable()
    assert len(message) - len(str(path)) < 400
    for word in words:
        assert word in message
    return message


def test_there_are_at_least_forty_kinds():
    assert len(BROKEN) >= 40


@pytest.mark.parametrize("name", BROKEN)
def test_broken_file_is_refused_in_one_line(name: str, tmp_path: Path):
    path = BROKEN[name](tmp_path)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.perf_counter()
    refuse(path)
    assert time.perf_counter() - start < 5
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 400 * (1 if sys.platform == "linux" else 1024) * 1024  # kilobytes on Linux, bytes elsewhere


@pytest.mark.parametrize(
    ("name", "words"),
    {
        "missing": ("No such file",),
        "folder": ("found a folder",),
        "named pipe": ("found a device or pipe",),
        "a terabyte": ("1099511627776",),
        "unknown suffix": (".pcd.bin", "'scan.foo'"),
        "bin empty": ("found 0",),
        "bin truncated": ("16 bytes", "found 797 bytes"),
        "bin text": ("found text", "1.0 2.0"),
        "bin with three floats": ("three floats a point", ".npy"),
        "bin with five floats": (".pcd.bin",),
        "bin all NaN": ("none in 50",),
        "bin beyond 10 km": ("10000", "2e+04"),
        "npy pickled objects": ("never loaded",),
        "npy an image": ("(64, 1024)",),
        "npy without intensity": ("intensity", "only x, y, z", "--intensity none"),
        "npy lying shape": ("16000000000000 bytes", "found 160"),
        "npz lying shape": ("points", "16000000000 bytes"),
        "npz bomb": ("160 bytes", "found 134217728"),
        "pcd a trillion points": ("1000000000000",),
        "pcd endless header": ("DATA",),
        "pcd lists differ": ("4, 3 and 4",),
        "pcd width x height": ("49 x 1 and 50",),
        "pcd truncated": ("800 bytes", "found 799"),
        "pcd packed lies about its size": ("800 bytes", "4294967295"),
        "ply no end_header": ("end_header",),
        "ply 10^18 vertices": ("1000000000000000000",),
        "ply truncated": ("800 bytes", "found 799"),
    }.items(),
)
def test_the_line_says_what_is_wrong(name: str, words: tuple[str, ...], tmp_path: Path):
    refuse(BROKEN[name](tmp_path), *words)


def test_a_file_without_read_permission_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def deny(path: Path) -> bytes:
        raise PermissionError(13, "Permission denied", str(path))

    path = tmp_path / "scan.bin"
    path.write_bytes(BODY)
    monkeypatch.setattr(Path, "read_bytes", deny)  # root reads everything, so the mode alone proves nothing
    refuse(path, "Permission denied")


@pytest.mark.parametrize("package", ["laspy", "pyarrow"])
def test_a_missing_package_names_its_extra(package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, package, None)
    path = tmp_path / {"laspy": "scan.laz", "pyarrow": "scan.feather"}[package]
    path.write_bytes(b"LASF")
    refuse(path, "lidarsynth[data]", package)


@pytest.mark.parametrize("scale", ["unit", "byte"])
def test_a_forced_scale_that_does_not_fit_is_refused(scale: str, tmp_path: Path):
    np.save(tmp_path / "scan.npy", points() * [1, 1, 1, 300])
    with pytest.raises(files.FileError, match=f"{scale}.*found"):
        read(tmp_path / "scan.npy", intensity=scale)
    with pytest.raises(ValueError, match="expected an intensity of auto"):
        read(tmp_path / "scan.npy", intensity="percent")


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("suffix", [".bin", ".npy", ".npz", ".pcd", ".ply", ".packed.pcd", ".ascii.ply"])
def test_random_damage_never_escapes(suffix: str, seed: int, tmp_path: Path, whole_files: dict[str, bytes]):
    """Bytes changed, cut and doubled at random: a scan or one line, nothing else."""
    rng = np.random.default_rng(seed)
    path = tmp_path / f"scan{suffix}"
    refused = 0
    for _ in range(60):
        data = bytearray(whole_files[suffix])
        for place in rng.integers(0, min(len(data), 600), rng.integers(1, 5)):
            data[place] = rng.integers(0, 256)
        if rng.random() < 0.3:
            data = data[: rng.integers(1, len(data))]
        path.write_bytes(data)
        message = ""
        try:
            scan, dropped = read_with_report(path)
        except files.FileError as error:
            message = str(error)
            refused += 1
        if message:
            assert message.startswith(f"{path}: expected ") and "found" in message and message.isprintable()
        else:
            assert len(scan) >= 1 and dropped >= 0 and np.isfinite(scan.xyz).all()
    assert refused > 0


@pytest.fixture
def whole_files(tmp_path: Path) -> dict[str, bytes]:
    table = points(300)
    scan = Scan(table[:, :3], table[:, 3], ring=np.arange(300) // 10, time=np.arange(300) / 3000)
    whole = {}
    for suffix in (".bin", ".npy", ".npz", ".pcd", ".ply"):
        write(tmp_path / f"whole{suffix}", scan)
        whole[suffix] = (tmp_path / f"whole{suffix}").read_bytes()
    packed = b"".join(b"\x1f" + table.T.tobytes()[i : i + 32] for i in range(0, 4800, 32))
    header = whole[".pcd"][: whole[".pcd"].index(b"DATA")].decode().splitlines()
    header = [line.replace("ring timestamp", "").replace(" 2 8", "").replace(" U F", "") for line in header]
    header = [line.replace("1 1 1 1 1 1", "1 1 1 1") if line.startswith("COUNT") else line for line in header]
    sizes = np.array([len(packed), 4800], "<u4").tobytes()
    whole[".packed.pcd"] = "\n".join([*header, "DATA binary_compressed\n"]).encode() + sizes + packed
    rows = "".join(" ".join(f"{v:.4f}" for v in row) + "\n" for row in table)
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    whole[".ascii.ply"] = f"ply\nformat ascii 1.0\nelement vertex 300\n{names}end_header\n{rows}".encode()
    return whole


def test_labels_are_refused(tmp_path: Path):
    path = tmp_path / "scan.label"
    with pytest.raises(files.FileError, match="No such file"):
        read_labels(path, 5)
    path.write_bytes(np.full(5, 40, "<u4").tobytes())
    with pytest.raises(files.FileError, match=r"expected 24 bytes.*found 20"):
        read_labels(path, 6)
    path.write_bytes(np.full(5, 7777, "<u4").tobytes())
    with pytest.raises(files.FileError, match="raw ids, found 7777"):
        read_labels(path, 5)


def test_read_image_refuses_a_scan(tmp_path: Path):
    table = points()
    write(tmp_path / "scan.npz", Scan(table[:, :3], table[:, 3]))
    with pytest.raises(files.FileError, match="expected a saved range image, found no mask, range, sensor"):
        read_image(tmp_path / "scan.npz")
    with pytest.raises(files.FileError, match=r"ends in \.npz"):
        read_image(tmp_path / "scan.ply")


SCAN = Scan(points()[:, :3], points()[:, 3])


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("absent/scan.ply", "No such file"),
        ("scan.docx", r"ends in \.bin"),
        ("scan.pcd.bin", r"found \.pcd\.bin"),
        ("folder.ply", "found a folder"),
        ("file/scan.ply", "Not a directory"),
    ],
)
def test_write_refuses_in_one_line(name: str, words: str, tmp_path: Path):
    (tmp_path / "folder.ply").mkdir()
    (tmp_path / "file").write_bytes(b"x")
    with pytest.raises(files.FileError, match=words) as error:
        write(tmp_path / name, SCAN)
    assert str(error.value).startswith(f"{tmp_path / name}: expected ")
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["file", "folder.ply"]


@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), RuntimeError("a fault of our own")])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    failure: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def fail(file, scan):
        file.write(b"half of it")
        raise failure

    write(tmp_path / "scan.bin", SCAN)
    monkeypatch.setitem(files.WRITERS, ".bin", fail)
    with pytest.raises(files.FileError if isinstance(failure, OSError) else RuntimeError, match=str(failure.args[-1])):
        write(tmp_path / "scan.bin", SCAN)
    assert [p.name for p in tmp_path.iterdir()] == ["scan.bin"]
    assert (tmp_path / "scan.bin").read_bytes() == BODY


def test_write_refuses_what_is_no_scan(tmp_path: Path):
    with pytest.raises(files.FileError, match=r"scan.bin: expected a Scan or a RangeImage, found ndarray"):
        files.write(tmp_path / "scan.bin", np.zeros((5, 4), np.float32))  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_write_refuses_what_would_not_come_back(tmp_path: Path):
    """One line before anything is written: the file and what is beside it stay as they are."""
    numbers, n = np.arange(len(SCAN)), len(SCAN)
    named, bare = (".pcd", ".ply", ".npz"), (".bin", ".npy")
    wrong: list[tuple[tuple[str, ...], str, dict]] = [
        (named, "expected ring numbers of 0-4095 in .*, found 70000", {"ring": numbers + 70000}),
        (named, "expected ring numbers of 0-4095 in .*, found -1", {"ring": numbers - 1}),
        (named[:2], "expected label numbers of 0-65535 in .*, found -1", {"label": numbers - 1}),
        (named[:2], "expected label numbers of 0-65535 in .*, found 65536", {"label": numbers + 65536}),
        (named[:2], "expected times in seconds in .*, of which float64 loses digits", {"time": numbers + (1 << 60)}),
        (named, "expected one number a point, .*, found late of .1,.", {"late": np.ones(1)}),
        (named[:2], "expected fields of numbers in .*, found q of (float128|longdouble)", {"q": np.ones(n, "g")}),
        (bare, "expected labels of 0-19, .*, found -1; ", {"label": numbers - 1}),
        (bare, "expected labels of 0-19, .*, found 255; ", {"label": numbers + 255}),
        (bare, "expected raw labels of 0-4294967295, found -1", {"raw_label": numbers - 1}),
        (bare, "expected raw labels of 0-4294967295, found 0.5", {"raw_label": numbers + 0.5}),
        (bare, "expected whole numbers as raw labels, found <U1", {"raw_label": np.full(n, "a")}),
        (bare, "expected new of 0 and 1, at most 255, found 300", {"new": np.full(n, 300)}),
        (bare, "expected numbers as confidence, found <U1", {"confidence": np.full(n, "a")}),
        (bare, "expected one number a point, .*, found new of .3,.", {"new": np.zeros(3, np.uint8)}),
    ]
    for kind in ("U2", "O", "c16", "M8[s]"):
        wrong.append((named, "expected fields of numbers in .*, found note of ", {"note": np.zeros(n, kind)}))
    marked = replace(SCAN, label=numbers % 20, extra={"new": np.zeros(n, np.uint8)})
    for suffixes, words, fields in wrong:
        own = {name: values for name, values in fields.items() if name in ("ring", "label", "time")}
        scan = replace(SCAN, **own, extra={})
        scan.extra.update({name: values for name, values in fields.items() if name not in own})  # type: ignore[attr-defined]
        for suffix in suffixes:
            path = tmp_path / f"a{suffix}"
            write(path, marked)
            before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
            with pytest.raises(files.FileError, match=words) as error:
                write(path, scan)
            assert str(error.value).startswith(f"{path}: expected ") and "\n" not in str(error.value)
            assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
    with pytest.raises(files.FileError, match=r"b.label: expected labels of 0-19"):
        files.write_labels(tmp_path / "b.label", replace(SCAN, label=numbers + 20))


def test_write_refuses_an_image_that_could_not_be_read(tmp_path: Path):
    sensor = SENSORS["vlp-16"].resized(width=32)
    mask = np.ones((16, 32), bool)
    image = RangeImage(np.full(mask.shape, 9.0), np.full(mask.shape, 0.5), mask, sensor)
    for fields, words in (
        ({"label": np.full(mask.shape, 255)}, "label of 0 to 19, found 512 such as 255"),
        ({"label": np.full(mask.shape, 0.0)}, "label of whole numbers, found float64"),
        ({"reflectance": np.full(mask.shape, 7.0)}, "reflectance of 0 to 1, found 512 such as 7.0"),
        ({"range": np.full(mask.shape, 1e5)}, "range of 0 to 10000, found 512"),
    ):
        with pytest.raises(files.FileError, match=f"a.npz: expected (finite )?{words}"):
            write(tmp_path / "a.npz", replace(image, **fields))
    assert not list(tmp_path.iterdir())
    write(tmp_path / "a.npz", replace(image, mask=mask & False, label=np.full(mask.shape, 255)))  # no ray returned
    assert not read_image(tmp_path / "a.npz").label.any()  # type: ignore[union-attr]


@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".npz"])
def test_as_many_rings_come_back_as_an_image_may_have_beams(suffix: str, tmp_path: Path):
    scan = replace(SCAN, ring=np.arange(len(SCAN)) + MOST - len(SCAN), label=np.full(len(SCAN), 255))
    write(tmp_path / f"a{suffix}", scan)
    found = read(tmp_path / f"a{suffix}")
    assert found.ring is not None and set(found.ring) <= set(range(MOST))
    np.testing.assert_array_equal(found.extra["label"], scan.label)
