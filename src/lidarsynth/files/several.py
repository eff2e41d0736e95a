"""Fields of several numbers a point, such as `normal` or `fpfh`: each number becomes a field of its own."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

MOST = 384  # such numbers of a point: SHOT's 352 fit; of more a scan that is completed would be no file that is read
PADDING = "_"  # the name of what stands between fields
RUN = 4  # names in a row, of which the first and the last are told


def numbered(names: Sequence[str], counts: Sequence[int]) -> list[list[str]]:
    """The names of each field's numbers: of one number its own, of several `name_0`, `name_1`, ..., or with a number
    behind where another field has that name. None of padding of several, and of what `several_left_out` tells."""
    used = {name for name, count in zip(names, counts, strict=True) if count <= 1}
    room, found = MOST, []
    for name, count in zip(names, counts, strict=True):
        own = [name] if count <= 1 else []
        if 1 < count <= room and name != PADDING:
            room -= count
            own = [_unused(f"{name}_{i}", used) for i in range(count)]
            used.update(own)
        found.append(own)
    return found


def several_left_out(names: Sequence[str], counts: Sequence[int]) -> str | None:
    """What is said of fields of so many numbers that `numbered` leaves them out, in one line, or None."""
    pairs = zip(names, counts, numbered(names, counts), strict=True)
    left = [f"{name[:40]} of {count}" for name, count, own in pairs if not own and name != PADDING]
    if not left:
        return None
    told = ", ".join(left[:RUN]) + (", ..." if left[RUN:] else "")
    return f"expected fields of several numbers, at most {MOST} in all, found {told}: left out"


def listed(names: Iterable[str]) -> list[str]:
    """The names as they are told: of more than RUN numbers of one field in a row the first and the last."""
    told: list[str] = []
    run: list[str] = []
    for name in (*names, ""):
        if run and not _follows(run[-1], name):
            told += run if len(run) <= RUN else [run[0], "...", run[-1]]
            run = []
        run.append(name)
    return told


def _unused(name: str, used: set[str]) -> str:
    word, number = name, 1
    while word in used:
        number += 1
        word = f"{name}_{number}"
    return word


def _follows(before: str, name: str) -> bool:
    one, two = (re.fullmatch(r"(.*_)(\d{1,9})", word, re.DOTALL) for word in (before, name))
    return bool(one and two and one[1] == two[1] and int(one[2]) + 1 == int(two[2]))
