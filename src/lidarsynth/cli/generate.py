"""The verb `generate`: scans from noise into a folder."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from lidarsynth.cli.arguments import (
    Count,
    Device,
    Format,
    GenerationSteps,
    Picture,
    Precision,
    Sampler,
    SensorWord,
    Source,
    arg,
)
from lidarsynth.cli.terminal import at_least, load_with_bar, say, scan_bar, step_bar, warn
from lidarsynth.lidar.plural import plural

if TYPE_CHECKING:
    from lidarsynth.lidar.sensor import Sensor
    from lidarsynth.systems.scan_model import ScanModel

FEW = 8  # scans, as many as are drawn together at least, which one process makes


def generate(
    count: Count = 4,
    out: Annotated[Path, arg(help="folder to write to.")] = Path("out"),
    model: Source = "default",
    format: Format = "ply",
    sensor: Annotated[SensorWord, arg(help="of the scans, for a model of any sensor; default the model's.")] = None,
    labels: Annotated[bool, arg(help="the class of each point too: as a field, and SemanticKITTI's .label.")] = False,
    boxes: Annotated[
        bool, arg(help="with labels, whose instances they have: a .json of the boxes of cars and people of each scan.")
    ] = False,
    steps: GenerationSteps = None,
    sampler: Sampler = None,
    layouts: Annotated[
        int | None,
        arg(
            metavar="INT", help="drawn for each scan; the likelier a street, the likelier kept; default 3, 1 is faster."
        ),
    ] = None,
    seed: Annotated[int, arg(help="scan i depends on seed + i only.")] = 0,
    batch_size: Annotated[int, arg(help="scans at once on a GPU; a CPU makes them one by one.")] = 4,
    device: Device = "cpu",
    precision: Precision = "fp32",
    workers: Annotated[
        int | None, arg(metavar="INT", help="processes; default one per core, where each has a block of scans to draw.")
    ] = None,
    picture: Picture = True,
) -> None:
    """New scans: a file and a picture per scan. Stopped, the same command goes on where it was."""
    from lidarsynth.files.lock import only_writer

    at_least(1, {"count": count, "steps": steps, "batch-size": batch_size, "workers": workers, "layouts": layouts})
    at_least(0, {"seed": seed})
    _begin_early(count, workers, device)
    from lidarsynth.systems.fingerprint import fingerprint
    from lidarsynth.verbs import generation

    labels = labels or boxes
    endings = generation.endings_of(format, labels, picture, boxes)
    source = generation.Drawing(model, device, sensor, labels, layouts, precision)
    loaded = source.of(load_with_bar(model, device))
    calls, used = loaded.generation_steps(steps, sampler), loaded.sampler_used(steps, sampler)
    settings = {"weights": fingerprint(loaded), "format": format} | generation.steps_of(loaded, steps, sampler)
    settings |= {"sampler": used, "seed": seed, "model": str(model), "sensor": loaded.sensor.name}
    said = {"labels": labels or None, "boxes": boxes or None, "layouts": generation.layouts_of(layouts, used)}
    said |= generation.precision_of(loaded)
    settings |= {key: value for key, value in said.items() if value is not None}
    with only_writer(out, "generation"):
        generation.claim(out, settings, loaded.sampler_used(steps))
        _caution(loaded, str(model), used if sampler is None else loaded.sampler_used())
        runs, size = generation.missing(out, count, endings), loaded.at_once(batch_size)
        workers = generation.processes(loaded, runs, workers)
        make = partial(generation.generate_into, out, loaded, runs, batch_size, endings, steps, sampler, seed)
        if workers < 2:
            with step_bar("generate", sum(-(-len(run) // size) for run in runs) * calls) as on_step:
                new = sum(1 for _ in make(on_step))
        else:
            with scan_bar("generate", sum(map(len, runs))) as (on_scan, _):
                new = sum(1 for _ in make(on_step=on_scan, workers=workers, source=source))
    made = f"{out}/ has {plural(count, 'scan')}, {new} of them new: 000000.{format} ... {count - 1:06d}.{format}"
    _tell(made, loaded.sensor if boxes else None)


def _begin_early(count: int, workers: int | None, device: str) -> None:
    """Where several processes are likely to draw, they begin while this one reads the model."""
    if count > FEW and (workers or os.cpu_count() or 1) > 1 and device == "cpu":
        from lidarsynth.data.workers import begin_early

        begin_early("lidarsynth.verbs.generation", "lidarsynth.weights.load")


def _caution(model: ScanModel, word: str, used: str | None) -> None:
    """Says of scans that are less near to streets than they might be why they are."""
    from lidarsynth.systems.notes import elsewhere

    if used != model.sampler_used():
        warn(f"with steps scans are drawn by {used}, not by {model.sampler_used()}, whose are nearer to streets")
    if told := elsewhere(model):
        warn(f"{word} {told}; use --model default")


def _tell(made: str, of_boxes: Sensor | None) -> None:
    from lidarsynth.streets.turn import told_of_tilt

    say(made)
    if of_boxes is not None and (told := told_of_tilt(of_boxes)):
        say(f"{told}; with points and boxes turned upright, by that tilt, they have all")
