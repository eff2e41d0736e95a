"""The Ray example: two workers of a local cluster complete a folder, name what is broken, and go on where they were.

What it does beside Ray is tested without, in the place of a cluster this process."""

import runpy
import sys
import warnings
from collections.abc import Callable
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.cli.main import main
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.streets.reader import SyntheticStreets

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "ray_complete.py"


class Rows:
    """`ray.data`'s rows, in one batch, and here."""

    def __init__(self, rows: list[dict[str, Any]], **how: object):
        self.rows = rows

    def map_batches(self, kind: Callable[..., Any], fn_constructor_kwargs: dict[str, Any], **how: object) -> "Rows":
        worker = kind(**fn_constructor_kwargs)
        done = worker({name: np.array([row[name] for row in self.rows]) for name in self.rows[0]})
        return Rows([dict(zip(done, values, strict=True)) for values in zip(*done.values(), strict=True)])

    def take_all(self) -> list[dict[str, Any]]:
        return self.rows


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs the example without Ray: exit code, stdout, stderr."""
    ray = ModuleType("ray")
    pool = SimpleNamespace(from_items=Rows, ActorPoolStrategy=lambda size: None)
    vars(ray).update(init=lambda: None, cluster_resources=lambda: {"CPU": 1}, data=pool)
    monkeypatch.setitem(sys.modules, "ray", ray)

    def run(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        monkeypatch.setattr(sys, "argv", [str(EXAMPLE), *map(str, words)])
        code: Any = 0
        try:
            runpy.run_path(str(EXAMPLE), run_name="__main__")
        except SystemExit as stop:
            code = stop.code
        return (code, *capsys.readouterr())

    return run


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    """Four scans of stems with dots and in folders, as data sets have them."""
    image = SyntheticStreets(0, 1, ls.SENSORS["vlp-16"].resized(width=512)).image(0)
    sparse = image.keep(corrupt(image, "points:0.5")).to_scan()
    for name in ("a.1.ply", "d0/b.ply", "d1/c.ply", "n.bin"):
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        ls.write(tmp_path / "in" / name, sparse)
    (tmp_path / "in" / "n.bin").rename(tmp_path / "in" / "n.pcd.bin")  # as nuScenes calls its own
    nuscenes = np.concatenate([sparse.xyz, sparse.reflectance[:, None] * 255, sparse.xyz[:, :1] * 0], 1)
    nuscenes.astype("<f4").tofile(tmp_path / "in" / "n.pcd.bin")
    return tmp_path / "in"


def names(folder: Path) -> list[str]:
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.suffix in (".ply", ".npy"))


def test_files_have_the_names_of_complete_and_are_not_read_again(program: Callable, scans: Path, tmp_path: Path):
    """Where they lie below the scans, too."""
    main(["complete", str(scans), "--out", str(tmp_path / "cli"), "--model", "bilinear", "--no-picture"])
    assert program(scans, scans / "out", "--model", "bilinear") == (0, "4 scans completed, 0 failed\n", "")
    assert names(scans / "out") == names(tmp_path / "cli") == ["a.1.ply", "b.ply", "c.ply", "n.ply"]
    again = program(scans, scans / "out", "--model", "bilinear")
    assert again == (0, "0 scans completed, 0 failed; 4 there already\n", "")
    assert program(scans / "a.1.ply", tmp_path / "npy", "--model", "bilinear", "--format", "npy")[0] == 0
    assert names(tmp_path / "npy") == ["a.1.npy"]


def test_what_cannot_be_done_is_a_line_and_exit_code_2(program: Callable, scans: Path, tmp_path: Path):
    out, broken = tmp_path / "out", tmp_path / "broken"
    broken.mkdir()
    ls.write(broken / "ok.bin", ls.read(scans / "a.1.ply"))
    ls.write(broken / "ok.pcd", ls.read(scans / "a.1.ply"))
    for words, told in (
        ((broken, out), "expected scans of different names, found two named ok: "),
        ((tmp_path / "none", out), "none: expected a file, folder, bag or capture, found nothing of that name"),
        ((scans, scans), "in: expected another folder than that of the scans, found the same"),
        ((scans, out, "--model", "nope"), "nope: expected shipped weights"),
    ):
        code, said, error = program(*words)
        assert (code, said) == (2, "") and told in error and error.count("\n") == 1
    assert not out.exists()
    for name in ("ok.bin", "ok.pcd"):
        (broken / name).unlink()
    (broken / "no.ply").write_text("ply\n")
    code, said, error = program(broken, out, "--model", "bilinear")
    assert (code, said) == (2, "0 scans completed, 1 failed\n")
    assert error.count(f"{broken / 'no.ply'}") == 1 and "expected scans, found all 1 broken" in error
    ls.write(broken / "ok.ply", ls.read(scans / "a.1.ply"))
    assert program(broken, out, "--model", "bilinear")[:2] == (0, "1 scan completed, 1 failed\n")
    assert program(broken, out, "--model", "bilinear")[0] == 0, "one was there"


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.filterwarnings("ignore")  # of Ray about itself
def test_two_workers_complete_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    ray = pytest.importorskip("ray", reason="the extra ray is not installed")  # here, for it takes seconds to import
    sensor = ls.SENSORS["vlp-16"].resized(width=512)
    streets = SyntheticStreets(0, 4, sensor)
    for i in range(4):
        image = streets.image(i)
        folder = tmp_path / "scans" / f"d{i % 2}"
        folder.mkdir(parents=True, exist_ok=True)
        ls.write(folder / f"{i}.ply", image.keep(corrupt(image, "points:0.5")))
    (tmp_path / "scans" / "broken.ply").write_text("ply\n")
    spec = spec_from_file_location("ray_complete", EXAMPLE)
    assert spec is not None and spec.loader is not None
    example = module_from_spec(spec)
    monkeypatch.setitem(sys.modules, example.__name__, example)
    spec.loader.exec_module(example)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ray.init(num_cpus=2, include_dashboard=False, logging_level="ERROR", log_to_driver=False)
        try:
            ray.cloudpickle.register_pickle_by_value(example)
            rows = example.complete(tmp_path / "scans", tmp_path / "out", workers=2, batch=2)
        finally:
            ray.shutdown()
    good = [row for row in rows if not row["error"]]
    assert len(rows) == 5 and len(good) == 4 and all(row["new"] > 0 for row in good)
    left = example.pairs(tmp_path / "scans", tmp_path / "out", "ply")  # all that a second run would be given
    assert [Path(pair["source"]).name for pair in left] == ["broken.ply"]
    local = ls.load("default").complete(ls.read(tmp_path / "scans" / "d1" / "3.ply")).to_scan()
    np.testing.assert_array_equal(ls.read(tmp_path / "out" / "3.ply").xyz, local.xyz)
