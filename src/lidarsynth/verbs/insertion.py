"""What the verb `insert` does with one scan: put road users into it, and say where they stand."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lidarsynth.files.labels import MOST_INSTANCES
from lidarsynth.lidar.boxes import Box
from lidarsynth.lidar.frame import transformed
from lidarsynth.lidar.plural import plural
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.removal import own_classes
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.lidar.small_file import LARGEST_INDEX, read_json
from lidarsynth.lidar.whole_file import write_whole
from lidarsynth.streets.turn import LEANING, sensor_pose, told_of_tilt
from lidarsynth.streets.wanted import Wanted
from lidarsynth.verbs.completion import Filled

if TYPE_CHECKING:
    from lidarsynth.systems.scan_model import ScanModel

BOXES = ".json"  # ending of the file of boxes, as `streets --format pcd` has it
LYING = 60.0  # degrees off upright, at which no box that stands upright says where a thing is


def insert_scan(model: ScanModel, scan: Scan, things: Sequence[Wanted], sensor: Sensor, seed: int = 0) -> Filled:
    """A scan of `sensor` with road users more. Raises ValueError as `ScanModel.insert` does."""
    from lidarsynth.systems.insertion import INSTANCE, inserted

    found = inserted(model.suited_to(scan, sensor), scan, things, np.random.default_rng(seed))
    image = project(replace(found.scan, label=own_classes(found.scan)), sensor)
    number = project(replace(found.scan, label=found.scan.extra[INSTANCE]), sensor).label
    image = replace(image, completed=found.scan, instance=number, boxes=found.boxes)
    return Filled(image, lambda: {"measured": project(scan, sensor), "inserted": image}, {}, scan)


def leaning(sensor: Sensor, transform: np.ndarray | None) -> float:
    """Degrees, 0 to 90, between what is upright and the z axis of points that (4, 4) `transform` brings to a sensor."""
    up = sensor_pose(sensor, np.zeros(6))[2, :3]
    z = up[2] if transform is None else up @ transform[:3, 2]
    return float(np.degrees(np.arccos(min(abs(z), 1.0))))


def check_upright(target: Path | None, sensor: Sensor, transform: np.ndarray | None) -> None:
    """Raises ValueError where boxes beside `target` would be in a frame that lies on its side; see `write_boxes`."""
    if target is None or target.suffix.lower() == ".npz" or transform is None:
        return
    if (lean := leaning(sensor, transform)) > LYING:
        raise ValueError(f"{target}: expected points whose z is up or down, as boxes stand, found it "
                         f"{lean:.0f} degrees off; beside a .npz they are in the sensor's frame")  # fmt: skip


def told_of(filled: Filled, scan: Scan, things: Sequence[Wanted], transform: np.ndarray | None = None) -> str:
    """What was inserted, in words, what found no room, and that boxes lean in the points' frame; see `write_boxes`."""
    boxes = filled.image.boxes
    asked, found = Counter(thing.kind for thing in things), Counter(box.kind for box in boxes)
    points = sum(box.points for box in boxes)
    gone = len(scan) + points - len(filled.points)
    text = f"inserted {_listed(found)}: {plural(points, 'point')}, in place of {gone} of {len(scan)}"
    room = f"no room was found for {_listed(asked - found)}" if asked - found else ""
    tilt = told_of_tilt(filled.image.sensor)
    if transform is not None:
        lean = leaning(filled.image.sensor, transform)
        told = f"z of the points is {lean:.0f} degrees off, and boxes, upright in their frame, lack points of theirs"
        tilt = told if lean >= LEANING else ""
    return "; ".join(filter(None, (text, room, tilt)))


def _listed(kinds: Counter[str]) -> str:
    return ", ".join(f"{count} {kind}" for kind, count in kinds.items())


def check_boxes(target: Path, source: Path, count: int) -> None:
    """Raises ValueError where the boxes beside `target` would replace a file that holds none, or those of `source`, a
    file of `count` points."""
    file = target.with_suffix(BOXES)
    if not file.exists():
        return
    try:
        found = read_json(file, LARGEST_INDEX)
    except (OSError, ValueError):
        found = None
    if not (isinstance(found, dict) and found.keys() == {"points", "boxes"}):
        raise ValueError(f"{target}: expected a name beside which {file.name} may be written, found another file there")
    own = source.with_suffix(BOXES)
    if own.exists() and own.samefile(file) and found["points"] == count:
        raise ValueError(f"{target}: expected a name whose {BOXES} is not that of {source}, found {file}")


def check_numbers(target: Path, points: Scan) -> None:
    """Raises ValueError where a `.label` beside `target` would be without the numbers of the points' boxes."""
    number = points.extra["instance"]
    if "raw_label" not in points.extra and (stray := number[(number < 0) | (number > MOST_INSTANCES)]).size:
        raise ValueError(f"{target}: expected instances of 0-{MOST_INSTANCES} for a .label, found {stray[0]}; a .ply "
                         "or .pcd holds others")  # fmt: skip


def write_boxes(target: Path, filled: Filled, transform: np.ndarray | None) -> None:
    """The boxes beside `target`: of a range image, in its sensor's frame and with the points that are its pixels; else
    in the frame of the file's points, which (4, 4) `transform` had brought into the sensor's."""
    image, count = filled.image, len(filled.points)
    boxes: Sequence[Box] = image.boxes
    if target.suffix.lower() == ".npz":
        count = int(image.mask.sum())
        boxes = [replace(box, points=int((image.instance == box.instance).sum())) for box in boxes]
    elif transform is not None:
        up = sensor_pose(image.sensor, np.zeros(6))[2, :3]
        boxes = [_back(box, np.linalg.inv(transform), up) for box in boxes]
    record: dict[str, Any] = {"points": count, "boxes": [box.record() for box in boxes]}
    write_whole(target.with_suffix(BOXES), json.dumps(record))


def _back(box: Box, matrix: np.ndarray, up: np.ndarray) -> Box:
    """The box through a (4, 4) rigid transform or mirror; `up` (3,) is upright in the frame that it comes from."""
    x, y, z = transformed(np.array([box.centre]), matrix)[0].astype(float).tolist()
    c, s = np.cos(box.yaw), np.sin(box.yaw)
    ahead = matrix[:3, :3] @ [c, s, -(up[0] * c + up[1] * s) / up[2]]  # level, though the frame is tilted
    yaw = float(np.arctan2(ahead[1], ahead[0]))
    return replace(box, centre=(x, y, z), place=(x, y, z), yaw=yaw, heading=yaw)
