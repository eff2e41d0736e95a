"""What training takes away from streets: returns alone, in every way, and never most of them."""

import numpy as np
import pytest

from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import with_fields
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.streets.virtual import VirtualStreets
from lidarsynth.systems.cascade import examples
from lidarsynth.systems.cascade.losing import MOST, WAYS, losing


@pytest.fixture(scope="module")
def streets() -> list[RangeImage]:
    reader = VirtualStreets(31, 1000)
    return [reader.image(16 * k) for k in range(4)]


def test_returns_are_lost_and_all_else_stays(streets: list[RangeImage]):
    shares = []
    for seed in range(40):
        image = streets[seed % len(streets)]
        worse = losing(image, np.random.default_rng(seed))
        assert worse.range.dtype == worse.reflectance.dtype == np.float32
        assert not (worse.mask & ~image.mask).any()
        assert (worse.range == np.where(worse.mask, image.range, 0)).all()
        assert (worse.reflectance == np.where(worse.mask, image.reflectance, 0)).all()
        assert worse.surface is image.surface and worse.label is image.label and worse.sensor == image.sensor
        shares.append(1 - worse.mask.sum() / image.mask.sum())
        again = losing(image, np.random.default_rng(seed))
        assert (again.mask == worse.mask).all()
    assert 0.02 < np.median(shares) < 0.2 and 0.2 < max(shares) < MOST


@pytest.mark.parametrize("way", [way for _, way in WAYS])
def test_each_way_takes_some_at_times_and_copes_with_nothing(way, streets: list[RangeImage]):
    taken = [way(streets[k % 4], np.random.default_rng(k)) & streets[k % 4].mask for k in range(24)]
    assert all(lost.shape == streets[k % 4].shape and lost.dtype == bool for k, lost in enumerate(taken))
    assert 0 < np.mean([lost.mean() for lost in taken]) < 0.5
    blank = np.zeros(streets[0].shape, np.float32)
    empty = RangeImage(blank, blank, blank > 0, streets[0].sensor)
    assert not (way(empty, np.random.default_rng(0)) & empty.mask).any()


def test_dashes_lie_along_rings_and_bands_are_of_beams():
    ways = {way.__name__: way for _, way in WAYS}
    full = np.full((32, 1024), 10.0, np.float32)
    image = RangeImage(full, full / 50, full > 0, SENSORS["hdl-32e"].resized(width=1024))

    def alike(name: str, axis: int) -> float:
        """How much oftener a lost pixel's neighbour is lost than any pixel."""
        lost = [ways[name](image, np.random.default_rng(seed)) for seed in range(30)]
        both = np.mean([(one & np.roll(one, 1, axis)).mean() for one in lost])
        return float(both / np.mean([one.mean() ** 2 for one in lost]))

    assert alike("_dashes", 1) > 1.5 * alike("_dashes", 0)
    assert alike("_bands", 1) > alike("_bands", 0)
    assert alike("_columns", 0) > 2 * alike("_columns", 1)


def test_recorded_scans_are_shown_as_they_are(streets: list[RangeImage], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(examples, "LOSING", 1.0)
    street = streets[0]
    recorded = RangeImage(street.range, street.reflectance, street.mask, street.sensor)
    assert examples._worse(recorded, np.random.default_rng(1)) is recorded
    assert examples._worse(street, np.random.default_rng(1)).mask.sum() < street.mask.sum()


def test_examples_lack_returns_where_the_most_likely_image_is_learned(monkeypatch: pytest.MonkeyPatch):
    """`draw` takes returns away from crops, but not from those that are drawn, nor from grids and lessons."""
    images, seen = VirtualStreets(32, 1000), []
    monkeypatch.setattr(examples, "losing", lambda image, rng: (seen.append(image), losing(image, rng))[1])
    experiment = with_fields(preset("default"), {"training.batch_size": 8, "model.observer_channels": 0})
    taken = [images.image(16 * k) for k in range(8)]
    drawn = examples.draw(experiment, Taken(taken), list(range(8)), 1, list(range(8)))
    assert drawn.crops.samples == 4
    assert 0 < len(seen) <= 4 and all(any(image is one for one in taken[4:]) for image in seen)


class Taken:
    """Images by their index."""

    def __init__(self, images: list[RangeImage]):
        self.images = images

    def take(self, indices: list[int]) -> list[RangeImage]:
        return [self.images[k] for k in indices]
