"""A stream of work through processes: answered in order, with only a few items under way at a time."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from lidarsynth.data.workers import keep_memory, watch_parent

_work: list[Callable[[Any], Any]] = []  # of this worker process


def in_window(
    make: Callable[[], Callable[[Any], Any]], items: Iterable[Any], workers: int
) -> Generator[Any, None, None]:
    """make()(item) of each item, in order; make() once in each of `workers` processes, or here where fewer than two.

    Items are taken from their stream as results leave, two for each worker ahead, so memory does not grow with it.
    Raises what the work raises, and OSError when a worker is gone.
    """
    if workers < 2:
        work = make()
        yield from map(work, items)
        return
    # Not fork: threads of torch in this process would be copied in whatever state they are.
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _start, (make,))
    waiting: deque[Future] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(_do, item))
            if len(waiting) > 2 * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    except BrokenProcessPool:
        raise OSError(f"expected {workers} worker processes to stay, found one gone (out of memory?); the same command "
                      "with --skip-existing goes on") from None  # fmt: skip
    finally:
        pool.shutdown(cancel_futures=True)


def _start(make: Callable[[], Callable[[Any], Any]]) -> None:
    watch_parent()
    keep_memory()
    _work.append(make())


def _do(item: Any) -> Any:
    return _work[0](item)
