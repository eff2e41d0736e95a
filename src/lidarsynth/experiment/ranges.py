"""Which values a field may have: said once, at the field, and so for the command line and every file alike."""

from __future__ import annotations

import math
from dataclasses import field, fields
from typing import Any

FINITE = (-(2.0**62), 2.0**62)
LARGEST = 3.4e38  # that a tensor of float32 takes


def within(default: Any, least: float, most: float = FINITE[1]) -> Any:
    """A field of a record with a range, ends included: of the number, or of each number of a tuple. None passes."""
    return field(default=default, metadata={"range": (least, most)})


def check_ranges(record: Any) -> None:
    """Raises ValueError by the field's name for a number out of its range; without one, for NaN and absurd numbers."""
    for part in fields(record):
        least, most = part.metadata.get("range", FINITE)
        value = getattr(record, part.name)
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, bool) or not isinstance(number, int | float):
                continue
            limit = LARGEST if most == FINITE[1] and isinstance(number, float) else most
            if not (math.isfinite(number) and least <= number <= limit):
                ends = most < FINITE[1] or number > limit
                span = f"{_plain(least)} to {_plain(limit)}" if ends else f"at least {_plain(least)}"
                raise ValueError(f"{part.name}: expected {span}, found {str(number)[:40]}")


def _plain(number: float) -> str:
    return f"{number:,.0f}" if number == int(number) and abs(number) < 1e15 else f"{number:g}"
