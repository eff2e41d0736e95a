"""The Ray example: two workers of a local cluster complete a folder, name what is broken, and go on where they were."""

import sys
import warnings
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.streets.reader import SyntheticStreets

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "ray_complete.py"


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
    np.testing.assert_array_equal(ls.read(tmp_path / "out" / "d1" / "3.ply").xyz, local.xyz)
