"""SemanticKITTI classes: raw `.label` words to the 20 training classes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidarsynth.data.fields import FileError

RAW_OF_CLASS: tuple[tuple[int, ...], ...] = (  # index = class (lidar/colours.py names them); 252-259 move
    (0, 1, 52, 99), (10, 252), (11,), (15,), (18, 258), (13, 16, 20, 256, 257, 259), (30, 254), (31, 253), (32, 255),
    (40, 60), (44,), (48,), (49,), (50,), (51,), (70,), (71,), (72,), (80,), (81,),
)  # fmt: skip


def _class_of_raw() -> np.ndarray:
    table = np.full(1 << 16, -1, np.int32)
    for training_class, raws in enumerate(RAW_OF_CLASS):
        table[list(raws)] = training_class
    return table


CLASS_OF_RAW = _class_of_raw()


def read_labels(path: str | Path, n: int) -> np.ndarray:
    """(n,) int32 training classes 0-19 of a SemanticKITTI `.label` file, in the point order of its `.bin`.

    Raises FileError when the file does not hold n words of 4 bytes or a raw id is not SemanticKITTI's.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise FileError(f"{path}: expected a readable .label file, found: {error.strerror}") from None
    if len(data) != 4 * n:
        raise FileError(f"{path}: expected {4 * n} bytes, one label of 4 for each of {n} points, found {len(data)}")
    raw = np.frombuffer(data, "<u4") & 0xFFFF  # the high half is the instance
    classes = CLASS_OF_RAW[raw]
    if np.any(classes < 0):
        raise FileError(f"{path}: expected SemanticKITTI's raw ids, found {int(raw[classes < 0][0])}")
    return classes
