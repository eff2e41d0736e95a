"""LiDAR-SR, ILN, LIIF and interpolation as models: what they fill, what they refuse, and the official files."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from oracle import assert_close
from torch import Tensor

import lidarsynth
from lidarsynth.experiment.folder import save
from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import with_fields
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.networks.iln import ILN, LIIF, angle_queries
from lidarsynth.networks.lidar_sr import Dropout, LidarSR, mc_dropout, remove_uncertain
from lidarsynth.systems.filling import Filling
from lidarsynth.systems.interpolation.model import InterpolationModel, interpolated
from lidarsynth.systems.table import SYSTEMS, assemble, build_network, transfer
from lidarsynth.systems.upsampling.model import UpsamplingModel, places, queries_at, scaled
from lidarsynth.verbs.completion import complete_scan, upsample_scan
from lidarsynth.verbs.description import describe

WORDS = ("lidar-sr", "iln", "liif")


def model_of(kind: str, **changes) -> UpsamplingModel:
    """A small model with weights of a seed, whose outputs are ranges within view."""
    experiment = preset("lidar-sr-tiny" if kind == "lidar-sr" else "iln-tiny")
    experiment = with_fields(experiment, {"model.network": kind, **changes})
    torch.manual_seed(1)
    network = build_network(experiment)
    if isinstance(network, LidarSR):
        torch.nn.init.constant_(network.outc.conv[1].bias, 0.3)
    model = assemble(experiment, network)
    assert isinstance(model, UpsamplingModel)
    return model


@pytest.fixture(scope="module", params=WORDS)
def model(request) -> UpsamplingModel:
    return model_of(request.param)


@pytest.fixture
def image() -> RangeImage:
    """Walls 10 to 30 m around with drop-outs, from points, so that it has them."""
    rng, sensor = np.random.default_rng(0), model_of("iln").sensor
    distance = rng.uniform(10, 30, (16, 64)).astype(np.float32) * (rng.random((16, 64)) < 0.9)
    reflectance = (rng.uniform(0.1, 0.9, (16, 64)) * (distance > 0)).astype(np.float32)
    wall = RangeImage(distance, reflectance, distance > 0, sensor)
    return project(wall.to_scan(), sensor, "unfolding")


def sphere(sensor: Sensor, radius: float = 12.0) -> Scan:
    """A point at `radius` metres in every direction of the sensor."""
    flat = replace(sensor, offsets=())
    return Scan((radius * flat.directions()).reshape(-1, 3), np.full(sensor.height * sensor.width, 0.5, np.float32))


# ---------------------------------------------------------------- places and scales


def test_places_are_indices_among_beams():
    beams = np.array([3.0, 1.0, 0.0, -4.0])
    np.testing.assert_allclose(places(beams, beams), [0, 1, 2, 3])
    np.testing.assert_allclose(places([2, 0.25, -1, -3], beams), [0.5, 1.75, 2.25, 2.75])
    np.testing.assert_allclose(places([5, 3.5, -6, -12], beams), [-1, -0.25, 3.5, 5])  # the outer spacing goes on


def test_queries_of_even_beams_are_those_of_iln_s_program():
    top, bottom, size = math.radians(3), math.radians(-25), (16, 32)
    beams = np.linspace(top, bottom, 16)
    wanted = np.linspace(top, bottom, 64)
    found = queries_at(places(wanted, beams), np.arange(64) / 2, size).view(64, 64, 2).flip(0)
    azimuth = torch.linspace(-math.pi, math.pi, 65)[:-1]
    elevation = torch.from_numpy(wanted[::-1].copy()).float()
    expected = angle_queries(elevation, azimuth, size, bottom, top).view(64, 64, 2)
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


def test_scaled_says_what_is_no_return():
    group = model_of("lidar-sr").experiment.upsampling
    assert group is not None
    metres = torch.tensor([0.0, 20.0, 80.0, 81.0])
    torch.testing.assert_close(scaled(metres, group), torch.tensor([1.0, 0.2, 0.8, 1.0]))
    torch.testing.assert_close(scaled(metres, replace(group, keras=True)), torch.tensor([0.0, 0.2, 0.8, 0.0]))


@pytest.mark.parametrize(("keras", "nothing"), [(False, 1.0), (True, 0.0)])
def test_what_is_too_near_is_0_and_no_gap(keras: bool, nothing: float):
    """In both published programs; a gap is as far as it goes in ILN's repository."""
    group = replace(preset("lidar-sr").upsampling, keras=keras, min_range=3.0)
    metres = torch.tensor([0.0, 0.01, 2.9, 3.0, 20.0, 81.0])
    torch.testing.assert_close(scaled(metres, group), torch.tensor([nothing, 0.0, 0.0, 0.03, 0.2, nothing]))
    assert preset("lidar-sr-keras").upsampling.min_range == 2, "metres, as its program"


# ---------------------------------------------------------------- completion


def test_known_pixels_come_back_exactly_and_new_ones_have_no_reflectance(model, image):
    known = corrupt(image, "beams:4")
    result = model.complete(image.keep(known), known, steps=1)
    for field in ("range", "reflectance", "mask", "xyz"):
        np.testing.assert_array_equal(getattr(result, field)[known], getattr(image, field)[known])
    assert not result.reflectance[~known].any() and result.mask[~known].mean() > 0.3
    assert result.range[result.mask].min() > model.sensor.min_range and not result.range[~result.mask].any()
    hidden = model.complete(image, known, steps=1)  # what is not known is not looked at
    np.testing.assert_array_equal(hidden.range, result.range)


def test_lidar_sr_is_its_network_turned_upside_down_and_back(image):
    model, known = model_of("lidar-sr"), corrupt(image, "beams:4")
    low = torch.from_numpy(np.where(image.mask, image.range / 100, 1)[::4][::-1].astype(np.float32).copy())
    with torch.no_grad():
        expected = 100 * model.network(low[None, None])[0, 0].flip(0).numpy()
    expected *= (expected > 1.45) & (expected < 80)
    result = model.complete(image, known, "network")
    np.testing.assert_allclose(result.range[~known], expected[~known], rtol=1e-6)


@pytest.mark.parametrize("keras", [False, True])
def test_lidar_sr_answers_the_mean_under_dropout_where_it_is_sure(image, keras):
    model, known = model_of("lidar-sr", **{"upsampling.keras": keras}), corrupt(image, "beams:4")
    calls = []
    result = model.complete(image, known, seed=7, on_step=lambda: calls.append(1))
    assert len(calls) == model.evaluations() == 8 and model.evaluations(steps=3) == 3
    low = np.where(image.mask, image.range / 100, 0 if keras else 1)[::4][::-1]
    low = torch.from_numpy(low.astype(np.float32).copy())[None, None]
    mean, std = mc_dropout(model.network, low, torch.Generator().manual_seed(7), 8)
    expected = 100 * remove_uncertain(mean, std)[0, 0].flip(0).numpy()
    expected *= (expected > 1.45) & (expected < 80)
    np.testing.assert_allclose(result.range[~known], expected[~known], rtol=1e-6)
    np.testing.assert_array_equal(model.complete(image, known, "monte-carlo", seed=7).range, result.range)
    sure = model_of("lidar-sr", **{"upsampling.keras": keras, "upsampling.threshold": 1e6})
    unsure = model_of("lidar-sr", **{"upsampling.keras": keras, "upsampling.threshold": -1.0})
    assert sure.complete(image, known, seed=7).mask.mean() > result.mask.mean() > known.mean()
    assert not unsure.complete(image, known, seed=7).mask[~known].any()
    assert not np.array_equal(sure.complete(image, known).range, sure.complete(image, known, seed=1).range)


def test_rows_that_span_the_known_ones_are_taken_where_they_are(image):
    """The official LiDAR-SR: 16 known rows and 64 made ones over the same view, 63 / 15 apart; here 15 / 3."""
    plain, spread = model_of("lidar-sr"), model_of("lidar-sr", **{"upsampling.spread": True})
    known = corrupt(image, "beams:4")
    made = plain.complete(image, np.where(known, True, False), "network")
    taken = spread.complete(image, known, "network")
    rows = np.rint(np.arange(16) / 4 * 15 / 3).astype(int).clip(0, 15)  # 0, 1, 2, 4, 5, ...
    for row in range(16):
        if row % 4 and rows[row] % 4:  # known rows of either hide what was made
            np.testing.assert_array_equal(taken.range[row], made.range[rows[row]])


def test_iln_stays_between_its_neighbours_and_takes_any_beams(image):
    model, rng = model_of("iln"), np.random.default_rng(3)
    for _ in range(4):
        rows = np.sort(rng.choice(16, 5, replace=False))
        known = np.zeros((16, 64), bool)
        known[rows] = True
        full = replace(image, range=np.where(image.mask, image.range, 25).astype(np.float32), mask=np.ones_like(known))
        result = model.complete(full, known)
        place = places(model.sensor.elevations, np.asarray(model.sensor.elevations)[rows])
        seen = (place > -1) & (place < 5)
        assert not result.mask[~seen].any(), "nothing is known near there"
        between = result.range[seen]
        assert between.min() >= full.range[rows].min() - 1e-3 and between.max() <= full.range[rows].max() + 1e-3


def test_missing_beams_that_see_only_sky_are_allowed_for_and_others_are_not(image):
    model, known = model_of("lidar-sr"), corrupt(image, "beams:4")
    known[0] = False
    assert model.complete(image, known, "network").mask[~known].any()
    for recipe in ("beams:8", "beams:4:1", "beams:2"):
        with pytest.raises(ValueError, match=r"lidar-sr-tiny: expected the known beams .* \(beams:4:0\), found known"):
            model.complete(image, corrupt(image, recipe))


@pytest.mark.parametrize("recipe", ["points:0.3", "sector:90", "region:5:20:-5:5"])
def test_other_patterns_are_refused(model, image, recipe):
    with pytest.raises(ValueError, match=r"expected whole beams to be missing .* such as beams:4 leaves, found known "
                                         r"pixels in 16 of 16 rows"):  # fmt: skip
        model.complete(image, corrupt(image, recipe))


def test_what_cannot_be_done_is_said_in_one_line(model, image):
    known, name = corrupt(image, "beams:4"), model.experiment.name
    for ask in (model.generate, lambda: model.stream(1), model.generation_steps):
        with pytest.raises(ValueError, match=f"{name}: expected a model that makes scans from noise"):
            ask()
    with pytest.raises(ValueError, match=rf"{name}: expected a method of auto, .*network, found 'repaint'"):
        model.complete(image, known, "repaint")
    with pytest.raises(ValueError, match="expected 1 step, the one pass of method network, found 4"):
        model.complete(image, known, "network", steps=4)
    with pytest.raises(ValueError, match="expected no sampler, for nothing is sampled, found 'ddim'"):
        model.complete(image, known, "network", sampler="ddim")
    with pytest.raises(ValueError, match=r"known must be \(16, 64\) bool"):
        model.complete(image, known[:8])
    if not isinstance(model.network, LidarSR):
        with pytest.raises(ValueError, match="expected a method of auto, network, found 'monte-carlo'"):
            model.evaluations("monte-carlo")


def test_a_saved_model_answers_as_before(model, image, tmp_path):
    save(tmp_path, model.experiment, model.network)
    again, known = lidarsynth.load(tmp_path), corrupt(image, "beams:4")
    assert isinstance(again, UpsamplingModel) and again.experiment == model.experiment
    np.testing.assert_array_equal(again.complete(image, known).range, model.complete(image, known).range)


# ---------------------------------------------------------------- upsampling


def test_a_sphere_stays_a_sphere_within_the_view_of_its_sensor():
    model = model_of("iln").into(SENSORS["hdl-64e-kitti"].resized(32, 128))
    result = model.upsample(sphere(SENSORS["vlp-16"]), "vlp-16")
    assert result.shape == (32, 128)
    elevation = np.asarray(model.sensor.elevations)
    seen = elevation > -17  # VLP-16's lowest beam is at -15 degrees, its spacing is 2
    np.testing.assert_allclose(result.range[seen], 12, rtol=1e-4)
    assert not result.mask[~seen].any()


def test_iln_makes_rows_and_columns_of_any_sensor():
    sensor_in = SENSORS["os1-64"].resized(16)
    for word in ("os1-128", "vlp-32c", "pandar64"):
        model = model_of("iln").into(word)
        result = model.upsample(sphere(sensor_in), sensor_in)
        assert result.shape == (SENSORS[word].height, SENSORS[word].width) and result.mask.any()
        np.testing.assert_allclose(result.range[result.mask], 12, rtol=1e-4)
        assert model.experiment.data.width == SENSORS[word].width


def test_lidar_sr_makes_four_beams_of_each_of_another_sensor():
    model, scan = model_of("lidar-sr"), sphere(SENSORS["vlp-16"])
    result = model.upsample(scan, "vlp-16", "network")
    low = project(scan, SENSORS["vlp-16"], width=64)
    x = torch.from_numpy(np.where(low.mask, low.range / 100, 1)[::-1].astype(np.float32).copy())
    with torch.no_grad():
        made = 100 * model.network(x[None, None])[0, 0].flip(0).numpy()
    assert made.shape == (64, 64)
    for row, elevation in enumerate(model.sensor.elevations):
        place = (15 - elevation) / 2 * 4  # beams are 2 degrees apart, made ones half a degree
        unmeasured = ~project(replace(scan, ring=None), model.sensor, "spherical").mask[row]
        if place < 64:
            np.testing.assert_allclose(result.range[row][unmeasured], made[round(place)][unmeasured], rtol=1e-5)
        else:
            assert not result.mask[row].any()


def test_measured_points_stay_whatever_the_sensor(model):
    scan = sphere(SENSORS["vlp-16"], 20.0)
    filled = upsample_scan(model, scan, SENSORS["vlp-16"], Filling(steps=1))
    measured = {tuple(p) for p in scan.xyz.tolist()}
    assert measured <= {tuple(p) for p in filled.points.xyz.tolist()} and len(filled.points) > len(scan)
    with pytest.raises(ValueError, match="at least 2 beams, found one"):
        model.upsample(sphere(Sensor("one", (-5.0,), 256)), Sensor("one", (-5.0,), 256))


def test_another_sensor_is_for_models_of_any_sensor():
    assert model_of("liif").into("vlp-32c").sensor == SENSORS["vlp-32c"]
    with pytest.raises(ValueError, match=r"divisible by 16, found 64 x 1800"):
        model_of("lidar-sr").into("pandar64")
    with pytest.raises(ValueError, match=r"tiny: expected a model of any sensor, .* for os1-64, found one of hdl"):
        assemble(preset("tiny"), build_network(preset("tiny"))).into("os1-64")
    with pytest.raises(ValueError, match=r"for hdl-64e-kitti, found one of hdl-64e-kitti/16 with 16 x 64 only$"):
        assemble(preset("tiny"), build_network(preset("tiny"))).into("hdl-64e-kitti")


def test_completion_of_a_scan_is_judged_against_interpolation(model, image):
    filled = complete_scan(model, image.to_scan(), "beams:4", Filling(steps=1))
    assert set(filled.errors) == {"lidarsynth", "nearest", "bilinear", "bicubic", "left empty"}
    assert math.isfinite(filled.errors["lidarsynth"].range_mae)


# ---------------------------------------------------------------- interpolation


@pytest.mark.parametrize("word", ["nearest", "bilinear", "bicubic"])
@pytest.mark.parametrize("recipe", ["beams:4", "points:0.3", "sector:60", "region:5:20:-5:5"])
def test_interpolation_is_a_model_of_range_and_reflectance_for_any_mask(image, word, recipe):
    model = lidarsynth.load(word)
    assert isinstance(model, InterpolationModel) and model.sensor == SENSORS["hdl-64e-kitti"]
    model, known = model.into(image.sensor), corrupt(image, recipe)
    result = model.complete(image.keep(known), known)
    expected = interpolated(image.keep(known), known, word)
    np.testing.assert_array_equal(result.range, expected.range)
    np.testing.assert_array_equal(result.reflectance[result.mask], expected.reflectance[result.mask])
    np.testing.assert_array_equal(result.xyz[known & image.mask], image.xyz[known & image.mask])
    assert result.mask[~known].mean() > 0.7 and result.reflectance[~known].any()


def test_interpolation_upsamples_and_says_what_it_cannot_do(image):
    model = lidarsynth.load("bilinear")
    result = model.upsample(sphere(SENSORS["vlp-16"]), "vlp-16")
    np.testing.assert_allclose(result.range[result.mask], 12, rtol=1e-3)
    assert model.evaluations() == 1 and lidarsynth.load("nearest").experiment.name == "nearest"
    small = model.into(image.sensor)
    known = corrupt(image, "beams:4")
    for ask, text in (
        (lambda: model.generate(), "bilinear: expected a model that makes scans from noise, found an interpolation"),
        (lambda: model.generation_steps(), "bilinear: expected a model that makes scans"),
        (lambda: small.complete(image, known, "repaint"), "expected method auto and 1 step, found repaint and None"),
        (lambda: small.complete(image, known, steps=3), "expected method auto and 1 step, found auto and 3"),
        (lambda: small.complete(image, known, sampler="ddim"), "expected no sampler"),
    ):
        with pytest.raises(ValueError, match=text):
            ask()
    assert SYSTEMS["bilinear"].task is None


def test_info_tells_the_published_counts():
    counts = {"lidar-sr": "34,600,001", "iln": "1,244,673", "iln-0d": "1,219,649", "iln-2d": "1,269,697",
              "liif": "1,434,049"}  # fmt: skip
    for word, count in counts.items():
        text = describe(word)
        assert f" {count}\n" in text and "16 to 64 rows (beams:4:0)" in text and "diffusion" not in text
    assert "16 to 64 rows (beams:4:3)" in describe("lidar-sr-keras"), "of each four the lowest, as its program"
    assert "monte" not in describe("iln") and "mean of 50 passes under dropout" in describe("lidar-sr")
    for word, how in (("nearest", "nearest known row"), ("bilinear", "linear between"), ("bicubic", "a = -0.75")):
        text = describe(word)
        assert "0, nothing to train" in text and how in text and "steps of" not in text


# ---------------------------------------------------------------- official files


LIDAR_IN = {"channels": 16, "points_per_ring": 64, "max_v": 0.29, "min_v": -0.29, "max_h": math.pi, "min_h": -math.pi,
            "norm_r": 90.0, "max_r": 70.0, "min_r": 2.0}  # fmt: skip


def official(name: str, weights: dict[str, Tensor]) -> dict:
    model = {"name": name, "args": {}, "state_dict": weights}
    return {"epoch": 400, "model": model, "optimizer": {}, "lr_scheduler": {}, "lidar_in": LIDAR_IN}


def test_official_lidar_sr_is_recognised_and_answers_as_stored(fixture_tensors, tmp_path):
    stored = fixture_tensors("lsr_4h1w_small")
    weights = {k.removeprefix("state_dict."): v for k, v in stored.items() if k.startswith("state_dict.")}
    torch.save(official("lsr", weights), tmp_path / "lsr_4h_1w_100.pth")
    model = lidarsynth.load(tmp_path / "lsr_4h_1w_100.pth")
    assert isinstance(model, UpsamplingModel) and model.experiment.name == "lsr_4h_1w_100"
    with torch.no_grad():
        assert_close(model.network(stored["input"]), stored["output"], atol=1e-5, rtol=0)
    group, sensor = model.experiment.upsampling, model.sensor
    assert group is not None and (group.factor, group.spread, group.norm, group.max_range) == ((4, 1), True, 90, 70)
    assert (sensor.height, sensor.width, sensor.max_range, group.min_range) == (64, 64, 70, 2)
    np.testing.assert_allclose(sensor.elevations[:61:4], np.degrees(np.linspace(0.29, -0.29, 16)), atol=1e-5)
    torch.save(official("lsr", {k: v for k, v in weights.items() if not k.startswith("up_scale")}), tmp_path / "x.pth")
    with pytest.raises(ValueError, match=r"x.pth: expected LiDAR-SR with 2, 3, 4 up-scaling layers, found 0"):
        lidarsynth.load(tmp_path / "x.pth")
    wide = fixture_tensors("lsr_8h2w_small")
    weights = {k.removeprefix("state_dict."): v for k, v in wide.items() if k.startswith("state_dict.")}
    torch.save(official("lsr", weights), tmp_path / "wide.pth")
    assert lidarsynth.load(tmp_path / "wide.pth").sensor.width == 128


@torch.no_grad()
def test_official_iln_is_shown_returns_that_are_too_near(tmp_path, monkeypatch):
    """Its program makes 0 of them, in the image that is filled and in one of another sensor's beams."""
    torch.manual_seed(2)
    torch.save(official("iln", ILN().state_dict()), tmp_path / "iln.pth")
    model, seen = lidarsynth.load(tmp_path / "iln.pth"), []
    encode = ILN.encode
    monkeypatch.setattr(ILN, "encode", lambda self, low: (seen.append(low), encode(self, low))[1])
    sensor_in = replace(model.sensor.rows(range(0, 64, 4)), name="16", min_range=2.0)
    radius = np.where(np.arange(64) < 32, 20.0, 1.5)  # metres; 1.5 on one side
    flat = (sensor_in.directions() * radius[:, None]).reshape(-1, 3).astype(np.float32)
    near, far = 2 * 0.0 - 1, 2 * 20 / 90 - 1
    upsampled = model.upsample(Scan(flat), sensor_in)
    known = np.zeros((64, 64), bool)
    known[::4] = True
    dense = Scan((model.sensor.directions() * radius[:, None]).reshape(-1, 3).astype(np.float32))
    completed = model.complete(dense, known)
    for low in seen:
        np.testing.assert_allclose(low[0, 0], np.broadcast_to(np.where(radius > 2, far, near), (16, 64)), atol=1e-6)
    assert len(seen) == 2
    for image in (upsampled, completed):
        assert not (image.mask & (image.range < 2))[1::4].any(), "and nothing so near is an answer"


@pytest.mark.parametrize(("name", "network"), [("iln", lambda: ILN(2)), ("liif_lidar", LIIF)])
def test_official_iln_and_liif_are_recognised(name, network, tmp_path):
    torch.manual_seed(0)
    theirs = network().eval()
    torch.save(official(name, theirs.state_dict()), tmp_path / "iln_2d_400.pth")
    model = lidarsynth.load(tmp_path / "iln_2d_400.pth")
    assert isinstance(model, UpsamplingModel) and type(model.network) is type(theirs)
    asked = torch.rand(1, 1, 4, 8), torch.rand(1, 5, 2)
    assert torch.equal(model.network(*asked), theirs(*asked))
    assert (model.sensor.height, model.sensor.width) == (64, 64)
    described = describe(str(tmp_path / "iln_2d_400.pth"))
    assert "1,269,697" in described if name == "iln" else "1,434,049" in described
    assert "400 epochs" in described and "CARLA" in described


def test_arguments_of_official_files_are_heard(tmp_path):
    """488 of 512 outputs differ where 4 heads are taken for 8."""
    torch.manual_seed(0)
    theirs = ILN(1, heads=4).eval()
    checkpoint = official("iln", theirs.state_dict())
    checkpoint["model"]["args"] = {"d": 1, "h": 4}
    torch.save(checkpoint, tmp_path / "four.pth")
    model = lidarsynth.load(tmp_path / "four.pth")
    asked = torch.rand(1, 1, 4, 8), torch.rand(1, 512, 2)
    assert torch.equal(model.network(*asked), theirs(*asked))
    save(tmp_path / "own", model.experiment, model.network)
    assert torch.equal(lidarsynth.load(tmp_path / "own").network(*asked), theirs(*asked))
    for name, network, args, said in (
        ("iln", ILN(1), {"d": 2}, "tensors of d = 2 layers, as model.args says, found 1"),
        ("iln", ILN(1), {"depth": 1}, r"expected model.args of d, h, found \{'depth': 1\}"),
        (
            "liif_lidar",
            LIIF(),
            {"cell_decode": True},
            "expected a LIIF without cell_decode, .*, found .*True",
        ),
    ):
        checkpoint = official(name, network.state_dict())
        checkpoint["model"]["args"] = args
        torch.save(checkpoint, tmp_path / "other.pth")
        with pytest.raises(ValueError, match=said):
            lidarsynth.load(tmp_path / "other.pth")


def test_arguments_of_official_liif_are_heard_and_kept(tmp_path):
    torch.manual_seed(0)
    theirs = LIIF(unfold=True, ensemble=False).eval()
    checkpoint = official("liif_lidar", theirs.state_dict())
    checkpoint["model"]["args"] = {"feat_unfold": True, "local_ensemble": False, "cell_decode": False}
    torch.save(checkpoint, tmp_path / "liif.pth")
    model, asked = lidarsynth.load(tmp_path / "liif.pth"), (torch.rand(1, 1, 4, 8), torch.rand(1, 512, 2) * 2 - 1)
    assert torch.equal(model.network(*asked), theirs(*asked))
    save(tmp_path / "own", model.experiment, model.network)
    again = lidarsynth.load(tmp_path / "own")
    assert torch.equal(again.network(*asked), theirs(*asked))
    assert "64 channels, of 3x3 pixels, of one neighbour" in describe(str(tmp_path / "own"))
    known = np.zeros((64, 64), bool)
    known[::4] = True
    assert again.complete(sphere(again.sensor), known).mask.any()
    plain = with_fields(again.experiment, {"upsampling.ensemble": True})
    with pytest.raises(ValueError, match=r"expected weights of liif, .* True \(network, .*, ensemble\), found liif"):
        transfer(build_network(plain), plain, again.network, again.experiment, "own")


def test_arguments_of_official_lidar_sr_are_heard(fixture_tensors, tmp_path):
    """The rate decides how far passes under dropout differ, and so which pixels stay."""
    stored = fixture_tensors("lsr_4h1w_small")
    weights = {k.removeprefix("state_dict."): v for k, v in stored.items() if k.startswith("state_dict.")}

    def loaded(args: object) -> UpsamplingModel:
        checkpoint = official("lsr", weights)
        checkpoint["model"]["args"] = args
        torch.save(checkpoint, tmp_path / "lsr.pth")
        return lidarsynth.load(tmp_path / "lsr.pth")

    for args, rate in (({}, 0.25), (None, 0.25), ({"dropout_rate": 0.1}, 0.1), ({"dropout_rate": 0}, 0.0)):
        model = loaded(args)
        rates = {module.rate for module in model.network.modules() if isinstance(module, Dropout)}
        assert rates == {rate} and (model.network.dropout, model.experiment.model.dropout) == (rate, rate)
    model = loaded({"scale_h": 4, "scale_w": 1, "width": 6, "dropout_rate": 0.1})
    save(tmp_path / "own", model.experiment, model.network)
    again = lidarsynth.load(tmp_path / "own")
    ours, theirs = (mc_dropout(m.network, stored["input"], torch.Generator().manual_seed(1), 8) for m in (model, again))
    assert torch.equal(ours[1], theirs[1]) and "dropout 0.1" in describe(str(tmp_path / "lsr.pth"))
    assert loaded({"scale_w": 2}).experiment.upsampling.factor == (4, 2), "tensors say nothing of columns"
    for args, said in (
        ({"scale_h": 8}, "expected tensors of scale_h = 8, as model.args says, found those of 4"),
        ({"width": 64}, "expected tensors of width = 64, as model.args says, found those of 6"),
        ({"scale_w": 3}, r"scale must be two powers of 2, .* got \(4, 3\)"),
        ({"dropout_rate": 1.5}, "expected dropout_rate of model.args from 0 to below 1, found 1.5"),
        ({"dropout_rate": "much"}, "expected a number as dropout_rate of model.args, found 'much'"),
        ({"scale_w": math.inf}, "expected a number as scale_w of model.args, found inf"),
        ([0.1], r"expected model.args by name, found \[0.1\]"),
    ):
        with pytest.raises(ValueError, match=said) as caught:
            loaded(args)
        assert "\n" not in str(caught.value)


def test_other_files_are_named_as_what_they_are(tmp_path):
    path = tmp_path / "file.pth"

    def refusal(content: object) -> str:
        torch.save(content, path)
        with pytest.raises(ValueError) as caught:
            lidarsynth.load(path)
        assert "\n" not in str(caught.value) and str(caught.value).startswith(str(path))
        return str(caught.value)

    assert "expected a model of lsr, iln, liif_lidar from ILN's repository, found 'edsr'" in refusal(
        official("edsr", {})
    )
    assert "head.0.conv.weight (64, 1, 3, 3), found (8, 1, 3, 3)" in refusal(official("iln", ILN(1, 2, 8).state_dict()))
    incomplete = ILN().state_dict()
    incomplete.pop("attention.mlp_head.1.bias")
    assert "expected attention.mlp_head.1.bias (1,), found none; 1 tensors" in refusal(official("iln", incomplete))
    broken = official("iln", ILN().state_dict()) | {"lidar_in": {"channels": 16}}
    assert "expected lidar_in with the numbers channels, points_per_ring" in refusal(broken)
    torch.save(official("iln", ILN().state_dict()), path)
    path.write_bytes(path.read_bytes()[:20_000])
    with pytest.raises(ValueError, match="found a truncated file"):
        lidarsynth.load(path)


def test_keras_weights_load_and_answer_as_stored(fixture_tensors, reference, tmp_path):
    h5py = pytest.importorskip("h5py", reason="lidarsynth[data] is not installed")
    stored = fixture_tensors("lsr_keras_small")
    order = ("kernel", "bias", "gamma", "beta", "moving_mean", "moving_variance")
    names = [key for key in stored if key.startswith("weights.")]
    names.sort(key=lambda key: (key.split(".")[1], order.index(key.split(".")[3])))
    path = tmp_path / "weights.h5"

    def write(tensors: list[Tensor]) -> None:
        layers = json.loads((reference / "facts" / "lsr_keras_layers.json").read_text())["layers"]
        left = iter(tensors)
        with h5py.File(path, "w") as file:
            file.attrs["layer_names"] = [name.encode() for _, name, _ in layers]
            for _, layer, weights in layers:
                group = file.create_group(layer)
                full = [f"{layer}/{name}:0".encode() for name, _ in weights]
                group.attrs["weight_names"] = full
                for name in full:
                    group.create_dataset(name.decode(), data=next(left).numpy())

    write([stored[name] for name in names])
    model = lidarsynth.load(path)
    assert isinstance(model, UpsamplingModel) and model.network.keras and model.experiment.upsampling.first == 3
    with torch.no_grad():
        found = model.network(stored["input"].permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
    assert_close(found, stored["output"], atol=1e-5, rtol=0)
    whole = path.read_bytes()
    write([*[stored[name] for name in names[:-1]], torch.zeros(3)])
    with pytest.raises(ValueError, match=r"weights.h5: expected outc.conv.1.bias \(1,\), found \(3,\)"):
        lidarsynth.load(path)
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"weights.h5: expected LiDAR-SR's Keras weights, found a damaged file"):
        lidarsynth.load(path)
    with h5py.File(path, "w") as file:
        file.create_group("layers")
    with pytest.raises(ValueError, match=r"expected weights by layer, as Keras 2 saves them, found \['layers'\]"):
        lidarsynth.load(path)
