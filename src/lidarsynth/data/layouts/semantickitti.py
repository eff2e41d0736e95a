"""SemanticKITTI: sequences/NN with velodyne/*.bin, labels/*.label, poses, calibration; rings, times and boxes beside.

Of scans of places, world w is in sequence w mod 11, so that the usual split (08 for validation) holds out every
eleventh world; a drive is a sequence.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from lidarsynth.data.layouts.calibration import camera_poses, numbers, odometry_calibration
from lidarsynth.data.layouts.layout import Content, Layout, Sizes, read_record
from lidarsynth.streets.frame import Frame, LabelledStreets
from lidarsynth.streets.world import POSES

SEQUENCES = 11  # those with labels, 00 to 10


def _place(streets: LabelledStreets, index: int) -> tuple[str, str]:
    """(folder of the sequence, number of the frame in it)."""
    world, number = streets.place(index)
    if streets.options.frames:
        return f"sequences/{world:02d}", f"{number:06d}"
    return f"sequences/{world % SEQUENCES:02d}", f"{world // SEQUENCES * POSES + number:06d}"


def _record(streets: LabelledStreets, index: int) -> str:
    sequence, name = _place(streets, index)
    return f"{sequence}/boxes/{name}.json"


def _scan(streets: LabelledStreets, index: int) -> str:
    sequence, name = _place(streets, index)
    return f"{sequence}/velodyne/{name}.bin"


def _files(streets: LabelledStreets, index: int, frame: Frame) -> Content:
    sequence, name = _place(streets, index)
    scan = frame.scan
    assert scan.ring is not None and scan.time is not None
    yield _scan(streets, index), np.column_stack([scan.xyz, scan.reflectance]).astype("<f4").tobytes()
    yield f"{sequence}/labels/{name}.label", frame.raw.astype("<u4").tobytes()
    yield f"{sequence}/rings/{name}.bin", scan.ring.astype("<u2").tobytes()
    yield f"{sequence}/point_times/{name}.bin", scan.time.astype("<f4").tobytes()


def _sizes(streets: LabelledStreets, index: int, points: int) -> Sizes:
    sequence, name = _place(streets, index)
    yield _scan(streets, index), 16 * points
    yield f"{sequence}/labels/{name}.label", 4 * points
    yield f"{sequence}/rings/{name}.bin", 2 * points
    yield f"{sequence}/point_times/{name}.bin", 4 * points


def _index(streets: LabelledStreets, path: Path) -> int:
    words = path.parent.parent.name, path.stem
    if not all(word.isdecimal() for word in words):
        return -1
    sequence, number = map(int, words)
    if streets.options.frames:
        return sequence * streets.options.frames + number
    return (number // POSES * SEQUENCES + sequence) * POSES + number % POSES


def _tables(streets: LabelledStreets, folder: Path) -> Content:
    places = [_place(streets, index) for index in range(len(streets))]
    for sequence in sorted({sequence for sequence, _ in places}):
        yield f"{sequence}/calib.txt", odometry_calibration().encode()
        if not streets.options.frames:
            continue
        names = [name for of, name in places if of == sequence]
        records = [read_record(folder / sequence / "boxes" / f"{name}.json") for name in names]
        poses = camera_poses(np.array([record["pose"] for record in records]))
        lines = "".join(numbers(pose) + "\n" for pose in poses).encode()
        yield f"{sequence}/poses.txt", lines
        yield sequence.replace("sequences/", "poses/") + ".txt", lines  # where KITTI's odometry has them
        stamps = [record["stamp"] - records[0]["stamp"] for record in records]
        yield f"{sequence}/times.txt", "".join(f"{stamp:.6e}\n" for stamp in stamps).encode()
        moved = {f"{int(name)}": record["boxes"] for name, record in zip(names, records, strict=True)}
        yield f"{sequence}/tracks.json", json.dumps(_tracks(moved)).encode()


def _tracks(boxes: dict[str, list[dict]]) -> dict[str, dict]:
    """Instance -> its kind, size, and its place, heading and velocity in the world by frame, at its stamp."""
    tracks: dict[str, dict] = {}
    for name, found in boxes.items():
        for box in found:
            track = tracks.setdefault(str(box["instance"]), {"kind": box["kind"], "size": box["size"], "frames": {}})
            late = box.get("late", 0.0)
            place = np.round(np.array(box["place"]) - late * np.array(box["world_velocity"]), 4).tolist()
            heading = round(box["heading"] - late * box.get("spin", 0.0), 5)
            track["frames"][name] = [*place, heading, *box["world_velocity"]]
    return tracks


SEMANTICKITTI = Layout(_record, _files, _sizes, _tables, "sequences/*/boxes/*.json", _index)
