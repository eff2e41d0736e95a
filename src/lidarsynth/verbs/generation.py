"""What the verb `generate` does: scans streamed into a folder, which goes on where it was stopped.

A finished scan is a file NNNNNN.ply and its picture NNNNNN.png. Each appears whole, the
scan last, so that a kill at any moment leaves whole files only. `generate.json` says what the scans were made with.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import lru_cache, partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from lidarsynth.data.workers import in_order
from lidarsynth.files.formats import WRITERS, write, write_labels
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import UnlikelySensorWarning
from lidarsynth.lidar.small_file import read_json
from lidarsynth.lidar.whole_file import sweep, write_whole
from lidarsynth.pictures.figure import in_the_way
from lidarsynth.pictures.portrait import portrait
from lidarsynth.pictures.render import save_png
from lidarsynth.systems.cascade.layout import BY_COLUMNS
from lidarsynth.systems.cascade.model import FILL_STEPS, CascadeModel
from lidarsynth.systems.cascade.request import warn_of_height
from lidarsynth.systems.scan_model import OnStep, ScanModel
from lidarsynth.verbs.companions import LABEL
from lidarsynth.verbs.insertion import BOXES

RECORD = "generate.json"
NAMED = frozenset({"model", "sensor"})  # in words what `weights` says in digits, by which alone folders are compared
MOST = 4  # processes, where nobody says how many: each has a gigabyte and a half


def endings_of(format: str, labels: bool, picture: bool, boxes: bool = False) -> tuple[str, ...]:
    """Of a finished scan's files, such as (".ply", ".png"). Raises ValueError for a format that is not written."""
    if f".{format}" not in WRITERS:
        words = ", ".join(ending.removeprefix(".") for ending in WRITERS)
        raise ValueError(f"expected a format of {words}, found {format!r}")
    return (f".{format}", *([LABEL] if labels else []), *([BOXES] if boxes else []), *([".png"] if picture else []))


def steps_of(model: ScanModel, steps: int | None = None, sampler: str | None = None) -> dict[str, int]:
    """What a folder records of a model's steps for a scan: `steps` of the sampler (of `columns`: the columns), and
    `fill_steps` of a cascade, which follow them. Raises ValueError as `stream`."""
    calls = model.generation_steps(steps, sampler)
    if isinstance(model, CascadeModel):
        return {"steps": calls - FILL_STEPS, "fill_steps": FILL_STEPS}
    return {"steps": calls}


def precision_of(model: ScanModel) -> dict[str, str]:
    """What a folder records of a model's products, where these are not in float32: scans differ by it."""
    return {"precision": model.precision} if isinstance(model, CascadeModel) and model.precision != "fp32" else {}


def layouts_of(layouts: int | None, sampler: str | None) -> int | None:
    """What a folder records of the layouts that were asked for. Raises ValueError for several of a sampler that would
    ignore them: those of columns alone are judged."""
    if layouts not in (None, 1) and sampler != BY_COLUMNS:
        raise ValueError(f"expected 1 layout of the sampler {sampler}, for only {BY_COLUMNS} chooses among them, found "
                         f"{layouts}; leave --layouts out")  # fmt: skip
    return layouts


def claim(folder: Path, settings: dict[str, Any], sampler: str | None = None) -> None:
    """Begin a folder of generated scans, or go on with one that was begun with the same settings.

    sampler  the default one, which records of before 2026-11-26 do not name
    Raises ValueError, and leaves the folder as it is, where its scans were made otherwise or by someone else.
    """
    record = folder / RECORD
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder to write to, found a file")
    if record.exists():
        found = _recorded(record)
        if "fill_steps" in settings and "fill_steps" not in found and isinstance(found.get("steps"), int):
            fill = settings["fill_steps"]  # before 2026-11-28 `steps` held those of both
            found |= {"steps": found["steps"] - fill, "fill_steps": fill}
        found |= {"sampler": sampler} if found.get("sampler") is None else {}
        if other := _differing(settings, found):
            asked, was = ({key: of.get(key) for key in other if key in of} for of in (settings, found))
            raise ValueError(f"{folder}: expected a folder of scans made with {asked}, found {was}; use another --out")
        return
    if taken := sorted(folder.glob("[0-9]" * 6 + ".*")):
        raise ValueError(f"{folder}: expected a folder without scans, or with {RECORD}, found {taken[0].name}; "
                         f"use another --out")  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(record, json.dumps(settings, indent=1) + "\n")


def _differing(settings: dict[str, Any], found: dict[str, Any]) -> list[str]:
    """The settings that are not as found; for other weights their model and sensor, where these have other words."""
    unequal = {key for key in settings.keys() | found.keys() if settings.get(key) != found.get(key)}
    if "weights" not in unequal:
        return sorted(unequal - NAMED)
    told = found.keys() >= NAMED and unequal & NAMED
    return sorted(unequal - {"weights"} if told else unequal | NAMED)


def _recorded(record: Path) -> dict[str, Any]:
    found = read_json(record)
    if not isinstance(found, dict):
        raise ValueError(f"{record}: expected the settings of generated scans, found {found!r:.60}")
    return found


def missing(folder: Path, count: int, endings: tuple[str, ...]) -> list[range]:
    """The scans of 0 .. count - 1 that lack a file, as runs of numbers in a row.

    endings  of a finished scan's files, such as (".ply", ".png")
    Raises ValueError where a picture of theirs would replace one that is none of ours.
    """
    there = {path.name for path in folder.iterdir()}
    runs: list[range] = []
    for i in range(count):
        if all(f"{i:06d}{ending}" in there for ending in endings):
            continue
        if ".png" in endings and (other := in_the_way(folder / f"{i:06d}.png")):
            raise ValueError(f"{other}; use another --out, or --no-picture")
        if runs and runs[-1].stop == i:
            runs[-1] = range(runs[-1].start, i + 1)
        else:
            runs.append(range(i, i + 1))
    return runs


def processes(model: ScanModel, runs: list[range], asked: int | None = None) -> int:
    """How many processes make the scans of `runs`: as many as asked, at most one for each block of scans that the model
    draws together; without a number one per processor core, where it draws more than one, and one on a GPU."""
    blocks = len(cut(runs, model.together))
    if asked is not None:
        return max(1, min(asked, blocks))
    on_cpu = next(model.network.parameters()).device.type == "cpu"
    return max(1, min(os.cpu_count() or 1, MOST, blocks)) if on_cpu and model.together > 1 else 1


def cut(runs: list[range], together: int) -> list[range]:
    """The same scans in runs that end where blocks of so many end."""
    return [range(max(run.start, start), min(run.stop, start + together))
            for run in runs for start in range(run.start - run.start % together, run.stop, together)]  # fmt: skip


class Drawing(NamedTuple):
    """Which model draws, as `load` takes it, and scans of which sensor, with labels or without, of how many layouts,
    with which products."""

    model: str = "default"
    device: str = "cpu"
    sensor: str | None = None
    labels: bool = False
    layouts: int | None = None
    precision: str = "fp32"

    def of(self, model: ScanModel) -> ScanModel:
        """A loaded model with images of that sensor, with labels or without."""
        model = model.into(self.sensor) if self.sensor else model
        if self.layouts is not None:
            if not isinstance(model, CascadeModel):
                raise ValueError(f"expected a model that chooses among layouts, such as default, found "
                                 f"{model.experiment.name}")  # fmt: skip
            model = model.choosing(self.layouts)
        model = model.at_precision(self.precision)
        return model.with_labels() if self.labels else model


def generate_into(
    folder: Path,
    model: ScanModel,
    runs: list[range],  # of `missing`
    batch_size: int,
    endings: tuple[str, ...],
    steps: int | None = None,
    sampler: str | None = None,
    seed: int = 0,
    on_step: OnStep = None,
    workers: int = 1,
    source: Drawing | None = None,
) -> Iterator[Path]:
    """Make the scans of `runs`, a batch in memory at a time, and yield each file when it and its picture are there.

    workers  processes, where there is a `source` from which each loads the same model; each has its share of the
             processor's cores, and `on_step` is called after each scan
    """
    sweep(folder)
    make = partial(_make, folder, batch_size, endings, steps, sampler, seed)
    if workers < 2 or source is None:
        for run in runs:
            yield from make(model, run, on_step)
        return
    if isinstance(model, CascadeModel):
        warn_of_height(model.sensor)
    pieces = cut(runs, model.together)
    threads = max(1, (os.cpu_count() or 1) // workers)
    with closing(in_order(partial(_piece, make, source, pieces, threads), range(len(pieces)), workers)) as made:
        for path in chain.from_iterable(made):
            yield path
            (on_step or (lambda: None))()


def _make(
    folder: Path,
    batch_size: int,
    endings: tuple[str, ...],
    steps: int | None,
    sampler: str | None,
    seed: int,
    model: ScanModel,
    run: range,
    on_step: OnStep,
) -> Iterator[Path]:
    images = model.stream(run.stop, steps, seed, sampler, batch_size, run.start, on_step)
    for i, image in zip(run, images, strict=True):
        yield _store(folder, f"{i:06d}", image, endings)


def _piece(
    make: Callable[[ScanModel, range, OnStep], Iterator[Path]],
    source: Drawing,
    pieces: list[range],
    threads: int,
    k: int,
) -> list[Path]:
    """In a worker: the files of one run."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnlikelySensorWarning)  # told by the process that began this one
        return list(make(_opened(source, threads), pieces[k], None))


@lru_cache(maxsize=1)
def _opened(source: Drawing, threads: int) -> ScanModel:
    """In a worker: its model, loaded once."""
    import torch

    from lidarsynth.weights.load import load

    torch.set_num_threads(threads)
    return source.of(load(source.model, device=source.device))


def boxes_record(image: RangeImage) -> dict[str, Any]:
    """What the JSON file of a generated scan holds: how many points it has, and its boxes."""
    return {"points": int(image.mask.sum()), "boxes": [box.record() for box in image.boxes]}


def _store(folder: Path, name: str, image: RangeImage, endings: tuple[str, ...]) -> Path:
    """Write the files of one scan, the scan last; instances with boxes alone."""
    image = image if BOXES in endings else replace(image, instance=None, boxes=())
    for ending in reversed(endings):
        if ending == ".png":
            save_png(folder / f"{name}.png", portrait(image))
        elif ending == LABEL:
            write_labels(folder / f"{name}{LABEL}", image.to_scan())
        elif ending == BOXES:
            write_whole(folder / f"{name}{BOXES}", json.dumps(boxes_record(image)))
        else:
            write(folder / f"{name}{ending}", image)
    return folder / f"{name}{endings[0]}"
