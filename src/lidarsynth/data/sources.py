"""Where the images of a cache come from: the word of each data set, its reader, and how its scans become images."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidarsynth.data.cache import shown, write_cache
from lidarsynth.data.folder import check_folder, scan_files
from lidarsynth.data.folder import folder as scan_folder
from lidarsynth.data.frames import Frames, Reader, choose, stamped
from lidarsynth.data.index import INDEX, REPORT, read_index, report
from lidarsynth.data.kitti import kitti, kitti_published
from lidarsynth.data.kitti360 import kitti360, kitti360_lidargen
from lidarsynth.data.nuscenes import NuScenes, nuscenes
from lidarsynth.data.street_caches import begins_alike
from lidarsynth.data.workers import check_workers
from lidarsynth.lidar.plural import plural
from lidarsynth.lidar.projection import PROJECTIONS, columns_of, project_thinned
from lidarsynth.lidar.recognition import recognise, same_kind
from lidarsynth.lidar.scan import RangeImage, with_points
from lidarsynth.lidar.sensor import WORDS, Sensor, from_dict, get_sensor
from lidarsynth.lidar.small_file import read_json
from lidarsynth.lidar.view import placement
from lidarsynth.streets.edition import EDITION

__all__ = ["SOURCES", "Projected", "Source", "cache_source", "cache_synthetic", "prepare", "scan_files", "summary"]


@dataclass(frozen=True)
class Source:
    """A data set: its reader (root, split) -> Reader, and what its images are unless said otherwise.

    sensor    None = recognised from the first scan
    width     columns; None = the sensor's own
    resizing  which columns stay of wider drawings, as in `projection.thin`
    told      whether the data set says itself which sensor each scan is of; else some are looked at
    """

    reader: Callable[[Path, str], Reader]
    split: str
    sensor: str | None
    projection: str
    width: int | None
    resizing: str = "nearest-exact"
    told: bool = False


SOURCES: dict[str, Source] = {  # images as in R2DM, section IV-A, where it uses the data set
    "kitti360": Source(kitti360, "train", "hdl-64e", "spherical", 1024),
    "kitti": Source(kitti, "train", "hdl-64e-kitti", "unfolding", 512),
    # images on which the presets of published systems learned: r2dm-kitti-raw, DUSty's and the vanilla GAN's, lidargen
    "kitti-r2dm": Source(kitti_published, "train", "hdl-64e-r2dm", "unfolding", 512),
    "kitti-dusty": Source(kitti_published, "train", "hdl-64e-dusty", "unfolding", 512, "nearest"),
    "kitti360-lidargen": Source(kitti360_lidargen, "train", "hdl-64e-lidargen", "spherical", 1024),
    "nuscenes": Source(nuscenes, "all", "hdl-32e", "auto", 1024, told=True),
    "nuscenes-sweeps": Source(
        lambda root, split: nuscenes(root, split, sweeps=True), "all", "hdl-32e", "auto", 1024, told=True
    ),
    "files": Source(lambda root, split: _files(root, split), "all", None, "auto", None),
}

CHECKED = 8  # scans from everywhere, whether they are in their sensor's frame: 0.3 s
LOOKED_AT = 16  # scans from everywhere, whether all are of one sensor
FIRINGS = {"firings": "one a column"}  # of caches of a sensor of one's own since 2026-12-01: none mixes both drawings
SYNTHETIC = "hdl-64e-kitti"  # the sensor of synthetic streets, unless said otherwise


@dataclass(frozen=True)
class Projected:
    """Image number -> RangeImage of a reader's scan, drawn at `columns` and thinned to the sensor's own columns."""

    reader: Reader
    sensor: Sensor
    projection: str
    columns: int
    resizing: str = "nearest-exact"

    def __call__(self, i: int) -> RangeImage:
        return project_thinned(with_points(self.reader[i]), self.sensor, self.projection, self.columns, self.resizing)


def prepare(
    name: str,
    root: Path,
    folder: Path | None,
    split: str | None = None,
    sensor: str | None = None,
    projection: str | None = None,
    width: int | None = None,
    workers: int | None = 0,
    count: int | None = None,
    check: bool = False,
    seed: int = 0,
    intensity: str = "auto",
    apart: bool = False,
    inside: bool = False,
    transform: np.ndarray | None = None,
    rings: tuple[int, int] | None = None,
) -> Iterator[tuple[int, int]]:
    """`cache_synthetic` for the word synthetic, whose cache may be `root` itself; `cache_source` for the others.

    count  of synthetic scans alone; None = 1000
    """
    if name == "synthetic":
        scale = None if intensity == "auto" else intensity
        others = {"--split": split, "--projection": projection, "--intensity": scale, "--transform": transform}
        others |= {"--rings": rings}
        for word, given in others.items():
            if given is not None:
                raise ValueError(f"expected {word} with a data set, found it with synthetic, whose scans are cast")
        spec = SYNTHETIC if sensor is None else sensor
        many = 1000 if count is None else count
        return cache_synthetic(folder or root, many, spec, width, seed, workers, check, apart, inside)
    if apart or inside:
        word = "--apart" if apart else "--inside"
        raise ValueError(f"expected {word} with synthetic, whose worlds are drawn, found it with {name}")
    if count is not None:
        raise ValueError(f"expected -n with synthetic, of which there are endless ones, found it with {name}")
    if folder is None:
        raise ValueError(f"expected data {name} ROOT CACHE, found no CACHE")
    return cache_source(name, root, folder, split, sensor, projection, width, workers, check, intensity,
                        transform, rings)  # fmt: skip


def cache_source(
    name: str,
    root: str | Path,
    folder: str | Path,
    split: str | None = None,
    sensor: str | None = None,
    projection: str | None = None,
    width: int | None = None,
    workers: int | None = 0,
    check: bool = False,
    intensity: str = "auto",
    transform: np.ndarray | None = None,
    rings: tuple[int, int] | None = None,
) -> Iterator[tuple[int, int]]:
    """Project a data set into a cache; yields (scans done, scans in all). What is None is the source's own.

    name     a word of SOURCES; `root` is where the data set lies, `folder` the cache; `split` a word of its reader
    workers, check  as in `write_cache`; None = as many as there are processors
    intensity, transform, rings  of the source `files`: scale, frame and part of them, as of `Frames`
    Raises ValueError for unknown words, a root without scans, or a cache of something else; OSError for a full disk.
    """
    if name not in SOURCES:
        raise ValueError(f"expected a source of {', '.join(SOURCES)} or synthetic, found {name!r}")
    own = SOURCES[name]
    split, projection = split or own.split, projection or own.projection
    if projection not in PROJECTIONS:
        raise ValueError(f"expected a projection of {', '.join(PROJECTIONS)}, found {projection!r}")
    check_folder(Path(root))
    if Path(root).resolve() == Path(folder).resolve():
        raise ValueError(f"{folder}: expected a folder for the cache other than that of the scans, found the same")
    reader = _reader(name, Path(root), split, intensity, transform, rings)
    word = sensor or _told(name, Path(root)) or _recognised(reader)
    width = _width(width, word, own.width)
    spec, columns = _sensor(word, width), columns_of(projection, width, get_sensor(word).width)
    image = Projected(reader, spec, projection, columns, own.resizing)
    source = {"name": name, "split": split, "projection": projection, "columns": columns}
    source |= {} if intensity == "auto" else {"intensity": intensity}
    source |= {} if transform is None else {"transform": np.asarray(transform).tolist()}
    source |= {} if rings is None else {"rings": list(rings)}
    source |= {} if spec.name in WORDS else FIRINGS
    source |= {"root": str(Path(root).resolve()), "missing": list(reader.missing)}
    stamp = partial(stamped, reader.frames) if isinstance(reader, Frames | NuScenes) else None
    for done in write_cache(folder, image, len(reader), spec, source, reader.name, _processes(workers), check, stamp):
        yield done, len(reader)


def cache_synthetic(
    folder: str | Path,
    count: int,
    sensor: str = SYNTHETIC,
    width: int | None = None,
    seed: int = 0,
    workers: int | None = 0,
    check: bool = False,
    apart: bool = False,
    inside: bool = False,
) -> Iterator[tuple[int, int]]:
    """Cast `count` synthetic streets into a cache; yields (images stored, images in all). Rest as `cache_source`.

    width   columns; None = as many as the sensor has
    apart   a world for each of them, for sets that are compared; else sixteen places in each, many times faster
    inside  of buildings, not of streets (`streets.interiors`), the sensor `mount` above the floor
    A cache that tells no edition of its streets, as those of before 2026-11-26, is gone on with where it begins as
    today's streets do. Raises ValueError for one of other streets.
    """
    from lidarsynth.streets.interiors import buildings
    from lidarsynth.streets.reader import SyntheticStreets

    spec = _sensor(sensor, _width(width, sensor, None))
    worlds = buildings(seed, spec) if inside else None
    streets = SyntheticStreets(seed=seed, length=count, sensor=spec, apart=apart, worlds=worlds)
    source = {"name": "synthetic", "seed": seed} | ({"apart": True} if apart else {})
    source |= {"inside": True} if inside else {}
    source |= {} if begins_alike(Path(folder), source, streets) else {"edition": EDITION}
    for done in write_cache(folder, streets.image, count, spec, source, workers=_processes(workers), check=check):
        yield done, count


def _told(name: str, root: Path) -> str | Sensor | None:
    """The source's own sensor; of a set that `streets` has written in that layout, the one that it was cast for."""
    from lidarsynth.data.street_sets import RECORD

    own, record = SOURCES[name], root / RECORD
    settings = read_json(record) if own.told and record.is_file() else None
    if not isinstance(settings, dict) or not isinstance(settings.get("sensor"), dict):
        return own.sensor
    cast = from_dict(settings["sensor"], str(record))
    known = WORDS.get(cast.name)
    return cast.name if known is not None and known.resized(width=cast.width) == cast else cast


def _width(given: int | None, sensor: str | Sensor, source: int | None) -> int:
    """The given width, else the source's for a sensor that we name, else the sensor's own."""
    if given is not None:
        return given
    return source if source is not None and sensor in WORDS else get_sensor(sensor).width


def _files(
    root: Path,
    split: str,
    intensity: str = "auto",
    transform: np.ndarray | None = None,
    rings: tuple[int, int] | None = None,
) -> Frames:
    choose("files", split, ("all",))
    return scan_folder(root, intensity, transform, rings)


def _reader(
    name: str,
    root: Path,
    split: str,
    intensity: str,
    transform: np.ndarray | None,
    rings: tuple[int, int] | None,
) -> Reader:
    asked = {"--intensity": intensity != "auto", "--transform": transform is not None, "--rings": rings is not None}
    if not any(asked.values()):
        return SOURCES[name].reader(root, split)
    if name != "files":
        word, what = next(word for word in asked if asked[word]), "scale" if asked["--intensity"] else "frame"
        raise ValueError(f"expected {word} with files, whose {what} is not known, found it with {name}")
    return _files(root, split, intensity, transform, rings)


def unfit(
    name: str,
    root: Path,
    sensor: str | None,
    intensity: str = "auto",
    transform: np.ndarray | None = None,
    rings: tuple[int, int] | None = None,
    split: str | None = None,
) -> str | None:
    """That scans are not in their sensor's frame, or cannot be of the sensor that is named for all, or is the data
    set's, by some scans from everywhere, in one line, or None. What only seems so must seem so of most files, and does
    not count of data sets."""
    if name not in SOURCES or SOURCES[name].told:
        return None
    word = sensor or SOURCES[name].sensor
    named = None if word is None else get_sensor(word)
    try:
        reader = _reader(name, root, split or SOURCES[name].split, intensity, transform, rings)
    except ValueError:
        if name == "files":
            raise
        return None
    looked, told = 0, []
    for i in range(0, len(reader), -(-len(reader) // CHECKED)):
        with suppress(ValueError):
            text, certain = placement(with_points(reader[i]), named)
            looked += 1
            where = reader.frames[i].path if isinstance(reader, Frames) else shown(reader.name(i)[1:])
            told += [] if text is None else [(certain, f"{where}: {text}")]
    sure = [line for certain, line in told if certain]
    lines = sure or [line for _, line in told]
    if not sure and (name != "files" or 2 * len(lines) <= looked):
        return None
    which = "it is" if looked == 1 else f"{len(lines)} of {looked} scans that were looked at are so, and"
    return f"{lines[0]}; {which} drawn all the same"


def _recognised(reader: Reader) -> str:
    """The sensor's word, by the first scan that can be read. Raises ValueError that asks for --sensor, also where some
    scan, of those looked at from everywhere, is of another sensor."""
    first = next(_sensors(reader, range(len(reader))), None)
    if first is None:
        return "hdl-64e-kitti"  # no scan can be read: whatever the sensor, the cache says so
    word, reason, name = first
    if word is None:
        raise ValueError(reason)
    for other, _, its in _sensors(reader, range(0, len(reader), max(1, len(reader) // LOOKED_AT))):
        if other is not None and not same_kind(other, word):
            raise ValueError(f"expected scans of one sensor, found {name} of {word} and {its} of {other}: "
                             "name the sensor with --sensor")  # fmt: skip
    return word


def _sensors(reader: Reader, numbers: range) -> Iterator[tuple[str | None, str, str]]:
    """`recognise` of those scans that can be read, and their names; others will be skipped, and named in the report."""
    for i in numbers:
        with suppress(ValueError):
            name = shown(reader.name(i)[1:])
            yield *recognise(reader[i], name), name


def _sensor(name: str | Sensor, width: int) -> Sensor:
    if width < 4:
        raise ValueError(f"expected --width of at least 4, found {width}")
    return get_sensor(name).resized(width=width)


def _processes(workers: int | None) -> int:
    if workers is None:
        return os.cpu_count() or 1
    check_workers(workers)
    return workers


def shards(folder: str | Path) -> dict[str, Any]:
    """Checksums of the shards of a cache, by its index, and when their files were written, None of one that is gone, so
    that what was mended is seen too; {} where it is not begun."""
    folder = Path(folder)
    index = read_index(folder) if (folder / INDEX).is_file() else {"shards": {}}
    files = {name: folder / name for name in index["shards"]}
    return {
        name: (entry.get("sha256"), files[name].stat().st_mtime_ns if files[name].is_file() else None)
        for name, entry in index["shards"].items()
    }


def summary(folder: str | Path) -> str:
    """What a cache holds, in one line: images, sequences, and what was skipped or is missing."""
    told = report(read_index(folder))
    sequences, skipped, missing = (len(told[key]) for key in ("sequences", "skipped", "missing"))
    text = plural(told["stored"], "image")
    if sequences:
        text += f" of {plural(sequences, 'sequence')}"
    text += f" in {folder}/"
    if skipped:
        text += f", {plural(skipped, 'broken scan')} skipped (named in {Path(folder) / REPORT})"
    if missing:
        text += f"; not found: {', '.join(told['missing'][:5])}{', ...' if missing > 5 else ''}"
    return text
