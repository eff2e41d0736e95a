"""Projection: equal to the reference in every pixel, and points that come back where they were."""

import json
import lzma
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
import torch
from oracle import assert_close

from lidarsynth.lidar.depth import to_x_0
from lidarsynth.lidar.projection import project, ring_of_points, row_of_points
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import SENSORS, Sensor, get_sensor

CODECS = {"log_depth": "log", "inverse_depth": "inverse", "depth": "metric"}


def scan_of(points: np.ndarray) -> Scan:
    return Scan(points[:, :3], points[:, 3])


@pytest.fixture(scope="module")
def points64(scan64: bytes) -> np.ndarray:
    return np.frombuffer(scan64, np.float32).reshape(-1, 4)


def real_scan(path: Path) -> Scan:
    """A scan of shared/scans: plain KITTI `.bin`, or `.scan.xz` as shared/scans/unpack.py describes it."""
    if path.suffix == ".bin":
        return scan_of(np.fromfile(path, np.float32).reshape(-1, 4))
    raw = lzma.decompress(path.read_bytes())
    n = int(np.frombuffer(raw, "<i4", 1)[0])
    steps = np.frombuffer(raw, "<i4", 3 * n, 4).reshape(3, n)
    xyz = (np.cumsum(steps, axis=1, dtype=np.int32) / 1000.0).T.astype(np.float32)
    return Scan(xyz, np.frombuffer(raw, np.uint8, n, 4 + 12 * n).astype(np.float32) / 100)


@pytest.mark.parametrize("width", [1024, 2048])
@pytest.mark.parametrize("method", ["spherical", "unfolding"])
def test_images_equal_the_reference_in_every_pixel(points64, method, width):
    """By the SHA-256 of the reference program's arrays: they are equal bit by bit, or not at all."""
    image = project(scan_of(points64), "hdl-64e", method, width=width)
    assert image.xyz is not None
    found = {"depth": image.range[None], "mask": image.mask[None].astype(np.uint8)}
    found |= {"reflectance": image.reflectance[None], "xyz": image.xyz.transpose(2, 0, 1)}
    stored = json.loads((Path(__file__).parent / "oracles/projection/scan64_images.json").read_text())
    expected = {key.rpartition(".")[2]: told for key, told in stored.items() if key.startswith(f"{method}-{width}.")}
    assert {"depth", "mask"} <= expected.keys()
    for name, told in expected.items():
        values = np.ascontiguousarray(found[name]) + np.zeros((), found[name].dtype)  # -0 is 0
        assert [str(values.dtype), [*values.shape], sha256(values.tobytes()).hexdigest()] == told, name


def test_network_inputs_equal_the_reference(points64, fixture_tensors):
    """Item -> x_0 -> nearest-exact resize, as the published training does it."""
    for key, expected in fixture_tensors("projection/preprocess").items():
        kind, source, *rest = key.split(".")
        method, width = source.split("-")
        image = project(scan_of(points64), "hdl-64e", method, width=int(width))
        if kind == "eval_mask":
            gated = image.mask & (image.range > 0.5) & (image.range < 63)  # the evaluation's gate, metres
            np.testing.assert_array_equal(gated, expected[0, 0].numpy().astype(bool))
            continue
        size, codec = tuple(int(n) for n in rest[0].removeprefix("to").split("x")), CODECS[rest[1]]
        x_0 = torch.nn.functional.interpolate(to_x_0(image, codec)[None], size=size, mode="nearest-exact")
        assert_close(x_0, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", SENSORS)
def test_points_come_back_within_a_pixel_at_their_exact_range(name):
    sensor = get_sensor(name).resized(width=512)
    rng = np.random.default_rng(0)
    top, bottom = sensor.elevations[0], sensor.elevations[-1]
    elevation, azimuth = np.radians(rng.uniform(bottom, top, 4000)), rng.uniform(-np.pi, np.pi, 4000)
    distance = rng.uniform(20, 70, 4000)
    flat = np.cos(elevation)
    xyz = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], 1) * distance[:, None]
    scan = Scan(xyz.astype(np.float32), rng.random(4000, np.float32))
    image = project(scan, sensor, "spherical")
    image = replace(image, xyz=None)  # back along the rays, as a generated image goes
    rows = np.nonzero(image.mask)[0]
    depth = np.linalg.norm(scan.xyz, axis=1)
    order = {value: i for i, value in enumerate(depth)}
    source = np.array([order[value] for value in image.range[image.mask]])
    assert len(rows) > 2000
    back = image.to_scan()
    np.testing.assert_allclose(np.linalg.norm(back.xyz, axis=1), depth[source], rtol=2e-6)
    np.testing.assert_array_equal(back.reflectance, scan.reflectance[source])
    turn = np.arctan2(back.xyz[:, 1], back.xyz[:, 0]) - azimuth[source]
    away = np.degrees(np.abs(np.angle(np.exp(1j * turn))))
    assert away.max() <= 360 / 512 * 1.001
    beams = np.array(sensor.elevations)
    step = np.abs(np.diff(beams)).max()
    tilt = np.abs(np.degrees(elevation[source]) - beams[rows])
    # Borders lie midway between the beams' tangents;
    # a beam that starts up to 0.21 m above the origin looks, at 20 m and more, 0.6 degrees off at most
    assert tilt.max() <= step * (1.001 if sensor.edges else 0.52) + (0.62 if sensor.offsets else 1e-3)


@pytest.mark.parametrize("name", SENSORS)
def test_rays_fall_into_their_own_pixel(name):
    sensor = get_sensor(name)
    distance = np.random.default_rng(0).uniform(5, 60, (sensor.height, sensor.width)).astype(np.float32)
    angles = sensor.ray_angles()
    if sensor.edges:  # rays run along the edges: half a pixel inward
        angles = angles - np.array([14 / 64, 180 / 1024])[:, None, None] * np.pi / 180
    direction = np.stack(
        [np.cos(angles[0]) * np.cos(angles[1]), np.cos(angles[0]) * np.sin(angles[1]), np.sin(angles[0])]
    )
    xyz = sensor.points(distance) if not sensor.edges else np.moveaxis(direction, 0, -1) * distance[..., None]
    scan = Scan(xyz.reshape(-1, 3).astype(np.float32), np.ones(xyz[..., 0].size, np.float32))
    image = project(scan, sensor, "spherical")
    assert image.mask.all()
    np.testing.assert_allclose(image.range, distance, rtol=1e-5)


@pytest.mark.parametrize("name", ["kitti360_000000.bin", "raw0048_000000.scan.xz", "object_000002.scan.xz"])
def test_elevations_and_rings_of_real_scans_agree(shared, name):
    scan = real_scan(shared / "scans" / "test" / name)
    by_angle, by_order = (project(scan, "hdl-64e-kitti", method) for method in ("spherical", "unfolding"))
    assert by_order.mask.mean() > 0.7
    assert (by_angle.range == by_order.range).mean() > 0.999
    auto = project(scan, "hdl-64e-kitti", "auto")
    np.testing.assert_array_equal(auto.range, by_order.range)


def published_rows(xyz: np.ndarray, height: int) -> np.ndarray:
    """Row of each point by the reference program's rule, point by point."""
    quadrant = [(0 if y >= 0 else 3) if x >= 0 else (1 if y >= 0 else 2) for x, y in xyz[:, :2]]
    starts = [i for i in range(len(xyz)) if quadrant[i - 1] == 3 and quadrant[i] == 0]
    rows, end, row = np.zeros(len(xyz), np.int64), len(xyz), height - 1
    for start in reversed(starts):
        rows[start:end] = row
        end, row = start, row - 1
    return rows


@pytest.fixture(scope="module")
def incomplete(points64) -> dict[str, np.ndarray]:
    """scan64 as sensors and files spoil it: same rules, other rings."""
    rows = published_rows(points64[:, :3], 64)
    ahead = points64[rows == 0]
    return {
        "whole": points64,
        "without the lowest two rings": points64[rows < 62],
        "without the highest two rings": points64[rows >= 2],
        "without a ring in the middle": points64[rows != 30],
        "first ring starts behind": np.concatenate([ahead[ahead[:, 1] < 0], points64[rows > 0]]),
        "cut out of an endless stream": np.concatenate([points64[5000:], points64[:5000]]),
        "one ring more, cut": points64[np.flatnonzero(rows == 1)[0] - 200 :],
    }


@pytest.mark.parametrize("case", ["whole", "without the lowest two rings", "without the highest two rings",
                                  "without a ring in the middle", "first ring starts behind",
                                  "cut out of an endless stream", "one ring more, cut"])  # fmt: skip
def test_unfolding_of_incomplete_scans_follows_the_published_rule(incomplete, case):
    points = incomplete[case]
    rows = row_of_points(scan_of(points), get_sensor("hdl-64e"), "unfolding")
    np.testing.assert_array_equal(rows, published_rows(points[:, :3], 64))


def test_rings_too_many_go_where_the_published_program_has_them(points64):
    """The 65th from the end becomes row -1, which is the last; those before it keep row 0."""
    rings, count = ring_of_points(scan_of(points64))
    first = points64[rings == 0]
    assert count == 64 and len(first) > 1000
    rows = row_of_points(scan_of(np.concatenate([first, points64])), get_sensor("hdl-64e"), "unfolding")
    np.testing.assert_array_equal(rows[len(first) :], np.maximum(rings, 0))
    assert (rows[: len(first)] == 63).mean() > 0.99
    rows = row_of_points(scan_of(np.concatenate([first, first, points64])), get_sensor("hdl-64e"), "unfolding")
    assert (rows[: len(first)] == 0).mean() > 0.99 and (rows[len(first) : 2 * len(first)] == 63).mean() > 0.99


def test_auto_never_unfolds_rings_onto_the_even_grid():
    """The rows of R2DM's grid are no beams of a unit: a ring belongs where its points are."""
    sensor = SENSORS["hdl-64e-kitti"]
    scan = RangeImage(*(np.full((64, 1024), v, np.float32) for v in (20, 0.5)), np.ones((64, 1024), bool), sensor)
    points = scan.to_scan()
    auto, spherical = (project(points, "hdl-64e", method) for method in ("auto", "spherical"))
    np.testing.assert_array_equal(auto.range, spherical.range)
    found = np.degrees(np.arcsin(auto.xyz[auto.mask][:, 2] / 20))
    rows = np.nonzero(auto.mask)[0]
    view = -np.diff(SENSORS["hdl-64e"].elevations)[0]
    off = np.abs(found - np.asarray(SENSORS["hdl-64e"].elevations)[rows] + view / 2)
    assert np.median(off) < view, "degrees; unfolding puts them 1.8 off"
    by_ring = project(points, "hdl-64e-kitti", "auto")
    np.testing.assert_array_equal(by_ring.range, project(points, "hdl-64e-kitti", "unfolding").range)


def test_points_in_another_order_are_refused_by_unfolding_and_turned_by_auto(points64):
    shuffled = points64[np.random.default_rng(0).permutation(len(points64))]
    for points, found in ((shuffled, r"\d{4}"), (points64[::-1], "0"), (points64[:0], "0")):
        with pytest.raises(
            ValueError, match=rf"unfolding expects about 64 rings, .*, found {found}; use the spherical projection$"
        ):
            project(scan_of(points), "hdl-64e", "unfolding")
    auto, spherical = (project(scan_of(shuffled), "hdl-64e", method) for method in ("auto", "spherical"))
    np.testing.assert_array_equal(auto.range, spherical.range)
    in_order = project(scan_of(points64), "hdl-64e", "spherical")
    np.testing.assert_array_equal(spherical.range, in_order.range, "the order of points makes no difference")


def test_a_ring_field_is_believed_whatever_the_order(points64):
    rows = published_rows(points64[:, :3], 64)
    expected = project(scan_of(points64), "hdl-64e", "unfolding")
    order = np.random.default_rng(0).permutation(len(points64))
    scan = replace(scan_of(points64[order]), ring=rows[order].astype(np.uint16))
    np.testing.assert_array_equal(project(scan, "hdl-64e", "unfolding").range, expected.range)
    beams = [project(s, "hdl-64e-kitti", m).range for s, m in ((scan, "auto"), (scan_of(points64), "unfolding"))]
    np.testing.assert_array_equal(*beams)
    assert ring_of_points(scan)[1] == 64
    low = scan[scan.ring < 62]  # its lowest beams saw nothing: the others stay where they are
    np.testing.assert_array_equal(project(low, "hdl-64e", "unfolding").range[:62], expected.range[:62])


def test_the_nearest_point_of_a_pixel_wins_whatever_the_order():
    direction = np.array([0.99, 0.02, -0.1]) / np.linalg.norm([0.99, 0.02, -0.1])
    for distances in ([30, 10, 20], [10, 20, 30], [20, 30, 10]):
        xyz = np.array(distances)[:, None] * direction
        scan = Scan(xyz.astype(np.float32), np.array(distances, np.float32) / 100, label=np.array(distances) // 10)
        image = project(scan, "hdl-64e", "spherical")
        assert image.mask.sum() == 1
        assert image.range[image.mask] == pytest.approx(10, rel=1e-6)
        assert image.reflectance[image.mask] == pytest.approx(0.1)
        assert image.label is not None and image.label[image.mask] == 1


def test_points_out_of_range_leave_no_return_and_hide_what_is_behind():
    direction = np.array([0.995, 0.0, -0.1]) / np.linalg.norm([0.995, 0.0, -0.1])
    for near, far, seen in ((1.0, 20.0, None), (1.4501, 20.0, 1.4501), (20.0, 90.0, 20.0), (81.0, 90.0, None)):
        xyz = (np.array([far, near])[:, None] * direction).astype(np.float32)
        image = project(Scan(xyz, np.ones(2, np.float32)), "hdl-64e", "spherical")
        assert image.range[image.mask].tolist() == pytest.approx([] if seen is None else [seen], rel=1e-6)


def test_the_seam_is_behind_and_the_azimuth_runs_clockwise():
    ahead, left, behind = [10, 0, 0], [0, 10, 0], [-10, 1e-6, 0]
    for point, column in ((ahead, 512), (left, 256), (behind, 0), ([-10, -0.01, 0], 1023), ([-10, -0.0, 0], 0)):
        image = project(Scan(np.array([point], np.float32), np.ones(1, np.float32)), "hdl-64e", "spherical")
        assert np.argwhere(image.mask)[0, 1] == column


def test_no_points_zeros_and_nan_make_empty_images():
    nothing = np.array([[0, 0, 0], [np.nan, 1, 1], [np.nan, np.nan, np.nan]], np.float32)
    for xyz in (nothing[:0], nothing):
        for name in ("hdl-64e", "hdl-64e-kitti"):
            image = project(Scan(xyz, np.ones(len(xyz), np.float32)), name, "auto")
            assert not image.mask.any() and not image.range.any() and image.shape == (64, 1024)


def test_real_beams_ignore_points_outside_the_view_and_the_grid_piles_them_up():
    up = np.array([[10, 0, 8], [10, 0, -9]], np.float32)
    scan = Scan(up, np.ones(2, np.float32))
    assert not project(scan, "hdl-64e-kitti", "spherical").mask.any()
    assert np.argwhere(project(scan, "hdl-64e", "spherical").mask)[:, 0].tolist() == [0, 63]
    assert row_of_points(scan, get_sensor("vlp-16"), "spherical").tolist() == [-1, -1]


@pytest.mark.parametrize("edges", [False, True])
def test_a_sensor_of_one_beam_projects(edges):
    sensor = Sensor("line", (0.0,), 360, edges=edges)
    scan = Scan(np.array([[10, 0, 0]], np.float32), np.ones(1, np.float32))
    assert project(scan, sensor, "spherical").mask.sum() == 1


def test_unknown_methods_and_sensors_are_refused(points64):
    with pytest.raises(ValueError, match="expected a projection of auto, spherical, unfolding, found 'cylindrical'"):
        project(scan_of(points64), "hdl-64e", "cylindrical")
    with pytest.raises(ValueError, match=r"expected a sensor of hdl-64e, .*, found 'lidar'"):
        project(scan_of(points64), "lidar")
