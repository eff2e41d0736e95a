"""What the verb `evaluate` does: sets of images -> statistics, kept and continued in files -> a report."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Literal, TypeAlias

from lidarsynth.data.cache import sha256 as sha256_of_file
from lidarsynth.gathering import Loaded, OnImages, gather, load_networks, part_of, select, unlike_names
from lidarsynth.image_sets import ImageSet, image_set, resized, sensor_of
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor, get_sensor
from lidarsynth.metrics.evaluate import Report, report_of
from lidarsynth.metrics.pairs import Pairs, classes_of
from lidarsynth.metrics.protocols import EvaluationProtocol, get_protocol
from lidarsynth.metrics.statistics import Statistics, definition, load_statistics, save_statistics
from lidarsynth.weights import cache_folder

ENDING = ".safetensors"  # of a file of statistics
Samples: TypeAlias = "str | Path | Sequence[RangeImage] | Sequence[str | Path]"


def evaluate(
    samples: Samples,
    reference: str | Path | Sequence[RangeImage],
    protocol: str | EvaluationProtocol = "bev-1",
    sensor: str | None = None,
    seed: int = 0,
    batch_size: int = 4,
    device: str = "cpu",
    on_images: OnImages = None,
) -> Report:
    """Judge samples against a reference under a named protocol (`metrics.protocols.PROTOCOLS`).

    samples    a folder of scans, of our `.npz` images, of official R2DM or LiDARGen `.pth` samples; a cache; a list of
               range images; or files of statistics that `gather_part` wrote, which are merged
    reference  the same, or one file of statistics. What is gathered of it stays in the cache folder
    sensor     of samples that are points or tensors, where neither the reference nor the protocol tells
    seed       of the subsets of the squared MMDs

    Rows whose network is not there are N/A with the reason. Raises ValueError for no samples, mixed resolutions, values
    that are not finite, statistics of another protocol.
    """
    start = time.monotonic()
    record = get_protocol(protocol) if isinstance(protocol, str) else protocol
    samples = _single(samples)
    judge = _judge_pairs if record.pairs else _judge_sets
    report = judge(_Run(record, sensor, batch_size, device, on_images), samples, reference, seed)
    return replace(report, seconds=time.monotonic() - start)


@dataclass(frozen=True)
class _Run:
    """What all steps of one evaluation share."""

    protocol: EvaluationProtocol
    sensor: str | None
    batch_size: int
    device: str
    on_images: OnImages

    def fallback(self) -> Sensor:
        """Of points and tensors, where nothing else tells."""
        p = self.protocol
        return get_sensor(self.sensor) if self.sensor else resized(get_sensor(p.sensor), p.height, p.width)

    def statistics(
        self,
        images: ImageSet,
        sensor: Sensor,
        role: Literal["samples", "real"],
        loaded: Loaded,
        count: int = 0,
        part: str | None = None,
    ) -> tuple[Statistics, Path | None]:
        """Gathered, or where they are of the reference, taken from and left in the cache folder; and their file."""
        chosen = select(self.protocol, role, images.names, count)
        numbers = part_of(chosen.numbers(), part)
        identity = [definition(self.protocol), role, sensor.to_dict(), images.stamp, loaded.weights, numbers]
        key = sha256(repr([*identity, sorted(chosen.bev)]).encode()).hexdigest()[:16]
        kept = cache_folder() / "statistics" / f"{self.protocol.name}-{key}{ENDING}" if images.stamp else None
        if kept and kept.is_file():
            return load_statistics(kept, self.protocol)[0], kept
        unfinished = kept.with_name(f"unfinished-{kept.name}") if kept else None
        empty = Statistics(self.protocol, sensor, role, loaded.networks, loaded.weights)
        projection = self.protocol.projection if sensor.name == self.protocol.sensor else "auto"
        statistics = gather(
            images, numbers, chosen, empty, projection, unfinished, self.batch_size, self.on_images
        )  # fmt: skip
        if kept and role == "real":
            save_statistics(kept, statistics, {"source": images.source})
        if unfinished:
            unfinished.unlink(missing_ok=True)
        return statistics, kept if role == "real" else None


def _judge_sets(run: _Run, samples: Samples, reference: str | Path | Sequence[RangeImage], seed: int) -> Report:
    files = _statistics_files(samples)
    real_file = next(iter(_statistics_files(reference)), None)
    real = load_statistics(real_file, run.protocol)[0] if real_file else None
    truth = None if real_file else image_set(reference)
    fallback = real.sensor if real else run.fallback()
    if truth and not run.sensor:
        fallback = sensor_of(truth.item(0), fallback)
    if files:
        fake = merged(files, run.protocol)
        sources, loaded = ", ".join(map(str, files)), load_networks(run.protocol, fake.sensor.width, run.device)
    else:
        judged = image_set(samples)
        sensor = sensor_of(judged.item(0), fallback)
        loaded, sources = load_networks(run.protocol, sensor.width, run.device), judged.source
        fake = run.statistics(judged, sensor, "samples", loaded)[0]
    if truth:
        sensor = _at_size(sensor_of(truth.item(0), fake.sensor), fake.sensor)
        real, real_file = run.statistics(truth, sensor, "real", loaded, fake.count)
    assert real
    report = report_of(fake, real, loaded.missing, seed)
    told = {"samples": sources, "reference": truth.source if truth else str(real_file)}
    hashes = dict(report.hashes)
    if real_file:
        told["reference statistics"] = str(real_file)
        hashes["reference statistics"] = sha256_of_file(real_file)
    warnings = report.warnings + (unlike_names(run.protocol, truth.names) if truth else ())
    return replace(report, sources=told, hashes=hashes, warnings=warnings)


def _judge_pairs(run: _Run, samples: Samples, reference: str | Path | Sequence[RangeImage], seed: int) -> Report:
    if _statistics_files(samples) or _statistics_files(reference):
        raise ValueError(f"{run.protocol.title} compares images one by one: expected images, found statistics")
    judged, truth = image_set(samples), image_set(reference)
    if len(judged) != len(truth):
        raise ValueError(f"{run.protocol.title} compares sample i with reference i: expected as many of both, found "
                         f"{len(judged)} and {len(truth)}")  # fmt: skip
    sensor = sensor_of(judged.item(0), sensor_of(truth.item(0), run.fallback()))
    loaded = load_networks(run.protocol, sensor.width, run.device)
    pairs, projection = Pairs(run.protocol, classes_of(loaded.networks)), run.protocol.projection
    for start in range(0, len(judged), run.batch_size):
        numbers = range(start, min(start + run.batch_size, len(judged)))
        batch = ([images.image(i, sensor, projection, images is truth) for i in numbers] for images in (judged, truth))
        pairs.update(*batch)
        if run.on_images:
            run.on_images("pairs", numbers.stop, len(judged))
    report = pairs.report(loaded.missing, loaded.weights)
    return replace(report, sources={"samples": judged.source, "reference": truth.source})


def gather_part(
    samples: Samples,
    part: str,
    out: str | Path,
    protocol: str | EvaluationProtocol = "bev-1",
    sensor: str | None = None,
    batch_size: int = 4,
    device: str = "cpu",
    on_images: OnImages = None,
) -> str:
    """Write the statistics of part `i/n` of the samples to a `.safetensors` file; returns the SHA-256 of its content.

    `evaluate` merges such files, of several machines too. Raises ValueError as it does.
    """
    record, out = get_protocol(protocol) if isinstance(protocol, str) else protocol, Path(out)
    samples = _single(samples)
    if out.suffix != ENDING or record.pairs:
        raise ValueError(f"{out}: expected a name that ends in {ENDING} and a protocol of sets, "
                         f"found {out.name[-20:]!r} and {record.name}")  # fmt: skip
    run, images = _Run(record, sensor, batch_size, device, on_images), image_set(samples)
    spec = sensor_of(images.item(0), run.fallback())
    statistics, _ = run.statistics(images, spec, "samples", load_networks(record, spec.width, device), part=part)
    return save_statistics(out, statistics, {"source": images.source, "part": part})


def merged(files: Sequence[Path], protocol: EvaluationProtocol) -> Statistics:
    """One set of statistics of several files. Raises ValueError where two hold the same images."""
    loaded = [load_statistics(file, protocol)[0] for file in files]
    for i, statistics in enumerate(loaded):
        if statistics.digest in [other.digest for other in loaded[:i]]:
            raise ValueError(f"{files[i]}: expected a part of its own, found the images of another part")
    for other in loaded[1:]:
        loaded[0].merge(other)
    return loaded[0]


def _single(samples: Samples) -> Samples:
    """A list of one path as the path."""
    if not isinstance(samples, str | Path) and len(samples) == 1 and isinstance(samples[0], str | Path):
        return samples[0]
    return samples


def _statistics_files(source: Samples) -> list[Path]:
    """The files of statistics that a source names, or [] where it names images. Raises ValueError for both at once."""
    sources = [source] if isinstance(source, str | Path) else list(source)
    paths = [Path(item) for item in sources if isinstance(item, str | Path)]
    if not [path for path in paths if path.suffix == ENDING]:
        return []
    if len(paths) != len(sources) or not all(path.suffix == ENDING for path in paths):
        raise ValueError(f"expected only files of statistics ({ENDING}), or none, found {', '.join(map(str, sources))}")
    return paths


def _at_size(sensor: Sensor, like: Sensor) -> Sensor:
    """The reference's sensor, as its images are thinned to the samples' size. Raises ValueError where they cannot."""
    if sensor.height % like.height or sensor.width % like.width:
        raise ValueError(f"expected a reference of the samples' {like.height} x {like.width} pixels or a multiple, "
                         f"found {sensor.height} x {sensor.width}")  # fmt: skip
    return resized(sensor, like.height, like.width)


def check_out(out: Path) -> None:
    """Raises ValueError unless a report can be named so."""
    if out.suffix != ".json":
        raise ValueError(f"{out}: expected a name that ends in .json, found {out.name[-20:]!r}")


def write_report(report: Report, out: Path) -> None:
    """Write the report as JSON and, beside it with the ending `.md`, as Markdown. Raises ValueError as `check_out`."""
    check_out(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(report.json())
    out.with_suffix(".md").write_text(report.markdown())
