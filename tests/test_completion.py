"""What `complete` and `upsample` do with one scan: nothing measured is lost, and the table's numbers are right."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from networks import trained

from lidarsynth.experiment.presets import preset
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.lidar.measured import with_measured
from lidarsynth.lidar.projection import occupied, pixel_of_points, project
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.metrics.reconstruction import reconstruction_errors
from lidarsynth.systems.diffusion.model import LidarModel
from lidarsynth.systems.filling import Filling
from lidarsynth.systems.interpolation.model import interpolated
from lidarsynth.systems.table import assemble
from lidarsynth.verbs.completion import _measured, complete_scan, hidden_part, judged, named_sensor, upsample_scan
from lidarsynth.weights.load import load

FLAT = Sensor("flat", (2.0, 0.0, -2.0, -4.0), width=8, min_range=1.0, max_range=50.0)


@pytest.fixture(scope="module")
def model() -> LidarModel:
    return assemble(preset("tiny"), trained(preset("tiny")))


def room(sensor: Sensor, seed: int = 0, holes: float = 0.2) -> Scan:
    """Walls 5 to 30 m away, seen by `sensor` with ray-drop."""
    rng = np.random.default_rng(seed)
    shape = (sensor.height, sensor.width)
    mask = rng.random(shape) >= holes
    distance = rng.uniform(5, 30, shape).astype(np.float32) * mask
    return RangeImage(distance, rng.random(shape).astype(np.float32) * mask, mask, sensor).to_scan()


def rows_of(scan: Scan) -> np.ndarray:
    """(N,) 16 bytes per point: x, y, z, reflectance."""
    table = np.column_stack([scan.xyz, scan.reflectance]).astype(np.float32)
    return np.ascontiguousarray(table).view("V16").ravel()


def image(distance: np.ndarray, reflectance: float = 0.5) -> RangeImage:
    mask = distance > 0
    return RangeImage(distance.astype(np.float32), np.float32(reflectance) * mask, mask, FLAT)


# measured points


def test_every_point_of_the_scan_comes_back_beside_the_new_ones(model: LidarModel):
    scan = room(SENSORS["hdl-64e-kitti"].resized(width=256))
    filled = complete_scan(model, scan)
    winners = model.image_of(scan).mask
    assert len(filled.points) == len(scan) + (filled.image.mask & ~winners).sum()
    assert np.isin(rows_of(scan), rows_of(filled.points)).all()


def test_each_pixel_with_a_point_keeps_its_nearest_one_in_the_image(model: LidarModel):
    scan = room(SENSORS["hdl-64e-kitti"].resized(width=256))
    truth, filled = model.image_of(scan), complete_scan(model, scan).image
    assert truth.xyz is not None and filled.xyz is not None
    np.testing.assert_array_equal(filled.xyz[truth.mask], truth.xyz[truth.mask])
    np.testing.assert_array_equal(filled.range[truth.mask], truth.range[truth.mask])


def test_points_come_row_by_row_with_their_row_as_ring(model: LidarModel):
    points = complete_scan(model, room(model.sensor.resized(width=256))).points
    assert points.ring is not None and (np.diff(points.ring) >= 0).all() and points.ring.max() == 15
    azimuth = np.arctan2(points.xyz[:, 1], points.xyz[:, 0])
    assert (np.diff(azimuth)[np.diff(points.ring) == 0] <= 0).all()


def test_points_out_of_view_come_last_on_the_first_or_last_ring(model: LidarModel):
    scan = room(SENSORS["vlp-16"].resized(width=64))
    filled = upsample_scan(model, scan, SENSORS["vlp-16"])
    assert filled.points.ring is not None
    assert np.isin(rows_of(scan), rows_of(filled.points)).all()
    above = scan.xyz[:, 2] > np.hypot(scan.xyz[:, 0], scan.xyz[:, 1]) * math.tan(math.radians(10))
    assert above.any()
    last = filled.points[slice(-len(scan), None)]
    assert np.isin(rows_of(scan[above]), rows_of(last)).all()
    assert (last.ring[np.isin(rows_of(last), rows_of(scan[above]))] == 0).all()


def test_with_measured_by_hand():
    """Two points in one pixel, one out of view, one new pixel."""
    filled = image(np.zeros((4, 8)))
    distance = filled.range.copy()
    distance[1, 2], distance[3, 5] = 10, 20
    filled = image(distance)
    near = FLAT.points(distance)[1, 2]
    scan = Scan(np.stack([2 * near, near, np.float32([1, 0, 9])]), np.float32([0.1, 0.2, 0.3]))
    measured = np.zeros((4, 8), bool)
    measured[1, 2] = True
    points = with_measured(scan, measured, filled, pixel_of_points(scan, filled.sensor, "spherical"))
    np.testing.assert_array_equal(points.xyz, np.stack([2 * near, near, FLAT.points(distance)[3, 5], [1, 0, 9]]))
    np.testing.assert_array_equal(points.reflectance, np.float32([0.1, 0.2, 0.5, 0.3]))
    np.testing.assert_array_equal(points.ring, [1, 1, 3, 0])
    seen = with_measured(scan[:2], measured, filled, pixel_of_points(scan[:2], filled.sensor, "spherical"))
    np.testing.assert_array_equal(seen.ring, [1, 1, 3])


def test_a_scan_without_reflectance_takes_that_of_its_pixels():
    distance = np.zeros((4, 8))
    distance[1, 2] = distance[2, 6] = 10
    filled = image(distance, reflectance=0.75)
    scan = Scan(FLAT.points(filled.range)[filled.mask], np.zeros(2, np.float32))
    points = with_measured(scan, filled.mask, filled, pixel_of_points(scan, filled.sensor, "spherical"))
    np.testing.assert_array_equal(points.reflectance, np.float32([0.75, 0.75]))


def test_a_cascade_lights_all_of_a_scan_without_reflectance():
    scan = room(SENSORS["vlp-16"])
    filled = load("default").complete(replace(scan, reflectance=np.zeros(len(scan), np.float32)))
    measured = filled.mask & ~filled.new
    assert (filled.reflectance[measured] > 0).mean() > 0.95 and filled.reflectance[filled.new].any()
    points = filled.to_scan()
    assert (points.reflectance[points.extra["new"] == 0] > 0).mean() > 0.95


def test_a_ray_that_went_beyond_the_limits_stays_empty(model: LidarModel):
    scan = room(SENSORS["hdl-64e-kitti"].resized(width=256), holes=0)
    ahead = np.abs(np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0])) < 0.5
    far = replace(scan, xyz=np.where(ahead[:, None], scan.xyz * np.float32(40), scan.xyz))
    filled = complete_scan(model, far)
    columns = np.abs(model.sensor.ray_angles()[1]) < 0.4
    assert columns.any()
    assert not filled.image.mask[columns].any(), "200 m and more are beyond 80 m"
    assert np.isin(rows_of(far), rows_of(filled.points)).all()


# one door


@pytest.mark.parametrize("word", ["tiny", "bilinear", "iln-tiny", "tiny-gan"])
def test_the_library_completes_as_the_command_line_does(word: str):
    """Rays with any point are known, and every measured point stays, whichever of the two is asked."""
    model = assemble(preset(word), trained(preset(word)))
    recipe, steps = ("beams:2" if word == "iln-tiny" else "points:0.5"), (1 if word != "tiny-gan" else 2)
    sensor = model.sensor
    seen = room(sensor, holes=0)
    ahead = np.abs(np.arctan2(seen.xyz[:, 1], seen.xyz[:, 0])) < 0.5
    seen = replace(seen, xyz=np.where(ahead[:, None], seen.xyz * np.float32(40), seen.xyz))
    drawn = model.image_of(room(sensor, holes=0)).keep(corrupt(model.image_of(room(sensor, holes=0)), recipe))
    assert seen.ring is not None
    sparse = seen[drawn.mask[seen.ring, np.tile(np.arange(sensor.width), sensor.height)]]
    sparse = replace(sparse, ring=None)
    asked, told = model.complete(sparse, steps=steps), complete_scan(model, sparse, how=Filling(steps=steps))
    np.testing.assert_array_equal(asked.range, told.image.range)
    np.testing.assert_array_equal(asked.mask, told.image.mask)
    np.testing.assert_array_equal(rows_of(asked.to_scan()), rows_of(told.points))
    if word != "tiny-gan":  # which knows no reflectance, and what was measured has one
        assert np.isin(rows_of(sparse), rows_of(asked.to_scan())).all(), "bit by bit"
    pixels = pixel_of_points(sparse, sensor, model.experiment.data.projection)
    there = occupied(sparse, sensor, pixels) & ~model.image_of(sparse).mask
    assert there.any()
    assert not asked.mask[there].any(), "nothing stands before a point beyond the limits"


@pytest.mark.parametrize("word", ["tiny", "bilinear", "iln-tiny"])
def test_the_library_upsamples_as_the_command_line_does(word: str):
    model, scan = assemble(preset(word), trained(preset(word))), room(SENSORS["vlp-16"].resized(width=64))
    far = replace(scan, xyz=np.where(scan.xyz[:, :1] > 8, scan.xyz * np.float32(40), scan.xyz))
    asked = model.upsample(far, "vlp-16", steps=1)
    told = upsample_scan(model, far, SENSORS["vlp-16"], Filling(steps=1))
    np.testing.assert_array_equal(asked.range, told.image.range)
    np.testing.assert_array_equal(rows_of(asked.to_scan()), rows_of(told.points))
    assert np.isin(rows_of(far), rows_of(asked.to_scan())).all()


def test_pixels_that_are_not_wanted_are_not_among_the_points(model: LidarModel):
    """Whoever says what is known gets the image's points, not the ones that were hidden."""
    scan = room(model.sensor.resized(width=256))
    half = np.zeros((16, 64), bool)
    half[:, :32] = True
    asked = model.complete(scan, half)
    assert asked.completed is None and len(asked.to_scan()) == asked.mask.sum()
    assert model.complete(scan).keep(half).completed is None


def test_what_would_be_ignored_is_refused(model: LidarModel):
    scan = room(model.sensor)
    for how, said in (
        (Filling("repaint", sampler="nonsense"), "expected a sampler of .*, found 'nonsense'"),
        (Filling("repaint", sampler="langevin"), "for repaint, found 'langevin'"),
        (Filling("posterior", sampler="heun"), "expected no sampler, .* found 'heun'"),
        (Filling("conditional", resamples=3), "expected no resamples, .* found 3"),
        (Filling("conditional", precision="bf16"), "expected precision fp32, .* found 'bf16'"),
    ):
        with pytest.raises(ValueError, match=said):
            model.filled(scan, how)


def test_repaint_takes_the_steps_of_the_sampler_that_is_named(model: LidarModel):
    scan = room(model.sensor)
    ddpm, again, ddim = (model.complete(scan, None, "repaint", 3, 2, s).range for s in (None, "ddpm", "ddim"))
    np.testing.assert_array_equal(ddpm, again)
    assert (ddpm != ddim).any()


# the table


def test_of_a_thinned_scan_only_beams_that_returned_are_hidden_and_judged():
    truth = image(np.array([[10.0] * 8, [0.0] * 8, [20.0, 0.0] * 4, [0.0] * 8]))
    known, judge = hidden_part(truth, "beams:2", 0)
    assert known[0].all() and judge[2].all() and known.sum() == judge.sum() == 8
    known, judge = hidden_part(truth, "points:0.5", 0)
    assert not judge[[1, 3]].any() and not known[[1, 3]].any() and (known | judge)[[0, 2]].all()
    for recipe, found in (("beams:1", "none"), ("sector:360", "every")):
        with pytest.raises(ValueError, match=f"some of the measured pixels, found '{recipe}', which hides {found}"):
            hidden_part(truth, recipe, 0)


def test_errors_are_over_hidden_pixels_with_empty_ones_as_zero():
    truth = image(np.array([[10.0] * 8, [20.0] * 8, [0.0] * 8, [40.0] * 8]))
    known = np.zeros((4, 8), bool)
    known[[0, 3]] = True
    before = truth.keep(known)
    guess = image(np.array([[10.0] * 8, [23.0] * 8, [1.0] * 8, [40.0] * 8]))
    errors = judged(guess, before, known, truth, ~known)
    assert list(errors) == ["lidarsynth", "nearest", "bilinear", "bicubic", "left empty"]
    assert {e.pixels for e in errors.values()} == {16}
    assert errors["lidarsynth"].range_mae == pytest.approx((3 + 1) / 2)
    assert errors["nearest"].range_mae == pytest.approx((10 + 40) / 2)
    assert errors["bilinear"].range_mae == pytest.approx((0 + 30) / 2)
    assert errors["left empty"].range_mae == pytest.approx((20 + 0) / 2)
    assert errors["left empty"].reflectance_mae == pytest.approx(0.25)


def test_a_scan_without_reflectance_is_judged_by_range_alone(model: LidarModel):
    scan = room(SENSORS["hdl-64e-kitti"].resized(width=256))
    errors = complete_scan(model, replace(scan, reflectance=np.zeros(len(scan), np.float32)), "beams:2").errors
    assert all(math.isnan(e.reflectance_mae) and math.isnan(e.reflectance_rmse) for e in errors.values())
    assert all(e.range_mae > 0 for e in errors.values())
    assert not math.isnan(complete_scan(model, scan, "beams:2").errors["nearest"].reflectance_mae)


def test_a_reflectance_that_the_model_gave_is_not_drawn_as_measured(model: LidarModel):
    scan = room(SENSORS["hdl-64e-kitti"].resized(width=256))
    for given in (scan, replace(scan, reflectance=np.zeros(len(scan), np.float32))):
        image = complete_scan(model, given).image
        points = np.where(image.mask[..., None], image.points(), np.float32(0))
        lit = replace(image, xyz=points, reflectance=np.where(image.mask, np.float32(0.5), np.float32(0)))
        assert _measured(model, given, lit, Filling()).reflectance.any() == given.reflectance.any()


def test_interpolation_works_in_metres_and_cuts_overshoots():
    truth = image(np.array([[10.0] * 8, [0.0] * 8, [0.0] * 8, [40.0] * 8]))
    known = np.zeros((4, 8), bool)
    known[[0, 3]] = True
    between = interpolated(truth, known, "bilinear")
    np.testing.assert_allclose(between.range[:, 0], [10, 20, 30, 40], rtol=1e-6)
    step = image(np.array([[0.0] * 8, [0.0] * 8, [0.0] * 8, [40.0] * 8]))
    known[[0, 1, 3]] = True
    curved = interpolated(step, known, "bicubic")
    assert (curved.range >= 0).all() and not curved.mask[0].any()


def test_hidden_pixels_do_not_reach_the_model_or_the_baselines(model: LidarModel):
    scan = room(model.sensor.resized(width=256))
    result = complete_scan(model, scan, "beams:4")
    before, truth = next(iter(result.shown.values())), result.shown["truth"]
    assert before.mask.sum() < truth.mask.sum()
    assert not before.mask[np.arange(16) % 4 != 0].any()
    assert scan.ring is not None
    other = replace(scan, reflectance=np.where(scan.ring % 4 == 0, scan.reflectance, np.float32(0.9)))
    again = complete_scan(model, other, "beams:4")
    np.testing.assert_array_equal(again.image.range, result.image.range)
    assert result.errors["lidarsynth"] == reconstruction_errors(
        result.image, truth, np.broadcast_to(np.arange(16)[:, None] % 4 != 0, (16, 64))
    )


def test_progress_is_told_at_every_step(model: LidarModel):
    calls: list[int] = []
    scan = room(SENSORS["hdl-64e-kitti"].resized(width=256))
    for method in ("conditional", "repaint"):
        calls.clear()
        how = Filling(method, 3, 2 if method == "repaint" else None)
        complete_scan(model, scan, None, how, on_step=lambda: calls.append(1))
        assert len(calls) == model.calls(model.resolved(how))


def test_figures_have_a_row_per_image_and_views(model: LidarModel):
    scan = room(SENSORS["hdl-64e-kitti"].resized(width=256))
    two, three = complete_scan(model, scan).figure(), complete_scan(model, scan, "sector:90").figure()
    assert two.shape[1] == three.shape[1] == 2100
    assert two.dtype == np.uint8 and three.std() > 10


# refusals


def test_refusals_say_both_sides(model: LidarModel):
    scan = room(SENSORS["hdl-64e-kitti"].resized(width=64))
    with pytest.raises(ValueError, match="hides some of the measured pixels, found 'points:1', which hides none"):
        complete_scan(model, scan, "points:1")
    with pytest.raises(ValueError, match="expected points within hdl-64e-kitti/16's view, found none of"):
        complete_scan(model, replace(scan, xyz=scan.xyz * np.float32(0.01)))
    cloud = Scan(np.random.default_rng(0).uniform(-9, 9, (500, 3)).astype(np.float32), np.ones(500, np.float32))
    with pytest.raises(ValueError, match=r"cloud\.ply: .* name the sensor with --from"):
        named_sensor(cloud, Path("cloud.ply"), "--from", None)
    assert named_sensor(cloud, Path("cloud.ply"), "--from", "vlp-16") == SENSORS["vlp-16"]


def test_what_was_written_reads_back_to_the_same_image(model: LidarModel):
    """The file's order of points must not look like other rings than they are."""
    scan = room(SENSORS["hdl-64e-kitti"].resized(width=256))
    points = complete_scan(model, scan).points
    plain = replace(points, ring=None)  # as a .bin holds it
    again, direct = project(plain, model.sensor, "auto"), project(plain, model.sensor, "spherical")
    np.testing.assert_array_equal(again.range, direct.range)
