"""Which points are read, and how they are moved into the sensor's frame, as words and files say it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidarsynth.lidar.frame import parse_axes, parse_transform
from lidarsynth.lidar.small_file import LARGEST, check_regular

FARTHEST = 1e9  # metres; no two frames on Earth are as far apart, and points there still have squares in float32


def parse_rings(text: str | None) -> tuple[int, int] | None:
    """(32, 63) from 32-63; None is all. Raises ValueError."""
    if text is None:
        return None
    first, dash, last = text.partition("-")
    if not (dash and first.isdecimal() and last.isdecimal() and int(first) <= int(last) < 1 << 16):
        raise ValueError(f"expected --rings FIRST-LAST, such as 32-63, found {text!r:.60}")
    return int(first), int(last)


def read_transform(text: str | None, mount: float | None = None, axes: str = "flu") -> np.ndarray | None:
    """(4, 4) from x:y:z:roll:pitch:yaw, or a file of 12 or 16 numbers (.txt, .npy), and then down by `mount` metres.

    mount  height of the sensor above the points' z = 0, such as the ground
    axes   where the points' own x, y and z point, as `parse_axes` reads it; undone first
    None of them is no transform at all.
    Raises ValueError for anything that is no rigid motion, and for a shift that is not finite or beyond FARTHEST.
    """
    turned = parse_axes(axes)
    if text is None and mount is None and np.array_equal(turned, np.eye(4)):
        return None
    matrix = np.eye(4) if text is None else _matrix_file(Path(text)) if Path(text).is_file() else parse_transform(text)
    for option, given, shift in (("transform", text, matrix[:3, 3]), ("mount", mount, mount or 0.0)):
        if not (np.abs(shift) <= FARTHEST).all():
            raise ValueError(f"expected --{option} of finite metres, at most {FARTHEST:g}, found {given}")
    down = np.eye(4)
    down[2, 3] = -(mount or 0.0)
    return down @ matrix @ turned


def _matrix_file(path: Path) -> np.ndarray:
    check_regular(path, LARGEST)
    try:
        numbers = np.load(path, allow_pickle=False) if path.suffix == ".npy" else np.loadtxt(path)
    except (ValueError, OSError) as error:
        raise ValueError(f"{path}: expected 4 x 4 numbers, found: {error}") from None
    if numbers.size not in (12, 16):
        raise ValueError(f"{path}: expected 4 x 4 numbers, or the upper 3 x 4, found {numbers.size}")
    matrix = np.eye(4)
    matrix.reshape(-1)[: numbers.size] = numbers.reshape(-1)
    rotation = matrix[:3, :3]
    if not (np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0):
        raise ValueError(f"{path}: expected a rotation and a shift, found a matrix that stretches or mirrors")
    return matrix
