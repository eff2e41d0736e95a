"""A scan as the bytes that the page draws: a JSON header, then one block per field, little-endian.

4 bytes "LSV1", uint32 length of the header, the header, then the blocks that it lists by name, type and count.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarsynth.files.fields import find
from lidarsynth.files.whole_numbers import stray
from lidarsynth.lidar.plural import plural
from lidarsynth.lidar.removal import own_classes
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.semantic_kitti import CLASSES
from lidarsynth.viewer.rows import rows_of

MAGIC = b"LSV1"
FINE = 0.01  # metres: positions are whole numbers of 16 bits while their step is below this


@dataclass(frozen=True)
class Shown:
    """What the page shows of one scan.

    boxes  records with kind, centre, size, yaw and, where known, velocity, as `lidarsynth streets` writes them
    notes  lines of what the viewer should say about it
    name   where only reading tells it, such as the stamp of a message
    """

    scan: Scan
    boxes: Sequence[Mapping[str, Any]] = ()
    notes: tuple[str, ...] = ()
    name: str = ""


def packed(shown: Shown) -> bytes:
    """The scan's bytes: xyz in steps of 1/32767 of the farthest coordinate (under 1 cm), fields of one byte a point."""
    scan, rows = shown.scan, rows_of(shown.scan)
    xyz, step = _positions(scan.xyz)
    blocks = {"xyz": xyz, "row": rows.row.astype("<i2"), **_fields(scan)}
    header = {
        "points": len(scan),
        "step": step,
        "strip": {"height": rows.height, "width": rows.width, "origin": rows.origin},
        "blocks": [{"name": name, "type": values.dtype.str[1:], "count": values.size}
                   for name, values in blocks.items()],
        "boxes": list(shown.boxes),
        "notes": [*shown.notes, *_classes_left_out(scan), *_confidence_left_out(scan), *_no_numbers(scan),
                  *([] if len(scan) else ["no point in this scan"])],
        "name": shown.name,
    }  # fmt: skip
    text = json.dumps(header, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    padded = (values.tobytes() + b"\0" * (-values.nbytes % 4) for values in blocks.values())
    return b"".join([MAGIC, struct.pack("<I", len(text)), text, *padded])


def _positions(xyz: np.ndarray) -> tuple[np.ndarray, float]:
    farthest = float(np.abs(xyz).max(initial=0.0))
    step = max(farthest, 1.0) / 32767
    if step > FINE:
        return xyz.astype("<f4"), 1.0
    return np.rint(xyz / np.float64(step)).astype("<i2"), step


def _fields(scan: Scan) -> dict[str, np.ndarray]:
    """The fields that colours are made of: reflectance and confidence in 255 steps, class, and new as 0 or 1."""
    fields: dict[str, np.ndarray] = {}
    if scan.reflectance.any():
        fields["reflectance"] = _in_255(scan.reflectance)
    if (classes := own_classes(scan)) is not None:
        fields["label"] = classes.astype(np.uint8)
    if (new := scan.extra.get("new")) is not None:
        fields["new"] = (np.asarray(new) > 0).astype(np.uint8)
    if (confidence := scan.extra.get("confidence")) is not None and np.isfinite(confidence).any():
        fields["confidence"] = _in_255(confidence)
    return fields


def _classes_left_out(scan: Scan) -> list[str]:
    """What is to be said of labels that are no class of ours, a line each."""
    name = find(dict(scan.extra), "label")
    if own_classes(scan) is not None or (name is None and "raw_label" not in scan.extra):
        return []
    if name is None:
        return ["classes left out: expected SemanticKITTI's raw ids in the field raw_label, found others"]
    found = stray(scan.extra[name], len(CLASSES) - 1)
    return [f"classes left out: expected training classes of 0-{len(CLASSES) - 1} in the field {name}, found {found}"]


def _confidence_left_out(scan: Scan) -> list[str]:
    """What is to be said of confidences none of which is a number, as of points that lost theirs on the way."""
    confidence = scan.extra.get("confidence")
    if confidence is None or not len(scan) or np.isfinite(confidence).any():
        return []
    return ["confidence left out: expected numbers from 0 to 1, found none"]


def _no_numbers(scan: Scan) -> list[str]:
    """What is to be said of points whose `new` is no number."""
    new = scan.extra.get("new")
    lost = 0 if new is None else len(new) - int(np.isfinite(new).sum())
    return [f"new is no number at {plural(lost, 'point')}; shown as measured"] if lost else []


def _in_255(values: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(np.nan_to_num(values.astype(np.float32)), 0, 1) * 255).astype(np.uint8)
