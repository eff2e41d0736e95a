"""Scan and RangeImage: shapes that fit, points out of images and images out of parts of images."""

import ast
import inspect
from dataclasses import MISSING, fields, replace
from pathlib import Path

import numpy as np
import pytest

from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage, Scan, as_scan
from lidarsynth.lidar.sensor import get_sensor
from lidarsynth.lidar.turns import several_turns

SENSOR = get_sensor("hdl-64e-kitti").resized(16, 64)


@pytest.fixture
def image() -> RangeImage:
    rng = np.random.default_rng(0)
    mask = rng.random((16, 64)) < 0.8
    distance = np.where(mask, rng.uniform(5, 60, mask.shape), 0).astype(np.float32)
    reflectance = (rng.random(mask.shape, np.float32) * mask).astype(np.float32)
    label = np.where(mask, rng.integers(1, 20, mask.shape), 0)
    return RangeImage(distance, reflectance, mask, SENSOR, label)


def test_the_hints_of_an_image_have_its_fields_and_take_a_word_for_a_sensor():
    tree = ast.parse(Path(inspect.getfile(RangeImage)).read_text())
    (image,) = (node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == "RangeImage")
    (hints,) = (node for node in ast.walk(image) if isinstance(node, ast.FunctionDef) and node.name == "__init__")
    told = {arg.arg: ast.unparse(arg.annotation) for arg in hints.args.args[1:] if arg.annotation}
    assert told == {f.name: f.type for f in fields(RangeImage)} | {"sensor": "Sensor | str"}
    given = [default.default for default in fields(RangeImage) if default.default is not MISSING]
    assert [ast.literal_eval(default) for default in hints.args.defaults] == given


def test_a_scan_picks_points_from_all_its_fields():
    scan = Scan(np.zeros((5, 3), np.float32), np.arange(5) / 5, ring=np.arange(5), label=np.arange(5) + 10)
    some = scan[np.array([True, False, True, False, True])]
    assert len(some) == 3 and some.ring.tolist() == [0, 2, 4] and some.label.tolist() == [10, 12, 14]
    assert some.time is None
    assert len(scan[1:3]) == 2 and scan[np.array([4, 4])].ring.tolist() == [4, 4]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"xyz": np.zeros((3, 4))}, r"xyz must be \(N, 3\), got \(3, 4\)"),
        ({"xyz": np.zeros(3)}, r"xyz must be \(N, 3\), got \(3,\)"),
        ({"reflectance": np.zeros(2)}, r"reflectance must be \(3,\) like xyz, got \(2,\)"),
        ({"ring": np.zeros((3, 1))}, r"ring must be \(3,\) like xyz, got \(3, 1\)"),
        ({"time": np.zeros(4)}, r"time must be \(3,\) like xyz, got \(4,\)"),
        ({"label": np.zeros(0)}, r"label must be \(3,\) like xyz, got \(0,\)"),
    ],
)
def test_scans_that_do_not_fit_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        Scan(**{"xyz": np.zeros((3, 3)), "reflectance": np.zeros(3), **fields})


@pytest.mark.parametrize("name", ["range", "reflectance", "mask", "label"])
def test_images_that_do_not_fit_their_sensor_are_refused(image, name):
    with pytest.raises(ValueError, match=rf"{name} must be \(16, 64\), the sensor's beams and columns, got \(16, 32\)"):
        replace(image, **{name: np.zeros((16, 32))})
    with pytest.raises(ValueError, match=r"xyz must be \(16, 64, 3\), got \(16, 64\)"):
        replace(image, xyz=np.zeros((16, 64)))


def test_an_image_becomes_the_points_of_its_measured_pixels(image):
    scan = image.to_scan()
    rows, columns = np.nonzero(image.mask)
    assert len(scan) == image.mask.sum() == len(rows)
    np.testing.assert_array_equal(scan.ring, rows)
    np.testing.assert_array_equal(scan.label, image.label[rows, columns])
    np.testing.assert_array_equal(scan.reflectance, image.reflectance[rows, columns])
    np.testing.assert_allclose(np.linalg.norm(scan.xyz, axis=1), image.range[rows, columns], rtol=1e-5)


def test_an_image_of_its_own_points_is_the_same_image(image):
    assert image.mask[-1].any() and image.mask[0].any()
    for method in ("unfolding", "auto", "spherical"):
        again = project(image.to_scan(), SENSOR, method)
        np.testing.assert_array_equal(again.mask, image.mask)
        np.testing.assert_allclose(again.range, image.range, rtol=1e-5)
        np.testing.assert_array_equal(again.reflectance, image.reflectance)
        np.testing.assert_array_equal(again.label, image.label)


def test_measured_points_win_over_rays(image):
    moved = np.zeros((16, 64, 3), np.float32)
    moved[3, :10] = [1, 2, 3]
    points = replace(image, xyz=moved).points()
    np.testing.assert_array_equal(points[3, :10], moved[3, :10])
    np.testing.assert_array_equal(points[4:], image.points()[4:])


def test_keeping_pixels_empties_the_others_in_every_field(image):
    image = replace(image, xyz=image.points())
    known = np.zeros((16, 64), bool)
    known[::4] = True
    kept = image.keep(known)
    np.testing.assert_array_equal(kept.mask, image.mask & known)
    for name in ("range", "reflectance", "label", "xyz"):
        ours, theirs = getattr(kept, name), getattr(image, name)
        np.testing.assert_array_equal(ours[known], theirs[known])
        assert not ours[~known].any()
        assert ours.dtype == theirs.dtype
    with pytest.raises(ValueError, match=r"known must be \(16, 64\), got \(64, 16\)"):
        image.keep(known.T)


def test_rings_and_labels_that_are_whole_floats_become_whole_numbers():
    azimuth = np.linspace(np.pi, -np.pi, 500, endpoint=False)
    xyz = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], 1) * 9
    rings = np.arange(500) % 2
    for dtype in (np.float32, np.float64, np.uint64, np.uint8):
        scan = Scan(xyz, ring=rings.astype(dtype), label=rings.astype(dtype))
        assert scan.ring.dtype.kind in "iu" and scan.ring.tolist() == scan.label.tolist() == rings.tolist()
        assert several_turns(scan) is None, "which counts points by rings"
    kept = rings.astype(np.uint16)
    assert Scan(xyz, ring=kept).ring is kept


@pytest.mark.parametrize("name", ["ring", "label"])
@pytest.mark.parametrize(
    ("values", "found"),
    [
        (np.array([0.5, 1, 2]), "expected whole numbers, found 0.5"),
        (np.array([0, np.nan, 2]), "expected whole numbers, found nan"),
        (np.array([0, np.inf, 2], np.float32), "expected whole numbers, found inf"),
        (np.array([0, 1, 2**63], np.uint64), "expected whole numbers, found 9223372036854775808"),
        (np.array(["a", "b", "c"]), "expected an array of numbers, found one of <U1"),
        (np.array([True, False, True]), "expected an array of numbers, found one of bool"),
    ],
)
def test_rings_and_labels_that_are_no_whole_numbers_are_refused_in_one_line(name: str, values: np.ndarray, found: str):
    with pytest.raises(ValueError, match=f"^{name}: {found}$"):
        Scan(np.zeros((3, 3)), **{name: values})


def test_times_and_further_fields_that_are_none_are_refused_in_one_line():
    with pytest.raises(ValueError, match=r"^time: expected an array of numbers, found one of <U1$"):
        Scan(np.zeros((3, 3)), time=np.array(list("abc")))
    for wrong in ([1], {3: np.zeros(3)}, [np.zeros(300)], None):
        with pytest.raises(ValueError, match=r"^extra: expected arrays by name, found .*$"):
            Scan(np.zeros((3, 3)), extra=wrong)  # type: ignore[arg-type]


@pytest.mark.filterwarnings("ignore:the matrix subclass:PendingDeprecationWarning")
def test_arrays_of_points_are_taken_as_they_are_or_refused_in_one_line():
    points = np.array([[1, 2, 3, 0.5]])
    assert as_scan(points).reflectance.tolist() == [0.5] and not as_scan(points[:, :3]).reflectance.any()
    for wrong, found in (
        (np.matrix(points), "a matrix"),
        (np.ma.masked_array(points, points > 2), "a MaskedArray"),
        (np.zeros((2, 5)), r"\(2, 5\) of float64"),  # whose fifth column would be lost
        (np.zeros((2, 2)), r"\(2, 2\) of float64"),
    ):
        with pytest.raises(ValueError, match=f"^expected .*points.*, found {found}$"):
            as_scan(wrong)
    with pytest.raises(ValueError, match=r"^xyz: expected an array of numbers, found a matrix$"):
        Scan(np.matrix(points[:, :3]))


def test_an_image_takes_the_word_of_a_sensor_and_numbers_of_any_type(image):
    vlp = get_sensor("vlp-16")
    distance = np.full((16, 1024), 7.5)
    made = RangeImage(distance, distance / 10, distance > 0, "vlp-16", xyz=vlp.points(distance).astype(np.float64))  # type: ignore[arg-type]
    assert made.sensor is vlp and made.shape == (16, 1024)
    assert made.range.dtype == made.reflectance.dtype == made.xyz.dtype == np.float32
    with pytest.raises(ValueError, match=r"expected a sensor of .*, found 'vlp-15'"):
        replace(image, sensor="vlp-15")
    with pytest.raises(ValueError, match=r"^reflectance: expected an array of numbers, found one of <U1$"):
        replace(image, reflectance=np.full(image.shape, "a"))
    for name in ("range", "reflectance"):
        assert getattr(replace(image), name) is getattr(image, name), "and none is copied that is right"


def test_measured_pixels_have_a_range(image):
    row, column = np.argwhere(image.mask)[5]
    for wrong in (0, -1, np.nan, np.inf):
        spoilt = image.range.copy()
        spoilt[row, column] = wrong
        with pytest.raises(ValueError, match=f"^expected ranges of measured pixels .* above 0, found {wrong:g}$"):
            replace(image, range=spoilt)
        empty = image.mask.copy()
        empty[row, column] = False
        assert len(replace(image, range=spoilt, mask=empty).to_scan()) == empty.sum(), "elsewhere anything may stand"
    near = replace(SENSOR, min_range=0.0)
    spoilt[row, column] = 0
    assert replace(image, range=spoilt, sensor=near).mask[row, column], "which is within the limits of such a sensor"


def test_scans_and_images_tell_of_themselves_in_one_line(image):
    xyz = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 70.25]], np.float32)
    scan = Scan(xyz, np.array([0.5, 0.0]), ring=np.arange(2), extra={"new": np.zeros(2)})
    assert repr(scan) == "Scan(2 points, 5.0 to 70.2 m, reflectance, ring, new)"
    assert repr(Scan(np.zeros((0, 3)))) == "Scan(0 points)"
    measured = image.range[image.mask]
    assert repr(image) == (
        f"RangeImage({SENSOR.name}, 16 x 64, {image.mask.sum()} measured, {measured.min():.1f} to "
        f"{measured.max():.1f} m, reflectance, label)"
    )
    assert repr(image.keep(np.zeros(image.shape, bool))) == f"RangeImage({SENSOR.name}, 16 x 64, 0 measured, label)"
