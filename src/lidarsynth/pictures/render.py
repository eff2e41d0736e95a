"""Pictures of scans as (H', W', 3) uint8 RGB arrays: strips of a range image, the bird's eye view, PNG files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont, PngImagePlugin

from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.whole_file import whole_file
from lidarsynth.pictures.colours import label_colours, point_colours, range_colours, reflectance_colours

BACKGROUNDS: dict[str, tuple[int, int, int]] = {"dark": (16, 18, 24), "white": (255, 255, 255)}
EMPTY = (16, 18, 24)  # colour of pixels without a return: dark, so that no colour of a return is close to it
KNOWN, UNKNOWN = (235, 235, 235), (52, 56, 66)
MARK = "lidarsynth"  # Software of our pictures, a text chunk of PNG
ROW_SCALE = 3  # picture rows per beam: beams are a few times farther apart than columns


def background_colour(background: str) -> tuple[int, int, int]:
    """The RGB colour of a word of `BACKGROUNDS`. Raises ValueError for another word."""
    if background not in BACKGROUNDS:
        raise ValueError(f"expected a background of {', '.join(BACKGROUNDS)}, found {background!r}")
    return BACKGROUNDS[background]


def _strip(colours: np.ndarray, mask: np.ndarray | None, row_scale: int) -> np.ndarray:
    if row_scale < 1:
        raise ValueError(f"row_scale must be a whole number from 1, got {row_scale}")
    if mask is not None:
        colours = np.where(mask[..., None], colours, np.array(EMPTY, np.uint8))
    return np.repeat(colours, row_scale, axis=0)


def range_strip(image: RangeImage, max_range: float | None = None, row_scale: int = ROW_SCALE) -> np.ndarray:
    """(H * row_scale, W, 3) uint8: log-depth in Turbo, near red, `max_range` metres (default the sensor's) blue."""
    return _strip(range_colours(image.range, max_range or image.sensor.max_range), image.mask, row_scale)


def reflectance_strip(image: RangeImage, row_scale: int = ROW_SCALE) -> np.ndarray:
    """(H * row_scale, W, 3) uint8: square root of reflectance in Viridis, empty pixels dark."""
    return _strip(reflectance_colours(image.reflectance), image.mask, row_scale)


def label_strip(image: RangeImage, row_scale: int = ROW_SCALE) -> np.ndarray:
    """(H * row_scale, W, 3) uint8: SemanticKITTI's class colours. Raises ValueError for an image without labels."""
    if image.label is None:
        raise ValueError("label_strip needs an image with labels, got an image without")
    return _strip(label_colours(image.label), image.mask, row_scale)


def bev(
    points: Scan | RangeImage,
    by: str = "height",  # word of colours.COLOURS
    extent: float = 40.0,  # metres from the sensor to each border
    size: int = 800,  # pixels along each side
    background: str = "dark",
    rings: float = 10.0,  # metres between range rings, 0 for none
    right: bool = False,  # x (forward) to the right and y (left) up
) -> np.ndarray:
    """(size, size, 3) uint8: the scan from above, x (forward) up and y (left) left, the sensor in the middle.

    A point is a soft round splat; splats that meet blend, so the density of points shows as brightness.
    Raises ValueError for an unknown colour or background, or an extent or size that is not positive.
    """
    if not (extent > 0 and size > 0):
        raise ValueError(f"extent and size must be positive, got {extent} metres and {size} pixels")
    scan, max_range = as_scan(points)
    scan = scan[np.abs(scan.xyz[:, :2]).max(axis=1, initial=0) < extent]
    canvas = _rings(extent, size, background_colour(background), rings, right)
    column_row = (extent - scan.xyz[:, [1, 0]]) * (size / (2 * extent))
    colour, opacity = _splat(column_row, point_colours(scan, by, max_range), size)
    drawn = opacity > 0
    picture, share = canvas.copy(), opacity[drawn][:, None]
    picture[drawn] = np.rint(canvas[drawn] * (1 - share) + colour[drawn] * share).astype(np.uint8)
    return np.rot90(_ego_marker(picture, size, background), -int(right))


def as_scan(points: Scan | RangeImage, max_range: float = 80.0) -> tuple[Scan, float]:
    """The points to draw, without NaN or infinity, and the range in metres at which range colours end."""
    if isinstance(points, RangeImage):
        points, max_range = points.to_scan(), points.sensor.max_range
    return points[np.all(np.isfinite(points.xyz), axis=1)], max_range


def _splat(column_row: np.ndarray, colours: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean colour (size, size, 3) and opacity (size, size) in [0, 1] of Gaussian splats of 3 x 3 pixels."""
    nearest = np.floor(column_row).astype(np.int32)
    pixel = nearest + np.arange(-1, 2)[:, None, None]  # (3, N, 2): columns and rows of the 3 x 3
    weight = np.exp(-((pixel + 0.5 - column_row) ** 2) / (2 * 0.6**2)) * ((pixel >= 0) & (pixel < size))
    weights = (weight[:, None, :, 0] * weight[None, :, :, 1]).reshape(9, -1)
    pixel = pixel.clip(0, size - 1)  # those outside weigh nothing
    index = (pixel[None, :, :, 1] * size + pixel[:, None, :, 0]).ravel()
    parts = [(weights * colours[:, channel]).ravel() for channel in range(3)]
    total = np.stack([np.bincount(index, part, size * size) for part in (*parts, weights.ravel())])
    mean = total[:3] / np.maximum(total[3], 1e-9)
    return mean.T.reshape(size, size, 3), 1 - np.exp(-1.6 * total[3]).reshape(size, size)


def _rings(extent: float, size: int, colour: tuple[int, int, int], step: float, right: bool) -> np.ndarray:
    """(size, size, 3) uint8, x up: a circle and its radius in metres every `step` metres, drawn twice as large and
    halved; the radii can be read where x is turned to the right."""
    faint = tuple(c + (26 if c < 128 else -30) for c in colour)
    picture = Image.new("RGB", (2 * size, 2 * size), colour)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(max(2 * size // 60, 8))
    radii = np.arange(step, extent * 2**0.5, step) if step > 0 else []
    for radius in radii:
        r = radius / extent * size
        draw.ellipse((size - r, size - r, size + r, size + r), outline=faint, width=2)
        if r < size:
            text = tuple(c + (90 if c < 128 else -110) for c in colour)
            place, anchor = ((size + r - 8, size + 4), "ra") if right else ((size + 8, size - r + 4), "la")
            draw.text(place, f"{radius:g} m", fill=text, font=font, anchor=anchor)
    return np.rot90(np.asarray(picture.reduce(2)), int(right))


def _ego_marker(rgb: np.ndarray, size: int, background: str) -> np.ndarray:
    """The picture with a small arrow head at the sensor, pointing forward (up)."""
    colour = (255, 255, 255) if background == "dark" else (20, 20, 20)
    picture, r = Image.fromarray(rgb), max(size / 80, 3)
    layer = Image.new("L", (4 * size, 4 * size))
    tip = [(0, -1.3), (0.9, 1), (0, 0.5), (-0.9, 1)]
    ImageDraw.Draw(layer).polygon([(4 * (size / 2 + x * r), 4 * (size / 2 + y * r)) for x, y in tip], fill=255)
    picture.paste(colour, mask=layer.reduce(4))
    return np.asarray(picture)


def save_png(path: str | Path, rgb: np.ndarray) -> Path:
    """Writes (H, W, 3) uint8 as a PNG with our mark, whole or not at all; returns the path. Raises ValueError for other
    arrays."""
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or 0 in rgb.shape:
        raise ValueError(f"rgb must be (H, W, 3) uint8 with pixels, got {rgb.shape} {rgb.dtype}")
    told = PngImagePlugin.PngInfo()
    told.add_text("Software", MARK)
    with whole_file(path) as scratch:  # level 3 is as small as 6, in half the time
        Image.fromarray(rgb).save(scratch, format="PNG", pnginfo=told, compress_level=3)
    return Path(path)
