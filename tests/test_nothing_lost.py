"""Training and generation that are damaged, doubled, misset or out of room: said in one line, and nothing is lost."""

import errno
import fcntl
import json
import os
import resource
import shutil
import subprocess
import sys
import threading
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest
import torch
from forked import Forked
from torch import nn

from lidarsynth.cli import terminal
from lidarsynth.cli.main import main
from lidarsynth.data.dataset import write_cache
from lidarsynth.experiment.folder import save
from lidarsynth.experiment.presets import PRESETS, preset
from lidarsynth.experiment.record import Experiment, from_dict, with_fields
from lidarsynth.files.lock import LOCK, only_writer
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.systems.memory import check_memory
from lidarsynth.systems.table import assemble, build_network
from lidarsynth.training import checkpoint
from lidarsynth.training.checkpoint import STATE, checkpoints, damage_of
from lidarsynth.training.machine import silent_threads
from lidarsynth.training.options import Options
from lidarsynth.verbs.training import run
from lidarsynth.weights.load import load

SENSOR = SENSORS["hdl-64e-kitti"].resized(16, 64)
QUIET = Options(sample_every=0, workers=0, save_every=2)


def noise_image(i: int) -> RangeImage:
    rng, shape = np.random.default_rng(i), (SENSOR.height, SENSOR.width)
    mask = rng.random(shape) < 0.9
    distance = (rng.uniform(2, 60, shape) * mask).astype(np.float32)
    return RangeImage(distance, (rng.random(shape) * mask).astype(np.float32), mask, SENSOR)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lost") / "cache"
    list(write_cache(folder, noise_image, 12, SENSOR, {"name": "noise"}))
    return folder


@pytest.fixture(scope="module")
def trained(cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of four steps with two checkpoints."""
    out = tmp_path_factory.mktemp("run") / "out"
    list(run(tiny(4), cache, out, options=QUIET))
    return out


def tiny(steps: int, **changes) -> Experiment:
    return with_fields(preset("tiny"), {"training.steps": steps, **changes})


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("name", [STATE, "model.safetensors", "experiment.json"])
def test_a_flipped_byte_is_found_named_and_the_checkpoint_before_is_taken(name, cache, trained, tmp_path):
    out = Path(shutil.copytree(trained, tmp_path / "out", symlinks=True))
    flip(checkpoints(out)[-1] / name)
    first, *_ = run(tiny(4), cache, out, options=QUIET)
    assert first.step == 2
    assert f"step-00000004 is damaged ({name} is not what was written): going on from step-00000002" in first.note


@pytest.mark.parametrize("damage", [lambda p: p.write_bytes(b""), lambda p: p.unlink(), flip])
def test_where_all_are_damaged_the_line_says_what_to_do(damage, cache, trained, tmp_path):
    out = Path(shutil.copytree(trained, tmp_path / "out", symlinks=True))
    for saved in checkpoints(out):
        damage(saved / STATE)
    before = sorted(path.name for path in out.rglob("*"))
    with pytest.raises(ValueError, match=r"found only damaged ones: .*; delete .* to begin again") as error:
        list(run(tiny(4), cache, out, options=QUIET))
    assert "\n" not in str(error.value) and sorted(path.name for path in out.rglob("*")) == before


def test_weights_without_checkpoints_are_not_written_over(cache, trained, tmp_path):
    out = Path(shutil.copytree(trained, tmp_path / "out", symlinks=True))
    shutil.rmtree(out / checkpoint.FOLDER)
    weights = (out / "model.safetensors").read_bytes()
    for begun in (None, str(out)):
        with pytest.raises(ValueError, match=r"found model.safetensors without any.*; name another folder, and --from"):
            list(run(tiny(4), cache, out, begun, options=QUIET))
    assert (out / "model.safetensors").read_bytes() == weights
    (out / "model.safetensors").unlink()
    assert [progress.step for progress in run(tiny(1), cache, out, options=QUIET)] == [0, 1]


def test_checkpoints_from_before_there_were_checksums_are_taken_and_empty_ones_are_not(trained, tmp_path):
    saved = Path(shutil.copytree(checkpoints(trained)[-1], tmp_path / "step-00000004"))
    (saved / checkpoint.CHECKSUMS).unlink()
    assert damage_of(saved) == ""
    (saved / STATE).write_bytes(b"")
    assert damage_of(saved) == f"{STATE} is empty or missing"


def test_a_folder_has_one_writer_and_the_lock_dies_with_it(cache, tmp_path):
    out = tmp_path / "out"
    hold = (
        "from lidarsynth.files.lock import only_writer\nimport pathlib, time\n"
        f"with only_writer(pathlib.Path({str(out)!r}), 'x'):\n print('held', flush=True)\n time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", hold], stdout=subprocess.PIPE, text=True)
    assert process.stdout and process.stdout.readline() == "held\n"
    with pytest.raises(ValueError, match="expected a folder that nobody else writes to, found another training"):
        list(run(tiny(2), cache, out, options=QUIET))
    assert sorted(path.name for path in out.iterdir()) == [LOCK], "the second wrote nothing"
    process.kill()
    process.wait()
    assert process.stdout.read() == ""
    process.stdout.close()
    assert [p.step for p in run(tiny(2), cache, out, options=QUIET)][-1] == 2
    assert not (out / LOCK).exists(), "it is taken away at the end"


def test_two_writers_never_hold_one_folder_and_no_locks_is_no_obstacle(tmp_path, monkeypatch):
    with (
        only_writer(tmp_path, "work"),
        pytest.raises(ValueError, match="another work at work"),
        only_writer(tmp_path, "work"),
    ):
        pass
    with only_writer(tmp_path, "work"):
        pass

    with only_writer(tmp_path / "refused", "work"), pytest.raises(ValueError, match="x"):
        raise ValueError("x")
    assert not (tmp_path / "refused").exists(), "a folder that got nothing goes again"

    with only_writer(tmp_path, "work", shared=True) as one:
        with only_writer(tmp_path, "work", shared=True) as two:
            assert one and two
        with pytest.raises(ValueError, match="another work at work"), only_writer(tmp_path, "work"):
            pass
    assert not (tmp_path / LOCK).exists(), "the last one takes it away"

    def refuse(file, kind):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with only_writer(tmp_path, "work"):
        pass
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="found a file"), only_writer(tmp_path / "file", "work"):
        pass


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("training.batch_size", 0),
        ("training.batch_size", -1),
        ("training.steps", -1),
        ("training.ema_every", 0),
        ("model.gn_num_groups", 0),
        ("model.attn_num_heads", 0),
        ("model.dropout", float("nan")),
        ("model.dropout", 1.5),
        ("model.base_channels", 10**9),
        ("model.num_residual_blocks", [10**8]),
        ("training.learning_rate", float("inf")),
        ("data.width", 0),
    ],
)
def test_settings_out_of_range_are_refused_by_the_field_wherever_they_come_from(field, value):
    with pytest.raises(ValueError, match=rf"^{field}: expected ") as told:
        with_fields(preset("tiny"), {field: tuple(value) if isinstance(value, list) else value})
    group, name = field.split(".")
    with pytest.raises(ValueError, match=rf"^here.{field}: expected ") as read:
        from_dict({**preset("tiny").to_dict(), group: {name: value}}, "here")
    assert str(read.value) == f"here.{told.value}"


def test_every_number_of_a_record_has_a_range_or_a_reason():
    for group in fields(Experiment):
        record = next(
            (
                t
                for t in (
                    get_type_hints(Experiment)[group.name],
                    *getattr(get_type_hints(Experiment)[group.name], "__args__", ()),
                )
                if is_dataclass(t)
            ),
            None,
        )
        for part in fields(record) if record and record.__name__ != "Card" else ():
            hint = str(get_type_hints(record)[part.name])
            if ("int" in hint or "float" in hint) and "dict" not in hint:
                assert "range" in part.metadata, f"{group.name}.{part.name}"
    for name in PRESETS:
        assert preset(name)


def test_a_model_that_cannot_fit_is_refused_before_it_is_built():
    huge = with_fields(preset("r2dm-h"), {"model.base_channels": 8192, "model.channel_multipliers": (8, 8, 8, 8)})
    with pytest.raises(
        ValueError, match=r"expected a network that fits into \d+ GiB of memory, found weights of [\d,]+ GiB"
    ):
        build_network(huge)


def test_a_system_that_does_not_tell_its_memory_refuses_no_network(monkeypatch):
    monkeypatch.delattr("os.sysconf_names")
    check_memory(with_fields(preset("r2dm-h"), {"model.base_channels": 8192}), nn.Module)


def test_training_needs_no_links_and_files_to_be_kept_are_open_to_write(cache, tmp_path, monkeypatch):
    def refuse(*words):
        raise OSError(errno.EPERM, "Operation not permitted")

    def fsync(file):
        kept.append(file)
        assert fcntl.fcntl(file, fcntl.F_GETFL) & os.O_ACCMODE != os.O_RDONLY  # Windows: Bad file descriptor

    kept = []
    monkeypatch.setattr(Path, "symlink_to", refuse)  # exFAT, Google Drive, Windows
    monkeypatch.setattr("os.fsync", fsync)
    list(run(tiny(2), cache, tmp_path / "out", options=QUIET))
    assert [damage_of(saved) for saved in checkpoints(tmp_path / "out")] == [""] and kept
    list(run(tiny(4), cache, tmp_path / "out", options=QUIET))
    assert [saved.name[-1] for saved in checkpoints(tmp_path / "out")] == ["2", "4"]


def test_weights_with_nan_are_refused_and_results_with_nan_name_the_model(tmp_path):
    experiment = preset("tiny")
    network = build_network(experiment)
    model = assemble(experiment, network)
    with torch.no_grad():
        next(network.parameters()).fill_(float("nan"))
    with pytest.raises(FloatingPointError, match=r"^tiny: expected finite values of its network, found NaN"):
        model.generate(1, steps=1)
    folder = save(tmp_path, experiment, network)
    with pytest.raises(ValueError, match=r"expected finite weights, found NaN or infinity in "):
        load(folder)


def test_a_full_disk_says_where_and_what_to_do_and_leaves_what_was_there(cache, trained, tmp_path, monkeypatch):
    out = Path(shutil.copytree(trained, tmp_path / "out", symlinks=True))

    def full(path, run):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoint, "save_run", full)
    with pytest.raises(
        OSError, match=r"out: expected room for a checkpoint, found: No space left.*goes on from the last"
    ):
        list(run(tiny(8, **{"training.decay": "constant"}), cache, tmp_path / "new/out", options=QUIET))
    assert not list((tmp_path / "new").rglob(".saving-*")) and damage_of(checkpoints(out)[-1]) == ""


def test_a_state_that_no_longer_fits_on_the_disk_is_told_as_such(cache, tmp_path):
    for most in range(60_000, 480_000, 60_000):
        words = ["train", "tiny", "--data", cache, "--out", tmp_path / "out", "--training.steps", 2, "--workers", 0]
        done = Forked(*words, run=partial(limited, most))
        _, errors = done.communicate()
        line = errors.strip().splitlines()[-1]
        assert (done.returncode, "Traceback" in errors) == (2, False), errors
        assert line.startswith(f"lidarsynth: {tmp_path / 'out'}: expected room for a checkpoint, found: "), errors
    assert not checkpoints(tmp_path / "out") and not list((tmp_path / "out").rglob(".*"))


def limited(most: int, words: list[str]) -> None:
    """The command line where no file may be larger than `most` bytes."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
    main(words)


def test_a_thread_that_a_full_disk_ends_prints_no_traceback(monkeypatch):
    told = []
    monkeypatch.setattr(threading, "excepthook", lambda failure: told.append(failure.exc_type))
    with silent_threads():
        for error in (OSError(errno.ENOSPC, "No space left on device"), ValueError("a fault of ours")):
            thread = threading.Thread(target=raised, args=(error,))
            thread.start()
            thread.join()
    assert told == [ValueError]


def raised(error: Exception) -> None:
    raise error


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
@pytest.mark.parametrize(("words", "stream"), [(["--version"], 1), (["info", "vlp-16"], 1), (["info", "nothing"], 2)])
def test_a_full_disk_under_what_is_said_is_no_traceback(words: list[str], stream: int):
    with open("/dev/full", "w") as full:
        out, err = (full if stream == number else subprocess.PIPE for number in (1, 2))
        command = [sys.executable, "-m", "lidarsynth", *words]
        done = subprocess.run(command, stdout=out, stderr=err, text=True, timeout=60)
    assert done.returncode == 2
    assert stream == 2 or done.stderr.startswith("lidarsynth: expected room to write, found: No space left on device")


def test_what_a_killed_run_left_is_swept_also_when_it_goes_on(cache, trained, tmp_path):
    out = Path(shutil.copytree(trained, tmp_path / "out", symlinks=True))
    (out / "checkpoints/.saving-step-00000006").mkdir()
    (out / ".saving-abc").mkdir()
    (out / ".model.0123.part").write_bytes(b"half")
    list(run(tiny(4), cache, out, options=QUIET))
    assert not list(out.rglob(".saving-*")) and not list(out.rglob("*.part"))


def test_validation_that_is_not_there_fails_before_the_first_step(cache, tmp_path):
    steps = run(tiny(2), cache, tmp_path / "out", validation=tmp_path / "nothing", options=QUIET)
    with pytest.raises(ValueError, match="nothing: expected a cache folder"):
        next(steps)


def test_refusals_are_one_short_line_without_escape_codes(capsys):
    for error in (OSError(errno.ENOSPC, "No space left on device"), OSError(errno.ENOSPC, "No space left", "/a/b")):
        text = terminal._of_system(error)
        assert "make room and run the same command again" in text and "Errno" not in text
    with pytest.raises(SystemExit):
        terminal._refuse("x" * 300_000 + "\x1b[2J\nend")
    line = capsys.readouterr().err
    assert len(line) < 1300 and line.count("\n") == 1 and "\x1b" not in line and line.endswith("?[2J end\n")
    terminal.warn("esc/e\x1b[31mred\nx.bin: two  spaces stay")
    assert capsys.readouterr().err == "lidarsynth: esc/e?[31mred x.bin: two  spaces stay\n"
    terminal.say("a\x1b[31mb")
    assert capsys.readouterr().out == "a?[31mb\n"


def test_records_keep_their_plain_form():
    text = json.dumps(preset("default").to_dict())
    assert from_dict(json.loads(text)) == preset("default")
