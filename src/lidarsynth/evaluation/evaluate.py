"""What the verb `evaluate` does: sets of images -> statistics, kept and continued in files -> a report."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from hashlib import sha256
from operator import index
from pathlib import Path
from typing import Literal, TypeAlias

from lidarsynth.data.cache import sha256 as sha256_of_file
from lidarsynth.evaluation import accumulation
from lidarsynth.evaluation.accumulation import Loaded, OnImages, gather, load_networks, part_of, select, unlike_names
from lidarsynth.evaluation.image_sets import ImageSet, Numbered, image_set, is_numbered, resized
from lidarsynth.evaluation.measures import LARGEST_SEED
from lidarsynth.evaluation.notes import (
    columns_apart,
    one_set,
    other_frames,
    out_of_images,
    tensors_taken,
    turned_images,
    unlike_metres,
    unlike_pairs,
    unlike_sensors,
    unused_sensor,
    upside_down,
)
from lidarsynth.evaluation.pairs import Pairs, classes_of
from lidarsynth.evaluation.parts import ENDING, merged, notes_of, statistics_files
from lidarsynth.evaluation.protocol import EvaluationProtocol
from lidarsynth.evaluation.protocols import get_protocol
from lidarsynth.evaluation.report import DEFINITIONS, Report, report_of
from lidarsynth.evaluation.statistics import GATHERED, Statistics, definition, load_statistics, save_statistics
from lidarsynth.lidar.sensor import GRIDS, Sensor, get_sensor
from lidarsynth.lidar.small_file import LARGEST_INDEX, read_json
from lidarsynth.lidar.whole_file import write_whole
from lidarsynth.networks.device import check_device
from lidarsynth.weights.download import cache_folder

THINNED = "thinned"  # scans in less than 1024 columns, since they are drawn as training images are
Role: TypeAlias = Literal["samples", "real"]
Samples: TypeAlias = "str | Path | Sequence[str | Path] | Numbered"


def evaluate(
    samples: Samples,
    reference: Samples,
    protocol: str | EvaluationProtocol = "bev-1",
    sensor: str | Sensor | None = None,
    seed: int = 0,
    batch_size: int = 4,
    device: str = "cpu",
    on_images: OnImages = None,
    intensity: str = "auto",
) -> Report:
    """Judge samples against a reference under a named protocol (`evaluation.protocols.PROTOCOLS`).

    samples    a folder of scans, of our `.npz` images, of official R2DM or LiDARGen `.pth` samples; a cache; a list, or
               what else has a length and gives its i-th, of range images, scans, arrays of points (N, 3) or (N, 4), or
               such samples; or files of statistics that `gather_part` wrote, which are merged
    reference  the same. What is gathered of it stays in the cache folder, as a file of statistics to share
    sensor     of samples that are points or tensors, where neither the reference nor the protocol tells
    seed       of the subsets of the squared MMDs, below 2**32
    intensity  scale of files of points, as `read` takes it; "none" of scans without: rows that need it are N/A

    Published networks that a protocol asks for are downloaded once, as `load` downloads releases; rows whose network is
    not to be had are N/A with the reason. Raises ValueError for no samples, mixed resolutions, values that are not
    finite, statistics of another protocol, a device that is not here.
    """
    start = time.monotonic()
    batch_size, seed = _whole("batch_size", batch_size, 1), _whole("seed", seed, 0, LARGEST_SEED)
    check_device(device)
    record = protocol if isinstance(protocol, EvaluationProtocol) else get_protocol(protocol)
    judge = _judge_pairs if record.pairs else _judge_sets
    report = judge(
        _Run(record, sensor, batch_size, device, on_images, intensity), _single(samples), _single(reference), seed
    )
    return replace(report, seconds=time.monotonic() - start)


def _whole(name: str, number: int, least: int, most: int | None = None) -> int:
    """The number as Python's own. Raises ValueError by its name for one that is not whole, or out of its limits."""
    try:
        found = index(number)
    except TypeError:
        found = None
    if found is None or isinstance(number, bool):
        raise ValueError(f"expected a {name} that is a whole number, found {' '.join(repr(number).split()):.60}")
    if found < least:
        raise ValueError(f"expected a {name} of at least {least}, found {found}")
    if most is not None and found > most:
        raise ValueError(f"expected a {name} of at most {most}, found {found}")
    return found


@dataclass(frozen=True)
class _Run:
    """What all steps of one evaluation share."""

    protocol: EvaluationProtocol
    sensor: str | Sensor | None
    batch_size: int
    device: str
    on_images: OnImages
    intensity: str = "auto"

    def images(self, source: Samples) -> ImageSet:
        """Of samples, or a reference."""
        return image_set(source, self.intensity)

    def fallback(self) -> Sensor:
        """Of points and tensors, where nothing else tells."""
        p = self.protocol
        return get_sensor(self.sensor) if self.sensor else resized(get_sensor(p.sensor), p.height, p.width)

    def sensor_like(self, reference: Samples | None) -> Sensor:
        """Of points and tensors that are judged against this."""
        if reference is None or self.sensor:
            return self.fallback()
        if files := statistics_files(_single(reference)):
            return load_statistics(files[0], self.protocol)[0].sensor
        return self.sensor_of(self.images(reference), self.fallback())

    def sensor_of(self, images: ImageSet, fallback: Sensor) -> Sensor:
        """Of a set by its first image; lists of points are judged as the protocol's own sensor draws them."""
        return self.fallback() if self.protocol.clouds else images.sensor(fallback)

    def notes(self, judged: ImageSet | None, truth: ImageSet | None, drawn: Sensor) -> tuple[str, ...]:
        """What is unlike in the images that were read, or statistics stand for, and judged as those of `drawn`."""
        sides = {"samples": judged, "the reference": truth}
        told = unused_sensor(self.sensor, judged, drawn) + unlike_sensors(sides, drawn)
        told += out_of_images(sides, drawn)
        told += tensors_taken(sides, drawn, self.sensor) + unlike_metres(sides) + other_frames(sides)
        if self.protocol.clouds:
            return told
        drawing = drawn, self.projection(drawn)
        return told + columns_apart(sides, *drawing) + upside_down(sides, *drawing) + turned_images(sides, *drawing)

    def projection(self, sensor: Sensor) -> str:
        """Of points: the protocol's into images of its own sensor; by rings into those that published programs take."""
        if sensor.name == self.protocol.sensor:
            return self.protocol.projection
        return "unfolding" if sensor.name.partition("/")[0] in GRIDS and not sensor.edges else "auto"

    def networks(self, sensor: Sensor) -> Loaded:
        return load_networks(self.protocol, sensor.width, self.device, self.on_images)

    def pairs(self, judged: ImageSet, truth: ImageSet, sensor: Sensor, loaded: Loaded) -> Pairs:
        """All images beside their truths; stopped, the next call goes on."""
        pairs, projection = Pairs(self.protocol, classes_of(loaded.networks)), self.projection(sensor)
        identity = [definition(self.protocol), sensor.to_dict(), judged.stamp, truth.stamp, loaded.weights, GATHERED]
        identity += [projection]  # before, always the protocol's own
        key = sha256(repr(identity).encode()).hexdigest()[:16]
        stamped = judged.stamp and truth.stamp
        unfinished = cache_folder() / "statistics" / f"unfinished-{self.protocol.name}-{key}.json" if stamped else None
        if unfinished and unfinished.is_file():
            with suppress(ValueError, KeyError, TypeError, AttributeError):  # damaged: begin again
                fresh = Pairs(self.protocol, pairs.classes)
                fresh.restore(read_json(unfinished, LARGEST_INDEX))
                pairs = fresh
        saved = time.monotonic()
        for start in range(pairs.count, len(judged), self.batch_size):
            numbers = range(start, min(start + self.batch_size, len(judged)))
            if (clouds := self.protocol.clouds) is not None:
                points = ([of.points(i, sensor, clouds, of is truth) for i in numbers] for of in (judged, truth))
                pairs.update_points(*points)
            else:
                sides, resizing = (judged, truth), self.protocol.resizing
                batch = (
                    [of.image(i, sensor, projection, of is truth, resizing, True) for i in numbers] for of in sides
                )
                pairs.update(*batch)
            if self.on_images:
                self.on_images("pairs", numbers.stop, len(judged))
            if unfinished and time.monotonic() - saved > accumulation.SAVE_EVERY:
                with suppress(OSError):  # the cache is for going on only
                    unfinished.parent.mkdir(parents=True, exist_ok=True)
                    write_whole(unfinished, json.dumps(pairs.state()))
                saved = time.monotonic()
        with suppress(OSError):
            if unfinished:
                unfinished.unlink(missing_ok=True)
        return pairs

    def statistics(
        self,
        images: ImageSet,
        sensor: Sensor,
        role: Role,
        loaded: Loaded,
        count: int = 0,
        part: str | None = None,
    ) -> tuple[Statistics, Path | None]:
        """Gathered, or where they are of the reference, taken from and left in the cache folder; and their file."""
        chosen = select(self.protocol, role, images.names, count)
        numbers = part_of(chosen.numbers(), part)
        identity = [definition(self.protocol), role, sensor.to_dict(), images.stamp, loaded.weights, numbers, GATHERED]
        identity += [] if sensor.width >= 1024 else [f"{THINNED}, {self.projection(sensor)}"]  # drawn otherwise before
        limits = [sorted(part) for part in (chosen.features, chosen.bev, chosen.sets)]
        key = sha256(repr([*identity, *limits]).encode()).hexdigest()[:16]
        kept = cache_folder() / "statistics" / f"{self.protocol.name}-{key}{ENDING}" if images.stamp else None
        if kept and kept.is_file():
            with suppress(ValueError):  # damaged: it is only kept to save time, and made anew
                return load_statistics(kept, self.protocol)[0], kept
        unfinished = kept.with_name(f"unfinished-{kept.name}") if kept else None
        empty = Statistics(self.protocol, sensor, role, loaded.networks, loaded.weights)
        drawn = self.projection(sensor)
        statistics = gather(images, numbers, chosen, empty, drawn, unfinished, self.batch_size, self.on_images)
        if kept and role == "real":
            try:
                save_statistics(kept, statistics, {"source": images.source})
            except OSError:  # a cache that cannot be written to costs the next run its time, no more
                kept = None
        with suppress(OSError):
            if unfinished:
                unfinished.unlink(missing_ok=True)
        return statistics, kept if role == "real" else None


def _judge_sets(run: _Run, samples: Samples, reference: Samples, seed: int) -> Report:
    files, real_files = statistics_files(samples), statistics_files(reference)
    warnings, hashes, told = (), {}, {}
    real, truth = None, None
    judged = None if files else run.images(samples)  # first: what is wrong with these is said first
    if real_files:
        real, warnings = merged(real_files, run.protocol)
        warnings += notes_of(real_files)
        told["reference"] = ", ".join(map(str, real_files))
    else:
        truth = run.images(reference)
        told["reference"] = truth.source
        warnings = unlike_names(run.protocol, truth.names)
    fallback = real.sensor if real else run.fallback()
    if truth and not run.sensor:
        fallback = run.sensor_of(truth, fallback)
    loaded = Loaded()
    if judged is None:
        fake, more = merged(files, run.protocol)
        told["samples"], warnings = ", ".join(map(str, files)), warnings + more + notes_of(files)
        if truth:
            loaded = run.networks(fake.sensor)
    else:
        sensor = run.sensor_of(judged, fallback)
        loaded, told["samples"] = run.networks(sensor), judged.source
        fake, _ = run.statistics(judged, sensor, "samples", loaded)
    if truth:
        sensor = _at_size(run.sensor_of(truth, fake.sensor), fake.sensor)
        real, kept = run.statistics(truth, sensor, "real", loaded, fake.count)
        real_files = [kept] if kept else []
    assert real
    report = report_of(fake, real, loaded.missing, seed, run.on_images)
    warnings += run.notes(judged, truth, fake.sensor)
    warnings += one_set(judged, truth, report.hashes, run.protocol)
    if real_files:
        told["reference statistics"] = ", ".join(map(str, real_files))
        hashes["reference statistics"] = ", ".join(map(sha256_of_file, real_files))
    hashes = {**report.hashes, **hashes}
    return replace(
        report, sources=told, hashes=hashes, warnings=report.warnings + warnings, images=_size_of(fake.sensor)
    )


def _judge_pairs(run: _Run, samples: Samples, reference: Samples, seed: int) -> Report:
    if statistics_files(samples) or statistics_files(reference):
        raise ValueError(f"{run.protocol.title} compares images one by one: expected images, found statistics")
    judged, truth = run.images(samples), run.images(reference)
    if len(judged) != len(truth):
        raise ValueError(f"{run.protocol.title} compares sample i with reference i: expected as many of both, found "
                         f"{len(judged)} and {len(truth)}")  # fmt: skip
    sensor = judged.sensor(truth.sensor(run.fallback()))
    loaded = run.networks(sensor)
    pairs = run.pairs(judged, truth, sensor, loaded)
    report = pairs.report(loaded.missing, loaded.weights)
    sources = {"samples": judged.source, "reference": truth.source}
    warnings = report.warnings + run.notes(judged, truth, sensor) + unlike_pairs(judged.names, truth.names)
    warnings += one_set(judged, truth, report.hashes, run.protocol, pairs.unlike)
    return replace(report, sources=sources, warnings=warnings, images=_size_of(sensor))


def _size_of(sensor: Sensor) -> str:
    return f"{sensor.height} x {sensor.width} of {sensor.name}"


def gather_part(
    samples: Samples,
    part: str,
    out: str | Path,
    protocol: str | EvaluationProtocol = "bev-1",
    sensor: str | None = None,
    batch_size: int = 4,
    device: str = "cpu",
    on_images: OnImages = None,
    side: Literal["samples", "reference"] = "samples",
    reference: Samples | None = None,
    intensity: str = "auto",
) -> str:
    """Write the statistics of part `i/n` of the samples to a `.safetensors` file; returns the SHA-256 of its content.

    `evaluate` merges such files, of several machines too; so does this, into one file, given files and the part 1/1.
    What is unlike in the images is kept in the file, which `parts.notes_of` tells, and so do reports.
    side       what the images are: samples to judge, or a reference
    reference  what they will be judged against, if it is here: tells the sensor of points, as in `evaluate`
    intensity  as in `evaluate`
    Raises ValueError as `evaluate` does.
    """
    batch_size = _whole("batch_size", batch_size, 1)
    check_device(device)
    if side not in ("samples", "reference"):
        raise ValueError(f"expected a side of samples, reference, found {side!r:.60}")
    if not isinstance(part, str):
        raise ValueError(f"expected a part such as '1/2', found {part!r:.60}")
    record, out = protocol if isinstance(protocol, EvaluationProtocol) else get_protocol(protocol), Path(out)
    samples = _single(samples)
    if out.suffix != ENDING or record.pairs:
        raise ValueError(f"{out}: expected a name that ends in {ENDING} and a protocol of sets, "
                         f"found {out.name[-20:]!r} and {record.name}")  # fmt: skip
    _check_place(out)  # not after hours
    if files := statistics_files(samples):
        statistics, lacking = merged(files, record)
        if lacking or part != "1/1":
            raise ValueError("; ".join(lacking) or f"expected the part 1/1 to merge files of statistics, found {part}")
        kept = {"source": ", ".join(map(str, files)), "part": part, "notes": json.dumps(notes_of(files))}
        return save_statistics(out, statistics, kept)
    if side == "reference" and 0 in (record.real, record.real_bev):
        raise ValueError(f"{record.title} takes as many of the reference as there are samples: expected it to be "
                         "gathered with them, found it alone")  # fmt: skip
    run = _Run(record, sensor, batch_size, device, on_images, intensity)
    images = run.images(samples)
    if unused := unused_sensor(sensor, images, run.fallback()):
        raise ValueError(f"expected the sensor of the images, or none, found another: {unused[0]}")
    spec = run.sensor_of(images, run.sensor_like(reference))
    role: Role = "real" if side == "reference" else "samples"
    notes = run.notes(*((None, images) if role == "real" else (images, None)), spec)
    notes += unlike_names(record, images.names) if role == "real" else ()
    statistics, _ = run.statistics(images, spec, role, run.networks(spec), part=part)
    return save_statistics(out, statistics, {"source": images.source, "part": part, "notes": json.dumps(notes)})


def _single(samples: Samples) -> Samples:
    """A list of one path as the path. Raises ValueError for what is no set of scans."""
    if not isinstance(samples, str | Path) and not is_numbered(samples):
        raise ValueError(f"expected a folder, files or a list of range images, found a {type(samples).__name__}")
    if isinstance(samples, list | tuple) and len(samples) == 1 and isinstance(samples[0], str | Path):
        return samples[0]
    return samples


def _at_size(sensor: Sensor, like: Sensor) -> Sensor:
    """The reference's sensor, as its images are thinned to the samples' size. Raises ValueError where they cannot."""
    if sensor.height % like.height or sensor.width % like.width:
        raise ValueError(f"expected a reference of the samples' {like.height} x {like.width} pixels or a multiple, "
                         f"found {sensor.height} x {sensor.width}; data takes --sensor and --width")  # fmt: skip
    return resized(sensor, like.height, like.width)


def check_out(out: Path) -> None:
    """Raises ValueError unless a report can be named so, OSError where its folder cannot be made."""
    if out.suffix != ".json" or out.is_dir():
        raise ValueError(f"{out}: expected the name of a file that ends in .json, "
                         f"found {'a folder' if out.is_dir() else repr(out.name[-20:])}")  # fmt: skip
    page = out.with_suffix(".md")
    if page.exists() and (not page.is_file() or DEFINITIONS not in page.read_text(encoding="utf-8", errors="replace")):
        raise ValueError(f"{out}: expected a name beside whose .md nothing is lost, found {page}, which is no report")
    if out.exists() and out.stat().st_size and not _is_report(out):
        raise ValueError(
            f"{out}: expected a name under which nothing is lost, found a file that is no report of evaluate"
        )
    _check_place(out)


def _is_report(path: Path) -> bool:
    try:
        values = read_json(path, LARGEST_INDEX)
    except (OSError, ValueError):
        return False
    return isinstance(values, dict) and {"protocol", "version", "values"} <= values.keys()


def _check_place(out: Path) -> None:
    """Raises ValueError unless a file can be put there, whose folder is made, and OSError where that cannot be."""
    if out.is_dir():
        raise ValueError(f"{out}: expected the name of a file, found a folder")
    out.parent.mkdir(parents=True, exist_ok=True)
    if not os.access(out.parent, os.W_OK | os.X_OK):
        raise ValueError(f"{out}: expected a folder that may be written to, found none of that right at {out.parent}")


def write_report(report: Report, out: Path) -> None:
    """Write the report as JSON and, beside it with the ending `.md`, as Markdown. Raises ValueError as `check_out`."""
    check_out(out)
    write_whole(out, report.json())
    write_whole(out.with_suffix(".md"), report.markdown())
