"""KITTI's object benchmark: training/velodyne, label_2, calib and image_2, ImageSets; all boxes around in boxes/*.json.

label_2 holds what the virtual camera sees, as KITTI has it: things with a point in its image. The images
are dark: OpenPCDet asks for their size.
"""

from __future__ import annotations

from functools import lru_cache
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from lidarsynth.data.layouts.calibration import AXES, IMAGE, PROJECTION, object_calibration
from lidarsynth.data.layouts.layout import Content, Layout, Sizes, is_held_out, numbered
from lidarsynth.lidar.boxes import Box
from lidarsynth.streets.actors import KINDS
from lidarsynth.streets.frame import Frame, LabelledStreets

HIDDEN = (0.2, 0.6)  # shares from which an object is partly, and largely occluded
NEAREST = 0.1  # m before the camera where boxes are cut


def _record(_: LabelledStreets, index: int) -> str:
    return f"training/boxes/{index:06d}.json"


def _scan(_: LabelledStreets, index: int) -> str:
    return f"training/velodyne/{index:06d}.bin"


def _files(streets: LabelledStreets, index: int, frame: Frame) -> Content:
    scan = frame.scan
    points = np.column_stack([scan.xyz, scan.reflectance]).astype("<f4").tobytes()
    yield _scan(streets, index), points
    shown = in_view(frame)
    lines = [line for box in frame.boxes if box.instance in shown and (line := label_line(box))]
    yield f"training/label_2/{index:06d}.txt", "".join(f"{line}\n" for line in lines).encode()
    yield f"training/calib/{index:06d}.txt", object_calibration().encode()
    yield f"training/image_2/{index:06d}.png", _dark_image()


def _sizes(streets: LabelledStreets, index: int, points: int) -> Sizes:
    yield _scan(streets, index), 16 * points
    yield f"training/label_2/{index:06d}.txt", None
    yield f"training/calib/{index:06d}.txt", len(object_calibration())
    yield f"training/image_2/{index:06d}.png", len(_dark_image())


def in_view(frame: Frame) -> set[int]:
    """The instances that have a point in the camera's image."""
    x, y, z = AXES[:3, :3] @ frame.scan.xyz.T.astype(np.float64)
    ahead = z > NEAREST
    columns, rows, _ = PROJECTION[:, :3] @ np.stack([x, y, z])[:, ahead] / z[ahead]
    inside = (columns >= 0) & (columns < IMAGE[0]) & (rows >= 0) & (rows < IMAGE[1])
    return set((frame.raw[ahead][inside] >> 16).tolist()) - {0}


def label_line(box: Box) -> str | None:
    """The 15 fields of KITTI's label_2, or None for what has no type there or is out of the camera's view."""
    kind = KINDS[box.kind].kitti
    corners = box.corners() @ AXES[:3, :3].T
    if not kind or (corners[:, 2] > NEAREST).sum() < 4:
        return None
    corners[:, 2] = np.maximum(corners[:, 2], NEAREST)
    pixels = (corners @ PROJECTION[:, :3].T)[:, :2] / corners[:, 2:]
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    inside = np.clip(low, 0, np.array(IMAGE) - 1.0), np.clip(high, 0, np.array(IMAGE) - 1.0)
    shown = np.prod(inside[1] - inside[0])
    if shown <= 0:
        return None
    truncated = 1 - shown / np.prod(high - low)
    length, width, height = box.size
    x, y, z = AXES[:3, :3] @ (np.array(box.centre) - (0, 0, height / 2))
    turn = _within(-box.yaw - np.pi / 2)
    level = int(np.searchsorted(HIDDEN, box.occlusion, side="right"))
    numbers = (_within(turn - np.arctan2(x, z)), *inside[0], *inside[1], height, width, length, x, y, z, turn)
    return f"{kind} {truncated:.2f} {level} " + " ".join(f"{value:.2f}" for value in numbers)


def _within(angle: float) -> float:
    """The angle between -pi and pi."""
    return float(np.arctan2(np.sin(angle), np.cos(angle)))


@lru_cache(maxsize=1)
def _dark_image() -> bytes:
    file = BytesIO()
    Image.new("RGB", IMAGE).save(file, "PNG")
    return file.getvalue()


def _tables(streets: LabelledStreets, _: Path) -> Content:
    held = [is_held_out(streets.place(index)[0]) for index in range(len(streets))]
    sets = {"train": [not h for h in held], "val": held, "trainval": [True] * len(held), "test": [False] * len(held)}
    for name, chosen in sets.items():
        yield f"ImageSets/{name}.txt", "".join(f"{i:06d}\n" for i, there in enumerate(chosen) if there).encode()


KITTI = Layout(_record, _files, _sizes, _tables, "training/boxes/*.json", numbered)
