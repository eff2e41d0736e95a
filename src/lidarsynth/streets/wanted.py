"""Which road users are to stand in a scan: kinds, how many, and where, in the words that somebody asks in."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from lidarsynth.streets.actors import KINDS

MOST = 100  # in one scan
GRAMMAR = "KIND, KIND:COUNT or KIND@X/Y/DEGREES, joined by commas, such as car:2,person@8/-3"


class Wanted(NamedTuple):
    """One road user: a word of `actors.KINDS`; where its middle stands, metres ahead and to the left of the sensor, or
    None = where there is room; yaw: radians, of its front, counter-clockwise from straight ahead, or None."""

    kind: str
    place: tuple[float, float] | None = None
    yaw: float | None = None


def wanted(things: str | Sequence[str]) -> list[Wanted]:
    """What words ask for, as GRAMMAR has it, each in a string of its own or joined by commas; those with a place first.

    Raises ValueError for other words, and for none or more than MOST.
    """
    texts = [things] if isinstance(things, str) else things
    if not isinstance(texts, Sequence) or not all(isinstance(text, str) for text in texts):
        raise ValueError(f"expected {GRAMMAR}, as text or a list of texts, found {things!r:.80}")
    words = [word.strip() for text in texts for word in text.split(",")]
    found = [one for word in words for one in _of_word(word)]
    if not 0 < len(found) <= MOST:
        raise ValueError(f"expected 1 to {MOST} things to insert, found {len(found)}")
    return sorted(found, key=lambda one: one.place is None)


def _of_word(word: str) -> list[Wanted]:
    kind, at, place = word.partition("@")
    kind, colon, count = kind.partition(":") if not at else (kind, "", "")
    if kind not in KINDS:
        raise ValueError(f"expected {GRAMMAR}, with a kind of {', '.join(KINDS)}, found {word!r}")
    if at:
        return [Wanted(kind, *_place(word, place))]
    if colon and not (count.isascii() and count.isdigit() and 0 < int(count) <= MOST):
        raise ValueError(f"expected {GRAMMAR}, with a count of 1 to {MOST}, found {word!r}")
    return [Wanted(kind)] * (int(count) if colon else 1)


def _place(word: str, text: str) -> tuple[tuple[float, float], float | None]:
    """Place and yaw of X/Y or X/Y/DEGREES."""
    try:
        numbers = [float(part) for part in text.split("/")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"expected {GRAMMAR}, with a place of two numbers of metres and, maybe, degrees, found "
                         f"{word!r}")  # fmt: skip
    x, y, *turn = numbers
    return (x, y), math.radians(turn[0]) if turn else None
