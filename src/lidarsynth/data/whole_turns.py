"""The turns of a capture that are worth a scan: it begins and ends in the midst of one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from typing import NamedTuple, TypeVar

from lidarsynth.files.fields import Fields, FileError

T = TypeVar("T")
Unread = Callable[[], Fields]  # a turn that is still in its packets, as it goes to another process, or is passed over

WHOLE, HALF = 0.9, 0.5  # of the turns beside it


class TimedTurn(NamedTuple):
    """A turn, and when the first and the last of its packets came, nanoseconds."""

    stamp: int
    time: int
    turn: Unread


def whole_turns(parts: Iterable[tuple[float, T]], fault: list[FileError] | None = None) -> Iterator[T]:
    """The turns, of parts (share of a turn, what is of it) as a capture has them.

    The first and the last, which a capture cuts, come if they are nine tenths as long as the one beside them; those
    between, which may have lost packets, if they are half as long: a sensor may be set to a sector. One that is alone
    comes from half a turn on. What a broken capture raises comes after the turns before it, and so does
    what `until_broken` has put on `fault` by then.
    """
    before, held = 0.0, None
    fault = [] if fault is None else fault
    for after in chain(until_broken(parts, fault), [(0.0, None)]):
        if held is not None:
            share, turn = held
            least = WHOLE if before == 0 or after[1] is None else HALF
            beside = max(before, after[0])
            if share >= least * beside and (beside > 0 or share > HALF):
                assert turn is not None
                yield turn
            before = share
        held = after
    if fault:
        raise fault[0]


def until_broken(items: Iterable[T], fault: list[FileError]) -> Iterator[T]:
    """The items before a FileError, which is put on `fault`."""
    try:
        yield from items
    except FileError as error:
        fault.append(error)
