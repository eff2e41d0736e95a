"""Commands that are stopped, or lose a process, in a group of their own: they end, in a line, and leave nobody."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from test_recognise import turn
from test_training_run import SENSOR, noise_image

from lidarsynth.cli.main import main
from lidarsynth.cli.terminal import answer
from lidarsynth.data.cache import write_cache
from lidarsynth.files.formats import write
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.verbs.training import _named

STREETS = ["data", "synthetic", "cache", "-n", "6000", "--sensor", "vlp-16", "--width", "128", "--workers", "2"]


@contextmanager
def running(folder: Path, *words: str) -> Iterator[subprocess.Popen]:
    """A command in a group of its own, of which nothing is left in the end."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs inherit "ignored"
    process = subprocess.Popen([sys.executable, "-m", "lidarsynth", *words], cwd=folder, start_new_session=True,
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)  # fmt: skip
    try:
        yield process
    finally:
        if _alive(process):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def _alive(process: subprocess.Popen) -> bool:
    try:
        os.killpg(process.pid, 0)
    except ProcessLookupError:
        return False
    return True


def ended(process: subprocess.Popen) -> tuple[int, str]:
    """Its exit code and what it said on stderr, once it and all of its group are gone; within half a minute."""
    errors = process.communicate(timeout=30)[1]
    until = time.monotonic() + 10
    while _alive(process) and time.monotonic() < until:
        time.sleep(0.05)
    assert not _alive(process), "processes are left behind"
    return process.returncode, errors


def once(there: Callable[[], bool], process: subprocess.Popen) -> None:
    until = time.monotonic() + 120
    while not there():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until
        time.sleep(0.02)


def workers_of(process: subprocess.Popen) -> list[int]:
    """Processes that a training has read ahead by: its forked children."""
    return [int(word) for word in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]


@pytest.mark.timeout(300)
@pytest.mark.parametrize("group", [False, True])
def test_two_interruptions_end_all_at_once(group: bool, tmp_path: Path):
    with running(tmp_path, *STREETS) as process:
        once(lambda: len(list((tmp_path / "cache").glob("*.npy"))) > 0, process)
        for pause in (0.05, 0):
            (os.killpg if group else os.kill)(process.pid, signal.SIGINT)
            time.sleep(pause)
        code, errors = ended(process)
    assert code in (130, -signal.SIGINT) and errors.count("\n") <= 1 and "Traceback" not in errors


@pytest.mark.timeout(300)
def test_an_interruption_while_processes_begin_is_one_line(tmp_path: Path):
    with running(tmp_path, *STREETS) as process:
        once(lambda: len(workers_of(process)) > 1, process)
        os.killpg(process.pid, signal.SIGINT)
        code, errors = ended(process)
    assert code == 130 and errors.endswith("lidarsynth: stopped\n") and "Traceback" not in errors


@pytest.mark.timeout(300)
@pytest.mark.parametrize("group", [False, True])
def test_sigterm_is_one_line_and_the_same_command_goes_on(group: bool, tmp_path: Path):
    words = ["streets", "--out", "set", "-n", "24", "--sensor", "vlp-16", "--workers", "2", "--no-picture"]
    with running(tmp_path, *words) as process:
        once(lambda: len(list((tmp_path / "set").rglob("velodyne/*.bin"))) > 0, process)
        for _ in range(2):  # as timeout(1) does
            (os.killpg if group else os.kill)(process.pid, signal.SIGTERM)
            time.sleep(0.002)
        code, errors = ended(process)
    assert code == 143 and errors.endswith("lidarsynth: stopped by SIGTERM\n") and "Traceback" not in errors
    there = {path: path.read_bytes() for path in (tmp_path / "set").rglob("*.bin")}
    assert not list((tmp_path / "set").rglob(".*")) and len(there) < 24 * 3
    with running(tmp_path, *words) as process:
        assert ended(process)[0] == 0
    assert len(list((tmp_path / "set").rglob("velodyne/*.bin"))) == 24
    assert all(path.read_bytes() == content for path, content in there.items())


def test_sigterm_ends_as_it_did_where_a_command_is_done():
    answer(lambda: None)
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_the_same_sigterm_once_more_does_not_kill_what_python_is_taking_apart():
    """On a busy machine the second of two came so late; handlers are gone by then."""
    lines = """
import os, signal
from lidarsynth.cli.terminal import answer
class Last:
    def __del__(self, kill=os.kill, pid=os.getpid(), number=signal.SIGTERM):
        kill(pid, number)
last = Last()
answer(lambda: os.kill(os.getpid(), signal.SIGTERM))
"""
    done = subprocess.run([sys.executable, "-c", lines], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (143, "lidarsynth: stopped by SIGTERM\n")


def test_the_same_sigterm_once_more_does_not_kill_what_is_about_to_exit():
    try:
        with pytest.raises(SystemExit, match="143"):
            answer(lambda: os.kill(os.getpid(), signal.SIGTERM))
        assert signal.getsignal(signal.SIGTERM) != signal.SIG_DFL
        os.kill(os.getpid(), signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


TRAIN = ["train", "tiny", "--data", "cache", "--out", "run", "--workers", "2", "--threads", "1", "--sample-every", "0",
         "--training.steps", "100000", "--training.batch_size", "1"]  # fmt: skip


@pytest.fixture
def training(tmp_path: Path) -> Path:
    list(write_cache(tmp_path / "cache", noise_image, 130, SENSOR, {"name": "noise"}))
    return tmp_path


def begun(folder: Path, process: subprocess.Popen) -> None:
    losses = folder / "run" / "losses.csv"
    once(lambda: losses.exists() and losses.read_text().count("\n") > 2, process)


@pytest.mark.timeout(300)
def test_two_sigterms_of_a_training_are_one(training: Path):
    with running(training, *TRAIN) as process:
        begun(training, process)
        for _ in range(2):
            os.kill(process.pid, signal.SIGTERM)
            time.sleep(0.005)
        code, errors = ended(process)
    assert code == 0 and list((training / "run" / "checkpoints").glob("step-*")), errors


@pytest.mark.timeout(300)
def test_images_that_vanish_end_a_training(training: Path):
    with running(training, *TRAIN) as process:
        begun(training, process)
        for path in (training / "cache").glob("*.npy"):
            path.write_bytes(b"")
        code, errors = ended(process)
    assert code == 2 and "Traceback" not in errors and ".npy: expected a shard of the cache" in errors


@pytest.mark.timeout(300)
@pytest.mark.skipif(sys.platform != "linux", reason="children are found in /proc")
def test_a_process_that_is_killed_ends_a_training_in_a_line(training: Path):
    with running(training, *TRAIN) as process:
        begun(training, process)
        os.kill(workers_of(process)[0], signal.SIGKILL)
        code, errors = ended(process)
    assert code == 2 and "Traceback" not in errors
    assert "expected the processes that read ahead to stay, found one gone" in errors


@pytest.mark.parametrize("error", [ConnectionResetError(104, "Connection reset by peer"), EOFError(),
                                   RuntimeError("DataLoader worker (pid 7) is killed by signal: Killed.")])  # fmt: skip
def test_a_process_that_is_gone_is_said_however_that_is_noticed(error: Exception, tmp_path: Path):
    """Between two batches, or while it hands one over."""

    def steps():
        yield "first"
        raise error

    named = _named(steps(), tmp_path)
    assert next(named) == "first"
    with pytest.raises(OSError, match="expected the processes that read ahead to stay, found one gone"):
        next(named)


@pytest.mark.timeout(300)
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere they notice after seconds")
def test_a_killed_training_leaves_its_folder_at_once(training: Path):
    with running(training, *TRAIN) as process:
        begun(training, process)
        process.kill()
        process.wait()
        with running(training, *TRAIN) as again:
            rows = (training / "run" / "losses.csv").read_text().count("\n")
            once(lambda: (training / "run" / "losses.csv").read_text().count("\n") not in (0, rows), again)


def test_what_a_process_cannot_begin_with_is_said_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "in").mkdir()
    for i in range(3):
        write(tmp_path / "in" / f"{i}.ply", turn(SENSORS["vlp-16"]))
    words = ["upsample", str(tmp_path / "in"), "--from", "vlp-16", "--to", "nonsense", "--out", str(tmp_path / "o")]
    with pytest.raises(SystemExit, match="2"):
        main([*words, "--workers", "2"])
    error = capsys.readouterr().err
    assert "expected a sensor of hdl-64e" in error and error.count("\n") == 1


LET_GO = """
import multiprocessing, socket, sys, time
from multiprocessing import resource_sharer
from lidarsynth.training.examples import _leave_endings

def reads_ahead(lines):
    _leave_endings(0)
    resource_sharer.DupFd(sys.stdin.fileno())
    lines.put(resource_sharer._resource_sharer._address)
    time.sleep(60)

context = multiprocessing.get_context("fork")
lines = context.Queue()
worker = context.Process(target=reads_ahead, args=(lines,), daemon=True)
worker.start()
address = lines.get()
for linger in (False, True):  # as a process that ends in good order, and as one that is gone
    with socket.socket(socket.AF_UNIX) as one:
        one.connect(address)
        if linger:
            one.recv(4)
time.sleep(0.5)
worker.kill()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="a socket of Unix")
def test_a_process_that_reads_ahead_does_not_mind_who_lets_go():
    done = subprocess.run([sys.executable, "-c", LET_GO], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and done.stderr == ""
