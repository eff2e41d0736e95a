"""nuScenes: the turns of LIDAR_TOP, from the data set's JSON tables alone, without the development kit."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarsynth.data.frames import Frame, Name, choose
from lidarsynth.files.fields import FileError
from lidarsynth.files.formats import read_with_report
from lidarsynth.lidar.scan import Scan

SPLITS = ("all", "mini", "trainval", "test")  # the versions of the tables; all = the only one there is
CHUNK = 1 << 20  # characters of a table at once
_BETWEEN = re.compile(r"[\s,]*")

TABLES: dict[str, dict[str, type]] = {  # what is read of the rows of each
    "scene": {"token": str, "name": str},
    "sample": {"token": str, "scene_token": str},
    "sensor": {"token": str, "channel": str},
    "calibrated_sensor": {"token": str, "sensor_token": str},
    "sample_data": {
        "token": str, "sample_token": str, "calibrated_sensor_token": str, "filename": str, "timestamp": int,
        "is_key_frame": bool,
    },
    "category": {"index": int, "name": str},
    "lidarseg": {"sample_data_token": str, "filename": str},
}  # fmt: skip

# lidarseg category -> SemanticKITTI training class; what has no counterpart is 0.
CLASS_OF_CATEGORY: dict[str, int] = {
    "vehicle.car": 1, "vehicle.emergency.police": 1, "vehicle.bicycle": 2, "vehicle.motorcycle": 3, "vehicle.truck": 4,
    "vehicle.bus.bendy": 5, "vehicle.bus.rigid": 5, "vehicle.construction": 5, "vehicle.trailer": 5,
    "vehicle.emergency.ambulance": 5, "human.pedestrian.adult": 6, "human.pedestrian.child": 6,
    "human.pedestrian.construction_worker": 6, "human.pedestrian.police_officer": 6, "flat.driveable_surface": 9,
    "flat.sidewalk": 11, "flat.other": 12, "static.manmade": 13, "movable_object.barrier": 14, "static.vegetation": 15,
    "flat.terrain": 17,
}  # fmt: skip


@dataclass(frozen=True)
class NuScenes:
    """A reader over LIDAR_TOP's files, in our frame, into which reading a `.pcd.bin` turns nuScenes' own.

    frames   one per scan, by scene and time; `frames[i].labels` is its lidarseg file, if it has one
    classes  (256,) SemanticKITTI class of each lidarseg category number
    Rings are counted from the top, reflectance is intensity / 255.
    """

    frames: Sequence[Frame]
    classes: np.ndarray
    missing: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Scan:
        frame = self.frames[index]
        scan, dropped = read_with_report(frame.path)
        label = None if frame.labels is None else self._labels(frame.labels, len(scan), dropped)
        return replace(scan, label=label)

    def _labels(self, path: str, count: int, dropped: int) -> np.ndarray:
        raw = np.fromfile(path, np.uint8) if Path(path).is_file() else np.zeros(0, np.uint8)
        if dropped or len(raw) != count:
            raise FileError(f"{path}: expected a label for each of {count + dropped} points, {dropped} of them lost, "
                            f"found {len(raw)}")  # fmt: skip
        return self.classes[raw]

    def name(self, index: int) -> Name:
        """nuscenes, the scene's name, and the time in microseconds."""
        return Name("nuscenes", self.frames[index].sequence, self.frames[index].frame)


def nuscenes(root: str | Path, split: str = "all", sweeps: bool = False) -> NuScenes:
    """ROOT/v1.0-*/{scene,sample,sample_data,...}.json and ROOT/samples/LIDAR_TOP/*.pcd.bin.

    split   version of the tables: `mini`, `trainval`, `test`, or `all` for the only one that `root` has
    sweeps  also the turns between the annotated key frames
    Files that the tables list and the disk lacks are left out; scenes without any are `missing`. Tables are read row by
    row, so that memory does not grow with them. Raises ValueError when a table is absent or broken, or no scan is left.
    """
    root = Path(root)
    tables = _tables(root, split)
    scenes = {row["token"]: row["name"] for row in rows(tables / "scene.json")}
    sample, sensor = tables / "sample.json", tables / "calibrated_sensor.json"
    scene_of = {row["token"]: _of(scenes, row, "scene", sample) for row in rows(sample)}
    kinds = {row["token"]: row["channel"] for row in rows(tables / "sensor.json")}
    tops = {row["token"] for row in rows(sensor) if _of(kinds, row, "sensor", sensor) == "LIDAR_TOP"}
    labels, classes = _lidarseg(root, tables)
    found = []
    for row in rows(tables / "sample_data.json"):
        if row["calibrated_sensor_token"] in tops and (sweeps or row["is_key_frame"]):
            path = root / row["filename"]
            if path.is_file():
                scene = _of(scene_of, row, "sample", tables / "sample_data.json")
                found.append(Frame(str(path), scene, str(row["timestamp"]), labels.get(row["token"])))
    if not found:
        raise ValueError(f"{root}: expected files of LIDAR_TOP as listed in {tables.name}, found none")
    found.sort(key=lambda frame: (frame.sequence, int(frame.frame)))
    missing = tuple(sorted(set(scenes.values()) - {frame.sequence for frame in found}))
    return NuScenes(found, classes, missing)


def _of(named: Mapping[str, str], row: Mapping[str, Any], table: str, path: Path) -> str:
    """What a row's token of another table stands for. Raises ValueError, naming the file, where that has no such."""
    token = row[f"{table}_token"]
    if token not in named:
        raise ValueError(f"{path}: expected tokens of {table}.json, found {token!r:.60}, which it lacks")
    return named[token]


def _tables(root: Path, split: str) -> Path:
    choose("nuscenes", split, SPLITS)
    there = sorted(path.name for path in root.glob("v1.0-*") if path.is_dir())
    wanted = there if split == "all" else [name for name in there if name == f"v1.0-{split}"]
    if len(wanted) != 1:
        expected = "one folder v1.0-*; choose a split" if split == "all" else f"v1.0-{split}"
        found = ", ".join(there) or "none: data files takes scans without tables"
        raise ValueError(f"{root}: expected {expected}, found {found}")
    return root / wanted[0]


def _lidarseg(root: Path, tables: Path) -> tuple[dict[str, str], np.ndarray]:
    """Label file by sample_data token, and (256,) training class by category number; empty without lidarseg."""
    classes = np.zeros(256, np.int32)
    if not (tables / "lidarseg.json").is_file():
        return {}, classes
    for row in rows(tables / "category.json"):
        if not 0 <= row["index"] < len(classes):
            raise ValueError(f"{tables / 'category.json'}: expected an index of 0 to 255, found {row['index']}")
        classes[row["index"]] = CLASS_OF_CATEGORY.get(row["name"], 0)
    return {row["sample_data_token"]: str(root / row["filename"]) for row in rows(tables / "lidarseg.json")}, classes


def rows(path: Path) -> Iterator[dict[str, Any]]:
    """The rows of a JSON table (a list of objects) of any size, one at a time. Raises ValueError, naming the file."""
    decoder = json.JSONDecoder()
    try:
        with open(path, encoding="utf-8") as file:
            text, at = file.read(CHUNK).lstrip(), 1
            if not text.startswith("["):
                raise ValueError(f"{path}: expected a JSON list of objects, found {text[:20]!r}")
            while True:
                try:
                    at = _BETWEEN.match(text, at).end()  # type: ignore[union-attr]
                    if text.startswith("]", at):
                        return
                    row, at = decoder.raw_decode(text, at)
                except json.JSONDecodeError as error:  # the row goes on in the next chunk, if there is one
                    more = file.read(CHUNK)
                    if not more:
                        raise ValueError(
                            f"{path}: expected JSON, found {error.msg} at {text[at : at + 40]!r}"
                        ) from None
                    text, at = text[at:] + more, 0
                else:
                    if not isinstance(row, dict):
                        raise ValueError(f"{path}: expected JSON objects, found {row!r:.40}")
                    _check(row, path)
                    yield row
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: expected a table of nuScenes, found: {error}") from None


def _check(row: Mapping[str, Any], path: Path) -> None:
    """Raises ValueError, naming the file, unless a row has the fields of its table, of their types."""
    for name, kind in TABLES.get(path.stem, {}).items():
        if type(row.get(name)) is not kind:
            found = repr(row[name]) if name in row else "none"
            raise ValueError(f"{path}: expected rows with {name} of type {kind.__name__}, found {found:.60}")
