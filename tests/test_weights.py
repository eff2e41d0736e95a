"""Official checkpoints load and say what they should; releases download, continue and fail in one clear line."""

import http.server
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from oracle import assert_close

from lidarsynth.experiment.folder import save
from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import Data, Model
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.depth import to_x_0
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import Scan
from lidarsynth.systems.diffusion.official_r2dm import experiment_of
from lidarsynth.systems.table import assemble, build_network
from lidarsynth.weights import load as weights
from lidarsynth.weights.download import cache_folder, download
from lidarsynth.weights.load import RELEASES, load_parts, shipped
from lidarsynth.weights.official import read_official

CONTENT = np.random.default_rng(0).bytes(3_000_000)


@pytest.fixture
def tiny(reference) -> Path:
    return reference / "fixtures" / "r2dm" / "tiny_H.pth"


@pytest.fixture
def edited(tiny, tmp_path):
    """`edited({"cfg/model/dropout": 0.1})` -> path of tiny_H.pth with these entries; the value `del` removes one."""

    def edit(changes: dict, name: str = "edited.pth") -> Path:
        checkpoint = torch.load(tiny, weights_only=True)
        for path, value in changes.items():
            *groups, key = path.split("/")
            table = checkpoint
            for group in groups:
                table = table[group]
            if value == "del":
                del table[key]
            else:
                table[key] = value
        torch.save(checkpoint, tmp_path / name)
        return tmp_path / name

    return edit


@pytest.mark.parametrize("name", ["config_A", "config_F", "config_G", "config_H", "tiny_H"])
@torch.no_grad()
def test_loaded_networks_say_what_the_reference_says(official_file, fixture_tensors, name):
    expected = fixture_tensors(f"r2dm/{name}_io")
    experiment, network = read_official(official_file(f"r2dm/{name}.pth"))
    assert not network.training
    output = network(expected["input"], expected["log_snr"])
    assert_close(output, expected["output"], atol=1e-4, rtol=0)
    torch.testing.assert_close(network.get_buffer("coords"), expected["coords"], atol=0, rtol=0)
    angles = torch.from_numpy(build_sensor(experiment).ray_angles())
    torch.testing.assert_close(angles[None], expected["coords"], atol=1e-6, rtol=0)


@torch.no_grad()
def test_raw_weights_are_the_other_set(shared, fixture_tensors):
    expected = fixture_tensors("r2dm/config_H_io")
    _, network = load_parts(shared / "fixtures" / "r2dm" / "config_H.pth", ema=False)
    output = network(expected["input"], expected["log_snr"])
    torch.testing.assert_close(output, expected["output_online_weights"], atol=1e-4, rtol=0)
    assert (output - expected["output"]).abs().max() > 1e-2


def test_the_experiment_tells_the_official_hyper_parameters(tiny, edited):
    experiment, _ = read_official(tiny)
    assert (experiment.name, experiment.data.sensor, experiment.data.codec) == ("tiny_H", "hdl-64e", "log")
    assert (experiment.data.projection, experiment.data.height, experiment.data.width) == ("spherical", 16, 64)
    assert experiment.model.channel_multipliers == (1, 1, 2, 2)
    assert (experiment.model.gn_num_groups, experiment.model.attn_num_heads) == (4, 2)
    assert (experiment.diffusion.schedule, experiment.diffusion.kind) == ("cosine", "eps")
    assert (experiment.training.steps, experiment.training.betas) == (300_000, (0.9, 0.99))
    assert "NC-SA" in experiment.card.licence and experiment.card.data == "KITTI-360"
    changes = {
        "cfg/data/depth_format": "inverse_depth",
        "cfg/data/projection": "unfolding-2048",
        "cfg/data/dataset": "kitti_raw",
        "cfg/diffusion/prediction_type": "v",
        "cfg/diffusion/loss_type": "huber",
        "cfg/training": {"adam_beta1": 0.9, "adam_beta2": 0.99},  # training fields are only told, never needed
    }
    experiment, _ = read_official(edited(changes))
    assert (experiment.data.codec, experiment.data.projection) == ("inverse", "unfolding")
    assert (experiment.diffusion.kind, experiment.diffusion.loss) == ("v", "huber")
    assert experiment.card.data == "KITTI raw"


def test_the_default_experiment_is_row_h_of_the_paper(edited):
    """Only name, size, sensor and card differ between r2dm-h and what an official cfg with R2DM's numbers gives."""
    experiment, _ = read_official(edited({}))
    ours = preset("r2dm-h")
    assert (experiment.diffusion, experiment.training) == (ours.diffusion, ours.training)


def with_coords(edited, elevation: np.ndarray, azimuth: np.ndarray) -> Path:
    """tiny_H with other ray angles, in degrees; the network's layers do not depend on them."""
    angles = np.radians(np.stack(np.broadcast_arrays(elevation[:, None], azimuth[None])))
    coords = torch.from_numpy(angles).float()[None]
    changes = {"ema_weights/model.coords": coords, "cfg/data/projection": "unfolding-2048"}
    return edited(changes)


def test_measured_angles_of_a_checkpoint_become_its_sensor(edited, fixture_tensors):
    table = fixture_tensors("r2dm/unfolding_angles")
    elevation = np.degrees(table["kitti_raw.elevation_rad"].double().numpy())[2::4]
    azimuth = np.degrees(table["kitti_raw.azimuth_rad"].double().numpy())[16::32]  # nearest-exact 2048 -> 64
    experiment, network = read_official(with_coords(edited, elevation, azimuth))
    sensor = assemble(experiment, network).sensor
    np.testing.assert_allclose(sensor.elevations, elevation, atol=1e-5)
    assert not sensor.edges
    assert (sensor.min_range, sensor.max_range) == (1.45, 80.0)
    found = network.get_buffer("coords")[0].numpy()
    away = np.degrees(np.abs(sensor.ray_angles() - found))
    assert away[0].max() < 1e-5
    assert away[1].max() < 0.51 * 360 / 2048 * 1.05  # the subsampled column lies half a fine step off the centre
    model = assemble(experiment, network)
    (image,) = model.generate(1, steps=2, seed=1)
    level = image.range * np.cos(found[0])
    expected = np.stack([level * np.cos(found[1]), level * np.sin(found[1]), image.range * np.sin(found[0])], axis=-1)
    np.testing.assert_allclose(image.points()[image.mask], expected[image.mask], atol=1e-4)  # R2DM's, by `coords`
    known = np.arange(image.shape[0])[:, None] % 4 + np.zeros(image.shape) == 0
    filled = model.complete(replace(image, xyz=None), known, steps=2)
    assert filled.new.any() and np.abs(filled.points() - sensor.points(filled.range))[filled.new].max() > 1e-3
    assert np.abs(filled.points() - sensor.points(filled.range))[known & filled.mask].max() < 1e-6


def test_the_published_angles_of_kitti_raw_have_a_word(tiny, tmp_path, fixture_tensors):
    """So that real scans are drawn and thinned for what they are judged with, as for its own training."""
    table = fixture_tensors("r2dm/unfolding_angles")
    for word in ("kitti_raw", "kitti_360"):
        elevation, azimuth = table[f"{word}.elevation_rad"], table[f"{word}.azimuth_rad"][2::4]
        coords = torch.stack(torch.broadcast_tensors(elevation[:, None], azimuth[None]))[None]
        checkpoint = torch.load(tiny, weights_only=True)
        checkpoint["cfg"]["data"] |= {"resolution": (64, 512), "projection": "unfolding-2048"}
        data = experiment_of(checkpoint, coords, "mine").data
        assert data.sensor == "hdl-64e-r2dm" if word == "kitti_raw" else data.sensor["name"] == "mine"
        assert (data.width, data.columns) == (512, 2048)


def test_a_scan_is_drawn_for_a_model_as_for_its_training(scan64: bytes, fixture_tensors):
    experiment = preset("r2dm-kitti-raw")
    model = assemble(experiment, build_network(experiment))
    table = np.frombuffer(scan64, "<f4").reshape(-1, 4)
    scan = Scan(table[:, :3], table[:, 3])
    expected = fixture_tensors("projection/preprocess")["train_x0.unfolding-2048.to64x512.log_depth"][0]
    image = model.image_of(scan)
    torch.testing.assert_close(to_x_0(image), expected, rtol=0, atol=1e-5)
    assert (image.mask.mean() < 0.85 * project(scan, image.sensor, "unfolding").mask.mean()).item()


def test_the_even_grid_of_any_height_is_exact(tiny, tmp_path):
    experiment = preset("r2dm-h")
    beams = {"elevations": (3 - 28 * np.arange(40) / 40).tolist(), "edges": True, "min_range": 1.45, "max_range": 80}
    small = Model(base_channels=8, num_residual_blocks=(1, 1, 1, 1), channel_multipliers=(1, 1, 2, 2))
    experiment = replace(experiment, data=Data(sensor=beams, height=40, width=200), model=small)
    network = build_network(experiment)
    checkpoint = torch.load(tiny, weights_only=True)
    checkpoint["cfg"]["data"] |= {"resolution": (40, 200)}
    checkpoint["cfg"]["model"] |= {"gn_num_groups": 8, "attn_num_heads": 8}
    checkpoint["ema_weights"] = {f"model.{key}": value for key, value in network.state_dict().items()}
    torch.save(checkpoint, tmp_path / "odd.pth")
    sensor = assemble(*read_official(tmp_path / "odd.pth")).sensor
    assert sensor.elevations == pytest.approx(beams["elevations"], abs=1e-12)
    assert sensor.edges and (sensor.height, sensor.width, sensor.max_range) == (40, 200, 80.0)
    found = torch.from_numpy(sensor.ray_angles())[None]
    torch.testing.assert_close(found, network.get_buffer("coords"), atol=1e-6, rtol=0)


def test_a_loaded_official_model_saves_and_loads_as_ours(edited, tmp_path, fixture_tensors):
    expected = fixture_tensors("r2dm/tiny_H_io")
    elevation, azimuth = np.linspace(2, -24, 16), 180 - 360 * (np.arange(64) + 0.625) / 64
    experiment, network = read_official(with_coords(edited, elevation, azimuth))
    save(tmp_path / "ours", experiment, network)
    for source in (tmp_path / "ours", str(tmp_path / "ours"), tmp_path / "ours" / "model.safetensors"):
        again, same = load_parts(source)
        assert again.to_dict() == experiment.to_dict()
        assert build_sensor(again) == build_sensor(experiment)
        with torch.no_grad():
            torch.testing.assert_close(
                same(expected["input"], expected["log_snr"]), network(expected["input"], expected["log_snr"])
            )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cfg/model/architecture": "refinenet"}, r"cfg.model.architecture .*\['efficient_unet'\], found 'refinenet'"),
        ({"cfg/model/architecture": ["efficient_unet"]}, r"cfg.model.architecture .* found \['efficient_unet'\]"),
        ({"cfg/data/depth_format": "log"}, r"cfg.data.depth_format .*'log_depth', 'inverse_depth', 'depth'\], found"),
        ({"cfg/data/train_reflectance": False}, r"cfg.data.train_reflectance .*\[True\], found False"),
        ({"cfg/diffusion/timestep_type": "discrete"}, r"cfg.diffusion.timestep_type .*\['continuous'\], found 'disc"),
        ({"cfg/diffusion/noise_schedule": "cosine_shifted"}, r"cfg.diffusion.noise_schedule .*'cosine_shifted'"),
        ({"cfg/model/base_channels": "del"}, r"expected cfg.model.base_channels, found the fields \['architecture'"),
        ({"cfg/model": "del"}, r"expected cfg.model.\w+, found the fields \['data', 'diffusion', 'training'\]"),
        ({"cfg/model/base_channels": "8"}, r"model.base_channels: expected int, found '8'"),
        ({"cfg/model/base_channels": 10}, r"gn_num_groups must divide all level widths .* got 4"),
        ({"cfg/model/base_channels": 16}, r"ema_weights: expected \S+ \(\d+.*\), found \(\d+"),
        (
            {"cfg/model/num_residual_blocks": (2, 1, 1, 1)},
            r"ema_weights: expected .*, found none; \d+ tensors do not fit",
        ),
        ({"cfg/data/resolution": (64, 1024)}, r"model.coords .*\(64, 1024\), found \(1, 2, 16, 64\)"),
        ({"cfg/data/resolution": 64}, r"cfg.data.resolution 64, found \(1, 2, 16, 64\)"),
        ({"ema_weights/model.coords": "del"}, r"expected model.coords \(1, 2, H, W\) .* found None"),
        ({"ema_weights/model.coords": torch.zeros(1, 2, 16, 64)}, "elevations that fall from row to row"),
        ({"ema_weights/model.in_conv.bias": "x"}, r"tensors by name, found 'model.in_conv.bias' str"),
        ({"cfg/data/train_depth": torch.zeros(2)}, r"cfg.data.train_depth .*\[True\], found tensor"),
        ({"cfg": "del"}, r"expected .* with cfg, weights and ema_weights, found 5 keys \['weights', 'ema_weights'"),
        ({"ema_weights": [1, 2]}, "with cfg, weights and ema_weights, found 6 keys"),
    ],
    ids=lambda value: value if isinstance(value, str) else "+".join(value),
)
def test_other_checkpoints_are_refused_by_the_name_of_the_field(edited, changes, message):
    path = edited(changes)
    with pytest.raises(ValueError, match=message) as caught:
        read_official(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize("changes", [{"cfg/training": None}, {"cfg/data/dataset": ["kitti_360"]}])
def test_what_a_network_does_not_need_may_be_anything(edited, changes):
    experiment, _ = read_official(edited(changes))
    assert (experiment.card.data == "not known") == ("cfg/data/dataset" in changes)


class Foreign:
    """Something that weights_only refuses to build."""


def broken_files(folder: Path, good: bytes) -> Iterator[tuple[Path, str]]:
    contents = {
        "empty": (b"", "found an empty file"),
        "truncated": (good[: len(good) // 2], "found a truncated file"),
        "text": (b"<!DOCTYPE html>", r"another kind of file, which starts with b'<!DO'"),
        "pickle": (b"\x80\x02garbage", "found a damaged or unsafe file"),
        "flipped": (good[:100] + bytes(200) + good[300:], "found a damaged or unsafe file"),
    }
    for name, (content, message) in contents.items():
        (folder / name).write_bytes(content)
        yield folder / name, message
    for name, value in {"list": [{}, {}, 3], "foreign": Foreign(), "plain": {"conv.weight": torch.zeros(2)}}.items():
        torch.save(value, folder / name)
    yield folder / "list", "found a list"
    yield folder / "foreign", r"found a damaged or unsafe file .*Foreign"
    yield folder / "plain", r"found 1 keys \['conv.weight'\]"
    yield folder, "found a folder"
    yield folder / "absent.pth", "found No such file"


def test_files_that_are_no_checkpoints_get_one_line(tiny, tmp_path):
    for path, message in broken_files(tmp_path, tiny.read_bytes()):
        with pytest.raises(ValueError, match=message) as caught:
            read_official(path)
        assert str(caught.value).startswith(f"{path}: expected an official R2DM checkpoint") and "\n" not in str(
            caught.value
        )


def test_checkpoints_of_other_systems_are_named_by_their_keys(official_file):
    with pytest.raises(ValueError, match=r"found 74 keys \['(feat|fc\d|bn\d)\."):
        read_official(official_file("pointnet/cls_model_39.pth"))


def test_words_and_paths_that_are_nothing_get_one_line(tmp_path):
    for source, found in {
        "nonsense": "no file or folder of that name",
        "r2dm-h": "a preset, which has no trained weights",
        tmp_path / "gone": "no file or folder of that name",
        Path("default"): "no file or folder of that name; words are given as str",
        tmp_path: "no experiment.json",
    }.items():
        with pytest.raises(ValueError, match=f"expected .*found {found}") as caught:
            load_parts(source)
        assert str(source) in str(caught.value) and "\n" not in str(caught.value)


def test_a_file_of_weights_is_read_into_a_network_that_draws_none(tmp_path):
    experiment = preset("tiny")
    network = build_network(experiment)
    save(tmp_path / "saved", experiment, network)
    state = torch.get_rng_state()
    again = load_parts(tmp_path / "saved")[1]
    assert torch.equal(torch.get_rng_state(), state), "random numbers for weights that the file gives"
    for name, value in network.state_dict().items():
        assert torch.equal(again.state_dict()[name], value), name


def test_shipped_words_come_first_and_a_path_is_still_reachable(tmp_path, monkeypatch):
    experiment = preset("tiny")
    network = build_network(experiment)
    save(tmp_path / "package" / "shipped" / "tiny", experiment, network, half=True)
    monkeypatch.setattr(weights, "SHIPPED", tmp_path / "package" / "shipped")
    assert shipped() == {"tiny": tmp_path / "package" / "shipped" / "tiny"}
    assert load_parts("tiny")[0] == experiment
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"tiny: expected"):
        load_parts("./tiny")


class Server(http.server.ThreadingHTTPServer):
    """Serves CONTENT; `ranges` False ignores Range, `cut` ends each connection after that many bytes."""

    ranges = True
    cut: int | None = None
    status = 200
    length = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.asked: list[tuple[str, str | None]] = []
        self.url = f"http://127.0.0.1:{self.server_port}"


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        server = self.server
        asked = self.headers["Range"]
        server.asked.append((self.path, asked))
        if server.status != 200:
            return self.send_error(server.status)
        start = int(asked.removeprefix("bytes=").rstrip("-")) if asked and server.ranges else 0
        if start >= len(CONTENT):
            return self.send_error(416)
        body = CONTENT[start:]
        self.send_response(206 if asked and server.ranges else 200)
        if asked and server.ranges:
            self.send_header("Content-Range", f"bytes {start}-{len(CONTENT) - 1}/{len(CONTENT)}")
        if server.length:
            self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body if server.cut is None else body[: server.cut])

    def log_message(self, *_):
        pass


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setenv("no_proxy", "*")
    with Server() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def test_a_download_arrives_whole_and_tells_its_progress(server, tmp_path):
    path = tmp_path / "new" / "folder" / "file.pth"
    steps = list(download(f"{server.url}/file.pth", path))
    assert path.read_bytes() == CONTENT
    assert [total for _, total in steps] == [len(CONTENT)] * len(steps)
    assert steps[0][0] == 0 and steps[-1][0] == len(CONTENT) and len(steps) >= 4
    assert [p.name for p in path.parent.iterdir()] == ["file.pth"]
    assert list(download(f"{server.url}/file.pth", path)) == []
    assert len(server.asked) == 1, "what is there is not asked for again"


def test_an_interrupted_download_continues_where_it_stopped(server, tmp_path):
    path = tmp_path / "file.pth"
    server.cut = 1_200_000
    message = r"found only 1200000 of 3000000 bytes; without a network, put the file at .*file\.pth$"
    with pytest.raises(ValueError, match=message):
        list(download(f"{server.url}/file.pth", path))
    assert not path.exists() and (tmp_path / "file.pth.part").stat().st_size == 1_200_000
    server.cut = None
    steps = list(download(f"{server.url}/file.pth", path))
    assert server.asked[-1][1] == "bytes=1199999-"
    assert steps[0] == (1_199_999, 3_000_000)
    assert path.read_bytes() == CONTENT


def test_a_reader_that_stops_keeps_what_it_has(server, tmp_path):
    path = tmp_path / "file.pth"
    progress = download(f"{server.url}/file.pth", path)
    while next(progress)[0] < 2_000_000:
        pass
    progress.close()
    kept = (tmp_path / "file.pth.part").stat().st_size
    assert kept >= 2_000_000 and not path.exists()
    list(download(f"{server.url}/file.pth", path))
    assert server.asked[-1][1] == f"bytes={kept - 1}-" and path.read_bytes() == CONTENT


@pytest.mark.parametrize("length", [True, False])
def test_a_server_that_cannot_continue_sends_it_all_again(server, tmp_path, length):
    server.ranges, server.length = False, length
    (tmp_path / "file.pth.part").write_bytes(bytes(500_000))
    steps = list(download(f"{server.url}/file.pth", tmp_path / "file.pth"))
    assert steps[0] == (0, 3_000_000 if length else None)
    assert (tmp_path / "file.pth").read_bytes() == CONTENT


@pytest.mark.parametrize("rest", [b"", b"more than the server has"])
def test_a_complete_or_too_long_part_becomes_the_file(server, tmp_path, rest):
    (tmp_path / "file.pth.part").write_bytes(CONTENT + rest)
    list(download(f"{server.url}/file.pth", tmp_path / "file.pth"))
    assert (tmp_path / "file.pth").read_bytes() == CONTENT


def test_two_processes_may_fetch_the_same_file(server, tmp_path):
    path = tmp_path / "file.pth"
    one, two = (download(f"{server.url}/file.pth", path) for _ in range(2))
    next(one), next(one), next(two)
    list(two)
    assert path.read_bytes() == CONTENT
    list(one)
    assert path.read_bytes() == CONTENT and [p.name for p in tmp_path.iterdir()] == ["file.pth"]


def test_refusals_and_absence_of_a_network_say_where_to_put_the_file(server, tmp_path):
    server.status = 404
    with pytest.raises(ValueError, match=r"found HTTP Error 404: .*; without a network, put the file at /"):
        list(download(f"{server.url}/file.pth", tmp_path / "file.pth"))
    server.server_close()
    with pytest.raises(ValueError, match=r"found \[Errno \d+\] .*; without a network, put the file at /"):
        list(download(f"{server.url}/file.pth", tmp_path / "other.pth"))
    (tmp_path / "blocked").write_text("a file, not a folder")
    with pytest.raises(ValueError, match=r"expected a download, found .*; without a network"):
        list(download(f"{server.url}/file.pth", tmp_path / "blocked" / "file.pth"))


def test_a_release_is_fetched_by_its_name_once(server, tiny, tmp_path, monkeypatch, fixture_tensors):
    monkeypatch.setattr(weights, "BASE_URL", server.url)
    monkeypatch.setitem(globals(), "CONTENT", tiny.read_bytes())
    monkeypatch.setenv("LIDARSYNTH_CACHE", str(tmp_path / "cache"))
    seen = []
    experiment, network = load_parts("r2dm-h-kitti360", on_bytes=lambda done, total: seen.append((done, total)))
    size = tiny.stat().st_size
    assert seen[-1] == (size, size)
    assert experiment.name == "r2dm-h-kitti360-300k"
    expected = fixture_tensors("r2dm/tiny_H_io")
    with torch.no_grad():
        torch.testing.assert_close(
            network(expected["input"], expected["log_snr"]), expected["output"], atol=1e-4, rtol=0
        )
    load_parts("r2dm-h-kitti360-300k")
    assert [path for path, _ in server.asked] == ["/r2dm-h-kitti360-300k.pth"]
    assert cache_folder() == tmp_path / "cache"
    monkeypatch.setitem(globals(), "CONTENT", b"<html>log in first</html>")
    with pytest.raises(ValueError, match=r"another kind of file.*; delete the file to download it again"):
        load_parts("r2dm-a-kitti360")


def test_the_cache_is_the_users_and_the_names_are_the_paper_rows(monkeypatch, tmp_path):
    monkeypatch.delenv("LIDARSYNTH_CACHE", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))
    if sys.platform == "linux":
        assert cache_folder() == tmp_path / "own" / "lidarsynth"
    (tmp_path / ".cache" / "lidarsynth").mkdir(parents=True)
    assert cache_folder() == tmp_path / ".cache" / "lidarsynth", "what earlier versions downloaded is found"
    assert {"r2dm-a-kitti360", "r2dm-h-kitti360", "r2dm-h-kittiraw"} <= set(RELEASES)


@pytest.mark.parametrize("base", ["nobody", "kitti", "../shipped/default", "/etc"])
def test_a_base_is_of_the_shipped_weights_that_have_none(tmp_path, base):
    experiment, network = load_parts("kitti")
    save(tmp_path / "m", replace(experiment, base=base), network, half=True)
    with pytest.raises(ValueError, match=r"expected a base of shipped weights that have none, found"):
        load_parts(tmp_path / "m")


def test_a_model_follows_its_base_whose_networks_have_changed_since(tmp_path):
    experiment, network = load_parts("kitti")
    before = replace(experiment.model, guide_channels=32, column_channels=0)
    save(tmp_path / "m", replace(experiment, model=before), network, half=True)
    found, again = load_parts(tmp_path / "m")
    assert found == experiment
    for name, value in network.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, atol=0, rtol=0)


def test_classes_are_of_the_base_where_a_model_has_none_of_its_own(tmp_path):
    experiment, network = load_parts("kitti")
    assert experiment.model.own_classes
    before = replace(experiment.model, own_classes=False, class_channels=8)
    save(tmp_path / "m", replace(experiment, model=before), network, half=True)
    _, again = load_parts(tmp_path / "m")
    for name, value in load_parts("default")[1].classes.state_dict().items():
        torch.testing.assert_close(again.classes.state_dict()[name], value, atol=0, rtol=0)
