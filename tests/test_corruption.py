"""Corruptions: the right pixels are known, the same ones for the same seed, and a wrong recipe is named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidarsynth.cli.main import main
from lidarsynth.lidar.corruption import CORRUPTIONS, check_recipe, corrupt
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import get_sensor

SENSOR = get_sensor("hdl-64e-kitti").resized(width=512)


@pytest.fixture
def street() -> RangeImage:
    """A flat road `mount` below the sensor as far as 40 m, and nothing above it."""
    rays = SENSOR.directions()
    distance = np.where(rays[..., 2] < -0.05, -SENSOR.mount / np.minimum(rays[..., 2], -0.05), 0).astype(np.float32)
    mask = (distance > 0) & (distance < 40)
    distance = np.where(mask, distance, np.float32(0))
    return RangeImage(distance, mask * np.float32(0.5), mask, SENSOR)


@pytest.mark.parametrize(("recipe", "rows"), [("beams", range(0, 64, 4)), ("beams:4", range(0, 64, 4)),
                                              ("beams:16:3", range(3, 64, 16)), ("beams:1", range(64)),
                                              ("beams:64:63", [63])])  # fmt: skip
def test_beams_keeps_whole_rows(street, recipe, rows):
    known = corrupt(street, recipe)
    assert known.dtype == bool and known.shape == (64, 512)
    np.testing.assert_array_equal(np.flatnonzero(known.all(axis=1)), list(rows))
    assert known.sum() == len(list(rows)) * 512


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_points_keeps_a_share_of_the_pixels(street, share):
    known = corrupt(street, f"points:{share}")
    deviation = np.sqrt(share * (1 - share) / known.size)
    assert abs(known.mean() - share) <= 5 * deviation
    np.testing.assert_array_equal(known, corrupt(street, f"points:{share}", seed=0))
    assert share == 1 or (known != corrupt(street, f"points:{share}", seed=1)).any()


@pytest.mark.parametrize("degrees", [45, 90, 359, 360])
@pytest.mark.parametrize("centre", [0, 90, 180, -170])
def test_a_sector_is_lost_around_its_centre(street, degrees, centre):
    known = corrupt(street, f"sector:{degrees}:{centre}")
    lost = ~known
    assert (lost == lost[:1]).all(), "the same columns in every row"
    assert abs(lost[0].sum() - degrees / 360 * 512) <= 1
    azimuth = np.degrees(SENSOR.ray_angles()[1, 0])
    away = np.abs(np.angle(np.exp(1j * np.radians(azimuth - centre)), deg=True))
    assert away[lost[0]].max() <= degrees / 2 + 1e-3
    assert degrees == 360 or away[known[0]].min() >= degrees / 2 - 1e-3


def test_the_default_sector_looks_forward(street):
    lost = ~corrupt(street, "sector")[0]
    directions = SENSOR.directions()[0]
    assert (directions[lost, 0] > 0.7).all() and lost.sum() == pytest.approx(128, abs=1)


def test_a_region_loses_the_road_in_the_box(street):
    known = corrupt(street, "region:5:20:-5:5")
    x, y = street.points()[..., 0], street.points()[..., 1]
    inside = street.mask & (x >= 5) & (x <= 20) & (y >= -5) & (y <= 5)
    assert inside.sum() > 100
    assert not known[inside].any()
    clearly_outside = street.mask & ((x < 4.5) | (x > 21) | (np.abs(y) > 5.5))
    assert known[clearly_outside].all()
    assert known[: 64 // 8].all(), "rays above the horizon never cross the road"


def test_a_region_hides_what_stands_in_it_and_what_it_hid(street):
    """A car in the box, seen by rays that would reach the road behind it, and the hole of its missing returns."""
    row, columns = 20, slice(250, 262)  # ahead
    distance = street.range.copy()
    distance[row, columns] = 10
    car = replace(street, range=distance)
    assert not corrupt(car, "region:5:20:-5:5")[row, columns].any()
    mask = street.mask.copy()
    mask[40, columns] = False
    empty = replace(street, mask=mask, range=np.where(mask, street.range, np.float32(0)))
    lost = ~corrupt(street, "region:5:20:-5:5")
    np.testing.assert_array_equal(~corrupt(empty, "region:5:20:-5:5")[40], lost[40])


def test_several_corruptions_apply_together(street):
    together = corrupt(street, "beams:4 + sector:90:180+points:0.5", seed=3)
    assert not (together & ~corrupt(street, "beams:4")).any()
    assert not (together & ~corrupt(street, "sector:90:180")).any()
    rows = corrupt(street, "beams:4") & corrupt(street, "sector:90:180")
    assert together[rows].mean() == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize(
    ("recipe", "message"),
    [
        ("", r"expected a corruption of beams, points, sector, region, found '' in ''"),
        ("rows:4", r"expected a corruption of beams, .* found 'rows' in 'rows:4'"),
        ("beams:4+", r"found '' in 'beams:4\+'"),
        ("beams:four", r"beams expects numbers after the colon, found 'beams:four'"),
        ("beams:", r"beams expects numbers after the colon, found 'beams:'"),
        ("beams:0", r"beams expects whole numbers EVERY in 1..64 and FIRST below it, found 0:0"),
        ("beams:65", r"found 65:0"),
        ("beams:2.5", r"found 2.5:0"),
        ("beams:4:4", r"found 4:4"),
        ("beams:4:-1", r"found 4:-1"),
        ("beams:4:1:9", r"beams expects at most 2 numbers, found 3 in 'beams:4:1:9'"),
        ("points:0", r"points expects the known share in \(0, 1\], found 0"),
        ("points:1.5", r"points expects the known share in \(0, 1\], found 1.5"),
        ("points:nan", r"points expects finite numbers, found 'points:nan'"),
        ("sector:0", r"sector expects a width in \(0, 360\] degrees, found 0"),
        ("sector:361", r"sector expects a width in \(0, 360\] degrees, found 361"),
        ("region:20:5", r"region expects X_MIN < X_MAX and Y_MIN < Y_MAX, found 20:5:-5:5"),
        ("region:0:1:2:3:4", r"region expects at most 4 numbers, found 5"),
    ],
)
def test_recipes_that_make_no_sense_are_named(street, recipe, message):
    with pytest.raises(ValueError, match=message):
        corrupt(street, recipe)


@pytest.mark.parametrize("recipe", ["beams:nan", "beams:inf", "beams:4:nan", "sector:90:nan", "region:nan:5:0:1"])
def test_numbers_that_are_none_are_refused(street, recipe):
    with pytest.raises(ValueError, match=rf"{recipe.split(':')[0]} expects .* found"):
        corrupt(street, recipe)


def test_every_corruption_has_defaults_that_leave_and_lose_pixels(street):
    for name in CORRUPTIONS:
        known = corrupt(street, name)
        assert 0 < known.sum() < known.size, name


def test_a_recipe_is_checked_before_any_scan_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """One line of the whole folder, not one of each scan."""
    for i in range(3):
        (tmp_path / f"{i}.bin").write_bytes(b"not read")
    with pytest.raises(SystemExit, match="2"):
        main(["complete", str(tmp_path), "--corrupt", "beams:4+rain", "--out", str(tmp_path / "o")])
    said = capsys.readouterr().err
    assert (
        said == "lidarsynth: expected a corruption of beams, points, sector, region, found 'rain' in 'beams:4+rain'\n"
    )
    assert not (tmp_path / "o").exists()
    assert check_recipe("beams:4 + sector:90:180") == [("beams", [4.0]), ("sector", [90.0, 180.0])]
