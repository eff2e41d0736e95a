"""What a model for any sensor does with other sensors' scans: errors, phantoms, the shadow of KITTI's car, VLP-16 x 4.

python benchmarks/any_sensor.py errors SCAN...      every 2nd and 4th beam of real scans, against the best interpolation
    --returned: hidden pixels where the truth returned alone, empty ones in the result counting as 0 m
python benchmarks/any_sensor.py phantoms SCAN...    points nearer than 5 m that are not there, every 4th beam known
python benchmarks/any_sensor.py floating SCAN...    new points where no surface is, every 4th beam known
python benchmarks/any_sensor.py shadow SCAN...      unknown pixels where KITTI's own car stands: how many stay empty
python benchmarks/any_sensor.py dense [--sensor vlp-16] [--mount 0.5] [--tilt 8 0]   streets in four times the beams
python benchmarks/any_sensor.py inside              buildings that nothing was trained on, seen by virtual sensors
python benchmarks/any_sensor.py responses           reflectance of held-out streets, reported in ways never trained on
Each takes --models (words or folders); those of SCAN... --sensor, of scans whose sensor is not recognised (a word or a
.toml file), and --rings and --transform as `lidarsynth complete`: of a file of several sensors, which one, and into its
frame.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

import lidarsynth as ls
from lidarsynth.cli.terminal import answer
from lidarsynth.lidar.frame import parse_transform
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.streets import hdl64e
from lidarsynth.streets.interiors import interiors
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.streets.virtual import SHARING, VirtualStreets
from lidarsynth.streets.world import POSES
from lidarsynth.systems.scan_model import ScanModel
from lidarsynth.verbs.completion import named_sensor
from lidarsynth.verbs.inputs import Reading, inputs_of

AS_IT_IS = Reading()
RIVALS = ("nearest", "bilinear", "bicubic")
NEAR, FREE = 5.0, 1.25  # metres; a truth so many times as far, or none, proves a near point wrong
FLOATING = (0.5, 0.03)  # metres, and share of its range, by which a point is off all that was measured
ON_GROUND = 0.25  # metres above flat ground under the sensor, at most, of what lies on it
HELD_OUT = 777_001  # a seed that nothing was trained on
Own = Callable[[Path], RangeImage]  # `own_image`, told more of how to read
loaded = cache(ls.load)


def own_image(path: Path, reading: Reading = AS_IT_IS, sensor: str | None = None) -> RangeImage:
    """A scan, of a capture the first one, in the rays of the sensor that made it, None = as recognised."""
    scan = next(inputs_of([path], reading).stream()).read().scan
    return loaded("nearest").into(named_sensor(scan, path, "--sensor", sensor)).image_of(scan)


def every(image: RangeImage, step: int) -> np.ndarray:
    """(H, W) bool: the pixels of every `step`-th beam."""
    known = np.zeros(image.shape, bool)
    known[::step] = True
    return known


def model_in(word: str, sensor: ls.Sensor) -> ScanModel:
    """The model in the rays of a sensor. Raises ValueError for one of other beams."""
    model = loaded(word)
    model = model.into(sensor) if model.any_sensor else model
    if model.sensor.elevations != sensor.elevations:
        raise ValueError(f"expected a model of any sensor, or one of {sensor.name}, found {word}")
    return model


def opened(paths: Sequence[Path], models: Sequence[str], own: Own) -> list[RangeImage]:
    """The scans; what is wrong with any, or with a model, is said before a line of a table."""
    if not paths:
        raise ValueError("expected SCAN..., found none")
    images = list(map(own, paths))
    for word in models:
        for image in images:
            model_in(word, image.sensor)
    return images


def completed(word: str, image: RangeImage, known: np.ndarray) -> RangeImage:
    """The image of its known pixels only, filled by a model in the same rays."""
    return model_in(word, image.sensor).complete(image.keep(known), known)


def mean_errors(filled: RangeImage, image: RangeImage, hidden: np.ndarray) -> np.ndarray:
    """(2,) metres and reflectance, over `hidden` (H, W) bool; empty ones count as 0."""
    pairs = ((filled.range, image.range), (filled.reflectance, image.reflectance))
    return np.array([np.abs(a - b)[hidden].mean() for a, b in pairs])


def errors(paths: Sequence[Path], models: Sequence[str], own: Own = own_image, returned: bool = False) -> Iterator[str]:
    """Metres / reflectance of each, and of the last model against the best of the interpolations."""
    images = opened(paths, models, own)
    yield "| scan, beams kept | " + " | ".join((*RIVALS, *models)) + " | against the best |"
    yield "|---" * (len(RIVALS) + len(models) + 2) + "|"
    for image, name in zip(images, (path.name for path in paths), strict=True):
        for step in (2, 4):
            known = every(image, step)
            hidden = ~known & (image.mask | (not returned))
            cells = [mean_errors(completed(word, image, known), image, hidden) for word in (*RIVALS, *models)]
            gain = 100 * (cells[-1] / np.min(cells[: len(RIVALS)], 0) - 1)
            shown = " | ".join(f"{a:.3f} / {b:.4f}" for a, b in cells)
            yield f"| {name} 1/{step} | {shown} | {gain[0]:+.0f} %, {gain[1]:+.0f} % |"


def phantoms(paths: Sequence[Path], models: Sequence[str], own: Own = own_image) -> Iterator[str]:
    """Hidden pixels filled nearer than 5 m where the truth is empty, or where it is a quarter farther; how many of the
    first lie on flat ground, from which a ray came back to nobody; and how many of both the median scan has."""
    counts: dict[str, list[tuple[int, int, int]]] = {word: [] for word in ("bilinear", *models)}
    for image in opened(paths, models, own):
        known = every(image, 4)
        for word, found in counts.items():
            filled = completed(word, image, known)
            near = filled.mask & (filled.range < NEAR) & ~known
            farther = near & image.mask & (image.range > FREE * filled.range)
            height = filled.sensor.points(filled.range)[..., 2] + filled.sensor.mount
            empty = near & ~image.mask
            found.append((int(empty.sum()), int((empty & (height < ON_GROUND)).sum()), int(farther.sum())))
    yield "| model | nearer than 5 m, where nothing returned | on the ground | where the truth is farther | median |"
    yield "|---|---|---|---|---|"
    for word, found in counts.items():
        nothing, ground, far = np.mean(found, 0)
        yield f"| {word} | {nothing:.0f} | {ground:.0f} | {far:.0f} | {np.median(np.array(found)[:, ::2].sum(1)):.0f} |"


def floating(paths: Sequence[Path], models: Sequence[str], own: Own = own_image) -> Iterator[str]:
    """New points farther than 0.5 m, and 3 % of their range, from every point of the whole scan; and how far new points
    are from the nearest one on average."""
    rows: dict[str, list[tuple[float, float, float]]] = {word: [] for word in (*RIVALS, *models)}
    for image in opened(paths, models, own):
        known, measured = every(image, 4), KDTree(image.sensor.points(image.range)[image.mask])
        for word, found in rows.items():
            filled = completed(word, image, known)
            new = filled.mask & ~known
            off, _ = measured.query(image.sensor.points(filled.range)[new])
            least, share = FLOATING
            found.append((int((off > np.maximum(least, share * filled.range[new])).sum()), len(off), float(off.mean())))
    yield "| model | floating | of new points | metres from the nearest measured one |"
    yield "|---|---|---|---|"
    for word, found in rows.items():
        count, total, off = np.mean(found, 0)
        yield f"| {word} | {count:.0f} | {100 * count / total:.1f} % | {off:.3f} |"


def shadow(paths: Sequence[Path], models: Sequence[str], own: Own = own_image) -> Iterator[str]:
    """Of unknown pixels that KITTI's car would hide, and of others of the same beams: the share that stays empty."""
    images, kitti = opened(paths, models, own), ls.get_sensor("hdl-64e-kitti")
    mask, elevations = hdl64e.hidden(kitti), np.asarray(kitti.elevations)
    yield "| scan | model | empty where KITTI's car stands | truly so | elsewhere in these beams | truly so |"
    yield "|---" * 6 + "|"
    for image, name in zip(images, (path.name for path in paths), strict=True):
        row = np.abs(np.asarray(image.sensor.elevations)[:, None] - elevations).argmin(1)
        column = (np.arange(image.shape[1]) * kitti.width / image.shape[1]).astype(int)
        car, known = mask[np.ix_(row, column)], every(image, 4)
        beams = car.any(axis=1, keepdims=True) & ~known
        for word in models:
            filled = completed(word, image, known)
            places = [(chosen, part) for chosen in (beams & car, beams & ~car) for part in (filled, image)]
            shares = " | ".join(f"{100 * (~part.mask[chosen]).mean():.0f} %" for chosen, part in places)
            yield f"| {name} | {word} | {shares} |"


def dense(name: str, models: Sequence[str], stance: Mapping[str, Any], count: int = 24) -> Iterator[str]:
    """Streets that nothing was trained on, cast in four times the beams of a sensor; its own ones are known.

    stance  its mount and tilt, of which nobody is told
    """
    sensor = ls.get_sensor(name).denser(4)
    reader = SyntheticStreets(HELD_OUT, 1 << 20, replace(sensor, **stance))
    totals = {word: np.zeros(2) for word in (*RIVALS, *models)}
    for image in (replace(reader.image(16 * i + 5), sensor=sensor) for i in range(count)):
        known = every(image, 4)
        for word, total in totals.items():
            total += mean_errors(completed(word, image, known), image, ~known) / count
    yield f"| {name} x 4, {count} held-out streets | range (m) | reflectance |"
    yield "|---|---|---|"
    yield from (f"| {word} | {a:.3f} | {b:.4f} |" for word, (a, b) in totals.items())


def buildings(count: int) -> list[RangeImage]:
    """As many buildings that nothing was trained on, each by a virtual sensor that is not told how it stands."""
    reader = interiors(HELD_OUT, POSES * count)
    seen = (reader.image(POSES * k) for k in range(count))
    return [replace(image, sensor=replace(image.sensor, mount=1.73, tilt=(0.0, 0.0))) for image in seen]


def inside(models: Sequence[str], count: int = 24) -> Iterator[str]:
    """Metres / reflectance of hidden pixels, and of those that returned, in as many buildings; nobody is told how the
    sensor stands."""
    images = buildings(count)
    for word in models:
        model_in(word, images[0].sensor)
    yield f"| {count} buildings | " + " | ".join((*RIVALS, *models)) + " |"
    yield "|---" * (len(RIVALS) + len(models) + 1) + "|"
    patterns: dict[str, Callable[[RangeImage, int], np.ndarray]] = {
        "every 2nd beam": lambda image, _: every(image, 2),
        "every 4th beam": lambda image, _: every(image, 4),
        "one point in ten": lambda image, k: np.random.default_rng(k).random(image.shape) < 0.1,
    }
    for pattern, chosen in patterns.items():
        cells = np.zeros((2, len(RIVALS) + len(models), 2))
        for k, image in enumerate(images):
            known = chosen(image, k)
            for column, word in enumerate((*RIVALS, *models)):
                filled = completed(word, image, known)
                for row, hidden in enumerate((~known, ~known & image.mask)):
                    cells[row, column] += mean_errors(filled, image, hidden) / count
        for name, row in zip((pattern, "rays that returned"), cells, strict=True):
            yield f"| {name} | " + " | ".join(f"{a:.3f} / {b:.4f}" for a, b in row) + " |"


def responses(count: int = 8) -> Iterator[str]:
    """Reflectance of hidden returns against bilinear's, of streets that virtual sensors report otherwise: taken as it
    stands (a sensor file with a dimness of 0), and as the model finds out."""
    streets, rng = VirtualStreets(HELD_OUT, SHARING * count), np.random.default_rng(HELD_OUT)
    images = [
        replace(street, sensor=replace(street.sensor, dimness=())) for street in map(streets.image, _firsts(count))
    ]
    ways: dict[str, Callable[[RangeImage], np.ndarray]] = {
        "as streets are": lambda image: image.reflectance,
        "a fifth of it": lambda image: 0.2 * image.reflectance,
        "its fifth power": lambda image: (1.2 * image.reflectance).clip(0, 1) ** 5,
        "beams 30 % apart": lambda image: image.reflectance * np.exp(rng.normal(0, 0.3, (image.shape[0], 1))),
        "less with distance, (6 m / r)^2": lambda image: image.reflectance * (6 / np.maximum(image.range, 6)) ** 2,
    }
    yield "| how it is reported | 1/2: as it stands | found out | 1/4: as it stands | found out |"
    yield "|---|---|---|---|---|"
    for way, report in ways.items():
        cells: list[list[np.ndarray]] = []
        for image in images:
            seen = replace(image, reflectance=(report(image).clip(0, 1) * 255).round().astype(np.float32) / 255)
            plain = replace(seen, sensor=replace(seen.sensor, name="plain", dimness=(0.0,) * seen.sensor.height))
            rows = [(every(image, step), seen, plain) for step in (2, 4)]
            cells.append([
                mean_errors(completed(word, one, known), seen, ~known & seen.mask)[1:]
                for known, own, bare in rows
                for word, one in (("bilinear", own), ("default", bare), ("default", own))
            ])  # fmt: skip
        mean = np.mean(cells, 0).reshape(2, 3)
        shown = " | ".join(f"{100 * (value / row[0] - 1):+.1f} %" for row in mean for value in row[1:])
        yield f"| {way} | {shown} |"


def _firsts(count: int) -> range:
    """One scan of each virtual sensor."""
    return range(0, SHARING * count, SHARING)


REPORTS: dict[str, Callable[[Sequence[Path], Sequence[str], Own], Iterator[str]]] = {
    "errors": errors,
    "phantoms": phantoms,
    "floating": floating,
    "shadow": shadow,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=(*REPORTS, "dense", "inside", "responses"))
    parser.add_argument("scans", nargs="*", type=Path)
    parser.add_argument("--models", nargs="+", default=["default"])
    parser.add_argument("--sensor", help="of SCAN..., None = as recognised; of dense, None = vlp-16")
    parser.add_argument("--mount", type=float)
    parser.add_argument("--tilt", type=float, nargs=2, help="pitch and roll, degrees")
    parser.add_argument("--returned", action="store_true")
    parser.add_argument("--rings", help="such as 32-63")
    parser.add_argument("--transform", type=parse_transform, help="x:y:z:roll:pitch:yaw")
    args = parser.parse_args()
    rings = None if args.rings is None else tuple(map(int, args.rings.split("-")))
    REPORTS["errors"] = partial(errors, returned=args.returned)
    own = partial(own_image, reading=Reading(transform=args.transform, rings=rings), sensor=args.sensor)
    stance = {name: value for name, value in (("mount", args.mount), ("tilt", args.tilt)) if value is not None}
    others = {"responses": responses, "dense": partial(dense, args.sensor or "vlp-16", args.models, stance),
              "inside": partial(inside, args.models)}  # fmt: skip
    for line in others[args.what]() if args.what in others else REPORTS[args.what](args.scans, args.models, own):
        print(line, flush=True)


if __name__ == "__main__":
    answer(main)
