"""Synthetic streets: a reader like any other, reproducible, for any sensor, and close to what KITTI's sensor sees."""

import numpy as np
import pytest

from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.streets import hdl64e
from lidarsynth.streets.facades import shade
from lidarsynth.streets.ground import Ground, Road
from lidarsynth.streets.materials import MATERIALS, NUMBER, TABLE
from lidarsynth.streets.moving import Bundles, meets
from lidarsynth.streets.objects import library
from lidarsynth.streets.raycast import one_by_one
from lidarsynth.streets.reader import SyntheticStreets, Worlds
from lidarsynth.streets.turn import attitudes, world_rays
from lidarsynth.streets.varied import VariedStreets
from lidarsynth.streets.virtual import WIDEST, VirtualStreets

pytest.importorskip("embreex", reason="lidarsynth[synthetic] is not installed")

KITTI = SENSORS["hdl-64e-kitti"]
WORLDS = Worlds(1, WIDEST)


@pytest.fixture(scope="module")
def images() -> list[RangeImage]:
    reader = SyntheticStreets(seed=0, length=96)
    return [reader.image(i) for i in range(0, 96, 16)]


def test_scan_has_rings_labels_and_sensor_frame():
    scan = SyntheticStreets(seed=3, length=4)[1]
    assert len(scan) > 80_000
    assert scan.ring is not None and scan.label is not None
    assert np.all(np.diff(scan.ring) >= 0) and scan.ring.max() == 63
    assert set(np.unique(scan.label)) <= set(range(20)) and 9 in scan.label
    distance = np.linalg.norm(scan.xyz, axis=1)
    assert distance.min() >= KITTI.min_range and distance.max() < KITTI.max_range + 1
    road = scan.xyz[(scan.label == 9) & (distance < 8)]
    assert abs(np.median(road[:, 2]) + KITTI.mount) < 0.2
    assert scan.reflectance.min() >= 0 and scan.reflectance.max() <= 1


def test_points_come_in_kitti_order():
    """Ring after ring from straight ahead counter-clockwise, so that unfolding without `ring` finds the same rows."""
    scan = SyntheticStreets(seed=3, length=4)[1]
    azimuth = np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0]) % (2 * np.pi)
    ring = np.cumsum(np.diff(azimuth, prepend=azimuth[:1]) < -np.pi)
    assert (ring == scan.ring).mean() > 0.99


def test_image_is_the_projection_of_its_scan():
    """Same place and beams: where both have a return, the ranges agree but at edges and in foliage."""
    reader = SyntheticStreets(seed=5, length=4)
    image, projected = reader.image(2), project(reader[2], KITTI, method="unfolding")
    both = image.mask & projected.mask
    assert both.mean() > 0.65
    apart = np.abs(np.log(image.range[both] / projected.range[both]))
    assert np.median(apart) < 0.01 and (apart < 0.05).mean() > 0.85


def test_scan_is_a_function_of_seed_and_number():
    reader = SyntheticStreets(seed=7, length=100)
    first = reader.image(30)
    reader.image(2)
    fresh = SyntheticStreets(seed=7, length=31)
    np.testing.assert_array_equal(fresh.image(30).range, first.range)
    np.testing.assert_array_equal(fresh.image(30).reflectance, first.reflectance)
    assert np.abs(SyntheticStreets(seed=8).image(30).range - first.range).mean() > 0.5
    assert np.abs(reader.image(31).range - first.range).mean() > 0.5


def test_scans_stay_the_same_from_machine_to_machine():
    """Coarse numbers of scan 0 of seed 0, stored: a change here means that published data sets change."""
    image = SyntheticStreets(seed=0, length=1).image(0)
    found = [image.mask.mean(), np.log(image.range[image.mask]).mean(), image.reflectance[image.mask].mean()]
    np.testing.assert_allclose(found, GOLDEN, rtol=2e-3)


@pytest.mark.parametrize("name", ["vlp-16", "hdl-32e", "os1-128"])
def test_any_sensor(name: str):
    sensor = SENSORS[name].resized(width=256)
    image = SyntheticStreets(seed=1, length=2, sensor=sensor, worlds=WORLDS).image(1)
    assert image.shape == (sensor.height, 256)
    assert 0.3 < image.mask.mean() < 0.95
    assert image.range[image.mask].max() < sensor.max_range + 1
    assert not hdl64e.own_car(sensor).any()


def test_statistics_are_those_of_kitti(images: list[RangeImage]):
    """Bands around the numbers of the real training scans (docs/synthetic.md)."""
    mask = np.stack([im.mask for im in images])
    distance = np.stack([im.range for im in images])
    reflectance = np.stack([im.reflectance for im in images])
    assert 0.80 < mask.mean() < 0.92
    assert 4.5 < np.median(distance[:, 48:][mask[:, 48:]]) < 5.7
    assert 12 < np.median(distance[:, :8][mask[:, :8]]) < 27
    assert 0.2 < np.median(reflectance[mask]) < 0.32
    assert 0.05 < (reflectance[mask] < 0.02).mean() < 0.25
    np.testing.assert_allclose(reflectance * 100, np.round(reflectance * 100), atol=1e-3)


def test_every_class_of_traffic_occurs():
    reader = SyntheticStreets(seed=2, length=800, sensor=KITTI.resized(width=256))
    seen, traffic = np.zeros(20, bool), [1, 6, 9, 10, 11, 13, 14, 15, 16, 17, 18, 19]
    for index in range(0, 800, 32):
        label = reader.image(index).label
        assert label is not None
        seen[np.unique(label)] = True
        if seen[traffic].all():
            return
    pytest.fail(f"never seen: {[c for c in traffic if not seen[c]]}")


def test_own_car_hides_the_same_pixels(images: list[RangeImage]):
    hidden = hdl64e.own_car(KITTI)
    assert 0.04 < hidden.mean() < 0.1
    assert not any((im.mask & hidden).any() for im in images)


def test_road_coordinates_invert_places():
    road = Road(3.0, -2.0, 0.7, 4.0, 2.0, wave=(4.0, 200.0, 1.0))
    s, d = np.linspace(-80, 80, 9), np.linspace(-6, 6, 9)
    x, y, _ = road.at(s, d)
    s_again, d_again = road.coordinates(x, y)
    np.testing.assert_allclose(d_again, d, atol=0.03)
    np.testing.assert_allclose(s_again, s, atol=0.3)


def test_surface_across_a_street():
    ground = Ground((Road(0, 0, 0, 5.0, 2.0, parking=(2.0, 0.0), lanes="solid"),))
    y = np.array([2.0, -4.0, 8.0, 1.0])
    material, label, _, _ = ground.surface(np.zeros(4), y, np.zeros(4, bool))
    assert label.tolist() == [9, 10, 17, 9]
    assert material[3] == NUMBER["marking"] and material[0] == NUMBER["road"]


def test_windows_lie_behind_the_wall():
    row = np.array([0, 0, 1, 0, 0, 3.0, 0.5, 1.0, 2.2, 0.2, 0, 0])
    u = np.linspace(0, 60, 400)
    points = np.column_stack([u, np.zeros(400), np.full(400, 1.5)])
    material, depth = shade(points, np.tile(row, (400, 1)))
    glass = material == NUMBER["window"]
    assert 0.1 < glass.mean() < 0.6
    np.testing.assert_allclose(depth[glass], 0.2)
    assert np.abs(depth[material == NUMBER["plaster"]]).max() < 0.2


def test_library_things_stand_on_the_ground():
    for kind, variants in library().items():
        for shape in variants:
            assert np.isfinite(shape.corners).all(), kind
            assert -1.5 < shape.corners[..., 2].min() < 0.45, kind
            assert len(shape.material) == len(shape.label) == len(shape)
    assert TABLE.shape == (len(MATERIALS), 6)


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match="expected seed of at least 0, found -1"):
        SyntheticStreets(seed=-1)
    with pytest.raises(IndexError, match=r"0\.\.9, got 10"):
        SyntheticStreets(length=10).image(10)


def test_a_sensor_with_one_beam():
    sensor = Sensor("line", (-10.0,), width=512, max_range=50.0)
    image = SyntheticStreets(seed=0, length=1, sensor=sensor).image(0)
    assert image.mask.mean() > 0.5


GOLDEN = [0.8925, 2.3618, 0.2591]  # filled pixels, mean ln range, mean reflectance


def test_a_pair_is_the_perfect_scan_and_todays_image():
    """The image bit by bit; the perfect one lies under it, but for noise, panes, and what was dropped."""
    for streets in (SyntheticStreets(seed=5, length=4), VirtualStreets(seed=6, length=8)):
        perfect, seen = streets.pair(2)
        image = streets.image(2)
        for name in ("range", "reflectance", "mask", "label"):
            np.testing.assert_array_equal(getattr(seen, name), getattr(image, name))
        assert perfect.sensor == seen.sensor and perfect.label is not None and seen.label is not None
        assert not perfect.reflectance.any() and not perfect.range[~perfect.mask].any()
        assert perfect.mask[seen.mask].mean() > 0.999
        assert perfect.mask.mean() > seen.mask.mean() + 0.005
        both = seen.mask & perfect.mask
        apart = np.abs(perfect.range - seen.range)[both]
        assert np.median(apart) < 0.04 and (apart < 0.5).mean() > 0.97
        assert (perfect.label == seen.label)[both].mean() > 0.97
        assert not perfect.mask[hdl64e.hidden(seen.sensor)].any()


def test_varied_streets_differ_in_density_and_roughness_and_depend_on_their_number_alone():
    streets, again = VariedStreets(6, 400), VariedStreets(6, 400)
    green = {streets.density(number).vegetation for number in range(24)}
    kerbs = [streets.density(number).kerbs for number in range(24)]
    rough = [streets.sensor(index).optics.rough for index in range(0, 96, 4)]
    assert green == {1, 2, 3} and min(kerbs) < 0.5 < max(kerbs) and 1 in kerbs
    assert min(rough) < 0.4 and rough.count(1.0) in range(2, 16)
    kitti = [s for s in (streets.sensor(index) for index in range(0, 400, 4)) if s.sensor.name == "hdl-64e-kitti"]
    assert any(s.sensor.elevations != SENSORS["hdl-64e-kitti"].elevations for s in kitti)
    late = again.image(33)  # another world than that of 2
    np.testing.assert_array_equal(streets.image(2).range, again.image(2).range)
    np.testing.assert_array_equal(streets.image(33).range, late.range)


def test_packets_meet_what_single_rays_meet():
    """Sixteen at once or one by one: the same triangles, single rays at edges aside; no part of a packet is lost."""
    reader = SyntheticStreets(0, 1, SENSORS["hdl-32e"].resized(width=256))
    world, caster = reader._worlds[0]
    sensor, pose = reader.sensor, attitudes(reader.sensor, world.poses[3][None])
    origins, rays = world_rays(sensor, sensor.directions(), np.ones((sensor.height, sensor.width), bool), pose)
    single = one_by_one(world.corners)(origins, rays)
    assert np.mean(caster.faces(origins, rays) != single) < 5e-4 and (single >= 0).mean() > 0.5
    for count in (0, 1, 15, 17, 8209):
        np.testing.assert_array_equal(caster.faces(origins[:count], rays[:count]) >= 0, single[:count] >= 0)


def test_bundles_find_every_ray_that_passes():
    """Of rays in any order, from places metres apart, the same as one by one."""
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(1000, 3)).astype(np.float32)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for order in (np.arange(1000), np.lexsort(np.round(rays.T, 1))):
        ways, origins = rays[order], rng.uniform(-1, 1, (1000, 3)).astype(np.float32)
        for middle, radius in ((rng.uniform(-30, 30, 3), r) for r in (0.3, 2.0, 6.0, 40.0)):
            found = Bundles(origins, ways).meet(middle, radius)
            np.testing.assert_array_equal(found, meets(origins, ways, middle, radius))
