"""Crowns let rays through: beside what grows, some rays meet what is behind it, and some behind it meet a leaf."""

from dataclasses import replace

import numpy as np
import torch

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.systems.cascade.foliage import ASIDE, PIERCED, grown, through_foliage
from lidarsynth.systems.cascade.images import UPRIGHT, noisy

SENSOR = SENSORS["os1-64"]
REACH = round(ASIDE / 360 * SENSOR.width)
NONE = np.zeros(SENSOR.blocked_rays().shape, bool)
LEAVES, WALL, ROAD, CAR = (CLASS_NUMBER[name] for name in ("vegetation", "building", "road", "car"))


def scene(*classes: int) -> RangeImage:
    """Parts of the turn, each of a class, and each metres further away than the one before; 0 is no return."""
    label = np.repeat(np.repeat(classes, SENSOR.width // len(classes))[None], SENSOR.height, 0)
    metres = np.repeat(np.repeat(np.arange(len(classes)) * 4.0 + 4, SENSOR.width // len(classes))[None], len(label), 0)
    mask = label > 0
    return RangeImage((metres * mask).astype(np.float32), (metres / 100 * mask).astype(np.float32), mask, SENSOR, label)


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_what_is_beside_a_crown_is_seen_through_it_and_nothing_is_lost_on_average():
    image = scene(LEAVES, WALL)
    edge = SENSOR.width // 2
    labels = np.stack([through_foliage(image, image.reflectance, NONE, rng(k))[0].label for k in range(8)])
    beside = labels[..., edge : edge + REACH] == LEAVES
    assert 0.2 * PIERCED < beside.mean() < 0.8 * PIERCED
    through = labels[..., edge - REACH : edge] == WALL
    assert abs(through.mean() - beside.mean()) < 0.05
    found, even = through_foliage(image, image.reflectance, NONE, rng())
    inside = found.label[:, edge - 100 : edge - REACH]
    assert (inside == LEAVES).all()
    assert ((found.label == WALL) == (found.range == 8)).all()  # ranges, labels and reflectances go together
    np.testing.assert_array_equal(even, found.reflectance)
    np.testing.assert_allclose(even, found.range / 100, rtol=1e-6)


def test_what_is_seen_through_a_crown_has_a_height():
    """Beams that are close together go the same way, those of a sensor of few beams each their own."""
    alike = []
    for name in ("hdl-64e-kitti", "hdl-32e"):
        sensor = SENSORS[name]
        label = np.full((sensor.height, sensor.width), LEAVES)
        label[:, : sensor.width // 2] = WALL
        metres = np.where(label == WALL, 8.0, 4.0).astype(np.float32)
        image = RangeImage(metres, metres / 10, metres > 0, sensor, label)
        found, _ = through_foliage(image, image.reflectance, np.zeros(label.shape, bool), rng())
        moved = [(found.label != label)[:, sensor.width // 2 + column] for column in range(3)]
        pairs = np.mean([(one[1:] & one[:-1]).mean() for one in moved])
        alike.append(pairs / np.mean([one.mean() ** 2 for one in moved]))  # 1, if each went its own way
    assert alike[0] > 3 and alike[1] < 2


def test_the_sky_is_seen_through_crowns_but_roads_and_cars_stay_as_they_are():
    for other in (ROAD, CAR):
        image = scene(LEAVES, other)
        found, _ = through_foliage(image, image.reflectance, NONE, rng())
        np.testing.assert_array_equal(found.label, image.label)
    image = scene(LEAVES, 0)
    found, _ = through_foliage(image, image.reflectance, NONE, rng())
    assert (found.mask != image.mask).sum() > 50
    np.testing.assert_array_equal(found.mask, found.label > 0)
    assert not found.range[~found.mask].any()


def test_blocked_rays_stay_empty_and_are_not_what_is_seen():
    image = scene(LEAVES, 0)
    blocked = ~image.mask
    found, _ = through_foliage(image, image.reflectance, blocked, rng())
    np.testing.assert_array_equal(found.mask, image.mask)


def test_images_without_classes_stay_as_they_are_and_seeds_decide():
    image = replace(scene(LEAVES, WALL), label=None)
    assert through_foliage(image, image.reflectance, NONE, rng())[0] is image
    image = scene(LEAVES, WALL)
    one, again, other = (grown([image], image.reflectance[None], NONE, [rng(k)])[0].range for k in (0, 0, 1))
    np.testing.assert_array_equal(one, again)
    assert (one != other).any()


def test_frames_of_windows_are_upright():
    """A few rays on walls stray from them, one above the other alike, by more than the sensor's noise."""
    image = away(scene(WALL), 12)
    off = noisy(image, rng()).range - 12
    strays = np.abs(off) > 0.05
    assert 0.02 < strays.mean() < 0.11
    bands = np.floor(np.asarray(SENSOR.elevations) / UPRIGHT)
    alike, apart = ((bands[1:] == bands[:-1]) == same for same in (True, False))
    both = strays[1:] & strays[:-1]
    assert both[alike].mean() > 0.6 * strays.mean() and both[apart].mean() < 0.3 * strays.mean()
    assert np.corrcoef(off[1:][alike][both[alike]], off[:-1][alike][both[alike]])[0, 1] > 0.9


def test_more_rays_meet_a_frame_the_farther_they_are_apart():
    def share(metres: float) -> float:
        return float((np.abs(noisy(away(scene(WALL), metres), rng()).range - metres) > 0.06).mean())

    assert 3 * share(4) < share(15) < 0.6 * share(35)
    assert abs(share(35) - share(60)) < 0.01  # of the far ones no more


def test_columns_that_are_nearer_together_meet_fewer_frames():
    image = away(scene(WALL), 15)
    wide = SENSOR.resized(width=2 * SENSOR.width)
    parts = (np.repeat(part, 2, 1) for part in (image.range, image.reflectance, image.mask))
    finer = RangeImage(*parts, wide, np.repeat(image.label, 2, 1))
    usual, fewer = (float((np.abs(noisy(one, rng()).range - 15) > 0.06).mean()) for one in (image, finer))
    assert 0 < fewer < 0.75 * usual


def away(image: RangeImage, metres: float) -> RangeImage:
    return replace(image, range=np.full_like(image.range, metres))
