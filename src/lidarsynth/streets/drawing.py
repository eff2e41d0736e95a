"""Pictures of labelled frames: classes from above with every box, and as a strip."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lidarsynth.lidar.projection import project
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.pictures.portrait import STRIP, enlarged, rows_of_a_beam
from lidarsynth.pictures.render import bev, label_strip, range_strip
from lidarsynth.streets.frame import Frame

BOX, MOVING, TEXT = (255, 255, 255), (255, 210, 60), (220, 224, 232)
AHEAD = 1.0  # s, how far the line before a moving box reaches


def bev_with_boxes(frame: Frame, extent: float = 40.0, size: int = 700, by: str = "label") -> np.ndarray:
    """(size, size, 3) uint8: the scan from above in class colours, with the boxes that got points.

    A tick leads from the middle of a box to its front; yellow ones move, and a line shows where to within a second.
    """
    picture = Image.fromarray(bev(frame.scan, by, extent, size))
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(max(size // 60, 9))
    for box in frame.boxes:
        if not box.points or max(abs(box.centre[0]), abs(box.centre[1])) > extent:
            continue
        colour = MOVING if box.moves else BOX
        corners = _pixels(box.corners()[:4, :2], extent, size)
        draw.polygon(corners, outline=colour)
        front = np.array([np.cos(box.yaw), np.sin(box.yaw)]) * box.size[0] / 2
        middle = np.array(box.centre[:2])
        draw.line(_pixels(np.stack([middle, middle + front]), extent, size), fill=colour)
        if box.moves:
            ahead = middle + AHEAD * np.array(box.velocity[:2])
            draw.line(_pixels(np.stack([middle, ahead]), extent, size), fill=colour)
        draw.text(corners[0], f"{box.kind} {box.instance}", fill=TEXT, font=font)
    return np.asarray(picture)


def strips(frame: Frame, sensor: Sensor) -> np.ndarray:
    """(H', W', 3) uint8: range over classes of the frame's range image, each about 192 pixels tall."""
    image = project(frame.scan, sensor, method="unfolding", width=min(sensor.width, STRIP))
    rows = rows_of_a_beam(image)
    both = range_strip(image, row_scale=rows), label_strip(image, rows)
    return np.concatenate([enlarged(strip, image) for strip in both])


def _pixels(points: np.ndarray, extent: float, size: int) -> list[tuple[float, float]]:
    """(x, y) of the picture for points (N, 2) in m: x ahead is up, y left is left."""
    return [((extent - y) * size / (2 * extent), (extent - x) * size / (2 * extent)) for x, y in points]
