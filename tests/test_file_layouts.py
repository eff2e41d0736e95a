"""Every layout of the same points, in any order and type, reads as the same scan."""

import struct
from pathlib import Path

import numpy as np
import pytest
from full_scan import N, full_scan, same

from lidarsynth.files.fields import FileError
from lidarsynth.files.formats import read, read_with_report
from lidarsynth.files.lzf import decompress
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import SENSORS


@pytest.fixture
def scan() -> Scan:
    return full_scan()


def columns_of(scan: Scan) -> dict[str, np.ndarray]:
    """Columns under the names and in the types that drivers use; one has no meaning to us."""
    return {
        "intensity": np.round(scan.reflectance * 255).astype(np.uint8),
        "z": scan.xyz[:, 2].astype(np.float64),
        "t": np.round((scan.time - scan.time.min()) * 1e9).astype(np.uint32),
        "x": scan.xyz[:, 0],
        "normal": np.ones(N, np.int16),
        "ring": (9 - scan.ring).astype(np.uint16),
        "y": scan.xyz[:, 1],
    }


def check(found: Scan, scan: Scan, exact: bool = True):
    np.testing.assert_allclose(found.xyz, scan.xyz, atol=0 if exact else 1e-3)
    np.testing.assert_allclose(found.reflectance, scan.reflectance, atol=0.5 / 255 + 1e-6)
    np.testing.assert_array_equal(found.ring, scan.ring)
    np.testing.assert_allclose(found.time, scan.time - scan.time.min(), atol=1e-6)


def pcd_bytes(columns: dict[str, np.ndarray], encoding: str, height: int = 1, extra: int = 0) -> bytes:
    """An independent PCD writer: any field order, a field `rgb` of `extra` numbers a point."""
    columns = dict(columns)
    if extra:
        columns["rgb"] = np.arange(N * extra, dtype=np.float32).reshape(N, extra)
    counts = [column.size // N for column in columns.values()]
    shapes = [(name, c.dtype.newbyteorder("<"), c.shape[1:]) for name, c in columns.items()]
    table = np.empty(N, shapes)
    for name, column in columns.items():
        table[name] = column
    sizes = [c.itemsize for c in columns.values()]
    kinds = [c.dtype.kind.upper() for c in columns.values()]
    if encoding == "ascii":
        rows = zip(*[c.reshape(N, -1).tolist() for c in columns.values()], strict=True)
        body = "".join(" ".join(f"{v!r}" for cell in row for v in cell) + "\n" for row in rows).encode()
    elif encoding == "binary":
        body = table.tobytes()
    else:
        packed = lzf_compress(b"".join(np.ascontiguousarray(table[name]).tobytes() for name in columns))
        body = struct.pack("<II", len(packed), table.nbytes) + packed
    return (
        f"# a comment\nVERSION .7\nFIELDS {' '.join(columns)}\nSIZE {' '.join(map(str, sizes))}\n"
        f"TYPE {' '.join(kinds)}\nCOUNT {' '.join(map(str, counts))}\nWIDTH {N // height}\nHEIGHT {height}\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {N}\nDATA {encoding}\n"
    ).encode() + body


def lzf_compress(data: bytes) -> bytes:
    """A greedy LZF encoder: the longest match among the places where the same three bytes stood last."""
    out, literals, last, at = bytearray(), bytearray(), {}, 0

    def flush():
        for i in range(0, len(literals), 32):
            chunk = literals[i : i + 32]
            out.extend(bytes([len(chunk) - 1]) + chunk)
        literals.clear()

    while at < len(data):
        start, last[data[at : at + 3]] = last.get(data[at : at + 3]), at
        if start is None or at - start > 8192 or at + 3 > len(data):
            literals.append(data[at])
            at += 1
            continue
        length = 3
        while length < 264 and at + length < len(data) and data[start + length] == data[at + length]:
            length += 1
        flush()
        offset = at - start - 1
        code = length - 2
        out.append(min(code, 7) << 5 | offset >> 8)
        if code >= 7:
            out.append(code - 7)
        out.append(offset & 255)
        at += length
    flush()
    return bytes(out)


@pytest.mark.parametrize("data", [b"a", b"abc" * 1000, bytes(5000), np.random.default_rng(0).bytes(3000), b"ab" * 9000])
def test_lzf_is_the_inverse_of_an_encoder(data: bytes):
    packed = lzf_compress(data)
    assert decompress(packed, len(data)) == data


@pytest.mark.parametrize("extra", [0, 3])
@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_in_any_order_and_type(encoding: str, extra: int, scan: Scan, tmp_path: Path):
    columns = columns_of(scan)
    for order in (list(columns), list(columns)[::-1]):
        (tmp_path / "scan.pcd").write_bytes(pcd_bytes({name: columns[name] for name in order}, encoding, extra=extra))
        check(read(tmp_path / "scan.pcd"), scan)


def test_the_rows_of_an_organised_pcd_are_rings(tmp_path: Path):
    sensor = SENSORS["vlp-16"].resized(width=N // 16)
    grid = sensor.points(np.full((16, N // 16), 10, np.float32))
    grid[3:5, 7] = np.nan
    grid[9, 9] = 0
    columns = {axis: grid[..., i].reshape(-1) for i, axis in enumerate("xyz")} | {"intensity": np.ones(N, np.float32)}
    (tmp_path / "scan.pcd").write_bytes(pcd_bytes(columns, "binary", height=16))
    found, dropped = read_with_report(tmp_path / "scan.pcd")
    assert dropped == 3
    rows = np.repeat(np.arange(16), N // 16)
    rows = np.delete(rows, [3 * N // 16 + 7, 4 * N // 16 + 7, 9 * N // 16 + 9])
    np.testing.assert_array_equal(found.ring, rows)
    shuffled = np.random.default_rng(0).permutation(N)
    columns = {name: column[shuffled] for name, column in columns.items()}
    (tmp_path / "scan.pcd").write_bytes(pcd_bytes(columns, "binary", height=16))
    assert read(tmp_path / "scan.pcd").ring is None


PLY_NAMES = {"u1": "uchar", "f8": "double", "u4": "uint", "f4": "float32", "i2": "int16", "u2": "ushort"}


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_in_any_order_and_type(encoding: str, scan: Scan, tmp_path: Path):
    """With another element of lists and one of plain numbers before the vertices, and faces after them."""
    columns = columns_of(scan)
    order = "<" if encoding == "binary_little_endian" else ">"
    properties = "".join(f"property {PLY_NAMES[c.dtype.str[1:]]} {name}\n" for name, c in columns.items())
    header = (
        f"ply\nformat {encoding} 1.0\ncomment a scan\nelement strip 2\nproperty int id\nproperty list uchar int n\n"
        f"element camera 1\nproperty float f\nproperty double d\nelement vertex {N}\n{properties}"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    if encoding == "ascii":
        rows = zip(*[column.tolist() for column in columns.values()], strict=True)
        body = "7 3 1 2 3\n8 0\n1.5 2.5\n" + "".join(" ".join(map(repr, row)) + "\n" for row in rows) + "3 0 1 2\n"
        data = body.encode()
    else:
        data = struct.pack(order + "iB3iiBfd", 7, 3, 1, 2, 3, 8, 0, 1.5, 2.5)
        data += np.rec.fromarrays([c.astype(c.dtype.newbyteorder(order)) for c in columns.values()]).tobytes()
        data += struct.pack(order + "B3i", 3, 0, 1, 2)
    (tmp_path / "scan.ply").write_bytes(header.encode() + data)
    check(read(tmp_path / "scan.ply"), scan)


def test_npz_of_columns_and_structured_npy(scan: Scan, tmp_path: Path):
    columns = columns_of(scan)
    np.savez(tmp_path / "scan.npz", **columns)
    check(read(tmp_path / "scan.npz"), scan)
    np.save(tmp_path / "scan.npy", np.rec.fromarrays(list(columns.values()), names=list(columns)).view(np.ndarray))
    check(read(tmp_path / "scan.npy"), scan)


def test_a_pose_beside_one_table_is_no_other(scan: Scan, tmp_path: Path):
    np.savez(tmp_path / "scan.npz", pose=np.eye(4), points=scan.xyz, intensity=scan.reflectance)
    same(read(tmp_path / "scan.npz"), scan, ("xyz", "reflectance"))
    few = np.random.default_rng(0).random((4, 4)).astype(np.float32)
    np.savez(tmp_path / "few.npz", few)
    np.testing.assert_array_equal(read(tmp_path / "few.npz").xyz, few[:, :3])


@pytest.mark.parametrize("name", ["points", "data", "arr_0"])
def test_npz_of_one_table(name: str, scan: Scan, tmp_path: Path):
    table = np.column_stack([scan.xyz, scan.reflectance])
    np.savez_compressed(tmp_path / "scan.npz", **{name: np.asfortranarray(table)})
    same(read(tmp_path / "scan.npz"), scan, ("xyz", "reflectance"))


def test_npz_of_one_array_in_rows(scan: Scan, tmp_path: Path):
    """As the same array in .npy; beside it (H, W) are fields of its points, a pose and other matrices are none."""
    table = np.column_stack([scan.xyz, scan.reflectance]).reshape(10, -1, 4)
    np.save(tmp_path / "scan.npy", table)
    np.savez(tmp_path / "scan.npz", points=table)
    same(read(tmp_path / "scan.npz"), read(tmp_path / "scan.npy"))
    same(read(tmp_path / "scan.npz"), scan, ("xyz", "reflectance"))
    more = {"ring": scan.ring.reshape(10, -1), "pose": np.eye(4), "wide": np.zeros((3, 20))}
    np.savez(tmp_path / "scan.npz", points=table, **more)
    same(read(tmp_path / "scan.npz"), scan, ("xyz", "reflectance", "ring"))
    np.savez(tmp_path / "scan.npz", points=table, pose=np.eye(4))
    same(read(tmp_path / "scan.npz"), scan, ("xyz", "reflectance"))
    boxes = np.zeros((7, 8, 3))
    np.savez(tmp_path / "scan.npz", points=table.reshape(-1, 4), boxes=boxes)
    same(read(tmp_path / "scan.npz"), scan, ("xyz", "reflectance"))
    np.savez(tmp_path / "scan.npz", points=table, boxes=boxes)
    with pytest.raises(FileError, match="expected the fields x, y, z, found no x, y, z in only points, boxes"):
        read(tmp_path / "scan.npz")


def test_npy_tables(scan: Scan, tmp_path: Path):
    table = np.column_stack([scan.xyz, scan.reflectance, 9 - scan.ring])
    np.save(tmp_path / "scan.npy", table)
    same(read(tmp_path / "scan.npy"), scan, ("xyz", "reflectance", "ring"))
    np.save(tmp_path / "scan.npy", np.column_stack([table[:, :4], scan.time]))
    assert read(tmp_path / "scan.npy").ring is None
    np.save(tmp_path / "scan.npy", scan.xyz)
    bare = read(tmp_path / "scan.npy", intensity="none")
    np.testing.assert_array_equal(bare.xyz, scan.xyz)
    np.testing.assert_array_equal(bare.reflectance, np.zeros(N))


def test_nuscenes_is_turned_into_our_frame_and_counts_rings_from_the_bottom(scan: Scan, tmp_path: Path):
    dark = np.round(scan.reflectance) / np.float32(255)  # at most 1 of 255: the format fixes the scale
    right, forward = -scan.xyz[:, 1], scan.xyz[:, 0]  # its own frame: x to the right, y forward
    table = np.column_stack([right, forward, scan.xyz[:, 2], dark * 255, 9 - scan.ring]).astype(np.float32)
    table.tofile(tmp_path / "scan.pcd.bin")
    found = read(tmp_path / "scan.pcd.bin")
    np.testing.assert_array_equal(found.xyz, scan.xyz, "x is forward everywhere")
    np.testing.assert_allclose(found.reflectance, dark, rtol=1e-6)
    np.testing.assert_array_equal(found.ring, scan.ring)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las(suffix: str, scan: Scan, tmp_path: Path):
    laspy = pytest.importorskip("laspy", reason="laspy comes with the extra `data`")
    las = laspy.create(point_format=1, file_version="1.2")
    las.header.scales = [0.001] * 3
    las.x, las.y, las.z = scan.xyz.T.astype(np.float64)
    las.intensity = np.round(scan.reflectance * 65535).astype(np.uint16)
    las.gps_time = scan.time - scan.time.min()
    las.add_extra_dim(laspy.ExtraBytesParams("ring", "uint8"))
    las.ring = (9 - scan.ring).astype(np.uint8)
    las.add_extra_dims([laspy.ExtraBytesParams("echo_width", "float32"), laspy.ExtraBytesParams("normal", "3f4")])
    las.echo_width = np.arange(len(scan), dtype=np.float32)
    las.classification = np.arange(len(scan)) % 3
    las.write(str(tmp_path / f"scan{suffix}"))
    found = read(tmp_path / f"scan{suffix}")
    check(found, scan, exact=False)
    np.testing.assert_array_equal(np.sort(found.extra["echo_width"]), np.arange(len(scan)))
    assert list(found.extra) == ["ring", "echo_width", "classification"], "three numbers a point are no field of a scan"
    whole = (tmp_path / f"scan{suffix}").read_bytes()
    (tmp_path / f"cut{suffix}").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"^\S*: expected .* found"):
        read(tmp_path / f"cut{suffix}")


def test_argoverse_feather(scan: Scan, tmp_path: Path):
    feather = pytest.importorskip("pyarrow.feather", reason="pyarrow comes with the extra `data`")
    pa = pytest.importorskip("pyarrow")
    columns = {
        **{axis: scan.xyz[:, i].astype(np.float16) for i, axis in enumerate("xyz")},
        "intensity": np.round(scan.reflectance * 255).astype(np.uint8),
        "laser_number": (9 - scan.ring).astype(np.uint8),
        "offset_ns": np.round((scan.time - scan.time.min()) * 1e9).astype(np.int32),
    }
    feather.write_feather(pa.table(columns), str(tmp_path / "scan.feather"))
    found = read(tmp_path / "scan.feather")
    np.testing.assert_allclose(found.xyz, scan.xyz, rtol=1e-3)
    np.testing.assert_array_equal(found.ring, scan.ring)
    np.testing.assert_allclose(found.time, scan.time - scan.time.min(), atol=1e-8)
    whole = (tmp_path / "scan.feather").read_bytes()
    (tmp_path / "cut.feather").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"^\S*: expected .* found"):
        read(tmp_path / "cut.feather")


def test_what_lacks_in_a_feather_is_no_number_and_leaves_out_no_column(scan: Scan, tmp_path: Path):
    feather = pytest.importorskip("pyarrow.feather", reason="pyarrow comes with the extra `data`")
    pa = pytest.importorskip("pyarrow")
    lost, light = np.arange(len(scan)) % 7 == 0, np.round(scan.reflectance * 255).astype(np.uint8)
    gone = {axis: pa.array(scan.xyz[:, i], mask=lost) for i, axis in enumerate("xyz")}
    more = {"intensity": pa.array(light, mask=lost), "flag": ~lost, "word": ["a"] * len(scan)}
    feather.write_feather(pa.table(gone | more | {"ring": pa.array(scan.ring, mask=lost)}), str(tmp_path / "a.feather"))
    found, dropped = read_with_report(tmp_path / "a.feather")
    assert dropped == lost.sum() and set(found.extra) == {"flag"}
    np.testing.assert_array_equal(found.xyz, scan.xyz[~lost])
    np.testing.assert_array_equal(found.ring, scan.ring[~lost])
    np.testing.assert_array_equal(found.reflectance, (light[~lost] / np.float64(255)).astype(np.float32))


def test_fractions_in_a_column_of_whole_numbers_stay(tmp_path: Path):
    rows = [f"{x} 2 3 {light}" for x, light in ((1, 0.25), (2, 0.75), (3, 1))]
    pcd = "FIELDS x y z intensity\nSIZE 4 4 4 1\nTYPE F F F U\nWIDTH 3\nDATA ascii\n"
    properties = "".join(f"property {kind}\n" for kind in ("float x", "float y", "float z", "uchar intensity"))
    ply = f"ply\nformat ascii 1.0\nelement vertex 3\n{properties}end_header\n"
    for name, header in (("a.pcd", pcd), ("a.ply", ply)):
        (tmp_path / name).write_text(header + "\n".join(rows) + "\n")
        np.testing.assert_array_equal(read(tmp_path / name).reflectance, np.float32([0.25, 0.75, 1]))
        (tmp_path / name).write_text(header + "\n".join(rows).replace("0.25", "51").replace("0.75", "102") + "\n")
        np.testing.assert_allclose(read(tmp_path / name).reflectance, [51 / 255, 102 / 255, 1 / 255], rtol=1e-6)


def test_an_image_without_a_sensor_is_told_what_its_file_lacks(tmp_path: Path):
    """As generators' code saves what it made: no points, and not what `write` makes of an image."""
    image = np.random.default_rng(0).uniform(5, 50, (32, 64)).astype(np.float32)
    looks = "which looks like an image: its file is an npz of range, reflectance, mask and sensor"
    for array in (image, np.stack([image, image]), np.stack([image, image], -1), np.stack([[image, image]] * 3)):
        np.save(tmp_path / "made.npy", array)
        with pytest.raises(FileError, match=looks):
            read(tmp_path / "made.npy")
    np.savez(tmp_path / "made.npz", range=image, reflectance=image / 50)
    with pytest.raises(FileError, match="expected a saved range image, found no mask, sensor in range, reflectance"):
        read(tmp_path / "made.npz")
    np.save(tmp_path / "table.npy", np.zeros((300, 12), np.float32))
    with pytest.raises(FileError, match=r"found \(300, 12\) of float32$"):
        read(tmp_path / "table.npy")
