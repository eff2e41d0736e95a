"""The pictures that the verbs write: a portrait of one range image, and before / after / truth of a filled one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.pictures.figure import GAP, PAPER, Picture, class_legend, colour_bar, panel
from lidarsynth.pictures.perspective import perspective
from lidarsynth.pictures.render import bev, label_strip, range_strip, reflectance_strip

STRIP = 1024  # pixels, the width of a strip
NARROW = 1 / 8  # of the turn: a gap of fewer columns is drawn
EXTENT = 32.0  # metres from the car to the left and right border of a view from above


def portrait(image: RangeImage) -> np.ndarray:
    """(H', W', 3) uint8: strips of range, reflectance and, if known, class with a legend, above a perspective view of
    the points, in the colours of their classes, if known, else by height. A reflectance of 0 everywhere is none."""
    distance, reflectance = strips(image, image.sensor.max_range)
    told = ("reflectance", reflectance) if image.reflectance.any() else _nothing(reflectance)
    rows: list[list[Picture]] = [[("range", distance)], [told]]
    by = "height" if image.label is None else "label"
    if image.label is not None:
        rows += [[("class", enlarged(label_strip(image, rows_of_a_beam(image)), image))]]
        rows += [[("", class_legend([image], distance.shape[1]))]]
    return panel([*rows, [("points", perspective(image, size=(STRIP, STRIP * 9 // 16), by=by))]])


def strips(image: RangeImage, max_range: float) -> tuple[np.ndarray, np.ndarray]:
    """Range and reflectance, (H', W', 3) uint8 of about 192 x 1024 for any size of image, colours to max_range m; of a
    sensor that sees a part of the turn, that part."""
    rows = rows_of_a_beam(image)
    return enlarged(range_strip(image, max_range, rows), image), enlarged(reflectance_strip(image, rows), image)


def rows_of_a_beam(image: RangeImage) -> int:
    """Picture rows per beam, so that a strip is about 192 tall."""
    return max(round(192 / image.shape[0]), 1)


def enlarged(strip: np.ndarray, image: RangeImage) -> np.ndarray:
    """(H', W', 3) uint8: of a strip (H', W, 3) of the image the columns in which its sensor sees anything, from the
    left to the right of where it looks, about 1024 wide."""
    strip = strip[:, _seen(image)]
    return np.repeat(strip, max(round(STRIP / strip.shape[1]), 1), axis=1)


def _seen(image: RangeImage) -> np.ndarray:
    """(W',) columns from one side of the widest gap to the other, in which the sensor sees nothing and no return is;
    all where it is narrow, as behind a mast."""
    free = np.flatnonzero(image.mask.any(axis=0) | ~image.sensor.blocked_rays().all(axis=0))
    gaps = np.diff(free, append=free[0] + image.shape[1]) if len(free) else np.ones(1, int)
    if gaps.max() <= image.shape[1] * NARROW:
        return np.arange(image.shape[1])
    first = free[(gaps.argmax() + 1) % len(free)]
    return (first + np.arange(image.shape[1] - gaps.max() + 1)) % image.shape[1]


def before_and_after(images: Mapping[str, RangeImage], points: Mapping[str, Scan]) -> np.ndarray:
    """(H', W', 3) uint8: a row of range and reflectance strips per caption, then all points in 3-D and from above. A
    reflectance that is 0 everywhere is none, and is not drawn.

    points  what to draw in 3-D instead of an image's own pixels, by caption
    """
    end = next(iter(images.values())).sensor.max_range
    both = {name: strips(image, end) for name, image in images.items()}
    rows: list[list[Picture]] = [
        [(f"{n}: range", d), (f"{n}: reflectance", r) if images[n].reflectance.any() else _nothing(r, f"{n}: ")]
        for n, (d, r) in both.items()
    ]
    rows.append([("", colour_bar("range", STRIP, end)), ("", colour_bar("reflectance", STRIP))])
    width = (2 * STRIP + GAP - GAP * (len(images) - 1)) // len(images)
    drawn = {name: points.get(name, image) for name, image in images.items()}
    rows.append([(f"{n}: {_count(p)} points", perspective(p, size=(width, width * 9 // 16))) for n, p in drawn.items()])
    rows.append([(f"{n}, from above", _ahead(p, width)) for n, p in drawn.items()])
    return panel(rows, width=2 * STRIP + GAP)


def _nothing(strip: np.ndarray, name: str = "") -> Picture:
    return f"{name}no reflectance taken", np.full_like(strip, PAPER)


def _ahead(points: Scan | RangeImage, width: int) -> np.ndarray:
    """(width * 9 // 16, width, 3) uint8: the bird's eye view turned so that the road runs to the right."""
    square = bev(points, extent=EXTENT, size=width, background="white", right=True)
    spare = (width - width * 9 // 16) // 2
    return np.ascontiguousarray(square[spare : spare + width * 9 // 16])


def _count(points: Scan | RangeImage) -> str:
    return f"{len(points) if isinstance(points, Scan) else int(points.mask.sum()):,}"
