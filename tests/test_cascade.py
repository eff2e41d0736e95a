"""The cascade: rays and candidates by closed forms, what is known stays, any sensor goes in and out."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lidarsynth.diffusion.samplers import generators
from lidarsynth.diffusion.schedule import flow
from lidarsynth.experiment.record import Data, Experiment, Model
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.networks import fill_unet
from lidarsynth.networks.candidates import BEND, candidates
from lidarsynth.networks.cascade import GUIDANCE, Cascade
from lidarsynth.networks.class_unet import ClassUNet
from lidarsynth.networks.coarse_unet import CoarseUNet, grid_columns, grid_rays, grid_rows, left_filled
from lidarsynth.networks.column_transformer import ColumnTransformer
from lidarsynth.networks.drafts import BOUND
from lidarsynth.networks.fill_unet import NOISES, FillUNet, Known, draw_noise
from lidarsynth.networks.rays import decode_range, encode_range, level_sines, padded, rays_of
from lidarsynth.streets.hdl64e import dimness, hidden, written_out
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade import model as cascade_model
from lidarsynth.systems.cascade.images import grid_of, noisy
from lidarsynth.systems.cascade.layout import DRAFT, draft, one_thread
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.cascade.naming import FAIR, weights
from lidarsynth.systems.cascade.surfaces import across_rings, straightened
from lidarsynth.systems.denser import spread
from lidarsynth.systems.precision import resolved_precision
from lidarsynth.weights.load import load_parts

SMALL = Sensor("small", tuple(np.linspace(5, -25, 24).tolist()), 256, 0.5, 120.0, mount=1.8)


@pytest.fixture(scope="module")
def model() -> CascadeModel:
    """An untrained cascade whose last layers are not zero."""
    torch.manual_seed(0)
    network = Cascade(CoarseUNet(32, (1, 2, 2, 2), 1), FillUNet((16, 16, 16, 16))).eval()
    for layer in (network.fill.out.weight, network.coarse.unet.out_conv.weight):
        torch.nn.init.normal_(layer, std=0.02)
    return CascadeModel(network, SMALL, Experiment("test", Data(sensor=SMALL.to_dict()), Model(network="cascade")))


def plane(sensor: Sensor, normal: tuple[float, float, float], level: float) -> torch.Tensor:
    """Metres (1, 1, H, W) to the plane normal . p = level along every ray."""
    return torch.from_numpy(level / (sensor.directions() @ np.array(normal)))[None, None].float()


def test_range_code_is_inverse_and_has_one_limit():
    metres = torch.linspace(0, 255, 500)
    assert_close(decode_range(encode_range(metres)), metres, rtol=1e-4, atol=1e-4)
    assert encode_range(torch.tensor(255.0)).item() == pytest.approx(1)


def test_flat_ground_is_where_trigonometry_puts_it():
    rays = rays_of(SMALL, SMALL.blocked_rays())
    low = np.radians(SMALL.elevations[-1])
    assert rays.ground[0, 0, 23, 0].item() == pytest.approx(1.8 / np.sin(-low), rel=1e-5)
    assert rays.ground[0, 0, 0, 0].item() == pytest.approx(120)
    assert rays.inside[0, 0, :, 0].tolist() == [1.0] * 24 + [0.0] * 8


def test_a_tilted_sensor_sees_the_road_as_its_pose_says():
    tilted = replace(SMALL, tilt=(4.0, -3.0))
    angles = tilted.ray_angles().astype(float)
    sines = level_sines(tilted, angles[0, :, 0], angles[1, 0])
    pitch, roll = np.radians(tilted.tilt)
    about_y = np.array([[np.cos(pitch), 0, -np.sin(pitch)], [0, 1, 0], [np.sin(pitch), 0, np.cos(pitch)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
    np.testing.assert_allclose(sines, (tilted.directions() @ (about_y @ about_x).T)[..., 2], atol=1e-6)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.02, -0.03, 1.0), (0.03, 0.05, 1.0)])
def test_the_plane_candidate_is_exact_on_planes_but_for_the_curve_of_the_sine(normal: tuple[float, float, float]):
    sensor = replace(SMALL, elevations=tuple(np.linspace(-5, -25, 24).tolist()))
    metres = plane(sensor, normal, -1.8)
    told = torch.zeros(metres.shape, dtype=torch.bool)
    told[:, :, ::4] = True
    rays = rays_of(sensor, sensor.blocked_rays())
    rays = type(rays)(*(part[:, :, :24] if part.shape[2] == 32 else part for part in rays))
    guesses = candidates(metres, torch.zeros_like(metres), told, told, rays)
    error = (decode_range(guesses.code[:, 2:3]) - metres).abs()[:, :, :21] / metres[:, :, :21]
    bilinear = (decode_range(guesses.code[:, 1:2]) - metres).abs()[:, :, :21] / metres[:, :, :21]
    assert error.max() < 2e-3
    assert error.max() < bilinear.max() / 5
    if normal[:2] == (0.0, 0.0):
        assert_close(decode_range(guesses.code[:, 7:8])[:, :, :21], metres[:, :, :21], rtol=1e-4, atol=1e-4)


def test_the_plane_candidate_goes_around_the_turn_where_nothing_is_above_or_below():
    metres = plane(SMALL, (1.0, 0.7, 0.0), 8.0)
    told = torch.zeros(metres.shape, dtype=torch.bool)
    told[:, :, 12, ::4] = True
    rays = rays_of(SMALL, SMALL.blocked_rays())
    rays = type(rays)(*(part[:, :, :24] if part.shape[2] == 32 else part for part in rays))
    near = (metres[0, 0, 12] > 1) & (metres[0, 0, 12] < 25)
    near &= near.roll(4) & near.roll(-4) & (torch.arange(256) % 4 != 0)
    guesses = candidates(metres, torch.zeros_like(metres), told, told, rays)
    errors = [(decode_range(guesses.code[0, k, 12]) - metres[0, 0, 12]).abs()[near].max() for k in (2, 0)]
    assert near.sum() > 20
    assert errors[0] < 0.2 * errors[1] and errors[0] < 0.05


def test_what_stands_beside_is_one_surface_where_it_goes_on_straight_and_two_at_an_edge():
    wall = plane(SMALL, (1.0, 0.7, 0.0), 8.0)
    metres = torch.where(torch.arange(256) < 30, wall, 2 * wall)  # the wall lies ahead, around columns 100 to 150
    told = torch.zeros(metres.shape, dtype=torch.bool)
    told[:, :, 12, ::4] = True
    rays = rays_of(SMALL, SMALL.blocked_rays())
    rays = type(rays)(*(part[:, :, :24] if part.shape[2] == 32 else part for part in rays))
    metres = torch.where(torch.arange(256) < 102, metres, 1.5 * metres)
    codes = decode_range(candidates(metres, torch.zeros_like(metres), told, told, rays).code)[0, :, 12]
    for column in (94, 110):
        assert_close(codes[5:7, column], metres[0, 0, 12, column].expand(2), rtol=2e-3, atol=0)
    edge = [metres[0, 0, 12, column] for column in (100, 104)]
    assert_close(codes[5:7, 102], torch.stack(edge), rtol=1e-5, atol=0)
    step = torch.where(torch.arange(256) < 102, 10.0, 11.0).expand(metres.shape)  # a mean errs least, a draw is no mean
    both = (
        decode_range(candidates(step, torch.zeros_like(step), told, told, rays, bend).code) for bend in (BEND, BEND / 2)
    )
    mean, drawn = (codes[0, 5:7, 12, 102] for codes in both)
    assert (mean > 10.3).all() and (mean < 10.7).all()
    assert_close(drawn, torch.tensor([10.0, 11.0]), rtol=1e-4, atol=0)


def test_generated_grids_get_flat_ground_and_upright_walls_and_keep_their_edges():
    rows = grid_rows(64)
    sensor = SENSORS["hdl-64e-kitti"]
    down = np.radians(np.asarray(sensor.elevations))[rows]
    ground = np.where(down < -0.06, sensor.mount / np.maximum(-np.sin(down), 1e-3), 0)
    wall = np.where(np.arange(128) < 64, 12.0, 20.0)[None] / np.cos(down)[:, None]
    truth = np.where((ground > 0)[:, None] & (ground[:, None] < wall), ground[:, None], wall)
    truth[:, 20:24] = 0
    waves = 1 + 0.01 * np.random.default_rng(0).standard_normal((3, *truth.shape))
    found = straightened(torch.from_numpy(truth * waves).float(), rows, sensor).numpy()
    empty = np.broadcast_to(truth == 0, found.shape)
    assert not found[empty].any() and (found[~empty] > 0).all()
    before, after = (np.abs(part / np.where(truth, truth, 1) - 1)[~empty] for part in (truth * waves, found))
    assert after.mean() < 0.5 * before.mean() and np.quantile(after, 0.99) < np.quantile(before, 0.99)
    again = straightened(torch.from_numpy(truth)[None], rows, sensor).numpy()[0]
    np.testing.assert_allclose(again, truth, rtol=0.03)


def rings_of_ground(sensor: Sensor, rows: np.ndarray, kerb: float) -> np.ndarray:
    """(R, 128) metres of ground that is flat but for a kerb so many metres high, 6 m to the left of the sensor."""
    down = -np.radians(np.asarray(sensor.elevations))[rows][:, None]
    azimuth = np.pi - 2 * np.pi * np.arange(128) / 128
    low, high = sensor.mount / np.sin(down), (sensor.mount - kerb) / np.sin(down)
    return np.where(high * np.cos(down) * np.sin(azimuth) > 6.0, high, low)


def test_kerbs_keep_their_edge_where_grids_have_little_noise():
    sensor, rows = SENSORS["hdl-64e-kitti"], np.arange(24, 64, 2)
    truth = rings_of_ground(sensor, rows, 0.15)
    noisy = torch.from_numpy(truth * (1 + 0.001 * np.random.default_rng(0).standard_normal(truth.shape)))[None]
    off = {
        edges: np.abs(straightened(noisy, rows, sensor, edges=edges).numpy()[0] / truth - 1) for edges in (True, False)
    }
    assert np.quantile(off[True], 0.99) < 0.01 < np.quantile(off[False], 0.99)
    right = np.s_[1:-1, 70:120]
    assert np.median(off[True][right]) < 0.8 * np.median(np.abs(noisy.numpy()[0] / truth - 1)[right])


def test_rings_of_ground_lose_what_is_of_one_ring_alone_and_keep_kerbs_and_walls():
    sensor, rows = SENSORS["hdl-64e-kitti"], np.arange(20, 64)
    truth = rings_of_ground(sensor, rows, 0.15)
    truth[:, 100:104] = 4.0  # a wall
    made = truth * (1 + 0.003 * np.random.default_rng(0).standard_normal(len(rows)))[:, None]
    made[:, 100:104] = truth[:, 100:104]
    humped = made.copy()
    humped[25, 60:70] *= 0.9
    humped[30, 10] = 0
    found = across_rings(torch.from_numpy(humped)[None], rows, sensor).numpy()[0]
    inner = np.s_[1:-1]
    steps = [np.abs(np.diff(np.log(part[inner, 40:90] / truth[inner, 40:90]), axis=0)) for part in (made, found)]
    assert steps[1].mean() < 0.6 * steps[0].mean() and steps[1].max() < 0.03
    assert np.quantile(np.abs(found / np.where(humped > 0, truth, 1) - 1)[humped > 0], 0.98) < 0.01
    np.testing.assert_allclose(found[:, 100:104], truth[:, 100:104], rtol=1e-4)
    np.testing.assert_array_equal(found == 0, humped == 0)


def test_rings_of_ground_that_are_far_apart_stay_as_they_are():
    sensor = SENSORS["hdl-32e"]
    rows = np.arange(12, 32)
    metres = torch.from_numpy(rings_of_ground(sensor, rows, 0.15))[None]
    metres[:, 8] *= 0.95
    assert_close(across_rings(metres, rows, sensor), metres, rtol=1e-4, atol=0)


def test_grids_of_a_dome_keep_their_ranges_where_beams_look_straight_up():
    dome = Sensor("dome", tuple(np.linspace(90, -90, 16).tolist()), 128, 0.5, 50.0)
    metres = torch.full((1, 16, 128), 5.0)
    found = straightened(metres, np.arange(16), dome)
    assert_close(found[:, [0, -1]], metres[:, [0, -1]], rtol=1e-4, atol=0)
    assert torch.isfinite(found).all()


def test_a_dome_whose_beams_look_straight_up_is_completed(model: CascadeModel):
    dome = Sensor("dome", tuple(np.linspace(90, 0, 16).tolist()), 128, 0.5, 50.0)
    image = RangeImage(
        np.full((16, 128), 5.0, np.float32), np.ones((16, 128), np.float32), np.ones((16, 128), bool), dome
    )
    known = np.zeros(image.shape, bool)
    known[3::4] = True
    filled = model.into(dome).complete(image.keep(known), known)
    assert np.isfinite(filled.range).all() and np.isfinite(filled.reflectance).all()
    assert filled.mask[~known].any()


def test_samples_are_rough_where_something_grows():
    label = np.repeat(np.array([[9, 15, 17, 9]]), 64, 1).repeat(24, 0)
    image = RangeImage(np.full(label.shape, 10.0), np.ones(label.shape), np.ones(label.shape, bool), SMALL, label)
    spread = noisy(image, torch.Generator().manual_seed(0)).range.reshape(24, 4, 64).std((0, 2))
    assert spread[1] > 0.06 and 0.02 < spread[2] < 0.04 and max(spread[0], spread[3]) < 0.015


def test_what_beams_lose_is_added_before_and_taken_off_after():
    """Beams that read one bright wall differently: the fill, untrained, gives each hidden beam its own reading."""
    fill = FillUNet((16, 16), (1, 1)).eval()
    dim = tuple(np.random.default_rng(0).uniform(0, 0.2, 24).tolist())
    rays = rays_of(SMALL, SMALL.blocked_rays(), dimness=dim)
    told = torch.zeros(1, 1, 32, 256, dtype=torch.bool)
    told[:, :, :24:4] = True
    read = (0.5 - rays.dimness).expand(told.shape)
    known = Known(told * 9.0, read * told, told, told, told)
    filled = fill(known, rays, torch.zeros(1, NOISES, 32, 256))
    assert_close(filled.reflectance[:, :, :24], read[:, :, :24], atol=1e-5, rtol=1e-5)
    assert read[0, 0, :24].std() > 0.04


def test_in_use_a_choice_close_to_a_hypothesis_is_that_hypothesis():
    fill, rays = FillUNet((16, 16), (1, 1)), rays_of(SMALL, SMALL.blocked_rays())
    metres = torch.linspace(9.0, 9.2, 32)[:, None].expand(1, 1, 32, 256)
    told = torch.zeros(metres.shape, dtype=torch.bool)
    told[:, :, ::4] = True
    known, nothing = Known(metres * told, metres * 0, told, told, told), torch.zeros(1, NOISES, 32, 256)
    codes = candidates(*known[:2], told, told, rays).code
    mixed, snapped = (fill.train(mode)(known, rays, nothing).code for mode in (True, False))
    off, before = ((codes - code).abs().amin(1) for code in (snapped, mixed))
    assert ((off < 1e-7) | (off >= fill_unet.SNAP)).all()
    assert ((off < 1e-7) & (before > 1e-4)).any() and (before > 1e-4).sum() > 2 * (off > 1e-4).sum()


def test_generated_ground_is_flat_between_the_grid_but_for_the_sensors_noise(model: CascadeModel):
    """Told the coarse grid of a plane, an untrained fill gives the plane, every beam with its own range noise."""
    fill = FillUNet((16, 16), (1, 1)).eval()
    sensor = replace(SMALL, elevations=tuple(np.linspace(-5, -25, 64).tolist()))
    flat = replace(model, sensor=sensor, network=Cascade(model.network.coarse, fill))
    truth = plane(sensor, (0.0, 0.0, 1.0), -1.8)[0, 0]
    rows, columns = grid_rows(64), grid_columns(256)
    grid = truth[rows][:, columns][None]
    (image,) = flat._filled_grids(grid, 0.3 * torch.ones_like(grid), rows, columns, [torch.Generator().manual_seed(0)])
    inner = slice(rows[0], rows[-1] + 1)
    error = (image.range - truth.numpy())[inner]
    assert image.mask[inner].all()
    assert 0.003 < error.std() < 0.03 and np.abs(error).max() < 0.15


def test_a_part_of_kittis_sensor_keeps_its_car_and_its_lasers():
    own = SENSORS["hdl-64e-kitti"]
    thinned = written_out(own).rows(list(range(2, 64, 4)))
    np.testing.assert_array_equal(hidden(thinned), hidden(own)[2::4])
    assert hidden(thinned).any() and dimness(thinned) == dimness(own)[2::4]
    assert dimness(written_out(own).denser(2))[::2] == pytest.approx(dimness(own))


def test_known_pixels_are_their_own_candidates_and_lonely_ones_the_ground():
    metres = torch.full((1, 1, 32, 256), 7.0)
    told = torch.zeros(metres.shape, dtype=torch.bool)
    rays = rays_of(SMALL, SMALL.blocked_rays())
    nothing = candidates(metres, metres / 10, told, told, rays)
    assert_close(decode_range(nothing.code[:, :1]), rays.ground, rtol=1e-4, atol=1e-3)
    told[0, 0, 3, 5] = True
    one = candidates(metres, metres / 10, told, told, rays)
    assert_close(decode_range(one.code[0, :, 3, 5]), torch.full((10,), 7.0))
    assert_close(one.reflectance[0, :, 3, 5], torch.full((6,), 0.7))


def test_what_is_not_known_is_never_looked_at(model: CascadeModel):
    rays = rays_of(SMALL, SMALL.blocked_rays())
    told = torch.rand(1, 1, *padded(SMALL), generator=torch.Generator().manual_seed(1)) < 0.3
    metres = torch.rand(told.shape, generator=torch.Generator().manual_seed(2)) * 40 + 1
    noise = torch.zeros(1, NOISES, *padded(SMALL))
    outputs = [
        model.network.fill(Known(m, m / 50, told, told, told), rays, noise)
        for m in (metres, torch.where(told, metres, 99.0))
    ]
    for a, b in zip(*(output[:3] for output in outputs), strict=True):
        assert_close(a, b)


def test_the_width_is_a_ring(model: CascadeModel):
    rays = rays_of(SMALL, SMALL.blocked_rays())
    rng = torch.Generator().manual_seed(3)
    told = torch.rand(1, 1, *padded(SMALL), generator=rng) < 0.2
    metres, noise = torch.rand(told.shape, generator=rng) * 40 + 1, draw_noise((1, *padded(SMALL)), rng)
    known = Known(metres, metres / 50, told, told, told)
    whole = model.network.fill(known, rays, noise)
    turned = model.network.fill(Known(*(part.roll(32, 3) for part in known)), rays, noise.roll(32, 3))
    for a, b in zip(whole[:3], turned[:3], strict=True):
        assert_close(a.roll(32, 3), b, atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("sensor", ["vlp-16", "pandar64", "os1-128"])
def test_measured_pixels_come_back_bit_by_bit_in_any_sensor(model: CascadeModel, sensor: str):
    image = SyntheticStreets(4, 16, SENSORS[sensor]).image(3)
    known = corrupt(image, "beams:2")
    filled = model.into(sensor).complete(image.keep(known), known)
    assert filled.shape == image.shape
    np.testing.assert_array_equal(filled.range[known], image.range[known])
    np.testing.assert_array_equal(filled.reflectance[known & image.mask], image.reflectance[known & image.mask])
    assert filled.mask[~known].any()


@pytest.mark.parametrize("width", [4, 16, 24])
def test_a_sensor_of_a_few_columns_is_completed(model: CascadeModel, width: int):
    image = SyntheticStreets(4, 16, replace(SMALL, width=width)).image(3)
    known = corrupt(image, "beams:2")
    assert model.into(image.sensor).complete(image.keep(known), known).shape == (24, width)


def test_generated_scans_bear_no_marks_of_completed_ones(model: CascadeModel):
    (image,) = model.generate(1, steps=1)
    assert image.new is None and image.confidence is None and not image.to_scan().extra


def test_scans_of_the_sensor_that_a_model_was_tuned_on_become_denser_without_its_name(model: CascadeModel):
    scan = SyntheticStreets(4, 16, SMALL).image(3).to_scan()
    up, named = model.upsample(scan, times=2), model.upsample(scan, SMALL, times=2)
    assert up.shape == (47, 256)
    np.testing.assert_array_equal(up.range, named.range)


def test_blocked_rays_stay_empty_and_no_other_sensor_gets_kittis_car(model: CascadeModel):
    blocked = replace(SMALL, blocked=((22, 10, 60), (23, 250, 80)))
    metres = np.zeros((24, 256), np.float32)
    metres[0, 0] = 30.0
    image = RangeImage(metres, metres / 60, metres > 0, blocked)
    filled = model.into(blocked).complete(image)
    assert not filled.mask[blocked.blocked_rays()].any()
    assert filled.mask[23, 81:249].any() == model.complete(image).mask[23, 81:249].any()
    assert not rays_of(SENSORS["hdl-64e-kitti"], np.zeros((64, 1024), bool)).blocked.any()


def test_coarse_code_is_inverse():
    network = CoarseUNet(32, (1, 2, 2, 2), 1)
    network.standard[1] = 0.1
    _, standing = grid_rays(SMALL, SMALL.blocked_rays(), grid_rows(24), grid_columns(256))
    rng = torch.Generator().manual_seed(0)
    metres = torch.rand(1, 16, 128, generator=rng) * 80 * (torch.rand(1, 16, 128, generator=rng) < 0.8)
    reflectance = torch.rand(1, 16, 128, generator=rng) * (metres > 0)
    back = network.decode(network.encode(metres, reflectance, standing[None]), standing[None])
    for found, expected in zip(back, (metres, reflectance), strict=True):
        assert_close(found, expected, atol=1e-3, rtol=1e-4)


def test_empty_pixels_hold_their_left_neighbour_around_the_turn():
    values, returned = torch.tensor([[[[5.0, 1.0, 2.0, 3.0]]]]), torch.tensor([[[False, True, False, False]]])
    assert left_filled(values, returned).flatten().tolist() == [1, 1, 1, 1]
    assert left_filled(values, torch.zeros_like(returned)).flatten().tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize(("height", "width"), [(16, 128), (20, 1800), (64, 1024), (128, 2048)])
def test_the_grid_is_sixteen_beams_and_128_columns_of_any_sensor(height: int, width: int):
    for grid, size, count in ((grid_rows(height), height, 16), (grid_columns(width), width, 128)):
        assert len(np.unique(grid)) == count
        assert grid.min() >= 0
        assert grid.max() < size


def test_generated_scans_depend_on_their_seed_alone(model: CascadeModel):
    three = model.generate(3, steps=2, seed=5, batch_size=1)
    (last,) = model.stream(3, steps=2, seed=5, batch_size=1, first=2)
    np.testing.assert_array_equal(three[2].range, last.range)
    assert (three[0].range != three[1].range).any()
    assert three[0].range.max() <= SMALL.max_range


def test_grids_come_column_by_column_but_where_steps_are_asked_for(model: CascadeModel):
    torch.manual_seed(1)
    parts = model.network.coarse, model.network.fill, None, ColumnTransformer(16, layers=1, pixel=16, blocks=1).eval()
    both, told = replace(model, network=Cascade(*parts)), []
    three = both.generate(3, seed=5, on_step=lambda: told.append(1))
    assert len(told) == 3 * both.generation_steps() == 3 * 129
    (last,) = both.stream(3, seed=5, first=2, sampler="columns")
    np.testing.assert_array_equal(three[2].range, last.range)
    assert (three[0].mask != three[1].mask).any() and three[0].mask.any()
    (diffused,) = both.generate(1, steps=2, seed=5)
    np.testing.assert_array_equal(diffused.range, model.generate(1, steps=2, seed=5)[0].range)
    assert both.generation_steps(sampler="ddim") == model.generation_steps() == 17
    assert [both.sampler_used(*how) for how in ((None, None), (128, None), (8, "ddim"))] == [
        "columns",
        "dpmpp-2m",
        "ddim",
    ]
    assert model.sampler_used() == "dpmpp-2m"
    for call, message in (
        (lambda: both.generation_steps(2, "columns"), "expected no steps with the sampler columns"),
        (lambda: model.generation_steps(sampler="columns"), "a sampler of ddpm, .*, found 'columns'"),
        (lambda: both.generation_steps(sampler="nonsense"), "a sampler of columns, ddpm"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_upsampling_keeps_the_beams_where_they_are(model: CascadeModel):
    sensor = SENSORS["vlp-16"]
    scan = SyntheticStreets(4, 16, sensor)[2]
    dense = model.upsample(scan, "vlp-16", times=4)
    assert dense.shape == (61, 1024)
    assert dense.sensor.elevations[::4] == pytest.approx(sensor.elevations)
    own = model.into(sensor).image_of(scan)
    np.testing.assert_array_equal(dense.range[::4], own.range)
    assert dense.mask[1::4].any()


def test_repaint_fills_a_lost_sector_and_leaves_the_rest(model: CascadeModel):
    image = SyntheticStreets(4, 16, SMALL).image(3)
    known = corrupt(image, "sector:90")
    filled = model.complete(image.keep(known), known, method="repaint", steps=2, resamples=1, seed=1)
    np.testing.assert_array_equal(filled.range[known], image.range[known])
    assert filled.mask[~known].any()
    network = Cascade(model.network.coarse, model.network.fill, Constant(torch.full((3, 16, 128), 9.0)))
    guided = replace(model, network=network)
    same = guided.complete(image.keep(known), known, method="repaint", steps=2, resamples=1, seed=1)
    np.testing.assert_array_equal(same.range, filled.range)  # known pixels guide enough
    assert (guided.generate(1, steps=2)[0].range != model.generate(1, steps=2)[0].range).any()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: m.generate(0), "at least 1"),
        (lambda m: m.generate(1, sampler="nonsense"), "a sampler of ddpm"),
        (lambda m: m.into(replace(SMALL, elevations=(1.0, 0.0))).generate(1), "at least 16 beams"),
        (lambda m: m.into(replace(SMALL, elevations=(1.0, 0.0))).generation_steps(), "at least 16 beams"),
        (lambda m: m.evaluations("posterior"), "a method of auto, conditional, sample, repaint"),
        (lambda m: m.evaluations(steps=4), "expected 1 step"),
    ],
)
def test_what_it_cannot_do_is_refused(model: CascadeModel, call, message: str):
    with pytest.raises(ValueError, match=message):
        call(model)


def test_spread_rows_are_known_and_no_others():
    image = SyntheticStreets(4, 16, SMALL).image(1)
    sparse, known = spread(image, SMALL.denser(3), 3)
    assert known.sum() == 24 * 256
    np.testing.assert_array_equal(sparse.range[::3], image.range)
    assert not sparse.mask[1::3].any()


def test_noise_has_three_grains():
    noise = draw_noise((2, 64, 1024), torch.Generator().manual_seed(0))
    assert noise.shape == (2, fill_unet.NOISES, 64, 1024)
    assert_close(noise.std((0, 2, 3)), torch.ones(3), atol=0.03, rtol=0)
    assert torch.equal(noise[:, 1, :, 0], noise[:, 1, :, 5])
    assert torch.equal(noise[:, 2, 0, 0], noise[:, 2, 3, 7])


def test_a_scan_is_completed_in_its_own_sensor_until_another_is_named(model: CascadeModel):
    scan = SyntheticStreets(4, 16, SENSORS["vlp-16"])[2]
    assert model.complete(scan).sensor.name == "vlp-16"
    assert model.into("hdl-32e").upsample(scan, "vlp-16").shape == (32, 1024)
    with pytest.raises(ValueError, match="found both"):
        model.into("hdl-32e").upsample(scan, "vlp-16", times=2)
    with pytest.raises(ValueError, match="name the sensor"):
        model.complete(replace(scan, xyz=scan.xyz[:, [2, 0, 1]], ring=None))


@pytest.fixture(scope="module")
def learned(model: CascadeModel) -> CascadeModel:
    """The untrained cascade with a network of classes, most rays returning."""
    torch.manual_seed(1)
    fill = FillUNet((16, 16, 16, 16), classes=20).eval()
    fill.load_state_dict(model.network.fill.state_dict(), strict=False)
    torch.nn.init.normal_(fill.out.weight, std=0.3)
    experiment = replace(model.experiment, model=replace(model.experiment.model, classes=20))
    network = Cascade(model.network.coarse, fill, classes=ClassUNet(8).eval())
    return replace(model, network=network, experiment=experiment)


def perfect(sensor: Sensor) -> Scan:
    """Ground and a round wall, a ray per pixel, with every field; times tell the points apart."""
    metres = np.minimum(20.0, sensor.mount / np.maximum(-sensor.directions()[..., 2], 1e-3)).astype(np.float32)
    scan = RangeImage(metres, np.zeros_like(metres), metres > 0, sensor, np.full(metres.shape, 9)).to_scan()
    numbers = np.arange(len(scan))
    return replace(scan, time=numbers * 1e-5, extra={"object": numbers.astype(np.uint32)})


def test_realised_points_are_the_simulators_bit_by_bit(learned: CascadeModel):
    scan = perfect(SMALL)
    real = learned.into(SMALL).realise(scan)
    assert 0.05 * len(scan) < len(real) < 0.98 * len(scan) and real.reflectance.std() > 0.01
    place = real.extra["object"].astype(int)
    assert np.all(np.diff(place) > 0)
    for name in ("xyz", "time", "ring", "label"):
        np.testing.assert_array_equal(getattr(real, name), getattr(scan, name)[place])
    again, other = (learned.realise(scan, SMALL, seed) for seed in (0, 1))
    np.testing.assert_array_equal(again.extra["object"], real.extra["object"])
    np.testing.assert_array_equal(again.reflectance, real.reflectance)
    assert len(np.intersect1d(other.extra["object"], place)) < len(place)
    bright = replace(scan, reflectance=np.full(len(scan), 0.7, np.float32))
    np.testing.assert_array_equal(learned.realise(bright, SMALL).reflectance, real.reflectance)


def test_what_a_sensor_cannot_see_is_never_realised(learned: CascadeModel):
    sensor = replace(SMALL, blocked=((23, 0, 99),), max_range=15.0)
    scan = perfect(SMALL)
    real = learned.realise(scan, sensor)
    depth = np.linalg.norm(real.xyz, axis=1)
    assert depth.max() <= 15 < np.linalg.norm(scan.xyz, axis=1).max()
    assert real.ring is not None
    image = learned.realised(scan, sensor)
    assert not image.mask[23, :100].any() and image.mask[23, 100:].any() and image.completed is not None
    with pytest.raises(ValueError, match=r"expected points within .* found none"):
        learned.realise(np.array([[0.0, 0.0, 50.0]]), SMALL)


def test_a_scan_with_other_columns_keeps_its_own(learned: CascadeModel):
    dense = replace(SMALL, width=1000)
    assert learned.realised(perfect(dense), SMALL).shape == (24, 1000)
    assert learned.realised(perfect(replace(SMALL, width=250)), SMALL).shape == (24, 256)
    lone = learned.realise(perfect(dense), SMALL)
    assert np.unique(lone.extra["object"]).size == len(lone)


def test_models_without_classes_refuse_in_one_line(model: CascadeModel):
    with pytest.raises(ValueError, match="test: expected a model that has learned which rays return"):
        model.realise(perfect(SMALL), SMALL)
    with pytest.raises(ValueError, match="test: expected a model that has learned classes"):
        model.with_labels()


def test_classes_come_with_generated_and_completed_scans(learned: CascadeModel):
    (image,) = learned.generate(1, steps=2, labels=True)
    (plain,) = learned.generate(1, steps=2)
    assert image.label is not None and plain.label is None
    np.testing.assert_array_equal(image.range, plain.range)
    assert set(np.unique(image.label[image.mask])) <= set(range(1, 20)) and not image.label[~image.mask].any()
    scan = replace(perfect(SMALL)[::3], label=None)
    filled = learned.into(SMALL).with_labels().complete(scan).to_scan()
    assert filled.label is not None and filled.label.min() >= 1
    own = learned.into(SMALL).with_labels().complete(perfect(SMALL)[::3]).to_scan()
    assert own.label is not None and np.all(own.label[own.extra["new"] == 0] == 9)


def test_scans_in_the_making_are_named_by_a_network_of_their_own(learned: CascadeModel):
    """Whose classes generated scans keep; recorded ones have those of the other."""
    road, building = (CLASS_NUMBER[word] for word in ("road", "building"))
    networks = {}
    for name, number in (("classes", road), ("drawn", building)):
        networks[name] = ClassUNet(8).eval()
        torch.nn.init.zeros_(networks[name].classes.weight)
        networks[name].classes.bias.data = 40.0 * torch.nn.functional.one_hot(torch.tensor(number), 20)
    network = Cascade(learned.network.coarse, learned.network.fill, **networks)
    model = replace(learned, network=network)
    (drawn,), (plain,) = (one.generate(1, steps=2) for one in (model.with_labels(), model))
    assert drawn.label is not None and (drawn.label[drawn.mask] == building).all() and plain.label is None
    np.testing.assert_array_equal(drawn.range, plain.range)
    filled = model.into(SMALL).with_labels().complete(replace(perfect(SMALL)[::3], label=None)).to_scan()
    assert filled.label is not None and (filled.label == road).all()


def test_a_street_is_sketched_as_generation_would_after_its_layout(learned: CascadeModel):
    metres = np.full((SMALL.height, SMALL.width), 9, np.float32)
    street = RangeImage(metres, metres / 30, metres > 0, SMALL)
    model = learned.into(SMALL)
    (first, other), (again, _) = (model.sketched([street, street], seed=3) for _ in range(2))
    assert first.shape == street.shape and not np.array_equal(first.range, other.range)
    np.testing.assert_array_equal(first.range, again.range)
    told = np.ix_(*grid_of(SMALL))
    assert first.mask[told].all()
    np.testing.assert_allclose(np.median(first.range[told]), 9, rtol=0.01)


def test_what_is_rarer_in_layouts_is_named_less_often_in_generated_scans_alone(learned: CascadeModel):
    classes = ClassUNet(8).eval()
    torch.nn.init.zeros_(classes.classes.weight)
    truck, building = (CLASS_NUMBER[word] for word in ("truck", "building"))
    bias = torch.zeros(20)
    bias[truck], bias[building] = 21.0, 20.0  # before what learning gave rare ones is taken off
    classes.classes.bias.data = bias + torch.from_numpy(FAIR * np.log(weights())).float()
    network = Cascade(learned.network.coarse, learned.network.fill, classes=classes)
    model = replace(learned, network=network).with_labels()
    (drawn,) = model.generate(1, steps=2)
    assert drawn.label is not None and (drawn.label[drawn.mask] == building).all()
    filled = model.into(SMALL).complete(replace(perfect(SMALL)[::3], label=None)).to_scan()
    assert filled.label is not None and (filled.label == truck).all()


def test_bf16_errs_little_and_auto_asks_the_processor(model: CascadeModel, monkeypatch: pytest.MonkeyPatch):
    image = SyntheticStreets(3, 1, SMALL).image(0)
    known = corrupt(image, "beams:4")
    exact, quick = (model.at_precision(word).complete(image.keep(known), known) for word in ("fp32", "bf16"))
    both = exact.mask & quick.mask & ~known
    off = np.abs(exact.range - quick.range)[both] / exact.range[both]
    assert off.any() and np.median(off) < 2e-3 and (exact.mask == quick.mask).mean() > 0.99
    np.testing.assert_array_equal(quick.range[known], exact.range[known])
    asked = model.complete(image.keep(known), known, precision="bf16")
    np.testing.assert_array_equal(asked.range, quick.range)
    for has in (False, True):
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda has=has: {"amx_bf16": has}, raising=False)
        assert model.at_precision("auto").precision == ("bf16" if has else "fp32")
    with pytest.raises(ValueError, match="expected a precision of auto, fp32, bf16, found 'fp8'"):
        model.at_precision("fp8")


@pytest.mark.parametrize(("of", "flags", "faster"), [
    ("Intel Xeon", {"amx_bf16": True, "avx512_bf16": True}, True),
    ("Intel Xeon", {"avx512_bf16": True}, False),  # as where a virtual machine has no AMX
    ("AMD EPYC 9R14", {"avx512_bf16": True}, True),
    ("AMD EPYC 7R13", {"avx512_bf16": False}, False),
])  # fmt: skip
def test_auto_takes_bf16_where_it_is_faster(
    of: str, flags: dict[str, bool], faster: bool, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"cpu_name": of} | flags, raising=False)
    assert resolved_precision("auto", torch.device("cpu")) == ("bf16" if faster else "fp32")


class Constant(CoarseUNet):
    """Believes in one grid: the velocity that leads there from anywhere."""

    def __init__(self, grid: torch.Tensor):
        torch.nn.Module.__init__(self)
        self.grid = grid

    def forward(self, x_t: torch.Tensor, log_snr: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
        return (x_t - self.grid) / torch.sigmoid(-log_snr / 2)[:, None, None, None]


def test_a_guide_is_led_away_from_and_the_rest_of_noise_is_taken_off(model: CascadeModel):
    rng = torch.Generator().manual_seed(0)
    good, bad, x_t = torch.randn(3, 2, 3, 16, 128, generator=rng)
    rays, log_snr = torch.zeros(2, 8, 16, 128), torch.tensor([0.0, 4.0])
    fill, t = model.network.fill, torch.sigmoid(-log_snr / 2)[:, None, None, None]
    alone, led = Cascade(Constant(good), fill), Cascade(Constant(good), fill, Constant(bad))
    assert_close(x_t - t * alone.velocity(x_t, log_snr, rays), good, rtol=0, atol=1e-5)
    beyond = good + GUIDANCE * (good - bad) * torch.tensor([1, 0])[:, None, None, None]  # the second has little noise
    assert_close(x_t - t * led.velocity(x_t, log_snr, rays), beyond, rtol=0, atol=1e-5)
    assert_close(led.settled(good + 0.1 * x_t, rays), good, rtol=0, atol=1e-5)


def test_a_scan_is_the_same_bit_by_bit_whatever_the_count_and_the_start(
    model: CascadeModel, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(cascade_model, "block", lambda *_: 2)
    told: list[int] = []
    four = model.generate(4, steps=2, seed=5, on_step=lambda: told.append(1))
    assert len(told) == 4 * model.generation_steps(2)
    (last,) = model.stream(4, steps=2, seed=5, first=3)
    three = model.generate(3, steps=2, seed=5)
    np.testing.assert_array_equal(last.range, four[3].range)
    for one, other in zip(three, four, strict=False):
        np.testing.assert_array_equal(one.range, other.range)
        np.testing.assert_array_equal(one.reflectance, other.reflectance)


def test_completion_asks_the_fill_of_least_error_and_generation_the_other(model: CascadeModel):
    streets = SyntheticStreets(5, 1, SMALL)
    image = streets.image(0)
    known = corrupt(image, "beams:4")
    network = copy.copy(model.network)
    network._modules = dict(model.network._modules)
    network.likeliest = FillUNet((16, 16, 16, 16)).eval()
    torch.nn.init.normal_(network.likeliest.out.weight, std=0.02)
    other = replace(model, network=network)
    plain, likely = (one.complete(image.keep(known), known) for one in (model, other))
    assert np.abs(plain.range - likely.range)[~known].max() > 0.01
    a, b = (one.complete(image.keep(known), known, method="sample", seed=1) for one in (model, other))
    np.testing.assert_array_equal(a.range, b.range)


def test_a_draft_is_noise_led_half_way_each_by_its_own_generator(model: CascadeModel):
    rays, standing = (part[None].expand(3, *part.shape) for part in grid_rays(
        SMALL, SMALL.blocked_rays(), grid_rows(SMALL.height), grid_columns(SMALL.width)))  # fmt: skip
    network = Cascade(model.network.coarse, model.network.fill)
    three = draft(network, rays, standing, generators(5, 3))
    (last,) = draft(network, rays[:1], standing[:1], generators(7, 1))
    assert_close(three[2], last, atol=1e-4, rtol=1e-4)
    assert (three[0] - three[1]).abs().max() > 0.1
    assert three[:, 6].unique().item() == pytest.approx(
        flow(BOUND).log_snr(torch.tensor(DRAFT)).item() / BOUND, abs=1e-5
    )
    quiet = draft(network, rays, standing, generators(5, 3), t=0.05)
    noise = (three[:, :2] - three[:, 2:4]).std(), (quiet[:, :2] - quiet[:, 2:4]).std()
    assert noise[1] < noise[0] / 4  # x_t and the mean of what it may become are the nearer, the less noise is left
    quick = draft(network, rays, standing, generators(5, 3), precision="bf16")
    assert 0 < (quick - three).abs().mean() < 0.01 and quick.dtype == torch.float32


def test_threads_are_as_before_when_columns_are_drawn():
    before, seen = torch.get_num_threads(), []

    def drawn() -> None:
        with one_thread():
            seen.append(torch.get_num_threads())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        drawn()
    assert seen == [1]
    assert torch.get_num_threads() == before


def test_columns_are_drawn_in_one_thread_and_all_else_as_before(model: CascadeModel):
    columns = ColumnTransformer(16, layers=1, pixel=16, blocks=1).eval()
    both = replace(model, network=Cascade(model.network.coarse, model.network.fill, None, columns))
    before, seen = torch.get_num_threads(), []
    torch.set_num_threads(2)
    try:
        both.generate(1, seed=5, on_step=lambda: seen.append(torch.get_num_threads()))
    finally:
        torch.set_num_threads(before)
    assert seen == [1] * 128 + [2]


def test_a_drawn_scan_which_is_one_of_many_has_no_confidence(model: CascadeModel):
    sure = load_parts("default")[0].confidence
    model = replace(model, experiment=replace(model.experiment, confidence=sure))
    rows, columns = np.arange(SMALL.height), np.arange(0, SMALL.width, 4)
    grid = torch.full((1, len(rows), len(columns)), 9.0)
    (image,) = model._filled_grids(grid, 0.02 * grid, rows, columns, generators(0, 1))
    assert image.confidence is None and image.mask.any()
    known = np.zeros(image.shape, bool)
    known[::2] = True
    assert model.complete(image.keep(known), known).confidence is not None
