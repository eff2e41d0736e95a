"""Numbers to colours: near is warm, bright reflectance is bright, SemanticKITTI classes have their usual colours."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.semantic_kitti import CLASS_COLOURS, CLASSES

# Seventeen anchors of Turbo (A. Mikhailov, 2019) and nine of Viridis (van der Walt and Smith, 2015), evenly spaced.
TURBO = np.array([
    (48, 18, 59), (64, 64, 162), (70, 107, 227), (66, 148, 255), (40, 188, 235), (24, 221, 194), (50, 242, 152),
    (109, 254, 98), (164, 252, 60), (205, 236, 52), (238, 207, 58), (253, 172, 52), (251, 126, 33), (235, 80, 14),
    (208, 47, 5), (169, 22, 1), (122, 4, 3)])  # fmt: skip
VIRIDIS = np.array([
    (68, 1, 84), (71, 45, 123), (59, 82, 139), (44, 114, 142), (33, 145, 140), (40, 174, 128), (94, 201, 98),
    (173, 220, 48), (253, 231, 37)])  # fmt: skip
MAX_RANGE = 80.0  # metres; where the range colours of a bare Scan, which has no sensor, end
NEAREST = 2.0  # metres; where range colours begin, a little nearer than the road's first return
LOW, HIGH = -2.3, 2.2  # metres above the sensor: the road lies near -1.73, and no HDL-64E beam at 40 m is above +1.4


def _ramp(value: ArrayLike, anchors: np.ndarray) -> np.ndarray:
    value = np.nan_to_num(np.clip(np.asarray(value, np.float32), 0, 1))
    shades = np.stack([np.interp(np.arange(1024) / 1023, np.linspace(0, 1, len(anchors)), a) for a in anchors.T], -1)
    return np.rint(shades).astype(np.uint8)[np.rint(value * 1023).astype(np.int32)]


def turbo(value: ArrayLike) -> np.ndarray:
    """(..., 3) uint8 from values (...) in [0, 1]: dark blue, cyan, green, orange, dark red. Clips; NaN counts as 0."""
    return _ramp(value, TURBO)


def viridis(value: ArrayLike) -> np.ndarray:
    """(..., 3) uint8 from values (...) in [0, 1]: violet, green, yellow, evenly brighter. Clips; NaN counts as 0."""
    return _ramp(value, VIRIDIS)


def range_colours(distance: ArrayLike, max_range: float = MAX_RANGE) -> np.ndarray:
    """(..., 3) uint8 from metres (...): log2(d + 1) along Turbo, red at `NEAREST`, blue at `max_range` metres."""
    near, far = np.log2(NEAREST + 1), np.log2(max(max_range, 2 * NEAREST) + 1)
    depth = (np.log2(np.maximum(np.asarray(distance, np.float32), 0) + 1) - near) / (far - near)
    return turbo(0.93 - 0.88 * np.clip(depth, 0, 1))


def height_colours(z: ArrayLike, low: float = LOW, high: float = HIGH) -> np.ndarray:
    """(..., 3) uint8 from heights (...) in metres: blue at `low`, red at `high`, the dark ends of Turbo cut."""
    return turbo(0.07 + 0.85 * np.clip((np.asarray(z, np.float32) - low) / (high - low), 0, 1))


def reflectance_colours(reflectance: ArrayLike) -> np.ndarray:
    """(..., 3) uint8 from reflectance (...) in [0, 1]: Viridis of the square root, since most returns are dark."""
    return viridis(np.sqrt(np.clip(np.asarray(reflectance, np.float32), 0, 1)))


def label_colours(label: ArrayLike) -> np.ndarray:
    """(..., 3) uint8 from SemanticKITTI training classes (...) 0-19. Raises ValueError for other numbers."""
    label = np.asarray(label)
    if label.size and (label.min() < 0 or label.max() >= len(CLASSES)):
        raise ValueError(f"label must be a training class 0-{len(CLASSES) - 1}, got {label.min()} to {label.max()}")
    return CLASS_COLOURS[label.astype(np.int32)]


def _of_labels(scan: Scan, max_range: float) -> np.ndarray:
    if scan.label is None:
        raise ValueError("colour 'label' needs a scan with labels, got a scan without")
    return label_colours(scan.label)


COLOURS: dict[str, Callable[[Scan, float], np.ndarray]] = {
    "height": lambda scan, max_range: height_colours(scan.xyz[:, 2]),
    "range": lambda scan, max_range: range_colours(np.linalg.norm(scan.xyz, axis=1), max_range),
    "reflectance": lambda scan, max_range: reflectance_colours(scan.reflectance),
    "label": _of_labels,
}


def point_colours(scan: Scan, by: str, max_range: float = MAX_RANGE) -> np.ndarray:
    """(N, 3) uint8, one colour per point, by a word of `COLOURS`. Raises ValueError for another word, or no labels."""
    if by not in COLOURS:
        raise ValueError(f"expected a colour by {', '.join(COLOURS)}, found {by!r}")
    return COLOURS[by](scan, max_range)
