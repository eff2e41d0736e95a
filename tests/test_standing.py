"""How high a sensor stands is seen in the scan: what is filled in, named and realised goes by it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.cli.main import main
from lidarsynth.lidar.ground import stance
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.streets.interiors import interiors
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade.known import standing

PLACES = (0, 16, 32, 48)  # of worlds of their own


def street(name: str, mount: float, place: int, tilt: tuple[float, float] = (0.0, 0.0), seed: int = 4321) -> RangeImage:
    """As seen from another height than the sensor's own, or tilted, of which nothing is said."""
    sensor = SENSORS[name]
    seen = SyntheticStreets(seed, 192, replace(sensor, mount=mount, tilt=tilt))
    return replace(seen.image(place), sensor=sensor)


def every(image: RangeImage, step: int) -> np.ndarray:
    known = np.zeros(image.shape, bool)
    known[::step] = True
    return known


@pytest.mark.parametrize("name", ["vlp-16", "os1-64", "hdl-32e"])
@pytest.mark.parametrize("mount", [0.5, 1.0, 3.2])
def test_the_ground_tells_how_high_a_sensor_stands(name: str, mount: float):
    for place in PLACES:
        image = street(name, mount, place)
        found = stance(image.sensor.points(image.range)[image.mask])
        if found is None:  # two of a VLP-16's beams meet the road within 25 m
            assert (name, mount) == ("vlp-16", 3.2) and standing(image.sensor, image, image.mask) is image.sensor
            continue
        assert found[0] == pytest.approx(mount, abs=0.12) and max(map(abs, found[1:])) < 2.1
        assert standing(image.sensor, image, image.mask).mount == pytest.approx(mount, abs=0.12)


def test_the_floor_of_a_room_tells_where_nothing_far_does():
    """Of 32 buildings: what is nearer than 3 m tells of some, and rightly, of every beam and every second."""
    reader, said = interiors(4331, 1 << 20), {step: [] for step in (1, 2)}
    for image in (reader.image(16 * k) for k in range(32)):
        points = image.sensor.points(image.range)
        for step, found in said.items():
            xyz = points[every(image, step) & image.mask]
            near = stance(xyz[np.hypot(*xyz[:, :2].T) < 3])
            found += [] if near is None else [near[0] / image.sensor.mount]
    assert len(said[1]) >= 7 and len(said[2]) >= 6
    assert all(abs(ratio - 1) < 0.2 for ratios in said.values() for ratio in ratios)


@pytest.mark.parametrize("count", [20, 50, 90, 150, 1000])
def test_a_carrier_s_own_roof_is_no_ground(count: int):
    """However few points of the road there are beside the roof's."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform((-2.2, -0.9), (2.2, 0.9), (400, 2)).T
    turn, far = rng.uniform(0, 2 * np.pi, count), rng.uniform(4, 25, count)
    roof = np.stack([x, y, np.full(400, -0.35)], 1)
    road = np.stack([far * np.cos(turn), far * np.sin(turn), np.full(count, -1.9)], 1)
    found = stance(np.concatenate([roof, road]).astype(np.float32))
    assert found is None or found[0] == pytest.approx(1.9, abs=0.1)
    assert stance(roof.astype(np.float32)) is None


@pytest.mark.parametrize("mount", [1.6, 1.9])
def test_a_mount_that_is_about_right_stays(mount: float):
    image = street("os1-64", mount, 0)
    for step in (1, 2, 4):
        assert standing(image.sensor, image, every(image, step)) is image.sensor


@pytest.mark.parametrize("tilt", [(8.0, 0.0), (0.0, 15.0), (-10.0, 5.0)])
def test_the_ground_tells_how_a_sensor_is_tilted(tilt: tuple[float, float]):
    for place in PLACES:
        image = street("os1-64", 1.73, place, tilt)
        for step in (1, 2):
            found = standing(image.sensor, image, every(image, step))
            assert found.mount == 1.73 and found.tilt == pytest.approx(tilt, abs=2)
        told = replace(image.sensor, tilt=tilt)
        assert standing(told, image, image.mask) is told, "as it is told"


@pytest.mark.parametrize(
    ("tilt", "seed", "places"), [((20.0, 0.0), 4321, PLACES), ((14.0, 14.0), 4321, PLACES), ((6.0, 0.0), 99, (80,))]
)
def test_what_is_told_and_right_stays_where_another_stance_seems_to_fit(
    tilt: tuple[float, float], seed: int, places: tuple[int, ...]
):
    for place in places:
        image = street("os1-64", 1.73, place, tilt, seed)
        told = replace(image.sensor, tilt=tilt)
        for step in (1, 2):
            assert standing(told, image, every(image, step)) is told


@pytest.mark.parametrize(("tilt", "place"), [((0.0, 12.0), 144), ((-15.0, 0.0), 64)])
def test_half_a_turn_tells_no_stance(tilt: tuple[float, float], place: int):
    image = street("vlp-16", 1.73, place, tilt, seed=99)
    told, half = replace(image.sensor, tilt=tilt), np.arange(image.shape[1]) < image.shape[1] // 2
    assert standing(told, image, np.broadcast_to(half, image.shape)) is told


def test_where_no_ground_is_seen_a_mount_stays():
    image = street("os1-64", 0.5, 0)
    assert standing(image.sensor, image, every(image, 64)) is image.sensor, "one beam"
    assert standing(image.sensor, image, every(image, 1) & (np.arange(64) < 24)[:, None]) is image.sensor, "the sky"
    assert stance(np.zeros((0, 3), np.float32)) is None
    wall = np.stack([np.full(500, 5.0), np.linspace(-20, 20, 500), np.linspace(-1, 3, 500)], 1).astype(np.float32)
    assert stance(wall) is None


@pytest.mark.parametrize(("mount", "tilt", "untold"), [(0.5, (0.0, 0.0), 1.1), (1.73, (8.0, 0.0), 1.09)])
def test_a_robots_scan_is_filled_as_if_it_were_told(mount: float, tilt: tuple[float, float], untold: float):
    model, errors = ls.load("default"), np.zeros(2)
    for place in PLACES[:2]:
        image = street("os1-64", mount, place, tilt)
        known = every(image, 4)
        for k, sensor in enumerate((replace(image.sensor, mount=mount, tilt=tilt), image.sensor)):
            filled = model.into(sensor).complete(replace(image, sensor=sensor).keep(known), known)
            assert filled.sensor == sensor
            errors[k] += np.abs(filled.range - image.range)[~known].mean()
    assert errors[1] < 1.02 * errors[0], f"it was {untold}"


def test_its_classes_go_by_it_too():
    model, image = ls.load("default"), street("os1-64", 0.5, 16)
    scan = image.to_scan()
    told, found = (model.label(scan, sensor=replace(image.sensor, mount=m)).label for m in (0.5, image.sensor.mount))
    assert (told == found).mean() > 0.97, "by its own mount 0.91"


def test_info_says_how_a_sensor_stands(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for name, image in (("low", street("vlp-16", 0.5, 0)), ("tilted", street("os1-64", 1.73, 0, (8.0, 0.0)))):
        ls.write(tmp_path / f"{name}.pcd", image.to_scan())
        main(["info", str(tmp_path / f"{name}.pcd")])
    low, tilted = [line.split("stands")[1].strip() for line in capsys.readouterr().out.splitlines() if "stands" in line]
    assert low == "about 0.5 m above the ground" and tilted.startswith("about 1.")
    assert "nose +8 and left side" in tilted or "nose +7 and" in tilted
