"""The observer: what it is shown of real scans and of streets, what it learns, and for which sensor it answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import Card
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.class_unet import ClassUNet
from lidarsynth.networks.coarse_unet import CoarseUNet
from lidarsynth.networks.fill_unet import NOISES, OUTPUTS, FillUNet, draw_noise
from lidarsynth.systems.cascade.examples import CascadeBatch, Crops, Seen, seen
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.cascade.observing import ObserverObjective, before_something, closed, on_surface

SENSOR = SENSORS["vlp-16"].resized(width=512)
WIDTHS = (16, 16, 16, 16)


def image_of(surface: bool = False) -> RangeImage:
    """A wall 10 m around, of whose rays two in three are lost, as bright as its column says."""
    full = np.full(SENSOR.directions().shape[:2], 10.0, np.float32)
    mask = np.arange(512)[None] % 3 == 0
    mask = np.broadcast_to(mask, full.shape)
    light = np.broadcast_to(np.linspace(0.1, 0.9, 512, dtype=np.float32), full.shape)
    return RangeImage(full * mask, light * mask, mask, SENSOR, surface=full if surface else None)


def batch_of(images: list[RangeImage]) -> CascadeBatch:
    each = [seen(image, np.random.default_rng(3)) for image in images]
    rays = type(each[0][0])(*(torch.cat(part) for part in zip(*(rays for rays, *_ in each), strict=True)))
    shown = Seen(rays, *(torch.cat(part) for part in zip(*(part for _, *part in each), strict=True)))
    none = torch.zeros(len(images), 1, 64, 256)
    crops = Crops(None, rays, none, none, none.long(), tuple(range(len(images))), 0)  # type: ignore[arg-type]
    return CascadeBatch(crops, None, None, None, None, shown)  # type: ignore[arg-type]


def fill(logit: float = 0.0) -> FillUNet:
    """One that says everywhere how likely a return is."""
    torch.manual_seed(0)
    network = FillUNet(WIDTHS)
    torch.nn.init.normal_(network.out.weight, std=0.02)
    with torch.no_grad():
        network.out.weight.view(8, OUTPUTS, -1)[:, -1 - NOISES] = 0
        network.out.bias.view(8, OUTPUTS)[:, -1 - NOISES] = logit
    return network


def test_what_is_seen_is_as_the_sensor_reports_it():
    image = image_of()
    for seed in range(8):
        rays, metres, reflectance, surface = seen(image, np.random.default_rng(seed))
        assert metres.shape == (1, 1, 64, 256) and rays.elevation.shape[2] == 64
        assert (surface == 0).all() and (metres[0, 0, 16:] == 0).all() and ((reflectance > 0) == (metres > 0)).all()
        values = np.unique(reflectance[reflectance > 0].numpy())
        assert np.isin(values, image.reflectance).all() and len(values) > 50


def test_holes_are_closed_before_surfaces_and_cast_ones_are_taken_as_they_are():
    batch = batch_of([image_of(), image_of(surface=True)])
    for logit in (5.0, -5.0):  # whether a return is expected there says nothing: simulators' surfaces all return
        known, lit = ObserverObjective(fill(), fill(logit), shining=False)._surfaces(batch.seen)
        real, street = known.metres[0, 0, :16], known.metres[1, 0, :16]
        measured = batch.seen.metres[0, 0, :16]
        assert_close(real[measured > 0], measured[measured > 0])
        assert (real[:, 8:-8] > 0).all() and not (real[:, (0, -1)][measured[:, (0, -1)] == 0] > 0).any()
        assert (street == batch.seen.surface[1, 0, :16]).all() and (street > 9 / 1.2).all()
        assert not known.told.any() and (known.reflectance == 0).all() and lit.flatten().tolist() == [1, 0]


def test_a_surface_is_below_a_return_or_between_two_and_the_sky_is_not():
    returned = torch.zeros(1, 1, 8, 90, dtype=torch.bool)
    returned[..., 3, 20] = True
    returned[..., 1, (2, 6, 40, 88)] = True
    step = torch.full((1, 1, 1, 1), np.radians(0.7))  # REACH is four of them
    part = before_something(returned, step)[0, 0]
    turn = before_something(torch.cat([returned, returned[..., :6]], -1), step, turn=90)[0, 0]
    assert (turn[:, 90:] == turn[:, :6]).all()
    for found in (part, turn[:, :90]):
        assert not found[0].any() and found[4:, 20].all() and found[1:, (2, 6, 40, 88)].all() and found[1, 2:7].all()
        assert not found[:, 21:40].any() and not found[2, 3:6].any()
    assert turn[1, [88, 89, 0, 1, 2]].all() and not part[1, [89, 0, 1]].any()


def test_a_recorded_scan_closed_has_its_returns_and_no_sky():
    image = image_of()
    image = image.keep(np.broadcast_to(np.arange(16)[:, None] >= 4, image.shape))
    before = fill(-5.0)
    found = closed(before, image)
    assert (found.range[image.mask] == image.range[image.mask]).all() and not found.mask[:4].any()
    assert found.mask[4:].all() and (found.reflectance == 0).all() and found.sensor == image.sensor


@pytest.mark.parametrize("shining", [False, True])
def test_streets_teach_which_rays_return_and_how_bright_they_are_where_they_may(shining: bool):
    objective = ObserverObjective(fill(), fill(5.0), shining)
    batch = batch_of([image_of(), image_of(surface=True)])
    brighter = batch._replace(seen=batch.seen._replace(reflectance=batch.seen.reflectance / 2))
    fewer = batch._replace(seen=batch.seen._replace(metres=batch.seen.metres * (batch.seen.reflectance > 0.5)))
    losses, of_others, of_fewer = (objective(b)["observed"] for b in (batch, brighter, fewer))
    assert losses.shape == (2,) and torch.isfinite(losses).all()
    assert abs(losses[0] - of_others[0]) > 1e-3 and (losses[1] != of_others[1]) == shining
    assert abs(losses[1] - of_fewer[1]) > 1e-3


@pytest.mark.slow
def test_it_learns_how_many_are_lost_but_not_which():
    network = fill()
    objective = ObserverObjective(network, fill(5.0).eval(), shining=False)
    batch = batch_of([image_of(), image_of()])
    optimizer = torch.optim.Adam(network.parameters(), 3e-3)
    before = None
    for _ in range(60):
        loss = objective(batch)["observed"].mean()
        before = before or float(loss.detach())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert float(loss.detach()) < 0.7 * before
    known, _ = objective._surfaces(batch.seen)
    with torch.no_grad():
        filled = network.eval()(known, batch.seen.rays, draw_noise((2, 64, 256), torch.Generator().manual_seed(0)))
    chance = filled.logit.sigmoid()[:, :, :16, 16:-16]
    assert float(chance.mean()) == pytest.approx(1 / 3, abs=0.12)
    returned = (batch.seen.metres > 0)[:, :, :16, 16:-16]
    assert float(chance[returned].mean() - chance[~returned].mean()) < 0.2  # it is not told which


def test_something_behind_a_pane_is_not_of_its_surface():
    measured, surface = torch.tensor([0.0, 10.0, 10.2, 14.0, 10.0]), torch.tensor([10.0, 10.0, 10.0, 10.0, 0.0])
    assert on_surface(measured, surface).tolist() == [False, True, True, False, False]


def test_it_answers_for_all_sensors_in_place_of_the_fill():
    experiment = replace(preset("kitti"), card=Card())  # tuned to no sensor, it has nothing to say of this one
    torch.manual_seed(1)
    parts = {"observer": fill(-5.0).eval(), "classes": ClassUNet(8)}
    network = Cascade(CoarseUNet(16, (1, 1, 1, 1), 1), fill(5.0).eval(), **parts)  # type: ignore[arg-type]
    model = CascadeModel(network.eval(), SENSOR, experiment)
    scan = Scan(*(getattr(image_of(surface=True).to_scan(), name) for name in ("xyz", "reflectance")))
    assert len(model.realise(scan, SENSOR)) < 0.05 * len(scan)
    bare = replace(model, network=Cascade(network.coarse, network.fill))
    assert len(bare.realise(scan, SENSOR)) > 0.9 * len(scan)
    assert model.with_labels().realise(scan, SENSOR).label is None  # a simulator knows better
