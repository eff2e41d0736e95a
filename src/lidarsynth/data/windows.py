"""A stream of work through processes: answered in order, with only a few items under way at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future
from functools import partial
from typing import Any

from lidarsynth.data.workers import keep_memory, pool_of, watch_parent

# A bag appears whole or not at all, and is begun anew.
GOES_ON = "--workers 1 needs the least; into a folder the same command with --skip-existing goes on"
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
    waiting: deque[Future] = deque()
    with pool_of(workers, _start, make, GOES_ON) as submit:
        for item in items:
            waiting.append(submit(_do, item))
            if len(waiting) > 2 * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _start(make: Callable[[], Callable[[Any], Any]]) -> None:
    watch_parent()
    keep_memory()
    try:
        _work.append(make())
    except Exception as error:  # what an initialiser raises is lost, and the pool with it
        _work.append(partial(_refuse, error))


def _refuse(error: Exception, item: Any) -> Any:
    raise error


def _do(item: Any) -> Any:
    return _work[0](item)
