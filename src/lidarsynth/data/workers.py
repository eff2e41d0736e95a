"""Work shared among processes, answered in order."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from itertools import chain, islice
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import wait
from typing import Any, TypeVar

TRIM, MMAP = -1, -3  # of mallopt(3): memory above the one goes back to the system, above the other it comes apart
LARGEST = 1 << 25  # bytes, of MMAP; what glibc allows at most
MOST = 1024  # processes or threads: a machine that is asked for a million stands still
AHEAD = 16  # items of each process that are begun or wait for it: there may be more in all than memory holds

Item = TypeVar("Item")
_make: list[Callable[[Any], Any]] = []  # of this worker process; sent once, not with every item
_begun: set[int] = set()  # processes that have called `begin_early`; those that are forked from them begin others


def in_order(make: Callable[[Item], Any], items: Iterable[Item], workers: int) -> Generator[Any, None, None]:
    """make(item) of each item, in order, by `workers` processes, or by this one where fewer than two have work.

    `make` must be picklable where there are workers. What it raises is raised here. Closing the generator ends the
    workers at once. Raises OSError when one is gone.
    """
    items = iter(items)
    first = list(islice(items, max(workers, 0)))
    workers, items = min(workers, len(first)), chain(first, items)
    if workers < 2:
        yield from map(make, items)
        return
    with pool_of(workers, _start, make, "the same command goes on, and --workers 1 needs the least") as submit:
        begun = deque(submit(_work, item) for item in islice(items, AHEAD * workers))
        while begun:
            yield begun.popleft().result()
            begun.extend(submit(_work, item) for item in islice(items, 1))


def check_workers(workers: int) -> None:
    """Raises ValueError unless they are from 0 to MOST."""
    if not 0 <= workers <= MOST:
        limit = "at least 0" if workers < 0 else f"at most {MOST:,}"
        raise ValueError(f"expected --workers of {limit}, found {workers:,}")


def begin_early(*modules: str) -> None:
    """On Linux, begins the process from which this one's workers then come, and which imports modules meanwhile: those
    that come without it do so each by itself, and not before they are asked for.

    To be called where this process still has much to do, as reading a model; `os.environ` of workers is as it is now.
    """
    if sys.platform == "linux":
        resource_tracker.ensure_running()  # which lets Ctrl-C through where it begins
        with _uninterrupted(), suppress(OSError):  # none where TMPDIR is too long for a socket, or after a fork
            forkserver.set_forkserver_preload([*modules])
            forkserver.ensure_running()
            _begun.add(os.getpid())


@contextmanager
def pool_of(
    workers: int, start: Callable[[Any], None], make: Any, goes_on: str
) -> Generator[Callable[..., Future], None, None]:
    """`submit(call, item)` to so many processes, each begun by `start(make)`; whatever leaves early ends them at once.

    goes_on  what to do where one is gone, in words
    Raises OSError when one is gone.
    """
    # Not fork: threads of torch in this process would be copied in whatever state they are.
    context = multiprocessing.get_context("forkserver" if os.getpid() in _begun else "spawn")
    others, done = set(multiprocessing.active_children()), False
    pool = ProcessPoolExecutor(workers, context, start, (make,))

    def submit(call: Callable[[Any], Any], item: Any) -> Future:
        with _uninterrupted():
            return pool.submit(call, item)

    try:
        yield submit
        done = True
    except BrokenProcessPool:
        raise OSError(f"expected {workers} worker processes to stay, found one gone (out of memory?); {goes_on}"
                      ) from None  # fmt: skip
    finally:
        for worker in set(multiprocessing.active_children()) - others if not done else ():
            worker.terminate()
        pool.shutdown(cancel_futures=True)


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Ctrl-C and SIGTERM wait, and processes that begin meanwhile never see Ctrl-C: it is the parent's to handle."""
    found = {int(number): signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handlers = {number: handler for number, handler in found.items() if callable(handler)}
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.SIGINT not in handlers or sys.platform == "win32":
        yield
        return
    came: list[tuple[int, Any]] = []
    for number in handlers:
        signal.signal(number, lambda *call: came.append(call))  # another thread may be the one that gets it
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # which processes inherit, and handlers not
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if came:
        handlers[came[0][0]](*came[0])


def _start(make: Callable[[Any], Any]) -> None:
    watch_parent()
    keep_memory()
    _make.append(make)


def watch_parent() -> None:
    """In a worker: Ctrl-C is the parent's to handle; a parent that was killed takes its workers along."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def keep_memory() -> None:
    """In a worker: images' memory is kept for the next image, which asking the system for it anew slows by a tenth."""
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # not of every C library
    if mallopt is not None:
        mallopt(MMAP, LARGEST)
        mallopt(TRIM, 32 * LARGEST)


def _end_with_parent() -> None:
    if parent := multiprocessing.parent_process():
        wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)


def _work(item: Any) -> Any:
    return _make[0](item)
