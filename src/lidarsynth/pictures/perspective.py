"""A perspective picture of points: z-buffer, points that grow as they come near, eye-dome lighting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image

from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.pictures.colours import point_colours
from lidarsynth.pictures.render import as_scan, background_colour

NEAR = 0.5  # metres in front of the camera; nearer points are not drawn


@dataclass(frozen=True)
class Camera:
    """Where the picture is taken from, in the sensor frame: a camera on a sphere around `target`, looking at it.

    azimuth    degrees counter-clockwise from x (forward) to where the camera stands; 180 is behind the car
    elevation  degrees above the horizon, in (-90, 90)
    distance   metres from the target
    target     metres, the point in the middle of the picture
    field      degrees, the horizontal field of view, in (0, 180)

    Raises ValueError when a value is outside.
    """

    azimuth: float = 210.0
    elevation: float = 28.0
    distance: float = 44.0
    target: tuple[float, float, float] = (6.0, 0.0, -1.0)
    field: float = 45.0

    def __post_init__(self):
        if not (-90 < self.elevation < 90 and 0 < self.field < 180 and self.distance > 0):
            raise ValueError("camera: expected elevation in (-90, 90), field in (0, 180) degrees and distance > 0, "
                             f"got {self.elevation}, {self.field} and {self.distance}")  # fmt: skip

    def project(self, xyz: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Pixel (N, 2) as column and row, floating, and depth (N,) in metres along the view, of points (N, 3)."""
        azimuth, elevation = np.radians([self.azimuth, self.elevation])
        back = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        axes = np.stack([right, -np.cross(back, right), -back], axis=1).astype(np.float32)
        seen = (xyz - np.asarray(self.target, np.float32)) @ axes
        depth = seen[:, 2] + np.float32(self.distance)
        focal = self.focal(size[0])
        middle = np.array(size, np.float32) / 2
        return middle + focal * seen[:, :2] / np.maximum(depth, NEAR)[:, None], depth

    def focal(self, width: int) -> float:
        """Pixels per radian in the middle of a picture `width` pixels wide."""
        return width / 2 / float(np.tan(np.radians(self.field) / 2))


BEHIND = Camera()  # behind the car and to its right, looking forward
INK = 0.86  # brightness of colours on white, where pale ones would vanish


def perspective(
    points: Scan | RangeImage,
    camera: Camera = BEHIND,
    size: tuple[int, int] = (1600, 900),  # width and height in pixels
    by: str = "height",  # word of colours.COLOURS
    background: str = "white",
    diameter: float = 0.07,  # metres, of a point
    shading: float = 1.0,  # strength of the eye-dome lighting, 0 for none
) -> np.ndarray:
    """(height, width, 3) uint8: the scan as seen by `camera`, drawn twice as large and halved.

    Eye-dome lighting (Boucheny, 2009) darkens a pixel whose neighbours are nearer, which outlines every shape.
    Raises ValueError for an unknown colour or background, or a size that is not positive.
    """
    if min(size) < 1:
        raise ValueError(f"size must be positive pixels, got {size}")
    scan, max_range = as_scan(points)
    width, height = 2 * size[0], 2 * size[1]
    pixel, depth = camera.project(scan.xyz, (width, height))
    radius = diameter / 2 * camera.focal(width) / np.maximum(depth, NEAR)
    radius = np.clip(radius, max(width / 2000, 1), max(width / 600, 1))  # never a single one of the four sub-pixels
    inside = np.abs(pixel - np.array(size)) < np.array(size) + radius[:, None] + 1
    seen = (depth > NEAR) & inside.all(axis=1)
    order = np.flatnonzero(seen)[np.argsort(-depth[seen], kind="stable")]
    winner = _z_buffer(pixel[order], radius[order], (width, height))
    canvas = np.empty((height, width, 3), np.uint8)
    canvas[0] = background_colour(background)
    canvas[1:] = canvas[0]
    drawn = np.flatnonzero(winner >= 0)
    colours = point_colours(scan, by, max_range)[order][winner[drawn]]
    light = (INK if background == "white" else 1) * _eye_dome(winner, depth[order], drawn, width, height, shading)
    canvas.reshape(-1, 3)[drawn] = np.rint(colours * light[:, None]).astype(np.uint8)
    return np.asarray(Image.fromarray(canvas).reduce(2))


def _z_buffer(pixel: np.ndarray, radius: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(height * width,) int32: the nearest point on every pixel, -1 for none; points come sorted from far to near."""
    width, height = size
    reach = int(np.ceil(radius.max(initial=1)))
    grid = np.stack(np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1)), -1).reshape(-1, 2)
    away = np.hypot(*grid.T)
    grid = grid[np.argsort(away, kind="stable")]  # so the disc of any radius is the first few offsets
    count = np.searchsorted(np.sort(away), radius, side="right")
    point = np.repeat(np.arange(len(pixel), dtype=np.int32), count)
    offset = np.arange(len(point)) - np.repeat(np.cumsum(count) - count, count)
    margin = 2 * reach + 2  # pixels around the picture, where discs of points beside it go
    wide = width + 2 * margin
    column, row = np.floor(pixel).astype(np.int32).T + margin
    winner = np.full((height + 2 * margin) * wide, -1, np.int32)
    at = (row * wide + column)[point] + (grid @ [1, wide]).astype(np.int32)[offset]
    winner[at] = point  # numpy keeps the last, that is the nearest
    return winner.reshape(-1, wide)[margin:-margin, margin:-margin].ravel()


def _eye_dome(
    winner: np.ndarray, depth: np.ndarray, drawn: np.ndarray, width: int, height: int, strength: float
) -> np.ndarray:
    """(len(drawn),) light in (0, 1]: exp(-strength * sum over 8 neighbours of max(0, log depth - log depth'))."""
    pad = max(width // 800, 2)  # pixels between a pixel and its neighbours
    wide = width + 2 * pad
    far, index = np.full((height + 2 * pad) * wide, np.inf, np.float32), drawn + (2 * (drawn // width) + wide + 1) * pad
    far[index] = here = np.log2(depth[winner[drawn]])
    shade = np.zeros(len(drawn), np.float32)
    for row, column in np.ndindex(3, 3):
        neighbour = far[index + pad * ((row - 1) * wide + column - 1)]
        shade += np.clip(here - neighbour, 0, 0.5)
    return np.exp(-strength * shade)
