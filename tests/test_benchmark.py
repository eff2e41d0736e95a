"""Benchmarks: tables from a file, going on after a stop, cells where nothing can be said, and how they refuse."""

import json
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from networks import tiny_cascade, trained
from PIL import Image

import lidarsynth as ls
from lidarsynth.benchmark import drawings, run
from lidarsynth.benchmark import generation as judging
from lidarsynth.benchmark import setup as setups
from lidarsynth.benchmark import upsampling as completing
from lidarsynth.benchmark.config import read_config, rows
from lidarsynth.benchmark.published import PUBLISHED, published, why_not
from lidarsynth.benchmark.rows import Row
from lidarsynth.benchmark.run import benchmark
from lidarsynth.benchmark.store import Seconds
from lidarsynth.benchmark.tables import RANK, Column, notes, protocol_columns, table
from lidarsynth.cli.main import main
from lidarsynth.data.dataset import CachedImages, write_cache
from lidarsynth.evaluation.accumulation import Loaded
from lidarsynth.evaluation.protocols import PROTOCOLS, R2DM_UPSAMPLING
from lidarsynth.experiment.folder import save
from lidarsynth.experiment.presets import preset
from lidarsynth.files.formats import read_image, write
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.metrics.reconstruction import reconstruction_errors
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.systems.interpolation.model import interpolated
from lidarsynth.verbs.learned_sensor import sensor_toml

REPO_ROOT = Path(__file__).resolve().parents[1]
SENSOR = SENSORS["hdl-64e-kitti"].resized(16, 64)
METHODS = '[[method]]\nname = "bilinear"\ninterpolation = "bilinear"\n'


def street(seed: int, sensor: Sensor = SENSOR, labelled: bool = False) -> RangeImage:
    """A road between walls at some distance, with ray-drop; class 9 below, 13 beside."""
    rng = np.random.default_rng(seed)
    rays = sensor.directions()
    with np.errstate(divide="ignore"):
        road = np.where(rays[..., 2] < 0, -1.7 / rays[..., 2], np.inf)
        wall = rng.uniform(5, 12) / np.abs(rays[..., 1])
    distance = np.minimum(road, wall)
    mask = (distance < 60) & (distance > 2) & (rng.random(distance.shape) < 0.9)
    reflectance = rng.random(distance.shape).astype(np.float32) * mask
    label = np.where(road < wall, 9, 13) * mask if labelled else None
    return RangeImage(np.where(mask, distance, 0).astype(np.float32), reflectance, mask, sensor, label)


def stored(folder: Path, images: list[RangeImage], sequence: str = "") -> Path:
    """A cache of the images."""
    names = {"name": lambda i: ("", sequence, f"{i}.bin")} if sequence else {}
    for _ in write_cache(folder, images.__getitem__, len(images), images[0].sensor, {"name": "streets"}, **names):
        pass
    return folder


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LIDARSYNTH_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def figures() -> None:
    """For tests that look at figure.png or scores.png, which take longer than all the rest."""


@pytest.fixture(autouse=True)
def no_figures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "figures" not in request.fixturenames:
        monkeypatch.setattr(run, "side_by_side", lambda *_: np.zeros((1, 1, 3), np.uint8))
        monkeypatch.setattr(run, "save_scores", lambda path, *_: path.touch())


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return stored(tmp_path / "data", [street(i) for i in range(4)])


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model folder of the preset `tiny`, 16 x 64 pixels."""
    experiment = preset("tiny")
    return save(tmp_path_factory.mktemp("model"), experiment, trained(experiment))


@dataclass
class Counted:
    """A model that counts what it is asked for, and stops the program at a call where it is told to."""

    model: Any
    reflectance: bool = True
    stop_at: int = -1
    calls: list[int] = field(default_factory=list)  # seeds
    together: int = 1
    any_sensor: bool = False

    @property
    def network(self) -> torch.nn.Module:
        return self.model.network

    @property
    def sensor(self) -> Sensor:
        return self.model.sensor

    @property
    def experiment(self):
        own = self.model.experiment
        return replace(own, data=replace(own.data, reflectance=self.reflectance))

    def _count(self, seed: int) -> None:
        if len(self.calls) == self.stop_at:
            raise KeyboardInterrupt
        self.calls.append(seed)

    def generate(self, n=1, steps=None, seed=0, sampler=None, batch_size=4, on_step=None):
        self._count(seed)
        return self.model.generate(n, steps, seed, sampler, batch_size, on_step)

    def complete(self, scan, known, method="auto", steps=None, resamples=None, sampler=None, seed=0, on_step=None):
        self._count(seed)
        return self.model.complete(scan, known, method, steps, resamples, sampler, seed, on_step)

    def evaluations(self, method="auto", steps=None, resamples=None, sampler=None):
        return self.model.evaluations(method, steps, resamples, sampler)

    def generation_steps(self, steps=None, sampler=None):
        return self.model.generation_steps(steps, sampler)


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def results(out: Path) -> dict[str, dict[str, Any]]:
    """Row's name -> what results.json says of it; the file has no NaN."""

    def refuse(word: str) -> float:
        raise AssertionError(f"{word} in results.json")

    told = json.loads((out / "results.json").read_text(), parse_constant=refuse)
    return {row["name"]: row for row in told["methods"]}


def cells(text: str, heading: str = "") -> Iterator[list[str]]:
    """The rows of the first table after a heading, the head first."""
    for line in text.partition(heading)[2].splitlines():
        if line.startswith("|") and not line.startswith("|---"):
            yield [cell.strip() for cell in line.strip("|").split("|")]
        elif line.startswith("##"):
            return


def no_model(word: str) -> Any:
    raise AssertionError(f"nobody asked for {word}")


def cached(folder: Path) -> list[RangeImage]:
    images = CachedImages(folder)
    return [images[i] for i in range(len(images))]


def picture(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


# upsampling


def test_interpolations_are_judged_as_by_hand(data: Path, tmp_path: Path, figures: None):
    near = '[[method]]\nname = "near"\ninterpolation = "nearest"\n'
    config = written(tmp_path / "b.toml", f'data = "{data}"\n{near}{METHODS}')
    text = benchmark("upsampling", config, tmp_path / "out", no_model, command="the command")
    found = results(tmp_path / "out")
    for name, word in (("near", "nearest"), ("bilinear", "bilinear")):
        for i, truth in enumerate(cached(data)):
            known = corrupt(truth, "beams:4")
            errors = reconstruction_errors(interpolated(truth.keep(known), known, word), truth, ~known)
            assert found[name]["errors of each scan"]["hidden range MAE"][i] == pytest.approx(errors.range_mae)
        value = found[name]["reports"]["r2dm-upsampling-2024"]["values"]["range MAE"]["value"]
        assert value == pytest.approx(np.mean(found[name]["errors of each scan"]["range MAE"]))
        assert found[name]["count"] == 4 and found[name]["evaluations"] == 0
    head, *body = cells(text, "## r2dm-upsampling-2024 v1")
    assert body[0][head.index("IoU, %")] == "N/A" and "- N/A, IoU, %, IoU weighted, %: no weights of rangenet" in text
    column = [row[head.index("hidden range MAE, m")] for row in body]
    assert sorted(column, key=lambda cell: float(cell.strip("*")))[0].startswith("**")
    assert sum("*" in cell for cell in column) == 1
    assert "the command" in text and text == (tmp_path / "out" / "table.md").read_text()
    assert picture(tmp_path / "out" / "figure.png").shape[1] > 2000
    told = json.loads((tmp_path / "out" / "results.json").read_text())
    assert told["data"]["scans"] == 4 and told["versions"]["torch"] and told["machine"]["cores"] > 0
    assert not (tmp_path / "out" / "scores.png").exists()


MODELS = """
[[method]]
name = "tiny"
model = "tiny"
steps = [1, 3]
[[method]]
name = "painted"
model = "tiny"
method = "repaint"
steps = 2
resamples = 2
images = 2
"""


def test_models_give_a_row_per_number_of_steps_and_slow_ones_a_table_of_their_own(data: Path, tiny: Path, tmp_path):
    config = written(tmp_path / "b.toml", f'data = "{data}"\nfigure = 3\n{METHODS}{MODELS}')
    text = benchmark("upsampling", config, tmp_path / "out", lambda word: ls.load(tiny))
    found = results(tmp_path / "out")
    assert list(found) == ["bilinear", "tiny, 1 step", "tiny, 3 steps", "painted"]
    assert [row["evaluations"] for row in found.values()] == [0, 1, 3, 3]
    assert [row["count"] for row in found.values()] == [4, 4, 4, 2]
    model, truths = ls.load(tiny), cached(data)
    known = corrupt(truths[2], "beams:4")
    filled = model.complete(truths[2].keep(known), known, steps=3, seed=2)
    error = reconstruction_errors(filled, truths[2]).range_mae
    assert found["tiny, 3 steps"]["errors of each scan"]["range MAE"][2] == pytest.approx(error)
    assert len(found["painted"]["seconds per scan"]["wall"]["each"]) == 2, "scan 3 is for the figure only"
    head, *body = cells(text, "## The first 2 scans only")
    assert len(body) == 4 and "scans" not in head
    bilinear = found["bilinear"]["errors of each scan"]["range MAE"]
    assert float(body[0][1].strip("*")) == pytest.approx(np.mean(bilinear[:2]), abs=6e-4)
    _, *body = cells(text, "## r2dm")
    assert "**" not in "".join(body[3]), "two scans are not compared with four"


def test_a_stopped_benchmark_goes_on_and_changed_settings_begin_anew(data: Path, tiny: Path, tmp_path: Path):
    config = written(tmp_path / "b.toml", f'data = "{data}"\n[[method]]\nname="m"\nmodel="x"\nsteps=1\n')
    stopped, again = Counted(ls.load(tiny), stop_at=2), Counted(ls.load(tiny))
    with pytest.raises(KeyboardInterrupt):
        benchmark("upsampling", config, tmp_path / "out", lambda word: stopped)
    assert stopped.calls == [0, 1] and not (tmp_path / "out" / "results.json").exists()
    kept = {path: path.read_text() for path in (tmp_path / "out").rglob("00000[01].json")}
    first = benchmark("upsampling", config, tmp_path / "out", lambda word: again)
    assert again.calls == [2, 3]
    assert kept == {path: path.read_text() for path in kept}, "what a scan took stays what it took"
    seconds = results(tmp_path / "out")["m"]["seconds per scan"]["wall"]["each"]
    assert seconds[:2] == [json.loads(text)["seconds"]["wall"] for _, text in sorted(kept.items())]
    assert benchmark("upsampling", config, tmp_path / "out", lambda word: again) == first and len(again.calls) == 2
    whole = tmp_path / "whole"
    benchmark("upsampling", config, whole, lambda word: Counted(ls.load(tiny)))
    assert results(whole)["m"]["errors of each scan"] == results(tmp_path / "out")["m"]["errors of each scan"]
    broken = next((tmp_path / "out").rglob("000001.npz"))
    broken.unlink()
    benchmark("upsampling", config, tmp_path / "out", lambda word: again)
    assert again.calls == [2, 3, 1]
    benchmark("upsampling", config, tmp_path / "out", lambda word: again, seed=7)
    assert again.calls[3:] == [7, 8, 9, 10]
    stored(tmp_path / "other", [street(i) for i in (0, 9, 2, 3)])
    benchmark("upsampling", config, tmp_path / "out", lambda word: again, data=str(tmp_path / "other"))
    assert again.calls[7:] == [1], "only the scan that is another one is filled anew"


def test_scans_that_were_cut_off_are_made_anew(data: Path, tmp_path: Path):
    config = written(tmp_path / "b.toml", f'data = "{data}"\n{METHODS}')
    benchmark("upsampling", config, tmp_path / "out", no_model)
    path = next((tmp_path / "out" / "scans").glob("*/000000.npz"))
    whole = read_image(path).range
    for left in (path.read_bytes()[:500], b""):
        path.write_bytes(left)
        benchmark("upsampling", config, tmp_path / "out", no_model)
        np.testing.assert_array_equal(read_image(path).range, whole)


def test_another_experiment_takes_another_folder(data: Path, tmp_path: Path):
    other = stored(tmp_path / "other", [street(i) for i in range(4, 6)])
    head, near = f'data = "{data}"\n', '[[method]]\nname = "near"\ninterpolation = "nearest"\n'
    config, out = tmp_path / "b.toml", tmp_path / "out"
    first = benchmark("upsampling", written(config, head + METHODS), out, no_model)
    kept = (out / "results.json").read_bytes()
    for text, told in (
        (head + 'corruption = "beams:2"\n' + METHODS, "with corruption = 'beams:4', found 'beams:2'"),
        (head + 'protocol = "lidm-reconstruction-2024"\n' + METHODS, "with protocol = .*, found .*'lidm-rec"),
        (head + "seed = 3\n" + METHODS + near, "with seed = 0, found 3"),
        (f'data = "{other}"\n' + METHODS, "with data = '.*data', found '.*other'"),
        (head + METHODS.replace('"bilinear"\n', '"nearest"\n').replace('name = "nearest"', 'name = "bilinear"'),
         "with method 'bilinear' = .*'bilinear'.*, found .*'nearest'"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=rf"{out}: expected the experiment .*{told}.*; use another --out"):
            benchmark("upsampling", written(config, text), out, no_model)
        assert (out / "results.json").read_bytes() == kept and (out / "table.md").read_text() == first
    written(config, f'reference = "{data}"\n[[method]]\nname = "noise"\nnoise = true\n')
    with pytest.raises(ValueError, match="with kind = 'upsampling', found 'generation'"):
        benchmark("generation", config, out, no_model)
    more = 'title = "More"\nimages = 2\nprotocol = ["lidm-reconstruction-2024", "r2dm-upsampling-2024"]\n' + head
    benchmark("upsampling", written(config, more + near + METHODS), out, no_model)
    assert [row["count"] for row in results(out).values()] == [2, 2], "rows are added, scans may be fewer"
    benchmark("upsampling", config, out, no_model)
    (out / "results.json").write_text("[]")
    with pytest.raises(ValueError, match="expected the results of a benchmark, found another table; use another --out"):
        benchmark("upsampling", config, out, no_model)


def test_rows_that_cannot_be_are_told(data: Path, tiny: Path, tmp_path: Path):
    small = stored(tmp_path / "small", [street(0, SENSOR.resized(width=32))])
    config = written(tmp_path / "b.toml", f'data = "{small}"\n[[method]]\nname="tiny"\nmodel="tiny"\n{METHODS}')
    text = benchmark("upsampling", config, tmp_path / "out", lambda word: ls.load(tiny))
    assert "- N/A, tiny: expected an image of 16 x 64, found (16, 32)" in text
    assert results(tmp_path / "out")["tiny"]["reports"] == {}
    config = written(tmp_path / "c.toml", f'data = "{data}"\n[[method]]\nname="range only"\nmodel="tiny"\nsteps=1\n')
    text = benchmark("upsampling", config, tmp_path / "out", lambda word: Counted(ls.load(tiny), reflectance=False))
    found = results(tmp_path / "out")["range only"]
    assert list(found["errors of each scan"]) == ["range MAE", "hidden range MAE"]
    values = found["reports"]["r2dm-upsampling-2024"]["values"]
    assert values["reflectance MAE"] == {"value": None, "unit": "", "reason": "the samples have no reflectance"}
    assert values["range MAE"]["value"] > 0

    class Broken(Counted):
        def complete(self, scan, known, **options):
            filled = self.model.complete(scan, known)
            return replace(filled, reflectance=filled.reflectance * np.float32("nan"))

    text = benchmark("upsampling", config, tmp_path / "nan", lambda word: Broken(ls.load(tiny)))
    assert "- N/A, range only: scan 0: expected finite numbers, found NaN or infinity" in text


def test_a_scan_without_points_is_named_and_takes_no_other_number_away(data: Path, tiny: Path, tmp_path: Path):
    """A protocol of points says nothing of it; the whole benchmark ended, without the name of the scan."""
    images = [street(0), street(1).keep(np.zeros((16, 64), bool))]
    folder = stored(tmp_path / "scans", images)
    protocols = 'protocol = ["lidm-reconstruction-2024", "iln-2022"]'
    model = '[[method]]\nname="tiny"\nmodel="tiny"'
    config = written(tmp_path / "b.toml", f'data = "{folder}"\n{protocols}\n{model}\n{METHODS}')

    class Refusing(Counted):
        def complete(self, scan, known, **options):
            if not scan.mask.any():
                raise ValueError("expected points, found none")
            return self.model.complete(scan, known, **options)

    names = CachedImages(folder).name(1)[1:]
    text = benchmark("upsampling", config, tmp_path / "out", lambda word: Refusing(ls.load(tiny)))
    assert f"- N/A, tiny: expected points, found none ({'/'.join(names)})" in text
    assert f"- N/A, CD, m2, EMD: {'/'.join(names)}: expected points between 1 and 56 m, found none of 0" in text
    found = results(tmp_path / "out")["bilinear"]
    assert found["reports"]["iln-2022"]["values"]["range MAE"]["value"] > 0 and len(found["errors of each scan"]) == 4


def test_classes_judge_and_colour(tmp_path: Path, figures: None):
    data = stored(tmp_path / "data", [street(i) for i in range(2)])
    config = written(tmp_path / "b.toml", f'data = "{data}"\n{METHODS}')
    network = RangeNet(21).eval()
    (tmp_path / "net").mkdir()
    for name, part in (("backbone", network.backbone), ("segmentation_decoder", network.decoder)):
        torch.save(part.state_dict(), tmp_path / "net" / name)
    torch.save(network.head.state_dict(), tmp_path / "net" / "segmentation_head")
    sensor = {"img_means": [12.12, 10.88, 0.23, -1.04, 0.21], "img_stds": [12.32, 11.47, 6.91, 0.86, 0.16]}
    inputs = {"range": True, "xyz": True, "remission": True}
    encoder = {"extra": {"layers": 21}, "OS": 32, "input_depth": inputs}
    settings = {"backbone": encoder, "dataset": {"sensor": sensor}}
    (tmp_path / "net" / "arch_cfg.yaml").write_text(json.dumps(settings))
    benchmark("upsampling", config, tmp_path / "out", no_model, classes=tmp_path / "net")
    report = results(tmp_path / "out")["bilinear"]["reports"]["r2dm-upsampling-2024"]
    assert 0 <= report["values"]["IoU"]["value"] <= 100 and len(report["hashes"]["rangenet"]) == 64
    image = drawings.with_classes(street(0), network)
    assert image.label is not None and not image.label[~image.mask].any()


def test_the_figure_shows_a_labelled_scan_in_the_colours_of_its_classes(tmp_path: Path, figures: None):
    truth = street(5, labelled=True)
    data = stored(tmp_path / "data", [street(4), truth])
    config = written(tmp_path / "b.toml", f'data = "{data}"\n{METHODS}')
    benchmark("upsampling", config, tmp_path / "out", no_model)
    colours = picture(tmp_path / "out" / "figure.png").reshape(-1, 3).astype(int)
    assert ((colours[:, 0] > 200) & (colours[:, 1] < 20) & (colours[:, 2] > 200)).sum() > 200, "the road is magenta"
    everywhere = replace(truth, range=truth.range + 1, mask=np.ones_like(truth.mask), label=None)
    shifted = drawings.with_labels_of(everywhere, truth)
    assert (shifted.label[truth.mask] == truth.label[truth.mask]).all() and not shifted.label[~truth.mask].any()


# published values


def test_published_values_stand_only_beside_the_papers_data(tmp_path: Path):
    drives = ("2013_05_28_drive_0000_sync/1", "2013_05_28_drive_0002_sync/2")
    name = "r2dm-upsampling-2024"
    assert published(name, "nearest", drives, "beams:4") == {"range MAE": 2.083, "reflectance MAE": 0.106, "IoU": 18.78}
    assert "reflectance MAE" not in published(name, "ILN", drives, "beams:4")
    assert published(name, "nearest", (*drives, "street/3"), "beams:4") == {}
    assert published(name, "nearest", drives, "beams:2") == {} == published("bev-1", "nearest", drives, "beams:4")
    assert "other scans" in why_not(name, ("street/3",), "beams:4") and "beams:2" in why_not(name, drives, "beams:2")
    assert {row for values in PUBLISHED[name].methods.values() for row in values} <= {
        row.name for row in R2DM_UPSAMPLING.rows
    }
    data = stored(tmp_path / "data", [street(0)], "2013_05_28_drive_0002_sync")
    config = written(tmp_path / "b.toml", f'data = "{data}"\n{METHODS}')
    text = benchmark("upsampling", config, tmp_path / "out", no_model)
    head, row = cells(text, "## r2dm")
    assert row[head.index("range MAE, m")].endswith("(2.110)") and row[head.index("IoU, %")] == "N/A (18.17)"
    assert "KITTI-360 test" in text
    several = 'protocol = ["r2dm-upsampling-2024", "iln-2022"]\n' + config.read_text()
    text = benchmark("upsampling", written(config, several), tmp_path / "several", no_model)
    assert "- published, r2dm-upsampling-2024: in parentheses, Nakashima" in text
    assert "- published, iln-2022: none" in text


def test_shares_of_voxels_are_better_the_more_they_are():
    """As IoU of classes, coverage, and accuracy near a half: of all other measures the least is best."""
    more = {row.measure for p in PROTOCOLS.values() for row in p.rows if row.unit == "%"} - {"drop-rate"}
    assert more == RANK.keys() and all(RANK[measure](60) < RANK[measure](90) for measure in ("sets-1nna",))
    assert all(RANK[measure](90) < RANK[measure](60) for measure in more - {"sets-1nna"})
    values = {"voxel IoU": {"value": 20.0}}, {"voxel IoU": {"value": 30.0}}
    found = [Row(str(i), "", {}, 2, {"iln-2022": {"values": each}}) for i, each in enumerate(values)]
    column = next(c for c in protocol_columns("iln-2022") if c.heading == "voxel IoU, %")
    assert column.cells(found) == ["20.00", "**30.00**"]


def test_the_best_is_bold_bounds_and_fewer_scans_take_no_part():
    def row(name: str, value: float | None, count: int = 4, floor: bool = False) -> Row:
        report = {"values": {"x": {"value": value}}}
        return Row(name, name, {}, count, {"p": report}, seconds=[Seconds(1, 2)], floor=floor)

    found = [row("a", 3.0), row("b|c", 2.0), row("few", 1.0, 2), row("floor", 0.5, 9, True), row("none", None)]
    lower = Column("x", lambda row: row.value("p", "x"), 1)
    lines = table(found, [lower, replace(lower, rank=lambda value: -value)])
    assert lines[2:] == [
        "| a | 4 | 3.0 | **3.0** |",
        "| b\\|c | 4 | **2.0** | 2.0 |",
        "| few | 2 | 1.0 | 1.0 |",
        "| floor | 9 | 0.5 | 0.5 |",
        "| none | 4 | N/A | N/A |",
    ]
    assert "**" not in "".join(table(found[:1], [lower])), "alone nobody is best"
    assert lower.cells([row("a", 2.01), row("b", 1.99), row("c", 2.2)]) == ["**2.0**", "**2.0**", "2.2"], "as shown"


def test_rows_that_were_judged_as_other_images_are_told_and_none_is_best():
    def row(name: str, images: str, floor: bool = False) -> Row:
        report = {"values": {"JSD x1e2": {"value": float(len(name))}}, "images": images}
        return Row(name, name, {}, 4, {"bev-1": report}, floor=floor)

    column = next(c for c in protocol_columns("bev-1") if c.heading == "JSD x1e2")
    one, other = "64 x 1024 of hdl-64e", "64 x 1024 of hdl-64e-kitti"
    alike = [row("a", one), row("bb", one)]
    assert column.cells(alike) == ["**1.000**", "2.000"] and notes(alike, [column], "bev-1") == []
    mixed = [*alike, row("ccc", other)]
    assert column.cells(mixed) == ["1.000", "2.000", "3.000"]
    (note,) = notes(mixed, [column], "bev-1")
    assert f"not to be compared: a, bb as {one}; ccc as {other}; `sensor` in the file" in note
    floor = [*alike, row("ccc", other, floor=True)]
    assert column.cells(floor)[0] == "**1.000**" and "ccc as" in notes(floor, [column], "bev-1")[0]


# generation

GENERATION = """
reference = "{reference}"
count = {count}
[[method]]
name = "others"
held_out = "{other}"
[[method]]
name = "tiny"
model = "tiny"
steps = [1, 2]
[[method]]
name = "heun"
model = "tiny"
steps = 2
sampler = "heun"
[[method]]
name = "noise"
noise = true
"""


@pytest.fixture
def generation(data: Path, tmp_path: Path) -> Path:
    other = stored(tmp_path / "other", [street(i) for i in range(10, 14)])
    return written(tmp_path / "g.toml", GENERATION.format(reference=data, other=other, count=3))


def test_generation_ranks_the_floor_the_model_and_noise(generation: Path, tiny: Path, tmp_path: Path, data: Path):
    model = Counted(ls.load(tiny))
    text = benchmark("generation", generation, tmp_path / "out", lambda word: model)
    found = results(tmp_path / "out")
    assert list(found) == ["others", "tiny, 1 step", "tiny, 2 steps", "heun", "noise"]
    assert [row["count"] for row in found.values()] == [4, 3, 3, 3, 3]
    assert [row["evaluations"] for row in found.values()] == [None, 1, 2, 4, None]
    assert [row["floor"] for row in found.values()] == [True, False, False, False, True]
    jsd = {name: row["reports"]["bev-1"]["values"]["JSD x1e2"]["value"] for name, row in found.items()}
    assert jsd["others"] < min(value for name, value in jsd.items() if name != "others")
    expected = ls.evaluate(ls.load(tiny).generate(3, steps=2), data, "bev-1").values["JSD x1e2"]
    assert jsd["tiny, 2 steps"] == pytest.approx(expected, rel=1e-4)
    assert found["noise"]["seconds per scan"] is None and "bev-1 v1 judges 10,000 samples" in text
    calls = len(model.calls)
    assert calls == 9
    more = written(tmp_path / "more.toml", generation.read_text().replace("count = 3", "count = 5"))
    benchmark("generation", more, tmp_path / "out", lambda word: model)
    assert model.calls[calls:] == [3, 4, 3, 4, 3, 4], "more scans are added to those that are there"
    assert benchmark("generation", generation, tmp_path / "out", lambda word: model) == text, "and fewer are fewer"


def test_models_whose_scans_come_in_blocks_make_whole_blocks(generation: Path, tiny: Path, tmp_path: Path):
    one, blocks = (Counted(ls.load(tiny), together=size) for size in (1, 2))
    texts = [
        benchmark("generation", generation, tmp_path / str(m.together), lambda word, m=m: m) for m in (one, blocks)
    ]
    assert one.calls[:3] == [0, 1, 2] and blocks.calls[:2] == [0, 2] and len(blocks.calls) == 6
    rows = [{name: row["reports"]["bev-1"]["values"] for name, row in results(tmp_path / k).items()} for k in "12"]
    for name in rows[0]:
        measured = [{key: value["value"] for key, value in row[name].items()} for row in rows]
        assert measured[0] == pytest.approx(measured[1], rel=1e-4, nan_ok=True), name
    assert all("tiny, 2 steps" in text for text in texts)


def test_models_of_any_sensor_make_scans_of_the_reference_s(tmp_path: Path):
    small, other = (SENSORS[word].resized(width=128) for word in ("vlp-16", "hdl-32e"))
    cascade, made = tiny_cascade(SENSORS["hdl-64e-kitti"].resized(16, 256)), {}
    for sensor in (small, other):
        data = stored(tmp_path / sensor.name, [street(i, sensor) for i in range(2)])
        config = f'reference = "{data}"\ncount = 2\n[[method]]\nname = "any"\nmodel = "any"\nsteps = 1\n'
        benchmark("generation", written(tmp_path / f"{sensor.name}.toml", config), tmp_path / "out" / sensor.name,
                  lambda word: cascade)  # fmt: skip
        row = results(tmp_path / "out" / sensor.name)["any"]
        assert row["reports"]["bev-1"]["values"]["JSD x1e2"]["value"] is not None
        made[sensor.name] = row
    assert made["vlp-16"] != made["hdl-32e"]


def test_models_of_any_sensor_are_not_said_to_have_learned_other_beams(data: Path, tiny: Path, tmp_path: Path):
    config = f'data = "{data}"\n{METHODS}[[method]]\nname = "own"\nmodel = "own"\n'
    other = replace(SENSOR, name="other", elevations=tuple(e + 0.1 for e in SENSOR.elevations))
    for model, said in ((tiny_cascade(other), False), (replace(ls.load(tiny), sensor=other), True)):
        out = tmp_path / type(model).__name__
        text = benchmark("upsampling", written(tmp_path / "b.toml", config), out, lambda word, m=model: m)
        assert "learned images of" not in text and ("expected an image of other's beams" in text) == said


def test_samples_of_others_compete_and_other_sizes_are_told(generation: Path, data: Path, tiny: Path, tmp_path: Path):
    odd = stored(tmp_path / "odd", [street(i, SENSOR.resized(width=48)) for i in range(4)])
    config = generation.read_text().replace("count = 3", "count = 4")
    config += f'[[method]]\nname = "odd"\nsamples = "{odd}"\n[[method]]\nname = "same"\nsamples = "{data}"\n'
    text = benchmark("generation", written(generation, config), tmp_path / "out", lambda word: ls.load(tiny))
    found = results(tmp_path / "out")
    assert found["same"]["reports"]["bev-1"]["values"]["JSD x1e2"]["value"] == pytest.approx(0, abs=1e-4)
    assert not found["same"]["floor"]
    head, *body = cells(text, "## bev-1")
    table_of = {row[0]: row for row in body}
    assert table_of["same"][head.index("JSD x1e2")].startswith("**")
    assert table_of["odd"][2:] == ["N/A"] * 6
    assert "expected a reference of the samples' 16 x 48 pixels or a multiple, found 16 x 64" in text
    assert "\n- same: samples and reference are the same images" in text, "a note of one row says of which"
    assert "\n- bev-1 v1 judges 10,000 samples, found 4\n" in text, "and one of all rows says nothing more"


@pytest.fixture
def points(tmp_path: Path) -> Path:
    """A generation of samples that are points, drawn into the images of a sensor of the user's own file."""
    for side, seeds in (("samples", range(3)), ("real", range(10, 13))):
        (tmp_path / side).mkdir()
        for seed in seeds:
            write(tmp_path / side / f"{seed}.ply", street(seed))
    (tmp_path / "my.toml").write_text(sensor_toml(SENSOR))
    text = f'reference = "{tmp_path}/real"\nsensor = "{tmp_path}/my.toml"\n'
    return written(tmp_path / "g.toml", f'{text}[[method]]\nname = "mine"\nsamples = "{tmp_path}/samples"\n')


def test_samples_are_judged_again_where_the_file_of_their_sensor_says_something_else(points: Path, tmp_path: Path):
    first = benchmark("generation", points, tmp_path / "out", no_model)
    assert benchmark("generation", points, tmp_path / "out", no_model) == first
    (tmp_path / "my.toml").write_text(sensor_toml(replace(SENSOR, max_range=20.0)))
    again = benchmark("generation", points, tmp_path / "out", no_model)
    assert again != first and again == benchmark("generation", points, tmp_path / "anew", no_model)


@pytest.mark.parametrize("changed", ["GATHERED", "weights", "neither"])
def test_samples_are_judged_again_by_other_networks_or_rules(changed: str, points: Path, tmp_path: Path, monkeypatch):
    counts = []
    monkeypatch.setattr(judging, "evaluate", lambda *args, **more: counts.append(1) or ls.evaluate(*args, **more))
    benchmark("generation", points, tmp_path / "out", no_model)
    if changed == "GATHERED":
        monkeypatch.setattr(judging, "GATHERED", judging.GATHERED + 1)
    elif changed == "weights":
        monkeypatch.setattr(setups, "load_networks", lambda *_, **more: Loaded({}, {"rangenet": "other"}, {}))
    benchmark("generation", points, tmp_path / "out", no_model)
    assert len(counts) == (1 if changed == "neither" else 2)


def test_scans_are_completed_again_where_the_file_of_their_sensor_says_something_else(tmp_path: Path):
    """Rings make rows, so that the images stay the same, bit by bit, where beams are found to stand elsewhere."""
    (tmp_path / "scans").mkdir()
    scan = street(1).to_scan()
    write(tmp_path / "scans" / "1.ply", replace(scan, ring=np.nonzero(street(1).mask)[0].astype(np.int64)))
    text = f'data = "{tmp_path}/scans"\nsensor = "{tmp_path}/my.toml"\nprotocol = "iln-2022"\n'
    config = written(tmp_path / "b.toml", f'{text}projection = "unfolding"\n{METHODS}')
    found = []
    for sensor in (SENSOR, replace(SENSOR, elevations=tuple(np.linspace(10, -40, 16)))):
        (tmp_path / "my.toml").write_text(sensor_toml(sensor))
        benchmark("upsampling", config, tmp_path / "out", no_model)
        found.append(results(tmp_path / "out")["bilinear"]["reports"]["iln-2022"]["values"])
    assert found[0]["range MAE"] == found[1]["range MAE"]
    assert found[0]["voxel IoU"] != found[1]["voxel IoU"]


def test_all_sensors_of_the_images_are_named(tmp_path: Path):
    """Each is judged as an image of its own sensor; the page named the first one's alone."""
    sensors = SENSOR, replace(SENSOR, name="other", elevations=tuple(np.linspace(10, -40, 16)))
    config = written(tmp_path / "b.toml", f'data = "{tmp_path}/two"\nprotocol = "iln-2022"\n{METHODS}')
    (tmp_path / "two").mkdir()
    for number, sensor in enumerate(sensors):
        write(tmp_path / "two" / f"{number}.npz", street(number, sensor))
    text = benchmark("upsampling", config, tmp_path / "out", no_model)
    assert f"two, {SENSOR.name}, other, {SENSOR.height} x {SENSOR.width}\n" in text
    assert json.loads((tmp_path / "out" / "results.json").read_text())["data"]["sensor"] == f"{SENSOR.name}, other"


def test_scans_of_another_sensor_than_the_images_they_are_drawn_into_are_told(tmp_path: Path):
    """Of a file that names no sensor, images are the protocol's, and of the scans' beams little is in them."""
    (tmp_path / "scans").mkdir()
    sensor = Sensor("my-lidar", tuple(np.linspace(15.0, -25.0, 23)), width=360)
    write(tmp_path / "scans" / "1.ply", street(1, sensor))
    (tmp_path / "my.toml").write_text(sensor_toml(sensor))
    found = []
    for name, line in (("none", ""), ("named", f'sensor = "{tmp_path}/my.toml"\n')):
        config = written(tmp_path / f"{name}.toml", f'data = "{tmp_path}/scans"\n{line}{METHODS}')
        text = benchmark("upsampling", config, tmp_path / name, no_model)
        record = json.loads((tmp_path / name / "results.json").read_text())
        found.append((re.findall(r"^- note: (.*)$", text, re.M), record["data"]["notes"]))
    (told, kept), named = found
    assert (
        "the scans that hdl-64e sees" in told[0] and "`sensor` in the file names theirs" in told[0] and len(kept) == 1
    )
    assert named == ([], [])


def test_completions_are_judged_again_by_other_rules(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    config = written(tmp_path / "b.toml", f'data = "{data}"\n{METHODS}')
    for step in (0, 0, 1):
        monkeypatch.setattr(completing, "GATHERED", completing.GATHERED + step)
        benchmark("upsampling", config, tmp_path / "out", no_model)
    assert len(list((tmp_path / "out").rglob("report-*.json"))) == 2


def test_scores_are_drawn_over_the_numbers_of_steps(generation: Path, tiny: Path, tmp_path: Path, figures: None):
    benchmark("generation", generation, tmp_path / "out", lambda word: ls.load(tiny))
    for name in ("scores.png", "figure.png"):
        assert len(np.unique(picture(tmp_path / "out" / name))) > 100, name


def test_pictures_of_the_users_are_not_replaced(generation: Path, tmp_path: Path):
    (tmp_path / "figure.png").write_bytes(b"of theirs")
    with pytest.raises(ValueError, match=r"figure\.png: expected a picture of lidarsynth to replace, found another"):
        benchmark("generation", generation, tmp_path, lambda word: pytest.fail("worked"))
    assert [path.name for path in tmp_path.glob("*.[jp][sn]*")] == ["figure.png"]


def test_range_only_models_have_no_feature_distance(generation: Path, tiny: Path, tmp_path: Path):
    config = written(
        generation, generation.read_text().replace("count = 3", 'count = 3\nprotocol = ["bev-1", "r2dm-2024"]')
    )
    text = benchmark("generation", config, tmp_path / "out", lambda word: Counted(ls.load(tiny), reflectance=False))
    assert "## r2dm-2024 v1" in text and "## bev-1 v1" in text
    for path in (tmp_path / "out" / "scans").glob("tiny-*/*.npz"):
        assert not ls.read_image(path).reflectance.any()
    values = results(tmp_path / "out")["heun"]["reports"]["r2dm-2024"]["values"]
    assert values["FRD"]["value"] is None and values["FRD"]["reason"]


def test_streets_are_cast_once(tmp_path: Path):
    pytest.importorskip("embreex")
    told: list[str] = []
    config = written(tmp_path / "g.toml", 'count = 2\n[[method]]\nname = "noise"\nnoise = true\n')
    times = set()
    for _ in range(2):
        benchmark("generation", config, tmp_path / "out", no_model, data="synthetic:2:5",
                  on_images=lambda what, done, total: told.append(what))  # fmt: skip
        times.add((tmp_path / "out" / "streets-2-5" / "0000000.npy").stat().st_mtime_ns)
    assert "streets" in told and len(times) == 1
    with pytest.raises(
        ValueError, match="expected synthetic:COUNT:SEED, such as synthetic:64:777, found 'synthetic:2'"
    ):
        benchmark("generation", config, tmp_path / "out", no_model, data="synthetic:2")


# files and refusals

GOOD = 'data = "street"\n' + METHODS


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("data = ", "expected TOML"),
        ('data = "street"\n', r"expected at least one \[\[method\]\]"),
        ('method = 3\ndata = "street"\n', r"expected at least one \[\[method\]\], found 3"),
        (METHODS, "expected the field data"),
        ('seeds = 1\n' + GOOD, r"expected the fields .*'seed'.*, found \['seeds'\]"),
        ('seed = "1"\n' + GOOD, r"seed: expected int, found '1'"),
        ("seed = -1\n" + GOOD, r"seed: expected whole numbers of at least 0, found -1"),
        ("images = 0\n" + GOOD, r"images: expected whole numbers of at least 1, found 0"),
        ("figure = 4\n" + GOOD, "figure: expected the number of one of 1 images, 0 to 0, found 4"),
        ('corruption = "beams:99"\n' + GOOD, "beams expects whole numbers"),
        ('corruption = "beams:1"\n' + GOOD, "expected a corruption that hides at least one pixel"),
        ('protocol = "r2dm"\n' + GOOD, "expected a protocol of"),
        ('protocol = "bev-1"\n' + GOOD, "protocol: expected one that compares image by image, found bev-1"),
        ('sensor = "x"\n' + GOOD, "expected a sensor of"),
        ('projection = "x"\n' + GOOD, "projection: expected one of auto, spherical, unfolding, found 'x'"),
        (GOOD + "step = 4\n", r"method 1: expected the fields .*, found \['step'\]"),
        (GOOD + "steps = 4\n", "method 'bilinear'.steps: expected it with a model, found it with interpolation"),
        (GOOD + METHODS, "expected a name of its own for every row, found 'bilinear' twice"),
        (GOOD.replace('"bilinear"\n', '"linear"\n'), "interpolation: expected one of nearest, bilinear"),
        (GOOD + 'model = "x"\n', "expected one of interpolation, model, found interpolation and model"),
        (GOOD + '[[method]]\nname = "x"\n', "method 'x': expected one of interpolation, model, found none"),
        (GOOD + '[[method]]\ninterpolation = "nearest"\n', "method 2: expected the field name"),
        (GOOD + '[[method]]\nname="x"\nmodel="x"\nsteps=[]\n', r"steps: expected whole .* 1, found \(\)"),
        (GOOD + '[[method]]\nname="x"\nmodel="x"\nsteps=[1, 0]\n', r"steps: expected .* at least 1, found \(1, 0\)"),
        (GOOD + '[[method]]\nname="x"\nmodel="x"\nsteps="4"\n', "method 2.steps: expected .*, found '4'"),
        (GOOD.replace("street", "nowhere"), "nowhere: expected a cache, or samples"),
        ("protocol = []\n" + GOOD, r"b.toml.protocol: expected one or several protocols, each once, found \[\]"),
        ('protocol = ["iln-2022", "iln-2022"]\n' + GOOD, r"each once, found \['iln-2022', 'iln-2022'\]"),
    ],
)  # fmt: skip
def test_files_that_cannot_be_used_are_refused_in_one_line(text: str, message: str, tmp_path: Path):
    config = written(tmp_path / "b.toml", text)
    with pytest.raises(ValueError, match=message) as error:
        benchmark("upsampling", config, tmp_path / "out", no_model)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out" / "table.md").exists()


def test_a_generation_takes_one_source_per_row_and_only_its_own_keys(tmp_path: Path):
    head = 'reference = "street"\n[[method]]\nname = "a"\n'
    for body, message in (
        ("noise = true\nsteps = 2\n", "steps: expected it with a model, found it with noise"),
        ('samples = "x"\ncount = 2\n', "count: expected it with a model, found it with samples"),
        ('noise = true\nheld_out = "x"\n', "expected one of model, samples, held_out, noise, found held_out and noise"),
        ('interpolation = "nearest"\n', r"found \['interpolation'\]"),
    ):
        with pytest.raises(ValueError, match=message):
            read_config("generation", written(tmp_path / "g.toml", head + body))
    with pytest.raises(ValueError, match="expected a readable file"):
        read_config("generation", tmp_path / "nothing.toml")
    with pytest.raises(ValueError, match=r"g.toml.seed: expected at most 4294967295, found 4294967296$"):
        read_config("generation", written(tmp_path / "g.toml", head + "noise = true\n"), seed=2**32)
    replaced = read_config("generation", written(tmp_path / "g.toml", head + "noise = true\n"), data="x", seed=3)
    assert (replaced.reference, replaced.seed) == ("x", 3)


def test_a_model_that_is_none_is_told_before_the_first_scan(data: Path, tmp_path: Path):
    config = written(tmp_path / "b.toml", f'data = "{data}"\n{METHODS}[[method]]\nname="x"\nmodel="no-such-model"\n')
    with pytest.raises(ValueError, match="no-such-model: expected shipped weights"):
        benchmark("upsampling", config, tmp_path / "out", ls.load)
    assert not (tmp_path / "out").exists()


def test_samples_that_are_nowhere_are_told_before_the_first_scan(generation: Path, tiny: Path, tmp_path: Path):
    model = Counted(ls.load(tiny))
    for words, message in (('held_out = "nowhere"', "nowhere: expected a cache, or samples"),
                           ('samples = "a.safetensors"', "a.safetensors: expected scans, .*, found statistics: evalu"),
                           ('samples = "synthetic:2"', "expected synthetic:COUNT:SEED")):  # fmt: skip
        text = generation.read_text() + f'[[method]]\nname = "last"\n{words}\n'
        with pytest.raises(ValueError, match=message):
            benchmark("generation", written(tmp_path / "last.toml", text), tmp_path / "out", lambda word: model)
    with pytest.raises(ValueError, match=r"^real.safetensors: expected scans, .*, found statistics"):
        benchmark("generation", generation, tmp_path / "out", lambda word: model, data="real.safetensors")
    assert not model.calls


def test_curves_need_matplotlib_and_say_so_first(generation: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"pip install 'lidarsynth\[viz\]'"):
        benchmark("generation", generation, tmp_path / "out", no_model)


def test_the_verb_writes_and_refuses(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    config = written(tmp_path / "b.toml", GOOD)
    words = ["benchmark", "upsampling", str(config), "--data", str(data), "--out", str(tmp_path / "out"), "--seed", "3"]
    main(words)
    told = capsys.readouterr().out
    command = json.loads((tmp_path / "out" / "results.json").read_text())["command"]
    assert sorted(shlex.split(command)) == sorted(["lidarsynth", *words]) and command in told
    assert f"wrote {tmp_path / 'out'}/ with results.json, table.md, figure.png" in told
    for wrong in (["--seed", "-1"], ["--data", "nowhere"], ["--classes", "nowhere"], ["--batch-size", "0"],
                  ["--device", "cuda:99"]):  # fmt: skip
        with pytest.raises(SystemExit) as end:
            main(["benchmark", "upsampling", str(config), "--out", str(tmp_path / "no"), *wrong])
        assert end.value.code == 2 and len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.parametrize("kind", ["upsampling", "generation"])
def test_the_examples_run(kind: str, data: Path, tmp_path: Path):
    text = (REPO_ROOT / "examples" / f"benchmark_{kind}.toml").read_text()
    assert [method for _, method in rows(read_config(kind, written(tmp_path / "whole.toml", text)).method)]
    smaller = {r"steps = 16\b": "steps = 1", r"steps = \[[0-9, ]*\]": "steps = [1]", r"count = \d+": "count = 2",
               r'held_out = ".*"': f'held_out = "{data}"'}  # fmt: skip
    for pattern, small in smaller.items():
        text = re.sub(pattern, small, text)
    shown = {"upsampling": None, "generation": "street"}[kind]  # as they are, but for the streets, which take an extra
    table_of = benchmark(kind, written(tmp_path / "b.toml", text), tmp_path / "out", ls.load, data=shown)
    names = [row[0] for row in cells(table_of, "## ")]
    assert {"upsampling": "kitti-streets, 1 step", "generation": "default by flow matching, 1 step"}[kind] in names
    assert len(names) == {"upsampling": 9, "generation": 5}[kind]


def test_the_commands_of_the_results_name_files_that_are_there():
    text = (REPO_ROOT / "docs" / "results.md").read_text()
    commands = re.findall(r"^lidarsynth benchmark (\w+) (\S+) ", text, re.MULTILINE)
    assert {kind for kind, _ in commands} == {"upsampling", "generation"}
    for kind, path in commands:
        assert read_config(kind, REPO_ROOT / path).method
    for path in re.findall(r"\]\((images/\S+)\)", text):
        assert (REPO_ROOT / "docs" / path).is_file()
