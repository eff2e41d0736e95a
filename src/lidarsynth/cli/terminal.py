"""How the command line speaks: lines on stdout, progress bars and one-line refusals on stderr, exit codes."""

from __future__ import annotations

import codecs
import errno
import io
import math
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, NoReturn

from lidarsynth.lidar.plural import plural

if TYPE_CHECKING:
    from lidarsynth.systems.scan_model import ScanModel
    from lidarsynth.training.loop import Progress

NARROWEST = 40  # columns
MOST = 1200  # characters of a refusal
REFUSED, STOPPED, UNHEARD = 2, 130, 141  # exit codes; the last two as shells have them for Ctrl-C and a closed pipe
SOON, PATIENCE = 0.05, 5.0  # seconds until a signal comes again, and for how long it does
TERMINATED, MOMENT = 143, 1.0  # likewise for SIGTERM; seconds, in which a second one is the same: timeout(1) sends two


def say(text: str) -> None:
    """A line on stdout, at once; escape codes, which a file's own names may hold, stay out of the terminal."""
    print("".join(c if c.isprintable() or c in "\n\t" else "?" for c in text), flush=True)


def warn(text: str) -> None:
    """A line on stderr about work that goes on; one line, without escape codes, whatever a file's own names hold."""
    print(f"lidarsynth: {_printable(text)}", file=sys.stderr, flush=True)


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in " ".join(text.splitlines()))


def at_least(least: int, numbers: Mapping[str, int | None]) -> None:
    """Raises ValueError by the option's name unless each number is None or from `least` to 2^62, or of workers to as
    many as a machine can begin."""
    from lidarsynth.data.workers import check_workers

    for name, number in numbers.items():
        if number is not None and not least <= number < 2**62:
            limit = f"at least {least}" if number < least else "at most 2^62 - 1"
            raise ValueError(f"expected --{name} of {limit}, found {number}")
        if name == "workers" and number is not None:
            check_workers(number)


@contextmanager
def step_bar(title: str, steps: int) -> Iterator[Callable[[], object]]:
    """A progress bar for work over two seconds; gives what to call after every network step."""
    from tqdm import tqdm

    with tqdm(total=steps, unit="step", delay=2, desc=title, leave=False, mininterval=_seconds()) as bar:
        yield bar.update


def _seconds() -> float:
    """Between two drawings of a bar: a log file wants few of them."""
    return 0.1 if sys.stderr.isatty() else 30.0


@contextmanager
def scan_bar(
    title: str, count: int | None, calls: int = 1
) -> Iterator[tuple[Callable[[], object], Callable[[], object] | None]]:
    """A progress bar with total and time left for work over two seconds; gives what to call after every scan, and after
    every network step where a scan takes several (`calls`): the bar counts these then."""
    from tqdm import tqdm

    total, unit, done = None if count is None else count * calls, "scan" if calls == 1 else "step", 0
    with tqdm(total=total, unit=unit, delay=2, desc=title, leave=False, mininterval=_seconds()) as bar:

        def on_scan() -> None:
            nonlocal done
            done += 1
            if calls > 1:
                of = "" if count is None else f" of {count}"
                bar.set_description(f"{title}, {plural(done, 'scan')}{of} done", refresh=False)
            bar.update(done * calls - bar.n)  # one that failed has taken fewer steps

        yield on_scan, None if calls == 1 else bar.update


@contextmanager
def image_bar() -> Iterator[Callable[[str, int, int], object]]:
    """A progress bar for work over two seconds; gives what to call with (what, done, in all): images, rows, bytes."""
    from tqdm import tqdm

    with tqdm(unit="", delay=2, leave=False, mininterval=_seconds()) as bar:

        def on_images(what: str, done: int, total: int) -> None:
            bar.total, bar.unit_scale = total, total > 1_000_000  # then as 1.23M, such as bytes
            bar.set_description(what, refresh=False)
            bar.update(done - bar.n)

        yield on_images


def counted(stored: Iterator[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Pass (images done, images in all) on, under a progress bar."""
    from tqdm import tqdm

    with tqdm(unit="image", delay=2, mininterval=_seconds()) as bar:
        for done, total in stored:
            bar.total = total
            bar.update(done - bar.n)
            yield done, total


def progress_line(run: Iterator[Progress], steps: int) -> Iterator[int]:
    """The steps of a training run as they are done, under a live line with losses and speed: times are those of steps,
    without the pictures and checkpoints between them."""
    from tqdm import tqdm

    bar, asked = None, time.perf_counter()
    try:
        for progress in run:  # its first is where the run stands
            if progress.note:
                tqdm.write(f"lidarsynth: {progress.note}", file=sys.stderr)
            if bar is None:
                bar = tqdm(total=steps, initial=progress.step, unit="step", mininterval=max(0.5, _seconds()))
            elif not bar.disable:
                between = max(time.perf_counter() - asked - progress.seconds, 0)
                bar.start_t, bar.last_print_t = bar.start_t + between, bar.last_print_t + between
            losses = " ".join(f"{name} {value:.4f}" for name, value in progress.losses.items())
            rest = f"norm {progress.grad_norm:.2f} rate {progress.learning_rate:.1e}"
            bar.set_postfix_str(f"{losses} {rest}", refresh=False)
            bar.update(progress.step - bar.n)
            if progress.judged:
                numbers = ", ".join(f"{name} {value:.4g}" for name, value in progress.judged.items())
                tqdm.write(f"lidarsynth: after step {progress.step}: {numbers}", file=sys.stderr)
            yield progress.step
            asked = time.perf_counter()
    finally:  # what a run ends with stands on a line of its own
        if bar is not None:
            bar.close()


def load_with_bar(source: str, device: str) -> ScanModel:
    """The model, under a progress bar where it has to be downloaded. Raises ValueError."""
    from tqdm import tqdm

    from lidarsynth.systems.table import assemble
    from lidarsynth.weights.load import load_parts

    check_device(device)
    with tqdm(desc=f"download {source}", unit="B", unit_scale=True, delay=2, mininterval=_seconds()) as bar:

        def on_bytes(done: int, total: int | None) -> None:
            bar.total = total
            bar.update(done - bar.n)

        parts = load_parts(source, on_bytes=on_bytes)
    try:
        return assemble(*parts).to(device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"expected a device of torch, such as cpu or cuda, found {device!r}: {error}") from None


def check_device(device: str) -> None:
    """Raises ValueError for what is no device of torch, is not here, or holds no numbers."""
    from lidarsynth.networks.device import check_device as check

    check(device)


def answer(verb: Callable[[], object]) -> None:
    """Do what a command line asks for and turn every failure into one line and an exit code.

    Raises SystemExit: 2 for what cannot be done, 130 for Ctrl-C, 143 for SIGTERM, 141 where nobody reads stdout.
    """
    if sys.stderr is None:  # closed by who started us, as 2>&- does
        sys.stderr = open(os.devnull, "w", encoding="utf-8", errors="replace")  # noqa: SIM115, for as long as the process lasts
    if isinstance(sys.stdout, io.TextIOWrapper):
        codecs.register_error("lidarsynth", _sayable)
        sys.stdout.reconfigure(errors="lidarsynth")
    if (columns := os.environ.get("COLUMNS", "")).isdigit() and int(columns) < NARROWEST:
        os.environ["COLUMNS"] = str(NARROWEST)  # the help of a narrower terminal would never be laid out
    try:
        with _interruptible(), _terminable(), _warned():
            verb()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at exit
        sys.exit(UNHEARD)
    except KeyboardInterrupt as stop:
        terminated = stop.args == (signal.SIGTERM,)
        _tell_last("stopped by SIGTERM" if terminated else "stopped")
        sys.exit(TERMINATED if terminated else STOPPED)
    except OSError as error:
        _refuse(_of_system(error))
    except (ValueError, ImportError, FloatingPointError) as error:
        _refuse(str(error))
    except RecursionError:
        _refuse("expected a file with a few levels of brackets, found too many")
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "memory" not in str(error):
            raise  # a fault of ours
        _refuse(f"expected enough memory, found too little: {error}".partition("\n")[0].removesuffix(": "))


@contextmanager
def _warned() -> Iterator[None]:
    """Warnings of the library's own are lines as `warn` says them, without the place in the program."""
    former, package, said = warnings.formatwarning, Path(__file__).parents[1], set[str]()

    def line(message: Warning | str, category: type[Warning], file: str, number: int, text: str | None = None) -> str:
        own = Path(file).is_relative_to(package) or category.__module__.startswith(package.name)
        if not own:
            return former(message, category, file, number, text)
        first = str(message) not in said  # Python itself says it once for each place in the program
        said.add(str(message))
        return f"lidarsynth: {_printable(str(message))}\n" if first else ""

    warnings.formatwarning = line
    try:
        yield
    finally:
        warnings.formatwarning = former


Handler = Callable[[int, FrameType | None], None]


def _once_imported(stop: Handler) -> Handler:
    """A handler of a signal that comes again and again until no module is being imported, for PATIENCE seconds: where
    that is interrupted, torch ends the process in words of its own, and Python may lose what was to stop it."""
    until, waits = -math.inf, False

    def again(number: int) -> None:
        nonlocal waits
        waits = False
        if sys.platform == "win32":
            signal.raise_signal(number)
        else:
            os.kill(os.getpid(), number)  # which wakes the first thread, whatever it waits for

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal until, waits
        if waits:
            return
        until = time.monotonic() + PATIENCE if until == -math.inf else until
        waits = time.monotonic() < until and _importing(frame)
        if waits:
            timer = threading.Timer(SOON, again, (number,))
            timer.daemon = True
            timer.start()
        else:
            until = -math.inf
            stop(number, frame)

    return handle


def _importing(frame: FrameType | None) -> bool:
    """Whether a module is being imported there."""
    while frame is not None and frame.f_code.co_filename != "<frozen importlib._bootstrap>":
        frame = frame.f_back
    return frame is not None


@contextmanager
def _interruptible() -> Iterator[None]:
    """Ctrl-C raises KeyboardInterrupt, but not into the import of a module."""
    ours = threading.current_thread() is threading.main_thread()
    if not ours or signal.getsignal(signal.SIGINT) != signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, _once_imported(signal.default_int_handler))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM (of timeout, Slurm, a machine that goes down) raises KeyboardInterrupt(SIGTERM): what ends well by Ctrl-C
    ends well by it, too. Once that has ended, it is ignored: the same one once more must not kill a process that exits,
    and Python takes handlers away before it is gone, but leaves what is ignored."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return
    last = -math.inf

    def stop(number: int, frame: object) -> None:
        nonlocal last
        former, last = last, time.monotonic()
        if last - former >= MOMENT:
            raise KeyboardInterrupt(number)

    signal.signal(signal.SIGTERM, _once_imported(stop))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL if last == -math.inf else signal.SIG_IGN)


def _sayable(error: UnicodeError) -> tuple[str, int]:
    """Stands in for what the terminal's encoding lacks: tyro's bullets, and file names of other languages."""
    assert isinstance(error, UnicodeEncodeError)
    lacking = error.object[error.start : error.end].replace("\u2022", "*")
    return lacking.encode("ascii", "backslashreplace").decode(), error.end


def _of_system(error: OSError) -> str:
    """A failure of the system in words: where, what was expected, what was found, what to do."""
    where = f"{error.filename}: " if error.filename else ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"{where}expected room to write, found: {error.strerror}; make room and run the same command again"
    if str(error.strerror).startswith("expected "):  # not the system's: that worker processes are gone
        return f"{where}{error.strerror}"
    if error.filename:
        return f"{where}expected a file that can be used, found: {error.strerror}"
    return str(error) if error.errno is None else f"expected the system to go along, found: {error.strerror}"


def _refuse(reason: str) -> NoReturn:
    """One line of at most MOST characters, on a line of its own, whatever a file's own names hold."""
    line = _printable(" ".join(reason.split()))
    line = line if len(line) <= MOST else f"{line[: MOST // 2]} ... {line[-MOST // 3 :]}"
    start = "\r\x1b[K" if sys.stderr.isatty() else ""  # over a progress bar that stood there
    _tell_last(line or "stopped for no known reason", start)
    sys.exit(REFUSED)


def _tell_last(line: str, start: str = "") -> None:
    """The line that a command ends with; the exit code holds where stderr is a file on the very disk that is full."""
    with suppress(OSError):
        print(f"{start}lidarsynth: {line}", file=sys.stderr, flush=True)
