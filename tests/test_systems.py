"""The table of systems: complete for every preset, and what cards say of each family is true."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from networks import trained

import lidarsynth as ls
from lidarsynth.experiment.presets import PRESETS, preset
from lidarsynth.experiment.record import Experiment, with_fields
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.systems.gan import model as gan_model
from lidarsynth.systems.scan_model import ScanModel
from lidarsynth.systems.table import SYSTEMS, assemble, card_of, official_readers, system_of, task_of
from lidarsynth.training.task import Task

SMALL = ("tiny", "lidargen-tiny", "tiny-gan", "lidar-sr-tiny", "iln-tiny", "bilinear")


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_has_a_system_that_is_complete(name: str):
    experiment = preset(name)
    system = system_of(experiment)
    with torch.device("meta"):
        assert sum(1 for _ in system.build(experiment, build_sensor(experiment)).parameters()) >= 0
    assert (system.model is None) == (system.family == "segmentation"), "only classes make no scans"
    assert (system.task is None) == (system.family == "interpolation") == (system.transfer is None)
    if system.task is not None:
        assert isinstance(task_of(experiment), Task)
    described = system.description
    assert described.network(experiment) and all(map(str, described.details(experiment).values()))
    assert described.about(experiment).sentence.endswith(".")


def test_official_readers_do_not_take_each_others_files():
    readers = official_readers()
    assert set(readers) == {"lidargen", "vanilla-gan/dusty-v1/dusty-v2", "lidar-sr/iln/liif"}
    files = {
        "vanilla-gan/dusty-v1/dusty-v2": {"G": {}, "D": {}, "G_ema": {}},
        "lidar-sr/iln/liif": {"model": {"name": "iln", "state_dict": {}}},
    }
    for owner, checkpoint in files.items():
        assert [name for name, reader in readers.items() if reader.belongs(checkpoint)] == [owner]


def scan_of(sensor: Sensor) -> Scan:
    rng = np.random.default_rng(0)
    mask = np.zeros((sensor.height, sensor.width), bool)
    mask[::4] = True
    distance = rng.uniform(5, 30, mask.shape).astype(np.float32) * mask
    return RangeImage(distance, np.float32(0.5) * mask, mask, sensor).to_scan()


@pytest.mark.parametrize("name", SMALL)
def test_the_usage_on_a_card_runs(name: str, monkeypatch: pytest.MonkeyPatch):
    experiment = preset(name) if preset(name).score is None else with_fields(preset(name), {"score.levels": 2})
    model = assemble(experiment, trained(experiment))
    monkeypatch.setattr(gan_model, "STEPS", 2)
    (usage,) = re.findall(r"```python\n(.*?)```", card_of(model.experiment, "someone/something"), re.S)
    assert 'ls.load("someone/something")' in usage or name == "bilinear"
    lines = [line for line in usage.splitlines() if not line.startswith("import lidarsynth")]
    monkeypatch.setattr(ls, "load", lambda source: model, raising=False)
    monkeypatch.setattr(ls, "read", lambda path: scan_of(model.sensor), raising=False)
    upsample = ScanModel.upsample
    monkeypatch.setattr(type(model), "upsample", lambda self, scan: upsample(self, scan, self.sensor))
    said: dict = {"ls": ls}
    exec("\n".join(lines).replace("steps=32", "steps=2"), said)
    assert said["dense"].mask.any()
    if "images" in said:
        assert len(said["images"]) == 4


@pytest.mark.parametrize("name", [*SMALL, "rangenet-street", "kitti", "default", "dusty-v1"])
def test_a_card_tells_its_own_family(name: str):
    text = card_of(preset(name))
    diffusion = system_of(preset(name)).family == "diffusion"
    assert ("diffusion model" in text or "score-based" in text) == diffusion
    assert ("R2DM" in text or "LiDARGen" in text) == diffusion
    assert ("no reflectance" in text) == (not preset(name).data.reflectance)
    assert ("generate(" in text) == (system_of(preset(name)).family in ("diffusion", "gan", "cascade"))


def test_all_of_the_augmentation_is_told():
    changes = {"data.roll": True, "data.mirror": True, "data.scale": 0.15, "data.mix": 0.8}
    assert (
        "| augmentation | roll, mirror, worlds up to 15% larger or smaller, a sector of another scan in 80% of those "
        "to be completed |" in card_of(with_fields(preset("kitti-streets"), changes))
    )


def test_a_word_that_is_in_no_table_is_named():
    with pytest.raises(ValueError, match=r"model.network: expected one of .*efficient-unet.*, found 'u-net'"):
        system_of(Experiment("x", model=preset("tiny").model.__class__(network="u-net")))


def test_systems_are_folders():
    import lidarsynth.systems.table as table

    folders = {path.name for path in Path(table.__file__).parent.iterdir() if path.is_dir() and path.name[0] != "_"}
    assert {system.family for system in SYSTEMS.values()} <= folders
