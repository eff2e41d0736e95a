"""The command line in a process of its own that is forked off this one: torch is not imported again."""

import os
import signal
import socket
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress

from lidarsynth.cli.main import main


class Forked:
    """A running command, or `run` of the words, in the manner of subprocess.Popen.

    `stdout` is a descriptor, or None to keep what is said.
    """

    def __init__(
        self,
        *words: object,
        stdout: int | None = None,
        environment: Mapping[str, str] | None = None,
        run: Callable[[list[str]], None] = main,
    ):
        self.run = run
        self.words, self.environment = [str(word) for word in words], dict(environment or {})
        self.returncode: int | None = None
        self._said = _kept(), _kept()
        fds = self._said[0] if stdout is None else stdout, self._said[1]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # threads of pytest-xdist, which wait
            self.pid = os.fork()
        if self.pid == 0:
            os._exit(self._command(*fds))

    def _command(self, out: int, err: int) -> int:
        os.environ.update(self.environment)
        os.dup2(out, 1)
        os.dup2(err, 2)
        sys.stdout, sys.stderr = (open(fd, "w", closefd=False) for fd in (1, 2))  # noqa: SIM115
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _forget_processes()
        warnings.resetwarnings()  # pytest makes them errors; a command prints them
        code = 0
        try:
            self.run(self.words)
            sys.stdout.flush()
        except SystemExit as end:
            code = int(end.code or 0)
        except BaseException:
            traceback.print_exc()
            code = 1
        with suppress(BrokenPipeError):
            sys.stdout.flush()
        sys.stderr.flush()
        return code

    def poll(self) -> int | None:
        """The exit code, negative for a signal; None while it runs."""
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.returncode = os.waitstatus_to_exitcode(status) if pid else None
        return self.returncode

    def wait(self, timeout: float = 100) -> int:
        until = time.monotonic() + timeout
        while self.poll() is None:
            if time.monotonic() > until:
                self.send_signal(signal.SIGKILL)
                raise TimeoutError(f"{self.words} took more than {timeout} s")
            time.sleep(0.005)
        assert self.returncode is not None
        return self.returncode

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def communicate(self, timeout: float = 100) -> tuple[str, str]:
        """What it said on stdout and stderr, after its end."""
        self.wait(timeout)
        out, err = (os.pread(fd, os.fstat(fd).st_size, 0).decode() for fd in self._said)
        return out, err


def _kept() -> int:
    """The descriptor of a file without a name."""
    fd, path = tempfile.mkstemp()
    os.unlink(path)
    return fd


def _forget_processes() -> None:
    """What accelerate found out in the parent about processes and devices does not hold here."""
    try:
        from accelerate.state import AcceleratorState, GradientState
    except ImportError:
        return
    AcceleratorState._reset_state(reset_partial_state=True)
    GradientState._reset_state()


def pair(*words: object) -> list[tuple[int, str, str]]:
    """Exit code, stdout and stderr of two processes that train together, as torchrun starts them."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": "2"}
    both = [Forked(*words, environment={**shared, "RANK": rank, "LOCAL_RANK": rank}) for rank in "01"]
    said = [process.communicate(timeout=200) for process in both]
    return [(process.wait(), *texts) for process, texts in zip(both, said, strict=True)]
