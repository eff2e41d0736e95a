"""Work shared among processes, answered in order."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import chain, islice
from multiprocessing.connection import wait
from typing import Any, TypeVar

TRIM, MMAP = -1, -3  # of mallopt(3): memory above the one goes back to the system, above the other it comes apart
LARGEST = 1 << 25  # bytes, of MMAP; what glibc allows at most
AHEAD = 16  # items of each process that are begun or wait for it: there may be more in all than memory holds

Item = TypeVar("Item")
_make: list[Callable[[Any], Any]] = []  # of this worker process; sent once, not with every item


def in_order(
    make: Callable[[Item], Any], items: Iterable[Item], workers: int, abandon: bool = False
) -> Generator[Any, None, None]:
    """make(item) of each item, in order, by `workers` processes, or by this one where fewer than two have work.

    `make` must be picklable where there are workers. What it raises is raised here. Closing the generator ends the
    workers after their present item, or, with `abandon`, at once, as items that take a minute ask for. Raises OSError
    when a worker is gone.
    """
    items = iter(items)
    first = list(islice(items, max(workers, 0)))
    workers, items = min(workers, len(first)), chain(first, items)
    if workers < 2:
        yield from map(make, items)
        return
    # Not fork: threads of torch in this process would be copied in whatever state they are.
    others, done = set(multiprocessing.active_children()), False
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _start, (make,))
    try:
        begun = deque(pool.submit(_work, item) for item in islice(items, AHEAD * workers))
        while begun:
            future = begun.popleft()
            yield future.result()
            begun.extend(pool.submit(_work, item) for item in islice(items, 1))
        done = True
    except BrokenProcessPool:
        raise OSError(f"expected {workers} worker processes to stay, found one gone (out of memory?); the same command "
                      "goes on, and --workers 1 needs the least") from None  # fmt: skip
    finally:
        for worker in set(multiprocessing.active_children()) - others if abandon and not done else ():
            worker.terminate()
        pool.shutdown(cancel_futures=True)


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
