"""What else an attack found: folders with two writers, pipes, logs, Ctrl-C while imports run, sums of downloads."""

import io
import os
import signal
import sys
import time
from hashlib import sha256
from importlib import import_module
from importlib.abc import MetaPathFinder
from pathlib import Path

import numpy as np
import pytest
import torch
import tqdm.std

from lidarsynth.__main__ import command
from lidarsynth.cli import terminal
from lidarsynth.cli.main import main
from lidarsynth.cli.terminal import answer
from lidarsynth.data.cache import write_cache
from lidarsynth.data.frames import read_velodyne
from lidarsynth.data.ouster import read_metadata
from lidarsynth.data.street_sets import write_streets
from lidarsynth.evaluation.evaluate import evaluate
from lidarsynth.files.lock import only_writer
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS, Sensor, from_dict, read_sensor
from lidarsynth.lidar.small_file import read_toml
from lidarsynth.metrics.bev import BevCounts
from lidarsynth.networks.archive import read_yaml
from lidarsynth.streets.frame import LabelledStreets
from lidarsynth.training.journal import _continue_table
from lidarsynth.weights.download import SUMS, download

SENSOR = SENSORS["vlp-16"].resized(16, 64)


def noise(i: int, sensor: Sensor = SENSOR) -> RangeImage:
    rng, shape = np.random.default_rng(i), (sensor.height, sensor.width)
    distance = rng.uniform(5, 60, shape).astype(np.float32)
    return RangeImage(distance, rng.random(shape).astype(np.float32), distance > 0, sensor)


def generate(out: Path) -> None:
    main(["generate", "-n", "1", "--steps", "1", "--no-picture", "--out", str(out)])


WRITERS = {
    "generate": generate,
    "cache": lambda out: list(write_cache(out, noise, 2, SENSOR, {"name": "noise"})),
    "streets": lambda out: list(write_streets(out, LabelledStreets(0, 1, SENSOR), "pcd")),
    "benchmark": lambda out: main(["benchmark", "upsampling", "none.toml", "--out", str(out)]),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_a_second_writer_is_refused_and_touches_nothing(kind: str, tmp_path: Path, capsys):
    (tmp_path / ".0000000.npy.1.part").write_bytes(b"what the first is at")
    with only_writer(tmp_path, "work"), pytest.raises((ValueError, SystemExit)) as error:
        WRITERS[kind](tmp_path)
    told = f"{error.value}{capsys.readouterr().err}"
    assert "expected a folder that nobody else writes to, found another" in told
    assert [path.name for path in tmp_path.iterdir()] == [".0000000.npy.1.part"]


@pytest.mark.timeout(20)
@pytest.mark.parametrize("name", ["a.json", "a.pcap", "a.bag", "a.mcap"])
def test_pipes_are_refused_whatever_their_name_promises(name: str, tmp_path: Path, capsys):
    os.mkfifo(tmp_path / name)
    with pytest.raises(SystemExit) as end:
        main(["info", str(tmp_path / name)])
    line = capsys.readouterr().err
    assert end.value.code == 2 and line.count("\n") == 1 and "expected a file, found a device or pipe" in line


@pytest.mark.parametrize(("name", "found"), [("a.bin", "no file or folder of that name"), ("empty", "nothing")])
def test_what_is_not_there_is_said_without_a_list_of_models(name: str, found: str, tmp_path: Path, capsys):
    (tmp_path / "empty").mkdir()
    with pytest.raises(SystemExit):
        main(["info", str(tmp_path / name)])
    line = capsys.readouterr().err
    assert line.endswith(f"found {found}\n") and "kitti" not in line


def test_a_toml_of_one_long_word_is_read_in_linear_time(tmp_path: Path):
    (tmp_path / "a.toml").write_text(f'{"word" * 100_000} = "{"word " * 50_000}"\n')
    start = time.process_time()
    assert len(read_toml(tmp_path / "a.toml")) == 1
    assert time.process_time() - start < 2, "100,000 letters took minutes"


@pytest.mark.timeout(20)
def test_a_pipe_in_a_data_set_and_a_yaml_of_aliases_of_aliases_are_refused_at_once(tmp_path: Path):
    os.mkfifo(tmp_path / "000000.bin")
    with pytest.raises(ValueError, match="found a device or pipe"):
        read_velodyne(tmp_path / "000000.bin")
    bomb = "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
    bomb += "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 10))
    for text, found in ((bomb, "values, found more"), ("a: 1\n" * 20_000, "bytes, found 100000")):
        with pytest.raises(ValueError, match=f"here: expected YAML of at most .* {found}"):
            read_yaml(text.encode(), "here")


def test_a_refusal_nobody_hears_is_a_refusal(monkeypatch, tmp_path: Path):
    monkeypatch.setattr(sys, "stderr", None)
    monkeypatch.setattr(os, "devnull", str(tmp_path / "nobody"))
    with pytest.raises(SystemExit) as end:
        main(["info", str(tmp_path / "nothing.bin")])
    sys.stderr.close()
    assert end.value.code == 2 and "nothing.bin: expected" in (tmp_path / "nobody").read_text()


class Clock:
    """A quarter of a second passes between two looks at it."""

    def __init__(self):
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 0.25
        return self.now


@pytest.mark.parametrize("bar", ["step", "scan", "image", "stored"])
def test_a_log_file_gets_few_pieces_of_progress(bar: str, monkeypatch):
    log = io.StringIO()
    monkeypatch.setattr(sys, "stderr", log)
    monkeypatch.setattr(tqdm.std, "time", Clock())
    if bar == "step":
        with terminal.step_bar("generate", 300) as on_step:
            for _ in range(300):
                on_step()
    elif bar == "scan":
        with terminal.scan_bar("complete", 300) as (on_scan, _):
            for _ in range(300):
                on_scan()
    elif bar == "image":
        with terminal.image_bar() as on_image:
            for i in range(300):
                on_image("samples", i, 300)
    else:
        list(terminal.counted((i, 300) for i in range(300)))
    assert 1 <= log.getvalue().count("\r") <= 8, "75 s and more of a clock"


class Interrupting(MetaPathFinder):
    """Ctrl-C while the command line is imported."""

    def find_spec(self, fullname, path, target=None):
        if fullname == "lidarsynth.cli.main":
            raise KeyboardInterrupt


def test_ctrl_c_while_the_program_is_read_ends_quietly(monkeypatch, capsys):
    monkeypatch.delitem(sys.modules, "lidarsynth.cli.main")
    monkeypatch.setattr(sys, "meta_path", [Interrupting(), *sys.meta_path])
    with pytest.raises(SystemExit) as end:
        command()
    assert end.value.code == 130 and capsys.readouterr().err == "lidarsynth: stopped\n"
    scripts = (Path(__file__).parents[1] / "pyproject.toml").read_text()
    assert 'lidarsynth = "lidarsynth.__main__:command"' in scripts, "the installed command begins there, too"


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_waits_until_a_module_is_imported(number: int, code: int, tmp_path: Path, monkeypatch, capsys):
    """Into that of torch it ended the process in torch's words (pybind11, code -6), or was lost."""
    twice = f"[os.kill(os.getpid(), {int(number)}) for _ in range(2)]"
    (tmp_path / "slow_to_import.py").write_text(f"import os, time\n{twice}\ntime.sleep(0.3)\nimported = True\n")
    monkeypatch.syspath_prepend(tmp_path)
    former = [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(SystemExit) as end:
            answer(lambda: (import_module("slow_to_import"), time.sleep(20)))
    finally:
        for one, handler in zip((signal.SIGINT, signal.SIGTERM), former, strict=True):
            signal.signal(one, handler)
    assert end.value.code == code and capsys.readouterr().err.startswith("lidarsynth: stopped")
    assert vars(sys.modules.pop("slow_to_import"))["imported"]


def test_sums_beside_the_downloads_are_kept(tmp_path: Path):
    (tmp_path / "there").write_bytes(b"content")
    url, cache = (tmp_path / "there").as_uri(), tmp_path / "cache"
    cache.mkdir()
    (cache / SUMS).write_text(f"{'0' * 64}  weights.pth\n{sha256(b'other').hexdigest()}  *unknown\n")
    with pytest.raises(ValueError, match=r"weights\.pth\.part: expected the SHA-256 0+ of .*SHA256SUMS, found ed7002"):
        list(download(url, cache / "weights.pth"))
    assert not (cache / "weights.pth").exists()
    (cache / SUMS).write_text(f"{sha256(b'content').hexdigest()}  weights.pth\n")
    list(download(url, cache / "weights.pth"))
    assert (cache / "weights.pth").read_bytes() == b"content"
    (cache / "weights.pth").write_bytes(b"damaged")
    with pytest.raises(ValueError, match="expected the SHA-256 ed7002"):
        list(download(url, cache / "weights.pth"))


def test_images_of_sixteen_rows_get_an_frd_with_a_note():
    wide = [noise(i, SENSORS["vlp-16"].resized(16, 1024)) for i in range(4)]
    report = evaluate(wide[:2], wide[2:], "street-1")
    assert report.values["FRD"] is not None
    assert "note: street-1 v1 is of 64 x 1024 images of hdl-64e-kitti, found 16 x 1024 of vlp-16" in str(report)


def test_merged_histograms_stay_small():
    whole, again = BevCounts(10), BevCounts(10)
    for i in range(3):
        whole.update(torch.rand(1, 50, 3, generator=torch.Generator().manual_seed(i)) * 40)
    again.load_state(whole.state())
    again.merge(whole)
    assert whole.scans.dtype == again.scans.dtype == torch.int16


@pytest.mark.parametrize("blocked", [7, None, [7], [[1, "a"]], {"a": 1}])
def test_blocked_columns_of_another_kind_are_named(blocked):
    with pytest.raises(ValueError, match="mine: expected blocked as a list of"):
        from_dict({**SENSOR.to_dict(), "blocked": blocked}, "mine")


def test_numbers_too_large_for_a_float_are_named(tmp_path: Path):
    (tmp_path / "a.toml").write_text(f"beams = 8\ntop = 1{'0' * 400}\nbottom = -25\n")
    with pytest.raises(ValueError, match=r"a\.toml: expected numbers in the sensor's fields, found"):
        read_sensor(tmp_path / "a.toml")
    beams = '"beam_altitude_angles": [4, 3, 2, 1], "beam_azimuth_angles": [0, 0, 0, 0]'
    (tmp_path / "a.json").write_text(f'{{{beams}, "columns_per_frame": 1e999}}')
    with pytest.raises(ValueError, match="expected Ouster metadata, found"):
        read_metadata(tmp_path / "a.json")


def test_damaged_rows_of_a_curve_are_left_out(tmp_path: Path):
    (tmp_path / "losses.csv").write_bytes(b"step,loss\n1,0.5\n\xff\x002,0.4\nx,0.3\n3,0.2\n9,0.1\n")
    _continue_table(tmp_path / "losses.csv", 4, ("step", "loss")).close()
    assert (tmp_path / "losses.csv").read_text() == "step,loss\n1,0.5\n3,0.2\n"
