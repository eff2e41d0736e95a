"""Things in a range image, and noise that is alike on each: against geometry that is known."""

from __future__ import annotations

import numpy as np
import torch

from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.networks.fill_unet import draw_noise
from lidarsynth.networks.rays import Rays, rays_of
from lidarsynth.networks.things import NONE, draw_on_things, things

SENSOR = SENSORS["hdl-32e"].resized(width=512)


def scene() -> tuple[torch.Tensor, Rays]:
    """Flat ground to a wall 20 m around, two posts 8 m away side by side, one where the turn ends, and some sky."""
    rays = rays_of(SENSOR, SENSOR.blocked_rays())
    metres = rays.ground.clamp(max=20.0).expand(1, 1, 32, 512).clone()
    high = slice(0, 14)
    for columns in (slice(100, 120), slice(121, 140)):
        metres[0, 0, high, columns] = 8
    metres[0, 0, high, :10] = metres[0, 0, high, -10:] = 8
    metres[0, 0, :4, 300:400] = 0
    return metres, rays


def test_what_stands_apart_is_apart_and_the_turn_has_no_end():
    metres, rays = scene()
    (of,) = things(metres, rays)
    posts = [np.unique(of[:14, part]) for part in (slice(100, 120), slice(121, 140), slice(0, 10), slice(-10, None))]
    assert all(len(post) == 1 and post[0] != NONE for post in posts)
    assert len({int(post[0]) for post in posts}) == 3 and posts[2] == posts[3]
    wall = of[metres[0, 0].numpy() == 20]
    assert np.unique(wall[wall != NONE]).size <= 4  # a strip of it stands between two posts
    assert (of[:4, 300:400] == NONE).all()
    assert (of[metres[0, 0].numpy() == rays.ground[0, 0].expand(32, 512).numpy()] == NONE).all()


def test_images_of_a_batch_are_apart():
    metres, rays = scene()
    both = things(torch.cat([metres, metres]), Rays(*(part.expand(2, *part.shape[1:]) for part in rays)))
    np.testing.assert_array_equal(both[0] == NONE, both[1] == NONE)
    assert not set(np.unique(both[0])) & set(np.unique(both[1])) - {NONE}
    for image in both:  # the same parts, whatever their numbers
        pairs = set(zip(image.ravel().tolist(), things(metres, rays)[0].ravel().tolist(), strict=True))
        assert len(pairs) == len(np.unique(image))


def test_noise_is_alike_on_a_thing_and_unit_over_many():
    of = np.repeat(np.arange(-1, 999)[:, None], 32, 1)
    noise = draw_on_things(of, torch.Generator().manual_seed(0))
    plain = draw_noise((1, 1000, 32), torch.Generator().manual_seed(0))
    assert torch.equal(noise[:, :2], plain[:, :2])
    each = noise[0, 2, 1:]
    assert (each == each[:, :1]).all() and abs(float(each.mean())) < 0.15 and abs(float(each.std()) - 1) < 0.1


def test_noise_of_the_ground_is_smooth_around_the_turn_and_unit():
    fields = [draw_on_things(np.full((64, 1024), NONE), torch.Generator().manual_seed(k))[0, 2] for k in range(60)]
    field = torch.stack(fields)
    around = torch.cat([field, field[..., :1]], -1)
    assert float(around.diff(dim=-1).abs().max()) < 0.5 and float(field.diff(dim=1).abs().max()) < 1.5
    assert float((field.std(0) - 1).abs().mean()) < 0.12 and float(field.mean(0).abs().mean()) < 0.15
    assert draw_on_things(np.full((16, 20), NONE)).shape == (1, 3, 16, 20)
