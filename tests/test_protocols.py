"""Protocols: what the papers' programs do, as records; and statistics, from features to numbers and files."""

import json
from dataclasses import FrozenInstanceError, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from lidarsynth.evaluation import pairs
from lidarsynth.evaluation import report as evaluate
from lidarsynth.evaluation.parts import merged
from lidarsynth.evaluation.protocols import BEV_1, LIDARGEN, PROTOCOLS, R2DM, Network, get_protocol
from lidarsynth.evaluation.statistics import Statistics, definition, load_statistics, save_statistics
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.metrics.distributions import kernel_distance
from lidarsynth.networks.pointnet import read_pointnet
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.networks.rangenet_archive import read_rangenet

GRID = Sensor("grid", (2.0, 0.0, -2.0, -4.0, -8.0, -12.0, -16.0, -20.0), 32, 0.1, 100.0)


def images(count: int, seed: int = 0, near: float = 0.6, far: float = 90.0) -> list[RangeImage]:
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        mask = rng.random((GRID.height, GRID.width)) < 0.8
        distance = (rng.uniform(near, far, mask.shape) * mask).astype(np.float32)
        made.append(RangeImage(distance, rng.random(mask.shape).astype(np.float32) * mask, mask, GRID))
    return made


def gathered(*batches: list[RangeImage], protocol=BEV_1, role="samples", keep: bool = True) -> Statistics:
    statistics = Statistics(protocol, GRID, role)
    for batch in batches:
        statistics.update(batch, [True] * len(batch), [keep] * len(batch))
    return statistics


def of_clouds(clouds: Tensor, role) -> Statistics:
    """Statistics of points (B, N, 3) that stand for images of one row."""
    sensor = Sensor("points", (0.0,), clouds.shape[1])
    protocol = replace(R2DM, near=0.0, far=float("inf"), networks=(Network("pointnet", (), "given", 64),))
    statistics = Statistics(protocol, sensor, role)
    one = np.ones((1, clouds.shape[1]), np.float32)
    statistics.update_histograms([RangeImage(one, one, one > 0, sensor, xyz=c[None].numpy()) for c in clouds])
    return statistics


def test_every_published_number_comes_out_of_files_of_statistics(fixture_tensors, reference: Path, tmp_path: Path):
    tensors = fixture_tensors("metrics/inputs")
    values = json.loads((reference / "fixtures/metrics/values.json").read_text())
    both = []
    for role, name in (("samples", "gen"), ("real", "real")):
        statistics = of_clouds(tensors[f"clouds_{name}"], role)
        features = tensors[f"features_{name}"]
        for part in features.split(7):
            statistics.add_features("pointnet", part, [True] * len(part))
        statistics.count = len(features)
        save_statistics(tmp_path / f"{name}.safetensors", statistics)
        both.append(load_statistics(tmp_path / f"{name}.safetensors", statistics.protocol)[0])
    found = {result.name: result.value for result in evaluate.results_of(*both)}
    assert found["FPD"] == pytest.approx(values["frechet_distance"], rel=1e-4)
    assert found["FPD squared MMD"] == pytest.approx(values["squared_mmd_np_seed0"], rel=1e-5)
    assert found["JSD x1e2"] == pytest.approx(100 * values["bev_jsd"], rel=1e-5)
    assert found["MMD x1e4"] == pytest.approx(1e4 * values["bev_mmd_float64"], rel=1e-5)
    assert found["FRD"] is None
    seeded = {result.name: result.value for result in evaluate.results_of(*both, seed=123)}
    assert seeded["FPD squared MMD"] == pytest.approx(values["squared_mmd_np_seed123"], rel=1e-5)


def test_features_of_rangenet_come_out_of_images(fixture_tensors, shared: Path):
    tensors = fixture_tensors("rangenet/darknet21_io")
    image, mask = tensors["image"][0].numpy(), tensors["mask"][0, 0].numpy() > 0
    sensor = SENSORS["hdl-64e"]
    network = read_rangenet(shared / "fixtures/rangenet/darknet21.tar.gz")
    protocol = replace(R2DM, near=0.0, far=float("inf"), gated=())
    xyz = np.moveaxis(image[1:4], 0, -1)
    statistics = Statistics(protocol, sensor, "real", {"rangenet": network})
    statistics.update_features([RangeImage(image[0], image[4], mask, sensor, xyz=xyz)], [True])
    expected = tensors["feature_lidargen"]
    # pixels at the origin have no point of their own and lie on their ray, at the range 0
    torch.testing.assert_close(
        statistics.features("rangenet"), expected, atol=1e-4 * float(expected.abs().max()), rtol=0
    )


def test_features_of_pointnet_come_out_of_images(fixture_tensors, official_file):
    protocol = replace(R2DM, near=0.0, far=float("inf"), gated=())
    tensors = fixture_tensors("pointnet/io")
    clouds = tensors["points_metric"].transpose(1, 2)
    network = read_pointnet(official_file("pointnet/cls_model_39.pth"))
    row = Sensor("points", (0.0,), clouds.shape[1])
    statistics = Statistics(protocol, row, "real", {"pointnet": network})
    distance = clouds.norm(dim=-1)[:, None].numpy()
    one = np.ones((1, row.width), np.float32)
    batch = [RangeImage(d, one, d > 0, row, xyz=c[None].numpy()) for d, c in zip(distance, clouds, strict=True)]
    statistics.update_features(batch, [True] * len(batch))
    expected = tensors["feature"]
    torch.testing.assert_close(
        statistics.features("pointnet"), expected, atol=1e-4 * float(expected.abs().max()), rtol=0
    )


def test_records_are_frozen_and_every_row_can_be_computed():
    for name, protocol in PROTOCOLS.items():
        assert get_protocol(name) is protocol and protocol.name == name
        known = pairs.MEASURES if protocol.pairs else evaluate.MEASURES
        assert {row.measure for row in protocol.rows} <= known.keys()
        assert all(row.network is None or protocol.network(row.network) for row in protocol.rows)
    with pytest.raises(FrozenInstanceError):
        R2DM.near = 0.0  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(ValueError, match=r"expected a protocol of r2dm-2024, .* found 'jsd'"):
        get_protocol("jsd")
    assert len({definition(protocol) for protocol in PROTOCOLS.values()}) == len(PROTOCOLS)
    assert definition(R2DM) != definition(replace(R2DM, far=64.0))


def test_statistics_depend_neither_on_batches_nor_on_who_gathered_them(tmp_path: Path):
    all_of_them = images(9)
    whole = gathered(all_of_them)
    halves = [gathered(all_of_them[5:7], all_of_them[7:]), gathered(all_of_them[:5])]
    for i, half in enumerate(halves):
        save_statistics(tmp_path / f"{i}.safetensors", half)
    first, second = (load_statistics(tmp_path / f"{i}.safetensors")[0] for i in (0, 1))
    first.merge(second)
    assert (first.count, first.lit, first.digest) == (9, 9, whole.digest)
    assert first.bev and whole.bev and torch.equal(first.bev.pooled, whole.bev.pooled)
    assert first.beams and whole.beams and np.array_equal(first.beams.histogram, whole.beams.histogram)
    real = gathered(images(9, seed=1), role="real")
    for own, its in zip(evaluate.results_of(whole, real), evaluate.results_of(first, real), strict=True):
        assert own.value == pytest.approx(its.value, rel=1e-5)
    assert gathered(images(9, seed=2)).digest != whole.digest


def test_equal_sets_score_zero_and_far_ones_more():
    first = gathered(images(6))
    assert {r.name: r.value for r in evaluate.results_of(first, gathered(images(6), role="real"))} == pytest.approx(
        {row.name: 0 for row in BEV_1.rows}, abs=1e-4
    )
    far = gathered(images(6, near=30))
    near = gathered(images(6, seed=5), role="real")
    values = [{r.name: r.value for r in evaluate.results_of(s, near)} for s in (first, far)]
    assert all(values[0][name] < values[1][name] for name in ("MMD x1e4", "JSD x1e2", "range, per beam"))


def test_the_gate_is_strict_and_of_the_sides_the_protocol_says():
    one = np.ones((GRID.height, GRID.width), np.float32)
    edge = [RangeImage(one * value, one, one > 0, GRID) for value in (63.0, 62.9, 0.5)]
    assert [int(gathered([image]).bev.pooled.sum()) for image in edge] == [0, one.size, 0]
    assert int(gathered([edge[0]], protocol=LIDARGEN).bev.pooled.sum()) == one.size


def test_lidargen_draws_samples_again_and_loses_their_first_point():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = RangeNet(21, width=4).eval()
    protocol = replace(LIDARGEN, networks=(Network("rangenet", (), "decoder", 64),))
    (image,) = images(1, far=62.0)
    row, column = np.argwhere(image.mask)[0]
    without = image.mask.copy()
    without[row, column] = False
    found = []
    for role, given in (("samples", image), ("real", image.keep(without)), ("real", image)):
        statistics = Statistics(protocol, GRID, role, {"rangenet": network})
        statistics.update_features([given], [True])
        found.append(statistics.features("rangenet"))
    torch.testing.assert_close(found[0], found[1], rtol=1e-3, atol=1e-4)
    assert not torch.allclose(found[0], found[2], rtol=1e-3, atol=1e-4)


def test_a_file_that_was_changed_or_is_of_another_protocol_is_refused(tmp_path: Path):
    path = tmp_path / "real.safetensors"
    told = save_statistics(path, gathered(images(3)), {"source": "here"})
    statistics, metadata = load_statistics(path)
    assert metadata["sha256"] == told and metadata["source"] == "here" and statistics.sensor == GRID
    tensors = load_file(path)
    tensors["bev.pooled"][3, 3] += 1
    save_file(tensors, path, metadata)
    with pytest.raises(ValueError, match=r"expected the content of SHA-256 .* found another"):
        load_statistics(path)
    with pytest.raises(ValueError, match="expected statistics of r2dm-2024 v1 as defined here, found those of bev-1"):
        load_statistics(path, R2DM)
    save_file({"a": torch.zeros(1)}, path)
    with pytest.raises(ValueError, match="expected 'lidarsynth statistics 1', found None"):
        load_statistics(path)
    path.write_bytes(b"nothing")
    with pytest.raises(ValueError, match="expected a file of statistics"):
        load_statistics(path)


def test_small_and_unlike_sets_are_told(tmp_path: Path):
    protocol = replace(R2DM, networks=(Network("pointnet", (), "given", 8),))
    both = [gathered(images(n), protocol=protocol, role=role) for n, role in ((4, "samples"), (30, "real"))]
    rng = np.random.default_rng(0)
    for statistics in both:
        count = statistics.count
        statistics.add_features("pointnet", rng.normal(size=(count, 8)).astype(np.float32), [True] * count)
    report = evaluate.report_of(*both, missing={"rangenet": "put darknet at /here"})
    assert report.values["FRD"] is None and "put darknet at /here" in str(report)
    assert report.values["FPD"] is not None
    text = "\n".join(report.warnings)
    assert "judges 10,000 samples, found 4" in text
    assert "4 samples against 30 of the reference" in text
    assert "4 images of the samples give a singular covariance of 8 pointnet features" in text
    assert "30 images" not in text
    told = json.loads(report.json())
    assert told["values"]["FPD"]["value"] == report.values["FPD"]
    assert (told["protocol"], told["version"], told["counts"]["reference"]) == ("r2dm-2024", 1, 30)
    assert "| FRD | N/A | put darknet at /here |" in report.markdown()
    one = gathered(images(1), protocol=protocol)
    one.add_features("pointnet", np.ones((1, 8), np.float32), [True])
    assert "at least 2 features" in str(evaluate.report_of(one, both[1]))


def test_unlike_statistics_do_not_meet():
    with pytest.raises(ValueError, match=r"found bev-1 v1 and r2dm-2024 v1"):
        evaluate.results_of(gathered(images(2)), gathered(images(2), protocol=R2DM))
    with pytest.raises(ValueError, match="statistics of one role, found samples and real"):
        gathered(images(2)).merge(gathered(images(2), role="real"))
    broken = images(1)[0]
    broken.range[0, 0] = np.nan
    with pytest.raises(ValueError, match="expected a finite range, found 1 pixels"):
        gathered([broken])
    wide = SENSORS["vlp-16"]
    blank = np.zeros((16, 1024), np.float32)
    with pytest.raises(ValueError, match="one size, 8 x 32, found one of 16 x 1024"):
        gathered([RangeImage(blank, blank, blank > 0, wide)])


def test_an_empty_scan_has_no_part_in_the_mmd_and_is_told():
    blank = np.zeros((GRID.height, GRID.width), np.float32)
    with_empty = gathered([*images(4), RangeImage(blank, blank, blank > 0, GRID)])
    report = evaluate.report_of(with_empty, gathered(images(4, seed=1), role="real"))
    plain = evaluate.report_of(gathered(images(4)), gathered(images(4, seed=1), role="real"))
    assert report.values["MMD x1e4"] == plain.values["MMD x1e4"]
    assert any("1 of the samples have no point" in warning for warning in report.warnings)


def test_the_squared_mmd_is_drawn_from_the_kept_features_of_bounded_number():
    protocol = replace(R2DM, networks=(Network("pointnet", (), "given", 8),), keep=5, subsets=2, subset_size=4)
    values = np.random.default_rng(0).normal(size=(2, 9, 8)).astype(np.float32)
    both = []
    for role, features in zip(("samples", "real"), values, strict=True):
        statistics = Statistics(protocol, GRID, role)
        for part in np.array_split(features, 3):
            statistics.add_features("pointnet", part, [True, False, True])
        statistics.count = 9
        both.append(statistics)
    kept = [features[[0, 2, 3, 5, 6]] for features in values]
    assert torch.equal(both[0].features("pointnet"), torch.from_numpy(kept[0]))
    expected = kernel_distance(kept[0], kept[1], np.random.RandomState(0), 2, 4)
    found = {r.name: r.value for r in evaluate.results_of(*both)}
    assert found["FPD squared MMD"] == pytest.approx(expected, rel=1e-6)


def test_parts_merge_in_the_order_of_their_numbers_however_their_files_are_named(tmp_path: Path):
    """As a shell's glob has them, 1, 10, 11, 2: the squared MMD's subsets are of other features in another order."""
    protocol = replace(R2DM, networks=(Network("pointnet", (), "given", 8),), keep=16, subsets=2, subset_size=4)
    values, drawn = np.random.default_rng(0).normal(size=(12, 2, 8)).astype(np.float32), images(12)
    for i in range(12):
        part = gathered(drawn[i : i + 1], protocol=protocol)
        part.add_features("pointnet", values[i], [True, True])
        save_statistics(tmp_path / f"part-{i + 1}.safetensors", part, {"part": f"{i + 1}/12"})
    files = sorted(tmp_path.iterdir())
    assert files[1].name == "part-10.safetensors"
    for given in (files, files[::-1]):
        total, told = merged(given, protocol)
        assert not told and torch.equal(total.features("pointnet"), torch.from_numpy(values[:8].reshape(16, 8)))
        assert total.bev and torch.equal(total.bev.scans, gathered(drawn, protocol=protocol).bev.scans)
