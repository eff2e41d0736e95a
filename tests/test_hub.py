"""Models on the Hugging Face hub, without network: a stand-in for huggingface_hub keeps repositories in a folder."""

import copy
import inspect
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import Card, Data, with_fields
from lidarsynth.lidar.sensor import from_dict
from lidarsynth.systems.diffusion.model import LidarModel
from lidarsynth.systems.hub import fetch, is_repository
from lidarsynth.systems.table import assemble, build_network, card_of
from lidarsynth.weights.load import load, load_parts

CARD = Card("MIT", "200 scans of one street", ("20 steps of 4 on 1 x cpu",), ("range MAE 1.5 m",))


class Repositories:
    """Does with a folder what huggingface_hub does with the hub; `commits` are (repository, files, message)."""

    def __init__(self, root: Path):
        self.root = root
        self.commits: list[tuple[str, list[str], str]] = []
        self.private: dict[str, bool] = {}

    def create_repo(self, repo_id: str, *, private: bool, exist_ok: bool) -> None:
        assert exist_ok or repo_id not in self.private
        self.private.setdefault(repo_id, private)

    def upload_folder(self, *, repo_id: str, folder_path: str, commit_message: str) -> None:
        assert repo_id in self.private, "404"
        shutil.copytree(folder_path, self.root / repo_id / "main", dirs_exist_ok=True)
        self.commits.append((repo_id, sorted(p.name for p in Path(folder_path).iterdir()), commit_message))

    def snapshot_download(self, repo_id: str, *, revision: str | None, allow_patterns: Iterable[str]) -> str:
        folder = self.root / repo_id / (revision or "main")
        if not folder.is_dir():
            raise OSError(f"404 Client Error.\n\nRepository Not Found for {repo_id}")
        for path in folder.iterdir():
            assert path.name in set(allow_patterns) | {"README.md"}
        return str(folder)


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Repositories:
    repositories = Repositories(tmp_path / "hub")
    monkeypatch.setitem(sys.modules, "huggingface_hub", repositories)
    return repositories


@pytest.fixture(scope="module")
def model() -> LidarModel:
    experiment = replace(preset("tiny"), card=CARD)
    network = build_network(experiment)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.1, generator=torch.Generator().manual_seed(0))
    return assemble(experiment, network)


def test_what_was_pushed_is_what_loads(hub: Repositories, model: LidarModel):
    assert model.push_to_hub("someone/street-1", private=True) == "https://huggingface.co/someone/street-1"
    names = ["README.md", "experiment.json", "model.safetensors"]
    assert hub.commits == [("someone/street-1", names, "lidarsynth: tiny")] and hub.private["someone/street-1"]
    found = load("someone/street-1")
    assert found.experiment == model.experiment
    torch.testing.assert_close(found.network.state_dict(), model.network.state_dict(), rtol=0, atol=0)
    card = (hub.root / "someone/street-1/main/README.md").read_text()
    assert card == card_of(model.experiment, "someone/street-1") and 'ls.load("someone/street-1")' in card


def test_half_of_the_size_and_revisions(hub: Repositories, model: LidarModel):
    model.push_to_hub("someone/street")
    whole = (hub.root / "someone/street/main/model.safetensors").stat().st_size
    shutil.copytree(hub.root / "someone/street/main", hub.root / "someone/street/v1")
    model.push_to_hub("someone/street", half=True)
    assert (hub.root / "someone/street/main/model.safetensors").stat().st_size < 0.7 * whole
    assert fetch("someone/street@v1") == hub.root / "someone/street/v1"
    halved = load("someone/street").network.state_dict()
    torch.testing.assert_close(halved, load("someone/street@v1").network.state_dict(), rtol=1e-3, atol=1e-4)


def test_weights_that_half_of_the_size_cannot_hold_are_refused_and_what_was_there_stays(model: LidarModel, tmp_path):
    large, folder = copy.deepcopy(model), model.save(tmp_path / "mine")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with torch.no_grad():
        next(large.network.parameters()).view(-1)[0] = 1e5
    for place in (folder, tmp_path / "new"):
        with pytest.raises(
            ValueError, match=r"expected weights of at most 65504 .*, found 100000 in \S+; save them whole"
        ):
            large.save(place, half=True)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before and not (tmp_path / "new").exists()
    assert load(large.save(folder)).network.state_dict().keys() == model.network.state_dict().keys()


def test_a_local_folder_goes_before_the_hub(hub: Repositories, model: LidarModel, tmp_path: Path, monkeypatch):
    from lidarsynth.experiment.folder import save

    monkeypatch.chdir(tmp_path)
    save("runs/mine", with_fields(model.experiment, {"training.seed": 7}), model.network)
    assert load("runs/mine").experiment.training.seed == 7


def test_every_failure_is_one_line(hub: Repositories, model: LidarModel, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(ValueError, match=r"^runs/mien: expected a model folder here, or .*found: 404 .*Not Found"):
        load_parts("runs/mien")
    (hub.root / "someone/else/main").mkdir(parents=True)
    with pytest.raises(ValueError, match=r"someone/else: expected model.safetensors and experiment.json, found no"):
        load("someone/else")
    for name in ("street", "a/b/c", "a/b@main", "", 5, None):
        with pytest.raises(ValueError, match="expected a repository owner/name, found"):
            model.push_to_hub(name)  # type: ignore[arg-type]

    def offline(*_, **__):
        raise ConnectionError("Cannot reach the hub.\n  Please check\n your connection")

    monkeypatch.setattr(hub, "snapshot_download", offline)
    monkeypatch.setattr(hub, "create_repo", offline)
    for attempt in (lambda: load("someone/street"), lambda: model.push_to_hub("someone/street")):
        with pytest.raises(ValueError, match=r"found: Cannot reach the hub. Please check your connection$") as caught:
            attempt()
        assert "\n" not in str(caught.value)


def test_without_the_extra_it_is_named(model: LidarModel, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    for attempt in (lambda: load("someone/street"), lambda: model.push_to_hub("someone/street")):
        with pytest.raises(ImportError, match=r"pip install 'lidarsynth\[hub\]'"):
            attempt()


def test_paths_and_files_are_no_repositories():
    assert all(map(is_repository, ("owner/name", "o/n.1_2-3@main", "o/n@refs/pr/1")))
    assert not any(map(is_repository, ("default", "./a/b", "/a/b", "a/b/c", "../b", "a/b.pth", "a/ b", "a/b@", "o/é")))


def test_the_card_says_what_the_experiment_says():
    own = from_dict({"name": "my-lidar", "beams": 32, "top": 15, "bottom": -25, "max_range": 120})
    data = Data(own.to_dict(), "auto", 32, 512, roll=True)
    text = card_of(replace(preset("tiny"), data=data, card=CARD))
    assert text.startswith("---\nlibrary_name: lidarsynth\n") and "\nlicense: mit\n---\n" in text
    assert "my-lidar, 32 beams from +15.00 to -25.00 degrees, 1 to 120 m" in text
    assert "| images | 32 x 512, auto projection, log range" in text and "| augmentation | roll |" in text
    assert "generates and completes" in text and "20 steps of 4, learning rate 0.001" in text
    assert "## Learned from\n\n200 scans of one street\n" in text and "## Licence\n\nMIT\n" in text
    assert "- 20 steps of 4 on 1 x cpu\n" in text and text.endswith("## Results\n\n- range MAE 1.5 m\n")


def test_the_card_keeps_back_nothing_and_makes_nothing_up():
    bare = card_of(preset("r2dm-h"))
    assert "license" not in bare and "Not stated" in bare and "Not recorded" in bare and "Results" not in bare
    assert "A diffusion model that generates LiDAR scans" in bare
    kitti = card_of(replace(preset("r2dm-h"), card=Card("CC BY-NC-SA 3.0, that of KITTI-360")))
    assert "\nlicense: cc-by-nc-sa-3.0\n" in kitti
    house = card_of(replace(preset("r2dm-h"), card=Card('for "us": only')))
    assert '\nlicense: other\nlicense_name: "for \\"us\\": only"\n' in house


def test_a_hub_elsewhere_is_named_as_huggingface_hub_is_told_of_it():
    said = []
    for place in ("", "https://hub.example.org/"):
        told = "from lidarsynth.systems.hub import HUB; print(HUB)"
        done = subprocess.run(
            [sys.executable, "-c", told], env=os.environ | {"HF_ENDPOINT": place}, capture_output=True
        )
        said.append(done.stdout.decode().strip())
    assert said == ["https://huggingface.co", "https://hub.example.org"]


def test_the_stand_in_has_the_signatures_of_the_real_one():
    real = pytest.importorskip("huggingface_hub")
    for name in ("create_repo", "upload_folder", "snapshot_download"):
        used = set(inspect.signature(getattr(Repositories, name)).parameters) - {"self"}
        assert used <= set(inspect.signature(getattr(real, name)).parameters)
