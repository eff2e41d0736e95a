"""One .pcd a scan, with ring, timestamp, SemanticKITTI class and instance of each point, and a .json with the boxes."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np

from lidarsynth.data.layouts.layout import Content, Layout, Sizes, numbered
from lidarsynth.files.pcd import write_table
from lidarsynth.streets.frame import Frame, LabelledStreets

POINT = np.dtype([
    ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("timestamp", "<f8"),
    ("label", "<u4"), ("instance", "<u4"),
])  # fmt: skip


def _record(_: LabelledStreets, index: int) -> str:
    return f"{index:06d}.json"


def _scan(_: LabelledStreets, index: int) -> str:
    return f"{index:06d}.pcd"


def _files(streets: LabelledStreets, index: int, frame: Frame) -> Content:
    table, scan = np.zeros(len(frame.scan), POINT), frame.scan
    table["x"], table["y"], table["z"] = scan.xyz.T
    table["intensity"], table["ring"], table["timestamp"] = scan.reflectance, scan.ring, scan.time
    table["label"], table["instance"] = scan.label, frame.raw >> 16
    file = BytesIO()
    write_table(file, table)
    yield _scan(streets, index), file.getvalue()


def _sizes(streets: LabelledStreets, index: int, points: int) -> Sizes:
    yield _scan(streets, index), _header(points) + points * POINT.itemsize


def _header(points: int) -> int:
    """Bytes before the points: those of an empty file, whose number of points is written twice as one digit."""
    file = BytesIO()
    write_table(file, np.zeros(0, POINT))
    return file.tell() + 2 * (len(str(points)) - 1)


def _tables(_: LabelledStreets, __: Path) -> Content:
    yield from ()


PCD = Layout(_record, _files, _sizes, _tables, "*.json", numbered)
