"""Evaluation as a user meets it: every form of samples, kept and merged statistics, the verb, and how it refuses."""

import json
import os
import random
import re
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from forked import Forked

import lidarsynth as ls
from lidarsynth.cli.main import main
from lidarsynth.data.dataset import CachedImages, write_cache
from lidarsynth.evaluation import accumulation
from lidarsynth.evaluation import evaluate as evaluation
from lidarsynth.evaluation.features import gated
from lidarsynth.evaluation.image_sets import as_image, image_set
from lidarsynth.evaluation.pairs import Pairs
from lidarsynth.evaluation.protocol import EvaluationProtocol, Sets
from lidarsynth.evaluation.protocols import BEV_1, DUSTY, LIDARGEN, R2DM, R2DM_UPSAMPLING, STREET_1
from lidarsynth.evaluation.report import Result
from lidarsynth.evaluation.statistics import Statistics, load_statistics
from lidarsynth.files.formats import write
from lidarsynth.lidar.projection import project, thin
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.metrics.reconstruction import voxel_errors
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.streets.hdl64e import own_car
from lidarsynth.verbs.learned_sensor import sensor_toml

SENSOR = SENSORS["hdl-64e"].resized(width=64)


def street(seed: int, sensor: Sensor = SENSOR) -> RangeImage:
    """A road between walls at some distance, with ray-drop."""
    rng = np.random.default_rng(seed)
    rays = sensor.directions()
    with np.errstate(divide="ignore"):
        wall = rng.uniform(5, 12) / np.abs(rays[..., 1])
        distance = np.minimum(np.where(rays[..., 2] < 0, -1.7 / rays[..., 2], np.inf), wall)
    mask = (distance < 60) & (distance > 2) & (rng.random(distance.shape) < 0.9)
    reflectance = rng.random(distance.shape).astype(np.float32) * mask
    return RangeImage(np.where(mask, distance, 0).astype(np.float32), reflectance, mask, sensor)


STREETS = [street(i) for i in range(6)]
REAL = [street(i) for i in range(100, 108)]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache folder, and files that cannot be downloaded, at once."""
    monkeypatch.setenv("LIDARSYNTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(accumulation, "URLS", dict.fromkeys(accumulation.URLS, (tmp_path / "nowhere").as_uri()))
    return tmp_path / "cache"


def saved(folder: Path, images: list[RangeImage], form: str = "npz") -> Path:
    """A folder of the images as `.npz`, `.ply`, or official samples of R2DM or LiDARGen."""
    folder.mkdir(parents=True)
    for i, image in enumerate(images):
        if form == "r2dm":
            xyz = np.moveaxis(image.points(), -1, 0)
            torch.save(torch.from_numpy(np.stack([image.range, *xyz, image.reflectance])), folder / f"{i:010d}.pth")
        elif form == "lidargen":
            code = torch.from_numpy(np.log2(image.range + 1) / 6)
            torch.save(torch.stack([code, torch.from_numpy(image.reflectance)]), folder / f"{i}.pth")
        else:
            write(folder / f"{i}.{form}", image)
    return folder


@pytest.fixture
def real(tmp_path: Path) -> Path:
    return saved(tmp_path / "real", REAL)


Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def run(*words: object) -> tuple[int, str, str]:
        code = 0
        try:
            main([str(word) for word in words])
        except SystemExit as end:
            code = int(end.code or 0)
        return code, *capsys.readouterr()

    return run


def test_a_list_of_images_is_judged_in_memory():
    report = ls.evaluate(STREETS, REAL, protocol="bev-1")
    assert report.counts["samples"] == 6 and report.counts["reference"] == 8
    assert 0 < report.values["JSD x1e2"] < 50
    assert report.beams is not None and len(report.beams.drop_rate) == 64
    same = ls.evaluate(STREETS, STREETS, protocol="bev-1")
    assert same.values == pytest.approx(dict.fromkeys(same.values, 0), abs=1e-4)


@pytest.mark.parametrize(("form", "exact"), [("npz", True), ("r2dm", True), ("lidargen", False)])
def test_every_form_of_the_same_samples_scores_the_same(form, exact, tmp_path: Path, real: Path):
    expected = ls.evaluate(STREETS, REAL)
    report = ls.evaluate(saved(tmp_path / form, STREETS, form), real)
    # LiDARGen's code is a logarithm in float32: a point may pass a cell's edge
    assert report.values == pytest.approx(expected.values, rel=1e-6 if exact else 0.02)
    assert (report.hashes["samples"] == expected.hashes["samples"]) == exact


def test_points_are_drawn_into_the_images_of_the_reference(tmp_path: Path, real: Path):
    sensor = SENSORS["hdl-64e-kitti"].resized(width=64)
    truth = [street(i, sensor) for i in range(100, 104)]
    points = saved(tmp_path / "ply", [street(i, sensor) for i in range(4)], "ply")
    report = ls.evaluate(points, saved(tmp_path / "truth", truth))
    expected = ls.evaluate([street(i, sensor) for i in range(4)], truth)
    assert report.values == pytest.approx(expected.values, rel=1e-4)


def test_a_cache_is_a_reference_and_larger_images_are_thinned(tmp_path: Path):
    wide = SENSORS["hdl-64e"].resized(width=128)
    large = [street(i, wide) for i in range(5)]
    for _ in write_cache(tmp_path / "large", large.__getitem__, len(large), wide, {"name": "streets"}):
        pass
    report = ls.evaluate(STREETS, tmp_path / "large")
    expected = ls.evaluate(STREETS, [thin(image, 64, 64) for image in large])
    assert report.values == pytest.approx(expected.values, rel=0.02), "a cache rounds to 2 mm"
    with pytest.raises(ValueError, match="expected a reference of the samples' 64 x 128 pixels or a multiple"):
        ls.evaluate(large, STREETS)


def test_statistics_of_the_reference_are_kept_shared_and_verified(tmp_path: Path, real: Path, cache: Path):
    calls: list[tuple[str, int, int]] = []
    first = evaluation.evaluate(STREETS, real, on_images=lambda *told: calls.append(told))
    assert ("real", 8, 8) in calls and calls[-1] == ("compute range, per beam", 3, 4)
    calls.clear()
    again = evaluation.evaluate(STREETS, real, on_images=lambda *told: calls.append(told))
    assert "samples" in {told[0] for told in calls} and ("real", 8, 8) not in calls, "it is not read twice"
    assert again.values == first.values
    (kept,) = (cache / "statistics").iterdir()
    assert first.sources["reference statistics"] == str(kept)
    plain = tmp_path / "plain"
    plain.touch()
    assert kept.stat().st_mode == plain.stat().st_mode, "as readable as any file, to be shared"
    shared = tmp_path / "given.safetensors"
    shared.write_bytes(kept.read_bytes())
    assert ls.evaluate(STREETS, shared).values == first.values
    content = bytearray(kept.read_bytes())
    content[-1] ^= 1
    shared.write_bytes(content)
    with pytest.raises(ValueError, match=r"given.safetensors: expected the content of SHA-256"):
        ls.evaluate(STREETS, shared)
    write(real / "8.npz", street(200))
    assert ls.evaluate(STREETS, real).counts["reference"] == 9, "a changed folder is read anew"


def test_what_was_kept_before_files_were_read_otherwise_is_made_anew(
    real: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
):
    ls.evaluate(STREETS, real)
    monkeypatch.setattr(evaluation, "GATHERED", evaluation.GATHERED + 1)
    ls.evaluate(STREETS, real)
    assert len(list((cache / "statistics").iterdir())) == 2


def test_two_machines_share_the_samples(tmp_path: Path, real: Path):
    samples = saved(tmp_path / "samples", STREETS)
    parts = [tmp_path / f"{i}.safetensors" for i in (1, 2)]
    for i, part in enumerate(parts, 1):
        evaluation.gather_part(samples, f"{i}/2", part, "bev-1")
    report, whole = ls.evaluate(parts, real), ls.evaluate(samples, real)
    assert report.values == pytest.approx(whole.values, rel=1e-5)
    assert report.hashes["samples"] == whole.hashes["samples"]
    with pytest.raises(ValueError, match="expected a part of its own"):
        ls.evaluate([parts[0], parts[0]], real)
    with pytest.raises(ValueError, match="expected only files of statistics"):
        ls.evaluate([parts[0], samples], real)
    with pytest.raises(ValueError, match="expected a part such as 1/2, found '3/2'"):
        evaluation.gather_part(samples, "3/2", parts[0], "bev-1")


def test_parts_of_points_are_drawn_into_the_images_of_the_reference(tmp_path: Path, run: Run):
    sensor = SENSORS["hdl-64e-kitti"].resized(width=64)
    real = saved(tmp_path / "real", [street(i, sensor) for i in range(100, 104)])
    points, out = saved(tmp_path / "ply", [street(i, sensor) for i in range(4)], "ply"), tmp_path / "r.json"
    run("evaluate", points, "--reference", real, "--out", out)
    expected = json.loads(out.read_text())["values"]
    reference = tmp_path / "real.safetensors"
    run("evaluate", real, "--part", "1/1", "--side", "reference", "--out", reference)
    for like in (real, reference):
        run("evaluate", points, "--part", "1/1", "--reference", like, "--out", tmp_path / "part.safetensors")
        assert run("evaluate", tmp_path / "part.safetensors", "--reference", reference, "--out", out)[0] == 0
        assert json.loads(out.read_text())["values"] == expected


def test_parts_of_a_reference_become_one_file_to_share(tmp_path: Path, real: Path):
    parts = [tmp_path / f"{i}.safetensors" for i in (1, 2, 3)]
    for i, part in enumerate(parts, 1):
        evaluation.gather_part(real, f"{i}/3", part, "bev-1", side="reference")
    shared_file = tmp_path / "streets.safetensors"
    evaluation.gather_part(parts, "1/1", shared_file, "bev-1")
    whole = ls.evaluate(STREETS, real)
    for reference in (shared_file, parts):
        report = ls.evaluate(STREETS, reference)
        assert report.values == pytest.approx(whole.values, rel=1e-6)
        assert report.hashes["reference"] == whole.hashes["reference"]
    report = ls.evaluate(STREETS, parts[:2])
    assert "expected all parts of the images, found none of 3/3" in report.warnings
    with pytest.raises(ValueError, match="found none of 2/3"):
        evaluation.gather_part([parts[0], parts[2]], "1/1", shared_file, "bev-1")
    evaluation.gather_part(real, "1/1", shared_file, "bev-1")
    with pytest.raises(ValueError, match="found samples and samples; gather a reference as such"):
        ls.evaluate(STREETS, shared_file)
    evaluation.gather_part(real, "2/2", shared_file, "bev-1", side="reference")
    evaluation.gather_part(real, "1/40", tmp_path / "one.safetensors", "bev-1", side="reference")
    told = ls.evaluate(STREETS, tmp_path / "one.safetensors").warnings
    lacking = "2/40, 3/40, 4/40, 5/40, 6/40, 7/40, 8/40, 9/40 and 31 more"
    assert any(text.endswith(f"found none of {lacking}") for text in told)
    with pytest.raises(ValueError, match="expected parts of one division, found 1/3, 2/2"):
        ls.evaluate(STREETS, [parts[0], shared_file])
    with pytest.raises(ValueError, match="takes as many of the reference as there are samples"):
        evaluation.gather_part(real, "1/1", shared_file, LIDARGEN, side="reference")


def evaluate_until_killed(words: list[str]) -> None:
    def kill(what: str, done: int, total: int) -> None:
        if done == 4:
            os.kill(os.getpid(), signal.SIGKILL)

    accumulation.SAVE_EVERY = 0.0
    evaluation.evaluate(*words, batch_size=1, on_images=kill)


@pytest.mark.parametrize("protocol", ["bev-1", "r2dm-upsampling-2024"])
def test_a_killed_evaluation_goes_on(protocol: str, tmp_path: Path, real: Path, cache: Path):
    """kill -9 in the middle: the second call begins at the fourth image, and finds what one call would have found."""
    samples = saved(tmp_path / "samples", [*STREETS, *STREETS[:2]])
    expected = ls.evaluate([*STREETS, *STREETS[:2]], REAL, protocol=protocol)
    killed = Forked(samples, real, protocol, run=evaluate_until_killed)
    assert killed.wait() == -signal.SIGKILL, killed.communicate()
    assert len(list((cache / "statistics").glob("unfinished-*"))) == 1
    seen: list[int] = []
    report = evaluation.evaluate(
        samples, real, protocol, batch_size=1, on_images=lambda what, done, total: seen.append(done)
    )
    assert seen[0] == 4, "three images were kept"
    assert report.values == expected.values, "bit by bit: integers, and sums in the same order"
    assert {**expected.hashes, **report.hashes} == report.hashes
    assert not list((cache / "statistics").glob("unfinished-*"))


def test_a_stopped_evaluation_goes_on(tmp_path: Path, real: Path, cache: Path, monkeypatch: pytest.MonkeyPatch):
    samples = saved(tmp_path / "samples", STREETS)
    expected = ls.evaluate(STREETS, real)
    monkeypatch.setattr(accumulation, "SAVE_EVERY", 0.0)
    seen: list[int] = []

    def stop(what: str, done: int, total: int) -> None:
        seen.append(done)
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluation.evaluate(samples, real, batch_size=1, on_images=stop)
    assert seen == [1, 2, 3, 4]
    seen.clear()
    report = evaluation.evaluate(samples, real, batch_size=1, on_images=lambda what, done, total: seen.append(done))
    assert seen[0] == 4, "three images were kept"
    assert report.values == pytest.approx(expected.values, rel=1e-6)
    assert report.hashes["samples"] == expected.hashes["samples"]
    assert not list((cache / "statistics").glob("unfinished-*"))


def test_networks_are_downloaded_or_make_rows_na(
    tmp_path: Path, real: Path, cache: Path, official_file, monkeypatch: pytest.MonkeyPatch
):
    report = ls.evaluate(STREETS, real, protocol="r2dm-2024")
    assert report.values["FPD"] is None and report.values["JSD x1e2"] is not None
    assert f"without a network, put the file at {cache / 'cls_model_39.pth'}" in str(report)
    assert "N/A: FPD, FPD squared MMD: file:" in str(report), "the reason stands there once"
    assert "no official rangenet for 64 columns, only for 2048, 1024, 512" in str(report)
    folder = official_file("pointnet/cls_model_39.pth").parent
    monkeypatch.setitem(accumulation.URLS, "pointnet", folder.as_uri())
    report = ls.evaluate(STREETS, real, protocol="r2dm-2024")
    assert report.values["FPD"] is not None and report.values["FPD squared MMD"] is not None
    assert len(report.hashes["pointnet"]) == 64
    assert any("singular covariance of 1808" in warning for warning in report.warnings)
    (cache / "cls_model_39.pth").write_bytes(b"")
    with pytest.raises(
        ValueError, match=r"cls_model_39\.pth: expected weights.*; delete the file to download it again"
    ):
        ls.evaluate(STREETS, real, protocol="r2dm-2024")


def test_another_rangenet_than_the_protocols_is_refused(cache: Path, shared: Path):
    cache.mkdir()
    (cache / "darknet53-1024.tar.gz").symlink_to(shared / "fixtures/rangenet/darknet21.tar.gz")
    with pytest.raises(ValueError, match="expected RangeNet-53, found RangeNet-21"):
        accumulation.load_networks(R2DM, 1024)


def test_protocols_choose_the_images_that_their_programs_choose():
    r2dm = accumulation.select(R2DM, "real", [str(i) for i in range(10_037)])
    assert len(r2dm.features) == 10_037 and len(r2dm.bev) == 10_000
    few = accumulation.select(replace(R2DM, real_bev=5), "real", [str(i) for i in range(37)])
    assert few.bev == {0, 19, 14, 21, 22}, "Random(0).shuffle of 37, metrics/values.json"
    names = [f"2013_05_28_drive_{s:04d}_sync/{i}" for s in range(4) for i in range(10)]
    chosen = accumulation.select(LIDARGEN, "real", names, samples=7)
    assert len(chosen.features) == 7 and chosen.features < set(range(20))
    assert chosen.bev == {*range(10), *range(20, 30)}
    samples = accumulation.select(LIDARGEN, "samples", [str(i) for i in range(2000)])
    assert samples.features == set(range(1100)) and len(samples.bev) == 2000


def test_the_shuffle_of_real_scans_is_of_the_published_order():
    """R2DM numbers KITTI-360 by its training drives, then 0 and 2; the paths of a folder begin with 0."""
    read = [f"2013_05_28_drive_{drive:04d}_sync/{i}" for drive in (3, 4, 5, 6, 7, 9, 10, 0, 2) for i in range(9)]
    order = list(range(81))
    random.Random(0).shuffle(order)
    published = {read[i] for i in order[:20]}
    for names in (read, sorted(read), [f"root/{name}.bin" for name in sorted(read)]):
        chosen = accumulation.select(replace(R2DM, real_bev=20), "real", names)
        assert {names[i].removeprefix("root/").removesuffix(".bin") for i in chosen.bev} == published
    raw = [f"2011_09_26_drive_{drive:04d}_sync/0" for drive in (3, 2, 0, 1)]
    assert accumulation.select(replace(R2DM, real_bev=3), "real", raw).bev == {0, 2, 1}, "another set stays as it is"


def test_dusty_judges_ranges_along_rays_and_takes_the_columns_of_its_program(scan64: bytes):
    """Its points are made of inverse depth, of real scans too, and both limits count."""
    table = np.frombuffer(scan64, "<f4").reshape(-1, 4)
    scan, sensor = Scan(table[:, :3], table[:, 3]), replace(ls.get_sensor(DUSTY.sensor), width=512)
    real = as_image(scan, sensor, DUSTY.projection, True, DUSTY.resizing)
    wide = project(scan, sensor, "unfolding", 2048)
    np.testing.assert_array_equal(real.range, wide.range[:, ::4])
    assert real.xyz is not None
    seen = Statistics(replace(DUSTY, networks=(), sets=Sets(points=64)), sensor, "real")
    bare = Statistics(seen.protocol, sensor, "real")
    seen.update([real], [True], [True], [True])
    bare.update([replace(real, xyz=None)], [True], [True], [True])
    np.testing.assert_array_equal(seen.sets(), bare.sets())
    nearest = np.where(np.arange(512) % 2 == 0, np.float32(1.45), np.float32(80)) * np.ones((64, 1), np.float32)
    limits = RangeImage(nearest, np.zeros_like(nearest), nearest > 0, sensor)
    assert gated(limits, DUSTY, "samples").all()


@pytest.mark.parametrize(
    ("word", "protocol", "projection"),
    [
        ("hdl-64e", R2DM, "spherical"),
        ("hdl-64e-r2dm", R2DM, "unfolding"),
        ("hdl-64e-dusty", DUSTY, "unfolding"),
        ("hdl-64e-lidargen", LIDARGEN, "spherical"),
        ("hdl-64e-lidargen", R2DM, "auto"),
        ("hdl-64e-kitti", R2DM, "auto"),
    ],
)
def test_scans_are_drawn_as_the_program_of_the_samples_draws_them(word: str, protocol, projection: str):
    """Of a turn of 62 rings too, which `auto` would draw by elevation, and mean beams have none of their own."""
    run = evaluation._Run(protocol, None, 1, "cpu", None)
    assert run.projection(replace(ls.get_sensor(word), width=512)) == projection


def test_a_reference_without_the_protocols_sequences_is_told():
    report = evaluation.evaluate(STREETS, REAL, LIDARGEN)
    assert report.counts["reference"] == 6, "as many as samples"
    apart = "6 samples against 8 of the reference in bird's eye view: scores of small sets are larger"
    assert any(warning.startswith(apart) for warning in report.warnings), "MMD and JSD are against all of them"
    assert any("the reference has none, all were taken" in warning for warning in report.warnings)
    assert report.values["FRD"] is None and report.values["JSD x1e2"] is not None


def test_a_reference_with_some_of_the_protocols_sequences_is_told(tmp_path: Path):
    """Of LiDARGen's, drive 0002 is for histograms alone; the FRD was with it, without a word."""
    for drive, told in (
        (0, ""),
        (1, "lidargen-2022 v2 compares bird's eye views with the sequences 0000_sync, 0002_sync; the reference has"),
        (2, "lidargen-2022 v2 compares features with the sequences 0000_sync, 0001_sync; the reference has none, all"),
        (3, "lidargen-2022 v2 compares with the sequences 0000_sync, 0001_sync, 0002_sync; the reference has none"),
    ):
        real = saved(tmp_path / f"2013_05_28_drive_{drive:04d}_sync", REAL[:2])
        found = [w for w in ls.evaluate(STREETS[:2], real, "lidargen-2022").warnings if "sequences" in w]
        assert bool(found) == bool(told) and all(warning.startswith(told) for warning in found), found


def test_upsampling_compares_images_one_by_one():
    report = ls.evaluate(STREETS[:2], REAL[:2], protocol="r2dm-upsampling-2024")
    errors = [np.abs(a.range - b.range).mean() for a, b in zip(STREETS, REAL[:2], strict=False)]
    assert report.values["range MAE"] == pytest.approx(np.mean(errors), rel=1e-5)
    assert report.values["IoU"] is None and "only for 2048" in str(report)
    with pytest.raises(ValueError, match=r"as many of both, found 6 and 8"):
        ls.evaluate(STREETS, REAL, protocol=R2DM_UPSAMPLING.name)


def test_voxels_are_compared_scan_by_scan_and_no_return_is_far():
    truth = REAL[0]
    same = ls.evaluate([truth], [truth], protocol="iln-2022").values
    assert list(same.values()) == [0, 100, 100, 100, 100]
    half = truth.keep(np.arange(truth.shape[0])[:, None] % 2 + np.zeros(truth.shape) == 0)
    report = ls.evaluate([half, truth], [truth, truth], protocol="iln-2022")
    lost = truth.mask & ~half.mask
    assert report.values["range MAE"] == pytest.approx((100 - truth.range[lost]).clip(0).sum() / truth.mask.size / 2)
    points = [image.sensor.points(image.range)[image.mask] for image in (half, truth)]
    errors = voxel_errors(*points)
    assert errors.precision == 1 and 0.3 < errors.recall < 0.9
    assert report.values["voxel recall"] == pytest.approx(50 * (errors.recall + 1))
    assert report.values["voxel IoU"] == pytest.approx(50 * (errors.iou + 1))
    nothing = truth.keep(np.zeros(truth.shape, bool))
    assert list(ls.evaluate([nothing], [truth], protocol="iln-2022").values.values())[1:] == [0, 0, 0, 0]


def test_the_shipped_network_tells_classes_without_a_download():
    street = ls.read(Path(ls.__file__).parent / "shipped" / "street.npz")
    truth = ls.load().image_of(street)
    rows = np.zeros(truth.shape, bool)
    rows[::4] = True
    hidden = truth.keep(rows)
    same, less = (ls.evaluate([image], [truth], protocol="street-upsampling-1") for image in (truth, hidden))
    assert same.values["range MAE"] == 0 and same.classes["car"] == 1 and same.classes["road"] == 1
    assert same.values["IoU weighted"] == pytest.approx(100)
    assert less.values["IoU weighted"] < 60 and less.classes["road"] < 0.6
    (weights,) = {value for name, value in same.to_dict()["hashes"].items() if "rangenet" in name}
    assert len(weights) == 64


def test_classes_are_compared_pixel_by_pixel_and_named(tmp_path: Path):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = RangeNet(21, width=4).eval()
    both = [Pairs(R2DM_UPSAMPLING, network) for _ in range(2)]
    both[0].update(STREETS[:2], REAL[:2])
    both[1].update(STREETS[2:3], REAL[2:3])
    both[0].merge(both[1])
    report = both[0].report()
    labels = [np.concatenate([both[0]._labels([image]) for image in images[:3]]) for images in (REAL, STREETS)]
    union = [[((labels[0] == c) & (labels[0] > 0) & (labels[1] > 0) & (labels[1] == c)).sum(),
              (((labels[0] == c) | (labels[1] == c)) & (labels[0] > 0) & (labels[1] > 0)).sum()]
             for c in range(1, 20)]  # fmt: skip
    iou = np.array([hit / max(either, 1) for hit, either in union])
    assert list(report.classes.values()) == pytest.approx(iou.tolist()) and "car" in report.classes
    assert report.values["IoU"] == pytest.approx(100 * iou.mean())
    assert "| car |" in report.markdown() and json.loads(report.json())["classes"] == report.classes
    truth = saved(tmp_path / "truth", REAL[:2])
    (truth / "1.npz").rename(truth / "2.npz")
    report = ls.evaluate(saved(tmp_path / "samples", STREETS[:2]), truth, protocol="r2dm-upsampling-2024")
    assert "1 of 2 samples are compared with a reference of another name, first" in report.warnings[-1]


def test_point_sets_are_judged_where_they_are_few_enough():
    small = ls.evaluate(STREETS, REAL, protocol="dusty-2023-small")
    assert small.counts["samples as point sets"] == 6 and small.counts["reference as point sets"] == 8
    assert 0 < small.values["JSD"] < 1 and 0 < small.values["MMD"] < 0.2
    assert 100 / 8 <= small.values["COV"] <= 100 and 0 <= small.values["1-NNA"] <= 100
    same = ls.evaluate(STREETS, STREETS, protocol="dusty-2023-small")
    assert same.values == pytest.approx({"JSD": 0, "COV": 100, "MMD": 0, "1-NNA": 0})
    few = replace(DUSTY, sets=replace(DUSTY.sets, points=16, pairs=90))
    report = evaluation.evaluate(STREETS, REAL, few)  # 6 * 8 + 15 + 28 = 91 pairs
    assert report.values["COV"] is None and report.values["JSD"] is not None
    assert "N/A: COV, MMD, 1-NNA: needs 91 earth mover's distances between sets of 16 points, at most 90" in str(report)
    assert json.loads(report.json())["values"]["SWD"]["reason"].endswith("not here")


def test_progress_goes_on_while_distances_of_point_sets_are_computed():
    told: list[tuple[str, int, int]] = []
    few = replace(DUSTY, sets=replace(DUSTY.sets, points=16))
    report = evaluation.evaluate(STREETS, REAL, few, on_images=lambda *step: told.append(step))
    assert [step for step in told if step[2] == 91] == [
        ("compute COV", i + 1, 91) for i in range(91)
    ]  # once for 3 rows
    assert report.values == evaluation.evaluate(STREETS, REAL, few).values


def broken_sample(folder: Path, values: torch.Tensor) -> Path:
    folder.mkdir()
    torch.save(values, folder / "0.pth")
    return folder


def test_errors_name_the_sample_and_say_both_sides(tmp_path: Path, real: Path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"empty: expected a cache, or samples \(.bin, .* found none"):
        ls.evaluate(tmp_path / "empty", real)
    with pytest.raises(ValueError, match="found no such file or folder"):
        ls.evaluate(STREETS, tmp_path / "nowhere")
    with pytest.raises(ValueError, match="found an empty list"):
        ls.evaluate([], real)
    nan = broken_sample(tmp_path / "nan", torch.full((5, 64, 64), float("nan")))
    with pytest.raises(ValueError, match=r"0.pth: expected finite values, found 20480 of NaN"):
        ls.evaluate(nan, real)
    shape = broken_sample(tmp_path / "shape", torch.zeros(3, 64, 64))
    with pytest.raises(ValueError, match=r"expected a tensor \(5, H, W\) or \(2, H, W\).*found \(3, 64, 64\)"):
        ls.evaluate(shape, real)
    mixed = saved(tmp_path / "mixed", [*STREETS[:2], street(0, SENSORS["hdl-64e"].resized(width=128))])
    with pytest.raises(ValueError, match=r"2.npz: expected images of one size, 64 x 64, found one of 64 x 128"):
        ls.evaluate(mixed, real)
    (tmp_path / "code").mkdir()
    torch.save({"f": print}, tmp_path / "code/0.pth")
    with pytest.raises(ValueError, match="damaged or unsafe file"):
        ls.evaluate(tmp_path / "code", real)
    with pytest.raises(ValueError, match=r"image 0: expected a range image, .* found \{'a': array\(.*\]\]") as caught:
        ls.evaluate([{"a": np.zeros((2, 3))}], real)
    assert "\n" not in str(caught.value)


def recoded(form: str, images: list[RangeImage]) -> list[torch.Tensor]:
    """Official samples in another code or scale than theirs."""
    tensors = []
    for image in images:
        code, xyz, light = np.log2(image.range + 1) / 6, np.moveaxis(image.points(), -1, 0), image.reflectance
        channels = {
            "both coded to -1 to 1": (2 * code - 1, 2 * light - 1),
            "range coded to -1 to 1": (2 * code - 1, light),
            "metres": (image.range, light),
            "exchanged": (light, code),
            "reflectance to 255": (code, 255 * light),
            "points, reflectance to 255": (image.range, *xyz, 255 * light),
            "points, reflectance to -1": (image.range, *xyz, light - 1),
            "points, depth as a code": (code, *xyz, light),
            "points, in 80 m": (image.range, *xyz / 80, light),
            "points, of another frame": (image.range, *xyz[:2], xyz[2] + 1.73, light),
        }[form]
        tensors.append(torch.from_numpy(np.stack(channels).astype(np.float32)))
    return tensors


@pytest.mark.parametrize(
    ("form", "reason"),
    [
        ("both coded to -1 to 1", "expected a reflectance of 0 to 1, found -1 to "),
        ("range coded to -1 to 1", r"expected a range code log2\(r \+ 1\) / 6 of 0 to 1.057, found -1 to "),
        ("metres", r"expected a range code log2\(r \+ 1\) / 6 of 0 to 1.057, found 0 to "),
        ("exchanged", r"expected a range code and then a reflectance, found .* are they exchanged\?"),
        ("reflectance to 255", "expected a reflectance of 0 to 1, found 0 to 25"),
        ("points, reflectance to 255", "expected a reflectance of 0 to 1, found 0 to 25"),
        ("points, reflectance to -1", "expected a reflectance of 0 to 1, found -1 to "),
        ("points, depth as a code", r"expected a depth of \|x, y, z\| in metres, found another in 100% of the pixels"),
        ("points, in 80 m", r"expected a depth of \|x, y, z\| in metres, found another in 100% of the pixels"),
        ("points, of another frame", r"expected a depth of \|x, y, z\| in metres, found another"),
    ],
)
def test_samples_in_another_code_are_refused(form: str, reason: str, tmp_path: Path, real: Path, run: Run):
    (tmp_path / "samples").mkdir()
    for i, tensor in enumerate(recoded(form, STREETS[:2])):
        torch.save(tensor, tmp_path / f"samples/{i}.pth")
    for protocol in ("bev-1", "r3dpa-2026"):
        with pytest.raises(ValueError, match=f"0.pth: {reason}") as refusal:
            ls.evaluate(tmp_path / "samples", real, protocol)
        assert "\n" not in str(refusal.value)
    assert run("evaluate", tmp_path / "samples", "--reference", real, "--out", tmp_path / "r.json")[0] == 2


def test_images_whose_channels_are_exchanged_are_refused(real: Path):
    exchanged = [replace(image, range=image.reflectance, reflectance=image.range) for image in STREETS[:2]]
    with pytest.raises(ValueError, match=r"image 0: expected ranges in metres and .* found ranges of at most 1 and a "
                                         r"reflectance of up to [0-9.]+: are they exchanged\?$"):  # fmt: skip
        ls.evaluate(exchanged, real, "bev-1")


@pytest.mark.parametrize(
    ("how", "turn"),
    [
        ("mirrored left to right", lambda array: array[:, ::-1]),
        ("turned by half a turn", lambda array: np.roll(array, 256, axis=1)),
        ("mirrored front to back", lambda array: np.roll(array[:, ::-1], 256, axis=1)),
        (None, lambda array: array),
    ],
)
def test_images_that_are_mirrored_or_turned_are_told_by_the_car_that_they_show(how, turn):
    sensor = SENSORS["hdl-64e-kitti"].resized(width=512)
    seen = [street(i, sensor) for i in range(2)]
    real = [image.keep(image.mask & ~own_car(sensor)) for image in seen]
    turned = [replace(image, **{name: turn(getattr(image, name)) for name in ("range", "reflectance", "mask")})
              for image in real]  # fmt: skip

    def told(samples: list[RangeImage], reference: list[RangeImage]) -> list[str]:
        return [text for text in ls.evaluate(samples, reference, "bev-1").warnings if "look" in text]

    for side, texts in (("samples", told(turned, real)), ("the reference", told(real, turned))):
        assert len(texts) == (how is not None)
        assert how is None or texts[0].startswith(f"images of {side} look {how}: ")
    assert told(seen, real) == []  # of a car that hides nothing
    thin = [image.keep(np.isin(np.arange(64), range(0, 64, 4))[:, None] & image.mask) for image in real]
    assert told(thin, real) == []


def test_samples_that_pass_their_limits_a_little_are_clipped(tmp_path: Path):
    code, light = np.log2(STREETS[0].range + 1) / 6, STREETS[0].reflectance
    kept = torch.from_numpy(np.stack([code, light]))
    kept[0, 0], kept[1, 0, :32] = 1.0, 0.0
    passed = kept.clone()
    passed[0, 0] = np.log2(81) / 6  # an hdl-64e sees 80 m, the code ends at 63
    passed[0][kept[0] == 0], passed[1, 0, :32] = -0.02, -0.02
    for name, tensor in (("kept", kept), ("passed", passed)):
        broken_sample(tmp_path / name, tensor)
    images = [image_set(tmp_path / name).image(0, SENSOR, "spherical") for name in ("kept", "passed")]
    for name in ("range", "reflectance", "mask"):
        np.testing.assert_array_equal(*(getattr(image, name) for image in images))
    assert images[1].range.max() == pytest.approx(63)


def test_tensors_of_other_beams_than_they_are_taken_for_are_noted(tmp_path: Path):
    protocol = replace(STREET_1, networks=(), rows=BEV_1.rows)
    real = saved(tmp_path / "real", [street(i, SENSORS["hdl-64e-kitti"].resized(width=64)) for i in range(2)], "ply")

    def notes(form: str, sensor: str | None = None, side: int = 0) -> list[str]:
        folder = tmp_path / form
        sides = (folder, real) if side == 0 else (real, folder)
        warnings = ls.evaluate(*sides, protocol, sensor=sensor).warnings
        return [text for text in warnings if "tensors" in text]

    for form in ("r2dm", "lidargen"):
        saved(tmp_path / form, STREETS[:2], form)
        assert notes(form, "hdl-64e") == []
    (points,) = notes("r2dm")
    assert re.fullmatch(
        r"the points of samples, which are tensors, lie \d\.\d degrees off the beams of hdl-64e-kitti, for whose rows "
        r"they are taken: --sensor names theirs \(R2DM's grid is hdl-64e\)",
        points,
    )
    assert notes("lidargen") == ["samples are tensors without points, taken for the rays of hdl-64e-kitti: --sensor "
                                 "names others (R2DM's grid is hdl-64e)"]  # fmt: skip
    assert notes("lidargen", side=1)[0].startswith("the reference are tensors without points")
    assert not [text for text in ls.evaluate(tmp_path / "r2dm", STREETS[:2]).warnings if "tensors" in text]


@pytest.mark.parametrize(("order", "signs"), [((1, 0, 2), (1, 1, 1)), ((0, 1, 2), (1, -1, 1)), ((0, 1, 2), (-1, 1, 1))])
def test_tensors_whose_points_are_off_their_columns_are_noted(order, signs):
    five = [np.concatenate([i.range[None], np.moveaxis(i.points(), -1, 0), i.reflectance[None]]) for i in STREETS[:2]]
    protocol = replace(STREET_1, networks=(), rows=BEV_1.rows)

    def notes(samples: list[np.ndarray]) -> list[str]:
        return [text for text in ls.evaluate(samples, REAL[:2], protocol).warnings if "off their columns" in text]

    turned = [np.concatenate([a[:1], a[1:4][list(order)] * np.reshape(signs, (3, 1, 1)), a[4:]]) for a in five]
    assert notes(five) == [] and len(notes(turned)) == 1


def test_what_stands_in_empty_pixels_does_not_count(tmp_path: Path, real: Path):
    def filled(image: RangeImage) -> RangeImage:
        hole = ~image.mask
        xyz = np.where(hole[..., None], np.float32(9), image.points())
        return replace(image, range=image.range + 50 * hole, reflectance=image.reflectance + hole, xyz=xyz)

    dirty = saved(tmp_path / "dirty", [filled(image) for image in STREETS])
    clean = saved(tmp_path / "clean", [replace(image, xyz=image.points()) for image in STREETS])
    for samples in (dirty, [filled(image) for image in STREETS]):
        report = ls.evaluate(samples, clean, "street-upsampling-1")
        assert report.values["range MAE"] == report.values["reflectance MAE"] == 0
    reports = [ls.evaluate(samples, real) for samples in (dirty, clean)]
    assert reports[0].values == reports[1].values and reports[0].hashes["samples"] == reports[1].hashes["samples"]


def test_a_whole_and_its_parts_do_not_merge(tmp_path: Path, real: Path, run: Run):
    samples, files = saved(tmp_path / "samples", STREETS), {}
    for part in ("1/1", "1/2", "2/2"):
        files[part] = tmp_path / f"{part[0]}of{part[2]}.safetensors"
        evaluation.gather_part(samples, part, files[part])
    for parts in (("1/1", "1/2"), ("2/2", "1/1"), ("1/1", "1/2", "2/2")):
        code, _, error = run("evaluate", *(files[part] for part in parts), "--reference", real)
        assert code == 2 and f"expected parts of one division, found {', '.join(parts)}" in error
    other = tmp_path / "other.safetensors"
    evaluation.gather_part(saved(tmp_path / "more", REAL[:3]), "1/1", other)
    assert ls.evaluate([files["1/1"], other], real).counts["samples"] == 9, "two whole sets are one"


@pytest.mark.parametrize("protocol", [STREET_1, replace(STREET_1, samples=2, real=0)])
def test_parts_of_which_some_count_for_no_feature_merge(tmp_path: Path, protocol: EvaluationProtocol):
    """More machines than images, or all but the first images for the bird's eye view alone, as of LiDARGen: a part
    without any features was refused, whatever the order, as one of other networks."""
    wide = SENSORS["hdl-64e-kitti"].resized(width=1024)
    images = [street(i, wide) for i in range(3)]
    files = [tmp_path / f"{i}.safetensors" for i in range(5)]
    for i, file in enumerate(files):
        evaluation.gather_part(images, f"{i + 1}/5", file, protocol)
    empty = [load_statistics(file, protocol)[0].count == 0 for file in files]
    assert empty[0] and True in empty[1:] and False in empty
    real = [street(i, wide) for i in range(100, 104)]
    merged, whole = (evaluation.evaluate(samples, real, protocol) for samples in (files[::-1], images))
    assert merged.values == pytest.approx(whole.values, rel=1e-5) and None not in whole.values.values()
    assert merged.hashes["samples"] == whole.hashes["samples"] and merged.counts == whole.counts


def test_where_a_part_cannot_be_written_is_told_before_it_is_gathered(tmp_path: Path):
    """What was gathered of samples, for hours, was lost."""
    taken, read = tmp_path / "a.safetensors", []
    taken.mkdir()
    (tmp_path / "file").touch()

    class Samples:
        def __len__(self) -> int:
            return 1

        def __getitem__(self, i: int) -> RangeImage:
            read.append(i)
            return STREETS[i]

    with pytest.raises(ValueError, match=r"a.safetensors: expected the name of a file, found a folder"):
        evaluation.gather_part(Samples(), "1/1", taken)
    with pytest.raises(OSError, match="file"):
        evaluation.gather_part(Samples(), "1/1", tmp_path / "file" / "a.safetensors")
    assert not read
    evaluation.gather_part(Samples(), "1/1", tmp_path / "new" / "a.safetensors")
    assert read and (tmp_path / "new" / "a.safetensors").is_file()


def test_devices_numbers_and_sensors_that_cannot_be_are_refused(tmp_path: Path, real: Path, run: Run):
    out, part = tmp_path / "r.json", tmp_path / "part.safetensors"
    for device in ("cuda:99", "tpu-9"):
        with pytest.raises(ValueError, match=f"expected a device of torch, such as cpu or cuda, found '{device}': "):
            ls.evaluate(STREETS, REAL, "street-1", device=device)
        code, _, error = run("evaluate", real, "--reference", real, "--out", out, "--device", device)
        assert code == 2 and error.count("\n") == 1 and "expected a device" in error
    with pytest.raises(ValueError, match="expected an intensity of auto, unit, byte, uint16, none, found 'bytes'"):
        ls.evaluate(STREETS, REAL, intensity="bytes")
    with pytest.raises(ValueError, match="expected a batch_size of at least 1, found 0"):
        ls.evaluate(STREETS, REAL, batch_size=0)
    with pytest.raises(ValueError, match="expected a seed of at least 0, found -1"):
        ls.evaluate(STREETS, REAL, seed=-1)
    with pytest.raises(ValueError, match="expected a batch_size of at least 1, found 0"):
        evaluation.gather_part(real, "1/1", part, batch_size=0)
    for wrong in (1.0, "1", True, None, np.ones(2)):
        for name in ("seed", "batch_size"):
            with pytest.raises(ValueError, match=f"^expected a {name} that is a whole number, found .*$"):
                ls.evaluate(STREETS, REAL, **{name: wrong})
    with pytest.raises(ValueError, match=r"^expected a seed of at most 4294967295, found 4294967296$"):
        ls.evaluate(STREETS, REAL, seed=2**32)
    assert json.loads(ls.evaluate(STREETS, REAL, seed=np.int64(2**32 - 1)).json())["seeds"]["subsets"] == 2**32 - 1
    told = "the samples know their own sensor, hdl-64e: vlp-16, named for points and tensors, is not used"
    assert told in ls.evaluate(STREETS, REAL, sensor="vlp-16").warnings
    assert told not in ls.evaluate(STREETS, REAL, sensor="hdl-64e").warnings
    with pytest.raises(ValueError, match=told):
        evaluation.gather_part(real, "1/1", part, sensor="vlp-16")
    evaluation.gather_part(real, "1/1", part, sensor="hdl-64e")
    assert told in ls.evaluate([part], REAL, sensor="vlp-16").warnings
    assert told in ls.evaluate(STREETS[:2], REAL[:2], "r2dm-upsampling-2024", sensor="vlp-16").warnings


def test_points_that_statistics_draw_say_so_where_another_sensor_was_named(tmp_path: Path, real: Path):
    scans, kept = tmp_path / "scans", tmp_path / "real.safetensors"
    scans.mkdir()
    for i, image in enumerate(STREETS):
        ls.write(scans / f"{i}.bin", image)
    evaluation.gather_part(real, "1/1", kept, side="reference")
    told = "the samples are drawn into the reference's images, of hdl-64e: vlp-16, named for points and tensors, is not"
    named = ls.evaluate(scans, kept, sensor="vlp-16")
    assert any(text.startswith(told) for text in named.warnings)
    for plain in (ls.evaluate(scans, kept), ls.evaluate(scans, kept, sensor="hdl-64e")):
        assert plain.values == named.values and not any("is not used" in text for text in plain.warnings)


def test_a_sensor_of_ones_own_need_not_have_a_word(real: Path):
    own = replace(STREETS[0].sensor, name="own")
    images = [replace(image, sensor=own) for image in STREETS]
    assert ls.evaluate(images, real, sensor=own).values == ls.evaluate(STREETS, real).values
    other = replace(own, name="other", elevations=tuple(e + 1 for e in own.elevations))
    told = "the samples know their own sensor, own: other, named for points and tensors, is not used"
    assert told in ls.evaluate(images, real, sensor=other).warnings


def test_more_machines_than_scans_merge(tmp_path: Path, real: Path):
    parts = [tmp_path / f"{i}.safetensors" for i in range(1, 13)]
    for i, part in enumerate(parts, 1):
        evaluation.gather_part(
            saved(tmp_path / "samples", STREETS) if i == 1 else tmp_path / "samples", f"{i}/12", part
        )
    report = ls.evaluate(parts, real)
    assert report.counts["samples"] == len(STREETS) < len(parts)
    assert report.values == pytest.approx(ls.evaluate(STREETS, real).values, rel=1e-6)
    with pytest.raises(ValueError, match="expected a part of its own"):
        ls.evaluate([parts[0], *parts], real)


def test_parts_of_one_scan_again_and_again_merge(tmp_path: Path):
    """Of a generator that has collapsed, whose parts are alike, or of noise from one seed: they were refused."""
    parts = [tmp_path / f"{i}.safetensors" for i in (1, 2)]
    for i, part in enumerate(parts, 1):
        evaluation.gather_part([STREETS[0]] * 4, f"{i}/2", part)
    report, whole = ls.evaluate(parts, REAL), ls.evaluate([STREETS[0]] * 4, REAL)
    assert report.values == pytest.approx(whole.values, rel=1e-6) and report.hashes == whole.hashes
    with pytest.raises(ValueError, match="expected a part of its own"):
        ls.evaluate([parts[0], parts[0]], REAL)


def test_a_zero_has_no_sign():
    assert [str(Result("FRD", value, "m")) for value in (-0.0004, 0.0004, -0.0006)] == [
        "0.000 m",
        "0.000 m",
        "-0.001 m",
    ]


def test_batches_in_one_file_are_images_like_others(tmp_path: Path, real: Path):
    (tmp_path / "batches").mkdir()
    for name, images in (("a", STREETS[:4]), ("b", STREETS[4:])):
        arrays = {key: np.stack([getattr(image, key) for image in images]) for key in ("range", "reflectance", "mask")}
        sensor = np.array(json.dumps(SENSOR.to_dict()))
        np.savez_compressed(tmp_path / f"batches/{name}.npz", sensor=sensor, **arrays)
    report, expected = ls.evaluate(tmp_path / "batches", real), ls.evaluate(STREETS, real)
    assert report.values == expected.values and report.hashes["samples"] == expected.hashes["samples"]
    assert image_set(tmp_path / "batches").names[4].endswith("b.npz[0]")
    np.savez(tmp_path / "batches/b.npz", sensor=sensor, **{**arrays, "mask": arrays["mask"][:1]})
    with pytest.raises(ValueError, match=r"b.npz.*expected a batch of arrays \(B, ...\)") as caught:
        ls.evaluate(tmp_path / "batches", real)
    assert str(caught.value).count("b.npz") == 1, "the file is named once"


@pytest.mark.parametrize("form", ["r2dm", "lidargen"])
def test_stacked_tensors_in_one_file_are_images_like_others(form: str, tmp_path: Path, real: Path):
    alone = saved(tmp_path / "alone", STREETS, form)
    each = [torch.load(path, weights_only=True) for path in sorted(alone.iterdir())]
    (tmp_path / "stacks").mkdir()
    torch.save(torch.stack(each[:4]), tmp_path / "stacks/a.pth")
    torch.save(torch.stack(each[4:]), tmp_path / "stacks/b.pth", _use_new_zipfile_serialization=False)
    report, expected = ls.evaluate(tmp_path / "stacks", real), ls.evaluate(alone, real)
    assert report.values == expected.values and report.hashes["samples"] == expected.hashes["samples"]
    assert image_set(tmp_path / "stacks").names[4].endswith("b.pth[0]")
    torch.save(torch.stack(each)[:, :1], tmp_path / "stacks/b.pth")
    with pytest.raises(ValueError, match=r"b.pth\[0\]: expected a tensor .*, found \(1, 64, 64\)$"):
        ls.evaluate(tmp_path / "stacks/b.pth", real)
    torch.save(torch.zeros(1, 5, 64, 64).expand(1 << 40, 5, 64, 64), tmp_path / "stacks/b.pth")
    with pytest.raises(ValueError, match=r"b.pth: expected tensors of plain numbers, found"):
        ls.evaluate(tmp_path / "stacks/b.pth", real)


def test_a_range_image_may_name_its_sensor(tmp_path: Path, real: Path):
    image = street(0, SENSORS["hdl-64e"])
    for name, word in (("by_word", "hdl-64e"), ("by_table", json.dumps(image.sensor.to_dict()))):
        np.savez(
            tmp_path / f"{name}.npz", range=image.range, reflectance=image.reflectance, mask=image.mask, sensor=word
        )
    assert ls.read(tmp_path / "by_word.npz").xyz.tobytes() == ls.read(tmp_path / "by_table.npz").xyz.tobytes()
    np.savez(tmp_path / "no.npz", range=image.range, reflectance=image.reflectance, mask=image.mask, sensor="hdl-65e")
    with pytest.raises(ValueError, match="expected a sensor's fields as JSON, or its word, found 'hdl-65e'"):
        ls.read(tmp_path / "no.npz")


def test_statistics_of_two_sensors_say_which_files_and_what_differs(tmp_path: Path, real: Path):
    wide = replace(SENSOR, max_range=SENSOR.max_range + 10)
    files = [tmp_path / "a.safetensors", tmp_path / "b.safetensors"]
    for file, sensor, images in zip(files, (SENSOR, wide), (STREETS[:2], STREETS[2:]), strict=True):
        evaluation.gather_part([replace(image, sensor=sensor) for image in images], "1/1", file, "bev-1")
    found = r"expected statistics of one sensor, found .* of max_range [\d.]+ and .* of max_range [\d.]+"
    with pytest.raises(ValueError, match=rf"a.safetensors and .*b.safetensors: {found}"):
        ls.evaluate(files, real)


def test_a_scan_counts_once_and_hidden_files_not_at_all(tmp_path: Path, real: Path):
    samples = saved(tmp_path / "samples", STREETS)
    (samples / "._0.npz").write_bytes(b"of another system")
    saved(samples / ".unfinished", STREETS[:1])
    for name in ("a.v1.ply", "a.v2.ply"):
        write(samples / name, STREETS[0])
    assert len(image_set(samples)) == 8
    write(samples / "3.ply", STREETS[3])
    with pytest.raises(ValueError, match=r"samples: expected one file per scan, found 3.npz and 3.ply"):
        ls.evaluate(samples, real)


def test_other_beams_have_no_report_per_beam():
    other = [street(i, SENSORS["hdl-64e-kitti"].resized(width=64)) for i in range(3)]
    report = ls.evaluate(STREETS, other)
    assert report.beams is None and report.values["no return, per beam"] is None
    assert report.values["JSD x1e2"] is not None
    assert any("other beams" in warning for warning in report.warnings)


def test_points_of_another_sensor_are_noted(tmp_path: Path):
    kinds = {name: SENSORS[name].resized(width=256) for name in ("hdl-64e-kitti", "vlp-16")}
    real, sparse = (saved(tmp_path / name, [street(i, kinds[name]) for i in range(2)], "ply") for name in kinds)
    for protocol in (BEV_1, replace(STREET_1, networks=(), rows=BEV_1.rows)):
        (note,) = (text for text in ls.evaluate(sparse, real, protocol).warnings if "points of" in text)
        assert note == (
            "the points of samples of vlp-16 and the reference of hdl-64e-kitti are drawn into images of "
            f"{protocol.sensor}: other beams"
        )
        assert not any("other beams" in text for text in ls.evaluate(real, real, protocol).warnings)
    assert any("other beams" in text for text in ls.evaluate(sparse, sparse).warnings), "than the protocol's"
    assert not any("other beams" in text for text in ls.evaluate(sparse, sparse, sensor="vlp-16").warnings)


def test_an_image_set_tells_where_it_comes_from(tmp_path: Path, real: Path):
    images = image_set(real)
    assert len(images) == 8 and images.source == str(real)
    assert images.stamp == image_set(str(real)).stamp != image_set(saved(tmp_path / "b", REAL[:2])).stamp
    assert image_set(real / "3.npz").image(0, SENSOR, "spherical").shape == (64, 64)


def test_folders_of_the_same_names_sizes_and_times_are_two(tmp_path: Path):
    """As unpacked archives are, which keep times: statistics of the one are not the other's."""
    folders = [saved(tmp_path / name, REAL[:2]) for name in ("a", "b")]
    first = image_set(folders[0]).stamp
    for folder in folders:
        for path in folder.iterdir():
            os.utime(path, ns=(10**18, 10**18))
    stamps = [image_set(folder).stamp for folder in folders]
    assert len({first, *stamps}) == 3
    path = folders[0] / "0.npz"
    same, found = path.read_bytes(), path.stat()
    path.unlink()
    path.write_bytes(same[::-1])
    os.utime(path, ns=(found.st_atime_ns, found.st_mtime_ns))
    assert image_set(folders[0]).stamp != stamps[0], "replaced in place, its time kept"


def test_the_verb_prints_a_table_and_writes_json_and_markdown(tmp_path: Path, real: Path, run: Run):
    samples, out = saved(tmp_path / "samples", STREETS), tmp_path / "out/report.json"
    code, text, _ = run("evaluate", samples, "--reference", real, "--protocol", "bev-1", "--out", out, "--seed", 3)
    assert code == 0
    assert "bev-1 v1: 6 samples against 8" in text and f"wrote {out} and {out.with_suffix('.md')}" in text
    told, page = json.loads(out.read_text()), out.with_suffix(".md").read_text()
    assert told["counts"]["samples"] == 6 and told["seeds"] == {"subsets": 3} and told["seconds"] > 0
    assert set(told["hashes"]) == {"samples", "reference", "reference statistics"}
    statistics = Path(told["sources"]["reference statistics"])
    assert load_statistics(statistics)[0].protocol is BEV_1
    expected = ls.evaluate(samples, real)
    assert {name: row["value"] for name, row in told["values"].items()} == expected.values
    assert "| JSD x1e2 |" in page and "wall time" in page and told["hashes"]["samples"] in page


def test_the_verb_gathers_parts_and_refuses_in_one_line(tmp_path: Path, real: Path, run: Run):
    samples = saved(tmp_path / "samples", STREETS)
    parts = [tmp_path / "a.safetensors", tmp_path / "b.safetensors"]
    for i, part in enumerate(parts, 1):
        assert run("evaluate", samples, "--part", f"{i}/2", "--out", part)[:2] == (0, f"wrote {part}\n")
    code, text, _ = run("evaluate", *parts, "--reference", real, "--out", tmp_path / "r.json")
    assert code == 0 and "6 samples against 8" in text
    for words, reason in (
        ((samples,), "expected --reference CACHE, STATS or FOLDER, found none"),
        ((samples, "--reference", real, "--protocol", "fid"), "expected a protocol of r2dm-2024"),
        ((samples, "--reference", real, "--out", "r.txt"), "expected the name of a file that ends in .json"),
        ((samples, "--reference", real, "--out", tmp_path), "found "),
        (("--reference", real), "expected SAMPLES to judge"),
        ((tmp_path / "no", "--reference", real), "found no such file or folder"),
        ((samples, real, "--reference", real), "expected one folder or file of images, or several of statistics"),
        ((tmp_path / "no", "--reference", tmp_path / "nor"), f"{tmp_path / 'no'}: expected a cache, or samples"),
    ):
        code, _, error = run("evaluate", *words)
        assert code == 2 and reason in error and error.count("\n") == 1


@pytest.mark.parametrize(("projection", "wide"), [("unfolding", 2048), ("spherical", 1024)])
def test_whole_scans_are_drawn_into_narrow_images_as_training_images_are(projection: str, wide: int):
    """At the published programs' width, and thinned: with a turn's ray-drop; images as points stay whole."""
    sensor = replace(SENSORS["hdl-64e-kitti"].resized(width=128), name="hdl-64e-kitti")
    scan = street(3, SENSORS["hdl-64e-kitti"]).to_scan()
    drawn = as_image(scan, sensor, projection)
    expected = thin(project(scan, SENSORS["hdl-64e-kitti"], projection, wide), width=128)
    np.testing.assert_array_equal(drawn.range, expected.range)
    assert drawn.mask.mean() < 0.95 * project(scan, sensor, projection).mask.mean()
    again = as_image(drawn.to_scan(), sensor, projection)
    assert again.mask.sum() > 0.99 * drawn.mask.sum()


@pytest.mark.parametrize("turned", [0.0, 0.3, 0.5])
def test_a_sensor_of_few_columns_keeps_its_points(turned: float, tmp_path: Path):
    """Wherever in its columns it looks: in a cache, and where it is judged."""
    sensor = replace(SENSORS["os1-64"].resized(width=512), name="mine")
    scan, angle = street(4, sensor).to_scan(), turned * 2 * np.pi / 512
    turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    scan = replace(scan, xyz=(scan.xyz @ turn).astype(np.float32))
    (tmp_path / "scans").mkdir()
    write(tmp_path / "scans" / "0.pcd", scan)
    (tmp_path / "mine.toml").write_text(sensor_toml(sensor), "utf-8")
    main(["data", "files", str(tmp_path / "scans"), str(tmp_path / "cache"), "--sensor", str(tmp_path / "mine.toml")])
    cached = CachedImages(tmp_path / "cache")[0]
    for image in (as_image(scan, sensor, "auto"), cached):
        assert image.mask.sum() > 0.9 * len(scan)
