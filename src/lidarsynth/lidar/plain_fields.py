"""Fields of a sensor's file, each of the type that it is written in: no text or true is taken for a number."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Real
from typing import Any

import numpy as np

METRES = ("min_range", "max_range", "mount")  # fields that are one number each
TRUTH = (bool, np.bool_)  # numbers, to Python


def check_plain(values: Mapping[str, Any], source: str) -> None:
    """Raises ValueError, which begins with the source, for a field of a sensor's table that is one value, of another
    type than its own."""
    if not isinstance(name := values.get("name", "own"), str) or not name.strip():
        raise ValueError(f"{source}: expected a word as name, found {name!r:.60}")
    if (edges := values.get("edges", False)) not in (False, True):
        raise ValueError(f"{source}: expected true or false as edges, found {edges!r:.60}")
    if not _is(int, width := values.get("width", 4)):
        raise ValueError(f"{source}: expected a whole number of columns as width, found {width!r:.60}")
    for key in METRES:
        if not _is(Real, value := values.get(key, 1)):
            raise ValueError(f"{source}: expected numbers in the sensor's fields, found {value!r:.60} as {key}")
        if value == np.inf or (key == "mount" and value < 0):
            raise ValueError(f"{source}: expected finite metres, of a mount 0 or more, found {value} as {key}")


def evenly_spaced(beams: Any, top: Any, bottom: Any, source: str) -> list[float]:
    """Elevations of `beams` from top to bottom, in degrees. Raises ValueError, which begins with the source."""
    if not (_is(int, beams) and 1 <= beams <= 1024):
        raise ValueError(f"{source}: expected beams of 1 to 1024, found {beams!r}")
    first, last = numbers([top, bottom], source, "top and bottom")
    if not np.isfinite([first, last]).all():
        raise ValueError(f"{source}: expected finite top and bottom, found {first} and {last}")
    return np.linspace(first, last, beams).tolist()


def numbers(values: Any, source: str, field: str) -> list[float]:
    """A list of numbers. Raises ValueError, which begins with the source and names the field, for what is none: digits
    in a text, too."""
    try:
        if isinstance(values, str) or any(isinstance(value, (str, *TRUTH)) for value in values):
            raise TypeError
        return [float(value) for value in values]
    except (TypeError, ValueError, OverflowError):
        found = f"{values!r:.60} as {field}" + (list_of(field) if _is(Real, values) else "")
        raise ValueError(f"{source}: expected numbers in the sensor's fields, found {found}") from None


def list_of(field: str) -> str:
    """What is said of one number in the place of a list."""
    return ", where a list belongs" + (": [pitch, roll]" if field == "tilt" else "")


def _is(kind: type, value: Any) -> bool:
    return isinstance(value, kind) and not isinstance(value, TRUTH)
