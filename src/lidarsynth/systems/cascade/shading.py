"""How bright the surfaces of a generated scan read, by their classes, before they get the speckle of these.

Reflectances of a drawn grid are single readings, 2.8 degrees and four beams apart: one that is dark by its speckle
makes a dark patch, and a sidewalk reads like a road here and there. Measured in docs/generation.md.
"""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.streets.hdl64e import hidden, lasers, unevenness
from lidarsynth.streets.sensor_model import flat_ground

GROUND = {"road": "road", "parking": "parking", "sidewalk": "sidewalk", "terrain": "grass"}  # materials of classes
# Parts of the turn and of the beams on either side that are around a pixel; how much of what is drawn stays, of what
# is brighter or darker all around, and of a pixel alone, on the ground; from which difference on that stays: markings.
WIDE, TALL = 1 / 21, 1 / 10
AROUND, ALONE, MARKED = 0.4, 0.5, 0.1
ENOUGH = 0.02  # of an image's pixels: of less ground one cannot tell how bright it is in the whole


def shaded(even: np.ndarray, image: RangeImage, own: bool = False) -> np.ndarray:
    """Reflectances (H, W) on average of a generated image with labels, given those that were drawn, `even` (H, W).

    Of what grows they are those of all of it around. Of the ground they are nearer to what flat ground of that kind
    reads so far away. All are brighter or darker by as much as makes the ground as bright as streets': each layout is
    of a sensor that reports in its own way.

    own  it stays as bright as it was drawn, by a model that has learned how its sensor reports
    """
    assert image.label is not None
    label = np.where(image.mask, image.label, 0)
    grows = label == CLASS_NUMBER["vegetation"]
    uneven = unevenness(image.sensor)
    even = np.where(grows, _around(even + uneven, grows) - uneven, even)
    expected = _expected(label, image)
    ground = expected > 0
    if not ground.any():
        return even.clip(0, 1).astype(np.float32)
    off = even - expected
    off = off - (usual := np.median(off[ground]))
    if not own and ground.mean() > ENOUGH:
        even, usual = even - usual, 0
    here = [(label == CLASS_NUMBER[name]) & ground for name in GROUND]
    around = sum(np.where(kind, _around(off, kind & (np.abs(off) < 2 * MARKED)), 0) for kind in here)
    alone = off - around
    calm = expected + usual + AROUND * around + np.where(np.abs(alone) < MARKED, ALONE, 1) * alone
    return np.where(ground, calm, even).clip(0, 1).astype(np.float32)


def _expected(label: np.ndarray, image: RangeImage) -> np.ndarray:
    """(H, W) what flat ground of each pixel's class reads there, 0 for other classes."""
    sensor, seen = image.sensor, ~hidden(image.sensor)
    expected = np.zeros(label.shape, np.float32)
    for name, material in GROUND.items():
        reads = np.zeros(label.shape, np.float32)
        reads[seen] = flat_ground(material, image.range[seen].astype(np.float32), sensor.mount, lasers(sensor))
        expected = np.where(label == CLASS_NUMBER[name], np.maximum(reads, 1e-3), expected)
    return expected * (image.range > 0)


def _around(values: np.ndarray, there: np.ndarray) -> np.ndarray:
    """(H, W) means of the values (H, W) of those pixels that are `there` (H, W) around each; the value, without any."""
    tall, wide = max(round(TALL * len(values)), 1), max(round(WIDE * values.shape[1]), 1)
    total, count = (_box(part, tall, wide) for part in (values * there, there.astype(np.float64)))
    return np.where(count > 0.5, total / np.maximum(count, 1), values)


def _box(values: np.ndarray, tall: int, wide: int) -> np.ndarray:
    """(H, W) sums over 2 tall + 1 rows, as far as there are, and 2 wide + 1 columns of a ring."""
    padded = np.pad(np.pad(values.astype(np.float64), ((0, 0), (wide, wide)), mode="wrap"), ((tall, tall), (0, 0)))
    for axis, half in enumerate((tall, wide)):
        summed = np.cumsum(np.insert(padded, 0, 0, axis), axis)
        size, count = 2 * half + 1, summed.shape[axis]
        padded = summed.take(range(size, count), axis) - summed.take(range(count - size), axis)
    return padded
