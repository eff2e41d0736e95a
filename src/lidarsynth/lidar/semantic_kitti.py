"""SemanticKITTI's 20 training classes: names, usual colours, and the raw ids of its `.label` files."""

from __future__ import annotations

import numpy as np

# SemanticKITTI's training classes with the colours of its own figures (Behley et al., 2019).
CLASSES: tuple[tuple[str, tuple[int, int, int]], ...] = (
    ("unlabeled", (90, 90, 90)),
    ("car", (100, 150, 245)),
    ("bicycle", (100, 230, 245)),
    ("motorcycle", (30, 60, 150)),
    ("truck", (80, 30, 180)),
    ("other-vehicle", (0, 0, 255)),
    ("person", (255, 30, 30)),
    ("bicyclist", (255, 40, 200)),
    ("motorcyclist", (150, 30, 90)),
    ("road", (255, 0, 255)),
    ("parking", (255, 150, 255)),
    ("sidewalk", (75, 0, 75)),
    ("other-ground", (175, 0, 75)),
    ("building", (255, 200, 0)),
    ("fence", (255, 120, 50)),
    ("vegetation", (0, 175, 0)),
    ("trunk", (135, 60, 0)),
    ("terrain", (150, 240, 80)),
    ("pole", (255, 240, 150)),
    ("traffic-sign", (255, 0, 0)),
)

CLASS_NUMBER = {name: number for number, (name, _) in enumerate(CLASSES)}
CLASS_COLOURS = np.array([colour for _, colour in CLASSES], np.uint8)

RAW_OF_CLASS: tuple[tuple[int, ...], ...] = (  # index = class (CLASSES names them); 252-259 move
    (0, 1, 52, 99), (10, 252), (11,), (15,), (18, 258), (20, 13, 16, 256, 257, 259), (30, 254), (31, 253), (32, 255),
    (40, 60), (44,), (48,), (49,), (50,), (51,), (70,), (71,), (72,), (80,), (81,),
)  # fmt: skip


def _class_of_raw() -> np.ndarray:
    table = np.full(1 << 16, -1, np.int32)
    for training_class, raws in enumerate(RAW_OF_CLASS):
        table[list(raws)] = training_class
    return table


CLASS_OF_RAW = _class_of_raw()
RAW = np.array([raws[0] for raws in RAW_OF_CLASS], np.uint32)  # stands for each class where nothing says more
