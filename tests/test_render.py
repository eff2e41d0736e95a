"""Pictures: known values get known colours at known pixels; anything, even nothing, gives a picture."""

import os
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image, ImageDraw

from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sector import runs_outside
from lidarsynth.lidar.semantic_kitti import CLASSES
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.pictures.colours import (
    NEAREST,
    TURBO,
    VIRIDIS,
    height_colours,
    label_colours,
    point_colours,
    range_colours,
    reflectance_colours,
    turbo,
)
from lidarsynth.pictures.figure import PAPER, class_legend, colour_bar, compare, panel
from lidarsynth.pictures.learned import learned_figure
from lidarsynth.pictures.perspective import Camera, perspective
from lidarsynth.pictures.portrait import _ahead as portrait_from_above
from lidarsynth.pictures.portrait import before_and_after, portrait, strips
from lidarsynth.pictures.render import (
    BACKGROUNDS,
    EMPTY,
    bev,
    label_strip,
    range_strip,
    reflectance_strip,
    save_png,
)

SMALL = Sensor("small", (2.0, 0.0, -5.0, -15.0), 32, 1.0, 50.0)


def one_point(x: float, y: float, z: float = 0.0) -> Scan:
    return Scan(np.array([[x, y, z]], np.float32), np.array([0.5], np.float32), label=np.array([1]))


def no_points() -> Scan:
    return Scan(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), label=np.zeros(0, int))


def small_image(seed: int = 0) -> RangeImage:
    generator = np.random.default_rng(seed)
    distance = generator.uniform(2, 50, (4, 32)).astype(np.float32)
    mask = generator.random((4, 32)) < 0.8
    reflectance = generator.random((4, 32), dtype=np.float32)
    label = np.where(mask, generator.integers(0, 20, (4, 32)), 0)
    return RangeImage(np.where(mask, distance, np.float32(0)), reflectance, mask, SMALL, label)


def street(points: int = 100_000) -> Scan:
    """A road of all rings and two walls."""
    generator = np.random.default_rng(0)
    x, y = generator.uniform(-60, 60, points), generator.uniform(-12, 12, points)
    wall = generator.random(points) < 0.4
    y, z = np.where(wall, np.sign(y) * 12, y), np.where(wall, generator.uniform(-1.7, 3, points), -1.7)
    return Scan(np.stack([x, y, z], -1).astype(np.float32), generator.random(points, dtype=np.float32))


def drawn(picture: np.ndarray, background: str) -> tuple[float, float]:
    """Column and row of the middle of everything that is not background."""
    rows, columns = np.nonzero(np.any(picture != BACKGROUNDS[background], axis=-1))
    return float(columns.mean()), float(rows.mean())


def test_ramps_pass_through_their_anchors_and_clip():
    np.testing.assert_allclose(turbo(np.linspace(0, 1, 17)).astype(int), TURBO, atol=1)
    np.testing.assert_array_equal(turbo([-3, 2, np.nan]), turbo([0, 1, 0]))
    np.testing.assert_array_equal(reflectance_colours([0, 1]), VIRIDIS[[0, -1]])


def test_near_is_warm_and_far_is_cold():
    near, far = range_colours([NEAREST, 80.0], 80.0).astype(int)
    assert near[0] > 150 > 60 > near[2]
    assert far[2] > far[0]
    blueness = range_colours(np.geomspace(3, 80, 40))[:, 2].astype(int) - range_colours(np.geomspace(3, 80, 40))[:, 0]
    assert blueness[-8:].min() > blueness[:8].max()


def test_classes_have_the_colours_of_semantickitti():
    assert len(CLASSES) == 20
    np.testing.assert_array_equal(label_colours([[9, 1]]), [[(255, 0, 255), (100, 150, 245)]])
    with pytest.raises(ValueError, match=r"0-19, got 3 to 20"):
        label_colours(np.array([3, 20]))


def test_point_colours_by_each_word():
    scan = one_point(3.0, 4.0, -1.0)
    np.testing.assert_array_equal(point_colours(scan, "height"), height_colours([-1.0]))
    np.testing.assert_array_equal(point_colours(scan, "range"), range_colours([np.sqrt(26.0)]))
    np.testing.assert_array_equal(point_colours(scan, "reflectance"), reflectance_colours([0.5]))
    np.testing.assert_array_equal(point_colours(scan, "label"), [CLASSES[1][1]])
    with pytest.raises(ValueError, match=r"height, range, reflectance, label, found 'speed'"):
        point_colours(scan, "speed")
    with pytest.raises(ValueError, match="needs a scan with labels"):
        point_colours(Scan(scan.xyz, scan.reflectance), "label")


def test_strips_colour_measured_pixels_and_leave_the_others_dark():
    image = small_image()
    for strip, colours in (
        (range_strip(image), range_colours(image.range, SMALL.max_range)),
        (reflectance_strip(image), reflectance_colours(image.reflectance)),
        (label_strip(image), label_colours(image.label)),
    ):
        assert strip.shape == (12, 32, 3) and strip.dtype == np.uint8
        np.testing.assert_array_equal(strip[1::3][image.mask], colours[image.mask])
        assert np.all(strip[2::3][~image.mask] == EMPTY)
    assert range_strip(image, max_range=10.0, row_scale=1).shape == (4, 32, 3)


def test_strips_say_what_is_wrong():
    image = small_image()
    bare = RangeImage(image.range, image.reflectance, image.mask, SMALL)
    with pytest.raises(ValueError, match="image with labels"):
        label_strip(bare)
    with pytest.raises(ValueError, match="whole number from 1, got 0"):
        range_strip(image, row_scale=0)


@pytest.mark.parametrize(
    ("x", "y", "column", "row"), [(20, 0, 100, 50), (0, 20, 50, 100), (-20, 0, 100, 150), (0, -20, 150, 100)]
)
def test_bev_has_forward_up_and_left_left(x: float, y: float, column: int, row: int):
    empty = bev(no_points(), size=200, rings=0)
    differs = np.any(bev(one_point(x, y), size=200, rings=0) != empty, axis=-1)
    rows, columns = np.nonzero(differs)
    assert abs(columns.mean() - column) <= 1 and abs(rows.mean() - row) <= 1
    assert len(rows) <= 9


def test_bev_leaves_out_what_is_outside_and_draws_rings():
    empty = bev(no_points(), size=200)
    np.testing.assert_array_equal(bev(one_point(41, 0), size=200), empty)
    assert np.any(empty[50, 100] != BACKGROUNDS["dark"])  # the ring at 20 m
    with pytest.raises(ValueError, match="must be positive, got 0 metres"):
        bev(no_points(), extent=0)
    with pytest.raises(ValueError, match="background of dark, white, found 'pink'"):
        bev(no_points(), background="pink")


@pytest.mark.parametrize("right", [False, True])
def test_distances_from_above_can_be_read_wherever_forward_is(right: bool):
    picture = bev(no_points(), background="white", rings=30.0, right=right).astype(int)
    text = (picture < 200).all(-1)
    text[380:420, 380:420] = False  # the arrow
    rows, columns = (np.flatnonzero(text.any(axis)) for axis in (1, 0))
    assert len(columns) and np.ptp(columns) > 1.5 * np.ptp(rows), "a line of text is wide"
    where = (800 - rows.mean()) if not right else columns.mean()
    assert where == pytest.approx(400 + 30 / 40 * 400, abs=30)
    forward = bev(one_point(15, 0), background="white", rings=0, right=right) != bev(
        no_points(), background="white", rings=0, right=right
    )
    assert np.argwhere(forward.any(-1)).mean(0) == pytest.approx([400, 550] if right else [250, 400], abs=1)


def test_the_view_from_above_in_a_picture_has_readable_distances():
    picture = portrait_from_above(no_points(), 640).astype(int)
    text = (picture < 200).all(-1)
    text[150:210, 290:350] = False
    columns = np.flatnonzero(text.any(0))
    rows = np.flatnonzero(text[:, columns[-1] - 25 :].any(1))  # of the outermost
    assert np.ptp(rows) < 15


def test_camera_looks_at_its_target_with_left_on_the_left():
    camera = Camera(azimuth=180, elevation=0, distance=10, target=(5, 0, 0), field=90)
    pixel, depth = camera.project(np.array([[5, 0, 0], [5, 5, 0], [5, 0, 5], [15, 0, 0]], np.float32), (200, 100))
    np.testing.assert_allclose(depth, [10, 10, 10, 20], atol=1e-5)
    np.testing.assert_allclose(pixel, [[100, 50], [50, 50], [100, 0], [100, 50]], atol=1e-4)
    with pytest.raises(ValueError, match=r"elevation in \(-90, 90\)"):
        Camera(elevation=90)


def test_camera_above_sees_forward_up():
    pixel, _ = Camera(180, 89.9, 30, (0, 0, 0)).project(np.array([[3, 0, 0], [0, 3, 0]], np.float32), (100, 100))
    assert pixel[0, 1] < 45 and pixel[1, 0] < 45


@pytest.mark.parametrize("background", sorted(BACKGROUNDS))
def test_perspective_draws_a_point_at_its_pixel(background: str):
    camera, scan = Camera(azimuth=150, elevation=20, distance=20), one_point(8, -2, 1)
    picture = perspective(scan, camera, (320, 180), background=background, diameter=0.3)
    expected = camera.project(scan.xyz, (320, 180))[0][0]
    np.testing.assert_allclose(np.array(drawn(picture, background)) + 0.5, expected, atol=0.75)


def test_perspective_shows_the_nearer_of_two_points_whatever_their_order():
    camera = Camera(azimuth=180, elevation=0, distance=10, target=(0, 0, 0))
    pair = Scan(np.array([[0, 0, 0], [4, 0, 0]], np.float32), np.zeros(2, np.float32), label=np.array([1, 19]))
    pictures = [perspective(s, camera, (600, 360), "label", "dark", 1.0) for s in (pair, pair[::-1])]
    np.testing.assert_array_equal(*pictures)
    np.testing.assert_array_equal(pictures[0][180, 300], CLASSES[1][1])


def test_eye_dome_lighting_darkens_only_what_lies_behind_an_edge():
    scan, camera = street(), Camera(azimuth=120)
    lit, flat = (perspective(scan, camera, (320, 180), background="dark", shading=s).astype(int) for s in (1.0, 0.0))
    assert np.all(lit <= flat)
    assert 0.02 < np.mean(np.any(lit < flat, axis=-1)) < 0.9


def test_points_behind_the_camera_and_nan_are_left_out():
    away = np.array([[-100, 0, 0], [np.nan, 0, 0], [np.inf, 1, 0]], np.float32)
    scan = Scan(away, np.zeros(3, np.float32))
    camera = Camera(azimuth=180, elevation=5, distance=10)
    assert np.all(perspective(scan, camera, (64, 36)) == BACKGROUNDS["white"])
    np.testing.assert_array_equal(bev(scan, size=64), bev(no_points(), size=64))


@pytest.mark.parametrize("by", ["height", "range", "reflectance", "label"])
def test_nothing_gives_a_picture(by: str):
    assert perspective(no_points(), size=(64, 36), by=by).shape == (36, 64, 3)
    assert bev(no_points(), by=by, size=64).shape == (64, 64, 3)
    zero = np.zeros((4, 32), np.float32)
    blank = RangeImage(zero, zero, zero > 0, SMALL, zero.astype(int))
    assert np.all(range_strip(blank) == EMPTY) and np.all(label_strip(blank) == EMPTY)
    assert compare({"nothing": blank}).dtype == np.uint8
    assert perspective(blank, size=(64, 36), by=by).shape == (36, 64, 3)


def test_pictures_are_deterministic_and_independent_of_point_order():
    scan = street(5_000)
    shuffled = scan[np.random.default_rng(1).permutation(len(scan))]
    np.testing.assert_array_equal(perspective(scan, size=(160, 90)), perspective(shuffled, size=(160, 90)))
    np.testing.assert_array_equal(bev(scan, size=100), bev(shuffled, size=100))


def test_a_large_scan_is_drawn_in_bounded_time():
    scan, started = street(), time.process_time()
    perspective(scan)
    bev(scan)
    assert time.process_time() - started < 4.0  # 0.6 s on an idle core


def test_panel_gives_every_row_one_width_and_a_title_more_height():
    red, wide = np.full((20, 30, 3), (255, 0, 0), np.uint8), np.zeros((10, 200, 3), np.uint8)
    figure = panel([[("a", wide)], [("b", red), ("c", red)]])
    assert figure.shape[1] == 200 + 40
    assert panel([[("a", wide)], [("b", red), ("c", red)]], "title").shape[0] > figure.shape[0]
    reds = np.all(np.abs(figure.astype(int) - (255, 0, 0)) < 3, axis=-1)
    assert np.count_nonzero(reds.any(axis=0)) == 200 - 12  # both pictures fill the row but for the gap
    assert panel([[("", red)]], width=60).shape == (40 + 40, 60 + 40, 3)
    assert panel([[("a caption that is far too long for its picture", red)]]).shape[1] == 30 + 40


def test_panel_says_what_is_wrong():
    with pytest.raises(ValueError, match=r"at least one picture in every row, got rows of \[1, 0\]"):
        panel([[("a", np.zeros((2, 2, 3), np.uint8))], []])
    with pytest.raises(ValueError, match=r"'a' must be \(H, W, 3\) uint8, got \(2, 2\) float64"):
        panel([[("a", np.zeros((2, 2)))]])
    with pytest.raises(ValueError, match="at least one image, got none"):
        compare({})


def test_compare_holds_the_strips_of_every_image():
    before, after = small_image(0), small_image(1)
    figure = compare({"before": before, "after": after}, "title", row_scale=3)
    for strip in (range_strip(before), reflectance_strip(after)):
        windows = np.lib.stride_tricks.sliding_window_view(figure[:, 20 : 20 + 32], 12, axis=0)
        assert np.any(np.all(np.moveaxis(windows, -1, 1) == strip, axis=(1, 2, 3)))


@pytest.mark.parametrize("by", ["range", "reflectance"])
def test_colour_bars(by: str):
    bar = colour_bar(by, width=300, max_range=SENSORS["hdl-64e"].max_range)
    assert bar.shape[1] == 300
    ends = {"range": range_colours([NEAREST, 80.0]), "reflectance": reflectance_colours([0, 1])}[by]
    np.testing.assert_allclose(bar[0, [0, -1]].astype(int), ends, atol=2)
    with pytest.raises(ValueError, match="range, reflectance, found 'speed'"):
        colour_bar("speed")


def test_save_png_round_trips_and_is_whole_or_not_at_all(tmp_path, monkeypatch: pytest.MonkeyPatch):
    picture = range_strip(small_image())
    path = save_png(tmp_path / "strip.png", picture)
    np.testing.assert_array_equal(np.asarray(Image.open(path)), picture)
    with Image.open(path) as opened:
        assert opened.info == {"Software": "lidarsynth"}
    before = path.read_bytes()

    def full_disk(*args: object, **options: object):
        raise OSError("No space left on device")

    monkeypatch.setattr(os, "replace", full_disk)
    with pytest.raises(OSError, match="No space left"):
        save_png(path, bev(no_points(), size=64))
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["strip.png"]
    with pytest.raises(ValueError, match=r"\(H, W, 3\) uint8 with pixels, got \(2, 2, 4\) uint8"):
        save_png(path, np.zeros((2, 2, 4), np.uint8))


def colours_of(picture: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(colour) for colour in np.unique(picture.reshape(-1, 3), axis=0).tolist()}


def test_a_legend_has_the_classes_that_occur_in_as_many_lines_as_they_take():
    image = small_image()
    every = replace(image, label=np.arange(128).reshape(4, 32) % 20, mask=np.ones((4, 32), bool), range=image.range + 1)
    for width in (1024, 300, 40):
        legend = class_legend([every], width)
        assert legend.shape[1] == width and colours_of(label_colours(np.arange(20))) <= colours_of(legend)
    lines = [len(class_legend([every], width)) / (2 * size) for width, size in ((1024, 16), (500, 12), (300, 12))]
    assert lines[0] == 2 and lines == sorted(set(lines)), "and not one that is cut"
    cars = replace(every, label=np.where(np.arange(32) < 9, 1, 9) * np.ones((4, 1), int), mask=image.mask)
    cars.mask[:, :9] = False
    shown = colours_of(class_legend([cars], 500))
    assert tuple(label_colours(9).tolist()) in shown and tuple(label_colours(1).tolist()) not in shown
    assert colours_of(class_legend([replace(every, label=None)], 500)) == {PAPER}


def test_the_portrait_of_a_labelled_scan_has_a_legend():
    image = small_image()
    with_classes, without = portrait(image), portrait(replace(image, label=None))
    legend = class_legend([image], 1024)
    assert any(
        np.array_equal(with_classes[row : row + len(legend), 20:-20], legend) for row in range(len(with_classes))
    )
    assert len(with_classes) > len(without) + len(legend)


def test_a_reflectance_that_nobody_gave_is_not_drawn_as_if_it_were_dark():
    image = small_image()
    dark = replace(image, reflectance=np.zeros_like(image.reflectance))
    drawn, lit = (before_and_after({"simulated": one, "real": image}, {}) for one in (dark, image))
    black = tuple(reflectance_colours(0.0).tolist())
    right = slice(drawn.shape[1] // 2, None)
    above, strips = drawn[: drawn.shape[0] // 6, right], lit[: lit.shape[0] // 6, right]
    assert colours_of(strips) - colours_of(above), "of the first row"
    assert (above == np.array(black)).all(-1).sum() == 0 and drawn.shape == lit.shape


def test_a_portrait_says_where_there_is_no_reflectance():
    image = replace(small_image(), label=None)
    dark, black = replace(image, reflectance=np.zeros_like(image.reflectance)), reflectance_colours(0.0)
    assert (portrait(dark) == black).all(-1).sum() == 0, "it is not drawn as if it were dark"
    assert portrait(dark).shape == portrait(image).shape


@pytest.mark.parametrize(("view", "columns"), [
    ([-60, 60], [*range(11, 21)]), ([120, 240], [*range(27, 32), *range(5)]), ([-170, 170], [*range(32)])])  # fmt: skip
def test_strips_of_a_sector_are_of_what_the_sensor_sees(view: list[int], columns: list[int]):
    """Also of one that looks back, over the seam; a narrow gap, as behind a mast, is drawn."""
    image = replace(small_image(), sensor=replace(SMALL, blocked=runs_outside(view, 4, 32, "mine")))
    mask = ~image.sensor.blocked_rays()
    image = replace(image, mask=mask, range=np.where(mask, 2.0 + np.arange(32), 0).astype(np.float32))
    wide = round(1024 / len(columns))
    for strip, whole in zip(
        strips(image, 50.0), (range_strip(image, 50.0, 48), reflectance_strip(image, 48)), strict=True
    ):
        np.testing.assert_array_equal(strip, np.repeat(whole[:, columns], wide, axis=1))


@pytest.mark.parametrize("word", ["vlp-16", "hdl-64e-kitti", "os1-128"])
def test_the_picture_of_a_sensor_has_whole_round_ticks(word: str, monkeypatch: pytest.MonkeyPatch):
    sensor, ticks = SENSORS[word], []
    draw = ImageDraw.ImageDraw.text

    def told(self, xy, text, *more, **options):
        if text.lstrip("+-").isdecimal():
            ticks.append(
                (int(text), xy[1], self.textbbox(xy, text, font=options.get("font"), anchor=options.get("anchor")))
            )
        return draw(self, xy, text, *more, **options)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", told)
    rings = [SimpleNamespace(residual=0.01)] * sensor.height
    shares = np.ones((sensor.height, sensor.width))
    learned_figure(SimpleNamespace(sensor=sensor, scans=3, returned=shares, rings=rings))  # type: ignore[arg-type]
    degrees, places, boxes = zip(*ticks, strict=True)
    (step,) = set(np.diff(degrees).tolist())
    assert step in (1, 2, 5, 10, 20) and all(number % step == 0 for number in degrees)
    assert len(ticks) >= 3 and all(box[1] >= 0 and box[3] <= 480 for box in boxes), "none is cut"
    assert np.ptp(np.diff(places) / np.diff(degrees)) < 1e-6
