"""What the page colours points by: for each word a scale with its ramp, ticks and unit, or a list of classes.

The colours are those of `pictures`, so that a scan looks the same in a figure and in the browser.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from lidarsynth.lidar.ground import plane
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.semantic_kitti import CLASSES
from lidarsynth.pictures.colours import NEAREST, height_colours, range_colours, viridis

SHADES = 256  # of a ramp
ENDS = (20.0, 40.0, 60.0, 80.0, 120.0, 200.0, 300.0, 500.0)  # metres where range colours may end
BELOW, ABOVE = 0.6, 5.4  # metres below and above the ground where height colours end
MEASURED, NEW = (126, 138, 156), (255, 159, 28)  # grey-blue and orange: told apart by all eyes


def colourings(first: Scan) -> dict[str, dict[str, Any]]:
    """Scales by word, fitted to the first scan and the same for all others of the page, so that colours compare.

    A scale has kind (linear, sqrt or log), low and high in its unit, `shades` (256 RGB in base64) and ticks; a list of
    classes has `classes`, (name, RGB) each. `fields` names what a scan must have.
    """
    distance = np.linalg.norm(first.xyz, axis=1)
    far = float(np.percentile(distance, 99)) if len(distance) else 80.0
    end = next((end for end in ENDS if end >= far), ENDS[-1])
    low, high = _heights(first)
    unit = np.linspace(0, 1, SHADES)
    return {
        "range": _scale("Range", "m", "log", NEAREST, end, range_colours(_log(unit, NEAREST, end), end),
                        [tick for tick in (2, 5, 10, 20, 40, 80, 160, 320) if tick <= end]),
        "height": _scale("Height above the sensor", "m", "linear", low, high,
                         height_colours(low + unit * (high - low), low, high),
                         list(range(math.ceil(low), math.floor(high) + 1))),
        "reflectance": _scale("Reflectance", "0 to 1", "sqrt", 0, 1, viridis(unit), [0, 0.1, 0.25, 0.5, 1],
                              ["reflectance"]),
        "label": {"title": "Class", "fields": ["label"], "classes": [[name, list(rgb)] for name, rgb in CLASSES]},
        "new": {"title": "Measured or new", "fields": ["new"],
                "classes": [["measured", list(MEASURED)], ["filled in", list(NEW)]]},
        "confidence": _scale("Confidence", "chance of being right", "linear", 0, 1, viridis(unit),
                             [0, 0.25, 0.5, 0.75, 1], ["confidence"]),
    }  # fmt: skip


def ground_height(first: Scan) -> float:
    """z of the ground below the sensor in metres, for the rings of distance; -1.7 where none is seen."""
    found = plane(first.xyz)
    return -1.7 if found is None else -found[0]


def _heights(first: Scan) -> tuple[float, float]:
    ground = ground_height(first)
    return round(ground - BELOW, 1), round(ground + ABOVE, 1)


def _log(unit: np.ndarray, low: float, high: float) -> np.ndarray:
    """Where a share of the way from low to high lies on the scale log2(d + 1)."""
    return np.exp2(np.log2(low + 1) + unit * np.log2((high + 1) / (low + 1))) - 1


def _scale(
    title: str,
    unit: str,
    kind: str,
    low: float,
    high: float,
    shades: np.ndarray,
    ticks: list[float],
    fields: Sequence[str] = (),
) -> dict[str, Any]:
    return {
        "title": title,
        "unit": unit,
        "kind": kind,
        "low": low,
        "high": high,
        "ticks": ticks,
        "shades": base64.b64encode(shades.astype(np.uint8).tobytes()).decode(),
        "fields": list(fields),
    }
