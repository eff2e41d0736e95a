"""Labelled figures: pictures with captions in rows, and range images one above the other or side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_COLOURS, CLASSES
from lidarsynth.pictures.colours import range_colours, reflectance_colours
from lidarsynth.pictures.render import MARK, range_strip, reflectance_strip

Picture = tuple[str, np.ndarray]  # caption, (H, W, 3) uint8
PAPER, INK, FAINT = (255, 255, 255), (25, 28, 34), (105, 110, 120)
MARGIN, GAP = 20, 12  # pixels around the figure and between its pictures


def panel(rows: Sequence[Sequence[Picture]], title: str = "", width: int | None = None) -> np.ndarray:
    """(H', W', 3) uint8: pictures in rows on white paper, each under its caption (empty for none), under a title.

    Every row is scaled to `width` pixels, or to its widest row's own width; a row's pictures share one height.
    Raises ValueError where there is no picture or a picture is not (H, W, 3) uint8.
    """
    rows = [list(row) for row in rows]
    if not rows or not all(rows):
        raise ValueError(f"panel needs at least one picture in every row, got rows of {[len(row) for row in rows]}")
    for caption, rgb in (picture for row in rows for picture in row):
        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
            raise ValueError(f"picture {caption!r} must be (H, W, 3) uint8, got {rgb.shape} {rgb.dtype}")
    width = width or max(sum(rgb.shape[1] for _, rgb in row) + GAP * (len(row) - 1) for row in rows)
    blocks = [_row(row, width) for row in rows]
    if title:
        blocks.insert(0, _text(title, width, width // 64 + 6, INK))
    height = sum(len(block) for block in blocks) + GAP * (len(blocks) - 1) + 2 * MARGIN
    figure = np.full((height, width + 2 * MARGIN, 3), PAPER, np.uint8)
    top = MARGIN
    for block in blocks:
        figure[top : top + len(block), MARGIN : MARGIN + width] = block
        top += len(block) + GAP
    return figure


def in_the_way(path: Path) -> str | None:
    """What is to be said, in one line, of a file where a picture would go that is none of ours; None where there is
    none, or one of ours: with the mark, or, of before there was one (2026-11-27), a figure of `panel`."""
    if not path.exists():
        return None
    try:
        with Image.open(path, formats=["PNG"]) as picture:
            ours = picture.info.get("Software") == MARK
            former = picture.mode == "RGB" and not picture.info and _is_panel(np.asarray(picture))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        ours = former = False
    return None if ours or former else f"{path}: expected a picture of lidarsynth to replace, found another"


def _is_panel(rgb: np.ndarray) -> bool:
    """Whether a picture (H, W, 3) has a margin as `panel` makes it, and no wider one at its sides."""
    inner = rgb[MARGIN:-MARGIN, MARGIN:-MARGIN]
    outer = rgb.copy()
    outer[MARGIN:-MARGIN, MARGIN:-MARGIN] = PAPER
    sides = inner.size and all((inner[:, side] != PAPER).any() for side in (0, -1))
    return bool(sides) and bool((outer == PAPER).all())


def _row(row: list[Picture], width: int) -> np.ndarray:
    """(h, width, 3): pictures of one height beside each other, captions above them."""
    room = width - GAP * (len(row) - 1)
    aspect = np.array([rgb.shape[1] / rgb.shape[0] for _, rgb in row])
    height = max(round(room / float(aspect.sum())), 1)
    edges = np.rint(np.concatenate([[0], np.cumsum(aspect)]) / aspect.sum() * room).astype(int)
    size = max(min(room // len(row) // 22, width // 60), 11)
    captioned = any(caption for caption, _ in row)
    parts: list[np.ndarray] = []
    for (caption, rgb), left, right in zip(row, edges[:-1], edges[1:], strict=True):
        picture = _resized(rgb, max(int(right - left), 1), height)
        column = [_text(caption, picture.shape[1], size, INK), picture] if captioned else [picture]
        parts += [np.full((sum(map(len, column)), GAP, 3), PAPER, np.uint8), np.vstack(column)]
    return np.hstack(parts[1:])


def _resized(rgb: np.ndarray, width: int, height: int) -> np.ndarray:
    if rgb.shape[:2] == (height, width):
        return rgb
    return np.asarray(Image.fromarray(rgb).resize((width, height), Image.Resampling.LANCZOS))


def _text(text: str, width: int, size: int, colour: tuple[int, int, int]) -> np.ndarray:
    """(h, width, 3): one line of text on paper, shortened with an ellipsis where it does not fit."""
    font = ImageFont.load_default(max(size, 11))
    while text and font.getlength(text) > width:
        text = text.removesuffix("...")[:-1] + "..." if len(text) > 4 else ""
    picture = Image.new("RGB", (width, round(1.6 * max(size, 11))), PAPER)
    ImageDraw.Draw(picture).text((0, picture.height // 2), text, fill=colour, font=font, anchor="lm")
    return np.asarray(picture)


def colour_bar(by: str, width: int = 480, max_range: float = 80.0) -> np.ndarray:
    """(h, width, 3) uint8: the legend of a strip, `range` (metres) or `reflectance`, with ticks. Raises ValueError."""
    if by == "range":
        top, ticks, unit = max_range, [t for t in (2, 5, 10, 20, 40, 80, 160) if t <= max_range], " m"
        values = 2.0 ** np.linspace(np.log2(3), np.log2(max_range + 1), width) - 1
        colours, places = range_colours(values, max_range), np.log2((np.array(ticks) + 1) / 3) / np.log2((top + 1) / 3)
    elif by == "reflectance":
        ticks, unit, values = [0, 0.1, 0.25, 0.5, 1], "", np.linspace(0, 1, width) ** 2
        colours, places = reflectance_colours(values), np.sqrt(ticks)
    else:
        raise ValueError(f"expected a colour bar of range, reflectance, found {by!r}")
    picture = Image.new("RGB", (width, 30), PAPER)
    picture.paste(Image.fromarray(np.repeat(colours[None], 10, axis=0)), (0, 0))
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(12)
    for tick, place in zip(ticks, places, strict=True):
        anchor = "l" if place < 0.02 else "r" if place > 0.98 else "m"
        draw.text((place * (width - 1), 13), f"{tick:g}{unit}", fill=FAINT, font=font, anchor=f"{anchor}a")
    return np.asarray(picture)


def class_legend(images: Sequence[RangeImage], width: int) -> np.ndarray:
    """(h, width, 3) uint8: the classes that returns of the images have, with their colours, in as many lines as these
    take."""
    size = max(width // 64, 12)
    font, found = ImageFont.load_default(size), [image.label[image.mask] for image in images if image.label is not None]
    places, left, top = [], 0, 0
    for number in np.unique(np.concatenate([*found, np.zeros(0, int)])).astype(int):
        long = round(1.3 * size + font.getlength(CLASSES[number][0]))
        if left and left + long > width:
            left, top = 0, top + 2 * size
        places.append((number, left, top))
        left += long + size
    picture = Image.new("RGB", (width, top + 2 * size), PAPER)
    draw = ImageDraw.Draw(picture)
    for number, left, top in places:
        colour = tuple(int(v) for v in CLASS_COLOURS[number])
        draw.rectangle((left, top + size // 2, left + size, top + size // 2 + size), fill=colour)
        draw.text((left + 1.3 * size, top + size), CLASSES[number][0], fill=INK, font=font, anchor="lm")
    return np.asarray(picture)


def compare(
    images: Mapping[str, RangeImage],
    title: str = "",
    max_range: float | None = None,  # metres where range colours end; None = the first image's sensor
    row_scale: int | None = None,  # picture rows per beam; None = all images about equally tall
) -> np.ndarray:
    """(H', W', 3) uint8: for each caption its range strip above its reflectance strip, colour bars below.

    Images of other sizes are allowed. Raises ValueError where `images` is empty.
    """
    if not images:
        raise ValueError("compare needs at least one image, got none")
    end = max_range or next(iter(images.values())).sensor.max_range
    width = max(image.shape[1] for image in images.values())
    rows: list[list[Picture]] = []
    for caption, image in images.items():
        scale = row_scale or max(round(192 / image.shape[0]), 1)
        rows += [[(caption, range_strip(image, end, scale))], [("", reflectance_strip(image, scale))]]
    half = (width - GAP) // 2
    bars = [("range", colour_bar("range", half, end)), ("reflectance", colour_bar("reflectance", half))]
    return panel([*rows, bars], title, width)
