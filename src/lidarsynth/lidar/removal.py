"""Which rays show what stands behind a thing, once it is taken away."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from lidarsynth.lidar.pieces import pieces
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER, CLASS_OF_RAW

# What is there one day and not another: SemanticKITTI's things.
TRAFFIC = ("car", "bicycle", "motorcycle", "truck", "other-vehicle", "person", "bicyclist", "motorcyclist")
GROUND = ("road", "parking", "sidewalk", "other-ground", "terrain")
MOST, HARDLY = 0.5, 0.15  # of a piece of what stands: of which more is to go, it goes whole; less, it stays
ROOF = 0.6  # metres above a thing's highest return: panes and a dark roof. Chosen on streets (docs/completion.md)
NEARER = (0.3, 0.02)  # metres, and share of the range, by which nothing was in the way of what was taken away


def removable(classes: str | Sequence[str]) -> tuple[str, ...]:
    """SemanticKITTI's words, as a sequence or joined by commas, `traffic` for all of TRAFFIC; each once, in order of
    their numbers. Raises ValueError for other words, and for none."""
    classes = classes.split(",") if isinstance(classes, str) else classes
    words = [*classes] if isinstance(classes, Iterable) else [classes]
    words = [word.strip() if isinstance(word, str) else word for word in words]
    words = [of for word in words for of in (TRAFFIC if word == "traffic" else (word,))]
    known = [word for word in CLASS_NUMBER if CLASS_NUMBER[word]]
    if not words or (unknown := [word for word in words if word not in known]):
        found = repr(unknown[0]) if words else "none"
        raise ValueError(f"expected classes to take away of traffic, {', '.join(known)}, found {found}")
    return tuple(word for word in known if word in words)


def in_words(classes: Sequence[str]) -> str:
    """What `removable` gave, in few words."""
    return "traffic" if tuple(classes) == TRAFFIC else ", ".join(classes)


def own_classes(scan: Scan) -> np.ndarray | None:
    """(N,) the classes that a scan says its points are of, by its labels or the raw ids of SemanticKITTI's `.label`
    file; or None, as of other ids."""
    raw = scan.extra.get("raw_label")
    if scan.label is not None or raw is None or raw.dtype.kind not in "iu":
        return scan.label
    classes = CLASS_OF_RAW[raw & 0xFFFF]  # the upper half is the instance
    return classes if (classes >= 0).all() else None


def in_whole_pieces(image: RangeImage, gone: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels `gone` (H, W) bool by the classes that a network gave an image, which errs at edges and on
    parts of things: pieces of what stands go whole where most of them does, and stay where hardly anything does."""
    assert image.label is not None
    stands = image.mask & (gone | ~np.isin(image.label, [CLASS_NUMBER[word] for word in GROUND]))
    if not gone.any():
        return gone
    of = pieces(image.range, stands)
    share = np.bincount(of[gone], minlength=of.max() + 1) / np.maximum(np.bincount(of[stands]), 1)
    all_of, none_of = (stands & part[of] for part in (share > MOST, share < HARDLY))
    return (gone | all_of) & ~none_of


def hidden_behind(image: RangeImage, gone: np.ndarray) -> np.ndarray:
    """(H, W) bool: the pixels `gone` (H, W) bool, and those that are empty because of them: between two of one piece in
    a column, as panes are, and up to ROOF above its highest one."""
    height, width = gone.shape
    row, column = np.nonzero(gone)
    if not len(row):
        return gone.copy()
    span = pieces(image.range, gone)[row, column] * width + column  # of a piece, in a column
    at, which = np.unique(span, return_inverse=True)
    top, bottom, far = np.full(len(at), height), np.zeros(len(at), int), np.full(len(at), np.inf)
    np.minimum.at(top, which, row)
    np.maximum.at(bottom, which, row)
    np.minimum.at(far, which, image.range[row, column])
    up = np.radians(np.asarray(image.sensor.elevations))
    roof = np.arctan((far * np.sin(up[top]) + ROOF) / (far * np.cos(up[top])))
    top = np.minimum(top, np.searchsorted(-up, -roof))
    ends = np.zeros((height + 1, width), int)
    np.add.at(ends, (top, at % width), 1)
    np.add.at(ends, (bottom + 1, at % width), -1)
    within = ends[:-1].cumsum(0) > 0
    return gone | (within & ~image.mask)


def in_the_way(filled: RangeImage, image: RangeImage, gone: np.ndarray) -> np.ndarray:
    """(H, W) bool: filled pixels nearer than what was taken away there, `gone` (H, W) bool of `image`: its ray has seen
    that nothing is."""
    free = image.range * (1 - NEARER[1]) - NEARER[0]
    return gone & filled.mask & (filled.range < free)
