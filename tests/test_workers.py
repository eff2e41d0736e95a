"""Workers that come from a process which begins while the first one still reads its model."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from lidarsynth.cli.generate import FEW
from lidarsynth.cli.main import main
from lidarsynth.cli.terminal import answer
from lidarsynth.data.bag_writer import write_bag
from lidarsynth.data.windows import in_window
from lidarsynth.files.formats import write
from lidarsynth.lidar.scan import Scan
from lidarsynth.systems.cascade.layout import BY_COLUMNS, block

Caps = pytest.CaptureFixture[str]
EARLY = """
from lidarsynth.data.workers import begin_early, in_order
if __name__ == "__main__":
    begin_early("lidarsynth.lidar.plural")
    told = "(__import__('sys').modules.keys() >= {'lidarsynth.lidar.plural'}, __import__('os').getcwd(), %d)"
    print(list(in_order(eval, [told % i for i in range(5)], 2)))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere workers begin by themselves")
@pytest.mark.parametrize("length", [1, 120])
def test_early_ones_have_imported_it_and_answer_in_order(length: int, tmp_path: Path):
    """Of a TMPDIR whose sockets have too long a name there are others, which import it themselves, or not at all."""
    (tmp_path / "early.py").write_text(EARLY)
    (temporary := tmp_path / ("t" * length)).mkdir()
    words, env = [sys.executable, tmp_path / "early.py"], os.environ | {"TMPDIR": str(temporary)}
    done = subprocess.run(words, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=100)
    assert done.stderr == ""
    assert done.stdout == f"{[(length == 1, str(tmp_path), i) for i in range(5)]}\n"


def gone(item: int) -> None:
    os._exit(1)


def at_work():
    return gone


def test_a_bag_whose_worker_is_gone_is_told_what_goes_on(tmp_path: Path, capsys: Caps):
    """Bags take no --skip-existing, which was all that the line offered, behind words of the file's."""
    pytest.importorskip("rosbags", reason="rosbags comes with the extra `ros`")

    def verb():
        with write_bag(tmp_path / "dense.bag"):
            list(in_window(at_work, range(9), 2))

    with pytest.raises(SystemExit, match="2"):
        answer(verb)
    said = capsys.readouterr().err
    assert f"{tmp_path}/dense.bag: expected 2 worker processes to stay, found one gone" in said
    assert "--workers 1 needs the least; into a folder the same command with --skip-existing goes on" in said
    assert list(tmp_path.iterdir()) == []


FORKED = """
import os
from lidarsynth.data.workers import begin_early, in_order
if __name__ == "__main__":
    begin_early("lidarsynth.lidar.plural")
    if not (child := os.fork()):
        begin_early("lidarsynth.lidar.plural")
        print(list(in_order(abs, range(5), 2)), flush=True)
        os._exit(0)
    os.waitpid(child, 0)
    print(list(in_order(abs, range(3), 2)))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere workers begin by themselves")
def test_a_process_that_is_forked_from_one_that_has_begun_has_its_own(tmp_path: Path):
    (tmp_path / "forked.py").write_text(FORKED)
    done = subprocess.run([sys.executable, tmp_path / "forked.py"], capture_output=True, text=True, timeout=100)
    assert (done.stdout, done.stderr) == ("[0, 1, 2, 3, 4]\n[0, 1, 2]\n", "")


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere workers begin by themselves")
@pytest.mark.parametrize("seconds", [0, 0.5, 1.5])
def test_ctrl_c_in_a_terminal_tells_nothing_of_processes_that_begin(seconds: float, tmp_path: Path):
    """There it goes to all processes of a command, whatever these import at that moment."""
    words = [sys.executable, "-m", "lidarsynth", "generate", "-n", "64", "--workers", "2", "--out", tmp_path]
    process = subprocess.Popen(words, stdout=-1, stderr=-1, text=True, start_new_session=True)
    while process.poll() is None and not early_one_of(process.pid):
        time.sleep(0.01)
    time.sleep(seconds)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=100)
    assert out == "" and "Traceback" not in err
    assert process.returncode in (130, -signal.SIGINT)


VERBS = ("complete", "upsample --times 2", "label", "realise", "project", "insert --add car:1")
WORDS = [*(f"{verb} scans --out o" for verb in VERBS), "generate --out o", "streets --out o",
         "data files scans o --sensor vlp-16", "data synthetic o"]  # fmt: skip


@pytest.mark.parametrize("words", WORDS)
def test_a_million_is_refused_by_every_verb(words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Caps):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scans").mkdir()
    write(Path("scans", "a.ply"), Scan(np.ones((5, 3), np.float32)))
    with pytest.raises(SystemExit, match="2"):
        main([*words.split(), "--workers", "1000000"])
    assert capsys.readouterr().err == "lidarsynth: expected --workers of at most 1,024, found 1,000,000\n"
    assert not Path("o").exists()


def early_one_of(group: int) -> bool:
    """Whether the process from which workers come has begun in a group."""
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if b"forkserver" in (path / "cmdline").read_bytes() and os.getpgid(int(path.name)) == group:
                return True
    return False


def test_as_few_scans_as_one_process_draws_begin_no_other():
    assert min(block((BY_COLUMNS, 128), choice) for choice in (1, 3)) == FEW
