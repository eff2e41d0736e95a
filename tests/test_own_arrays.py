"""What a generator of the user's own makes, as arrays: judged as its files are, one at a time, or refused."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from weakref import WeakSet

import numpy as np
import pytest
import torch
from test_evaluate import REAL, STREETS, saved
from test_readme import street

import lidarsynth as ls
from lidarsynth.lidar.depth import from_x_0, to_x_0

SENSOR = STREETS[0].sensor


def published(image: ls.RangeImage) -> np.ndarray:
    """(5, H, W), as R2DM's program saves."""
    return np.stack([image.range, *np.moveaxis(image.points(), -1, 0), image.reflectance])


def points(image: ls.RangeImage) -> np.ndarray:
    """(N, 4)"""
    return np.column_stack([image.to_scan().xyz, image.to_scan().reflectance])


class Asked:
    """A data set that makes each image when asked for it."""

    def __init__(self, images: list[ls.RangeImage], times: int = 1):
        self.images, self.times, self.most = images, times, 0
        self.held: WeakSet[ls.RangeImage] = WeakSet()

    def __len__(self) -> int:
        return len(self.images) * self.times

    def __getitem__(self, i: int) -> ls.RangeImage:
        image = replace(self.images[i % len(self.images)])
        self.held.add(image)
        self.most = max(self.most, len(self.held))
        return image


FORMS: dict[str, Callable[[list[ls.RangeImage]], Any]] = {
    "a data set": Asked,
    "a tuple": tuple,
    "one stacked array": lambda images: np.stack([published(image) for image in images]),
    "one stacked tensor": lambda images: torch.from_numpy(np.stack([published(image) for image in images])),
    "tensors that learn": lambda images: [torch.from_numpy(published(image)).requires_grad_() for image in images],
    "x_0": lambda images: [from_x_0(to_x_0(image).numpy(), SENSOR) for image in images],
    "scans": lambda images: [image.to_scan() for image in images],
    "arrays of points": lambda images: [points(image) for image in images],
    "tensors of points": lambda images: [torch.from_numpy(points(image)) for image in images],
}
POINTS = [form for form in FORMS if "points" in form or form == "scans"]


@pytest.mark.parametrize("form", FORMS)
def test_every_form_is_judged_as_its_files_are(form: str, tmp_path: Path):
    files = STREETS if form not in POINTS else saved(tmp_path / "files", STREETS, "ply")
    expected, found = (ls.evaluate(given, REAL).values for given in (files, FORMS[form](STREETS)))
    assert found == pytest.approx(expected, rel=1e-3)
    expected, found = (ls.evaluate(REAL, given, sensor=SENSOR).values for given in (files, FORMS[form](STREETS)))
    assert found == pytest.approx(expected, rel=1e-3)


def test_a_data_set_is_held_one_batch_at_a_time():
    samples = Asked(STREETS, times=8)
    assert ls.evaluate(samples, REAL, batch_size=4).counts["samples"] == 48
    assert samples.most <= 9, "a batch, and the one that is made before it goes"


def brighter(image: ls.RangeImage) -> ls.RangeImage:
    return replace(image, reflectance=255 * image.reflectance)


REFUSED = {  # what is found -> images that are so
    "a reflectance of 0 to 1, found 0 to": [brighter(STREETS[0])],
    "a reflectance of 0 to 1 in the fourth column, found 0": [points(STREETS[0]) * [1, 1, 1, 255]],
    r"metres from the sensor, found half of the points \d+": [points(STREETS[0]) * [1000, 1000, 1000, 1]],
    "finite points, found NaN": [points(STREETS[0]) * np.nan],
    r"points of \(N, 3\) .*, found \(64, 64\)": [STREETS[0].range],
    r"found -1 to .*\(lidar.depth.from_x_0 takes -1 to 1\)": np.stack([to_x_0(STREETS[0]).numpy()]),
}


@pytest.mark.parametrize("found", REFUSED)
def test_other_scales_and_shapes_are_refused_by_number(found: str):
    with pytest.raises(ValueError, match=f"^image 0: expected .*{found}"):
        ls.evaluate(REFUSED[found], REAL)


def test_a_list_of_files_is_refused():
    with pytest.raises(ValueError, match=r"expected one folder or file of images, .*, found a.bin, b.bin$"):
        ls.evaluate(["a.bin", "b.bin"], REAL)


def test_a_reflectance_that_overshoots_is_clipped():
    over = [replace(image, reflectance=np.where(image.mask, 1.04, 0)) for image in STREETS]
    one = [replace(image, reflectance=np.where(image.mask, 1.0, 0)) for image in STREETS]
    assert ls.evaluate(over, REAL).hashes["samples"] == ls.evaluate(one, REAL).hashes["samples"]


@pytest.mark.parametrize("given", [(image for image in STREETS), {0: STREETS[0]}, STREETS[0].to_scan(), STREETS[0]])
def test_what_is_no_set_is_refused(given: Any):
    with pytest.raises(ValueError, match="expected a folder, files or a list of range images, found a"):
        ls.evaluate(given, REAL)


def told(samples: Any, words: str) -> list[str]:
    return [note for note in ls.evaluate(samples, REAL).warnings if words in note]


def test_rows_from_below_are_told():
    assert told([replace(image, range=image.range[::-1], mask=image.mask[::-1]) for image in STREETS], "row 0 is the")
    assert not told(STREETS, "row 0 is the")


def test_ranges_beyond_the_limits_of_their_sensor_are_told():
    for scale in (0.1, 5):
        assert told([replace(image, range=scale * image.range) for image in STREETS], "outside 1.45 to 80 m")
    assert not told(STREETS, "the limits of")


def test_points_in_another_frame_are_told():
    xyz = street("hdl-64e-kitti").to_scan().xyz
    assert told([xyz[:, [1, 2, 0]]], "y up instead of z") and not told([xyz], "sensor's frame")


def test_points_that_are_shares_of_a_limit_are_told_and_say_why_rows_are_none():
    report = ls.evaluate([points(image) / [80, 80, 80, 1] for image in STREETS], REAL)
    assert any("expected metres, not shares of a limit" in note for note in report.warnings)
    for result in report.results[:2]:
        assert result.value is None and result.reason == "no point of the samples lies within the bird's eye gate"


def test_points_of_fewer_columns_than_the_images_they_are_drawn_into_are_told():
    """Half of the columns would be empty, which no other number than an FRD that is too large says."""
    half = SENSOR.resized(width=SENSOR.width // 2)
    narrow = [ls.RangeImage(i.range[:, 1::2], i.reflectance[:, 1::2], i.mask[:, 1::2], half) for i in STREETS]
    clouds = [points(image) for image in narrow]
    assert told(clouds, "points of samples leave columns empty")
    for given in (narrow, [points(image) for image in STREETS]):
        assert not told(given, "columns empty")
