"""Which pixels of a range image are known: sparse beams, sparse points, a blocked sector, a removed region.

The patterns are what training hides, too: masks (H, W) bool of a shape, True = known.
"""

from __future__ import annotations

from collections.abc import Callable
from inspect import signature

import numpy as np

from lidarsynth.lidar.scan import RangeImage


def every_beam(shape: tuple[int, int], every: int, first: int = 0) -> np.ndarray:
    """Every `every`-th row is known, from row `first` on."""
    known = np.zeros(shape, bool)
    known[first::every] = True
    return known


def without_rectangle(shape: tuple[int, int], rows: range, columns: range) -> np.ndarray:
    """`rows` of `columns` are lost; columns go on at the other end of the turn."""
    known = np.ones(shape, bool)
    known[rows.start : rows.stop, np.asarray(columns, int) % shape[1]] = False
    return known


def without_columns(shape: tuple[int, int], columns: range) -> np.ndarray:
    """A sector is lost: `columns` of all rows."""
    return without_rectangle(shape, range(shape[0]), columns)


def beams(image: RangeImage, rng: np.random.Generator, every: float = 4, first: float = 0) -> np.ndarray:
    """Every `every`-th beam is known, from row `first` on. (H, W) bool."""
    if every != int(every) or first != int(first) or not 1 <= every <= image.shape[0] or not 0 <= first < every:
        raise ValueError(f"beams expects whole numbers EVERY in 1..{image.shape[0]} and FIRST below it, "
                         f"found {every:g}:{first:g}")  # fmt: skip
    return every_beam(image.shape, int(every), int(first))


def points(image: RangeImage, rng: np.random.Generator, share: float = 0.1) -> np.ndarray:
    """A random share of the pixels is known. (H, W) bool."""
    if not 0 < share <= 1:
        raise ValueError(f"points expects the known share in (0, 1], found {share:g}")
    return rng.random(image.shape) < share


def sector(image: RangeImage, rng: np.random.Generator, degrees: float = 90, centre: float = 0) -> np.ndarray:
    """A sector is lost: `degrees` wide around azimuth `centre` (0 forward, 90 left). (H, W) bool, True = known."""
    if not 0 < degrees <= 360:
        raise ValueError(f"sector expects a width in (0, 360] degrees, found {degrees:g}")
    azimuth = np.degrees(image.sensor.ray_angles()[1])
    away = np.abs((azimuth - centre + 180) % 360 - 180)
    return away > degrees / 2


def region(
    image: RangeImage,
    rng: np.random.Generator,
    x_min: float = 5,
    x_max: float = 20,
    y_min: float = -5,
    y_max: float = 5,
) -> np.ndarray:
    """The rays that cross the flat box x_min..x_max, y_min..y_max (metres, sensor frame) at the road are lost.

    A ray counts as crossing when its measured point lies in the box, or, where it is empty or hits something behind,
    when it meets the road plane `sensor.mount` below the sensor there. (H, W) bool, True = known.
    """
    if not (x_min < x_max and y_min < y_max):
        found = f"{x_min:g}:{x_max:g}:{y_min:g}:{y_max:g}"
        raise ValueError(f"region expects X_MIN < X_MAX and Y_MIN < Y_MAX, found {found}")
    rays = image.sensor.directions()
    down = np.minimum(rays[..., 2:], -1e-3)
    road = rays * (-image.sensor.mount / down)
    measured = np.where(image.mask[..., None], image.points(), road)
    lost = np.zeros(image.shape, bool)
    for place in (measured, road):
        x, y = place[..., 0], place[..., 1]
        lost |= (x_min <= x) & (x <= x_max) & (y_min <= y) & (y <= y_max)
    return ~lost


CORRUPTIONS: dict[str, Callable[..., np.ndarray]] = {
    "beams": beams,
    "points": points,
    "sector": sector,
    "region": region,
}


def corrupt(image: RangeImage, recipe: str, seed: int = 0) -> np.ndarray:
    """(H, W) bool, True = known, for a recipe such as `beams:4`, `points:0.1`, `sector:90:180`, `region:5:20:-5:5`.

    Several joined by `+` apply together. Raises ValueError that names the part it could not read.
    """
    if not isinstance(image, RangeImage):
        raise ValueError(f"expected a range image, such as project gives, found a {type(image).__name__}")
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"expected a seed of 0 and above, found {seed!r:.40}")
    rng = np.random.default_rng(seed)
    known = np.ones(image.shape, bool)
    for name, values in check_recipe(recipe):
        known &= CORRUPTIONS[name](image, rng, *values)
    return known


def check_recipe(recipe: str) -> list[tuple[str, list[float]]]:
    """Name and numbers of each part of a recipe. Raises ValueError that names the part it could not read."""
    if not isinstance(recipe, str):
        raise ValueError(f"expected a recipe such as beams:4, found a {type(recipe).__name__}")
    parts = []
    for part in recipe.split("+"):
        name, *numbers = part.strip().split(":")
        if name not in CORRUPTIONS:
            raise ValueError(f"expected a corruption of {', '.join(CORRUPTIONS)}, found {name!r} in {recipe!r}")
        try:
            values = [float(n) for n in numbers]
        except ValueError:
            raise ValueError(f"{name} expects numbers after the colon, found {part!r}") from None
        if not np.isfinite(values).all():
            raise ValueError(f"{name} expects finite numbers, found {part!r}")
        takes = len(signature(CORRUPTIONS[name]).parameters) - 2  # after image and rng
        if len(values) > takes:
            raise ValueError(f"{name} expects at most {takes} numbers, found {len(values)} in {part!r}")
        parts.append((name, values))
    return parts
