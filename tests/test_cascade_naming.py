"""What returns are of: surroundings, lessons, the network and its loss."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.lidar.surroundings import CHANNELS, surroundings
from lidarsynth.networks.class_unet import MULTIPLE, RAYS, ClassUNet, around_the_turn
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.streets.varied import VariedStreets
from lidarsynth.systems.cascade.examples import CascadeBatch
from lidarsynth.systems.cascade.lessons import HEIGHT, WIDTH, Lessons, Pixels, _filled_in, lesson, lessons
from lidarsynth.systems.cascade.naming import (
    ALSO,
    PEOPLE,
    THOUSAND,
    NamingObjective,
    _on_true_beams,
    named,
    of_pieces,
    of_surfaces,
    sketched,
    weights,
)
from lidarsynth.systems.cascade.response import AS_STREETS
from lidarsynth.systems.cascade.scores import SEAM, lovasz
from lidarsynth.weights.load import load

WIDE = Sensor("wide", tuple(np.linspace(2, -24, 40).tolist()), 1024)


def kerb(sensor: Sensor, height: float = 0.1, edge: float = 4.0) -> RangeImage:
    """A plain that is `height` metres higher left of y = `edge`; a wall all around at 25 m."""
    direction = sensor.directions().astype(np.float64)
    pitch, roll = np.tan(np.radians(sensor.tilt))
    up = np.array([pitch, roll, 1.0])
    down = -(direction @ up)

    def plain(above: float) -> np.ndarray:
        return np.where(down > 1e-6, (sensor.mount - above) / np.maximum(down, 1e-6), 1e3)

    low, high = plain(0), plain(height)
    metres = np.where(high * direction[..., 1] > edge, high, low)
    metres = np.minimum(metres, 25 / np.hypot(direction[..., 0], direction[..., 1])).astype(np.float32)
    return RangeImage(metres, np.full(metres.shape, 0.3, np.float32), metres > 0, sensor)


def test_a_kerb_of_ten_centimetres_is_told_whatever_the_tilt_and_the_columns():
    for sensor in (WIDE, replace(WIDE, tilt=(3.0, -2.0)), replace(WIDE, mount=2.2), replace(WIDE, width=2048)):
        image = kerb(sensor)
        near = surroundings(image)
        y, away = image.points()[..., 1], np.hypot(*np.moveaxis(image.points()[..., :2], -1, 0))
        high, low = (away < 12) & (y > 4.2) & (y < 6), (away < 12) & (np.abs(y) < 3)
        assert np.median(near[7][high]) == pytest.approx(0, abs=0.3)  # 10 cm above the lowest around
        assert np.median(near[7][low]) == pytest.approx(-1, abs=0.3)
        assert np.median(near[5][high]) - np.median(near[5][low]) == pytest.approx(0.2, abs=0.05)


def test_walls_stand_and_grounds_lie():
    image = kerb(WIDE)
    away = np.hypot(*np.moveaxis(image.points()[..., :2], -1, 0))
    slope = surroundings(image)[4]
    wall = (away > 24.9) & np.roll(away > 24.9, -1, 0)
    assert np.median(slope[:-1][wall[:-1]]) > 2.2  # 1.5 pi / 2
    assert np.abs(np.median(slope[away < 12])) < 0.1


def test_what_is_empty_has_no_surroundings():
    image = kerb(WIDE).keep(np.zeros((40, 1024), bool))
    assert surroundings(image).shape == (CHANNELS, 40, 1024) and not surroundings(image).any()
    half = kerb(WIDE).keep(np.tile(np.arange(1024) < 512, (40, 1)))
    assert not surroundings(half)[:, :, 512:].any() and np.isfinite(surroundings(half)).all()


def test_the_network_goes_around_the_turn():
    torch.manual_seed(0)
    network = ClassUNet(8).eval()
    x = torch.randn(1, RAYS + CHANNELS, 32, 96)
    with torch.no_grad():
        whole, turned = network(x), network(x.roll(2 * MULTIPLE, -1))
    assert whole.shape == (1, 20, 32, 96)
    assert_close(turned, whole.roll(2 * MULTIPLE, -1), atol=1e-4, rtol=1e-4)
    assert around_the_turn(torch.arange(40.0)[None, None, None]).shape[-1] == 64


def test_lessons_are_of_any_sensor_and_of_their_seed_alone():
    streets = VariedStreets(5, 1 << 20)
    images = [streets.image(k) for k in range(0, 128, 16)]
    some = lessons(images, range(8))
    assert some.inputs.shape == (8, RAYS + CHANNELS, HEIGHT, WIDTH) and some.classes.shape == (8, HEIGHT, WIDTH)
    assert torch.isfinite(some.inputs).all() and some.inputs.abs().max() < 20
    assert not some.classes[some.inputs[:, 0] == 0].any()  # nothing returned, nothing to name
    assert (some.classes[some.inputs[:, 0] > 0] > 0).float().mean() > 0.99
    again = lessons(images[2:4], (2, 3))  # two cuts of every second image
    assert_close(again.inputs, some.inputs[2:4])
    low = next(image for image in images if image.shape[0] < HEIGHT)
    inputs, classes = lesson(low, np.random.default_rng(1))
    assert not inputs[:, 0, low.shape[0] :].any() and not classes[:, low.shape[0] :].any()


def test_half_of_the_lessons_are_less_rough_than_recorded():
    image = kerb(SENSORS["hdl-64e-kitti"])
    noise = np.random.default_rng(0).normal(1, 0.004, image.shape).astype(np.float32)
    rough = replace(image, range=image.range * noise, surface=image.range, label=np.full(image.shape, 9))
    bends = [float(lesson(rough, np.random.default_rng(k))[0][0, 10].mean()) for k in range(60)]
    as_recorded = np.median(sorted(bends)[30:])
    assert sum(bend > as_recorded - 0.15 for bend in bends) in range(18, 46) and min(bends) < as_recorded - 0.5


def test_what_lies_between_known_beams_is_of_one_surface_with_them_or_of_one_of_them():
    image = kerb(SENSORS["hdl-64e-kitti"])
    metres = image.range.copy()
    metres[:, 200:204] = np.minimum(metres[:, 200:204], 6.0)  # a post
    label = np.where(metres == 6, 18, 9)
    seen = Pixels(metres, metres / 50, label)
    for seed in range(8):
        found = _filled_in(seen, image.sensor, np.random.default_rng(seed))
        off = np.abs(found.metres - metres) / metres
        changed = off > 0.01
        assert changed.mean() < 0.25 and np.median(off) < 1e-3  # ground and walls go on
        post = np.abs(found.metres - 6) < 0.05
        assert (found.label[post & (off > 0.1)] == 18).all()  # what is drawn as the post is of its class


def batch(inputs: torch.Tensor, classes: torch.Tensor) -> CascadeBatch:
    return CascadeBatch(None, None, None, None, Lessons(inputs, classes, (0, 1)))  # type: ignore[arg-type]


def test_the_loss_is_none_where_all_is_right_and_minds_no_ends_and_nothing_unnamed():
    class Echo(torch.nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return 40 * torch.nn.functional.one_hot(x[:, 0].long(), 20).permute(0, 3, 1, 2).float()

    classes = torch.randint(1, 20, (2, 64, 256), generator=torch.Generator().manual_seed(0))
    classes[classes == 12] = 1  # no street has other ground
    objective, said = NamingObjective(Echo()), classes.clone()  # type: ignore[arg-type]
    said[..., :SEAM], said[:, 0] = 3, 3
    classes[:, 0] = 0
    right = objective(batch(said[:, None].float(), classes))["named"]
    assert right.shape == (2,) and right.max() < 1e-3
    said[0, 5:20] = 7
    wrong = objective(batch(said[:, None].float(), classes))["named"]
    assert wrong[0] > wrong[1] > 0.05


def test_inside_buildings_returns_may_be_of_none_and_what_is_empty_is_not_judged():
    class Echo(torch.nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return 40 * torch.nn.functional.one_hot(x[:, 1].long(), 20).permute(0, 3, 1, 2).float()

    classes = torch.randint(0, 20, (2, 64, 256), generator=torch.Generator().manual_seed(0))
    back = torch.ones(2, 64, 256)
    back[:, :8] = 0
    said = classes.clone()
    said[:, :8] = 3
    objective = NamingObjective(Echo(), inside=True)  # type: ignore[arg-type]
    assert objective(batch(torch.stack([back, said], 1), classes))["inside"].max() < 1e-3
    said[0][classes[0] == 0] = 13  # furniture, taken for walls
    wrong = objective(batch(torch.stack([back, said], 1), classes))["inside"]
    assert wrong[0] > wrong[1] > 0.01
    classes[0] = 0  # of a scan that nobody has labelled
    unsaid, _ = objective(batch(torch.stack([back, said], 1), classes))["inside"]
    alone = objective(batch(torch.stack([back, said], 1)[1:], classes[1:]))["inside"]
    assert unsaid < 1e-3 and alone.max() < 1e-3


def sure(word: str) -> ClassUNet:
    """A network to which all is of one class."""
    network = ClassUNet(8).eval()
    torch.nn.init.zeros_(network.classes.weight)
    torch.nn.init.zeros_(network.classes.bias)
    network.classes.bias.data[CLASS_NUMBER[word]] = 40
    return network


@pytest.mark.parametrize(
    ("said", "found"),
    [("other-ground", "other-ground"), ("unlabeled", "unlabeled"), ("road", "car"), ("building", "car")],
)
def test_the_network_of_insides_is_believed_where_it_sees_floors_or_furniture(said: str, found: str):
    (image,) = named(sure("car"), [kerb(WIDE)], AS_STREETS, WIDE, inside=sure(said))
    assert image.label is not None and (image.label[image.mask] == CLASS_NUMBER[found]).all()
    assert not image.label[~image.mask].any()


@pytest.mark.parametrize(("which", "found"), [("other-ground", "building"), ("road", "car")])
def test_a_network_of_its_own_may_say_which_scans_are_of_insides(which: str, found: str):
    """The other one, that names what is there, would say no of the first, in which it sees walls alone."""
    networks = sure("building"), sure(which)
    (image,) = named(sure("car"), [kerb(WIDE)], AS_STREETS, WIDE, inside=networks[0], indoors=networks[1])
    assert image.label is not None and (image.label[image.mask] == CLASS_NUMBER[found]).all()


def test_the_lovasz_softmax_is_one_less_the_iou_of_sure_answers():
    label = torch.tensor([1] * 60 + [2] * 40)
    said = torch.tensor([1] * 50 + [2] * 50)  # IoU 50 / 60 and 40 / 50
    loss = lovasz(60 * torch.nn.functional.one_hot(said, 4).float(), label)
    assert loss.item() == pytest.approx(1 - (50 / 60 + 40 / 50) / 2, abs=1e-5)
    assert lovasz(torch.zeros(0, 4), torch.zeros(0, dtype=torch.long)).item() == 0


def test_every_return_gets_a_class_and_nothing_else_does():
    torch.manual_seed(0)
    sensor = replace(WIDE, width=1000)  # no multiple of anything
    image = kerb(sensor).keep(np.random.default_rng(0).random((40, 1000)) < 0.8)
    images = [image, image.keep(np.zeros(image.shape, bool)), *[image] * 4]
    found = named(ClassUNet(8).eval(), images, AS_STREETS, sensor)
    for before, after in zip(images, found, strict=True):
        assert after.label is not None and not after.label[~before.mask].any()
        assert set(np.unique(after.label[before.mask])) <= set(range(1, 20))
        assert after.range is before.range
    np.testing.assert_array_equal(found[0].label, found[-1].label)  # alone or among others


def test_what_is_filled_in_lies_as_high_as_what_was_measured_around():
    image = kerb(replace(WIDE, offsets=tuple(np.linspace(0.2, 0.0, 40).tolist())), height=0.0)
    true = replace(image.sensor, elevations=tuple((np.array(image.sensor.elevations) - 0.6).tolist()))
    away = np.hypot(*np.moveaxis(true.points(image.range)[..., :2], -1, 0))
    ranges = np.where(away < 24, kerb(true, height=0.0).range, image.range)  # as beams that look lower see the plain
    xyz = true.points(ranges)
    known = np.zeros(image.shape, bool)
    known[::4] = True
    filled = RangeImage(ranges, image.reflectance, image.mask, image.sensor, xyz=np.where(known[..., None], xyz, 0))
    plain = (xyz[..., 2] < -1.5) & (away < 20)
    assert np.abs((filled.points() - xyz)[plain][:, 2]).max() > 0.15
    assert np.abs((_on_true_beams(filled).points() - xyz)[plain][:, 2]).max() < 0.02
    assert _on_true_beams(image) is image


def test_of_classes_that_look_alike_the_common_one_is_named():
    """Learned with more weight, a rare class would be named too often."""
    torch.manual_seed(0)
    network = ClassUNet(8).eval()
    torch.nn.init.zeros_(network.classes.weight)
    torch.nn.init.zeros_(network.classes.bias)
    (image,) = named(network, [kerb(WIDE)], AS_STREETS, WIDE)
    assert image.label is not None and (image.label[image.mask] == int(np.argmax(THOUSAND))).all()
    assert (weights() * np.array(THOUSAND)).sum() == pytest.approx(1000)


def test_what_gets_more_is_named_more_often():
    torch.manual_seed(3)
    network, images = ClassUNet(8).eval(), [kerb(WIDE)]
    green = 15
    plain, more = (named(network, images, AS_STREETS, WIDE, more=told)[0].label for told in (None, {"vegetation": 9.0}))
    assert plain is not None and more is not None
    assert (more == green).sum() > (plain == green).sum()
    kept = more != green
    np.testing.assert_array_equal(more[kept], plain[kept])


def test_more_may_be_of_each_row_and_greenery_gets_it_above_the_horizon():
    torch.manual_seed(3)
    network, images, green = ClassUNet(8).eval(), [kerb(WIDE)], CLASS_NUMBER["vegetation"]
    rows = np.where(np.arange(WIDE.height) < 10, 9.0, 0.0)
    plain, more, all_of_them = (named(network, images, AS_STREETS, WIDE, more=told, alone=True)[0].label
                                for told in (None, {"vegetation": rows}, {"vegetation": 9.0}))  # fmt: skip
    assert plain is not None and more is not None and all_of_them is not None
    np.testing.assert_array_equal(more[:10], all_of_them[:10])
    np.testing.assert_array_equal(more[10:], plain[10:])
    assert (more[:10] == green).sum() > (plain[:10] == green).sum()
    greener = sketched(SENSORS["os1-64"])["vegetation"]
    up = np.asarray(SENSORS["os1-64"].elevations)
    assert isinstance(greener, np.ndarray) and (np.diff(greener) <= 0).all()
    assert np.ptp(greener[up < 2]) == 0 and greener[up > 6] == pytest.approx(greener[-1] + 1)
    np.testing.assert_array_equal(sketched(SENSORS["hdl-64e-kitti"])["vegetation"], greener[-1])


def test_pixels_of_a_surface_are_named_together_and_edges_stay():
    metres = torch.full((8, 32), 10.0)
    metres[:, 16:] = 12.0  # a step, and behind it another class
    metres[4, 5] = 0
    chances = torch.zeros(3, 8, 32)
    chances[0, :, :16], chances[1, :, 16:] = 1.0, 1.0
    chances[:, 2, 8] = torch.tensor([0.4, 0.0, 0.6])  # one pixel of a wall that is taken for a pole
    chances[:, 4, 5] = torch.tensor([0.0, 0.0, 1.0])  # and one that did not return
    mean = of_surfaces(chances, metres)
    assert_close(mean.sum(0), torch.ones(8, 32))
    assert int(mean[:, 2, 8].argmax()) == 0
    assert (mean[0, :, 14:16] > 0.9).all() and (mean[1, :, 16:18] == 1).all()
    assert mean[0, 0, 0] == 1 and mean[1, 0, 31] == 1  # around the turn, but no nearer to each other
    assert_close(mean[:, 4, 5], chances[:, 4, 5])


def test_pieces_inside_are_wholly_people_or_furniture_and_all_else_stays():
    person, wall = CLASS_NUMBER["person"], CLASS_NUMBER["building"]
    metres = torch.full((4, 32), 9.0)
    metres[:, 2:6], metres[:, 10:14], metres[0, 20] = 3.0, 4.0, 0.0
    chances = torch.full((20, 4, 32), 1e-3)
    chances[wall] = 0.9
    chances[wall, :, 2:6], chances[wall, :, 10:14] = 0.1, 0.1
    chances[0, :, 2:6], chances[person, :, 2:6] = 0.2, 0.6
    chances[0, 1, 2:6], chances[person, 1, 2:6] = 0.6, 0.2  # a part of the first that looks like furniture
    chances[0, :, 10:14], chances[person, :, 10:14] = 0.6, 0.2
    alike = torch.full_like(chances, math.exp(-PEOPLE / ALSO))  # streets' network says nothing either way
    whole = of_pieces(chances, alike, metres)
    label = whole.argmax(0)
    assert (label[:, 2:6] == person).all() and (label[:, 10:14] == 0).all()
    assert (label[:, 14:] == wall).all() and (label[:, :2] == wall).all()
    assert_close(whole.sum(0), chances.sum(0))
    surely = alike.clone()
    surely[person] = 1.0
    assert (of_pieces(chances, surely, metres).argmax(0)[:, 10:14] == person).all()
    assert_close(of_pieces(chances, alike, torch.zeros_like(metres)), chances)  # nothing returned


def test_streets_that_a_robot_sees_are_no_insides_of_buildings():
    low = replace(SENSORS["vlp-16"], width=1024, mount=0.3)
    streets, model, floors = SyntheticStreets(98_003, 160, low), load("default").into(low), 0
    for image in map(streets.image, range(0, 160, 32)):
        label = model.label(replace(image, label=None).to_scan()).label
        assert label is not None
        floors += (label == CLASS_NUMBER["other-ground"]).mean() > 0.05
    assert floors <= 1, "all five of them, before the network of insides had seen such streets"
