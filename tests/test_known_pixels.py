"""What a completion of an image looks at: pixels that are known, and nothing else, whatever stands there."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from networks import tiny_cascade

import lidarsynth as ls
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.filling import Filling

BLOCKED = Sensor("blocked", tuple(np.linspace(5, -25, 24).tolist()), 256, 0.5, 120.0, mount=1.8,
                 blocked=((22, 10, 60), (23, 200, 230)))  # fmt: skip
METHODS = {
    "conditional": {},
    "sample": {},
    "repaint": {"steps": 2, "resamples": 1},
}


@pytest.fixture(scope="module")
def model() -> CascadeModel:
    return tiny_cascade(BLOCKED)


@pytest.fixture(scope="module")
def image() -> RangeImage:
    """Measured nearly everywhere, on rays that are said to be blocked too."""
    rng = np.random.default_rng(0)
    mask = rng.random((24, 256)) < 0.9
    distance = (rng.uniform(2, 60, mask.shape) * mask).astype(np.float32)
    return RangeImage(distance, (rng.random(mask.shape) * mask).astype(np.float32), mask, BLOCKED)


def beams(every: int) -> np.ndarray:
    known = np.zeros((24, 256), bool)
    known[::every] = True
    return known


def assert_same(one: RangeImage, other: RangeImage) -> None:
    for name in ("range", "reflectance", "mask", "confidence"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)


@pytest.mark.parametrize("method", METHODS)
def test_what_is_not_known_does_not_change_the_answer(model: CascadeModel, image: RangeImage, method: str):
    known = beams(4)
    ask = {"method": method, **METHODS[method]}
    assert_same(model.complete(image, known, **ask), model.complete(image.keep(known), known, **ask))
    how = model.resolved(Filling(**ask))
    assert_same(model.fill(image, known, how), model.fill(image.keep(known), known, how))


def test_doubts_are_of_what_is_known_alone(model: CascadeModel, image: RangeImage):
    known = beams(4)
    torch.testing.assert_close(model.doubts(image, known), model.doubts(image.keep(known), known), atol=0, rtol=0)


@pytest.mark.parametrize("word", ["cascade", "bilinear", "nearest"])
def test_what_stands_where_nothing_returned_is_never_seen(model: CascadeModel, image: RangeImage, word: str):
    rng, filler = np.random.default_rng(1), model if word == "cascade" else ls.load(word)
    some = image.keep(rng.random(image.shape) < 0.3)
    for garbage in (7.0, np.nan, np.inf):
        distance, shade = (np.where(some.mask, v, np.float32(garbage)) for v in (some.range, some.reflectance))
        spoilt = replace(some, range=distance, reflectance=shade)
        assert_same(filler.complete(spoilt), filler.complete(some))
        known = some.mask | beams(4)  # empty ones are known to be empty
        assert_same(filler.complete(spoilt, known), filler.complete(some, known))


@pytest.mark.parametrize("word", ["cascade", "bilinear", "kitti-streets"])
def test_known_pixels_may_be_a_turned_view_or_read_only(model: CascadeModel, image: RangeImage, word: str):
    filler = model if word == "cascade" else ls.load(word)
    if word == "kitti-streets":
        tall, wide = filler.sensor.height // 8, filler.sensor.width // 256
        parts = (np.tile(part[:8], (tall, wide)) for part in (image.range, image.reflectance, image.mask))
        image = RangeImage(*parts, filler.sensor)
    known = np.random.default_rng(0).random(image.shape) < 0.3
    turned, frozen = known[:, ::-1].copy()[:, ::-1], known.copy()
    frozen.flags.writeable = False
    expected = filler.complete(image, known)
    torch.set_warn_always(True)
    try:
        for given in (turned, frozen):
            np.testing.assert_array_equal(filler.complete(image, given).range, expected.range)
    finally:
        torch.set_warn_always(False)


def test_where_nothing_is_known_nothing_is_filled(model: CascadeModel, image: RangeImage):
    nothing = np.zeros(image.shape, bool)
    for given, known in ((image, nothing), (image.keep(nothing), None), (image.keep(nothing), ~nothing)):
        count = int(given.mask.sum())
        with pytest.raises(ValueError, match=f"expected points within blocked's view, found none of {count} points"):
            model.complete(given, known)


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_device_that_is_not_here_is_named_as_where_a_model_is_loaded(model: CascadeModel):
    said = []
    for ask in (lambda: model.to("cuda"), lambda: ls.load("default", device="cuda"), lambda: model.to("gpu")):
        with pytest.raises(ValueError, match="expected a device of torch, such as cpu or cuda, found") as refused:
            ask()
        said.append(str(refused.value))
    assert said[0] == said[1] and not any("\n" in line for line in said)
    assert model.to("cpu") is model
