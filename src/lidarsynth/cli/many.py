"""What verbs share that take many scans, as `complete` and `label` do: their options, and doing the work."""

from __future__ import annotations

import time
from collections import deque
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from lidarsynth.cli.arguments import Rings, arg
from lidarsynth.cli.outcomes import NAMED, check_any, named_failure, refuse_all, say_summary, tell, tell_of_many
from lidarsynth.cli.terminal import load_with_bar, say, scan_bar, step_bar, warn
from lidarsynth.lidar.plural import plural, was

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lidarsynth.data.bag_records import Topic
    from lidarsynth.data.bag_writer import BagWriter
    from lidarsynth.systems.scan_model import ScanModel
    from lidarsynth.verbs.batch import Job, Result, Work
    from lidarsynth.verbs.inputs import Input, Inputs

PICTURES = 10  # scans that get a picture unasked


@dataclass(frozen=True)
class Many:
    """Of bags, frames, and many scans."""

    topic: Annotated[
        str | None,
        arg(metavar="NAME", help="of a bag, or ADDRESS:PORT of a sensor in a capture; the only one if not given."),
    ] = None
    keep_topics: Annotated[bool, arg(help="copy all other topics, attachments and metadata into the new bag.")] = False
    metadata: Annotated[Path | None, arg(metavar="FILE", help="JSON of an Ouster's, CSV of a Hesai's packets.")] = None
    transform: Annotated[
        str | None,
        arg(
            metavar="T", help="brings points into the sensor's frame: x:y:z:roll:pitch:yaw, or a file of 4 x 4 numbers."
        ),
    ] = None
    axes: Annotated[
        str,
        arg(
            metavar="XYZ",
            help="where x, y, z of the files point (f b l r u d): CARLA's fru is left-handed, AirSim has frd.",
        ),
    ] = "flu"
    mount: Annotated[
        float | None, arg(metavar="M", help="metres of the sensor above the points' z = 0, where that is the ground.")
    ] = None
    rings: Rings = None
    strict: Annotated[bool, arg(help="refuse points that are not in the sensor's frame, instead of a warning.")] = False
    format: Annotated[
        str | None,
        arg(metavar="FORMAT", help="of files in a folder: ply, pcd, bin, npy or npz; default ply, of project npz."),
    ] = None
    workers: Annotated[int, arg(help="processes.")] = 1
    skip_existing: Annotated[bool, arg(help="leave out scans whose file is there: goes on where it was.")] = False
    shard: Annotated[str | None, arg(metavar="I/N", help="only every N-th scan, from the I-th: one of N machines.")] = (
        None
    )
    all_pictures: Annotated[bool, arg(help=f"pictures of captures, too, and of more than {PICTURES} scans.")] = False


def work_through(job: Job, paths: list[Path], out: Path, many: Many, intensity: str) -> list[Result]:
    """Do the job with every scan, say what came of it, and return the results, after those of scans that were there
    already, as far as reports tell them. Raises ValueError where all failed."""
    from lidarsynth.data.bag_writer import FORMATS
    from lidarsynth.data.workers import begin_early, check_workers
    from lidarsynth.verbs.expansion import is_stream
    from lidarsynth.verbs.inputs import Reading, inputs_of
    from lidarsynth.verbs.placement import parse_rings, read_transform

    check_workers(many.workers)
    transform = read_transform(many.transform, many.mount, many.axes)
    rings = parse_rings(many.rings)
    reading = Reading(intensity, many.topic, many.metadata, transform, job.verb != "label", job.needs_labels, rings)
    inputs = inputs_of(paths, reading, out)
    if inputs.below:
        names = ", ".join(path.name for path in inputs.below[:NAMED]) + (", ..." if inputs.below[NAMED:] else "")
        count = len(inputs.below)
        warn(f"{plural(count, 'scan')} below {out}, where results go, {was(count)} passed over: {names}; name them to "
             "read them")  # fmt: skip
    for line in inputs.words:
        warn(line)
    if many.workers > 1 and not inputs.single:
        begin_early("lidarsynth.verbs.batch", *(["lidarsynth.weights.load"] if job.verb != "project" else []))
    job = replace(job, transform=transform, strict=many.strict)
    if not (many.all_pictures or inputs.single or (inputs.count or PICTURES + 1) <= PICTURES):
        job = replace(job, picture=False)
    if out.suffix.lower() in FORMATS:
        if many.format is not None:
            raise ValueError(f"{out}: expected a folder with --format {many.format}, found a bag")
        return _into_bag(job, inputs, paths, out, many)
    if many.keep_topics:
        raise ValueError(f"{out}: expected a .mcap or .bag to keep topics in, found another kind of output")
    if inputs.single and not any(is_stream(path) for path in paths) and (out.suffix or out.is_file()):
        for word, given in (("--format", many.format), ("--shard", many.shard)):
            if given is not None:
                raise ValueError(f"{out}: expected a folder with {word} {given}, found the name of a file")
        if many.skip_existing and out.exists():
            say(f"{out} is there already")
            return []
        return _one(job, inputs, out)
    return _into_folder(job, inputs, out, many, intensity)


def _model(job: Job) -> ScanModel | None:
    """The model, its request checked before any work."""
    from lidarsynth.verbs.completion import check_confident

    if job.verb == "project":
        return None
    model = load_with_bar(job.model, job.device)
    if job.verb == "realise":
        model.check_realises()
        return model
    if job.verb == "insert":
        return model
    if job.verb == "label":
        return model.with_labels()
    (model.into(job.into) if job.into else model).check(job.how)
    check_confident(model, job.how, job.least)
    return model.with_labels() if job.labels else model


def _calls(job: Job, model: ScanModel | None, workers: int = 1) -> int:
    """How many network steps a scan takes, after each of which this process is told."""
    if model is None or workers > 1 or job.verb in ("realise", "insert", "label"):
        return 1
    return model.calls(model.resolved(job.how))


def _one(job: Job, inputs: Inputs, out: Path) -> list[Result]:
    from lidarsynth.verbs.batch import run
    from lidarsynth.verbs.output_files import works

    work = list(works(inputs, out, "ply", beside=job.beside))
    model = _model(job)
    with step_bar(work[0].item.path.name, _calls(job, model)) as on_step:
        (result,) = run(job, work, model=model, on_step=on_step)
    if result.error is not None:
        raise ValueError(named_failure(result))
    tell(result)
    return [result]


def _into_folder(job: Job, inputs: Inputs, out: Path, many: Many, intensity: str) -> list[Result]:
    from lidarsynth.lidar.whole_file import TOKEN, sweep
    from lidarsynth.verbs.batch_report import (
        check_report,
        is_mixed,
        merge_shards,
        other_names,
        parse_shard,
        remove_report,
        report_of,
        report_path,
        result_of,
        rows_before,
        same,
        shard_reports,
        write_report,
    )
    from lidarsynth.verbs.output_files import works

    shard, skipped, begun = parse_shard(many.shard), [], time.perf_counter()
    ending, report = many.format or ("npz" if job.verb == "project" else "ply"), report_path(out, shard)
    check_report(out, shard)
    before = rows_before(out, shard, ending) if many.skip_existing else {}
    if (told := other_names(out, ending, before, inputs.places)) is not None:
        warn(told)
    known = {file for file, row in before.items() if "errors" in row} if job.corrupt else None  # else no mean of all
    stream = works(inputs, out, ending, shard, many.skip_existing, skipped, job.beside, known)
    first = next(stream, None)
    with _held(out, alone=shard[1] == 1):
        replaced = shard_reports(out) if shard[1] == 1 else []
        model = _model(job) if first is not None or skipped else None
        settings = _settings(job, model, out, many, ending, intensity)
        if shard[1] == 1:
            sweep(out, deep=True, token=TOKEN)
        count = None if inputs.count is None else len(range(shard[0] - 1, inputs.count, shard[1]))
        results = _done(job, model, _again(first, stream), many, count, report, settings, before)
        seconds = time.perf_counter() - begun
        others = report.is_file() and not same(report, settings["recipe"], told=False)  # of a part, to be kept
        nothing = results and not skipped and all(result.error is not None for result in results)
        if nothing and (shard[1] == 1 or others):  # else the other parts may be whole
            refuse_all(results)
        out.mkdir(parents=True, exist_ok=True)
        rows = [before[file] for file in skipped if file in before]
        write_report(report, report_of(results, len(skipped), seconds, settings, rows))
        for path in replaced:
            remove_report(path)
        merged = merge_shards(out, shard[1])
    if merged is not None and is_mixed(merged):
        warn(f"{merged}: expected shards of one recipe, found several in report-*-of-{shard[1]}.json; make those of "
             "another anew, without --skip-existing")  # fmt: skip
    if replaced:
        warn(f"{report}: of this run's scans now, in place of {', '.join(path.name for path in replaced[:NAMED])}"
             f"{', ...' if replaced[NAMED:] else ''}, of shards that were made here before")  # fmt: skip
    say_summary(results, len(skipped), seconds, merged or report)
    if merged is not None:
        check_any(merged)
    return [*map(result_of, rows), *results]


def _done(
    job: Job,
    model: ScanModel | None,
    works: Iterator[Work],
    many: Many,
    count: int | None,
    report: Path,
    settings: dict[str, Any],
    before: dict[Path, dict[str, Any]],
) -> list[Result]:
    """What came of the works, said as they are done; from the first that is, the report tells that the run goes on, and
    the journal what has been made, after what was `before`."""
    from lidarsynth.verbs.batch import run
    from lidarsynth.verbs.batch_report import add_to_journal, begin_journal

    results = []
    with scan_bar(job.verb, count, _calls(job, model, many.workers)) as (on_scan, on_step):
        for result in run(job, works, many.workers, model, on_step):
            if result.error is None:
                if all(earlier.error is not None for earlier in results):
                    report.parent.mkdir(parents=True, exist_ok=True)
                    begin_journal(report, before.values())
                    _begin(report, settings, many.skip_existing)
                add_to_journal(report, result)
            results.append(result)
            on_scan()
            tell_of_many(result, (count or PICTURES + 1) <= PICTURES, len(results))
    return results


@contextmanager
def _held(out: Path, alone: bool) -> Iterator[None]:
    """The folder, which nobody else writes to if `alone`; shards share it. One that is made for the lock, and stays
    empty, is taken away.

    Raises ValueError where another process holds it, and where nobody can know that none does.
    """
    from lidarsynth.files.lock import only_writer
    from lidarsynth.verbs.batch_report import shards_at_work

    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        with only_writer(out, "run", shared=not alone) as locked:
            if alone and not locked and (working := shards_at_work(out)):
                raise ValueError(f"{working[0]}: expected shards that are done, found one at work, or killed: wait, or "
                                 "remove it")  # fmt: skip
            yield
    finally:
        for folder in made:
            with suppress(OSError):
                folder.rmdir()


def _settings(job: Job, model: ScanModel | None, out: Path, many: Many, ending: str, intensity: str) -> dict[str, Any]:
    """What the report says of the run. Raises ValueError where files that are there already would be gone on with, and
    were made in another way."""
    from lidarsynth.systems.fingerprint import fingerprint
    from lidarsynth.verbs.batch_report import check_no_other_whole, check_same, parse_shard

    reading = {"intensity": None if intensity == "auto" else intensity, "rings": many.rings, "topic": many.topic}
    recipe = job.recipe(None if model is None else fingerprint(model))
    reading["metadata"] = None if many.metadata is None else _told_by(many.metadata)
    recipe |= {name: word for name, word in reading.items() if word is not None}
    if many.skip_existing:
        check_same(out, recipe)
    if parse_shard(many.shard)[1] > 1:
        check_no_other_whole(out, recipe)
    settings = {"verb": job.verb, "model": job.model, "out": str(out), "format": ending, "workers": many.workers}
    return settings | ({"shard": many.shard} if many.shard else {}) | {"recipe": recipe}


def _told_by(metadata: Path) -> str:
    """The digits of a `.json` or `.csv`, wherever it is; of a bag that holds one, which may be large, its name."""
    if metadata.suffix.lower() not in (".json", ".csv") or not metadata.is_file():
        return metadata.name
    return blake2b(metadata.read_bytes(), digest_size=8).hexdigest()


def _begin(report: Path, settings: dict[str, Any], goes_on: bool) -> None:
    """Says how the scans of a run are made that may be killed; the report of such scans stays until the run is done.

    goes_on  with the scans that are there, which `check_same` found to be alike
    """
    from lidarsynth.verbs.batch_report import same, shard_reports, unfinished, write_report

    recipe = settings["recipe"]
    others = [] if "shard" in settings else shard_reports(report.parent)
    if all(same(path, recipe) for path in (report, *others)):
        return
    there = [path for path in (report, *others) if path.exists()]
    mixed = not all(goes_on and same(path, recipe, told=False) for path in there)
    write_report(report, unfinished(settings, mixed))


def _again(first: Any, rest: Iterator[Any]) -> Iterator[Any]:
    if first is not None:
        yield first
        yield from rest


def _into_bag(job: Job, inputs: Inputs, paths: list[Path], out: Path, many: Many) -> list[Result]:
    from lidarsynth.data.bag_writer import write_bag
    from lidarsynth.data.bags import is_bag
    from lidarsynth.lidar.whole_file import unfinished
    from lidarsynth.verbs.batch import Work, run
    from lidarsynth.verbs.output_files import check_bag, looked_at

    if many.shard or many.skip_existing or len(paths) != 1 or not is_bag(paths[0]):
        raise ValueError(f"{out}: expected one bag to make another of, without --shard and --skip-existing; a folder "
                         "takes anything")  # fmt: skip
    if job.verb in ("project", "insert") or job.corrupt:
        words = {"project": "range images", "insert": "boxes"}
        word = words.get(job.verb, f"--corrupt {job.corrupt}")
        raise ValueError(f"{out}: expected a file or folder for {word}, found a bag, which holds points")
    check_bag(out, [paths[0], *([] if many.metadata is None else [many.metadata])])
    for left in unfinished(out):
        warn(f"{left}: of a run that was killed; remove it, unless one is at work there")
    model, begun, results = _model(job), time.perf_counter(), []
    out.parent.mkdir(parents=True, exist_ok=True)
    topic, others = _topics(paths[0], many)
    calls = _calls(job, model, many.workers)
    taken: deque[Input] = deque()
    copied = []
    with write_bag(out, others) as writer, scan_bar(job.verb, inputs.count, calls) as (on_scan, on_step):
        writer.publish_as(topic)
        if many.keep_topics:
            _copy(paths[0], writer, others)
        items = enumerate(_noted(inputs.stream(), taken))
        stream = (Work(item, None, looked_at(number), number) for number, item in items)
        for result in run(replace(job, picture=False), stream, many.workers, model, on_step):
            item = taken.popleft()
            if result.cloud is not None:
                writer.write_cloud(topic.name, result.cloud)
            elif many.keep_topics and _copied(item, topic.name, writer):
                copied.append(Path(result.name).name)
            results.append(replace(result, cloud=None))
            on_scan()
            tell_of_many(result, False, len(results))
        if results and all(result.error is not None for result in results):
            refuse_all(results)  # before the bag is in its place
    if copied:
        warn(f"{out}: {plural(len(copied), 'message')} that failed {was(len(copied))} copied unchanged: "
             f"{', '.join(copied[:NAMED])}{', ...' if copied[NAMED:] else ''}")  # fmt: skip
    say_summary(results, 0, time.perf_counter() - begun, out)
    return results


def _noted(stream: Iterator[Input], taken: deque[Input]) -> Iterator[Input]:
    """The scans, each put into `taken` until its result is there."""
    for item in stream:
        taken.append(item)
        yield item


def _copied(item: Input, topic: str, writer: BagWriter) -> bool:
    """Whether a message of which nothing was made is in the new bag as it was; packets are copied anyway."""
    from lidarsynth.data.bag_records import POINTS, Message
    from lidarsynth.verbs.inputs import MessageInput

    message = item.message if isinstance(item, MessageInput) else None
    return isinstance(message, Message) and message.topic.kind == POINTS and writer.copy_cloud(topic, message)


def _topics(path: Path, many: Many) -> tuple[Topic, list[Topic]]:
    """The topic of points, of packets one of its own, and the others that are to be copied."""
    from lidarsynth.data.bag_records import OF_PACKETS
    from lidarsynth.data.bags import open_bag

    with open_bag(path) as bag:
        topic = bag.point_topic(many.topic)
        kind = bag.kind_of(topic)
        own = next(one for one in bag.topics if (one.name, one.kind) == (topic, kind))
        others = [one for one in bag.topics if (one.name, one.kind) != (topic, kind) or kind in OF_PACKETS]
        named = replace(own, name=f"{topic}/points") if kind in OF_PACKETS else own
        return named, others if many.keep_topics else []


def _copy(path: Path, writer: BagWriter, topics: list[Topic]) -> None:
    from lidarsynth.data.bags import open_bag

    with open_bag(path) as bag:
        kept = {(topic.name, topic.kind) for topic in topics}
        for message in bag.messages(frozenset(topic.name for topic in topics)) if topics else ():
            if (message.topic.name, message.topic.kind) in kept:  # a topic may be of several types
                writer.copy(message)
        left = [record.name for record in bag.attached() if not writer.attach(record)]
    if left:
        warn(f"{writer.path}: expected a .mcap for attachments and metadata, found a .bag, which holds none: "
             f"{', '.join(left[:NAMED])}{', ...' if left[NAMED:] else ''} left out")  # fmt: skip
