"""KITTI's scans in the even grid that R2DM draws them in."""

import numpy as np

from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade.examples import evenly

KITTI = SENSORS["hdl-64e-kitti"]


def test_a_share_of_kittis_images_is_drawn_in_the_even_grid():
    image, rng = SyntheticStreets(3, 16, KITTI).image(0), np.random.default_rng(0)
    drawn = [evenly(image, 0.4, rng) for _ in range(50)]
    even = [other for other in drawn if other is not image]
    assert 10 <= len(even) <= 30 and all(other.sensor == SENSORS["hdl-64e"] for other in even)
    share = even[0].mask[:, 300:700].mean(1)
    assert (share[40:60] < 0.3).sum() == 2, "rows between lasers are as empty as in real scans that are drawn so"
    assert np.isin(even[0].label[even[0].mask > 0], np.unique(image.label)).all() and even[0].label.any()


def test_no_share_and_other_sensors_stay_as_they_are():
    image, rng = SyntheticStreets(3, 16, SENSORS["vlp-16"]).image(0), np.random.default_rng(0)
    assert evenly(image, 1.0, rng) is image
    state = rng.bit_generator.state
    image = SyntheticStreets(3, 16, KITTI).image(0)
    assert evenly(image, 0.0, rng) is image and rng.bit_generator.state == state, "no other numbers are drawn"
