"""Many scans through `complete`, `upsample`, `realise`, `label`, `project`: one by one or in processes, one report."""

from __future__ import annotations

import errno
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lidarsynth.data.bag_records import Cloud
from lidarsynth.data.windows import in_window
from lidarsynth.files.formats import BARE, BESIDE, write, write_labels
from lidarsynth.files.labels import label_path
from lidarsynth.lidar.columns import columns_note, usual_at_most
from lidarsynth.lidar.plural import plural
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.scan import RangeImage, Scan, check_seen, with_points
from lidarsynth.lidar.sensor import WORDS, Sensor, get_sensor
from lidarsynth.lidar.unseen import caution, darkness, filled_before
from lidarsynth.lidar.view import placement
from lidarsynth.pictures.figure import in_the_way
from lidarsynth.pictures.portrait import portrait
from lidarsynth.pictures.render import save_png
from lidarsynth.streets.wanted import wanted
from lidarsynth.systems.filling import Filling
from lidarsynth.systems.notes import IN_PYTHON, beyond_image, bound, hardly_told
from lidarsynth.verbs.companions import LABEL, check_companions, check_labels
from lidarsynth.verbs.completion import Filled, complete_scan, named_sensor, taken_away, upsample_scan
from lidarsynth.verbs.inputs import Input, Loaded, back_in_place, message_fields, without_places
from lidarsynth.verbs.insertion import (
    BOXES,
    check_boxes,
    check_numbers,
    check_upright,
    insert_scan,
    told_of,
    write_boxes,
)
from lidarsynth.verbs.labelling import found, label_scan, labelled_fields
from lidarsynth.verbs.realisation import realise_scan, realised_fields
from lidarsynth.verbs.viewpoint import viewpoint_note

if TYPE_CHECKING:  # `project` needs no torch
    from lidarsynth.metrics.reconstruction import Errors
    from lidarsynth.systems.scan_model import OnStep, ScanModel

FIRST, EVERY = 2, 50  # whose frame is looked at: the first ones, and every so many
MEANT = {"model": "weights", "sensor": "sensor_is", "into": "into_is"}  # words of a recipe -> what they mean, in digits
FIELDS = {"realise": realised_fields, "label": labelled_fields}  # of a bag's messages; of the others, `message_fields`


@dataclass(frozen=True)
class Job:
    """What is done with every scan.

    verb       complete, upsample, realise, insert, label or project
    model      as `load` takes it; not of project
    how        of complete and upsample; of realise and insert its seed, scan i being drawn from seed + i
    corrupt    recipe to hide a part first, of complete
    sensor     that made the scans, None = that of a range image, or recognised
    into       sensor of the result, of upsample
    least      confidence of new points of complete and upsample, of classes of label, None = all
    times      as many beams as the scan's own, of upsample; None = the model's own number
    projection, width  of project
    transform  (4, 4) that was applied to the points, to be undone in the result, or None
    strict     refuse scans that are not in their sensor's frame
    picture    a .png beside each file
    labels     classes of the points too, of complete and upsample; of label, always
    things     that are put into the scan, of insert, as `streets.wanted` has them
    """

    verb: str
    model: str = "default"
    device: str = "cpu"
    how: Filling = field(default_factory=Filling)
    corrupt: str | None = None
    sensor: str | Sensor | None = None
    into: str | None = None
    least: float | None = None
    times: int | None = None
    projection: str = "auto"
    width: int | None = None
    transform: np.ndarray | None = None
    strict: bool = False
    picture: bool = True
    labels: bool = False
    things: str | None = None

    @property
    def beside(self) -> tuple[str, ...]:
        """Endings of the files that a .bin or .npy of this job may get beside it, as far as the job tells."""
        marks = tuple(f".{name}" for name in BESIDE) if self.verb in ("complete", "upsample", "insert") else ()
        return (*marks, LABEL) if self.labels or self.needs_labels else marks

    @property
    def needs_labels(self) -> bool:
        """Whether a `.label` file of a scan's own that does not fit is refused; `label` alone reads none."""
        return self.verb in ("realise", "insert") or self.how.removed is not None

    def recipe(self, weights: str | None = None) -> dict[str, Any]:
        """What decides the results, as plain values; what was not asked for is left out.

        weights  the `fingerprint` of the model, where it is loaded: a folder of that name may hold others tomorrow, and
                 a file of a sensor others too, whose digits are told as `sensor_is` and `into_is`
        Raises ValueError for a sensor that is none.
        """
        names = ["verb", "sensor", "projection", "width"]
        if self.verb != "project":
            names = ["verb", "model", "sensor", "corrupt", "into", "times", "least", "labels", "things"]
        kept = {name: getattr(self, name) for name in names} | (vars(self.how) if self.verb != "project" else {})
        kept["transform"] = None if self.transform is None else np.asarray(self.transform).tolist()
        kept |= {MEANT[name]: _digits(word) for name in ("sensor", "into") if (word := kept.get(name)) is not None}
        kept |= {MEANT["model"]: weights}
        kept = {name: list(value) if isinstance(value, tuple) else value for name, value in kept.items()}  # as JSON's
        return {name: value for name, value in kept.items() if value is not None and value is not False}


def _digits(word: str) -> str:
    """16 hex digits of what a sensor is, whatever it is called here."""
    return blake2b(json.dumps(get_sensor(word).to_dict(), sort_keys=True).encode(), digest_size=8).hexdigest()


@dataclass(frozen=True)
class Work:
    """One scan, the file to write, or None for one that goes into a bag, whether to look at its frame, its number."""

    item: Input
    target: Path | None
    check: bool
    number: int = 0


@dataclass(frozen=True)
class Result:
    """What became of one scan.

    error     why there is no result, in one line, or None
    warning   what seems wrong with it, in one line, or None
    points    measured, and after it; `dropped` were without a return
    note      what was done, in words
    errors    of hidden pixels by method, where a corruption was asked for
    cloud     for a bag
    beside    endings of what was written beside the target
    picture   that was written, or None
    """

    name: str
    source: Path
    target: Path | None
    seconds: float
    error: str | None = None
    warning: str | None = None
    dropped: int = 0
    points: tuple[int, int] = (0, 0)
    note: str = ""
    errors: Mapping[str, Errors] = field(default_factory=dict)
    cloud: Cloud | None = None
    beside: tuple[str, ...] = ()
    picture: Path | None = None


def run(job: Job, works: Iterable[Work], workers: int = 1, model: ScanModel | None = None,
        on_step: OnStep = None) -> Iterator[Result]:  # fmt: skip
    """The results in order; a scan that fails comes as its error. Raises ValueError when the disk is full.

    workers  processes, each with a model of its own; below 2 the work is done here, with `model` if it is given
    """
    yield from in_window(partial(start, job, model if workers < 2 else None, on_step, workers), works, workers)


def start(job: Job, model: ScanModel | None, on_step: OnStep, workers: int) -> Callable[[Work], Result]:
    """What one process does with each scan, its model loaded once."""
    if job.verb != "project":
        if workers > 1:
            import torch

            torch.set_num_threads(1)
        if model is None:
            from lidarsynth.weights.load import load

            model = load(job.model, device=job.device)
        model = model.into(job.into) if job.into else model
        model = model.with_labels() if job.labels else model
    return partial(_one, job, model, on_step)


def _one(job: Job, model: ScanModel | None, on_step: OnStep, work: Work) -> Result:
    begun, warning = time.perf_counter(), None
    try:
        loaded = work.item.read()
        if job.sensor is None and (job.verb != "complete" or _of_any_sensor(model)):
            job = replace(job, sensor=loaded.sensor)  # other models complete any sensor's scans in their own images
        with_points(loaded.scan, str(work.item.path))
        warning = _frame_warning(loaded, job, work) or _sensor_warning(loaded.scan, job, work, model)
        warning = warning or _viewpoint_warning(job, work)
        beyond = _view_warning(loaded.scan, job, work, model)
        done, note = _made(job, model, work, loaded.scan, on_step)
        more = loaded.left_out, beyond, _caution(loaded.scan, job, work, model, alone=warning is None)
        more = (*more, _few_beams(loaded.scan, job, model))
        more = (*more, darkness(loaded.scan) if work.check and job.verb != "realise" else None)
        warning = _in_one_line(work.item.path, warning, *more)  # of what was made: not said where nothing is
        cloud, beside, picture, other = None, (), None, None
        if work.target is None:
            points = _points(done, loaded, job.transform)
            fields = FIELDS.get(job.verb, message_fields)(points, loaded)
            told = loaded.published, loaded.sequence
            cloud = Cloud(loaded.stamp, loaded.frame_id, loaded.time, fields, *told)
        else:
            if job.picture and (other := in_the_way(work.target.with_suffix(".png"))):
                job = replace(job, picture=False)
                other += "; it stays: use another --out, or --no-picture"
            beside = _store(work.target, work.item.path, done, loaded, job)
            picture = work.target.with_suffix(".png") if job.picture else None
    except (ValueError, FloatingPointError) as error:
        if isinstance(error.__cause__, OSError) and error.__cause__.errno in (errno.ENOSPC, errno.EDQUOT):
            raise  # that is no fault of the scan, and the next ones would not fit either
        text = str(error).replace(IN_PYTHON, "")
        text = text if warning is None or warning == text else f"{warning}; as they are: {text}"
        if work.target is not None and work.target.exists():
            text += f"; {work.target} is of an earlier run"
        return Result(work.item.name, work.item.path, work.target, time.perf_counter() - begun, text)
    errors = {} if isinstance(done, RangeImage) else done.errors
    warning = "; ".join(filter(None, (warning, other))) or None
    whose = work.item.name, work.item.path, work.target, time.perf_counter() - begun
    count = len(loaded.scan), _count(done, work)
    return Result(*whose, None, warning, loaded.dropped, count, note, errors, cloud, beside, picture)


def _count(done: Filled | RangeImage, work: Work) -> int:
    """How many points are written: a range image holds one a pixel."""
    if isinstance(done, RangeImage):
        return int(done.mask.sum())
    in_image = work.target is not None and work.target.suffix.lower() == ".npz"
    return int(done.image.mask.sum()) if in_image else len(done.points)


def _of_any_sensor(model: ScanModel | None) -> bool:
    """Whether a model completes each scan in the image of its own sensor."""
    from lidarsynth.systems.any_sensor import AnySensorModel

    return isinstance(model, AnySensorModel)


def _frame_warning(loaded: Loaded, job: Job, work: Work) -> str | None:
    if not (work.check or job.strict):
        return None
    warning, certain = placement(loaded.scan, None if job.sensor is None else get_sensor(job.sensor))
    if certain and job.strict:
        raise ValueError(f"{work.item.path}: {warning}")
    return None if warning is None else f"{work.item.path}: {warning}"


def _sensor_warning(scan: Scan, job: Job, work: Work, model: ScanModel | None) -> str | None:
    """That a model of one sensor, or one that was tuned to one, gets another's scan, in one line."""
    if not work.check or model is None or (job.verb == "upsample" and not model.any_sensor):
        return None
    text = model.stranger(scan, None if job.sensor is None else get_sensor(job.sensor))
    return text and f"{work.item.path}: {job.model} {text}; use --model default"


def _view_warning(scan: Scan, job: Job, work: Work, model: ScanModel | None) -> str | None:
    """That measured points are out of the view of the sensor that `upsample` gives. Raises ValueError where that is to
    be refused."""
    if job.verb != "upsample" or model is None or not (work.check or job.strict):
        return None
    text = beyond_image(model, scan)
    if text is not None and job.strict:
        raise ValueError(f"{work.item.path}: {text}")
    return text


def _viewpoint_warning(job: Job, work: Work) -> str | None:
    """That a file puts the sensor elsewhere than at the origin, where nobody has said which frame the points are in."""
    text = viewpoint_note(work.item.path) if work.check and job.transform is None else None
    return text and f"{work.item.path}: {text}"


def _caution(scan: Scan, job: Job, work: Work, model: ScanModel | None, alone: bool) -> str | None:
    """What must be said of the points that are to be completed: of each scan, how many were filled in before; of those
    that are looked at, what lacks, and where nothing else is said (`alone`) all that there is to say."""
    if job.verb not in ("complete", "upsample") or model is None:
        return None
    if not work.check or job.how.removed is not None:  # then nothing is filled where the scan has gaps of its own
        return filled_before(scan)
    sensor = None if job.sensor is None else get_sensor(job.sensor)
    around = job.verb == "complete" or bound(model)
    return caution(scan, sensor, alone, model.sensor if job.into else None, around)


def _few_beams(scan: Scan, job: Job, model: ScanModel | None) -> str | None:
    """That a scan, whichever of many, has so few beams that the result is a guess; a range image of it is none."""
    return None if model is None else hardly_told(model, scan, job.sensor)


def _in_one_line(path: Path, warning: str | None, *more: str | None) -> str | None:
    """A warning that begins with the path of its scan, and what else is to be said of that."""
    text = "; ".join(text for text in more if text is not None)
    if warning is None:
        return f"{path}: {text}" if text else None
    return f"{warning}; {text}" if text else warning


def _made(
    job: Job, model: ScanModel | None, work: Work, scan: Scan, on_step: OnStep
) -> tuple[Filled | RangeImage, str]:
    """The result, and what was done in words."""
    path = work.item.path
    if job.verb == "project":
        image = project(scan, named_sensor(scan, path, "--sensor", job.sensor), job.projection, job.width)
        image = check_seen(image, len(scan))
        done = (
            f"{plural(len(scan), 'point')}, {image.sensor.name}, {image.mask.mean():.1%} of {image.shape} pixels filled"
        )
        return image, done if job.width else done + _columns(image.sensor, job, "; ")
    assert model is not None
    if job.verb == "complete":
        sensor = None if job.sensor is None else get_sensor(job.sensor)
        filled = complete_scan(model, scan, job.corrupt, job.how, on_step, sensor, job.least)
        gone = taken_away(scan, filled.image, job.how, job.model)
        return filled, gone + (_columns(filled.image.sensor, job, "; " if gone else "") if model.any_sensor else "")
    if job.verb == "realise":
        sensor = named_sensor(scan, path, "--sensor", job.sensor, model.sensor)
        filled = realise_scan(model, scan, sensor, job.how.seed + work.number)
        done = f"{sensor.name} would report {len(filled.points)} of {len(scan)} points"
        usual = sensor if job.sensor is not None else WORDS.get(sensor.name, sensor)
        note = columns_note(filled.image.sensor, usual.width)
        return filled, f"{done}; {note}" if note else done
    if job.things is not None:
        sensor, things = named_sensor(scan, path, "--sensor", job.sensor, model.sensor), wanted(job.things)
        check_upright(work.target, sensor, job.transform)
        filled = insert_scan(model, scan, things, sensor, job.how.seed + work.number)
        in_image = work.target is not None and work.target.suffix.lower() == ".npz"
        said = told_of(filled, scan, things, None if in_image else job.transform)
        return filled, said + _columns(sensor, job, "; ")
    if job.verb == "label":
        sensor = named_sensor(scan, path, "--sensor", job.sensor, model.sensor)
        sensor = usual_at_most(sensor) if job.sensor is None else sensor
        named = label_scan(model, scan, sensor, job.how.precision, job.least)
        return named, found(named.points, sensor) + _columns(sensor, job, "; ")
    sensor = named_sensor(scan, path, "--from", job.sensor, model.sensor if model.any_sensor else None)
    filled = upsample_scan(model, scan, sensor, job.how, on_step, job.times, job.least)
    done = f"{plural(len(scan), 'point')} of {sensor.name} became {_count(filled, work)}"
    own = filled.image.sensor.width == sensor.width  # else the image is another sensor's
    return filled, done + _columns(sensor, job, "; ") if own else done


def _columns(sensor: Sensor, job: Job, before: str = "") -> str:
    """That a scan's own sensor, which nobody named, has other columns than usual, in words after `before`."""
    note = columns_note(sensor) if job.sensor is None else ""
    return note and before + note


def _points(done: Filled | RangeImage, loaded: Loaded, transform: np.ndarray | None) -> Scan:
    if isinstance(done, RangeImage):
        raise ValueError("expected a file or folder for range images, found a bag, which holds points")
    if done.errors:
        raise ValueError("expected a file or folder with --corrupt, found a bag")
    return back_in_place(done.points, loaded, transform)


def _store(target: Path, source: Path, done: Filled | RangeImage, loaded: Loaded, job: Job) -> tuple[str, ...]:
    """Write the result, the scan last: where it is, all is. Returns the endings of what is beside a .bin or .npy."""
    beside: tuple[str, ...] = ()
    if job.things is not None:
        check_boxes(target, source, len(loaded.scan) + loaded.dropped)
    target.parent.mkdir(parents=True, exist_ok=True)
    image = done if isinstance(done, RangeImage) else done.image
    if target.suffix.lower() == ".npz":
        content: RangeImage | Scan = image
    else:
        placed = image.to_scan()
        if isinstance(done, Filled) and not done.errors:
            placed = back_in_place(placed, loaded, job.transform)
        if target.suffix.lower() in BARE:
            beside = tuple(f".{name}" for name in BESIDE if name in placed.extra)
            beside += (LABEL,) if placed.label is not None or "raw_label" in placed.extra else ()
        check_companions(target, source, beside)  # again: only the points tell of labels in a .ply
        if LABEL in beside and job.things is not None:
            check_numbers(target, placed)
        if LABEL in beside:
            label_path(target).parent.mkdir(parents=True, exist_ok=True)  # labels/ beside velodyne/
            write_labels(label_path(target), placed)
        else:
            check_labels(target)
        content = without_places(placed)
    if job.picture:
        save_png(target.with_suffix(".png"), portrait(done) if isinstance(done, RangeImage) else done.figure())
    if job.things is not None and isinstance(done, Filled):
        write_boxes(target, done, job.transform)
        beside += (BOXES,)
    write(target, content)
    return beside
