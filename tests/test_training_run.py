"""Runs in a folder: exact continuation after kill -9 and SIGTERM, several processes, checkpoints, fine-tuning."""

import csv
import json
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from forked import Forked, pair
from networks import tiny_cascade
from safetensors.torch import load_file

import lidarsynth as ls
from lidarsynth.cli.main import main
from lidarsynth.data.dataset import CachedImages, write_cache
from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import Card, Experiment, with_fields
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.systems.model_card import card_text
from lidarsynth.systems.table import build_network, task_of, transfer
from lidarsynth.systems.table import load_folder as load
from lidarsynth.training import monitor
from lidarsynth.training.checkpoint import checkpoints
from lidarsynth.training.options import Options
from lidarsynth.verbs import training as training_verb
from lidarsynth.verbs.description import describe
from lidarsynth.verbs.training import resolve, run
from lidarsynth.verbs.training_start import Start, check_start
from lidarsynth.weights.load import load_parts

SENSOR = SENSORS["hdl-64e-kitti"].resized(16, 64)
QUIET = Options(sample_every=0, workers=0)
STEPS = 20  # of the killed run


def noise_image(i: int, sensor: Sensor = SENSOR) -> RangeImage:
    """Random ranges and reflectances, a tenth of the pixels empty."""
    rng, shape = np.random.default_rng(i), (sensor.height, sensor.width)
    mask = rng.random(shape) < 0.9
    distance = rng.uniform(2, 60, shape).astype(np.float32)
    return RangeImage(distance * mask, (rng.random(shape) * mask).astype(np.float32), mask, sensor)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("training") / "cache"
    list(write_cache(folder, noise_image, 24, SENSOR, {"name": "noise"}))
    return folder


def tiny(steps: int, **changes) -> Experiment:
    return with_fields(preset("tiny"), {"training.steps": steps, **changes})


def table(out: Path) -> list[dict[str, str]]:
    with (out / "losses.csv").open() as file:
        return list(csv.DictReader(file))


def command(cache: Path, out: Path, *more: str) -> list[str]:
    words = ["train", "tiny", "--data", str(cache), "--out", str(out), "--sample-every", "0", "--threads", "1"]
    return [*words, *more]


def started(cache: Path, out: Path, rows: int, *more: str) -> Forked:
    """A training process that has done at least `rows` steps."""
    process = Forked(*command(cache, out, *more))
    until = time.monotonic() + 120
    while not ((out / "losses.csv").exists() and len(table(out)) >= rows):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until
        time.sleep(0.02)
    return process


@pytest.mark.timeout(300)
def test_killed_and_stopped_a_run_continues_bit_by_bit(cache: Path, tmp_path: Path):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    list(run(tiny(STEPS), cache, whole, options=QUIET))
    more = ("--set", f"training.steps={STEPS}", "--save-every", "2")
    killed = started(cache, broken, random.randint(3, 5), *more)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    (kept, *_), done = reversed(checkpoints(broken)), len(table(broken))
    assert killed.returncode == -signal.SIGKILL and 2 <= int(kept.name[5:]) <= done < STEPS
    stopped = started(cache, broken, done + random.randint(1, 3), *more, "--resume")
    stopped.send_signal(signal.SIGTERM)
    output, errors = stopped.communicate(timeout=60)
    assert stopped.returncode == 0, errors
    assert "stopped after step" in output and f"stopped after step {len(table(broken))};" in output
    list(run(tiny(STEPS), cache, broken, options=QUIET))
    assert (broken / "losses.csv").read_bytes() == (whole / "losses.csv").read_bytes()
    assert (broken / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()
    assert not list(broken.rglob(".saving-*"))


@pytest.mark.timeout(300)
def test_two_processes_give_the_curve_of_one(cache: Path, tmp_path: Path):
    experiment = tiny(4, **{"diffusion.mean_weight": True})
    list(run(experiment, cache, tmp_path / "one", options=QUIET))
    more = ("--set", "training.steps=4", "diffusion.mean_weight=true", "--workers", "0")
    ends = pair(*command(cache, tmp_path / "two", *more))
    assert [code for code, _, _ in ends] == [0, 0], ends
    assert "wrote" in ends[0][1] and not ends[1][1], "only the first process speaks"
    for column in ("loss", "grad_norm"):
        one, two = ([float(row[column]) for row in table(tmp_path / name)] for name in ("one", "two"))
        np.testing.assert_allclose(two, one, rtol=1e-4)
    assert load(tmp_path / "two")[0].card.history == ("4 steps of 4 on 2 x cpu",)
    ours, theirs = (load_file(tmp_path / name / "model.safetensors") for name in ("one", "two"))
    torch.testing.assert_close(theirs, ours, rtol=1e-3, atol=1e-4)


def test_a_run_can_be_extended(cache: Path, tmp_path: Path):
    """More steps go on from the last checkpoint; fewer than are done, or any other change, are another run."""
    out = tmp_path / "run"
    list(run(tiny(2), cache, out, options=QUIET))
    steps = [progress.step for progress in run(tiny(3), cache, out, options=QUIET)]
    assert steps == [2, 3] and len(table(out)) == 3
    experiment, _ = load(out)
    assert experiment.training.steps == 3 and experiment.card.history == ("3 steps of 4 on 1 x cpu",)
    with pytest.raises(ValueError, match=r"run: expected training.steps of at least 3, which are done, found 2"):
        list(run(tiny(2), cache, out, options=QUIET))
    with pytest.raises(ValueError, match=r"expected its own run, with training.learning_rate"):
        list(run(tiny(8, **{"training.learning_rate": 0.5}), cache, out, options=QUIET))


def test_a_run_on_scans_of_a_sensor_with_blocked_rays_goes_on(tmp_path: Path):
    own = Sensor("mine", tuple(np.linspace(10, -20, 16)), width=64, max_range=60.0, blocked=((15, 10, 30), (14, 60, 2)))
    list(write_cache(tmp_path / "own", lambda i: noise_image(i, own), 4, own, {"name": "noise"}))
    out = tmp_path / "run"
    for steps, done in ((1, [0, 1]), (2, [1, 2])):
        experiment = resolve("tiny", (f"training.steps={steps}", "training.batch_size=2"), data=tmp_path / "own")
        assert [progress.step for progress in run(experiment, tmp_path / "own", out, options=QUIET)] == done
    other = with_fields(experiment, {"data.sensor": {**experiment.data.sensor, "blocked": [[15, 10, 31]]}})
    own = r"its own run, with data.sensor.blocked = \[\[15, 10, 30\], .*found \[\[15, 10, 31\]\]"
    with pytest.raises(ValueError, match=own):
        list(run(other, tmp_path / "own", out, options=QUIET))
    word = with_fields(experiment, {"data.sensor": "vlp-16"})
    with pytest.raises(ValueError, match=r"its own run, with data.sensor = 'mine', found 'vlp-16'"):
        list(run(word, tmp_path / "own", out, options=QUIET))


def test_a_run_goes_on_with_its_own_images(cache: Path, tmp_path: Path):
    """Wherever their folder lies now; as many of the same name, but other ones, are other data."""
    out, moved, twin, few = (tmp_path / name for name in ("run", "moved", "twin", "few"))
    shutil.copytree(cache, moved)
    list(write_cache(twin, lambda i: noise_image(100 + i), 24, SENSOR, {"name": "noise"}))
    list(write_cache(few, noise_image, 12, SENSOR, {"name": "few"}))
    list(run(tiny(2), cache, out, options=QUIET))
    assert [progress.step for progress in run(tiny(3), moved, out, options=QUIET)] == [2, 3]
    own = r"run: expected its own run, which learns from 24 images of noise"
    for data, found in (
        (twin, "24 images of noise"),
        (few, "12 images of few"),
        ("synthetic", "endless images of syn"),
    ):
        with pytest.raises(ValueError, match=rf"{own}.*, found {found}.*; another folder begins a new run"):
            list(run(tiny(4), data, out, options=QUIET))
    with pytest.raises(ValueError, match="36 images of several caches"):
        list(run(tiny(4), f"{cache},{few}", out, options=QUIET))
    (out / "start.json").unlink()  # as of a run from before there was one
    with pytest.raises(ValueError, match=rf"{own}, found 12 images of few; another folder"):
        list(run(tiny(4), few, out, options=QUIET))
    assert [progress.step for progress in run(tiny(4), cache, out, options=QUIET)] == [3, 4]
    (out / "start.json").write_text("[]")
    with pytest.raises(ValueError, match=r"start.json: expected what a run began with, found another table"):
        list(run(tiny(5), cache, out, options=QUIET))


def test_a_run_goes_on_from_no_other_weights(cache: Path, tmp_path: Path):
    first, plain, tuned = (tmp_path / name for name in ("first", "plain", "tuned"))
    for out, weights in ((first, None), (plain, None), (tuned, str(first))):
        list(run(tiny(1), cache, out, weights, options=QUIET))
    for weights in (None, str(first)):
        assert [p.step for p in run(tiny(1), cache, tuned, weights, options=QUIET)] == [1], "the same command goes on"
    for out, begun in ((tuned, first), (plain, "no weights")):
        with pytest.raises(ValueError, match=rf"its own run, begun from {begun}, found --from nowhere; leave it away"):
            list(run(tiny(2), cache, out, "nowhere", options=QUIET))
    (tuned / "start.json").unlink()
    (progress,) = run(tiny(1), cache, tuned, "nowhere", options=QUIET)
    assert progress.note == f"--from nowhere is not used: the run in {tuned} goes on"


def test_a_run_on_several_caches_says_so(cache: Path, tmp_path: Path):
    few = tmp_path / "few"
    list(write_cache(few, lambda i: noise_image(100 + i), 3, SENSOR, {"name": "few"}))
    list(
        run(
            resolve("tiny", ("training.steps=2",), data=f"{cache},{few}"),
            f"{cache},{few}",
            tmp_path / "run",
            options=QUIET,
        )
    )
    assert load(tmp_path / "run")[0].card.data == "27 images of several caches (24 of noise and 3 of few)"
    assert load(tmp_path / "run")[0].card.sensor == SENSOR.name and not load(tmp_path / "run")[0].card.synthetic
    with pytest.raises(ValueError, match="nowhere"):
        list(run(tiny(2), f"{cache},nowhere", tmp_path / "other", options=QUIET))


def test_a_run_that_counted_scans_as_often_as_they_are_shown_goes_on(cache: Path, tmp_path: Path):
    """A cache that is named twice counts once too; runs from before that go on with the same images."""
    few, out, start = tmp_path / "few", tmp_path / "run", tmp_path / "run" / "start.json"
    list(write_cache(few, lambda i: noise_image(100 + i), 3, SENSOR, {"name": "few"}))
    data = f"{few},{cache},{few}"
    list(run(tiny(1), data, out, options=QUIET))
    told = "27 images of several caches (3 of few (2 x) and 24 of noise)"
    assert told in start.read_text() and load(out)[0].card.data == told
    start.write_text(
        start.read_text().replace(told, "72 images of several caches (3 of few and 24 of noise and 3 of few)")
    )
    assert [progress.step for progress in run(tiny(2), data, out, options=QUIET)] == [1, 2]
    with pytest.raises(ValueError, match="its own run, which learns from 72 images of several"):
        list(run(tiny(3), f"{few},{cache}", out, options=QUIET))
    assert check_start(tmp_path, Start("27 images of several caches (24 of a and 3 of b)"),
                       Card(data="48 images of several caches (24 of a and 3 of b)")) == ""  # fmt: skip
    with pytest.raises(ValueError, match="its own run"):
        check_start(tmp_path, Start("27 images of a"), Card(data="48 images of a"))


def test_info_tells_how_far_a_stopped_run_came(cache: Path, tmp_path: Path):
    steps = run(tiny(5), cache, tmp_path, options=Options(save_every=2, sample_every=0, workers=0))
    for progress in steps:
        if progress.step == 3:
            break
    steps.close()  # killed: the checkpoint of step 2 is the newest
    assert "stopped at 2 of 5 steps of 4" in describe(str(tmp_path))
    assert "stopped at 2 of 5 steps of 4" in card_text(load(tmp_path)[0], ls.load(tmp_path).description)
    list(run(tiny(5), cache, tmp_path, options=QUIET))
    assert "stopped" not in describe(str(tmp_path)) and " 5 steps of 4" in describe(str(tmp_path))
    record = json.loads((tmp_path / "experiment.json").read_text())
    del record["card"]["steps"]  # as of a run from before it was told
    (tmp_path / "experiment.json").write_text(json.dumps(record))
    assert "stopped" not in describe(str(tmp_path)) and " 5 steps of 4" in describe(str(tmp_path))


def test_a_run_s_folder_loads_and_keeps_the_last_checkpoints(cache: Path, tmp_path: Path):
    options = Options(save_every=1, keep=2, log_every=2, sample_every=4, workers=0)
    steps = [p.step for p in run(tiny(4), cache, tmp_path, options=options)]
    assert steps == list(range(5))
    assert [folder.name for folder in checkpoints(tmp_path)] == ["step-00000003", "step-00000004"]
    assert (tmp_path / "checkpoints" / "latest").resolve() == checkpoints(tmp_path)[-1].resolve()
    for folder in (tmp_path, tmp_path / "checkpoints" / "latest"):
        experiment, network = load(folder)
        assert experiment.training.steps == 4 and experiment.card.history == ("4 steps of 4 on 1 x cpu",)
        torch.testing.assert_close(network.state_dict(), load(tmp_path)[1].state_dict())
    assert len(list((tmp_path / "pictures").glob("sample-00000004-*.png"))) == 2
    assert list((tmp_path / "tensorboard").iterdir())
    assert [p.step for p in run(tiny(4), cache, tmp_path, options=options)] == [4], "a finished run has nothing to do"


def test_tensorboard_holds_losses_speed_validation_and_pictures(cache: Path, tmp_path: Path):
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    options = Options(log_every=1, sample_every=2, workers=0)
    list(run(tiny(2), cache, tmp_path, options=options, validation=cache))
    board = events.EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    curves = set(board.Tags()["scalars"])
    assert {"train/loss", "train/grad_norm", "speed/samples_per_second", "speed/waiting_share"} <= curves
    assert {"validation/t_0.1", "validation/t_0.9", "validation/completion"} <= curves
    assert set(board.Tags()["images"]) == {"sample/0", "sample/1"}
    rows = [float(row["loss"]) for row in table(tmp_path)]
    assert [e.step for e in board.Scalars("train/loss")] == [1, 2]
    assert board.Scalars("train/loss")[1].value == pytest.approx(rows[1])


def test_numbers_of_held_out_images_are_in_a_table_and_printed_and_change_nothing_learned(
    cache: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    looking, whole = Options(sample_every=2, save_every=2, workers=0), tmp_path / "whole"
    (last, *_) = reversed(list(run(tiny(4), cache, whole, options=looking, validation=cache)))
    with (whole / "judged.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["step"] for row in rows} == {"2", "4"}
    assert last.judged == {row["number"]: float(row["value"]) for row in rows if row["step"] == "4"}
    assert {"validation/t_0.1", "validation/completion"} <= last.judged.keys()
    list(run(tiny(4), cache, tmp_path / "blind", options=QUIET))
    assert not (tmp_path / "blind" / "judged.csv").exists()
    assert (tmp_path / "blind" / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()
    halves = tmp_path / "halves"
    list(run(tiny(2), cache, halves, options=looking, validation=cache))
    with (halves / "judged.csv").open("a") as file:
        file.write("3,validation/completion,0.5\n")  # of a run that was killed after its checkpoint
    words = command(cache, halves, "--set", "training.steps=4", "--workers", "0", "--validation", str(cache))
    main([*words, "--sample-every", "2"])
    assert (halves / "judged.csv").read_bytes() == (whole / "judged.csv").read_bytes()
    told = f"validation/t_0.1 {last.judged['validation/t_0.1']:.4g}, "
    assert f"lidarsynth: after step 4: {told}" in capsys.readouterr().err


def test_a_run_refuses_what_does_not_fit(cache: Path, tmp_path: Path):
    with pytest.raises(ValueError, match="expected a run to resume, found no checkpoint"):
        list(run(tiny(2), cache, tmp_path, options=QUIET, resume=True))
    with pytest.raises(ValueError, match="expected images of 32 x 64, found 16 x 64"):
        list(run(tiny(2, **{"data.height": 32}), cache, tmp_path, options=QUIET))
    list(run(tiny(2), cache, tmp_path, options=QUIET))
    with pytest.raises(ValueError, match=r"with training.batch_size = 4, found 2"):
        list(run(tiny(2, **{"training.batch_size": 2}), cache, tmp_path, options=QUIET))
    (checkpoints(tmp_path)[-1] / "checksums.json").unlink()  # as of a run from before there were any
    (checkpoints(tmp_path)[-1] / "state.pt").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"state.pt: expected a training state"):
        list(run(tiny(2), cache, tmp_path, options=QUIET))


def test_a_diverging_run_names_its_last_checkpoint(cache: Path, tmp_path: Path):
    experiment = tiny(60, **{"training.learning_rate": 1e30, "training.warmup": 3})
    with pytest.raises(
        FloatingPointError, match=r"step 3: .* scans noise/\d+, .*; last good checkpoint: .*step-00000002$"
    ):
        list(run(experiment, cache, tmp_path, options=Options(sample_every=0, save_every=1, workers=0)))
    for folder in checkpoints(tmp_path):
        assert all(bool(p.isfinite().all()) for p in load(folder)[1].parameters())


def test_resolve_takes_the_sensor_of_the_images(cache: Path, tmp_path: Path):
    assert resolve("tiny", data=cache) == preset("tiny")
    own = Sensor("mine", tuple(np.linspace(10, -20, 32)), width=128, max_range=60.0)
    list(write_cache(tmp_path / "own", lambda i: noise_image(i, own), 4, own, {"name": "noise"}))
    data = resolve("tiny", ("training.steps=5",), data=tmp_path / "own").data
    assert (data.height, data.width) == (32, 128) and isinstance(data.sensor, dict) and data.sensor["name"] == "mine"
    with pytest.raises(ValueError, match="expected images of 16 x 64, found 32 x 128"):
        resolve("tiny", ("data.height=16",), data=tmp_path / "own")
    sized = resolve("tiny", ("data.height=32", "data.width=128"), data=tmp_path / "own").data
    assert sized == data, "a size that fits is no choice of a sensor either"
    turned = resolve("tiny", ("data.roll=true",), data=tmp_path / "own").data
    assert turned.roll and turned.height == 32, "an augmentation is no choice of a sensor"
    with pytest.raises(ValueError, match=r"expected group\.field=value"):
        resolve("tiny", ("steps",))
    with pytest.raises(ValueError, match="no_such"):
        resolve("tiny", ("training.no_such=1",))
    for word, knows in (("tiny", "true"), ("tiny-gan", "false")):  # trained as before, and the record said otherwise
        assert resolve(word, (f"data.reflectance={knows}",)) == preset(word)
        other = "false" if knows == "true" else "true"
        with pytest.raises(ValueError, match=f"data.reflectance: expected {knows}, .* of {word} .*, found {other}"):
            resolve(word, (f"data.reflectance={other}",))


@pytest.mark.parametrize(
    ("preset_word", "drawn", "expected"),
    [("tiny", "spherical", "spherical"), ("tiny", "unfolding", "auto"), ("r2dm-h", "auto", "auto")],
)
def test_resolve_takes_the_projection_of_the_images(tmp_path: Path, preset_word: str, drawn: str, expected: str):
    list(write_cache(tmp_path, noise_image, 2, SENSOR, {"name": "noise", "projection": drawn}))
    assert resolve(preset_word, data=tmp_path).data.projection == expected
    assert resolve(preset_word, ("data.projection=unfolding",), data=tmp_path).data.projection == "unfolding"


def filled(experiment: Experiment, seed: int = 0):
    torch.manual_seed(seed)
    network = build_network(experiment)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return network


def output(network, shape: tuple[int, int]) -> torch.Tensor:
    x_t = torch.randn(1, 2, *shape, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        return network(x_t, torch.tensor([0.3]))


def test_fine_tuning_may_add_and_drop_the_known_pixels():
    told = preset("tiny")
    untold = with_fields(told, {"model.network": "efficient-unet"})
    for source, target in ((told, told), (told, untold), (untold, told), (untold, untold)):
        trained, network = filled(source), filled(target, seed=1)
        transfer(network, target, trained, source, "weights")
        torch.testing.assert_close(output(network, (16, 64)), output(trained, (16, 64)))


def test_fine_tuning_may_change_sensor_and_resolution():
    source = preset("tiny")
    target = with_fields(source, {"data.sensor": "hdl-32e", "data.height": 32, "data.width": 128})
    trained, network = filled(source), filled(target, seed=1)
    angles = dict(network.named_buffers())["unet.coords"].clone()
    transfer(network, target, trained, source, "weights")
    torch.testing.assert_close(dict(network.named_buffers())["unet.coords"], angles)
    # two new frequencies of the position encoding: the old ones keep their weights, the new ones start at zero
    old, new = trained.state_dict()["unet.in_conv.weight"], network.state_dict()["unet.in_conv.weight"]
    assert (old.shape[1], new.shape[1]) == (8 + 2 * (4 + 6), 8 + 2 * (5 + 7))
    torch.testing.assert_close(new[:, :8], old[:, :8])
    sines, cosines = [8, 9, 10, 11, 13, 14, 15, 16, 17, 18], [20, 21, 22, 23, 25, 26, 27, 28, 29, 30]
    torch.testing.assert_close(new[:, sines + cosines], old[:, 8:])
    assert not new[:, [12, 19, 24, 31]].any()
    assert output(network, (32, 128)).isfinite().all()


def test_fine_tuning_refuses_other_networks_and_meanings():
    source = preset("tiny")
    target = with_fields(source, {"model.base_channels": 16, "diffusion.kind": "eps", "data.codec": "metric"})
    with pytest.raises(ValueError) as refusal:
        transfer(build_network(target), target, build_network(source), source, "there.safetensors")
    assert "--set model.base_channels=8 data.codec=log diffusion.kind=x_0" in str(refusal.value)
    assert "found model.base_channels=16, data.codec=metric, diffusion.kind=eps" in str(refusal.value)


def test_a_refinenet_and_a_unet_start_from_neither():
    """All fields that count are alike: nothing but the network differs, and no tensor of one is in the other."""
    alike = {"model.base_channels": 16, "model.attn_num_heads": 8}
    both = [with_fields(preset(word), alike) for word in ("r2dm-h", "r2dm-refinenet")]
    for one, other in (both, both[::-1]):
        with pytest.raises(ValueError, match=f"^x: expected weights of {one.model.network}, found those of "):
            transfer(filled(one), one, filled(other), other, "x")


def test_from_weights_starts_there_and_keeps_their_history(cache: Path, tmp_path: Path):
    list(run(tiny(2), cache, tmp_path / "first", options=QUIET))
    experiment = tiny(1, **{"training.warmup": 1})  # one step at rate 0
    list(run(experiment, cache, tmp_path / "second", str(tmp_path / "first"), options=QUIET))
    found, network = load(tmp_path / "second")
    torch.testing.assert_close(network.state_dict(), load(tmp_path / "first")[1].state_dict())
    assert found.card.history == ("2 steps of 4 on 1 x cpu", "from tiny", "1 steps of 4 on 1 x cpu")
    assert found.card.data == "24 images of noise, then 24 images of noise"


def test_a_run_from_shipped_weights_says_what_these_learned_from_and_under_which_terms(cache: Path, tmp_path: Path):
    streets = tmp_path / "streets"
    list(write_cache(streets, noise_image, 3, SENSOR, {"name": "synthetic", "seed": 3}))
    own = "for what was learned from the scans, their own terms; for the rest, "
    for word in ("default", "kitti"):
        source = load_parts(word)[0]
        licence = source.card.licence
        for data, terms in ((cache, own + licence), (f"{streets},{cache}", own + licence), (streets, licence),
                            ("virtual", licence)):  # fmt: skip
            card = training_verb._gone_on(source, word, Card(data="4 images of files, split all"), data)
            assert card.data == f"what `{word}` learned from, then 4 images of files, split all"
            assert card.licence == terms and card.history[-1] == f"from {word}"
            assert card.synthetic == (terms == licence)
        mine = replace(source, card=replace(source.card, licence=own + licence))
        assert training_verb._gone_on(mine, "runs/mine", Card(data="more"), cache).licence == own + licence
    source = load_parts("default")[0]  # of a copy elsewhere, whose word says nothing
    copied = training_verb._gone_on(source, "./copy", Card(data="4 images of files"), cache).data
    assert copied.startswith("synthetic streets and insides of buildings alone") and copied.endswith(
        ", then 4 images of files"
    )
    assert "no real scan" not in copied
    assert "no real scan" in training_verb._gone_on(source, "./copy", Card(data="4 images"), streets).data


def test_the_licence_is_the_user_s_else_that_of_the_weights(cache: Path, tmp_path: Path):
    licensed = resolve("tiny", ("training.steps=1", "card.licence=CC BY 4.0"), data=cache)
    list(run(licensed, cache, tmp_path / "first", options=QUIET))
    assert load(tmp_path / "first")[0].card.licence == "CC BY 4.0"
    own = "for what was learned from the scans, their own terms; for the rest, CC BY 4.0"
    for chosen, expected in (("", own), ("ours alone", "ours alone")):
        experiment, out = tiny(1, **{"card.licence": chosen}), tmp_path / f"second {chosen}"
        list(run(experiment, cache, out, str(tmp_path / "first"), options=QUIET))
        assert load(out)[0].card.licence == expected
        assert ("license: other" in card_text(load(out)[0], ls.load(out).description)) == bool(expected)


def test_images_of_fewer_beams_than_the_grid_has_teach_completion_alone(tmp_path):
    few = Sensor("few", (5.0, 0.0, -5.0, -10.0), width=128)
    list(write_cache(tmp_path / "few", lambda i: noise_image(i, few), 1, few, {"name": "few"}))
    from_cache = resolve("default", ("training.batch_size=1",), data=tmp_path / "few")
    with pytest.raises(ValueError, match=r"at least 16 beams to learn to generate from, found 4; `tuned` learns"):
        list(run(from_cache, tmp_path / "few", tmp_path / "run", options=QUIET))
    assert not (tmp_path / "run").exists(), "refused before anything is written"
    task_of(preset("tuned")).suits(preset("tuned"), CachedImages(tmp_path / "few"), True)


def test_a_preset_s_own_licence_takes_no_terms_of_the_weights_away(tmp_path: Path):
    streets, weights = tmp_path / "streets", preset("tuned")
    list(write_cache(streets, noise_image, 1, SENSOR, {"name": "synthetic", "seed": 3}))
    terms = "for what was learned from the scans, their own terms; for the rest, MIT"
    source = replace(weights, card=Card(licence=terms))
    kitti, own = preset("kitti"), preset("kitti").card.licence
    assert not training_verb._given(kitti) and not training_verb._given(preset("tiny"))
    chosen = replace(kitti, card=replace(kitti.card, licence="ours alone"))
    for experiment, expected in (
        (kitti, f"for what was learned from the scans, their own terms; for the rest, {own}"),
        (chosen, "ours alone"),
    ):
        given = bool(training_verb._given(experiment))
        card = training_verb._gone_on(source, "runs/mine", experiment.card, streets, given)
        assert card.licence == expected
        shipped = replace(source, card=Card(licence="MIT"))
        assert training_verb._gone_on(shipped, "default", experiment.card, streets, given).licence == (
            own if experiment is kitti else expected
        )


def test_completions_are_drawn_of_images_with_something_to_go_on_from(cache: Path):
    sensor = SENSOR.resized(16, 64)
    model, images = tiny_cascade(sensor), [noise_image(i) for i in range(3)]
    for network in (model.network, tiny_cascade(sensor).network):
        pictures = training_verb.completions(model.experiment, network, images)
        assert len(pictures) == 2 and all(p.dtype == np.uint8 and p.ndim == 3 for p in pictures)
    empty = images[0].keep(np.zeros((16, 64), bool))
    assert len(training_verb.completions(model.experiment, model.network, [empty, images[1]])) == 1


def test_images_in_which_nothing_returned_are_not_looked_at(tmp_path: Path):
    def image(i: int) -> RangeImage:
        return noise_image(i).keep(np.full((16, 64), i != 1))

    list(write_cache(tmp_path / "some", image, 3, SENSOR, {"name": "noise"}))
    assert len(monitor._spread(tiny(1), tmp_path / "some")) == 2
    list(write_cache(tmp_path / "none", lambda i: image(1), 3, SENSOR, {"name": "noise"}))
    assert len(monitor._spread(tiny(1), tmp_path / "none")) == 3


@pytest.mark.parametrize(
    "change",
    ["training.decay=linear", "diffusion.schedule=cos", "diffusion.kind=noise", "diffusion.loss=l3", "data.codec=cm",
     "data.projection=flat", "model.network=unet", "model.coords_encoding=sine", "training.steps=0",
     "training.learning_rate=1e38"],
)  # fmt: skip
def test_words_that_no_table_has_are_refused_before_anything_is_done(change: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit, match="2"):
        main(["train", "tiny", "--set", change, "--dry-run"])
    error = capsys.readouterr().err
    assert f"{change.partition('=')[0]}: expected " in error and error.count("\n") == 1


def test_a_run_that_ends_before_its_average_goes_on_says_so(cache: Path, tmp_path: Path):
    notes = {}
    for steps in (3, 12):
        experiment = tiny(steps, **{"training.ema_every": 10})
        progress = list(run(experiment, cache, tmp_path / str(steps), options=Options(sample_every=0, workers=0)))
        notes[steps] = progress[0].note
    assert notes[3] == "the weights that are kept are those after step 1: 3 steps end before their average goes on"
    assert notes[12] == ""


DIES = """
import sys
from lidarsynth.training import loop
from lidarsynth.training.options import Options
from lidarsynth.verbs.training import resolve, run

def fault(training, step):
    raise RuntimeError("a fault of ours")

loop.learning_rate = fault
list(run(resolve("tiny"), sys.argv[1], sys.argv[2], options=Options(workers=2)))
"""


def test_a_fault_ends_the_processes_that_read_ahead(cache: Path, tmp_path: Path):
    """They ignore SIGTERM, by which Python would end them as it leaves: it waited for them for ever."""
    ended = subprocess.run([sys.executable, "-c", DIES, cache, tmp_path / "run"], capture_output=True, timeout=120)
    assert ended.returncode == 1 and b"a fault of ours" in ended.stderr


def test_a_run_that_is_refused_leaves_nothing(cache: Path, tmp_path: Path):
    list(
        write_cache(
            tmp_path / "other",
            lambda i: noise_image(i, SENSOR.resized(8, 64)),
            1,
            SENSOR.resized(8, 64),
            {"name": "noise"},
        )
    )
    for data, validation in ((cache, "other"), (cache, "nowhere"), ("synthetic", "other")):
        with pytest.raises(ValueError, match=r"expected (the sensor|a cache folder|images of 16 x 64, found 8 x 64)"):
            list(run(tiny(2), data, tmp_path / "out", validation=tmp_path / validation, options=QUIET))
        assert not (tmp_path / "out").exists()


def test_a_run_that_goes_on_with_other_validation_images_says_so(cache: Path, tmp_path: Path):
    other, out, again = tmp_path / "other", tmp_path / "out", tmp_path / "elsewhere"
    list(write_cache(other, lambda i: noise_image(i + 90, SENSOR), 4, SENSOR, {"name": "noise"}))
    shutil.copytree(other, again)
    list(run(tiny(1), cache, out, validation=other, options=QUIET))
    for validation, said in ((again, False), (None, False), (cache, True), ("synthetic", True)):
        first = next(iter(run(tiny(2), cache, out, validation=validation, options=QUIET)))
        assert ("judged.csv hold numbers of both" in first.note) is said, validation


@pytest.mark.parametrize(
    ("word", "batch", "accumulate", "said"),
    [
        ("tiny", 4, 3, "expected a batch size that 3 processes x passes share equally, found 4"),
        ("tiny-gan", 6, 1, "training.batch_size: expected a multiple of 4, or fewer, .* found 6"),
        ("tiny-gan", 12, 2, "training.batch_size: expected a multiple of 4, or fewer, .* found 6"),
    ],
)
def test_batches_that_cannot_be_shared_are_refused_before_anything_is_written(
    cache: Path, tmp_path: Path, word: str, batch: int, accumulate: int, said: str
):
    experiment = with_fields(preset(word), {"training.batch_size": batch, "data.height": 16})
    with pytest.raises(ValueError, match=said):
        list(run(experiment, cache, tmp_path / "new", options=replace(QUIET, accumulate=accumulate)))
    assert not (tmp_path / "new").exists() or not list((tmp_path / "new").iterdir())


def test_nothing_of_a_cascade_is_compiled_and_that_is_said(cache: Path, tmp_path: Path):
    with pytest.raises(ValueError, match=r"^expected no --compile for a cascade, .* found it$"):
        list(run(with_fields(preset("tuned"), {"training.steps": 1}), cache, tmp_path / "new",
                 options=replace(QUIET, compile=True)))  # fmt: skip
    assert not (tmp_path / "new").exists()


def test_a_run_that_was_stopped_before_it_had_looked_looks_where_it_goes_on(cache: Path, tmp_path: Path):
    options = Options(sample_every=2, save_every=1, workers=0)
    list(run(tiny(3), cache, tmp_path / "whole", options=options, validation=cache))
    for step in (2, 3):  # in the midst of the run, and behind its last step
        stopped = run(tiny(3), cache, tmp_path / str(step), options=options, validation=cache)
        for progress in stopped:
            if progress.step == step - 1:
                signal.raise_signal(signal.SIGTERM)
        assert progress.step == step and not progress.judged, "stopped where it would have looked"
        again = list(run(tiny(3), cache, tmp_path / str(step), options=options, validation=cache))
        assert [progress.step for progress in again if progress.judged] == sorted({step, 3})
        assert (tmp_path / str(step) / "judged.csv").read_text() == (tmp_path / "whole" / "judged.csv").read_text()
        names = [sorted(p.name for p in (tmp_path / at / "pictures").iterdir()) for at in (str(step), "whole")]
        assert names[0] == names[1]


@pytest.mark.parametrize(
    ("change", "said"),
    [("diffusion.gamma=1e300", "diffusion.gamma: expected 0 to 3.4e+38, found 1e+300"),
     ("training.clip_norm=1e39", "training.clip_norm: expected 1e-09 to 3.4e+38, found 1e+39"),
     ("upsampling.first=9", "upsampling.first: expected less than 4, the rows of upsampling.factor, found 9")],
)  # fmt: skip
def test_numbers_that_nothing_can_be_done_with_are_refused(change: str, said: str):
    with pytest.raises(ValueError) as refused:
        resolve("iln-tiny", (change,))
    assert str(refused.value) == said


def test_numbers_may_be_written_without_a_point(cache: Path, tmp_path: Path):
    experiment = resolve("tiny", ("training.betas=[0,0]", "training.steps=1"), data=cache)
    assert all(type(beta) is float for beta in experiment.training.betas), "torch takes no others"
    assert [progress.step for progress in run(experiment, cache, tmp_path, options=QUIET)] == [0, 1]


@pytest.mark.parametrize("name", ["threads", "workers"])
def test_a_million_threads_or_processes_are_refused(name: str):
    with pytest.raises(ValueError, match=f"expected {name} of at most 1,024, found 1,000,000"):
        Options(**{name: 1_000_000})
