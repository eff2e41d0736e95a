"""The rows of nuScenes v1.0's tables that labelled streets need, from the JSON of their frames."""

from __future__ import annotations

from collections.abc import Iterator
from hashlib import md5
from typing import Any, NamedTuple

import numpy as np

from lidarsynth.lidar.boxes import MOVES
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.streets.actors import KINDS

# Categories by their number in nuScenes-lidarseg.
CATEGORIES = (
    "noise", "animal", "human.pedestrian.adult", "human.pedestrian.child", "human.pedestrian.construction_worker",
    "human.pedestrian.personal_mobility", "human.pedestrian.police_officer", "human.pedestrian.stroller",
    "human.pedestrian.wheelchair", "movable_object.barrier", "movable_object.debris",
    "movable_object.pushable_pullable", "movable_object.trafficcone", "static_object.bicycle_rack", "vehicle.bicycle",
    "vehicle.bus.bendy", "vehicle.bus.rigid", "vehicle.car", "vehicle.construction", "vehicle.emergency.ambulance",
    "vehicle.emergency.police", "vehicle.motorcycle", "vehicle.trailer", "vehicle.truck", "flat.driveable_surface",
    "flat.other", "flat.sidewalk", "flat.terrain", "static.manmade", "static.other", "static.vegetation",
    "vehicle.ego",
)  # fmt: skip
ATTRIBUTES = ("vehicle.moving", "vehicle.parked", "pedestrian.moving", "pedestrian.standing", "cycle.with_rider",
              "cycle.without_rider")  # fmt: skip
VISIBLE = (("1", "v0-40"), ("2", "v40-60"), ("3", "v60-80"), ("4", "v80-100"))
EPOCH = 1_600_000_000_000_000  # microseconds; world w begins w * 1000 s later
SENSOR_TURN = (2**-0.5, 0.0, 0.0, -(2**-0.5))  # nuScenes' LIDAR_TOP looks along y, its carrier along x

Rows = Iterator[tuple[str, dict[str, Any]]]  # (table, row)


class Shot(NamedTuple):
    """One frame of a scene: its file, whether it is a key frame, and its JSON."""

    index: int
    filename: str
    is_key: bool
    record: dict[str, Any]


def token(*words: object) -> str:
    """32 hexadecimal digits that are the same whenever the words are."""
    return md5(" ".join(map(str, words)).encode(), usedforsecurity=False).hexdigest()


def microseconds(record: dict[str, Any]) -> int:
    """The time stamp of a frame; places of one world are half a second apart."""
    seconds = record["stamp"] or 0.5 * record["frame"]
    return EPOCH + record["world"] * 1_000_000_000 + round(seconds * 1e6)


def fixed_rows(sensor: Sensor) -> Rows:
    """What is the same in every set: words, the sensor, the map, the log."""
    for index, name in enumerate(CATEGORIES):
        yield "category", {"token": token("category", name), "name": name, "description": "", "index": index}
    for name in ATTRIBUTES:
        yield "attribute", {"token": token("attribute", name), "name": name, "description": ""}
    for number, level in VISIBLE:
        yield "visibility", {"token": number, "level": level, "description": ""}
    yield "sensor", {"token": token("sensor"), "channel": "LIDAR_TOP", "modality": "lidar"}
    yield (
        "calibrated_sensor",
        {
            "token": token("calibrated"),
            "sensor_token": token("sensor"),
            "translation": [0.0, 0.0, sensor.mount],
            "rotation": list(SENSOR_TURN),
            "camera_intrinsic": [],
        },
    )
    log = {"logfile": "streets", "vehicle": sensor.name, "date_captured": "2020-09-13", "location": "synthetic"}
    yield "log", {"token": token("log"), **log}
    area = {"category": "semantic_prior", "filename": "maps/empty.png", "log_tokens": [token("log")]}
    yield "map", {"token": token("map"), **area}


def scene_rows(world: int, name: str, shots: list[Shot], mount: float) -> Rows:
    """The scene, its samples, files, poses, instances and annotations."""
    keys = [shot for shot in shots if shot.is_key]
    samples = {shot.index: token("sample", shot.index) for shot in keys}
    order = list(samples.values())
    yield (
        "scene",
        {
            "token": token("scene", world),
            "name": name,
            "description": "synthetic street",
            "log_token": token("log"),
            "nbr_samples": len(keys),
            "first_sample_token": order[0],
            "last_sample_token": order[-1],
        },
    )
    for k, shot in enumerate(keys):
        links = {"prev": order[k - 1] if k else "", "next": order[k + 1] if k + 1 < len(order) else ""}
        stamp = microseconds(shot.record)
        yield "sample", {"token": order[k], "timestamp": stamp, "scene_token": token("scene", world), **links}
    for k in range(len(shots)):
        yield from _file_rows(shots, k, samples, mount)
    yield from _annotation_rows(world, keys, order)


def _file_rows(shots: list[Shot], k: int, samples: dict[int, str], mount: float) -> Rows:
    shot, stamp = shots[k], microseconds(shots[k].record)
    nearest = min(samples, key=lambda index: abs(index - shot.index))
    pose = np.array(shot.record["pose"])
    base = pose[:3, 3] - pose[:3, 2] * mount
    rotation = quaternion(pose[:3, :3])
    yield (
        "ego_pose",
        {
            "token": token("pose", shot.index),
            "timestamp": stamp,
            "rotation": rotation,
            "translation": [round(float(v), 5) for v in base],
        },
    )
    yield (
        "sample_data",
        {
            "token": token("data", shot.index),
            "sample_token": samples[nearest],
            "ego_pose_token": token("pose", shot.index),
            "calibrated_sensor_token": token("calibrated"),
            "filename": shot.filename,
            "fileformat": "pcd",
            "width": 0,
            "height": 0,
            "timestamp": stamp,
            "is_key_frame": shot.is_key,
            "prev": token("data", shots[k - 1].index) if k else "",
            "next": token("data", shots[k + 1].index) if k + 1 < len(shots) else "",
        },
    )
    if shot.is_key:
        label = {"filename": lidarseg_path(shot.index), "sample_data_token": token("data", shot.index)}
        yield "lidarseg", {"token": token("data", shot.index), **label}


def lidarseg_path(index: int) -> str:
    """Where the classes of key frame `index` are."""
    return f"lidarseg/v1.0-trainval/{token('data', index)}_lidarseg.bin"


def _annotation_rows(world: int, keys: list[Shot], samples: list[str]) -> Rows:
    """Instances that got a point in a key frame, each with its chain of annotations."""
    chains: dict[int, list[tuple[str, dict[str, Any]]]] = {}
    for shot, sample in zip(keys, samples, strict=True):
        for box in shot.record["boxes"]:
            if box["points"]:
                chains.setdefault(box["instance"], []).append((sample, box))
    for instance, chain in chains.items():
        own = token("instance", world, instance)
        names = [token("annotation", own, sample) for sample, _ in chain]
        kind = KINDS[chain[0][1]["kind"]]
        ends = {"first_annotation_token": names[0], "last_annotation_token": names[-1]}
        category = token("category", kind.nuscenes)
        yield "instance", {"token": own, "category_token": category, "nbr_annotations": len(chain), **ends}
        for k, (sample, box) in enumerate(chain):
            links = {"prev": names[k - 1] if k else "", "next": names[k + 1] if k + 1 < len(chain) else ""}
            yield "sample_annotation", _annotation(names[k], sample, own, box) | links


def _annotation(name: str, sample: str, instance: str, box: dict[str, Any]) -> dict[str, Any]:
    length, width, height = box["size"]
    half = box["heading"] / 2
    shown = 1 - box["occlusion"]
    level = 1 + int(np.searchsorted((0.4, 0.6, 0.8), shown, side="right"))
    return {
        "token": name,
        "sample_token": sample,
        "instance_token": instance,
        "visibility_token": str(level),
        "attribute_tokens": [token("attribute", attribute_of(box))],
        "translation": box["place"],
        "size": [width, length, height],
        "rotation": [float(np.cos(half)), 0.0, 0.0, float(np.sin(half))],
        "num_lidar_pts": box["points"],
        "num_radar_pts": 0,
    }


def attribute_of(box: dict[str, Any]) -> str:
    """nuScenes' word for what a road user is doing."""
    moves = float(np.linalg.norm(box["world_velocity"])) > MOVES
    if box["kind"] == "person":
        return "pedestrian.moving" if moves else "pedestrian.standing"
    if box["kind"] in ("bicycle", "motorcycle"):
        return "cycle.without_rider"
    if box["kind"] in ("bicyclist", "motorcyclist"):
        return "cycle.with_rider"
    return "vehicle.moving" if moves else "vehicle.parked"


def quaternion(rotation: np.ndarray) -> list[float]:
    """w, x, y, z of a rotation (3, 3), w >= 0 (Shepperd, 1978)."""
    m = rotation
    squares = np.array([1 + m[0, 0] + m[1, 1] + m[2, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2],
                        1 - m[0, 0] + m[1, 1] - m[2, 2], 1 - m[0, 0] - m[1, 1] + m[2, 2]])  # fmt: skip
    a = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    b = m[1, 0] + m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2]
    rows = (
        (squares[0], *a),
        (a[0], squares[1], b[0], b[1]),
        (a[1], b[0], squares[2], b[2]),
        (a[2], b[1], b[2], squares[3]),
    )
    q = np.array(rows[int(np.argmax(squares))])
    q = q / np.linalg.norm(q)
    return (q if q[0] >= 0 else -q).tolist()
