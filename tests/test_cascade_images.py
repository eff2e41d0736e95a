"""What makes generated images look recorded: coherent returns, speckle by class, one reflectance for a surface."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import lidarsynth as ls
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.networks.column_neighbours import known_grid
from lidarsynth.networks.fill_unet import draw_coherent, draw_noise
from lidarsynth.networks.rays import decode_range, encode_range
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade.hanging import landed
from lidarsynth.systems.cascade.images import TEXTURE, agreed, as_read, grid_of, noisy, with_doubts
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.cascade.surfaces import along_rings, evened, paved


def test_the_noise_of_returning_is_alike_around():
    noise = draw_coherent((1, 256, 1024), torch.Generator().manual_seed(0))[0, 0]
    assert abs(float(noise.std()) - 1) < 0.05
    along, down, apart = (float((noise * noise.roll(k, (0, 1))).mean()) for k in ((0, 2), (2, 0), (0, 9)))
    assert 0.7 < along < 0.85 and 0.3 < down < 0.45 and abs(apart) < 0.05  # exp(-d^2 / 4 s^2)
    assert torch.equal(*(part[0, 1:] for part in (draw_coherent((1, 32, 64), rng(3)), draw_noise((1, 32, 64), rng(3)))))


def test_rays_between_two_that_agree_do_as_they_do():
    sensor = replace(SENSORS["vlp-16"], width=512)
    columns, shape = np.arange(1, 512, 2), (16, 512)
    metres = np.zeros((1, 16, 256), np.float32)
    metres[:, :, 10:20] = 9
    empty, full = np.zeros(shape, np.float32), np.full(shape, 7, np.float32)
    nothing = RangeImage(empty, empty, empty > 0, sensor)
    everything = RangeImage(full, full / 10, full > 0, sensor)
    (lit,) = agreed([nothing], [everything], metres, columns)
    between = lit.mask[:, 0::2]  # of column 2 k, before the known number k
    assert between[:, 11:20].all() and not between[:, :11].any() and not between[:, 20:].any()
    assert (lit.range[:, 22:39:2] == 7).all() and (lit.reflectance[:, 22:39:2] == np.float32(0.7)).all()
    (dark,) = agreed([everything], [nothing], metres, columns)
    assert dark.mask[:, 20:41].all() and dark.mask.sum() == 16 * 21
    sparse = metres[..., ::2]
    assert agreed([everything], [nothing], sparse, columns[::2])[0] is everything


def rng(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_speckle_is_that_of_the_class_and_leaves_the_mean_alone():
    even = np.full((64, 512), 0.3, np.float32)
    even[:32] = 0
    label = np.full((64, 512), CLASS_NUMBER["road"])
    label[:, 256:] = CLASS_NUMBER["vegetation"]
    sensor = replace(SENSORS["vlp-16"], elevations=tuple(np.linspace(5, -25, 64).tolist()), width=512)
    image = RangeImage(np.full((64, 512), 9, np.float32), even, np.ones((64, 512), bool), sensor, label)
    read = as_read(image, even, rng(0)).reflectance
    dark, road, leaves = read[:32], read[32:, :256], read[32:, 256:]
    assert (dark[:, :256] == 0).all() and dark.mean() < 0.01
    assert abs(road.mean() - 0.3) < 0.01 and abs(leaves.mean() - 0.3) < 0.04
    assert 0.01 < road.std() < 0.05 and leaves.std() > 2 * road.std()
    plain = as_read(replace(image, label=None, mask=image.mask & (label > 9)), even, rng(0)).reflectance
    assert road.std() < plain[32:, 256:].std() and not plain[:, :256].any()


def test_reflectances_of_one_surface_are_evened_and_kerbs_stay():
    noise = 0.02 * torch.randn(1, 16, 128, generator=rng(0))
    metres, shade = torch.full((1, 16, 128), 10.0), torch.full((1, 16, 128), 0.3)
    metres[..., 64:], shade[..., 32:64] = 20, 0.5
    shade[..., 64:] = 0.8
    metres[:, 5, 10] = 0
    told = torch.zeros(1, 8, 16, 128)
    told[:, 1] = 2 * encode_range(metres)  # all is flat ground
    found = evened(known_grid(metres, shade + noise), told)
    for part, level in ((slice(2, 30), 0.3), (slice(34, 62), 0.5), (slice(66, 126), 0.8)):
        assert abs(float(found[0, :, part].mean()) - level) < 0.02
    rest = (found - shade)[0, :, 12:30]
    assert rest.std() < 0.5 * noise.std() and found[0, 5, 10] == 0
    assert_close(found[0, 4:7, 9:12].flatten()[[0, 2, 6, 8]], torch.full((4,), 0.3), atol=0.03, rtol=0)
    shade[:, -1] += 0.03  # the lowest beam is no neighbour of the highest
    again = evened(known_grid(metres, shade + noise), told)
    assert torch.equal(again[:, :10], found[:, :10]) and not torch.equal(again[:, 12:], found[:, 12:])


def test_what_stands_before_a_wall_does_not_melt_into_it():
    """Post 8 % before a wall: both keep their edge, while noise of 0.15 % is straightened."""
    metres = torch.full((1, 16, 512), 10.0)
    metres[..., 100:120] = 9.2
    noise = 1 + 0.0015 * torch.randn(metres.shape, generator=rng(1))
    found = along_rings(metres * noise)
    assert (found / metres - 1).abs().max() < 0.02
    assert (found / metres - 1)[..., 20:90].std() < 0.5 * (noise - 1).std()


def test_paved_ground_is_level_and_kerbs_and_grass_stay():
    sensor = replace(SENSORS["vlp-16"], width=512)
    metres, shape = np.full((16, 512), 8.0, np.float32), (16, 512)
    metres[:, 100:200] = 7.7  # a sidewalk beside the road
    metres[3, 300] = 0  # no return
    metres *= 1 + 0.001 * np.random.default_rng(0).standard_normal(shape).astype(np.float32)
    label = np.full(shape, CLASS_NUMBER["road"])
    label[:, 100:200], label[:, 400:] = CLASS_NUMBER["sidewalk"], CLASS_NUMBER["terrain"]
    found = paved(RangeImage(metres, np.zeros(shape, np.float32), metres > 0, sensor, label)).range
    edge = np.isin(np.arange(512), [0, 99, 100, 199, 200, 299, 300, 301, 399])
    level = ~edge & (np.arange(512) < 400)
    steps, before = (np.abs(np.diff(part[:3], axis=1)[:, level[1:] & level[:-1]]) for part in (found, metres))
    assert steps.mean() < 0.4 * before.mean()
    assert np.abs(found / np.maximum(metres, 1) - metres / np.maximum(metres, 1)).max() < 0.005  # no slope at the kerb
    assert np.array_equal(found == 0, metres == 0)
    assert_close(found[:, 400:], metres[:, 400:], rtol=1e-6, atol=0)
    assert_close(found[:, [99, 100, 199, 200]], metres[:, [99, 100, 199, 200]], rtol=1e-6, atol=0)


def test_classes_are_drawn_by_their_chances_and_alike_side_by_side():
    chances = torch.tensor([0.0, 0.5, 0.3, 0.2])
    logits = chances.clamp_min(1e-6).log()[None, :, None, None].expand(40, 4, 16, 512)
    drawn = with_doubts(logits, [rng(k) for k in range(40)])
    assert drawn is not None
    kinds = drawn.argmax(1)
    shares = torch.bincount(kinds.flatten(), minlength=4) / kinds.numel()
    assert_close(shares, chances, atol=0.03, rtol=0)
    assert (kinds == kinds.roll(1, 2)).float().mean() > 0.95
    sure = torch.where(torch.arange(4) == 2, 20.0, 0.0)[None, :, None, None].expand(1, 4, 16, 512)
    assert (with_doubts(sure, [rng(0)]).argmax(1) == 2).all()  # type: ignore[union-attr]
    assert with_doubts(logits, None) is None and with_doubts(None, [rng(0)]) is None


def test_a_sample_has_the_texture_of_the_class_that_was_drawn_and_the_likeliest_label():
    terrain, road = CLASS_NUMBER["terrain"], CLASS_NUMBER["road"]
    sensor = replace(SENSORS["vlp-16"], width=512)
    full = np.full((16, 512), 10.0, np.float32)
    label = np.full(full.shape, road)
    label[:, 256:] += TEXTURE * terrain
    image = RangeImage(full, full / 40, full > 0, sensor, label)
    seen = noisy(image, rng(0))
    assert (seen.label == road).all()
    smooth, rough = (seen.range - full)[:, :256].std(0).mean(), (seen.range - full)[:, 256:].std(0).mean()
    assert 0.025 < rough < 0.04 and smooth < 0.5 * rough
    read = as_read(image, image.reflectance, rng(0)).reflectance
    assert read[:, 256:].std() > 1.5 * read[:, :256].std()


def test_noise_stays_within_the_limits_of_the_sensor():
    sensor = SENSORS["vlp-16"]
    ends = np.resize(np.float32([sensor.min_range, sensor.max_range]), (16, sensor.width))
    seen = noisy(RangeImage(ends, ends / 200, ends > 0, sensor), rng(0)).range
    assert seen.min() >= np.float32(sensor.min_range) and seen.max() <= sensor.max_range and (seen != ends).any()


def test_a_drawn_scan_is_rough_where_greenery_is_seen_in_it(monkeypatch: pytest.MonkeyPatch):
    """Whatever the fill drew, the classes that are seen in the result decide, and are its labels."""
    model = ls.load("default").into("vlp-16")
    assert isinstance(model, CascadeModel)
    seen = []
    for word, pierced in (("road", 0.2), ("vegetation", 0.0), ("vegetation", 0.2)):
        monkeypatch.setattr("lidarsynth.systems.cascade.foliage.PIERCED", pierced)

        def all_of(network, images, *_, of=CLASS_NUMBER[word], **__):
            return [replace(image, label=np.where(image.mask, of, 0)) for image in images]

        monkeypatch.setattr("lidarsynth.systems.cascade.model.named", all_of)
        (image,) = model.generate(1, labels=True)
        assert image.label is not None and (image.label[image.mask] == CLASS_NUMBER[word]).all()
        seen.append(image)
    smooth, rough = (np.abs(np.diff(image.range, 2, axis=1))[:, 8:-8] for image in seen[:2])
    assert (seen[0].mask == seen[1].mask).all()
    assert 0 < (seen[0].mask != seen[2].mask).mean() < 0.1  # through leaves to the sky, and never through a road
    assert np.median(rough[rough > 0]) > 2 * np.median(smooth[smooth > 0])


def test_three_tenths_of_what_hangs_are_taken_away_and_what_stands_stays():
    metres, shade = np.full((1, 32, 256), 20.0, np.float32), np.full((1, 32, 256), 0.3, np.float32)
    metres[:, 24:] = 8  # ground, nearer than the wall
    metres[0, 10:24, 40:44] = 7.5  # a post that stands on it
    metres[0, :6, 200:] = 0  # sky
    for k in range(12):
        metres[0, 12:15, 60 + 10 * k : 64 + 10 * k] = 10 + 0.1 * k
        shade[0, 12:15, 60 + 10 * k : 64 + 10 * k] = 0.9
    metres[0, 12:15, [255, 0]] = 11  # across the seam
    parts = torch.from_numpy(metres), torch.from_numpy(shade)
    left = []
    for seed in range(30):
        grid = landed(known_grid(*parts), [rng(seed)])
        found = (decode_range(grid.code) * grid.returned)[0].numpy()
        there = [found[13, 61 + 10 * k] < 15 for k in range(12)] + [found[13, 0] < 15]
        assert there[-1] == (found[13, 255] < 15)
        left.append(np.mean(there))
        for k, stays in enumerate(there[:12]):
            place = np.s_[12:15, 60 + 10 * k : 64 + 10 * k]
            np.testing.assert_allclose(found[place], 10 + 0.1 * k if stays else 20, rtol=1e-3)
            assert_close(grid.shade[0][place], torch.full((3, 4), 0.9 if stays else 0.3))
        rest = np.ones(found.shape, bool)
        rest[12:15] = False
        np.testing.assert_allclose(found[rest], metres[0][rest], rtol=1e-4)
        np.testing.assert_allclose(found[12:15, 40:44], 7.5, rtol=1e-4)
    assert 0.6 < np.mean(left) < 0.8 and min(left) < 0.7 < max(left)


def test_a_beam_far_above_the_others_is_drawn_with_the_grid():
    """Walls went on to it: of a VLP-32C's highest beam, 5 degrees above the next one, 68 % returned, for 54."""
    for name, first in (("vlp-32c", 0), ("pandar64", 0), ("hdl-64e-kitti", 2), ("hdl-32e", 1), ("os1-128", 4)):
        rows, columns = grid_of(SENSORS[name])
        assert rows[0] == first
        assert len(rows) == 16
        assert (np.diff(rows) == SENSORS[name].height // 16).all()
        assert len(columns) == 128


def test_beams_between_those_of_a_tall_grid_are_as_smooth_as_these():
    """Of an OS1-128 every second beam is left to the fill, which was told every second column, too, and made rings of
    them that strayed by 15 cm."""
    sensor = SENSORS["os1-128"]
    street = SyntheticStreets(616, 16, sensor).image(4)
    (drawn,) = ls.load("default").into(sensor).sketched([street], seed=1)
    flat = np.arange(90, 120)  # beams of -9 to -20 degrees
    log = np.log(np.maximum(drawn.range, 0.1))
    bend = np.abs(2 * log - np.roll(log, 1, 1) - np.roll(log, -1, 1))
    ground = drawn.mask & street.mask & np.isin(street.label, [CLASS_NUMBER["road"], CLASS_NUMBER["sidewalk"]])
    rows = [np.median(bend[row][ground[row]]) for row in flat]
    assert np.median(rows[1::2]) < 1.5 * np.median(rows[::2])
    assert np.median(rows[::2]) < 1.5 * np.median(rows[1::2])
