"""street-1: the shipped network is the frozen one, needs no download, and worse scans get worse scores."""

import json
import runpy
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
import torch

import lidarsynth as ls
from lidarsynth.cli.main import main
from lidarsynth.evaluation import accumulation
from lidarsynth.evaluation.accumulation import load_networks
from lidarsynth.evaluation.protocols import STREET_1
from lidarsynth.evaluation.report import results_of
from lidarsynth.evaluation.statistics import Statistics, definition
from lidarsynth.files.formats import write
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.networks.street_features import StreetFeatures
from lidarsynth.systems.segmentation.training import judge, pixels
from lidarsynth.weights.load import load_parts, shipped

REPO_ROOT = Path(__file__).resolve().parents[1]
SENSOR = SENSORS["hdl-64e-kitti"]
# A score of street-1 v1 is one of these weights and of this definition; other ones are another version.
WEIGHTS = "22208860765953c16a564fe25837aff70035d68cfa4287374466de5df069febf"
DEFINITION = "v1 fc7ac3a76ca63ff9"


@pytest.fixture(autouse=True)
def offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty cache folder, and nothing that can be downloaded."""
    monkeypatch.setenv("LIDARSYNTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(accumulation, "URLS", dict.fromkeys(accumulation.URLS, (tmp_path / "nowhere").as_uri()))


@pytest.fixture(scope="module")
def street() -> RangeImage:
    """The scan of the demo."""
    return project(ls.read(shipped()["street-1"].parent / "street.npz"), SENSOR, "auto")


@pytest.fixture(scope="module")
def network() -> StreetFeatures:
    features = load_networks(STREET_1, 1024).networks["rangenet"]
    assert isinstance(features, StreetFeatures)
    return features


def values(network: StreetFeatures, *images: RangeImage) -> torch.Tensor:
    stacked = torch.from_numpy(np.stack([pixels(image) for image in images]))
    return network(stacked, stacked[:, :1] > 0)


def test_weights_and_definition_are_those_of_version_1():
    weights = shipped()["street-1"] / "model.safetensors"
    assert sha256(weights.read_bytes()).hexdigest() == WEIGHTS
    assert definition(STREET_1) == DEFINITION
    assert weights.stat().st_size < 15e6
    card = json.loads((weights.parent / "experiment.json").read_text())["card"]
    assert card["licence"] == "MIT" and sum("mIoU" in line for line in card["results"]) >= 2


def test_it_comes_with_the_package_and_without_a_download():
    loaded = load_networks(STREET_1, 1024)
    assert loaded.weights == {"rangenet": WEIGHTS} and not loaded.missing
    assert load_networks(STREET_1, 512).missing == {"rangenet": "no official rangenet for 512 columns, only for 1024"}


def test_it_is_described_and_makes_no_scans(capsys: pytest.CaptureFixture[str]):
    main(["info", "street-1"])
    text = capsys.readouterr().out
    assert "1,549,908" in text and "a class for every pixel, makes no scans" in text and "mIoU" in text
    with pytest.raises(ValueError, match=r"^street-1: expected a network of .*, which make scans, found rangenet$"):
        ls.load("street-1")


def test_features_are_logarithms_of_deviations_of_two_maps(network: StreetFeatures, street: RangeImage):
    found = values(network, street)
    assert found.shape == (1, 128) and found.dtype == torch.float32
    maps = {}
    rangenet = network.network
    handles = [
        rangenet.backbone.enc3.register_forward_hook(lambda m, i, out: maps.update(encoded=out)),
        rangenet.decoder.dec4.register_forward_hook(lambda m, i, out: maps.update(decoded=out)),
    ]
    stacked = torch.from_numpy(pixels(street))[None]
    with torch.no_grad():
        rangenet(rangenet.network_input(stacked, stacked[:, :1] > 0))
    for handle in handles:
        handle.remove()
    both = torch.cat([maps["encoded"], maps["encoded"] + maps["decoded"]], 1)
    torch.testing.assert_close(found, torch.log(both.flatten(2).std(-1) + 0.01), rtol=1e-4, atol=1e-4)


def test_features_do_not_depend_on_the_batch_and_need_no_return(network: StreetFeatures, street: RangeImage):
    other = street.keep(np.arange(64)[:, None] % 2 + np.zeros(1024) > 0)
    together = values(network, street, other)
    torch.testing.assert_close(together[:1], values(network, street), rtol=1e-4, atol=1e-4)
    assert (together[0] - together[1]).abs().mean() > 0.1
    nothing = values(network, street.keep(np.zeros((64, 1024), bool)))
    assert torch.isfinite(nothing).all()
    with pytest.raises(ValueError, match="evaluation mode"):
        StreetFeatures(RangeNet(21, width=2).train())(torch.zeros(1, 5, 8, 32), torch.zeros(1, 1, 8, 32))


def test_the_shipped_network_knows_streets(street: RangeImage):
    experiment, rangenet = load_parts("street-1")
    assert judge(experiment, rangenet, [street])["accuracy"] > 0.5


def test_streets_without_cars_are_the_same_streets():
    pytest.importorskip("embreex", reason="lidarsynth[synthetic] is not installed")
    from lidarsynth.streets.reader import SyntheticStreets

    full, empty = (SyntheticStreets(12, 32, SENSOR, without).image(5) for without in ((), ("car",)))
    assert full.label is not None and empty.label is not None
    assert (full.label == 1).mean() > 0.01 and not (empty.label == 1).any()
    road = (full.label == 9) & (empty.label == 9)
    assert road.mean() > 0.1 and np.array_equal(full.range[road], empty.range[road])
    with pytest.raises(ValueError, match=r"expected classes of unlabeled, car, .* found 'tram'"):
        SyntheticStreets(12, 32, SENSOR, ("tram",))


@pytest.mark.timeout(300)
def test_worse_scans_get_worse_scores(network: StreetFeatures):
    pytest.importorskip("embreex", reason="lidarsynth[synthetic] is not installed")
    benchmark = runpy.run_path(str(REPO_ROOT / "benchmarks/street.py"))
    first = replace(STREET_1, rows=STREET_1.rows[:1])
    judge_of = benchmark["Judge"](first, accumulation.Loaded({"rangenet": network}, {"rangenet": WEIGHTS}))
    scans = list(benchmark["streets"](3000, 2))
    real = judge_of.gather(scans, "real")

    def score(corrupt) -> float:
        images = [corrupt(image, np.random.default_rng(k)) for k, image in enumerate(scans)]
        return judge_of.scores(judge_of.gather(images), real)[0].value

    assert score(lambda image, rng: image) == pytest.approx(0, abs=1e-6)
    for kind in ("blur", "rows shuffled", "beams without return"):
        weak, *_, strong = benchmark["CORRUPTIONS"][kind].values()
        assert 1e-4 < 2 * score(weak) < (strongest := score(strong)), kind
        if kind == "rows shuffled":
            assert score(benchmark["noise_image"]) > 2 * strongest


@pytest.mark.timeout(120)
def test_the_verb_evaluates_offline(street: RangeImage, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folders = {}
    for name, keep in (("real", 0.95), ("samples", 0.8), ("dark", 0.95)):
        folders[name] = tmp_path / name
        folders[name].mkdir()
        for i in range(2):
            image = street.keep(np.random.default_rng(i).random(street.shape) < keep)
            image = replace(image, reflectance=np.zeros_like(image.reflectance)) if name == "dark" else image
            write(folders[name] / f"{i}.npz", image)
    out = tmp_path / "report.json"
    words = ["--reference", str(folders["real"]), "--protocol", "street-1", "--out", str(out)]
    main(["evaluate", str(folders["samples"]), *words])
    text = capsys.readouterr().out
    assert "street-1 v1: 2 samples against 2" in text and "singular covariance of 128 rangenet features" in text
    found = json.loads(out.read_text())
    assert all(row["value"] is not None and row["value"] > 0 for row in found["values"].values() if row["unit"] != "m")
    assert found["definition"] == DEFINITION and found["hashes"]["rangenet"] == WEIGHTS
    main(["evaluate", str(folders["dark"]), *words])
    assert "the samples have no return with a reflectance, which rangenet needs" in capsys.readouterr().out


def test_statistics_of_another_set_of_weights_are_not_compared(network: StreetFeatures, street: RangeImage):
    sides = [Statistics(STREET_1, SENSOR, role, {"rangenet": network}, {"rangenet": weights})
             for role, weights in (("samples", WEIGHTS), ("real", "other"))]  # fmt: skip
    for side in sides:
        side.update([street, street], [True] * 2, [True] * 2)
    frd = results_of(*sides)[0]
    assert frd.value is None and "different weights of rangenet" in frd.reason
