"""Experiments: presets, replaced fields, records and folders; what cannot be built says why."""

import json
import re
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
import torch
from networks import trained
from safetensors.torch import load_file, save_file

from lidarsynth.experiment.eight_bits import SCALE
from lidarsynth.experiment.folder import read_experiment, save
from lidarsynth.experiment.presets import PRESETS, preset
from lidarsynth.experiment.record import WEIGHTS, Data, Training, from_dict, with_fields
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.sensor import SENSORS, get_sensor
from lidarsynth.systems.diffusion.build import build_denoiser
from lidarsynth.systems.table import SHIPPED, build_network
from lidarsynth.systems.table import load_folder as load


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_survives_json_and_can_be_built(name):
    experiment = preset(name)
    assert experiment.name == name
    assert from_dict(json.loads(json.dumps(experiment.to_dict()))) == experiment
    with torch.device("meta"):
        network = build_network(experiment)
    assert build_denoiser(experiment, network).kind == experiment.diffusion.kind
    sensor = build_sensor(experiment)
    assert (sensor.height, sensor.width) == (experiment.data.height, experiment.data.width)
    assert experiment.training.steps > experiment.training.warmup


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("r2dm-a", 31_082_370),
        ("r2dm-e", 31_082_370),
        ("r2dm-f", 31_081_218),
        ("r2dm-g", 31_095_618),
        ("r2dm-h", 31_099_650),
        ("r2dm-kitti-raw", 31_098_498),
    ],
)
def test_presets_of_the_paper_have_its_parameter_counts(name, count):
    with torch.device("meta"):
        assert sum(p.numel() for p in build_network(preset(name)).parameters()) == count


def test_rows_of_table_ii_differ_in_what_the_table_says():
    rows = {name[-1]: preset(name) for name in PRESETS if name.startswith("r2dm-") and len(name) == 6}
    assert "".join(sorted(rows)) == "abcdefgh"
    assert [rows[r].diffusion.loss for r in "abcdefgh"] == ["l2", "l1", "huber", "l2", "l2", "l2", "l2", "l2"]
    assert [rows[r].data.codec for r in "abcdefgh"] == ["log", "log", "log", "metric", "inverse", "log", "log", "log"]
    encodings = [rows[r].model.coords_encoding for r in "abcdefgh"]
    assert encodings == ["polar_coordinates"] * 5 + [None, "spherical_harmonics", "fourier_features"]
    assert {rows[r].training for r in rows} == {Training()}


def test_the_shipped_model_fits_its_60_mb():
    with torch.device("meta"):
        network = build_network(preset("default"))
    in_bytes = sum(p.numel() for name, p in network.named_parameters() if name.startswith("coarse."))
    assert sum(p.numel() for p in network.parameters()) * 2 - in_bytes < 60e6
    assert (SHIPPED / "default" / WEIGHTS).stat().st_size < 60e6


def test_experiments_are_frozen_and_fields_are_replaced_by_name():
    experiment = with_fields(preset("tiny"), {"training.steps": 7, "model.stem": [2, 4], "model.temb_channels": 64})
    assert (experiment.training.steps, experiment.model.stem, experiment.model.temb_channels) == (7, (2, 4), 64)
    assert with_fields(preset("tiny"), {}) == preset("tiny")
    with pytest.raises(FrozenInstanceError):
        experiment.name = "other"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"training.steps": "7"}, "training.steps: expected int, found '7'"),
        ({"training.steps": True}, "training.steps: expected int, found True"),
        ({"training.learning_rate": "fast"}, "training.learning_rate: expected float, found 'fast'"),
        ({"model.stem": (1, 2, 3)}, r"model.stem: expected tuple\[int, int\], found \(1, 2, 3\)"),
        ({"model.channel_multipliers": (1, 2.5)}, r"model.channel_multipliers: expected tuple\[int, \.\.\.\], found"),
        ({"model.ring": 1}, "model.ring: expected bool, found 1"),
        ({"data.sensor": 64}, r"data.sensor: expected str \| dict, found 64"),
        ({"steps": 7}, "expected an experiment field such as training.steps, found 'steps'"),
        ({"training": 7}, "expected an experiment field such as training.steps, found 'training'"),
        ({"training.step": 7}, "found 'training.step'"),
        ({"name.x": 7}, "found 'name.x'"),
        ({"__class__.x": 7}, "found '__class__.x'"),
    ],
)
def test_fields_that_do_not_fit_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        with_fields(preset("tiny"), changes)


@pytest.mark.parametrize(
    ("record", "message"),
    [
        ([], r"experiment: expected a table of \['name', .*\], found \[\]"),
        ({}, r"experiment: expected the field name, found \[\]"),
        ({"name": "x", "steps": 1}, r"experiment: expected the fields .*, found \['steps'\]"),
        ({"name": "x", "data": {"with": 1}}, r"experiment.data: expected the fields .*, found \['with'\]"),
        ({"name": "x", "data": 3}, r"experiment.data: expected a table of .*, found 3"),
        ({"name": "x", "training": {"betas": [0.9]}}, r"experiment.training.betas: expected tuple\[float, float\]"),
        ({"name": 3}, r"experiment.name: expected str, found 3"),
    ],
)
def test_records_that_do_not_fit_are_refused_by_name(record, message):
    with pytest.raises(ValueError, match=message):
        from_dict(record)


def test_absent_fields_have_their_defaults():
    assert from_dict({"name": "r2dm-h"}) == preset("r2dm-h")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"model.network": "resnet"},
            "model.network: expected one of .*efficient-unet, .*, found 'resnet'",
        ),
        ({"diffusion.schedule": "sine"}, "diffusion.schedule: expected one of cosine, .*, found 'sine'"),
        ({"diffusion.kind": "noise"}, "kind must be one of eps, .*, got 'noise'"),
        ({"data.sensor": "hdl-65e"}, "expected a sensor of hdl-64e, .*, found 'hdl-65e'"),
        ({"data.height": 24}, "height must divide its 64 beams, got 24"),
        ({"data.width": 60}, "width must be divisible by 8"),
        ({"model.coords_encoding": "fourier"}, "coords_encoding must be one of"),
    ],
)
def test_experiments_that_cannot_be_built_say_why(changes, message):
    experiment = with_fields(preset("tiny"), changes)
    with pytest.raises(ValueError, match=message):
        build_denoiser(experiment, build_network(experiment))


@pytest.mark.parametrize(
    ("word", "changes", "message"),
    [
        ("r2dm-h", {"model.channel_multipliers": [1]}, r"model.channel_multipliers: expected 4 .*, found \[1\]"),
        ("r2dm-h", {"model.num_residual_blocks": [0, 0, 0, 0]}, "model.num_residual_blocks: expected 4 .*, found"),
        (
            "r2dm-h",
            {"model.base_channels": 12},
            r"model.gn_num_groups must divide all level widths \[12, 12, 24, .*\], got 8",
        ),
        ("r2dm-h", {"model.attn_num_heads": 7}, "model.attn_num_heads: expected a divisor of 256, 512 .*, found 7"),
        ("r2dm-h", {"model.stem": [1, 3]}, "divisible by 24, .*: expected 1008 or 1032, found 1024"),
        ("kitti-streets", {"model.base_channels": 2, "model.gn_num_groups": 2}, "base_channels: expected an even"),
        ("lidargen", {"model.base_channels": 1}, "model.base_channels: expected at least 2 for refinenet, found 1"),
        ("lidargen", {"score.sigma_min": 0}, "score.sigma_min, score.sigma_max: expected .*, found 0 and 50"),
        ("lidargen", {"score.sigma_max": 0.4}, "score.sigma_min, score.sigma_max: expected .*, found 0.01 and 0.4"),
        ("lidargen", {"data.width": 1023}, "refinenet: expected images of an even number .*, found 64 x 1023"),
        ("r2dm-refinenet", {"data.height": 4}, "refinenet: expected images .*, 8 at least, found 4 x 1024"),
        ("dusty-v1", {"data.width": 16}, "dusty-v1: expected images whose sides .*, found 64 x 16"),
        ("dusty-v2", {"data.width": 40}, "dusty-v2: expected images whose sides .*, found 64 x 40"),
        ("lidar-sr", {"upsampling.factor": [1, 1]}, r"upsampling.factor: expected .*, found \[1, 1\]"),
        ("lidar-sr", {"upsampling.factor": [3, 1]}, r"upsampling.factor: expected .*, found \[3, 1\]"),
        ("lidar-sr", {"upsampling.factor": [64, 1], "data.height": 32}, "64 rows and of 16 columns, found 32 x 1024"),
        ("iln", {"model.attn_num_heads": 5}, "model.attn_num_heads: expected a divisor of 64 channels, found 5"),
        ("default", {"model.base_channels": 8}, "model.base_channels: expected a multiple of 16, found 8"),
        ("default", {"model.column_channels": 33}, "model.column_channels: expected a multiple of 4, found 33"),
        ("default", {"model.guide_channels": 9}, "model.guide_channels: expected a multiple of 8, found 9"),
        ("default", {"model.judge_channels": 1}, "model.judge_channels: expected a multiple of 8, found 1"),
        ("default", {"model.classes": 5}, "model.classes: expected 0 or 20, found 5"),
    ],
)
def test_numbers_that_networks_cannot_be_built_of_are_refused_by_their_fields(word, changes, message):
    experiment = with_fields(preset(word), changes)
    with torch.device("meta"), pytest.raises(ValueError, match=message):
        build_network(experiment)


# ---------------------------------------------------------------- folders


@pytest.mark.parametrize("half", [False, True])
def test_a_saved_model_loads_as_it_was(tmp_path, half):
    experiment = replace(preset("tiny"), data=Data(sensor=get_sensor("vlp-16").to_dict(), height=16, width=64))
    network = trained(experiment)
    folder = save(tmp_path / "deep" / "model", experiment, network, half)
    assert sorted(p.name for p in folder.iterdir()) == ["experiment.json", "model.safetensors"]
    assert read_experiment(folder) == experiment
    again, loaded = load(str(folder))
    assert again == experiment and not loaded.training
    buffers = {name for name, _ in network.named_buffers()}
    assert "unet.coords" in buffers
    for name, value in network.state_dict().items():
        tolerance = 1e-3 if half and name not in buffers else 0
        torch.testing.assert_close(loaded.state_dict()[name], value, rtol=tolerance, atol=tolerance * 0.01)
    size = (folder / "model.safetensors").stat().st_size
    save(folder, experiment, network, not half)
    assert (folder / "model.safetensors").stat().st_size != size, "saving again replaces"
    with pytest.raises(ValueError, match=r"model.safetensors: expected a folder to write to, found a file"):
        save(folder / "model.safetensors", experiment, network)


def test_matrices_in_eight_bits_are_off_by_little_and_take_half_of_the_place(tmp_path):
    experiment = with_fields(preset("tiny"), {"model.base_channels": 32})
    network = trained(experiment)
    sizes = []
    for bytewise in ((), ("unet.",)):
        folder = save(tmp_path / f"bits {len(bytewise)}", experiment, network, half=True, bytewise=bytewise)
        sizes.append((folder / "model.safetensors").stat().st_size)
    assert 0.5 < sizes[1] / sizes[0] < 0.75
    loaded, stored = load(folder)[1].state_dict(), load_file(folder / "model.safetensors")
    off = 0
    for name, value in network.state_dict().items():
        if stored[name].dtype != torch.int8:
            torch.testing.assert_close(loaded[name], value, rtol=1e-3, atol=1e-5)
            continue
        assert stored[name + SCALE].dtype == torch.float32 and value.ndim > 1
        largest = value.flatten(1).abs().amax(1).view(-1, *(1,) * (value.ndim - 1))
        assert ((loaded[name] - value).abs() <= largest / 253).all()
        off += int((loaded[name] != value).sum())
    assert off > 1000


def test_a_tuned_model_has_a_fill_as_deep_as_it_was_saved_with():
    blocks = {name: load(SHIPPED / name)[1].surest for name in ("default", "kitti")}
    counts = {name: [len(stage) for stage in list(fill.down)[::2]] for name, fill in blocks.items()}
    assert counts == {"default": [1, 2, 6, 6], "kitti": [1, 1, 2, 2]}
    assert read_experiment(SHIPPED / "kitti").model.likeliest_blocks == (1, 1, 2, 2)
    assert preset("tuned").model.likeliest_blocks == read_experiment(SHIPPED / "default").model.likeliest_blocks
    with pytest.raises(ValueError, match=r"model.likeliest_blocks: expected four numbers, found \(1, 2, 3\)"):
        build_network(with_fields(preset("default"), {"model.likeliest_blocks": (1, 2, 3)}))


def test_scales_that_do_not_fit_are_no_tensors_of_the_network(tmp_path):
    experiment = with_fields(preset("tiny"), {"model.base_channels": 32})
    folder = save(tmp_path, experiment, trained(experiment), half=True, bytewise=("unet.",))
    stored = load_file(folder / "model.safetensors")
    name = next(name for name in stored if name.endswith(SCALE))
    save_file({**stored, name: stored[name][:-1].clone()}, folder / "model.safetensors")
    with pytest.raises(ValueError, match=rf"expected {re.escape(name)} not to be there"):
        load(folder)


def test_the_ray_angles_of_the_sensor_are_in_the_network():
    experiment = preset("tiny")
    angles = torch.from_numpy(build_sensor(experiment).ray_angles())[None]
    torch.testing.assert_close(build_network(experiment).get_buffer("unet.coords"), angles, rtol=0, atol=0)


def test_folders_that_are_no_models_get_one_line(tmp_path):
    experiment, good = preset("tiny"), tmp_path / "good"
    save(good, experiment, trained(experiment))
    weights, record = (good / "model.safetensors").read_bytes(), (good / "experiment.json").read_text()
    other = json.dumps(with_fields(experiment, {"model.base_channels": 16}).to_dict())
    deeper = json.dumps(with_fields(experiment, {"model.num_residual_blocks": (2, 1, 1, 1)}).to_dict())
    cases = {
        "no record": (
            None,
            weights,
            "expected a model folder with model.safetensors and experiment.json, found no exp",
        ),
        "no weights": (record, None, "expected model.safetensors beside experiment.json, found none"),
        "bad json": (record[:-5], weights, r"experiment.json: expected JSON, found"),
        "other json": ("[1]", weights, r"experiment.json: expected a table of"),
        "nameless": ("{}", weights, r"experiment.json: expected the field name"),
        "truncated": (record, weights[:-100], r"model.safetensors: expected safetensors weights, found"),
        "empty": (record, b"", r"model.safetensors: expected safetensors weights, found"),
        "wider": (other, weights, r"model.safetensors: expected \S+ \(.*\), found \("),
        "deeper": (deeper, weights, r"expected \S+ .*, found .*; \d+ tensors do not fit ConditionalUNet"),
    }
    for name, (json_text, content, message) in cases.items():
        folder = tmp_path / name
        folder.mkdir()
        if json_text is not None:
            (folder / "experiment.json").write_text(json_text)
        if content is not None:
            (folder / "model.safetensors").write_bytes(content)
        with pytest.raises(ValueError, match=message) as caught:
            load(folder)
        assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(ValueError, match=r"experiment.json: expected .*, found"):
        load(good / "experiment.json")


def test_a_failed_save_leaves_the_old_model(tmp_path, monkeypatch):
    experiment, network = preset("tiny"), trained(preset("tiny"))
    folder = save(tmp_path, experiment, network)
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    monkeypatch.setattr("lidarsynth.experiment.folder.json.dumps", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        save(tmp_path, experiment, trained(experiment, seed=1))
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before


@pytest.mark.parametrize(
    ("word", "source"),
    [
        ("r2dm-kitti-raw", "kitti-r2dm"),
        *((word, "kitti-dusty") for word in ("vanilla-gan", "dusty-v1", "dusty-v2")),
        ("lidargen", "kitti360-lidargen"),
    ],
)
def test_presets_of_published_systems_learn_from_the_images_of_their_programs(word: str, source: str):
    from lidarsynth.data.sources import SOURCES

    data, own = preset(word).data, SOURCES[source]
    assert (data.sensor, data.projection, data.width) == (own.sensor, own.projection, own.width)
    assert own.resizing == ("nearest" if source == "kitti-dusty" else "nearest-exact")


@pytest.mark.parametrize(
    ("word", "fixture", "key"),
    [
        ("hdl-64e-r2dm", "r2dm/unfolding_angles", "kitti_raw.elevation_rad"),
        ("hdl-64e-dusty", "gan_coords", "table_elevation_64"),
    ],
)
def test_mean_beams_are_those_of_the_published_tables(fixture_tensors, word: str, fixture: str, key: str):
    published = np.degrees(fixture_tensors(fixture)[key].double().numpy())
    np.testing.assert_allclose(get_sensor(word).elevations, published, atol=1e-5)
    assert word not in SENSORS, "what is in SENSORS is recognised, and streets are drawn of it"
