"""nuScenes v1.0 with lidarseg: samples and sweeps of LIDAR_TOP, and all thirteen tables; a world or drive is a scene.

Key frames are two a second, as in nuScenes; of scans of places every one is. There are no cameras.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from io import BytesIO
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
from PIL import Image

from lidarsynth.data.layouts.layout import Content, Layout, Sizes, is_held_out, numbered, read_record
from lidarsynth.data.layouts.nuscenes_tables import Shot, fixed_rows, lidarseg_path, scene_rows
from lidarsynth.lidar.semantic_kitti import RAW
from lidarsynth.streets.actors import KINDS
from lidarsynth.streets.frame import FURNITURE, Frame, LabelledStreets

VERSION = "v1.0-trainval"
TABLES = ("category", "attribute", "visibility", "sensor", "calibrated_sensor", "ego_pose", "log", "map", "scene",
          "sample", "sample_data", "instance", "sample_annotation", "lidarseg")  # fmt: skip
KEY_RATE = 2.0  # key frames per second
# lidarseg number of each training class, where no kind says more.
CLASS = np.array([29, 17, 14, 21, 23, 16, 2, 14, 21, 24, 24, 26, 25, 28, 28, 30, 30, 27, 28, 28], np.uint8)


def _is_key(streets: LabelledStreets, index: int) -> bool:
    every = max(round(streets.options.rate / KEY_RATE), 1)
    return not streets.options.frames or streets.place(index)[1] % every == 0


def _scan(streets: LabelledStreets, index: int) -> str:
    folder = "samples" if _is_key(streets, index) else "sweeps"
    return f"{folder}/LIDAR_TOP/streets__LIDAR_TOP__{index:06d}.pcd.bin"


def _record(_: LabelledStreets, index: int) -> str:
    return f"boxes/{index:06d}.json"


def _files(streets: LabelledStreets, index: int, frame: Frame) -> Content:
    scan = frame.scan
    assert scan.ring is not None and scan.label is not None
    x, y, z = scan.xyz.T
    ring = streets.sensor.height - 1 - scan.ring  # counted from the lowest beam
    points = np.column_stack([-y, x, z, scan.reflectance * 255, ring]).astype("<f4")
    yield _scan(streets, index), points.tobytes()
    if _is_key(streets, index):
        yield lidarseg_path(index), classes(frame).tobytes()


def _sizes(streets: LabelledStreets, index: int, points: int) -> Sizes:
    yield _scan(streets, index), 20 * points
    if _is_key(streets, index):
        yield lidarseg_path(index), points


def classes(frame: Frame) -> np.ndarray:
    """(N,) uint8 numbers of nuScenes-lidarseg."""
    assert frame.scan.label is not None
    table = np.zeros(1 << 16, np.uint8)
    table[RAW], table[FURNITURE] = CLASS, CLASS[0]
    for kind in KINDS.values():
        table[[kind.raw, kind.moving]] = kind.nuscenes_index
    return table[frame.raw & 0xFFFF]


def _tables(streets: LabelledStreets, folder: Path) -> Content:
    split: dict[str, list[str]] = {"train": [], "val": []}
    files = {name: TemporaryFile() for name in TABLES}  # noqa: SIM115
    try:
        for table, row in _rows(streets, folder, split):
            files[table].write((b",\n" if files[table].tell() else b"[\n") + json.dumps(row).encode())
        for name, file in files.items():
            file.write(b"\n]\n" if file.tell() else b"[]\n")
            file.seek(0)
            yield f"{VERSION}/{name}.json", file
    finally:
        for file in files.values():
            file.close()
    yield f"{VERSION}/splits.json", json.dumps(split).encode()
    yield "maps/empty.png", _empty_map()


def _rows(streets: LabelledStreets, folder: Path, split: dict[str, list[str]]) -> Iterator:
    yield from fixed_rows(streets.sensor)
    for world, indices in groupby(range(len(streets)), lambda index: streets.place(index)[0]):
        name = f"scene-{world:04d}"
        split["val" if is_held_out(world) else "train"].append(name)
        shots = [
            Shot(i, _scan(streets, i), _is_key(streets, i), read_record(folder / _record(streets, i))) for i in indices
        ]
        yield from scene_rows(world, name, shots, streets.sensor.mount)


def _empty_map() -> bytes:
    file = BytesIO()
    Image.new("L", (8, 8)).save(file, "PNG")
    return file.getvalue()


NUSCENES = Layout(_record, _files, _sizes, _tables, "boxes/*.json", numbered)
