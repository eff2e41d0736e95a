"""The verb `benchmark`: a file says which methods meet on which scans; tables, numbers and pictures come out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from lidarsynth.benchmark.config import KINDS, Generation, Upsampling, protocols_of, read_config, rows
from lidarsynth.benchmark.drawings import plotter, save_scores, side_by_side, with_classes, with_labels_of
from lidarsynth.benchmark.generation import generation_row
from lidarsynth.benchmark.published import PUBLISHED, why_not
from lidarsynth.benchmark.record import check_same, record_of
from lidarsynth.benchmark.rows import Row
from lidarsynth.benchmark.setup import Load, Setup, open_setup
from lidarsynth.benchmark.sources import corrupted, located
from lidarsynth.benchmark.tables import in_the_file, page
from lidarsynth.benchmark.upsampling import Problem, upsampling_row
from lidarsynth.evaluation.accumulation import OnImages
from lidarsynth.evaluation.image_sets import emptied, image_set, sensor_of
from lidarsynth.evaluation.pairs import classes_of
from lidarsynth.evaluation.parts import ENDING
from lidarsynth.evaluation.protocols import R2DM_UPSAMPLING, get_protocol
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import get_sensor
from lidarsynth.lidar.whole_file import write_whole
from lidarsynth.metrics.reconstruction import reconstruction_errors
from lidarsynth.networks.device import check_device
from lidarsynth.pictures.figure import in_the_way
from lidarsynth.pictures.render import save_png

RESULTS, TABLE, FIGURE, SCORES = "results.json", "table.md", "figure.png", "scores.png"


@dataclass(frozen=True)
class Outcome:
    """What the methods were found to be.

    about     what was compared with what, for people
    data      the same for programs: source, names, hash
    pictures  caption -> one scan, by every method
    note      whose classes give the points their colours
    """

    rows: Sequence[Row]
    about: Mapping[str, str]
    data: Mapping[str, Any]
    pictures: Mapping[str, RangeImage]
    note: str = ""


def benchmark(
    kind: str,
    config: str | Path,
    out: str | Path,
    load: Load,
    data: str | None = None,
    classes: Path | None = None,
    seed: int | None = None,
    device: str = "cpu",
    batch_size: int = 1,
    on_images: OnImages = None,
    command: str = "",
) -> str:
    """Run a benchmark's file: results.json, table.md and figure.png in `out`; returns the page of tables.

    kind     upsampling | generation, where several numbers of steps also give scores.png
    load     word of the file -> model, such as `lidarsynth.load`
    data     replaces the file's data or reference, and `seed` its seed
    classes  a RangeNet, for semantic scores and for the colours of points
    command  to be told in the results

    Scans stay in `out`, so that the same call goes on where it was stopped, and a new row is added to old ones. Raises
    ValueError in one line, also where `out` has a row of the same name that another file made; a method that cannot do
    what is asked for is a row without numbers instead.
    """
    check_device(device)
    settings, out = read_config(kind, config, data, seed), Path(out)
    replaced = [name for name, given in ((KINDS[kind][2], data), ("seed", seed)) if given is not None]
    check_same(out / RESULTS, kind, settings, replaced)
    for name in () if (out / RESULTS).exists() else (FIGURE, SCORES):
        if other := in_the_way(out / name):
            raise ValueError(f"{other}; use another --out")
    several = any(isinstance(method.steps, tuple) and len(method.steps) > 1 for method in settings.method)
    draws_scores = kind == "generation" and several
    if draws_scores:
        plotter()  # its lack is told now, not after hours
    setup = open_setup(settings, out, load, classes, device, batch_size, on_images)
    out.mkdir(parents=True, exist_ok=True)
    outcome = upsampling(setup, settings) if isinstance(settings, Upsampling) else generation(setup, settings)
    names = protocols_of(settings)
    text = page(settings.title, command, outcome.rows, names, outcome.about)
    write_whole(out / RESULTS, record_of(kind, settings, setup, outcome.rows, outcome.data, command, replaced))
    save_png(out / FIGURE, side_by_side(outcome.pictures, settings.title, outcome.note))
    if draws_scores:
        save_scores(out / SCORES, outcome.rows, names, settings.title)
    write_whole(out / TABLE, text)
    return text


def upsampling(setup: Setup, config: Upsampling) -> Outcome:
    """Every method fills the same scans. Raises ValueError for data that cannot be used."""
    data = corrupted(config, setup.folder, setup.on_images)
    stamps, sensors = data.stamps(setup.progress("read", len(data)))
    problem = Problem(config, data, stamps, data.shown(config.figure))
    found = [upsampling_row(setup, problem, group, method) for group, method in rows(config.method)]
    (_, known), size = data[problem.shown], f"{data.sensor.height} x {data.sensor.width}"
    about = {
        "scans": f"{len(data)} of {config.data}, {', '.join(sensors)}, {size}",
        "hidden": f"{config.corruption}, {1 - known.mean():.0%} of the pixels",
        "seed": str(config.seed),
    }
    for name in (names := protocols_of(config)):
        told = why_not(name, data.names, config.corruption)
        about["published" if len(names) == 1 else f"published, {name}"] = (
            told or f"in parentheses, {PUBLISHED[name].source}" if name in PUBLISHED else "none"
        )
    if told := data.notes(config.sensor):
        about["note"] = in_the_file("; ".join(told))
    record = {"source": data.images.source, "names": list(data.names), "sensor": ", ".join(sensors), "scans": len(data),
              "notes": list(told), "sha256": sha256("".join(problem.stamps.values()).encode()).hexdigest()}  # fmt: skip
    return Outcome(found, about, record, *_filled_pictures(setup, problem, found))


def _filled_pictures(setup: Setup, problem: Problem, found: Sequence[Row]) -> tuple[dict[str, RangeImage], str]:
    number = problem.shown
    truth, known = problem.data[number]
    pictures = {f"input, {problem.config.corruption}": truth.keep(known)}
    for row in found:
        if row.image:
            image = emptied(row.image(number))
            error = reconstruction_errors(image, truth, ~known).range_mae
            pictures[f"{row.name}: hidden range MAE {error:.2f} m"] = image
    return _coloured(setup, pictures | {"truth": truth}, truth)


def _coloured(
    setup: Setup, pictures: dict[str, RangeImage], truth: RangeImage | None = None
) -> tuple[dict[str, RangeImage], str]:
    """With the classes that a RangeNet sees, else those of the truth where it has labels, else as they are."""
    width = next(iter(pictures.values())).sensor.width
    network = classes_of(setup.judges(R2DM_UPSAMPLING.name, width).networks)
    if network is not None:
        return {caption: with_classes(image, network) for caption, image in pictures.items()}, "classes by RangeNet"
    if truth is not None and truth.label is not None:
        labelled = {caption: with_labels_of(image, truth) for caption, image in pictures.items()}
        return labelled, "the truth's class at the same pixel, grey where the truth has no return"
    return pictures, ""


def generation(setup: Setup, config: Generation) -> Outcome:
    """Every method's scans meet the same reference. Raises ValueError for a reference that cannot be used."""
    words = [word for method in config.method if (word := method.samples or method.held_out)]
    for word in (config.reference, *words):
        if word.endswith(ENDING):
            raise ValueError(f"{word}: expected scans, which pictures show too, found statistics: evaluate takes them")
    reference = image_set(located(config.reference, setup.folder, config.sensor, setup.on_images))
    for word in words:  # their lack is told now, not after hours
        image_set(located(word, setup.folder, config.sensor, setup.on_images))
    first = get_protocol(protocols_of(config)[0])
    sensor = sensor_of(reference.item(0), get_sensor(config.sensor or first.sensor))
    found = [generation_row(setup, config, group, method, reference, sensor) for group, method in rows(config.method)]
    about = {
        "reference": f"{len(reference)} of {config.reference}, {sensor.name}, {sensor.height} x {sensor.width}",
        "seed": str(config.seed),
    }
    shown = min(config.figure, len(reference) - 1)
    pictures = {"reference": reference.image(shown, sensor, "auto")}
    pictures |= {r.name: r.image(min(config.figure, r.count - 1)) for r in found if r.image and r.count}
    record = {"source": reference.source, "scans": len(reference), "sensor": sensor.name, "stamp": reference.stamp}
    return Outcome(found, about, record, *_coloured(setup, pictures))
